"""What processes say: bounded, of their own name, harmless to a terminal, for their owner's eyes, and never fatal."""

from __future__ import annotations

import json
import logging
from pathlib import Path

import pytest

from msgs.bus.local import LocalNetwork
from nodes.node import Heartbeat, NodeState
from nodes.process.logs import LINES_AT_ONCE, LINES_PER_S, BusLogHandler, JsonLog, LineSplitter, parse_line

FORGED = (
    ('{"text": "x"}', "output", "x"),
    ('{"text": "x", "level": ["a"], "node": ["b"], "time": 1}', "output", "x"),
    ('{"text": "x", "level": "info", "node": "supervisor"}', "info", "x"),
    ('{"text": "\\u001b[2J\\u009b1mred\\ud800", "level": "info"}', "info", "[2J1mred"),
    ('{"text": "a\\n[supervisor] all is well", "level": "info"}', "info", "a\n    [supervisor] all is well"),
)


@pytest.mark.parametrize(("record", "level", "text"), FORGED)
def test_a_record_speaks_for_its_own_node_and_steers_no_terminal(record: str, level: str, text: str) -> None:
    entry = parse_line("radar", f"\x1e{record}")
    assert (entry["node"], entry["level"], entry["text"]) == ("radar", level, text)
    assert isinstance(entry["time"], str)
    entry["text"].encode()


@pytest.mark.parametrize(
    "junk", ["[" * 60_000, '{"a":' * 10_000, '{"text": 1}', "[1]", "", '{"text": "x"', "9" * 60_000]
)
def test_a_record_that_is_none_is_text(junk: str) -> None:
    entry = parse_line("radar", f"\x1e{junk}")
    assert (entry["level"], entry["text"]) == ("output", junk)


def test_a_flood_of_lines_is_left_out_and_said() -> None:
    """What passes is bounded by the clock alone; a state, on which the graph's start hangs, always passes."""
    now_s = 0.0
    splitter = LineSplitter(clock=lambda: now_s)
    lines = [line for _ in range(20) for line in splitter.feed(b"x\n" * 10_000)]
    assert len(lines) == LINES_AT_ONCE
    assert splitter.feed(b'\x1e{"text": "ready", "state": "ready"}\n') == ['\x1e{"text": "ready", "state": "ready"}']
    now_s = 1.0
    lines = splitter.feed(b"y\n" * 10_000)
    assert lines[:2] == [f"({200_000 - LINES_AT_ONCE} lines left out: more than {LINES_PER_S} a second)", "y"]
    assert len(lines) == LINES_PER_S + 1
    assert splitter.finish() == [f"({10_000 - LINES_PER_S} lines left out: more than {LINES_PER_S} a second)"]


def test_a_line_without_end_takes_no_memory() -> None:
    splitter = LineSplitter(limit=1000)
    for _ in range(5000):
        assert all(len(line) <= 1000 for line in splitter.feed(b"\x00\xff" * 500))
        assert len(splitter._rest) < 1000


def test_the_log_is_for_its_owner_alone_and_bounded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("nodes.process.logs._FILE_BYTES", 1000)
    log = JsonLog(tmp_path / "log.jsonl")
    for number in range(500):
        log.write({"text": str(number)})
    log.close()
    files = sorted(tmp_path.iterdir())
    assert len(files) == 4
    assert all(path.stat().st_mode & 0o777 == 0o600 and path.stat().st_size <= 1000 for path in files)
    assert json.loads((tmp_path / "log.jsonl").read_text().splitlines()[-1]) == {"text": "499"}


def test_a_full_disk_costs_lines_and_no_graph() -> None:
    log = JsonLog(Path("/dev/full"))
    for _ in range(3):
        log.write({"text": "x" * 100_000})
    log.close()
    assert log.lost == 3


def test_a_folder_that_has_gone_costs_lines_and_no_graph(tmp_path: Path) -> None:
    log = JsonLog(tmp_path / "gone" / "log.jsonl")
    log.write({"text": "x"})
    log.close()
    assert log.lost == 1


def test_what_is_not_for_all_is_not_on_the_bus() -> None:
    """And what cannot travel, half a character of a file name, does not end the node that says it."""
    network = LocalNetwork()
    listener = network.bus("listener")
    listener.subscribe("log")
    handler = BusLogHandler("x")
    secret = logging.LogRecord("n", logging.INFO, "", 0, "open http://127.0.0.1/secret/", None, None)
    secret.in_public = "page at port 1"
    handler.emit(secret)
    handler.emit(logging.LogRecord("n", logging.INFO, "", 0, "read a\udcff.mcap", None, None))
    Heartbeat(network.bus("x"), "x", handler).beat(NodeState.READY)
    assert [one.message.text for one in listener.receive(0.0)] == ["page at port 1", "read a\\xff.mcap"]


def test_a_group_s_record_is_of_the_node_it_names_and_of_no_other() -> None:
    assert parse_line("both", '\x1e{"text": "t", "node": "a"}', ["a", "b"])["node"] == "a"
    assert parse_line("both", '\x1e{"text": "t", "node": "supervisor"}', ["a", "b"])["node"] == "both"
    assert parse_line("both", '\x1e{"text": "t", "node": ["a"]}', ["a", "b"])["node"] == "both"
