"""A radar of the ARS 408 kind on CAN beside the whole graph: measurements and targets sent, read, lost.

A stand-in sends 17 measurements a second of 64 targets with their qualities, 129 frames each at the pace of a bus of
500 kbit/s, over udp_multicast. The graph of the launch file runs beside, a node a process. Every message of
radar/detections is compared with what was sent.
Usage: python -m benchmarks.live.detections_can [--launch FILE] [--duration S] [--targets N] [--drop N] [--json]
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.live.live_graph import STOPPING_S, node_report, quantiles, shed_of
from msgs.bus.zmq import ZmqBus, run_dir
from msgs.files.shipped import CHECKOUT
from msgs.values.detections import RadarDetections
from msgs.values.diagnostics import NodeStatus
from msgs.values.perception import BevFrame
from nodes.can.bus import BusParams, open_bus
from nodes.process.launch_file import dump_launch, launch_from_mapping, parse_yaml
from tests.nodes.drivers.target_radar_stand_in import Target, measurement, message, random_targets
from tests.ports import free_udp_port

CYCLE_S = 1.0 / 17.0
#: Time on a bus of 500 kbit/s of a frame with 8 bytes, stuffed bits left out.
FRAME_S = 111 / 500e3
#: Longest time until the first view: kernels may have to be compiled.
PATIENCE_S = 240.0
#: Different measurements; they are sent in turn.
SEEDS = 32


class StandIn(threading.Thread):
    """Sends measurements until it is asked to stop; every `drop`-th frame is kept back."""

    def __init__(self, params: BusParams, targets: int, drop: int) -> None:
        super().__init__()
        self.measurements = [random_targets(targets, seed) for seed in range(SEEDS)]
        self._bus, self._drop = open_bus(params), drop
        self._stop_asked = threading.Event()
        self.sent = self.frames = self.dropped = self.late = 0

    def run(self) -> None:
        due_s = time.monotonic()
        while not self._stop_asked.is_set():
            self._send(measurement(self.measurements[self.sent % SEEDS], self.sent), due_s)
            self.sent += 1
            due_s += CYCLE_S
            self.late += time.monotonic() > due_s
            time.sleep(max(0.0, due_s - time.monotonic()))
        self._bus.shutdown()

    def stop(self) -> None:
        """End after the measurement that is on its way."""
        self._stop_asked.set()
        self.join()

    def _send(self, frames: list[tuple[int, bytes]], start_s: float) -> None:
        for at, frame in enumerate(frames):
            self.frames += 1
            if self._drop and self.frames % self._drop == 0:
                self.dropped += 1
                continue
            self._bus.send(message(frame))
            ahead_s = start_s + at * FRAME_S - time.monotonic()
            if ahead_s > 1e-3:
                time.sleep(ahead_s)


def run(launch: Path, duration_s: float, targets: int, drop: int) -> dict[str, Any]:
    """Run the graph with the radar's node; from its first view on send for so long, and compare."""
    params = BusParams(
        interface="udp_multicast", channel="239.74.163.2", options={"port": free_udp_port(), "hop_limit": 0}
    )
    domain = f"bench{os.getpid()}"
    heard = Heard(ZmqBus("benchmark", run_dir(domain)))
    with tempfile.TemporaryDirectory() as folder:
        file = _with_radar(launch, params, Path(folder) / launch.name)
        command = [sys.executable, "-m", "mirrorwave", "launch", str(file), "--headless", "--domain", domain]
        graph = subprocess.Popen(command, cwd=CHECKOUT, stdout=subprocess.DEVNULL)
        try:
            heard.until(lambda: bool(heard.views), PATIENCE_S)
            heard.start()
            stand_in = StandIn(params, targets, drop)
            stand_in.start()
            heard.until(lambda: False, duration_s)
            stand_in.stop()
            heard.until(lambda: False, STOPPING_S)
        finally:
            graph.send_signal(signal.SIGINT)
            graph.wait()
    return report(stand_in, heard, targets) | {"exit_code": graph.returncode}


class Heard:
    """What a subscriber outside the graph hears."""

    def __init__(self, bus: ZmqBus) -> None:
        self._bus = bus
        for topic in ("radar/detections", "diagnostics/node", "perception/hidden_objects"):
            bus.subscribe(topic)
        bus.want_all()
        self.start()

    def start(self) -> None:
        """Forget what was heard."""
        self.detections: list[tuple[int, RadarDetections]] = []
        self.status: dict[str, list[NodeStatus]] = {}
        self.views: list[int] = []

    def until(self, is_done: Callable[[], bool], limit_s: float) -> None:
        """Listen until a condition holds or the time is over."""
        end_s = time.monotonic() + limit_s
        while time.monotonic() < end_s and not is_done():
            for received in self._bus.receive(0.05):
                self._take(received.message)

    def _take(self, value: Any) -> None:
        if isinstance(value, RadarDetections):
            self.detections.append((time.monotonic_ns(), value))
        elif isinstance(value, NodeStatus):
            self.status.setdefault(value.node, []).append(value)
        elif isinstance(value, BevFrame):
            self.views.append(value.scan_id)


def _with_radar(launch: Path, params: BusParams, out: Path) -> Path:
    """Write the launch file with the radar's node in it."""
    value = parse_yaml(launch.read_text(), str(launch))
    bus = {"interface": params.interface, "channel": params.channel, "options": params.options}
    value["nodes"]["detections_radar"] = {"module": "nodes.drivers.detections_radar", "params": bus}
    out.write_text(dump_launch(launch_from_mapping(value, str(launch))))
    return out


def report(stand_in: StandIn, heard: Heard, targets: int) -> dict[str, Any]:
    """Return counts of what was sent and read, and the delay from a measurement's first frame to its message."""
    found = [each for _, each in heard.detections]
    delay_ms = [1e-6 * (at_ns - each.stamp_ns) for at_ns, each in heard.detections]
    sent = stand_in.measurements
    radar = heard.status["detections_radar"]
    return {
        "machine": f"{platform.processor() or platform.machine()}, {os.cpu_count()} cores, {platform.platform()}",
        "measurements_sent": stand_in.sent,
        "measurements_read": len(found),
        "targets_sent": stand_in.sent * targets,
        "targets_read": sum(len(each) for each in found),
        "targets_said_lost": sum(each.lost for each in found),
        "frames_sent": stand_in.frames - stand_in.dropped,
        "frames_dropped": stand_in.dropped,
        "cycles_late": stand_in.late,
        "wrong_measurements": sum(not _agrees(each, sent[each.scan_id % SEEDS]) for each in found if not each.lost),
        "delay_ms": quantiles(delay_ms) if delay_ms else {},
        "views": len(heard.views),
        "node": node_report(radar) if len(radar) >= 2 else {},
        "shed": {name: shed for name, items in heard.status.items() if (shed := shed_of(items[-1]))},
    }


def _agrees(found: RadarDetections, targets: list[Target]) -> bool:
    position_m = np.array([target.position_m for target in targets])
    speeds_mps = [target.radial_speed_mps for target in targets]
    return (
        len(found) == len(targets)
        and np.allclose(found.range_m, np.hypot(*position_m.T), atol=1e-9)
        and np.allclose(found.azimuth_rad, np.arctan2(position_m[:, 1], position_m[:, 0]), atol=1e-9)
        and np.allclose(found.radial_speed_mps, speeds_mps, atol=1e-9)
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--launch", type=Path, default=CHECKOUT / "launch" / "corner.yaml")
    parser.add_argument("--duration", type=float, default=60.0)
    parser.add_argument("--targets", type=int, default=64)
    parser.add_argument("--drop", type=int, default=0, help="keep back every so manyth frame (0: none)")
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    result = run(arguments.launch, arguments.duration, arguments.targets, arguments.drop)
    print(json.dumps(result) if arguments.json else json.dumps(result, indent=2))


if __name__ == "__main__":
    main()
