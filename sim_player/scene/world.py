"""A scene prepared for tracing: flat arrays with drawn scatterers, and its snapshot at a time."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, TypeVar, cast

import numpy as np

from models.physics.attenuation import vegetation_db
from models.physics.curved_mirror import arc_normals, arc_points
from models.physics.fresnel import stack_transmission
from models.physics.materials import is_volume, permittivity, wall_layers
from msgs.values.frames import Pose2
from msgs.values.radar import RadarParams, RadarSetup
from msgs.values.vehicle import ego_motion
from sim_player.bodies.centres import Bodies, Body, body_of, joined_bodies
from sim_player.scene.bounce import Builds, Layers, all_bounces, builds_of
from sim_player.scene.coincident import WallPieces, cut_coincident
from sim_player.scene.description import Scene, SceneObject, Surface, check_scene
from sim_player.scene.road_users import ScatteringCentres, scattering_centres
from sim_player.scene.segments import BODY, STRAIGHT, TABLE_STEPS, VOLUME, WALL, Blockers, as_bent
from sim_player.scene.wall_ends import SAME_END_M, Corners, EndNodes, WallEnds, corners_of, end_nodes, wall_ends

T = TypeVar("T")
_LOG = logging.getLogger(__name__)

#: Patches of the diffuse return along a wall: shorter than a range bin.
PATCH_M = 0.13
#: Median and spread of the wall's own small scatterers (metal parts of a hand's size), every 1-3 m.
STRUCTURE_RCS_DBSM, STRUCTURE_SPREAD_DB = -12.0, 4.0
STRUCTURE_SPACING_M = (1.0, 3.0)
#: Cosine of a direction (or so many metres of a point) behind the antenna from which on it is taken for behind.
BEHIND = 1e-9
#: Rounding of the share of a wall that is in direct sight.
LIT_MARGIN = 1e-7


@dataclass(frozen=True)
class World:
    """A scene made ready for tracing. W wall pieces, K centres, Q wall scatterers."""

    scene: Scene
    setup: RadarSetup
    radar: RadarParams
    radar_height_m: float
    #: Wall pieces: ends [W, 2], heights, signed curvature, rms roughness, index of the scene's surface [W].
    wall_a: np.ndarray
    wall_b: np.ndarray
    wall_height_m: np.ndarray
    wall_curvature_per_m: np.ndarray
    wall_roughness_m: np.ndarray
    wall_surface: np.ndarray
    #: Index into `stacks` of each piece of wall; a volume (foliage) has none: -1.
    wall_stack: np.ndarray
    stacks: tuple[Layers, ...]
    #: Field factor of one crossing of each build over the cosine, complex128 [builds, TABLE_STEPS + 1]: of `stacks`,
    #: of all foliage, and of bodies, 0. Row of each piece of wall, int32 [W].
    transmission: np.ndarray
    wall_build: np.ndarray
    #: Scattering centres of all objects at start: [K, 3], normals [K, 2, 3], the rest [K]. An exponent of -1 - n is
    #: centre n of `bodies`, those of meshes and primitives, whose fields `sim_player.bodies.fields` has.
    centre_m: np.ndarray
    centre_normals: np.ndarray
    centre_rcs_m2: np.ndarray
    centre_phase_rad: np.ndarray
    centre_exponent: np.ndarray
    centre_floor: np.ndarray
    centre_object: np.ndarray
    #: Box faces of all objects at start, 4 each, and object velocities [objects, 2].
    face_a: np.ndarray
    face_b: np.ndarray
    face_height_m: np.ndarray
    velocity_mps: np.ndarray
    bodies: Bodies
    #: Wall scatterers: position [Q, 2], piece of wall, length of wall that it represents (0: structure), RCS, unit
    #: phasor.
    speck_m: np.ndarray
    #: Normal of the wall at the scatterer, either sign, [Q, 2].
    speck_normal: np.ndarray
    speck_wall: np.ndarray
    speck_length_m: np.ndarray
    speck_rcs_m2: np.ndarray
    speck_phasor: np.ndarray
    #: Numbers in the whole world of the pieces of wall, wall scatterers, objects and centres of a part of it.
    wall_id: np.ndarray
    speck_id: np.ndarray
    object_id: np.ndarray
    centre_id: np.ndarray
    #: What the scene draws twice in one place and is left out (`sim_player.scene.coincident`), one line each.
    left_out: tuple[str, ...] = ()
    #: Half round trip up to which a part of a world has all paths of the whole (`sim_player.paths.reach`).
    reach_m: float = math.inf

    @cached_property
    def is_mirror(self) -> np.ndarray:
        """Mask of the pieces that are walls, not foliage; bool [W]."""
        return self.wall_stack >= 0

    @cached_property
    def is_curved(self) -> np.ndarray:
        """Mask of the pieces with a relevant curvature; bool [W]."""
        chord = np.hypot(*(self.wall_b - self.wall_a).T)
        return self.is_mirror & (np.abs(self.wall_curvature_per_m) * chord >= STRAIGHT)

    @cached_property
    def is_flat(self) -> np.ndarray:
        """Mask of the straight mirrors; bool [W]."""
        return self.is_mirror & ~self.is_curved

    @property
    def orders_alike(self) -> bool:
        """True if both orders of two routes make one echo: transmitter and receiver in one place, steered alike."""
        return self.scene.radar.separation_m == 0.0 and self.setup.array.steered_ways == 2

    @property
    def ground(self) -> Surface | None:
        """The scene's ground, if it names one."""
        return next((surface for surface in self.scene.surfaces if surface.role == "ground"), None)

    @cached_property
    def ground_face(self) -> tuple[complex, float, float]:
        """Permittivity, rms roughness [m] and the wavelength at the ground; ValueError where there is none."""
        if self.ground is None:
            raise ValueError(f"scene {self.scene.name!r} must name a ground, got none")
        epsilon = permittivity(self.ground.material, self.radar.carrier_hz)
        return epsilon, 1e-3 * self.ground.roughness_mm, self.radar.wavelength_m

    @cached_property
    def kept(self) -> dict[str, Any]:
        """What others have derived from this world and keep with it."""
        return {}

    def once(self, name: str, make: Callable[[], T]) -> T:
        """Return what depends on the world alone, made at the first call and kept under a name."""
        if name not in self.kept:
            self.kept[name] = make()
        return cast("T", self.kept[name])

    @cached_property
    def numbers(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Numbers in the whole world of pieces of wall (the last row: -1, none), centres and objects, int32."""
        walls = np.append(self.wall_id, -1)
        return walls.astype(np.int32), self.centre_id.astype(np.int32), self.object_id.astype(np.int32)

    @cached_property
    def most_through(self) -> np.ndarray:
        """Field factor of each piece of wall at its most transparent incidence, [W]."""
        return np.asarray(np.abs(self.transmission).max(axis=1)[self.wall_build])

    def reflection(self, wall: np.ndarray, cosine: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return one bounce of pieces of wall [N]: (as built, front face alone, field left by roughness)."""
        return all_bounces(self.builds, np.asarray(wall, np.int64), np.asarray(cosine, np.float64))

    @cached_property
    def builds(self) -> Builds:
        """The walls' builds as compiled code takes them."""
        return builds_of(self.stacks, self.wall_stack, self.wall_roughness_m, self.radar.wavelength_m)

    @cached_property
    def corners(self) -> Corners:
        """Pairs of walls that share an end, arcs by their tangents there."""
        bend = np.where(self.is_curved, self.wall_curvature_per_m, 0.0)
        return corners_of(self.wall_a, self.wall_b, bend, self.is_mirror)

    def share_an_end(self, first: np.ndarray, second: np.ndarray) -> np.ndarray:
        """Return which of some pairs of pieces of wall [N] share an end; bool [N]."""
        ends = np.stack([self.wall_a, self.wall_b], axis=1)
        apart = np.linalg.norm(ends[first][:, :, None] - ends[second][:, None], axis=-1)
        return np.asarray((apart <= SAME_END_M).any(axis=(1, 2)))

    @cached_property
    def wall_frames(self) -> tuple[np.ndarray, np.ndarray]:
        """Unit normals to the left of all pieces of wall (of an arc: of its chord), and their middles, [W, 2] each."""
        along = self.wall_b - self.wall_a
        normal = np.column_stack([-along[:, 1], along[:, 0]]) / np.hypot(*along.T)[:, None]
        return normal, 0.5 * (self.wall_a + self.wall_b)

    @cached_property
    def wall_ends(self) -> WallEnds:
        """Ends of all mirrors and which of them meet."""
        return wall_ends(self.wall_a, self.wall_b, self.wall_curvature_per_m, self.is_mirror)

    @cached_property
    def end_nodes(self) -> EndNodes:
        """Places at which mirrors end, alone, together or on another."""
        return end_nodes(self.wall_a, self.wall_b, self.wall_curvature_per_m, self.is_mirror)

    @cached_property
    def structure(self) -> tuple[np.ndarray, np.ndarray]:
        """Index of the scatterers that are structure of walls; their points at the radar's height."""
        return self._level(np.flatnonzero(self.speck_length_m == 0.0))

    @cached_property
    def rough_patches(self) -> tuple[np.ndarray, np.ndarray]:
        """Index of the patches of rough mirrors; their points at the radar's height."""
        rough = self.is_mirror & (self.wall_roughness_m > 0.0)
        return self._level(np.flatnonzero((self.speck_length_m > 0.0) & rough[self.speck_wall]))

    def _level(self, specks: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return specks, np.column_stack([self.speck_m[specks], np.full(len(specks), self.radar_height_m)])

    @cached_property
    def centres(self) -> tuple[np.ndarray, ...]:
        """RCS, normals, exponent, floor, object and unit phasor of all centres as compiled code takes them."""
        numbers = self.centre_rcs_m2, self.centre_normals, self.centre_exponent, self.centre_floor
        plain = tuple(np.ascontiguousarray(values, np.float64) for values in numbers)
        return *plain, self.centre_object.astype(np.int32), np.exp(1j * self.centre_phase_rad)

    @cached_property
    def blocker_kinds(self) -> tuple[np.ndarray, ...]:
        """Kind int8, owner, build and box int32 of all pieces that may block: walls, then faces, the last build."""
        faces, walls = len(self.face_a), len(self.wall_a)
        meshes = np.array([scene_object.class_ is None for scene_object in self.scene.objects], bool)
        object_index = np.repeat(np.arange(len(meshes)), 4)
        kind = np.concatenate([np.where(self.is_mirror, WALL, VOLUME), np.full(faces, BODY)])
        # the patches of a mesh lie inside its box
        owner = np.concatenate([np.full(walls, -1), np.where(meshes[object_index], object_index, -1)])
        build = np.concatenate([self.wall_build, np.full(faces, len(self.transmission) - 1)])
        box = np.concatenate([np.full(walls, -1), object_index])
        return kind.astype(np.int8), owner.astype(np.int32), build.astype(np.int32), box.astype(np.int32)


def prepare(scene: Scene, seed: int = 0, setup: RadarSetup | None = None) -> World:
    """Draw a scene's scatterers (phases fixed by `seed`) and flatten it for `trace`; ValueError from `check_scene`."""
    if seed < 0:
        raise ValueError(f"seed must not be negative, got {seed!r}")
    if scene.radars:
        names = ", ".join(scene.radars)
        raise ValueError(f"radars: must be none where one is simulated, which radar.mounting places, got {names}")
    check_scene(scene)
    setup = scene.setup if setup is None else setup
    pieces = [
        (np.array(a), np.array(b), index)
        for index, surface in enumerate(scene.surfaces)
        if surface.role != "ground"
        for a, b in zip(surface.polyline_m[:-1], surface.polyline_m[1:], strict=True)
    ]
    owner = np.array([index for *_, index in pieces], np.int32)
    surfaces = [scene.surfaces[index] for index in owner]
    drawn = WallPieces(
        a=np.array([a for a, *_ in pieces], np.float64).reshape(-1, 2),
        b=np.array([b for _, b, _ in pieces], np.float64).reshape(-1, 2),
        height_m=np.array([surface.height_m for surface in surfaces], np.float64),
        curvature_per_m=np.array([surface.curvature_per_m for surface in surfaces], np.float64),
        is_volume=np.array([is_volume(surface.material) for surface in surfaces], bool),
    )
    chord_m = np.hypot(*(drawn.b - drawn.a).T)
    drawn = replace(drawn, curvature_per_m=as_bent(drawn.curvature_per_m, chord_m, setup.radar.wavelength_m))
    standing = cut_coincident(drawn, setup.radar_height_m)
    coinciding_m: dict[tuple[int, int], float] = {}
    for goes, stands, metres in standing.left_out:
        pair = int(owner[goes]), int(owner[stands])
        coinciding_m[pair] = coinciding_m.get(pair, 0.0) + metres
    left_out = tuple(
        f"surfaces[{goes}].polyline_m: {metres:.3g} m coincide with surfaces[{stands}], which stands there alone"
        for (goes, stands), metres in coinciding_m.items()
    )
    for line in left_out:
        _LOG.warning("scene %r: %s", scene.name, line)
    wall_a, wall_b, curvature = standing.a, standing.b, drawn.curvature_per_m[standing.piece]
    owner = owner[standing.piece]
    surfaces = [scene.surfaces[index] for index in owner]
    stacks, wall_stack = _stacks(surfaces, setup.radar.carrier_hz)
    transmission, wall_build = _builds(scene, setup.radar, stacks, wall_stack, owner)
    objects = _object_arrays(scene, setup.radar.wavelength_m, seed)
    specks = _wall_specks(wall_a, wall_b, curvature, seed)
    return World(
        scene=scene,
        setup=setup,
        radar=setup.radar,
        radar_height_m=setup.radar_height_m,
        wall_a=wall_a,
        wall_b=wall_b,
        wall_height_m=standing.height_m,
        wall_curvature_per_m=curvature,
        wall_roughness_m=np.array([1e-3 * surface.roughness_mm for surface in surfaces], np.float64),
        wall_surface=owner,
        wall_stack=wall_stack,
        stacks=stacks,
        transmission=transmission,
        wall_build=wall_build,
        **objects,
        **specks,
        wall_id=np.arange(len(wall_a)),
        speck_id=np.arange(len(specks["speck_m"])),
        object_id=np.arange(len(scene.objects)),
        centre_id=np.arange(len(objects["centre_m"])),
        left_out=left_out,
    )


def radar_pose(scene: Scene, time_s: float) -> Pose2:
    """Return the pose of the radar after a time, in the frame of the vehicle at start."""
    return vehicle_pose(scene, time_s) @ scene.radar.mounting.vehicle_from_radar


def vehicle_pose(scene: Scene, time_s: float) -> Pose2:
    """Return `start_from_vehicle`: the pose of the vehicle after a time."""
    return ego_motion(scene.ego.speed_mps, math.radians(scene.ego.yaw_rate_dps), time_s)


@dataclass(frozen=True)
class SeenPairs:
    """N pairs of pieces of wall of which the second may be seen in the first, in order."""

    #: Int64 [N].
    first: np.ndarray
    second: np.ndarray
    #: Share of the second on which, [N, 2].
    share: np.ndarray


@dataclass(frozen=True)
class Snapshot:
    """A world frozen at a time: the radar and all moving objects at their positions, in the scene's frame."""

    world: World
    pose: Pose2
    #: Antenna, with its height over the ground, [3].
    antenna: np.ndarray
    radar_velocity: np.ndarray
    centre: np.ndarray
    velocity: np.ndarray
    blockers: Blockers
    #: Unit normals [W, 2] of all pieces of wall (of an arc: its chord) towards the radar, and their offsets [W].
    normal: np.ndarray
    offset: np.ndarray
    #: Share of each piece of wall that may be in direct sight, [W, 2]: on the rest of it no path has its first mirror.
    lit: np.ndarray
    #: Which pieces of wall may be seen in which; None: all in all.
    seen_pairs: SeenPairs | None = None
    #: Whether routes that leave behind the antenna, where its elements neither send nor receive, are left out.
    ahead_only: bool = False
    #: Numbers of the pieces of wall beyond a part's reach that are there for their flashes.
    distant: np.ndarray = field(default_factory=lambda: np.zeros(0, np.int64))

    @property
    def origin(self) -> np.ndarray:
        """The antenna's position in the plane, [2]."""
        return self.antenna[:2]

    def is_ahead(self, direction: np.ndarray) -> np.ndarray:
        """Return which directions [N, 2 or 3] from the antenna do not point behind it, bool [N]."""
        yaw = self.pose.yaw_rad
        return np.asarray(direction[:, 0] * math.cos(yaw) + direction[:, 1] * math.sin(yaw) >= -BEHIND)

    @cached_property
    def lit_shares(self) -> np.ndarray:
        """The share of each wall on which a path may have its first mirror, [W, 2]: in direct sight, or rounded."""
        return np.clip(self.lit + np.array([-LIT_MARGIN, LIT_MARGIN]), 0.0, 1.0)

    @cached_property
    def walls(self) -> tuple[np.ndarray, ...]:
        """Ends, normals, offsets and heights of all pieces of wall as compiled code takes them."""
        return self.world.wall_a, self.world.wall_b, self.normal, self.offset, self.world.wall_height_m


@dataclass(frozen=True)
class RadarState:
    """The radar's pose in the scene's frame, and its velocity there, [2]."""

    pose: Pose2
    velocity: np.ndarray


def scene_radar(scene: Scene, time_s: float) -> RadarState:
    """Return the state of a radar that moves as the scene says."""
    pose, mounted = radar_pose(scene, time_s), scene.radar.mounting
    turn_rps = math.radians(scene.ego.yaw_rate_dps)
    heading_rad = pose.yaw_rad - math.radians(mounted.yaw_deg)
    in_vehicle = np.array([scene.ego.speed_mps - turn_rps * mounted.y_m, turn_rps * mounted.x_m])
    return RadarState(pose, Pose2(yaw_rad=heading_rad).rotate(in_vehicle))


def snapshot(world: World, time_s: float = 0.0, radar: RadarState | None = None) -> Snapshot:
    """Move objects and radar to a time; `radar` where it does not move as the scene says."""
    radar = scene_radar(world.scene, time_s) if radar is None else radar
    pose = radar.pose
    shift = world.velocity_mps * time_s
    centre = world.centre_m.copy()
    centre[:, :2] += shift[world.centre_object]
    origin = np.array([pose.x_m, pose.y_m])
    normal, offset = wall_lines(world, origin)
    return Snapshot(
        world=world,
        pose=pose,
        antenna=np.array([pose.x_m, pose.y_m, world.radar_height_m]),
        radar_velocity=radar.velocity,
        centre=centre,
        velocity=world.velocity_mps[world.centre_object],
        blockers=_blockers(world, np.repeat(shift, 4, axis=0)),
        normal=normal,
        offset=offset,
        lit=np.tile([0.0, 1.0], (len(world.wall_a), 1)),
    )


def _blockers(world: World, face_shift: np.ndarray) -> Blockers:
    """Return all pieces of wall and the faces of all objects, moved [faces, 2], as they stand in the way of rays."""
    kind, owner, build, box = world.blocker_kinds
    return Blockers(
        a=np.concatenate([world.wall_a, world.face_a + face_shift]),
        b=np.concatenate([world.wall_b, world.face_b + face_shift]),
        height_m=np.concatenate([world.wall_height_m, world.face_height_m]),
        curvature_per_m=np.concatenate([world.wall_curvature_per_m, np.zeros(len(face_shift))]),
        kind=kind,
        owner=owner,
        build=build,
        box=box,
        transmission=world.transmission,
        wavelength_m=world.radar.wavelength_m,
    )


def wall_blockers(world: World) -> Blockers:
    """Return all pieces of wall as they stand in the way of rays."""
    return _blockers(world, np.zeros((len(world.face_a), 2))).take(np.arange(len(world.wall_a)))


def wall_lines(world: World, origin: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the unit normals [W, 2] towards a point and offsets [W] of all pieces of wall."""
    left, middle = world.wall_frames
    side = np.where(np.einsum("wi,wi->w", origin - middle, left) < 0.0, -1.0, 1.0)
    normal = left * side[:, None]
    return normal, -np.einsum("wi,wi->w", normal, middle)


def _stacks(surfaces: list[Surface], carrier_hz: float) -> tuple[tuple[Layers, ...], np.ndarray]:
    """Return the distinct builds of all walls, and the index of each piece's build."""
    stack_index: dict[Layers, int] = {}
    index = []
    for surface in surfaces:
        if is_volume(surface.material):
            index.append(-1)
            continue
        thickness_m = None if surface.thickness_mm is None else 1e-3 * surface.thickness_mm
        layers = wall_layers(surface.material, thickness_m, carrier_hz)
        index.append(stack_index.setdefault(layers, len(stack_index)))
    return tuple(stack_index), np.array(index, np.int32)


def _builds(
    scene: Scene, radar: RadarParams, stacks: tuple[Layers, ...], wall_stack: np.ndarray, wall_surface: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the rows of `World.transmission` (walls, 0 without a back, then foliage) and each piece's, int32 [W]."""
    cosine = np.linspace(0.0, 1.0, TABLE_STEPS + 1)
    volumes, place = np.unique(wall_surface[wall_stack < 0], return_inverse=True)
    wall_build = wall_stack.astype(np.int32)
    wall_build[wall_stack < 0] = len(stacks) + place
    rows: list[np.ndarray] = []
    for layers in stacks:
        permittivities, thicknesses = np.array([e for e, _ in layers]), np.array([d for _, d in layers])
        if np.isinf(thicknesses).any():
            rows.append(np.zeros(len(cosine), np.complex128))
            continue
        through = stack_transmission(permittivities, thicknesses, cosine, radar.wavelength_m)
        # against the same stretch of air
        rows.append(through * np.exp(2j * np.pi / radar.wavelength_m * thicknesses.sum() * cosine))
    for surface in volumes:
        depth_m = 1e-3 * (scene.surfaces[surface].thickness_mm or 1000.0) / np.maximum(cosine, 0.05)
        rows.append(10.0 ** (-vegetation_db(radar.carrier_hz, depth_m) / 20.0) + 0j)
    return np.stack([*rows, np.zeros(TABLE_STEPS + 1, np.complex128)]), wall_build


def _object_arrays(scene: Scene, wavelength_m: float, seed: int) -> dict[str, Any]:
    """Return the object fields of `World`."""
    objects = list(scene.objects)
    bodies = [_body(scene_object, wavelength_m) for scene_object in objects]
    sizes = [0 if body is None else len(body.position_m) for body in bodies]
    first = np.cumsum([0, *sizes])
    centres = [_centres(each, bodies[index], first[index], seed, index) for index, each in enumerate(objects)]
    corners = [scene_object.corners_m() for scene_object in objects]
    yaw = np.radians([scene_object.yaw_deg for scene_object in objects])
    speed = np.array([scene_object.speed_mps for scene_object in objects])

    def joined(arrays: list[np.ndarray], *shape: int) -> np.ndarray:
        return np.concatenate(arrays) if arrays else np.zeros((0, *shape))

    def on_plan(scene_object: SceneObject, points: np.ndarray, origin: np.ndarray) -> np.ndarray:
        """Return the points or vectors of the object's frame, their third coordinate kept."""
        return np.concatenate([scene_object.place(points[..., :2]) - origin, points[..., 2:]], axis=-1)

    positions = [np.array([scene_object.x_m, scene_object.y_m]) for scene_object in objects]
    own = list(zip(objects, centres, positions, strict=True))
    return {
        "centre_m": joined([on_plan(scene_object, drawn.position_m, np.zeros(2)) for scene_object, drawn, _ in own], 3),
        "centre_normals": joined(
            [on_plan(scene_object, drawn.normals, position) for scene_object, drawn, position in own], 2, 3
        ),
        "centre_rcs_m2": joined([drawn.peak_rcs_m2 for drawn in centres]),
        "centre_phase_rad": joined([drawn.phase_rad for drawn in centres]),
        "centre_exponent": joined([drawn.lobe_exponent for drawn in centres]),
        "centre_floor": joined([np.full(len(drawn.phase_rad), drawn.lobe_floor) for drawn in centres]),
        "centre_object": np.repeat(
            np.arange(len(objects)), np.array([len(centre.phase_rad) for centre in centres], int)
        ),
        "face_a": joined(corners, 2),
        "face_b": joined([np.roll(box, -1, axis=0) for box in corners], 2),
        "face_height_m": np.repeat(np.array([scene_object.kind.height_m for scene_object in objects], float), 4),
        "velocity_mps": np.column_stack([speed * np.cos(yaw), speed * np.sin(yaw)]),
        "bodies": joined_bodies(
            [body.turned(angle) for body, angle in zip(bodies, yaw, strict=True) if body is not None], wavelength_m
        ),
    }


def _body(scene_object: SceneObject, wavelength_m: float) -> Body | None:
    """Return the body of a mesh or primitive, None for a class."""
    mesh = scene_object.shape
    if mesh is None:
        return None
    reach_m = 0.5 * math.hypot(scene_object.kind.length_m, scene_object.kind.width_m)
    range_m = math.hypot(scene_object.x_m, scene_object.y_m) - reach_m
    return body_of(mesh, wavelength_m, scene_object.primitive, range_m)


def _centres(scene_object: SceneObject, body: Body | None, first: int, seed: int, index: int) -> ScatteringCentres:
    """Return the scattering centres of one object: drawn for a class, those of its body, from number `first` on."""
    if body is None:
        return scattering_centres(scene_object.object_class, seed, index)
    count = len(body.position_m)
    return ScatteringCentres(
        position_m=body.position_m,
        normals=np.stack([body.normal, body.normal], axis=1),
        peak_rcs_m2=body.peak_rcs_m2,
        phase_rad=np.zeros(count),
        lobe_exponent=-1.0 - first - np.arange(count),
        lobe_floor=0.0,
    )


def _wall_specks(wall_a: np.ndarray, wall_b: np.ndarray, curvature_per_m: np.ndarray, seed: int) -> dict[str, Any]:
    """Return the wall scatterer fields of `World`: diffuse patches, then structure, piece by piece."""
    position, owner, length, rcs = [np.zeros((0, 2))], [np.zeros(0, int)], [np.zeros(0)], [np.zeros(0)]
    normal = [np.zeros((0, 2))]
    rng = np.random.default_rng([seed, 2])
    for index, (a, b) in enumerate(zip(wall_a, wall_b, strict=True)):
        wall_length = math.dist(a, b)
        count = max(round(wall_length / PATCH_M), 1)
        patch = (np.arange(count) + rng.uniform(0.2, 0.8, count)) / count
        steps = np.cumsum(rng.uniform(*STRUCTURE_SPACING_M, int(wall_length / STRUCTURE_SPACING_M[0]) + 1))
        # ends have an echo of their own (`los_surfaces`)
        joints = steps[steps < wall_length] / wall_length
        share = np.concatenate([patch, joints])
        position.append(arc_points(a, b, curvature_per_m[index], share))
        normal.append(arc_normals(a, b, curvature_per_m[index], share))
        owner.append(np.full(len(share), index))
        length.append(np.concatenate([np.full(count, wall_length / count), np.zeros(len(joints))]))
        level_db = rng.normal(STRUCTURE_RCS_DBSM, STRUCTURE_SPREAD_DB, len(joints))
        rcs.append(np.concatenate([np.zeros(count), 10.0 ** (level_db / 10.0)]))
    phase = rng.uniform(0.0, 2.0 * np.pi, sum(map(len, rcs)))
    return {
        "speck_m": np.concatenate(position),
        "speck_normal": np.concatenate(normal),
        "speck_wall": np.concatenate(owner),
        "speck_length_m": np.concatenate(length),
        "speck_rcs_m2": np.concatenate(rcs),
        "speck_phasor": np.exp(1j * phase),
    }
