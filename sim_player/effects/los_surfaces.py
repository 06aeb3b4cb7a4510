"""Walls in direct sight: the flash of a wall that is met square on, and its structure (edges, frames, joints).

A flash is the radar's own image: field r lambda sqrt(P) / (4 pi 2d), from the mirror law alone. Structure is small
scatterers every 1-3 m and at every end; their level is an engineering choice, not a measurement.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from sim_player.effects.names import bit
from sim_player.scene.world import Snapshot, World
from sim_player.trace.echoes import Echoes, echo_amplitude, join_echoes, surface_echoes
from sim_player.trace.routes import NEAREST_M, NONE, dot, make_routes, straight_routes
from sim_player.trace.segments import segment_occlusion
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
    specks = np.flatnonzero((world.speck_length_m == 0.0) & (world.wall_height_m[world.speck_wall] > view.antenna[2]))
    point = _level(view, world.speck_m[specks])
    routes, occlusion = straight_routes(view, point)
    visible_specks = specks[occlusion.free]
    routes = replace(routes.take(occlusion.free), target=world.speck_id[visible_specks])
    weight = (
        echo_amplitude(world.radar, world.speck_rcs_m2[visible_specks], routes.length_m)
        * world.speck_phasor[visible_specks]
    )
    return surface_echoes(
        view, routes, weight, point[occlusion.free], world.speck_wall[visible_specks], bit("los_surfaces")
    )


def _flashes(view: Snapshot) -> Echoes:
    """The foot of the perpendicular on every straight piece of wall, where it lies on the piece and is seen."""
    world = view.world
    distance = view.normal @ view.origin + view.offset
    foot = view.origin - distance[:, None] * view.normal
    along = world.wall_b - world.wall_a
    share = dot(foot - world.wall_a, along) / dot(along, along)
    met = (share >= 0.0) & (share <= 1.0) & (world.wall_height_m > view.antenna[2]) & (distance > NEAREST_M)
    wall = np.flatnonzero(met & world.is_flat)
    point = _level(view, foot[wall])
    occlusion = segment_occlusion(view.antenna, point, view.blockers)
    direction = np.column_stack([-view.normal[wall], np.zeros(len(wall))])
    whole, front, rough = world.reflection(wall, np.ones(len(wall)))
    # one bounce on a round trip: half of it each way
    routes = make_routes(
        # a number that is no scatterer's
        NONE - world.wall_id[wall],
        distance[wall],
        direction,
        direction,
        occlusion,
        0,
        whole=np.sqrt(whole + 0j),
        front=np.sqrt(front + 0j),
        rough=np.sqrt(rough),
    )
    weight = flash_weight(view, 2.0 * distance[wall])
    return surface_echoes(view, routes, weight, point, wall, bit("los_surfaces")).take(occlusion.free)


def _level(view: Snapshot, plan: np.ndarray) -> np.ndarray:
    """Points of the plane at the antenna's height."""
    return np.column_stack([plan, np.full(len(plan), view.antenna[2])])
