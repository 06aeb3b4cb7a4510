"""Shared parts of the reports of all studies: how a run was made, intervals and quantiles, the two files."""

from __future__ import annotations

import math
import os
import platform
from importlib.metadata import version
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from lab.measures.frame_scores import Estimate
from msgs.files.checksums import json_lines
from msgs.files.whole_files import write_whole
from msgs.values.wording import counted

#: Draws of a bootstrap interval.
DRAWS = 1000
#: A machine is busy beyond this load of a core before a run, or where timed sections wait for a core so often.
MAX_LOAD, MAX_WAITED = 0.5, 0.1
#: A quantile needs so many samples to be printed.
SAMPLES_FOR = {"p50": 2, "p90": 20, "p99": 200}


class Provenance(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Origin of a run; every report begins with it."""

    command: str
    machine: str
    versions: dict[str, str]
    seed: int

    @property
    def packages(self) -> str:
        """The versions in one line."""
        return ", ".join(f"{name} {version}" for name, version in self.versions.items())


class Interval(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A value with its 95 % interval over bootstrap draws of the frames; null where it has none."""

    value: float | None
    low: float | None
    high: float | None

    @classmethod
    def of(cls, estimate: Estimate) -> Interval:
        """Return the interval of an estimate, whose NaN become null."""
        return cls(value=finite(estimate.value), low=finite(estimate.low), high=finite(estimate.high))


class Times(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Quantiles in milliseconds; null where there are too few samples for one."""

    p50: float | None
    p90: float | None
    p99: float | None


def finite(value: float) -> float | None:
    """Return a number that JSON holds, else None."""
    return float(value) if math.isfinite(value) else None


def quantiles_ms(samples_ms: np.ndarray) -> Times:
    """Return the quantiles that a number of samples can carry."""
    quantiles = {name: float(np.quantile(samples_ms, float(name[1:]) / 100.0)) for name in SAMPLES_FOR}
    return Times(**{name: value if samples_ms.size >= SAMPLES_FOR[name] else None for name, value in quantiles.items()})


def machine() -> str:
    """Return processor, cores and system."""
    return f"{platform.processor() or platform.machine()}, {counted(os.cpu_count() or 1, 'core')}, {platform.system()}"


def load_per_core() -> float:
    """Return how many processes wanted each core in the last minute."""
    return os.getloadavg()[0] / (os.cpu_count() or 1)


def busy_reason(load_before: float, waited: float = 0.0) -> str:
    """Return why measured times do not count, "" where they do.

    `load_before`: `load_per_core` before the run; `waited`: share of the timed sections that was no CPU time.
    """
    reasons = []
    if load_before > MAX_LOAD:
        reasons.append(f"{load_before:.2f} processes wanted each core before it began (limit {MAX_LOAD:g})")
    if waited > MAX_WAITED:
        reasons.append(f"it waited for a core {100.0 * waited:.0f} % of the time (limit {100.0 * MAX_WAITED:g} %)")
    return " and ".join(reasons)


def busy_lines(busy: str) -> list[str]:
    """Return what a page says of a machine that was busy, and why; nothing where it was not."""
    return ["", f"**The times do not count**: the machine was busy. {busy}."] if busy else []


def versions() -> dict[str, str]:
    """Return the versions of what times depend on."""
    packages = ("mirrorwave", "numpy", "scipy", "numba", "onnxruntime", "pyzmq", "msgspec")
    return {"python": platform.python_version()} | {name: version(name) for name in packages}


def write_report(out: Path, name: str, report: Any, page: str) -> None:
    """Write `name`.json and `name`.md into a folder, which is made where it is not there."""
    out.mkdir(parents=True, exist_ok=True)
    write_whole(out / f"{name}.json", json_lines(report))
    write_whole(out / f"{name}.md", page.encode())
