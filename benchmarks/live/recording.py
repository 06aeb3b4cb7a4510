"""A recording at the full raw rate: bytes/s, what each subscriber lost, CPU of each node, against plain writing.

The graph is recorded by `mirrorwave launch --record --raw`; afterwards as many bytes are written to the same folder in
blocks of a beam's size, plainly and with space taken ahead (`reserve`), and the recording is read back and checked.
Usage: python -m benchmarks.live.recording [--graph player|whole] [--launch FILE] [--duration S] [--folder DIR] [--keep]
       [--json]
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import subprocess
import sys
import tempfile
import time
import zlib
from pathlib import Path

import msgspec

from benchmarks.live.live_graph import node_report
from msgs.bus.zmq import ZmqBus, run_dir
from msgs.files.shipped import CHECKOUT
from msgs.recording.mcap import RAW_TOPIC, RecordingInfo, info
from msgs.recording.mcap_writer import RESERVE_BYTES, reserve
from msgs.values.diagnostics import NodeStatus
from nodes.process.launch_file import dump_launch, read_launch_file

ROOT = CHECKOUT
BLOCK_BYTES = 4 << 20
#: Plain writing stops here: enough to see a rate.
PLAIN_BYTES = 4 << 30


def player_alone(launch: Path, folder: Path) -> Path:
    """The launch file with its player only."""
    graph = read_launch_file(launch)
    player = msgspec.structs.replace(graph.nodes["player"], after=())
    alone = folder / "player.yaml"
    alone.write_text(dump_launch(msgspec.structs.replace(graph, nodes={"player": player})))
    return alone


def record(launch: Path, out: Path, duration_s: float, folder: Path) -> tuple[int, dict[str, list[NodeStatus]]]:
    """Run and record the graph; its exit code and all heartbeats."""
    domain = f"bench{os.getpid()}"
    command = [sys.executable, "-m", "mirrorwave", "launch", str(launch), "--duration", str(duration_s), "--headless"]
    command += ["--record", str(out), "--raw", "--domain", domain, "--runs-dir", str(folder / "runs")]
    bus = ZmqBus("benchmark", run_dir(domain))
    bus.subscribe("diagnostics/node")
    status: dict[str, list[NodeStatus]] = {}
    with subprocess.Popen(command, cwd=ROOT, stdout=subprocess.DEVNULL) as graph:
        while graph.poll() is None:
            for received in bus.receive(0.05):
                assert isinstance(received.message, NodeStatus)
                status.setdefault(received.message.node, []).append(received.message)
    bus.close()
    return graph.returncode, status


def plain_mb_per_s(path: Path, total_bytes: int, *, as_recorded: bool) -> float:
    """Rate of writing blocks of random bytes, fsync apart."""
    block = os.urandom(BLOCK_BYTES)
    with path.open("xb", buffering=0) as file:
        start_s, end = time.perf_counter(), 0
        for at in range(0, total_bytes, BLOCK_BYTES):
            if as_recorded and at + BLOCK_BYTES > end:
                end = at + BLOCK_BYTES + RESERVE_BYTES
                reserve(file.fileno(), at, end - at)
            file.write(block)
        took_s = time.perf_counter() - start_s
    path.unlink()
    return 1e-6 * total_bytes / took_s


def crc_mb_per_s() -> float:
    block = os.urandom(BLOCK_BYTES)
    start_s = time.perf_counter()
    for _ in range(100):
        zlib.crc32(block)
    return 1e-6 * 100 * BLOCK_BYTES / (time.perf_counter() - start_s)


def report(code: int, found: RecordingInfo, status: dict[str, list[NodeStatus]]) -> dict:
    ready = {name: [item for item in items if item.state == "ready"] for name, items in status.items()}
    beams = next(topic for topic in found.topics if topic.topic == RAW_TOPIC)
    return {
        "machine": f"{platform.processor() or platform.machine()}, {os.cpu_count()} cores, {platform.platform()}",
        "exit_code": code,
        "recording": {
            "size_bytes": found.size_bytes,
            "duration_s": round(found.duration_s, 2),
            # the graph takes seconds to start: the beams' rate counts from the first of them
            "raw_mb_per_s": round(1e-6 * beams.rate_hz * beams.bytes / max(beams.messages, 1), 1),
            "beams_per_s": round(beams.rate_hz, 2),
            "complete": found.complete,
            "checksums_agree": found.checksums_agree,
            "missing": None if found.losses is None else found.losses.total,
        },
        "lost_rejected_outdated": {
            f"{name}: {count.topic}": [count.lost, count.rejected, count.outdated]
            for name, items in status.items()
            for count in items[-1].received
            if count.messages or count.lost
        },
        "nodes": {name: node_report(items) for name, items in ready.items() if len(items) >= 2},
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--graph", choices=("player", "whole"), default="player")
    parser.add_argument("--launch", type=Path, default=ROOT / "launch" / "corner.yaml")
    parser.add_argument("--duration", type=float, default=60.0)
    parser.add_argument("--folder", type=Path, help="where to record; needs 0.35 GB a second")
    parser.add_argument("--keep", action="store_true", help="keep the recording")
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory(dir=arguments.folder) as name:
        folder = Path(name)
        launch = arguments.launch if arguments.graph == "whole" else player_alone(arguments.launch, folder)
        out = (arguments.folder or Path()) / "benchmark.mcap" if arguments.keep else folder / "benchmark.mcap"
        code, status = record(launch, out, arguments.duration, folder)
        start_s = time.perf_counter()
        found = info(out)
        read_s = time.perf_counter() - start_s
        total = min(found.size_bytes, PLAIN_BYTES)
        result = {
            "graph": arguments.graph,
            **report(code, found, status),
            "read_and_checked_mb_per_s": round(1e-6 * found.size_bytes / read_s, 1),
            "plain_write_mb_per_s": round(plain_mb_per_s(folder / "plain", total, as_recorded=False), 1),
            "plain_write_reserved_mb_per_s": round(plain_mb_per_s(folder / "plain", total, as_recorded=True), 1),
            "crc32_mb_per_s": round(crc_mb_per_s(), 1),
        }
    print(json.dumps(result) if arguments.json else json.dumps(result, indent=2))


if __name__ == "__main__":
    main()
