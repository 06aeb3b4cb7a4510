"""The doctor's checks of this machine: packages, processor, disk, clock, buses, weights; then the graph."""

from __future__ import annotations

import hashlib
import importlib
import importlib.metadata
import json
import os
import re
import sys
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path

from mirrorwave.console import error_line
from mirrorwave.diagnose.findings import Finding, Status
from msgs.files.shipped import WEIGHTS
from nodes.process.machine import installed_version, integer_kernels

_MIB = 1 << 20
#: Package -> module to import: importing it is what finds a missing shared library.
_PACKAGES = {
    "numpy": "numpy",
    "scipy": "scipy.linalg",
    "numba": "numba",
    "trimesh": "trimesh",
    "onnxruntime": "onnxruntime",
    "pyzmq": "zmq",
    "msgspec": "msgspec",
    "mcap": "mcap",
    "zstandard": "zstandard",
    "lz4": "lz4.frame",
    "sigmf": "sigmf",
    "jsonschema": "jsonschema",
    "PyYAML": "yaml",
    "typer": "typer",
    "rich": "rich",
    "matplotlib": "matplotlib",
    "psutil": "psutil",
    "threadpoolctl": "threadpoolctl",
    "python-can": "can",
    "cantools": "cantools",
    "starlette": "starlette",
    "uvicorn": "uvicorn",
    "websockets": "websockets",
}
#: Below this the graph's buffers and networks do not fit beside anything else.
_MEMORY_NEEDED_BYTES = 1 << 30
#: A requirement of an extra, as the metadata of an installation has it.
_EXTRA = re.compile(r"""(?P<name>[A-Za-z0-9_.-]+).*;.*extra == ['"](?P<extra>[^'"]+)['"]""")
_CLOCK_SOURCE = Path("/sys/devices/system/clocksource/clocksource0/current_clocksource")
#: How the kernel numbers the kind of a network interface (ARPHRD_CAN).
_CAN_DEVICE = "280"
#: Where `bev_viewer` serves unless told otherwise.
_VIEWER_PORT = 8765


def all_findings(domain: str) -> list[Finding]:
    """Every check in a fixed order; one that cannot run has failed."""
    from mirrorwave.diagnose.doctor_graph import check_room, graph_findings
    from mirrorwave.diagnose.node_types import plugin_findings
    from msgs.bus.zmq import run_dir

    checks: dict[str, Callable[[], Iterator[Finding]]] = {
        "python": check_python,
        "packages": check_packages,
        "extras": check_extras,
        "processor": check_processor,
        "disk": lambda: iter([check_room("disk", Path.cwd())]),
        "clock": check_clock,
        "can": check_can,
        "weights": lambda: check_weights(WEIGHTS),
        "plug-ins": lambda: iter(plugin_findings()),
        "run directory": lambda: check_run_dir(run_dir(domain)),
        "viewer port": check_viewer_port,
        "graph": lambda: graph_findings(run_dir(domain)),
    }
    findings: list[Finding] = []
    for name, check in checks.items():
        try:
            findings += check()
        except Exception as error:  # noqa: BLE001 - whatever stops a check is what the doctor has to report
            findings.append(Finding(name, Status.FAILED, f"{type(error).__name__}: {error_line(error)}"))
    return findings


def check_python() -> Iterator[Finding]:
    """Python is new enough."""
    fits = sys.version_info >= (3, 11)
    yield Finding("python", Status.OK if fits else Status.FAILED, f"{sys.version.split()[0]} (needs 3.11)")


def check_packages() -> Iterator[Finding]:
    """Every package is there and its shared libraries load."""
    for package, module in _PACKAGES.items():
        try:
            importlib.import_module(module)
            yield Finding(package, Status.OK, importlib.metadata.version(package))
        except (ImportError, OSError) as error:
            yield Finding(package, Status.FAILED, error_line(error))


def check_extras() -> Iterator[Finding]:
    """Check which optional packages are installed, by extra, and name the command for the rest."""
    declared = importlib.metadata.metadata("mirrorwave").get_all("Provides-Extra") or ()
    optional = [_EXTRA.match(line) for line in importlib.metadata.requires("mirrorwave") or ()]
    for extra in declared:
        names = [match["name"] for match in optional if match and match["extra"] == extra]
        absent = [name for name in names if name != "mirrorwave" and installed_version(name) is None]
        hint = f"not installed: {', '.join(absent)}; pip install 'mirrorwave[{extra}]'" if absent else ", ".join(names)
        yield Finding(f"extra {extra}", Status.OK, hint)


def check_clock() -> Iterator[Finding]:
    """The clock that stamps come from: reading it must cost nothing, and it must be as fine as a beam's time."""
    import time

    source = _CLOCK_SOURCE.read_text().strip() if _CLOCK_SOURCE.is_file() else "unknown"
    resolution_ns = 1e9 * time.get_clock_info("monotonic").resolution
    slow = source in ("hpet", "acpi_pm", "jiffies", "refined-jiffies") or resolution_ns > 1e5
    detail = f"source {source}, {resolution_ns:g} ns"
    yield Finding("clock", Status.WARNING if slow else Status.OK, detail + (": slow or coarse" if slow else ""))


def check_can() -> Iterator[Finding]:
    """CAN interfaces of this machine; having none is no fault."""
    names = [
        path.parent.name
        for path in sorted(Path("/sys/class/net").glob("*/type"))
        if path.read_text().strip() == _CAN_DEVICE
    ]
    yield Finding("can", Status.OK, ", ".join(names) or "no interface of the kernel (virtual buses and logs work)")


def check_viewer_port() -> Iterator[Finding]:
    """Check that the viewer's usual port is free."""
    import socket

    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind(("127.0.0.1", _VIEWER_PORT))
        except OSError:
            detail = f"{_VIEWER_PORT} is taken, by a viewer that runs or by another program; the next gets a free one"
            yield Finding("viewer port", Status.OK, detail)
            return
    yield Finding("viewer port", Status.OK, f"{_VIEWER_PORT} is free")


def check_processor() -> Iterator[Finding]:
    """Cores, memory, and a compiler that works."""
    import numba
    import psutil

    yield Finding("cores", Status.OK, f"{len(os.sched_getaffinity(0))} usable; int8 networks on {integer_kernels()}")
    free = psutil.virtual_memory().available
    enough = free >= _MEMORY_NEEDED_BYTES
    yield Finding("memory", Status.OK if enough else Status.WARNING, f"{free / _MIB:.0f} MiB available")
    works = numba.njit(_one_more)(1) == 2
    yield Finding("compiler", Status.OK if works else Status.FAILED, f"numba {numba.__version__} compiles")


def check_weights(folder: Path) -> Iterator[Finding]:
    """Every exported network has a card and the bytes that its card promises."""
    networks = sorted(folder.glob("*.onnx"))
    if not networks:
        yield Finding("weights", Status.WARNING, f"{folder}: no network; `mirrorwave train` makes one")
    for network in networks:
        try:
            yield _check_network(network)
        except (OSError, ValueError) as error:
            yield Finding(f"weights {network.stem}", Status.FAILED, f"cannot be read: {error_line(error)}")


def check_run_dir(run_dir: Path) -> Iterator[Finding]:
    """The directory of the graph's sockets can be written and a message gets through."""
    run_dir.mkdir(parents=True, exist_ok=True, mode=0o700)
    with tempfile.TemporaryFile(dir=run_dir):
        pass
    yield Finding("run directory", Status.OK, str(run_dir))


def _check_network(network: Path) -> Finding:
    check = f"weights {network.stem}"
    card_path = network.with_suffix(".json")
    if not card_path.is_file():
        return Finding(check, Status.FAILED, f"{card_path.name} is missing: weights without a card are not trusted")
    promised = json.loads(card_path.read_text(encoding="utf-8")).get("sha256")
    digest = hashlib.sha256(network.read_bytes()).hexdigest()
    if promised != digest:
        return Finding(check, Status.FAILED, f"checksum {digest[:12]} is not the card's {str(promised)[:12]}")
    return Finding(check, Status.OK, f"{network.stat().st_size / _MIB:.1f} MiB, checksum as on its card")


def _one_more(number: int) -> int:
    return number + 1
