"""`bag play`: spans, pace, keys, other names, what is waited for and what is told; on a bus with a clock of its own."""

from __future__ import annotations

import json
import os
import pty
import sys
import termios
from contextlib import closing
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from mcap.writer import Writer

from mirrorwave.cli import main
from mirrorwave.commands.captures.bag_options import span_ns
from mirrorwave.replay import listeners as replay_graph
from mirrorwave.replay.keys import Key, Keyboard, keys_of
from mirrorwave.replay.listeners import NodeLoss, ReplayedGraph
from mirrorwave.replay.schedule import Position, Replay, ReplayParams, Schedule, Summary, whole_scans
from msgs.bus import zmq as zmq_bus
from msgs.bus.codec import encode_inline, json_schema
from msgs.bus.interface import Envelope, Received
from msgs.bus.zmq import ZmqBus
from msgs.recording.mcap import Recorded, RecordingReader, RecordingWriter
from msgs.values.diagnostics import NodeStatus, ShedCount, TopicCount
from msgs.values.perception import BevFrame
from msgs.values.radar import RadarBeam, RadarSetup
from msgs.values.vehicle import VehicleState
from nodes.inputs.beam_queue import MAX_SCANS_WAITING, BeamQueue
from nodes.node import Stop
from tests.builders import example_beam, example_status, example_view

ANSWER = "perception/hidden_objects"
BEAMS = 4
MS = 1_000_000
#: Recorded scans are 100 ms long here, a beam every 25 ms; the set-up was said a minute before.
SCAN_MS, BEAM_MS, FIRST_MS = 100, 25, 60_000


def beam(scan: int, index: int) -> RadarBeam:
    return example_beam(
        stamp_ns=(FIRST_MS + SCAN_MS * scan + BEAM_MS * index - 12) * MS,
        scan_id=scan,
        beam_index=index,
        beam_count=BEAMS,
    )


def view(scan: int) -> BevFrame:
    return example_view(scan_id=scan)


def received(topic: str, message: msgspec.Struct, paced: bool = False, sequence: int = 0) -> Received:
    return Received(topic, message, Envelope(publisher="a", topic=topic, sequence=sequence, sent_ns=0, paced=paced))


def status(node: str, took: int, pid: int = 1, shed: int = 0, outdated: int = 0, stamp_ns: int = 0) -> NodeStatus:
    return example_status(
        stamp_ns=stamp_ns,
        node=node,
        pid=pid,
        received=(
            TopicCount(topic="radar/beam", messages=took, bytes=0),
            TopicCount(topic="radar/ra_map", messages=0, bytes=0, outdated=outdated),
        ),
        shed=(ShedCount(what="scan", reason="behind", count=shed),),
    )


class FakeBus:
    """Takes what is published, answers each scan some time after its last beam; time passes while somebody waits."""

    def __init__(self, answer_ms: float | None = None) -> None:
        self.time_ns = 10**15
        self.sent: list[tuple[str, Any, int]] = []
        self.inbox: list[tuple[int, Received]] = []
        self._answer_ms = answer_ms

    def publish(self, topic: str, message: Any) -> None:
        self.sent.append((topic, message, self.time_ns))
        if self._answer_ms is not None and topic == "radar/beam" and message.beam_index == BEAMS - 1:
            self.inbox.append((self.time_ns + int(self._answer_ms * MS), received(ANSWER, view(message.scan_id))))

    def subscribe(self, topic: str) -> None: ...

    def subscribers(self, topic: str) -> int:
        return 1

    def now_ns(self) -> int:
        return self.time_ns

    def receive(self, timeout_s: float) -> list[Received]:
        self.time_ns += round(1e9 * timeout_s) or 1000
        due = [item for item in self.inbox if item[0] <= self.time_ns]
        self.inbox = [item for item in self.inbox if item not in due]
        return [message for _, message in due]

    def beams(self) -> list[tuple[int, int]]:
        return [(message.scan_id, message.beam_index) for topic, message, _ in self.sent if topic == "radar/beam"]

    def times_ms(self, topic: str) -> list[float]:
        times = [time_ns for sent, _, time_ns in self.sent if sent == topic]
        return [(time_ns - times[0]) / MS for time_ns in times]


class FakeKeys(Keyboard):
    """Keys by the turn in which they are pressed."""

    def __init__(self, presses: dict[int, Key]) -> None:
        super().__init__(-1)
        self._presses, self._turn = presses, 0

    def pressed(self) -> list[Key]:
        self._turn += 1
        return [self._presses[self._turn]] if self._turn in self._presses else []


def record(path: Path, scans: int = 4, first_beam: int = 0, set_ns: int = 0) -> Path:
    """Scans, from the second on with a clock that was set."""
    with RecordingWriter(path, {}) as writer:
        writer.write("radar/setup", RadarSetup(), publisher="radar", sequence=0, sent_ns=0)
        for number in range(first_beam, scans * BEAMS):
            message = beam(number // BEAMS, number % BEAMS)
            state = VehicleState(stamp_ns=message.stamp_ns, speed_mps=float(number))
            sent_ns = message.stamp_ns + 12 * MS + set_ns * (number >= BEAMS)
            writer.write("radar/beam", message, publisher="radar", sequence=number, sent_ns=sent_ns)
            writer.write("vehicle/state", state, publisher="can", sequence=number, sent_ns=sent_ns - MS)
    return path


@pytest.fixture
def drive(tmp_path: Path) -> Path:
    return record(tmp_path / "drive.mcap")


def play(
    path: Path, bus: FakeBus, tmp_path: Path, monkeypatch: pytest.MonkeyPatch | None = None,
    keys: dict[int, Key] | None = None, start_s: float = 0.0, end_s: float | None = None, stop: Stop | None = None,
    **options: Any,
) -> Summary:  # fmt: skip
    topics = ("radar/setup", "radar/beam", "vehicle/state")
    if monkeypatch is not None:
        monkeypatch.setattr(replay_graph, "list_publishers", lambda _: [(ANSWER, "geometry")])
    stop = stop or Stop()
    graph = ReplayedGraph(bus, tmp_path, topics, lambda: stop.requested)  # type: ignore[arg-type]
    start_ns, end_ns = span_ns(FIRST_MS * MS - MS, 1 << 62, start_s, end_s)
    params = ReplayParams(topics=topics, first_ns=FIRST_MS * MS - MS, start_ns=start_ns, end_ns=end_ns, **options)
    shown: list[Position] = []
    with RecordingReader(path) as reader:
        replay = Replay(reader, bus, graph, params, stop, FakeKeys(keys or {}), shown.append)  # type: ignore[arg-type]
        return replay.run()


# spans and pace


def test_everything_goes_once_in_its_order_and_at_its_time(drive: Path, tmp_path: Path) -> None:
    bus = FakeBus()
    found = play(drive, bus, tmp_path)
    assert found.messages == {"radar/setup": 1, "radar/beam": 16, "vehicle/state": 16}
    assert found.is_whole
    assert found.scans == 4
    assert found.unanswered is None
    # what is said once goes at once, however long before it was said
    assert [topic for topic, _, _ in bus.sent[:3]] == ["radar/setup", "vehicle/state", "radar/beam"]
    assert bus.times_ms("radar/beam") == pytest.approx([BEAM_MS * index for index in range(16)], abs=1.0)
    stamps = [message.stamp_ns for topic, message, _ in bus.sent if topic == "radar/beam"]
    assert stamps == [beam(number // BEAMS, number % BEAMS).stamp_ns for number in range(16)]


@pytest.mark.parametrize(("rate", "spread_ms"), [(2.0, 187.5), (0.5, 750.0), (0.0, 0.0)])
def test_the_rate_sets_the_pace(drive: Path, tmp_path: Path, rate: float, spread_ms: float) -> None:
    bus = FakeBus()
    play(drive, bus, tmp_path, rate=rate)
    assert bus.times_ms("radar/beam")[-1] == pytest.approx(spread_ms, abs=2.0)


def test_a_cut_leaves_whole_scans_and_the_states_before_them(drive: Path, tmp_path: Path) -> None:
    bus = FakeBus()
    # from the second beam of scan 1 to the second of scan 2: scan 1 is torn, scan 2 is played to its end
    play(drive, bus, tmp_path, start_s=0.12, end_s=0.23)
    assert bus.beams() == [(2, index) for index in range(BEAMS)]
    assert bus.sent[0][0] == "radar/setup"
    assert [message.speed_mps for topic, message, _ in bus.sent if topic == "vehicle/state"][:6] == [0, 1, 2, 3, 4, 5]


def test_a_scan_that_the_recording_itself_holds_in_part_is_played(tmp_path: Path) -> None:
    bus = FakeBus()
    path = record(tmp_path / "part.mcap", scans=2, first_beam=2)
    topics = ("radar/setup", "radar/beam", "vehicle/state")
    with RecordingReader(path) as reader:
        messages = list(whole_scans(reader.messages(topics), is_cut=False, end_ns=None))
    assert sum(one.topic == "radar/beam" for one in messages) == 6
    play(path, bus, tmp_path, start_s=0.0)
    assert bus.beams()[-4:] == [(1, index) for index in range(BEAMS)]


def test_a_delay_shifts_what_follows_but_for_what_can_be_caught_up() -> None:
    schedule = Schedule(2.0)
    assert schedule.due_ns(0, 1000 * MS) == 1000 * MS
    assert schedule.due_ns(100 * MS, 1000 * MS) == 1050 * MS
    schedule.forgive(100 * MS, 1250 * MS)
    assert schedule.due_ns(200 * MS, 1250 * MS) == 1100 * MS
    schedule.forgive(100 * MS, 2050 * MS)
    assert schedule.due_ns(200 * MS, 2050 * MS) == 1800 * MS
    schedule.restart()
    schedule.forgive(100 * MS, 2050 * MS)
    assert schedule.due_ns(200 * MS, 2050 * MS) == 2100 * MS
    schedule.change_rate(1.0, 200 * MS, 2050 * MS)
    assert schedule.due_ns(300 * MS, 2050 * MS) == 2200 * MS


def test_loops_play_the_set_up_again(drive: Path, tmp_path: Path) -> None:
    stop, bus = Stop(), FakeBus()
    found = play(drive, bus, tmp_path, rate=0.0, loop=True, keys={10: Key.QUIT}, stop=stop)
    assert found.interrupted
    assert found.passes >= 1
    assert found.is_whole
    assert found.messages["radar/setup"] == found.passes + 1


def test_a_span_that_holds_nothing_is_not_begun_again_and_again(drive: Path, tmp_path: Path) -> None:
    """The set-up from before it is no reason to: without a pause it would be sent without end."""
    bus = FakeBus()
    found = play(drive, bus, tmp_path, start_s=5.0, loop=True)
    assert found.passes == 1
    assert [topic for topic, _, _ in bus.sent] == ["radar/setup"]


def test_a_set_up_that_stands_behind_the_first_beam_comes_before_it(tmp_path: Path) -> None:
    path = tmp_path / "part.mcap"
    with RecordingWriter(path, {}) as writer:
        for number in range(BEAMS):
            message = beam(0, number)
            sent_ns = message.stamp_ns + 12 * MS
            writer.write("radar/beam", message, publisher="radar", sequence=number, sent_ns=sent_ns)
        writer.write("radar/setup", RadarSetup(), publisher="radar", sequence=0, sent_ns=FIRST_MS * MS + 1)
    bus = FakeBus()
    play(path, bus, tmp_path)
    assert [topic for topic, _, _ in bus.sent] == ["radar/setup"] + BEAMS * ["radar/beam"]


def test_states_from_before_the_start_are_no_time_played(drive: Path, tmp_path: Path) -> None:
    found = play(drive, FakeBus(), tmp_path, start_s=0.3)
    # 0.299 s: a state, then the last scan, whose last beam comes 75 ms after its first
    assert found.played_s == pytest.approx(0.075, abs=0.002)


@pytest.mark.parametrize(
    "options", [{}, {"rate": 2.0}, {"keeps_time": True}, {"paused": True, "keys": {40: Key.PAUSE}}]
)
def test_a_clock_that_was_set_is_played_over(options: dict[str, Any], tmp_path: Path) -> None:
    """At the pace of the recording, whatever that is; time played is what passed."""
    right, stepped = FakeBus(), FakeBus()
    found = play(record(tmp_path / "right.mcap"), right, tmp_path, **options)
    over = play(record(tmp_path / "set.mcap", set_ns=17 * 10**17), stepped, tmp_path, **options)
    assert stepped.beams() == right.beams()
    np.testing.assert_allclose(stepped.times_ms("radar/beam"), right.times_ms("radar/beam"), atol=25.0)
    assert over.played_s == pytest.approx(found.played_s, abs=0.025)


def test_stamps_on_the_clock_of_now_keep_their_age(drive: Path, tmp_path: Path) -> None:
    bus = FakeBus()
    play(drive, bus, tmp_path, on_clock=True)
    ages_ms = [(time_ns - message.stamp_ns) / MS for topic, message, time_ns in bus.sent if topic == "radar/beam"]
    assert ages_ms == pytest.approx([12.0] * 16, abs=1.0)
    assert [message.stamp_ns for topic, message, _ in bus.sent if topic == "radar/setup"] == [0]


# keys


def test_pausing_and_steps_keep_to_whole_scans(drive: Path, tmp_path: Path) -> None:
    bus = FakeBus()
    found = play(drive, bus, tmp_path, rate=0.0, paused=True, keys={20: Key.STEP, 60: Key.STEP, 90: Key.QUIT})
    assert bus.beams() == [(scan, index) for scan in (0, 1) for index in range(BEAMS)]
    assert found.interrupted


def test_seeking_goes_on_at_the_next_whole_scan(tmp_path: Path) -> None:
    bus = FakeBus()
    path = record(tmp_path / "long.mcap", scans=60)
    play(path, bus, tmp_path, rate=0.0, keys={2: Key.FORWARD, 5: Key.BACK})
    scans = [scan for scan, index in bus.beams() if index == 0]
    # forward from before scan 1 by 5 s, back from before scan 54 or 55 by 5 s, from there to the end
    assert scans[0] == 0
    assert scans[1] in (51, 52)
    assert min(scans[1:]) < 10
    assert scans[-1] == 59
    assert all(bus.beams().count((scan, index)) == scans.count(scan) for scan in scans for index in range(BEAMS))


def test_keys_are_told_from_what_a_terminal_sends() -> None:
    assert keys_of(b" s\x1b[A\x1bOBx\x1b[Cq") == (
        [Key.PAUSE, Key.STEP, Key.FASTER, Key.SLOWER, Key.FORWARD, Key.QUIT],
        b"",
    )
    assert keys_of(b"s\x1b[") == ([Key.STEP], b"\x1b[")


def test_a_terminal_is_left_as_it_was() -> None:
    leader, follower = pty.openpty()
    before = termios.tcgetattr(follower)
    with Keyboard(follower) as keyboard:
        assert keyboard.is_there
        assert not termios.tcgetattr(follower)[3] & (termios.ICANON | termios.ECHO)
        os.write(leader, b" \x1b[D")
        assert keyboard.pressed() == [Key.PAUSE, Key.BACK]
    assert termios.tcgetattr(follower) == before
    os.close(leader)
    os.close(follower)


def test_a_terminal_that_belongs_to_another_is_left_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    """A player in the background of a shell would be stopped as soon as it changed the terminal."""
    leader, follower = pty.openpty()
    monkeypatch.setattr(os, "tcgetpgrp", lambda _: os.getpgrp() + 1)
    assert not Keyboard(follower).is_there
    monkeypatch.setattr(sys, "stdin", None)
    assert not Keyboard().is_there
    os.close(leader)
    os.close(follower)


# what is waited for


def test_no_more_than_two_scans_are_on_their_way(drive: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    bus = FakeBus(answer_ms=400.0)
    found = play(drive, bus, tmp_path, monkeypatch, rate=0.0)
    begun = [time_ns / MS for topic, message, time_ns in bus.sent if topic == "radar/beam" and message.beam_index == 0]
    # scans 0 and 1 go at once, 2 when 0 is answered, 3 when 1 is
    assert begun[1] - begun[0] < 50.0
    assert 400.0 <= begun[2] - begun[0] < 450.0
    assert found.unanswered == 0
    assert found.answered_on == ANSWER
    assert found.is_whole
    # who ends it waits for none
    ended = play(drive, FakeBus(answer_ms=400.0), tmp_path, monkeypatch, rate=0.0, loop=True, keys={10: Key.QUIT})
    assert (ended.interrupted, ended.answered_on, ended.unanswered, ended.lost) == (True, ANSWER, None, ())


def test_who_keeps_time_waits_for_nobody(drive: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    bus = FakeBus(answer_ms=400.0)
    play(drive, bus, tmp_path, monkeypatch, keeps_time=True)
    assert bus.times_ms("radar/beam") == pytest.approx([BEAM_MS * index for index in range(16)], abs=1.0)


def graph_of(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, bus: FakeBus) -> ReplayedGraph:
    publishers = [(ANSWER, "geometry"), ("diagnostics/node", "ra_former")]
    monkeypatch.setattr(replay_graph, "list_publishers", lambda _: publishers)
    return ReplayedGraph(bus, tmp_path, ("radar/beam",), lambda: False)  # type: ignore[arg-type]


def test_what_stays_silent_is_given_up_and_counted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    bus = FakeBus()
    graph = graph_of(tmp_path, monkeypatch, bus)
    for scan in range(3):
        graph.note_sent(Recorded("radar/beam", beam(scan, 0), "a", 0, 0))
    graph.await_room(0, patience_s=0.01)
    assert graph.unanswered == 3
    bus.inbox.append((0, received(ANSWER, view(1))))
    graph.serve(0.0)
    assert graph.unanswered == 2


def test_what_nodes_missed_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    bus = FakeBus()
    graph = graph_of(tmp_path, monkeypatch, bus)
    bus.inbox.append((0, received("diagnostics/node", status("ra_former", took=100, shed=2, outdated=1))))
    graph.await_subscribers(0.0)
    for index in range(4):
        graph.note_sent(Recorded("radar/beam", beam(0, index), "a", 0, 0))
    later = status("ra_former", took=103, shed=5, outdated=3, stamp_ns=2 * bus.time_ns)
    bus.inbox.append((0, received("diagnostics/node", later)))
    graph.confirm(0.01)
    assert graph.losses() == (
        NodeLoss(node="ra_former", what="radar/beam", reason="not received", count=1),
        NodeLoss(node="ra_former", what="radar/ra_map", reason="lost or outdated", count=2),
        NodeLoss(node="ra_former", what="scan", reason="behind", count=3),
    )
    bus.inbox.append((0, received("diagnostics/node", status("ra_former", took=4, pid=2))))
    graph.serve(0.0)
    assert [loss.reason for loss in graph.losses()] == ["started anew"]


def test_a_node_that_never_connects_ends_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(replay_graph, "READY_S", 0.05)
    graph = graph_of(tmp_path, monkeypatch, FakeBus())
    with pytest.raises(TimeoutError, match="ra_former says nothing"):
        graph.await_subscribers(0.0)


# what a paced message asks of others


def test_paced_beams_are_all_folded_up_to_what_only_a_flood_would_pile() -> None:
    most = MAX_SCANS_WAITING * BEAMS
    for paced, kept in ((False, 0), (True, most)):
        queue = BeamQueue(0.5)
        queue.load = 5.0
        for number in range(most):
            queue.put(received("radar/beam", beam(number // BEAMS, number % BEAMS), paced, number))
        assert (len(queue) == kept) if paced else (queue.shed_scans > 0)
    queue.put(received("radar/beam", beam(MAX_SCANS_WAITING, 0), True, most))
    assert (len(queue), queue.shed_beams) == (most, 1)


@pytest.mark.graph
def test_who_keeps_time_still_waits_until_readers_are_there(
    drive: Path, quiet_domain: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with closing(ZmqBus("reader", quiet_domain / "default")) as reader:
        reader.subscribe("vehicle/state")
        assert main(["bag", "play", str(drive), "--rate", "10", "--realtime", "--json"]) == 0
        assert json.loads(capsys.readouterr().out)["messages"]["vehicle/state"] == 16


@pytest.mark.graph
def test_a_paced_bus_waits_for_a_reader_that_is_behind(quiet_domain: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(zmq_bus, "_HELD_UP_NS", 300 * MS)
    large = msgspec.structs.replace(beam(0, 0), samples=np.zeros((128, 8192, 2), np.int16))
    with (
        closing(ZmqBus("player", quiet_domain, paced=True)) as player,
        closing(ZmqBus("reader", quiet_domain)) as reader,
    ):
        player.advertise("radar/beam")
        reader.subscribe("radar/beam")
        while not player.subscribers("radar/beam"):
            player.receive(0.01)
            reader.receive(0.01)
        sent = taken = 0
        error = ""
        while not error and sent < 500:
            try:
                player.publish("radar/beam", large)
                sent += 1
            except TimeoutError as raised:
                error = str(raised)
        assert error.startswith("radar/beam: a subscriber has taken nothing")
        while found := reader.receive(0.5):
            taken += len(found)
        assert taken == sent
        assert reader.counts()[0][0].lost == 0


# the command


@pytest.fixture
def foreign(tmp_path: Path) -> Path:
    """A recording of another program: our type under its own topic."""
    path = tmp_path / "foreign.mcap"
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        schema = writer.register_schema("VehicleState", "jsonschema", msgspec.json.encode(json_schema(VehicleState)))
        channel = writer.register_channel("car/motion", "msgpack", schema)
        for index in range(5):
            data = encode_inline(VehicleState(stamp_ns=index * MS, speed_mps=1.0))
            writer.add_message(channel, index * MS, data, index * MS)
        writer.finish()
    return path


def test_a_foreign_topic_is_played_under_a_known_name(
    foreign: Path, quiet_domain: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["bag", "play", str(foreign), "--remap", "car/motion:=vehicle/state", "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["messages"] == {"vehicle/state": 5}
    assert told["nodes"] == []
    assert told["answered_on"] is None


@pytest.mark.parametrize(
    ("options", "text"),
    [
        (["--rate", "-1"], "--rate must be 0 or 0.05..1000, got -1"),
        (["--rate", "nan"], "--rate must be 0 or 0.05..1000, got nan"),
        (["--rate", "0.01"], "--rate must be 0 or 0.05..1000, got 0.01"),
        (["--rate", "0", "--realtime"], "--realtime keeps time and needs a --rate above 0"),
        (["--clock", "--rate", "2"], "--clock needs --rate 1"),
        (["--end", "2", "--duration", "1"], "--end and --duration must not be given together"),
        (["--start", "inf"], "--start must be 0..1e+09 s, got inf"),
        (["--start", "400"], "--start must be within the recording"),
        (["--duration", "nan"], "--duration must be 0..1e+09 s, got nan"),
        (["--topics", ""], "--topics must name a topic, got ''"),
        (["--duration", "0"], "--end must be after --start 0, got 0"),
        (["--topics", "log"], "holds no topic 'log' to play"),
        (["--remap", "radar/beam"], "--remap must be OLD:=NEW"),
        (["--remap", "nope:=radar/beam"], "holds no topic 'nope'"),
        (["--remap", "radar/beam:=nope"], "unknown topic 'nope'"),
        (["--remap", "radar/beam:=vehicle/state"], "vehicle/state carries VehicleState, but radar/beam RadarBeam"),
        (["--start-paused"], "--start-paused needs a terminal"),
    ],
)
def test_wrong_options_are_one_line(
    drive: Path, quiet_domain: Path, options: list[str], text: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["bag", "play", str(drive), *options]) == 2
    error = capsys.readouterr().err
    assert text in error
    assert error.count("\n") == 1


def test_a_cut_recording_is_played_as_far_as_it_goes(
    foreign: Path, drive: Path, quiet_domain: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    whole = drive.read_bytes()
    drive.write_bytes(whole[:-60])
    assert main(["bag", "play", str(drive), "--rate", "0", "--json"]) == 3
    told = json.loads(capsys.readouterr().out)
    assert "cut off" in told["loss"]
    assert told["messages"]["radar/beam"] == 16
    for broken in (b"", whole[:8], b"not a recording"):
        drive.write_bytes(broken)
        assert main(["bag", "play", str(drive), "--rate", "0"]) in (2, 3)
        assert capsys.readouterr().err.count("\n") == 1


def test_what_a_node_makes_itself_is_left_out(
    tmp_path: Path, quiet_domain: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "both.mcap"
    with RecordingWriter(path, {}) as writer:
        writer.write("vehicle/state", VehicleState(stamp_ns=0), publisher="can", sequence=0, sent_ns=0)
        writer.write(ANSWER, view(0), publisher="geometry", sequence=0, sent_ns=1)
    with closing(ZmqBus("geometry", quiet_domain / "default")) as bus:
        bus.advertise(ANSWER)
        assert main(["bag", "play", str(path), "--json"]) == 0
        assert json.loads(capsys.readouterr().out)["messages"] == {"vehicle/state": 1}
        assert main(["bag", "play", str(path)]) == 0
        assert "1 message played" in capsys.readouterr().out
        assert main(["bag", "play", str(path), "--topics", ANSWER]) == 2
        assert f"living publishers of {ANSWER} (geometry)" in capsys.readouterr().err
