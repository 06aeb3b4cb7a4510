"""Peaks that a heatmap names and the map places."""

from __future__ import annotations

import numpy as np
import pytest

from models.perception.find.peaks import PeakParams
from models.perception.find.ridge_matching import RidgeMatchingParams, ridge_matched_peaks
from models.perception.find.ridges import RidgeParams, find_ridges
from msgs.values.perception import PathClass
from msgs.values.radar import RangeAzimuthGrid, RangeAzimuthMap
from tests.builders import example_map

GRID = RangeAzimuthGrid()
NOISE_MW = 1e-13


def map_with(*targets: tuple[float, float, float]) -> RangeAzimuthMap:
    """Gaussian lobes (range bin, azimuth bin, level in dB over noise) 9 deg wide and 2 bins deep, no noise drawn."""
    i, j = np.mgrid[: GRID.range_bins, : GRID.azimuth_bins]
    power = np.zeros(GRID.shape)
    for range_bin, azimuth_bin, level_db in targets:
        lobe = np.exp(-np.log(2) * (((i - range_bin) / 1.0) ** 2 + ((j - azimuth_bin) / 9.6) ** 2))
        power += NOISE_MW * 10 ** (level_db / 10) * lobe
    return example_map(np.sqrt(power).astype("<c8"), grid=GRID, noise_power_mw=NOISE_MW)


def heatmap_with(*rises: tuple[PathClass, int, int, float]) -> np.ndarray:
    heatmap = np.zeros((2, *GRID.shape), np.float32)
    for path_class, i, j, score in rises:
        heatmap[path_class, i, j] = score
    return heatmap


def test_the_ridge_places_what_the_heatmap_names() -> None:
    """The heatmap is 6 columns (2.8 deg) off; the lobe's vertex is at column 120.4. Tolerance: a tenth of a column."""
    ra_map = map_with((100.0, 120.4, 40.0))
    peaks = ridge_matched_peaks(
        heatmap_with((PathClass.MIRRORED, 101, 126, 0.6)), ra_map, PeakParams(), RidgeMatchingParams()
    )
    assert peaks.path_class.tolist() == [PathClass.MIRRORED]
    assert peaks.score.tolist() == pytest.approx([0.6])
    assert GRID.azimuth_index(peaks.azimuth_rad)[0] == pytest.approx(120.4, abs=0.1)
    assert GRID.range_index(peaks.range_m)[0] == pytest.approx(100.0, abs=0.05)


def test_a_ridge_that_nothing_names_is_no_peak() -> None:
    ra_map = map_with((100.0, 120.0, 40.0), (200.0, 60.0, 40.0))
    peaks = ridge_matched_peaks(
        heatmap_with((PathClass.LOS, 100, 120, 0.5)), ra_map, PeakParams(), RidgeMatchingParams()
    )
    assert len(peaks) == 1


def test_the_heatmaps_own_maximum_counts_where_the_map_has_no_ridge_of_its_class() -> None:
    """An image beside a stronger direct return of the same lobe: no ridge of its own, named all the same."""
    ra_map = map_with((100.0, 120.0, 40.0))
    heatmap = heatmap_with((PathClass.LOS, 100, 120, 0.6), (PathClass.MIRRORED, 101, 132, 0.5))
    peaks = ridge_matched_peaks(heatmap, ra_map, PeakParams(), RidgeMatchingParams())
    assert peaks.path_class.tolist() == [PathClass.LOS, PathClass.MIRRORED]


@pytest.mark.parametrize("own", [(60, 60), (60, 180), (140, 60), (140, 180)])
def test_a_maximum_far_from_a_ridge_is_kept_on_whichever_side_it_lies(own: tuple[int, int]) -> None:
    """40 bins nearer or farther than the ridge of its class, 60 columns to the left or right: another object."""
    heatmap = heatmap_with((PathClass.LOS, 100, 120, 0.6), (PathClass.LOS, *own, 0.5))
    peaks = ridge_matched_peaks(heatmap, map_with((100.0, 120.0, 40.0)), PeakParams(), RidgeMatchingParams())
    assert sorted(peaks.score.tolist()) == pytest.approx([0.5, 0.6])
    assert GRID.range_index(peaks.range_m[peaks.score.argmin()]) == pytest.approx(own[0], abs=1.0)


def test_equal_bytes_on_equal_maps_and_none_on_an_empty_one() -> None:
    empty = map_with()
    assert len(ridge_matched_peaks(heatmap_with(), empty, PeakParams(), RidgeMatchingParams())) == 0
    one = ridge_matched_peaks(heatmap_with((PathClass.LOS, 0, 0, 0.9)), empty, PeakParams(), RidgeMatchingParams())
    assert np.isfinite(one.covariance).all()


def test_ridges_leave_side_lobes_out() -> None:
    """A lobe 25 dB down at the same range, 40 deg away, belongs to the stronger peak; one 15 dB down does not."""
    for level_db, count in ((25.0, 1), (45.0, 2)):
        power = np.abs(map_with((100.0, 60.0, 60.0), (100.0, 160.0, level_db)).values) ** 2
        cells, _ = find_ridges(power, np.ones(GRID.shape, bool), NOISE_MW, GRID.range_m, RidgeParams())
        assert len({tuple(cell) for cell in cells if abs(cell[0] - 100) <= 1}) == count
