"""Straight legs between points against everything that stands in the way: what blocks, what lets through, what thins.

All of it exact per leg and blocker, compiled; a leg leaves `CLEARANCE_M` off at both ends, so a point that lies on a
wall is not hidden by it. Walls include their ends (`CLEARANCE_M` is added), so walls that share a corner leave no gap.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields

import numpy as np
from numba import njit

CLEARANCE_M = 1e-6
#: The same on arcs, whose crossings come from a quadratic.
ARC_CLEARANCE_M = 1e-4
#: Steps of the cosine in the table of what a wall lets through.
TABLE_STEPS = 1024
#: Curvature times length below which a wall counts as straight.
STRAIGHT = 1e-6

BODY, WALL, VOLUME = 0, 1, 2


@dataclass(frozen=True)
class Blockers:
    """M upright pieces: straight or arcs, from the ground to a height."""

    #: Ends in the plane, [M, 2].
    a: np.ndarray
    b: np.ndarray
    height_m: np.ndarray
    curvature_per_m: np.ndarray
    #: `BODY`, `WALL` or `VOLUME` (foliage: never blocks), int8.
    kind: np.ndarray
    #: Owner whose own legs it does not block, -1 for none; int32.
    owner: np.ndarray
    #: Field factor of one crossing over the cosine of incidence, complex128 [M, TABLE_STEPS + 1].
    passing: np.ndarray


@dataclass(frozen=True)
class Passage:
    """What N legs meet."""

    #: No body and no wall in the way.
    free: np.ndarray
    #: Field factor of all walls crossed; 0 behind a body.
    through: np.ndarray
    #: Field factor of all foliage crossed.
    foliage: np.ndarray


def passage(start: np.ndarray, end: np.ndarray, blockers: Blockers, owner: np.ndarray | int = -1) -> Passage:
    """Follow legs from `start` to `end` ([N, 3], or one point for all, heights above ground) past the blockers.

    `owner` [N] names the thing at a leg's end whose own body does not count.
    """
    end = np.ascontiguousarray(end, np.float64)
    start = np.ascontiguousarray(np.broadcast_to(np.asarray(start, np.float64), end.shape))
    owners = np.ascontiguousarray(np.broadcast_to(np.asarray(owner, np.int32), len(end)))
    free, through, foliage = _follow(
        start,
        end,
        owners,
        blockers.a,
        blockers.b,
        blockers.height_m,
        blockers.curvature_per_m,
        blockers.kind,
        blockers.owner,
        blockers.passing,
    )
    return Passage(free, through, foliage)


def without(blockers: Blockers, index: int) -> Blockers:
    """All blockers but one."""
    return Blockers(
        **{field.name: np.delete(getattr(blockers, field.name), index, axis=0) for field in fields(Blockers)}
    )


def in_series(*legs: Passage) -> Passage:
    """Legs travelled one after the other."""
    free, through, foliage = legs[0].free, legs[0].through, legs[0].foliage
    for leg in legs[1:]:
        free, through, foliage = free & leg.free, through * leg.through, foliage * leg.foliage
    return Passage(free, through, foliage)


@njit(cache=True, nogil=True)
def _follow(start, end, owners, a, b, height, curvature, kind, owner, passing):  # type: ignore[no-untyped-def]
    count, pieces = len(end), len(a)
    free = np.ones(count, np.bool_)
    through = np.ones(count, np.complex128)
    foliage = np.ones(count, np.float64)
    for n in range(count):
        for m in range(pieces):
            if owner[m] >= 0 and owner[m] == owners[n]:
                continue
            if abs(curvature[m]) * math.hypot(b[m, 0] - a[m, 0], b[m, 1] - a[m, 1]) < STRAIGHT:
                _straight(n, m, start, end, a, b, height, kind, passing, free, through, foliage)
            else:
                _arc(n, m, start, end, a, b, height, curvature, kind, passing, free, through, foliage)
    return free, through, foliage


@njit(cache=True, nogil=True, inline="always")
def _meet(n, m, cosine, kind, passing, free, through, foliage):  # type: ignore[no-untyped-def]
    """One crossing at a cosine of incidence."""
    position = min(max(cosine, 0.0), 1.0) * TABLE_STEPS
    step = min(int(position), TABLE_STEPS - 1)
    share = position - step
    factor = (1.0 - share) * passing[m, step] + share * passing[m, step + 1]
    if kind[m] == VOLUME:
        foliage[n] *= abs(factor)
    else:
        free[n] = False
        through[n] *= factor


@njit(cache=True, nogil=True, inline="always")
def _straight(n, m, start, end, a, b, height, kind, passing, free, through, foliage):  # type: ignore[no-untyped-def]
    rx, ry = end[n, 0] - start[n, 0], end[n, 1] - start[n, 1]
    wx, wy = b[m, 0] - a[m, 0], b[m, 1] - a[m, 1]
    turn = rx * wy - ry * wx
    ray, wall = math.hypot(rx, ry), math.hypot(wx, wy)
    # parallel: they meet nowhere, or the leg sees the wall's edge, of no width
    if abs(turn) <= 1e-12 * ray * wall:
        return
    ox, oy = a[m, 0] - start[n, 0], a[m, 1] - start[n, 1]
    along_ray = (ox * wy - oy * wx) / turn
    along_wall = (ox * ry - oy * rx) / turn
    margin = CLEARANCE_M / max(ray, CLEARANCE_M)
    wider = CLEARANCE_M / max(wall, CLEARANCE_M)
    if not (margin < along_ray < 1.0 - margin and -wider <= along_wall <= 1.0 + wider):
        return
    rise = end[n, 2] - start[n, 2]
    if start[n, 2] + rise * along_ray < height[m]:
        cosine = abs(turn) / (wall * math.sqrt(ray * ray + rise * rise))
        _meet(n, m, cosine, kind, passing, free, through, foliage)


@njit(cache=True, nogil=True)
def _arc(n, m, start, end, a, b, height, curvature, kind, passing, free, through, foliage):  # type: ignore[no-untyped-def]
    wx, wy = b[m, 0] - a[m, 0], b[m, 1] - a[m, 1]
    chord = math.hypot(wx, wy)
    radius = 1.0 / curvature[m]
    # centre to the left of a -> b for positive curvature
    reach = math.copysign(math.sqrt(max(radius * radius - 0.25 * chord * chord, 0.0)), radius)
    cx = 0.5 * (a[m, 0] + b[m, 0]) - reach * wy / chord
    cy = 0.5 * (a[m, 1] + b[m, 1]) + reach * wx / chord
    rx, ry, rise = end[n, 0] - start[n, 0], end[n, 1] - start[n, 1], end[n, 2] - start[n, 2]
    fx, fy = start[n, 0] - cx, start[n, 1] - cy
    square = rx * rx + ry * ry
    half = fx * rx + fy * ry
    rest = half * half - square * (fx * fx + fy * fy - radius * radius)
    if rest <= 0.0 or square == 0.0:
        return
    margin = ARC_CLEARANCE_M / math.sqrt(square)
    for sign in (-1.0, 1.0):
        along = (-half + sign * math.sqrt(rest)) / square
        if not margin < along < 1.0 - margin:
            continue
        px, py = start[n, 0] + along * rx, start[n, 1] + along * ry
        # the arc is the part of the circle on the far side of its chord from the centre
        side = (px - a[m, 0]) * wy - (py - a[m, 1]) * wx
        if side * radius < -ARC_CLEARANCE_M * chord * abs(radius):
            continue
        if start[n, 2] + rise * along < height[m]:
            cosine = abs((px - cx) * rx + (py - cy) * ry) / (abs(radius) * math.sqrt(square + rise * rise))
            _meet(n, m, cosine, kind, passing, free, through, foliage)
