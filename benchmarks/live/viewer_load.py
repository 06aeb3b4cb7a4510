"""What pages cost the graph: latency with no page, one that never reads, ten that do, and one that sends garbage.

`launch/demo.yaml` at the real rate; latency as in `benchmarks.live.live_graph`; phases of `--phase` seconds in the same
run. Usage: python -m benchmarks.live.viewer_load [--phase 12] [--json]
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import re
import secrets
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator

import numpy as np
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import ClientConnection, connect

from msgs.bus.zmq import ZmqBus, run_dir
from msgs.files.shipped import CHECKOUT
from msgs.values.diagnostics import NodeStatus
from msgs.values.perception import BevFrame
from nodes.inputs.view_latency import latency_ns

ROOT = CHECKOUT
LAUNCH = ROOT / "launch" / "demo.yaml"


class Pages:
    """Connections to the viewer, each served by its own thread until the phase ends."""

    def __init__(self, url: str) -> None:
        self._origin = url.rsplit("/", 2)[0]
        self._address = url.replace("http://", "ws://") + "ws"
        self.bytes = 0

    def open(self) -> ClientConnection:
        return connect(self._address, origin=self._origin, max_size=2**24)  # type: ignore[arg-type]

    def never_reads(self, ended: threading.Event) -> None:
        with self.open():
            ended.wait()

    def reads(self, ended: threading.Event) -> None:
        """Takes and acknowledges every update, as the page does."""
        with self.open() as page:
            while not ended.is_set():
                with contextlib.suppress(TimeoutError):
                    message = page.recv(timeout=0.2)
                    self.bytes += len(message)
                    if isinstance(message, str) and (update := json.loads(message)).get("type") == "update":
                        self.bytes += sum(len(page.recv(timeout=5.0)) for _ in range(update.get("messages", 0)))
                        page.send(json.dumps({"type": "ack", "number": update["number"]}))

    def sends_garbage(self, ended: threading.Event) -> None:
        while not ended.is_set():
            with contextlib.suppress(ConnectionClosed, OSError), self.open() as page:
                page.send(secrets.token_bytes(500))
                page.send("[" * 900)
                page.send("x" * 100_000)
            time.sleep(0.02)


@contextlib.contextmanager
def launched(domain: str) -> Iterator[str]:
    """The demo graph; yields the address that the viewer printed."""
    command = [sys.executable, "-m", "mirrorwave", "launch", str(LAUNCH), "--domain", domain]
    graph = subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, text=True, start_new_session=True)
    assert graph.stdout is not None
    try:
        for line in graph.stdout:
            if found := re.search(r"http://\S+", line):
                break
        threading.Thread(target=graph.stdout.read, daemon=True).start()
        yield found.group()  # type: ignore[union-attr]
    finally:
        os.killpg(graph.pid, signal.SIGINT)
        graph.wait(30.0)


def measure(bus: ZmqBus, duration_s: float, clients: list[Callable[[threading.Event], None]]) -> dict:
    """Latencies of views while clients do what they do."""
    ended = threading.Event()
    threads = [threading.Thread(target=client, args=(ended,)) for client in clients]
    for thread in threads:
        thread.start()
    latency_ms, viewer = [], []
    end_s = time.monotonic() + duration_s
    while time.monotonic() < end_s:
        for received in bus.receive(0.05):
            if isinstance(received.message, BevFrame):
                latency_ms.append(1e-6 * latency_ns(received.message.stamp_ns, time.monotonic_ns()))
            elif isinstance(received.message, NodeStatus) and received.message.node == "bev_viewer":
                viewer.append(received.message)
    ended.set()
    for thread in threads:
        thread.join()
    p50, p99 = np.percentile(latency_ms, [50, 99])
    cpu = (viewer[-1].cpu_s - viewer[0].cpu_s) / (viewer[-1].uptime_s - viewer[0].uptime_s)
    return {
        "views": len(latency_ms),
        "latency_p50_ms": round(float(p50), 1),
        "latency_p99_ms": round(float(p99), 1),
        "viewer_cpu_share": round(cpu, 3),
        "viewer_resident_mib": round(viewer[-1].resident_bytes / 2**20, 1),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--phase", type=float, default=12.0)
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    domain = f"pages{os.getpid()}"
    bus = ZmqBus("observer", run_dir(domain))
    for topic in ("perception/hidden_objects", "diagnostics/node"):
        bus.subscribe(topic)
    with launched(domain) as url:
        pages = Pages(url)
        time.sleep(3.0)
        phases: dict[str, list[Callable[[threading.Event], None]]] = {
            "no page": [],
            "one that never reads": [pages.never_reads],
            "ten that read": [pages.reads] * 10,
            "garbage, fifty times a second": [pages.sends_garbage],
            "no page again": [],
        }
        rows = {name: measure(bus, arguments.phase, clients) for name, clients in phases.items()}
        rows["ten that read"]["kilobytes_per_s_each"] = round(pages.bytes / 10 / arguments.phase / 1e3, 1)
    bus.close()
    print(json.dumps(rows, indent=None if arguments.json else 2))


if __name__ == "__main__":
    main()
