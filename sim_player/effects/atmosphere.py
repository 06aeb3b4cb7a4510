"""Gases and rain along every way: ITU-R P.676 and P.838."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from models.physics.attenuation import gas_db_per_m, rain_db_per_m
from sim_player.scene.world import World
from sim_player.trace.echoes import Echoes

if TYPE_CHECKING:
    from sim_player.planner.ablation import Chain

NAME = "atmosphere"
ABOUT = "gases and rain along the paths"
COST_S = 0.0


def absent(world: World) -> str | None:
    """There is air everywhere."""
    return None


def apply(echoes: Echoes, world: World, used: bool) -> np.ndarray | float:
    """Field factor of every echo."""
    if not used:
        return 1.0
    return np.asarray(10.0 ** (-air_db_per_m(world) * (echoes.out_m + echoes.back_m) / 20.0))


def air_db_per_m(world: World) -> float:
    """Specific attenuation of the scene's air, dB/m."""
    weather, carrier_hz = world.scene.weather, world.radar.carrier_hz
    gas = gas_db_per_m(carrier_hz, weather.temperature_c, weather.pressure_hpa, weather.water_vapour_g_per_m3)
    return float(gas + rain_db_per_m(carrier_hz, weather.rain_mm_per_h))


def change(chain: Chain) -> np.ndarray:
    """Bound of what it changes: magnitudes of all paths' differences."""
    return chain.weight_change(NAME)
