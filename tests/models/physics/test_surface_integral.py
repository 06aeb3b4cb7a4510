"""Physical optics of one wall: against the image, the bare surface, the knife edge."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.special import fresnel

from tests.models.physics.surface_integral import surface_field, two_way_field, wall_field

WAVELENGTH_M = 0.1
RADAR, PLACE = np.array([0.0, 0.0, 0.3]), np.array([1.0, 8.0, 0.9])
#: Both see the wall x = 6; the specular point is at y = 4.36.
WALL = np.array([6.0, -4.0]), np.array([6.0, 12.0])
IMAGE = np.array([11.0, 8.0, 0.9])


def image_field(image: np.ndarray, wavelength_m: float) -> complex:
    length_m = np.linalg.norm(image - RADAR)
    return complex(np.exp(-2j * np.pi / wavelength_m * length_m) / length_m)


def decibel(ratio: complex) -> float:
    return float(20.0 * np.log10(abs(ratio)))


def test_endless_flat_wall_gives_the_field_of_the_image() -> None:
    """Layout: 16 m wall, ends faded over 3 m. Exact: e^{-jkL} / L.

    Bias: stationary phase in height drops a phase of order 1/(k l), measured 1.03 mrad at 3 GHz (and 7e-6 dB); at a
    tenth of the wavelength a tenth of it.
    """
    for wavelength_m, tolerance_rad in ((WAVELENGTH_M, 1.5e-3), (0.1 * WAVELENGTH_M, 1.5e-4)):
        ratio = wall_field(RADAR, PLACE, *WALL, 0.0, wavelength_m, taper_m=3.0) / image_field(IMAGE, wavelength_m)
        assert abs(decibel(ratio)) < 1e-3
        assert abs(np.angle(ratio)) < tolerance_rad


def test_bare_surface_integral_gives_the_field_of_the_image() -> None:
    """As above over the whole surface, 16 m x 15 m: no stationary phase, so only the fading (3 m) is left as error."""
    field = surface_field(RADAR, PLACE, *WALL, 0.0, WAVELENGTH_M, (-7.0, 8.0), taper_m=3.0)
    assert abs(field / image_field(IMAGE, WAVELENGTH_M) - 1.0) < 1e-4


@pytest.mark.parametrize("curvature_per_m", [0.0, 0.04, -0.04])
def test_one_integral_is_the_surface_integral(curvature_per_m: float) -> None:
    """Height by stationary phase against both dimensions integrated, flat, hollow and bulging wall.

    Bias 1.0-1.2 mrad (1/(8k) of the legs). Measured difference in level: 2e-5 dB.
    """
    surface = surface_field(RADAR, PLACE, *WALL, curvature_per_m, WAVELENGTH_M, (-7.0, 8.0), taper_m=3.0)
    line = wall_field(RADAR, PLACE, *WALL, curvature_per_m, WAVELENGTH_M, taper_m=3.0)
    assert abs(decibel(line / surface)) < 1e-3
    assert abs(np.angle(line / surface)) < 2e-3


@pytest.mark.parametrize("curvature_per_m", [0.0, 0.04, -0.04])
@pytest.mark.parametrize("heights_m", [(-0.4, 1.2), (-0.4, 9.0), (0.6, 3.0), (1.5, 3.0)])
def test_finite_height_is_the_fresnel_integral(curvature_per_m: float, heights_m: tuple[float, float]) -> None:
    """Walls of finite height, sharp on all sides: Fresnel integrals in height against the surface.

    The last wall stands above the specular point and only diffracts (-23 dB). Tolerance: 2 % of the endless wall's
    field; measured 1.0 %.
    """
    surface = surface_field(RADAR, PLACE, *WALL, curvature_per_m, WAVELENGTH_M, heights_m)
    line = wall_field(RADAR, PLACE, *WALL, curvature_per_m, WAVELENGTH_M, heights_m)
    assert abs(line - surface) < 0.02 * abs(image_field(IMAGE, WAVELENGTH_M))


@pytest.mark.parametrize("beyond_m", [-2.0, -0.7, -0.2, 0.0, 0.2, 0.7, 2.0])
def test_sharp_end_is_a_knife_edge(beyond_m: float) -> None:
    """Wall that ends `beyond_m` past the specular point: half-plane of the image, (1 + j)/2 times a Fresnel integral.

    v = 2 sqrt(detour / wavelength); at v = 0 half the field, -6.02 dB. Measured: within 0.6 % of the image's field.
    """
    wavelength_m = 0.02
    specular = np.array([6.0, 6.0 / 11.0 * 8.0])
    end = specular + np.array([0.0, beyond_m])
    field = wall_field(RADAR, PLACE, np.array([6.0, -60.0]), end, 0.0, wavelength_m, taper_m=0.0)
    height = RADAR[2] + 0.6 * 6.0 / 11.0
    corner = np.append(end, height)
    detour_m = np.linalg.norm(corner - RADAR) + np.linalg.norm(PLACE - corner) - np.linalg.norm(IMAGE - RADAR)
    sine, cosine = fresnel(np.sign(beyond_m) * np.sqrt(4.0 * detour_m / wavelength_m))
    expected = 0.5 * (1.0 + 1j) * (cosine + 0.5 - 1j * (sine + 0.5))
    assert abs(field / image_field(IMAGE, wavelength_m) - expected) < 0.015


def test_out_and_back_are_the_same_number() -> None:
    """Reciprocity, exact: sharp, curved and finite."""
    out = wall_field(RADAR, PLACE, *WALL, 0.04, WAVELENGTH_M, (0.0, 2.0))
    back = wall_field(PLACE, RADAR, *WALL, 0.04, WAVELENGTH_M, (0.0, 2.0))
    assert out == pytest.approx(back, rel=1e-12)
    assert two_way_field(out) == pytest.approx(out * back, rel=1e-12)


def test_places_on_two_sides_have_no_mirror() -> None:
    assert wall_field(RADAR, np.array([9.0, 8.0, 0.9]), *WALL, 0.0, WAVELENGTH_M) == 0.0


def test_turning_everything_changes_nothing() -> None:
    turn = np.array([[0.6, -0.8], [0.8, 0.6]])
    moved = [np.append(turn @ place[:2] + [3.0, -9.0], place[2]) for place in (RADAR, PLACE)]
    ends = [turn @ end + [3.0, -9.0] for end in WALL]
    field = wall_field(RADAR, PLACE, *WALL, 0.04, WAVELENGTH_M)
    assert wall_field(moved[0], moved[1], ends[0], ends[1], 0.04, WAVELENGTH_M) == pytest.approx(field, rel=1e-9)


@pytest.mark.parametrize("wavelength_m", [0.0, -1.0, float("nan")])
def test_wavelength_is_checked(wavelength_m: float) -> None:
    with pytest.raises(ValueError, match="wavelength must be positive"):
        wall_field(RADAR, PLACE, *WALL, 0.0, wavelength_m)
