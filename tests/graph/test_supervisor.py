"""The supervisor with real processes: restart, hang, back-off, clean end, and never an orphan."""

from __future__ import annotations

import contextlib
import json
import math
import os
import re
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from benchmarks.live.processes import processes_of
from msgs.files.shipped import CHECKOUT
from msgs.values.node_params import ParamRequest
from nodes.process.launch_file import LaunchFile, launch_from_mapping
from nodes.process.liveness import Sample, sample
from nodes.process.supervisor import Supervisor, read_lock

pytestmark = pytest.mark.graph

TOY = "tests.graph.toy_nodes"
ROOT = CHECKOUT
#: Nothing is measured against this: it ends a test that would wait for ever.
PATIENCE_S = 120.0


@pytest.fixture
def run_dir(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    # short, because a socket's path has room for some hundred bytes
    import tempfile

    with tempfile.TemporaryDirectory(prefix="mw") as folder:
        yield Path(folder) / "run"
        assert processes_of(folder) == []


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
        return self.pids(name)[-1]

    def pids(self, name: str) -> list[int]:
        """Processes of a node that were ready, the oldest first."""
        said = [entry["text"] for entry in self.entries if entry["text"].startswith(f"{name} ready")]
        return [int(text.rpartition(" ")[2]) for text in said]


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


def test_a_graph_that_holds_goes_on_after_the_node_that_ends_it(run_dir: Path) -> None:
    """Until it is asked to end; meanwhile that node can be started again."""
    log = _Log()
    launch = _launch(
        echo={"params": {"kind": "echo"}}, tick={"params": {"ticks": 1}, "after": ["echo"], "ends_graph": True}
    )
    supervisor = Supervisor(launch, run_dir, runs_dir=run_dir.parent / "runs", on_log=log, holds=True)
    request = ParamRequest(stamp_ns=0, request="again", node="supervisor", changes='{"tick": {}}')
    log.rules = [
        ("the page keeps the last view until Ctrl-C", 1, lambda: supervisor._begin_restart(request)),
        ("the page keeps the last view until Ctrl-C", 2, supervisor.request_stop),
    ]
    assert supervisor.run() == 0
    assert len(log.pids("tick")) == 2
    assert log.count("stopping: asked to") == 1


def test_nodes_get_ready_side_by_side_and_begin_in_order(run_dir: Path) -> None:
    """The one that comes after lives while the one before is still being made, and begins when it is ready."""
    log = _Log()
    launch = _launch(
        echo={"params": {"kind": "echo", "start_s": 2.0}},
        tick={"params": {"ticks": 5}, "after": ["echo"], "ends_graph": True},
    )
    assert _run(launch, run_dir, log) == 0
    took_s = {
        name: float(found[1])
        for entry in log.entries
        for name in launch.nodes
        if (found := re.match(rf"{name} ready after ([0-9.]+) s", entry["text"]))
    }
    assert list(took_s) == ["echo", "tick"]
    # counted from the start of its own process
    assert took_s["tick"] >= 2.0


def test_a_recorder_is_ready_before_the_others_start(run_dir: Path) -> None:
    log = _Log()
    recorder = {"module": "nodes.recorder", "params": {"path": str(run_dir.parent / "a.mcap")}}
    launch = _launch(recorder=recorder, tick={"params": {"ticks": 5}, "after": ["recorder"], "ends_graph": True})
    supervisor = Supervisor(launch, run_dir, runs_dir=run_dir.parent / "runs", on_log=log)
    started: list[bool] = []
    log.rules = [("recorder ready", 1, lambda: started.append(supervisor._nodes["tick"].child is not None))]
    assert supervisor.run() == 0
    assert started == [False]


def test_a_graph_goes_on_without_its_fork_server(run_dir: Path) -> None:
    log = _Log()
    launch = _launch(echo={"params": {"kind": "echo"}}, tick={"after": ["echo"]})
    supervisor = Supervisor(launch, run_dir, runs_dir=run_dir.parent / "runs", on_log=log)

    def kill_both() -> None:
        assert supervisor._server is not None
        for pid in (supervisor._server._pid, log.pid("tick")):
            os.kill(pid or 0, signal.SIGKILL)

    log.rules = [("tick ready", 1, kill_both), ("tick ready", 2, supervisor.request_stop)]
    assert supervisor.run() == 0
    assert log.count("nodes are started without the fork server from now on: ") == 1
    assert log.count("tick was ended by SIGKILL") == 1


def test_a_terminal_that_goes_is_one_request_to_stop(run_dir: Path) -> None:
    """Shell and kernel both send SIGHUP; a second request would kill the recorder."""
    supervisor = Supervisor(_launch(tick={}), run_dir)
    with supervisor._signals():
        for number, requests in ((signal.SIGHUP, 1), (signal.SIGHUP, 1), (signal.SIGINT, 2)):
            signal.raise_signal(number)
            assert supervisor._stop_requests == requests


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


@pytest.mark.parametrize(
    ("kind", "timeout_s", "reason"),
    [
        # a stopped and a blocked process are given a fifth and a half of the time
        ("tick", 4.0, r"stopped for \d+\.\d s"),
        ("hang", 1.6, r"blocked for \d+\.\d s"),
        ("busy", 1.0, "silent for 1 s, it is busy"),
    ],
)
def test_a_silent_node_is_replaced_by_what_it_is_at(
    kind: str, timeout_s: float, reason: str, run_dir: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    log = _Log()

    def with_a_core(pid: int) -> Sample:
        """As on a machine of its own: the time in which a busy node waits for a core is not held against it."""
        is_busy = kind == "busy" and pid in log.pids("toy")
        now_s = time.monotonic()
        return Sample(now_s, "R", cpu_s=now_s, waited_s=0.0) if is_busy else sample(pid)

    monkeypatch.setattr("nodes.process.supervisor.sample", with_a_core)
    launch = _launch(
        echo={"params": {"kind": "echo"}},
        toy={"params": {"kind": kind}, "hang_timeout_s": timeout_s, "after": ["echo"]},
    )
    supervisor = Supervisor(launch, run_dir, runs_dir=run_dir.parent / "runs", on_log=log)
    log.rules = [
        # three times: a hanging node takes no notice of the first request, and the second only asks for patience
        ("toy ready", 2, lambda: [supervisor.request_stop() for _ in range(3)].clear()),
        ("toy ready", 1, lambda: os.kill(log.pid("toy"), signal.SIGSTOP if kind == "tick" else 0)),
    ]
    supervisor.run()
    said = [entry["text"] for entry in log.entries if entry["text"].startswith("toy hangs: ")]
    assert len(said) == 1
    assert re.fullmatch(f"toy hangs: {reason}", said[0])
    assert log.count("toy was ended by SIGKILL") == 1
    assert log.count("echo ready") == 1


#: Its heartbeat comes late each time.
SLOW = {"params": {"kind": "pause", "after_s": 1.5, "period_s": 0.01}, "hang_timeout_s": 600.0}


def test_a_silence_is_said_before_anybody_is_killed_for_it(run_dir: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """And what the node is at: blocked, where it does not just wait for a core."""
    monkeypatch.setattr("nodes.process.supervisor._SILENCE_INTERVAL_S", 0.0)
    log = _Log()
    supervisor = Supervisor(_launch(slow=SLOW), run_dir, runs_dir=run_dir.parent / "runs", on_log=log)
    answers = "slow answers again after"

    def stop_after_the_next_answer() -> None:
        log.rules.append((answers, log.count(answers) + 1, supervisor.request_stop))

    log.rules = [("it is blocked", 1, stop_after_the_next_answer)]
    assert supervisor.run() == 0
    assert log.count("slow has not answered for") > 0
    assert log.count("hangs") == 0


def test_a_silence_is_said_once(run_dir: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("nodes.process.supervisor._SILENCE_INTERVAL_S", math.inf)
    log = _Log()
    supervisor = Supervisor(_launch(slow=SLOW), run_dir, runs_dir=run_dir.parent / "runs", on_log=log)
    log.rules = [("slow answers again after", 1, supervisor.request_stop)]
    assert supervisor.run() == 0
    assert log.count("slow has not answered for") == 1


def test_a_crash_wakes_the_supervisor(run_dir: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    # nothing else does within the hour: nobody is heard, and READY stands in the pipe until it is read
    monkeypatch.setattr("msgs.bus.zmq.ZmqBus.subscribe", lambda *_: None)
    log = _Log()
    launch = _launch(crash={"params": {"kind": "crash"}, "restart": {"max_restarts": 3, "delay_s": 0.0}})
    supervisor = Supervisor(launch, run_dir, runs_dir=run_dir.parent / "runs", on_log=log)
    log.rules = [("crash ready", 1, lambda: monkeypatch.setattr("nodes.process.supervisor.POLL_S", 3600.0))]
    assert supervisor.run() == 1
    assert log.count("restart in 0 s") == 3


def test_what_cannot_be_started_is_tried_again(run_dir: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    log, tries = _Log(), []
    spawn = os.posix_spawn

    def refuse_once(*arguments: Any, **options: Any) -> int:
        tries.append(1)
        if len(tries) == 1:
            raise BlockingIOError(11, "Resource temporarily unavailable")
        return spawn(*arguments, **options)

    monkeypatch.setattr(os, "posix_spawn", refuse_once)
    assert _run(_launch(tick={"params": {"ticks": 1}, "ends_graph": True}), run_dir, log) == 0
    assert (
        log.count("cannot be started: BlockingIOError: [Errno 11] Resource temporarily unavailable; restart in 0 s")
        == 1
    )


def test_nothing_is_left_open_of_nodes_that_ended(run_dir: Path) -> None:
    log, opened = _Log(), []
    launch = _launch(crash={"params": {"kind": "crash"}, "restart": {"max_restarts": 2, "delay_s": 0.0}})
    supervisor = Supervisor(launch, run_dir, runs_dir=run_dir.parent / "runs", on_log=log)
    log.rules = [("crash ready", number, lambda: opened.append(_held_of_children())) for number in (1, 2, 3)]
    assert supervisor.run() == 1
    assert len(opened) == 3
    assert len(set(opened)) == 1
    assert _held_of_children() == opened[0] - 2


def _held_of_children() -> int:
    """Open pipes and process descriptors of this process."""
    found = 0
    for entry in os.listdir("/proc/self/fd"):
        with contextlib.suppress(OSError):
            target = os.readlink(f"/proc/self/fd/{entry}")
            found += target.startswith("pipe:") or "pidfd" in target
    return found


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


def test_the_graph_goes_on_without_its_terminal(run_dir: Path) -> None:
    from nodes.process.launch_file import dump_launch

    folder = run_dir.parent
    launch = _launch(tick={"params": {"ticks": 10, "text": "hello\n"}, "ends_graph": True})
    (folder / "toy.yaml").write_text(dump_launch(launch))
    command = [sys.executable, "-m", "mirrorwave", "launch", str(folder / "toy.yaml"), "--runs-dir", str(folder)]
    environment = {**os.environ, "MIRRORWAVE_RUN_DIR": str(folder)}
    with subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, env=environment) as process:
        assert process.stdout is not None
        assert b"graph toy" in process.stdout.readline()
        # as `mirrorwave launch ... | head -1` does
        process.stdout.close()
    assert process.returncode == 0
    said = [json.loads(line)["text"] for line in (folder / "toy-1" / "log.jsonl").read_text().splitlines()]
    assert said[-1] == "stopping: tick has come to its end"


def test_the_patience_with_a_process_may_change_while_it_is_asked_to_stop(monkeypatch: pytest.MonkeyPatch) -> None:
    from nodes.process.child import Child

    sent: list[signal.Signals] = []
    monkeypatch.setattr(Child, "__init__", lambda self: vars(self).update(_asked_s=None, _terminated_s=None))
    monkeypatch.setattr(Child, "_signal", lambda self, number: sent.append(number))
    child = Child()  # type: ignore[call-arg]
    for now_s, patience_s, last_s in ((0.0, 5.0, 2.0), (1.0, 5.0, 2.0), (1.1, 0.5, 1.5), (2.5, 0.5, 1.5)):
        child.stop(now_s, patience_s, last_s)
    assert sent == [signal.SIGINT, signal.SIGCONT, signal.SIGTERM]
    child.stop(2.7, 0.5, 1.5)
    assert sent[3:] == [signal.SIGKILL]


_SCRIPT = """
import sys
from pathlib import Path
from nodes.process.launch_file import read_launch_file
from nodes.process.supervisor import Supervisor
folder = Path(sys.argv[1])
say = lambda entry: print(entry["text"], flush=True)
sys.exit(Supervisor(read_launch_file(folder / "toy.yaml"), folder / "run", runs_dir=folder / "runs", on_log=say).run())
"""


@pytest.mark.parametrize("numbers", [[signal.SIGINT], [signal.SIGINT, signal.SIGINT], [signal.SIGKILL]])
def test_no_process_is_left_behind(run_dir: Path, numbers: list[signal.Signals]) -> None:
    from nodes.process.launch_file import dump_launch

    folder = run_dir.parent
    hang = {"params": {"kind": "hang", "after_s": 0.1}, "after": ["tick"]}
    launch = _launch(tick={}, **({"hang": hang} if len(numbers) > 1 else {}))
    (folder / "toy.yaml").write_text(dump_launch(launch))
    command = [sys.executable, "-c", _SCRIPT, str(folder)]
    with subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, text=True) as process:
        guard = threading.Timer(PATIENCE_S, process.kill)
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
    deadline_s = time.monotonic() + PATIENCE_S
    while processes_of(folder) and time.monotonic() < deadline_s:
        time.sleep(0.02)
    assert processes_of(folder) == []
    assert process.returncode == (-signal.SIGKILL if signal.SIGKILL in numbers else 0)
