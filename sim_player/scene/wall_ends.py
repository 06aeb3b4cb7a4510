"""Ends of a scene's walls, and where they meet: the geometry of corners and edges that no motion changes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

#: Ends of walls nearer than this are one.
SAME_END_M = 1e-6
#: So many ends are compared each with each.
FEW_ENDS = 400


@dataclass(frozen=True)
class Corners:
    """C ordered pairs of straight walls that share an end."""

    #: First and second wall, int64 [C, 2].
    pairs: np.ndarray
    #: Of each the apex, unit vectors from there along both walls, and the lengths of both [m]; [C, 8].
    geometry: np.ndarray


@dataclass(frozen=True)
class WallEnds:
    """Both ends of all mirrors, starts first: 2 M ends of M walls."""

    #: Wall, position [2 M, 2], and direction [rad] in which the wall leaves it [2 M].
    wall: np.ndarray
    position: np.ndarray
    face_rad: np.ndarray
    #: Ends that no other meets, and pairs of ends that meet each other alone; int64.
    alone: np.ndarray
    first: np.ndarray
    second: np.ndarray


def corners_of(a: np.ndarray, b: np.ndarray, is_flat: np.ndarray) -> Corners:
    """Return all ordered pairs of straight walls a -> b [W, 2] that share an end."""
    walls = np.tile(np.flatnonzero(is_flat), 2)
    end_1, end_2 = _same(np.concatenate([a[is_flat], b[is_flat]]))
    first, second = walls[end_1], walls[end_2]
    first, second = first[first != second], second[first != second]
    ends = np.stack([a, b], axis=1)
    apart = np.linalg.norm(ends[first][:, :, None] - ends[second][:, None], axis=-1).reshape(-1, 4)
    nearest = np.argmin(apart, axis=1)
    apex = ends[first, nearest // 2]
    along_1, along_2 = ends[first, 1 - nearest // 2] - apex, ends[second, 1 - nearest % 2] - apex
    long_1, long_2 = np.linalg.norm(along_1, axis=1)[:, None], np.linalg.norm(along_2, axis=1)[:, None]
    geometry = np.hstack([apex, along_1 / long_1, along_2 / long_2, long_1, long_2])
    return Corners(np.column_stack([first, second]), geometry)


def share_an_end(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Return which of N pairs of walls, both ends of each [N, 2, 2], share an end; bool [N]."""
    apart = np.linalg.norm(first[:, :, None] - second[:, None], axis=-1)
    return np.asarray((apart <= SAME_END_M).any(axis=(1, 2)))


def wall_ends(a: np.ndarray, b: np.ndarray, curvature_per_m: np.ndarray, is_mirror: np.ndarray) -> WallEnds:
    """Return the ends of all mirrors among walls a -> b [W, 2] of some curvature [W]."""
    chord = (b - a)[is_mirror]
    along = np.arctan2(chord[:, 1], chord[:, 0])
    # an arc leaves its chord by half its turn
    bend = np.arcsin(0.5 * curvature_per_m[is_mirror] * np.hypot(*chord.T))
    position = np.concatenate([a[is_mirror], b[is_mirror]])
    first, second = _same(position)
    meeting = np.bincount(first, minlength=len(position))
    two = (first < second) & (meeting[first] == 2)
    return WallEnds(
        wall=np.tile(np.flatnonzero(is_mirror), 2),
        position=position,
        face_rad=np.concatenate([along - bend, along + np.pi + bend]),
        alone=np.flatnonzero(meeting == 1),
        first=first[two],
        second=second[two],
    )


def _same(ends: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return all pairs of ends [N, 2] that are one, each end with itself too, in order."""
    if len(ends) <= FEW_ENDS:
        apart = ends[:, None] - ends
        first, second = np.nonzero((apart**2).sum(-1) <= SAME_END_M**2)
        return first, second
    # here: a tenth of a second and 10 MiB of every simulated radar
    from scipy.spatial import cKDTree

    every = np.arange(len(ends))
    pairs = cKDTree(ends).query_pairs(SAME_END_M, output_type="ndarray")
    first, second = np.concatenate([np.column_stack([every, every]), pairs, pairs[:, ::-1]]).T
    order = np.lexsort((second, first))
    return first[order], second[order]
