"""Walls' ends and corners bend what passes them: shadows get soft borders, and weak echoes reach behind the corner.

Upright edges by the uniform theory (`models.physics.diffraction`): a free end is a half plane that lets through and
reflects what its wall does, so at the border of its shadow the edge has 1 - T of an opaque one's wave, T the field that
the wall lets through there (physical optics of a screen: Born and Wolf, Principles of Optics, 8.3, T in place of 0).
Where two builds meet in one plane, the half plane has the difference of both. A corner that points at the radar is a
wedge. Both legs may lead through further walls and over tops (`segments`); a ray over the edge's own top meets
Fresnel's share of it. A bend on one way or on both, by any two edges; the other way may be clear, by mirrors or through
walls. Left out: corners that open towards the radar and places where more than two walls meet, joints of walls of two
heights, the faces' roughness, edges of vehicles, and bends that leave little. Bends before or after a mirror have their
own file.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from models.compiled import compiled
from models.physics.diffraction import passed_edge_at, wedge_terms_at
from msgs.values.array_table import ArrayTable
from sim_player.scene.bounce import bounce
from sim_player.scene.segments import crossing_factor, is_clear, is_screened, may_pass, series
from sim_player.scene.world import Snapshot, World
from sim_player.trace.echoes import LEAST_BOTH, Echoes, object_echoes, same_target
from sim_player.trace.effect_names import bit
from sim_player.trace.routes import ROUTE, Routes, direction_of, fill_route, grown, owners
from sim_player.trace.snapshot import TraceContext

#: Corners whose walls turn by less than this are no edge (window panes in one plane).
LEAST_TURN_RAD = 0.05
#: Points nearer than this to an edge's faces or to the edge itself are on the wall, not beside it.
NEAREST_EDGE_M = 0.05
#: Bends that leave less than this of the field of a free ray as long are left out: at joints and beside mirrors, and at
#: ends and corners.
LEAST_BEND, LEAST_BENT = 0.03, 0.01
_BENT, _THROUGH = bit("edge_diffraction"), bit("wall_transmission")
#: What `series` says of ways that meet nothing, and that are blocked.
OPEN, BLOCKED = (1.0 + 0.0j, 1.0, False), (0.0j, 0.0, False)
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
    #: Whether the last face is the other half of the first one's plane, of another build.
    joint: np.ndarray
    #: Greatest weight of the wave at the border of the shadow, over that of an edge that lets nothing through.
    weight: np.ndarray
    #: The same number for the same edge from everywhere: by the end of the first face's wall in the whole world.
    number: np.ndarray

    @cached_property
    def table(self) -> np.ndarray:
        """The same as numbers, [E, 10], for compiled code."""
        rest = self.first, self.last, self.face_rad, self.sense, self.n, self.height_m, self.joint, self.weight
        return np.column_stack([self.point, *rest]).astype(np.float64)


def absent(world: World) -> str | None:
    """An edge and an object."""
    if not len(world.centre_m):
        return "the scene holds no object"
    return None if world.is_mirror.any() else "the scene holds no wall: there is no edge"


def apply(tracing: TraceContext) -> Echoes:
    """Echoes with one bend (out or back, the other way clear or through walls) and with two."""
    view = tracing.view
    bent = edge_routes(view, view.centre, tracing.owner, tracing.walls_let_through)
    tracing.routes["edge_diffraction"] = bent
    straight = tracing.unbent_routes
    every = Routes.joined([bent, straight])
    left = np.concatenate([most_factor(bent), np.minimum(np.abs(straight.other), 1.0)])
    first, second = same_target(bent.target, every.target)
    strong = left[first] * left[second] >= LEAST_BOTH
    same, mixed = strong & (first == second), strong & (first < second)
    alike = object_echoes(view, bent, (first[same], first[same]), _BENT)
    return Echoes.joined([alike, object_echoes(view, every, (first[mixed], second[mixed]), _BENT)])


def most_factor(rows: Routes | Echoes) -> np.ndarray:
    """Return the greatest field factor that routes or echoes have with whole walls or their front faces alone, [N]."""
    other = np.abs(rows.other) if isinstance(rows, Routes) else 1.0
    return np.asarray(np.maximum(np.abs(rows.whole), np.abs(rows.front)) * other)


def edge_routes(view: Snapshot, point_m: np.ndarray, owner: np.ndarray, walls: bool = False) -> Routes:
    """Routes antenna -> edge -> points [N, 3] whose legs are free, or lead through `walls`, on the edge's open side."""
    edges = edges_of(view)
    world = view.world
    scene = world.builds, (world.transmission, world.wall_build), view.blockers.pieces, world.radar.wavelength_m
    routes = Routes(
        _edge_routes(
            view.antenna, point_m, owners(owner, len(point_m)), edges.table, scene, walls, (LEAST_BENT, LEAST_BEND)
        )
    )
    return routes.with_columns(edge=edges.number[routes.edge])


@compiled(error_model="numpy")
def _edge_routes(antenna, point, owner, edges, scene, walls, least):  # type: ignore[no-untyped-def]
    pieces = scene[2]
    rows, count = np.empty(len(point), ROUTE), 0
    start = antenna[0], antenna[1], antenna[2]
    groups, low, top = point_groups(point, owner, start[2])
    for e in range(len(edges)):
        x, y, _, _, face_rad, sense, n_half, height, _, _ = edges[e]
        weakest = least[1] if edges[e, 8] else least[0]
        source_plan = math.hypot(x - start[0], y - start[1])
        to_source = turn_from_face(start[0] - x, start[1] - y, face_rad, sense)
        if to_source >= n_half * np.pi or source_plan <= NEAREST_EDGE_M:
            continue
        # seen at the greatest height at which a ray to any point may meet it
        if not may_pass((start, (x, y, top)), pieces, walls):
            continue
        # where the lowest ray meets nothing on its way, none does
        is_open = is_clear((start, (x, y, low)), pieces)
        for group in groups:
            # one wall may hide all of an object
            circle = group[0], group[1], group[2]
            if is_screened((x, y), circle, ((x, y), (group[0], group[1])), top, EVERYWHERE, pieces):
                continue
            image = group[0] - x, group[1] - y, group[2]
            if most_bent(edges[e], (to_source, source_plan), image, top - low, scene[3]) < weakest:
                continue
            for n in range(int(group[3]), int(group[4])):
                end = point[n, 0], point[n, 1], point[n, 2]
                target_plan = math.hypot(end[0] - x, end[1] - y)
                if target_plan <= NEAREST_EDGE_M:
                    continue
                # the ray meets the edge where heights are in proportion to the plan lengths (Keller's cone)
                bend = x, y, start[2] + source_plan / (source_plan + target_plan) * (end[2] - start[2])
                to_target = turn_from_face(end[0] - x, end[1] - y, face_rad, sense)
                if to_target >= n_half * np.pi:
                    continue
                depart, source_m = direction_of(start, bend)
                arrive, target_m = direction_of(bend, end)
                reach = stands_beside(bend[2] - height, source_m, target_m, scene[3])
                if reach == 0.0:
                    continue
                stretch = math.hypot(1.0, (end[2] - start[2]) / (source_plan + target_plan))
                turns, lengths = (to_target, to_target), (source_m, target_m)
                if bend_bound(edges[e], to_source, turns, lengths, stretch, scene[3]) < weakest:
                    continue
                before = OPEN if is_open else series((start, bend), -1, pieces, walls)
                behind = series((bend, end), owner[n], pieces, walls) if before[0] != 0.0 else BLOCKED
                if behind[0] == 0.0:
                    continue
                if count == len(rows):
                    rows = grown(rows)
                passed = before[0] * behind[0] * reach
                bent = bend_field(edges[e], (to_source, to_target), (source_m, target_m), source_plan, scene)
                if max(abs(bent[0]), abs(bent[1])) * abs(passed) < weakest:
                    continue
                row = rows[count]
                count += 1
                fill_route(row, n, source_m + target_m, depart, arrive, _BENT)
                row.edge, row.foliage, row.other = e, before[1] * behind[1], passed
                row.whole, row.front = bent
                if before[2] or behind[2]:
                    row.needs |= _THROUGH
    return rows[:count]


@compiled(error_model="numpy")
def stands_beside(over_m, source_m, target_m, wavelength_m):  # type: ignore[no-untyped-def]
    """Return the share of a wave that meets an upright edge, where its ray passes by so far over the edge's top."""
    return 1.0 - passed_edge_at(over_m, source_m, target_m, wavelength_m)


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
    """Return the uniform field of a bend over that of a free ray as long, with whole walls and their front faces.

    At the border of its shadow 1 - T of a free end, 1 - T1 T2 of a corner whose border lies behind both faces.
    """
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
    passed, beside = crossing_factor(transmission, wall_build[first], cosines[0]), 1.0 + 0.0j
    if edge[8]:
        beside = crossing_factor(transmission, wall_build[last], cosines[0])
    elif first != last:
        passed *= crossing_factor(transmission, wall_build[last], cosines[1])
    built = front = (beside - passed) * terms[0]
    for face in range(2):
        of_wall, of_front, _ = bounce(builds, first if edge[8] or not face else last, cosines[face])
        if edge[8]:
            other_wall, other_front, _ = bounce(builds, last, cosines[face])
            of_wall, of_front = of_wall - other_wall, of_front - other_front
        built, front = built + of_wall * terms[1 + face], front + of_front * terms[1 + face]
    spread = math.sqrt((source_m + target_m) / (source_m * target_m))
    return built * spread, front * spread


@compiled(error_model="numpy")
def most_bent(edge, source, image, climb, wavelength_m):  # type: ignore[no-untyped-def]
    """Return a bound of what an edge (a row of `Edges.table`) bends from a source towards points of a circle.

    Over free rays, which rise by `climb`. `source`: turn from the first face, distance; `image`: middle, radius.
    """
    (to_source, source_plan), (x, y, radius) = source, image
    away = math.hypot(x, y)
    if away <= 2.0 * radius:
        return np.inf
    middle, half = turn_from_face(x, y, edge[4], edge[5]), math.asin(radius / away)
    stretch = math.hypot(1.0, climb / (source_plan + away - radius))
    return bend_bound(
        edge, to_source, (middle - half, middle + half), (source_plan, away - radius), stretch, wavelength_m
    )


@compiled(error_model="numpy")
def bend_bound(edge, to_source, to_target, lengths, stretch, wavelength_m):  # type: ignore[no-untyped-def]
    """Return a bound of `bend_field` for targets between two turns: |F| <= 1, four cotangents that peak at the ends."""
    n = edge[6]
    # across the first face turns begin again
    if min(to_target) < 0.0 or max(to_target) > 2.0 * np.pi:
        return np.inf
    # a joint has the difference of two reflections
    total = 0.0
    for side, weight in ((-1.0, edge[9]), (1.0, 2.0 if edge[8] else 1.0)):
        for sign in (-1.0, 1.0):
            first = (np.pi + sign * (to_target[0] + side * to_source)) / (2.0 * n)
            last = (np.pi + sign * (to_target[1] + side * to_source)) / (2.0 * n)
            flattest = min(abs(math.tan(first)), abs(math.tan(last)))
            if flattest < 1e-9 or math.floor(first / np.pi) != math.floor(last / np.pi):
                return np.inf
            total += weight / flattest
    # 1 / (2 n sqrt(2 pi k s s' / (s + s')) sin(skew))
    turns = lengths[0] * lengths[1] / ((lengths[0] + lengths[1]) * wavelength_m)
    return total * stretch / (4.0 * np.pi * n * math.sqrt(turns))


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
    """Free ends of walls, corners by their side of over a half turn, joints of two builds in one plane; kept."""
    return _kept(world)[0]


def _kept(world: World) -> tuple[Edges, np.ndarray, np.ndarray]:
    """Return the open edges and the corners (`_corners`) of a world, which no motion changes."""

    def find() -> tuple[Edges, np.ndarray, np.ndarray]:
        corner, left = _corners(world)
        return _open_edges(world, corner, left), corner, left

    return world.once("edges", find)


def _open_edges(world: World, corner: np.ndarray, left: np.ndarray) -> Edges:
    ends = world.wall_ends
    joint = np.setdiff1d(np.arange(len(ends.first)), corner)
    builds = world.wall_build[ends.wall]
    joint = joint[builds[ends.first[joint]] != builds[ends.second[joint]]]
    first = np.concatenate([ends.alone, ends.first[corner], ends.first[joint]])
    last = np.concatenate([ends.alone, ends.second[corner], ends.second[joint]])
    wall_1, wall_2 = ends.wall[first], ends.wall[last]
    alone, joined = np.ones(len(ends.alone)), np.ones(len(joint))
    is_joint, through = np.arange(len(first)) >= len(first) - len(joint), world.most_through
    passed = np.where(wall_1 == wall_2, 1.0, through[wall_2]) * through[wall_1]
    return Edges(
        point=ends.position[first],
        first=wall_1,
        last=wall_2,
        face_rad=ends.face_rad[first],
        sense=np.concatenate([alone, np.where(left > np.pi, 1.0, -1.0), joined]),
        n=np.concatenate([2.0 * alone, np.maximum(left, 2.0 * np.pi - left) / np.pi, 2.0 * joined]),
        height_m=np.minimum(world.wall_height_m[wall_1], world.wall_height_m[wall_2]),
        joint=is_joint,
        weight=np.where(is_joint, through[wall_1] + through[wall_2], 1.0 + passed),
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
    faces = np.ones(len(open_edges(world)), bool)
    faces[len(ends.alone) : len(ends.alone) + len(corner)] = is_left == (left > np.pi)
    return faces
