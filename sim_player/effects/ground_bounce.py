"""The ground as a mirror under every way to an object, straight or by one wall: echoes of three ways beside the first.

Level ground at height 0, TM; the bounce changes only the heights of a way. On one way (either), or on both.
"""

from __future__ import annotations

import math

import numpy as np

from models.compiled import compiled
from models.physics.fresnel import half_space_at
from models.physics.mirror import mirrored
from sim_player.scene.bounce import below_top, bounce, coherent_field
from sim_player.scene.segments import series
from sim_player.scene.world import World
from sim_player.trace.echoes import Echoes, cofocal, object_echoes, same_target
from sim_player.trace.effect_names import bit
from sim_player.trace.routes import ROUTE, Routes, direction_of, fill_bounce, fill_route, plane_bounces
from sim_player.trace.snapshot import TraceContext

_GROUND = bit("ground_bounce")
_MIRRORED = _GROUND | bit("specular_relay")


def absent(world: World) -> str | None:
    """A ground and something to see in it."""
    if world.ground is None:
        return "the scene has no ground"
    return None if len(world.centre_m) else "the scene holds no object"


def apply(tracing: TraceContext) -> Echoes:
    """Straight and once mirrored ways with the ground on one of the two legs, or on both."""
    view = tracing.view
    low = view.centre * [1.0, 1.0, -1.0]
    bounces = plane_bounces(view, view.antenna, low, view.world.is_flat)
    face, pieces = view.world.ground_face, view.blockers.pieces
    straight = _straight(view.antenna, view.centre, tracing.owner, face, pieces)
    mirrored = _mirrored(view.antenna, view.centre, tracing.owner, bounces, view.walls, view.world.builds, face, pieces)
    ground = Routes.joined([Routes(straight), Routes(mirrored)])
    tracing.routes["ground_bounce"] = ground
    clear = tracing.clear_routes("los_objects", "specular_relay")
    # the same chain of walls: target and wall agree
    walls = len(view.world.wall_a) + 1
    mine, other = (routes.target.astype(np.int64) * walls + routes.wall + 1 for routes in (ground, clear))
    first, second = same_target(mine, other)
    both = Routes.joined([ground, clear])
    mixed = object_echoes(view, both, (first, second + len(ground)), bit("ground_bounce"))
    return Echoes.joined([object_echoes(view, ground, cofocal(ground), bit("ground_bounce")), mixed])


@compiled(error_model="numpy")
def _straight(antenna, centre, owner, face, pieces):  # type: ignore[no-untyped-def]
    """Antenna -> ground -> centre."""
    rows, count = np.empty(len(centre), ROUTE), 0
    start = antenna[0], antenna[1], antenna[2]
    for n in range(len(centre)):
        end = centre[n, 0], centre[n, 1], centre[n, 2]
        share = start[2] / (start[2] + end[2])
        bounce_point = start[0] + share * (end[0] - start[0]), start[1] + share * (end[1] - start[1]), 0.0
        over, leaves, _ = series((start, bounce_point, end), owner[n], pieces, False)
        if over == 0.0:
            continue
        depart, length = direction_of(start, (end[0], end[1], -end[2]))
        # it rises to its target after the bounce
        fill_route(rows[count], n, length, depart, (depart[0], depart[1], -depart[2]), _GROUND)
        at_ground, left = _reflection(face, abs(depart[2]))
        rows[count].whole, rows[count].front, rows[count].rough = at_ground, at_ground, left
        rows[count].ground, rows[count].foliage, rows[count].other = True, leaves, over
        count += 1
    return rows[:count]


@compiled(error_model="numpy")
def _mirrored(antenna, centre, owner, bounces, walls, builds, face, pieces):  # type: ignore[no-untyped-def]
    """Antenna -> wall and ground, in the order that heights decide -> centre."""
    wall, target, points = bounces
    normal, offset, top = walls[2], walls[3], walls[4]
    rows, count = np.empty(len(wall), ROUTE), 0
    start = antenna[0], antenna[1], antenna[2]
    for m in range(len(wall)):
        n, w = target[m], wall[m]
        nx, ny = normal[w, 0], normal[w, 1]
        end, image = (centre[n, 0], centre[n, 1], centre[n, 2]), (points[m, 1, 0], points[m, 1, 1], -centre[n, 2])
        at_wall = points[m, 0, 0], points[m, 0, 1], abs(points[m, 0, 2])
        share = start[2] / (start[2] + end[2])
        x, y = start[0] + share * (image[0] - start[0]), start[1] + share * (image[1] - start[1])
        reach = math.hypot(at_wall[0] - start[0], at_wall[1] - start[1])
        early = share < reach / math.hypot(image[0] - start[0], image[1] - start[1])
        if not early:
            # beyond the wall the unfolded plan is folded back to the real one
            x, y = mirrored(x, y, nx, ny, offset[w])
        at_ground = x, y, 0.0
        first, second = (at_ground, at_wall) if early else (at_wall, at_ground)
        over, leaves, _ = series((start, first, second, end), owner[n], pieces, False)
        if over == 0.0:
            continue
        depart, length = direction_of(start, image)
        portion = reach / math.hypot(image[0] - start[0], image[1] - start[1])
        over = below_top(builds[3], top[w] - at_wall[2], portion * length, (1.0 - portion) * length, depart[2])
        if over == 0.0:
            continue
        towards = depart[0] * nx + depart[1] * ny
        arrive = (depart[0] - 2.0 * towards * nx, depart[1] - 2.0 * towards * ny, -depart[2])
        row = rows[count]
        count += 1
        fill_route(row, n, length, depart, arrive, _MIRRORED)
        whole, front, rough = bounce(builds, w, abs(towards))
        by_ground, left = _reflection(face, abs(depart[2]))
        fill_bounce(row, w, (whole * by_ground, front * by_ground, rough * left))
        row.ground, row.foliage, row.other = True, leaves, over
    return rows[:count]


@compiled(error_model="numpy")
def _reflection(face, cosine):  # type: ignore[no-untyped-def]
    """TM reflection of the ground, and the field that its roughness leaves."""
    permittivity, roughness_m, wavelength_m = face
    # Eq. (13) gives TM the sign of the magnetic field; the upright electric field above the ground follows it
    return half_space_at(permittivity, cosine, True)[0], coherent_field(roughness_m, cosine, wavelength_m)
