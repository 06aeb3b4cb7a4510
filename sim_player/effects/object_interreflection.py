"""One object lit by another: antenna -> first -> second -> antenna, straight or both in the same wall.

Between centres without a lobe (corners, wheels, bicycles, pedestrians), in either order.
"""

from __future__ import annotations

import math

import numpy as np

from models.compiled import compiled
from sim_player.scene.segments import series
from sim_player.scene.world import World
from sim_player.trace.echoes import ECHO, Echoes, fill_echo, rate_of, rcs_towards
from sim_player.trace.effect_names import bit
from sim_player.trace.routes import NEAREST_M, direction_of, grown
from sim_player.trace.snapshot import TraceContext

_LIT = bit("object_interreflection")


def absent(world: World) -> str | None:
    """It takes two objects."""
    count = len(world.scene.objects)
    return None if count >= 2 else f"{count} object{'' if count == 1 else 's'}: none lights another"


def apply(tracing: TraceContext) -> Echoes:
    """Pairs of lobe-free centres of two objects that see each other and are reached by the same chain of walls."""
    view, world = tracing.view, tracing.view.world
    routes = tracing.clear_routes("los_objects", "specular_relay")
    routes = routes.take(world.centre_exponent[routes.target] == 0)
    # power P lambda^2 s1 s2 / ((4 pi)^4 R1^2 d^2 R2^2)
    unit = math.sqrt(1e3 * world.radar.transmit_power_w / (4.0 * math.pi) ** 4) * world.radar.wavelength_m
    centres = *world.centres, view.centre, view.velocity
    pieces, numbers = view.blockers.pieces, world.numbers
    return Echoes(_lit(routes.rows, unit, world.orders_alike, centres, view.radar_velocity, pieces, numbers))


@compiled(error_model="numpy")
def _lit(routes, unit, alike, centres, radar_velocity, pieces, numbers):  # type: ignore[no-untyped-def]
    owner = centres[4]
    rows, count = np.empty(64, ECHO), 0
    for swapped in range(1 if alike else 2):
        for i in range(len(routes)):
            for j in range(len(routes)):
                route_1, route_2 = routes[i], routes[j]
                if route_1.wall != route_2.wall or owner[route_1.target] >= owner[route_2.target]:
                    continue
                if count == len(rows):
                    rows = grown(rows)
                if swapped:
                    route_1, route_2 = route_2, route_1
                weight = unit * (2.0 if alike else 1.0)
                scene = centres, radar_velocity, pieces, numbers
                count += _one_by_another(rows[count], route_1, route_2, weight, scene)
    return rows[:count]


@compiled(error_model="numpy")
def _one_by_another(row, route_1, route_2, unit, scene):  # type: ignore[no-untyped-def]
    """Write the echo antenna -> first -> second -> antenna; return how many there are, 0 or 1."""
    centres, radar_velocity, pieces, (wall_id, centre_id, object_id) = scene
    peak_m2, normals, exponent, floor, owner, phasor, position, velocity = centres
    c, d = route_1.target, route_2.target
    start = position[c, 0], position[c, 1], position[c, 2]
    end = position[d, 0], position[d, 1], position[d, 2]
    onward, between = direction_of(start, end)
    if between < NEAREST_M:
        onward = onward[0] * between / NEAREST_M, onward[1] * between / NEAREST_M, onward[2] * between / NEAREST_M
        between = NEAREST_M
    first, second = (peak_m2[c], exponent[c], floor[c]), (peak_m2[d], exponent[d], floor[d])
    rcs_1 = rcs_towards(first, normals, c, route_1.arrive, -1.0) * rcs_towards(first, normals, c, onward, 1.0)
    rcs_2 = rcs_towards(second, normals, d, route_2.arrive, -1.0) * rcs_towards(second, normals, d, onward, -1.0)
    if not (rcs_1 > 0.0 and rcs_2 > 0.0):
        return 0
    over, foliage, _ = series((start, end), owner[d], pieces, False)
    if over == 0.0:
        return 0
    fill_echo(row, route_1, route_2, _LIT, wall_id, (centre_id[c], centre_id[d]))
    field = unit * math.sqrt(math.sqrt(rcs_1) * math.sqrt(rcs_2)) / (route_1.length_m * between * route_2.length_m)
    row.weight = field * phasor[c] * phasor[d] * route_1.other * route_2.other * over
    row.foliage *= foliage
    row.out_m, row.back_m = route_1.length_m + 0.5 * between, route_2.length_m + 0.5 * between
    apart = onward[0] * (velocity[d, 0] - velocity[c, 0]) + onward[1] * (velocity[d, 1] - velocity[c, 1])
    there = rate_of(route_1, velocity[c, 0], velocity[c, 1], radar_velocity)
    back = rate_of(route_2, velocity[d, 0], velocity[d, 1], radar_velocity)
    row.rate_mps = 0.5 * (there + back + apart)
    row.object_index = object_id[owner[c]]
    row.point[:] = position[c]
    return 1
