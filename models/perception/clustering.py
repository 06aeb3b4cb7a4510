"""Density clustering of points in the plane (DBSCAN), in metres."""

from __future__ import annotations

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

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
    count = len(points_m)
    labels = np.full(count, NOISE, np.int64)
    if count == 0:
        return labels
    pairs = cKDTree(points_m).query_pairs(eps_m, output_type="ndarray")
    core = 1 + np.bincount(pairs.ravel(), minlength=count) >= min_points
    joined = pairs[core[pairs].all(axis=1)]
    graph = coo_array((np.ones(len(joined), np.int8), (joined[:, 0], joined[:, 1])), shape=(count, count))
    _, component = connected_components(graph, directed=False)
    labels[core] = component[core]
    _join_border(points_m, core, labels, eps_m)
    return _in_order_of_first_point(labels)


def _join_border(points_m: np.ndarray, core: np.ndarray, labels: np.ndarray, eps_m: float) -> None:
    """Give each point that is not core the label of its nearest core point within reach, in place."""
    cores, border = np.flatnonzero(core), np.flatnonzero(~core)
    if len(cores) == 0 or len(border) == 0:
        return
    distance_m = np.linalg.norm(points_m[border, None] - points_m[None, cores], axis=-1)  # [border, cores]
    nearest = distance_m.argmin(axis=1)
    reached = distance_m[np.arange(len(border)), nearest] <= eps_m
    labels[border[reached]] = labels[cores[nearest[reached]]]


def _in_order_of_first_point(labels: np.ndarray) -> np.ndarray:
    """Renumber labels 0, 1, ... by where they first occur; `NOISE` stays."""
    seen, first = np.unique(labels[labels != NOISE], return_index=True)
    order = np.empty(len(seen), np.int64)
    order[np.argsort(first)] = np.arange(len(seen))
    out = np.full(len(labels), NOISE, np.int64)
    out[labels != NOISE] = order[np.searchsorted(seen, labels[labels != NOISE])]
    return out


def fits_box(points_m: np.ndarray, length_m: float, width_m: float) -> bool:
    """Whether points [N, 2] fit in a rectangle of some orientation (tried every 5 degrees)."""
    angle_rad = np.radians(np.arange(0.0, 180.0, 5.0))
    along = points_m @ np.stack([np.cos(angle_rad), np.sin(angle_rad)])  # [N, angles]
    extent_m = np.ptp(along, axis=0)
    # a quarter turn further on is the extent across
    across_m = np.roll(extent_m, len(angle_rad) // 2)
    return bool(((extent_m <= length_m) & (across_m <= width_m)).any())
