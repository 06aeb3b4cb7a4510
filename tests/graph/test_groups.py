"""Several nodes in one process: one falls, all fall and come back; one hangs, all are replaced; one ends, all end."""

from __future__ import annotations

import os
import re
import signal
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from benchmarks.live.processes import processes_of
from nodes.process.launch_file import LaunchFile, launch_from_mapping
from nodes.process.supervisor import Supervisor
from tests.graph.test_supervisor import _Log

pytestmark = pytest.mark.graph

TOY = "tests.graph.toy_nodes"
GROUP = {"process": "both"}


@pytest.fixture
def run_dir() -> Iterator[Path]:
    with tempfile.TemporaryDirectory(prefix="mw") as folder:
        yield Path(folder) / "run"
        assert processes_of(folder) == []


def launch(**nodes: dict[str, Any]) -> LaunchFile:
    entries = {name: {"module": TOY, "process": "both", **entry} for name, entry in nodes.items()}
    return launch_from_mapping({"name": "toy", "nodes": entries}, "toy.yaml")


def supervise(graph: LaunchFile, run_dir: Path, log: _Log, **options: Any) -> Supervisor:
    return Supervisor(graph, run_dir, runs_dir=run_dir.parent / "runs", on_log=log, **options)


def test_nodes_of_one_process_hear_each_other_and_end_with_the_one_that_ends(run_dir: Path) -> None:
    log = _Log()
    graph = launch(
        echo={"params": {"kind": "echo"}},
        tick={"params": {"ticks": 20, "text": "hello\n"}, "after": ["echo"], "ends_graph": True},
    )
    assert supervise(graph, run_dir, log).run() == 0
    assert log.count("both ready") == 1
    assert log.count("both has come to its end") == 1
    # what a library writes is of no node's thread
    assert [entry["node"] for entry in log.entries if entry["text"] == "hello"] == ["both"]


def test_a_node_that_fails_takes_its_group_down_and_all_come_back(run_dir: Path) -> None:
    log = _Log()
    graph = launch(
        alone={"params": {"kind": "echo"}, "process": ""},
        echo={"params": {"kind": "echo"}},
        crash={"params": {"kind": "crash", "after_s": 0.3}},
    )
    supervisor = supervise(graph, run_dir, log)
    log.rules = [("both ready", 2, supervisor.request_stop)]
    assert supervisor.run() == 0
    assert log.count("alone ready") == 1
    failed = [entry for entry in log.entries if "the toy is broken" in entry["text"] and entry["level"] == "critical"]
    assert failed[0]["node"] == "crash"
    said = [entry["text"] for entry in log.entries]
    assert log.count("both exited with code 1: RuntimeError: the toy is broken; restart in 0 s") == 1, said


def test_a_group_ends_of_what_failed_first(run_dir: Path) -> None:
    """A member that will not end with the one that failed is said, and is not the reason."""
    log = _Log()
    graph = launch(
        hang={"params": {"kind": "hang"}, "hang_timeout_s": 600, "restart": {"policy": "never"}},
        crash={"params": {"kind": "crash", "after_s": 0.3}, "hang_timeout_s": 600, "restart": {"policy": "never"}},
    )
    assert supervise(graph, run_dir, log).run() == 1
    assert log.count("hang did not end with the others") == 1
    said = [entry["text"] for entry in log.entries]
    assert log.count("both FAILED: RuntimeError: the toy is broken") == 1, said


def test_a_killed_group_is_back_with_all_its_nodes(run_dir: Path) -> None:
    log = _Log()
    supervisor = supervise(launch(echo={"params": {"kind": "echo"}}, tick={}), run_dir, log)
    log.rules = [
        ("both ready", 1, lambda: os.kill(log.pid("both"), signal.SIGKILL)),
        ("both ready", 2, supervisor.request_stop),
    ]
    assert supervisor.run() == 0
    assert log.count("both was ended by SIGKILL") == 1


def test_a_node_that_hangs_beside_one_that_works_is_noticed(run_dir: Path) -> None:
    log = _Log()
    graph = launch(
        tick={"hang_timeout_s": 2.0}, hang={"params": {"kind": "hang", "after_s": 0.1}, "hang_timeout_s": 2.0}
    )
    supervisor = supervise(graph, run_dir, log)
    log.rules = [("both ready", 2, supervisor.request_stop)]
    supervisor.run()
    assert log.count("both hangs") == 1


def test_one_that_will_not_end_cannot_keep_the_others(run_dir: Path) -> None:
    log = _Log()
    graph = launch(
        hang={"params": {"kind": "hang"}, "hang_timeout_s": 600},
        tick={"params": {"ticks": 5}, "ends_graph": True, "hang_timeout_s": 600},
    )
    supervisor = supervise(graph, run_dir, log)
    log.rules = [("did not end with the others", 1, supervisor.request_stop)]
    supervisor.run()
    assert log.count("hang did not end with the others") >= 1


def test_a_node_refused_refuses_its_group(run_dir: Path) -> None:
    log = _Log()
    assert supervise(launch(tick={}, wrong={"params": {"kind": "none"}}), run_dir, log).run() == 2
    refused = [entry for entry in log.entries if entry["level"] == "critical"]
    assert refused[0]["node"] == "wrong"
    assert re.search("toy.kind must be one of", refused[0]["text"])
