"""Edges of the shifted series, of CFAR-NLOS and of choosing scenes: nothing there, everything there, full gain."""

from __future__ import annotations

import math

import numpy as np
import pytest

from lab.evaluate.cfar_nlos import CfarNlosParams, privileged_peaks
from msgs.values.perception import PathClass
from msgs.values.radar import RadarSetup, RangeAzimuthGrid, RangeAzimuthMap
from sim_player.dataset.domain_shift import ShiftParams, domain_shifted_scene, draw_faults, faulty_profiles
from sim_player.dataset.labelled_scan import profile_noise
from sim_player.scene.description import Scene, SceneObject
from tests.builders import example_map

SETUP = RadarSetup()
GRID = RangeAzimuthGrid()


def map_of(values: np.ndarray, noise_power_mw: float) -> RangeAzimuthMap:
    return example_map(values, noise_power_mw=noise_power_mw)


@pytest.mark.parametrize("noise_power_mw", [0.0, 1e-11])
def test_an_empty_map_has_no_peaks(noise_power_mw: float) -> None:
    empty = np.zeros(0)
    peaks = privileged_peaks(map_of(np.zeros(GRID.shape), noise_power_mw), empty, empty, empty)
    assert len(peaks) == 0


@pytest.mark.parametrize("scale", [1e-15, 1.0, 1e12])
def test_levels_do_not_matter(scale: float) -> None:
    """The same map in other units: the same cells and classes."""
    rng = np.random.default_rng(3)
    values = rng.normal(size=GRID.shape) + 1j * rng.normal(size=GRID.shape)
    values[100:103, 60:72] += 300.0
    values[220:223, 150:162] += 300.0
    truth = np.array([101 * GRID.range_bin_m]), np.array([GRID.azimuth_at(np.array(66.0))]), np.array([PathClass.LOS])
    plain = privileged_peaks(map_of(values, 2.0), *truth)
    scaled = privileged_peaks(map_of(scale * values, 2.0 * scale**2), *truth)
    assert {PathClass.LOS, PathClass.MIRRORED} <= set(plain.path_class.tolist())
    np.testing.assert_array_equal(scaled.path_class, plain.path_class)
    np.testing.assert_allclose(scaled.range_m, plain.range_m, atol=1e-3)


def test_tolerance_over_everything_makes_all_direct() -> None:
    rng = np.random.default_rng(4)
    values = rng.normal(size=GRID.shape) + 1j * rng.normal(size=GRID.shape)
    values[50::60, 20::50] += 300.0
    wide = CfarNlosParams(range_tolerance_m=1e6, azimuth_tolerance_deg=360.0)
    peaks = privileged_peaks(map_of(values, 2.0), np.zeros(1), np.zeros(1), np.zeros(1), wide)
    assert len(peaks) > 10
    assert (peaks.path_class == PathClass.LOS).all()


def test_full_gain_with_phase_errors_stays_finite() -> None:
    """|exp(j phi)|^2 exceeds one by a rounding for many phases: no root of a negative number, no noise added."""
    params = ShiftParams(beam_gain=(1.0, 1.0), beam_phase_deg=60.0, dead_beams=(0, 0))
    profiles = profile_noise(SETUP, 2).astype(np.complex64)
    for seed in range(20):
        faults = draw_faults(np.random.default_rng(seed), len(SETUP.beams), params)
        turned = faulty_profiles(profiles, faults, SETUP, 2)
        np.testing.assert_allclose(np.abs(turned), np.abs(profiles), rtol=1e-5, atol=1e-7 * np.abs(profiles).max())


def test_all_beams_but_one_may_die() -> None:
    params = ShiftParams(dead_beams=(99, 99))
    faults = draw_faults(np.random.default_rng(1), len(SETUP.beams), params)
    assert faults.dead.sum() == len(SETUP.beams) - 1


def test_a_scene_without_walls_takes_clutter() -> None:
    """A lone car: clutter is placed around it, not in it, and all in front of the radar."""
    scene = Scene(name="lone", objects=(SceneObject(class_="car", x_m=12.0, y_m=0.0),))
    for seed in range(10):
        shifted = domain_shifted_scene(scene, np.random.default_rng(seed))
        ends = np.array([surface.polyline_m for surface in shifted.surfaces])
        assert 4 <= len(ends) <= 11
        assert not scene.objects[0].contains(ends.reshape(-1, 2)).any()
        assert np.abs(np.arctan2(ends[..., 1], ends[..., 0])).max() < math.radians(90.0)
