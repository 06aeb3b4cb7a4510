"""Diffuse return of rough walls: what the mirror loses, in Lambert's lobe or in Kirchhoff's."""

from __future__ import annotations

import math

import numpy as np
import pytest

from models.physics.fresnel import coherent_power, half_space_reflection
from models.physics.materials import permittivity
from models.physics.rough_lobe import RoughLobe
from sim_player.effects.diffuse_scattering import LIT_ELEVATION_RAD
from sim_player.trace.echoes import echo_amplitude
from sim_player.trace.routes import dot, scatterer_routes, straight_routes
from tests.sim_player.trace.point_scenes import RADAR, points_world, traced, unit_weight, wall

NAME = "diffuse_scattering"

FAR = [(-5.0, -300.0, 1.0)]


def test_lambert_lobe_of_each_patch() -> None:
    """RCS 4 |r|^2 (1 - rho) cos^2 A, A = patch length times the lit height 0.3 R (the wall is higher); 1e-12."""
    rough = {"material": "concrete", "roughness_mm": 1.2, "height_m": 9.0}
    world = points_world(FAR, wall((12.0, -8.0), (12.0, 8.0), diffuse_lobe="lambert", **rough))
    echoes = traced(world, NAME).echoes[NAME]
    distance = np.hypot(*echoes.point[:, :2].T)
    cosine = 12.0 / distance
    length = world.speck_length_m[world.speck_length_m > 0.0]
    assert len(echoes) == len(length) > 100
    r = half_space_reflection(permittivity("concrete", RADAR.carrier_hz), cosine)
    rho = coherent_power(1.2e-3, cosine, RADAR.wavelength_m)
    rcs = 4.0 * np.abs(r) ** 2 * (1.0 - rho) * cosine**2 * length * LIT_ELEVATION_RAD * distance
    np.testing.assert_allclose(np.abs(unit_weight(echoes)) ** 2, rcs / distance**4, rtol=1e-12)


def test_lobe_holds_the_energy_that_roughness_takes() -> None:
    """Lambert: bistatic RCS 4 a cos_i cos_s per area over the half space sends out a of what falls in, cos_i per area.

    Integral of sigma / (4 pi) over directions = a cos_i: quadrature of the effect's own form, 1e-6.
    """
    share, incident = 0.37, 0.6
    polar = (np.arange(2000) + 0.5) / 2000.0 * 0.5 * np.pi
    per_area = 4.0 * share * incident * np.cos(polar)
    out = np.sum(per_area / (4.0 * np.pi) * 2.0 * np.pi * np.sin(polar)) * 0.5 * np.pi / 2000.0
    assert out == pytest.approx(share * incident, rel=1e-6)
    # and the form itself: monostatic RCS per area of the traced patches is that lobe at cos_s = cos_i
    rough = {"material": "metal", "roughness_mm": 30.0, "height_m": 9.0}
    world = points_world(FAR, wall((12.0, -8.0), (12.0, 8.0), diffuse_lobe="lambert", **rough))
    echoes = traced(world, NAME).echoes[NAME]
    distance = np.hypot(*echoes.point[:, :2].T)
    area = world.speck_length_m[world.speck_length_m > 0.0] * LIT_ELEVATION_RAD * distance
    cosine = 12.0 / distance
    np.testing.assert_allclose(np.abs(unit_weight(echoes)) ** 2 * distance**4 / area, 4.0 * cosine**2, rtol=2e-3)


ROUGH = {"material": "concrete", "roughness_mm": 2.0, "correlation_mm": 20.0, "height_m": 9.0}
ENDS = (12.0, -8.0), (12.0, 8.0)


def test_kirchhoffs_lobe_of_each_patch() -> None:
    """RCS |r|^2 A times the lobe's backscatter, mean over the lit height of +-0.15 rad; the same phases; 1e-12."""
    cosine_law = traced(points_world(FAR, wall(*ENDS, diffuse_lobe="lambert", **ROUGH)), NAME).echoes[NAME]
    world = points_world(FAR, wall(*ENDS, **ROUGH))
    echoes = traced(world, NAME).echoes[NAME]
    distance = np.hypot(*echoes.point[:, :2].T)
    length = world.speck_length_m[world.speck_length_m > 0.0]
    r = half_space_reflection(permittivity("concrete", RADAR.carrier_hz), 12.0 / distance)
    lobe = RoughLobe(2e-3, 0.02, RADAR.wavelength_m)
    per_area = lobe.backscatter(12.0 / distance, 0.5 * LIT_ELEVATION_RAD)
    rcs = np.abs(r) ** 2 * per_area * length * LIT_ELEVATION_RAD * distance
    np.testing.assert_allclose(np.abs(unit_weight(echoes)) ** 2, rcs / distance**4, rtol=1e-12)
    np.testing.assert_allclose(np.angle(echoes.weight), np.angle(cosine_law.weight), atol=1e-12)


def test_lobe_belongs_to_its_surface() -> None:
    """Two walls, one with each lobe: the first one's echoes keep every byte, the other's change."""
    first, second = ((12.0, -8.0), (12.0, 0.0)), ((14.0, 0.0), (14.0, 8.0))
    plain = points_world(FAR, wall(*first, **ROUGH), wall(*second, **ROUGH))
    mixed = points_world(FAR, wall(*first, **ROUGH), wall(*second, diffuse_lobe="lambert", **ROUGH))
    before, after = (traced(world, NAME).echoes[NAME] for world in (plain, mixed))
    own = before.surface == 0
    np.testing.assert_array_equal(before.weight[own], after.weight[own])
    assert np.all(before.weight[~own] != after.weight[~own])


def test_cosine_law_has_the_bytes_of_the_first_series() -> None:
    """4 (1 - rho) cos^2 h ds and the radar equation, in the order in which they were first multiplied: no bit moves."""
    world = points_world(FAR, wall(*ENDS, diffuse_lobe="lambert", **ROUGH))
    tracing = traced(world, NAME)
    echoes, (routes, occlusion) = tracing.echoes[NAME], straight_routes(tracing.view, world.rough_patches[1])
    assert np.all(np.abs(scatterer_routes(tracing.view, *world.rough_patches)[1].other) == 1.0)
    routes, patches = routes.take(np.flatnonzero(occlusion.free)), world.rough_patches[0][occlusion.free]
    cosine = np.minimum(np.abs(dot(routes.depart[:, :2], world.speck_normal[patches])), 1.0)
    _, _, rough = world.reflection(world.speck_wall[patches], cosine)
    height = np.minimum(world.wall_height_m[world.speck_wall[patches]], LIT_ELEVATION_RAD * routes.length_m)
    rcs = 4.0 * (1.0 - rough**2) * cosine**2 * height * world.speck_length_m[patches]
    weight = echo_amplitude(world.radar, rcs, routes.length_m) * world.speck_phasor[patches]
    np.testing.assert_array_equal(echoes.weight, weight * routes.other * routes.other)


def test_smooth_low_or_hidden_walls_scatter_nothing() -> None:
    rough = {"material": "brick", "roughness_mm": 1.0}
    low = points_world(FAR, wall((2.0, -0.3), (2.0, 0.3), height_m=0.2, **rough))
    assert len(traced(low, NAME).echoes[NAME]) == 0
    hidden = points_world(FAR, wall((12.0, -8.0), (12.0, 8.0), **rough), wall((6.0, -9.0), (6.0, 9.0)))
    assert len(traced(hidden, NAME).echoes[NAME]) == 0


def test_phases_are_random_and_fixed() -> None:
    """Unit phasors of the patches: mean near 0 within 4 / sqrt(N), the same at any time."""
    world = points_world(FAR, wall((12.0, -8.0), (12.0, 8.0), material="brick", roughness_mm=1.0))
    one, two = (traced(world, NAME, time_s=time_s).echoes[NAME] for time_s in (0.0, 3.0))
    np.testing.assert_array_equal(one.weight, two.weight)
    phasor = one.weight / np.abs(one.weight)
    assert abs(phasor.mean()) < 4.0 / math.sqrt(len(phasor))
