"""The air of a scene: what it takes from a path, by its weather."""

from __future__ import annotations

from models.physics.attenuation import fog_db_per_m, gas_db_per_m, rain_db_per_m, snow_db_per_m
from sim_player.scene.world import World


def air_db_per_m(world: World) -> float:
    """Return the specific attenuation of the scene's air, dB/m; found once and kept with the world."""
    return world.once("air_db_per_m", lambda: _air_db_per_m(world))


def _air_db_per_m(world: World) -> float:
    weather, carrier_hz = world.scene.weather, world.radar.carrier_hz
    gas = gas_db_per_m(carrier_hz, weather.temperature_c, weather.pressure_hpa, weather.water_vapour_g_per_m3)
    snow = snow_db_per_m(carrier_hz, weather.snow_mm_per_h)
    fog = fog_db_per_m(carrier_hz, weather.fog_g_per_m3, weather.temperature_c) if weather.fog_g_per_m3 else 0.0
    return float(gas + rain_db_per_m(carrier_hz, weather.rain_mm_per_h) + snow + fog)
