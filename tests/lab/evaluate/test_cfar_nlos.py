"""CFAR-NLOS: privileged truth of direct returns tells detections apart, and nothing else of the truth is looked at."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import pytest

from lab.evaluate.cfar_nlos import CfarNlosParams, privileged_peaks
from models.perception.find.cfar import CfarParams
from models.perception.find.ridges import RidgeParams
from msgs.values.perception import PathClass, Peaks
from msgs.values.radar import RangeAzimuthGrid, RangeAzimuthMap
from tests.builders import example_map

GRID = RangeAzimuthGrid()
#: A wall's echo at 12 m, -20 deg, and an image behind it at 31 m, 15 deg.
WALL, IMAGE = (12.0, -20.0), (31.0, 15.0)


def two_targets() -> RangeAzimuthMap:
    """Two lobes of 40 dB, 2 bins and 9 degrees wide, in noise of unit power."""
    rng = np.random.default_rng(5)
    values = (rng.normal(size=GRID.shape) + 1j * rng.normal(size=GRID.shape)) / math.sqrt(2.0)
    for range_m, azimuth_deg in (WALL, IMAGE):
        range_part = np.exp(-(((GRID.range_m - range_m) / GRID.range_bin_m / 1.2) ** 2) / 2.0)
        azimuth_part = np.exp(-(((np.degrees(GRID.azimuth_rad) - azimuth_deg) / 5.4) ** 2))
        values += 100.0 * np.outer(range_part, azimuth_part)
    return example_map(values, stamp_ns=7, scan_id=3)


def found(truth: list[tuple[float, float]], classes: Sequence[int], params: CfarNlosParams | None = None) -> Peaks:
    """Peaks of the map with truth points given as (range in metres, azimuth in degrees)."""
    range_m, azimuth_deg = np.array(truth, float).reshape(-1, 2).T
    return privileged_peaks(two_targets(), range_m, np.radians(azimuth_deg), np.array(classes, np.uint8), params)


def class_at(peaks: Peaks, target: tuple[float, float]) -> int:
    """Class of the strongest peak within 0.5 m and 2 deg of a target."""
    near = np.abs(peaks.range_m - target[0]) < 0.5
    near &= np.abs(np.degrees(peaks.azimuth_rad) - target[1]) < 2.0
    assert near.any()
    return int(peaks.path_class[near][np.argmax(peaks.snr_db[near])])


def test_what_lies_at_a_true_direct_point_is_direct() -> None:
    peaks = found([WALL, IMAGE], [PathClass.LOS, PathClass.MIRRORED])
    assert class_at(peaks, WALL) == PathClass.LOS
    assert class_at(peaks, IMAGE) == PathClass.MIRRORED
    assert (peaks.stamp_ns, peaks.scan_id) == (7, 3)


def test_truth_of_mirrored_points_is_not_looked_at() -> None:
    """Without any direct truth every detection is mirrored, wherever mirrored truth lies."""
    for truth, classes in (([], []), ([WALL, IMAGE], [PathClass.MIRRORED] * 2)):
        peaks = found(truth, classes)
        assert len(peaks) >= 2
        assert (peaks.path_class == PathClass.MIRRORED).all()


@pytest.mark.parametrize(("off_m", "off_deg", "direct"), [(1.5, 0.0, True), (2.5, 0.0, False), (0.0, 5.0, False)])
def test_both_tolerances_must_hold(off_m: float, off_deg: float, direct: bool) -> None:
    """Defaults 2 m and 3 deg; the detection itself lies within 0.5 m and 1 deg of the wall's echo."""
    peaks = found([(WALL[0] + off_m, WALL[1] + off_deg)], [PathClass.LOS])
    strongest = np.abs(peaks.range_m - WALL[0]) < 0.15
    expected = PathClass.LOS if direct else PathClass.MIRRORED
    assert set(peaks.path_class[strongest].tolist()) == {expected}


def test_tolerances_and_detector_are_the_caller_s() -> None:
    """Truth 2.5 m beyond the wall's echo, which the defaults call mirrored: direct within 3.5 m; lobes of 40 dB
    are no detections where 60 dB are asked for.
    """
    beyond = [(WALL[0] + 2.5, WALL[1])]
    wide = CfarNlosParams(range_tolerance_m=3.5)
    assert class_at(found(beyond, [PathClass.LOS], wide), WALL) == PathClass.LOS
    deaf = CfarNlosParams(cfar=CfarParams(ridges=RidgeParams(spacing=(2, 4), min_snr_db=60.0)))
    assert len(found(beyond, [PathClass.LOS], deaf)) == 0


@pytest.mark.parametrize(
    ("truth", "rule"),
    [
        ((np.zeros(2), np.zeros(1), np.zeros(1)), "must have one length, got 2, 1 and 1"),
        ((np.array([np.nan]), np.zeros(1), np.zeros(1)), "truth_range_m must be finite"),
        ((np.zeros(1), np.array([np.inf]), np.zeros(1)), "truth_azimuth_rad must be finite"),
    ],
)
def test_bad_truth_is_refused(truth: tuple[np.ndarray, np.ndarray, np.ndarray], rule: str) -> None:
    with pytest.raises(ValueError, match=rule):
        privileged_peaks(two_targets(), *truth)


def test_bad_tolerances_are_refused() -> None:
    with pytest.raises(ValueError, match=r"cfar_nlos\.range_tolerance_m must be"):
        CfarNlosParams(range_tolerance_m=0.0)
    with pytest.raises(ValueError, match=r"cfar_nlos\.azimuth_tolerance_deg must be"):
        CfarNlosParams(azimuth_tolerance_deg=float("nan"))
