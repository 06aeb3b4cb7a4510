"""Occlusion and transmission of straight segments between points, by walls, bodies and foliage.

Exact per segment and blocker, compiled: all blockers in turn, or of many those alone whose boxes a segment meets. A
segment leaves out `CLEARANCE_M` at both ends, so a wall does not hide a point that lies on it. Walls include their ends
(`CLEARANCE_M` is added), so walls that share a corner leave no gap.

A top edge ends smoothly: of a wave whose ray passes it at a clearance h, Fresnel's share at v = h sqrt(2 (1/d1 + 1/d2)
/ lambda) passes over it (one knife edge, ITU-R P.526-15 4.1), and of the rest what the wall lets through. Several walls
multiply; of a box the edge counts that cuts off more. The share stands against the straight ray: its phase has the
detour. What is left of a way fades out below -28 dB and is gone at -34 dB (`LEAST_LEFT`), which is -68 dB out and back.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import Any

import numpy as np

from models.compiled import compiled
from models.physics.diffraction import FADES_TO, faded_share_at

CLEARANCE_M = 1e-6
#: The same on arcs, whose crossings come from a quadratic.
ARC_CLEARANCE_M = 1e-4
#: Steps of the cosine in the table of a wall's transmission.
TABLE_STEPS = 1024
#: Turn [rad] below which a wall counts as straight, and the same where its sagitta is less than this share of a
#: wavelength: phases of bounces then err by 0.2 rad at most, and focusing by the turn times distance over length.
STRAIGHT, STRAIGHT_TURN, STRAIGHT_SAGITTA = 1e-6, 1e-3, 1.0 / 64.0
#: Pieces in a box of the tree that is not divided further, and by how much boxes are wider than what they hold.
LEAF = 4
BOX_MARGIN_M = 1e-3
#: A wall hides all of something only where it does so by this much.
SCREEN_M = 1e-3
#: Field factor that tops leave of a way, or walls of a bent one, from which on down it counts as blocked (-34 dB); it
#: fades from twice that. Under a single top there is as much at Fresnel's argument of -5.
LEAST_LEFT, DARK_V = 0.02, 5.0

BODY, WALL, VOLUME = 0, 1, 2


def as_bent(curvature_per_m: np.ndarray, chord_m: np.ndarray, wavelength_m: float) -> np.ndarray:
    """Return the curvature of walls [W] of some chords [W], 0 of those that count as straight."""
    turn = np.abs(curvature_per_m) * chord_m
    slight = (turn < STRAIGHT_TURN) & (0.125 * turn * chord_m < STRAIGHT_SAGITTA * wavelength_m)
    return np.where(slight | (turn < STRAIGHT), 0.0, curvature_per_m)


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
    #: Row of `transmission` that each has, int32 [M].
    build: np.ndarray
    #: Number of the box of which each is one of four faces, -1 for none; int32.
    box: np.ndarray
    #: Field factor of one crossing over the cosine of incidence, complex128 [builds, TABLE_STEPS + 1].
    transmission: np.ndarray
    #: Of the wave that passes their tops; 0 for rays alone.
    wavelength_m: float = 0.0
    #: Whether they are found by a tree of boxes: the same pieces meet a segment, in another order.
    tree: bool = False

    @cached_property
    def pieces(self) -> tuple[Any, ...]:
        """The same pieces as compiled code takes them, with their boxes."""
        columns = self.a, self.b, self.height_m, self.curvature_per_m, self.kind, self.owner, self.build, self.box
        pieces = _pieces(*columns, np.abs(self.transmission).max(axis=1, initial=0.0) < LEAST_LEFT)
        order, boxes = _boxes(*_bounds(pieces), LEAF if self.tree else max(len(pieces), 1))
        return pieces[order], self.transmission, boxes, _faces(self.box[order]), self.wavelength_m

    def take(self, selection: np.ndarray) -> Blockers:
        """Return the pieces of an index or mask."""
        return replace(self, **{name: getattr(self, name)[selection] for name in _BY_PIECE})


@dataclass(frozen=True)
class Occlusion:
    """Occlusion and transmission of N segments."""

    #: Whether no body and no wall blocks it.
    free: np.ndarray
    #: Field factor of what passes over the tops of all, 1 where it is far from them, 0 where it is not free.
    over: np.ndarray
    #: The same with what walls let through; 0 behind a body.
    through: np.ndarray
    #: Field factor of all foliage crossed; incomplete where nothing comes through.
    foliage: np.ndarray

    def take(self, selection: np.ndarray) -> Occlusion:
        """Return the segments of an index or mask."""
        return Occlusion(*(column[selection] for column in (self.free, self.over, self.through, self.foliage)))

    def where(self, mask: np.ndarray) -> Occlusion:
        """Return the same, with all segments but those of a mask blocked."""
        over, through = np.where(mask, self.over, 0.0), np.where(mask, self.through, 0.0)
        return Occlusion(self.free & mask, over, through, self.foliage)


def segment_occlusion(
    start: np.ndarray, end: np.ndarray, blockers: Blockers, owner: np.ndarray | int = -1
) -> Occlusion:
    """Test segments from `start` to `end` ([N, 3], or one point for all); `owner` [N]: the object at its end."""
    return _passage((start, end), blockers, owner, False)


def free_segments(points: tuple[np.ndarray, ...], blockers: Blockers, owner: np.ndarray | int = -1) -> Occlusion:
    """Test segments in series from point to point ([N, 3] or one): `through` is 0 of blocked ones, which end early.

    `owner` [N] belongs to the last segment.
    """
    return _passage(points, blockers, owner, True)


def _passage(points: tuple[np.ndarray, ...], blockers: Blockers, owner: np.ndarray | int, give_up: bool) -> Occlusion:
    count = len(points[-1])
    vertices_m = np.empty((len(points), count, 3))
    for index, point in enumerate(points):
        vertices_m[index] = point
    owners = np.ascontiguousarray(np.broadcast_to(np.asarray(owner, np.int32), count))
    return Occlusion(*_follow(vertices_m, owners, blockers.pieces, give_up))


def without(blockers: Blockers, index: int | np.ndarray) -> Blockers:
    """Return all blockers but those of an index or several."""
    return blockers.take(np.delete(np.arange(len(blockers.a)), index))


def join_blockers(first: Blockers, *more: Blockers) -> Blockers:
    """Return all blockers of several sets that share one table of `transmission`, in order."""
    parts = first, *more
    joined: dict[str, Any] = {name: np.concatenate([getattr(part, name) for part in parts]) for name in _BY_PIECE}
    return replace(first, **joined)


_BY_PIECE = tuple(
    field.name for field in fields(Blockers) if field.name not in ("transmission", "wavelength_m", "tree")
)
#: Columns of a piece in compiled code: start, vector to the end, length, share of it that `CLEARANCE_M` is, height,
#: end, curvature (0: straight), kind, owner, build, box, whether it is a wall that lets next to nothing through. One
#: array: each further one would be reference-counted per segment.
_COLUMNS = 15
#: Columns of a box: least and greatest x and y, first and last piece that it holds itself (none: boxes follow), and
#: the box to go on with if a segment misses it.
_BOX_COLUMNS = 7


@compiled(error_model="numpy")
def _pieces(a, b, height, curvature, kind, owner, build, box, opaque):  # type: ignore[no-untyped-def]
    piece = np.empty((len(a), _COLUMNS))
    for m in range(len(a)):
        wx, wy = b[m, 0] - a[m, 0], b[m, 1] - a[m, 1]
        wall = math.hypot(wx, wy)
        bent = curvature[m] if abs(curvature[m]) * wall >= STRAIGHT else 0.0
        wider = CLEARANCE_M / max(wall, CLEARANCE_M)
        piece[m, :7] = (a[m, 0], a[m, 1], wx, wy, wall, wider, height[m])
        piece[m, 7:13] = (b[m, 0], b[m, 1], bent, float(kind[m]), float(owner[m]), float(build[m]))
        piece[m, 13] = float(box[m])
        piece[m, 14] = 1.0 if kind[m] == WALL and opaque[build[m]] else 0.0
    return piece


@compiled(error_model="numpy")
def _faces(box):  # type: ignore[no-untyped-def]
    """Return the rows of the four faces of each box, [B, 4], -1 where one is missing."""
    faces = np.full((box.max() + 1 if len(box) else 0, 4), -1)
    for m in range(len(box)):
        for place in range(4):
            if box[m] >= 0 and faces[box[m], place] < 0:
                faces[box[m], place] = m
                break
    return faces


def _bounds(pieces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the least and the greatest coordinates of pieces, [M, 2] each."""
    # an arc stays within half its chord of it
    a, b = pieces[:, :2], pieces[:, 7:9]
    wider = BOX_MARGIN_M + np.where(pieces[:, 9] == 0.0, 0.0, 0.5 * pieces[:, 4])[:, None]
    return np.minimum(a, b) - wider, np.maximum(a, b) + wider


@compiled(error_model="numpy")
def _boxes(low, high, leaf):  # type: ignore[no-untyped-def]
    """Order of pieces in which neighbours stand together, [M], and nested boxes halved at medians, depth first."""
    count = len(low)
    order, boxes, stop = np.arange(count), np.empty((2 * count + 1, _BOX_COLUMNS)), np.empty(2 * count + 1, np.int64)
    waiting, waits, made = np.empty((2 * count + 2, 2), np.int64), 1, 0
    waiting[0, 0], waiting[0, 1] = 0, count
    while waits:
        waits -= 1
        first, last = waiting[waits, 0], waiting[waits, 1]
        box = boxes[made]
        stop[made] = last
        made += 1
        box[0], box[1], box[2], box[3] = np.inf, np.inf, -np.inf, -np.inf
        for m in order[first:last]:
            box[0], box[1] = min(box[0], low[m, 0]), min(box[1], low[m, 1])
            box[2], box[3] = max(box[2], high[m, 0]), max(box[3], high[m, 1])
        box[4], box[5] = first, last
        if last - first > leaf:
            axis = 0 if box[2] - box[0] > box[3] - box[1] else 1
            members = order[first:last].copy()
            order[first:last] = members[np.argsort(low[members, axis] + high[members, axis])]
            middle = (first + last) // 2
            waiting[waits, 0], waiting[waits, 1] = middle, last
            waiting[waits + 1, 0], waiting[waits + 1, 1] = first, middle
            waits += 2
            box[5] = first
    # past a box goes on the first one after it whose pieces begin where its own end
    begins = np.full(count + 1, made)
    for n in range(made - 1, -1, -1):
        boxes[n, 6] = begins[stop[n]] if stop[n] < count else made
        begins[int(boxes[n, 4])] = n
    return order, boxes[:made]


@compiled(error_model="numpy")
def _follow(vertices_m, owners, pieces, give_up):  # type: ignore[no-untyped-def]
    vertices, count = vertices_m.shape[0], vertices_m.shape[1]
    free = np.ones(count, np.bool_)
    over, through = np.ones(count, np.complex128), np.ones(count, np.complex128)
    foliage = np.ones(count, np.float64)
    for n in range(count):
        for segment in range(vertices - 1):
            start = vertices_m[segment, n, 0], vertices_m[segment, n, 1], vertices_m[segment, n, 2]
            end = vertices_m[segment + 1, n, 0], vertices_m[segment + 1, n, 1], vertices_m[segment + 1, n, 2]
            own = owners[n] if segment == vertices - 2 else -1
            above, factor, leaves = passage(start, end, own, pieces, give_up)
            over[n] *= above
            through[n] *= factor
            foliage[n] *= leaves
            if give_up and above == 0.0:
                through[n] = 0.0
                break
        free[n] = is_left(over[n])
    return free, over, through, foliage


@compiled(error_model="numpy")
def passage(start, end, own, pieces, give_up):  # type: ignore[no-untyped-def]
    """Return the factor of all tops on a segment (1: none near, 0: blocked), with walls, and of foliage; not `faded`.

    `pieces` as of `Blockers`; `own`: owner whose pieces do not block; `give_up`: end at the first that blocks.
    """
    piece, passing, boxes, faces, wavelength_m = pieces
    sx, sy, sz = start
    rx, ry, rise = end[0] - sx, end[1] - sy, end[2] - sz
    # tuples: array views would be reference-counted in the inner loop
    ray = (sx, sy, sz, rx, ry, rise, math.hypot(rx, ry))
    lowest = sz + min(rise, 0.0)
    # v^2 = h^2 / (spread share (1 - share))
    spread = 0.5 * wavelength_m * math.hypot(ray[6], rise)
    near = FADES_TO * math.sqrt(0.25 * spread)
    over, through, foliage = 1.0 + 0.0j, 1.0 + 0.0j, 1.0
    box = 0
    while box < len(boxes):
        if _misses(sx, sy, rx, ry, boxes, box):
            box = int(boxes[box, 6])
            continue
        for m in range(int(boxes[box, 4]), int(boxes[box, 5])):
            height, bend, owner = piece[m, 6], piece[m, 9], piece[m, 11]
            if lowest >= height + near or (owner >= 0.0 and owner == own):
                continue
            second = (-1.0, 0.0)
            if bend == 0.0:
                line = (piece[m, 0], piece[m, 1], piece[m, 2], piece[m, 3], piece[m, 4], piece[m, 5])
                first = _straight(ray, line)
            else:
                first, second = _arc(ray, (piece[m, 0], piece[m, 1], piece[m, 7], piece[m, 8], bend))
            for cosine, share in (first, second):
                if cosine < 0.0:
                    continue
                v = _over_v(ray, spread, height, share)
                if v >= FADES_TO or (v > -FADES_TO and _is_behind(ray, spread, m, v, piece, faces)):
                    continue
                above = faded_share_at(v)
                factor = crossing_factor(passing, int(piece[m, 12]), cosine)
                if piece[m, 10] == VOLUME:
                    foliage *= abs(factor + (1.0 - factor) * above)
                else:
                    over *= above
                    through *= factor + (1.0 - factor) * above
            # nothing brings back what is blocked
            if over == 0.0 and (give_up or through == 0.0):
                return over, through, foliage
        box += 1
    return over, through, foliage


@compiled(error_model="numpy")
def _over_v(ray, spread, height, share):  # type: ignore[no-untyped-def]
    """Return Fresnel's argument of a ray over a top that it passes at a share of it, from `FADES_TO` on only that."""
    clearance = ray[2] + ray[5] * share - height
    square = spread * share * (1.0 - share)
    if clearance * clearance >= FADES_TO * FADES_TO * square:
        return FADES_TO if clearance >= 0.0 else -FADES_TO
    return clearance / math.sqrt(square)


@compiled(error_model="numpy")
def _is_behind(ray, spread, m, v, piece, faces):  # type: ignore[no-untyped-def]
    """Return whether another face of the same box cuts off more of a ray, or as much and comes first."""
    if piece[m, 13] < 0.0:
        return False
    for place in range(4):
        k = faces[int(piece[m, 13]), place]
        if k < 0 or k == m:
            continue
        line = (piece[k, 0], piece[k, 1], piece[k, 2], piece[k, 3], piece[k, 4], piece[k, 5])
        cosine, share = _straight(ray, line)
        if cosine >= 0.0:
            other = _over_v(ray, spread, piece[k, 6], share)
            if other < v or (other == v and k < m):
                return True
    return False


@compiled(error_model="numpy")
def faded(field):  # type: ignore[no-untyped-def]
    """Return what is left of a way as it fades out: the same above twice `LEAST_LEFT`, nothing below it."""
    return field * _step(LEAST_LEFT, 2.0 * LEAST_LEFT, abs(field))


@compiled(error_model="numpy")
def is_left(field):  # type: ignore[no-untyped-def]
    """Return whether a way counts, faded: what is left of it then is 1e-3 and more."""
    return abs(field) > 1.1 * LEAST_LEFT


@compiled(error_model="numpy")
def all_faded(fields):  # type: ignore[no-untyped-def]
    """Return `faded` of fields [N]."""
    left = np.empty(len(fields), np.complex128)
    for n in range(len(fields)):
        left[n] = faded(fields[n])
    return left


@compiled(error_model="numpy")
def _step(low, high, value):  # type: ignore[no-untyped-def]
    """Return a smooth step from 0 to 1."""
    share = min(max((value - low) / (high - low), 0.0), 1.0)
    return share * share * (3.0 - 2.0 * share)


@compiled(error_model="numpy")
def _misses(sx, sy, rx, ry, boxes, box):  # type: ignore[no-untyped-def]
    """Return whether a segment has no point in a box."""
    x, y = 0.5 * (boxes[box, 0] + boxes[box, 2]) - sx, 0.5 * (boxes[box, 1] + boxes[box, 3]) - sy
    wide, high = 0.5 * (boxes[box, 2] - boxes[box, 0]), 0.5 * (boxes[box, 3] - boxes[box, 1])
    # along both axes, and across the segment
    return (
        abs(x - 0.5 * rx) > wide + 0.5 * abs(rx)
        or abs(y - 0.5 * ry) > high + 0.5 * abs(ry)
        or abs(x * ry - y * rx) > wide * abs(ry) + high * abs(rx)
    )


@compiled(error_model="numpy")
def series(points, own, pieces, walls):  # type: ignore[no-untyped-def]
    """Return the field factor of all tops on segments from point to point (0: blocked), and that of foliage.

    With `walls`, of what they let through too, `LEAST_LEFT` and more, and whether it crosses one. `own`: last
    segment's.
    """
    field, leaves, crosses = 1.0 + 0.0j, 1.0, False
    for index in range(len(points) - 1):
        start, end = points[index], points[index + 1]
        if start == end:
            continue
        over, through, foliage = passage(start, end, own if index == len(points) - 2 else -1, pieces, not walls)
        crosses |= over == 0.0
        field *= through if walls else over
        if not is_left(field):
            return 0.0j, 0.0, False
        leaves *= foliage
    return faded(field), leaves, crosses


@compiled(error_model="numpy")
def may_pass(points, pieces, walls):  # type: ignore[no-untyped-def]
    """Return whether lower rays along the same plan may have a factor in `series`: at most four times as much."""
    for index in range(len(points) - 1):
        over, through, _ = passage(points[index], points[index + 1], -1, pieces, not walls)
        if over == 0.0 and not (walls and abs(through) > 0.25 * LEAST_LEFT):
            return False
    return True


@compiled(error_model="numpy")
def is_clear(points, pieces):  # type: ignore[no-untyped-def]
    """Return whether segments from point to point meet neither walls nor bodies nor foliage, and no top near by."""
    for index in range(len(points) - 1):
        over, through, foliage = passage(points[index], points[index + 1], -1, pieces, True)
        if over != 1.0 or through != 1.0 or foliage != 1.0:
            return False
    return True


@compiled(error_model="numpy")
def is_screened(source, circle, between, top, line, pieces):  # type: ignore[no-untyped-def]
    """Return whether one straight wall blocks what rays from a source to a circle have on the positive side of a line.

    In plan, no higher than `top`; circle: place and radius; line: unit normal and offset between. No is not: free.
    """
    piece, _, boxes, _, wavelength_m = pieces
    away = math.hypot(circle[0] - source[0], circle[1] - source[1]) + circle[2]
    # what passes over a top, of the longest ray
    covered = top + SCREEN_M + DARK_V * math.sqrt(0.125 * wavelength_m * (away + top))
    (sx, sy), (ex, ey) = between
    rx, ry = ex - sx, ey - sy
    ray = (sx, sy, top, rx, ry, 0.0, math.hypot(rx, ry))
    box = 0
    while box < len(boxes):
        if _misses(sx, sy, rx, ry, boxes, box):
            box = int(boxes[box, 6])
            continue
        for m in range(int(boxes[box, 4]), int(boxes[box, 5])):
            # arcs, what lets through, and what does not block its owner's own rays
            if piece[m, 9] != 0.0 or piece[m, 14] == 0.0 or piece[m, 11] >= 0.0 or piece[m, 6] <= covered:
                continue
            wall = (piece[m, 0], piece[m, 1], piece[m, 2], piece[m, 3], piece[m, 4], piece[m, 5])
            ends = piece[m, 0], piece[m, 1], piece[m, 7], piece[m, 8]
            if _straight(ray, wall)[0] >= 0.0 and _screens(ends, source, circle, line):
                return True
        box += 1
    return False


@compiled(error_model="numpy")
def _screens(ends, source, circle, line):  # type: ignore[no-untyped-def]
    """Return whether a stretch on the positive side of a line parts a source from all of a circle, by `SCREEN_M`."""
    (ax, ay, bx, by), (nx, ny, offset) = ends, line
    if min(ax * nx + ay * ny, bx * nx + by * ny) + offset < SCREEN_M:
        return False
    x, y, radius = circle[0] - source[0], circle[1] - source[1], circle[2] + SCREEN_M
    away = math.sqrt(x * x + y * y)
    if away <= 2.0 * radius:
        return False
    # source and circle on both sides of it
    wx, wy = bx - ax, by - ay
    wall = math.sqrt(wx * wx + wy * wy)
    before = wx * (source[1] - ay) - wy * (source[0] - ax)
    behind = wx * (circle[1] - ay) - wy * (circle[0] - ax)
    if before * behind >= 0.0 or abs(before) < SCREEN_M * wall or abs(behind) < radius * wall:
        return False
    # one end beyond each tangent: by the distance from it
    sine = radius / away
    cosine = math.sqrt(1.0 - sine * sine)
    x, y = x / away, y / away
    side = math.copysign(1.0, behind)
    ax, ay, bx, by = side * (ax - source[0]), side * (ay - source[1]), side * (bx - source[0]), side * (by - source[1])
    to_a = (cosine * x - side * sine * y) * ay - (cosine * y + side * sine * x) * ax
    to_b = (cosine * x + side * sine * y) * by - (cosine * y - side * sine * x) * bx
    return to_a > SCREEN_M and to_b < -SCREEN_M


@compiled(error_model="numpy")
def crossing_factor(passing, build, cosine):  # type: ignore[no-untyped-def]
    """Return the field factor of one crossing of a build at a cosine of incidence, from the table of all builds."""
    position = min(max(cosine, 0.0), 1.0) * TABLE_STEPS
    step = min(int(position), TABLE_STEPS - 1)
    share = position - step
    return (1.0 - share) * passing[build, step] + share * passing[build, step + 1]


@compiled(error_model="numpy")
def _straight(segment, piece):  # type: ignore[no-untyped-def]
    """Return the cosine of incidence of a segment and a straight piece in plan (-1: none), and the share before."""
    sx, sy, _, rx, ry, rise, ray = segment
    ax, ay, wx, wy, wall, wider = piece
    # shares along segment and piece times `turn`: most pieces are rejected without a division
    turn = rx * wy - ry * wx
    ox, oy = ax - sx, ay - sy
    across = ox * wy - oy * wx
    along = ox * ry - oy * rx
    if turn < 0.0:
        turn, across, along = -turn, -across, -along
    if across <= 0.0 or across >= turn or along < -wider * turn or along > turn + wider * turn:
        return -1.0, 0.0
    # parallel: no intersection, or the segment runs along the wall, which has no width
    if turn <= 1e-12 * ray * wall:
        return -1.0, 0.0
    share = across / turn
    margin = CLEARANCE_M / max(ray, CLEARANCE_M)
    if not margin < share < 1.0 - margin:
        return -1.0, 0.0
    return turn / (wall * math.sqrt(ray * ray + rise * rise)), share


@compiled(error_model="numpy")
def _arc(segment, arc):  # type: ignore[no-untyped-def]
    """Return what `_straight` does for both places where a segment may meet an arc."""
    sx, sy, _, rx, ry, rise, _ = segment
    ax, ay, bx, by, curvature = arc
    wx, wy = bx - ax, by - ay
    chord = math.hypot(wx, wy)
    # an arc less than a half circle stays within half its chord of it: most segments miss it
    reach = 0.5 * chord + ARC_CLEARANCE_M
    if (
        max(sx, sx + rx) < min(ax, bx) - reach
        or min(sx, sx + rx) > max(ax, bx) + reach
        or max(sy, sy + ry) < min(ay, by) - reach
        or min(sy, sy + ry) > max(ay, by) + reach
    ):
        return (-1.0, 0.0), (-1.0, 0.0)
    radius = 1.0 / curvature
    # centre to the left of a -> b for positive curvature
    apothem = math.copysign(math.sqrt(max(radius * radius - 0.25 * chord * chord, 0.0)), radius)
    cx = 0.5 * (ax + bx) - apothem * wy / chord
    cy = 0.5 * (ay + by) + apothem * wx / chord
    fx, fy = sx - cx, sy - cy
    square = rx * rx + ry * ry
    half = fx * rx + fy * ry
    rest = half * half - square * (fx * fx + fy * fy - radius * radius)
    if rest <= 0.0 or square == 0.0:
        return (-1.0, 0.0), (-1.0, 0.0)
    margin = ARC_CLEARANCE_M / math.sqrt(square)
    first, last = (-1.0, 0.0), (-1.0, 0.0)
    for sign in (-1.0, 1.0):
        along = (-half + sign * math.sqrt(rest)) / square
        if not margin < along < 1.0 - margin:
            continue
        px, py = sx + along * rx, sy + along * ry
        # the arc is the part of the circle beside its chord, on the far side from the centre
        along_chord = (px - ax) * wx + (py - ay) * wy
        side = (px - ax) * wy - (py - ay) * wx
        wider = ARC_CLEARANCE_M * chord
        if not -wider <= along_chord <= chord * chord + wider or side * radius < -wider * abs(radius):
            continue
        cosine = abs((px - cx) * rx + (py - cy) * ry) / (abs(radius) * math.sqrt(square + rise * rise))
        if sign < 0.0:
            first = cosine, along
        else:
            last = cosine, along
    return first, last
