"""How a run of tests ends early, by a worker that died or by SIGTERM: at once, and naming what was running."""

from __future__ import annotations

import signal

import pytest


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
