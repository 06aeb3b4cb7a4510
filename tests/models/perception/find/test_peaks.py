from __future__ import annotations

import math

import msgspec
import numpy as np
import pytest

from models.perception.find.peaks import PeakParams, echo_power, find_peaks, local_maxima, peaks_at, polar_covariance
from msgs.values.perception import MAX_PEAKS, PathClass
from msgs.values.radar import RangeAzimuthGrid, RangeAzimuthMap
from tests.builders import example_map

GRID = RangeAzimuthGrid()


def flat_map(values: np.ndarray | None = None, incoherent: bool = False) -> RangeAzimuthMap:
    return example_map(
        np.zeros(GRID.shape) if values is None else values,
        stamp_ns=10,
        scan_id=4,
        azimuth_stamp_ns=np.arange(256, dtype=np.int64) * 1000,
        noise_power_mw=1e-10,
        incoherent=np.full(512, incoherent),
        missing_beams=(2,),
        saturated_share=0.25,
    )


def heat(*blobs: tuple[int, float, float, float]) -> np.ndarray:
    """Gaussians of one cell sigma: (class, range bin, azimuth bin, height)."""
    out = np.zeros((2, *GRID.shape), np.float32)
    rows, columns = np.arange(512)[:, None], np.arange(256)[None]
    for path_class, row, column, height in blobs:
        blob = height * np.exp(-0.5 * ((rows - row) ** 2 + (columns - column) ** 2))
        out[path_class] = np.maximum(out[path_class], blob)
    return out


def test_one_peak_of_each_class_with_all_it_carries():
    peaks = find_peaks(heat((0, 100, 60, 0.9), (1, 140, 61, 0.7)), flat_map(), PeakParams())
    assert peaks.path_class.tolist() == [PathClass.LOS, PathClass.MIRRORED]
    np.testing.assert_allclose(peaks.score, [0.9, 0.7], rtol=1e-6)
    assert peaks.peak_stamp_ns.tolist() == [60_000, 61_000]
    assert (peaks.scan_id, peaks.stamp_ns, peaks.missing_beams, peaks.saturated_share) == (4, 10, (2,), 0.25)


@pytest.mark.parametrize("ego_compensated", [False, True])
def test_peaks_say_whether_the_motion_was_taken_out_of_their_map(ego_compensated: bool):
    ra_map = msgspec.structs.replace(flat_map(), ego_compensated=ego_compensated)
    assert find_peaks(heat((0, 100, 60, 0.9)), ra_map, PeakParams()).ego_compensated is ego_compensated


def test_threshold_and_distance():
    """Below 0.3: none. Three cells apart: the higher stays; four apart: both."""
    assert len(find_peaks(heat((0, 100, 60, 0.29)), flat_map(), PeakParams())) == 0
    values = np.zeros((40, 40))
    values[10, 10], values[13, 10], values[20, 20], values[24, 20] = 0.9, 0.8, 0.9, 0.8
    assert local_maxima(values, 0.3, 3).tolist() == [[10, 10], [20, 20], [24, 20]]


@pytest.mark.parametrize("shape", [(1, 2), (2, 2), (5, 9), (1, 30)])
def test_a_plateau_is_one_peak_near_its_middle(shape):
    values = np.zeros((50, 60))
    values[10 : 10 + shape[0], 20 : 20 + shape[1]] = 0.5
    (cell,) = local_maxima(values, 0.3, 3)
    assert abs(cell[0] - (10 + (shape[0] - 1) / 2)) <= 0.5
    assert abs(cell[1] - (20 + (shape[1] - 1) / 2)) <= 0.5


def test_a_constant_map_is_one_plateau():
    assert len(local_maxima(np.full((30, 30), 0.5), 0.3, 3)) == 1


def test_peaks_in_the_corners_of_the_map():
    values = np.zeros((20, 20))
    values[0, 0] = values[0, 19] = values[19, 0] = values[19, 19] = 0.6
    assert len(local_maxima(values, 0.3, 3)) == 4
    probabilities = np.zeros((2, *GRID.shape), np.float32)
    probabilities[0, [0, 0, 511, 511], [0, 255, 0, 255]] = 0.8
    assert len(find_peaks(probabilities, flat_map(), PeakParams())) == 4


@pytest.mark.parametrize("fraction", [-0.4, -0.2, 0.0, 0.3, 0.45])
def test_range_is_refined_on_the_map(fraction):
    """A Gaussian main lobe is a parabola in log magnitude: the vertex is exact to float32 rounding."""
    row = np.exp(-0.5 * ((np.arange(512) - (100 + fraction)) / 0.9) ** 2)
    values = np.repeat(row[:, None], 256, axis=1)
    peaks = find_peaks(heat((0, 100, 60, 0.9)), flat_map(values), PeakParams())
    assert peaks.range_m[0] / GRID.range_bin_m == pytest.approx(100 + fraction, abs=1e-3)


@pytest.mark.parametrize("fraction", [-0.4, 0.0, 0.25])
def test_azimuth_comes_from_the_centroid_of_the_heat_map(fraction):
    """The centroid of 3 cells of a unit Gaussian is drawn to the middle: at most 0.15 cells (0.07 deg) off."""
    peaks = find_peaks(heat((0, 100, 60 + fraction, 0.9)), flat_map(), PeakParams())
    found = float(GRID.azimuth_index(peaks.azimuth_rad)[0])
    assert found == pytest.approx(60 + fraction, abs=0.15)


def test_covariance_has_floors_limits_and_widens_without_coherence():
    params = PeakParams()
    clear, faint = (polar_covariance(np.array([snr]), np.array([False]), 0.2, params)[0] for snr in (60.0, -10.0))
    assert math.degrees(math.sqrt(clear[1, 1])) == pytest.approx(params.azimuth_std_floor_deg)
    assert math.degrees(math.sqrt(faint[1, 1])) == pytest.approx(params.azimuth_std_limit_deg)
    torn = polar_covariance(np.array([60.0]), np.array([True]), 0.2, params)[0]
    assert torn[1, 1] == pytest.approx(4.0 * clear[1, 1])
    assert torn[0, 0] == clear[0, 0]


def test_no_peaks_is_a_valid_message_and_a_wrong_grid_is_refused():
    assert len(find_peaks(np.zeros((2, *GRID.shape), np.float32), flat_map(), PeakParams())) == 0
    with pytest.raises(ValueError, match="probabilities"):
        find_peaks(np.zeros((2, 512, 512), np.float32), flat_map(), PeakParams())


@pytest.mark.slow
def test_what_a_network_may_give_beyond_scores_and_ranges_is_taken_for_the_nearer_end() -> None:
    """A score of 1.3, one of -0.1, and a place half a bin before the first: a message holds neither."""
    cells = np.array([[0, 40], [0, 90]])
    places = np.array([[-0.5, 40.0], [-0.5, 90.0]])
    peaks = peaks_at(flat_map(), cells, places, np.array([1.3, -0.1]), np.zeros(2, np.uint8), PeakParams())
    assert peaks.score.tolist() == [1.0, 0.0]
    assert peaks.range_m.tolist() == [0.0, 0.0]


def test_of_too_many_peaks_the_best_are_kept() -> None:
    """A heat map of noise, as of a network that has learnt nothing: two classes, each with thousands of maxima."""
    ra_map = flat_map()
    noise = np.random.default_rng(0).random((len(PathClass), *ra_map.grid.shape))
    every = [local_maxima(channel, 0.5, 1) for channel in noise]
    assert sum(len(cells) for cells in every) > MAX_PEAKS
    peaks = find_peaks(noise, ra_map, PeakParams(threshold=0.5, min_distance=1))
    assert len(peaks) == MAX_PEAKS
    best = np.sort(np.concatenate([noise[which][tuple(cells.T)] for which, cells in enumerate(every)]))[-MAX_PEAKS:]
    np.testing.assert_array_equal(np.sort(peaks.score), best)


@pytest.mark.parametrize("mode", ["coherent", "photons"])
def test_power_of_a_few_cells_is_that_of_the_map(mode: str) -> None:
    """To the byte, whatever the number of cells and their order."""
    rng = np.random.default_rng(0)
    values = rng.normal(size=GRID.shape) + 1j * rng.normal(size=GRID.shape)
    ra_map = msgspec.structs.replace(flat_map(values * 10.0 ** rng.uniform(-12, 3, GRID.shape)), mode=mode)
    power = echo_power(ra_map)
    for shape in [(0,), (1,), (7, 3), (64,)]:
        at = rng.integers(0, 512, shape), rng.integers(0, 256, shape)
        np.testing.assert_array_equal(echo_power(ra_map, at), power[at])
