"""Diffuse echoes of rough walls: the power |r|^2 (1 - rho) that roughness takes from the mirror, in a lobe.

Patches of random phase, in Kirchhoff's lobe (`models.physics.rough_lobe`).
"""

from __future__ import annotations

import numpy as np

from models.physics.rough_lobe import RoughLobe, rough_lobe
from sim_player.scene.world import World
from sim_player.trace.echoes import Echoes, echo_amplitude, surface_echoes
from sim_player.trace.effect_names import bit
from sim_player.trace.routes import dot, scatterer_routes
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
    visible, routes = scatterer_routes(view, patches, point)
    patches = patches[visible]
    wall = world.speck_wall[patches]
    cosine = np.minimum(np.abs(dot(routes.depart[:, :2], world.speck_normal[patches])), 1.0)
    whole, front, _ = world.reflection(wall, cosine)
    lit_height = np.minimum(world.wall_height_m[wall], LIT_ELEVATION_RAD * routes.length_m)
    per_area = rcs_per_area(world, wall, cosine, 0.5 * lit_height / routes.length_m)
    rcs = per_area * lit_height * world.speck_length_m[patches]
    weight = echo_amplitude(world.radar, rcs, routes.length_m) * world.speck_phasor[patches]
    echoes = surface_echoes(view, routes, weight, point[visible], wall, bit("diffuse_scattering"))
    # the share that the wall reflects at all belongs to the patch, not to its route
    return echoes.with_columns(whole=echoes.whole * np.abs(whole), front=echoes.front * np.abs(front))


def rcs_per_area(world: World, wall: np.ndarray, cosine: np.ndarray, elevation_rad: np.ndarray) -> np.ndarray:
    """Return the cross section per area back to the radar of perfect but rough pieces of wall at cosines, [N].

    `elevation_rad`: half of the height that is lit.
    """
    surface, per_area = world.wall_surface[wall], np.empty(len(wall))
    alike: dict[RoughLobe, list[int]] = {}
    for index in np.flatnonzero(np.bincount(surface)).tolist():
        rough = world.scene.surfaces[index]
        lobe = rough_lobe(1e-3 * rough.roughness_mm, 1e-3 * rough.correlation_mm, world.radar.wavelength_m)
        alike.setdefault(lobe, []).append(index)
    for lobe, surfaces in alike.items():
        own = np.isin(surface, surfaces)
        per_area[own] = lobe.backscatter(cosine[own], elevation_rad[own])
    return per_area
