"""Walls out of a dense answer: where a direction first meets a wall, and how the wall is turned there.

A cell's probability, depth beyond the wall's line and direction to it make an element; those that agree grow into
walls.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import expit

from models.compiled import compiled
from msgs.values.array_table import ArrayTable
from msgs.values.perception import Wall
from msgs.values.radar import RangeAzimuthGrid

#: Answers of a cell: logit of a wall, how far beyond its line the cell lies [`BEYOND_M`], cosine and sine of the angle
#: from the ray to the direction of the line's foot.
WALL_ANSWERS = 4
BEYOND_M = 0.5
#: Rays meet walls at most this obliquely.
MAX_INCIDENCE_RAD = math.radians(86.0)
#: So many elements of a map at most, the likeliest: four of each azimuth.
MAX_ELEMENTS = 1024
#: Errors of one element: across the line, and of its direction.
ELEMENT_STD_M, ELEMENT_STD_RAD = 0.15, math.radians(4.0)
#: Elements nearer than this come from the same beams and share their errors.
SHARED_M = 1.0
#: Two walls are one within these: off its line, turned against it, beyond its ends.
SAME_WALL_M, SAME_WALL_COS, SAME_END_M = 0.2, math.cos(math.radians(1.0)), 2.0
#: Least probability of an element.
LEAST = 0.2
#: Elements of a wall lie so near its line, and turn so little against it.
ACROSS_M, TURN_RAD, MAX_GAP_M = 0.4, math.radians(14.0), 3.0
#: Least length, and sum of probabilities, of a wall.
MIN_LENGTH_M, MIN_SUPPORT, MAX_WALLS = 1.0, 2.0, 16


@dataclass(frozen=True)
class WallElements(ArrayTable):
    """Pieces of walls, N of them: position [N, 2], unit vector to the foot of their line [N, 2], probability [N]."""

    place_m: np.ndarray
    toward: np.ndarray
    probability: np.ndarray


def wall_elements(answer: np.ndarray, grid: RangeAzimuthGrid) -> WallElements:
    """Return the likeliest cells along each azimuth as elements, of an answer [`WALL_ANSWERS`, range, azimuth]."""
    logit = answer[0]
    is_peak = logit >= math.log(LEAST / (1.0 - LEAST))
    is_peak[1:] &= logit[1:] > logit[:-1]
    is_peak[:-1] &= logit[:-1] >= logit[1:]
    row, column = np.nonzero(is_peak)
    if len(row) > MAX_ELEMENTS:
        kept = np.sort(np.argsort(-logit[row, column], kind="stable")[:MAX_ELEMENTS])
        row, column = row[kept], column[kept]
    beyond_m = BEYOND_M * answer[1, row, column].astype(np.float64)
    angle_rad = np.arctan2(answer[3, row, column].astype(np.float64), answer[2, row, column].astype(np.float64))
    angle_rad = np.clip(angle_rad, -MAX_INCIDENCE_RAD, MAX_INCIDENCE_RAD)
    azimuth_rad = grid.azimuth_at(column)
    foot_m = np.maximum(grid.range_at(row) * np.cos(angle_rad) - beyond_m, 0.05)
    range_m = foot_m / np.cos(angle_rad)
    place_m = range_m[:, None] * np.stack([np.cos(azimuth_rad), np.sin(azimuth_rad)], axis=1)
    toward_rad = azimuth_rad + angle_rad
    toward = np.stack([np.cos(toward_rad), np.sin(toward_rad)], axis=1)
    return WallElements(place_m, toward, expit(logit[row, column].astype(np.float64)))


def weighed_together(scans: Sequence[WallElements]) -> WallElements:
    """Return the likeliest elements of several scans, each weighed by its share of the scans."""
    joined = WallElements.joined(scans)
    likeliest = np.sort(np.argsort(-joined.probability, kind="stable")[:MAX_ELEMENTS])
    kept = joined.take(likeliest)
    return WallElements(kept.place_m, kept.toward, kept.probability / len(scans))


def grown_walls(elements: WallElements) -> tuple[list[Wall], np.ndarray]:
    """Return the walls that elements form, best supported first, and the wall of each element (-1: none), int64 [N]."""
    table = np.column_stack([elements.place_m, elements.toward, elements.probability])
    limits = (ACROSS_M, math.cos(TURN_RAD), MAX_GAP_M, MIN_LENGTH_M, MIN_SUPPORT)
    rows, wall_of = _grow(table, *limits, MAX_WALLS)
    return [_as_wall(row, int((wall_of == index).sum())) for index, row in enumerate(rows)], wall_of


def _as_wall(row: np.ndarray, elements: int) -> Wall:
    toward_x, toward_y, offset_m, ax, ay, bx, by, angle_std_rad, offset_std_m, curvature = row.tolist()
    return Wall(
        normal=(-toward_x, -toward_y),
        offset_m=offset_m,
        ends_m=((ax, ay), (bx, by)),
        inliers=elements,
        angle_std_rad=angle_std_rad,
        offset_std_m=offset_std_m,
        curvature_per_m=curvature,
    )


def further_walls(grown: Sequence[Wall], known: Sequence[Wall]) -> list[Wall]:
    """Return the walls that are none of the known ones: turned otherwise, off their lines, or beside their ends."""
    return [wall for wall in grown if not any(_is_same(wall, other) for other in known)]


def _is_same(wall: Wall, other: Wall) -> bool:
    a, b = np.array(other.ends_m)
    middle_m = np.mean(wall.ends_m, axis=0)
    length_m = max(float(np.hypot(*(b - a))), 1e-9)
    along_m = float((middle_m - a) @ (b - a)) / length_m
    across_m = abs(float(middle_m @ np.array(other.normal)) + other.offset_m)
    turned = float(np.dot(wall.normal, other.normal))
    return across_m < SAME_WALL_M and turned > SAME_WALL_COS and -SAME_END_M < along_m < length_m + SAME_END_M


@compiled(error_model="numpy")
def _grow(table, across_m, least_cos, max_gap_m, min_length_m, min_support, max_walls):  # type: ignore[no-untyped-def]
    """Return rows (direction to the foot, offset, ends, errors, curvature) of walls, and the wall of each element."""
    count = len(table)
    wall_of = np.full(count, -1, np.int64)
    free = np.ones(count, np.bool_)
    rows = np.zeros((max_walls, 10))
    walls = 0
    own = np.empty(count, np.int64)
    along = np.empty(count)
    # what agrees with the line of each element
    support_of = np.zeros(count)
    for seed in range(count):
        for k in range(count):
            if _agrees(table, k, table[seed, 0], table[seed, 1], table[seed, 2], table[seed, 3], across_m, least_cos):
                support_of[seed] += table[k, 4]
    while walls < max_walls:
        best, most = -1, 0.0
        for seed in range(count):
            if free[seed] and support_of[seed] * table[seed, 4] > most:
                best, most = seed, support_of[seed] * table[seed, 4]
        if best < 0:
            break
        px, py, mx, my = table[best, 0], table[best, 1], table[best, 2], table[best, 3]
        size = 0
        for _ in range(3):
            size = _run(
                table, free, px, py, mx, my, table[best, 0], table[best, 1], across_m, least_cos, max_gap_m, own, along
            )
            if size == 0:
                break
            px, py, mx, my = _line(table, own, size, mx, my)
        if size == 0:
            _take(table, best, free, support_of, across_m, least_cos)
            continue
        support, first, last = 0.0, np.inf, -np.inf
        for k in range(size):
            s = -(table[own[k], 0] - px) * my + (table[own[k], 1] - py) * mx
            first, last = min(first, s), max(last, s)
            support += table[own[k], 4]
        offset = px * mx + py * my
        if last - first >= min_length_m and support >= min_support and offset > 0.3:
            _write(rows, walls, table, own, size, px, py, mx, my, first, last)
            for k in range(size):
                wall_of[own[k]] = walls
            walls += 1
        for k in range(size):
            _take(table, own[k], free, support_of, across_m, least_cos)
        _take(table, best, free, support_of, across_m, least_cos)
    return rows[:walls], wall_of


@compiled(error_model="numpy")
def _take(table, k, free, support_of, across_m, least_cos):  # type: ignore[no-untyped-def]
    """Take a free element out of the support of all others."""
    if not free[k]:
        return
    free[k] = False
    for seed in range(len(table)):
        if _agrees(table, k, table[seed, 0], table[seed, 1], table[seed, 2], table[seed, 3], across_m, least_cos):
            support_of[seed] -= table[k, 4]


@compiled(error_model="numpy")
def _agrees(table, k, px, py, mx, my, across_m, least_cos):  # type: ignore[no-untyped-def]
    dx, dy = table[k, 0] - px, table[k, 1] - py
    # far along a line its direction, known to a few degrees, may carry it further off
    reach = across_m + 0.03 * min(abs(dy * mx - dx * my), 10.0)
    return abs(dx * mx + dy * my) < reach and table[k, 2] * mx + table[k, 3] * my > least_cos


@compiled(error_model="numpy")
def _run(table, free, px, py, mx, my, sx, sy, across_m, least_cos, max_gap_m, own, along):  # type: ignore[no-untyped-def]
    """Write to `own` the agreeing elements that hang together with the place (sx, sy), and return how many."""
    size = 0
    for k in range(len(table)):
        if free[k] and _agrees(table, k, px, py, mx, my, across_m, least_cos):
            own[size] = k
            along[size] = -(table[k, 0] - px) * my + (table[k, 1] - py) * mx
            size += 1
    if size == 0:
        return 0
    order = np.argsort(along[:size])
    start = -(sx - px) * my + (sy - py) * mx
    middle, least = 0, np.inf
    for k in range(size):
        if abs(along[order[k]] - start) < least:
            middle, least = k, abs(along[order[k]] - start)
    low, high = middle, middle
    while low > 0 and along[order[low]] - along[order[low - 1]] <= max_gap_m:
        low -= 1
    while high < size - 1 and along[order[high + 1]] - along[order[high]] <= max_gap_m:
        high += 1
    kept = np.empty(high - low + 1, np.int64)
    for k in range(low, high + 1):
        kept[k - low] = own[order[k]]
    for k in range(len(kept)):
        own[k] = kept[k]
    return len(kept)


@compiled(error_model="numpy")
def _line(table, own, size, mx, my):  # type: ignore[no-untyped-def]
    """Return the middle and direction of the line through elements, by their places and directions together."""
    weight, x, y = 0.0, 0.0, 0.0
    for k in range(size):
        w = table[own[k], 4]
        weight, x, y = weight + w, x + w * table[own[k], 0], y + w * table[own[k], 1]
    x, y = x / weight, y / weight
    # small turn against (mx, my): normal equations of across = turn * along and of the elements' own directions
    information, pull = 1e-9, 0.0
    for k in range(size):
        w = table[own[k], 4]
        dx, dy = table[own[k], 0] - x, table[own[k], 1] - y
        s, across = -dx * my + dy * mx, dx * mx + dy * my
        turned = mx * table[own[k], 3] - my * table[own[k], 2]
        information += w * (s * s / ELEMENT_STD_M**2 + 1.0 / ELEMENT_STD_RAD**2)
        pull += w * (-s * across / ELEMENT_STD_M**2 + turned / ELEMENT_STD_RAD**2)
    turn = pull / information
    c, s = np.cos(turn), np.sin(turn)
    return x, y, c * mx - s * my, s * mx + c * my


@compiled(error_model="numpy")
def _write(rows, at, table, own, size, px, py, mx, my, first, last):  # type: ignore[no-untyped-def]
    """Write the row of a wall of some elements between `first` and `last` along its line."""
    length = last - first
    weight, second, curve, curve_information, residual = 0.0, 0.0, 0.0, 0.0, 0.0
    middle = 0.5 * (first + last)
    for k in range(size):
        w = table[own[k], 4]
        dx, dy = table[own[k], 0] - px, table[own[k], 1] - py
        s = -dx * my + dy * mx
        across = dx * mx + dy * my
        turned = mx * table[own[k], 3] - my * table[own[k], 2]
        weight += w
        second += w * s * s
        residual += w * across * across
        # an arc hollow towards the radar lies (length^2 / 12 - t^2) * curvature / 2 beyond its mean line, and its
        # direction turns by curvature * t
        t = s - middle
        sag = 0.5 * (length * length / 12.0 - t * t)
        curve_information += w * (sag * sag / ELEMENT_STD_M**2 + t * t / ELEMENT_STD_RAD**2)
        curve += w * (sag * across / ELEMENT_STD_M**2 + t * turned / ELEMENT_STD_RAD**2)
    independent = max(min(length / SHARED_M, float(size)), 1.0)
    share = independent / weight
    std = np.sqrt(max(residual / weight, ELEMENT_STD_M**2 / 4.0))
    curvature = curve / max(curve_information, 1e-12)
    sure = curvature * curvature * curve_information * share > 9.0 and length > 3.0
    if not sure or abs(curvature) * length * length < 0.8:
        curvature = 0.0
    curvature = min(max(curvature, -0.2), 0.2)
    if abs(curvature) * length > 1.6:
        curvature = 1.6 / length if curvature > 0.0 else -1.6 / length
    # the chord of an arc lies nearer to the radar than its middle
    shift = -curvature * length * length / 12.0
    cx, cy = px + shift * mx, py + shift * my
    ends = first, last
    for end in range(2):
        rows[at, 3 + 2 * end] = cx - ends[end] * my
        rows[at, 4 + 2 * end] = cy + ends[end] * mx
    rows[at, 0], rows[at, 1] = mx, my
    rows[at, 2] = cx * mx + cy * my
    rows[at, 7] = std / np.sqrt(max(share * second, 1e-6) + (ELEMENT_STD_M / ELEMENT_STD_RAD) ** 2 * independent / 4.0)
    rows[at, 8] = std / np.sqrt(independent)
    rows[at, 9] = curvature
