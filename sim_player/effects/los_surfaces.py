"""Walls in direct sight: the flash of a wall that is met square on, and its structure (edges, frames, joints).

A flash is the radar's own image: field r lambda sqrt(P) / (4 pi 2d), from the mirror law alone. Structure is small
scatterers every 1-3 m and at every end; their level is an engineering choice, not a measurement.
"""

from __future__ import annotations

import cmath
import math

import numpy as np

from models.compiled import compiled
from sim_player.effects.names import bit
from sim_player.scene.world import Snapshot, World
from sim_player.trace.bounce import bounce
from sim_player.trace.echoes import Echoes, echo_amplitude, join_echoes, surface_echoes
from sim_player.trace.routes import NEAREST_M, NONE, ROUTE, Routes, fill_route, straight_routes
from sim_player.trace.segments import passage
from sim_player.trace.snapshot import TraceContext


def absent(world: World) -> str | None:
    """No wall, no return."""
    return None if len(world.wall_a) else "the scene holds no wall"


def apply(tracing: TraceContext) -> Echoes:
    """Flashes of straight walls, then structure."""
    return join_echoes([_flashes(tracing.view), structure(tracing.view)])


def flash_weight(view: Snapshot, length_m: np.ndarray) -> np.ndarray:
    """Weight of the radar's own image over a round trip, before any reflection."""
    radar = view.world.radar
    return np.asarray(math.sqrt(1e3 * radar.transmit_power_w) * radar.wavelength_m / (4.0 * np.pi * length_m))


def structure(view: Snapshot) -> Echoes:
    """Small scatterers of all walls in direct sight."""
    world = view.world
    specks, point = world.structure
    routes, occlusion = straight_routes(view, point)
    visible = np.flatnonzero(occlusion.free)
    visible_specks = specks[visible]
    routes = routes.take(visible).with_columns(target=world.speck_id[visible_specks])
    weight = (
        echo_amplitude(world.radar, world.speck_rcs_m2[visible_specks], routes.length_m)
        * world.speck_phasor[visible_specks]
    )
    return surface_echoes(view, routes, weight, point[visible], world.speck_wall[visible_specks], bit("los_surfaces"))


def _flashes(view: Snapshot) -> Echoes:
    """The foot of the perpendicular on every straight piece of wall, where it lies on the piece and is seen."""
    world = view.world
    wall, point, rows = _feet(
        view.antenna, np.flatnonzero(world.is_flat), view.walls, world.builds, view.blockers.pieces
    )
    # a number that is no scatterer's
    routes = Routes(rows).with_columns(target=NONE - world.wall_id[wall])
    weight = flash_weight(view, 2.0 * routes.length_m)
    return surface_echoes(view, routes, weight, point, wall, bit("los_surfaces"))


@compiled(error_model="numpy")
def _feet(antenna, flat, walls, builds, pieces):  # type: ignore[no-untyped-def]
    """Walls, their points and the routes there; one bounce on a round trip is half of it each way."""
    a, b, normal, offset, top = walls
    wall, point, rows, count = np.empty(len(flat), np.int64), np.empty((len(flat), 3)), np.empty(len(flat), ROUTE), 0
    start = antenna[0], antenna[1], antenna[2]
    for w in flat:
        nx, ny = normal[w, 0], normal[w, 1]
        distance = nx * start[0] + ny * start[1] + offset[w]
        foot = start[0] - distance * nx, start[1] - distance * ny, start[2]
        wx, wy = b[w, 0] - a[w, 0], b[w, 1] - a[w, 1]
        share = ((foot[0] - a[w, 0]) * wx + (foot[1] - a[w, 1]) * wy) / (wx * wx + wy * wy)
        if not (0.0 <= share <= 1.0 and top[w] > start[2] and distance > NEAREST_M):
            continue
        free, _, foliage = passage(start, foot, -1, pieces, True)
        if not free:
            continue
        fill_route(rows[count], NONE, distance, (-nx, -ny, 0.0), (-nx, -ny, 0.0), 0)
        whole, front, rough = bounce(builds, w, 1.0)
        rows[count].whole, rows[count].front = cmath.sqrt(whole), cmath.sqrt(front)
        rows[count].rough, rows[count].foliage = math.sqrt(rough), foliage
        wall[count] = w
        point[count, 0], point[count, 1], point[count, 2] = foot
        count += 1
    return wall[:count], point[:count], rows[:count]
