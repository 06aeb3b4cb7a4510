"""The machine and the software that a program runs on, as recordings name them."""

from __future__ import annotations

import importlib.metadata
import os
import platform
from pathlib import Path
from typing import Any

_PACKAGES = ("mirrorwave", "numpy", "scipy", "onnxruntime", "pyzmq", "msgspec", "mcap", "zstandard")


def machine_facts() -> dict[str, Any]:
    """Return processor, cores, memory in bytes, kernel, Python and package versions; no name and no address."""
    return {
        "processor": _processor(),
        "cores": os.cpu_count(),
        "memory_bytes": os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES"),
        "kernel": f"{platform.system()} {platform.release()}",
        "python": platform.python_version(),
        "packages": {name: version for name in _PACKAGES if (version := installed_version(name))},
    }


def quota_cores(memberships: Path = Path("/proc/self/cgroup"), root: Path = Path("/sys/fs/cgroup")) -> float | None:
    """Return the processor time that control groups grant this process, in cores; None without a limit."""
    limits = []
    for line in _lines(memberships):
        _, controllers, path = line.split(":", 2)
        if controllers == "" or "cpu" in controllers.split(","):
            top = root / controllers
            folder = top / path.lstrip("/")
            limits += [_limit_cores(group) for group in (folder, *folder.parents) if group.is_relative_to(top)]
    return min((limit for limit in limits if limit is not None), default=None)


def _limit_cores(group: Path) -> float | None:
    """Return the limit of a control group of either version; None where it has none."""
    words = " ".join([*_lines(group / "cpu.max"), *_lines(group / "cpu.cfs_quota_us")]).split()
    words += _lines(group / "cpu.cfs_period_us")
    try:
        quota_us, period_us = (int(word) for word in words)
    except ValueError:
        # no such files, or "max"
        return None
    return quota_us / period_us if quota_us > 0 and period_us > 0 else None


def _lines(path: Path) -> list[str]:
    try:
        return path.read_text(encoding="utf-8", errors="replace").splitlines()
    except OSError:
        return []


def _processor() -> str:
    names = (line.partition(":")[2].strip() for line in _lines(Path("/proc/cpuinfo")) if line.startswith("model name"))
    return next(names, platform.machine())


def installed_version(package: str) -> str | None:
    """Return the version of an installed package, None where it is not installed."""
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return None
