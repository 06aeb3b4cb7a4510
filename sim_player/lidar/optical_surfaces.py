"""Surfaces that a level ray of light can meet in a frozen world, and the patches of objects that light reaches.

Walls by their faces at 850 nm, objects as matt surfaces: classes as boxes, meshes by their faces.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from models.physics.materials import is_volume
from models.physics.mirror import CLEARANCE_M
from models.physics.photons.optics import (
    OBJECT_ALBEDO,
    diffuse_reflectance,
    matt_albedo,
    optical_material,
    optical_reflectance,
)
from msgs.values.array_table import ArrayTable
from sim_player.bodies.triangles import cut_triangles
from sim_player.scene.description import SceneObject
from sim_player.scene.world import Snapshot, World

#: Objects are cut into patches of at most this length.
PATCH_M = 0.25


@dataclass(frozen=True)
class Surfaces(ArrayTable):
    """M upright pieces that a level ray can meet: walls, box sides, and cuts through meshes."""

    a: np.ndarray
    b: np.ndarray
    curvature_per_m: np.ndarray
    #: Level part of the unit normal: 1 where the piece stands upright.
    level: np.ndarray
    #: Object it belongs to, -1 for a wall.
    object_index: np.ndarray
    #: Optics: n + jk, albedo of what enters, rms height; `matt`: an object or foliage, all of whose light is `albedo`.
    index: np.ndarray
    albedo: np.ndarray
    roughness_m: np.ndarray
    matt: np.ndarray

    @classmethod
    def of_walls(cls, world: World) -> Surfaces:
        """Return all pieces of wall, in the order of the world."""
        built = [world.scene.surfaces[surface] for surface in world.wall_surface]
        optics = [optical_material(surface.material) for surface in built]
        return cls(
            a=world.wall_a,
            b=world.wall_b,
            curvature_per_m=world.wall_curvature_per_m,
            level=np.ones(len(built)),
            object_index=np.full(len(built), -1, np.int32),
            index=np.array([material.index for material in optics], np.complex128),
            albedo=np.array([material.albedo for material in optics], np.float64),
            roughness_m=world.wall_roughness_m,
            matt=np.array([is_volume(surface.material) for surface in built], bool),
        )

    @classmethod
    def of_object(cls, object_index: int, a: np.ndarray, b: np.ndarray, level: np.ndarray, albedo: float) -> Surfaces:
        """Return the matt pieces of one object."""
        count, zero = len(a), np.zeros(len(a))
        return cls(
            a=a,
            b=b,
            curvature_per_m=zero,
            level=level,
            object_index=np.full(count, object_index, np.int32),
            index=np.ones(count, np.complex128),
            albedo=np.full(count, albedo),
            roughness_m=zero,
            matt=np.ones(count, bool),
        )

    def diffuse(self, cosine: np.ndarray, wavelength_m: float) -> np.ndarray:
        """Return the share of the light that each piece scatters at a cosine of incidence."""
        bare = diffuse_reflectance(self.index, self.albedo, cosine, self.roughness_m, wavelength_m)
        return np.where(self.matt, self.albedo, bare)

    def mirror(self, cosine: np.ndarray, wavelength_m: float) -> np.ndarray:
        """Return the share that each piece mirrors at a cosine of incidence: R_s of Eq. (16)."""
        whole = optical_reflectance(self.index, cosine, self.roughness_m, wavelength_m)
        return np.where(self.matt, 0.0, whole)


def all_surfaces(view: Snapshot, height_m: float) -> Surfaces:
    """Return everything in a frozen world that reaches the sensor's height."""
    world, blockers = view.world, view.blockers
    walls = len(world.wall_a)
    parts = [Surfaces.of_walls(world).take(world.wall_height_m > height_m)]
    for index, scene_object in enumerate(world.scene.objects):
        sides = slice(walls + 4 * index, walls + 4 * index + 4)
        a, b, level = blockers.a[sides], blockers.b[sides], np.ones(4)
        if scene_object.class_ is None:
            a, b, level = _cut(_triangles(view, index), height_m)
        elif scene_object.kind.height_m <= height_m:
            continue
        parts.append(Surfaces.of_object(index, a, b, level, object_albedo(scene_object)))
    return Surfaces.joined(parts)


def object_albedo(scene_object: SceneObject) -> float:
    """Return the share that an object scatters: its class's, or its material's as a rough piece."""
    if scene_object.class_ is not None:
        return OBJECT_ALBEDO[scene_object.class_]
    return matt_albedo(optical_material(scene_object.material))


def _triangles(view: Snapshot, index: int) -> np.ndarray:
    """Return the corners of a mesh's faces at its pose, heights over the ground, [F, 3, 3]."""
    mesh = view.world.scene.objects[index].shape
    corners = np.zeros((0, 3, 3)) if mesh is None else mesh.corners_m
    scene_object = view.world.scene.objects[index]
    shift = view.blockers.a[len(view.world.wall_a) + 4 * index] - scene_object.corners_m()[0]
    return np.concatenate([scene_object.place(corners[..., :2]) + shift, corners[..., 2:]], axis=-1)


def _cut(corners: np.ndarray, height_m: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Cut triangles [F, 3, 3] at a height: ends [M, 2] of the segments, and the level part of their normals [M]."""
    above = corners[..., 2] >= height_m
    # the corner that lies alone on its side comes first
    alone = np.where(above.sum(axis=1) == 1, above.argmax(axis=1), (~above).argmax(axis=1))
    met = above.any(axis=1) & ~above.all(axis=1)
    turned = np.take_along_axis(corners, (alone[:, None] + np.arange(3))[..., None] % 3, axis=1)[met]
    tip, base = turned[:, :1], turned[:, 1:]
    share = (height_m - tip[..., 2]) / (base[..., 2] - tip[..., 2])
    ends = tip[..., :2] + share[..., None] * (base[..., :2] - tip[..., :2])
    normal = np.cross(turned[:, 1] - turned[:, 0], turned[:, 2] - turned[:, 0])
    level = np.hypot(normal[:, 0], normal[:, 1]) / np.linalg.norm(normal, axis=1)
    long = np.hypot(*(ends[:, 1] - ends[:, 0]).T) > CLEARANCE_M
    return ends[long, 0], ends[long, 1], level[long]


@dataclass(frozen=True)
class Patches:
    """Q matt patches of all objects: position and outward normal [Q, 3], area, albedo, object; owner as `Blockers`."""

    position_m: np.ndarray
    normal: np.ndarray
    area_m2: np.ndarray
    albedo: np.ndarray
    object_index: np.ndarray
    owner: np.ndarray


def patches_of(view: Snapshot) -> Patches:
    """Return the patches of a frozen world: sides and roofs of classes, faces of meshes."""
    objects = view.world.scene.objects
    is_mesh = np.array([scene_object.class_ is None for scene_object in objects], bool)
    made = [_mesh_patches(view, i) if is_mesh[i] else _box_patches(view, i) for i in range(len(objects))]
    count = np.array([len(area) for *_, area in made], int)
    object_index = np.repeat(np.arange(len(objects), dtype=np.int32), count)
    return Patches(
        position_m=np.concatenate([np.zeros((0, 3)), *(positions for positions, _, _ in made)]),
        normal=np.concatenate([np.zeros((0, 3)), *(normal for _, normal, _ in made)]),
        area_m2=np.concatenate([np.zeros(0), *(area for *_, area in made)]),
        albedo=np.repeat([object_albedo(scene_object) for scene_object in objects], count),
        object_index=object_index,
        owner=np.where(is_mesh[object_index], object_index, -1).astype(np.int32),
    )


def _box_patches(view: Snapshot, index: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the positions, normals and areas of the patches of a box: four sides and the roof."""
    height_m = view.world.scene.objects[index].kind.height_m
    start = len(view.world.wall_a) + 4 * index
    corners = np.column_stack([view.blockers.a[start : start + 4], np.zeros(4)])
    following, up = np.roll(corners, -1, axis=0), np.array([0.0, 0.0, height_m])
    sides = [_cells(a, b - a, up) for a, b in zip(corners, following, strict=True)]
    roof = _cells(corners[0] + up, corners[1] - corners[0], corners[3] - corners[0])
    parts = [*sides, roof]
    return tuple(np.concatenate(column) for column in zip(*parts, strict=True))  # type: ignore[return-value]


def _cells(corner: np.ndarray, along: np.ndarray, up: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return a rectangle in equal cells of at most `PATCH_M`: their middles [Q, 3], normals along x up, areas [Q]."""
    columns, rows = (max(math.ceil(float(np.linalg.norm(edge)) / PATCH_M), 1) for edge in (along, up))
    across, high = np.meshgrid((np.arange(columns) + 0.5) / columns, (np.arange(rows) + 0.5) / rows)
    positions = corner + across.reshape(-1, 1) * along + high.reshape(-1, 1) * up
    normal = np.cross(along, up)
    area = float(np.linalg.norm(normal))
    count = len(positions)
    return positions, np.broadcast_to(normal / area, (count, 3)), np.full(count, area / count)


def _mesh_patches(view: Snapshot, index: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return positions, normals and areas of a mesh: pieces of its faces, merged in cubes where they face alike."""
    corners, _ = cut_triangles(_triangles(view, index), PATCH_M)
    doubled = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    if not view.world.scene.objects[index].shape.closed:  # type: ignore[union-attr]
        # a sheet has two sides
        corners, doubled = np.concatenate([corners, corners]), np.concatenate([doubled, -doubled])
    area = 0.5 * np.linalg.norm(doubled, axis=1)
    centre = corners.mean(axis=1)
    # faces alike: of one octant and one leading axis
    facing = np.column_stack([doubled > 0.0, np.abs(doubled).argmax(axis=1)])
    key = np.concatenate([np.floor(centre / PATCH_M).astype(np.int64), facing], axis=1)
    _, owner = np.unique(key, axis=0, return_inverse=True)
    owner = owner.ravel()
    total = np.bincount(owner, area)
    positions = np.column_stack([np.bincount(owner, area * centre[:, axis]) for axis in range(3)]) / total[:, None]
    normal = np.column_stack([np.bincount(owner, doubled[:, axis]) for axis in range(3)])
    return positions, normal / np.linalg.norm(normal, axis=1)[:, None], total
