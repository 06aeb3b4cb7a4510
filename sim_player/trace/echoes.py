"""Echoes: an outbound route, a scatterer, a return route; their weights with and without each effect.

Weight of an echo in sqrt(mW), without the antenna: sqrt(P lambda^2 sigma / (4 pi)^3) times the factors of both routes
over both lengths: 1/R^2 for the same route there and back (Eq. (5)); two bounces square the field of one.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from msgs.values.array_table import ArrayTable
from msgs.values.perception import PathClass
from msgs.values.radar import RadarParams
from sim_player.scene.road_users import seen_rcs_m2
from sim_player.scene.world import Snapshot, World
from sim_player.trace.routes import NONE, Routes, dot


@dataclass(frozen=True)
class Echoes(ArrayTable):
    """E echoes in the scene's frame."""

    #: Weight with none of the factors below.
    weight: np.ndarray
    #: Field factors of out and back together, as in `Routes`.
    whole: np.ndarray
    front: np.ndarray
    rough: np.ndarray
    foliage: np.ndarray
    #: Lengths of both routes, and unit vectors of travel at departure and (reversed) at arrival, [E, 3].
    out_m: np.ndarray
    back_m: np.ndarray
    depart: np.ndarray
    arrive: np.ndarray
    #: Half the rate of change of the length.
    rate_mps: np.ndarray
    kind: np.ndarray
    order: np.ndarray
    needs: np.ndarray
    surface: np.ndarray
    object_index: np.ndarray
    #: The same number for the same scatterer by the same routes at another time, uint64.
    chain: np.ndarray
    point: np.ndarray

    def __len__(self) -> int:
        return len(self.weight)


def join_echoes(parts: list[Echoes]) -> Echoes:
    """Return all echoes of several sets, in order."""
    return Echoes.joined(parts)


def echo_amplitude(radar: RadarParams, rcs_m2: np.ndarray, range_m: np.ndarray) -> np.ndarray:
    """Return the radar equation without the antenna, as a field in sqrt(mW): sqrt(P lambda^2 sigma / ((4 pi)^3
    R^4)).
    """
    power_mw = 1e3 * radar.transmit_power_w * radar.wavelength_m**2 * rcs_m2 / (4.0 * np.pi) ** 3
    return np.asarray(np.sqrt(power_mw) / np.square(range_m))


def object_echoes(view: Snapshot, routes: Routes, pairs: tuple[np.ndarray, np.ndarray], needs: int = 0) -> Echoes:
    """Return the echoes of centres: out by route `pairs[0]`, back by `pairs[1]`; different routes in both orders."""
    pairs, times = both_orders(view.world, pairs)
    out, back = routes.take(pairs[0]), routes.take(pairs[1])
    world, centre = view.world, out.target
    rcs = np.sqrt(centre_rcs_m2(world, centre, -out.arrive) * centre_rcs_m2(world, centre, -back.arrive))
    constant = echo_amplitude(world.radar, rcs, np.ones(len(centre))) * np.exp(1j * world.centre_phase_rad[centre])
    mirrored = (out.wall >= 0) | (back.wall >= 0)
    echoes = Echoes(
        weight=times * constant * out.other * back.other / (out.length_m * back.length_m),
        whole=out.whole * back.whole,
        front=out.front * back.front,
        rough=out.rough * back.rough,
        foliage=out.foliage * back.foliage,
        out_m=out.length_m,
        back_m=back.length_m,
        depart=out.depart,
        arrive=back.depart,
        rate_mps=0.5 * (_rate(view, out) + _rate(view, back)),
        kind=np.where(mirrored, PathClass.MIRRORED, PathClass.LOS).astype(np.uint8),
        order=np.maximum(_order(out), _order(back)),
        needs=out.needs | back.needs | np.uint32(needs),
        surface=wall_number(world, np.where(out.wall >= 0, out.wall, back.wall)),
        object_index=object_number(world, centre),
        chain=chain_of(world, centre_numbers(world, out), centre_numbers(world, back), needs),
        point=view.centre[centre],
    )
    return echoes.take(rcs > 0.0)


def both_orders(world: World, pairs: tuple[np.ndarray, np.ndarray]) -> tuple[tuple[np.ndarray, np.ndarray], np.ndarray]:
    """Return pairs of routes (out, back) in each order, and how often each pair counts, [E].

    Either route of a mixed pair may come first. Where the arrays cannot tell, one pair counts twice in field.
    """
    out, back = pairs
    mixed = out != back
    if world.orders_alike:
        return pairs, np.where(mixed, 2.0, 1.0)
    swapped = np.append(out, back[mixed]), np.append(back, out[mixed])
    return swapped, np.ones(len(swapped[0]))


def wall_number(world: World, wall: np.ndarray) -> np.ndarray:
    """Return the numbers that pieces of wall have in the whole world, int32 [N]; -1 for none."""
    return np.asarray(np.append(world.wall_id, NONE)[wall], np.int32)


def object_number(world: World, centre: np.ndarray) -> np.ndarray:
    """Return the numbers that the objects of some centres have in the whole world, int32 [N]."""
    return np.asarray(world.object_id[world.centre_object[centre]], np.int32)


def centre_numbers(world: World, routes: Routes) -> Routes:
    """Return routes to centres with the numbers that these have in the whole world as targets."""
    return replace(routes, target=world.centre_id[routes.target])


def chain_of(world: World, out: Routes, back: Routes, needs: int) -> np.ndarray:
    """Return a number for each echo by its scatterer, its two routes and its effects; uint64 [E], a hash.

    Targets have numbers of the whole world, so that it stays while other parts of that world are traced.
    """
    chain = np.full(len(out), needs, np.uint64)
    for routes in (out, back):
        walls = wall_number(world, routes.wall), wall_number(world, routes.wall2)
        for part in (routes.target, *walls, routes.edge, routes.ground, routes.needs):
            # wraps: the odd factor of a linear congruential generator
            chain = (chain + (part.astype(np.int64) + 2).astype(np.uint64)) * np.uint64(6364136223846793005)
    return chain


def cofocal(routes: Routes) -> tuple[np.ndarray, np.ndarray]:
    """Return each route taken out and back."""
    every = np.arange(len(routes))
    return every, every


def same_target(first: np.ndarray, second: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return all index pairs (i, j) with first[i] == second[j]."""
    order = np.argsort(second, kind="stable")
    low = np.searchsorted(second[order], first, "left")
    count = np.searchsorted(second[order], first, "right") - low
    left = np.repeat(np.arange(len(first)), count)
    step = np.arange(len(left)) - np.repeat(np.cumsum(count) - count, count)
    return left, order[np.repeat(low, count) + step]


def surface_echoes(
    view: Snapshot, routes: Routes, weight: np.ndarray, point: np.ndarray, wall: np.ndarray, needs: int
) -> Echoes:
    """Return the echoes of points on walls, out and back by the same route; `weight` already divided by the lengths.

    The routes' targets are the points' numbers in the whole world.
    """
    count = len(routes)
    return Echoes(
        weight=weight * routes.other**2,
        whole=routes.whole**2,
        front=routes.front**2,
        rough=routes.rough**2,
        foliage=routes.foliage**2,
        out_m=routes.length_m,
        back_m=routes.length_m,
        depart=routes.depart,
        arrive=routes.depart,
        rate_mps=_rate(view, routes, still=True),
        kind=np.where(routes.wall >= 0, PathClass.MIRRORED, PathClass.LOS).astype(np.uint8),
        order=_order(routes),
        needs=routes.needs | np.uint32(needs),
        surface=wall_number(view.world, wall),
        object_index=np.full(count, NONE, np.int32),
        chain=chain_of(view.world, routes, routes, needs),
        point=point,
    )


def _rate(view: Snapshot, routes: Routes, still: bool = False) -> np.ndarray:
    """Return the rate of change of a route's length: by Fermat's principle only the motion of its ends matters."""
    own = dot(routes.depart[:, :2], view.radar_velocity)
    if still:
        return np.asarray(-own)
    return np.asarray(dot(routes.arrive[:, :2], view.velocity[routes.target]) - own)


def _order(routes: Routes) -> np.ndarray:
    return ((routes.wall >= 0).astype(np.uint8) + (routes.wall2 >= 0)).astype(np.uint8)


def centre_rcs_m2(world: World, centre: np.ndarray, direction: np.ndarray) -> np.ndarray:
    """Return the RCS of some centres of a world towards unit vectors [N, 3]."""
    return seen_rcs_m2(
        world.centre_rcs_m2[centre],
        world.centre_normals[centre],
        world.centre_exponent[centre],
        direction,
        world.centre_floor[centre],
    )
