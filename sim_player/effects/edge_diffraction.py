"""Walls' ends and corners bend what passes them: shadows get soft borders, and weak echoes reach behind the corner.

Upright edges by the uniform theory (`models.physics.diffraction`): a free end is a half plane that lets through and
reflects what its wall does, a corner that points at the radar a wedge. One bend on one or both ways, by the same edge.
Left out: the walls' top edges, joints of materials in one plane, corners that open towards the radar and places where
more than two walls meet, bends before or after a mirror, the faces' roughness, edges of vehicles.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from models.physics.diffraction import edge_field, wedge_terms
from msgs.values.array_table import ArrayTable
from sim_player.effects.names import bit
from sim_player.scene.world import Snapshot, World
from sim_player.trace.echoes import Echoes, cofocal, join_echoes, object_echoes, same_target
from sim_player.trace.routes import Routes, join_routes, make_routes, norm
from sim_player.trace.segments import Occlusion, free_segments, transmission_factor
from sim_player.trace.snapshot import TraceContext

#: Corners whose walls turn by less than this are no edge (window panes in one plane).
LEAST_TURN_RAD = 0.05
#: Points nearer than this to an edge's faces or to the edge itself are on the wall, not beside it.
NEAREST_EDGE_M = 0.05
#: Ends of walls nearer than this are one edge.
SAME_END_M = 1e-6


@dataclass(frozen=True)
class Edges(ArrayTable):
    """E upright edges."""

    #: Place in the plane, [E, 2], and the pieces of wall of the first and the last face (a free end: the same), [E].
    point: np.ndarray
    first: np.ndarray
    last: np.ndarray
    #: Direction of the first face from the edge [rad], sense in which the air is turned through (+1: left), [E].
    face_rad: np.ndarray
    sense: np.ndarray
    #: Exterior angle / pi.
    n: np.ndarray
    height_m: np.ndarray

    def __len__(self) -> int:
        return len(self.n)


def absent(world: World) -> str | None:
    """An edge and an object."""
    if not len(world.centre_m):
        return "the scene holds no object"
    return None if world.is_mirror.any() else "the scene holds no wall: there is no edge"


def apply(tracing: TraceContext) -> Echoes:
    """Echoes with one bend (out or back, the other way clear) and with two (out and back by the same edge)."""
    view = tracing.view
    bent = edge_routes(view, view.centre, tracing.owner)
    tracing.routes["edge_diffraction"] = bent
    clear = tracing.clear_routes("los_objects", "specular_relay", "curved_wall", "second_relay")
    first, second = same_target(bent.target, clear.target)
    both = join_routes([bent, clear])
    mixed = object_echoes(view, both, (first, second + len(bent)), bit("edge_diffraction"))
    return join_echoes([object_echoes(view, bent, cofocal(bent), bit("edge_diffraction")), mixed])


def edge_routes(view: Snapshot, point_m: np.ndarray, owner: np.ndarray) -> Routes:
    """Routes antenna -> edge -> points [N, 3] whose legs are free and on the edge's open side."""
    edges = _in_sight(view, edges_of(view), point_m)
    edge, target = (grid.ravel() for grid in np.meshgrid(np.arange(len(edges)), np.arange(len(point_m)), indexing="ij"))
    source_plan = norm(edges.point - view.origin)[edge]
    target_plan = norm(point_m[target, :2] - edges.point[edge])
    # the ray meets the edge where heights are in proportion to the plan lengths (Keller's cone)
    share = source_plan / (source_plan + target_plan)
    height = view.antenna[2] + share * (point_m[target, 2] - view.antenna[2])
    wide = edges.n[edge] * np.pi
    to_source, to_target = _angle(edges, view.origin[None])[edge], _angle(edges.take(edge), point_m[target, :2])
    open_side = (to_source < wide) & (to_target < wide) & (height < edges.height_m[edge])
    keep = np.flatnonzero(open_side & (source_plan > NEAREST_EDGE_M) & (target_plan > NEAREST_EDGE_M))
    edge, target = edge[keep], target[keep]
    bend = np.column_stack([edges.point[edge], height[keep]])
    occlusion = free_segments((view.antenna, bend, point_m[target]), view.blockers, owner[target])
    free = np.flatnonzero(occlusion.free)
    keep, edge, target = keep[free], edge[free], target[free]
    angles = to_source[keep], to_target[keep]
    return _bent(view, edges.take(edge), edge, target, (bend[free], point_m[target]), angles, occlusion.take(free))


def _in_sight(view: Snapshot, edges: Edges, point_m: np.ndarray) -> Edges:
    """The edges that the antenna sees at the greatest height at which a ray to any point may meet them."""
    top = np.full(len(edges), max(view.antenna[2], point_m[:, 2].max(initial=0.0)))
    return edges.take(free_segments((view.antenna, np.column_stack([edges.point, top])), view.blockers).free)


def _bent(
    view: Snapshot,
    edges: Edges,
    edge: np.ndarray,
    target: np.ndarray,
    points: tuple[np.ndarray, np.ndarray],
    angles: tuple[np.ndarray, np.ndarray],
    occlusion: Occlusion,
) -> Routes:
    """Routes by known points of edges (one a route) with their uniform field."""
    (bend, end), (to_source, to_target) = points, angles
    out, on = bend - view.antenna, end - bend
    source_m, target_m = norm(out), norm(on)
    skew = norm(out[:, :2]) / source_m
    distance = source_m * target_m * skew**2 / (source_m + target_m)
    incident, *faces = wedge_terms(edges.n, to_source, to_target, distance, view.world.radar.wavelength_m, skew)
    wide = edges.n * np.pi
    # the more grazing of both rays: the mirror's own angle at its border, no field along a face, alike both ways
    cosine = [np.minimum(*np.abs(np.sin([turn - to_source, turn - to_target]))) * skew for turn in (0.0, wide)]
    passed = np.where(
        edges.first == edges.last, transmission_factor(view.world.transmission, edges.first, cosine[0]), 0.0
    )
    built, front = ((1.0 - passed) * incident for _ in range(2))
    for wall, angle, face in zip((edges.first, edges.last), cosine, faces, strict=True):
        of_wall, of_front, _ = view.world.reflection(wall, angle)
        built, front = built + of_wall * face, front + of_front * face
    return make_routes(
        target,
        source_m + target_m,
        out / source_m[:, None],
        on / target_m[:, None],
        occlusion,
        bit("edge_diffraction"),
        edge=edge,
        whole=edge_field(built, source_m, target_m),
        front=edge_field(front, source_m, target_m),
    )


def edges_of(view: Snapshot) -> Edges:
    """Free ends of walls, and corners of two walls whose open side is wider than a half turn and faces the radar."""
    world = view.world
    wall = np.tile(np.flatnonzero(world.is_mirror), 2)
    point, face = _ends(world)
    same = norm(point[:, None] - point[None]) < SAME_END_M
    alone = np.flatnonzero(same.sum(axis=1) == 1)
    end_1, end_2 = np.nonzero(np.triu(same, 1) & (same.sum(axis=1) == 2)[:, None])
    towards = np.arctan2(*(view.origin - point[end_1]).T[::-1])
    left = (face[end_2] - face[end_1]) % (2.0 * np.pi)
    # the radar stands on one side of the corner: the air is the turn that holds it
    is_left = (towards - face[end_1]) % (2.0 * np.pi) < left
    turn = np.where(is_left, left, 2.0 * np.pi - left)
    corner = turn > np.pi + LEAST_TURN_RAD
    end_1, end_2, turn, is_left = end_1[corner], end_2[corner], turn[corner], is_left[corner]
    first, last = np.concatenate([alone, end_1]), np.concatenate([alone, end_2])
    return Edges(
        point=point[first],
        first=wall[first],
        last=wall[last],
        face_rad=face[first],
        sense=np.concatenate([np.ones(len(alone)), np.where(is_left, 1.0, -1.0)]),
        n=np.concatenate([np.full(len(alone), 2.0), turn / np.pi]),
        height_m=np.minimum(world.wall_height_m[wall[first]], world.wall_height_m[wall[last]]),
    )


def _ends(world: World) -> tuple[np.ndarray, np.ndarray]:
    """Both ends of all walls, starts first: places [2 W, 2] and the direction [rad] in which the wall leaves them."""
    a, b = world.wall_a[world.is_mirror], world.wall_b[world.is_mirror]
    chord = b - a
    along = np.arctan2(chord[:, 1], chord[:, 0])
    # an arc leaves its chord by half its turn
    bend = np.arcsin(0.5 * world.wall_curvature_per_m[world.is_mirror] * np.hypot(*chord.T))
    return np.concatenate([a, b]), np.concatenate([along - bend, along + np.pi + bend])


def _angle(edges: Edges, point: np.ndarray) -> np.ndarray:
    """Angle of points around edges (one each) from the first face through the air, 0..2 pi."""
    offset = point - edges.point
    turn = edges.sense * (np.arctan2(offset[:, 1], offset[:, 0]) - edges.face_rad)
    return np.asarray(turn % (2.0 * np.pi))
