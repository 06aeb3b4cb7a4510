"""Straight and mirrored ways that lead through walls: glass and wood let 10 GHz pass, 40 cm of concrete does not.

Left out: arcs, two mirrors and the ground, and mixtures that leave little (`LEAST_BOTH`).
"""

from __future__ import annotations

import numpy as np

from sim_player.scene.segments import Occlusion
from sim_player.scene.world import World
from sim_player.trace.echoes import LEAST_BOTH, Echoes, cofocal, object_echoes, same_target
from sim_player.trace.effect_names import bit
from sim_player.trace.routes import Routes
from sim_player.trace.snapshot import TraceContext


def absent(world: World) -> str | None:
    """Something behind, and a wall with a back."""
    if not len(world.centre_m):
        return "the scene holds no object"
    if not world.is_mirror.any():
        return "the scene holds no wall"
    return None if world.most_through[world.is_mirror].max() > 0.0 else "every wall is too thick to have a back"


def apply(tracing: TraceContext) -> Echoes:
    """Ways to centres that cross walls and no body, out and back, or back by another way: through walls or clear."""
    view = tracing.view
    direct, mirrored = _behind(*tracing.straight, bit("los_objects")), _behind(*tracing.mirrored, 0)
    through = Routes.joined([direct, mirrored])
    if not len(through):
        tracing.routes["wall_transmission"] = through
        return object_echoes(view, through, cofocal(through))
    every = Routes.joined([through, tracing.unbent_routes])
    tracing.routes["wall_transmission"] = through
    left = np.abs(every.other)
    out, back = same_target(through.target, every.target)
    mixed = (out < back) & (left[out] * left[back] >= LEAST_BOTH)
    alike = object_echoes(view, through, cofocal(through))
    return Echoes.joined([alike, object_echoes(view, every, (out[mixed], back[mixed]))])


def _behind(routes: Routes, occlusion: Occlusion, needs: int) -> Routes:
    """The routes that walls stand in, weakened by them."""
    through = occlusion.through - occlusion.over
    behind = np.flatnonzero(np.abs(through) >= LEAST_BOTH)
    routes, through = routes.take(behind), through[behind]
    return routes.with_columns(other=routes.other * through, needs=routes.needs | (needs | bit("wall_transmission")))
