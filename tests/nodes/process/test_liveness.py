"""What a silent process is at, and when it is given up: decisions on samples, without processes but for the reading."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time

import pytest

from nodes.process.liveness import LATE_S, Doing, Sample, Silence, sample

#: Distance of two looks at a silent process.
STEP_S = 0.05


def _look(
    states: str, seconds: float, *, cpu: float = 0.0, waited: float = 0.0, silence: Silence | None = None
) -> Silence:
    """A silence of so many seconds at steady shares on a core and waiting for one, after `silence`."""
    silence = silence or Silence()
    last = silence._last
    if last is None:
        last = Sample(100.0, states, 1.0, 1.0)
        silence.add(last)
    for index in range(1, round(seconds / STEP_S) + 1):
        passed_s = index * STEP_S
        silence.add(
            Sample(last.time_s + passed_s, states, last.cpu_s + cpu * passed_s, last.waited_s + waited * passed_s)
        )
    return silence


@pytest.mark.parametrize(
    ("states", "cpu", "doing"),
    [
        ("RSS", 1.0, Doing.BUSY),
        # a step that waits for its own threads, and a loop that sleeps between its bursts
        ("SSR", 0.5, Doing.BUSY),
        ("SSS", 0.5, Doing.BUSY),
        ("RSS", 0.0, Doing.STARVED),
        # a tick of another thread's housekeeping is no work
        ("SSS", 0.001, Doing.BLOCKED),
        ("DSS", 0.0, Doing.DISK),
        ("TTT", 0.0, Doing.STOPPED),
        ("tSS", 0.0, Doing.TRACED),
    ],
)
def test_what_it_is_at(states: str, cpu: float, doing: Doing) -> None:
    assert _look(states, 0.2, cpu=cpu).doing is doing


def test_one_look_tells_nothing() -> None:
    assert _look("S", 0.0).doing is None
    assert _look("S", 0.0).overdue(0.7) == ""


@pytest.mark.parametrize(
    ("states", "cpu", "last_s", "reason"),
    [
        ("S", 0.0, 2.5, "blocked for 2.5 s"),
        ("T", 0.0, 1.0, "stopped for 1.0 s"),
        ("R", 1.0, 5.0 - LATE_S + STEP_S, "silent for 5 s, it is busy"),
        ("D", 0.0, 5.0 - LATE_S + STEP_S, "silent for 5 s, it waits for a disk"),
    ],
)
def test_the_patience_with_each(states: str, cpu: float, last_s: float, reason: str) -> None:
    assert _look(states, last_s - 2 * STEP_S, cpu=cpu).overdue(5.0) == ""
    assert _look(states, last_s, cpu=cpu).overdue(5.0) == reason


@pytest.mark.parametrize("states", ["R", "t"])
def test_a_starved_or_debugged_process_is_never_given_up(states: str) -> None:
    assert _look(states, 600.0).overdue(5.0) == ""


def test_time_spent_waiting_for_a_core_is_not_held_against_it() -> None:
    # it gets a tenth of a core, on average: ten times the patience
    assert _look("R", 43.0, cpu=0.1, waited=0.9).overdue(5.0) == ""
    assert _look("R", 45.0, cpu=0.1, waited=0.9).overdue(5.0) == "silent for 5 s, it is busy"


def test_a_wait_that_the_kernel_adds_up_late_gives_no_credit_for_time_before() -> None:
    # four seconds of work, then one interval whose wait comes to ten: no more than that interval is forgiven
    silence = _look("R", 4.0, cpu=1.0)
    last = silence._last
    assert last is not None
    before_s = silence.answerable_s
    silence.add(Sample(last.time_s + STEP_S, "R", last.cpu_s + 0.01, last.waited_s + 10.0))
    assert silence.answerable_s == before_s


def test_work_in_between_begins_the_patience_with_a_block_anew() -> None:
    silence = _look("S", 1.8)
    _look("S", 0.1, cpu=0.5, silence=silence)
    assert _look("S", 2.0, silence=silence).overdue(5.0) == ""


def test_a_block_is_seen_through_threads_that_wake_and_wait_for_a_core() -> None:
    # every other look finds the bus's thread waiting for a core: that time does not count, and ends no block
    silence = Silence()
    for index in range(101):
        silence.add(Sample(STEP_S * index, "SSR" if index % 2 else "SSS", 1.0, 1.0))
    assert silence.overdue(5.1) == ""
    assert silence.overdue(4.9) == "blocked for 2.5 s"


def test_what_starts_may_wait_for_a_device_and_what_nobody_can_see_is_given_up_at_last() -> None:
    assert _look("S", 4.0).overdue(5.0, is_starting=True) == ""
    assert _look("S", 5.0).overdue(5.0, is_starting=True) == "silent for 5 s, it is blocked"
    assert _look("", 4.0).overdue(5.0) == ""
    assert _look("", 5.0).overdue(5.0) == "silent for 5 s, it cannot be looked at"


def test_a_thread_that_ended_gives_and_takes_nothing() -> None:
    silence = _look("R", 1.0, cpu=1.0)
    last = silence._last
    assert last is not None
    before_s = silence.answerable_s
    silence.add(Sample(last.time_s + STEP_S, "R", 0.0, 0.0))
    assert silence.answerable_s <= before_s + STEP_S


def test_who_looks_late_stood_still_himself() -> None:
    silence = _look("S", 0.2)
    last = silence._last
    assert last is not None
    silence.add(Sample(last.time_s + 30.0, "S", last.cpu_s, last.waited_s))
    assert silence.overdue(5.0) == ""


def test_a_process_is_read() -> None:
    with subprocess.Popen([sys.executable, "-c", "input()"], stdin=subprocess.PIPE) as process:
        try:
            _until(process.pid, "S")
            process.send_signal(signal.SIGSTOP)
            _until(process.pid, "T")
        finally:
            process.kill()
        process.wait()
        assert sample(process.pid).states == ""


def _until(pid: int, states: str) -> None:
    """Wait until a process is in such a state."""
    end_s = time.monotonic() + 30.0
    while (seen := sample(pid)).states != states:
        assert time.monotonic() < end_s, f"still {seen}"
        time.sleep(0.01)


def test_cpu_time_is_read() -> None:
    before = sample(os.getpid())
    end_s = time.process_time() + 0.05
    while time.process_time() < end_s:
        pass
    after = sample(os.getpid())
    assert after.cpu_s - before.cpu_s >= 0.03
    assert "R" in after.states


def test_the_work_of_threads_that_have_ended_is_known() -> None:
    before = sample(os.getpid())

    def work() -> None:
        end_s = time.thread_time() + 0.05
        while time.thread_time() < end_s:
            pass

    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    assert sample(os.getpid()).cpu_s - before.cpu_s >= 0.05
