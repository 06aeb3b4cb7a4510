"""Flashes and structure of walls in direct sight."""

from __future__ import annotations

import math

import numpy as np
import pytest

from models.physics.fresnel import coherent_power, slab_reflection
from models.physics.materials import permittivity
from sim_player.scene.description import Ego
from sim_player.trace.conversion import weights
from tests.sim_player.effects.point_scenes import RADAR, points_world, traced, unit_weight, wall

NAME = "los_surfaces"

FAR = [(-5.0, -300.0, 1.0)]


@pytest.mark.parametrize("effects", [{"slab_resonance", "rough_wall_loss"}, {"slab_resonance"}, set()])
def test_flash_is_one_bounce_on_a_round_trip(effects: set[str]) -> None:
    """P (lambda / (4 pi 2 d))^2 |r|^2 rho, complex r once, at 2 d; each factor only with its effect; 1e-12."""
    world = points_world(FAR, wall((9.0, -3.0), (9.0, 3.0), material="glass", thickness_mm=6.0, roughness_mm=0.4))
    echoes = traced(world, NAME).echoes[NAME]
    flash = echoes.take(np.arange(len(echoes)) == np.argmax(np.abs(echoes.weight)))
    eps = permittivity("glass", RADAR.carrier_hz)
    thickness = 6e-3 if "slab_resonance" in effects else math.inf
    r = slab_reflection(eps, np.array(1.0), np.array(thickness), RADAR.wavelength_m)
    left = math.sqrt(float(coherent_power(0.4e-3, np.array(1.0), RADAR.wavelength_m)))
    one = math.sqrt(1e3 * RADAR.transmit_power_w) * RADAR.wavelength_m / (4.0 * math.pi * 18.0)
    expected = one * complex(r) * (left if "rough_wall_loss" in effects else 1.0)
    assert weights(flash, world, frozenset(effects))[0] == pytest.approx(expected, rel=1e-12)
    assert flash.out_m[0] + flash.back_m[0] == pytest.approx(18.0)


def test_structure_follows_the_radar_equation() -> None:
    world = points_world(FAR, wall((9.0, 2.0), (9.0, 30.0)))
    echoes = traced(world, NAME).echoes[NAME]
    specks = world.speck_length_m == 0.0
    distance = np.hypot(*world.speck_m[specks].T)
    expected = np.sqrt(world.speck_rcs_m2[specks]) * world.speck_phasor[specks] / distance**2
    np.testing.assert_allclose(unit_weight(echoes), expected, rtol=1e-12)


def test_hidden_walls_do_not_flash() -> None:
    world = points_world(FAR, wall((9.0, -30.0), (9.0, 30.0)), wall((4.0, -3.0), (4.0, 3.0), role="occluder"))
    echoes = traced(world, NAME).echoes[NAME]
    assert not (np.isclose(echoes.point[:, 0], 9.0) & np.isclose(echoes.point[:, 1], 0.0)).any()


def test_flash_follows_a_turning_driving_radar() -> None:
    """Radar at (2, 0) after 1 s: 7 m left, straight ahead of the wall, closing at 2 m/s."""
    world = points_world(FAR, wall((9.0, -3.0), (9.0, 3.0)), ego=Ego(speed_mps=2.0))
    echoes = traced(world, NAME, time_s=1.0).echoes[NAME]
    flash = np.argmax(np.abs(echoes.weight))
    assert echoes.out_m[flash] == pytest.approx(7.0)
    assert echoes.rate_mps[flash] == pytest.approx(-2.0)
