"""Peaks of a class heat map, refined below the cell on the range-azimuth map, with their polar errors."""

from __future__ import annotations

import math
from types import EllipsisType

import msgspec
import numpy as np

from models.perception.find.pursuit import pursued_peaks
from msgs.values.arrays import require_positive, require_within
from msgs.values.perception import MAX_PEAKS, PathClass, Peaks
from msgs.values.radar import RangeAzimuthMap


class Points(msgspec.Struct, frozen=True, kw_only=True):
    """Points of a map, LOS before mirrored, strongest first: fractional cells [N, 2], score [N], `PathClass` [N]."""

    cells: np.ndarray
    score: np.ndarray
    path_class: np.ndarray


#: Range error: a bin over sqrt(2 SNR), within the bounds below.
RANGE_STD_FLOOR_M = 0.06
RANGE_STD_LIMIT_M = 0.2
#: Azimuth errors are this much wider where the beams did not fit one coherent scene.
INCOHERENT_FACTOR = 2.0


class PeakParams(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Peak picking (released settings) and the error model of a peak."""

    threshold: float = 0.3
    min_distance: int = 3
    #: Two-way 3 dB width of a beam: a peak's azimuth error is this over sqrt(2 SNR), within the bounds below.
    beam_width_deg: float = 9.0
    azimuth_std_floor_deg: float = 0.7
    azimuth_std_limit_deg: float = 4.0

    def __post_init__(self) -> None:
        require_within("peaks.min_distance", 1, 8192, self.min_distance)
        for name in ("threshold", "beam_width_deg", "azimuth_std_floor_deg"):
            require_positive(f"peaks.{name}", getattr(self, name))


def find_peaks(probabilities: np.ndarray, ra_map: RangeAzimuthMap, params: PeakParams) -> Peaks:
    """Return the maxima of a heat map [2, range, azimuth] as `Points`; `ValueError` where it is not the map's size."""
    _require_on_grid(probabilities, ra_map)
    points = heatmap_points(probabilities, params.threshold, params.min_distance)
    cells = points.cells.astype(np.int64)
    fractional = points.cells.copy()
    for channel, of_class in zip(probabilities, (points.path_class == k for k in PathClass), strict=True):
        fractional[of_class] = _centroid(channel, cells[of_class])
    return peaks_at(ra_map, cells, fractional, points.score, points.path_class, params)


def find_pursued_peaks(probabilities: np.ndarray, ra_map: RangeAzimuthMap, params: PeakParams) -> Peaks:
    """Return the peaks of the heat map by pursuit: as many as its mass is worth; raises ValueError as above."""
    _require_on_grid(probabilities, ra_map)
    points = pursued_points(probabilities, params.threshold)
    return peaks_at(ra_map, points.cells.astype(np.int64), points.cells, points.score, points.path_class, params)


def pursued_points(heatmap: np.ndarray, threshold: float) -> Points:
    """Return the peaks of each class of a heat map [2, range, azimuth] by pursuit, on whole cells."""
    return _of_classes([pursued_peaks(channel, threshold) for channel in heatmap])


def _require_on_grid(probabilities: np.ndarray, ra_map: RangeAzimuthMap) -> None:
    shape = len(PathClass), *ra_map.grid.shape
    if probabilities.shape != shape:
        raise ValueError(f"probabilities must have shape {shape}, got {probabilities.shape}")


def heatmap_points(heatmap: np.ndarray, threshold: float, min_distance: int) -> Points:
    """Return the local maxima of each class of a heat map [2, range, azimuth], on whole cells (section 3.1.1)."""
    maxima = [local_maxima(channel, threshold, min_distance) for channel in heatmap]
    return _of_classes([(at, channel[at[:, 0], at[:, 1]]) for at, channel in zip(maxima, heatmap, strict=True)])


def _of_classes(by_class: list[tuple[np.ndarray, np.ndarray]]) -> Points:
    """Return the cells [N, 2] and scores [N] of each class in one row."""
    return Points(
        cells=np.concatenate([cells for cells, _ in by_class]).astype(np.float64),
        score=np.concatenate([score for _, score in by_class]).astype(np.float64),
        path_class=np.repeat(np.arange(len(by_class), dtype=np.uint8), [len(cells) for cells, _ in by_class]),
    )


def echo_power(ra_map: RangeAzimuthMap, at: tuple[np.ndarray, np.ndarray] | EllipsisType = ...) -> np.ndarray:
    """Return |values|^2, float64 [range, azimuth] or at rows and columns; a lack of photons is zero."""
    values = ra_map.values[at]
    values = values.real.clip(0.0) if ra_map.mode == "photons" else np.abs(values)
    # the square of a float32 magnitude may leave float32
    return np.square(values, dtype=np.float64)


def peaks_at(
    ra_map: RangeAzimuthMap,
    cells: np.ndarray,
    fractional: np.ndarray,
    score: np.ndarray,
    path_class: np.ndarray,
    params: PeakParams,
) -> Peaks:
    """Return the message of peaks at cells [N, 2] with fractional places [N, 2]; ranges refined on the map.

    At most `MAX_PEAKS`, the highest scores; scores beyond 0..1, of an untrained network, are clipped.
    """
    if len(cells) > MAX_PEAKS:
        best = np.sort(np.argsort(-np.asarray(score), kind="stable")[:MAX_PEAKS])
        cells, fractional, score, path_class = (values[best] for values in (cells, fractional, score, path_class))
    grid = ra_map.grid
    range_index = _refined_range(ra_map, cells, fractional[:, 0])
    snr_db = _snr_db(echo_power(ra_map, (cells[:, 0], cells[:, 1])), ra_map.noise_power_mw)
    speed_mps, std_mps = _radial_speeds(ra_map, cells, snr_db)
    return Peaks(
        stamp_ns=ra_map.stamp_ns,
        scan_id=ra_map.scan_id,
        range_m=np.maximum(np.asarray(grid.range_at(range_index), np.float64), 0.0),
        azimuth_rad=np.asarray(grid.azimuth_at(fractional[:, 1]), np.float64),
        score=np.clip(np.asarray(score, np.float64), 0.0, 1.0),
        path_class=np.asarray(path_class, np.uint8),
        covariance=polar_covariance(snr_db, ra_map.incoherent[cells[:, 0]], grid.range_bin_m, params),
        peak_stamp_ns=ra_map.azimuth_stamp_ns[cells[:, 1]],
        snr_db=snr_db,
        incoherent=bool(ra_map.incoherent[cells[:, 0]].any()),
        missing_beams=ra_map.missing_beams,
        saturated_share=ra_map.saturated_share,
        faults=ra_map.faults,
        vehicle_from_radar=ra_map.vehicle_from_radar,
        radial_speed_mps=speed_mps,
        radial_speed_std_mps=std_mps,
        settled_stamp_ns=ra_map.settled_stamp_ns,
        ego_compensated=ra_map.ego_compensated,
    )


def _radial_speeds(
    ra_map: RangeAzimuthMap, cells: np.ndarray, snr_db: np.ndarray
) -> tuple[np.ndarray, np.ndarray] | tuple[None, None]:
    """Return the radial speeds of peaks and their standard deviations, None where the map has none."""
    if ra_map.radial_speed_cmps is None:
        return None, None
    speed_mps = ra_map.radial_speed_mps((cells[:, 0], cells[:, 1]))
    std_mps = ra_map.radial_speed_unit_std_mps * 10.0 ** (-0.05 * snr_db)
    return speed_mps, np.where(np.isfinite(speed_mps), std_mps, np.nan)


def local_maxima(values: np.ndarray, threshold: float, min_distance: int) -> np.ndarray:
    """Return the cells [N, 2] of maxima over `threshold`, highest first, none within `min_distance` of a higher.

    A plateau gives one peak, at its middle; equal ones come in the order of the cells.
    """
    # imported here: pursuit needs no maxima, and a restarted node must not wait for it
    from scipy import ndimage

    highest = ndimage.maximum_filter(values, size=2 * min_distance + 1, mode="constant", cval=-np.inf)
    candidate = (values >= highest) & (values >= threshold)
    plateaus, count = ndimage.label(candidate, structure=np.ones((3, 3), int))
    if count == 0:
        return np.zeros((0, 2), np.int64)
    middle = _plateau_middles(plateaus, count)
    level = values[middle[:, 0], middle[:, 1]]
    order = np.argsort(-level, kind="stable")
    return middle[order[keep_apart(middle[order], (min_distance, min_distance))]]


def _plateau_middles(plateaus: np.ndarray, count: int) -> np.ndarray:
    """Return the cell of each plateau nearest to its centre [count, 2]; the first of equals."""
    cells = np.argwhere(plateaus)
    label = plateaus[cells[:, 0], cells[:, 1]] - 1
    size = np.bincount(label, minlength=count)
    centre = np.stack([np.bincount(label, cells[:, axis], count) / size for axis in (0, 1)], axis=1)
    distance = np.abs(cells - centre[label]).max(axis=1)
    order = np.lexsort((distance, label))
    first = np.searchsorted(label[order], np.arange(count))
    return cells[order[first]]


def keep_apart(cells: np.ndarray, spacing: tuple[int, int]) -> np.ndarray:
    """Return the indices of cells [N, 2], best first, at least `spacing` apart in one axis; at most `MAX_PEAKS`."""
    free = np.ones(len(cells), bool)
    kept: list[int] = []
    for index in range(len(cells)):
        if len(kept) == MAX_PEAKS:
            break
        if free[index]:
            kept.append(index)
            free &= (np.abs(cells - cells[index]) > spacing).any(axis=1)
    return np.array(kept, np.int64)


def _centroid(values: np.ndarray, cells: np.ndarray) -> np.ndarray:
    """Return the fractional cells [N, 2]: centre of mass of the 3 x 3 cells about each, within the map."""
    step = np.stack(np.meshgrid((-1, 0, 1), (-1, 0, 1), indexing="ij"), axis=-1).reshape(9, 2)
    around = cells[:, None] + step  # [N, 9, 2]
    inside = ((around >= 0) & (around < values.shape)).all(axis=-1)
    clipped = np.clip(around, 0, np.array(values.shape) - 1)
    weight = np.where(inside, values[clipped[..., 0], clipped[..., 1]], 0.0).astype(np.float64)
    # what rises above the lowest of the nine: a constant background would pull towards the middle
    weight -= np.where(inside, weight, np.inf).min(axis=1, keepdims=True)
    weight = np.where(inside, weight, 0.0)
    total = weight.sum(axis=1, keepdims=True)
    shift = np.einsum("nk,nki->ni", weight / np.where(total > 0.0, total, 1.0), np.broadcast_to(step, around.shape))
    return cells + shift


def _refined_range(ra_map: RangeAzimuthMap, cells: np.ndarray, fallback: np.ndarray) -> np.ndarray:
    """Return the fractional range bins [N] of parabolas through the log powers about the map's peaks, or `fallback`."""
    bins, column = ra_map.values.shape[0], cells[:, 1]
    reach = np.clip(cells[:, 0, None] + np.arange(-1, 2), 0, bins - 1)
    strongest = echo_power(ra_map, (reach, column[:, None])).argmax(axis=1)
    top = np.take_along_axis(reach, strongest[:, None], axis=1)[:, 0]
    inner = np.clip(top, 1, bins - 2)
    about = echo_power(ra_map, (inner + np.array([[-1], [0], [1]]), column))
    before, here, after = np.log(np.maximum(about, np.finfo(np.float32).tiny))
    peaked = (top == inner) & (here >= before) & (here >= after) & (before - 2.0 * here + after < 0.0)
    curvature = np.where(peaked, before - 2.0 * here + after, -1.0)
    return np.where(peaked, inner + 0.5 * (before - after) / curvature, fallback)


def _snr_db(power: np.ndarray, noise_power_mw: float) -> np.ndarray:
    """Return powers over the map's noise [N], at least -30 dB so that empty cells stay finite."""
    return 10.0 * np.log10(np.clip(power / max(noise_power_mw, 1e-300), 1e-3, 1e30))


def polar_covariance(snr_db: np.ndarray, incoherent: np.ndarray, range_bin_m: float, params: PeakParams) -> np.ndarray:
    """Return the diagonal covariances (range [m], azimuth [rad]) [N, 2, 2]: resolution over sqrt(2 SNR), bounded."""
    spread = 1.0 / np.sqrt(2.0 * 10.0 ** (snr_db / 10.0))
    range_std_m = np.clip(range_bin_m * spread, RANGE_STD_FLOOR_M, RANGE_STD_LIMIT_M)
    azimuth_deg = np.clip(
        params.beam_width_deg * spread, params.azimuth_std_floor_deg, params.azimuth_std_limit_deg
    ) * np.where(incoherent, INCOHERENT_FACTOR, 1.0)
    covariance = np.zeros((len(snr_db), 2, 2))
    covariance[:, 0, 0] = range_std_m**2
    covariance[:, 1, 1] = (math.pi / 180.0 * azimuth_deg) ** 2
    return covariance
