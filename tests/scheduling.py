"""In which order a run of tests hands them to its workers.

The first worker takes the tests that start processes and mostly wait for them, one file after the other; meanwhile the
others compute, the longest first. So there is one graph at a time as long as there is anything else to do, and short
tests fill up whatever time is left at the end. A run that no terminal shows says every ten seconds how far it is.

How long is known of the longest, in `tests/seconds.txt`, and else told from the markers. To measure it again:
`python -m pytest --durations=0 ... | python -m tests.scheduling > tests/seconds.txt`.
"""

from __future__ import annotations

import re
import sys
import threading
import time
from collections import Counter
from collections.abc import Iterable, Sequence
from pathlib import Path

import pytest
from xdist.scheduler import LoadFileScheduling
from xdist.workermanage import WorkerController

#: Seconds of the units that take longest: a line `12 tests/test_it.py` each, the longest first.
SECONDS = Path(__file__).with_name("seconds.txt")
#: A unit stands there if it takes as long; one that does not takes a second for each slow test, and each of a graph.
MIN_S = 5.0
#: How often a run says how far it is.
BEAT_S = 10.0
#: Files whose tests make nothing for each other: each may run in a worker of its own.
SEPARATE = frozenset(
    {
        "tests/graph/test_supervisor.py",
        "tests/mirrorwave/test_exit_signals.py",
        "tests/mirrorwave/test_terminal.py",
        "tests/test_make_test.py",
    }
)


def unit_of(nodeid: str) -> str:
    """The tests that one worker runs in a row: those of a file, or a single one."""
    file = nodeid.split("::", 1)[0]
    return nodeid if file in SEPARATE else file


def in_order(items: list[pytest.Item]) -> list[pytest.Item]:
    """First what the first worker takes first, last what the others do; equal ones by their names.

    The order is the same however the files were come by.
    """
    known = dict(reversed(line.split(" ", 1)) for line in SECONDS.read_text(encoding="utf-8").splitlines())
    graphs, slow = (
        Counter(unit_of(item.nodeid) for item in items if item.get_closest_marker(marker))
        for marker in ("graph", "slow")
    )

    def place(item: pytest.Item) -> tuple[bool, float, str]:
        unit = unit_of(item.nodeid)
        seconds = float(known.get(unit, min(graphs[unit] + slow[unit], MIN_S)))
        return unit not in graphs, -seconds if unit in graphs else seconds, item.nodeid.split("::", 1)[0]

    return sorted(items, key=place)


def longest(report: Iterable[str]) -> list[str]:
    """The lines of `SECONDS`, of what a run with `--durations=0` says."""
    seconds: Counter[str] = Counter()
    for line in report:
        if found := re.match(r"([\d.]+)s (?:call|setup|teardown) +(\S.*)", line):
            seconds[unit_of(found[2].strip())] += float(found[1])  # type: ignore[assignment]
    return [f"{took:.0f} {unit}" for unit, took in seconds.most_common() if took >= MIN_S]


class FromBothEnds(LoadFileScheduling):
    """The first worker takes units from the beginning of the collection, all others from its end."""

    def __init__(self, config: pytest.Config, log: object) -> None:
        super().__init__(config, log)
        # else by their number of tests
        config.option.loadscopereorder = False

    def _split_scope(self, nodeid: str) -> str:
        return unit_of(nodeid)

    def _assign_work_unit(self, node: WorkerController) -> None:
        if node is not self.nodes[0]:
            self.workqueue.move_to_end(next(reversed(self.workqueue)), last=False)
        super()._assign_work_unit(node)


class Beats:
    """A line every ten seconds of what is done and left, where nobody sees the dots come."""

    def __init__(self, config: pytest.Config) -> None:
        self._config, self._over = config, threading.Event()
        self._all, self._done = 0, 0

    @pytest.hookimpl(optionalhook=True)
    def pytest_xdist_node_collection_finished(self, ids: Sequence[str]) -> None:
        self._all = len(ids)

    def pytest_runtest_logfinish(self) -> None:
        self._done += 1

    @pytest.hookimpl(wrapper=True)
    def pytest_runtestloop(self) -> object:
        thread = threading.Thread(target=self._beat, daemon=True)
        thread.start()
        try:
            return (yield)
        finally:
            self._over.set()
            thread.join()

    def _beat(self) -> None:
        reporter = self._config.pluginmanager.get_plugin("terminalreporter")
        start_s = time.monotonic()
        while reporter is not None and not self._over.wait(BEAT_S):
            reporter.ensure_newline()
            what = f"{self._done} of {self._all} tests" if self._all else "collecting tests"
            reporter.write_line(f"{what}, {time.monotonic() - start_s:.0f} s", flush=True)


if __name__ == "__main__":
    print(*longest(sys.stdin), sep="\n")
