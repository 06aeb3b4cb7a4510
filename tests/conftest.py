"""How a run of tests uses the machine, and how it ends early, by a worker that died or by SIGTERM: at once, naming what
was running; no tolerance that cannot fail."""

from __future__ import annotations

import gc
import os
import signal
import sys
from pathlib import Path
from typing import Any

# as verbs and nodes do, before numpy is imported: threads that wait for each other take the cores of other tests
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
import pytest
from hypothesis import HealthCheck, settings

from tests.home import move_in
from tests.scheduling import Beats, FromBothEnds, in_order

# a shared machine is slow at times
settings.register_profile("shared", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("shared")
# before a test imports what looks for a home
move_in()
# where a machine forbids it (containers often do) every worker, and every process that a test starts, would compile all
# modules again; more than half of the time of collecting
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
sys.dont_write_bytecode = False
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    # tests in the background of a shell: what they start would not hear the Ctrl-C that ends it
    signal.signal(signal.SIGINT, signal.default_int_handler)
if signal.getsignal(signal.SIGHUP) is signal.SIG_IGN:
    # nohup: nor the goodbye of a terminal
    signal.signal(signal.SIGHUP, signal.SIG_DFL)


class Ending:
    """What the process that hands tests to workers knows of them."""

    def __init__(self) -> None:
        self._running: dict[str, None] = {}
        self._crashed = self._lost = ""

    @pytest.hookimpl(wrapper=True)
    def pytest_runtestloop(self) -> object:
        previous = signal.signal(signal.SIGTERM, self._end)
        try:
            return (yield)
        finally:
            signal.signal(signal.SIGTERM, previous)

    def pytest_runtest_logstart(self, nodeid: str) -> None:
        self._running[nodeid] = None

    def pytest_runtest_logfinish(self, nodeid: str) -> None:
        self._running.pop(nodeid, None)

    @pytest.hookimpl(optionalhook=True)
    def pytest_handlecrashitem(self, crashitem: str) -> None:
        self._crashed = crashitem

    @pytest.hookimpl(trylast=True)
    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        # else the other workers would first run to the end of their files
        if report.nodeid == self._crashed:
            pytest.exit(f"a worker died while running {self._crashed}", pytest.ExitCode.TESTS_FAILED)

    @pytest.hookimpl(optionalhook=True)
    def pytest_testnodedown(self, error: object) -> None:
        self._lost = self._lost or str(error or "")

    @pytest.hookimpl(wrapper=True)
    def pytest_sessionfinish(self, session: pytest.Session) -> object:
        # one that dies between its tests would leave a run that passed
        if self._lost and session.exitstatus == pytest.ExitCode.OK:
            session.exitstatus = pytest.ExitCode.TESTS_FAILED
        return (yield)

    def _end(self, number: int, frame: object) -> None:
        running = ", ".join(self._running) or "no test"
        pytest.exit(f"{signal.Signals(number).name} while running {running}", pytest.ExitCode.INTERRUPTED)


def pytest_configure(config: pytest.Config) -> None:
    # who runs tests itself would hand the handler of SIGTERM on to what they fork
    if config.getoption("dist", "no") != "no" and not hasattr(config, "workerinput"):
        config.pluginmanager.register(Ending())
        if not sys.stdout.isatty():
            config.pluginmanager.register(Beats(config))


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config: pytest.Config, log: object) -> FromBothEnds | None:
    return FromBothEnds(config, log) if config.getoption("dist") == "loadfile" else None


@pytest.hookimpl(wrapper=True)
def pytest_collection(session: pytest.Session) -> object:
    """Some million objects that stay: to look through them for garbage, again and again, would take a third longer.

    In a fresh checkout half of the time goes into rewriting assertions: each worker begins in another room, and finds
    what the others have rewritten meanwhile. `in_order` orders their tests alike.
    """
    worker, config = getattr(session.config, "workerinput", None), session.config
    if worker and config.args == ["tests"] and not config.getoption("ignore"):
        rooms = sorted(f"tests/{path.name}" for path in Path(__file__).parent.iterdir() if is_room(path))
        at = len(rooms) * int(worker["workerid"].removeprefix("gw")) // worker["workercount"]
        config.args[:] = rooms[at:] + rooms[:at]
    gc.disable()
    try:
        return (yield)
    finally:
        gc.enable()
        gc.freeze()


@pytest.hookimpl(wrapper=True)
def pytest_runtest_protocol() -> object:
    """What a test makes known of topics (those of a sensor with a name, its own) ends with it."""
    from msgs.bus.topics import TOPICS

    with TOPICS.restored():
        return (yield)


def is_room(path: Path) -> bool:
    return path.name.startswith("test_") or (path.is_dir() and path.name[0] not in "._")


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    for item in items:
        if item.nodeid.startswith("tests/docs/test_pages.py::test_page["):
            item.add_marker("slow")
    if hasattr(config, "workerinput"):
        items[:] = in_order(items)


#: pytest's own, added to a relative one that is asked for.
DEFAULT_ABSOLUTE = 1e-12
#: Expected values under this are powers, photons or energies, no rounding about zero.
SMALL = 1e-6

_approx = pytest.approx


def approx(expected: Any, rel: float | None = None, abs: float | None = None, nan_ok: bool = False) -> Any:
    """`pytest.approx`, which refuses a relative tolerance that its default absolute one would swallow.

    A power of 1e-13 mW is equal to any other to within 1e-12: such a test cannot fail. It says `abs=0.0`.
    """
    is_relative = rel is not None and abs is None and isinstance(expected, float | complex | np.number)
    if is_relative and 0.0 < np.abs(expected) < SMALL and rel * np.abs(expected) < DEFAULT_ABSOLUTE:
        raise ValueError(
            f"approx({expected!r}, rel={rel!r}) needs abs=0.0: the default absolute tolerance, "
            f"{DEFAULT_ABSOLUTE:g}, is looser"
        )
    return _approx(expected, rel=rel, abs=abs, nan_ok=nan_ok)


pytest.approx = approx
