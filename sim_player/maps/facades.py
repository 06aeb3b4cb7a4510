"""Facades: the walls of buildings that border open air, each once, whatever a map draws twice, inside or side by side.

One rule: a stretch of outline is a wall where no other building lies outside it. So walls between neighbours, walls of
what stands inside another building, and outlines with the parts that fill them come to their outer walls. Of outlines
that coincide the smallest building, a part, says what its wall is made of; of equal ones the first.
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
    #: Ends [E, 2], numbers of the nodes there [E].
    start: np.ndarray
    end: np.ndarray
    start_node: np.ndarray
    end_node: np.ndarray
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
    """Return all edges, corners that coincide with those of a building before as one node."""
    rings = [np.asarray(ring, np.float64) for own in buildings for ring in own]
    building = np.repeat(np.arange(len(buildings)), [len(own) for own in buildings])
    hole = np.concatenate([np.arange(len(own)) > 0 for own in buildings])
    corners = np.concatenate(rings)
    node = np.arange(len(corners))
    pairs = cKDTree(corners).query_pairs(TOUCH_M, output_type="ndarray")
    for low, high in pairs[np.lexsort((pairs[:, 0], pairs[:, 1]))]:
        node[high] = min(node[high], node[low])
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
        start_node=node,
        end_node=node[following],
        outwards=normal * side[:, None],
    )


def _cuts(edges: _Edges) -> list[list[tuple[float, int]]]:
    """Return where each edge is cut: shares of it and nodes, its ends among them; by corners of others that lie on it
    and by edges of others that cross it.
    """
    cuts: list[list[tuple[float, int]]] = [
        [(0.0, int(a)), (1.0, int(b))] for a, b in zip(edges.start_node, edges.end_node, strict=True)
    ]
    lines = shapely.linestrings(np.stack([edges.start, edges.end], axis=1))
    tree = shapely.STRtree(lines)
    length = np.hypot(*(edges.end - edges.start).T)
    corner, edge = tree.query(shapely.points(edges.start), predicate="dwithin", distance=TOUCH_M)
    others = edges.building[corner] != edges.building[edge]
    for point, line in zip(corner[others], edge[others], strict=True):
        along = edges.end[line] - edges.start[line]
        _cut(
            cuts[line],
            float((edges.start[point] - edges.start[line]) @ along) / length[line] ** 2,
            int(edges.start_node[point]),
            length[line],
        )
    first, second = tree.query(lines, predicate="crosses")
    ahead = (first < second) & (edges.building[first] != edges.building[second])
    for number, (one, two) in enumerate(zip(first[ahead], second[ahead], strict=True)):
        u, v = edges.end[one] - edges.start[one], edges.end[two] - edges.start[two]
        turn = float(u[0] * v[1] - u[1] * v[0])
        # edges side by side cross by their rounding alone
        if abs(turn) / max(length[one], length[two]) < BESIDE_M:
            continue
        gap = edges.start[two] - edges.start[one]
        for line, share in (
            (one, (gap[0] * v[1] - gap[1] * v[0]) / turn),
            (two, (gap[0] * u[1] - gap[1] * u[0]) / turn),
        ):
            _cut(cuts[line], float(share), -1 - number, length[line])
    return [sorted(own) for own in cuts]


def _cut(cuts: list[tuple[float, int]], share: float, node: int, length_m: float) -> None:
    """Add a cut unless one is there already, by its node or by its place."""
    near = any(known == node or abs(share - at) * length_m < TOUCH_M for at, known in cuts)
    if 0.0 < share < 1.0 and not near:
        cuts.append((share, node))


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
    seen: set[frozenset[int]] = set()
    twice = 0
    for index in np.lexsort((np.arange(len(edge)), area[edges.building[edge]])):
        if covered[index]:
            continue
        if nodes[index] in seen:
            twice += 1
            continue
        seen.add(nodes[index])
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
