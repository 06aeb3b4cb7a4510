"""The most accurate profile that fits a latency budget on this machine: measured in seconds, remembered after that."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory

import msgspec
import numpy as np

from mirrorwave.studies.report import machine, versions
from mirrorwave.studies.tradeoff.report import latency_ms, point_of, read_report
from mirrorwave.studies.tradeoff.runner import PARTS, Plan, run_plan
from mirrorwave.studies.tradeoff.settings import PROFILE, Setting, profiles
from models.training.files import json_lines
from msgs.files.shipped import RESULTS
from msgs.files.whole_files import write_whole

#: The committed full run: how accurate each profile is.
COMMITTED = RESULTS / "tradeoff.json"
#: Places and repetitions that each profile is timed on here.
PLACES, REPEATS = 2, 6
#: The slowest of these samples, times this, is what the live graph must be expected to need: its processes share cores.
MARGIN = 1.5


class Timed(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A profile on this machine: how long it must be expected to take from the last beam to the view, in ms."""

    profile: str
    recovered_f1_1m: float
    expected_ms: float


class _CachedTimes(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Times measured on a machine of this kind with these profiles and packages."""

    key: str
    timed: list[Timed]


def require_budget(budget_ms: float) -> None:
    """Raise `ValueError` unless a budget is a positive number of milliseconds."""
    if not 0.0 < budget_ms < float("inf"):
        raise ValueError(f"--latency-budget-ms must be positive and finite, got {budget_ms}")


def pick(budget_ms: float, timed: list[Timed]) -> Timed:
    """The most accurate profile that fits, the faster of equals; `ValueError` naming the nearest where none does."""
    fitting = [candidate for candidate in timed if candidate.expected_ms <= budget_ms]
    if not fitting:
        nearest = min(timed, key=lambda candidate: candidate.expected_ms)
        raise ValueError(
            f"--latency-budget-ms: no profile fits {budget_ms:g} ms on this machine; the nearest is "
            f"{nearest.profile}, which needs {nearest.expected_ms:.0f} ms"
        )
    return max(fitting, key=lambda candidate: (candidate.recovered_f1_1m, -candidate.expected_ms))


def reason(budget_ms: float, picked: Timed, timed: list[Timed]) -> str:
    """Return the reason for this profile, in one line."""
    better = [candidate for candidate in timed if candidate.recovered_f1_1m > picked.recovered_f1_1m]
    slower = ", ".join(f"{candidate.profile} would need {candidate.expected_ms:.0f} ms" for candidate in better)
    return (
        f"profile {picked.profile}: expected {picked.expected_ms:.0f} of {budget_ms:g} ms from the last beam, "
        f"recovered F1 {picked.recovered_f1_1m:.3f}; " + (slower or "none is more accurate")
    )


def timed_profiles(remeasure: bool = False, tick: Callable[[], None] = lambda: None) -> list[Timed]:
    """All profiles of known accuracy with their times here, from memory unless something changed or `remeasure`."""
    rows, path = _known(), cache_path()
    key = _key(rows)
    if not remeasure and (cached := _recall(path)) is not None and cached.key == key:
        return cached.timed
    timed = measure(rows, tick)
    path.parent.mkdir(parents=True, exist_ok=True)
    write_whole(path, json_lines(_CachedTimes(key=key, timed=timed)))
    return timed


def measure(rows: dict[str, tuple[Setting, float]], tick: Callable[[], None] = lambda: None) -> list[Timed]:
    """Time profiles on a few places; those that cannot run here are left out."""
    plan = Plan(rows=[row for row, _ in rows.values()], frames=PLACES, repeats=REPEATS)
    with TemporaryDirectory(prefix="mirrorwave-") as folder:
        results = run_plan(plan, Path(folder), tick)
    timed = []
    for name, (_, accuracy) in rows.items():
        if any(name in result.failed for result in results):
            continue
        parts = latency_ms([result.times_ms[name] for result in results])
        slowest_ms = float(np.sum([parts[part] for part in PARTS], axis=0).max())
        timed.append(Timed(profile=name, recovered_f1_1m=accuracy, expected_ms=MARGIN * slowest_ms))
    return timed


def _known() -> dict[str, tuple[Setting, float]]:
    """Profiles with the recovered F1 that the committed run found for the same parameters.

    Raises `ValueError` where it knows none.
    """
    measured = {row.name: row for row in read_report(COMMITTED).rows if row.switch == PROFILE}
    committed = {}
    for row in profiles():
        report_row = measured.get(row.name)
        if report_row is not None and report_row.params == row.params and (point := point_of(report_row)) is not None:
            committed[row.name] = (row, point[1])
    if not committed:
        raise ValueError(f"{COMMITTED}: must hold a profile with the parameters of launch/profiles, holds none")
    return committed


def cache_path() -> Path:
    """Return the path of the cached times."""
    base = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(base) / "mirrorwave" / "latency.json"


def _key(rows: dict[str, tuple[Setting, float]]) -> str:
    """Changes with the machine, the packages, the profiles and their accuracy."""
    facts = {"machine": machine(), "cores": sorted(os.sched_getaffinity(0)), "versions": versions(), "rows": rows}
    return hashlib.sha256(msgspec.json.encode(facts, order="deterministic")).hexdigest()


def _recall(path: Path) -> _CachedTimes | None:
    """Read the cached times; None where there is no such file or its content is not understood."""
    try:
        return msgspec.json.decode(path.read_bytes(), type=_CachedTimes)
    except (OSError, msgspec.DecodeError, UnicodeError, RecursionError):
        return None
