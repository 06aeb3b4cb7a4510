"""`mirrorwave doctor`: is this machine fit, and does the graph do well; names what fails and why."""

from __future__ import annotations

import hashlib
import importlib
import importlib.metadata
import json
import os
import sys
import tempfile
from collections.abc import Callable, Iterator
from enum import StrEnum
from pathlib import Path
from typing import NamedTuple

import typer

from mirrorwave.console import DEFAULT_DOMAIN, AsJson, Domain, ExitCode, error_line, print_json, print_table
from msgs.diagnostics import NodeState, NodeStatus

_MIB = 1 << 20
#: Package -> module to import: importing it is what finds a missing shared library.
_PACKAGES = {
    "numpy": "numpy",
    "scipy": "scipy.linalg",
    "numba": "numba",
    "onnxruntime": "onnxruntime",
    "pyzmq": "zmq",
    "msgspec": "msgspec",
    "msgpack": "msgpack",
    "mcap": "mcap",
    "sigmf": "sigmf",
    "PyYAML": "yaml",
    "rich": "rich",
    "matplotlib": "matplotlib",
    "psutil": "psutil",
    "python-can": "can",
    "cantools": "cantools",
    "starlette": "starlette",
    "uvicorn": "uvicorn",
}
_WEIGHTS = Path(__file__).resolve().parents[1] / "models" / "weights"
#: Below this the graph's buffers and networks do not fit beside anything else.
_MEMORY_NEEDED_BYTES = 1 << 30
#: A heartbeat comes twice a second; a node that said nothing for this long has stopped turning.
_STALE_S = 2.0


class Status(StrEnum):
    """Outcome of a check."""

    OK = "ok"
    WARNING = "warning"
    FAILED = "failed"


class Finding(NamedTuple):
    """What a check found."""

    check: str
    status: Status
    detail: str


def doctor(domain: Domain = DEFAULT_DOMAIN, as_json: AsJson = False) -> None:
    """Check this machine and, if one runs, the graph; exit code 1 if a check failed."""
    findings = all_findings(domain)
    if as_json:
        print_json([finding._asdict() for finding in findings])
    else:
        print_table(("CHECK", "STATUS", "DETAIL"), findings)
    if any(finding.status is Status.FAILED for finding in findings):
        raise typer.Exit(ExitCode.FAILED)


def all_findings(domain: str) -> list[Finding]:
    """Every check in a fixed order; one that cannot run has failed."""
    from msgs.zmq_bus import run_dir

    checks: dict[str, Callable[[], Iterator[Finding]]] = {
        "python": check_python,
        "packages": check_packages,
        "processor": check_processor,
        "weights": lambda: check_weights(_WEIGHTS),
        "run directory": lambda: check_run_dir(run_dir(domain)),
        "graph": lambda: check_graph(run_dir(domain)),
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


def check_processor() -> Iterator[Finding]:
    """Cores, memory, and a compiler that works."""
    import numba
    import psutil

    yield Finding("cores", Status.OK, f"{len(os.sched_getaffinity(0))} usable")
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
        yield _check_network(network)


def check_run_dir(run_dir: Path) -> Iterator[Finding]:
    """The directory of the graph's sockets can be written and a message gets through."""
    run_dir.mkdir(parents=True, exist_ok=True, mode=0o700)
    with tempfile.TemporaryFile(dir=run_dir):
        pass
    yield Finding("run directory", Status.OK, str(run_dir))


def check_graph(run_dir: Path) -> Iterator[Finding]:
    """Every node of the running graph, worst first within its line: failed, silent, losing, degraded."""
    from mirrorwave.node import collect_heartbeats
    from msgs.zmq_bus import list_publishers
    from nodes.supervisor import read_lock

    owner = read_lock(run_dir)
    if not owner and not list_publishers(run_dir):
        yield Finding("graph", Status.OK, "none runs in this domain")
        return
    heard = collect_heartbeats(run_dir, _STALE_S)
    for name in sorted({*owner.get("nodes", ()), *heard}):
        yield _check_node(name, heard.get(name, []))


def _check_node(name: str, beats: list[NodeStatus]) -> Finding:
    from mirrorwave.node import node_row

    check = f"node {name}"
    if not beats:
        return Finding(check, Status.FAILED, f"no heartbeat in {_STALE_S:g} s: it crashed, hangs or was never started")
    row = node_row(beats)
    load = f"{row['cpu_percent']:.0f} % cpu, {row['resident_bytes'] / _MIB:.0f} MiB"
    if row["state"] in (NodeState.DEGRADED, NodeState.STOPPING):
        status = Status.FAILED if row["node"] == "supervisor" else Status.WARNING
        return Finding(check, status, f"{row['state']}: {row['reason'] or 'no reason given'}; {load}")
    losses = [
        f"{count.topic}: {count.lost} lost, {count.rejected} rejected"
        for count in beats[-1].received
        if count.lost or count.rejected
    ]
    return Finding(check, Status.WARNING if losses else Status.OK, "; ".join([row["state"], *losses, load]))


def _check_network(network: Path) -> Finding:
    check = f"weights {network.stem}"
    card_path = network.with_suffix(".json")
    if not card_path.is_file():
        return Finding(check, Status.FAILED, f"{card_path.name} is missing: weights without a card are not trusted")
    promised = json.loads(card_path.read_text(encoding="utf-8")).get("sha256")
    found = hashlib.sha256(network.read_bytes()).hexdigest()
    if promised != found:
        return Finding(check, Status.FAILED, f"checksum {found[:12]} is not the card's {str(promised)[:12]}")
    return Finding(check, Status.OK, f"{network.stat().st_size / _MIB:.1f} MiB, checksum as on its card")


def _one_more(number: int) -> int:
    return number + 1
