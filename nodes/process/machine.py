"""The machine and the software that a program runs on, as recordings name them."""

from __future__ import annotations

import importlib.metadata
import os
import platform
from pathlib import Path
from typing import Any

#: Instructions that products of whole numbers run on, the best first; below AVX2, and on ARM, floats between them are
#: rounded otherwise.
_INTEGER_KERNELS = {
    "avx512_vnni": "AVX-512 VNNI",
    "avx_vnni": "AVX VNNI",
    "avx2": "AVX2",
    "i8mm": "ARM I8MM",
    "asimddp": "ARM dot product",
}
_CPUINFO = Path("/proc/cpuinfo")
_PACKAGES = ("mirrorwave", "numpy", "scipy", "onnxruntime", "pyzmq", "msgspec", "mcap", "zstandard")


def machine_facts() -> dict[str, Any]:
    """Return processor, cores, memory in bytes, kernel, Python and package versions; no name and no address."""
    return {
        "processor": _fact(_CPUINFO, "model name") or platform.machine(),
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


def integer_kernels(cpuinfo: Path = _CPUINFO) -> str:
    """Return the instructions that networks of whole numbers run on, as this processor names its own."""
    flags = {word for key in ("flags", "Features") for word in _fact(cpuinfo, key).split()}
    return next((name for flag, name in _INTEGER_KERNELS.items() if flag in flags), f"{platform.machine()} alone")


def _fact(cpuinfo: Path, key: str) -> str:
    """Return what the first line of a key says; empty where there is none."""
    lines = (line.partition(":") for line in _lines(cpuinfo))
    return next((value.strip() for name, _, value in lines if name.strip() == key), "")


def installed_version(package: str) -> str | None:
    """Return the version of an installed package, None where it is not installed."""
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return None
