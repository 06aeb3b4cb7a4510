"""`mirrorwave calibrate`: what it finds in simulated captures, what reads its files, what it refuses."""

from __future__ import annotations

import json
import math
from pathlib import Path

import msgspec
import numpy as np
import pytest
import yaml

from contrib.calibrate.capture import Capture
from contrib.calibrate.drive import Guess, _formed
from contrib.calibrate.mounting import Motion
from contrib.calibrate.radar_alone import measure_noise
from mirrorwave.cli import main
from mirrorwave.commands.sim.group import write_recording
from msgs.bus.interface import Envelope, Outgoing, Received
from msgs.recording.mcap import RecordingReader, RecordingWriter
from msgs.recording.sigmf import write_capture
from msgs.values.diagnostics import NodeState
from msgs.values.frames import Pose2
from msgs.values.perception import Peaks
from msgs.values.radar import RadarSetup
from msgs.values.vehicle import VehicleState
from nodes import player as player_node
from nodes.ra_former import Params, RaFormerNode
from nodes.vehicle_can import Params as VehicleCanParams
from sim_player.drive import Drive
from sim_player.player import ScenePlayer
from sim_player.scene.description import Scene, SceneObject, SceneRadar, Surface, load_scene, scene_to_yaml
from sim_player.scene.front_end import FrontEnd, Spur
from tests.builders import peaks_at
from tests.contrib.calibrate.test_mounting import (
    AZIMUTH_STD_RAD,
    LATE_S,
    PRIOR,
    RANGE_STD_M,
    TRUE,
    drive,
    sightings,
    states,
)

EFFECTS = "los_surfaces,thermal_noise,flicker,leakage,adc,spurs"
WALL = Surface(role="relay", material="concrete", polyline_m=((20.0, -10.0), (20.0, 15.0)), height_m=5.0)
#: A scene needs something; this is no wall.
FAR = SceneObject(class_="pedestrian", x_m=90.0, y_m=0.0)
FAULTS = FrontEnd(flicker_corner_hz=3e6, leakage_dbm=-40.0, spurs=(Spur(frequency_hz=210.1e6, power_dbm=-75.0),))


def receiver(figure_db: float = 11.0, walls: bool = True) -> Scene:
    radar = SceneRadar(noise_figure_db=figure_db, front_end=FAULTS)
    return Scene(name="receiver", radar=radar, surfaces=(WALL,) if walls else (), objects=(FAR,))


def capture(path: Path, scene: Scene, scans: int, chirps: int, seed: int = 0) -> Path:
    source = ScenePlayer(scene, seed, chirps_per_beam=chirps, effects=EFFECTS)
    beams = len(source.setup.beams)
    if path.suffix == ".mcap":
        write_recording(path, (event.outgoing for event in player_node.scene_events(source, scans)), {})
    else:
        write_capture(path, source.setup, (source.beam(*divmod(one, beams)) for one in range(scans * beams)))
    return path


def received(topic: str, message: msgspec.Struct) -> Received:
    return Received(topic, message, Envelope(publisher="test", topic=topic, sequence=0, sent_ns=0, paced=True))


def run_json(capsys: pytest.CaptureFixture[str], *argv: object) -> dict[str, object]:
    assert main([str(one) for one in argv]) == 0
    found: dict[str, object] = json.loads(capsys.readouterr().out)
    return found


@pytest.mark.slow
def test_noise_goes_round(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Receiver -> capture -> figures -> scene -> capture: figures come back, floors agree within 0.15 dB (0.5 dB where
    1/f noise rises, bands of few bins)."""
    first = capture(tmp_path / "first.sigmf-meta", receiver(), 1, 32)
    scene_file, out = tmp_path / "plain.yaml", tmp_path / "noisy.yaml"
    scene_file.write_text(scene_to_yaml(Scene(name="plain", surfaces=(WALL,))))
    result = run_json(
        capsys, "calibrate", "noise", first, "--out", out, "--scene", scene_file, "--plot", tmp_path / "n.png", "--json"
    )
    floor = result["floor"]
    assert isinstance(floor, dict)
    assert floor["noise_figure_db"] == pytest.approx(11.0, abs=0.05)
    assert floor["flicker_corner_hz"] == pytest.approx(3e6, rel=0.1)
    assert floor["spurs"][0]["power_dbm"] == pytest.approx(-75.0, abs=0.3)
    assert (tmp_path / "n.png").stat().st_size > 0
    second = capture(tmp_path / "second.sigmf-meta", load_scene(out), 1, 32, seed=1)
    again = measure_noise(Capture(second), 1)
    assert again.power_dbm == pytest.approx(floor["power_dbm"], abs=0.15)
    pairs = zip(again.bands, floor["bands"], strict=True)
    assert max(abs(ours.modelled_dbm - theirs["modelled_dbm"]) for ours, theirs in pairs) < 0.5


def test_receiver_alone_is_a_radar_block(tmp_path: Path) -> None:
    first = capture(tmp_path / "first.sigmf-meta", receiver(), 1, 16)
    assert main(["calibrate", "noise", str(first), "--out", str(tmp_path / "receiver.yaml")]) == 0
    block = yaml.safe_load((tmp_path / "receiver.yaml").read_text())["radar"]
    assert msgspec.convert(block, SceneRadar).noise_figure_db == pytest.approx(11.0, abs=0.1)


@pytest.mark.slow
def test_background_goes_into_the_graph(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Leakage of -40 dBm lies in the first bins of every map; with the background it is 30 dB down or more."""
    field = capture(tmp_path / "field.mcap", receiver(walls=False), 6, 2)
    out = tmp_path / "background.npy"
    result = run_json(capsys, "calibrate", "background", field, "--out", out, "--plot", tmp_path / "b.png", "--json")
    quality = result["quality"]
    assert isinstance(quality, dict)
    assert quality["leakage_dbm"] == pytest.approx(-40.0, abs=0.5)
    assert quality["noise_dbm"] == pytest.approx(quality["expected_noise_dbm"], abs=0.5)
    powers = []
    for background in (None, str(out)):
        node = RaFormerNode(Params(background=background))
        with RecordingReader(field) as reader:
            sent = [received(one.topic, one.message) for one in reader.messages(("radar/setup", "radar/beam"))]
        maps = [out.message for one in sent[:26] for out in node.step([one], 0)]
        powers.append(float(np.abs(maps[0].values[:4]).max() ** 2))
    assert powers[1] < 1e-3 * powers[0]


def test_background_of_other_beams_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "small.npy"
    np.save(path, np.zeros((3, 16), np.complex64))
    node = RaFormerNode(Params(background=str(path)))
    node.step([received("radar/setup", RadarSetup())], 0)
    state, reason = node.health()
    assert (state, reason[:22]) == (NodeState.DEGRADED, "setup.background must ")


def raw_recording(path: Path, scans: int, way: Drive, *, said: bool = True, walls: bool = True) -> Path:
    """A few scans of raw beams past a wall, one chirp a beam, with the bus's states or without."""
    scene = Scene(name="drive", surfaces=(WALL,) if walls else (), objects=(FAR,))
    player = ScenePlayer(scene, chirps_per_beam=1, start_ns=10**10, drive=way)
    with RecordingWriter(path, {}) as writer:
        writer.write("radar/setup", player.setup, publisher="player", sequence=0, sent_ns=0)
        for number, state in enumerate(way.states(0.3 * scans, 10**10) if said else []):
            writer.write("vehicle/state", state, publisher="can", sequence=number, sent_ns=state.stamp_ns)
        for number in range(scans * len(player.setup.beams)):
            beam = player.beam(*divmod(number, len(player.setup.beams)))
            writer.write("radar/beam", beam, publisher="player", sequence=number, sent_ns=beam.stamp_ns)
    return path


def steady(speed_mps: float) -> Drive:
    return Drive(np.array([-5.0, 30.0]), np.full(2, speed_mps), np.zeros(2))


def peaks_recording(path: Path, way: Drive, scans: int) -> Path:
    """The yard of tests/models/vehicle as peaks, with the bus's states, as a recording without raw beams holds them."""
    by_stamp: dict[int, list[np.ndarray]] = {}
    for one in sightings(way, scans):
        by_stamp.setdefault(one.stamp_ns, []).append(one.points_m)
    with RecordingWriter(path, {}) as writer:
        writer.write("radar/setup", RadarSetup(), publisher="player", sequence=0, sent_ns=0)
        for number, state in enumerate(states(way, 0.3 * scans)):
            writer.write("vehicle/state", state, publisher="can", sequence=number, sent_ns=state.stamp_ns)
        for number, (stamp_ns, points) in enumerate(by_stamp.items()):
            found = peaks(stamp_ns, number, np.concatenate(points))
            writer.write("perception/peaks", found, publisher="detector", sequence=number, sent_ns=stamp_ns)
    return path


def peaks(stamp_ns: int, scan_id: int, points_m: np.ndarray) -> Peaks:
    return peaks_at(points_m, (), (RANGE_STD_M, AZIMUTH_STD_RAD), stamp_ns=stamp_ns, scan_id=scan_id)


@pytest.mark.slow
def test_mounting_and_clock_of_a_recorded_drive(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """0.2 m, 2 deg and 80 ms put in; tolerance as in tests/models/vehicle, and the files are what the graph takes."""
    recording = peaks_recording(tmp_path / "drive.mcap", drive(), 60)
    mount, clock = tmp_path / "mount.yaml", tmp_path / "clock.yaml"
    prior = ("--prior", PRIOR.x_m, PRIOR.y_m, 0.0)
    result = run_json(
        capsys, "calibrate", "extrinsic", recording, "--out", mount, *prior, "--plot", tmp_path / "d.png", "--json"
    )
    assert isinstance(result["mounting"], dict)
    assert result["mounting"]["yaw_rad"]["observed"]
    pose = msgspec.convert(yaml.safe_load(mount.read_text())["ra_former"], Params).vehicle_from_radar
    assert (pose.x_m, pose.y_m) == pytest.approx((TRUE.x_m, TRUE.y_m), abs=0.15)
    assert pose.yaw_rad == pytest.approx(TRUE.yaw_rad, abs=math.radians(0.4))
    assert (tmp_path / "d.png").stat().st_size > 0
    assert main(["calibrate", "clock", str(recording), "--out", str(clock), "--pose", "1.4", "0.2", "2"]) == 0
    said = capsys.readouterr().out
    assert "yaw: 2.000 deg, as given" in said
    offset_s = yaml.safe_load(clock.read_text())["vehicle_can"]["clock_offset_s"]
    assert offset_s == pytest.approx(-LATE_S, abs=0.015)
    assert VehicleCanParams(clock_offset_s=offset_s).clock_offset_s == offset_s


def test_straight_drive_gives_yaw_and_no_clock(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    recording, out = peaks_recording(tmp_path / "drive.mcap", steady(4.0), 40), tmp_path / "mount.yaml"
    assert main(["calibrate", "extrinsic", str(recording), "--out", str(out), "--prior", "1.2", "0", "0"]) == 0
    pose = yaml.safe_load(out.read_text())["ra_former"]["vehicle_from_radar"]
    assert (pose["x_m"], pose["y_m"]) == (1.2, 0.0)
    assert math.degrees(pose["yaw_rad"]) == pytest.approx(2.0, abs=0.5)
    assert "x: 1.200 m, as given: this drive does not tell" in out.read_text()
    capsys.readouterr()
    assert main(["calibrate", "clock", str(recording), "--out", str(tmp_path / "clock.yaml")]) == 2
    assert "drive with changing speed and yaw rate" in capsys.readouterr().err
    assert not (tmp_path / "clock.yaml").exists()


@pytest.mark.slow
def test_what_does_not_serve_is_refused_in_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    still = raw_recording(tmp_path / "still.mcap", 11, steady(0.0))
    stateless = raw_recording(tmp_path / "stateless.mcap", 1, steady(0.0), said=False)
    no_walls = raw_recording(tmp_path / "open.mcap", 2, steady(5.0), walls=False)
    empty, garbage = tmp_path / "empty.mcap", tmp_path / "garbage.mcap"
    empty.write_bytes(b"")
    garbage.write_bytes(bytes(range(256)) * 9)
    out = tmp_path / "out.yaml"
    for argv, said in (
        (("extrinsic", still), "still.mcap: the vehicle must move"),
        (("extrinsic", stateless), "stateless.mcap: holds no vehicle/state"),
        (("extrinsic", no_walls), "open.mcap: straight walls must be seen in at least 10 scans with states, got 0"),
        (("clock", empty), "empty.mcap"),
        (("clock", garbage), "garbage.mcap"),
        (("clock", tmp_path / "none.mcap"), "none.mcap"),
        (("noise", still), "still.mcap: noise is read between the echoes"),
        (("noise", tmp_path / "none.sigmf-meta"), "none.sigmf"),
        (("background", still), "the name must end in .npy"),
        (("extrinsic", still, "--plot", tmp_path / "a.txt"), "a.txt: a picture's name must end in .png, .svg, .pdf"),
    ):
        assert main(["calibrate", *map(str, argv), "--out", str(out)]) == 2
        line = capsys.readouterr().err
        assert said in line
        assert line.count("\n") == 1
        assert not out.exists()
    assert main(["calibrate", "background", str(stateless), "--out", str(tmp_path / "b.npy")]) == 2
    assert "at least 4 complete scans, got 1" in capsys.readouterr().err


def test_scans_without_states_to_their_end_are_left_out(tmp_path: Path) -> None:
    """States that end in the middle of the third scan: its beams cannot be freed from the motion, nor the fourth's."""
    recording = raw_recording(tmp_path / "short.mcap", 4, steady(5.0))
    source = Capture(recording)
    said = [one for one in source.messages(("vehicle/state",)) if one.stamp_ns <= 10**10 + 700_000_000]
    guess = Guess(vehicle_from_radar=Pose2(), clock_offset_s=0.0, yaw_rate_bias_rps=0.0, speed_scale=1.0)
    scans: list[None] = []
    found = _formed(source, Motion(said), guess, lambda: scans.append(None))
    assert len(scans) == 4
    assert {one.stamp_ns for one in found} == {10**10, 10**10 + 300_000_000}


@pytest.mark.slow
def test_a_cut_recording_is_read_and_said_to_be_cut(tmp_path: Path) -> None:
    field = capture(tmp_path / "field.mcap", receiver(walls=False), 6, 2)
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(field.read_bytes()[:-2_000_000])
    assert main(["calibrate", "background", str(cut), "--out", str(tmp_path / "b.npy")]) == 3
    assert np.load(tmp_path / "b.npy").shape[0] == 25


def test_player_puts_states_on_the_radars_clock(tmp_path: Path) -> None:
    path = tmp_path / "states.mcap"
    write_recording(path, iter([Outgoing("vehicle/state", VehicleState(stamp_ns=10**9))]), {})
    node = player_node.create(player_node.Params(capture=str(path), vehicle_clock_offset_s=-0.08))
    (sent,) = node.step([], 0)
    assert sent.message.stamp_ns == 10**9 - 80_000_000
    with pytest.raises(ValueError, match="vehicle_clock_offset_s"):
        player_node.Params(capture="x", vehicle_clock_offset_s=math.nan)
