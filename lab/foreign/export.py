"""Export of a prepared scene as triangle meshes with ITU materials, for ray tracers of meshes.

Walls are sheets: a foreign tracer lays the slab of their thickness into the material, as ours does. An arc becomes flat
strips. An object of a class is a closed box, of a mesh that mesh. The ground is a square. Foliage is left out: it
mirrors nothing, and foreign tracers know no volume that a path crosses.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from enum import IntEnum

import numpy as np

from models.physics.curved_mirror import arc_points
from models.physics.materials import CONSTRUCTIONS, permittivity, wall_layers, wall_name
from sim_player.bodies.meshes import Mesh, box
from sim_player.scene.description import SceneObject
from sim_player.scene.world import World, radar_pose

#: Half the side of the ground's square, beyond the radar's range.
GROUND_REACH_M = 250.0
#: Largest deviation of the strips of an arc from it.
ARC_ERROR_M = 1e-3
#: Points on a body are moved out of it by this much: single precision must tell on which side they lie.
STAND_OFF_M = 0.01


class SurfaceKind(IntEnum):
    """Part of the scene that a mesh stands for."""

    WALL = 0
    OBJECT = 1
    GROUND = 2


@dataclass(frozen=True, eq=False)
class ExportedSurface:
    """One mesh in the scene's frame (heights over the ground) and what a foreign tracer must know of its material."""

    kind: SurfaceKind
    #: Piece of wall (`World.wall_a`) or object; -1 for the ground.
    index: int
    #: Its `material` is the name of the front layer in ITU-R P.2040 (`models.physics.materials.TABLE`).
    mesh: Mesh
    #: Front layer: relative permittivity (Im <= 0) at the carrier, and thickness, inf without a back.
    permittivity: complex
    thickness_m: float
    #: Layers of the whole build; a foreign tracer of single slabs has the right reflection for 1 alone.
    layers: int = 1
    curved: bool = False


def exported_surfaces(world: World, time_s: float = 0.0) -> tuple[ExportedSurface, ...]:
    """Return the walls, objects and ground of a scene at a time after start, in this order."""
    walls = [_wall(world, int(piece)) for piece in np.flatnonzero(world.is_mirror)]
    objects = [
        _object(world, index, scene_object, world.velocity_mps[index] * time_s)
        for index, scene_object in enumerate(world.scene.objects)
    ]
    return (*walls, *objects, *_ground(world, time_s))


def clear_of_bodies(world: World) -> World:
    """Return the world with every scattering centre `STAND_OFF_M` outside the faces it lies on, for both tracers."""
    first, second = world.centre_normals[:, 0], world.centre_normals[:, 1]
    same = (first == second).all(axis=1)
    outward = first + np.where(same[:, None], 0.0, second)
    return replace(world, centre_m=world.centre_m + STAND_OFF_M * outward)


def _wall(world: World, piece: int) -> ExportedSurface:
    """Return one piece of wall: a rectangle, or the strips of an arc."""
    surface = world.scene.surfaces[world.wall_surface[piece]]
    chord, curvature = math.dist(world.wall_a[piece], world.wall_b[piece]), float(world.wall_curvature_per_m[piece])
    curved = bool(world.is_curved[piece])
    share = np.linspace(0.0, 1.0, (_strips(chord, curvature) if curved else 1) + 1)
    plan = arc_points(world.wall_a[piece], world.wall_b[piece], curvature, share)
    name, thickness_m = wall_name(surface.material), surface.thickness_mm
    layers = wall_layers(name, None if thickness_m is None else 1e-3 * thickness_m, world.radar.carrier_hz)
    material = CONSTRUCTIONS[name][0].material if name in CONSTRUCTIONS else name
    mesh = _upright(plan, float(world.wall_height_m[piece]), material, f"wall_{piece}")
    return ExportedSurface(SurfaceKind.WALL, piece, mesh, *layers[0], layers=len(layers), curved=curved)


def _strips(chord_m: float, curvature_per_m: float) -> int:
    """Return the number of strips that follow an arc to `ARC_ERROR_M`."""
    half_angle = math.asin(0.5 * chord_m * abs(curvature_per_m))
    step = math.acos(max(1.0 - ARC_ERROR_M * abs(curvature_per_m), 0.0))
    return max(math.ceil(half_angle / step), 1)


def _upright(plan_m: np.ndarray, height_m: float, material: str, name: str) -> Mesh:
    """Return the rectangles over a line [N, 2], from the ground to a height."""
    count = len(plan_m)
    foot = np.column_stack([plan_m, np.zeros(count)])
    low = np.arange(count - 1)
    high = low + count
    faces = np.concatenate([np.column_stack([low, low + 1, high + 1]), np.column_stack([low, high + 1, high])])
    return Mesh(np.concatenate([foot, foot + np.array([0.0, 0.0, height_m])]), faces, material, name)


def _object(world: World, index: int, scene_object: SceneObject, shift_m: np.ndarray) -> ExportedSurface:
    """Return an object's mesh, or the box of its class in metal, where it stands."""
    kind = scene_object.kind
    mesh = scene_object.shape or box(kind.length_m, kind.width_m, kind.height_m)
    plan = scene_object.place(mesh.vertices_m[:, :2]) + shift_m
    standing = replace(mesh, vertices_m=np.column_stack([plan, mesh.vertices_m[:, 2]]), name=f"object_{index}")
    medium = permittivity(mesh.material, world.radar.carrier_hz)
    return ExportedSurface(SurfaceKind.OBJECT, index, standing, medium, math.inf)


def _ground(world: World, time_s: float) -> tuple[ExportedSurface, ...]:
    """Return the ground around the radar, if the scene has one."""
    if world.ground is None:
        return ()
    pose = radar_pose(world.scene, time_s)
    corners = np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]]) * GROUND_REACH_M + [pose.x_m, pose.y_m]
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    mesh = Mesh(np.column_stack([corners, np.zeros(4)]), faces, wall_name(world.ground.material), "ground")
    medium = permittivity(world.ground.material, world.radar.carrier_hz)
    return (ExportedSurface(SurfaceKind.GROUND, -1, mesh, medium, math.inf),)
