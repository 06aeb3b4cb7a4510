"""The part of a world that a radar's echoes can reach: what is traced of a scene of many walls.

Walls and objects beyond the reach have no part in shorter echoes. Of the walls within all may stand in the way;
mirrors, edges and scatterers are those that the radar sees, through walls too, or in another wall. Longer echoes are
left out, but for flashes of straight walls that leak into the map.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields, replace

import msgspec
import numpy as np

from models.physics.antenna import element_field
from models.physics.diffraction import FADES_TO
from msgs.values.radar import RadarSetup, RangeAzimuthGrid
from msgs.values.units import SPEED_OF_LIGHT_MPS, ratio_from_db
from sim_player.effects.edge_diffraction import open_edges
from sim_player.effects.mirrored_diffraction import mirrors_beside
from sim_player.paths.visibility import PlanWalls, lit_in_mirrors, lit_walls, split_walls
from sim_player.scene.description import WHOLE_WALLS, reach_m
from sim_player.scene.segments import DARK_V, Blockers, join_blockers, segment_occlusion
from sim_player.scene.wall_ends import NODE_M
from sim_player.scene.world import (
    BEHIND,
    RadarState,
    SeenPairs,
    Snapshot,
    World,
    scene_radar,
    snapshot,
    wall_blockers,
    wall_lines,
)
from sim_player.trace.echoes import echo_amplitude
from sim_player.trace.routes import dot, norm

#: The radar's surroundings are kept while it stays in a square of this side.
SQUARE_M = 16.0
#: Shares of a wall are told apart to so much.
ROUNDING = 1e-7
#: Level under the noise, in any bin, of all that the walls within reach hide together.
HIDDEN_DB = -40.0
#: Level under the noise, in any bin, up to which the flash of a wall beyond reach is left out.
LEAK_DB = -40.0
#: Delay of such a flash at most, in chirps.
LATEST = 0.99
_NO_SPECKS = np.zeros(0, int), np.zeros(0, int)


def reachable_snapshot(
    world: World, time_s: float = 0.0, radar: RadarState | None = None, ahead_only: bool = False
) -> Snapshot:
    """Return what a radar's echoes can reach of a world at a time; a small world whole.

    `radar`: its state if not the scene's. `ahead_only`: without echoes that leave or arrive behind the antenna.
    """
    radar = scene_radar(world.scene, time_s) if radar is None else radar
    if len(world.wall_a) <= WHOLE_WALLS:
        return snapshot(world, time_s, radar)
    origin = np.array([radar.pose.x_m, radar.pose.y_m])
    near = _surroundings(world, origin)
    around = _with_objects(world, _objects_within(world, origin, time_s))
    ahead = np.array([math.cos(radar.pose.yaw_rad), math.sin(radar.pose.yaw_rad)]) if ahead_only else None
    direct, pairs, share = _lit(near, around, origin, ahead)
    lit = direct.copy()
    np.minimum.at(lit[:, 0], pairs[:, 1], share[:, 0])
    np.maximum.at(lit[:, 1], pairs[:, 1], share[:, 1])
    visible = np.flatnonzero(_any(lit))
    distant = _distant_mirrors(world, near, origin, ahead)
    antenna = np.array([*origin, world.radar_height_m])
    around_edges = _any(lit) | _beside_edges(near, around, antenna, time_s, direct, _any(lit), ahead)
    around_edges |= _joined_to(near.world, around_edges)
    walls = np.union1d(near.walls[around_edges], distant)
    inside, place = np.isin(walls, near.walls[visible]), np.searchsorted(walls, near.walls)
    of_walls = np.tile([np.inf, -np.inf], (2, len(walls), 1))
    of_walls[:, inside] = direct[visible], lit[visible]
    part = _with_walls(around, walls, _specks_of(world, walls))
    # what scatters on walls beyond reach is beyond reach
    part = _with_specks(part, _lit_specks(part, *of_walls) & ~np.isin(walls, distant)[part.speck_wall])
    view = snapshot(replace(part, reach_m=reach_m(world.setup)), time_s, radar)
    blockers = join_blockers(view.blockers, near.blockers.take(~around_edges & ~np.isin(near.walls, distant)))
    return replace(
        view,
        blockers=replace(blockers, tree=True),
        lit=of_walls[0],
        seen_pairs=SeenPairs(place[pairs[:, 0]], place[pairs[:, 1]], share),
        ahead_only=ahead_only,
        distant=distant,
    )


def _joined_to(world: World, kept: np.ndarray) -> np.ndarray:
    """Return which pieces of wall end where kept ones do, bool [W]: without them a corner is an end."""
    node_of = world.end_nodes.node_of
    held = np.zeros(len(world.end_nodes.position) + 1, bool)
    # the last one is that of no mirror
    held[node_of[kept]] = True
    held[-1] = False
    return np.asarray(held[node_of].any(axis=1))


@dataclass(frozen=True)
class _Surroundings:
    """All walls around a square within which the radar stands, without their scatterers."""

    world: World
    #: Their numbers, and how they stand in the way.
    walls: np.ndarray
    blockers: Blockers
    #: Its straight walls for `lit_walls`.
    plan: PlanWalls
    #: Factor of a ray behind each piece of wall, [W]: where it only passes beside or over walls, and with what the
    #: most transparent incidence lets through.
    beside: np.ndarray
    through: np.ndarray
    #: Numbers of the straight walls of the whole world whose flash may come from beyond reach and leak into the map.
    distant: np.ndarray


def _surroundings(world: World, origin: np.ndarray) -> _Surroundings:
    """Return the walls around a point, kept with the world while that stays in its square."""
    square = tuple(np.floor(origin / SQUARE_M).astype(int).tolist())
    if world.kept.get("square") != square:
        middle, far_m = SQUARE_M * (np.array(square) + 0.5), reach_m(world.setup) + SQUARE_M * math.sqrt(0.5)
        near_walls = _walls_within(world, middle, far_m)
        world.kept.update(square=square, surroundings=_surroundings_of(world, near_walls, _distant(world, middle)))
    near: _Surroundings = world.kept["surroundings"]
    return near


def _walls_within(world: World, middle: np.ndarray, far_m: float) -> np.ndarray:
    """Return the pieces of wall of which some point may lie within a distance of a point."""
    half_m = 0.5 * norm(world.wall_b - world.wall_a)
    walls = np.flatnonzero(norm(0.5 * (world.wall_a + world.wall_b) - middle) <= far_m + half_m.max())
    along = world.wall_b[walls] - world.wall_a[walls]
    share = np.clip(dot(middle - world.wall_a[walls], along) / dot(along, along), 0.0, 1.0)
    away = norm(world.wall_a[walls] + share[:, None] * along - middle)
    # an arc stays within half its chord of it
    return np.asarray(walls[away <= far_m + np.where(world.wall_curvature_per_m[walls] == 0.0, 0.0, half_m[walls])])


def _feet(world: World, walls: np.ndarray, origin: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the feet [N, 2] of the perpendiculars on walls, how far beyond the ends they lie, and how far off."""
    start, along = world.wall_a[walls], world.wall_b[walls] - world.wall_a[walls]
    square = dot(along, along)
    share = dot(origin - start, along) / square
    foot = start + share[:, None] * along
    return foot, np.maximum(-share, share - 1.0) * np.sqrt(square), norm(foot - origin)


def _distant(world: World, middle: np.ndarray) -> np.ndarray:
    """Return the straight walls that may flash from beyond reach, for a radar in the square around a point."""
    walls, slack_m = np.flatnonzero(world.is_flat), SQUARE_M * math.sqrt(0.5)
    _, beside_m, away_m = _feet(world, walls, middle)
    return np.asarray(walls[(beside_m <= slack_m) & (away_m > reach_m(world.setup) - slack_m)])


def _distant_mirrors(world: World, near: _Surroundings, origin: np.ndarray, ahead: np.ndarray | None) -> np.ndarray:
    """Return the walls beyond reach that flash, nothing between, and leak into the map by more than `LEAK_DB`."""
    foot, beside_m, away_m = _feet(world, near.distant, origin)
    leaks = (beside_m <= 0.0) & (away_m > reach_m(world.setup)) & _leaks(world.setup, away_m)
    # over its top too, as far as anything is left
    over_m = FADES_TO * np.sqrt(0.25 * world.radar.wavelength_m * away_m)
    leaks &= world.wall_height_m[near.distant] > world.radar_height_m - over_m
    if ahead is not None:
        leaks &= (foot - origin) @ ahead >= 0.0
    walls, foot = near.distant[leaks], foot[leaks]
    if not len(walls):
        return np.zeros(0, np.int64)
    antenna = np.array([*origin, world.radar_height_m])
    foot = np.column_stack([foot, np.full(len(walls), world.radar_height_m)])
    # most are hidden by what is near
    free = segment_occlusion(antenna, foot, near.blockers).free
    if free.any():
        free[free] = segment_occlusion(antenna, foot[free], wall_blockers(world)).free
    return _with_neighbours(world, walls[free])


def _with_neighbours(world: World, walls: np.ndarray) -> np.ndarray:
    """Return some walls and all that meet their ends: without them a joint is an end that echoes."""
    every = np.concatenate([world.wall_a, world.wall_b])
    meet = [norm(every - end) <= NODE_M for wall in walls for end in (world.wall_a[wall], world.wall_b[wall])]
    return np.unique(np.concatenate([walls, *(np.flatnonzero(near) % len(world.wall_a) for near in meet)]))


def _leaks(setup: RadarSetup, away_m: np.ndarray) -> np.ndarray:
    """Return which flashes of mirrors so far off may leave more than `LEAK_DB` in the last range bin, bool [N].

    Bound: no loss, on boresight. A Hann window's skirt d bins off is 1 / (pi d^3); what is cut off at the overlapped
    start, where the window is h, leaves h / (pi d), and so does the last chirp's echo, a band away.
    """
    radar, array = setup.radar, setup.array
    peak = float(element_field(setup.element, np.zeros(1), np.zeros(1))[0]) ** 2 * array.columns * array.rows
    flash = peak * math.sqrt(1e3 * radar.transmit_power_w) * radar.wavelength_m / (8.0 * math.pi * away_m)
    off = np.maximum(away_m / radar.range_bin_m - RangeAzimuthGrid().range_bins, 2.0)
    late = 2.0 * away_m / (SPEED_OF_LIGHT_MPS * radar.chirp_period_s)
    risen = np.where(late < 0.5, 1.0 - np.cos(2.0 * math.pi * late), 2.0)
    noise_mw = radar.noise_power_mw / (radar.samples_per_chirp * radar.chirps_per_beam)
    band_off = np.maximum((1.0 - late) * radar.bandwidth_hz * radar.chirp_period_s, 1.0)
    share = (1.1 / off**3 + risen / off + risen / band_off) / math.pi
    return np.asarray((late < LATEST) & (flash * share > math.sqrt(noise_mw * ratio_from_db(LEAK_DB))))


def _surroundings_of(world: World, walls: np.ndarray, distant: np.ndarray) -> _Surroundings:
    """Return pieces of wall with what stays while the radar moves among them."""
    part = _with_walls(world, walls)
    straight = np.flatnonzero(~part.is_curved)
    # rays rise no higher than the antenna and the scattering centres
    top_m = max(world.radar_height_m, float(world.centre_m[:, 2].max(initial=0.0)))
    # what passes over a top, of the longest ray
    top_m += DARK_V * math.sqrt(0.125 * world.radar.wavelength_m * reach_m(world.setup))
    passed = ~part.is_mirror | part.is_curved | (part.wall_height_m < top_m)
    return _Surroundings(
        world=part,
        walls=walls,
        distant=distant,
        blockers=replace(wall_blockers(part), tree=True),
        plan=split_walls(part.wall_a[straight], part.wall_b[straight], straight),
        beside=passed.astype(np.float64),
        through=np.where(passed, 1.0, part.most_through),
    )


def _objects_within(world: World, origin: np.ndarray, time_s: float) -> np.ndarray:
    """Return the objects of which some part may lie within reach at a time."""
    corners = (world.face_a + np.repeat(world.velocity_mps * time_s, 4, axis=0) - origin).reshape(-1, 4, 2)
    size_m = norm(corners[:, 0] - corners[:, 2])
    return np.flatnonzero(norm(corners).min(axis=1) <= reach_m(world.setup) + size_m)


def _lit(
    near: _Surroundings, around: World, origin: np.ndarray, ahead: np.ndarray | None
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the share of each piece of wall that the radar sees `ahead`, also through walls, [W, 2]; none: (inf,
    -inf).

    And the pairs [N, 2] of a flat piece and one seen in it, with the share of it that is seen, [N, 2].
    """
    world = near.world
    direct = clear = _ahead(world, origin, ahead, lit_walls(origin, near.plan, near.beside))
    mirrors = np.flatnonzero((clear[:, 1] > clear[:, 0]) & world.is_flat)
    if (near.through > near.beside).any():
        through = lit_walls(origin, near.plan, near.through, _least_through(around, origin, len(direct)))
        direct = _hull(direct, _ahead(world, origin, ahead, through))
    # of arcs everything is taken for seen, also in mirrors
    direct[world.is_curved] = [0.0, 1.0]
    normal, offset = wall_lines(world, origin)
    start, along = world.wall_a[mirrors, None], (world.wall_b - world.wall_a)[mirrors, None]
    window = start + clear[mirrors][:, :, None] * along
    pairs, share = lit_in_mirrors(origin, near.plan, near.beside, (normal[mirrors], offset[mirrors], window))
    arcs = np.flatnonzero(world.is_curved)
    # arcs in every mirror, and everything in arcs
    every = _each_with_each(mirrors, arcs), _each_with_each(arcs, np.flatnonzero(world.is_mirror))
    pairs = np.concatenate([np.column_stack([mirrors[pairs[:, 0]], pairs[:, 1]]), *every])
    share = np.concatenate([share, np.tile([0.0, 1.0], (len(pairs) - len(share), 1))])
    order = np.lexsort((pairs[:, 1], pairs[:, 0]))
    return direct, pairs[order], share[order]


def _each_with_each(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Return all pairs of two lists, int64 [N, 2]."""
    return np.stack(np.meshgrid(first, second, indexing="ij"), axis=-1).reshape(-1, 2)


def _beside_edges(
    near: _Surroundings,
    around: World,
    antenna: np.ndarray,
    time_s: float,
    lit: np.ndarray,
    kept: np.ndarray,
    ahead: np.ndarray | None,
) -> np.ndarray:
    """Return which pieces of wall beside `kept` [W] mirror to objects what edges in direct sight bend, bool [W]."""
    edges = open_edges(near.world)
    low, high = lit[edges.first].T
    share = (edges.number % 2).astype(np.float64)
    in_sight = ~edges.joint & (share >= low - ROUNDING) & (share <= high + ROUNDING)
    if ahead is not None:
        in_sight &= (edges.point - antenna[:2]) @ ahead >= -BEHIND
    centre_m = around.centre_m.copy()
    centre_m[:, :2] += around.velocity_mps[around.centre_object] * time_s
    ends = antenna, centre_m, around.centre_object
    return mirrors_beside(near.world, edges.take(in_sight), near.world.is_flat & ~kept, ends, near.blockers)


def _ahead(world: World, origin: np.ndarray, ahead: np.ndarray | None, lit: np.ndarray) -> np.ndarray:
    """Return what of the share of each piece of wall [W, 2] is ahead of a point."""
    if ahead is None:
        return lit
    start, end = (world.wall_a - origin) @ ahead + BEHIND, (world.wall_b - origin) @ ahead + BEHIND
    crosses = (start < 0.0) != (end < 0.0)
    at = start / np.where(crosses, start - end, 1.0)
    low = np.where(crosses & (start < 0.0), np.maximum(lit[:, 0], at), lit[:, 0])
    high = np.where(crosses & (end < 0.0), np.minimum(lit[:, 1], at), lit[:, 1])
    dark = (low > high) | ((start < 0.0) & (end < 0.0))
    return np.where(dark[:, None], [np.inf, -np.inf], np.column_stack([low, high]))


def _hull(*shares: np.ndarray) -> np.ndarray:
    """Return the least share of each wall that holds several, [W, 2]."""
    every = np.stack(shares)
    return np.column_stack([every[..., 0].min(axis=0), every[..., 1].max(axis=0)])


def _any(lit: np.ndarray) -> np.ndarray:
    return np.asarray(lit[:, 1] >= lit[:, 0])


def _specks_of(world: World, walls: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the scatterers of some pieces of wall, and how many each piece has."""
    first = world.once("first_speck", lambda: np.searchsorted(world.speck_wall, np.arange(len(world.wall_a) + 1)))
    return _runs(first, walls)


def _lit_specks(world: World, direct: np.ndarray, lit: np.ndarray) -> np.ndarray:
    """Return which wall scatterers the radar may see: patches directly, structure in a wall too; bool [Q]."""
    wall, along = world.speck_wall, world.wall_b - world.wall_a
    share = dot(world.speck_m - world.wall_a[wall], along[wall]) / dot(along, along)[wall]
    share[world.is_curved[wall]] = 0.5
    low, high = np.where((world.speck_length_m > 0.0)[:, None], direct[wall], lit[wall]).T
    return np.asarray((share >= low - ROUNDING) & (share <= high + ROUNDING))


def _least_through(world: World, origin: np.ndarray, walls: int) -> float:
    """Return the field factor of walls, one way, behind which all objects together stay `HIDDEN_DB` under the noise.

    Bound: every centre as bright as it can be, straight and in each of so many walls, in the array's full gain.
    """
    setup, radar = world.setup, world.setup.radar
    distance_m = np.maximum(norm(world.centre_m[:, :2] - origin), 1.0)
    largest = float(echo_amplitude(radar, world.centre_rcs_m2, distance_m).sum()) * (1 + walls)
    broadside = float(element_field(setup.element, np.zeros(1), np.zeros(1))[0])
    gain = (setup.array.columns * setup.array.rows * max(broadside, 1.0)) ** 2
    noise_mw = radar.noise_power_mw / (radar.samples_per_chirp * radar.chirps_per_beam)
    return math.sqrt(min(math.sqrt(noise_mw * ratio_from_db(HIDDEN_DB)) / max(gain * largest, 1e-300), 1.0))


def _with_walls(world: World, walls: np.ndarray, specks: tuple[np.ndarray, np.ndarray] = _NO_SPECKS) -> World:
    """Return the part of a world that has these pieces of wall, in order, with these scatterers, so many a piece."""
    part = _with_specks(world, specks[0])
    return replace(
        part,
        **{name: getattr(world, name)[walls] for name in _names(world) if name.startswith("wall_")},
        speck_wall=np.repeat(np.arange(len(walls)), specks[1]) if len(specks[0]) else specks[0],
    )


def _with_specks(world: World, specks: np.ndarray) -> World:
    """Return the part of a world that has these wall scatterers, by index or mask."""
    return replace(world, **{name: getattr(world, name)[specks] for name in _names(world) if name.startswith("speck_")})


def _with_objects(world: World, objects: np.ndarray) -> World:
    """Return the part of a world that has these objects, in order."""
    if len(objects) == len(world.object_id):
        return world
    first = np.searchsorted(world.centre_object, np.arange(len(world.object_id) + 1))
    centres, count = _runs(first, objects)
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


def _runs(start: np.ndarray, wanted: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the places of wanted owners in an ascending list, and how many each has; `start` where each begins."""
    count = start[wanted + 1] - start[wanted]
    place = np.arange(count.sum()) - np.repeat(np.cumsum(count) - count, count)
    return np.repeat(start[wanted], count) + place, count
