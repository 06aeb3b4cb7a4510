"""Straight and mirrored ways that lead through walls: glass and wood let 10 GHz pass, 40 cm of concrete does not."""

from __future__ import annotations

import numpy as np

from sim_player.effects.names import bit
from sim_player.scene.world import World
from sim_player.trace.echoes import Echoes, cofocal, join_echoes, object_echoes
from sim_player.trace.routes import Routes
from sim_player.trace.segments import Occlusion
from sim_player.trace.snapshot import TraceContext


def absent(world: World) -> str | None:
    """Something behind, and a wall with a back."""
    if not len(world.centre_m):
        return "the scene holds no object"
    if not world.is_mirror.any():
        return "the scene holds no wall"
    return None if world.most_through[world.is_mirror].max() > 0.0 else "every wall is too thick to have a back"


def apply(tracing: TraceContext) -> Echoes:
    """Ways to centres that cross walls and no body, out and back; the walls' factors squared."""
    view = tracing.view
    direct, mirrored = _behind(*tracing.straight), _behind(*tracing.mirrored)
    return join_echoes(
        [
            object_echoes(view, direct, cofocal(direct), bit("wall_transmission") | bit("los_objects")),
            object_echoes(view, mirrored, cofocal(mirrored), bit("wall_transmission")),
        ]
    )


def _behind(routes: Routes, occlusion: Occlusion) -> Routes:
    """The routes that walls stand in, weakened by them."""
    behind = np.flatnonzero(~occlusion.free & (occlusion.through != 0.0))
    routes = routes.take(behind)
    return routes.with_columns(other=routes.other * occlusion.through[behind])
