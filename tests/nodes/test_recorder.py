"""The recorder writes what it hears, never over what exists, and outlives a disk that refuses."""

from __future__ import annotations

from pathlib import Path

import pytest

from msgs.diagnostics import NodeState
from msgs.local_bus import LocalNetwork
from msgs.recording import RecordingReader
from msgs.topics import TOPICS
from msgs.vehicle import VehicleState
from nodes.node import InProcessGraph
from nodes.recorder import RAW_TOPIC, Params, create
from tests.graph import toy_nodes


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


def test_a_restarted_recorder_writes_beside_the_first(tmp_path: Path) -> None:
    _record(tmp_path / "a.mcap")
    first = (tmp_path / "a.mcap").read_bytes()
    _record(tmp_path / "a.mcap")
    assert (tmp_path / "a.mcap").read_bytes() == first
    assert (tmp_path / "a-2.mcap").is_file()


def test_raw_beams_only_when_asked_for() -> None:
    assert RAW_TOPIC not in Params(path="x").chosen_topics()
    assert set(Params(path="x", raw=True).chosen_topics()) == set(TOPICS)
    assert Params(path="x", topics=("log",)).chosen_topics() == ("log",)
    with pytest.raises(ValueError, match="unknown topic 'nope'"):
        Params(path="x", topics=("nope",))


def test_a_disk_that_refuses_degrades_the_node(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    network = LocalNetwork()
    recorder = create(Params(path=str(tmp_path / "a.mcap"), topics=("vehicle/state",)))
    bus, sender = network.bus("recorder"), network.bus("sender")
    bus.subscribe("vehicle/state")

    def refuse(*arguments: object, **named: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(recorder._writer, "write", refuse)
    for stamp_ns in range(3):
        sender.publish("vehicle/state", VehicleState(stamp_ns=stamp_ns))
        network.advance(1)
    recorder.step(bus.receive(0.0), 0)
    state, reason = recorder.health()
    assert state is NodeState.DEGRADED
    assert "No space left on device; 3 messages missed" in reason
    recorder.close()
