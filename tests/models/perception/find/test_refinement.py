"""Echoes placed below the cell on complex maps."""

from __future__ import annotations

import msgspec
import numpy as np
import pytest

from benchmarks.perception.cramer_rao import azimuth_response, raw_bound
from models.perception.find.peaks import PeakParams, peaks_at
from models.perception.find.refinement import EchoRefiner, RefinementParams, refined_peaks
from models.perception.form.coarray import AzimuthInterpolator
from models.perception.form.ra_forming import ScanProfiles, form_map
from models.physics.waveform import WINDOW_TAPS, tone_profile
from msgs.values.radar import RadarSetup, RangeAzimuthGrid, RangeAzimuthMap

SETUP = RadarSetup()
GRID = RangeAzimuthGrid()
INTERPOLATOR = AzimuthInterpolator(SETUP)
REFINER = EchoRefiner(SETUP)
CELL = np.array([GRID.range_bin_m, GRID.azimuth_step_rad])


def map_of(
    place: np.ndarray, amplitude: np.ndarray, noise_mw: float, seed: int = 0, missing: tuple[int, ...] = ()
) -> RangeAzimuthMap:
    """The map of echoes at fractional cells [N, 2]; noise per beam and windowed bin."""
    rng = np.random.default_rng(seed)
    white = rng.standard_normal((2, len(SETUP.beams), GRID.range_bins + 2)) * np.sqrt(0.5 * noise_mw / 1.5)
    bins = white[0] + 1j * white[1]
    noise = sum(tap * bins[:, i : i + GRID.range_bins] for i, tap in enumerate(WINDOW_TAPS["hann"]))
    tones = tone_profile(SETUP.radar.samples_per_chirp, place[:, 0], GRID.range_bins) * amplitude[:, None]
    profiles = azimuth_response(SETUP, GRID.azimuth_at(place[:, 1])).T @ tones + noise
    profiles[list(missing)] = 0.0
    stamps_ns = np.zeros(len(SETUP.beams), np.int64)
    return form_map(ScanProfiles(0, 0, profiles.astype(np.complex64), noise_mw, stamps_ns, missing), INTERPOLATOR)


def echoes(count: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Isolated echoes within +-50 degrees at random fractions of a cell, and their amplitudes of random phase."""
    rng = np.random.default_rng(seed)
    place = np.stack([24.0 * (1 + np.arange(count)) + rng.uniform(-0.5, 0.5, count), rng.uniform(22, 233, count)], 1)
    return place, np.exp(2j * np.pi * rng.random(count))


@pytest.mark.parametrize("missing", [(), (11,), (3, 16)])
def test_places_of_clean_echoes_are_exact(missing: tuple[int, ...]) -> None:
    """No noise, starts half a bin and 2 cells off; single beams may miss. Tolerance: a thousandth of a cell."""
    place, amplitude = echoes(20, 1)
    found = REFINER.refine(map_of(place, amplitude, 1e-14, missing=missing), place + np.array([0.4, -2.0]))
    assert found.refined.all()
    np.testing.assert_allclose(found.fractional, place, atol=1e-3)
    np.testing.assert_allclose(np.abs(found.amplitude), 1.0, atol=1e-3)


@pytest.mark.parametrize("snr_db", [20.0, 35.0])
def test_errors_stay_within_twice_the_bound_and_match_their_covariance(snr_db: float) -> None:
    """200 echoes (10 maps of 20): RMSE over the raw bound; mean squared error over stated variance near 1."""
    noise_mw = 10.0 ** (-snr_db / 10.0)
    refiner = EchoRefiner(SETUP, RefinementParams(range_std_floor_m=0.0, azimuth_std_floor_deg=0.0))
    errors, stated, bounds = [], [], []
    for seed in range(10):
        place, amplitude = echoes(20, seed)
        found = refiner.refine(map_of(place, amplitude, noise_mw, seed), np.rint(place))
        errors.append((found.fractional - place) * CELL)
        stated.append(np.diagonal(found.covariance, axis1=1, axis2=2))
        alone = [raw_bound(SETUP, at[:1], GRID.azimuth_at(at[1:]), np.ones(1), noise_mw)[0] for at in place]
        bounds.append(np.diagonal(alone, axis1=1, axis2=2))
    squared = np.concatenate(errors) ** 2
    ratio = np.sqrt(squared.mean(axis=0) / np.concatenate(bounds).mean(axis=0))
    assert (ratio > 0.85).all()
    assert (ratio < 1.7).all()
    np.testing.assert_allclose(np.mean(squared / np.concatenate(stated), axis=0), 1.0, atol=0.3)


def test_neighbours_no_longer_pull_at_each_other() -> None:
    """Two equal echoes 16 cells (7.5 deg) apart at 45 dB, in quadrature: alone each is 1 cell off, together none."""
    place = np.array([[100.3, 120.0], [100.3, 136.0]])
    ra_map = map_of(place, np.array([1.0, 1.0j]), 10.0**-4.5)
    start = place + np.array([[0.0, 2.0], [0.0, -2.0]])
    together = REFINER.refine(ra_map, start).fractional
    alone = np.concatenate([REFINER.refine(ra_map, start[i : i + 1]).fractional for i in range(2)])
    assert np.abs(together - place).max() < 0.3
    assert np.abs(alone - place).max() > 1.0


def test_range_lobes_of_a_strong_wall_are_taken_off() -> None:
    """An echo 4 bins behind one 50 dB stronger: within 0.03 bins with the wall among the echoes."""
    place = np.array([[100.4, 120.0], [104.4, 124.0]])
    ra_map = map_of(place, np.array([316.0, 1.0]), 1e-4)
    both = REFINER.refine(ra_map, np.rint(place)).fractional
    assert np.abs(both[1] - place[1])[0] < 0.03


def test_bins_of_magnitudes_stay() -> None:
    place, amplitude = echoes(3, 0)
    ra_map = map_of(place, amplitude, 1e-3)
    incoherent = ra_map.incoherent.copy()
    incoherent[round(place[1, 0])] = True
    found = REFINER.refine(msgspec.structs.replace(ra_map, incoherent=incoherent), place + 0.2)
    assert found.refined.tolist() == [True, False, True]
    np.testing.assert_array_equal(found.fractional[1], place[1] + 0.2)


def test_a_point_brings_its_covariance_and_a_crowd_keeps_the_error_model() -> None:
    """One echo alone; and 40 of random phase within 2 bins and 30 cells, named by one peak."""
    rng = np.random.default_rng(5)
    crowd = np.stack([200.0 + rng.uniform(-1, 1, 40), 120.0 + rng.uniform(-15, 15, 40)], axis=1)
    place = np.concatenate([[[100.3, 80.6]], crowd])
    amplitude = np.concatenate([[10.0], 3.0 * np.exp(2j * np.pi * rng.random(40))])
    ra_map = map_of(place, amplitude, 1e-3)
    cells = np.array([[100, 81], [200, 120]])
    peaks = peaks_at(ra_map, cells, cells.astype(float), np.ones(2), np.zeros(2, np.uint8), PeakParams())
    found = refined_peaks(peaks, ra_map, REFINER)
    assert found.azimuth_rad[0] == pytest.approx(GRID.azimuth_at(80.6), abs=1e-3)
    assert found.range_m[0] == pytest.approx(GRID.range_at(100.3), abs=5e-3)
    assert np.sqrt(found.covariance[0, 1, 1]) == pytest.approx(np.radians(0.2), rel=0.1)
    np.testing.assert_array_equal(found.covariance[1], peaks.covariance[1])
    np.testing.assert_array_equal(found.snr_db, peaks.snr_db)


def test_params_say_what_they_must_be() -> None:
    with pytest.raises(ValueError, match=r"patch_bins must be odd and at least 3, got 4"):
        RefinementParams(patch_bins=4)
    with pytest.raises(ValueError, match=r"refinement\.iterations must be"):
        RefinementParams(iterations=0)
    with pytest.raises(ValueError, match=r"window must be one of .*got 'flat'"):
        EchoRefiner(SETUP, window="flat")
