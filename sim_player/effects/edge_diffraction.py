"""Walls' ends and corners bend what passes them: shadows get soft borders, and weak echoes reach behind the corner.

Upright edges by the uniform theory (`models.physics.diffraction`): a free end is a half plane, a corner that points at
the radar a wedge. One bend on one or both ways, by the same edge. Left out: the walls' top edges, corners that open
towards the radar, bends before or after a mirror, edges of vehicles.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from models.physics.diffraction import edge_field, wedge_coefficient
from models.physics.fresnel import half_space_reflection
from sim_player.echoes import Echoes, join_echoes, object_echoes, cofocal, same_target
from sim_player.effect_names import bit
from sim_player.effects.tracing import Tracing
from sim_player.legs import in_series, passage
from sim_player.routes import Routes, join_routes, make_routes, norm
from sim_player.world import Snapshot, World

NAME = "edge_diffraction"
ABOUT = "echoes bent around walls' ends and corners"
#: Corners whose walls turn by less than this are no edge (window panes in one plane).
LEAST_TURN_RAD = 0.05
#: Points nearer than this to an edge's faces or to the edge itself are on the wall, not beside it.
NEAREST_EDGE_M = 0.05


@dataclass(frozen=True)
class Edges:
    """E upright edges."""

    #: Place in the plane, [E, 2], and the piece of wall of the first face.
    point: np.ndarray
    wall: np.ndarray
    #: Direction of the first face from the edge [rad], sense in which the air is turned through (+1: left), [E].
    face_rad: np.ndarray
    sense: np.ndarray
    #: Exterior angle / pi.
    n: np.ndarray
    height_m: np.ndarray
    #: Permittivity of the front of both faces' material.
    permittivity: np.ndarray


def absent(world: World) -> str | None:
    """An edge and an object."""
    if not len(world.centre_m):
        return "the scene holds no object"
    return None if world.is_mirror.any() else "the scene holds no wall: there is no edge"


def apply(tracing: Tracing) -> Echoes:
    """Echoes with one bend (out or back, the other way clear) and with two (out and back by the same edge)."""
    view = tracing.view
    bent = edge_routes(view, view.centre, tracing.owner)
    tracing.routes[NAME] = bent
    clear = tracing.clear_routes("los_objects", "specular_relay")
    first, second = same_target(bent.target, clear.target)
    both = join_routes([bent, clear])
    mixed = object_echoes(view, both, (first, second + len(bent)), bit(NAME))
    return join_echoes([object_echoes(view, bent, cofocal(bent), bit(NAME)), mixed])


def edge_routes(view: Snapshot, point_m: np.ndarray, owner: np.ndarray) -> Routes:
    """Routes antenna -> edge -> points [N, 3] whose legs are free and on the edge's open side."""
    edges = edges_of(view)
    edge, target = (
        grid.ravel() for grid in np.meshgrid(np.arange(len(edges.n)), np.arange(len(point_m)), indexing="ij")
    )
    end = point_m[target]
    # the ray meets the edge where heights are in proportion to the plan lengths (Keller's cone)
    source_plan = norm(edges.point[edge] - view.origin)
    target_plan = norm(end[:, :2] - edges.point[edge])
    share = source_plan / (source_plan + target_plan)
    height = view.antenna[2] + share * (end[:, 2] - view.antenna[2])
    to_source, to_target = _angle(edges, edge, view.origin[None]), _angle(edges, edge, end[:, :2])
    wide = edges.n[edge] * np.pi
    open_side = (to_source < wide) & (to_target < wide) & (height < edges.height_m[edge])
    keep = np.flatnonzero(open_side & (source_plan > NEAREST_EDGE_M) & (target_plan > NEAREST_EDGE_M))
    edge, target, end = edge[keep], target[keep], end[keep]
    bend = np.column_stack([edges.point[edge], height[keep]])
    legs = in_series(passage(view.antenna, bend, view.blockers), passage(bend, end, view.blockers, owner[target]))
    free = np.flatnonzero(legs.free)
    return _bent(view, edges, edge, target, end, bend, to_source[keep], to_target[keep], legs).take(free)


def _bent(view, edges, edge, target, end, bend, to_source, to_target, legs) -> Routes:  # type: ignore[no-untyped-def]
    """Routes by known points of edges with their uniform field."""
    out, on = bend - view.antenna, end - bend
    source_m, target_m = norm(out), norm(on)
    skew = norm(out[:, :2]) / source_m
    distance = source_m * target_m * skew**2 / (source_m + target_m)
    first = half_space_reflection(edges.permittivity[edge], np.abs(np.sin(to_source)))
    last = half_space_reflection(edges.permittivity[edge], np.abs(np.sin(edges.n[edge] * np.pi - to_source)))
    coefficient = wedge_coefficient(
        edges.n[edge], to_source, to_target, distance, view.world.radar.wavelength_m, skew, first, last
    )
    return make_routes(
        target,
        source_m + target_m,
        out / source_m[:, None],
        on / target_m[:, None],
        legs,
        bit(NAME),
        edge=edge,
        other=edge_field(coefficient, source_m, target_m),
    )


def edges_of(view: Snapshot) -> Edges:
    """Free ends of walls, and corners whose open side is wider than a half turn and faces the radar."""
    world = view.world
    found = []
    for surface in np.unique(world.wall_surface[world.is_mirror]):
        walls = np.flatnonzero(world.wall_surface == surface)
        chain = np.concatenate([world.wall_a[walls], world.wall_b[walls[-1:]]])
        closed = bool(np.hypot(*(chain[0] - chain[-1])) < 1e-9)
        for index, wall in enumerate(walls):
            before = walls[index - 1] if index or closed else None
            found.append(_edge(view, chain[index], chain[index + 1], wall, world, before))
        if not closed:
            found.append(_edge(view, chain[-1], chain[-2], walls[-1], world, None))
    known = [edge for edge in found if edge is not None]
    columns = list(zip(*known, strict=True)) if known else [()] * 7
    return Edges(
        point=np.array(columns[0], np.float64).reshape(-1, 2),
        wall=np.array(columns[1], np.int32),
        face_rad=np.array(columns[2], np.float64),
        sense=np.array(columns[3], np.float64),
        n=np.array(columns[4], np.float64),
        height_m=np.array(columns[5], np.float64),
        permittivity=np.array(columns[6], np.complex128),
    )


def _edge(view, point, along, wall, world, before):  # type: ignore[no-untyped-def]
    """One edge as a row of `Edges`, None where it is none; `along` is the next point of its first face."""
    face = np.arctan2(along[1] - point[1], along[0] - point[0])
    front = world.stacks[world.wall_stack[wall]][0][0]
    row = (point, wall, face, 1.0, 2.0, world.wall_height_m[wall], front)
    if before is None:
        return row
    other = world.wall_a[before] if before != wall else world.wall_b[before]
    last = np.arctan2(other[1] - point[1], other[0] - point[0])
    towards = np.arctan2(view.origin[1] - point[1], view.origin[0] - point[0])
    left = (last - face) % (2.0 * np.pi)
    # the radar stands on one side of the corner: the air is the turn that holds it
    sense, turn = (1.0, left) if (towards - face) % (2.0 * np.pi) < left else (-1.0, 2.0 * np.pi - left)
    if turn < np.pi + LEAST_TURN_RAD:
        return None
    return (point, wall, face, sense, turn / np.pi, world.wall_height_m[wall], front)


def _angle(edges: Edges, edge: np.ndarray, point: np.ndarray) -> np.ndarray:
    """Angle of points around edges from the first face through the air, 0..2 pi."""
    offset = point - edges.point[edge]
    turn = edges.sense[edge] * (np.arctan2(offset[:, 1], offset[:, 0]) - edges.face_rad[edge])
    return np.asarray(turn % (2.0 * np.pi))
