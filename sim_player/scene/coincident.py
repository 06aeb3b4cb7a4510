"""Walls drawn in one place: the last one drawn stands there, the others are cut.

Two flat walls, or arcs of one circle, coincide within `NODE_M`. One no higher than the radar yields to one that is;
what stands is as high there as the highest. Mirrors and foliage do not cut each other.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from models.compiled import compiled
from models.physics.curved_mirror import arc_from_ends, arc_points
from sim_player.scene.wall_ends import NODE_M

#: Sine of the angle between walls beyond which they can not be one over any length.
STEEPEST = 0.2


@dataclass(frozen=True)
class WallPieces:
    """W pieces of wall as drawn."""

    #: Ends [W, 2], height, signed curvature, whether it is foliage [W].
    a: np.ndarray
    b: np.ndarray
    height_m: np.ndarray
    curvature_per_m: np.ndarray
    is_volume: np.ndarray


@dataclass(frozen=True)
class Stretches:
    """What stands of walls: M stretches of pieces, in the order drawn."""

    a: np.ndarray
    b: np.ndarray
    height_m: np.ndarray
    #: Piece of each [M], and what is left out: rows of piece, piece that stands there, and length of it [m].
    piece: np.ndarray
    left_out: list[tuple[int, int, float]]


def cut_coincident(walls: WallPieces, radar_height_m: float) -> Stretches:
    """Return the stretches of walls of which no two coincide."""
    cuts: dict[int, list[tuple[float, float]]] = {}
    raised: dict[int, list[tuple[float, float, float]]] = {}
    left_out = []
    for first, second, on_first, on_second in _overlaps(walls):
        stands, goes, on_stands, on_goes = second, first, on_second, on_first
        low, high = walls.height_m[second], walls.height_m[first]
        if low <= radar_height_m and low < high:
            stands, goes, on_stands, on_goes = first, second, on_first, on_second
        cuts.setdefault(goes, []).append(on_goes)
        left_out.append((goes, stands, (on_goes[1] - on_goes[0]) * _length_m(walls, goes)))
        if walls.height_m[goes] > walls.height_m[stands]:
            raised.setdefault(stands, []).append((*on_stands, float(walls.height_m[goes])))
    if not left_out:
        return Stretches(walls.a, walls.b, walls.height_m, np.arange(len(walls.a)), [])
    ends, height, piece = [], [], []
    for index in range(len(walls.a)):
        own = raised.get(index, [])
        for begin, end in _left(cuts.get(index, []), own, NODE_M / _length_m(walls, index)):
            middle = 0.5 * (begin + end)
            higher = [top for low, high, top in own if low <= middle <= high]
            ends.append(_points(walls, index, np.array([begin, end])))
            height.append(max([float(walls.height_m[index]), *higher]))
            piece.append(index)
    stretch = np.array(ends).reshape(-1, 2, 2)
    return Stretches(stretch[:, 0], stretch[:, 1], np.array(height), np.array(piece, np.int64), left_out)


def _left(
    cuts: list[tuple[float, float]], raised: list[tuple[float, float, float]], least: float
) -> list[tuple[float, float]]:
    """Return the stretches (shares) that cuts leave, divided where a piece is raised; none shorter than `least`."""
    at = sorted({0.0, 1.0, *(end for cut in cuts for end in cut), *(end for row in raised for end in row[:2])})
    at = [at[0], *(here for before, here in pairwise(at) if here - before > least)]
    at[-1] = 1.0 if 1.0 - at[-1] <= least else at[-1]
    return [
        (low, high) for low, high in pairwise(at) if not any(cut[0] <= 0.5 * (low + high) <= cut[1] for cut in cuts)
    ]


def _overlaps(walls: WallPieces) -> list[tuple[int, int, tuple[float, float], tuple[float, float]]]:
    """Return all pairs of pieces that coincide, in order, and the shares of the first and of the second on which."""
    rows = [(int(row[0]), int(row[1]), (row[2], row[3]), (row[4], row[5])) for row in _straight_pairs(*_plain(walls))]
    curved = np.flatnonzero(_is_arc(walls))
    for place, second in enumerate(curved):
        for first in curved[:place]:
            shares = _on_one_circle(walls, int(first), int(second))
            if shares is not None:
                rows.append((int(first), int(second), *shares))
    return sorted(rows)


def _plain(walls: WallPieces) -> tuple[np.ndarray, ...]:
    straight = np.flatnonzero(~_is_arc(walls))
    low_x = np.minimum(walls.a[:, 0], walls.b[:, 0])
    order = straight[np.argsort(low_x[straight], kind="stable")]
    return np.ascontiguousarray(walls.a), np.ascontiguousarray(walls.b), walls.is_volume, order


def _is_arc(walls: WallPieces) -> np.ndarray:
    """Return which pieces leave their chord by more than counts."""
    return np.asarray(np.abs(walls.curvature_per_m) * np.sum((walls.b - walls.a) ** 2, axis=1) > 2.0 * NODE_M)


def _length_m(walls: WallPieces, index: int) -> float:
    """Return the length of a piece along itself."""
    chord, curvature = math.dist(walls.a[index], walls.b[index]), abs(float(walls.curvature_per_m[index]))
    return 2.0 * math.asin(0.5 * chord * curvature) / curvature if curvature else chord


def _points(walls: WallPieces, index: int, share: np.ndarray) -> np.ndarray:
    """Return points of a piece at shares of it, its own ends exactly."""
    a, b = walls.a[index], walls.b[index]
    points = arc_points(a, b, float(walls.curvature_per_m[index]), share)
    points[share == 0.0], points[share == 1.0] = a, b
    return points


def _on_one_circle(
    walls: WallPieces, first: int, second: int
) -> tuple[tuple[float, float], tuple[float, float]] | None:
    """Return the shares of two arcs on which they coincide, None if they do not."""
    if walls.is_volume[first] != walls.is_volume[second]:
        return None
    shares = []
    for own, other in ((first, second), (second, first)):
        place = np.sort(_shares(walls, own, np.stack([walls.a[other], walls.b[other]])))
        low, high = np.clip(place, 0.0, 1.0)
        if (high - low) * _length_m(walls, own) <= NODE_M:
            return None
        points = _points(walls, own, np.array([low, 0.5 * (low + high), high]))
        centre, radius, *_ = arc_from_ends(walls.a[other], walls.b[other], float(walls.curvature_per_m[other]))
        if (np.abs(np.hypot(*(points - centre).T) - radius) > NODE_M).any():
            return None
        shares.append((float(low), float(high)))
    return shares[0], shares[1]


def _shares(walls: WallPieces, index: int, point: np.ndarray) -> np.ndarray:
    """Return where on an arc, 0..1 from a to b and beyond, the points [N, 2] lie, by their directions."""
    centre, _, start, end = arc_from_ends(walls.a[index], walls.b[index], float(walls.curvature_per_m[index]))
    middle, half = 0.5 * (start + end), 0.5 * (end - start)
    turn = np.arctan2(point[:, 1] - centre[1], point[:, 0] - centre[0]) - middle
    return np.asarray(0.5 + 0.5 * ((turn + np.pi) % (2.0 * np.pi) - np.pi) / half)


@compiled(error_model="numpy")
def _straight_pairs(a, b, is_volume, order):  # type: ignore[no-untyped-def]
    """Return first, second and shares of each (low and high) of all pairs of straight pieces that coincide, [N, 6]."""
    rows, count = np.empty((16, 6)), 0
    for place in range(len(order)):
        m = order[place]
        until = max(a[m, 0], b[m, 0]) + NODE_M
        low_y, high_y = min(a[m, 1], b[m, 1]) - NODE_M, max(a[m, 1], b[m, 1]) + NODE_M
        for further in range(place + 1, len(order)):
            n = order[further]
            if min(a[n, 0], b[n, 0]) > until:
                break
            if max(a[n, 1], b[n, 1]) < low_y or min(a[n, 1], b[n, 1]) > high_y or is_volume[m] != is_volume[n]:
                continue
            first, second = min(m, n), max(m, n)
            on_first, on_second = _shared(a, b, first, second), _shared(a, b, second, first)
            if on_first[0] >= on_first[1] or on_second[0] >= on_second[1]:
                continue
            if count == len(rows):
                more = np.empty((2 * count, 6))
                more[:count] = rows
                rows = more
            rows[count, 0], rows[count, 1], rows[count, 2:4], rows[count, 4:6] = first, second, on_first, on_second
            count += 1
    return rows[:count]


@compiled(error_model="numpy")
def _shared(a, b, own, other):  # type: ignore[no-untyped-def]
    """Return the shares of a piece between which another one coincides with it; nothing: low over high."""
    wx, wy, vx, vy = b[own, 0] - a[own, 0], b[own, 1] - a[own, 1], b[other, 0] - a[other, 0], b[other, 1] - a[other, 1]
    square, long = wx * wx + wy * wy, math.hypot(vx, vy)
    if abs(wx * vy - wy * vx) > STEEPEST * math.sqrt(square) * long:
        return 1.0, 0.0
    at_a = ((a[other, 0] - a[own, 0]) * wx + (a[other, 1] - a[own, 1]) * wy) / square
    at_b = ((b[other, 0] - a[own, 0]) * wx + (b[other, 1] - a[own, 1]) * wy) / square
    low, high = max(min(at_a, at_b), 0.0), min(max(at_a, at_b), 1.0)
    if (high - low) * math.sqrt(square) <= NODE_M:
        return 1.0, 0.0
    for share in (low, high):
        x, y = a[own, 0] + share * wx - a[other, 0], a[own, 1] + share * wy - a[other, 1]
        if abs(x * vy - y * vx) > NODE_M * long:
            return 1.0, 0.0
    return low, high
