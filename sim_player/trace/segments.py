"""Occlusion and transmission of straight segments between points, by walls, bodies and foliage.

Exact per segment and blocker, compiled. A segment leaves out `CLEARANCE_M` at both ends, so a wall does not hide a
point that lies on it. Walls include their ends (`CLEARANCE_M` is added), so walls that share a corner leave no gap.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields

import numpy as np
from numba import njit

CLEARANCE_M = 1e-6
#: The same on arcs, whose crossings come from a quadratic.
ARC_CLEARANCE_M = 1e-4
#: Steps of the cosine in the table of a wall's transmission.
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
    #: Owner whose own segments it does not block, -1 for none; int32.
    owner: np.ndarray
    #: Field factor of one crossing over the cosine of incidence, complex128 [M, TABLE_STEPS + 1].
    transmission: np.ndarray


@dataclass(frozen=True)
class Occlusion:
    """Occlusion and transmission of N segments."""

    #: Whether no body and no wall blocks it.
    free: np.ndarray
    #: Field factor of all walls crossed; 0 behind a body.
    through: np.ndarray
    #: Field factor of all foliage crossed.
    foliage: np.ndarray

    def take(self, selection: np.ndarray) -> Occlusion:
        """Return the segments of an index or mask."""
        return Occlusion(self.free[selection], self.through[selection], self.foliage[selection])


def transmission_factor(passing: np.ndarray, piece: np.ndarray, cosine: np.ndarray) -> np.ndarray:
    """Return the field factor of one crossing of some pieces [N] at cosines of incidence [N], from the table of all
    pieces.
    """
    position = np.clip(cosine, 0.0, 1.0) * TABLE_STEPS
    step = np.minimum(position.astype(np.int64), TABLE_STEPS - 1)
    share = position - step
    return np.asarray((1.0 - share) * passing[piece, step] + share * passing[piece, step + 1])


def segment_occlusion(
    start: np.ndarray, end: np.ndarray, blockers: Blockers, owner: np.ndarray | int = -1
) -> Occlusion:
    """Test segments from `start` to `end` ([N, 3], or one point for all, heights above ground) against the blockers.

    `owner` [N] is the object at a segment's end whose own body does not block it.
    """
    return _passage((start, end), blockers, owner, False)


def free_segments(points: tuple[np.ndarray, ...], blockers: Blockers, owner: np.ndarray | int = -1) -> Occlusion:
    """Test segments in series from point to point, for callers that need free ones only: a blocked series ends early.

    `points` are [N, 3] or one point for all, the last one [N, 3]; `owner` [N] belongs to the last segment. Where a
    series is not free, `through` is 0 and `foliage` is incomplete.
    """
    return _passage(points, blockers, owner, True)


def _passage(points: tuple[np.ndarray, ...], blockers: Blockers, owner: np.ndarray | int, give_up: bool) -> Occlusion:
    count = len(points[-1])
    vertices_m = np.empty((len(points), count, 3))
    for index, point in enumerate(points):
        vertices_m[index] = point
    free, through, foliage = _follow(
        vertices_m,
        np.ascontiguousarray(np.broadcast_to(np.asarray(owner, np.int32), count)),
        blockers.a,
        blockers.b,
        blockers.height_m,
        blockers.curvature_per_m,
        blockers.kind,
        blockers.owner,
        blockers.transmission,
        give_up,
    )
    return Occlusion(free, through, foliage)


def without(blockers: Blockers, index: int | np.ndarray) -> Blockers:
    """Return all blockers but those of an index or several."""
    return Blockers(
        **{field.name: np.delete(getattr(blockers, field.name), index, axis=0) for field in fields(Blockers)}
    )


def in_series(*segments: Occlusion) -> Occlusion:
    """Combine segments travelled one after the other."""
    free, through, foliage = segments[0].free, segments[0].through, segments[0].foliage
    for segment in segments[1:]:
        free, through, foliage = free & segment.free, through * segment.through, foliage * segment.foliage
    return Occlusion(free, through, foliage)


@njit(cache=True, nogil=True, error_model="numpy")
def _follow(vertices_m, owners, a, b, height, curvature, kind, owner, passing, give_up):  # type: ignore[no-untyped-def]
    vertices, count, pieces = vertices_m.shape[0], vertices_m.shape[1], len(a)
    free = np.ones(count, np.bool_)
    through = np.ones(count, np.complex128)
    foliage = np.ones(count, np.float64)
    # per piece: start, vector to its end, length, share of it that `CLEARANCE_M` is
    line = np.empty((pieces, 6))
    bent = np.empty(pieces, np.bool_)
    for m in range(pieces):
        wx, wy = b[m, 0] - a[m, 0], b[m, 1] - a[m, 1]
        wall = math.hypot(wx, wy)
        bent[m] = abs(curvature[m]) * wall >= STRAIGHT
        line[m] = a[m, 0], a[m, 1], wx, wy, wall, CLEARANCE_M / max(wall, CLEARANCE_M)
    for n in range(count):
        for segment in range(vertices - 1):
            # tuples: array views would be reference-counted in the inner loop
            sx, sy, sz = vertices_m[segment, n, 0], vertices_m[segment, n, 1], vertices_m[segment, n, 2]
            rx, ry, rise = (
                vertices_m[segment + 1, n, 0] - sx,
                vertices_m[segment + 1, n, 1] - sy,
                vertices_m[segment + 1, n, 2] - sz,
            )
            ray = (sx, sy, sz, rx, ry, rise, math.hypot(rx, ry))
            lowest = sz + min(rise, 0.0)
            own = owners[n] if segment == vertices - 2 else -1
            for m in range(pieces):
                if lowest >= height[m] or (owner[m] >= 0 and owner[m] == own):
                    continue
                if bent[m]:
                    _arc(n, m, ray, a, b, height, curvature, kind, passing, free, through, foliage)
                else:
                    piece = (line[m, 0], line[m, 1], line[m, 2], line[m, 3], line[m, 4], line[m, 5], height[m])
                    cosine = _straight(ray, piece)
                    if cosine >= 0.0:
                        _meet(n, m, cosine, kind, passing, free, through, foliage)
                if give_up and not free[n]:
                    break
            if give_up and not free[n]:
                through[n] = 0.0
                break
    return free, through, foliage


@njit(cache=True, nogil=True, error_model="numpy")
def _straight(segment, piece):  # type: ignore[no-untyped-def]
    """Return the cosine of incidence where a segment meets a straight piece, -1 where it does not."""
    sx, sy, sz, rx, ry, rise, ray = segment
    ax, ay, wx, wy, wall, wider, height = piece
    # shares along segment and piece times `turn`: most pieces are rejected without a division
    turn = rx * wy - ry * wx
    ox, oy = ax - sx, ay - sy
    across = ox * wy - oy * wx
    along = ox * ry - oy * rx
    if turn < 0.0:
        turn, across, along = -turn, -across, -along
    if across <= 0.0 or across >= turn or along < -wider * turn or along > turn + wider * turn:
        return -1.0
    # parallel: no intersection, or the segment runs along the wall, which has no width
    if turn <= 1e-12 * ray * wall:
        return -1.0
    share = across / turn
    margin = CLEARANCE_M / max(ray, CLEARANCE_M)
    if not margin < share < 1.0 - margin or sz + rise * share >= height:
        return -1.0
    return turn / (wall * math.sqrt(ray * ray + rise * rise))


@njit(cache=True, nogil=True, error_model="numpy")
def _meet(n, m, cosine, kind, passing, free, through, foliage):  # type: ignore[no-untyped-def]
    """Apply one crossing at a cosine of incidence."""
    position = min(max(cosine, 0.0), 1.0) * TABLE_STEPS
    step = min(int(position), TABLE_STEPS - 1)
    share = position - step
    factor = (1.0 - share) * passing[m, step] + share * passing[m, step + 1]
    if kind[m] == VOLUME:
        foliage[n] *= abs(factor)
    else:
        free[n] = False
        through[n] *= factor


@njit(cache=True, nogil=True, error_model="numpy")
def _arc(n, m, segment, a, b, height, curvature, kind, passing, free, through, foliage):  # type: ignore[no-untyped-def]
    sx, sy, sz, rx, ry, rise, _ = segment
    wx, wy = b[m, 0] - a[m, 0], b[m, 1] - a[m, 1]
    chord = math.hypot(wx, wy)
    # an arc less than a half circle stays within half its chord of it: most segments miss it
    reach = 0.5 * chord + ARC_CLEARANCE_M
    if (
        max(sx, sx + rx) < min(a[m, 0], b[m, 0]) - reach
        or min(sx, sx + rx) > max(a[m, 0], b[m, 0]) + reach
        or max(sy, sy + ry) < min(a[m, 1], b[m, 1]) - reach
        or min(sy, sy + ry) > max(a[m, 1], b[m, 1]) + reach
    ):
        return
    radius = 1.0 / curvature[m]
    # centre to the left of a -> b for positive curvature
    apothem = math.copysign(math.sqrt(max(radius * radius - 0.25 * chord * chord, 0.0)), radius)
    cx = 0.5 * (a[m, 0] + b[m, 0]) - apothem * wy / chord
    cy = 0.5 * (a[m, 1] + b[m, 1]) + apothem * wx / chord
    fx, fy = sx - cx, sy - cy
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
        px, py = sx + along * rx, sy + along * ry
        # the arc is the part of the circle beside its chord, on the far side from the centre
        along_chord = (px - a[m, 0]) * wx + (py - a[m, 1]) * wy
        side = (px - a[m, 0]) * wy - (py - a[m, 1]) * wx
        wider = ARC_CLEARANCE_M * chord
        if not -wider <= along_chord <= chord * chord + wider or side * radius < -wider * abs(radius):
            continue
        if sz + rise * along < height[m]:
            cosine = abs((px - cx) * rx + (py - cy) * ry) / (abs(radius) * math.sqrt(square + rise * rise))
            _meet(n, m, cosine, kind, passing, free, through, foliage)
