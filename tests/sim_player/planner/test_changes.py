"""Every effect has a bound of what it changes: that of its kind, or its own."""

from __future__ import annotations

import math
from types import SimpleNamespace

import numpy as np
import pytest

from msgs.values.radar import RadarParams, RadarSetup
from sim_player.effects.table import EFFECTS, SIGNAL, ArrayEffect, SignalEffect, always
from sim_player.planner.ablation import EffectAblation, _mirror_skirts, crowd
from sim_player.planner.changes import change_of
from sim_player.planner.purposes import Purpose
from sim_player.scene.description import Scene, SceneObject, SceneRadar, Weather
from sim_player.scene.front_end import FrontEnd, Spur
from sim_player.scene.world import prepare
from sim_player.signal.levels import noise_profiles
from tests.sim_player.trace.point_scenes import wall

FRONT_END = FrontEnd(
    coupling_db=-20.0,
    iq_gain_db=0.5,
    flicker_corner_hz=1e5,
    leakage_dbm=-60.0,
    spurs=(Spur(frequency_hz=1e7, power_dbm=-80.0),),
)


def ablation(front_end: FrontEnd = FRONT_END) -> EffectAblation:
    """All effects of a wall beside a car, with a faulty front end."""
    scene = Scene(
        name="car",
        surfaces=(wall((12.0, -5.0), (12.0, 8.0), material="concrete"),),
        objects=(SceneObject(class_="car", x_m=8.0, y_m=3.0),),
        radar=SceneRadar(front_end=front_end),
        weather=Weather(rain_mm_per_h=5.0),
    )
    return EffectAblation(prepare(scene), scene.setup, 0.0, Purpose.SAMPLES, 0.1)


def change_bound(found: EffectAblation, name: str) -> np.ndarray:
    """The largest that an effect may change, [beams, bins]."""
    change = change_of(found, name)
    return np.abs(change.values) + np.broadcast_to(change.bound, found.shape)


@pytest.fixture(scope="module")
def full() -> EffectAblation:
    return ablation()


@pytest.mark.parametrize("name", EFFECTS)
def test_every_effect_has_a_bound(full: EffectAblation, name: str) -> None:
    bound = change_bound(full, name)
    assert bound.shape == full.shape
    assert np.isfinite(bound).all()
    assert (bound >= 0.0).all()


@pytest.mark.parametrize("name", SIGNAL)
def test_signal_effects_that_are_there_change_something(full: EffectAblation, name: str) -> None:
    assert change_bound(full, name).any()


def test_faults_that_are_not_stated_change_nothing() -> None:
    faultless = ablation(FrontEnd())
    for name in ("flicker", "leakage", "iq_imbalance", "spurs"):
        assert not change_bound(faultless, name).any(), name


def test_flicker_widens_noise_draws_of_five_and_a_half_rms() -> None:
    """Layout: corner at range bin 8. Analytic: the density of the sum is 1 + 8 / bin of the thermal one's, which a Hann
    window turns into a power of 1.5 / N a bin; what draws reach grows by 5.5 times what the rms grows.

    Bias: the window passes on the next lower bin's density too. Bound: from the bin's own to that one's.
    """
    radar = RadarParams()
    tested = ablation(FrontEnd(flicker_corner_hz=8.0 / radar.chirp_period_s))
    thermal_rms = math.sqrt(1.5 * radar.noise_power_mw / (radar.samples_per_chirp * radar.chirps_per_beam))
    bins = np.arange(1, tested.shape[1])
    own = 5.5 * thermal_rms * (np.sqrt(1.0 + 8.0 / bins) - 1.0)
    bound = change_bound(tested, "flicker")[:, 1:]
    assert (bound >= own * (1.0 - 1e-6)).all()
    assert (bound[:, 1:] <= own[:-1] * (1.0 + 1e-6)).all()


def test_noise_stays_under_its_bound() -> None:
    """40 draws of 25 x 512 cells of thermal noise and rounding. Rayleigh: the strongest of 5e5 reaches 3.6 rms, +-0.4.

    The bound is to hold for 10^13 cells, 5.5 rms; a much wider one would keep noise that nobody sees.
    """
    plain = ablation(FrontEnd())
    draws = [noise_profiles(plain.setup, seed, plain.flags, plain.front_end) for seed in range(40)]
    strongest = float((np.abs(draws).max(axis=0) / change_bound(plain, "thermal_noise")).max())
    assert 3.2 / 5.5 < strongest < 4.0 / 5.5


def test_effect_without_a_bound_is_an_error(full: EffectAblation, monkeypatch: pytest.MonkeyPatch) -> None:
    """A signal effect that the planner knows no bound of must not pass for one that changes nothing."""
    monkeypatch.setitem(EFFECTS, "hum", SignalEffect("mains in the receiver", always))
    with pytest.raises(KeyError, match="hum has no bound"):
        change_bound(full, "hum")
    monkeypatch.setitem(EFFECTS, "element_pattern", ArrayEffect("gain falls off the element's axis", always))
    assert change_bound(full, "element_pattern").any()


def test_paths_share_what_is_left_out_with_those_two_bins_away() -> None:
    """In bins 0, 10, 10, 12 and 13: three about the tenth, four about the twelfth, two about the thirteenth."""
    radar = RadarSetup().radar
    length_m = 2.0 * radar.range_bin_m * (np.array([0, 10, 10, 12, 13]) + 0.3)
    assert crowd(radar, SimpleNamespace(length_m=length_m)).tolist() == [1, 3, 3, 4, 2]  # type: ignore[arg-type]


def test_an_image_lies_as_far_below_zero_as_its_echo_above() -> None:
    """From bin 2 to bin 3 at -f are five bins: 1 / 125; beside zero all of it may be there."""
    skirts = _mirror_skirts(4)
    assert (skirts[2, 3], skirts[0, 2], skirts[0, 1], skirts[1, 1]) == (1 / 125, 1 / 8, 1.0, 1 / 8)
