"""LiDAR clouds of a scene by plain geometry: first hits of rays on walls, objects and ground, with noise along the ray.

No photons: `nearest_hits` gives the range and the surface at which each ray ends. Frames: `scene` is the scene's own,
heights above the
ground; `radar` has its origin in the antenna, z up; `lidar` has its origin in the sensor.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from contrib.annotate.registration import import_open3d
from models.physics.mirror import blocked
from models.physics.plane import segment_distance_m
from sim_player.bodies.meshes import Mesh, box
from sim_player.generate.placement import Boxes, chords
from sim_player.scene.description import Scene, SceneObject

#: Codes of the surface at which a ray ends; objects are numbered from 0 up.
NOTHING, GROUND, WALL = -3, -2, -1
#: The ground reaches this far.
GROUND_HALF_M = 500.0
#: Least distance of a viewpoint from walls and objects, and largest distance from the one that it must overlap.
CLEARANCE_M, FARTHEST_STEP_M = 1.2, 14.0
#: Least cosine to the normal at which a side counts as covered.
LEAST_COSINE = 0.3
#: Most viewpoints of a scene, and the spacing of the positions that are tried.
MAX_VIEWPOINTS, SPACING_M = 3, 1.0
#: Rays of a LiDAR: their elevations and the farthest hit.
ELEVATION_LIMIT_DEG, MAX_RANGE_M = 22.5, 100.0


@dataclass(frozen=True, kw_only=True)
class LidarParams:
    """A spinning LiDAR: `channels` elevations over +-`ELEVATION_LIMIT_DEG`, `azimuths` a turn; noise is one sigma."""

    channels: int = 128
    azimuths: int = 1024
    range_noise_m: float = 0.02


@dataclass(frozen=True, kw_only=True)
class Viewpoint:
    """Pose of a LiDAR in the scene: position, height above the ground, heading, tilt."""

    x_m: float
    y_m: float
    z_m: float = 1.8
    yaw_deg: float = 0.0
    pitch_deg: float = 0.0
    roll_deg: float = 0.0

    def scene_from_lidar(self) -> np.ndarray:
        """Return the rigid transform [4, 4]."""
        return rigid(
            (self.x_m, self.y_m, self.z_m), math.radians(self.roll_deg), math.radians(self.pitch_deg),
            math.radians(self.yaw_deg),
        )  # fmt: skip


@dataclass(frozen=True, eq=False)
class LidarCloud:
    """N hits: `points_m` [N, 3] in the LiDAR's frame, the surface of each (`WALL`, `GROUND` or the object's index), and
    the true `radar_from_lidar` [4, 4]."""

    points_m: np.ndarray
    surface: np.ndarray
    radar_from_lidar: np.ndarray


def rigid(position_m: tuple[float, float, float], roll_rad: float, pitch_rad: float, yaw_rad: float) -> np.ndarray:
    """Transform [4, 4] that rolls, then pitches, then yaws (about x, y, z) and then moves."""
    from scipy.spatial.transform import Rotation

    transform = np.eye(4)
    transform[:3, :3] = Rotation.from_euler("xyz", [roll_rad, pitch_rad, yaw_rad]).as_matrix()
    transform[:3, 3] = position_m
    return transform


def ray_directions(params: LidarParams) -> np.ndarray:
    """Return the unit vectors [channels * azimuths, 3] in the LiDAR's frame, channel after channel from below."""
    limit_rad = math.radians(ELEVATION_LIMIT_DEG)
    elevation = np.linspace(-limit_rad, limit_rad, params.channels)[:, None]
    azimuth = np.linspace(-np.pi, np.pi, params.azimuths, endpoint=False)[None]
    x, y = np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth)
    return np.stack([x, y, np.broadcast_to(np.sin(elevation), x.shape)], axis=-1).reshape(-1, 3)


def scene_triangles(scene: Scene) -> tuple[np.ndarray, np.ndarray]:
    """Return the corners [F, 3, 3] of all surfaces in the scene's frame and the owner of each face [F]."""
    flat = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]) * GROUND_HALF_M
    faces, owner = [flat[[[0, 1, 2], [0, 2, 3]]]], [GROUND]
    for surface in scene.surfaces:
        if surface.role != "ground":
            faces.append(_upright(chords(surface), surface.height_m))
            owner.append(WALL)
    for index, scene_object in enumerate(scene.objects):
        faces.append(_object_triangles(scene_object))
        owner.append(index)
    return np.concatenate(faces), np.repeat(owner, [len(corners) for corners in faces])


def _upright(line_m: np.ndarray, height_m: float) -> np.ndarray:
    """Return the triangles of a wall along a line in plan."""
    pieces = []
    for (ax, ay), (bx, by) in pairwise(line_m.tolist()):
        a, b = (ax, ay, 0.0), (bx, by, 0.0)
        a_top, b_top = (ax, ay, height_m), (bx, by, height_m)
        pieces += [(a, b, b_top), (a, b_top, a_top)]
    return np.array(pieces)


def _object_triangles(scene_object: SceneObject) -> np.ndarray:
    """Return the triangles of an object at its pose; a class is the box of its kind."""
    kind = scene_object.kind
    mesh: Mesh = scene_object.shape or box(kind.length_m, kind.width_m, kind.height_m)
    corners = mesh.corners_m
    return np.concatenate([scene_object.place(corners[..., :2]), corners[..., 2:]], axis=-1)


def nearest_hits(
    scene: Scene, origin_m: np.ndarray, directions: np.ndarray, max_range_m: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return the range [N] to the first surface along unit vectors [N, 3] from a point [3] (infinity: none), and its
    code.
    """
    o3d = import_open3d()
    triangles, owner = scene_triangles(scene)
    caster = o3d.t.geometry.RaycastingScene(nthreads=1)
    vertices = np.ascontiguousarray(triangles.reshape(-1, 3), np.float32)
    caster.add_triangles(vertices, np.arange(len(vertices), dtype=np.uint32).reshape(-1, 3))
    start = np.broadcast_to(origin_m, directions.shape)
    hits = caster.cast_rays(np.concatenate([start, directions], axis=1).astype(np.float32), nthreads=1)
    range_m = hits["t_hit"].numpy().astype(np.float64)
    face = hits["primitive_ids"].numpy().astype(np.int64)
    hit = range_m <= max_range_m
    return np.where(hit, range_m, np.inf), np.where(hit, owner[np.where(hit, face, 0)], NOTHING)


def lidar_cloud(scene: Scene, viewpoint: Viewpoint, params: LidarParams, seed: int) -> LidarCloud:
    """Return the cloud of a LiDAR at one viewpoint of a scene at rest, noise drawn from `seed`."""
    scene_from_lidar = viewpoint.scene_from_lidar()
    directions = ray_directions(params)
    range_m, surface = nearest_hits(
        scene, scene_from_lidar[:3, 3], directions @ scene_from_lidar[:3, :3].T, MAX_RANGE_M
    )
    noisy_m = range_m + np.random.default_rng(seed).normal(0.0, params.range_noise_m, len(range_m))
    hit = np.isfinite(range_m) & (noisy_m > 0.0)
    # the antenna stands at the scene's origin, at its mounting height
    radar_from_scene = rigid((0.0, 0.0, -scene.radar.height_m), 0.0, 0.0, 0.0)
    return LidarCloud(noisy_m[hit, None] * directions[hit], surface[hit], radar_from_scene @ scene_from_lidar)


def choose_viewpoints(scene: Scene) -> tuple[Viewpoint, ...]:
    """Choose up to `MAX_VIEWPOINTS` viewpoints that together see as much as they can of the sides of all objects.

    The first is the radar's own position. Each next one is near an earlier one and in its sight, so that clouds
    overlap; greedy, on a grid.
    """
    lines = [chords(surface) for surface in scene.surfaces if surface.role != "ground"]
    a = np.concatenate([np.zeros((0, 2)), *(line[:-1] for line in lines)])
    b = np.concatenate([np.zeros((0, 2)), *(line[1:] for line in lines)])
    boxes = Boxes.of(scene.objects)
    face_a, face_b = boxes.faces
    a, b = np.concatenate([a, face_a]), np.concatenate([b, face_b])
    samples, outward = _side_samples(face_a, face_b)
    candidates = _free_positions(a, b, boxes, samples, SPACING_M)

    def seen_from(position: np.ndarray) -> np.ndarray:
        """Return the samples in sight, not so edge-on that rays would miss them."""
        to_viewpoint = position - samples
        faced = np.sum(to_viewpoint * outward, axis=1) > LEAST_COSINE * np.hypot(to_viewpoint[:, 0], to_viewpoint[:, 1])
        return np.asarray(faced & ~blocked(position, samples, a, b))

    sees = np.array([seen_from(position) for position in candidates]).reshape(len(candidates), len(samples))
    selected, covered = [np.zeros(2)], seen_from(np.zeros(2))
    while len(selected) < MAX_VIEWPOINTS and len(candidates):
        near = np.zeros(len(candidates), bool)
        for earlier in selected:
            near |= (np.hypot(*(candidates - earlier).T) <= FARTHEST_STEP_M) & ~blocked(earlier, candidates, a, b)
        gain = np.where(near, (sees & ~covered).sum(axis=1), 0)
        if gain.max(initial=0) == 0:
            break
        best = int(np.argmax(gain))
        selected.append(candidates[best])
        covered |= sees[best]
    return tuple(Viewpoint(x_m=float(x), y_m=float(y), yaw_deg=30.0 * index) for index, (x, y) in enumerate(selected))


def _side_samples(face_a: np.ndarray, face_b: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the points a hand's breadth inside the ends of sides and between, a little outside, [N, 2], and the
    normals there.
    """
    share = np.array([0.05, 0.275, 0.5, 0.725, 0.95])
    along = face_b - face_a
    outward = np.column_stack([along[:, 1], -along[:, 0]]) / np.hypot(*along.T)[:, None]
    samples = face_a[:, None] + share[:, None] * along[:, None] + 0.01 * outward[:, None]
    return samples.reshape(-1, 2), np.repeat(outward, len(share), axis=0)


def _free_positions(a: np.ndarray, b: np.ndarray, boxes: Boxes, samples: np.ndarray, spacing_m: float) -> np.ndarray:
    """Return the grid positions [N, 2] around the radar and the objects that keep clear of everything."""
    every = np.concatenate([np.zeros((1, 2)), samples])
    low, high = every.min(axis=0) - 4.0, every.max(axis=0) + 4.0
    x, y = (np.arange(math.ceil(lo), hi, spacing_m) for lo, hi in zip(low, high, strict=True))
    positions = np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1).reshape(-1, 2)
    free = ~boxes.contain(positions).any(axis=0) & (segment_distance_m(positions, a, b) > CLEARANCE_M).all(axis=1)
    return np.asarray(positions[free])
