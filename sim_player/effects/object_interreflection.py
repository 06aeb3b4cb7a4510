"""One object lit by another: antenna -> first -> second -> antenna, straight or both in the same wall.

Between the centres without a lobe (corners and wheels, all of bicycles and pedestrians) of different objects: flat
sides send such light elsewhere. Either may come first.
"""

from __future__ import annotations

import math

import numpy as np

from msgs.values.perception import PathClass
from sim_player.effects.names import bit
from sim_player.scene.world import Snapshot, World
from sim_player.trace.echoes import (
    Echoes,
    both_orders,
    centre_numbers,
    centre_rcs_m2,
    chain_of,
    object_number,
    wall_number,
)
from sim_player.trace.routes import NEAREST_M, Routes, dot, norm
from sim_player.trace.segments import segment_occlusion
from sim_player.trace.snapshot import TraceContext


def absent(world: World) -> str | None:
    """It takes two objects."""
    count = len(world.scene.objects)
    return None if count >= 2 else f"{count} object{'' if count == 1 else 's'}: none lights another"


def apply(tracing: TraceContext) -> Echoes:
    """Pairs of lobe-free centres of two objects that see each other and are reached by the same chain of walls."""
    view, world = tracing.view, tracing.view.world
    routes = tracing.clear_routes("los_objects", "specular_relay")
    routes = routes.take(world.centre_exponent[routes.target] == 0)
    (first, second), times = both_orders(world, _pairs(routes, world))
    route_1, route_2 = routes.take(first), routes.take(second)
    start, end = view.centre[route_1.target], view.centre[route_2.target]
    occlusion = segment_occlusion(start, end, view.blockers, world.centre_object[route_2.target])
    between = np.maximum(norm(end - start), NEAREST_M)
    onward = (end - start) / between[:, None]
    rcs_one = _bistatic(view, route_1, onward)
    rcs_two = _bistatic(view, route_2, -onward)
    # power P lambda^2 s1 s2 / ((4 pi)^4 R1^2 d^2 R2^2)
    power_mw = 1e3 * world.radar.transmit_power_w * world.radar.wavelength_m**2 / (4.0 * math.pi) ** 4
    phase = world.centre_phase_rad[route_1.target] + world.centre_phase_rad[route_2.target]
    spread_m3 = route_1.length_m * between * route_2.length_m
    weight = times * np.sqrt(power_mw * rcs_one * rcs_two) / spread_m3 * np.exp(1j * phase)
    mirrored = route_1.wall >= 0
    echoes = Echoes(
        weight=weight * route_1.other * route_2.other,
        whole=route_1.whole * route_2.whole,
        front=route_1.front * route_2.front,
        rough=route_1.rough * route_2.rough,
        foliage=route_1.foliage * route_2.foliage * occlusion.foliage,
        out_m=route_1.length_m + 0.5 * between,
        back_m=route_2.length_m + 0.5 * between,
        depart=route_1.depart,
        arrive=route_2.depart,
        rate_mps=_rate(view, route_1, route_2, onward),
        kind=np.where(mirrored, PathClass.MIRRORED, PathClass.LOS).astype(np.uint8),
        order=mirrored.astype(np.uint8),
        needs=route_1.needs | route_2.needs | np.uint32(bit("object_interreflection")),
        surface=wall_number(world, route_1.wall),
        object_index=object_number(world, route_1.target),
        chain=chain_of(
            world, centre_numbers(world, route_1), centre_numbers(world, route_2), bit("object_interreflection")
        ),
        point=start,
    )
    return echoes.take(occlusion.free & (rcs_one > 0.0) & (rcs_two > 0.0))


def _pairs(routes: Routes, world: World) -> tuple[np.ndarray, np.ndarray]:
    """Index pairs of routes by the same wall (or straight) to centres of different objects, each pair once."""
    object_of_route = world.centre_object[routes.target]
    same = (routes.wall[:, None] == routes.wall[None]) & (object_of_route[:, None] < object_of_route[None])
    first, second = np.nonzero(same)
    return first, second


def _bistatic(view: Snapshot, routes: Routes, onward: np.ndarray) -> np.ndarray:
    """RCS of centres between where their route comes from and a direction they send on to."""
    rcs_m2 = [centre_rcs_m2(view.world, routes.target, direction) for direction in (-routes.arrive, onward)]
    return np.asarray(np.sqrt(rcs_m2[0] * rcs_m2[1]))


def _rate(view: Snapshot, route_1: Routes, route_2: Routes, onward: np.ndarray) -> np.ndarray:
    """Half the rate of change of the whole length."""
    towards = [
        dot(route.arrive[:, :2], view.velocity[route.target]) - dot(route.depart[:, :2], view.radar_velocity)
        for route in (route_1, route_2)
    ]
    apart = dot(onward[:, :2], view.velocity[route_2.target] - view.velocity[route_1.target])
    return np.asarray(0.5 * (towards[0] + towards[1] + apart))
