"""The most accurate profile that fits a latency budget on this machine: tried live, remembered after that.

A trial beside other work says nothing of the machine alone: it decides this once and is not kept. That no profile fits
is never taken from memory.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import resource
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import msgspec
import psutil

from lab.studies.report import busy_reason, load_per_core, machine, versions
from lab.tradeoff.rows import profiles
from msgs.bus.zmq import ZmqBus, run_dir
from msgs.files.checksums import json_lines
from msgs.files.shipped import CHECKOUT, LAUNCH, RESULTS
from msgs.files.whole_files import write_whole
from msgs.values.perception import BevFrame
from msgs.values.radar import RadarSetup
from nodes.inputs.view_latency import latency_ns, scan_period_s
from nodes.process.machine import quota_cores

#: The committed losses of the profiles (`python -m benchmarks.accuracy.profile_losses`).
COMMITTED = RESULTS / "profiles.json"
#: What is tried: a graph with a simulated radar, so that its nodes have no more of the machine than they have in use.
TRIED = LAUNCH / "corner.yaml"
#: Scans of a trial, and those before them in which kernels and caches are still filled.
SCANS, SETTLING_SCANS = 20, 10
#: Scans of a trial that may lack a view: the first and the last may lie outside it.
MISSING_SCANS = 2
#: The slowest view of a trial, times this, is what one in a hundred must be expected to need.
MARGIN = 1.25
#: A trial counts while all other processes use less than this share of the cores.
OTHERS_SHARE = 0.2
_START_S, _STOP_S = 120.0, 20.0
#: Caches of another version hold trials of which nobody knows whether the machine was busy.
_CACHE_VERSION = 2


class ProfileLoss(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Missed objects and false reports a scan of a profile with these parameters."""

    profile: str
    params: dict[str, dict[str, Any]]
    loss: float


class ProfileLosses(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The losses of all profiles on the same places, and the command that measured them."""

    command: str
    rows: list[ProfileLoss]


class Timed(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A profile on this machine: how long it must be expected to take from the last beam to the view, in ms; None where
    it does not keep up with the radar. Of the trial's scans so many brought a view.
    """

    profile: str
    loss: float
    expected_ms: float | None
    views: int = SCANS


class Trial(msgspec.Struct, frozen=True, kw_only=True):
    """Latencies of the views of a graph, and how many cores all other processes used meanwhile."""

    latencies_ms: list[float]
    others_cores: float = 0.0


class _CachedTimes(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Times measured on a machine of this kind with these profiles and packages."""

    key: str
    timed: list[Timed]


def pick(budget_ms: float, remeasure: bool = False, note: Callable[[str], None] = lambda text: None) -> list[Timed]:
    """Try profiles in order of their loss, from memory where nothing has changed; the last one fits the budget.

    `note` gets a line before each trial, and what of it is not kept. Raises `ValueError` with all that was measured
    where none fits.
    """
    if not 0.0 < budget_ms < float("inf"):
        raise ValueError(f"--latency-budget-ms must be positive and finite, got {budget_ms}")
    losses, path = _known(), cache_path()
    memory = _Memory(path, _key(losses), remeasure)
    load, busy = load_per_core(), ""
    timed: list[Timed] = []
    for again in (False, True):
        timed = []
        for candidate in losses:
            known = memory.kept.get(candidate.profile)
            if known is None or (again and candidate.profile not in memory.measured):
                note(f"trying profile {candidate.profile} on this machine")
                trial = run_live(candidate.profile, SCANS)
                known = _timed(candidate, trial)
                cores = os.cpu_count() or 1
                reasons = [busy_reason(load)]
                if trial.others_cores > OTHERS_SHARE * cores:
                    reasons.append(
                        f"other processes used {trial.others_cores:.1f} of {cores} cores "
                        f"(limit {OTHERS_SHARE * cores:g})"
                    )
                busy = " and ".join(filter(None, reasons))
                if busy:
                    note(f"profile {candidate.profile} is not remembered, the machine is busy: {busy}")
                memory.keep(known, is_lasting=not busy)
            timed.append(known)
            if known.expected_ms is not None and known.expected_ms <= budget_ms:
                return timed
        if memory.measured >= {row.profile for row in losses}:
            break
    raise ValueError(
        f"--latency-budget-ms: no profile fits {budget_ms:g} ms on this machine; "
        + ", ".join(f"{row.profile} would {_need(row)}" for row in timed)
        + (f"; the machine is busy: {busy}" if busy else "")
    )


def reason(budget_ms: float, timed: list[Timed]) -> str:
    """Return the reason for the last profile of those tried, in one line, and where it is remembered."""
    *better, picked = timed
    slower = ", ".join(f"{candidate.profile} would {_need(candidate)}" for candidate in better)
    return (
        f"profile {picked.profile}: expected {picked.expected_ms:.0f} of {budget_ms:g} ms from the last beam, "
        f"loss {picked.loss:.2f}; {slower or 'none is more accurate'}; trials of an idle "
        f"machine are kept in {cache_path()}, --remeasure repeats them"
    )


class _Memory:
    """Trials by profile: those of the cache, and those of this run, of which only lasting ones go into the cache."""

    def __init__(self, path: Path, key: str, forget: bool) -> None:
        cached = None if forget else _recall(path)
        self._path, self._key = path, key
        self.kept = {row.profile: row for row in cached.timed} if cached is not None and cached.key == key else {}
        self._lasting = dict(self.kept)
        #: Profiles tried in this run.
        self.measured: set[str] = set()

    def keep(self, timed: Timed, is_lasting: bool) -> None:
        """Take in a trial of this run; a failure to write the cache costs no more than the next run's time."""
        self.kept[timed.profile] = timed
        self.measured.add(timed.profile)
        # a verdict that did not hold now is gone as well
        self._lasting.pop(timed.profile, None)
        if is_lasting:
            self._lasting[timed.profile] = timed
        with contextlib.suppress(OSError):
            self._path.parent.mkdir(parents=True, exist_ok=True)
            write_whole(self._path, json_lines(_CachedTimes(key=self._key, timed=list(self._lasting.values()))))


def _timed(candidate: ProfileLoss, trial: Trial) -> Timed:
    views = len(trial.latencies_ms)
    expected_ms = MARGIN * max(trial.latencies_ms) if views >= max(SCANS - MISSING_SCANS, 1) else None
    return Timed(profile=candidate.profile, loss=candidate.loss, expected_ms=expected_ms, views=views)


def _cpu_s() -> tuple[float, float]:
    """Return the CPU seconds of all processes so far, and those of this one and of its children that have ended."""
    times = psutil.cpu_times()._asdict()
    own = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    everything = sum(times.get(name, 0.0) for name in ("user", "nice", "system", "irq", "softirq", "steal"))
    return everything, sum(usage.ru_utime + usage.ru_stime for usage in own)


def run_live(profile: str, scans: int) -> Trial:
    """Run the graph with a profile for so many scans; milliseconds from last beam to view of each, none if it fails."""
    start_s, before = time.monotonic(), _cpu_s()
    latencies_ms = _live_latencies_ms(profile, scans)
    everything_s, own_s = (after - earlier for after, earlier in zip(_cpu_s(), before, strict=True))
    return Trial(latencies_ms=latencies_ms, others_cores=max(everything_s - own_s, 0.0) / (time.monotonic() - start_s))


def _live_latencies_ms(profile: str, scans: int) -> list[float]:
    period_s = scan_period_s(RadarSetup())
    domain = f"budget{os.getpid()}"
    command = [sys.executable, "-m", "mirrorwave", "launch", str(TRIED), "--headless", "--domain", domain]
    observer = contextlib.closing(ZmqBus("observer", run_dir(domain)))
    with TemporaryDirectory(prefix="mirrorwave-") as folder, observer as bus:
        bus.subscribe("perception/hidden_objects")
        graph = subprocess.Popen(
            [*command, "--profile", profile, "--runs-dir", folder],
            cwd=CHECKOUT,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            start_new_session=True,
        )
        try:
            deadline_s = time.monotonic() + _START_S
            while not _latencies_ms(bus, 0.5):
                if graph.poll() is not None or time.monotonic() > deadline_s:
                    return []
            _latencies_ms(bus, SETTLING_SCANS * period_s)
            return _latencies_ms(bus, scans * period_s)
        finally:
            _stop(graph)
            shutil.rmtree(run_dir(domain), ignore_errors=True)


def _latencies_ms(bus: ZmqBus, duration_s: float) -> list[float]:
    """Return the latencies of the views that come within a time."""
    latencies_ms = []
    end_s = time.monotonic() + duration_s
    while (left_s := end_s - time.monotonic()) > 0.0:
        views = [received.message for received in bus.receive(left_s)]
        now_ns = bus.now_ns()
        latencies_ms += [1e-6 * latency_ns(view.stamp_ns, now_ns) for view in views if isinstance(view, BevFrame)]
    return latencies_ms


def _stop(graph: subprocess.Popen[bytes]) -> None:
    """End a graph as Ctrl-C does, or at once where that takes too long."""
    with contextlib.suppress(ProcessLookupError):
        os.killpg(graph.pid, signal.SIGINT)
    try:
        graph.wait(_STOP_S)
    except subprocess.TimeoutExpired:
        graph.kill()
        graph.wait()


def _need(timed: Timed) -> str:
    if timed.expected_ms is None:
        return f"leave out scans ({timed.views} of {SCANS} views came)"
    return f"need {timed.expected_ms:.0f} ms"


def _known() -> list[ProfileLoss]:
    """Profiles whose loss is known for their present parameters, the most accurate first.

    Of several with the same parameters the first in the order of `profiles`. Raises `ValueError` where there is none.
    """
    measured = msgspec.json.decode(COMMITTED.read_bytes(), type=ProfileLosses)
    present = {row.name: row.params for row in profiles()}
    rows: list[ProfileLoss] = []
    by_name = {row.profile: row for row in measured.rows}
    for row in (by_name[name] for name in present if name in by_name):
        if present[row.profile] == row.params and all(row.params != other.params for other in rows):
            rows.append(row)
    if not rows:
        raise ValueError(f"{COMMITTED}: must hold a profile with the parameters of launch/profiles, holds none")
    return sorted(rows, key=lambda row: row.loss)


def cache_path() -> Path:
    """Return the path of the cached times."""
    base = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(base) / "mirrorwave" / "latency.json"


def _key(losses: list[ProfileLoss]) -> str:
    """Changes with the machine, what of it this process may use, the packages, the profiles and their accuracy."""
    usable = {"cores": sorted(os.sched_getaffinity(0)), "quota_cores": quota_cores()}
    facts = {"cache": _CACHE_VERSION, "machine": machine(), **usable, "versions": versions(), "losses": losses}
    return hashlib.sha256(msgspec.json.encode(facts, order="deterministic")).hexdigest()


def _recall(path: Path) -> _CachedTimes | None:
    """Read the cached times; None where there is no such file or its content is not understood."""
    try:
        return msgspec.json.decode(path.read_bytes(), type=_CachedTimes)
    except (OSError, msgspec.DecodeError, UnicodeError, RecursionError):
        return None
