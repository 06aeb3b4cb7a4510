"""`make test` ends whatever becomes of a test: a worker that dies, a test that hangs, a run that is stopped.

It is run with its own options on a few small files.
"""

from __future__ import annotations

import os
import re
import shlex
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path
from types import SimpleNamespace

import pytest

from msgs.files.shipped import CHECKOUT
from tests import scheduling

pytestmark = pytest.mark.slow

ROOT = CHECKOUT
#: Nothing is measured against this: it ends a run that would not end.
PATIENCE_S = 600.0
#: The end of a run as pytest tells it.
LAST_LINE = re.compile(r"^(no tests ran|(\d+ (failed|passed)(, )?)+) in [\d.]+s", re.MULTILINE)

#: Where tests are handed out one by one, not by files.
SEPARATE = "tests/graph/test_supervisor.py"
assert SEPARATE in scheduling.SEPARATE

KILLED = "os.kill(os.getpid(), signal.SIGKILL)"
#: Compiled code that holds the interpreter: no other thread runs, no handler of a signal is called.
STUCK = "re.match('(a+)+$', 60 * 'a' + 'b')"
#: As in a thread of a library that blocks all signals: nothing is printed.
SILENT = "signal.pthread_sigmask(signal.SIG_BLOCK, signal.valid_signals()); ctypes.string_at(0)"


def test_a_run_off_a_terminal_says_how_far_it_is(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(scheduling, "BEAT_S", 0.001)
    lines, said = [], threading.Event()

    class Reporter:
        def ensure_newline(self) -> None: ...

        def write_line(self, text: str, flush: bool) -> None:
            lines.append(text)
            said.set()

    config = SimpleNamespace(pluginmanager=SimpleNamespace(get_plugin=lambda name: Reporter()))
    beats = scheduling.Beats(config)
    beats.pytest_xdist_node_collection_finished(["a", "b", "c"])
    beats.pytest_runtest_logfinish()
    run = beats.pytest_runtestloop()
    next(run)
    assert said.wait(PATIENCE_S)
    run.close()
    assert lines[0] == "1 of 3 tests, 0 s"


def test_files_that_are_known_to_last_are_begun_first_whatever_order_they_come_in(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The first worker takes files from the beginning, the others from the end."""
    known = scheduling.longest(["1.50s setup    test_long.py::test_0", "7.26s call     test_long.py::test_1[a b]", "x"])
    assert known == ["9 test_long.py"]
    (tmp_path / "seconds.txt").write_text("\n".join(["8 test_long_graph.py", *known]))
    monkeypatch.setattr(scheduling, "SECONDS", tmp_path / "seconds.txt")
    marks = {"graph": ["graph"] * 3, "long_graph": ["graph"], "short": [""] * 2, "slow": ["slow"] * 20, "long": [""]}
    items = [
        SimpleNamespace(nodeid=f"test_{name}.py::test_{at}", get_closest_marker=mark.__eq__)
        for name, found in marks.items()
        for at, mark in enumerate(found)
    ]
    for come in (items, items[4:] + items[:4]):
        ordered = dict.fromkeys(item.nodeid.split("::")[0] for item in scheduling.in_order(come))  # type: ignore[arg-type]
        wanted = ["long_graph", "graph", "short", "slow", "long"]
        assert list(ordered) == [f"test_{name}.py" for name in wanted]


def commands(goal: str) -> list[list[str]]:
    """The commands of a goal that run tests, by this interpreter."""
    said = subprocess.run(["make", "-n", goal], cwd=ROOT, capture_output=True, text=True, check=True).stdout
    found = [shlex.split(line) for line in said.splitlines() if " -m pytest " in line]
    return [[sys.executable if word.endswith("/python") else word for word in words] for words in found]


def write(folder: Path, body: str, at: int, is_graph: bool = False, file: str = "test_b.py") -> None:
    """Three files of three tests; the one of `file`, the second, at `at` does `body`."""
    for path in (folder / "test_a.py", folder / file, folder / "test_c.py"):
        bodies = [body if (path, number) == (folder / file, at) else "pass" for number in range(3)]
        write_file(path, bodies, is_graph)


def write_file(path: Path, bodies: list[str], is_graph: bool = False) -> None:
    lines = ["import ctypes, os, re, signal, time", "import pytest"]
    lines += ["pytestmark = pytest.mark.graph"] if is_graph else []
    lines += [f"def test_{number}(): {body}" for number, body in enumerate(bodies)]
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("\n".join(lines) + "\n")


def start(folder: Path, *options: str, goal: str = "test") -> subprocess.Popen[str]:
    """`make test` on the tests of a folder, in two workers."""
    environment = {name: value for name, value in os.environ.items() if not name.startswith("PYTEST_")}
    # plugins that no test here uses would be most of the time
    environment |= {"PYTHONPATH": str(ROOT), "PYTEST_DISABLE_PLUGIN_AUTOLOAD": "1"}
    here = [
        "-p",
        "xdist",
        "-c",
        str(ROOT / "pyproject.toml"),
        "--rootdir",
        str(folder),
        "-p",
        "tests.conftest",
        "-p",
        "no:cacheprovider",
        "-n",
        "2",
    ]
    (command,) = commands(goal)
    return subprocess.Popen(
        [*command, *here, *options, "."],
        cwd=folder,
        env=environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )


def end(run: subprocess.Popen[str]) -> str:
    """What a run said by its end."""
    try:
        return run.communicate(timeout=PATIENCE_S)[0]
    except subprocess.TimeoutExpired:
        run.terminate()
        pytest.fail(f"the run goes on: {run.communicate()[0]}")


@pytest.mark.parametrize(
    ("body", "at", "is_graph", "file"),
    [
        (KILLED, 1, False, "test_b.py"),
        (KILLED, 2, False, "test_b.py"),
        (KILLED, 2, False, SEPARATE),
        (SILENT, 2, True, "test_b.py"),
    ],
    ids=["middle killed", "last killed", "separate killed", "of graphs crashed"],
)
def test_a_test_that_takes_its_process_with_it_ends_the_run_and_is_named(
    body: str, at: int, is_graph: bool, file: str, tmp_path: Path
) -> None:
    """Killed, or crashed without a word; in the middle or last of its file."""
    write(tmp_path, body, at, is_graph, file)
    run = start(tmp_path)
    said = end(run)
    assert run.returncode == 1, said
    assert f"crashed while running '{file}::test_{at}'" in said
    assert LAST_LINE.search(said), said


def test_a_test_that_hangs_ends_the_run_and_is_named(tmp_path: Path) -> None:
    write_file(tmp_path / "test_b.py", [STUCK])
    run = start(tmp_path, "-o", "faulthandler_timeout=1")
    said = end(run)
    assert run.returncode == 1, said
    assert "Timeout (0:00:01)!" in said
    assert re.search(r'test_b\.py", line \d+ in test_0', said), said
    assert "crashed while running 'test_b.py::test_0'" in said
    assert LAST_LINE.search(said), said


DIES = f"""
import os, signal, time
def pytest_sessionfinish(session):
    worker = os.environ.get("PYTEST_XDIST_WORKER")
    if worker == "gw0": {KILLED}
    if worker == "gw1": time.sleep(1.0)
"""


def test_a_worker_that_dies_after_its_last_test_fails_the_run(tmp_path: Path) -> None:
    """Also when another ends in order after it."""
    write(tmp_path, "pass", 0)
    (tmp_path / "conftest.py").write_text(DIES)
    run = start(tmp_path)
    said = end(run)
    assert run.returncode == 1, said
    assert "node down" in said
    assert LAST_LINE.search(said), said


TELLS = """
import os, pathlib, pytest
@pytest.hookimpl(trylast=True)
def pytest_runtest_logstart(nodeid):
    if nodeid == "test_b.py::test_1" and "PYTEST_XDIST_WORKER" not in os.environ:
        pathlib.Path("running").touch()
"""


def test_a_run_that_is_stopped_names_the_test_that_it_was_at(tmp_path: Path) -> None:
    """As its limit of time does it, by SIGTERM."""
    write(tmp_path, "time.sleep(3600.0)", 1)
    (tmp_path / "conftest.py").write_text(TELLS)
    run = start(tmp_path)
    try:
        end_s = time.monotonic() + PATIENCE_S
        while not (tmp_path / "running").exists():
            assert time.monotonic() < end_s, "the test did not start"
            time.sleep(0.01)
    finally:
        run.send_signal(signal.SIGTERM)
    said = end(run)
    assert run.returncode != 0
    assert re.search(r"SIGTERM while running .*test_b\.py::test_1", said), said
    assert LAST_LINE.search(said), said


TAKEN = """
import os, pathlib
def pytest_runtest_logstart(nodeid):
    worker = os.environ.get("PYTEST_XDIST_WORKER")
    if worker:
        with pathlib.Path(f"taken by {worker}").open("a") as file:
            print(nodeid, file=file)
"""


def test_graphs_run_one_at_a_time_and_the_longest_of_the_others_first(tmp_path: Path) -> None:
    """The worker that is ready first begins with the graphs, most in a file first; the other with most that is slow."""
    say, await_it = "pathlib.Path({0!r}).touch()", "while not pathlib.Path({0!r}).exists(): time.sleep(0.01)"
    for name, tests in {
        "short": [("other", "pass")],
        "slow": [("slow", "pass")],
        # the second worker has reported a test, and has its next file, before the first one reports any; its file lasts
        # as long as there are graphs
        "slower": [("slow", "pass"), ("slow", f"{say.format('second')}\n    {await_it.format('done')}")],
        "graph": [("graph", say.format("done"))],
        "graphs": [("graph", await_it.format("second")), ("graph", "pass"), ("other", "pass")],
    }.items():
        said = [f"@pytest.mark.{mark}\ndef test_{at}():\n    {body}\n" for at, (mark, body) in enumerate(tests)]
        (tmp_path / f"test_{name}.py").write_text("\n".join(["import pathlib, time, pytest", *said]))
    (tmp_path / "conftest.py").write_text(TAKEN)
    run = start(tmp_path, "-o", "markers=graph\nslow\nother")
    said = end(run)
    assert run.returncode == 0, said
    taken = [(tmp_path / f"taken by gw{worker}").read_text().splitlines() for worker in (0, 1)]
    files = [list(dict.fromkeys(nodeid.split("::")[0] for nodeid in one)) for one in taken]
    assert sorted(files) == [["test_graphs.py", "test_graph.py"], ["test_slower.py", "test_slow.py", "test_short.py"]]


#: Print the kernels that the demo's player loads beyond those of what set-up runs; its other nodes are the chain.
FIRST_LOADED = """
import sys
from mirrorwave.cli import main
from models.compiled import KernelCache
loaded, load = [], KernelCache.load_overload
def load_overload(self, *words):
    loaded.append(self._py_func.__qualname__)
    return load(self, *words)
KernelCache.load_overload = load_overload
assert main(["process", "--sample", "--out", sys.argv[1]]) == 0
for words in sys.argv[2:]:
    words = f"sim run launch/{words} --chirps-per-beam 8 --out {sys.argv[1]}/{len(loaded)}.mcap"
    assert main(words.split()) == 0
loaded.clear()
from nodes import player
params = player.Params(scene="launch/scenes/facade_across_lane.yaml", scans=1)
assert sum(event.outgoing.topic == "radar/beam" for event in player.events_of(params)) == 25
print("first loaded:", *loaded)
"""


def test_set_up_compiles_what_the_demo_needs(tmp_path: Path) -> None:
    rule = (ROOT / "Makefile").read_text()
    assert "mirrorwave process --sample" in rule
    scenes = shlex.split(re.findall(r"for words in (.*); do", rule)[0])
    image = (ROOT / "Containerfile").read_text()
    assert all(f"mirrorwave sim run launch/{words} " in image for words in scenes)
    command = [sys.executable, "-c", FIRST_LOADED, tmp_path, *scenes]
    run = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    assert run.stdout.splitlines()[-1:] == ["first loaded:"], run.stderr[-2000:]


def test_the_fast_run_leaves_out_what_is_slow_or_starts_processes(tmp_path: Path) -> None:
    marks = ("graph", "slow", "parametrize('number', [1])")
    for mark in marks:
        argument = "number" if "number" in mark else ""
        text = f"import pytest\n@pytest.mark.{mark}\ndef test_it({argument}): pass\n"
        (tmp_path / f"test_{mark[:5]}.py").write_text(text)
    run = start(tmp_path, "-vv", goal="test-fast")
    said = end(run)
    assert run.returncode == 0, said
    assert "1 passed" in said
    assert "test_param.py::test_it[1]" in said


def test_every_test_and_every_run_has_a_limit_of_time(pytestconfig: pytest.Config) -> None:
    assert float(pytestconfig.getini("faulthandler_timeout")) > 0.0
    for goal in ("test", "test-fast", "test-road"):
        assert [words[0] for words in commands(goal)] == ["timeout"]


#: In place of `make`: `beside` is what becomes of the checks beside the tests, `tests` of those.
MAKE = """#!/bin/bash
case "$*" in
    setup-dev) ;;
    test) {tests} ;;
    *) {beside} ;;
esac
"""
#: Goes on until it is ended.
ENDLESS = "while :; do sleep 0.05; done"


@pytest.mark.parametrize(
    ("tests", "beside", "code"),
    [("echo fine", "echo fine", 0), ("exit 3", ENDLESS, 3), (ENDLESS, "exit 4", 4), ("echo fine", "exit 4", 4)],
    ids=["all pass", "tests fail", "checks fail", "checks alone fail"],
)
def test_ci_fails_with_what_fails_first_and_ends_the_others(tests: str, beside: str, code: int, tmp_path: Path) -> None:
    programs = tmp_path / "bin"
    programs.mkdir()
    # nothing is to be installed
    for name in ("make", "chromium", "pkg-config"):
        (programs / name).write_text(MAKE.format(tests=tests, beside=beside) if name == "make" else "#!/bin/sh\n")
        (programs / name).chmod(0o755)
    environment = os.environ | {"PATH": f"{programs}:{os.environ['PATH']}"}
    done = subprocess.run(
        ["bash", ROOT / ".ci" / "run"],
        env=environment,
        capture_output=True,
        text=True,
        timeout=PATIENCE_S,
        check=False,
    )
    assert done.returncode == code, done.stderr
    assert code or done.stdout.count("fine") == 2
