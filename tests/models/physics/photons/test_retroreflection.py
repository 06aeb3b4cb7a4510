"""The hidden retroreflector's law: a worked example, both ends of its fall-off, and the bounds of its arguments."""

from __future__ import annotations

import math

import numpy as np
import pytest

from models.physics.photons.optics import confocal_photons, photons_per_pulse, retroreflected_photons
from msgs.values.lidar import SpadParams

#: Spot of 5 mm radius at 5 m.
SPAD = SpadParams()


def photons(segment_m: float = 0.4, cone_rad: float = 1e-3, exponent: float = 1.0, **other: float) -> float:
    fields = {"spot_cosine": 1.0, "wall_cosine": 1.0, "object_cosine": 1.0, **other}
    return float(
        retroreflected_photons(
            SPAD, 5.0, 0.5, fields["spot_cosine"], segment_m, fields["wall_cosine"], fields["object_cosine"], 1e-4, 0.5,
            cone_rad, exponent,
        )
    )  # fmt: skip


def test_a_narrow_cone_by_hand() -> None:
    """1 cm^2 at 0.4 m: 0.5 / pi x 1e-4 / 0.16 on it, all of 0.5 back, 0.5 x (5 mm / 5 m)^2 to the aperture."""
    by_hand = photons_per_pulse(SPAD) * (0.5 / math.pi * 1e-4 / 0.16) * 0.5 * (0.5 * 1e-6 / (1.0 + 1e-6))
    assert photons() == pytest.approx(by_hand, rel=1e-9)


def test_fall_off_is_the_square_near_and_the_fourth_power_far() -> None:
    """The spot is 12 rms of the cone wide at 0.4 m, and a thousandth of them at 5 km."""
    assert photons(0.2) / photons(0.4) == pytest.approx(4.0, rel=1e-9)
    assert photons(5e3) / photons(1e4) == pytest.approx(16.0, rel=1e-5)


def test_a_retroreflector_outshines_a_matt_patch_by_the_cone() -> None:
    """Far away the ratio is that of the solid angles, pi of a matt patch over 2 pi cone^2: half a million."""
    matt = float(confocal_photons(SPAD, 5.0, 0.5, 1e4, 1.0, 1.0, 1e-4, 0.5))
    assert photons(1e4) / matt == pytest.approx(math.pi / (2.0 * math.pi * 1e-6), rel=1e-5)


def test_cosines() -> None:
    assert photons(object_cosine=0.5, exponent=3.0) / photons() == pytest.approx(0.125, rel=1e-9)
    assert photons(wall_cosine=0.5) / photons() == pytest.approx(0.5, rel=1e-9)
    assert photons(spot_cosine=0.5) / photons() == pytest.approx(0.5, rel=1e-9)
    assert photons(spot_cosine=0.0) == 0.0
    assert photons(segment_m=1e4, spot_cosine=0.5) / photons(segment_m=1e4) == pytest.approx(1.0, rel=1e-3)


def test_no_more_light_than_there_is() -> None:
    near = retroreflected_photons(SPAD, 1e-6, 1.0, 1.0, 1e-6, 1.0, 1.0, 4.0, 1.0, 1e-9)
    assert float(near) <= photons_per_pulse(SPAD)
    assert np.isfinite(near)


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"segment_m": 0.0}, "segment_m must be finite and positive"),
        ({"cone_rad": 0.0}, "cone_rad must be finite and positive"),
        ({"cone_rad": math.nan}, "cone_rad must be finite and positive"),
        ({"exponent": -1.0}, "entrance_exponent must be finite and not negative"),
        ({"exponent": math.inf}, "entrance_exponent must be finite and not negative"),
        ({"wall_cosine": 1.5}, r"wall_cosine must lie in 0\.\.1"),
    ],
)
def test_arguments_out_of_range_are_refused(fields: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        photons(**fields)
