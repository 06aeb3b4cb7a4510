"""Echoes of rain, snow and fog: level against an integral over the beam, walls, ground, draws, all levels of signal."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import lru_cache

import msgspec
import numpy as np
import pytest

from models.physics.antenna import setup_weights, two_way_pattern
from msgs.values.radar import PRESETS, RadarSetup
from msgs.values.units import BOLTZMANN_J_PER_K, SPEED_OF_LIGHT_MPS
from sim_player.dataset.labelled_scan import labelled_scan
from sim_player.planner.plan import manual_plan, noisy_profiles, plan_world
from sim_player.player import ScenePlayer
from sim_player.scene.air import air_db_per_m
from sim_player.scene.description import Ego, Scene, SceneObject, SceneRadar, Surface, Weather
from sim_player.scene.front_end import NO_FAULTS
from sim_player.scene.world import prepare, snapshot
from sim_player.signal.absences import no_rain
from sim_player.signal.clutter import (
    CELLS,
    Clutter,
    clutter_profiles,
    correlation_time_s,
    drawn_cells,
    profile_bound_mw,
    profile_power_mw,
    slow_time_basis,
    with_clutter,
)
from sim_player.signal.levels import hann_profiles
from sim_player.signal.rain_volume import clutter_at
from sim_player.signal.switches import PLAIN
from tests.sim_player.trace.point_scenes import wall

RAINS = msgspec.structs.replace(PLAIN, rain_clutter=True)
BOX = SceneObject(class_="car", x_m=-30.0, y_m=0.0)


def scene(*surfaces: Surface, preset: str = "xband", weather: Weather | None = None, **more: object) -> Scene:
    radar = SceneRadar(preset=preset, height_m=1.5)  # type: ignore[arg-type]
    weather = Weather(rain_mm_per_h=25.0) if weather is None else weather
    return Scene(name="rain", radar=radar, surfaces=surfaces, objects=(BOX,), weather=weather, **more)  # type: ignore[arg-type]


def over_noise_db(asked: Scene, range_m: float, beam: int) -> float:
    """Mean level of a bin of the product over its thermal noise."""
    world = prepare(asked)
    power_mw = profile_power_mw(world.setup, clutter_at(snapshot(world), RAINS), RAINS, NO_FAULTS)
    radar = world.radar
    noise_mw = 1e3 * BOLTZMANN_J_PER_K * 290.0 * radar.sample_rate_hz * 10.0 ** (0.1 * radar.noise_figure_db)
    noise_mw *= 1.5 / (radar.samples_per_chirp * radar.chirps_per_beam)
    return 10.0 * math.log10(power_mw[beam, round(range_m / radar.range_bin_m)] / noise_mw)


def everywhere(azimuth: np.ndarray, elevation: np.ndarray) -> np.ndarray:
    return np.ones(azimuth.shape)


@lru_cache
def solid_angle(asked: Scene, beam: int, gain: Callable[[np.ndarray, np.ndarray], np.ndarray] = everywhere) -> float:
    """Integral of the two-way power pattern over the sphere, a Riemann sum in steps of 0.25 and 0.5 deg."""
    azimuth = np.radians(np.arange(-89.875, 90.0, 0.25))
    elevation = np.radians(np.arange(-89.75, 90.0, 0.5))
    across, up = (grid.ravel() for grid in np.meshgrid(azimuth, elevation))
    pattern = np.abs(two_way_pattern(asked.setup, setup_weights(asked.setup)[beam : beam + 1], across, up)[0]) ** 2
    return float(np.sum(pattern * gain(across, up) * np.cos(up)) * math.radians(0.25) * math.radians(0.5))


def integral_db(asked: Scene, eta_per_m: float, angle: float, range_m: float) -> float:
    """Level over noise of a bin of a Hann window, which takes 1.5 bins of drops and of noise alike."""
    radar, loss_db = asked.setup.radar, 2.0 * range_m * air_db_per_m(prepare(asked))
    echo_mw = 1e3 * radar.transmit_power_w * radar.wavelength_m**2 * eta_per_m * radar.range_bin_m * angle
    echo_mw *= 10.0 ** (-0.1 * loss_db) / ((4.0 * math.pi) ** 3 * range_m**2)
    noise_mw = 1e3 * BOLTZMANN_J_PER_K * 290.0 * radar.sample_rate_hz * 10.0 ** (0.1 * radar.noise_figure_db)
    return 10.0 * math.log10(echo_mw * radar.samples_per_chirp * radar.chirps_per_beam / noise_mw)


def xband_eta(rain: float) -> float:
    return math.pi**5 * 0.93 * 200e-18 * rain**1.6 / (SPEED_OF_LIGHT_MPS / 10e9) ** 4


@pytest.mark.parametrize("rain", [5.0, 25.0, 50.0])
def test_level_is_the_integral_over_the_beam(rain: float) -> None:
    """Rayleigh's law at 10 GHz, no ground: Z = 200 R^1.6, |K|^2 = 0.93. At 25 mm/h 17 dB at 20 m, 11 dB at 40 m.

    Known bias: fading within a beam, -0.1 dB. Tolerance 0.2 dB.
    """
    asked = scene(weather=Weather(rain_mm_per_h=rain))
    for range_m, beam in ((20.0, 12), (40.0, 12), (20.0, 3), (80.0, 3)):
        wanted = integral_db(asked, xband_eta(rain), solid_angle(scene(), beam), range_m)
        assert over_noise_db(asked, range_m, beam) == pytest.approx(wanted, abs=0.2)
    if rain == 25.0:
        levels = [over_noise_db(asked, range_m, 12) for range_m in (20.0, 40.0)]
        assert levels == pytest.approx([17.0, 11.0], abs=0.5)


def test_level_at_77_ghz() -> None:
    """Mie over Marshall and Palmer's sizes gives 3.94e-4 1/m at 5 mm/h, 9 dB under Rayleigh.

    Known bias: fading within a beam of 2 tau takes 1.5 dB off a plain mean over chirps.
    """
    asked = scene(preset="77ghz", weather=Weather(rain_mm_per_h=5.0))
    radar = asked.setup.radar
    chirp = np.arange(128) * radar.chirp_period_s / correlation_time_s(radar)
    fading_db = 10.0 * math.log10(np.exp(-0.5 * np.subtract.outer(chirp, chirp) ** 2).mean())
    for beam in (28, 45):
        wanted = integral_db(asked, 3.936e-4, solid_angle(asked, beam), 30.0) + fading_db
        assert over_noise_db(asked, 30.0, beam) == pytest.approx(wanted, abs=0.3)


def test_ground_and_wall_end_the_volume() -> None:
    """Radar at 1.5 m: ground at 20 m ends the beam 4.3 deg below the horizon, a metal wall of 3 m at 15 m hides what
    lies under 5.7 deg, and shows as much in its mirror.
    """
    ground = Surface(role="ground", material="asphalt")
    foliage = msgspec.structs.replace(wall((15.0, -40.0), (15.0, 40.0)), material="vegetation", thickness_mm=1e5)
    foliage = msgspec.structs.replace(foliage, height_m=3.0)
    dry = scene()
    above = lambda azimuth, up: 20.0 * np.sin(up) > -1.5  # noqa: E731
    over = lambda azimuth, up: (20.0 * np.sin(up) > -1.5) & (15.0 * np.tan(up) > 1.5 * np.cos(azimuth))  # noqa: E731
    for surfaces, gain in (((ground,), above), ((ground, foliage), over)):
        wanted = integral_db(dry, xband_eta(25.0), solid_angle(dry, 12, gain), 20.0)
        assert over_noise_db(scene(*surfaces), 20.0, 12) == pytest.approx(wanted, abs=0.3)
    # a truck broadside, 3.2 m high and 8 m long, hides what lies behind and below its roof
    truck = SceneObject(class_="truck", x_m=10.0, y_m=0.0, yaw_deg=90.0)
    side_m = 10.0 - 0.5 * truck.kind.width_m
    past = lambda azimuth, up: (  # noqa: E731
        (side_m * np.tan(up) > 1.7 * np.cos(azimuth)) | (side_m * np.abs(np.tan(azimuth)) > 4.0)
    )
    wanted = integral_db(dry, xband_eta(25.0), solid_angle(dry, 12, past), 20.0)
    behind = msgspec.structs.replace(dry, objects=(truck,))
    assert over_noise_db(behind, 20.0, 12) == pytest.approx(wanted, abs=0.6)
    mirror = msgspec.structs.replace(wall((15.0, -60.0), (15.0, 60.0)), material="metal", height_m=3.0)
    assert over_noise_db(scene(mirror), 20.0, 12) == pytest.approx(over_noise_db(dry, 20.0, 12), abs=0.05)
    concrete = msgspec.structs.replace(mirror, material="concrete", height_m=60.0)
    # |r|^4 of concrete at 10 GHz is -15 dB
    drop = over_noise_db(dry, 20.0, 12) - over_noise_db(scene(concrete), 20.0, 12)
    assert 12.0 < drop < 18.0


def test_draws_have_the_profile_and_fade_between_beams() -> None:
    """Circular Gaussian: mean power as stated (0.5 dB), kurtosis 2; beams of a scan apart, chirps of a beam alike.

    The covariance of slow time is exp(-(t / tau)^2 / 2), tau = lambda / (4 pi 1 m/s) = 2.39 ms: 0.96 over a beam, of
    which terms of a hundredth of the power are left out; at 77 GHz 0.08 over a beam.
    """
    world = prepare(scene())
    clutter = clutter_at(snapshot(world), RAINS)
    power = profile_power_mw(world.setup, clutter, RAINS, NO_FAULTS)
    draws = np.stack([clutter_profiles(world.setup, clutter, RAINS, NO_FAULTS, seed) for seed in range(12)])
    ratio = np.abs(draws[:, :, 20:]) ** 2 / power[:, 20:]
    assert 10.0 * math.log10(ratio.mean()) == pytest.approx(0.0, abs=0.1)
    assert np.mean(ratio**2) / np.mean(ratio) ** 2 == pytest.approx(2.0, abs=0.1)
    white = draws / np.sqrt(np.maximum(power, 1e-300))
    beams = np.mean(white[:, :-1, 20:] * np.conj(white[:, 1:, 20:]))
    assert abs(beams) < 0.02
    for radar, carrier_hz in ((world.radar, 10e9), (PRESETS["77ghz"].radar, 77e9)):
        basis, tau = slow_time_basis(radar), correlation_time_s(radar)
        assert tau == pytest.approx(SPEED_OF_LIGHT_MPS / carrier_hz / (4.0 * math.pi))
        apart = np.subtract.outer(np.arange(128), np.arange(128)) * radar.chirp_period_s / tau
        np.testing.assert_allclose(basis.T @ basis, np.exp(-0.5 * apart**2), atol=0.05)
        assert math.exp(-0.5 * (12e-3 / tau) ** 2) < 1e-5


def test_beams_of_one_time_share_their_drops() -> None:
    """A digital array: neighbouring beams are correlated as their patterns overlap, distant ones are not."""
    world = prepare(scene(preset="77ghz"))
    clutter = clutter_at(snapshot(world), RAINS)
    power = clutter.beam_power_mw(world.setup, RAINS, NO_FAULTS)[:, 40:1000]
    draws = drawn_cells(world.setup, clutter, RAINS, NO_FAULTS, 3)[:, 0, 40:1000] / np.sqrt(power)
    weights = setup_weights(world.setup)
    azimuth = np.radians(np.arange(-89.95, 90.0, 0.1))
    pattern = two_way_pattern(world.setup, weights, azimuth, np.zeros(len(azimuth)))
    for other in (29, 31):
        both = pattern[[28, other]] @ np.conj(pattern[[28, other]]).T
        wanted = abs(both[0, 1]) / math.sqrt(abs(both[0, 0] * both[1, 1]))
        got = abs(np.vdot(draws[28], draws[other])) / (np.linalg.norm(draws[28]) * np.linalg.norm(draws[other]))
        assert got == pytest.approx(wanted, abs=0.1)


def test_all_levels_agree_and_follow_the_radar() -> None:
    """Kernel profiles are the mean of the beats' chirps; the literal sum of tones is the beats; 8 m/s turn chirps."""
    asked = scene(ego=Ego(speed_mps=8.0))
    world, front_end = prepare(asked), NO_FAULTS
    setup, clutter = world.setup, clutter_at(snapshot(world), RAINS)
    profiles = clutter_profiles(setup, clutter, RAINS, front_end, 5)
    nothing = np.zeros((1, 8192), np.complex128), np.ones(128, np.complex128), np.ones((1, 128))
    cells = drawn_cells(setup, clutter, RAINS, front_end, 5)
    beats, carrier, basis = with_clutter(setup, nothing, clutter, cells[12], 12)
    mean = ((carrier * basis).mean(axis=1) @ beats)[None]
    np.testing.assert_allclose(hann_profiles(mean, 8192)[0, 2:], profiles[12, 2:], atol=1e-3 * np.abs(profiles).max())
    sample = np.array([0, 1, 777, 8191])
    tones = np.exp(2j * np.pi * np.outer(sample, np.arange(cells.shape[2])) / 16384.0)
    wanted_beats = (tones @ cells[12].T).T
    at = np.abs(wanted_beats).max()
    np.testing.assert_allclose(beats[1 : 1 + cells.shape[1], sample], wanted_beats, atol=1e-5 * at)
    chirps = (carrier * basis).T @ beats[:, ::64]
    turn = np.angle(np.vdot(chirps[:-1], chirps[1:]))
    wanted = -4.0 * math.pi * 8.0 * setup.radar.chirp_period_s / setup.radar.wavelength_m
    assert turn == pytest.approx(wanted, abs=0.1 * abs(wanted))


@pytest.mark.parametrize("speed_mps", [0.0, 8.0])
def test_beats_of_a_player_hold_the_rain(speed_mps: float) -> None:
    """Same seed, same bytes; dry beams are those of the noise; rain stands over it at 10 to 20 m."""
    wet = scene(ego=Ego(speed_mps=speed_mps))
    effects = "thermal_noise,adc,element_pattern,rain_clutter,motion"
    one, two = (ScenePlayer(wet, 4, effects=effects, chirps_per_beam=16) for _ in range(2))
    samples = one.beam(1, 12).samples
    np.testing.assert_array_equal(two.beam(1, 12).samples, samples)
    dry = ScenePlayer(wet, 4, effects="thermal_noise,adc,element_pattern,motion", chirps_per_beam=16).beam(1, 12)
    difference = samples.astype(float) - dry.samples
    beat = (difference[..., 0] + 1j * difference[..., 1])[:1]
    profile = np.abs(hann_profiles(beat, 8192)[0]) ** 2
    assert profile[47:94].mean() > 8.0 * profile[300:].mean()


def test_a_plan_knows_it() -> None:
    """None in dry air; a bound over the noise in rain; planned and full maps have the same drops."""
    assert no_rain(prepare(scene(weather=Weather()))) == "no rain, snow or fog"
    world = prepare(scene())
    row = {effect.name: effect for effect in plan_world(world, world.setup, thorough=True).effects}["rain_clutter"]
    # 5.5 rms of what stands in the first bins, added up over the beams of a map
    assert row.used
    assert row.bound_db is not None
    assert 0.0 < row.bound_db - over_noise_db(scene(), 1.5, 12) - 20.0 * math.log10(5.5) < 10.0
    drizzle = prepare(scene(weather=Weather(rain_mm_per_h=1e-6)))
    skipped = {effect.name: effect for effect in plan_world(drizzle, drizzle.setup, thorough=True).effects}
    assert not skipped["rain_clutter"].used
    every = noisy_profiles(manual_plan(world, world.setup), world.setup, 2)
    planned = noisy_profiles(plan_world(world, world.setup, profiles_only=True), world.setup, 2)
    rms = np.sqrt(np.mean(np.abs(every[:, 400:]) ** 2))
    assert np.abs(every - planned).max() < 0.1 * rms


def test_what_drowns_in_rain_has_no_label() -> None:
    """A pedestrian at 100 m is 29 dB over the noise of a dry map, and 7 dB over 200 mm/h of rain with 50 of snow."""
    man = SceneObject(class_="pedestrian", x_m=100.0, y_m=0.0)
    dry = msgspec.structs.replace(scene(weather=Weather()), objects=(man,))
    wet = msgspec.structs.replace(dry, weather=Weather(rain_mm_per_h=200.0, snow_mm_per_h=50.0))
    for asked, labels in ((dry, True), (wet, False)):
        assert bool(len(labelled_scan(asked, 1, "all").labels.range_m)) == labels
        truth = ScenePlayer(asked, 1, effects="all", chirps_per_beam=128).truth(0)
        assert bool(len(truth.los_points_m)) == labels


def test_power_is_bounded_at_a_tenth_of_the_work() -> None:
    """Drops from 1 m to the end of the map in the middle directions: never under the power, at most 1 % over it where
    they stand.
    """
    setup = RadarSetup()
    power_mw = np.zeros((128, CELLS))
    power_mw[60:68, 10:] = 1.0 / np.square(np.arange(10, CELLS))
    clutter = Clutter(power_mw, np.zeros(2))
    exact, bound = (of(setup, clutter, PLAIN, NO_FAULTS) for of in (profile_power_mw, profile_bound_mw))
    assert (bound >= exact * (1.0 - 1e-9)).all()
    assert (bound[:, 8:60] <= 1.01 * exact[:, 8:60]).all()
