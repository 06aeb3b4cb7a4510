"""The corner live with the Foxglove bridge and one client that reads every channel: counts, losses, cores, memory.

The client holds every message against the schema of its announcement after the run. Losses: what the bridge left out
because its server was busy, and what it dropped for a slow client.
Usage: python -m benchmarks.live.foxglove_bridge [--duration S] [--json]
"""

from __future__ import annotations

import argparse
import json
import os
import re
import struct
import subprocess
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path
from typing import Any

import jsonschema
from websockets.sync.client import connect

from benchmarks.live.live_graph import node_report, quantiles, shed_of
from msgs.bus.zmq import ZmqBus, run_dir
from msgs.files.shipped import CHECKOUT
from msgs.values.diagnostics import NodeStatus
from msgs.values.perception import BevFrame
from nodes.inputs.view_latency import latency_ns

LAUNCH = CHECKOUT / "launch" / "corner_foxglove.yaml"
_HEAD = struct.Struct("<BIQ")
_START_S, _STOP_S = 60.0, 30.0


def address_of(runs: Path) -> str:
    """Return the address that the bridge logs, once it has."""
    end_s = time.monotonic() + _START_S
    while time.monotonic() < end_s:
        for log in runs.glob("*/log.jsonl"):
            if match := re.search(r"ws://\S+", log.read_text(encoding="utf-8")):
                return match[0]
        time.sleep(0.1)
    raise TimeoutError(f"no address within {_START_S:g} s")


def listen(address: str, bus: ZmqBus, duration_s: float) -> dict[str, Any]:
    """Read all channels for so long, and the graph's own views and heartbeats beside them."""
    status: dict[str, list[NodeStatus]] = {}
    latency_ms: list[float] = []
    kept: list[tuple[int, bytes]] = []
    said: list[str] = []
    with connect(address, subprotocols=["foxglove.sdk.v1"], max_size=1 << 24) as socket:
        socket.recv()
        channels = {channel["id"]: channel for channel in json.loads(socket.recv())["channels"]}
        subscriptions = [{"id": number, "channelId": number} for number in channels]
        socket.send(json.dumps({"op": "subscribe", "subscriptions": subscriptions}))
        end_s = time.monotonic() + duration_s
        while time.monotonic() < end_s:
            try:
                data = socket.recv(0.01)
            except TimeoutError:
                data = None
            if isinstance(data, bytes):
                kept.append((_HEAD.unpack_from(data)[1], data[_HEAD.size :]))
            elif data is not None:
                said.append(data)
            for received in bus.receive(0.0):
                if isinstance(received.message, BevFrame):
                    latency_ms.append(1e-6 * latency_ns(received.message.stamp_ns, time.monotonic_ns()))
                elif isinstance(received.message, NodeStatus):
                    status.setdefault(received.message.node, []).append(received.message)
    for number, body in kept:
        jsonschema.validate(json.loads(body), json.loads(channels[number]["schema"]))
    counts = Counter(channels[number]["topic"] for number, _ in kept)
    return {
        "messages": dict(counts),
        "bytes": sum(len(body) for _, body in kept),
        "warnings": said,
        "bridge": node_report(status["foxglove"]),
        "left_out": shed_of(status["foxglove"][-1]),
        "lost_before": {count.topic: count.lost for count in status["foxglove"][-1].received if count.lost},
        "views": len(latency_ms),
        "latency_ms": quantiles(latency_ms),
    }


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--duration", type=float, default=60.0)
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    domain = f"foxglove{os.getpid()}"
    bus = ZmqBus("benchmark", run_dir(domain))
    for topic in ("perception/hidden_objects", "diagnostics/node"):
        bus.subscribe(topic)
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, "-m", "mirrorwave", "launch", str(LAUNCH), "--domain", domain, "--runs-dir", folder]
        graph = subprocess.Popen(command, cwd=CHECKOUT, stdout=subprocess.DEVNULL, start_new_session=True)
        try:
            result = listen(address_of(Path(folder)), bus, arguments.duration)
        finally:
            graph.terminate()
            graph.wait(_STOP_S)
            bus.close()
    print(json.dumps(result, indent=None if arguments.json else 2))


if __name__ == "__main__":
    main()
