"""Density clustering of points in the plane (DBSCAN), in metres."""

from __future__ import annotations

import numpy as np

from models.compiled import compiled

#: Label of points that belong to no cluster.
NOISE = -1


def dbscan(points_m: np.ndarray, eps_m: float, min_points: int) -> np.ndarray:
    """Return the cluster labels of points [N, 2], int64 [N]; `NOISE` for points in none; `ValueError` as checked.

    A core point has `min_points` points within `eps_m`, itself included; others join their nearest core point. Clusters
    are numbered in the order of their first point.
    """
    points_m = np.asarray(points_m, np.float64)
    if points_m.ndim != 2 or points_m.shape[1] != 2:
        raise ValueError(f"points_m must have shape [N, 2], got {points_m.shape}")
    if not eps_m > 0.0 or min_points < 1:
        raise ValueError(f"eps_m must be positive and min_points at least 1, got {eps_m!r} and {min_points!r}")
    # copied to the one layout for which the kernel is compiled
    return _clusters(points_m.copy(), float(eps_m), int(min_points))


@compiled
def _clusters(points_m: np.ndarray, eps_m: float, min_points: int) -> np.ndarray:
    """Return the labels of points [N, 2]: trees of core points, then border points; no pair is stored."""
    order = np.argsort(points_m[:, 0], kind="mergesort")
    start, stop = _reach(points_m[order, 0], eps_m)
    core = _core(points_m, eps_m, min_points, order, start, stop)
    parent = np.arange(len(order))
    for k in range(len(order)):
        i = order[k]
        if not core[i]:
            continue
        root = _root(parent, i)
        for m in range(k + 1, stop[k]):
            j = order[m]
            if core[j] and parent[j] != root and _distance2(points_m, i, j) <= eps_m * eps_m:
                other = _root(parent, j)
                parent[max(root, other)] = min(root, other)
                root = min(root, other)
    _join_border(points_m, eps_m, order, start, stop, core, parent)
    return _in_order_of_first_point(parent)


@compiled
def _reach(x_m: np.ndarray, eps_m: float) -> tuple[np.ndarray, np.ndarray]:
    """Return for each of the sorted coordinates [N] the first one within `eps_m` and the first one beyond."""
    start, stop = np.zeros(len(x_m), np.int64), np.empty(len(x_m), np.int64)
    last = 0
    for k in range(len(x_m)):
        while last < len(x_m) and x_m[last] - x_m[k] <= eps_m:
            start[last] = k
            last += 1
        stop[k] = last
    return start, stop


@compiled
def _core(
    points_m: np.ndarray, eps_m: float, min_points: int, order: np.ndarray, start: np.ndarray, stop: np.ndarray
) -> np.ndarray:
    """Return which points have enough others within reach, themselves included; bool [N]."""
    core = np.zeros(len(order), np.bool_)
    for k in range(len(order)):
        count = 0
        for m in range(start[k], stop[k]):
            count += _distance2(points_m, order[k], order[m]) <= eps_m * eps_m
            if count >= min_points:
                core[order[k]] = True
                break
    return core


@compiled
def _distance2(points_m: np.ndarray, i: int, j: int) -> float:
    """Return the square of the distance of two points."""
    dx, dy = points_m[j, 0] - points_m[i, 0], points_m[j, 1] - points_m[i, 1]
    return float(dx * dx + dy * dy)


@compiled
def _root(parent: np.ndarray, i: int) -> int:
    """Return the root of a point's tree; paths to it are shortened in place."""
    while parent[i] != i:
        parent[i] = parent[parent[i]]
        i = parent[i]
    return i


@compiled
def _join_border(
    points_m: np.ndarray,
    eps_m: float,
    order: np.ndarray,
    start: np.ndarray,
    stop: np.ndarray,
    core: np.ndarray,
    parent: np.ndarray,
) -> None:
    """Give each point that is not core its nearest core point for a parent, the first of equals, or `NOISE`."""
    for k in range(len(order)):
        i = order[k]
        if core[i]:
            continue
        parent[i], nearest2 = NOISE, eps_m * eps_m
        for j in order[start[k] : stop[k]]:
            distance2 = _distance2(points_m, i, j)
            first = parent[i] == NOISE or j < parent[i]
            if core[j] and (distance2 < nearest2 or (distance2 == nearest2 and first)):
                parent[i], nearest2 = j, distance2


@compiled
def _in_order_of_first_point(parent: np.ndarray) -> np.ndarray:
    """Return the labels 0, 1, ... of trees by where they first occur; `NOISE` stays."""
    labels, of_root = np.full(len(parent), NOISE), np.full(len(parent), NOISE)
    count = 0
    for i in range(len(parent)):
        if parent[i] == NOISE:
            continue
        root = _root(parent, i)
        if of_root[root] == NOISE:
            of_root[root] = count
            count += 1
        labels[i] = of_root[root]
    return labels


def fits_box(points_m: np.ndarray, length_m: float, width_m: float) -> bool:
    """Return whether points [N, 2] fit in a rectangle of some orientation (tried every 5 degrees)."""
    return bool(_fits_box(np.array(points_m, np.float64), float(length_m), float(width_m)))


#: Directions a box is tried in: half a turn of them.
_ANGLES_RAD = np.radians(np.arange(0.0, 180.0, 5.0))
_COS, _SIN = np.cos(_ANGLES_RAD), np.sin(_ANGLES_RAD)


@compiled
def _fits_box(points_m: np.ndarray, length_m: float, width_m: float) -> bool:
    extent_m = np.empty(len(_COS))
    for k in range(len(_COS)):
        low, high = np.inf, -np.inf
        for i in range(len(points_m)):
            along = points_m[i, 0] * _COS[k] + points_m[i, 1] * _SIN[k]
            low, high = min(low, along), max(high, along)
        extent_m[k] = high - low
    # a quarter turn further on is the extent across
    across_m = np.roll(extent_m, len(_COS) // 2)
    return bool(((extent_m <= length_m) & (across_m <= width_m)).any())
