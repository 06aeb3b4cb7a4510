"""Visibility of upright walls from a point, in the plane: every wall that some ray from there may meet.

Between two ends' directions the same walls lie one behind the other. Grazing rays pass, edge-on walls count as seen.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from models.compiled import compiled
from models.physics.mirror import mirrored

#: Ends nearer than this to a ray stop it no more than they are met by it.
GRAZE_M = 2e-6
#: The same in angle, for far ends.
GRAZE_RAD = 1e-9
#: Share and metres by which a wall may be met nearer than its nearest point, by rounding.
NEARER = 1e-3


@dataclass(frozen=True)
class PlanWalls:
    """S straight stretches of wall that cross each other nowhere but at their ends."""

    #: Ends [S, 2].
    a: np.ndarray
    b: np.ndarray
    #: Piece of wall that each is a stretch of, and where on it the stretch begins and ends (shares of it), [S].
    wall: np.ndarray
    begin: np.ndarray
    end: np.ndarray


def split_walls(a: np.ndarray, b: np.ndarray, wall: np.ndarray) -> PlanWalls:
    """Return walls [W, 2] cut where they cross each other; `wall` [W] are their numbers."""
    owner, begin, end = _cut(np.ascontiguousarray(a), np.ascontiguousarray(b))
    along = b[owner] - a[owner]
    return PlanWalls(a[owner] + begin[:, None] * along, a[owner] + end[:, None] * along, wall[owner], begin, end)


def lit_walls(
    source: np.ndarray,
    walls: PlanWalls,
    passing: np.ndarray,
    least: float = 0.0,
    window: tuple[np.ndarray, np.ndarray] | None = None,
) -> np.ndarray:
    """Return which share of each piece of wall [W] rays from a point may meet, [W, 2]; (inf, -inf): none of it.

    `passing` [W]: factor left behind each piece, a ray ends at `least`. `window`: ends of a line where rays begin.
    """
    through = np.zeros((2, 2)) if window is None else np.stack(window)
    lit: np.ndarray = _sweep(
        np.asarray(source, np.float64),
        (walls.a, walls.b, walls.begin, walls.end, walls.wall),
        passing,
        least,
        through,
        window is not None,
    )
    return lit


def lit_in_mirrors(
    source: np.ndarray, walls: PlanWalls, passing: np.ndarray, mirrors: tuple[np.ndarray, np.ndarray, np.ndarray]
) -> tuple[np.ndarray, np.ndarray]:
    """Return which pieces of wall rays from a point meet by K mirrors: pairs int64 [N, 2] in order, shares [N, 2].

    `mirrors`: normals [K, 2] and offsets [K] of their lines, and the ends [K, 2, 2] between which rays meet them.
    """
    plan = walls.a, walls.b, walls.begin, walls.end, walls.wall
    pairs, share = _mirrored_sweeps(np.asarray(source, np.float64), plan, passing, *mirrors)
    return pairs, share


@compiled(error_model="numpy")
def _mirrored_sweeps(source, walls, passing, normal, offset, window):  # type: ignore[no-untyped-def]
    pairs, share, image, count = np.empty((64, 2), np.int64), np.empty((64, 2)), np.empty(2), 0
    for k in range(len(normal)):
        image[0], image[1] = mirrored(source[0], source[1], normal[k, 0], normal[k, 1], offset[k])
        lit = _sweep(image, walls, passing, 0.0, window[k], True)
        for wall in range(len(passing)):
            if lit[wall, 1] < lit[wall, 0]:
                continue
            if count == len(pairs):
                pairs, share = np.concatenate((pairs, pairs)), np.concatenate((share, share))
            pairs[count, 0], pairs[count, 1] = k, wall
            share[count] = lit[wall]
            count += 1
    return pairs[:count], share[:count]


@compiled(error_model="numpy")
def _cut(a, b):  # type: ignore[no-untyped-def]
    """Shares at which walls are met by others, as stretches: owner, begin, end."""
    count = len(a)
    # typed by what they will hold: empty lists have no type
    owner, share = [0 for _ in range(0)], [0.0 for _ in range(0)]
    for m in range(count):
        owner.append(m)
        share.append(0.0)
        owner.append(m)
        share.append(1.0)
        low_x, high_x = min(a[m, 0], b[m, 0]) - GRAZE_M, max(a[m, 0], b[m, 0]) + GRAZE_M
        low_y, high_y = min(a[m, 1], b[m, 1]) - GRAZE_M, max(a[m, 1], b[m, 1]) + GRAZE_M
        for n in range(m):
            if max(a[n, 0], b[n, 0]) < low_x or min(a[n, 0], b[n, 0]) > high_x:
                continue
            if max(a[n, 1], b[n, 1]) < low_y or min(a[n, 1], b[n, 1]) > high_y:
                continue
            mx, my, nx, ny = b[m, 0] - a[m, 0], b[m, 1] - a[m, 1], b[n, 0] - a[n, 0], b[n, 1] - a[n, 1]
            turn = mx * ny - my * nx
            if abs(turn) <= 1e-12 * math.hypot(mx, my) * math.hypot(nx, ny):
                continue
            ox, oy = a[n, 0] - a[m, 0], a[n, 1] - a[m, 1]
            on_m, on_n = (ox * ny - oy * nx) / turn, (ox * my - oy * mx) / turn
            if -1e-9 <= on_m <= 1.0 + 1e-9 and -1e-9 <= on_n <= 1.0 + 1e-9:
                if 1e-9 < on_m < 1.0 - 1e-9:
                    owner.append(m)
                    share.append(on_m)
                if 1e-9 < on_n < 1.0 - 1e-9:
                    owner.append(n)
                    share.append(on_n)
    owners, shares = np.array(owner), np.array(share)
    order = np.argsort(owners + 0.5 * shares)
    owners, shares = owners[order], shares[order]
    stretch = owners[1:] == owners[:-1]
    return owners[1:][stretch], shares[:-1][stretch], shares[1:][stretch]


@compiled(error_model="numpy")
def _sweep(source, walls, passing, least, window, narrow):  # type: ignore[no-untyped-def]
    a, b = walls[0], walls[1]
    lit = np.empty((len(passing), 2))
    lit[:, 0], lit[:, 1] = np.inf, -np.inf
    # begins in a direction in which nobody draws a wall's end
    middle, half = 0.1234, math.pi
    if narrow:
        first = math.atan2(window[0, 1] - source[1], window[0, 0] - source[0])
        turn = _wrapped(math.atan2(window[1, 1] - source[1], window[1, 0] - source[0]) - first)
        middle, half = first + 0.5 * turn, 0.5 * abs(turn) + GRAZE_RAD
    low, high, piece = _spans(source, a, b, middle, half, window)
    nearest = _nearest(source, a, b, piece)
    order = np.argsort(np.concatenate((low, high)))
    inside = np.empty(len(piece), np.int64)
    count = 0
    for index in range(len(order)):
        # the span that begins or ends here
        span = order[index] % len(piece)
        starts = order[index] < len(piece)
        angle = low[span] if starts else high[span]
        # where the window cuts a span it has no end
        if abs(angle) < half:
            # the end itself, by rays that pass all other ends
            _look(source, walls, passing, least, window, narrow, middle + angle, angle, span,
                  (low, high, piece, nearest), inside[:count], lit)  # fmt: skip
        # those that rays are inside of stand in order of their nearest points
        place = _place(nearest, inside, count, nearest[span])
        if starts and high[span] > low[span]:
            for moved in range(count, place, -1):
                inside[moved] = inside[moved - 1]
            inside[place] = span
            count += 1
        elif not starts:
            while place < count and inside[place] != span:
                place += 1
            if place < count:
                count -= 1
                for moved in range(place, count):
                    inside[moved] = inside[moved + 1]
        if index + 1 < len(order):
            following = order[index + 1]
            until = low[following] if following < len(piece) else high[following - len(piece)]
            if until > angle:
                _meet(source, walls, passing, least, window, narrow, (middle + angle, middle + until),
                      (piece, nearest), inside[:count], lit)  # fmt: skip
    return lit


@compiled(error_model="numpy")
def _place(nearest, inside, count, distance):  # type: ignore[no-untyped-def]
    """Return how many of the spans that rays are inside of are nearer than a distance."""
    low, high = 0, count
    while low < high:
        middle = (low + high) // 2
        if nearest[inside[middle]] < distance:
            low = middle + 1
        else:
            high = middle
    return low


@compiled(error_model="numpy")
def _nearest(source, a, b, piece):  # type: ignore[no-untyped-def]
    """Return a distance that no point of each span's wall is nearer than, by a margin for rays that run along it."""
    nearest = np.empty(len(piece))
    for span in range(len(piece)):
        m = piece[span]
        ax, ay, wx, wy = a[m, 0] - source[0], a[m, 1] - source[1], b[m, 0] - a[m, 0], b[m, 1] - a[m, 1]
        share = min(max(-(ax * wx + ay * wy) / max(wx * wx + wy * wy, 1e-300), 0.0), 1.0)
        nearest[span] = (1.0 - NEARER) * math.hypot(ax + share * wx, ay + share * wy) - NEARER
    return nearest


@compiled(error_model="numpy")
def _spans(source, a, b, middle, half, window):  # type: ignore[no-untyped-def]
    """Directions from the middle between which each wall stands, within half a window; wall of each span."""
    low, high, piece = np.empty(2 * len(a)), np.empty(2 * len(a)), np.empty(2 * len(a), np.int64)
    count = 0
    # lines that rays through a narrow window stay on one side of: both its edges, and the window's own
    lines, cuts = np.empty((3, 3)), half < 0.5 * math.pi
    if cuts:
        wx, wy = window[1, 0] - window[0, 0], window[1, 1] - window[0, 1]
        long = max(math.hypot(wx, wy), GRAZE_M)
        front = math.copysign(1.0 / long, wx * (source[1] - window[0, 1]) - wy * (source[0] - window[0, 0]))
        lines[0] = math.sin(middle + half), -math.cos(middle + half), 0.0
        lines[1] = -math.sin(middle - half), math.cos(middle - half), 0.0
        lines[2, 0], lines[2, 1] = front * wy, -front * wx
        lines[2, 2] = lines[2, 0] * (source[0] - window[0, 0]) + lines[2, 1] * (source[1] - window[0, 1])
    for m in range(len(a)):
        if cuts and _stands_aside(source, a[m], b[m], lines):
            continue
        first = _wrapped(math.atan2(a[m, 1] - source[1], a[m, 0] - source[0]) - middle)
        turn = _wrapped(math.atan2(b[m, 1] - source[1], b[m, 0] - source[0]) - middle - first)
        start, stop = min(first, first + turn), max(first, first + turn)
        for whole in (-2.0 * math.pi, 0.0, 2.0 * math.pi):
            if start + whole <= half and stop + whole >= -half and count < len(low):
                low[count], high[count], piece[count] = max(start + whole, -half), min(stop + whole, half), m
                count += 1
    return low[:count], high[:count], piece[:count]


@compiled(error_model="numpy")
def _stands_aside(source, a, b, lines):  # type: ignore[no-untyped-def]
    """Return whether a wall stands behind one of three lines, well beyond rounding; lines by vectors from a source."""
    ax, ay, bx, by = a[0] - source[0], a[1] - source[1], b[0] - source[0], b[1] - source[1]
    margin = 2.0 * GRAZE_M + 2.0 * GRAZE_RAD * (abs(ax) + abs(ay) + abs(bx) + abs(by))
    for line in range(3):
        nx, ny, offset = lines[line, 0], lines[line, 1], lines[line, 2]
        if nx * ax + ny * ay + offset < -margin and nx * bx + ny * by + offset < -margin:
            return True
    return False


@compiled(error_model="numpy")
def _meet(source, walls, passing, least, window, narrow, between, spans, inside, lit):  # type: ignore[no-untyped-def]
    """Light the walls that the rays between two directions meet, nearest first."""
    a, b, begin, end, wall = walls
    piece, nearest = spans
    ray = _ray(0.5 * (between[0] + between[1]))
    rays = _ray(between[0]), _ray(between[1])
    after, left = _start(source, window, narrow, ray), 1.0
    while left > least:
        distance = np.inf
        for span in inside:
            if nearest[span] > distance:
                break
            here = _distance(source, ray, a[piece[span]], b[piece[span]])
            if after < here < distance:
                distance = here
        if distance == np.inf:
            return
        # walls that stand in one another are met together
        for span in inside:
            if nearest[span] > distance + GRAZE_M:
                break
            m = piece[span]
            if not after < _distance(source, ray, a[m], b[m]) <= distance + GRAZE_M:
                continue
            for bound in rays:
                place = begin[m] + _share(source, bound, a[m], b[m]) * (end[m] - begin[m])
                lit[wall[m], 0] = min(lit[wall[m], 0], place)
                lit[wall[m], 1] = max(lit[wall[m], 1], place)
            left *= passing[wall[m]]
        after = distance + GRAZE_M


@compiled(error_model="numpy")
def _look(source, walls, passing, least, window, narrow, along, angle, span, spans, inside, lit):  # type: ignore[no-untyped-def]
    """Light the wall of a span whose end lies in a direction, unless others stand before that end on both sides."""
    a, b, begin, end, wall = walls
    low, high, piece, nearest = spans
    m = piece[span]
    ax, ay, bx, by = a[m, 0] - source[0], a[m, 1] - source[1], b[m, 0] - source[0], b[m, 1] - source[1]
    at_a, at_b = math.hypot(ax, ay), math.hypot(bx, by)
    turn_a, turn_b = abs(_wrapped(math.atan2(ay, ax) - along)), abs(_wrapped(math.atan2(by, bx) - along))
    edge_on = high[span] - low[span] < GRAZE_RAD
    reach = min(at_a, at_b) if edge_on else at_a if turn_a < turn_b else at_b
    graze = GRAZE_RAD + GRAZE_M / max(reach, GRAZE_M)
    ray = _ray(along)
    left, start = 1.0, _start(source, window, narrow, ray)
    if reach <= start - GRAZE_M:
        return
    for other in inside:
        if nearest[other] > reach or left <= least:
            break
        if low[other] < angle - graze and high[other] > angle + graze:
            here = _distance(source, ray, a[piece[other]], b[piece[other]])
            if start < here < reach - GRAZE_M:
                left *= passing[wall[piece[other]]]
    if left > least:
        place = end[m] if turn_b < turn_a else begin[m]
        lit[wall[m], 0] = min(lit[wall[m], 0], begin[m] if edge_on else place)
        lit[wall[m], 1] = max(lit[wall[m], 1], end[m] if edge_on else place)


@compiled(error_model="numpy")
def _ray(angle):  # type: ignore[no-untyped-def]
    """Unit vector of a direction."""
    return math.cos(angle), math.sin(angle)


@compiled(error_model="numpy")
def _start(source, window, narrow, ray):  # type: ignore[no-untyped-def]
    """Distance at which a ray passes the window."""
    return _distance(source, ray, window[0], window[1]) + GRAZE_M if narrow else 0.0


@compiled(error_model="numpy")
def _distance(source, ray, a, b):  # type: ignore[no-untyped-def]
    """Distance at which a ray cuts the line through two points; that of the nearer one where it runs along them."""
    wx, wy = b[0] - a[0], b[1] - a[1]
    turn = ray[0] * wy - ray[1] * wx
    ox, oy = a[0] - source[0], a[1] - source[1]
    if turn * turn <= 1e-24 * (wx * wx + wy * wy):
        return min(math.hypot(ox, oy), math.hypot(b[0] - source[0], b[1] - source[1]))
    return (ox * wy - oy * wx) / turn


@compiled(error_model="numpy")
def _share(source, ray, a, b):  # type: ignore[no-untyped-def]
    """Where on a wall, 0..1, a ray meets it."""
    wx, wy = b[0] - a[0], b[1] - a[1]
    cx, cy = ray
    turn = cx * wy - cy * wx
    if abs(turn) <= 1e-12 * math.hypot(wx, wy):
        return 0.5
    ox, oy = a[0] - source[0], a[1] - source[1]
    return min(max((ox * cy - oy * cx) / turn, 0.0), 1.0)


@compiled(error_model="numpy")
def _wrapped(angle):  # type: ignore[no-untyped-def]
    """Angle in -pi..pi."""
    return angle - 2.0 * math.pi * math.floor(angle / (2.0 * math.pi) + 0.5)
