"""Detection without a network: CFAR, lobe suppression, and classes from the walls among the detections."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import msgspec
import numpy as np

from models.perception.find.peaks import PeakParams, echo_power, peaks_at
from models.perception.find.ridges import RidgeParams, find_ridges, ridge_cells
from models.perception.mirrors.clustering import dbscan
from models.perception.mirrors.mirror_table import WallArrays, behind_walls, wall_arrays
from models.perception.mirrors.recovery import cartesian_covariance
from models.perception.mirrors.walls import WallParams, find_walls
from models.physics.link_budget import spad_threshold
from msgs.values.frames import xy_from_polar
from msgs.values.perception import PathClass, Peaks, Wall
from msgs.values.radar import RangeAzimuthMap

#: Ordered statistic: window in range bins, which share of it counts as quiet, ranges that share a window.
WINDOW = 128
QUANTILE, STRIDE = 0.3, 8
#: Walls that separate images from direct returns; an image lies at least this deep behind one.
CLUSTER_EPS_M, CLUSTER_MIN_POINTS = 4.0, 2
MIN_DEPTH_M = 1.5
WALLS = WallParams()


class CfarParams(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """False-alarm rate, ridges and errors of their peaks."""

    false_alarm_rate: float = 1e-4
    ridges: RidgeParams = RidgeParams()
    peaks: PeakParams = PeakParams()

    def __post_init__(self) -> None:
        if not 0.0 < self.false_alarm_rate < 1.0:
            raise ValueError(f"cfar.false_alarm_rate must be in (0, 1), got {self.false_alarm_rate!r}")


#: For maps of a LiDAR: beams without lobes, one azimuth wide. Where a cell expects a few counts, their law has a longer
#: tail than the normal one: 16 dB keep false alarms below 4e-5 a cell whatever the count.
PHOTON_CFAR = CfarParams(
    false_alarm_rate=1e-6,
    ridges=RidgeParams(spacing=(2, 1), min_snr_db=16.0, azimuth_lobe_db=300.0, range_lobe_db=300.0),
    peaks=PeakParams(beam_width_deg=0.5, azimuth_std_floor_deg=0.14),
)


def ordered_statistic_mask(power: np.ndarray, params: CfarParams) -> np.ndarray:
    """Return the OS-CFAR against a quantile of a window of ranges in the same azimuth; bool [R, A].

    Walls raise a mean, but not the quarter of quiet cells between them. `stride` ranges share one window.
    """
    bins = power.shape[0]
    window = min(WINDOW, bins)
    rank = _rank(window)
    starts = np.clip(np.arange(0, bins, STRIDE) + STRIDE // 2 - window // 2, 0, bins - window)
    views = np.lib.stride_tricks.sliding_window_view(power, window, axis=0)[starts]  # [stretches, azimuth, window]
    level = np.partition(views, rank - 1, axis=-1)[..., rank - 1]
    threshold = ordered_statistic_alpha(window, rank, params.false_alarm_rate) * level
    return power > np.repeat(threshold, STRIDE, axis=0)[:bins]


def warm(params: CfarParams) -> None:
    """Compile the kernels that maps need, or load them: the first map must not wait for that."""
    from models.perception.mirrors.peaks_to_view import synthetic_peaks

    ridge_cells(np.zeros((1, 1)), params.ridges.spacing)
    classify_behind_walls(synthetic_peaks())
    ordered_statistic_alpha(WINDOW, _rank(WINDOW), params.false_alarm_rate)


def _rank(window: int) -> int:
    return max(int(QUANTILE * window), 1)


@lru_cache(maxsize=32)
def ordered_statistic_alpha(count: int, rank: int, false_alarm_rate: float) -> float:
    """Return the threshold factor of OS-CFAR on exponential noise: prod_{i<k} (n - i) / (n - i + alpha) = P_fa."""
    # imported here: a network needs no threshold, and this import is a fifth of the start time of its node
    from scipy.optimize import brentq

    left = count - np.arange(rank)
    return float(brentq(lambda alpha: np.sum(np.log1p(alpha / left)) + np.log(false_alarm_rate), 0.0, 1e9))


def cfar_peaks(ra_map: RangeAzimuthMap, params: CfarParams) -> Peaks:
    """Return the classified peaks of a map without a network: detect, then mark images by the walls before them."""
    return classify_behind_walls(detect(ra_map, params))


def detect(ra_map: RangeAzimuthMap, params: CfarParams) -> Peaks:
    """Return the ridges of the CFAR detections that are no side lobes, all of class LOS; strongest first.

    Echoes from beyond the map's azimuths are left out. The score is 1 - 1 / sqrt(SNR), 0.78 at 13 dB.
    """
    power, noise_power_mw = echo_power(ra_map), ra_map.noise_power_mw
    has_lobes = ra_map.mode != "photons"
    # the noise of counts is known and need not be measured beside a cell, where a period's end or a wall may lie
    mask = ordered_statistic_mask(power, params) if has_lobes else power > spad_threshold(params.false_alarm_rate)
    cells, fractional = find_ridges(power, mask, noise_power_mw, ra_map.grid.range_m, params.ridges, has_lobes)
    snr = power[cells[:, 0], cells[:, 1]] / max(ra_map.noise_power_mw, 1e-300)
    score = 1.0 - 1.0 / np.sqrt(np.maximum(snr, 1.0))
    path_class = np.full(len(cells), PathClass.LOS, np.uint8)
    return peaks_at(ra_map, cells, fractional, score, path_class, params.peaks)


def classify_behind_walls(peaks: Peaks) -> Peaks:
    """Mark as mirrored the detections behind a wall that nearer detections form; no network, no truth.

    The nearest wall marks what its rays cross deeper than `MIN_DEPTH_M`; walls are fitted again among the direct ones
    until none hides a direct peak, so that images never form a wall.
    """
    points_m = xy_from_polar(peaks.range_m, peaks.azimuth_rad)
    covariance_m2 = cartesian_covariance(peaks.range_m, peaks.azimuth_rad, peaks.covariance)
    mirrored = np.zeros(len(peaks), bool)
    for _ in range(WALLS.max_walls):
        direct = np.flatnonzero(~mirrored)
        labels = dbscan(points_m[direct], CLUSTER_EPS_M, CLUSTER_MIN_POINTS)
        walls, _ = find_walls(points_m[direct], covariance_m2[direct], labels, WALLS)
        hidden = _behind_nearest(points_m[direct], walls, MIN_DEPTH_M)
        if not hidden.any():
            break
        mirrored[direct[hidden]] = True
    path_class = np.where(mirrored, PathClass.MIRRORED, PathClass.LOS).astype(np.uint8)
    return msgspec.structs.replace(peaks, path_class=path_class)


def _behind_nearest(points_m: np.ndarray, walls: list[Wall], depth_m: float) -> np.ndarray:
    """Return the points [N, 2] behind the nearest wall that hides any; bool [N]."""
    for wall in sorted(walls, key=lambda wall: wall.offset_m):
        hidden = behind_walls(points_m, drawn_in(wall), depth_m)
        if hidden.any():
            return hidden
    return np.zeros(len(points_m), bool)


def drawn_in(wall: Wall) -> WallArrays:
    """Return the wall without its outermost half metre, which an azimuth error may have made up."""
    arrays = wall_arrays([wall])
    a, b = arrays.trimmed(0.5)
    return replace(arrays, a=a, b=b)
