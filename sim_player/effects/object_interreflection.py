"""One object lit by another: antenna -> first -> second -> antenna, straight or both in the same wall.

Between the centres without a lobe (corners and wheels, all of bicycles and pedestrians) of different objects: flat
sides send such light elsewhere. Either may come first, so the field counts twice.
"""

from __future__ import annotations

import math

import numpy as np

from msgs.values.perception import PathClass
from sim_player.effects.names import bit
from sim_player.scene.world import Snapshot, World
from sim_player.trace.echoes import Echoes, centre_rcs_m2
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
    first, second = _pairs(routes, world)
    one, two = routes.take(first), routes.take(second)
    start, end = view.centre[one.target], view.centre[two.target]
    occlusion = segment_occlusion(start, end, view.blockers, world.centre_object[two.target])
    between = np.maximum(norm(end - start), NEAREST_M)
    onward = (end - start) / between[:, None]
    rcs_one = _bistatic(view, one, onward)
    rcs_two = _bistatic(view, two, -onward)
    # power P lambda^2 s1 s2 / ((4 pi)^4 R1^2 d^2 R2^2)
    power_mw = 1e3 * world.radar.transmit_power_w * world.radar.wavelength_m**2 / (4.0 * math.pi) ** 4
    phase = world.centre_phase_rad[one.target] + world.centre_phase_rad[two.target]
    weight = 2.0 * np.sqrt(power_mw * rcs_one * rcs_two) / (one.length_m * between * two.length_m) * np.exp(1j * phase)
    mirrored = one.wall >= 0
    echoes = Echoes(
        weight=weight * one.other * two.other,
        whole=one.whole * two.whole,
        front=one.front * two.front,
        rough=one.rough * two.rough,
        foliage=one.foliage * two.foliage * occlusion.foliage,
        out_m=one.length_m + 0.5 * between,
        back_m=two.length_m + 0.5 * between,
        depart=one.depart,
        arrive=two.depart,
        rate_mps=_rate(view, one, two, onward),
        kind=np.where(mirrored, PathClass.MIRRORED, PathClass.LOS).astype(np.uint8),
        order=mirrored.astype(np.uint8),
        needs=one.needs | two.needs | np.uint32(bit("object_interreflection")),
        surface=one.wall,
        object_index=world.centre_object[one.target].astype(np.int32),
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


def _rate(view: Snapshot, one: Routes, two: Routes, onward: np.ndarray) -> np.ndarray:
    """Half the rate of change of the whole length."""
    towards = [
        dot(route.arrive[:, :2], view.velocity[route.target]) - dot(route.depart[:, :2], view.radar_velocity)
        for route in (one, two)
    ]
    apart = dot(onward[:, :2], view.velocity[two.target] - view.velocity[one.target])
    return np.asarray(0.5 * (towards[0] + towards[1] + apart))
