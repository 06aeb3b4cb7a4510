"""What becomes of a verb whose terminal hangs up, whose stdout came closed, or whose reader has seen enough."""

from __future__ import annotations

import contextlib
import os
import pty
import shlex
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from benchmarks.live.processes import processes_of
from mirrorwave.exit_signals import HUNG_UP
from mirrorwave.terminal import READER_LEFT
from msgs.recording.mcap import RecordingReader, info
from nodes.recording.files import recorded_files
from tests.mirrorwave.endings import hears_endings, made_box

pytestmark = pytest.mark.graph

PATIENCE_S = 90.0
#: Bytes of a recording that holds a chunk of messages, and of such a chunk, a second of them.
RECORDED, MORE = 6_000, 1_000
VERB = [sys.executable, "-m", "mirrorwave"]
#: Verbs that print and end.
PRINTING = ["topic list", "sim material concrete --json", "graph launch/corner.yaml", "--help", "--version"]
#: Verbs that listen, each in a loop of its own, here where nothing comes.
LISTENING = [
    "top",
    "top --once --window 1000",
    "topic echo radar/ra_map",
    "topic hz radar/ra_map --duration 1000",
    "topic delay radar/ra_map --duration 1000",
    "node list --window 1000",
    "can monitor -i virtual -c nobody",
    "can monitor -i virtual -c nobody --signals",
]


@pytest.fixture
def box(monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A folder of its own, its name short enough for a graph's sockets; nothing that was started in it is left."""
    with made_box(monkeypatch) as path, only_its_own(path):
        yield path


@pytest.fixture(scope="module")
def box_of_all() -> Iterator[Path]:
    with pytest.MonkeyPatch.context() as patch, made_box(patch) as path, only_its_own(path), graph(path):
        yield path


@pytest.fixture
def running(box_of_all: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """A graph that runs, for verbs that leave it as it is; nothing but its own processes is left."""
    monkeypatch.setenv("MIRRORWAVE_RUN_DIR", str(box_of_all))
    monkeypatch.setenv("MIRRORWAVE_DOMAIN", "t")
    with only_its_own(box_of_all):
        yield


@contextmanager
def only_its_own(path: Path) -> Iterator[None]:
    before = processes_of(path)
    yield
    wait_for(lambda: processes_of(path) == before)


def wait_for(what: Callable[[], object]) -> None:
    deadline_s = time.monotonic() + PATIENCE_S
    while not what():
        assert time.monotonic() < deadline_s, "waited in vain"
        time.sleep(0.05)


@contextmanager
def started(words: list[str], **options: object) -> Iterator[subprocess.Popen[str]]:
    """A verb in a process of its own, which has ended afterwards."""
    outputs = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, **options}
    with subprocess.Popen([*VERB, *words], text=True, **outputs) as process:  # type: ignore[call-overload]
        try:
            yield process
        finally:
            process.kill()


def ended(process: subprocess.Popen[str]) -> tuple[int, str, str]:
    """Exit code, stdout and stderr."""
    out, err = process.communicate(timeout=PATIENCE_S)
    return process.returncode, out, err


def hang_up(process: subprocess.Popen[str], times: int = 2) -> tuple[int, str, str]:
    """As shell and kernel do: more than once."""
    for _ in range(times):
        process.send_signal(signal.SIGHUP)
    return ended(process)


@contextmanager
def graph(box: Path, *more: str) -> Iterator[subprocess.Popen[str]]:
    words = ["launch", str(box / "t.yaml"), "--runs-dir", str(box / "runs"), *more]
    with started(words, stdout=subprocess.DEVNULL) as process:
        try:
            wait_for(lambda: list(box.glob("t/vehicle.state@tick")))
            yield process
        finally:
            process.send_signal(signal.SIGINT)
            process.wait(PATIENCE_S)


# the terminal hangs up


@pytest.mark.parametrize("more", [[], ["--split-duration", "0.5"]])
def test_a_recording_is_whole_when_its_terminal_has_gone(box: Path, more: list[str]) -> None:
    out = box / "out.mcap"
    with graph(box), started(["bag", "record", str(out), *more]) as recorder:
        wait_for(lambda: sum(path.stat().st_size for path in recorded_files(out)) > RECORDED)
        code, said, trouble = hang_up(recorder)
    assert (code, trouble) == (0, "")
    assert " messages, 0 missing" in said
    for path in recorded_files(out):
        found = info(path)
        assert (found.complete, found.checksums_agree, found.loss) == (True, True, None)


def test_a_graph_and_its_recording_end_well_when_the_terminal_has_gone(box: Path) -> None:
    """Shell and kernel both say so: the second time is no wish for haste."""
    out = box / "out.mcap"
    with graph(box, "--record", str(out)) as launched:
        wait_for(lambda: out.exists() and out.stat().st_size > RECORDED)
        for _ in range(3):
            launched.send_signal(signal.SIGHUP)
        assert launched.wait(PATIENCE_S) == 0
    found = info(out)
    assert (found.complete, found.checksums_agree, found.loss) == (True, True, None)


@pytest.mark.parametrize("verb", ["bag record", "launch"])
def test_whoever_asked_to_outlive_the_terminal_does(box: Path, verb: str) -> None:
    """As `nohup` does: what is ignored stays ignored, by the nodes as well."""
    ignored = {"preexec_fn": lambda: signal.signal(signal.SIGHUP, signal.SIG_IGN)}
    out = box / "out.mcap"
    words = {
        "bag record": ["bag", "record", str(out)],
        "launch": ["launch", str(box / "t.yaml"), "--runs-dir", str(box / "runs"), "--record", str(out)],
    }[verb]
    with contextlib.ExitStack() as stack:
        if verb == "bag record":
            stack.enter_context(graph(box))
        process = stack.enter_context(started(words, **ignored))
        wait_for(lambda: out.exists() and out.stat().st_size > RECORDED)
        for pid in [process.pid, *processes_of(out)]:
            os.kill(pid, signal.SIGHUP)
        size = out.stat().st_size
        wait_for(lambda: out.stat().st_size > size + MORE)
        assert process.poll() is None
        process.send_signal(signal.SIGINT)
        assert ended(process)[0] == 0
    assert info(out).complete


def test_a_terminal_that_is_closed_costs_no_recording(box: Path) -> None:
    """A true terminal: closing it sends SIGHUP, and whatever is printed afterwards fails."""
    out = box / "out.mcap"
    leader, follower = pty.openpty()
    with graph(box):
        process = subprocess.Popen(
            [*VERB, "bag", "record", str(out)], stdin=follower, stdout=follower, stderr=follower,
            start_new_session=True, preexec_fn=lambda: os.close(os.open(os.ttyname(0), os.O_RDWR)),
        )  # fmt: skip
        os.close(follower)
        wait_for(lambda: out.exists() and out.stat().st_size > RECORDED)
        os.close(leader)
        code = process.wait(PATIENCE_S)
    found = info(out)
    assert (found.complete, found.checksums_agree, found.loss) == (True, True, None)
    assert code in (1, READER_LEFT)


@pytest.mark.parametrize("verb", ["topic echo radar/ra_map", "topic hz radar/ra_map --duration 1000", "top"])
def test_other_verbs_end_at_once_and_quietly(running: None, verb: str) -> None:
    with started(verb.split()) as process:
        wait_for(lambda: hears_endings(process))
        # well within its set-up or its work
        time.sleep(1.0)
        code, _, trouble = hang_up(process)
    # who has just been looking goes as after Ctrl-C
    assert (code, trouble) == (0 if verb == "top" else HUNG_UP, "")


def test_workers_go_with_their_parent(box: Path) -> None:
    out = box / "set"
    words = ["sim", "dataset", "--out", str(out), "--count", "2000", "--seed", "1", "--workers", "2"]
    # a file: workers hold a pipe open
    trouble = (box / "stderr").open("w+")
    with trouble, started(words, stderr=trouble, start_new_session=True) as process:
        wait_for(lambda: list(out.glob("*")))
        children = [int(pid) for pid in Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text().split()]
        # as the kernel does: everybody in the group hears it
        os.killpg(process.pid, signal.SIGHUP)
        process.wait(PATIENCE_S)
        wait_for(lambda: not any(Path(f"/proc/{pid}").exists() for pid in children))
    assert process.returncode == HUNG_UP, (box / "stderr").read_text()
    assert not list(out.glob("*.part"))


@pytest.mark.parametrize("ignored", [False, True])
def test_a_node_on_its_own_ends_well(box: Path, ignored: bool) -> None:
    command = [
        sys.executable,
        "-m",
        "nodes.node",
        "tests.graph.toy_nodes",
        "--name",
        "tick",
        "--run-dir",
        str(box / "t"),
    ]
    before = (lambda: signal.signal(signal.SIGHUP, signal.SIG_IGN)) if ignored else None
    with subprocess.Popen(command, stderr=subprocess.DEVNULL, preexec_fn=before) as process:
        wait_for(lambda: list(box.glob("t/vehicle.state@tick")))
        process.send_signal(signal.SIGHUP)
        if ignored:
            time.sleep(1.0)
            assert process.poll() is None
            process.send_signal(signal.SIGINT)
        assert process.wait(PATIENCE_S) == 0


# stdout came closed, or takes nothing


def through_shell(line: str, **options: object) -> subprocess.CompletedProcess[str]:
    python = f"{sys.executable} -m mirrorwave"
    return subprocess.run(
        ["bash", "-c", f"set -o pipefail; {line.replace('mirrorwave', python, 1)}"],
        capture_output=True, text=True, timeout=PATIENCE_S, check=False,
    )  # fmt: skip


@pytest.mark.parametrize("verb", [*PRINTING, "doctor"])
def test_verbs_work_without_stdout(verb: str, box: Path) -> None:
    found = through_shell(f"mirrorwave {verb} >&-")
    assert found.stderr == ""
    assert found.returncode in ((0, 1) if verb == "doctor" else (0,))


def test_without_stdout_an_error_is_one_line() -> None:
    found = through_shell("mirrorwave bag info nowhere.mcap >&-")
    assert (found.returncode, found.stderr.count("\n")) == (2, 1)
    assert "nowhere.mcap" in found.stderr


def test_without_any_stream_the_code_still_tells() -> None:
    assert through_shell("mirrorwave topic list <&- >&- 2>&-").returncode == 0
    assert through_shell("mirrorwave bag info nowhere.mcap <&- >&- 2>&-").returncode == 2


def test_a_file_does_not_get_the_number_of_a_stream_that_came_closed(box: Path) -> None:
    """What is printed would stand in the recording."""
    out = box / "out.mcap"
    with graph(box):
        assert through_shell(f"mirrorwave bag record {out} --duration 1 <&- >&- 2>&-").returncode == 0
    with RecordingReader(out) as reader:
        assert reader.loss is None
        assert reader.types
    launched = through_shell(f"mirrorwave launch {box}/t.yaml --duration 0.5 --runs-dir {box}/runs <&- >&- 2>&-")
    assert launched.returncode == 0


@pytest.mark.parametrize("closed", ["<&-", ">&-", "2>&-", "<&- 2>&-", "<&- >&- 2>&-"])
def test_what_a_verb_starts_has_its_streams_too(closed: str) -> None:
    """A socket of the fork server, or of a worker, would get the number of one that is missing."""
    code = (
        "import os, sys; from mirrorwave.terminal import open_closed_streams; open_closed_streams();"
        "sys.stdin.read(); sys.stdout.write('.'); sys.stderr.write('.');"
        "words = ['sh', '-c', 'for n in 0 1 2; do [ -e /proc/$$/fd/$n ] || exit 1; done'];"
        "sys.exit(os.waitstatus_to_exitcode(os.waitpid(os.posix_spawn('/bin/sh', words, os.environ), 0)[1]))"
    )
    command = f"{sys.executable} -c {shlex.quote(code)} </dev/null {closed}"
    assert subprocess.run(["bash", "-c", command], capture_output=True, timeout=PATIENCE_S, check=False).returncode == 0


@pytest.mark.parametrize("verb", ["topic list", "sim material concrete --json"])
def test_a_full_disk_behind_stdout_is_named(verb: str) -> None:
    found = through_shell(f"mirrorwave {verb} >/dev/full")
    assert (found.returncode, found.stderr) == (1, "mirrorwave: standard output: No space left on device\n")


# the reader leaves


@pytest.mark.parametrize("verb", PRINTING)
def test_verbs_end_quietly_when_their_reader_has_left(verb: str) -> None:
    with started(verb.split()) as process:
        assert process.stdout is not None
        process.stdout.close()
        assert process.wait(PATIENCE_S) == READER_LEFT
        assert process.stderr is not None
        assert process.stderr.read() == ""


@pytest.mark.parametrize("verb", LISTENING)
def test_listening_verbs_do_not_wait_for_their_next_line(verb: str, running: None) -> None:
    with started(verb.split()) as process:
        assert process.stdout is not None
        process.stdout.close()
        assert process.wait(PATIENCE_S) == READER_LEFT
        assert process.stderr is not None
        assert process.stderr.read() == ""


def test_a_body_that_survives_every_exception_ends_with_its_reader(box: Path) -> None:
    """Libraries wrap what is raised in them, as python-can does around the import of an interface."""
    code = (
        "import time\nfrom mirrorwave.terminal import ends_with_reader\ntry:\n    with ends_with_reader():\n"
        "        print('up', flush=True)\n        while True:\n            try:\n                time.sleep(60)\n"
        "            except Exception:\n                pass\nexcept BrokenPipeError:\n    raise SystemExit(7)\n"
    )
    with subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, stderr=subprocess.DEVNULL) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == b"up\n"
        process.stdout.close()
        try:
            assert process.wait(PATIENCE_S) == 7
        finally:
            process.kill()


def test_the_head_of_a_stream(running: None) -> None:
    echo = through_shell("mirrorwave topic echo vehicle/state | head -3")
    assert (echo.returncode, echo.stdout.count("\n"), echo.stderr) == (READER_LEFT, 3, "")
    top = through_shell("mirrorwave top --window 0.5 | head -12")
    assert (top.returncode, top.stdout.count("\n"), top.stderr) == (READER_LEFT, 12, "")
    assert "tick" in top.stdout


def test_a_graph_goes_on_when_its_log_has_no_reader(box: Path) -> None:
    found = through_shell(f"mirrorwave launch {box}/t.yaml --duration 1 --runs-dir {box}/runs | head -1")
    assert (found.returncode, found.stdout.count("\n"), found.stderr) == (0, 1, "")
    log = (box / "runs" / "ticking-1" / "log.jsonl").read_text()
    assert "1 s are over" in log
