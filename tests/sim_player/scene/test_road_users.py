"""Road users as scattering centres."""

from __future__ import annotations

import numpy as np
import pytest

from sim_player.scene.description import OBJECT_KINDS
from sim_player.scene.road_users import CENTRE_HEIGHT_M, scattering_centres, seen_rcs_m2

CLASSES = list(OBJECT_KINDS)


def towards(aspect_deg: float) -> np.ndarray:
    return np.array([[np.cos(np.radians(aspect_deg)), np.sin(np.radians(aspect_deg))]])


def test_coherent_rcs_averages_to_the_same() -> None:
    """Speckle: the coherent sum |sum sqrt(rcs) e^{j(phase + 2 k r)}|^2 averages to the incoherent one.

    Layout: a car at 10 GHz, 720 aspects, 40 seeds. Centres 0.28 m apart are 19 half waves: independent phases. One
    aspect is exponentially distributed; some 10 a seed are independent, so 400 draws: 5 % = 0.22 dB rms, 3 sigma.
    """
    wave_number = 2.0 * np.pi * 10e9 / 299_792_458.0
    aspect = np.linspace(0.0, 2.0 * np.pi, 720, endpoint=False)
    direction = np.column_stack([np.cos(aspect), np.sin(aspect)])
    total = []
    for seed in range(40):
        car = scattering_centres("car", seed, 0)
        rcs = seen_rcs_m2(car.peak_rcs_m2, car.normals, car.lobe_exponent, direction[:, None])
        phase = car.phase_rad + 2.0 * wave_number * direction @ car.position_m[:, :2].T
        total.append(np.mean(np.abs((np.sqrt(rcs) * np.exp(1j * phase)).sum(axis=1)) ** 2))
    assert 10.0 * np.log10(np.mean(total)) == pytest.approx(11.25, abs=0.66)


@pytest.mark.parametrize("name", CLASSES)
def test_centres_stand_on_the_outline(name: str) -> None:
    kind, centres = OBJECT_KINDS[name], scattering_centres(name, 3, 1)
    x, y, z = centres.position_m.T
    off_outline = np.minimum(np.abs(np.abs(x) - kind.length_m / 2), np.abs(np.abs(y) - kind.width_m / 2))
    assert off_outline.max() < 1e-12
    assert np.abs(x).max() <= kind.length_m / 2 + 1e-12
    assert np.abs(y).max() <= kind.width_m / 2 + 1e-12
    assert z.min() >= CENTRE_HEIGHT_M[0]
    assert z.max() <= CENTRE_HEIGHT_M[1]
    # outward normals: a centre is on the side its normal points to
    assert (np.einsum("ki,kfi->kf", centres.position_m[:, :2], centres.normals[..., :2]) > 0.0).all()


def test_faces_scatter_their_peak_along_their_normal_a_lobe_beside_it_and_nothing_behind() -> None:
    """Sixty degrees off: a tenth without a lobe, the rest by cos^12; a corner, of both faces, keeps its peak."""
    car = scattering_centres("car", 0, 0)
    front, corner = car.position_m[:, 0] == 2.25, np.abs(car.position_m[:, 1]) == 0.9
    for aspect_deg, face in ((0.0, 1.0), (60.0, 0.1 + 0.9 * 0.5**12)):
        seen = seen_rcs_m2(car.peak_rcs_m2, car.normals, car.lobe_exponent, towards(aspect_deg)) / car.peak_rcs_m2
        assert seen[front & ~corner] == pytest.approx(face)
        assert seen[front & corner] == pytest.approx(1.0)
    seen = seen_rcs_m2(car.peak_rcs_m2, car.normals, car.lobe_exponent, towards(0.0))
    assert (car.position_m[seen > 0.0, 0] > 0.0).all()


def test_same_seed_same_centres_and_objects_differ() -> None:
    one, again, other = (scattering_centres("car", 5, index) for index in (0, 0, 1))
    np.testing.assert_array_equal(one.phase_rad, again.phase_rad)
    assert not np.array_equal(one.phase_rad, other.phase_rad)
