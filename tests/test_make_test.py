"""`make test` ends whatever becomes of a test: a worker that dies, a test that hangs, a run that is stopped.

Each part of it is run with its own options on a few small files.
"""

from __future__ import annotations

import os
import re
import shlex
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from msgs.files.shipped import CHECKOUT

ROOT = CHECKOUT
#: Nothing is measured against this: it ends a run that would not end.
PATIENCE_S = 600.0
#: The end of a run as pytest tells it.
LAST_LINE = re.compile(r"^(no tests ran|(\d+ (failed|passed)(, )?)+) in [\d.]+s", re.MULTILINE)
PLAIN, DOCS, GRAPH = range(3)

KILLED = "os.kill(os.getpid(), signal.SIGKILL)"
#: Compiled code that holds the interpreter: no other thread runs, no handler of a signal is called.
STUCK = "re.match('(a+)+$', 60 * 'a' + 'b')"
#: As in a thread of a library that blocks all signals: nothing is printed.
SILENT = "signal.pthread_sigmask(signal.SIG_BLOCK, signal.valid_signals()); ctypes.string_at(0)"


def parts() -> list[list[str]]:
    """The commands of `make test` that run tests, of this interpreter and without the paths of this project."""
    said = subprocess.run(["make", "-n", "test"], cwd=ROOT, capture_output=True, text=True, check=True).stdout
    commands = [shlex.split(line) for line in said.splitlines() if " -m pytest " in line]
    found = [[sys.executable if word.endswith("/python") else word for word in words] for words in commands]
    return [[word for word in words if "tests/docs" not in word] for words in found]


def write(folder: Path, part: int, body: str, at: int) -> None:
    """Three files of three tests; the one of the second file at `at` does `body`."""
    for file in "abc":
        bodies = [body if (file, number) == ("b", at) else "pass" for number in range(3)]
        write_file(folder / f"test_{file}.py", part, bodies)


def write_file(path: Path, part: int, bodies: list[str]) -> None:
    lines = ["import ctypes, os, re, signal, time", "import pytest"]
    lines += ["pytestmark = pytest.mark.graph"] if part == GRAPH else []
    lines += [f"def test_{number}(): {body}" for number, body in enumerate(bodies)]
    path.write_text("\n".join(lines) + "\n")


def start(folder: Path, part: int, *options: str) -> subprocess.Popen[str]:
    """A part of `make test` on the tests of a folder."""
    environment = {name: value for name, value in os.environ.items() if not name.startswith("PYTEST_")}
    environment |= {"PYTHONPATH": str(ROOT), "PYTEST_XDIST_AUTO_NUM_WORKERS": "2"}
    here = [
        "-c",
        str(ROOT / "pyproject.toml"),
        "--rootdir",
        str(folder),
        "-p",
        "tests.conftest",
        "-p",
        "no:cacheprovider",
    ]
    return subprocess.Popen(
        [*parts()[part], *here, *options, "."],
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
    ("part", "body", "at"),
    [
        (PLAIN, KILLED, 0),
        (PLAIN, KILLED, 1),
        (PLAIN, KILLED, 2),
        (DOCS, KILLED, 2),
        (GRAPH, SILENT, 2),
    ],
    ids=["first killed", "middle killed", "last killed", "of docs killed", "of graphs crashed"],
)
def test_a_test_that_takes_its_process_with_it_ends_the_run_and_is_named(
    part: int, body: str, at: int, tmp_path: Path
) -> None:
    """Killed, or crashed without a word; first, in the middle, last of its file."""
    write(tmp_path, part, body, at)
    run = start(tmp_path, part)
    said = end(run)
    assert run.returncode == 1, said
    assert f"crashed while running 'test_b.py::test_{at}'" in said
    assert LAST_LINE.search(said), said


@pytest.mark.parametrize("part", [PLAIN, GRAPH])
def test_a_test_that_hangs_ends_the_run_and_is_named(part: int, tmp_path: Path) -> None:
    write_file(tmp_path / "test_b.py", part, [STUCK])
    run = start(tmp_path, part, "-o", "faulthandler_timeout=1")
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
    write(tmp_path, PLAIN, "pass", 0)
    (tmp_path / "conftest.py").write_text(DIES)
    run = start(tmp_path, PLAIN)
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
    write(tmp_path, PLAIN, "time.sleep(3600.0)", 1)
    (tmp_path / "conftest.py").write_text(TELLS)
    run = start(tmp_path, PLAIN)
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


def test_every_test_and_every_part_has_a_limit_of_time(pytestconfig: pytest.Config) -> None:
    assert float(pytestconfig.getini("faulthandler_timeout")) > 0.0
    assert [words[0] for words in parts()] == ["timeout"] * 3
