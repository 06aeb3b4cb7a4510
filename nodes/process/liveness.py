"""Activity of a silent node, from the kernel's data on its process: a decision on samples alone.

A node on an overloaded machine is silent too, and must not be killed: only time in which it had a core, or
asked for none, counts against it.
"""

from __future__ import annotations

import contextlib
import time
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path

from nodes.node import HEARTBEAT_S

#: A heartbeat older than this is late: its process is sampled.
LATE_S = 1.2 * HEARTBEAT_S
#: Maximum time that an interval between two samples counts: a late supervisor was stalled itself.
_INTERVAL_LIMIT_S = 0.25
#: Threads with a smaller share of a core only wake and sleep again.
_IDLE_SHARE = 0.02
#: Share of the whole patience for a process that is unlikely to answer.
_BLOCKED_SHARE, _STOPPED_SHARE = 0.5, 0.2
#: `CPUCLOCK_SCHED` of the kernel: time on a core of a process, threads that have ended included.
_CPU_CLOCK = 2


class Doing(StrEnum):
    """Activity of a silent process; completes "it ..."."""

    BUSY = "is busy"
    STARVED = "waits for a core"
    BLOCKED = "is blocked"
    DISK = "waits for a disk"
    STOPPED = "is stopped"
    TRACED = "is held by a debugger"
    UNSEEN = "cannot be looked at"


@dataclass(frozen=True)
class Sample:
    """A process at one time: its threads' states (letters as in /proc/PID/stat) and their accumulated times, summed.

    `cpu_s` on a core, `waited_s` for one; the kernel adds a wait when it has ended. No states: it cannot be seen.
    """

    time_s: float
    states: str
    cpu_s: float
    waited_s: float


class Silence:
    """The time since a process was last heard, as far as it counts against it."""

    def __init__(self) -> None:
        self._last: Sample | None = None
        #: Activity between the last two samples; None before there are two.
        self.doing: Doing | None = None
        #: Time silent though it could have sent a message; it was not sampled earlier.
        self.answerable_s = LATE_S
        #: Duration of its present activity, or of the one before it began to wait for a core.
        self.lasting_s = 0.0
        self._lasting: Doing | None = None

    def add(self, sample: Sample) -> None:
        """Add the next sample, later than the one before."""
        last, self._last = self._last, sample
        if last is None:
            return
        interval_s = min(sample.time_s - last.time_s, _INTERVAL_LIMIT_S)
        doing = _doing(last, sample)
        self.doing = doing
        if doing is not Doing.STARVED:
            # a thread that wakes to wait for a core does not end a block: the bus's own does so with every message
            self.lasting_s = interval_s + (self.lasting_s if doing is self._lasting else 0.0)
            self._lasting = doing
        if doing not in (Doing.STARVED, Doing.TRACED):
            # the sum falls when a thread has ended
            waited_s = max(0.0, sample.waited_s - last.waited_s)
            self.answerable_s += max(0.0, interval_s - waited_s)

    def overdue(self, patience_s: float, is_starting: bool = False) -> str:
        """Return why it is to be given up, if a working one may be silent for `patience_s`; empty while it is not.

        A starting process may be blocked for all of it: it waits for a device.
        """
        if self.doing is Doing.STOPPED and self.lasting_s >= _STOPPED_SHARE * patience_s:
            return f"stopped for {self.lasting_s:.1f} s"
        if self.doing is Doing.BLOCKED and not is_starting and self.lasting_s >= _BLOCKED_SHARE * patience_s:
            return f"blocked for {self.lasting_s:.1f} s"
        return f"silent for {patience_s:g} s, it {self.doing}" if self.answerable_s > patience_s else ""


def _doing(last: Sample, sample: Sample) -> Doing:
    """Return the activity of a process between two samples."""
    if not sample.states:
        return Doing.UNSEEN
    if "t" in sample.states:
        return Doing.TRACED
    if set(sample.states) == {"T"}:
        return Doing.STOPPED
    if sample.cpu_s - last.cpu_s >= _IDLE_SHARE * (sample.time_s - last.time_s):
        return Doing.BUSY
    if "R" in sample.states:
        return Doing.STARVED
    return Doing.DISK if "D" in sample.states else Doing.BLOCKED


def sample(pid: int) -> Sample:
    """Return the process `pid` now; without states if it has ended or cannot be seen."""
    states, cpu_s, waited_ns = "", 0.0, 0
    with contextlib.suppress(OSError):
        # of the whole process, because the times of a thread end with it
        cpu_s = time.clock_gettime(~pid << 3 | _CPU_CLOCK)
        for thread in Path(f"/proc/{pid}/task").iterdir():
            # a thread that ends meanwhile has no data
            with contextlib.suppress(OSError, IndexError):
                # the name in brackets may hold anything
                states += (thread / "stat").read_text(errors="replace").rpartition(")")[2].split()[0]
                # not every kernel reports it
                waited_ns += int((thread / "schedstat").read_text().split()[1])
    return Sample(time.monotonic(), states, cpu_s, 1e-9 * waited_ns)
