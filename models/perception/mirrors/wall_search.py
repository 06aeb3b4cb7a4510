"""Compiled search for wall segments, by the rules of `models.perception.mirrors.walls`: RANSAC, refit, cut at gaps."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from models.compiled import compiled
from models.perception.mirrors.lines import Line, fitted, gains, residual_gain, variance_across

#: Hypotheses that are refit and compared in each round of the search.
FINALISTS = 4
#: Refits with weights that follow the line.
FIT_ROUNDS = 3
#: Log likelihood a point must add to continue a wall.
MIN_EXTENSION_GAIN = 1.0


class Limits(NamedTuple):
    """Conditions for a mirror, as in `WallParams`."""

    min_inliers: int
    max_gap_m: float
    min_length_m: float
    max_angle_std_rad: float
    min_offset_m: float
    min_score: float


class Segment(NamedTuple):
    """A fitted line, its score, its ends in metres, and whether it acts as a mirror."""

    line: Line
    score: float
    ax: float
    ay: float
    bx: float
    by: float
    is_mirror: bool


_NOTHING = Segment(Line(0.0, 1.0, 0.0, math.inf, math.inf), -math.inf, 0.0, 0.0, 0.0, 0.0, False)


@compiled(error_model="numpy")
def best_segment(
    points_m: np.ndarray, covariance_m2: np.ndarray, pairs: np.ndarray, limits: Limits
) -> tuple[Segment, np.ndarray]:
    """Return the highest-scoring segment among the finalists of one RANSAC and the indices of its points.

    `pairs` [H], ascending, number the pairs of points [N, 2] of the hypotheses. It may be no mirror.
    """
    lines = _lines_through(points_m, pairs)
    gain, total = _support(points_m, covariance_m2, lines)
    best, best_run = _NOTHING, np.empty(0, np.int64)
    finalists = np.empty(FINALISTS, np.int64)
    count = 0
    for index in np.argsort(-total, kind="mergesort"):
        # hypotheses with the same inliers become the same line
        if _has_same_inliers(gain, index, finalists[:count]):
            continue
        finalists[count] = index
        count += 1
        segment, run = _best_on_line(points_m, covariance_m2, np.flatnonzero(gain[index] > 0.0), limits)
        if segment.is_mirror and segment.score > best.score:
            best, best_run = segment, run
        if count == FINALISTS:
            break
    return best, best_run


@compiled(error_model="numpy")
def _lines_through(points_m: np.ndarray, pairs: np.ndarray) -> np.ndarray:
    """Return the lines (nx, ny, offset) [H, 3] through the numbered pairs of points that do not coincide."""
    lines = np.empty((len(pairs), 3))
    count, first, row_start = 0, 0, 0
    for pair in pairs:
        while pair >= row_start + len(points_m) - 1 - first:
            row_start += len(points_m) - 1 - first
            first += 1
        second = first + 1 + pair - row_start
        dx, dy = points_m[second, 0] - points_m[first, 0], points_m[second, 1] - points_m[first, 1]
        length_m = math.hypot(dx, dy)
        if length_m > 1e-6:
            lines[count, 0], lines[count, 1] = -dy / length_m, dx / length_m
            lines[count, 2] = -(lines[count, 0] * points_m[first, 0] + lines[count, 1] * points_m[first, 1])
            count += 1
    return lines[:count]


@compiled(error_model="numpy")
def _support(points_m: np.ndarray, covariance_m2: np.ndarray, lines: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return what each point adds to each line's score [H, N] and the scores [H]."""
    gain, total = np.empty((len(lines), len(points_m))), np.empty(len(lines))
    for h in range(len(lines)):
        gain[h] = gains(points_m, covariance_m2, lines[h, 0], lines[h, 1], lines[h, 2])
        total[h] = gain[h].sum()
    return gain, total


@compiled
def _has_same_inliers(gain: np.ndarray, index: int, rows: np.ndarray) -> bool:
    """Return whether a row of gains [H, N] has the same inliers as one of some other rows."""
    for row in rows:
        alike = True
        for i in range(gain.shape[1]):
            if (gain[index, i] > 0.0) != (gain[row, i] > 0.0):
                alike = False
                break
        if alike:
            return True
    return False


@compiled(error_model="numpy")
def _best_on_line(
    points_m: np.ndarray, covariance_m2: np.ndarray, inliers: np.ndarray, limits: Limits
) -> tuple[Segment, np.ndarray]:
    """Return the best segment on one hypothesis: refit twice (inliers follow the line), then cut at gaps."""
    best, best_run = _NOTHING, inliers
    line = best.line
    for _ in range(2):
        if len(inliers) < limits.min_inliers:
            return best, best_run
        line = fitted(points_m[inliers], covariance_m2[inliers], FIT_ROUNDS)
        inliers = np.flatnonzero(gains(points_m, covariance_m2, line.nx, line.ny, line.offset_m) > 0.0)
    along = points_m[inliers, 1] * line.nx - points_m[inliers, 0] * line.ny
    order = np.argsort(along, kind="mergesort")
    start = 0
    for stop in range(1, len(order) + 1):
        if stop < len(order) and along[order[stop]] - along[order[stop - 1]] <= limits.max_gap_m:
            continue
        run = np.sort(inliers[order[start:stop]])
        start = stop
        if len(run) < limits.min_inliers:
            continue
        segment = supported(points_m[run], covariance_m2[run], limits)
        if segment.is_mirror and segment.score > best.score:
            best, best_run = segment, run
    return best, best_run


@compiled(error_model="numpy")
def supported(points_m: np.ndarray, covariance_m2: np.ndarray, limits: Limits) -> Segment:
    """Return the line through points [N, 2], at least two of them, and whether they make it a mirror."""
    line = fitted(points_m, covariance_m2, FIT_ROUNDS)
    nx, ny, offset_m = line.nx, line.ny, line.offset_m
    reach = points_m[:, 1] * nx - points_m[:, 0] * ny
    low, high = reach.min(), reach.max()
    ax, ay = -low * ny - offset_m * nx, low * nx - offset_m * ny
    bx, by = -high * ny - offset_m * nx, high * nx - offset_m * ny
    gain = gains(points_m, covariance_m2, nx, ny, offset_m)
    score = gain.sum()
    is_mirror = bool(
        np.count_nonzero(gain) >= limits.min_inliers
        and math.hypot(bx - ax, by - ay) >= limits.min_length_m
        and line.angle_std_rad <= limits.max_angle_std_rad
        and offset_m >= limits.min_offset_m
        and score >= limits.min_score
    )
    return Segment(line, score, ax, ay, bx, by, is_mirror)


@compiled(error_model="numpy")
def left_over(points_m: np.ndarray, covariance_m2: np.ndarray, segment: Segment, run: np.ndarray) -> np.ndarray:
    """Return the points that a wall does not explain: not its own, nor between its ends; bool [N]."""
    line = segment.line
    low, high = segment.ay * line.nx - segment.ax * line.ny, segment.by * line.nx - segment.bx * line.ny
    gain = gains(points_m, covariance_m2, line.nx, line.ny, line.offset_m)
    reach = points_m[:, 1] * line.nx - points_m[:, 0] * line.ny
    is_left = (gain <= 0.0) | (reach < low) | (reach > high)
    is_left[run] = False
    return is_left


@compiled(error_model="numpy")
def next_on_line(points_m: np.ndarray, covariance_m2: np.ndarray, segment: Segment, limits: Limits) -> int:
    """Return the point [N, 2] nearest to a segment's ends among those that continue it within errors, -1: none."""
    line = segment.line
    low, high = segment.ay * line.nx - segment.ax * line.ny, segment.by * line.nx - segment.bx * line.ny
    low, high = min(low, high), max(low, high)
    nearest, nearest_m = -1, math.inf
    for i in range(len(points_m)):
        x, y = points_m[i, 0], points_m[i, 1]
        reach = y * line.nx - x * line.ny
        gap_m = max(low - reach, reach - high, 0.0)
        if gap_m > limits.max_gap_m or gap_m >= nearest_m:
            continue
        own = variance_across(covariance_m2[i], line.nx, line.ny)
        variance = own + line.offset_std_m**2 + ((reach - 0.5 * (low + high)) * line.angle_std_rad) ** 2
        if residual_gain(x * line.nx + y * line.ny + line.offset_m, variance) > MIN_EXTENSION_GAIN:
            nearest, nearest_m = i, gap_m
    return nearest
