"""What a node that has fallen silent is at, from what the kernel says of its process: a decision on samples alone.

A node on an overloaded machine is silent too, and to kill it would be wrong: only time in which it had a core, or
asked for none, is held against it.
"""

from __future__ import annotations

import contextlib
import time
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path

from nodes.node import HEARTBEAT_S

#: A heartbeat older than this is late: its process is looked at.
LATE_S = 1.2 * HEARTBEAT_S
#: An interval between two looks counts no more than this: whoever looks late stood still himself.
_INTERVAL_LIMIT_S = 0.25
#: Threads that got less of a core do nothing but wake and fall asleep again.
_IDLE_SHARE = 0.02
#: What will hardly answer any more is not waited for as long as what works: share of the whole patience.
_BLOCKED_SHARE, _STOPPED_SHARE = 0.5, 0.2
#: `CPUCLOCK_SCHED` of the kernel: the time that a process, threads that have ended included, was on a core.
_CPU_CLOCK = 2


class Doing(StrEnum):
    """What a silent process is at; completes "it ..."."""

    BUSY = "is busy"
    STARVED = "waits for a core"
    BLOCKED = "is blocked"
    DISK = "waits for a disk"
    STOPPED = "is stopped"
    TRACED = "is held by a debugger"
    UNSEEN = "cannot be looked at"


@dataclass(frozen=True)
class Sample:
    """A process at one time: its threads' states (letters as in /proc/PID/stat) and what they had by then, summed.

    `cpu_s` on a core, `waited_s` for one; the kernel adds a wait up when it has ended. No states: it cannot be seen.
    """

    time_s: float
    states: str
    cpu_s: float
    waited_s: float


class Silence:
    """The time since a process was last heard, as far as it can be held against it."""

    def __init__(self) -> None:
        self._last: Sample | None = None
        #: What it was at between the last two samples; None before there are two.
        self.doing: Doing | None = None
        #: Silent though it could have spoken; it was looked at no earlier.
        self.answerable_s = LATE_S
        #: How long it has been at what it is at, or was before it began to wait for a core.
        self.lasting_s = 0.0
        self._lasting: Doing | None = None

    def add(self, sample: Sample) -> None:
        """Take in the next sample, later than the one before."""
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
            # the sum falls where a thread has ended
            waited_s = max(0.0, sample.waited_s - last.waited_s)
            self.answerable_s += max(0.0, interval_s - waited_s)

    def overdue(self, patience_s: float, is_starting: bool = False) -> str:
        """Why it is to be given up, if what works may be silent for `patience_s`; empty while it is not.

        What is starting may be blocked for all of it: it waits for a device.
        """
        if self.doing is Doing.STOPPED and self.lasting_s >= _STOPPED_SHARE * patience_s:
            return f"stopped for {self.lasting_s:.1f} s"
        if self.doing is Doing.BLOCKED and not is_starting and self.lasting_s >= _BLOCKED_SHARE * patience_s:
            return f"blocked for {self.lasting_s:.1f} s"
        return f"silent for {patience_s:g} s, it {self.doing}" if self.answerable_s > patience_s else ""


def _doing(last: Sample, sample: Sample) -> Doing:
    """What a process was at between two samples."""
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
    """Return the process `pid` now; without states where it has gone or cannot be seen."""
    states, cpu_s, waited_ns = "", 0.0, 0
    with contextlib.suppress(OSError):
        # of the whole process, because the times of a thread go with it
        cpu_s = time.clock_gettime(~pid << 3 | _CPU_CLOCK)
        for thread in Path(f"/proc/{pid}/task").iterdir():
            # one that ends meanwhile says nothing
            with contextlib.suppress(OSError, IndexError):
                # the name in brackets may hold anything
                states += (thread / "stat").read_text(errors="replace").rpartition(")")[2].split()[0]
                # not every kernel says so
                waited_ns += int((thread / "schedstat").read_text().split()[1])
    return Sample(time.monotonic(), states, cpu_s, 1e-9 * waited_ns)
