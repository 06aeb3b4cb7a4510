"""Echoes: an outbound route, a scatterer, a return route; their weights with and without each effect.

Weight of an echo in sqrt(mW), without the antenna: sqrt(P lambda^2 sigma / (4 pi)^3) times the factors of both routes
over both lengths: 1/R^2 for the same route there and back (Eq. (5)); two bounces square the field of one.
"""

from __future__ import annotations

import math

import numpy as np

from models.compiled import compiled
from msgs.values.perception import PathClass
from msgs.values.radar import RadarParams
from sim_player.bodies.fields import body_echo
from sim_player.scene.world import Snapshot, World
from sim_player.trace.routes import NONE, Routes
from sim_player.trace.row_table import Column, RowTable


class Echoes(RowTable):
    """E echoes in the scene's frame."""

    #: Weight with none of the factors below.
    weight = Column("c16")
    #: Field factors of out and back together, as in `Routes`.
    whole = Column("c16")
    front = Column("c16")
    rough = Column("f8")
    foliage = Column("f8")
    #: Lengths of both routes, and unit vectors of travel at departure and (reversed) at arrival, [E, 3].
    out_m = Column("f8")
    back_m = Column("f8")
    depart = Column("f8", 3)
    arrive = Column("f8", 3)
    #: Half the rate of change of the length.
    rate_mps = Column("f8")
    #: The same number for the same scatterer by the same routes at another time.
    chain = Column("u8")
    point = Column("f8", 3)
    needs = Column("u4")
    surface = Column("i4")
    object_index = Column("i4")
    kind = Column("u1")
    order = Column("u1")


ECHO = Echoes.dtype
#: Mixtures of ways of which both leave less than this of a free field together (-60 dB) are left out.
LEAST_BOTH = 1e-3
_LOS, _MIRRORED = int(PathClass.LOS), int(PathClass.MIRRORED)


def echo_amplitude(radar: RadarParams, rcs_m2: np.ndarray, range_m: np.ndarray) -> np.ndarray:
    """Return the radar equation without the antenna, as a field in sqrt(mW): sqrt(P lambda^2 sigma / ((4 pi)^3
    R^4)).
    """
    power_mw = 1e3 * radar.transmit_power_w * radar.wavelength_m**2 * rcs_m2 / (4.0 * np.pi) ** 3
    return np.asarray(np.sqrt(power_mw) / np.square(range_m))


def object_echoes(view: Snapshot, routes: Routes, pairs: tuple[np.ndarray, np.ndarray], needs: int = 0) -> Echoes:
    """Return the echoes of centres: out by route `pairs[0]`, back by `pairs[1]`; different routes in both orders."""
    if not len(pairs[0]):
        return Echoes.joined([])
    (out, back), times = both_orders(view.world, pairs)
    world = view.world
    centres, bodies = (
        (*world.centres, view.centre, view.velocity),
        (world.bodies, 2.0 * math.pi / world.radar.wavelength_m),
    )
    motion, numbers = view.radar_velocity, world.numbers
    return Echoes(_of_centres(routes.rows, out, back, times * _unit(world), needs, centres, bodies, motion, numbers))


def _unit(world: World) -> float:
    """Return the amplitude of an echo of 1 m2 from 1 m, kept with the world."""
    return world.once("unit_amplitude", lambda: float(echo_amplitude(world.radar, np.ones(1), np.ones(1))[0]))


def both_orders(world: World, pairs: tuple[np.ndarray, np.ndarray]) -> tuple[tuple[np.ndarray, np.ndarray], np.ndarray]:
    """Return pairs of routes (out, back) in each order, and how often each pair counts, [E].

    Either route of a mixed pair may come first. Where the arrays cannot tell, one pair counts twice in field.
    """
    out, back = pairs
    if out is back:
        return pairs, np.ones(len(out))
    mixed = out != back
    if world.orders_alike:
        return pairs, np.where(mixed, 2.0, 1.0)
    swapped = np.append(out, back[mixed]), np.append(back, out[mixed])
    return swapped, np.ones(len(swapped[0]))


def cofocal(routes: Routes) -> tuple[np.ndarray, np.ndarray]:
    """Return each route taken out and back."""
    every = np.arange(len(routes))
    return every, every


def same_target(first: np.ndarray, second: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return all index pairs (i, j) with first[i] == second[j]; targets are integers and not negative."""
    if not len(first) or not len(second):
        return np.zeros(0, np.int64), np.zeros(0, np.int64)
    return _same_target(np.asarray(first, np.int64), np.asarray(second, np.int64))


def surface_echoes(
    view: Snapshot, routes: Routes, weight: np.ndarray, point: np.ndarray, wall: np.ndarray, needs: int
) -> Echoes:
    """Return the echoes of points on walls, out and back by the same route; `weight` already divided by the lengths.

    The routes' targets are the points' numbers in the whole world.
    """
    if not len(routes):
        return Echoes.joined([])
    weight, wall = np.asarray(weight, np.complex128), np.asarray(wall, np.int64)
    return Echoes(_of_walls(routes.rows, weight, point, wall, needs, view.radar_velocity, view.world.numbers[0]))


@compiled(error_model="numpy")
def _same_target(first, second):  # type: ignore[no-untyped-def]
    targets = 0
    for target in second:
        targets = max(targets, target + 1)
    # of each target the first route, of each route the next one of its target
    start, following = np.full(targets, -1), np.empty(len(second), np.int64)
    for j in range(len(second) - 1, -1, -1):
        following[j] = start[second[j]]
        start[second[j]] = j
    count = 0
    left, right = np.empty(len(first) + 64, np.int64), np.empty(len(first) + 64, np.int64)
    for i in range(len(first)):
        j = start[first[i]] if first[i] < targets else -1
        while j >= 0:
            if count == len(left):
                left, right = np.append(left, left), np.append(right, right)
            left[count], right[count] = i, j
            count += 1
            j = following[j]
    return left[:count], right[:count]


@compiled(error_model="numpy")
def _of_centres(routes, out, back, times, needs, centres, bodies, radar_velocity, numbers):  # type: ignore[no-untyped-def]
    peak_m2, normals, exponent, floor, owner, phasor, position, velocity = centres
    wall_id, centre_id, object_id = numbers
    rows, count = np.empty(len(out), ECHO), 0
    for pair in range(len(out)):
        there, here = routes[out[pair]], routes[back[pair]]
        c = there.target
        out_m, back_m, x, y, z = there.length_m, here.length_m, 0.0, 0.0, 0.0
        if exponent[c] < 0.0:
            field, out_m, back_m, (x, y, z) = body_echo(bodies[0], int(-1.0 - exponent[c]), bodies[1], there, here)
        else:
            lobe = (peak_m2[c], exponent[c], floor[c])
            rcs = rcs_towards(lobe, normals, c, there.arrive, -1.0)
            if out[pair] != back[pair]:
                rcs = np.sqrt(rcs * rcs_towards(lobe, normals, c, here.arrive, -1.0))
            field = np.sqrt(rcs) * phasor[c]
        if field == 0.0:
            continue
        row = rows[count]
        count += 1
        row.weight = times[pair] * field * there.other * here.other / (out_m * back_m)
        fill_echo(row, there, here, needs, wall_id, (centre_id[c], centre_id[c]))
        row.out_m, row.back_m = out_m, back_m
        row.rate_mps = 0.5 * (
            rate_of(there, velocity[c, 0], velocity[c, 1], radar_velocity)
            + rate_of(here, velocity[c, 0], velocity[c, 1], radar_velocity)
        )
        row.object_index = object_id[owner[c]]
        row.point[0], row.point[1], row.point[2] = position[c, 0] + x, position[c, 1] + y, position[c, 2] + z
    return rows[:count]


@compiled(error_model="numpy")
def _of_walls(routes, weight, point, wall, needs, radar_velocity, wall_id):  # type: ignore[no-untyped-def]
    rows = np.empty(len(routes), ECHO)
    for n in range(len(routes)):
        row, route = rows[n], routes[n]
        row.weight = weight[n] * route.other * route.other
        fill_echo(row, route, route, needs, wall_id, (route.target, route.target))
        row.rate_mps = rate_of(route, 0.0, 0.0, radar_velocity)
        row.surface, row.object_index = wall_id[wall[n]], NONE
        row.point[:] = point[n]
    return rows


@compiled(error_model="numpy")
def fill_echo(row, there, here, needs, wall_id, targets):  # type: ignore[no-untyped-def]
    """Write what an echo has from its routes alone, out by `there` and back by `here`.

    `wall_id`: numbers of the walls in the whole world, -1 last; `targets`: those of both routes' targets.
    """
    row.whole, row.front = there.whole * here.whole, there.front * here.front
    row.rough, row.foliage = there.rough * here.rough, there.foliage * here.foliage
    row.out_m, row.back_m = there.length_m, here.length_m
    row.depart[:] = there.depart
    row.arrive[:] = here.depart
    row.kind = _MIRRORED if there.wall >= 0 or here.wall >= 0 else _LOS
    row.order = max((there.wall >= 0) + (there.wall2 >= 0), (here.wall >= 0) + (here.wall2 >= 0))
    row.needs = there.needs | here.needs | np.uint32(needs)
    row.surface = wall_id[there.wall if there.wall >= 0 else here.wall]
    row.chain = chain_of((there, here), targets, needs, wall_id)


@compiled(error_model="numpy")
def chain_of(routes, targets, needs, wall_id):  # type: ignore[no-untyped-def]
    """Return a number for an echo by its scatterer, its two routes and its effects; uint64, a hash.

    By numbers of the whole world, so that it stays while other parts of that world are traced.
    """
    chain = np.uint64(needs)
    for route, target in ((routes[0], targets[0]), (routes[1], targets[1])):
        for part in (target, wall_id[route.wall], wall_id[route.wall2], route.edge):
            chain = _chained(chain, np.int64(part))
        chain = _chained(_chained(chain, np.int64(route.ground)), np.int64(route.needs))
    return chain


@compiled(error_model="numpy")
def _chained(chain, part):  # type: ignore[no-untyped-def]
    # wraps: the odd factor of a linear congruential generator
    return (chain + np.uint64(part + 2)) * np.uint64(6364136223846793005)


@compiled(error_model="numpy")
def rate_of(route, x_mps, y_mps, radar_velocity):  # type: ignore[no-untyped-def]
    """Return the rate of change of a route's length: by Fermat's principle only the motion of its ends matters."""
    depart, arrive = route.depart, route.arrive
    own = depart[0] * radar_velocity[0] + depart[1] * radar_velocity[1]
    return arrive[0] * x_mps + arrive[1] * y_mps - own


@compiled(error_model="numpy")
def rcs_towards(lobe, normals, centre, direction, sense):  # type: ignore[no-untyped-def]
    """Return `seen_rcs_m2` of one centre towards `sense` times a direction; `lobe` is its peak, exponent and floor."""
    peak_m2, exponent, floor = lobe
    first, second = 0.0, 0.0
    for axis in range(3):
        first += normals[centre, 0, axis] * direction[axis]
        second += normals[centre, 1, axis] * direction[axis]
    cosine = max(sense * first, sense * second)
    if cosine <= 0.0:
        return 0.0
    return peak_m2 * (floor + (1.0 - floor) * (cosine**exponent if exponent != 0.0 else 1.0))
