"""Diffuse return of rough walls: what the mirror loses, in Kirchhoff's lobe."""

from __future__ import annotations

import math

import numpy as np

from models.physics.fresnel import half_space_reflection
from models.physics.materials import permittivity
from models.physics.rough_lobe import RoughLobe
from sim_player.effects.diffuse_scattering import LIT_ELEVATION_RAD
from tests.sim_player.trace.point_scenes import RADAR, points_world, traced, unit_weight, wall

NAME = "diffuse_scattering"

FAR = [(-5.0, -300.0, 1.0)]


ROUGH = {"material": "concrete", "roughness_mm": 2.0, "correlation_mm": 20.0, "height_m": 9.0}
ENDS = (12.0, -8.0), (12.0, 8.0)


def test_kirchhoffs_lobe_of_each_patch() -> None:
    """RCS |r|^2 A times the lobe's backscatter, mean over the lit height of +-0.15 rad; the patches' phases; 1e-12."""
    world = points_world(FAR, wall(*ENDS, **ROUGH))
    echoes = traced(world, NAME).echoes[NAME]
    distance = np.hypot(*echoes.point[:, :2].T)
    length = world.speck_length_m[world.speck_length_m > 0.0]
    r = half_space_reflection(permittivity("concrete", RADAR.carrier_hz), 12.0 / distance)
    lobe = RoughLobe(2e-3, 0.02, RADAR.wavelength_m)
    per_area = lobe.backscatter(12.0 / distance, 0.5 * LIT_ELEVATION_RAD)
    rcs = np.abs(r) ** 2 * per_area * length * LIT_ELEVATION_RAD * distance
    np.testing.assert_allclose(np.abs(unit_weight(echoes)) ** 2, rcs / distance**4, rtol=1e-12)
    phasor = echoes.weight / np.abs(echoes.weight)
    np.testing.assert_allclose(phasor, world.speck_phasor[world.rough_patches[0]], atol=1e-12)


def test_lobe_belongs_to_its_surface() -> None:
    """Two walls, another lobe on one of them: the other one's echoes keep every byte, its own change."""
    first, second = ((12.0, -8.0), (12.0, 0.0)), ((14.0, 0.0), (14.0, 8.0))
    plain = points_world(FAR, wall(*first, **ROUGH), wall(*second, **ROUGH))
    mixed = points_world(FAR, wall(*first, **ROUGH), wall(*second, **ROUGH | {"correlation_mm": 40.0}))
    before, after = (traced(world, NAME).echoes[NAME] for world in (plain, mixed))
    own = before.surface == 0
    np.testing.assert_array_equal(before.weight[own], after.weight[own])
    assert np.all(before.weight[~own] != after.weight[~own])


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
