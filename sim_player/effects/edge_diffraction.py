"""Walls' ends and corners bend what passes them: shadows get soft borders, and weak echoes reach behind the corner.

Upright edges by the uniform theory (`models.physics.diffraction`): a free end is a half plane that lets through and
reflects what its wall does, a corner that points at the radar a wedge. One bend on one or both ways, by the same edge.
Left out: the walls' top edges, joints of materials in one plane, corners that open towards the radar and places where
more than two walls meet, the faces' roughness, edges of vehicles. Bends before or after a mirror have their own file.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from models.compiled import compiled
from models.physics.diffraction import wedge_terms_at
from msgs.values.array_table import ArrayTable
from sim_player.effects.names import bit
from sim_player.scene.world import Snapshot, World
from sim_player.trace.bounce import bounce
from sim_player.trace.echoes import Echoes, cofocal, join_echoes, object_echoes, same_target
from sim_player.trace.routes import ROUTE, Routes, direction_of, fill_route, grown, join_routes, owners
from sim_player.trace.segments import clear_series, crossing_factor, is_screened, passage
from sim_player.trace.snapshot import TraceContext

#: Corners whose walls turn by less than this are no edge (window panes in one plane).
LEAST_TURN_RAD = 0.05
#: Points nearer than this to an edge's faces or to the edge itself are on the wall, not beside it.
NEAREST_EDGE_M = 0.05
_BENT = bit("edge_diffraction")
#: A line that all of the plan is on the positive side of: unit normal and offset.
EVERYWHERE = 0.0, 0.0, 1.0


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
    #: The same number for the same edge from everywhere: by the end of the first face's wall in the whole world.
    number: np.ndarray

    def __len__(self) -> int:
        return len(self.n)

    @cached_property
    def table(self) -> np.ndarray:
        """The same as numbers, [E, 8], for compiled code."""
        return np.column_stack(
            [self.point, self.first, self.last, self.face_rad, self.sense, self.n, self.height_m]
        ).astype(np.float64)


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
    edges = edges_of(view)
    world = view.world
    scene = world.builds, (world.transmission, world.wall_build), view.blockers.pieces, world.radar.wavelength_m
    routes = Routes(_edge_routes(view.antenna, point_m, owners(owner, len(point_m)), edges.table, scene))
    return routes.with_columns(edge=edges.number[routes.edge])


@compiled(error_model="numpy")
def _edge_routes(antenna, point, owner, edges, scene):  # type: ignore[no-untyped-def]
    pieces = scene[2]
    rows, count = np.empty(len(point), ROUTE), 0
    start = antenna[0], antenna[1], antenna[2]
    groups, low, top = point_groups(point, owner, start[2])
    for e in range(len(edges)):
        x, y, _, _, face_rad, sense, n_half, height = edges[e]
        source_plan = math.hypot(x - start[0], y - start[1])
        to_source = turn_from_face(start[0] - x, start[1] - y, face_rad, sense)
        if to_source >= n_half * np.pi or source_plan <= NEAREST_EDGE_M:
            continue
        # seen at the greatest height at which a ray to any point may meet it
        if not passage(start, (x, y, top), -1, pieces, True)[0]:
            continue
        # where the lowest ray meets nothing on its way, none does
        free, _, foliage = passage(start, (x, y, low), -1, pieces, True)
        is_open = free and foliage == 1.0
        for group in groups:
            # one wall may hide all of an object
            circle = group[0], group[1], group[2]
            if is_screened((x, y), circle, ((x, y), (group[0], group[1])), top, EVERYWHERE, pieces):
                continue
            for n in range(int(group[3]), int(group[4])):
                end = point[n, 0], point[n, 1], point[n, 2]
                target_plan = math.hypot(end[0] - x, end[1] - y)
                if target_plan <= NEAREST_EDGE_M:
                    continue
                # the ray meets the edge where heights are in proportion to the plan lengths (Keller's cone)
                bend = x, y, start[2] + source_plan / (source_plan + target_plan) * (end[2] - start[2])
                to_target = turn_from_face(end[0] - x, end[1] - y, face_rad, sense)
                if to_target >= n_half * np.pi or bend[2] >= height:
                    continue
                before = 1.0 if is_open else clear_series((start, bend), -1, pieces)
                behind = clear_series((bend, end), owner[n], pieces) if before >= 0.0 else -1.0
                if behind < 0.0:
                    continue
                leaves = before * behind
                if count == len(rows):
                    rows = grown(rows)
                row = rows[count]
                count += 1
                depart, source_m = direction_of(start, bend)
                arrive, target_m = direction_of(bend, end)
                fill_route(row, n, source_m + target_m, depart, arrive, _BENT)
                row.edge, row.foliage = e, leaves
                row.whole, row.front = bend_field(
                    edges[e], (to_source, to_target), (source_m, target_m), source_plan, scene
                )
    return rows[:count]


@compiled(error_model="numpy")
def point_groups(point, owner, height):  # type: ignore[no-untyped-def]
    """Return circles around the points of each object, [G, 5]: place, radius, first and last point; heights' span."""
    groups, count, first = np.empty((len(point), 5)), 0, 0
    for n in range(len(point)):
        if n + 1 < len(point) and owner[n + 1] == owner[n]:
            continue
        x, y, radius = point[first : n + 1, 0].mean(), point[first : n + 1, 1].mean(), 0.0
        for m in range(first, n + 1):
            radius = max(radius, math.hypot(point[m, 0] - x, point[m, 1] - y))
        groups[count] = x, y, radius + 1e-6, float(first), float(n + 1)
        count, first = count + 1, n + 1
    low, top = height_span(height, point)
    return groups[:count], low, top


@compiled(error_model="numpy")
def height_span(height, point):  # type: ignore[no-untyped-def]
    """Return the least and the greatest of a height and those of points [N, 3]."""
    low = top = height
    for n in range(len(point)):
        low, top = min(low, point[n, 2]), max(top, point[n, 2])
    return low, top


@compiled(error_model="numpy")
def bend_field(edge, angles, lengths, source_plan, scene):  # type: ignore[no-untyped-def]
    """Return the uniform field of a bend over that of a free ray as long, with whole walls and their front faces."""
    builds, (transmission, wall_build), _, wavelength_m = scene
    first, last, n = int(edge[2]), int(edge[3]), edge[6]
    (to_source, to_target), (source_m, target_m) = angles, lengths
    skew = source_plan / source_m
    distance = source_m * target_m * skew * skew / (source_m + target_m)
    terms = wedge_terms_at(n, to_source, to_target, distance, wavelength_m, skew)
    # the more grazing of both rays: the mirror's own angle at its border, no field along a face, alike both ways
    cosines = (
        min(abs(math.sin(to_source)), abs(math.sin(to_target))) * skew,
        min(abs(math.sin(n * np.pi - to_source)), abs(math.sin(n * np.pi - to_target))) * skew,
    )
    passed = crossing_factor(transmission, wall_build[first], cosines[0]) if first == last else 0.0j
    built = front = (1.0 - passed) * terms[0]
    for face in range(2):
        of_wall, of_front, _ = bounce(builds, last if face else first, cosines[face])
        built, front = built + of_wall * terms[1 + face], front + of_front * terms[1 + face]
    spread = math.sqrt((source_m + target_m) / (source_m * target_m))
    return built * spread, front * spread


@compiled(error_model="numpy")
def turn_from_face(x, y, face_rad, sense):  # type: ignore[no-untyped-def]
    """Return the angle of a direction around an edge from the first face through the air, 0..2 pi."""
    return (sense * (math.atan2(y, x) - face_rad)) % (2.0 * np.pi)


def edges_of(view: Snapshot) -> Edges:
    """Edges that the radar faces: free ends of walls, and corners whose open side, wider than a half turn, holds it."""
    edges, faces = open_edges(view.world), _faces(view.world, view.origin)
    if view.ahead_only:
        faces &= view.is_ahead(edges.point - view.origin)
    return edges.take(faces)


def open_edges(world: World) -> Edges:
    """Free ends of walls, and corners of two walls with the side that is wider than a half turn, wherever it opens.

    Found once and kept with the world.
    """
    return _kept(world)[0]


def _kept(world: World) -> tuple[Edges, np.ndarray, np.ndarray]:
    """Return the open edges and the corners (`_corners`) of a world, which no motion changes."""

    def find() -> tuple[Edges, np.ndarray, np.ndarray]:
        corner, left = _corners(world)
        return _open_edges(world, corner, left), corner, left

    return world.once("edges", find)


def _open_edges(world: World, corner: np.ndarray, left: np.ndarray) -> Edges:
    ends = world.wall_ends
    first, last = np.concatenate([ends.alone, ends.first[corner]]), np.concatenate([ends.alone, ends.second[corner]])
    wall_1, wall_2 = ends.wall[first], ends.wall[last]
    alone = np.ones(len(ends.alone))
    return Edges(
        point=ends.position[first],
        first=wall_1,
        last=wall_2,
        face_rad=ends.face_rad[first],
        sense=np.concatenate([alone, np.where(left > np.pi, 1.0, -1.0)]),
        n=np.concatenate([2.0 * alone, np.maximum(left, 2.0 * np.pi - left) / np.pi]),
        height_m=np.minimum(world.wall_height_m[wall_1], world.wall_height_m[wall_2]),
        number=2 * world.wall_id[wall_1] + (first >= len(ends.wall) // 2),
    )


def _corners(world: World) -> tuple[np.ndarray, np.ndarray]:
    """Return which pairs of ends that meet are edges, and the turns through the air to the left of their first face."""
    ends = world.wall_ends
    left = (ends.face_rad[ends.second] - ends.face_rad[ends.first]) % (2.0 * np.pi)
    corner = np.flatnonzero(np.maximum(left, 2.0 * np.pi - left) > np.pi + LEAST_TURN_RAD)
    return corner, left[corner]


def _faces(world: World, origin: np.ndarray) -> np.ndarray:
    """Return which of `open_edges` have a point in the air that they are open to, bool [E]."""
    ends, (_, corner, left) = world.wall_ends, _kept(world)
    end = ends.first[corner]
    towards = np.arctan2(*(origin - ends.position[end]).T[::-1])
    is_left = (towards - ends.face_rad[end]) % (2.0 * np.pi) < left
    return np.concatenate([np.ones(len(ends.alone), bool), is_left == (left > np.pi)])
