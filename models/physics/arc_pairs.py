"""Ways by two walls of which one is an arc, or both: the point of both bounces that Fermat's principle asks for.

Newton's method from the chords' point makes the plan length stationary over both places at once. The field is that of
flat mirrors over the root of D = [(1/l1 + 1/l2 - 2 k1/c1) (1/l2 + 1/l3 - 2 k2/c2) - 1/l2^2] l1 l2 l3 / (l1 + l2 + l3)
(stationary phase); c are the cosines of incidence, k is positive where a wall is hollow towards the ray. Left out:
further points of strongly bent walls, and the exact field near caustics (`LEAST_SPREAD`).
"""

from __future__ import annotations

import math

import numpy as np

from models.compiled import compiled
from models.physics.mirror import mirrored

#: Least |D|: nearer to a caustic the rays' field has no bound.
LEAST_SPREAD = 0.05
#: Places on chords beyond this share of a wall before its ends and behind are not followed.
BESIDE = 0.5
_STEPS, _CLOSE_M = 30, 1e-9


def arc_pairs(
    antenna: np.ndarray,
    point_m: np.ndarray,
    walls: tuple[np.ndarray, np.ndarray, np.ndarray],
    lines: tuple[np.ndarray, np.ndarray],
    is_mirror: np.ndarray,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return first wall, second wall and target [M, 3], points of both walls and the end [M, 3, 3], and gains [M].

    Of all ways from the antenna [3] by two walls to points [N, 3], one wall of which at least is an arc, whatever
    stands between. `walls`: ends [W, 2] and curvatures [W] (0: straight); `lines`: unit normals [W, 2] and offsets [W]
    of their chords; `is_mirror` [W]: which walls to try.
    """
    a, b, bend = walls
    chord = np.hypot(*(b - a).T)
    # half an arc is longer than half its chord by its angle over that angle's sine
    half = 0.5 * chord / np.sinc(np.arcsin(0.5 * bend * chord) / np.pi)
    arcs = a, b, bend, half
    pairs, vertices, gain = _pairs(antenna, point_m, np.flatnonzero(is_mirror), arcs, *lines)
    return pairs, vertices, gain


@compiled(error_model="numpy")
def _pairs(antenna, point, mirrors, arcs, normal, offset):  # type: ignore[no-untyped-def]
    bend = arcs[2]
    pairs, vertices, gain, count = np.empty((16, 3), np.int64), np.empty((16, 3, 3)), np.empty(16, np.complex128), 0
    source = antenna[0], antenna[1]
    for first in mirrors:
        for second in mirrors:
            if first == second or (bend[first] == 0.0 and bend[second] == 0.0):
                continue
            lines = (
                (normal[first, 0], normal[first, 1], offset[first]),
                (normal[second, 0], normal[second, 1], offset[second]),
            )
            image = mirrored(source[0], source[1], lines[0][0], lines[0][1], lines[0][2])
            for target in range(len(point)):
                end = point[target, 0], point[target, 1]
                places, near = _on_chords(image, end, lines, arcs, first, second)
                if not near:
                    continue
                met, where, field = _stationary(source, end, places, arcs, first, second)
                if not met:
                    continue
                if count == len(pairs):
                    pairs, vertices = np.concatenate((pairs, pairs)), np.concatenate((vertices, vertices))
                    gain = np.concatenate((gain, gain))
                (x1, y1), (x2, y2) = where
                l1, l2 = math.hypot(x1 - source[0], y1 - source[1]), math.hypot(x2 - x1, y2 - y1)
                rise = (point[target, 2] - antenna[2]) / (l1 + l2 + math.hypot(end[0] - x2, end[1] - y2))
                pairs[count, 0], pairs[count, 1], pairs[count, 2] = first, second, target
                vertices[count, 0, 0], vertices[count, 0, 1], vertices[count, 0, 2] = x1, y1, antenna[2] + l1 * rise
                vertices[count, 1, 0], vertices[count, 1, 1] = x2, y2
                vertices[count, 1, 2] = antenna[2] + (l1 + l2) * rise
                vertices[count, 2, 0], vertices[count, 2, 1], vertices[count, 2, 2] = end[0], end[1], point[target, 2]
                gain[count] = field
                count += 1
    return pairs[:count], vertices[:count], gain[:count]


@compiled(error_model="numpy")
def _on_chords(image, end, lines, arcs, first, second):  # type: ignore[no-untyped-def]
    """Return places on both chords, as lengths from the middle, and whether they lie on them or not far beside."""
    a, b, _, half = arcs
    (n1x, n1y, o1), (n2x, n2y, o2) = lines
    ex, ey = mirrored(end[0], end[1], n2x, n2y, o2)
    over, beyond = image[0] * n2x + image[1] * n2y + o2, ex * n2x + ey * n2y + o2
    share = over / (over - beyond)
    x2, y2 = image[0] + share * (ex - image[0]), image[1] + share * (ey - image[1])
    over, beyond = image[0] * n1x + image[1] * n1y + o1, x2 * n1x + y2 * n1y + o1
    share = over / (over - beyond)
    x1, y1 = image[0] + share * (x2 - image[0]), image[1] + share * (y2 - image[1])
    s1, s2 = _along(x1, y1, a, b, first), _along(x2, y2, a, b, second)
    near = abs(s1) <= (1.0 + 2.0 * BESIDE) * half[first] and abs(s2) <= (1.0 + 2.0 * BESIDE) * half[second]
    return (s1, s2), near


@compiled(error_model="numpy")
def _along(x, y, a, b, wall):  # type: ignore[no-untyped-def]
    wx, wy = b[wall, 0] - a[wall, 0], b[wall, 1] - a[wall, 1]
    return ((x - 0.5 * (a[wall, 0] + b[wall, 0])) * wx + (y - 0.5 * (a[wall, 1] + b[wall, 1])) * wy) / math.hypot(
        wx, wy
    )


@compiled(error_model="numpy")
def _stationary(source, end, places, arcs, first, second):  # type: ignore[no-untyped-def]
    """Return whether both walls mirror from source to end next to two places, the points, and the gain there."""
    half_1, half_2 = arcs[3][first], arcs[3][second]
    k1, k2 = arcs[2][first], arcs[2][second]
    s1, s2 = places
    none = False, ((0.0, 0.0), (0.0, 0.0)), 0.0j
    for step in range(_STEPS):
        x1, y1, t1x, t1y = _place(arcs, first, s1)
        x2, y2, t2x, t2y = _place(arcs, second, s2)
        l1, l2, l3 = (
            math.hypot(x1 - source[0], y1 - source[1]),
            math.hypot(x1 - x2, y1 - y2),
            math.hypot(x2 - end[0], y2 - end[1]),
        )
        if min(l1, l2, l3) < 1e-6:
            return none
        ux, uy, vx, vy = (x1 - source[0]) / l1, (y1 - source[1]) / l1, (x1 - x2) / l2, (y1 - y2) / l2
        wx, wy = (x2 - end[0]) / l3, (y2 - end[1]) / l3
        # along and across both walls
        u1, v1, v2, w2 = ux * t1x + uy * t1y, vx * t1x + vy * t1y, vx * t2x + vy * t2y, wx * t2x + wy * t2y
        un, vn, vm, wm = uy * t1x - ux * t1y, vy * t1x - vx * t1y, vy * t2x - vx * t2y, wy * t2x - wx * t2y
        g1, g2 = u1 + v1, w2 - v2
        h11 = un * un / l1 + vn * vn / l2 + k1 * (un + vn)
        h22 = wm * wm / l3 + vm * vm / l2 + k2 * (wm - vm)
        h12 = -(t1x * t2x + t1y * t2y - v1 * v2) / l2
        det = h11 * h22 - h12 * h12
        if step > 0 and abs(g1) + abs(g2) < _CLOSE_M:
            break
        if abs(det) < 1e-15:
            return none
        d1, d2 = (h22 * g1 - h12 * g2) / det, (h11 * g2 - h12 * g1) / det
        shrink = min(1.0, half_1 / max(abs(d1), 1e-12), half_2 / max(abs(d2), 1e-12))
        s1, s2 = s1 - shrink * d1, s2 - shrink * d2
    else:
        return none
    # on both walls, and on one side of each
    if abs(s1) > half_1 + _CLOSE_M or abs(s2) > half_2 + _CLOSE_M or un * vn <= 0.0 or vm * wm >= 0.0:
        return none
    spread = det / (un * un * vm * vm) * l1 * l2 * l3 / (l1 + l2 + l3)
    root = 1.0 / math.sqrt(max(abs(spread), LEAST_SPREAD))
    phase = 1j if spread < 0.0 else (-1.0 + 0.0j if h11 < 0.0 else 1.0 + 0.0j)
    return True, ((x1, y1), (x2, y2)), root * phase


@compiled(error_model="numpy")
def _place(arcs, wall, s):  # type: ignore[no-untyped-def]
    """Return the point of a wall at a length from its middle, and the tangent there."""
    a, b, bend, half = arcs
    ux, uy = b[wall, 0] - a[wall, 0], b[wall, 1] - a[wall, 1]
    chord = math.hypot(ux, uy)
    ux, uy = ux / chord, uy / chord
    k, long = bend[wall], half[wall]
    x, y = s, 0.0
    cosine, sine = 1.0, 0.0
    if k != 0.0:
        cosine, sine = math.cos(k * s), math.sin(k * s)
        before, after = 0.5 * k * (long + s), 0.5 * k * (long - s)
        # by the sagitta: no digit is lost to the radius
        x = sine / k
        y = -2.0 / k * math.sin(before) * math.sin(after)
    middle_x, middle_y = 0.5 * (a[wall, 0] + b[wall, 0]), 0.5 * (a[wall, 1] + b[wall, 1])
    return (
        middle_x + x * ux - y * uy,
        middle_y + x * uy + y * ux,
        cosine * ux - sine * uy,
        cosine * uy + sine * ux,
    )
