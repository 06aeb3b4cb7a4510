"""Factors of every echo, with an effect and without it, and scenes that have none of one."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from models.physics.attenuation import gas_db_per_m, rain_db_per_m
from sim_player.effects import weights
from sim_player.scene.air import air_db_per_m
from sim_player.scene.description import Surface, Weather
from tests.sim_player.trace.point_scenes import RADAR, points_world, wall

ECHOES: Any = SimpleNamespace(
    rough=np.array([0.9]), whole=np.array([0.7]), front=np.array([0.6]), foliage=np.array([0.3]),
    out_m=np.array([40.0]), back_m=np.array([60.0]),
)  # fmt: skip
WORLD: Any = SimpleNamespace(once=lambda name, make: 0.2)


@pytest.mark.parametrize(
    ("effect", "used", "unused"),
    [
        # 0.2 dB/m over 100 m are 20 dB: a tenth of the field
        (weights.atmosphere, 0.1, 1.0),
        (weights.rough_wall_loss, 0.9, 1.0),
        (weights.slab_resonance, 0.7, 0.6),
        (weights.vegetation, 0.3, 1.0),
    ],
)
def test_an_effect_is_a_factor_of_the_field(effect: Any, used: float, unused: float) -> None:
    assert effect(ECHOES, WORLD, True) == pytest.approx(used)
    assert effect(ECHOES, WORLD, False) == pytest.approx(unused)


def test_air_attenuates_by_gases_and_rain() -> None:
    """50 mm/h at the carrier: both terms, of the scene's own weather."""
    weather = Weather(temperature_c=25.0, pressure_hpa=990.0, water_vapour_g_per_m3=12.0, rain_mm_per_h=50.0)
    world = points_world([(4.0, 0.0, 1.0)], weather=weather)
    gas = gas_db_per_m(RADAR.carrier_hz, 25.0, 990.0, 12.0)
    assert air_db_per_m(world) == pytest.approx(gas + rain_db_per_m(RADAR.carrier_hz, 50.0))
    assert gas < 0.1 * air_db_per_m(world)


@pytest.mark.parametrize(
    ("surfaces", "roughness", "backs", "plants"),
    [
        ((wall((12.0, -5.0), (12.0, 8.0)),), False, False, False),
        ((wall((12.0, -5.0), (12.0, 8.0), roughness_mm=1.0),), True, False, False),
        ((Surface(role="ground", material="asphalt", roughness_mm=1.0),), True, False, False),
        ((wall((12.0, -5.0), (12.0, 8.0), material="glass", thickness_mm=6.0),), False, True, False),
        (
            (wall((12.0, -5.0), (12.0, 8.0), material="vegetation", role="occluder", thickness_mm=900.0),),
            False,
            False,
            True,
        ),
    ],
)
def test_a_scene_says_which_of_them_it_lacks(
    surfaces: tuple[Surface, ...], roughness: bool, backs: bool, plants: bool
) -> None:
    world = points_world([(4.0, 6.0, 1.0)], *surfaces)
    assert (weights.no_roughness(world) is None) == roughness
    assert (weights.no_backs(world) is None) == backs
    assert (weights.no_plants(world) is None) == plants
