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
from numba import njit

from models.perception.geometry.association import DirectReturns
from models.perception.geometry.mirrors import RADAR, WallArrays, hits

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
#: Least depth of an image behind its wall, and what a wall must be passed by to block.
MIN_DEPTH_M, CUT_DEPTH_M = 1.0, 1.0
#: Walls mirror beyond their outermost return by this and by twice the beam's error, within a limit.
END_MARGIN_M, MAX_MARGIN_M, AZIMUTH_STD_RAD = 0.5, 8.0, 0.035
#: Sides of vehicles are poor mirrors and do not surely block.
VEHICLE_LENGTH_M = 5.5
#: The certain part of a wall ends this much before its outermost return.
TRIM_M = 1.0
#: Bounds of distances in features; units of positions, of an angle's error, of a number of images.
NEAR_M, FAR_M, PLACE_M, ANGLE_RAD, IMAGES = 0.2, 120.0, 40.0, 0.2, 2.0
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


class _Walls(NamedTuple):
    """Walls of a scan, [W] and [W, 2]; `certain` are ends drawn in, `sure` are long enough to block."""

    a: np.ndarray
    b: np.ndarray
    certain_a: np.ndarray
    certain_b: np.ndarray
    normal: np.ndarray
    offset_m: np.ndarray
    length_m: np.ndarray
    angle_std_rad: np.ndarray
    sure: np.ndarray


class _Rays(NamedTuple):
    """Rays of the columns and where they meet the walls, [C, W]: the mirror there, and its nearest return."""

    direction: np.ndarray
    to_wall_m: np.ndarray
    missed_m: np.ndarray
    normal: np.ndarray
    offset_m: np.ndarray
    gap_m: np.ndarray


class _Map(NamedTuple):
    """What the map shows [R, C]: level, scores of direct and of mirrored peaks; first cell and steps of its grid."""

    level: np.ndarray
    direct: np.ndarray
    mirrored: np.ndarray
    first_m: float
    step_m: float
    first_rad: float
    step_rad: float


def cell_hypotheses(
    grid: CellGrid, walls: WallArrays, returns: DirectReturns, level: np.ndarray, scores: np.ndarray
) -> CellHypotheses:
    """Return the hypotheses of every cell of a map.

    `level` [R, C] is the map's level in 0..1, `scores` [2, R, C] those of direct and mirrored peaks in each cell.
    """
    direction = np.stack([np.cos(grid.azimuth_rad), np.sin(grid.azimuth_rad)], axis=1)
    certain_a, certain_b = walls.trimmed(TRIM_M)
    arrays = _Walls(
        walls.a,
        walls.b,
        certain_a,
        certain_b,
        walls.normal,
        walls.offset_m,
        walls.length_m,
        walls.angle_std_rad,
        walls.length_m > VEHICLE_LENGTH_M,
    )
    shown, direct, mirrored = np.array([level, *scores], np.float64)
    (first_m, next_m), (first_rad, next_rad) = grid.range_m[:2].tolist(), grid.azimuth_rad[:2].tolist()
    scan_map = _Map(shown, direct, mirrored, first_m, next_m - first_m, first_rad, next_rad - first_rad)
    wall, second, features = _all_cells(grid.range_m, _rays(direction, walls, returns), arrays, scan_map)
    return CellHypotheses(wall, second, features)


def _rays(direction: np.ndarray, walls: WallArrays, returns: DirectReturns) -> _Rays:
    """Return where the rays of the columns meet the walls or their lines beyond the ends."""
    met = hits(RADAR, FAR_M * direction, walls)
    ahead = np.nan_to_num(met.along_ray, nan=-1.0) > 0.0
    to_wall_m = np.where(ahead, met.along_ray * FAR_M, np.inf)
    gap_m = np.full(to_wall_m.shape, FAR_M)
    for index in range(len(walls)):
        own = returns.points_m[returns.wall == index]
        reached = np.flatnonzero(ahead[:, index])
        if len(own) and len(reached):
            mirror_m = to_wall_m[reached, index, None] * direction[reached]
            gap_m[reached, index] = np.linalg.norm(mirror_m[:, None] - own, axis=-1).min(axis=1)
    return _Rays(direction, to_wall_m, met.missed_m(walls.length_m), met.normal, met.offset_m, gap_m)


@njit(cache=True)
def _cuts(origin, end, a, b):  # type: ignore[no-untyped-def]
    """Return whether the segment origin-end crosses the segment a-b."""
    rx, ry, sx, sy = end[0] - origin[0], end[1] - origin[1], b[0] - a[0], b[1] - a[1]
    turn = rx * sy - ry * sx
    if turn == 0.0:
        return False
    along = ((a[0] - origin[0]) * sy - (a[1] - origin[1]) * sx) / turn
    across = ((a[0] - origin[0]) * ry - (a[1] - origin[1]) * rx) / turn
    return 1e-9 < along < 1.0 and 0.0 <= across <= 1.0


@njit(cache=True)
def _height(place, wall, walls):  # type: ignore[no-untyped-def]
    """Return the signed distance of a place from the line of a wall, positive on the radar's side."""
    return place[0] * walls.normal[wall, 0] + place[1] * walls.normal[wall, 1] + walls.offset_m[wall]


@njit(cache=True)
def _blocker(origin, end, own, walls):  # type: ignore[no-untyped-def]
    """Return the first wall other than `own` that surely blocks a segment, -1: none."""
    nearest, blocker = np.inf, -1
    for wall in range(len(walls.sure)):
        if wall == own or not walls.sure[wall]:
            continue
        stop = _height(end, wall, walls)
        if abs(stop) <= CUT_DEPTH_M or not _cuts(origin, end, walls.certain_a[wall], walls.certain_b[wall]):
            continue
        start = _height(origin, wall, walls)
        if start / (start - stop) < nearest:
            nearest, blocker = start / (start - stop), wall
    return blocker


@njit(cache=True)
def _at(ray, distance):  # type: ignore[no-untyped-def]
    return ray[0] * distance, ray[1] * distance


@njit(cache=True)
def _folded(place, normal, depth):  # type: ignore[no-untyped-def]
    """Return the mirror image of a place that lies `depth` behind a mirror."""
    return place[0] + 2.0 * depth * normal[0], place[1] + 2.0 * depth * normal[1]


@njit(cache=True)
def _depth(place, column, wall, rays):  # type: ignore[no-untyped-def]
    """Return the depth of a place behind the mirror that a column's ray meets in a wall."""
    normal = rays.normal[column, wall]
    return -(place[0] * normal[0] + place[1] * normal[1] + rays.offset_m[column, wall])


@njit(cache=True)
def _preferences(column, rays, walls):  # type: ignore[no-untyped-def]
    """Return the cost [W] of each wall as the first mirror of a column's ray (inf: it is none), and whether the way to
    it is free.
    """
    count = len(walls.sure)
    cost, free = np.full(count, np.inf), np.zeros(count, np.bool_)
    for wall in range(count):
        ray, to_wall = rays.direction[column], rays.to_wall_m[column, wall]
        if not to_wall < FAR_M:
            continue
        incidence = abs(ray[0] * rays.normal[column, wall, 0] + ray[1] * rays.normal[column, wall, 1])
        sideways = to_wall * AZIMUTH_STD_RAD / max(incidence, 0.1)
        missed = rays.missed_m[column, wall]
        if missed > min(END_MARGIN_M + 2.0 * sideways, MAX_MARGIN_M):
            continue
        free[wall] = _blocker((0.0, 0.0), _at(ray, to_wall), wall, walls) < 0
        cost[wall] = missed - to_wall + (0.0 if free[wall] else _BLOCKED_EARLY)
        cost[wall] += (_MISSED if missed > 0.0 else 0.0) + (0.0 if walls.sure[wall] else _SHORT)
    return cost, free


@njit(cache=True)
def _twice(mirror, place, second, walls):  # type: ignore[no-untyped-def]
    """Return whether an image folded to `place` by way of `mirror` may have been mirrored by the wall `second` too,
    and the place then.
    """
    stop, start = _height(place, second, walls), _height(mirror, second, walls)
    if start * stop >= 0.0 or abs(stop) < MIN_DEPTH_M:
        return False, place
    normal = walls.normal[second]
    folded = place[0] - 2.0 * stop * normal[0], place[1] - 2.0 * stop * normal[1]
    share = start / (start - stop)
    turn = mirror[0] + share * (place[0] - mirror[0]), mirror[1] + share * (place[1] - mirror[1])
    return _blocker(turn, folded, second, walls) < 0, folded


@njit(cache=True)
def _log(distance):  # type: ignore[no-untyped-def]
    return 0.25 * np.log(min(max(distance, NEAR_M), FAR_M))


@njit(cache=True)
def _cell_of(place, scan_map):  # type: ignore[no-untyped-def]
    """Return the row and column of a place, outside the map where it is not in view."""
    row = round((np.hypot(place[0], place[1]) - scan_map.first_m) / scan_map.step_m)
    column = round((np.arctan2(place[1], place[0]) - scan_map.first_rad) / scan_map.step_rad)
    return int(row), int(column)


@njit(cache=True)
def _largest(field, row, column):  # type: ignore[no-untyped-def]
    """Return the largest value within a range bin of a cell; zero outside."""
    best = 0.0
    if 0 <= column < field.shape[1]:
        for at in range(max(row - 1, 0), min(row + 2, field.shape[0])):
            best = max(best, field[at, column])
    return best


@njit(cache=True)
def _shows(place, wall, walls):  # type: ignore[no-untyped-def]
    """Return whether a wall shows the radar an image of a place, and where."""
    height = _height(place, wall, walls)
    if height < MIN_DEPTH_M:
        return False, place
    normal, offset = walls.normal[wall], walls.offset_m[wall]
    image = place[0] - 2.0 * height * normal[0], place[1] - 2.0 * height * normal[1]
    if not _cuts((0.0, 0.0), image, walls.a[wall], walls.b[wall]):
        return False, image
    mirror = _at(image, offset / (offset + height))
    return _blocker((0.0, 0.0), mirror, wall, walls) < 0 and _blocker(mirror, place, wall, walls) < 0, image


@njit(cache=True)
def _distance(place, a, b):  # type: ignore[no-untyped-def]
    """Return the distance of a place from a segment."""
    sx, sy = b[0] - a[0], b[1] - a[1]
    share = ((place[0] - a[0]) * sx + (place[1] - a[1]) * sy) / max(sx * sx + sy * sy, 1e-12)
    share = min(max(share, 0.0), 1.0)
    return np.hypot(place[0] - a[0] - share * sx, place[1] - a[1] - share * sy)


@njit(cache=True)
def _describe_place(place, own, walls, scan_map, out):  # type: ignore[no-untyped-def]
    """Write what walls and map say of a place; `own` is the last wall on the way."""
    row, column = _cell_of(place, scan_map)
    in_view = 0 <= column < scan_map.level.shape[1]
    hidden = _blocker((0.0, 0.0), place, -1, walls) >= 0
    out[8], out[9], out[10], out[11] = place[0] / PLACE_M, place[1] / PLACE_M, in_view, hidden
    if in_view and not hidden:
        out[12], out[13] = _largest(scan_map.level, row, column), _largest(scan_map.direct, row, column)
    nearest = FAR_M
    for wall in range(len(walls.sure)):
        nearest = min(nearest, _distance(place, walls.a[wall], walls.b[wall]))
        if wall == own:
            continue
        shown, image = _shows(place, wall, walls)
        if not shown:
            continue
        row, column = _cell_of(image, scan_map)
        if 0 <= column < scan_map.level.shape[1] and row < scan_map.level.shape[0]:
            out[14] += 1.0 / IMAGES
            out[15] = max(out[15], _largest(scan_map.level, row, column))
            out[16] = max(out[16], _largest(scan_map.mirrored, row, column))
    out[17] = _log(nearest)


@njit(cache=True)
def _describe_mirror(place, column, wall, rays, walls, out):  # type: ignore[no-untyped-def]
    """Write the features of the way from the radar to a cell by its first mirror."""
    ray, normal = rays.direction[column], rays.normal[column, wall]
    out[0] = 1.0
    out[1] = _log(_depth(place, column, wall, rays))
    out[2] = _log(rays.to_wall_m[column, wall])
    out[3] = abs(ray[0] * normal[0] + ray[1] * normal[1])
    out[4] = rays.missed_m[column, wall] / MAX_MARGIN_M
    out[5] = _log(walls.length_m[wall])
    out[6] = min(walls.angle_std_rad[wall] / ANGLE_RAD, 1.0)
    out[7] = _log(rays.gap_m[column, wall])


@njit(cache=True)
def _costs(place, column, preference, rays, walls):  # type: ignore[no-untyped-def]
    """Return the costs [W] of single mirrors of a cell, and the wall that blocks each one's second leg (-1: none)."""
    cost, block = preference.copy(), np.full(len(preference), -1)
    for wall in range(len(cost)):
        if not np.isfinite(cost[wall]):
            continue
        depth = _depth(place, column, wall, rays)
        if depth < MIN_DEPTH_M or rays.to_wall_m[column, wall] >= np.hypot(place[0], place[1]):
            cost[wall] = np.inf
            continue
        mirror = _at(rays.direction[column], rays.to_wall_m[column, wall])
        block[wall] = _blocker(mirror, _folded(place, rays.normal[column, wall], depth), wall, walls)
        cost[wall] += 0.0 if block[wall] < 0 else _BLOCKED_LATE
    return cost, block


@njit(cache=True)
def _singles(place, column, cost, free, block, rays, walls, scan_map, wall_out, out):  # type: ignore[no-untyped-def]
    """Write the cheapest single mirrors of a cell."""
    left = cost.copy()
    for k in range(min(SINGLES, len(left))):
        wall = np.argmin(left)
        if not np.isfinite(left[wall]):
            break
        left[wall] = np.inf
        wall_out[k] = wall
        _describe_mirror(place, column, wall, rays, walls, out[k])
        folded = _folded(place, rays.normal[column, wall], _depth(place, column, wall, rays))
        _describe_place(folded, wall, walls, scan_map, out[k])
        out[k, 18], out[k, 19] = free[wall], block[wall] < 0


@njit(cache=True)
def _pair(place, column, cost, free, block, rays, walls, scan_map, wall_out, second_out, out):  # type: ignore[no-untyped-def]
    """Write the cheapest pair of mirrors of a cell: a wall whose second leg another one blocks, and that one."""
    left = cost.copy()
    for _ in range(len(left)):
        wall = np.argmin(left)
        if not np.isfinite(left[wall]):
            return
        left[wall] = np.inf
        if block[wall] < 0 or not free[wall]:
            continue
        mirror = _at(rays.direction[column], rays.to_wall_m[column, wall])
        folded = _folded(place, rays.normal[column, wall], _depth(place, column, wall, rays))
        is_free, folded = _twice(mirror, folded, block[wall], walls)
        if is_free:
            wall_out[SINGLES], second_out[SINGLES] = wall, block[wall]
            _describe_mirror(place, column, wall, rays, walls, out[SINGLES])
            _describe_place(folded, block[wall], walls, scan_map, out[SINGLES])
            out[SINGLES, 18], out[SINGLES, 19] = 1.0, 1.0
            return


@njit(cache=True, nogil=True)
def _all_cells(range_m, rays, walls, scan_map):  # type: ignore[no-untyped-def]
    """Return first and second walls int16 [K, R, C] and features float32 [K, F, R, C] of all cells."""
    rows, columns = len(range_m), len(rays.direction)
    wall = np.full((rows, columns, HYPOTHESES), -1, np.int16)
    second = np.full((rows, columns, HYPOTHESES), -1, np.int16)
    features = np.zeros((rows, columns, HYPOTHESES, len(FEATURES)), np.float32)
    for column in range(columns):
        preference, free = _preferences(column, rays, walls)
        for row in range(rows):
            place = _at(rays.direction[column], range_m[row])
            cost, block = _costs(place, column, preference, rays, walls)
            out = features[row, column]
            _singles(place, column, cost, free, block, rays, walls, scan_map, wall[row, column], out)
            _pair(place, column, cost, free, block, rays, walls, scan_map, wall[row, column], second[row, column], out)
    return wall.transpose(2, 0, 1), second.transpose(2, 0, 1), features.transpose(2, 3, 0, 1)
