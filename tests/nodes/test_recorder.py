"""The recorder: never over what exists, in parts, in snapshots, and what it does when the disk refuses."""

from __future__ import annotations

import json
import math
import secrets
from datetime import datetime
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

from msgs.bus.local import LocalNetwork
from msgs.bus.topics import TOPICS
from msgs.recording import mcap_writer as mcap_file
from msgs.recording.mcap import RAW_TOPIC, Losses, RecordingReader, TopicLoss, info
from msgs.values.diagnostics import LogRecord, NodeState
from msgs.values.vehicle import VehicleState
from nodes.node import InProcessGraph
from nodes.recorder import Params, Recorder, create
from nodes.recording.snapshot_recorder import Ring, SnapshotRecorder
from nodes.recording.snapshot_trigger import TriggerFile, find_recorders
from tests.graph import toy_nodes
from tests.msgs.bus.test_codec import EXAMPLES

TOPICS_HEARD = ("radar/setup", "vehicle/state")


def _record(path: Path) -> None:
    tick = toy_nodes.create(toy_nodes.Params(ticks=4))
    recorder = create(Params(path=str(path), metadata={"launch": "x"}))
    graph = InProcessGraph(LocalNetwork(), {"tick": tick, "recorder": recorder})
    graph.run()
    graph.close()


def test_what_was_sent_is_in_the_recording(tmp_path: Path) -> None:
    _record(tmp_path / "a.mcap")
    with RecordingReader(tmp_path / "a.mcap") as reader:
        messages = list(reader.messages())
        assert reader.metadata["launch"] == "x"
        assert reader.complete
    assert [message.message.speed_mps for message in messages] == [1.0, 2.0, 3.0, 4.0]
    assert {(message.topic, message.publisher) for message in messages} == {("vehicle/state", "tick")}


def test_names_that_are_no_utf8(tmp_path: Path) -> None:
    """Of the file, and in what the recorder writes about the run."""
    path = tmp_path / "r\udcfc.mcap"
    recorder = create(Params(path=str(path), metadata={"launch": "/k\udcfc.yaml"}))
    recorder.close()
    with RecordingReader(path) as reader:
        assert reader.metadata["launch"] == "/k\\xfc.yaml"


def test_a_recording_that_cannot_begin_leaves_no_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object) -> None:
        raise OSError(28, "no space")

    monkeypatch.setattr(mcap_file.McapFile, "add_metadata", refuse)
    with pytest.raises(OSError, match="no space"):
        create(Params(path=str(tmp_path / "a.mcap")))
    assert list(tmp_path.iterdir()) == []


def test_a_restarted_recorder_writes_beside_the_first(tmp_path: Path) -> None:
    _record(tmp_path / "a.mcap")
    first = (tmp_path / "a.mcap").read_bytes()
    _record(tmp_path / "a.mcap")
    assert (tmp_path / "a.mcap").read_bytes() == first
    assert (tmp_path / "a-2.mcap").is_file()


def test_raw_beams_only_when_asked_for() -> None:
    assert RAW_TOPIC not in Params(path="x").selected_topics()
    assert set(Params(path="x", raw=True).selected_topics()) == set(TOPICS)
    assert Params(path="x", topics=("log",)).selected_topics() == ("log",)
    with pytest.raises(ValueError, match="unknown topic 'nope'"):
        Params(path="x", topics=("nope",))


@pytest.mark.parametrize(
    ("params", "rule"),
    [
        ({"split_bytes": 0}, "split_bytes must be above zero and below 1e.18, got 0"),
        ({"split_s": math.nan}, "split_s must be above zero and below 1e.18, got nan"),
        ({"snapshot_s": 1e300}, "snapshot_s must be above zero and below"),
        ({"split_bytes": 10**400}, "split_bytes must be above zero and below"),
        ({"max_parts": 3}, "max_parts needs split_bytes or split_s"),
        ({"snapshot_s": -1.0}, "snapshot_s must be above zero"),
        ({"snapshot_s": 5.0, "split_s": 1.0}, "snapshot_s must not stand beside"),
        ({"min_free_bytes": -1}, "min_free_bytes must not be negative"),
    ],
)
def test_params_that_do_not_fit_are_refused(params: dict[str, Any], rule: str) -> None:
    with pytest.raises(ValueError, match=rule):
        Params(path="a.mcap", **params)
    # the disk may be filled
    assert Params(path="a.mcap", min_free_bytes=0).min_free_bytes == 0


class Bench:
    """A recorder on an in-process network, and a car and a radar that send to it."""

    def __init__(self, path: Path, *, topics: tuple[str, ...] = TOPICS_HEARD, **params: Any) -> None:
        self.network = LocalNetwork()
        self.recorder: Any = (SnapshotRecorder if "snapshot_s" in params else Recorder)(
            Params(path=str(path), topics=topics, **params)
        )
        self.bus, self.sender = self.network.bus("recorder"), self.network.bus("car")
        for topic in topics:
            self.bus.subscribe(topic)
        self.recorder.counts = lambda: self.bus.counts()[0]

    def say(self, topic: str, message: Any) -> None:
        """Send a message, 0.1 s after the one before, and let the recorder have it."""
        self.network.advance(100_000_000)
        self.sender.publish(topic, message)
        self.step()

    def step(self) -> None:
        self.recorder.step(self.bus.receive(0.0), self.network.now_ns)

    def states(self, count: int) -> None:
        for number in range(count):
            self.say("vehicle/state", VehicleState(stamp_ns=number))


def _contents(path: Path) -> list[tuple[str, int]]:
    with RecordingReader(path) as reader:
        assert reader.complete
        return [(message.topic, message.sequence) for message in reader.messages()]


def test_split_by_time_each_part_opens_alone(tmp_path: Path) -> None:
    """Radar set-up, said once, stands at the start of each part, as if sent then; no state is lost between parts."""
    bench = Bench(tmp_path / "a.mcap", split_s=1.0)
    bench.say("radar/setup", EXAMPLES["radar/setup"][0])
    bench.states(25)
    bench.recorder.close()
    parts = sorted(tmp_path.iterdir())
    assert [part.name for part in parts] == ["a-00001.mcap", "a-00002.mcap", "a-00003.mcap"]
    sequences = []
    for number, part in enumerate(parts):
        found = info(part)
        assert (found.checksums_agree, found.losses) == (True, Losses())
        assert found.metadata["part"] == str(number + 1)
        assert found.duration_s <= 1.0
        (first, *others) = _contents(part)
        assert first == ("radar/setup", 0)
        sequences += [sequence for _, sequence in others]
    assert sequences == list(range(25))
    assert (bench.recorder.messages, bench.recorder.missed) == (28, 0)


def test_split_by_size_keeps_the_newest_parts(tmp_path: Path) -> None:
    bench = Bench(tmp_path / "a.mcap", topics=("log",), split_bytes=20_000, max_parts=3)
    rng = np.random.default_rng(3)
    for number in range(40):
        bench.say("log", LogRecord(stamp_ns=number, node="a", level="info", text=rng.bytes(1500).hex()))
    bench.recorder.close()
    parts = sorted(tmp_path.iterdir())
    assert len(parts) == 3
    assert parts == bench.recorder.paths
    assert parts[0].name > "a-00001.mcap"
    assert [sequence for part in parts for _, sequence in _contents(part)][-1] == 39
    # what is in progress counts before it is compressed, and the index comes on top
    assert all(part.stat().st_size < 25_000 for part in parts)


def test_parts_of_an_earlier_run_are_kept(tmp_path: Path) -> None:
    for _ in range(2):
        bench = Bench(tmp_path / "a.mcap", split_s=0.5, max_parts=1)
        bench.states(8)
        bench.recorder.close()
    assert [path.name for path in sorted(tmp_path.iterdir())] == ["a-00002.mcap", "a-00004.mcap"]


def test_a_snapshot_holds_the_last_seconds_and_what_was_said_before(tmp_path: Path) -> None:
    """Three triggers, three files; set-up that fell out of the ring long ago is in each."""
    bench = Bench(tmp_path / "s.mcap", snapshot_s=1.0, metadata={"launch": "x"})
    bench.say("radar/setup", EXAMPLES["radar/setup"][0])
    for _ in range(3):
        bench.states(20)
        bench.recorder.trigger()
        assert bench.recorder.pending()
        bench.step()
        bench.recorder._writing.join()
    bench.recorder.close()
    for number in (1, 2, 3):
        contents = _contents(tmp_path / f"s-0000{number}.mcap")
        # a second of one message each 0.1 s, both ends included
        assert contents == [("radar/setup", 0)] + [("vehicle/state", 20 * number - at) for at in range(11, 0, -1)]
        found = info(tmp_path / f"s-0000{number}.mcap")
        assert (found.duration_s, found.losses) == (pytest.approx(1.0), Losses())
        assert found.metadata["launch"] == "x"
    assert len(list(tmp_path.iterdir())) == 3


def test_the_ring_is_bounded_in_bytes(tmp_path: Path) -> None:
    bench = Bench(tmp_path / "s.mcap", topics=("log",), snapshot_s=1000.0)
    bench.recorder._ring = Ring(10**12, 10_000)
    for number in range(50):
        bench.say("log", LogRecord(stamp_ns=number, node="a", level="info", text="x" * 1000))
        assert bench.recorder._ring.bytes <= 10_000
    bench.recorder.trigger()
    bench.step()
    bench.recorder.close()
    assert [sequence for _, sequence in _contents(tmp_path / "s-00001.mcap")] == list(range(43, 50))


def test_a_snapshot_without_room_says_so_and_the_next_may_work(tmp_path: Path) -> None:
    bench = Bench(tmp_path / "s.mcap", snapshot_s=1.0, min_free_bytes=1 << 60, run_dir=str(tmp_path / "run"))
    bench.recorder._door = TriggerFile(tmp_path / "run")
    bench.states(3)
    bench.recorder.trigger()
    bench.step()
    bench.recorder._writing.join()
    assert bench.recorder.health()[0] is NodeState.DEGRADED
    (door,) = find_recorders(tmp_path / "run")
    assert "are to stay free" in json.loads(door.read_text())["last"]["error"]
    assert not list(tmp_path.glob("*.mcap"))
    bench.recorder.close()
    assert find_recorders(tmp_path / "run") == []


def test_what_the_bus_lost_is_in_the_recording(tmp_path: Path) -> None:
    bench = Bench(tmp_path / "a.mcap", split_s=1.0)
    bench.states(3)
    # numbers that never reach the recorder
    known = bench.bus._tally._last["vehicle/state"]
    known["car"] = msgspec.structs.replace(known["car"], sequence=0)
    bench.states(20)
    bench.recorder.close()
    first, *others = sorted(tmp_path.iterdir())
    losses = info(first).losses
    assert losses is not None
    assert losses.topics == (TopicLoss(topic="vehicle/state", lost=2),)
    assert [info(part).losses for part in others] == [Losses()] * len(others)
    assert bench.recorder.lost == 2


def test_a_disk_that_refuses_degrades_the_node(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What the disk did not take is counted, also what waited in the chunk; the file is whole up to there."""
    bench = Bench(tmp_path / "a.mcap")
    bench.states(15)

    def refuse(*arguments: object) -> None:
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(mcap_file, "_write_all", refuse)
        bench.states(12)
    bench.states(3)
    state, reason = bench.recorder.health()
    assert state is NodeState.DEGRADED
    assert f"No space left on device; {bench.recorder.missed} messages missed" in reason
    bench.recorder.close()
    with RecordingReader(tmp_path / "a.mcap") as reader:
        kept = [message.sequence for message in reader.messages()]
    assert kept == list(range(len(kept)))
    assert len(kept) >= 10
    assert bench.recorder.messages == len(kept)
    assert bench.recorder.messages + bench.recorder.missed == 30


def test_too_little_room_ends_the_recording_before_it_is_used(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """Warned before; at no time, and not with its index, does the file leave less than was to stay free."""
    path, kept = tmp_path / "a.mcap", 2_000_000
    disk = kept + 200_000
    seen: list[int] = []

    def free_bytes(folder: Path) -> int:
        seen.append(disk - (512 * path.stat().st_blocks if path.exists() else 0))
        return seen[-1]

    monkeypatch.setattr("nodes.recorder.free_bytes", free_bytes)
    bench = Bench(path, topics=("log", "vehicle/state"), min_free_bytes=kept)
    for _ in range(200):
        # a second of it is a chunk, written at once: it does not compress
        bench.say("log", LogRecord(stamp_ns=0, node="a", level="info", text=secrets.token_hex(1500)))
        bench.states(1)
    assert bench.recorder.health()[0] is NodeState.DEGRADED
    assert "room for less than 60 s" in caplog.text
    bench.recorder.close()
    assert disk - 512 * path.stat().st_blocks >= kept
    assert min(seen) >= kept
    # and it does not stop long before: a chunk in progress and the index were to find room
    assert path.stat().st_size > 60_000
    found = info(path)
    assert (found.complete, found.checksums_agree, found.loss) == (True, True, None)
    assert found.losses is not None
    assert "are to stay free" in str(found.losses.ended)
    counted = {topic.topic: topic.messages for topic in found.topics}
    missed = {topic.topic: topic.missed for topic in found.losses.topics}
    assert {topic: counted[topic] + missed[topic] for topic in ("log", "vehicle/state")} == {
        "log": 200,
        "vehicle/state": 200,
    }
    assert sum(missed.values()) == bench.recorder.missed


@pytest.mark.parametrize(("size", "missed"), [(100, 0), (20_000, 1)])
def test_a_message_finds_room_for_itself_or_is_missed(
    size: int, missed: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    bench = Bench(tmp_path / "a.mcap", topics=("log",), min_free_bytes=1_000_000)
    free = 1_000_000 + bench.recorder._writer.growth_bytes() + 10_000
    monkeypatch.setattr("nodes.recorder.free_bytes", lambda folder: free)
    bench.say("log", LogRecord(stamp_ns=0, node="a", level="info", text=secrets.token_hex(size // 2)))
    assert bench.recorder.missed == missed
    bench.recorder.close()


def test_what_came_after_the_end_is_in_the_file_where_there_is_room_for_that(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The file was finished before; where it cannot grow it stays as it was."""
    for name, has_room in (("a", True), ("b", False)):
        bench = Bench(tmp_path / f"{name}.mcap")
        bench.states(12)
        with monkeypatch.context() as patch:
            patch.setattr("nodes.recorder.free_bytes", lambda folder: 0)
            bench.states(1)
        before = info(tmp_path / f"{name}.mcap")
        bench.states(4)

        def refuse(*arguments: object) -> None:
            raise OSError(28, "No space left on device")

        with monkeypatch.context() as patch:
            if not has_room:
                patch.setattr("os.posix_fallocate", refuse)
            bench.recorder.close()
        found = info(tmp_path / f"{name}.mcap")
        assert (found.complete, found.checksums_agree, found.loss) == (True, True, None)
        assert found.topics == before.topics
        assert before.losses is not None
        assert found.losses is not None
        assert found.losses.ended == before.losses.ended
        missed = [topic.missed for topic in found.losses.topics if topic.topic == "vehicle/state"]
        assert missed == ([5] if has_room else [])


def test_the_next_part_may_find_no_room(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    bench = Bench(tmp_path / "a.mcap", split_s=1.0)
    bench.states(5)

    def refuse(*arguments: object, **named: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("nodes.recorder.RecordingWriter", refuse)
    bench.states(10)
    bench.recorder.close()
    assert bench.recorder.refused
    assert (bench.recorder.messages, bench.recorder.missed) == (10, 5)
    assert len(_contents(tmp_path / "a-00001.mcap")) == 10


def test_the_machine_and_the_time_are_in_the_metadata(tmp_path: Path) -> None:
    _record(tmp_path / "a.mcap")
    metadata = info(tmp_path / "a.mcap").metadata
    machine = json.loads(metadata["machine"])
    assert machine["cores"] >= 1
    assert machine["packages"]["mcap"]
    assert datetime.fromisoformat(metadata["started_utc"]).tzinfo is not None
