"""Hard cases of rain: drizzle and cloudburst, both bands, walls edge-on, at the radar's height, all around it."""

from __future__ import annotations

import math

import numpy as np
import pytest

from models.physics.precipitation import reflectivity_per_m
from sim_player.scene.description import Scene, SceneArray, SceneRadar, Surface, Weather
from sim_player.scene.front_end import NO_FAULTS
from sim_player.scene.world import prepare, snapshot
from sim_player.signal.clutter import clutter_profiles, profile_power_mw
from sim_player.signal.rain_volume import clutter_at
from sim_player.signal.switches import SignalEffects
from tests.sim_player.trace.point_scenes import wall

RAINS = SignalEffects(rain_clutter=True)
LAYOUTS: tuple[tuple[Surface, ...], ...] = (
    (),
    (wall((5.0, 0.0), (50.0, 0.0)), wall((5.0, 0.0), (50.0, 0.0))),
    (wall((20.0, -9.0), (20.0, 9.0), height_m=1.0), Surface(role="ground", material="concrete")),
    (wall((9.0, -9.0), (9.0, 9.0), (-9.0, 9.0), (-9.0, -9.0), (9.0, -9.0)),),
    (wall((9.0, -9.0), (9.0, 9.0), height_m=1e-3), wall((1e-1, 3.0), (0.2, 3.0), height_m=900.0)),
)


@pytest.mark.parametrize("surfaces", LAYOUTS)
@pytest.mark.parametrize("preset", ["xband", "77ghz"])
def test_clutter_is_finite_and_grows_with_the_rain(surfaces: tuple[Surface, ...], preset: str) -> None:
    """No division by a wall seen edge-on, by a cosine of nothing, or by a trace of rain: 1e-300 to 200 mm/h."""
    before = np.zeros(1)
    for rain in (1e-300, 0.001, 200.0):
        radar = SceneRadar(preset=preset)  # type: ignore[arg-type]
        world = prepare(Scene(name="r", radar=radar, surfaces=surfaces, weather=Weather(rain_mm_per_h=rain)))
        with np.errstate(over="raise", divide="raise", invalid="raise"):
            power_mw = profile_power_mw(world.setup, clutter_at(snapshot(world), RAINS), RAINS, NO_FAULTS)
        assert np.isfinite(power_mw).all()
        assert (power_mw >= before).all()
        before = power_mw
    assert np.isfinite(clutter_profiles(world.setup, clutter_at(snapshot(world), RAINS), RAINS, NO_FAULTS, 1)).all()


@pytest.mark.parametrize("chirps", [1, 2, 2048])
def test_terms_of_slow_time_keep_the_power(chirps: int) -> None:
    """One chirp of one column, and 2,048 chirps over 4.7 tau: a thousandth of the power is left out at most."""
    radar = SceneRadar(array=SceneArray(columns=1), beams_deg=(0.0,), chirps_per_beam=chirps)
    world = prepare(Scene(name="r", radar=radar, weather=Weather(fog_g_per_m3=5.0, snow_mm_per_h=50.0)))
    profiles = clutter_profiles(world.setup, clutter_at(snapshot(world), RAINS), RAINS, NO_FAULTS, 1)
    assert np.isfinite(profiles).all()
    power_mw = profile_power_mw(world.setup, clutter_at(snapshot(world), RAINS), RAINS, NO_FAULTS)[:, 10:]
    ratio = float(np.mean(np.abs(profiles[:, 10:]) ** 2 / power_mw))
    assert 10.0 * math.log10(ratio) == pytest.approx(0.0, abs=1.0)


@pytest.mark.parametrize("frequency_hz", [1e9, 20e9, 20.001e9, 300e9, 1000e9])
def test_mie_holds_at_every_band(frequency_hz: float) -> None:
    """Drops of a hundredth to 80 wavelengths; where Mie's series takes over at 20 GHz rain moves by under 3 dB."""
    amounts = [reflectivity_per_m(frequency_hz, rain, rain / 10.0) for rain in (0.0, 1e-300, 1e-6, 1.0, 300.0)]
    assert np.isfinite(amounts).all()
    assert amounts == sorted(amounts)
    step_db = 10.0 * math.log10(reflectivity_per_m(20.001e9, 10.0) / reflectivity_per_m(20e9, 10.0))
    assert abs(step_db) < 3.0
