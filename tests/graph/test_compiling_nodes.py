"""Nodes that had to compile leave the compiler behind: they start again before they are ready, once."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest

from benchmarks.live.processes import processes_of
from nodes.process.interpreter import COMPILED
from nodes.process.launch_file import launch_from_mapping
from nodes.process.supervisor import Supervisor
from tests.graph.test_supervisor import _Log

pytestmark = pytest.mark.graph

WITH, WITHOUT = "made with the compiler", "made from the cache"


@pytest.fixture
def folder(monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A short one, since a socket's path has room for some hundred bytes; kernels are kept in it."""
    with tempfile.TemporaryDirectory(prefix="mw") as name:
        monkeypatch.setenv("NUMBA_CACHE_DIR", f"{name}/kernels")
        yield Path(name)
        assert processes_of(name) == []


def made(folder: Path, process: str) -> list[str]:
    """Run a graph until its node is ready; return what it said of each time that it was made."""
    log = _Log()
    entry = {"module": "tests.graph.toy_kernel", "process": process}
    graph = launch_from_mapping({"name": "toy", "nodes": {"toy": entry}}, "toy.yaml")
    supervisor = Supervisor(graph, folder / "run", runs_dir=folder / "runs", on_log=log)
    log.rules = [(f"{process or 'toy'} ready", 1, supervisor.request_stop)]
    assert supervisor.run() == 0
    assert log.count("restart in") == log.count("exited") == 0
    return [entry["text"] for entry in log.entries if entry["text"] in (WITH, WITHOUT)]


@pytest.mark.parametrize("process", ["", "both"], ids=["process", "group"])
def test_a_node_that_compiled_is_made_again_from_the_cache(folder: Path, process: str) -> None:
    assert made(folder, process) == [WITH, WITHOUT]
    assert made(folder, process) == [WITHOUT]


def test_a_node_that_cannot_keep_its_kernels_is_not_started_for_ever(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(COMPILED, "1")
    assert made(folder, "") == [WITH]
