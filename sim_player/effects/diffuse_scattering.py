"""Diffuse echoes of rough walls: the power |r|^2 (1 - rho) that roughness takes from the mirror, in a Lambert lobe.

RCS per area 4 |r|^2 (1 - rho) cos^2 over the height that the antenna lights; patches of random phase along the wall.
"""

from __future__ import annotations

import numpy as np

from sim_player.effects.names import bit
from sim_player.scene.world import World
from sim_player.trace.echoes import Echoes, echo_amplitude, surface_echoes
from sim_player.trace.routes import dot, straight_routes
from sim_player.trace.snapshot import TraceContext

#: Two-way elevation beamwidth of four rows: how much of a wall's height a patch stands for.
LIT_ELEVATION_RAD = 0.3


def absent(world: World) -> str | None:
    """Smooth walls scatter nothing."""
    rough = world.is_mirror & (world.wall_roughness_m > 0.0)
    return None if rough.any() else "no wall is rough"


def apply(tracing: TraceContext) -> Echoes:
    """Patches of all rough walls in direct sight."""
    view, world = tracing.view, tracing.view.world
    patches, point = world.rough_patches
    routes, occlusion = straight_routes(view, point)
    visible = np.flatnonzero(occlusion.free)
    patches = patches[visible]
    routes = routes.take(visible).with_columns(target=world.speck_id[patches])
    wall = world.speck_wall[patches]
    cosine = np.minimum(np.abs(dot(routes.depart[:, :2], world.speck_normal[patches])), 1.0)
    whole, front, rough = world.reflection(wall, cosine)
    lit_height = np.minimum(world.wall_height_m[wall], LIT_ELEVATION_RAD * routes.length_m)
    rcs = 4.0 * (1.0 - rough**2) * cosine**2 * lit_height * world.speck_length_m[patches]
    weight = echo_amplitude(world.radar, rcs, routes.length_m) * world.speck_phasor[patches]
    echoes = surface_echoes(view, routes, weight, point[visible], wall, bit("diffuse_scattering"))
    # the share that the wall reflects at all belongs to the patch, not to its route
    return echoes.with_columns(whole=echoes.whole * np.abs(whole), front=echoes.front * np.abs(front))
