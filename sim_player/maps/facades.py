"""Facades: the walls of buildings that border open air, each once, whatever a map draws twice, inside or side by side.

A stretch of outline is a wall where no other building lies outside it; of coinciding ones the smallest says its build.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import shapely
from scipy.spatial import cKDTree

#: Corners and edges nearer than this coincide: maps round degrees to a centimetre, and people draw by hand.
TOUCH_M = 0.05
#: A wall faces open air where this far outside it no building stands.
BESIDE_M = 2.0 * TOUCH_M

Ring = np.ndarray


@dataclass(frozen=True)
class Facades:
    """What is left of the rings of buildings."""

    #: Lines of each building's rings that are walls, [points, 2] each; a whole ring is closed.
    lines: tuple[tuple[np.ndarray, ...], ...]
    #: Stretches of outline that border another building, and that another building has too.
    between: int
    twice: int


@dataclass(frozen=True)
class _Edges:
    """Edges of all rings of all buildings, E of them, one ring after another."""

    building: np.ndarray
    ring: np.ndarray
    #: Ends [E, 2]; number of the edge that begins where each ends [E].
    start: np.ndarray
    end: np.ndarray
    following: np.ndarray
    #: Unit vector out of the building, [E, 2].
    outwards: np.ndarray


def facades(buildings: list[list[Ring]]) -> Facades:
    """Return the walls of buildings, each of an outer ring and those of its courtyards, [corners, 2] in metres."""
    if not buildings:
        return Facades((), 0, 0)
    shapes = np.array([shapely.Polygon(rings[0], rings[1:]) for rings in buildings])
    edges = _edges(buildings)
    cuts = _cuts(edges)
    kept, between, twice = _judged(shapes, edges, cuts)
    of_building: list[list[np.ndarray]] = [[] for _ in buildings]
    for ring in range(int(edges.ring[-1]) + 1):
        mine = np.flatnonzero(edges.ring == ring)
        of_building[edges.building[mine[0]]] += _lines(edges, mine, kept)
    return Facades(tuple(map(tuple, of_building)), between, twice)


def _lines(edges: _Edges, ring: np.ndarray, kept: list[list[tuple[float, float]]]) -> list[np.ndarray]:
    """Return the lines that the kept stretches of a ring's edges make, from corner to corner."""
    lines: list[list[np.ndarray]] = []
    open_end = False
    for edge in ring:
        for first, last in kept[edge]:
            start, end = (edges.start[edge] + share * (edges.end - edges.start)[edge] for share in (first, last))
            if open_end and first == 0.0:
                lines[-1].append(end)
            else:
                lines.append([start, end])
            open_end = False
        open_end = bool(kept[edge]) and kept[edge][-1][1] == 1.0
    if len(lines) > 1 and open_end and kept[ring[0]] and kept[ring[0]][0][0] == 0.0:
        lines[0] = [*lines.pop(), *lines[0][1:]]
    lengths = [float(np.hypot(*np.diff(line, axis=0).T).sum()) for line in lines]
    return [np.array(line) for line, length_m in zip(lines, lengths, strict=True) if length_m >= BESIDE_M]


def _edges(buildings: list[list[Ring]]) -> _Edges:
    """Return all edges."""
    rings = [np.asarray(ring, np.float64) for own in buildings for ring in own]
    building = np.repeat(np.arange(len(buildings)), [len(own) for own in buildings])
    hole = np.concatenate([np.arange(len(own)) > 0 for own in buildings])
    corners = np.concatenate(rings)
    first = np.concatenate([[0], np.cumsum([len(ring) for ring in rings])])
    following = np.concatenate([np.roll(np.arange(a, b), -1) for a, b in pairwise(first)])
    of_ring = np.repeat(np.arange(len(rings)), np.diff(first))
    along = corners[following] - corners
    area = np.array(
        [np.sum(ring[:, 0] * np.roll(ring[:, 1], -1) - ring[:, 1] * np.roll(ring[:, 0], -1)) for ring in rings]
    )
    # right of a ring that turns left, but into its courtyard
    side = np.where((area > 0.0) ^ hole, 1.0, -1.0)[of_ring]
    normal = np.column_stack([along[:, 1], -along[:, 0]]) / np.hypot(*along.T)[:, None]
    return _Edges(
        building=building[of_ring],
        ring=of_ring,
        start=corners,
        end=corners[following],
        following=following,
        outwards=normal * side[:, None],
    )


def _cuts(edges: _Edges) -> list[list[tuple[float, int]]]:
    """Return where each edge is cut, shares and nodes: its ends, corners of others on it, and crossings."""
    lines = shapely.linestrings(np.stack([edges.start, edges.end], axis=1))
    tree = shapely.STRtree(lines)
    along = edges.end - edges.start
    length_m = np.hypot(*along.T)
    first, second = tree.query(lines, predicate="crosses")
    turn = along[first, 0] * along[second, 1] - along[first, 1] * along[second, 0]
    # edges side by side cross by their rounding alone
    apart = np.abs(turn) > BESIDE_M * np.maximum(length_m[first], length_m[second])
    crosses = apart & (edges.building[first] != edges.building[second])
    first, second = first[crosses], second[crosses]
    gap = edges.start[second] - edges.start[first]
    share = (gap[:, 0] * along[second, 1] - gap[:, 1] * along[second, 0]) / turn[crosses]
    node = _coinciding(np.concatenate([edges.start, edges.start[first] + share[:, None] * along[first]]))
    corner, edge = tree.query(shapely.points(edges.start), predicate="dwithin", distance=TOUCH_M)
    foreign = edges.building[corner] != edges.building[edge]
    corner, edge = corner[foreign], edge[foreign]
    reach = np.einsum("ni,ni->n", edges.start[corner] - edges.start[edge], along[edge]) / length_m[edge] ** 2
    cuts = [[(0.0, int(node[at])), (1.0, int(node[to]))] for at, to in enumerate(edges.following)]
    for line, at, number in zip(
        [*edge, *first], [*reach, *share], [*node[corner], *node[len(edges.start) :]], strict=True
    ):
        # one cut is enough for what coincides
        near = any(known == number or abs(at - there) * length_m[line] < TOUCH_M for there, known in cuts[line])
        if 0.0 < at < 1.0 and not near:
            cuts[line].append((float(at), int(number)))
    return [sorted(own) for own in cuts]


def _coinciding(points: np.ndarray) -> np.ndarray:
    """Return a number for each point [N], that of the first point which it coincides with."""
    number = np.arange(len(points))
    pairs = cKDTree(points).query_pairs(TOUCH_M, output_type="ndarray")
    for low, high in pairs[np.lexsort((pairs[:, 0], pairs[:, 1]))]:
        number[high] = min(number[high], number[low])
    return number


def _judged(
    shapes: np.ndarray, edges: _Edges, cuts: list[list[tuple[float, int]]]
) -> tuple[list[list[tuple[float, float]]], int, int]:
    """Return the stretches of each edge that are walls, as shares, and how many border or repeat another building."""
    count = np.array([len(own) - 1 for own in cuts])
    edge = np.repeat(np.arange(len(cuts)), count)
    span = np.array([(a[0], b[0]) for own in cuts for a, b in pairwise(own)])
    nodes = [frozenset((a[1], b[1])) for own in cuts for a, b in pairwise(own)]
    middle = edges.start[edge] + span.mean(axis=1)[:, None] * (edges.end - edges.start)[edge]
    beside = shapely.points(middle + BESIDE_M * edges.outwards[edge])
    piece, shape = shapely.STRtree(shapes).query(beside, predicate="intersects")
    covered = np.zeros(len(edge), bool)
    covered[piece[shape != edges.building[edge[piece]]]] = True
    area = np.array([each.area for each in shapes]).round(3)
    kept: list[list[tuple[float, float]]] = [[] for _ in cuts]
    drawn: set[frozenset[int]] = set()
    twice = 0
    for index in np.lexsort((np.arange(len(edge)), area[edges.building[edge]])):
        if covered[index]:
            continue
        if nodes[index] in drawn:
            twice += 1
            continue
        drawn.add(nodes[index])
        kept[edge[index]].append((float(span[index, 0]), float(span[index, 1])))
    return [_joined(sorted(own)) for own in kept], int(covered.sum()), twice


def _joined(stretches: list[tuple[float, float]]) -> list[tuple[float, float]]:
    """Return stretches of an edge, those that follow each other as one."""
    joined: list[tuple[float, float]] = []
    for first, last in stretches:
        if joined and joined[-1][1] == first:
            first = joined.pop()[0]
        joined.append((first, last))
    return joined
