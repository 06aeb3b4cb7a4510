"""Out by one way, back by another: direct and mirrored, two walls, two points of a curved wall; arrays set apart.

Both orders are one echo of twice the field where transmitter and receiver are one; else they differ in length.
"""

from __future__ import annotations

import numpy as np

from sim_player.scene.world import World
from sim_player.trace.echoes import Echoes, object_echoes, same_target
from sim_player.trace.effect_names import bit
from sim_player.trace.snapshot import TraceContext


def absent(world: World) -> str | None:
    """Something to reach, and a mirror for the second way."""
    if world.scene.radar.separation_m > 0.0:
        return None
    if not len(world.centre_m):
        return "the scene holds no object"
    return None if world.is_mirror.any() else "the scene holds no wall: there is one way only"


def apply(tracing: TraceContext) -> Echoes:
    """All mixtures of two clear ways to the same centre."""
    routes = tracing.clear_routes("los_objects", "specular_relay", "curved_wall", "second_relay")
    out, back = same_target(routes.target, routes.target)
    mixed = np.flatnonzero(out < back)
    return object_echoes(tracing.view, routes, (out[mixed], back[mixed]), bit("non_cofocal"))
