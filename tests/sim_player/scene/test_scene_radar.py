"""A scene's own radar, and scenes with little or nothing in them, through the whole simulator."""

from __future__ import annotations

import math

import msgspec
import numpy as np
import pytest

from models.physics.antenna import setup_weights, two_way_pattern
from sim_player.dataset.labelled_scan import labelled_scan
from sim_player.paths.ray_tracing import trace
from sim_player.planner.plan import manual_plan, plan_world
from sim_player.player import ScenePlayer
from sim_player.scene.description import Scene, SceneArray, SceneObject, SceneRadar, Surface, Weather
from sim_player.scene.world import prepare
from sim_player.signal.levels import kernel_profiles
from sim_player.signal.switches import IDEAL
from tests.sim_player.trace.point_scenes import points_world, wall

#: The prototype's boards: 2 x 8 patches each, one sends and one receives.
BOARDS = SceneRadar(array=SceneArray(columns=8, rows=2), separation_m=0.25)


def half_power_deg(level: np.ndarray, angle_deg: np.ndarray) -> float:
    return 2.0 * float(np.interp(-0.5, -level / level.max(), angle_deg))


def test_beamwidths_of_the_boards() -> None:
    """Closed form, both ways, x = pi sin(angle) / 2.

    Azimuth (sin(8 x) / (8 sin x))^4 under the element's 80 deg; elevation cos(x)^4 of two rows under 60 deg. To 0.02
    deg: 9.1 and 30.2 deg; the four rows of the preset have 17.3 deg.
    """
    setup = Scene(name="boards", radar=BOARDS).setup
    angle_deg = np.linspace(1e-6, 45.0, 4501)
    angle, zero = np.radians(angle_deg), np.zeros(4501)
    weights = setup_weights(setup)[12:13]
    x = 0.5 * math.pi * np.sin(angle)
    columns = (np.sin(8.0 * x) / (8.0 * np.sin(x))) ** 4 * 10.0 ** (-2.4 * (angle_deg / 80.0) ** 2)
    rows = np.cos(x) ** 4 * 10.0 ** (-2.4 * (angle_deg / 60.0) ** 2)
    for got, wanted in (
        (two_way_pattern(setup, weights, angle, zero), columns),
        (two_way_pattern(setup, weights, zero, angle), rows),
    ):
        level = np.abs(got[0]) ** 2
        assert half_power_deg(level, angle_deg) == pytest.approx(half_power_deg(wanted, angle_deg), abs=0.02)
    assert half_power_deg(columns, angle_deg) == pytest.approx(9.1, abs=0.1)
    assert half_power_deg(rows, angle_deg) == pytest.approx(30.2, abs=0.1)


def test_level_of_the_boards() -> None:
    """1 m^2 at 40 m ahead, at the radar's height: P lambda^2 (16 x 4.1 dBi)^2 / ((4 pi)^3 R^4), in the middle beam.

    Boards 0.25 m apart lengthen the way by 0.2 mm alone. Bias: half a bin beside its bin, at most 1.42 dB; the power of
    three bins of a Hann window is 1.5 times the peak's. Tolerance 0.1 dB.
    """
    world = points_world([(40.0, 0.0, 1.0)], radar=BOARDS)
    radar = world.radar
    effects = msgspec.structs.replace(IDEAL, element_pattern=True)
    profile = kernel_profiles(world.setup, trace(world), effects)[12]
    got_mw = float(np.sum(np.abs(profile[180:195]) ** 2)) / 1.5
    gain = 16.0 * 10.0**0.41
    wanted_mw = 1e3 * radar.transmit_power_w * radar.wavelength_m**2 * gain**2 / ((4.0 * math.pi) ** 3 * 40.0**4)
    assert 10.0 * math.log10(got_mw / wanted_mw) == pytest.approx(0.0, abs=0.1)


GROUND = Surface(role="ground", material="concrete")


@pytest.mark.parametrize("surfaces", [(), (GROUND,)])
@pytest.mark.parametrize("preset", ["xband", "77ghz"])
def test_an_open_field_is_a_scene(surfaces: tuple[Surface, ...], preset: str) -> None:
    """Nothing comes back: plans hold no path, maps and beams hold the receiver's noise."""
    scene = Scene(name="field", radar=SceneRadar(preset=preset), surfaces=surfaces)  # type: ignore[arg-type]
    world = prepare(scene)
    for plan in (plan_world(world, world.setup, thorough=True), manual_plan(world, world.setup)):
        assert len(plan.paths) == 0
        assert "thermal_noise" in plan.used
    scan = labelled_scan(scene, 1)
    assert np.mean(np.abs(scan.profiles) ** 2) == pytest.approx(scan.noise_power_mw, rel=0.1, abs=0.0)
    player = ScenePlayer(scene, effects="auto", chirps_per_beam=1)
    assert np.std(player.beam(0, 3).samples) > 10.0
    assert player.truth(0).objects == ()


def test_echoes_later_than_a_chirp_are_left_out() -> None:
    """A wall of 1.9 km and a car at 900 m: what comes back after 0.99 of a chirp, 810 m away, belongs to no chirp."""
    scene = Scene(
        name="far",
        surfaces=(wall((20.0, -950.0), (20.0, 950.0)),),
        objects=(SceneObject(class_="car", x_m=-900.0, y_m=0.0), SceneObject(class_="car", x_m=9.0, y_m=3.0)),
    )
    world = prepare(scene)
    paths = plan_world(world, world.setup, thorough=True).paths
    assert 0.0 < paths.length_m.max() < 0.99 * 1637.4
    moving = msgspec.structs.replace(scene, objects=(SceneObject(class_="car", x_m=3e3, y_m=0.0, speed_mps=5.0),))
    assert len(trace(prepare(moving))) > 0


def test_one_beam_of_one_chirp_in_rain() -> None:
    """A radar of one column, one beam and one chirp plans, plays and stays finite."""
    radar = SceneRadar(array=SceneArray(columns=1), beams_deg=(-40.0,), chirps_per_beam=1)
    scene = Scene(name="small", radar=radar, surfaces=(GROUND,), weather=Weather(rain_mm_per_h=25.0, snow_mm_per_h=1.0))
    world = prepare(scene)
    assert "rain_clutter" in plan_world(world, world.setup, thorough=True).used
    one, two = (ScenePlayer(scene, 3, effects="all").beam(0, 0).samples for _ in range(2))
    np.testing.assert_array_equal(one, two)
    assert one.shape == (1, 8192, 2)
