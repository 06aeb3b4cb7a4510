"""From a scene at a time to paths: direct echoes of objects and walls, and objects seen in walls (image method).

Geometry first, fields second. Exact for planar upright walls in the ray limit. What this tracer leaves out:
diffraction (shadow edges are sharp; a flash or image switches on and off at a wall's end), second and higher order
mirrors, walls mirrored in walls, vehicles as mirrors, ground bounce, transmission through walls, paths with one
bounce only (wall on the way out, direct on the way back), and polarisation change of rays that are not level.

Levels of what walls return directly:
- flash: the image of the radar, field r sqrt(rho) lambda sqrt(P) / (4 pi 2d); from the mirror law alone.
- diffuse: the energy roughness takes from the mirror, |r|^2 (1 - rho), in a Lambert lobe: RCS per area
  4 |r|^2 (1 - rho) cos^2, over the height that the antenna lights; patches of random phase.
- structure (edges, frames, joints): `STRUCTURE_RCS_DBSM` every 1-3 m and at every end of a wall. These levels are
  engineering choices (metal parts of a hand's size), not measurements.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields

import numpy as np

from models.physics.fresnel import coherent_power, slab_reflection
from models.physics.materials import permittivity
from models.physics.mirror import crossing_parameters, cut, reflect
from msgs.frames import Pose2
from msgs.perception import PathClass
from msgs.radar import RadarParams, RadarSetup
from msgs.vehicle import ego_motion
from sim_player.objects import scattering_centres, seen_rcs_m2
from sim_player.scene import Scene, check_scene

#: Patches of the diffuse return along a wall: shorter than a range bin.
PATCH_M = 0.13
#: Two-way elevation beamwidth of four rows: how much of a wall's height a patch stands for.
LIT_ELEVATION_RAD = 0.3
#: Median and spread of the wall's own small scatterers.
STRUCTURE_RCS_DBSM, STRUCTURE_SPREAD_DB = -12.0, 4.0
STRUCTURE_SPACING_M = (1.0, 3.0)
#: Nearer than this the radar equation means nothing; distances are taken as at least this.
NEAREST_M = 0.1


@dataclass(frozen=True)
class Paths:
    """P paths of one instant; points in the radar's frame (z above the antenna) in metres."""

    #: `PathClass` values, uint8 [P].
    kind: np.ndarray
    #: Round trip, and half its rate of change (the radial speed of the virtual point).
    length_m: np.ndarray
    radial_speed_mps: np.ndarray
    #: Direction of arrival at the radar.
    azimuth_rad: np.ndarray
    elevation_rad: np.ndarray
    #: Complex field weight without the antenna, transmit power included, in sqrt(mW).
    amplitude: np.ndarray
    #: Piece of wall that returned or mirrored it (index into `World.wall_a`), -1 for none; int32.
    surface: np.ndarray
    #: Object it comes from, -1 for none; int32.
    thing: np.ndarray
    #: Where the scatterer is, and where it seems to be: [P, 3].
    point_m: np.ndarray
    virtual_m: np.ndarray

    def __len__(self) -> int:
        return len(self.length_m)

    def take(self, which: np.ndarray) -> Paths:
        """The paths of an index or mask."""
        return Paths(**{field.name: getattr(self, field.name)[which] for field in fields(self)})


@dataclass(frozen=True)
class World:
    """A scene made ready for tracing: flat arrays, randomness drawn. W wall pieces, K centres, Q wall scatterers."""

    scene: Scene
    radar: RadarParams
    radar_height_m: float
    #: Wall pieces: ends [W, 2], heights, material constants [W], index of the scene's surface.
    wall_a: np.ndarray
    wall_b: np.ndarray
    wall_height_m: np.ndarray
    wall_permittivity: np.ndarray
    wall_thickness_m: np.ndarray
    wall_roughness_m: np.ndarray
    wall_surface: np.ndarray
    #: Scattering centres of all objects at start: [K, 3], [K, 2, 2], [K]...
    centre_m: np.ndarray
    centre_normals: np.ndarray
    centre_rcs_m2: np.ndarray
    centre_phase_rad: np.ndarray
    centre_exponent: np.ndarray
    centre_object: np.ndarray
    #: Box faces of all objects at start, 4 each, and object velocities [objects, 2].
    face_a: np.ndarray
    face_b: np.ndarray
    face_height_m: np.ndarray
    velocity_mps: np.ndarray
    #: Wall scatterers: place [Q, 2], piece of wall, length of wall it stands for (0: structure), RCS, unit phasor.
    speck_m: np.ndarray
    speck_wall: np.ndarray
    speck_length_m: np.ndarray
    speck_rcs_m2: np.ndarray
    speck_phasor: np.ndarray


def prepare(scene: Scene, seed: int = 0, setup: RadarSetup | None = None) -> World:
    """Draw a scene's scatterers (phases fixed by `seed`) and flatten it for `trace`; ValueError from `check_scene`."""
    if seed < 0:
        raise ValueError(f"seed must not be negative, got {seed!r}")
    check_scene(scene)
    setup = scene.setup if setup is None else setup
    walls = [
        (np.array(a), np.array(b), index)
        for index, surface in enumerate(scene.surfaces)
        if surface.role != "ground"
        for a, b in zip(surface.polyline_m[:-1], surface.polyline_m[1:], strict=True)
    ]
    owner = np.array([index for *_, index in walls], np.int32)
    surfaces = [scene.surfaces[index] for index in owner]
    wall_a = np.array([a for a, *_ in walls], np.float64).reshape(-1, 2)
    wall_b = np.array([b for _, b, _ in walls], np.float64).reshape(-1, 2)
    return World(
        scene=scene,
        radar=setup.radar,
        radar_height_m=setup.radar_height_m,
        wall_a=wall_a,
        wall_b=wall_b,
        wall_height_m=np.array([surface.height_m for surface in surfaces], np.float64),
        wall_permittivity=np.array([permittivity(s.material, setup.radar.carrier_hz) for s in surfaces], np.complex128),
        wall_thickness_m=np.array([np.inf if s.thickness_mm is None else 1e-3 * s.thickness_mm for s in surfaces]),
        wall_roughness_m=np.array([1e-3 * surface.roughness_mm for surface in surfaces], np.float64),
        wall_surface=owner,
        **_object_arrays(scene, seed),
        **_wall_specks(wall_a, wall_b, seed),
    )


def radar_pose(scene: Scene, time_s: float) -> Pose2:
    """`start_from_now`: where the radar is after a time."""
    return ego_motion(scene.ego.speed_mps, math.radians(scene.ego.yaw_rate_dps), time_s)


def trace(world: World, time_s: float = 0.0) -> Paths:
    """All paths at a time after start, of the kinds the module names: LOS objects, walls, mirrored objects."""
    view = _View.at(world, time_s)
    parts = [_direct_objects(view), _wall_flashes(view), _wall_specks_seen(view), _mirrored_objects(view)]
    return _in_radar_frame(view, [part for part in parts if len(part.length_m)])


@dataclass(frozen=True)
class _View:
    """A world frozen at a time: the radar and everything that moves at its place, in the scene's frame."""

    world: World
    pose: Pose2
    origin: np.ndarray
    radar_velocity: np.ndarray
    centre: np.ndarray
    velocity: np.ndarray
    blocker_a: np.ndarray
    blocker_b: np.ndarray
    blocker_height: np.ndarray
    #: Unit normals [W, 2] of all pieces of wall towards the radar, and their offsets [W].
    normal: np.ndarray
    offset: np.ndarray

    @classmethod
    def at(cls, world: World, time_s: float) -> _View:
        """Move objects and radar to a time."""
        pose = radar_pose(world.scene, time_s)
        shift = world.velocity_mps * time_s
        face_shift = np.repeat(shift, 4, axis=0)
        speed = world.scene.ego.speed_mps
        centre = world.centre_m.copy()
        centre[:, :2] += shift[world.centre_object]
        origin = np.array([pose.x_m, pose.y_m])
        normal, offset = _wall_lines(world, origin)
        return cls(
            world=world,
            pose=pose,
            origin=origin,
            radar_velocity=speed * np.array([math.cos(pose.yaw_rad), math.sin(pose.yaw_rad)]),
            centre=centre,
            velocity=world.velocity_mps[world.centre_object],
            blocker_a=np.concatenate([world.wall_a, world.face_a + face_shift]),
            blocker_b=np.concatenate([world.wall_b, world.face_b + face_shift]),
            blocker_height=np.concatenate([world.wall_height_m, world.face_height_m]),
            normal=normal,
            offset=offset,
        )

    def free(
        self, start: np.ndarray, end: np.ndarray, start_z: np.ndarray | float, end_z: np.ndarray | float
    ) -> np.ndarray:
        """Which straight legs [N] pass every wall and box, or over them."""
        along_ray, along_wall = crossing_parameters(start, end, self.blocker_a, self.blocker_b)
        hit = cut(along_ray, along_wall, start, end, self.blocker_a, self.blocker_b)
        start_z, end_z = np.broadcast_to(start_z, len(end))[:, None], np.broadcast_to(end_z, len(end))[:, None]
        below = start_z + (end_z - start_z) * along_ray < self.blocker_height
        return ~(hit & below).any(axis=1)


@dataclass(frozen=True)
class _Part:
    """Paths of one kind in the scene's frame: what `Paths` is made of."""

    kind: PathClass
    length_m: np.ndarray
    radial_speed_mps: np.ndarray
    amplitude: np.ndarray
    surface: np.ndarray
    thing: np.ndarray
    point: np.ndarray
    virtual: np.ndarray


def _direct_objects(view: _View) -> _Part:
    """Scattering centres in direct sight."""
    world, centre = view.world, view.centre
    rcs = _seen_rcs(world, np.arange(len(centre)), _unit(view.origin - centre[:, :2]))
    which = np.flatnonzero(rcs > 0.0)
    which = which[view.free(view.origin, centre[which, :2], world.radar_height_m, centre[which, 2])]
    target = centre[which]
    ray = _ray(view, target)
    length = 2.0 * np.maximum(_norm(ray), NEAREST_M)
    phasor = np.exp(1j * world.centre_phase_rad[which])
    return _Part(
        PathClass.LOS,
        length,
        2.0 * _dot(ray[:, :2], view.velocity[which] - view.radar_velocity) / length,
        echo_amplitude(world.radar, rcs[which], 0.5 * length) * phasor,
        np.full(len(which), -1),
        world.centre_object[which],
        target,
        target,
    )


def _mirrored_objects(view: _View) -> _Part:
    """Scattering centres seen in each piece of wall: the specular point inside the piece, both legs free."""
    world, centre = view.world, view.centre
    wall, target = _mirror_pairs(view)
    normal, offset = view.normal[wall], view.offset[wall]
    image = reflect(centre[target], normal, offset)
    # the specular point, by the heights over the wall of the two ends (exact, no line intersection needed)
    radar_height = normal @ view.origin + offset
    target_height = _dot(centre[target, :2], normal) + offset
    share = (radar_height / (radar_height + target_height))[:, None]
    radar3 = np.array([*view.origin, world.radar_height_m])
    specular = radar3 + share * (image - radar3)
    rcs = _seen_rcs(world, target, _unit(specular[:, :2] - centre[target, :2]))
    seen = (rcs > 0.0) & _within(specular, world, wall)
    seen[seen] = view.free(view.origin, specular[seen, :2], world.radar_height_m, specular[seen, 2])
    seen[seen] = view.free(specular[seen, :2], centre[target[seen], :2], specular[seen, 2], centre[target[seen], 2])
    wall, target, image, normal, rcs = wall[seen], target[seen], image[seen], normal[seen], rcs[seen]
    ray = _ray(view, image)
    length = 2.0 * np.maximum(_norm(ray), NEAREST_M)
    image_velocity = reflect(view.velocity[target], normal, 0.0)
    field = _wall_field(world, wall, np.abs(_dot(ray[:, :2], normal)) / (0.5 * length))
    return _Part(
        PathClass.MIRRORED,
        length,
        2.0 * _dot(ray[:, :2], image_velocity - view.radar_velocity) / length,
        # two bounces square the field: out by the wall and back by it
        echo_amplitude(world.radar, rcs, 0.5 * length) * field**2 * np.exp(1j * world.centre_phase_rad[target]),
        wall,
        world.centre_object[target],
        centre[target],
        image,
    )


def _mirror_pairs(view: _View) -> tuple[np.ndarray, np.ndarray]:
    """Candidate (wall, centre) pairs: the centre on the radar's side, the specular point within the ends."""
    world = view.world
    if not len(world.wall_a) or not len(view.centre):
        return np.zeros(0, int), np.zeros(0, int)
    normal, offset = view.normal, view.offset
    height = normal @ view.centre[:, :2].T + offset[:, None]  # [W, K]
    radar_height = (normal @ view.origin + offset)[:, None]
    along = world.wall_b - world.wall_a
    squared = _dot(along, along)[:, None]
    target_share = (along @ view.centre[:, :2].T - _dot(along, world.wall_a)[:, None]) / squared
    radar_share = ((along @ view.origin) - _dot(along, world.wall_a))[:, None] / squared
    # similar triangles: the feet of both, weighted by the other's height
    with np.errstate(divide="ignore", invalid="ignore"):
        share = (radar_share * height + target_share * radar_height) / (height + radar_height)
        wall, target = np.nonzero((height > 1e-9) & (radar_height > 1e-9) & (share >= 0.0) & (share <= 1.0))
    return wall, target


def _wall_flashes(view: _View) -> _Part:
    """The image of the radar itself where the foot of the perpendicular lies on a visible piece of wall."""
    world = view.world
    normal, offset = view.normal, view.offset
    distance = normal @ view.origin + offset
    foot = view.origin - distance[:, None] * normal
    along = world.wall_b - world.wall_a
    share = _dot(foot - world.wall_a, along) / _dot(along, along)
    height = world.radar_height_m
    wall = np.flatnonzero((share >= 0.0) & (share <= 1.0) & (world.wall_height_m > height) & (distance > NEAREST_M))
    wall = wall[view.free(view.origin, foot[wall], height, height)]
    distance = distance[wall]
    spreading = world.radar.wavelength_m / (4.0 * np.pi * 2.0 * distance)
    point = np.column_stack([foot[wall], np.full(len(wall), height)])
    return _Part(
        PathClass.LOS,
        2.0 * distance,
        normal[wall] @ view.radar_velocity,
        math.sqrt(1e3 * world.radar.transmit_power_w) * spreading * _wall_field(world, wall, np.ones(len(wall))),
        wall,
        np.full(len(wall), -1),
        point,
        point,
    )


def _wall_specks_seen(view: _View) -> _Part:
    """Diffuse patches and structure of all walls in direct sight."""
    world = view.world
    height = world.radar_height_m
    tall = np.flatnonzero(world.wall_height_m[world.speck_wall] > height)
    which = tall[view.free(view.origin, world.speck_m[tall], height, height)]
    wall = world.speck_wall[which]
    ray = world.speck_m[which] - view.origin
    distance = np.maximum(_norm(ray), NEAREST_M)
    cosine = np.minimum(np.abs(_dot(ray, view.normal[wall])) / distance, 1.0)
    reflected = np.abs(_fresnel(world, wall, cosine)) ** 2
    lost = reflected * (1.0 - coherent_power(world.wall_roughness_m[wall], cosine, world.radar.wavelength_m))
    lit_height = np.minimum(world.wall_height_m[wall], LIT_ELEVATION_RAD * distance)
    rcs = world.speck_rcs_m2[which] + 4.0 * lost * cosine**2 * lit_height * world.speck_length_m[which]
    point = np.column_stack([world.speck_m[which], np.full(len(which), height)])
    return _Part(
        PathClass.LOS,
        2.0 * distance,
        -_dot(ray, np.broadcast_to(view.radar_velocity, ray.shape)) / distance,
        echo_amplitude(world.radar, rcs, distance) * world.speck_phasor[which],
        wall,
        np.full(len(which), -1),
        point,
        point,
    )


def echo_amplitude(radar: RadarParams, rcs_m2: np.ndarray, range_m: np.ndarray) -> np.ndarray:
    """Radar equation without the antenna, as a field in sqrt(mW): sqrt(P lambda^2 sigma / ((4 pi)^3 R^4))."""
    power_mw = 1e3 * radar.transmit_power_w * radar.wavelength_m**2 * rcs_m2 / (4.0 * np.pi) ** 3
    return np.sqrt(power_mw) / np.square(range_m)


def _wall_field(world: World, wall: np.ndarray, cosine: np.ndarray) -> np.ndarray:
    """Field of one bounce: r sqrt(rho), vertical polarisation (TE)."""
    cosine = np.minimum(cosine, 1.0)
    rho = coherent_power(world.wall_roughness_m[wall], cosine, world.radar.wavelength_m)
    return _fresnel(world, wall, cosine) * np.sqrt(rho)


def _fresnel(world: World, wall: np.ndarray, cosine: np.ndarray) -> np.ndarray:
    """Slab (or half-space) coefficient of the pieces of wall."""
    return slab_reflection(
        world.wall_permittivity[wall], cosine, world.wall_thickness_m[wall], world.radar.wavelength_m
    )


def _wall_lines(world: World, origin: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Unit normals [W, 2] towards a place and offsets [W] of all pieces of wall."""
    along = world.wall_b - world.wall_a
    normal = np.column_stack([-along[:, 1], along[:, 0]]) / _norm(along)[:, None]
    middle = 0.5 * (world.wall_a + world.wall_b)
    side = np.where(_dot(origin - middle, normal) < 0.0, -1.0, 1.0)
    normal *= side[:, None]
    return normal, -_dot(normal, middle)


def _within(specular: np.ndarray, world: World, wall: np.ndarray) -> np.ndarray:
    """Which specular points are not above their wall's top."""
    return specular[:, 2] < world.wall_height_m[wall]


def _seen_rcs(world: World, which: np.ndarray, direction: np.ndarray) -> np.ndarray:
    """RCS of some centres towards plane directions."""
    return seen_rcs_m2(world.centre_rcs_m2[which], world.centre_normals[which], world.centre_exponent[which], direction)


def _in_radar_frame(view: _View, parts: list[_Part]) -> Paths:
    """All parts as one set of paths, seen from the radar."""
    if not parts:
        parts = [_nothing()]
    virtual = _to_radar(view, np.concatenate([part.virtual for part in parts]))
    plan = np.hypot(virtual[:, 0], virtual[:, 1])
    return Paths(
        kind=np.concatenate([np.full(len(part.length_m), part.kind, np.uint8) for part in parts]),
        length_m=np.concatenate([part.length_m for part in parts]),
        radial_speed_mps=np.concatenate([part.radial_speed_mps for part in parts]),
        azimuth_rad=np.arctan2(virtual[:, 1], virtual[:, 0]),
        elevation_rad=np.arctan2(virtual[:, 2], plan),
        amplitude=np.concatenate([part.amplitude for part in parts]).astype(np.complex128),
        surface=np.concatenate([part.surface for part in parts]).astype(np.int32),
        thing=np.concatenate([part.thing for part in parts]).astype(np.int32),
        point_m=_to_radar(view, np.concatenate([part.point for part in parts])),
        virtual_m=virtual,
    )


def _nothing() -> _Part:
    """No paths."""
    empty, points = np.zeros(0), np.zeros((0, 3))
    return _Part(PathClass.LOS, empty, empty, empty, empty, empty, points, points)


def _to_radar(view: _View, points: np.ndarray) -> np.ndarray:
    """Scene points [N, 3] (heights above ground) in the radar's frame (heights above the antenna)."""
    plan = view.pose.inverse().apply(points[:, :2])
    return np.column_stack([plan, points[:, 2] - view.world.radar_height_m])


def _ray(view: _View, targets: np.ndarray) -> np.ndarray:
    """Vectors [N, 3] from the antenna to points [N, 3]."""
    return targets - np.array([*view.origin, view.world.radar_height_m])


def _norm(vectors: np.ndarray) -> np.ndarray:
    return np.sqrt(_dot(vectors, vectors))


def _dot(left: np.ndarray, right: np.ndarray) -> np.ndarray:
    return np.einsum("...i,...i->...", left, right)


def _unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.maximum(_norm(vectors), 1e-9)[..., None]


def _object_arrays(scene: Scene, seed: int) -> dict[str, np.ndarray]:
    """The object fields of `World`."""
    things = list(enumerate(scene.objects))
    centres = [scattering_centres(thing.class_, seed, index) for index, thing in things]
    corners = [thing.corners_m() for _, thing in things]
    yaw = np.radians([thing.yaw_deg for _, thing in things])
    speed = np.array([thing.speed_mps for _, thing in things])

    def joined(arrays: list[np.ndarray], *shape: int) -> np.ndarray:
        return np.concatenate(arrays) if arrays else np.zeros((0, *shape))

    placed = [
        np.column_stack([thing.place(own.position_m[:, :2]), own.position_m[:, 2]])
        for (_, thing), own in zip(things, centres, strict=True)
    ]
    turned = [
        thing.place(own.normals) - np.array([thing.x_m, thing.y_m])
        for (_, thing), own in zip(things, centres, strict=True)
    ]
    return {
        "centre_m": joined(placed, 3),
        "centre_normals": joined(turned, 2, 2),
        "centre_rcs_m2": joined([own.peak_rcs_m2 for own in centres]),
        "centre_phase_rad": joined([own.phase_rad for own in centres]),
        "centre_exponent": joined([own.lobe_exponent for own in centres]),
        "centre_object": np.repeat(np.arange(len(things)), np.array([len(own.phase_rad) for own in centres], int)),
        "face_a": joined(corners, 2),
        "face_b": joined([np.roll(box, -1, axis=0) for box in corners], 2),
        "face_height_m": np.repeat(np.array([thing.kind.height_m for _, thing in things], float), 4),
        "velocity_mps": np.column_stack([speed * np.cos(yaw), speed * np.sin(yaw)]),
    }


def _wall_specks(wall_a: np.ndarray, wall_b: np.ndarray, seed: int) -> dict[str, np.ndarray]:
    """The wall scatterer fields of `World`: diffuse patches, then structure, piece by piece."""
    place, owner, length, rcs = [np.zeros((0, 2))], [np.zeros(0, int)], [np.zeros(0)], [np.zeros(0)]
    rng = np.random.default_rng([seed, 2])
    for index, (a, b) in enumerate(zip(wall_a, wall_b, strict=True)):
        wall_length = math.dist(a, b)
        count = max(round(wall_length / PATCH_M), 1)
        patch = (np.arange(count) + rng.uniform(0.2, 0.8, count)) / count
        steps = np.cumsum(rng.uniform(*STRUCTURE_SPACING_M, int(wall_length / STRUCTURE_SPACING_M[0]) + 1))
        joints = np.concatenate([[0.0, 1.0], steps[steps < wall_length] / wall_length])
        # the ends a hand's breadth inside, where a real edge has its depth
        joints = np.clip(joints, 0.02 / wall_length, max(1.0 - 0.02 / wall_length, 0.5))
        share = np.concatenate([patch, joints])
        place.append(a + share[:, None] * (b - a))
        owner.append(np.full(len(share), index))
        length.append(np.concatenate([np.full(count, wall_length / count), np.zeros(len(joints))]))
        level_db = rng.normal(STRUCTURE_RCS_DBSM, STRUCTURE_SPREAD_DB, len(joints))
        rcs.append(np.concatenate([np.zeros(count), 10.0 ** (level_db / 10.0)]))
    phase = rng.uniform(0.0, 2.0 * np.pi, sum(map(len, rcs)))
    return {
        "speck_m": np.concatenate(place),
        "speck_wall": np.concatenate(owner),
        "speck_length_m": np.concatenate(length),
        "speck_rcs_m2": np.concatenate(rcs),
        "speck_phasor": np.exp(1j * phase),
    }
