"""Random drives past a side street from a seed: streets, walls, parked and moving road users, speeds, sight lines.

The vehicle starts at (0, 0) along x; a side street opens on the left (on the right in half of the scenes), and a road
user comes down it towards the main street. It is hidden at first and comes into direct sight within the drive. Mirrors
are not required: in some streets no wall shows the road user before it is in direct sight.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
from msgspec.structs import replace

from models.physics.mirror import blocked
from models.physics.plane import segment_distance_m
from msgs.values.frames import Pose2
from msgs.values.perception import PathClass
from sim_player.drive import Drive, DrivePlayer
from sim_player.generate.domain_shift import BUSH, POST, SIGN, Clutter
from sim_player.generate.layouts import ACROSS, FRONT, ROADSIDE
from sim_player.generate.placement import Boxes, Walls
from sim_player.generate.places import draw_ground, draw_radar, draw_weather
from sim_player.generate.wall_kinds import FINISHES, Line, build, surface
from sim_player.scene.description import OBJECT_KINDS, Scene, SceneObject, Surface, check_scene
from sim_player.trace.paths import Paths
from sim_player.trace.truth import labelled

#: Index of the road user that comes down the side street.
CROSSING = 0
#: View across the junction: the main street's other side, its bend, or the end of a T-junction.
Layout = Literal["parallel", "bend", "across"]
LAYOUTS: tuple[Layout, ...] = ("parallel", "bend", "across")
#: Manner of driving past.
Manner = Literal["steady", "braking", "turning"]
MANNERS: tuple[Manner, ...] = ("steady", "braking", "turning")
#: Probability of each class in the side street, and its band of speeds [m/s].
CLASS_SHARE = {"car": 0.45, "van": 0.15, "truck": 0.08, "bus": 0.05, "bicycle": 0.15, "pedestrian": 0.12}
SPEED_MPS = {
    "car": (3.0, 12.0),
    "van": (3.0, 12.0),
    "truck": (3.0, 9.0),
    "bus": (3.0, 9.0),
    "bicycle": (2.0, 7.0),
    "pedestrian": (0.8, 2.5),
}
EGO_SPEED_MPS, BRAKING_MPS2, TURN_DPS = (2.0, 12.0), (1.0, 3.0), (3.0, 12.0)
#: Time of direct sight after the start [s], and the step of the search for it.
SIGHT_S, STEP_S = (2.1, 7.5), 0.3
#: Duration of a drive [s], a little more than the latest sight.
DURATION_S = 9.0
#: Share of scenes with a low wall at the corner in place of a house, a parked vehicle in the side street, an oncoming
#: vehicle and a pedestrian in plain sight; share of parking bays that are taken.
LOW_CORNER, PARKED_ASIDE, ONCOMING, WALKER, TAKEN = 0.25, 0.4, 0.3, 0.4, 0.35
MASONRY = ("concrete", "painted", "rendered", "brick")
#: Room between the vehicle's path and walls, between its path and road users, and between road users and walls [m].
WALL_ROOM_M, USER_ROOM_M, FOOTING_M = 1.2, 1.8, 0.3
#: Streets drawn before an error: about one in three is suitable.
ATTEMPTS = 2000


@dataclass(frozen=True)
class SideStreet:
    """A scene in the vehicle's frame at the start, and the vehicle's drive; object `CROSSING` comes out."""

    scene: Scene
    drive: Drive
    layout: Layout
    manner: Manner


@dataclass(frozen=True)
class _Plan:
    """Measures of a street [m]: sides of the main street, mouth of the side street along x."""

    left_m: float
    right_m: float
    near_m: float
    far_m: float
    layout: Layout


def random_side_street(seed: int, index: int = 0) -> SideStreet:
    """Draw drive number `index` of the series `seed`; its scene passes `check_scene`.

    Fixed by its arguments. ValueError for a negative seed or index.
    """
    for name, number in (("seed", seed), ("index", index)):
        if number < 0:
            raise ValueError(f"{name} must not be negative, got {number!r}")
    rng = np.random.default_rng([seed, index])
    for _ in range(ATTEMPTS):
        street = _draw(rng, f"side_street_{seed}_{index}")
        sight_s = _sight_s(street) if _is_legal(street.scene) else None
        if sight_s is not None and _has_room(street, sight_s):
            return street
    raise RuntimeError(f"no side street in {ATTEMPTS} draws of seed {seed}, index {index}")


def direct_sight(paths: Paths) -> bool:
    """Return whether the crossing object has a direct path, through no wall and round no edge."""
    return bool((labelled(paths) & (paths.kind == PathClass.LOS) & (paths.object_index == CROSSING)).any())


def _draw(rng: np.random.Generator, name: str) -> SideStreet:
    """Return one street, suitable or not."""
    speed_mps = float(rng.uniform(*EGO_SPEED_MPS))
    near_m = 4.0 + speed_mps * float(rng.uniform(1.5, 5.0))
    layout = LAYOUTS[rng.integers(len(LAYOUTS))]
    left_m, right_m, mouth_m = (float(rng.uniform(*band)) for band in ((2.5, 6.5), (3.0, 9.0), (6.0, 14.0)))
    plan = _Plan(left_m, right_m, near_m, near_m + mouth_m, layout)
    manner = MANNERS[rng.integers(len(MANNERS))]
    scene = Scene(
        name=name,
        radar=draw_radar(rng, "xband"),
        surfaces=(*_walls(rng, plan), *_clutter(rng, plan), *draw_ground(rng, "xband")),
        objects=_users(rng, plan),
        weather=draw_weather(rng),
    )
    street = SideStreet(scene, _drive(rng, manner, speed_mps), layout, manner)
    return _mirrored(street) if rng.random() < 0.5 else street


def _walls(rng: np.random.Generator, plan: _Plan) -> tuple[Surface, ...]:
    """Return the corner that hides the side street, the house beyond it, and the possible mirrors."""
    start = -float(rng.uniform(0.0, 4.0))
    corner = [(start, plan.left_m), (plan.near_m, plan.left_m), (plan.near_m, plan.left_m + rng.uniform(12.0, 30.0))]
    low = rng.random() < LOW_CORNER
    walls = [_wall(rng, corner, (1.0, 2.2) if low else (3.0, 10.0), "occluder")]
    if plan.layout == "parallel":
        depth_m, front_m = plan.left_m + float(rng.uniform(10.0, 30.0)), plan.far_m + float(rng.uniform(8.0, 20.0))
        beyond = [(plan.far_m, depth_m), (plan.far_m, plan.left_m), (front_m, plan.left_m)]
        walls.append(_wall(rng, beyond, (3.0, 10.0), "occluder"))
    return (*walls, *_mirrors(rng, plan))


def _wall(
    rng: np.random.Generator,
    points: list[tuple[float, float]],
    height_m: tuple[float, float],
    role: Literal["relay", "occluder"],
) -> Surface:
    """Return a masonry wall along points."""
    finish = FINISHES[MASONRY[rng.integers(len(MASONRY))]]
    plain = tuple((float(x), float(y)) for x, y in points)
    return surface(rng, finish, plain, float(rng.uniform(*height_m)), role=role)


def _mirrors(rng: np.random.Generator, plan: _Plan) -> tuple[Surface, ...]:
    """Return the right side of the main street, and the wall that bends with it or ends it."""
    right, start = -plan.right_m, float(rng.uniform(1.0, 6.0))
    if plan.layout == "parallel":
        return _built(rng, (start, right), (plan.far_m + float(rng.uniform(4.0, 20.0)), right), ROADSIDE)
    if plan.layout == "bend":
        bend, turn = plan.near_m + float(rng.uniform(-3.0, 9.0)), math.radians(rng.uniform(25.0, 75.0))
        length = float(rng.uniform(12.0, 28.0))
        tip = (bend + length * math.cos(turn), right + length * math.sin(turn))
        return (
            *_built(rng, (start, right), (bend, right), ROADSIDE),
            *_built(rng, (bend, right), tip, (*FRONT, *ACROSS)),
        )
    lean = math.tan(rng.uniform(-0.15, 0.15))
    end, low, high = plan.far_m, right - float(rng.uniform(0.0, 8.0)), plan.left_m + float(rng.uniform(6.0, 25.0))
    across = _built(rng, (end + lean * low, low), (end + lean * high, high), (*FRONT, *ACROSS))
    return (*_built(rng, (start, right), (plan.near_m + float(rng.uniform(-3.0, 2.0)), right), ROADSIDE), *across)


def _built(rng: np.random.Generator, start: tuple, end: tuple, kinds: tuple) -> tuple[Surface, ...]:
    """Return a wall of one of some kinds; none where it would be shorter than a door."""
    if math.dist(start, end) < 2.0:
        return ()
    return build(rng, Line(start, end, kinds), "xband")[1]


def _clutter(rng: np.random.Generator, plan: _Plan) -> tuple[Surface, ...]:
    """Return the posts, signs and bushes at the kerbs."""
    pieces = []
    for kind, max_count in ((POST, 4), (SIGN, 2), (BUSH, 1)):
        for _ in range(int(rng.integers(0, max_count + 1))):
            pieces.append(_piece(rng, plan, kind))
    return tuple(pieces)


def _piece(rng: np.random.Generator, plan: _Plan, kind: Clutter) -> Surface:
    """Return one piece of clutter."""
    side = (plan.left_m - 0.5, 0.5 - plan.right_m)[rng.integers(2)]
    x, angle = float(rng.uniform(4.0, plan.far_m + 6.0)), float(rng.uniform(0.0, math.pi))
    length_m, height_m = float(rng.uniform(*kind.length_m)), float(rng.uniform(*kind.height_m))
    tip = (x + length_m * math.cos(angle), side + length_m * math.sin(angle))
    return surface(rng, FINISHES[kind.finish], ((x, side), tip), height_m)


def _users(rng: np.random.Generator, plan: _Plan) -> tuple[SceneObject, ...]:
    """Return the crossing road user first, then others, parked and moving."""
    crossing = _crossing(rng, plan)
    users = [crossing]
    if rng.random() < PARKED_ASIDE:
        x = plan.near_m + 1.5 if crossing.x_m > 0.5 * (plan.near_m + plan.far_m) else plan.far_m - 1.5
        users.append(_user(rng, _kind(rng), (x, plan.left_m + rng.uniform(4.0, 22.0)), 90.0))
    bays = [(x, 1.4 - plan.right_m) for x in np.arange(6.0, plan.far_m, 7.0) if plan.right_m > 5.0]
    bays += [(x, plan.left_m - 1.4) for x in np.arange(6.0, plan.near_m - 3.0, 7.0) if plan.left_m > 5.0]
    users += [_user(rng, _kind(rng), bay, 0.0) for bay in bays if rng.random() < TAKEN]
    if plan.layout == "parallel" and plan.left_m > 4.0 and rng.random() < ONCOMING:
        spot = (plan.far_m + rng.uniform(5.0, 30.0), plan.left_m - 1.6)
        users.append(_user(rng, _kind(rng), spot, 180.0, float(rng.uniform(3.0, 12.0))))
    if rng.random() < WALKER:
        spot = (rng.uniform(6.0, plan.far_m), 0.8 - plan.right_m)
        users.append(_user(rng, "pedestrian", spot, float(rng.choice([0.0, 180.0])), float(rng.uniform(0.8, 1.8))))
    return tuple(users)


def _kind(rng: np.random.Generator) -> str:
    """Return the class of a vehicle that parks or drives on the main street."""
    return str(rng.choice(["car", "van", "truck"], p=[0.75, 0.17, 0.08]))


def _user(
    rng: np.random.Generator, name: str, spot: tuple[float, float], heading_deg: float, speed_mps: float = 0.0
) -> SceneObject:
    """Return a road user near a heading."""
    return SceneObject(
        class_=name,  # type: ignore[arg-type]
        x_m=float(spot[0]),
        y_m=float(spot[1]),
        yaw_deg=heading_deg + float(rng.normal(0.0, 2.0)),
        speed_mps=speed_mps,
    )


def _crossing(rng: np.random.Generator, plan: _Plan) -> SceneObject:
    """Return the road user that comes down the side street."""
    name = str(rng.choice(list(CLASS_SHARE), p=list(CLASS_SHARE.values())))
    speed_mps = float(rng.uniform(*SPEED_MPS[name]))
    kind = OBJECT_KINDS[name]
    aside = 0.5 * kind.width_m + 0.6
    spot = (
        float(rng.uniform(plan.near_m + aside, plan.far_m - aside)),
        plan.left_m + 0.5 * kind.length_m + speed_mps * float(rng.uniform(1.0, 8.0)),
    )
    return _user(rng, name, spot, -90.0, speed_mps)


def _drive(rng: np.random.Generator, manner: Manner, speed_mps: float) -> Drive:
    """Return the speed and yaw rate over the drive, [s], [m/s], [rad/s]."""
    time_s = np.arange(0.0, DURATION_S + 0.05, 0.05)
    # the steering wheel is never quite still
    sway_rps = math.radians(rng.uniform(0.0, 1.0))
    yaw_rate_rps = sway_rps * np.sin(2.0 * np.pi * (rng.uniform(0.1, 0.4) * time_s + rng.random()))
    speeds = np.full(len(time_s), speed_mps)
    since_s = np.maximum(time_s - rng.uniform(0.0, 3.0), 0.0)
    if manner == "braking":
        speeds = np.maximum(speed_mps - rng.uniform(*BRAKING_MPS2) * since_s, rng.choice([0.0, 0.3]) * speed_mps)
    if manner == "turning":
        rate_rps = math.radians(rng.uniform(*TURN_DPS)) * rng.choice([-1.0, 1.0])
        yaw_rate_rps += rate_rps * np.minimum(since_s, 1.0)
    return Drive(time_s, speeds, yaw_rate_rps)


def _mirrored(street: SideStreet) -> SideStreet:
    """Return the street with left and right exchanged."""
    scene, drive = street.scene, street.drive

    def wall(piece: Surface) -> Surface:
        flipped = tuple((x, -y) for x, y in piece.polyline_m)
        return replace(piece, polyline_m=flipped, curvature_per_m=-piece.curvature_per_m)

    users = tuple(replace(user, y_m=-user.y_m, yaw_deg=-user.yaw_deg) for user in scene.objects)
    scene = replace(scene, surfaces=tuple(map(wall, scene.surfaces)), objects=users)
    return SideStreet(scene, Drive(drive.time_s, drive.speed_mps, -drive.yaw_rate_rps), street.layout, street.manner)


def _has_room(street: SideStreet, until_s: float) -> bool:
    """Return whether vehicle and road users keep off walls and each other up to a time."""
    scene, times_s = street.scene, np.arange(0.0, until_s + STEP_S, STEP_S)
    walls = Walls.of(_upright(scene))
    poses = [street.drive.pose(float(time_s)) for time_s in times_s]
    path_m = np.array([[pose.x_m, pose.y_m] for pose in poses])
    if segment_distance_m(path_m, *walls.footing).min() < WALL_ROOM_M:
        return False
    boxes = [_boxes_at(scene.objects, float(time_s)) for time_s in times_s]
    near = (segment_distance_m(at[None], *box.faces).min() for at, box in zip(path_m, boxes, strict=True))
    return min(near) >= USER_ROOM_M and not any(_collides(box, walls) for box in boxes)


def _boxes_at(users: tuple[SceneObject, ...], time_s: float) -> Boxes:
    """Return the outlines of all road users at a time, grown by the room they keep."""

    def outline(user: SceneObject) -> np.ndarray:
        turn = math.radians(user.yaw_deg)
        spot = np.array([user.x_m, user.y_m]) + time_s * user.speed_mps * np.array([math.cos(turn), math.sin(turn)])
        length_m, width_m = (side + 2.0 * FOOTING_M for side in (user.kind.length_m, user.kind.width_m))
        return Boxes.at(spot[None], np.array([user.yaw_deg]), length_m, width_m).corners

    return Boxes(np.concatenate([outline(user) for user in users]))


def _collides(boxes: Boxes, walls: Walls) -> bool:
    """Return whether any road user stands in a wall or in another."""
    if boxes.crossed_by(*walls.footing).any():
        return True
    corners = boxes.corners
    return any(
        Boxes(corners[index : index + 1]).crossed_by(*Boxes(np.delete(corners, index, axis=0)).faces).any()
        for index in range(len(corners))
        if len(corners) > 1
    )


def _is_legal(scene: Scene) -> bool:
    """Return whether the simulator takes the scene."""
    try:
        check_scene(scene)
    except ValueError:
        return False
    return True


def _sight_s(street: SideStreet) -> float | None:
    """Return when the crossing object comes into direct sight; None where it is there too early, or not in time."""
    walls, first_s, last_s = Walls.of(_upright(street.scene)), *SIGHT_S
    # seen from above first: most draws are refused here
    if not _is_hidden(street, walls, 0.0):
        return None
    player = DrivePlayer(street.scene, street.drive, Pose2(), chirps_per_beam=1)
    for time_s in np.arange(0.0, last_s + STEP_S, STEP_S):
        if direct_sight(player.paths(float(time_s))):
            return float(time_s) if time_s >= first_s else None
    return None


def _is_hidden(street: SideStreet, walls: Walls, time_s: float) -> bool:
    """Return whether walls stand before the middle of the crossing object."""
    pose = street.drive.pose(time_s)
    middle = _boxes_at(street.scene.objects[:1], time_s).corners[0].mean(axis=0)
    return bool(blocked(np.array([pose.x_m, pose.y_m]), middle[None], walls.a, walls.b)[0])


def _upright(scene: Scene) -> tuple[Surface, ...]:
    """Return all surfaces but the ground."""
    return tuple(surface for surface in scene.surfaces if surface.role != "ground")
