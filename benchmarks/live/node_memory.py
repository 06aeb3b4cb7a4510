"""Resident memory of one node over hours of its own clock, as fast as it steps: what grows without end shows.

`player`: the soak's scene with short beams (4 chirps). `recorder`: a map, peaks, a view, 15 vehicle states and 5
heartbeats a scan into parts of 300 s, two of which are kept. Resident memory every ten minutes of that clock, in MiB.
Usage: python -m benchmarks.live.node_memory player|recorder [--hours 2]
"""

from __future__ import annotations

import argparse
import json
import tempfile
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path

import msgspec
import psutil

from msgs.bus.interface import Envelope, Received
from msgs.values.diagnostics import NodeState, NodeStatus
from msgs.values.units import ns_from_s
from msgs.values.vehicle import VehicleState
from nodes import player, recorder
from tests.fuzz.cases import peaks, ra_map, view

SCENE = "launch/scenes/facade_across_lane.yaml"
START_NS, SCAN_NS, STATE_NS = 10**12, ns_from_s(0.3), ns_from_s(0.02)
LOOK_NS = ns_from_s(600.0)


def play(folder: Path) -> Iterator[int]:
    """Step a player whenever it is due; its clock."""
    node = player.create(player.Params(scene=SCENE, publish_vehicle_state=False, chirps_per_beam=4))
    now_ns = START_NS
    while True:
        due_ns = node.due_ns(now_ns)
        assert due_ns is not None
        now_ns = max(now_ns + 1, due_ns)
        node.step([], now_ns)
        node.stages.drain()
        yield now_ns


def record(folder: Path) -> Iterator[int]:
    """Hand a recorder scan after scan; its clock."""
    node = recorder.create(recorder.Params(path=str(folder / "a.mcap"), split_s=300.0, max_parts=2))
    sent: Counter[tuple[str, str]] = Counter()
    status = NodeStatus(stamp_ns=0, node="a", pid=1, state=NodeState.READY, uptime_s=1.0, cpu_s=1.0, resident_bytes=1)
    now_ns = START_NS
    try:
        for scan in range(1 << 62):
            now_ns = START_NS + scan * SCAN_NS
            messages: list[tuple[str, str, msgspec.Struct]] = [
                ("radar/ra_map", "ra_former", msgspec.structs.replace(ra_map(scan, now_ns), scan_id=scan)),
                ("perception/peaks", "dense_predictor", peaks(scan, now_ns)),
                ("perception/hidden_objects", "geometry", view(scan, now_ns)),
            ]
            for index in range(15):
                messages.append(("vehicle/state", "can", VehicleState(stamp_ns=now_ns + index * STATE_NS)))
            for name in ("a", "b", "c", "d", "e"):
                beat = msgspec.structs.replace(status, node=name, stamp_ns=now_ns)
                messages.append(("diagnostics/node", name, beat))
            node.step([_received(*one, sent, now_ns) for one in messages], now_ns)
            node.stages.drain()
            yield now_ns
    finally:
        node.close()


def _received(
    topic: str, publisher: str, message: msgspec.Struct, sent: Counter[tuple[str, str]], now_ns: int
) -> Received:
    envelope = Envelope(publisher=publisher, topic=topic, sequence=sent[topic, publisher], sent_ns=now_ns)
    sent[topic, publisher] += 1
    return Received(topic, message, envelope)


WORK: dict[str, Callable[[Path], Iterator[int]]] = {"player": play, "recorder": record}


def resident_mib(name: str, hours: float) -> list[float]:
    """Resident memory every ten minutes of the node's clock, from the tenth minute on."""
    process, found = psutil.Process(), []
    look_ns, end_ns = START_NS + LOOK_NS, START_NS + ns_from_s(3600.0 * hours)
    with tempfile.TemporaryDirectory() as folder:
        clock = WORK[name](Path(folder))
        for now_ns in clock:
            if now_ns >= look_ns:
                look_ns += LOOK_NS
                found.append(round(process.memory_info().rss / 2**20, 1))
            if now_ns >= end_ns:
                break
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("node", choices=WORK)
    parser.add_argument("--hours", type=float, default=2.0)
    arguments = parser.parse_args()
    print(json.dumps({"node": arguments.node, "resident_mib": resident_mib(arguments.node, arguments.hours)}))


if __name__ == "__main__":
    main()
