"""Density clustering of points in the plane (DBSCAN), in metres."""

from __future__ import annotations

import numpy as np
from numba import njit

#: Label of points that belong to no cluster.
NOISE = -1


def dbscan(points_m: np.ndarray, eps_m: float, min_points: int) -> np.ndarray:
    """Cluster labels of points [N, 2], int64 [N]; `NOISE` for points in none.

    A core point has at least `min_points` points within `eps_m`, itself included; core points within `eps_m` of each
    other share a cluster. A point that is not core joins its nearest core point within reach (ties: the first one).
    Clusters are numbered in the order of their first point, so equal input gives equal labels. Raises ValueError
    where a parameter or the shape does not fit.
    """
    points_m = np.asarray(points_m, np.float64)
    if points_m.ndim != 2 or points_m.shape[1] != 2:
        raise ValueError(f"points_m must have shape [N, 2], got {points_m.shape}")
    if not eps_m > 0.0 or min_points < 1:
        raise ValueError(f"eps_m must be positive and min_points at least 1, got {eps_m!r} and {min_points!r}")
    # a copy: of one layout, whatever came, for which the kernel is compiled
    return _clusters(points_m.copy(), float(eps_m), int(min_points))


@njit(cache=True, nogil=True)
def _clusters(points_m: np.ndarray, eps_m: float, min_points: int) -> np.ndarray:
    """Labels of points [N, 2]: core points joined to trees whose root is their first point, then border points."""
    first, second = _near_pairs(points_m, eps_m)
    count = len(points_m)
    neighbours = np.ones(count, np.int64)
    for k in range(len(first)):
        neighbours[first[k]] += 1
        neighbours[second[k]] += 1
    core = neighbours >= min_points
    parent = np.arange(count)
    for k in range(len(first)):
        if core[first[k]] and core[second[k]]:
            one, other = _root(parent, first[k]), _root(parent, second[k])
            parent[max(one, other)] = min(one, other)
    _join_border(points_m, core, parent, first, second)
    return _in_order_of_first_point(parent)


@njit(cache=True, nogil=True)
def _near_pairs(points_m: np.ndarray, eps_m: float) -> tuple[np.ndarray, np.ndarray]:
    """Pairs of points within `eps_m`, found in a sweep along x."""
    order = np.argsort(points_m[:, 0], kind="mergesort")
    first, second = [0 for _ in range(0)], [0 for _ in range(0)]
    for k in range(len(order)):
        i = order[k]
        for m in range(k + 1, len(order)):
            j = order[m]
            dx, dy = points_m[j, 0] - points_m[i, 0], points_m[j, 1] - points_m[i, 1]
            if dx > eps_m:
                break
            if dx * dx + dy * dy <= eps_m * eps_m:
                first.append(i)
                second.append(j)
    return np.array(first, np.int64), np.array(second, np.int64)


@njit(cache=True, nogil=True)
def _root(parent: np.ndarray, i: int) -> int:
    """Root of a point's tree; ways to it are shortened in place."""
    while parent[i] != i:
        parent[i] = parent[parent[i]]
        i = parent[i]
    return i


@njit(cache=True, nogil=True)
def _join_border(
    points_m: np.ndarray, core: np.ndarray, parent: np.ndarray, first: np.ndarray, second: np.ndarray
) -> None:
    """Give each point that is not core its nearest core point for a parent, the first of equals, or `NOISE`."""
    nearest_m = np.full(len(core), np.inf)
    for i in range(len(core)):
        if not core[i]:
            parent[i] = NOISE
    for k in range(len(first)):
        for i, j in ((first[k], second[k]), (second[k], first[k])):
            if core[i] or not core[j]:
                continue
            distance_m = np.sqrt((points_m[i, 0] - points_m[j, 0]) ** 2 + (points_m[i, 1] - points_m[j, 1]) ** 2)
            if distance_m < nearest_m[i] or (distance_m == nearest_m[i] and j < parent[i]):
                parent[i], nearest_m[i] = j, distance_m


@njit(cache=True, nogil=True)
def _in_order_of_first_point(parent: np.ndarray) -> np.ndarray:
    """Labels 0, 1, ... of trees by where they first occur; `NOISE` stays."""
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
    """Whether points [N, 2] fit in a rectangle of some orientation (tried every 5 degrees)."""
    return bool(_fits_box(np.array(points_m, np.float64), float(length_m), float(width_m)))


#: Directions a box is tried in: half a turn of them.
_ANGLES_RAD = np.radians(np.arange(0.0, 180.0, 5.0))
_COS, _SIN = np.cos(_ANGLES_RAD), np.sin(_ANGLES_RAD)


@njit(cache=True, nogil=True)
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
