"""Memory of the nodes: where it is in a running graph, and what grows without end.

`graph`: a launch file at its real rate; after so many seconds each of its processes by what it maps, in MiB: resident,
and in brackets proportional (a page that several share counts once) and what no file holds, shared or not.

`stopped`: resident memory of a player whose receiver is stopped for a moment, and runs on.

The others: resident memory of one node over hours of its own clock, as fast as it steps.
`player`: the soak's scene with short beams (4 chirps). `recorder`: a map, peaks, a view, 15 vehicle states and 5
heartbeats a scan into parts of 300 s, two of which are kept. `viewer`: the same messages, and no page. `geometry`: maps
and peaks of that scene, a vehicle that stands, default profile.
Resident memory every ten minutes of that clock, in MiB.
Usage: python -m benchmarks.live.node_memory player|recorder|viewer|geometry [--hours 2]
       python -m benchmarks.live.node_memory stopped [--launch FILE]
       python -m benchmarks.live.node_memory graph [--launch FILE] [--after 60] [--group PROCESS=NODE,NODE]
"""

from __future__ import annotations

import argparse
import itertools
import json
import os
import re
import signal
import tempfile
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import NamedTuple

import msgspec
import psutil

from benchmarks.live.faults import LAUNCHES, Graph, hear_ctrl_c
from mirrorwave.node_chain import SharedParts, stage_params
from mirrorwave.profiles import read_profile
from mirrorwave.studies.report import table
from msgs.bus.codec import decode_inline, encode_inline
from msgs.bus.interface import Envelope, Received
from msgs.values.diagnostics import NodeState, NodeStatus
from msgs.values.perception import Peaks
from msgs.values.radar import RangeAzimuthMap
from msgs.values.units import ns_from_s
from msgs.values.vehicle import VehicleState
from nodes import bev_viewer, geometry, player, recorder
from nodes.node import Node
from nodes.process.memory import Mapping, mappings
from sim_player.player import ScenePlayer
from tests.fuzz.cases import peaks, ra_map, view

SCENE = "launch/scenes/facade_across_lane.yaml"
START_NS, SCAN_NS, STATE_NS = 10**12, ns_from_s(0.3), ns_from_s(0.02)
LOOK_NS = ns_from_s(600.0)
#: Scans that geometry sees in turn.
SEEN_SCANS = 12
#: Less than a fifth of a node's time limit, after which a stopped one is killed.
STOPPED_S = 0.8


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
    return take_scans(recorder.create(recorder.Params(path=str(folder / "a.mcap"), split_s=300.0, max_parts=2)))


def show(folder: Path) -> Iterator[int]:
    """Hand a viewer scan after scan; its clock."""
    return take_scans(bev_viewer.create(bev_viewer.Params(port=0)))


def see(folder: Path) -> Iterator[int]:
    """Hand geometry maps and peaks of `SEEN_SCANS` scans, decoded each time, over and over; its clock."""
    seen = encoded_scans(SEEN_SCANS)
    node = geometry.create(stage_params("geometry", read_profile("default")["geometry"]))
    sent: Counter[tuple[str, str]] = Counter()
    try:
        for scan in itertools.count():
            now_ns = START_NS + scan * SCAN_NS
            ra_map, found = at_scan(seen[scan % SEEN_SCANS], scan, now_ns)
            messages: list[tuple[str, str, msgspec.Struct]] = [*vehicle_states(now_ns - SCAN_NS)]
            messages += [("radar/ra_map", "ra_former", ra_map), ("perception/peaks", "dense_predictor", found)]
            if not node.step([_received(*one, sent, now_ns) for one in messages], now_ns):
                raise RuntimeError(f"geometry gave no view of scan {scan}: {node.health()[1]}")
            node.stages.drain()
            yield now_ns
    finally:
        node.close()


def encoded_scans(count: int) -> list[tuple[bytes, bytes]]:
    """Return the maps and peaks of so many scans of the scene, as the bus carries them."""
    radar = player.scene_player(player.Params(scene=SCENE, effects="auto"))
    assert isinstance(radar, ScenePlayer)
    chain = SharedParts.of(read_profile("default"), radar.setup).chain()
    beams = (radar.beam(scan, index) for scan in range(count) for index in range(len(radar.setup.beams)))
    views = (view for beam in beams for view in chain.add(beam))
    return [(encode_inline(view.ra_map), encode_inline(view.peaks)) for view in views if view.ra_map is not None]


def at_scan(encoded: tuple[bytes, bytes], scan: int, stamp_ns: int) -> tuple[RangeAzimuthMap, Peaks]:
    """Decode a map and its peaks as those of another scan."""
    ra_map, found = decode_inline(RangeAzimuthMap, encoded[0]), decode_inline(Peaks, encoded[1])
    later_ns = stamp_ns - ra_map.stamp_ns
    return (
        msgspec.structs.replace(
            ra_map, scan_id=scan, stamp_ns=stamp_ns, azimuth_stamp_ns=ra_map.azimuth_stamp_ns + later_ns
        ),
        msgspec.structs.replace(found, scan_id=scan, stamp_ns=stamp_ns, peak_stamp_ns=found.peak_stamp_ns + later_ns),
    )


def vehicle_states(start_ns: int) -> Iterator[tuple[str, str, msgspec.Struct]]:
    """Yield what a vehicle that stands says in a scan."""
    for index in range(15):
        yield "vehicle/state", "can", VehicleState(stamp_ns=start_ns + index * STATE_NS)


def take_scans(node: Node) -> Iterator[int]:
    """Hand a node the messages of scan after scan; its clock."""
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
            messages += vehicle_states(now_ns)
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


WORK: dict[str, Callable[[Path], Iterator[int]]] = {"player": play, "recorder": record, "viewer": show, "geometry": see}


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


def graph_memory(launch: Path, after_s: float, groups: list[str]) -> str:
    """Return the memory of a running graph's processes, as a table."""
    with tempfile.TemporaryDirectory() as folder:
        options = ["--headless", *(part for group in groups for part in ("--group", group))]
        graph = Graph(launch, f"memory{os.getpid()}", Path(folder), options=options)
        try:
            graph.observe()
            graph.first_view_s()
            graph.listen(after_s)
            found = psutil.Process(graph.process.pid).children(recursive=True)
            names = {pid: name for name, pid in graph.pids.items()} | {graph.process.pid: "supervisor"}
            columns = {
                names.get(pid, "fork server"): by_kind(mappings(pid))
                for pid in (graph.process.pid, *(child.pid for child in found))
            }
        finally:
            graph.stop()
    kinds = dict.fromkeys(kind for column in columns.values() for kind in column)
    largest_first = sorted(kinds, key=lambda kind: -sum(column[kind].resident for column in columns.values()))
    sums = [_sum(column.values()) for column in columns.values()]
    rows = [*((kind, *(column[kind] for column in columns.values())) for kind in largest_first), ("all", *sums)]
    return "\n".join([*table(("", *columns), rows), f"In all: {_sum(sums)}."])


def stopped_receiver(launch: Path) -> list[int]:
    """Return the player's resident memory in MiB: before the RA former is stopped, at the end of that, every 2 s after.

    It is stopped for `STOPPED_S`, for which its supervisor waits.
    """
    with tempfile.TemporaryDirectory() as folder:
        graph = Graph(launch, f"stopped{os.getpid()}", Path(folder), options=["--headless"])
        try:
            graph.observe()
            graph.first_view_s()
            graph.listen(8.0)
            sender, found = psutil.Process(graph.pids["player"]), []
            for number, listen_s in ((signal.SIGSTOP, STOPPED_S), (signal.SIGCONT, 2.0)):
                found.append(_resident_mib(sender))
                os.kill(graph.pids["ra_former"], number)
                graph.listen(listen_s)
            for _ in range(3):
                found.append(_resident_mib(sender))
                graph.listen(2.0)
        finally:
            graph.stop()
    return found


def _resident_mib(process: psutil.Process) -> int:
    return round(process.memory_info().rss / 2**20)


class Share(NamedTuple):
    """Memory in MiB: resident, proportional, and pages that no file holds."""

    resident: float = 0.0
    proportional: float = 0.0
    anonymous: float = 0.0

    def __str__(self) -> str:
        return f"{self.resident:.1f} ({self.proportional:.1f}, {self.anonymous:.1f})"


def _sum(shares: Iterable[Share]) -> Share:
    return Share(*(sum(values) for values in zip(*shares, strict=True)))


def by_kind(found: Iterable[Mapping]) -> defaultdict[str, Share]:
    """Return memory by what is mapped: a package's libraries, the interpreter and the system's, or none of them."""
    shares: defaultdict[str, Share] = defaultdict(Share)
    for item in found:
        sizes = (item.rss, item.pss, item.anonymous)
        shares[kind_of(item.path)] = _sum([shares[kind_of(item.path)], Share(*(size / 2**20 for size in sizes))])
    return shares


def kind_of(path: str) -> str:
    """Return what a path belongs to."""
    if not path.startswith("/"):
        return "heap of the C library" if path == "[heap]" else "other memory of its own"
    package = re.search(r"(?:site|dist)-packages/([^/.]+)", path)
    return package[1] if package else "interpreter and system"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("node", choices=[*WORK, "graph", "stopped"])
    parser.add_argument("--hours", type=float, default=2.0)
    parser.add_argument("--launch", type=Path, default=LAUNCHES[0])
    parser.add_argument("--after", type=float, default=60.0, metavar="S")
    parser.add_argument("--group", action="append", default=[], help="host these nodes in one process")
    arguments = parser.parse_args()
    if arguments.node == "stopped":
        hear_ctrl_c()
        print(stopped_receiver(arguments.launch))
        return
    if arguments.node == "graph":
        hear_ctrl_c()
        print(graph_memory(arguments.launch, arguments.after, arguments.group))
        return
    print(json.dumps({"node": arguments.node, "resident_mib": resident_mib(arguments.node, arguments.hours)}))


if __name__ == "__main__":
    main()
