"""Ends of a scene's walls, and where they meet: the geometry of corners and edges that no motion changes."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from models.compiled import compiled

#: Ends of walls nearer than this are one.
SAME_END_M = 1e-6
#: Ends nearer than this meet in one node, an end so near to another wall stands against it, and walls so near are one.
NODE_M = 1e-3
#: Rounding of ends that are one.
ALIKE_M = 1e-5
#: So many ends are compared each with each.
FEW_ENDS = 400


@dataclass(frozen=True)
class Corners:
    """C ordered pairs of walls that share an end."""

    #: First and second wall, int64 [C, 2].
    pairs: np.ndarray
    #: Of each the apex, unit vectors from there along both walls, the lengths of both [m], and how both bend to the
    #: left of those vectors [1/m]; [C, 10].
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


@dataclass(frozen=True)
class EndNodes:
    """N places at which walls end, and the F faces that leave them, counter-clockwise by node."""

    #: Position [N, 2], where its faces begin [N + 1], the first of its ends (twice the wall, plus one for its b) [N].
    position: np.ndarray
    start: np.ndarray
    end: np.ndarray
    #: How far from a node something of its own may stand before it as seen from anywhere, [N].
    slack_m: np.ndarray
    #: Wall, direction [rad], and curvature of each face (positive: its centre lies to the left), [F].
    wall: np.ndarray
    face_rad: np.ndarray
    curvature_per_m: np.ndarray
    #: Node and direction [rad] of each wall's ends a and b, [W, 2]; -1 of what is no mirror.
    node_of: np.ndarray
    face_rad_of: np.ndarray

    @property
    def arrays(self) -> tuple[np.ndarray, ...]:
        """The same as compiled code takes it."""
        return self.position, self.start, self.slack_m, self.wall, self.face_rad, self.curvature_per_m


def corners_of(a: np.ndarray, b: np.ndarray, curvature_per_m: np.ndarray, is_mirror: np.ndarray) -> Corners:
    """Return all ordered pairs of mirrors among walls a -> b [W, 2] of some curvature [W] that share an end."""
    walls = np.tile(np.flatnonzero(is_mirror), 2)
    end_1, end_2 = _same(np.concatenate([a[is_mirror], b[is_mirror]]))
    first, second = walls[end_1], walls[end_2]
    first, second = first[first != second], second[first != second]
    ends = np.stack([a, b], axis=1)
    apart = np.linalg.norm(ends[first][:, :, None] - ends[second][:, None], axis=-1).reshape(-1, 4)
    nearest = np.argmin(apart, axis=1)
    apex = ends[first, nearest // 2]
    along_1, along_2 = ends[first, 1 - nearest // 2] - apex, ends[second, 1 - nearest % 2] - apex
    long_1, long_2 = np.linalg.norm(along_1, axis=1)[:, None], np.linalg.norm(along_2, axis=1)[:, None]
    # from the far end on, left is right
    bend_1 = np.where(nearest // 2 == 0, curvature_per_m[first], -curvature_per_m[first])[:, None]
    bend_2 = np.where(nearest % 2 == 0, curvature_per_m[second], -curvature_per_m[second])[:, None]
    towards_1, towards_2 = _turned(along_1 / long_1, bend_1 * long_1), _turned(along_2 / long_2, bend_2 * long_2)
    geometry = np.hstack([apex, towards_1, towards_2, long_1, long_2, bend_1, bend_2])
    return Corners(np.column_stack([first, second]), geometry)


def _turned(along: np.ndarray, turn: np.ndarray) -> np.ndarray:
    """Return the tangents [N, 2] at the starts of arcs of unit chords [N, 2] and curvatures times chords [N, 1]."""
    sine = -0.5 * turn
    cosine = np.sqrt(1.0 - sine * sine)
    return np.hstack([cosine * along[:, :1] - sine * along[:, 1:], cosine * along[:, 1:] + sine * along[:, :1]])


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


def end_nodes(a: np.ndarray, b: np.ndarray, curvature_per_m: np.ndarray, is_mirror: np.ndarray) -> EndNodes:
    """Return where the mirrors among walls a -> b [W, 2] end, alone, together or on another, which has two faces."""
    along = np.arctan2(*(b - a).T[::-1])
    bend = np.arcsin(np.clip(0.5 * curvature_per_m * np.hypot(*(b - a).T), -1.0, 1.0))
    face_rad = np.column_stack([along - bend, along + np.pi + bend]) % (2.0 * np.pi)
    straight = is_mirror & (curvature_per_m == 0.0)
    node_of, first, slack_m, node, wall, end = _nodes(np.stack([a, b], axis=1), is_mirror, straight)
    # past an end: one face as at its own a, one as at its own b
    rad = face_rad[wall, end]
    order = np.lexsort((rad, node))
    node, wall, end = node[order], wall[order], end[order]
    return EndNodes(
        position=np.stack([a, b], axis=1)[first // 2, first % 2],
        start=np.searchsorted(node, np.arange(len(first) + 1)),
        end=first,
        slack_m=slack_m,
        wall=wall,
        face_rad=rad[order],
        curvature_per_m=np.where(end == 0, 1.0, -1.0) * curvature_per_m[wall],
        node_of=node_of,
        face_rad_of=face_rad,
    )


@compiled(error_model="numpy")
def _nodes(ends, is_mirror, straight):  # type: ignore[no-untyped-def]
    """Return the node of each end [W, 2], first end and slack of each node, and node, wall and end of all faces."""
    walls = len(ends)
    slack_m = [0.0 for _ in range(0)]
    node_of, first = np.full((walls, 2), -1), [0 for _ in range(0)]
    node, wall, end = [0 for _ in range(0)], [0 for _ in range(0)], [0 for _ in range(0)]
    for index in range(2 * walls):
        w, side = index // 2, index % 2
        if not is_mirror[w] or node_of[w, side] >= 0:
            continue
        x, y = ends[w, side]
        off = 0.0
        for v in range(walls):
            if not is_mirror[v]:
                continue
            ax, ay, bx, by = ends[v, 0, 0] - x, ends[v, 0, 1] - y, ends[v, 1, 0] - x, ends[v, 1, 1] - y
            if min(ax, bx) > NODE_M or max(ax, bx) < -NODE_M or min(ay, by) > NODE_M or max(ay, by) < -NODE_M:
                continue
            at_a, at_b = math.hypot(ax, ay), math.hypot(bx, by)
            wx, wy = bx - ax, by - ay
            beside = abs(ax * wy - ay * wx) / math.hypot(wx, wy)
            within = ax * wx + ay * wy < 0.0 and bx * wx + by * wy > 0.0 and min(at_a, at_b) > NODE_M
            passes = straight[v] and beside <= NODE_M and within
            off = max(off, beside if passes else 0.0)
            for at, far in ((0, at_a), (1, at_b)):
                meets = node_of[v, at] < 0 and far <= NODE_M
                if meets:
                    off = max(off, far)
                    node_of[v, at] = len(first)
                if meets or passes:
                    node.append(len(first))
                    wall.append(v)
                    end.append(at)
        first.append(index)
        slack_m.append(2.0 * off + ALIKE_M)
    return node_of, np.array(first), np.array(slack_m), np.array(node), np.array(wall), np.array(end)


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
