"""The part of a world that a radar's echoes can reach: what is traced of a scene of many walls.

An echo that touches a point at a distance d has a half round trip of d at least, so walls and objects beyond the reach
have no part in shorter echoes, not even by standing in their way. Of the walls within reach all may stand in the way;
mirrors, edges and scatterers are only those that the radar sees (through walls too, as far as anything comes back) or
that it sees in another wall, since paths have two mirrors at most. All echoes up to the reach are those of the whole
world; longer ones are left out.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields, replace

import msgspec
import numpy as np
from scipy.spatial import cKDTree

from models.physics.antenna import element_field
from models.physics.mirror import reflect
from msgs.values.radar import RadarSetup, RangeAzimuthGrid
from msgs.values.units import ratio_from_db
from sim_player.scene.visibility import PlanWalls, lit_walls, split_walls
from sim_player.scene.world import (
    RadarState,
    Snapshot,
    World,
    scene_radar,
    snapshot,
    wall_blockers,
    wall_lines,
)
from sim_player.trace.echoes import echo_amplitude
from sim_player.trace.routes import dot, norm
from sim_player.trace.segments import Blockers, join_blockers

#: Worlds of so many pieces of wall or fewer are traced whole.
WHOLE_WALLS = 64
#: Reach over the range of a map: echoes beyond the map leak into it, the less the further.
REACH_SHARE = 1.5
#: The radar's surroundings are kept while it stays in a square of this side.
SQUARE_M = 16.0
#: Shares of a wall are told apart to so much.
ROUNDING = 1e-7
#: Level under the noise, in any bin, of all that the walls within reach hide together.
HIDDEN_DB = -40.0


def reach_m(setup: RadarSetup) -> float:
    """Return the half round trip up to which a part of a world has all paths."""
    return REACH_SHARE * RangeAzimuthGrid().range_bins * setup.radar.range_bin_m


def reachable_snapshot(world: World, time_s: float = 0.0, radar: RadarState | None = None) -> Snapshot:
    """Return what a radar's echoes can reach of a world at a time; a small world whole.

    `radar`: its state where it does not move as the scene says.
    """
    radar = scene_radar(world.scene, time_s) if radar is None else radar
    if len(world.wall_a) <= WHOLE_WALLS:
        return snapshot(world, time_s, radar)
    origin = np.array([radar.pose.x_m, radar.pose.y_m])
    near = _surroundings(world, origin)
    around = _with_objects(near.world, _objects_within(near.world, origin, time_s))
    direct, lit = _lit(near, around, origin)
    visible = np.flatnonzero(_any(lit))
    view = snapshot(_with_walls(around, visible, _lit_specks(near, direct, lit)), time_s, radar)
    blockers = join_blockers(view.blockers, near.blockers.take(~_any(lit)))
    return replace(view, blockers=replace(blockers, tree=True), lit=direct[visible])


@dataclass(frozen=True)
class _Surroundings:
    """All walls around a square within which the radar stands."""

    world: World
    blockers: Blockers
    #: Its straight walls for `lit_walls`.
    plan: PlanWalls
    #: Factor of a ray behind each piece of wall, [W]: where it only passes beside or over walls, and with what the
    #: most transparent incidence lets through.
    beside: np.ndarray
    through: np.ndarray
    #: Where on its wall each scatterer lies, 0..1, [Q].
    speck_share: np.ndarray


def _surroundings(world: World, origin: np.ndarray) -> _Surroundings:
    """Return the walls around a point, kept with the world while that stays in its square."""
    square = tuple(np.floor(origin / SQUARE_M).astype(int).tolist())
    if world.kept.get("square") != square:
        middle, far_m = SQUARE_M * (np.array(square) + 0.5), reach_m(world.setup) + SQUARE_M * math.sqrt(0.5)
        world.kept.update(square=square, surroundings=_surroundings_of(world, _walls_within(world, middle, far_m)))
    near: _Surroundings = world.kept["surroundings"]
    return near


def _walls_within(world: World, middle: np.ndarray, far_m: float) -> np.ndarray:
    """Return the pieces of wall of which some point may lie within a distance of a point."""
    if "tree" not in world.kept:
        half_m = 0.5 * np.hypot(*(world.wall_b - world.wall_a).T)
        world.kept.update(tree=cKDTree(0.5 * (world.wall_a + world.wall_b)), half_m=half_m)
    half_m = world.kept["half_m"]
    walls = np.array(sorted(world.kept["tree"].query_ball_point(middle, far_m + half_m.max())), int)
    along = world.wall_b[walls] - world.wall_a[walls]
    share = np.clip(dot(middle - world.wall_a[walls], along) / dot(along, along), 0.0, 1.0)
    away = norm(world.wall_a[walls] + share[:, None] * along - middle)
    # an arc stays within half its chord of it
    return np.asarray(walls[away <= far_m + np.where(world.wall_curvature_per_m[walls] == 0.0, 0.0, half_m[walls])])


def _surroundings_of(world: World, walls: np.ndarray) -> _Surroundings:
    """Return pieces of wall with what stays while the radar moves among them."""
    part = replace(_with_walls(world, walls), reach_m=reach_m(world.setup))
    straight, wall = np.flatnonzero(~part.is_curved), part.speck_wall
    along = part.wall_b[wall] - part.wall_a[wall]
    share = dot(part.speck_m - part.wall_a[wall], along) / dot(along, along)
    # rays rise no higher than the antenna and the scattering centres
    top_m = max(world.radar_height_m, float(world.centre_m[:, 2].max(initial=0.0)))
    passed = ~part.is_mirror | part.is_curved | (part.wall_height_m < top_m)
    return _Surroundings(
        world=part,
        blockers=wall_blockers(part),
        plan=split_walls(part.wall_a[straight], part.wall_b[straight], straight),
        beside=passed.astype(np.float64),
        through=np.where(passed, 1.0, part.most_through),
        speck_share=np.where(part.is_curved[wall], 0.5, share),
    )


def _objects_within(world: World, origin: np.ndarray, time_s: float) -> np.ndarray:
    """Return the objects of which some part may lie within reach at a time."""
    corners = (world.face_a + np.repeat(world.velocity_mps * time_s, 4, axis=0) - origin).reshape(-1, 4, 2)
    size_m = norm(corners[:, 0] - corners[:, 2])
    return np.flatnonzero(norm(corners).min(axis=1) <= world.reach_m + size_m)


def _lit(near: _Surroundings, around: World, origin: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the share of each piece of wall that the radar sees, also through walls, and the share that it sees so or
    in a wall that it sees, [W, 2] each; (inf, -inf) for none.
    """
    world = near.world
    direct = lit_walls(origin, near.plan, near.beside)
    mirrors = np.flatnonzero((direct[:, 1] > direct[:, 0]) & world.is_flat)
    lit, clear = direct, direct
    if (near.through > near.beside).any():
        direct = _hull(direct, lit_walls(origin, near.plan, near.through, _least_through(around, origin)))
    direct = _hull(direct, np.where(world.is_curved[:, None], [0.0, 1.0], [np.inf, -np.inf]))
    lit = direct
    normal, offset = wall_lines(world, origin)
    for mirror in mirrors:
        image = reflect(origin, normal[mirror], offset[mirror])
        start, end = (world.wall_a[mirror] + share * (world.wall_b - world.wall_a)[mirror] for share in clear[mirror])
        lit = _hull(lit, lit_walls(image, near.plan, near.beside, window=(start, end)))
    return direct, lit


def _hull(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Return the least share of each wall that holds two, [W, 2]."""
    return np.column_stack([np.minimum(first[:, 0], second[:, 0]), np.maximum(first[:, 1], second[:, 1])])


def _any(lit: np.ndarray) -> np.ndarray:
    return np.asarray(lit[:, 1] >= lit[:, 0])


def _lit_specks(near: _Surroundings, direct: np.ndarray, lit: np.ndarray) -> np.ndarray:
    """Return which wall scatterers the radar may see: patches directly, structure in a wall too; bool [Q]."""
    world, wall = near.world, near.world.speck_wall
    low, high = np.where((world.speck_length_m > 0.0)[:, None], direct[wall], lit[wall]).T
    return np.asarray((near.speck_share >= low - ROUNDING) & (near.speck_share <= high + ROUNDING))


def _least_through(world: World, origin: np.ndarray) -> float:
    """Return the field factor of walls, one way, behind which all objects together stay `HIDDEN_DB` under the noise.

    Bound: every centre as bright as it can be, at its distance, straight and in every wall, in the array's full gain.
    """
    setup, radar = world.setup, world.setup.radar
    distance_m = np.maximum(norm(world.centre_m[:, :2] - origin), 1.0)
    largest = float(echo_amplitude(radar, world.centre_rcs_m2, distance_m).sum()) * (1 + len(world.wall_a))
    broadside = float(element_field(setup.element, np.zeros(1), np.zeros(1))[0])
    gain = (setup.array.columns * setup.array.rows * max(broadside, 1.0)) ** 2
    noise_mw = radar.noise_power_mw / (radar.samples_per_chirp * radar.chirps_per_beam)
    return math.sqrt(min(math.sqrt(noise_mw * ratio_from_db(HIDDEN_DB)) / max(gain * largest, 1e-300), 1.0))


def _with_walls(world: World, walls: np.ndarray, wanted: np.ndarray | None = None) -> World:
    """Return the part of a world that has these pieces of wall, in order, with their scatterers, or the wanted of
    these, bool [Q].
    """
    specks, count = _runs(world.speck_wall, len(world.wall_a), walls)
    owner = np.repeat(np.arange(len(walls)), count)
    if wanted is not None:
        specks, owner = specks[wanted[specks]], owner[wanted[specks]]
    fields_of_walls = [name for name in _names(world) if name.startswith("wall_")]
    fields_of_specks = [name for name in _names(world) if name.startswith("speck_") and name != "speck_wall"]
    return replace(
        world,
        **{name: getattr(world, name)[walls] for name in fields_of_walls},
        **{name: getattr(world, name)[specks] for name in fields_of_specks},
        speck_wall=owner,
    )


def _with_objects(world: World, objects: np.ndarray) -> World:
    """Return the part of a world that has these objects, in order."""
    if len(objects) == len(world.object_id):
        return world
    centres, count = _runs(world.centre_object, len(world.object_id), objects)
    faces = (4 * objects[:, None] + np.arange(4)).ravel()
    names = [name for name in _names(world) if name.startswith("centre_") and name != "centre_object"]
    kept = tuple(world.scene.objects[index] for index in objects)
    return replace(
        world,
        scene=msgspec.structs.replace(world.scene, objects=kept),
        **{name: getattr(world, name)[centres] for name in names},
        **{name: getattr(world, name)[faces] for name in ("face_a", "face_b", "face_height_m")},
        velocity_mps=world.velocity_mps[objects],
        object_id=world.object_id[objects],
        centre_object=np.repeat(np.arange(len(objects)), count),
    )


def _names(world: World) -> list[str]:
    return [field.name for field in fields(world)]


def _runs(owner: np.ndarray, owners: int, wanted: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the places of wanted owners in their ascending list, and how many each has."""
    start = np.searchsorted(owner, np.arange(owners + 1))
    count = np.diff(start)[wanted]
    place = np.arange(count.sum()) - np.repeat(np.cumsum(count) - count, count)
    return np.repeat(start[wanted], count) + place, count
