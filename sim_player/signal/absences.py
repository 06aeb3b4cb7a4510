"""Absences of signal effects: when a scene has none of a switch of `SignalEffects` (`sim_player.signal.switches`)."""

from __future__ import annotations

from sim_player.scene.world import World
from sim_player.signal.receiver import iq_factors


def no_motion(world: World) -> str | None:
    """Only where something moves."""
    return None if world.scene.moves else "nothing moves"


def no_rain(world: World) -> str | None:
    """Only where something falls or floats."""
    weather = world.scene.weather
    falls = weather.rain_mm_per_h or weather.snow_mm_per_h or weather.fog_g_per_m3
    return None if falls else "no rain, snow or fog"


def no_phase_steps(world: World) -> str | None:
    """Ideal phase shifters, or measured weights: nothing to round."""
    exact = world.setup.array.phase_bits == 0 or world.setup.steering_weights is not None
    return "phases are exact" if exact else None


def no_coupling(world: World) -> str | None:
    """Only where the front end states it."""
    return "the columns do not couple" if world.scene.radar.front_end.coupling_db is None else None


def no_flicker(world: World) -> str | None:
    """Only where the front end states it."""
    return "the receiver has no 1/f noise" if world.scene.radar.front_end.flicker_corner_hz == 0.0 else None


def no_leakage(world: World) -> str | None:
    """Only where the front end states it."""
    return "no leakage is stated" if world.scene.radar.front_end.leakage_dbm is None else None


def no_iq_imbalance(world: World) -> str | None:
    """Only where the front end states it."""
    return "I and Q agree" if iq_factors(world.scene.radar.front_end)[1] == 0.0 else None


def no_spurs(world: World) -> str | None:
    """Only where the front end states them."""
    return None if world.scene.radar.front_end.spurs else "no spurs are stated"
