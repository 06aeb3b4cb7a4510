"""Verbs and nodes that a signal ends: one exit code each, whatever they were at when it came."""

from __future__ import annotations

import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from functools import partial
from pathlib import Path

import pytest

from mirrorwave.exit_signals import HUNG_UP, INTERRUPTED, TERMINATED, runs_until_stopped
from msgs.recording.mcap import info
from tests.mirrorwave.endings import hears_endings, made_box

pytestmark = pytest.mark.graph

PATIENCE_S = 120.0
#: Runs a module as `python -m` does, and stands still where it would import another one; the file says that it does.
HELD = """
import runpy, sys, time
from pathlib import Path

class Gone:
    def __del__(self):
        hold()

def hold():
    Path(reached).touch()
    while not Path(released).exists():
        time.sleep(0.02)

class Hold:
    def find_spec(self, name, path=None, target=None):
        if name != held:
            return
        if way == "lost":
            # as in a library that cannot pass an error on
            Gone()
            time.sleep(600)
        elif way == "text":
            exec("hold()", globals())
        elif way == "other error":
            try:
                hold()
            except KeyboardInterrupt:
                raise SyntaxError("made of it") from None
        else:
            hold()

held, way, reached, released, module = sys.argv[1:6]
sys.argv[:] = [module, *sys.argv[6:]]
sys.meta_path.insert(0, Hold())
runpy.run_module(module, run_name="__main__", alter_sys=True)
"""
#: A module whose import stands for a phase: the command line's own, its verbs', the verb's set-up, its work.
PROCESS = ["typer", "mirrorwave.offline", "msgs.recording.mcap"]
LAUNCH = ["typer", "nodes.process.launch_file", "msgs.bus.zmq"]
RECORD = ["typer", "mirrorwave.commands.captures.bag", "nodes.recorder"]
NODE = ["psutil", "msgs.bus.zmq", "tests.graph.toy_nodes"]
CODES = {signal.SIGINT: INTERRUPTED, signal.SIGTERM: TERMINATED, signal.SIGHUP: HUNG_UP}


def phases(helds: list[str]) -> list[tuple[str, signal.Signals]]:
    """Every phase with Ctrl-C, the last one with the other signals: a phase takes a second."""
    others = [(helds[-1], number) for number in CODES if number != signal.SIGINT]
    return [*((held, signal.SIGINT) for held in helds), *others]


@pytest.fixture(autouse=True, scope="module")
def _hang_up_is_heard() -> Iterator[None]:
    """What is started here hears SIGHUP, also where the tests themselves run under `nohup`."""
    previous = signal.signal(signal.SIGHUP, signal.SIG_DFL)
    yield
    signal.signal(signal.SIGHUP, previous)


@pytest.fixture
def box(monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A folder of its own, its name short enough for a graph's sockets."""
    with made_box(monkeypatch) as path:
        yield path


@pytest.fixture(scope="module")
def box_of_all() -> Iterator[Path]:
    """A folder in which a graph runs, to be listened to."""
    with pytest.MonkeyPatch.context() as patch, made_box(patch) as path:
        launched = ["-m", "mirrorwave", "launch", str(path / "t.yaml"), "--runs-dir", str(path / "runs")]
        with started(launched) as graph:
            wait_for(graph, (path / "t" / "vehicle.state@tick").exists)
            yield path
            graph.send_signal(signal.SIGINT)
            graph.communicate(timeout=PATIENCE_S)
    assert graph.returncode == 0


def wait_for(process: subprocess.Popen[str], what: Callable[[], bool]) -> None:
    deadline_s = time.monotonic() + PATIENCE_S
    while not what():
        assert process.poll() is None, process.communicate()
        assert time.monotonic() < deadline_s, "waited in vain"
        time.sleep(0.02)


@contextmanager
def started(command: list[str]) -> Iterator[subprocess.Popen[str]]:
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    with subprocess.Popen([sys.executable, *command], text=True, **pipes) as process:  # type: ignore[call-overload]
        try:
            yield process
        finally:
            process.kill()


def told_while_held(
    box: Path, held: str, number: signal.Signals, module: str, words: list[str], way: str = "plain"
) -> tuple[int, str]:
    """Exit code and stderr of a module that hears a signal where it imports `held`."""
    with started(["-c", HELD, held, way, str(box / "reached"), str(box / "released"), module, *words]) as process:
        wait_for(process, (box / "reached").exists)
        process.send_signal(number)
        # what only takes note of a signal goes on
        (box / "released").touch()
        _, said = process.communicate(timeout=PATIENCE_S)
    return process.returncode, said


@pytest.mark.parametrize(("held", "number"), phases(PROCESS))
def test_work_that_was_not_done_ends_with_128_and_the_signal(box: Path, held: str, number: signal.Signals) -> None:
    words = ["process", str(box / "none.mcap"), "--out", str(box / "out")]
    code, said = told_while_held(box, held, number, "mirrorwave", words)
    assert code == CODES[number] == 128 + number
    # nobody reads what is said where the terminal has gone
    said_of = {
        signal.SIGINT: "mirrorwave: interrupted\n",
        signal.SIGTERM: "mirrorwave: terminated\n",
        signal.SIGHUP: "",
    }
    assert said == said_of[number]


@pytest.mark.parametrize(("way", "number"), phases(["lost", "text", "other error"]))
def test_what_a_library_makes_of_an_interrupt_changes_nothing(box: Path, way: str, number: signal.Signals) -> None:
    """Some lose it, some make another error of it, some mark the process to end by SIGINT whatever comes."""
    words = ["process", str(box / "none.mcap"), "--out", str(box / "out")]
    code, said = told_while_held(box, "mirrorwave.offline", number, "mirrorwave", words, way)
    assert code == CODES[number]
    assert said.count("\n") == (number != signal.SIGHUP)


@pytest.mark.parametrize(
    ("verb", "held", "number"),
    [(verb, *phase) for verb, helds in (("launch", LAUNCH), ("record", RECORD)) for phase in phases(helds)],
)
def test_what_runs_until_told_is_done_when_told(box: Path, held: str, verb: str, number: signal.Signals) -> None:
    words = {
        "launch": ["launch", str(box / "t.yaml"), "--runs-dir", str(box / "runs")],
        "record": ["bag", "record", str(box / "a.mcap")],
    }[verb]
    assert told_while_held(box, held, number, "mirrorwave", words) == (0, "")


@pytest.mark.parametrize(("held", "number"), phases(NODE))
def test_a_node_is_done_when_told(box: Path, held: str, number: signal.Signals) -> None:
    words = ["tests.graph.toy_nodes", "--name", "tick", "--run-dir", str(box / "t")]
    code, said = told_while_held(box, held, number, "nodes.node", words)
    assert code == 0
    assert "Traceback" not in said


@pytest.mark.parametrize("numbers", [[signal.SIGTERM], [signal.SIGINT] * 2, [signal.SIGTERM, signal.SIGINT]])
def test_a_running_graph_with_its_recorder_is_done_when_told(box: Path, numbers: list[signal.Signals]) -> None:
    """A second signal, which meets it while it stops, asks for patience and loses nothing."""
    out = box / "a.mcap"
    words = ["-m", "mirrorwave", "launch", str(box / "t.yaml"), "--runs-dir", str(box / "runs"), "--record", str(out)]
    with started(words) as process:
        wait_for(process, (box / "t" / "vehicle.state@tick").exists)
        for number in numbers[:1]:
            process.send_signal(number)
        for line in process.stdout or ():
            if "stopping" in line:
                break
        for number in numbers[1:]:
            process.send_signal(number)
        process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 0
    assert info(out).complete


#: Closes in the time that the second and third signal take to come, as a verb closes what it holds.
CLOSING = """
import sys, time
from mirrorwave.exit_signals import ended_by_signal, hear_endings
hear_endings()
try:
    print("up", flush=True)
    time.sleep(600)
except KeyboardInterrupt:
    pass
print("closing", flush=True)
sys.stdin.read()
print("closed", flush=True)
raise SystemExit(ended_by_signal(["process"]))
"""


def test_the_first_ctrl_c_closes_the_second_asks_for_patience_the_third_ends() -> None:
    """In every verb: nothing that is being closed hears the second."""
    for times in (2, 3):
        with started_closing() as process:
            assert process.stdout is not None
            assert process.stderr is not None
            assert process.stdout.readline() == "up\n"
            process.send_signal(signal.SIGINT)
            assert process.stdout.readline() == "closing\n"
            process.send_signal(signal.SIGINT)
            assert "press Ctrl-C once more to end at once" in process.stderr.readline()
            if times == 3:
                process.send_signal(signal.SIGINT)
            out, said = process.communicate("", timeout=PATIENCE_S)
        assert process.returncode == INTERRUPTED
        assert (out, said) == (("closed\n", "mirrorwave: interrupted\n") if times == 2 else ("", ""))


@contextmanager
def started_closing() -> Iterator[subprocess.Popen[str]]:
    with subprocess.Popen(
        [sys.executable, "-c", CLOSING], text=True, stdin=subprocess.PIPE, stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
    ) as process:  # fmt: skip
        try:
            yield process
        finally:
            process.kill()


@pytest.mark.parametrize(
    "verb", ["topic hz vehicle/state --duration 500", "topic echo vehicle/state", "node list --window 500"]
)
def test_who_listens_is_ended_as_a_shell_would_have_it(
    box_of_all: Path, verb: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """By each signal one of three that listen at the same time."""
    monkeypatch.setenv("MIRRORWAVE_RUN_DIR", str(box_of_all))
    monkeypatch.setenv("MIRRORWAVE_DOMAIN", "t")
    with ExitStack() as stack:
        command = ["-m", "mirrorwave", *verb.split()]
        listeners = {number: stack.enter_context(started(command)) for number in CODES}
        for process in listeners.values():
            wait_for(process, partial(hears_endings, process))
        # well within its set-up or its work
        time.sleep(1.0)
        for number, process in listeners.items():
            process.send_signal(number)
        for process in listeners.values():
            process.communicate(timeout=PATIENCE_S)
    assert {number: process.returncode for number, process in listeners.items()} == CODES


@pytest.mark.parametrize(
    ("line", "until_told"),
    [
        ("launch a.yaml --duration 5", True),
        ("top", True),
        ("top --once", False),
        ("top --json --window 1", False),
        ("bag record a.mcap", True),
        ("bag info a.mcap", False),
        ("bag", False),
        ("process launch", False),
        ("", False),
    ],
)
def test_verbs_that_run_until_told(line: str, until_told: bool) -> None:
    assert runs_until_stopped(line.split()) is until_told
