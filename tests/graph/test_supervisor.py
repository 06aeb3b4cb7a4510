"""The supervisor with real processes: restart, hang, back-off, clean end, and never an orphan."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import psutil
import pytest

from nodes.launch_file import LaunchFile, launch_from_mapping
from nodes.supervisor import Supervisor, read_lock

pytestmark = pytest.mark.graph

TOY = "tests.graph.toy_nodes"
ROOT = Path(__file__).parents[2]


@pytest.fixture
def run_dir(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    # short, because a socket's path has room for some hundred bytes
    import tempfile

    with tempfile.TemporaryDirectory(prefix="mw") as folder:
        yield Path(folder) / "run"
        assert _orphans(folder) == []


def _orphans(folder: str) -> list[int]:
    return [process.pid for process in psutil.process_iter(["cmdline"]) if folder in str(process.info["cmdline"])]


def _launch(**nodes: dict[str, Any]) -> LaunchFile:
    entries = {name: {"module": TOY, **entry} for name, entry in nodes.items()}
    return launch_from_mapping({"name": "toy", "nodes": entries}, "toy.yaml")


class _Log:
    """Collects a supervisor's log; a rule may act when a text appears for the n-th time."""

    def __init__(self) -> None:
        self.entries: list[dict[str, Any]] = []
        self.rules: list[tuple[str, int, Callable[[], None]]] = []

    def __call__(self, entry: dict[str, Any]) -> None:
        self.entries.append(entry)
        for text, count, act in self.rules:
            if text in entry["text"] and self.count(text) == count:
                act()

    def count(self, text: str) -> int:
        return sum(text in entry["text"] for entry in self.entries)

    def pid(self, name: str) -> int:
        said = [entry["text"] for entry in self.entries if entry["text"].startswith(f"{name} ready")]
        return int(said[-1].rpartition(" ")[2])


def _run(launch: LaunchFile, run_dir: Path, log: _Log | None = None, **options: Any) -> int:
    return Supervisor(launch, run_dir, runs_dir=run_dir.parent / "runs", on_log=log, **options).run()


def test_a_graph_ends_with_the_node_that_ends_it(run_dir: Path) -> None:
    log = _Log()
    launch = _launch(
        echo={"params": {"kind": "echo"}},
        tick={"params": {"ticks": 5, "text": "hello\n"}, "after": ["echo"], "ends_graph": True},
    )
    assert _run(launch, run_dir, log) == 0
    starts = [entry["text"].split()[0] for entry in log.entries if " ready after" in entry["text"]]
    assert starts == ["echo", "tick"]
    run_folder = run_dir.parent / "runs" / "toy-1"
    entries = [json.loads(line) for line in (run_folder / "log.jsonl").read_text().splitlines()]
    assert any((entry["node"], entry["text"]) == ("tick", "hello") for entry in entries)
    assert (run_folder / "launch.yaml").is_file()


def test_a_killed_node_is_restarted_and_the_others_stay(run_dir: Path) -> None:
    log = _Log()
    launch = _launch(echo={"params": {"kind": "echo"}}, tick={"after": ["echo"]})
    supervisor = Supervisor(launch, run_dir, runs_dir=run_dir.parent / "runs", on_log=log)
    log.rules = [
        ("tick ready", 1, lambda: os.kill(log.pid("tick"), signal.SIGKILL)),
        ("tick ready", 2, supervisor.request_stop),
    ]
    assert supervisor.run() == 0
    assert log.count("tick was ended by SIGKILL") == 1
    assert log.count("echo ready") == 1


def test_a_hanging_node_is_killed_and_restarted(run_dir: Path) -> None:
    log = _Log()
    launch = _launch(hang={"params": {"kind": "hang"}, "hang_timeout_s": 1.0})
    supervisor = Supervisor(launch, run_dir, runs_dir=run_dir.parent / "runs", on_log=log)
    # twice: a hanging node takes no notice of the first request
    log.rules = [("hang ready", 2, lambda: (supervisor.request_stop(), supervisor.request_stop())[0])]
    supervisor.run()
    assert log.count("hang hangs: no heartbeat for 1 s") == 1


def test_a_node_that_keeps_crashing_fails_for_good(run_dir: Path) -> None:
    log = _Log()
    restart = {"delay_s": 0.05, "max_restarts": 2}
    assert _run(_launch(crash={"params": {"kind": "crash"}, "restart": restart}), run_dir, log) == 1
    assert log.count("restart in") == 2
    assert log.count("crash FAILED: RuntimeError: the toy is broken") == 1
    assert any("Traceback" in entry.get("traceback", "") for entry in log.entries)


def test_wrong_parameters_are_not_tried_again(run_dir: Path) -> None:
    log = _Log()
    assert _run(_launch(tick={"params": {"ticks": "x"}}), run_dir, log) == 2
    assert log.count("restart in") == 0
    assert log.count("tick FAILED: tick.params.ticks: Expected int, got str") == 1


def test_duration_counts_from_ready_and_one_shots_end_the_graph(run_dir: Path) -> None:
    log = _Log()
    assert _run(_launch(tick={}), run_dir, log, duration_s=0.2) == 0
    assert log.count("0.2 s are over") == 1
    log = _Log()
    launch = _launch(once={"params": {"ticks": 1}, "restart": {"policy": "never"}}, echo={"params": {"kind": "echo"}})
    assert _run(launch, run_dir, log) == 0
    assert log.count("all nodes that run once have ended") == 1


def test_two_graphs_do_not_share_a_directory(run_dir: Path) -> None:
    log = _Log()
    seen: list[str] = []

    def second() -> None:
        with pytest.raises(OSError, match="a graph runs here already, pid") as caught:
            _run(_launch(tick={}), run_dir)
        seen.append(str(caught.value))

    supervisor = Supervisor(_launch(tick={}), run_dir, runs_dir=run_dir.parent / "runs", on_log=log)
    log.rules = [("tick ready", 1, lambda: (second(), supervisor.request_stop())[0])]
    assert supervisor.run() == 0
    assert seen[0].endswith(str(os.getpid()))
    assert read_lock(run_dir) == {}


_SCRIPT = """
import sys
from pathlib import Path
from nodes.launch_file import read_launch_file
from nodes.supervisor import Supervisor
folder = Path(sys.argv[1])
say = lambda entry: print(entry["text"], flush=True)
sys.exit(Supervisor(read_launch_file(folder / "toy.yaml"), folder / "run", runs_dir=folder / "runs", on_log=say).run())
"""


@pytest.mark.parametrize("numbers", [[signal.SIGINT], [signal.SIGINT, signal.SIGINT], [signal.SIGKILL]])
def test_no_process_is_left_behind(run_dir: Path, numbers: list[signal.Signals]) -> None:
    from nodes.launch_file import dump_launch

    folder = run_dir.parent
    hang = {"params": {"kind": "hang", "after_s": 0.1}, "after": ["tick"]}
    launch = _launch(tick={}, **({"hang": hang} if len(numbers) > 1 else {}))
    (folder / "toy.yaml").write_text(dump_launch(launch))
    command = [sys.executable, "-c", _SCRIPT, str(folder)]
    with subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, text=True) as process:
        guard = threading.Timer(20.0, process.kill)
        guard.start()
        assert process.stdout is not None
        ready = 0
        while ready < len(launch.nodes):
            line = process.stdout.readline()
            assert line, "the supervisor ended before its nodes were ready"
            ready += " ready after " in line
        time.sleep(0.3)
        for number in numbers:
            process.send_signal(number)
            time.sleep(0.1)
        process.stdout.read()
        process.wait()
        guard.cancel()
    deadline_s = time.monotonic() + 5.0
    while _orphans(str(folder)) and time.monotonic() < deadline_s:
        time.sleep(0.02)
    assert _orphans(str(folder)) == []
    assert process.returncode == (-signal.SIGKILL if signal.SIGKILL in numbers else 0)
