"""The player: order, timing, stamps, sources; on an in-process bus."""

from __future__ import annotations

import subprocess
import sys
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import msgspec
import numpy as np
import pytest

from mirrorwave.commands.sim.group import write_recording, write_sigmf
from msgs.bus.local import LocalNetwork
from msgs.files.shipped import CHECKOUT
from msgs.recording.mcap import RecordingWriter
from msgs.recording.sigmf import write_capture
from msgs.values.detections import RadarDetections
from msgs.values.diagnostics import NodeState
from msgs.values.environment import WallPriors
from msgs.values.perception import SceneTruth
from msgs.values.radar import RadarBeam, RadarSetup
from msgs.values.vehicle import VehicleState
from nodes.node import InProcessGraph
from nodes.player import (
    LATE_NS,
    LONGEST_LAG_NS,
    SENSED_TOPICS,
    Backlog,
    Event,
    Params,
    Player,
    capture_events,
    create,
    scene_events,
    scene_of,
    scene_player,
    truth_beside,
    with_walls,
)
from nodes.process.fork_server import environment
from sim_player.player import ScenePlayer

SCENE = "launch/scenes/facade_across_lane.yaml"


def params(**changes: object) -> Params:
    return Params(**{"scene": SCENE, "scans": 1, "chirps_per_beam": 2, **changes})  # type: ignore[arg-type]


def played(player_params: Params) -> tuple[list, list[int]]:
    """Messages that a listener hears, and the virtual time at which each was sent."""
    network = LocalNetwork(start_ns=5_000_000_000)
    listener = network.bus("listener")
    for topic in SENSED_TOPICS:
        listener.subscribe(topic)
    graph = InProcessGraph(network, {"player": create(player_params)})
    graph.run()
    # a bus keeps the order within a topic; across topics the time of sending does
    received = sorted(listener.receive(0.0), key=lambda item: item.envelope.sent_ns)
    graph.close()
    return [item.message for item in received], [item.envelope.sent_ns for item in received]


def test_a_scene_is_played_at_the_radars_rate() -> None:
    """25 beams 12 ms apart, the first 30 ms after the set-up; stamps are the times of sending."""
    messages, sent_ns = played(params())
    assert isinstance(messages[0], RadarSetup)
    assert [message.scan_id for message in messages if isinstance(message, SceneTruth)] == [0]
    beams = [(at, message) for at, message in zip(sent_ns, messages, strict=True) if isinstance(message, RadarBeam)]
    assert [beam.beam_index for _, beam in beams] == list(range(25))
    assert np.diff([at for at, _ in beams]).tolist() == [12_000_000] * 24
    assert [at for at, _ in beams] == [beam.stamp_ns for _, beam in beams]
    assert beams[0][0] - sent_ns[0] == 30_000_000
    states = [message for message in messages if isinstance(message, VehicleState)]
    assert [state.stamp_ns for state in states] == [beam.stamp_ns for _, beam in beams]


#: Kernels that are loaded while the player of a moving scene is made, and those loaded by two scans of it.
LOADED = """
from models.compiled import KernelCache
from nodes.player import Params, create

loaded, load = [], KernelCache.load_overload

def noted(cache, *words):
    loaded.append(cache._py_func.__name__)
    return load(cache, *words)

KernelCache.load_overload = noted
params = Params(scene="launch/scenes/corner.yaml", scans=2, chirps_per_beam=4, object_speed_mps=1.0, ego_speed_mps=0.5)
player = create(params)
made = len(loaded)
beams, now_ns = 0, 0
while not player.finished():
    beams += sum(outgoing.topic == "radar/beam" for outgoing in player.step([], now_ns))
    now_ns += 4_000_000
print(made, beams, *loaded[made:])
"""


@pytest.mark.slow
def test_what_moves_has_its_kernels_loaded_before_the_player_is_ready() -> None:
    """Loaded with the first beam they made the first views of a live graph 0.2 to 0.6 s late."""
    command = [sys.executable, "-c", LOADED]
    done = subprocess.run(command, cwd=CHECKOUT, env=environment({}), capture_output=True, text=True, check=True)
    made, beams, *later = done.stdout.split()
    assert int(made) > 20
    assert int(beams) == 50
    assert later == []


def test_each_radar_of_a_scene_has_topics_of_its_own() -> None:
    """Set-ups of both, then every beam of both, each stamped and sent by its own."""
    source = scene_player(params(scene="launch/scenes/two_front_corners.yaml", effects="basic"))
    sent = [event.outgoing for event in scene_events(source, 1)]
    assert [outgoing.topic for outgoing in sent[:2]] == ["radar/left/setup", "radar/right/setup"]
    counts = Counter(outgoing.topic for outgoing in sent)
    assert counts["radar/left/beam"] == counts["radar/right/beam"] == 25


def test_a_beam_is_sent_before_the_next_one_is_made() -> None:
    """To make one takes milliseconds, by which every beam would be late."""
    source = scene_player(params())
    made: list[str] = []

    def events() -> Iterator[Event]:
        for event in scene_events(source, 1):
            made.append(event.outgoing.topic)
            yield event

    player = Player(events(), rate=1.0, settle_s=0.0, restamp=True)
    sent = [outgoing.topic for outgoing in player.step([], 0)]
    while "radar/beam" not in sent:
        sent += [outgoing.topic for outgoing in player.step([], 0)]
    assert made == sent
    assert player.pending()
    assert player.step([], 0) == []
    assert len(made) == len(sent) + 1
    assert not player.pending()


def test_rate_scales_time() -> None:
    _, sent_ns = played(params(rate=4.0))
    assert max(sent_ns) - 5_000_000_000 == 30_000_000 + 24 * 3_000_000


def written(source: ScenePlayer, path: Path) -> Path:
    """A capture of the first scan of a scene, in the format that the name asks for."""
    events = (event.outgoing for event in scene_events(source, 1))
    if path.suffix == ".mcap":
        write_recording(path, events, {})
    else:
        write_sigmf(path, source.setup, events, {})
    return path


def test_a_capture_whose_truth_cannot_be_written_is_not_left_behind(tmp_path: Path) -> None:
    path = tmp_path / "capture.sigmf-meta"
    truth_beside(path).mkdir()
    with pytest.raises(OSError, match="truth"):
        written(scene_player(params()), path)
    assert list(tmp_path.iterdir()) == [truth_beside(path)]


@pytest.mark.parametrize("name", ["capture.mcap", "capture.sigmf-meta"])
def test_a_capture_says_the_same_as_the_scene(tmp_path: Path, name: str) -> None:
    source = scene_player(params())
    path = written(source, tmp_path / name)
    messages, _ = played(Params(capture=str(path)))
    beams = [message for message in messages if isinstance(message, RadarBeam)]
    assert [beam.stamp_ns for beam in beams] == [source.stamp_ns(0, index) for index in range(25)]
    np.testing.assert_array_equal(beams[7].samples, source.beam(0, 7).samples)
    truth = next(message for message in messages if isinstance(message, SceneTruth))
    np.testing.assert_array_equal(truth.hidden_points_m, source.truth(0).hidden_points_m)


@pytest.mark.parametrize("name", ["capture.mcap", "capture.sigmf-meta"])
def test_a_digital_array_is_played_from_a_capture_as_it_is_simulated(tmp_path: Path, name: str) -> None:
    """Beams of one time go out over half of the scan, from the scene and from what was written of it: 6 ms apart."""
    source = scene_player(params(scene="launch/scenes/facade_across_lane_77ghz.yaml"))
    path = written(source, tmp_path / name)
    beams = [event for event in capture_events(path) if isinstance(event.outgoing.message, RadarBeam)]
    step_ns = source.setup.beam_share_ns // 2
    assert len({event.outgoing.message.stamp_ns for event in beams}) == 1
    assert step_ns > 0
    expected_ns = [index * source.setup.beam_share_ns // 2 for index in range(len(beams))]
    assert [event.offset_ns - beams[0].offset_ns for event in beams] == expected_ns


def test_a_capture_begins_at_once_whatever_clock_its_stamps_are_of(tmp_path: Path) -> None:
    """Stamps in Unix time, as a board writes them: offsets are those from its first beam, 12 ms a beam."""
    source = scene_player(params())
    unix_ns = 1_750_000_000_000_000_000
    beams = (source.beam(0, index) for index in range(3))
    later = (msgspec.structs.replace(beam, stamp_ns=beam.stamp_ns + unix_ns) for beam in beams)
    path, _ = write_capture(tmp_path / "capture.sigmf-meta", source.setup, later)
    events = [event for event in capture_events(path) if event.outgoing.topic == "radar/beam"]
    assert [event.offset_ns for event in events] == [0, 12_000_000, 24_000_000]


@pytest.mark.parametrize(("name", "step_s"), [("a.mcap", 1.7e9), ("a.sigmf-meta", 1.7e9), ("a.sigmf-meta", -5.0)])
def test_a_clock_that_was_set_is_played_over(
    tmp_path: Path, name: str, step_s: float, caplog: pytest.LogCaptureFixture
) -> None:
    """As of a board that boots in 1970 and learns the time of day within a scan: pace, order and stamps stay."""
    source, path = scene_player(params()), tmp_path / name
    beams = [source.beam(0, index) for index in range(25)]
    start_ns = [10**18 + (round(step_s * 1e9) if index >= 12 else 0) for index in range(25)]
    beams = [
        msgspec.structs.replace(beam, stamp_ns=beam.stamp_ns + at) for beam, at in zip(beams, start_ns, strict=True)
    ]
    if path.suffix == ".mcap":
        with RecordingWriter(path, {}) as writer:
            writer.write("radar/setup", source.setup, publisher="radar", sequence=0, sent_ns=0)
            for index, beam in enumerate(beams):
                writer.write("radar/beam", beam, publisher="radar", sequence=index, sent_ns=beam.stamp_ns)
    else:
        write_capture(path, source.setup, iter(beams))
    played = [event for event in capture_events(path) if event.outgoing.topic == "radar/beam"]
    assert [event.offset_ns for event in played] == [12_000_000 * index for index in range(25)]
    assert [event.outgoing.message.stamp_ns for event in played] == [beam.stamp_ns for beam in beams]
    assert f"{path}: the clock was set by {step_s:+.{0 if step_s > 10 else 1}f} s" in caplog.text


def test_the_graphs_own_work_in_a_recording_is_left_out(tmp_path: Path) -> None:
    """A recording may hold maps and views of an earlier run: they must not meet those of this one."""
    events = [event.outgoing for event in scene_events(scene_player(params()), 1)]
    path = tmp_path / "capture.mcap"
    write_recording(path, iter(events), {})
    assert {event.outgoing.topic for event in capture_events(path)} <= set(SENSED_TOPICS)


def test_a_set_up_that_stands_behind_the_first_beams_comes_before_them(tmp_path: Path) -> None:
    """As at the start of a part of a recording; once, since the former begins anew with each."""
    source = scene_player(params())
    path = tmp_path / "part.mcap"
    with RecordingWriter(path, {}) as writer:
        for index in range(3):
            sent_ns = 1000 * index
            writer.write("radar/beam", source.beam(0, index), publisher="radar", sequence=index, sent_ns=sent_ns)
        for number, sent_ns in enumerate((500, 1500)):
            writer.write("radar/setup", source.setup, publisher="radar", sequence=number, sent_ns=sent_ns)
    topics = [event.outgoing.topic for event in capture_events(path)]
    assert topics == ["radar/setup", "radar/beam", "radar/beam", "radar/setup", "radar/beam"]
    assert [event.offset_ns for event in capture_events(path)] == [0, 0, 1000, 1500, 2000]


def test_a_car_that_was_heard_long_before_the_radar_is_played_in_time(tmp_path: Path) -> None:
    """Only what still counts for the first beam goes at once: queues would not hold 20 s of states."""
    source = scene_player(params())
    path = tmp_path / "late_radar.mcap"
    with RecordingWriter(path, {}) as writer:
        writer.write("radar/setup", source.setup, publisher="radar", sequence=0, sent_ns=0)
        for index in range(2000):
            state = VehicleState(stamp_ns=10_000_000 * index)
            writer.write("vehicle/state", state, publisher="car", sequence=index, sent_ns=10_000_000 * index)
        writer.write("radar/beam", source.beam(0, 0), publisher="radar", sequence=0, sent_ns=20_000_000_000)
    player, now_ns = create(Params(capture=str(path))), 0
    at_once = player.step([], now_ns)
    assert [outgoing.topic for outgoing in at_once] == ["radar/setup"] + 51 * ["vehicle/state"]
    due_ns = player.due_ns(now_ns)
    assert due_ns == 30_000_000 + 510_000_000


@pytest.mark.parametrize(("offset_s", "first_ns"), [(0.5, 500_000_000), (-0.055, 5_000_000)])
def test_states_from_before_the_radars_clock_began_are_left_out(tmp_path: Path, offset_s: float, first_ns: int) -> None:
    path = tmp_path / "drive.mcap"
    with RecordingWriter(path, {}) as writer:
        for index in range(20):
            state = VehicleState(stamp_ns=20_000_000 * index, speed_mps=float(index))
            writer.write("vehicle/state", state, publisher="car", sequence=index, sent_ns=state.stamp_ns)
    messages = played(Params(capture=str(path), vehicle_clock_offset_s=offset_s))[0]
    stamps_ns = [message.stamp_ns for message in messages]
    assert stamps_ns == list(range(first_ns, 380_000_000 + round(offset_s * 1e9) + 1, 20_000_000))


def test_speeds_override_the_scene() -> None:
    scene = scene_of(params(object_speed_mps=5.0, ego_speed_mps=8.0))
    assert {thing.speed_mps for thing in scene.objects} == {5.0}
    assert scene.ego.speed_mps == 8.0
    assert not scene_of(params()).moves
    with pytest.raises(
        ValueError, match=r"facade_across_lane\.yaml: ego\.speed_mps: must lie in -100\.\.100, got 9000\.0"
    ):
        scene_of(params(ego_speed_mps=9000.0))


@pytest.mark.parametrize(
    ("change", "rule"),
    [
        ({"capture": "x.mcap"}, "exactly one of scene and capture"),
        ({"scene": None}, "exactly one of scene and capture"),
        ({"rate": 0.0}, r"player\.rate must be positive, got 0\.0"),
        ({"rate": float("nan")}, r"player\.rate must be positive"),
        ({"settle_s": float("inf")}, r"player\.settle_s must be 0\.\.3600 s, got inf"),
        ({"settle_s": float("nan")}, r"player\.settle_s must be 0\.\.3600 s, got nan"),
        ({"scans": -1}, r"player\.scans must not be negative"),
    ],
)
def test_bad_parameters_are_refused(change: dict, rule: str) -> None:
    with pytest.raises(ValueError, match=rule):
        params(**change)


@pytest.mark.parametrize("content", [b"", b"\x00" * 100, b"\x89MCAP0\r\n", b"{}"])
@pytest.mark.parametrize("name", ["bad.mcap", "bad.sigmf-meta"])
def test_garbage_as_a_capture_is_one_line(tmp_path: Path, name: str, content: bytes) -> None:
    path = tmp_path / name
    path.write_bytes(content)
    with pytest.raises(ValueError, match="bad") as caught:
        create(Params(capture=str(path)))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("wrong", [{"purpose": "fun"}, {"chirps_per_beam": 0}])
def test_params_refuse_what_no_scene_has(wrong: dict[str, object]) -> None:
    with pytest.raises(msgspec.ValidationError, match=r"fun|chirps_per_beam"):
        msgspec.convert({"scene": "x", **wrong}, Params)


@pytest.mark.parametrize("scene", [SCENE, "launch/scenes/facade_across_lane_77ghz.yaml"])
def test_walls_of_a_scene_are_sent_once_a_scan(scene: str) -> None:
    """With the stamp of its first beam, as the vehicle sees them then; stamps move with the bus clock's."""
    messages, _ = played(params(scene=scene, scans=2, walls="true", ego_speed_mps=5.0))
    walls = [message for message in messages if isinstance(message, WallPriors)]
    starts = [message.stamp_ns for message in messages if isinstance(message, RadarBeam) and message.beam_index == 0]
    assert [message.stamp_ns for message in walls] == starts
    first, second = (np.array([wall.ends_m for wall in message.walls]) for message in walls)
    driven_m = 5.0 * 1e-9 * (starts[1] - starts[0])
    np.testing.assert_allclose(first[..., 0] - second[..., 0], driven_m, atol=1e-9)


def test_a_scene_sends_no_walls_unless_asked() -> None:
    assert not [message for message in played(params())[0] if isinstance(message, WallPriors)]


def test_noisy_walls_follow_the_seed() -> None:
    def walls(seed: int) -> list[WallPriors]:
        return [message for message in played(params(walls="noisy", seed=seed))[0] if isinstance(message, WallPriors)]

    assert walls(1) == walls(1)
    assert walls(1) != walls(2)


def test_walls_are_those_of_a_scene() -> None:
    with pytest.raises(ValueError, match=r"player.walls are those of a scene, a capture has its own: got 'true'"):
        Params(capture="a.mcap", walls="true")


def test_walls_in_a_recording_are_played_from_it(tmp_path: Path) -> None:
    """Recorded with the beams, and sent again with the stamps that they had."""
    scene = params(walls="noisy")
    source = scene_player(scene)
    path = tmp_path / "walls.mcap"
    sent = [event.outgoing for event in with_walls(scene_events(source, 1), source, scene)]
    write_recording(path, iter(sent), {})
    (expected,) = (outgoing.message for outgoing in sent if outgoing.topic == "environment/walls")
    assert [message for message in played(Params(capture=str(path)))[0] if isinstance(message, WallPriors)] == [
        expected
    ]


class SlowScene:
    """A scene of which a beam takes so long to make, on a clock of its own that nothing else moves."""

    def __init__(self, beam_ns: int) -> None:
        self.now_ns, self._beam_ns = 0, beam_ns
        self._source = scene_player(params())
        self._beam = self._source.beam(0, 0)
        self.setup, self.scene = self._source.setup, self._source.scene
        self.stamp_ns, self.vehicle_state = self._source.stamp_ns, self._source.vehicle_state

    def load_kernels(self) -> None:
        """It has none."""

    def beam(self, scan: int, index: int) -> RadarBeam:
        self.now_ns += self._beam_ns
        stamp_ns = self.stamp_ns(scan, index)
        return msgspec.structs.replace(self._beam, scan_id=scan, beam_index=index, stamp_ns=stamp_ns)

    def truth(self, scan: int) -> SceneTruth:
        return msgspec.structs.replace(self._source.truth(0), scan_id=scan)


def driven(player: Player, until_ns: int, clock: SlowScene) -> list[tuple[int, RadarBeam | RadarDetections]]:
    """Beams and detections with the times at which they were sent, as the loop of a node has them."""
    sent = []
    while clock.now_ns < until_ns and not player.finished():
        due_ns = player.due_ns(clock.now_ns)
        assert due_ns is not None
        clock.now_ns = clock.now_ns if player.pending() else max(clock.now_ns, due_ns)
        at_ns = clock.now_ns
        messages = [outgoing.message for outgoing in player.step([], at_ns)]
        sent += [(at_ns, message) for message in messages if isinstance(message, RadarBeam | RadarDetections)]
    return sent


@pytest.mark.parametrize("times", [0.5, 2.0, 3.0, 6.0, 20.0])
def test_a_player_that_cannot_keep_up_leaves_scans_out_and_never_lags_a_second(times: float) -> None:
    """Whole scans: only of those before it knows how long it takes the end may be missing."""
    source = SlowScene(round(times * 12_000_000))
    backlog = Backlog(1.0, lambda: source.now_ns)
    player = Player(scene_events(source, None, backlog), 1.0, 0.03, True, backlog)  # type: ignore[arg-type]
    start_ns = 30_000_000 + source.now_ns
    sent = driven(player, 60_000_000_000, source)
    lags_ns = [at_ns - beam.stamp_ns for at_ns, beam in sent]  # type: ignore[union-attr]
    assert min(lags_ns) >= 0
    assert max(lags_ns) <= LONGEST_LAG_NS
    counts = Counter(beam.scan_id for _, beam in sent)
    torn = [scan for scan in sorted(counts)[:-1] if counts[scan] < 25]
    assert len(torn) <= (0 if times < 4.0 else 2)
    passed = (source.now_ns - start_ns) / 300_000_000
    assert len(counts) - len(torn) >= 0.7 * passed / max(times, 1.0)
    assert len(counts) + backlog.left_out == pytest.approx(passed, abs=1.5 + 1.5 * times)
    state, reason = player.health()
    assert (state is NodeState.DEGRADED) is (times > 1.0)
    assert reason == ("" if times < 1.0 else f"cannot keep up with real time: {backlog.left_out} scans left out so far")
    assert sum(count.count for count in player.shed.counts()) == backlog.left_out


def test_a_capture_that_was_held_up_goes_on_where_it_should_be(tmp_path: Path) -> None:
    """A stop of 5 s, as of a machine that swaps: at most the last second is caught up with, the rest is left out."""
    path = tmp_path / "a.mcap"
    empty = np.zeros(0)
    with RecordingWriter(path, {}) as writer:
        for scan in range(100):
            detections = RadarDetections(
                stamp_ns=scan * 100_000_000, scan_id=scan, sensor="front", range_m=empty, azimuth_rad=empty,
                covariance=np.zeros((0, 2, 2)),
            )  # fmt: skip
            writer.write("radar/detections", detections, publisher="radar", sequence=scan, sent_ns=detections.stamp_ns)
    player, clock = create(Params(capture=str(path), settle_s=0.0)), SlowScene(0)
    sent = driven(player, 2_050_000_000, clock)
    clock.now_ns += 5_000_000_000
    sent += driven(player, 20_000_000_000, clock)
    assert [message.scan_id for _, message in sent] == [*range(22), *range(66, 100)]
    assert max(at_ns - message.stamp_ns for at_ns, message in sent) <= LATE_NS + 50_000_000
    assert player.shed.counts()[0].count == 44
    assert player.health() == (NodeState.DEGRADED, "cannot keep up with real time: 44 scans left out so far")
