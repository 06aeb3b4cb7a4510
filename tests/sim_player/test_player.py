"""A scene played: stamps, repeatability, levels of signal that agree, and the scenes that ship."""

from __future__ import annotations

import msgspec
import numpy as np
import pytest

from models.physics.antenna import setup_weights
from models.physics.mirror import blocked
from models.physics.waveform import beat_samples
from msgs.files.shipped import CHECKOUT
from msgs.values.perception import PathClass
from msgs.values.radar import RadarParams, RadarSetup
from sim_player.dataset.labelled_scan import clean_profiles
from sim_player.paths.ray_tracing import trace
from sim_player.paths.truth import hidden_objects
from sim_player.player import ScenePlayer
from sim_player.scene.description import Ego, Scene, SceneObject, Surface, load_scene
from sim_player.scene.world import prepare
from sim_player.signal.fmcw import beam_weights

FOLDER = CHECKOUT / "launch" / "scenes"
HIDDEN_COUNT = {
    "facade_across_lane": 1,
    "oblique_container": 1,
    "parallel_street_wall": 1,
    "corner": 1,
    "two_hidden_vehicles": 2,
    "nothing_hidden": 0,
    "open_field": 0,
    "facade_across_lane_77ghz": 1,
    "hidden_car_xband": 1,
    "hidden_car_77ghz": 1,
    "hidden_car_spad": 1,
}


def facade(speed_mps: float = 0.0, ego_mps: float = 0.0) -> Scene:
    scene = load_scene(FOLDER / "facade_across_lane.yaml")
    moving = msgspec.structs.replace(scene.objects[0], speed_mps=speed_mps)
    return msgspec.structs.replace(scene, objects=(moving,), ego=Ego(speed_mps=ego_mps))


def folded(samples: np.ndarray) -> np.ndarray:
    return (samples[..., 0].astype(float) + 1j * samples[..., 1]).mean(axis=0)


def test_the_scenes_are_here() -> None:
    # the scene of several radars: tests/sim_player/test_rig.py
    assert {path.stem for path in FOLDER.glob("*.yaml")} == {*HIDDEN_COUNT, "two_front_corners"}


@pytest.mark.parametrize("name", HIDDEN_COUNT)
def test_shipped_scenes_hide_what_they_say(name: str) -> None:
    """No face of a hidden vehicle is in direct sight; its images are near, in the field of view, and many."""
    scene = load_scene(FOLDER / f"{name}.yaml")
    paths = trace(prepare(scene))
    assert hidden_objects(paths) == set(range(HIDDEN_COUNT[name]))
    a = np.array([point for surface in scene.surfaces for point in surface.polyline_m[:-1]])
    b = np.array([point for surface in scene.surfaces for point in surface.polyline_m[1:]])
    for index, thing in enumerate(scene.objects):
        corners = thing.corners_m()
        share = np.linspace(0.0, 1.0, 21)[:, None, None]
        outline = (corners + share * (np.roll(corners, -1, axis=0) - corners)).reshape(-1, 2)
        assert blocked(np.zeros(2), outline, a, b).all()
        images = paths.take((paths.kind == PathClass.MIRRORED) & (paths.object_index == index))
        assert len(images) >= 10
        assert 0.5 * images.length_m.max() < 60.0
        assert np.degrees(np.abs(images.azimuth_rad)).max() < 50.0
    for surface in scene.surfaces:
        if surface.role == "relay":
            assert np.linalg.norm(np.diff(surface.polyline_m, axis=0), axis=1).sum() >= 8.0


@pytest.mark.parametrize("name", [name for name, count in HIDDEN_COUNT.items() if count])
def test_hidden_vehicles_stand_well_inside_the_window(name: str) -> None:
    """Moved by 1 m in any direction they are hidden still, and seen."""
    scene = load_scene(FOLDER / f"{name}.yaml")
    for dx, dy in ((1.0, 0.0), (-1.0, 0.0), (0.0, 1.0), (0.0, -1.0)):
        moved = tuple(msgspec.structs.replace(thing, x_m=thing.x_m + dx, y_m=thing.y_m + dy) for thing in scene.objects)
        paths = trace(prepare(msgspec.structs.replace(scene, objects=moved)))
        assert hidden_objects(paths) == set(range(len(moved))), (dx, dy)


def test_beams_are_stamped_evenly_over_the_scan() -> None:
    player = ScenePlayer(facade(), chirps_per_beam=1, start_ns=1_000)
    assert player.setup.stamp_ns == 1_000
    for scan, index, stamp_ns in ((0, 0, 1_000), (0, 24, 288_001_000), (2, 1, 612_001_000)):
        beam = player.beam(scan, index)
        assert (beam.stamp_ns, beam.scan_id, beam.beam_index, beam.beam_count) == (stamp_ns, scan, index, 25)
        assert beam.samples.shape == (1, 8192, 2)
        assert beam.azimuth_rad == player.setup.beams.azimuth_rad[index]
    assert player.truth(2).stamp_ns == 600_001_000
    state = ScenePlayer(facade(0.0, 8.0), chirps_per_beam=1).vehicle_state(12)
    assert (state.stamp_ns, state.speed_mps, state.valid) == (12, 8.0, True)


@pytest.mark.parametrize("speed_mps", [0.0, 5.0])
def test_same_seed_same_bytes_in_any_order(speed_mps: float) -> None:
    one, other = (ScenePlayer(facade(speed_mps), seed=3, chirps_per_beam=4) for _ in range(2))
    first = [one.beam(scan, index).samples for scan, index in ((0, 3), (2, 7), (1, 0))]
    second = [other.beam(scan, index).samples for scan, index in ((1, 0), (0, 3), (2, 7))]
    for here, there in zip(first, (second[1], second[2], second[0]), strict=True):
        np.testing.assert_array_equal(here, there)
    assert not np.array_equal(one.beam(0, 3).samples, one.beam(1, 3).samples)
    assert not np.array_equal(first[0], ScenePlayer(facade(speed_mps), seed=4, chirps_per_beam=4).beam(0, 3).samples)


def test_recorded_beams_equal_kernel_level_up_to_noise() -> None:
    """int16 beams, folded: the difference to the kernel level is the receiver's noise and no more.

    Folded noise per bin: kT0 f_s F 1.5 / 2^20 (quantisation 60 dB below); 512 bins give its power to 10 %, 4 sigma.
    """
    player = ScenePlayer(facade(), seed=2)
    setup = player.setup
    kernel = clean_profiles(setup, player.paths(0.0))
    count = setup.radar.samples_per_chirp
    window = 1.0 - np.cos(2.0 * np.pi * np.arange(count) / count)
    for index in (4, 12, 20):
        beam = folded(player.beam(0, index).samples) * np.sqrt(setup.milliwatt_per_code_squared)
        error = np.fft.fft(beam * window)[:512] / count - kernel[index]
        expected = 1.5 * setup.radar.noise_power_mw / 2**20
        assert np.mean(np.abs(error) ** 2) == pytest.approx(expected, rel=0.3, abs=0.0)


@pytest.mark.parametrize(("speed_mps", "ego_mps"), [(0.6, 0.0), (15.0, 0.0), (5.0, 8.0)])
def test_moving_beams_equal_a_chirp_by_chirp_sum(speed_mps: float, ego_mps: float) -> None:
    """Reference: the scene traced anew for each of 16 chirps, spread over a whole beam's duration; a quiet receiver.

    Left out by the player: range migration, whose phase error is 2 pi B dL / c over both the beam and the chirp: at
    26 m/s of path length and +-0.35 ms, 0.13 rad at the corners, a third of that rms. Tolerance 0.05 relative L2,
    plus quantisation of 1/6 code^2 a sample (3 sigma of it is nothing: 2 10^6 samples).
    """
    quiet = RadarSetup(radar=RadarParams(noise_figure_db=-60.0))
    player = ScenePlayer(facade(speed_mps, ego_mps), seed=1, setup=quiet)
    setup, radar = player.setup, player.setup.radar
    index = 14
    beam = player.beam(0, index).samples[::8].astype(float)
    got = (beam[..., 0] + 1j * beam[..., 1]) * np.sqrt(setup.milliwatt_per_code_squared)
    start_s = 1e-9 * index * setup.beam_interval_ns
    exact = []
    for chirp in range(0, radar.chirps_per_beam, 8):
        paths = player.paths(start_s + chirp * radar.chirp_period_s)
        weights = beam_weights(setup, paths, slice(index, index + 1))
        exact.append((weights @ beat_samples(radar, paths.length_m))[0])
    quantisation = np.sqrt(got.size * setup.milliwatt_per_code_squared / 6.0)
    assert np.linalg.norm(got - exact) < 0.05 * np.linalg.norm(exact) + 1.1 * quantisation
    assert np.linalg.norm(exact) > 20.0 * quantisation


def test_moving_target_turns_the_slow_time_phase() -> None:
    """A lone car head-on at 10 m/s: its Doppler line stands at 2 v / lambda, within one bin of 1 / T_f."""
    coming = SceneObject(class_="car", x_m=20.0, y_m=0.0, yaw_deg=180.0, speed_mps=10.0)
    player = ScenePlayer(Scene(name="t", objects=(coming,)))
    samples = player.beam(0, 12).samples.astype(np.float32)
    profile = np.fft.fft(samples[..., 0] + 1j * samples[..., 1], axis=1)[:, 60:100]
    doppler = np.abs(np.fft.fft(profile, axis=0)).sum(axis=1)
    radar = player.setup.radar
    expected = -2.0 * 10.0 / radar.wavelength_m * radar.beam_duration_s
    assert abs((np.argmax(doppler) - expected + 64) % 128 - 64) <= 1.0


def test_phase_jitter_turns_whole_beams() -> None:
    """Echo phases of a beam differ from scan to scan with jitter, and do not without."""
    for jitter_rad, still in ((0.0, True), (2.0, False)):
        player = ScenePlayer(facade(), chirps_per_beam=8, phase_jitter_rad=jitter_rad)
        lines = [np.fft.fft(folded(player.beam(scan, 12).samples))[100:108] for scan in range(6)]
        strongest = np.argmax(np.abs(lines[0]))
        phases = np.array([line[strongest] / abs(line[strongest]) for line in lines])
        assert (abs(phases.mean()) > 0.99) == still
    with pytest.raises(ValueError, match="phase_jitter_rad must be finite and not negative, got -1"):
        ScenePlayer(facade(), phase_jitter_rad=-1.0)


def test_beams_use_the_quantised_phases() -> None:
    """The 6-bit weights' phases are whole steps from column to column, and the beats follow them.

    A metal wall's flash at boresight in beam b has the power of |sum of weights|^4 / columns^2.
    """
    scene = Scene(
        name="t",
        surfaces=(Surface(role="relay", material="metal", polyline_m=((15.0, -0.4), (15.0, 0.4)), height_m=4.0),),
    )
    paths, setup = trace(prepare(scene)), scene.setup
    flash = np.argmax(np.abs(paths.amplitude))
    weights = setup_weights(setup)
    step = np.angle(weights[:, 1:] / weights[:, :-1]) / (2.0 * np.pi / 64)
    np.testing.assert_allclose(step, np.round(step), atol=1e-9)
    gain = np.abs(beam_weights(setup, paths)[:, flash]) / np.abs(beam_weights(setup, paths)[12, flash])
    np.testing.assert_allclose(gain, np.abs(weights.sum(axis=1)) ** 2 / 64.0, atol=1e-9)
