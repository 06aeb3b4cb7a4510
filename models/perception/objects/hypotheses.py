"""Every cell of a map as the image that a wall might show there: up to four hypotheses a cell, each a place.

The first three are single mirrors, likeliest first: walls that the cell's ray crosses before those that it narrowly
misses, with both legs free before blocked ones, long ones before the sides of vehicles, the last one crossed first (its
returns show that nearer walls do not reach so far). The fourth is two mirrors in a row, where a wall blocks the second
leg. Each hypothesis comes with what the map says of it: whether the place is in view and a direct return stands there,
and whether other walls show an image of it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from models.compiled import compiled
from models.perception.geometry.association import DirectReturns
from models.perception.geometry.mirrors import RADAR, WallArrays, hits
from models.perception.objects.wall_table import (
    ENDS,
    FAR_M,
    NORMAL_X,
    NORMAL_Y,
    OFFSET,
    SURE,
    blocks,
    cuts,
    height_m,
    is_free,
    nearest_wall_m,
    wall_table,
)

#: Single mirrors of a cell, and all hypotheses.
SINGLES = 3
HYPOTHESES = SINGLES + 1
#: Features of a hypothesis, in order; distances are logarithms, so that zero is a metre.
FEATURES = (
    "valid", "depth", "to_wall", "incidence", "missed", "wall_length", "wall_angle_std", "mirror_gap",
    "x", "y", "in_view", "is_hidden", "direct_level", "direct_score", "other_images", "other_level", "other_score",
    "nearest_wall", "first_segment_free", "second_segment_free",
)  # fmt: skip
#: Index of the one feature that changes sign with left and right.
Y_FEATURE = FEATURES.index("y")
#: Least depth of an image behind its wall.
MIN_DEPTH_M = 1.0
#: Walls mirror beyond their outermost return by this and by twice the beam's error, within a limit.
END_MARGIN_M, MAX_MARGIN_M, AZIMUTH_STD_RAD = 0.5, 8.0, 0.035
#: Bounds of distances in features; units of positions, of an angle's error, of a number of images.
NEAR_M, PLACE_M, ANGLE_RAD, IMAGES = 0.2, 40.0, 0.2, 2.0
#: Costs by which single mirrors are ordered; each outweighs all that come before it.
_MISSED, _SHORT, _BLOCKED_LATE, _BLOCKED_EARLY = 1e3, 2e3, 1e4, 2e4


class CellGrid(NamedTuple):
    """Centres of cells, evenly spaced: ranges [R] in metres, azimuths [C] in radians."""

    range_m: np.ndarray
    azimuth_rad: np.ndarray


@dataclass(frozen=True)
class CellHypotheses:
    """Hypotheses of all cells, none where `wall` is negative; walls int16 [K, R, C], features float32 [K, F, R, C]."""

    wall: np.ndarray
    second: np.ndarray
    features: np.ndarray


# Columns of where the rays of the columns meet the walls, an array [C, W, 8]: distance along the ray (inf: never) and
# beyond the wall's ends, the mirror there, the cosine of the ray's angle with its normal.
TO_WALL, MISSED, MIRROR_NORMAL_X, MIRROR_NORMAL_Y, MIRROR_OFFSET, MIRROR_X, MIRROR_Y, INCIDENCE = range(8)
# Fields of the map, an array [3, R, C].
LEVEL, DIRECT, MIRRORED = range(3)


class _Grid(NamedTuple):
    """First cell of a map and its steps."""

    first_m: float
    step_m: float
    first_rad: float
    step_rad: float


def cell_hypotheses(
    grid: CellGrid,
    walls: WallArrays,
    returns: DirectReturns,
    level: np.ndarray,
    scores: np.ndarray,
    features: np.ndarray | None = None,
) -> CellHypotheses:
    """Return the hypotheses of every cell of a map, their features in an array float32 [K, F, R, C] if one is given.

    `level` [R, C] is the map's level in 0..1, `scores` [2, R, C] those of direct and mirrored peaks in each cell.
    """
    direction = np.stack([np.cos(grid.azimuth_rad), np.sin(grid.azimuth_rad)], axis=1)
    (first_m, next_m), (first_rad, next_rad) = grid.range_m[:2].tolist(), grid.azimuth_rad[:2].tolist()
    steps = _Grid(first_m, next_m - first_m, first_rad, next_rad - first_rad)
    rays, columns = _rays(direction, walls), wall_table(walls)
    shared = _shared_features(rays, walls.length_m, walls.angle_std_rad, returns.points_m, returns.wall)
    fields = np.array([level, *scores], np.float64)
    if features is None:
        features = np.empty((HYPOTHESES, len(FEATURES), *level.shape), np.float32)
    first, second = _all_cells(grid.range_m, direction, rays, shared, columns, fields, steps, features)
    return CellHypotheses(first, second, features)


def _rays(direction: np.ndarray, walls: WallArrays) -> np.ndarray:
    """Return where the rays of the columns meet the walls or their lines beyond the ends."""
    met = hits(RADAR, FAR_M * direction, walls)
    ahead = np.nan_to_num(met.along_ray, nan=-1.0) > 0.0
    rays = np.zeros((*ahead.shape, 8))
    rays[..., TO_WALL] = np.where(ahead, met.along_ray * FAR_M, np.inf)
    rays[..., MISSED] = met.missed_m(walls.length_m)
    rays[..., MIRROR_NORMAL_X : MIRROR_NORMAL_Y + 1] = met.normal
    rays[..., MIRROR_OFFSET] = met.offset_m
    mirror_m = np.where(ahead, met.along_ray * FAR_M, 0.0)[..., None] * direction[:, None]
    rays[..., MIRROR_X : MIRROR_Y + 1] = mirror_m
    turned = direction[:, None] * met.normal
    rays[..., INCIDENCE] = np.abs(turned[..., 0] + turned[..., 1])
    return rays


@compiled
def _log(distance):  # type: ignore[no-untyped-def]
    return 0.25 * np.log(min(max(distance, NEAR_M), FAR_M))


@compiled(error_model="numpy")
def _shared_features(rays, length_m, angle_std_rad, returns_m, wall_of_return):  # type: ignore[no-untyped-def]
    """Return the features float32 [C, W, 8] of the first mirrors that all cells of a column share: all but the
    depth.
    """
    columns, count = rays.shape[:2]
    gap2 = np.full((columns, count), np.inf)
    for k in range(len(returns_m)):
        wall = wall_of_return[k]
        for column in range(columns if wall >= 0 else 0):
            dx, dy = rays[column, wall, MIRROR_X] - returns_m[k, 0], rays[column, wall, MIRROR_Y] - returns_m[k, 1]
            gap2[column, wall] = min(gap2[column, wall], dx * dx + dy * dy)
    features = np.zeros((columns, count, 8), np.float32)
    for column in range(columns):
        for wall in range(count):
            features[column, wall, 0] = 1.0
            features[column, wall, 2] = _log(rays[column, wall, TO_WALL])
            features[column, wall, 3] = rays[column, wall, INCIDENCE]
            features[column, wall, 4] = rays[column, wall, MISSED] / MAX_MARGIN_M
            features[column, wall, 5] = _log(length_m[wall])
            features[column, wall, 6] = min(angle_std_rad[wall] / ANGLE_RAD, 1.0)
            features[column, wall, 7] = _log(np.sqrt(gap2[column, wall]))
    return features


@compiled(error_model="numpy")
def _blocker(ox, oy, ex, ey, walls, among, count):  # type: ignore[no-untyped-def]
    """Return the first of the `count` walls `among` that surely blocks a segment, -1: none does."""
    nearest, blocker = np.inf, -1
    for k in range(count):
        wall = among[k]
        if not blocks(ox, oy, ex, ey, walls, wall):
            continue
        start, stop = height_m(ox, oy, walls, wall), height_m(ex, ey, walls, wall)
        if start / (start - stop) < nearest:
            nearest, blocker = start / (start - stop), wall
    return blocker


@compiled
def _depth(x, y, rays, column, wall):  # type: ignore[no-untyped-def]
    """Return the depth of a place behind the mirror that a column's ray meets in a wall."""
    along_x, along_y = x * rays[column, wall, MIRROR_NORMAL_X], y * rays[column, wall, MIRROR_NORMAL_Y]
    return -(along_x + along_y + rays[column, wall, MIRROR_OFFSET])


@compiled
def _folded(x, y, rays, column, wall):  # type: ignore[no-untyped-def]
    """Return a place folded back in the mirror that a column's ray meets in a wall."""
    twice = 2.0 * _depth(x, y, rays, column, wall)
    return x + twice * rays[column, wall, MIRROR_NORMAL_X], y + twice * rays[column, wall, MIRROR_NORMAL_Y]


@compiled(error_model="numpy")
def _preference(rays, column, walls, wall):  # type: ignore[no-untyped-def]
    """Return the cost of a wall as the first mirror of a column's ray (inf: it is none), and whether the way to it is
    free.
    """
    to_wall, missed = rays[column, wall, TO_WALL], rays[column, wall, MISSED]
    sideways = to_wall * AZIMUTH_STD_RAD / max(rays[column, wall, INCIDENCE], 0.1)
    if not to_wall < FAR_M or missed > min(END_MARGIN_M + 2.0 * sideways, MAX_MARGIN_M):
        return np.inf, False
    free = is_free(0.0, 0.0, rays[column, wall, MIRROR_X], rays[column, wall, MIRROR_Y], walls, wall)
    cost = missed - to_wall + (0.0 if free else _BLOCKED_EARLY)
    return cost + ((_MISSED if missed > 0.0 else 0.0) + (0.0 if walls[wall, SURE] else _SHORT)), free


@compiled
def _side(ox, oy, ex, ey, x, y):  # type: ignore[no-untyped-def]
    """Return on which side of the line from (ox, oy) to (ex, ey) a point lies; 0: too near to it to be sure."""
    rx, ry, px, py = ex - ox, ey - oy, x - ox, y - oy
    turn = rx * py - ry * px
    return np.sign(turn) if abs(turn) > 1e-9 * (abs(rx) + abs(ry)) * (1.0 + abs(px) + abs(py)) else 0.0


@compiled
def _may_block(ox, oy, nearest, furthest, walls, own, among):  # type: ignore[no-untyped-def]
    """Write to `among` the walls that may surely block a segment to a place between `nearest` and `furthest`, and
    return how many: one that lies to one side of both outer segments blocks none between.
    """
    count = 0
    for wall in range(len(walls)):
        if wall == own or walls[wall, SURE] == 0.0:
            continue
        ax, ay, bx, by = walls[wall, 7], walls[wall, 8], walls[wall, 9], walls[wall, 10]
        side = _side(ox, oy, nearest[0], nearest[1], ax, ay)
        if (
            side == 0.0
            or _side(ox, oy, nearest[0], nearest[1], bx, by) != side
            or _side(ox, oy, furthest[0], furthest[1], ax, ay) != side
            or _side(ox, oy, furthest[0], furthest[1], bx, by) != side
        ):
            among[count] = wall
            count += 1
    return count


@compiled(error_model="numpy")
def _is_image(x, y, away_m, rays, column, wall):  # type: ignore[no-untyped-def]
    """Return whether a place on a column's ray lies behind the mirror that the ray meets in a wall."""
    return rays[column, wall, TO_WALL] < away_m and _depth(x, y, rays, column, wall) >= MIN_DEPTH_M


@compiled(error_model="numpy")
def _costs(range_m, direction, rays, walls):  # type: ignore[no-untyped-def]
    """Return the costs [R, C, W] of single mirrors of all cells (inf: none), the wall that blocks each one's second leg
    (-1: none), and whether the first is free [C, W].
    """
    rows, (columns, count) = len(range_m), rays.shape[:2]
    cost, block = np.full((rows, columns, count), np.inf), np.full((rows, columns, count), -1, np.int16)
    free, among = np.zeros((columns, count), np.bool_), np.empty(count, np.int64)
    x, y, away_m = np.empty(rows), np.empty(rows), np.empty(rows)
    for column in range(columns):
        for row in range(rows):
            x[row], y[row] = direction[column, 0] * range_m[row], direction[column, 1] * range_m[row]
            away_m[row] = np.hypot(x[row], y[row])
        for wall in range(count):
            preference, free[column, wall] = _preference(rays, column, walls, wall)
            first = 0 if np.isfinite(preference) else rows
            while first < rows and not _is_image(x[first], y[first], away_m[first], rays, column, wall):
                first += 1
            if first == rows:
                continue
            mx, my = rays[column, wall, MIRROR_X], rays[column, wall, MIRROR_Y]
            nearest = _folded(x[first], y[first], rays, column, wall)
            furthest = _folded(x[-1], y[-1], rays, column, wall)
            candidates = _may_block(mx, my, nearest, furthest, walls, wall, among)
            for row in range(first, rows):
                if _is_image(x[row], y[row], away_m[row], rays, column, wall):
                    fx, fy = _folded(x[row], y[row], rays, column, wall)
                    blocker = _blocker(mx, my, fx, fy, walls, among, candidates)
                    block[row, column, wall] = blocker
                    cost[row, column, wall] = preference + (0.0 if blocker < 0 else _BLOCKED_LATE)
    return cost, block, free


@compiled(error_model="numpy")
def _twice(mx, my, x, y, walls, second):  # type: ignore[no-untyped-def]
    """Return whether an image folded to (x, y) by way of the mirror at (mx, my) may have been mirrored by the wall
    `second` too, and the place then.
    """
    stop, start = height_m(x, y, walls, second), height_m(mx, my, walls, second)
    if start * stop >= 0.0 or abs(stop) < MIN_DEPTH_M:
        return False, x, y
    fx, fy = x - 2.0 * stop * walls[second, NORMAL_X], y - 2.0 * stop * walls[second, NORMAL_Y]
    share = start / (start - stop)
    return is_free(mx + share * (x - mx), my + share * (y - my), fx, fy, walls, second), fx, fy


@compiled(error_model="numpy")
def _cell_of(x, y, steps):  # type: ignore[no-untyped-def]
    """Return the row and column of a place, outside the map where it is not in view."""
    row = round((np.hypot(x, y) - steps.first_m) / steps.step_m)
    column = round((np.arctan2(y, x) - steps.first_rad) / steps.step_rad)
    return int(row), int(column)


@compiled
def _largest(fields, field, row, column):  # type: ignore[no-untyped-def]
    """Return the largest value of a field within a range bin of a cell; zero outside."""
    best = 0.0
    if 0 <= column < fields.shape[2]:
        for at in range(max(row - 1, 0), min(row + 2, fields.shape[1])):
            best = max(best, fields[field, at, column])
    return best


@compiled(error_model="numpy")
def _shows(x, y, walls, wall):  # type: ignore[no-untyped-def]
    """Return whether a wall shows the radar an image of a place, and where."""
    height, offset = height_m(x, y, walls, wall), walls[wall, OFFSET]
    if height < MIN_DEPTH_M:
        return False, x, y
    ix, iy = x - 2.0 * height * walls[wall, NORMAL_X], y - 2.0 * height * walls[wall, NORMAL_Y]
    if not cuts(0.0, 0.0, ix, iy, walls, wall, ENDS):
        return False, ix, iy
    mx, my = ix * (offset / (offset + height)), iy * (offset / (offset + height))
    return is_free(0.0, 0.0, mx, my, walls, wall) and is_free(mx, my, x, y, walls, wall), ix, iy


@compiled(error_model="numpy")
def _describe_place(x, y, own, walls, fields, steps, out):  # type: ignore[no-untyped-def]
    """Write what walls and map say of a place; `own` is the last wall on the way."""
    row, column = _cell_of(x, y, steps)
    in_view = 0 <= column < fields.shape[2]
    hidden = not is_free(0.0, 0.0, x, y, walls, -1)
    out[8], out[9], out[10], out[11] = x / PLACE_M, y / PLACE_M, in_view, hidden
    if in_view and not hidden:
        out[12], out[13] = _largest(fields, LEVEL, row, column), _largest(fields, DIRECT, row, column)
    for wall in range(len(walls)):
        if wall == own:
            continue
        shown, ix, iy = _shows(x, y, walls, wall)
        if not shown:
            continue
        row, column = _cell_of(ix, iy, steps)
        if 0 <= column < fields.shape[2] and row < fields.shape[1]:
            out[14] += 1.0 / IMAGES
            out[15] = max(out[15], _largest(fields, LEVEL, row, column))
            out[16] = max(out[16], _largest(fields, MIRRORED, row, column))
    out[17] = _log(nearest_wall_m(x, y, walls))


@compiled
def _cheapest(cost, row, column):  # type: ignore[no-untyped-def]
    """Return the wall of the least cost of a cell, the first of equals; -1: all are infinite."""
    wall, least = -1, np.inf
    for index in range(cost.shape[2]):
        if cost[row, column, index] < least:
            wall, least = index, cost[row, column, index]
    return wall


@compiled(error_model="numpy")
def _all_cells(range_m, direction, rays, shared, walls, fields, steps, features):  # type: ignore[no-untyped-def]
    """Return first and second walls int16 [K, R, C] of all cells and write their features float32 [K, F, R, C].

    Of a cell the cheapest single mirrors, and the cheapest pair: a wall whose second leg another one blocks, and that.
    """
    rows, columns = len(range_m), len(direction)
    first = np.full((HYPOTHESES, rows, columns), -1, np.int16)
    second = np.full((HYPOTHESES, rows, columns), -1, np.int16)
    cost, block, free = _costs(range_m, direction, rays, walls)
    of_row = np.empty((columns, HYPOTHESES, len(FEATURES)), np.float32)
    for row in range(rows):
        # written cell by cell, then turned: channels lie far apart
        of_row[:] = 0.0
        for column in range(columns):
            x, y = direction[column, 0] * range_m[row], direction[column, 1] * range_m[row]
            singles, paired = 0, False
            while singles < SINGLES or not paired:
                wall = _cheapest(cost, row, column)
                if wall < 0:
                    break
                cost[row, column, wall] = np.inf
                depth, blocker = _depth(x, y, rays, column, wall), block[row, column, wall]
                fx, fy = _folded(x, y, rays, column, wall)
                if singles < SINGLES:
                    out = of_row[column, singles]
                    _describe_place(fx, fy, wall, walls, fields, steps, out)
                    out[:8] = shared[column, wall]
                    out[1], out[18], out[19] = _log(depth), free[column, wall], blocker < 0
                    first[singles, row, column] = wall
                    singles += 1
                if not paired and blocker >= 0 and free[column, wall]:
                    mx, my = rays[column, wall, MIRROR_X], rays[column, wall, MIRROR_Y]
                    paired, fx, fy = _twice(mx, my, fx, fy, walls, blocker)
                    if paired:
                        out = of_row[column, SINGLES]
                        _describe_place(fx, fy, blocker, walls, fields, steps, out)
                        out[:8] = shared[column, wall]
                        out[1], out[18], out[19] = _log(depth), 1.0, 1.0
                        first[SINGLES, row, column], second[SINGLES, row, column] = wall, blocker
        _turn(of_row, features, row)
    return first, second


@compiled
def _turn(of_row, features, row):  # type: ignore[no-untyped-def]
    """Write the features [C, K, F] of a row to those of the map [K, F, R, C]."""
    columns, kinds, count = of_row.shape
    for k in range(kinds):
        for f in range(count):
            for column in range(columns):
                features[k, f, row, column] = of_row[column, k, f]
