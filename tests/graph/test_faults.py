"""Faults put to the real processes, one after the other: each is seen, said and survived (docs/results/README.md).

One graph serves most of them: the corner at the real rate with short beams, a car on a CAN bus that the test drives,
a recorder and a viewer. What is no matter of processes (broken files) is put to the functions themselves.
"""

from __future__ import annotations

import contextlib
import json
import os
import re
import resource
import shutil
import signal
import socket
import stat
import struct
import subprocess
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager, suppress
from functools import partial
from pathlib import Path
from typing import Any

import can
import numpy as np
import psutil
import pytest
import zmq
from websockets.sync.client import ClientConnection, connect

from benchmarks.live.processes import processes_of
from mirrorwave.cli import main
from models.perception.onnx_session import MAX_MODEL_BYTES
from msgs.bus.interface import Outgoing
from msgs.bus.local import LocalNetwork
from msgs.bus.topics import TOPICS
from msgs.bus.zmq import ZmqBus, socket_path
from msgs.files.shipped import WEIGHTS
from msgs.recording.mcap import RecordingReader
from msgs.values.diagnostics import NodeState
from msgs.values.perception import BevFrame, Peaks
from msgs.values.radar import RadarSetup, RangeAzimuthMap
from msgs.values.vehicle import VehicleState
from nodes import dense_predictor, geometry, player, ra_former
from nodes.can.bus import BusParams, CanLink, LogFrame, bus_frame, load_dbc, load_mapping
from nodes.node import InProcessGraph, load_node
from nodes.process.supervisor import read_lock
from nodes.vehicle_can import LogSource
from sim_player.car import SimulatedCar
from tests.graph.fault_tools import PATIENCE_S, LiveGraph
from tests.ports import free_udp_port

SCENE = "launch/scenes/facade_across_lane.yaml"
#: The chain that makes views, and what hangs on it.
CHAIN = ("player", "ra_former", "dense_predictor", "geometry")
BESIDE = ("vehicle_can", "bev_viewer", "recorder")
SECOND_NS = 1_000_000_000
BEAMS_A_SCAN = 25
#: A user of no rights.
NOBODY = 65_534
ENTER = stat.S_IXGRP | stat.S_IXOTH
#: Of the virtual clock: a clock may be set back from here.
START_NS = 10_000 * SECOND_NS
CAN_BUS = {
    "interface": "udp_multicast",
    "channel": "239.74.163.2",
    # of this run alone: other tests may drive cars of their own
    "options": {"port": free_udp_port(), "hop_limit": 0},
}
Note = Callable[[str, object], None]


def launch_text(folder: Path) -> str:
    """The graph: heartbeats may stop for long, so that nothing but what the tests do is taken for a fault."""
    patient = {"hang_timeout_s": 10.0}
    nodes: dict[str, Any] = {
        "player": {
            "module": "nodes.player",
            "params": {"scene": SCENE, "publish_vehicle_state": False, "chirps_per_beam": 4},
            "after": ["ra_former", "dense_predictor", "geometry"],
        },
        "vehicle_can": {"module": "nodes.vehicle_can", "params": CAN_BUS},
        "ra_former": {"module": "nodes.ra_former", "hang_timeout_s": 17.5},
        "dense_predictor": {"module": "nodes.dense_predictor"},
        "geometry": {"module": "nodes.geometry"},
        "bev_viewer": {"module": "nodes.bev_viewer", "params": {"port": 0}, "viewer": True},
        "hungry": {"module": "tests.graph.hungry_node"},
    }
    return json.dumps({"name": "faults", "nodes": {name: patient | entry for name, entry in nodes.items()}})


class Car(threading.Thread):
    """A car on a CAN bus of this machine that says what it is told to: well, wrong checksums, bus-off or nothing."""

    def __init__(self) -> None:
        super().__init__(daemon=True)
        self.mode = "well"
        self.ends = threading.Event()
        self._link = CanLink(BusParams(**CAN_BUS))
        self.works = self._link.send(can.Message(), 0)
        self._car = SimulatedCar(
            load_dbc(Path("launch/can/mirrorwave.dbc")), load_mapping(Path("launch/can/mirrorwave.yaml"))
        )
        self.speed_mps = 0.0

    def run(self) -> None:
        while not self.ends.wait(0.005):
            now_ns = time.monotonic_ns()
            frames = self._car.frames(VehicleState(stamp_ns=now_ns, speed_mps=self.speed_mps))
            if self.mode == "bus-off":
                self._link.send(can.Message(is_error_frame=True, arbitration_id=0x40), now_ns)
            for frame in frames if self.mode in ("well", "wrong checksums") else ():
                data = bytes(byte ^ (0xFF if self.mode != "well" else 0) for byte in frame.data)
                self._link.send(bus_frame(frame.arbitration_id, data, frame.extended, now_ns), now_ns)
        self._link.close()


@pytest.fixture(scope="module")
def car() -> Iterator[Car]:
    """Frames over udp_multicast on this machine."""
    one = Car()
    one.start()
    yield one
    one.ends.set()
    one.join()


@contextmanager
def own_disk(folder: Path) -> Iterator[Path | None]:
    """A file system of its own where the machine allows to mount one, else None."""
    made = subprocess.run(["mount", "-t", "tmpfs", "-o", "size=4g", "tmpfs", folder], capture_output=True)
    try:
        yield folder if made.returncode == 0 else None
    finally:
        if made.returncode == 0:
            subprocess.run(["umount", "-l", folder], check=True)


@pytest.fixture(scope="module")
def graph(car: Car) -> Iterator[LiveGraph]:
    """The running graph, everything ready and views coming; its path is short, as socket names ask."""
    with tempfile.TemporaryDirectory(prefix="mw") as name:
        root = Path(name)
        (root / "disk").mkdir()
        with own_disk(root / "disk") as disk:
            (root / "faults.yaml").write_text(launch_text(root))
            recording = ["--record", str(root / "disk" / "all.mcap"), "--min-free", "0"]
            live = LiveGraph(root / "faults.yaml", root, *recording)
            live.disk = disk
            try:
                live.await_ready((*CHAIN, *BESIDE, "hungry"))
                live.await_views()
                yield live
            finally:
                with suppress(subprocess.TimeoutExpired):
                    live.close()
        assert processes_of(root) == []


@pytest.fixture
def note(request: pytest.FixtureRequest) -> Note:
    """Tells a measured figure, on the terminal with `-s`: docs/results/README.md has them from there."""

    def tell(what: str, value: object) -> None:
        print(f"\n{request.node.name}: {what}: {value if not isinstance(value, float) else f'{value:.2f}'}", end="")

    return tell


# who joins, and how


# what comes in


def garbage(topic: str, rng: np.random.Generator) -> list[list[bytes]]:
    """Random, truncated, oversize and nested messages under the right topic, and none at all."""
    name = topic.encode() + b"\0"
    return [
        [name],
        [name, b""],
        [name, rng.bytes(300)],
        [name, b"\x82\xa8envelope"],
        [name, b"\x91" * 5000],
        [name, rng.bytes(100), rng.bytes(1000), b""],
        [name, rng.bytes(TOPICS[topic].max_bytes + 1)],
        [name[:-1] + b"x\0", rng.bytes(50)],
    ]


@pytest.mark.graph
def test_garbage_on_every_topic_is_counted_and_survived(graph: LiveGraph) -> None:
    """Oversize and malformed frames are refused one by one: nothing ends, views go on, each refusal is counted."""
    takers = {
        "radar/beam": "ra_former",
        "vehicle/state": "ra_former",
        "radar/setup": "ra_former",
        "radar/ra_map": "dense_predictor",
        "perception/peaks": "geometry",
    }
    # before a message over the limit cuts the sender off for good
    fewest, pids, rng, context = 4, graph.pids(), np.random.default_rng(0), zmq.Context()
    try:
        evil = {topic: context.socket(zmq.PUB) for topic in takers}
        for topic, publisher in evil.items():
            publisher.bind(f"ipc://{socket_path(graph.run_dir, topic, 'evil')}")
        start_s = time.monotonic()

        def all_have_refused() -> bool:
            if time.monotonic() - start_s > 0.5:
                for topic, publisher in evil.items():
                    for frames in garbage(topic, rng):
                        publisher.send_multipart(frames)
            return all(graph.rejected(node, topic) >= fewest for topic, node in takers.items())

        graph.await_that("garbage to be refused", all_have_refused)
    finally:
        context.destroy(linger=0)
        for topic in takers:
            socket_path(graph.run_dir, topic, "evil").unlink(missing_ok=True)
    graph.await_views()
    assert graph.pids() == pids


def flood(run_dir: Path, ends: threading.Event) -> None:
    """A set-up that turns all beats round, and 600 empty sets of peaks a second."""
    none = np.zeros(0)
    with closing(ZmqBus("stray", run_dir)) as bus:
        bus.publish("radar/setup", RadarSetup(beat_sign=-1))
        while not ends.wait(1 / 600):
            peaks = Peaks(
                stamp_ns=bus.now_ns(), scan_id=0, range_m=none, azimuth_rad=none, score=none, snr_db=none,
                path_class=none.astype(np.uint8), covariance=none.reshape(0, 2, 2), peak_stamp_ns=none.astype(np.int64),
            )  # fmt: skip
            bus.publish("perception/peaks", peaks)
            bus.receive(0.0)


@pytest.mark.graph
def test_a_second_publisher_changes_nothing_and_is_named(graph: LiveGraph) -> None:
    readers = {"ra_former": "radar/setup", "dense_predictor": "radar/setup", "geometry": "perception/peaks"}

    def name_it() -> bool:
        return all(f"{topic} has 2 publishers" in graph.status[node].reason for node, topic in readers.items())

    ends = threading.Event()
    sender = threading.Thread(target=flood, args=(graph.run_dir, ends))
    sender.start()
    try:
        graph.await_that("the second publisher to be named", name_it)
        graph.await_views()
        graph.await_that("objects while it sends", lambda: graph.view is not None and graph.view.objects)
    finally:
        ends.set()
        sender.join()
    for node, topic in readers.items():
        shed = {count.what: count.reason for count in graph.status[node].shed}
        assert shed[f"{topic} message"] == "of another publisher"


@pytest.mark.graph
def test_beams_lost_on_the_way_are_said_and_views_go_on(graph: LiveGraph, note: Note) -> None:
    """A former that stands still for 125 beams misses what its queue does not hold, whole scans and torn ones: every
    beam is counted, no scan it lacks comes as if it were whole, none is left out unsaid, and the views come again."""
    lost_before, maps = graph.lost("ra_former", "radar/beam"), {}
    left_out_before = _scans_left_out(graph)
    with _joined(graph, "map_reader", "radar/ra_map", "sim/truth") as bus:
        # the test may be late itself: a map is not left out because a newer one is there
        bus.want_all()

        def hear(topic: str, count: int) -> None:
            end_s = time.monotonic() + PATIENCE_S
            while count > 0:
                assert time.monotonic() < end_s, f"{count} more messages of {topic} should have come"
                for one in bus.receive(0.1):
                    count -= one.topic == topic
                    if one.topic == "radar/ra_map":
                        maps[one.message.scan_id] = one.message

        hear("radar/ra_map", 1)
        pid = graph.fault(signal.SIGSTOP, ["ra_former"])["ra_former"]
        hear("sim/truth", 5)
        os.kill(pid, signal.SIGCONT)
        hear("radar/ra_map", 5)
        unheard = next(count.lost for count in bus.counts()[0] if count.topic == "radar/ra_map")
    graph.await_that("lost beams to be counted", lambda: graph.lost("ra_former", "radar/beam") > lost_before)
    lost = graph.lost("ra_former", "radar/beam") - lost_before
    absent = max(maps) - min(maps) + 1 - len(maps)
    flagged = sum(bool(one.missing_beams) for one in maps.values())
    note("beams lost", lost)
    note("scans left out", absent)
    note("scans flagged", flagged)
    assert absent + flagged >= lost / BEAMS_A_SCAN
    said = left_out_before + absent - unheard - lost // BEAMS_A_SCAN
    graph.await_that("scans left out to be said", lambda: _scans_left_out(graph) >= said)
    graph.await_views()
    assert graph.status["ra_former"].pid == pid


@pytest.mark.graph
def test_wrong_checksums_cost_the_motion_and_not_the_views(graph: LiveGraph, car: Car, note: Note) -> None:
    """Frames whose checksum does not hold do not count: the state is invalid and says why, views go on without the
    vehicle's motion; the first good frames bring it back."""
    _require_can(car)
    _await_motion(graph, known=True)
    car.mode = "wrong checksums"
    state, seen_s = _await_state(graph, lambda state: not state.valid)
    assert "checksum" in state.reason
    note("said after s", seen_s)
    _await_motion(graph, known=False)
    assert graph.await_that("DEGRADED", lambda: graph.status["vehicle_can"].state is NodeState.DEGRADED)
    car.mode = "well"
    note("again after s", _await_state(graph, lambda state: state.valid)[1])
    _await_motion(graph, known=True)


@pytest.mark.graph
def test_a_bus_that_is_off_or_gone_comes_back(graph: LiveGraph, car: Car, note: Note) -> None:
    """Bus-off is told in the state's reason; datagrams that are no frames make the node open its bus anew. Either way
    the node stays, views go on and the motion comes back with the frames."""
    _require_can(car)
    pids = graph.pids()
    car.mode = "bus-off"
    _, seen_s = _await_state(graph, lambda state: not state.valid and "bus-off" in state.reason)
    note("bus-off said after s", seen_s)
    car.mode = "well"
    note("again after s", _await_state(graph, lambda state: state.valid)[1])
    car.mode = "silent"
    start = len(graph.said)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as stranger:
        stranger.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_TTL, 0)

        def is_opened_anew() -> bool:
            stranger.sendto(b"no frame", (CAN_BUS["channel"], CAN_BUS["options"]["port"]))
            return graph.found("udp_multicast", "vehicle_can", start) is not None

        graph.await_that("the bus to be given up", is_opened_anew)
    car.mode = "well"
    note("after a broken bus again after s", _await_state(graph, lambda state: state.valid)[1])
    graph.await_views()
    assert graph.pids() == pids


# who looks on


@pytest.mark.graph
def test_dead_pages_hold_nobody_up(graph: LiveGraph, note: Note) -> None:
    """One page never reads, one vanishes without a word, one never finishes its first line: another page gets update
    after update and the graph its views."""
    pids = graph.pids()
    found = re.findall(r"open (http\S+)", graph.out.read_text())
    url, host = found[-1], found[-1].split("/")[2]
    options = {"origin": f"http://{host}", "max_size": 1 << 24, "ping_interval": None, "close_timeout": 0.1}
    page = partial(connect, url.replace("http:", "ws:") + "ws", compression=None, **options)
    with socket.create_connection(tuple(host.split(":"))) as mute, page(max_queue=1), page() as gone, page() as good:
        mute.sendall(b"GET / HT")
        # the end without a goodbye
        gone.socket.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
        gone.socket.shutdown(socket.SHUT_RDWR)
        start_s = time.monotonic()
        numbers = _updates(good, 8)
        note("8 updates in s", time.monotonic() - start_s)
        assert numbers == sorted(set(numbers))
        graph.await_views()
    assert graph.pids() == pids


# what ends


def _await_new(graph: LiveGraph, note: Note, pids: dict[str, int], start: int, sign: str) -> None:
    """Wait until processes that were hit are replaced and views come; all others must be the same as before."""
    since_ns = time.monotonic_ns()
    others = {name: pid for name, pid in graph.pids().items() if name not in pids}
    for name in pids:
        seen = graph.await_text(f"{name} {sign}", "supervisor", start)
        note(f"{name} seen after s", seen.time_s - 1e-9 * since_ns)
    graph.await_ready(pids, other_than=pids)
    for name in pids:
        ready = graph.await_text(f"{name} ready after", "supervisor", start)
        note(f"{name} again after s", ready.time_s - 1e-9 * since_ns)
    note("view again after s", graph.await_views(since_ns=since_ns))
    assert {name: pid for name, pid in graph.pids().items() if name not in pids} == others


@pytest.mark.graph
def test_killed_nodes_are_replaced_and_the_others_stay(graph: LiveGraph, note: Note) -> None:
    """SIGKILL, as the kernel sends it when memory is short, ends any node: it is said, the node is started again,
    views go on, and no other process is touched."""
    start = len(graph.said)
    _await_new(graph, note, graph.fault(signal.SIGKILL, (*CHAIN[::2], *BESIDE[:2])), start, "was ended by SIGKILL")


@pytest.mark.graph
def test_what_a_killed_recorder_wrote_is_recoverable(graph: LiveGraph, note: Note, tmp_path: Path) -> None:
    """The file ends where its last whole chunk does; it reads up to there, `bag recover` makes a whole one of it, and
    the recorder that is started again writes beside it."""
    before, start = _recorder_file(graph), len(graph.said)
    _await_new(graph, note, graph.fault(signal.SIGKILL, ["recorder"]), start, "was ended by SIGKILL")
    assert len(_recorder_file(graph)) == len(before) + 1
    assert {stat.S_IMODE(path.stat().st_mode) for path in _recorder_file(graph)} == {0o600}
    with RecordingReader(before[-1]) as reader:
        maps = sum(isinstance(one.message, RangeAzimuthMap) for one in reader.messages(["radar/ra_map"]))
        assert maps > 0
        assert reader.loss is not None
    whole = tmp_path / "whole.mcap"
    assert main(["bag", "recover", str(before[-1]), str(whole)]) == 3
    with RecordingReader(whole) as reader:
        assert sum(1 for _ in reader.messages(["radar/ra_map"])) == maps


@pytest.mark.graph
def test_stopped_nodes_are_replaced(graph: LiveGraph, note: Note) -> None:
    """SIGSTOP to every node at once: each is missed, killed and started again, and views come again."""
    start = len(graph.said)
    _await_new(graph, note, graph.fault(signal.SIGSTOP, (*CHAIN, *BESIDE)), start, "hangs")


@pytest.mark.graph
def test_a_node_without_memory_ends_with_one_line_and_comes_back(graph: LiveGraph, note: Note) -> None:
    """The kernel gives a node no more memory: it ends with one line that says so, is started again, and no other is
    touched. (The kernel's other answer, SIGKILL, is above.)"""
    start, pid = len(graph.said), graph.status["hungry"].pid
    # room for all it may come to need, but not for the 1 GiB that it asks for
    most = _size_between_requests(pid) + (1 << 29)
    resource.prlimit(pid, resource.RLIMIT_AS, (most, resource.RLIM_INFINITY))
    _await_new(graph, note, {"hungry": pid}, start, "exited with code 1: ")
    said = graph.found("hungry exited with code 1: ", "supervisor", start)
    assert said is not None
    assert "MemoryError: Unable to allocate 1.00 GiB" in said.text
    note("said", said.text)


@pytest.mark.graph
def test_a_run_directory_that_is_deleted_is_made_again(graph: LiveGraph, note: Note) -> None:
    """Whoever was connected stays connected; sockets are opened again at their places, so that who comes later, and
    a node that is started again, find everybody."""
    start, start_s = len(graph.said), time.monotonic()
    _delete(graph.run_dir)
    graph.await_text("opened again", "player", start)
    note("sockets again after s", time.monotonic() - start_s)
    pid = graph.process.pid
    graph.await_that("the lock to stand again", lambda: read_lock(graph.run_dir).get("pid") == pid)
    _await_new(graph, note, graph.fault(signal.SIGKILL, ["geometry"]), start, "was ended by SIGKILL")
    with _joined(graph, "latecomer", "radar/setup") as bus:
        assert isinstance(_first(bus, "radar/setup").message, RadarSetup)


def _delete(folder: Path) -> None:
    """Delete a folder in which others may just be making files: `rmtree` fails where one comes after it has listed."""
    for _ in range(100):
        with contextlib.suppress(OSError):
            return shutil.rmtree(folder)
    raise TimeoutError(f"{folder}: is filled faster than it is deleted")


@pytest.mark.graph
def test_a_full_disk_ends_the_recording_and_not_the_graph(graph: LiveGraph, note: Note) -> None:
    """The recorder says so, stays, DEGRADED, and counts what it misses; the file is whole up to there, views go on,
    and at the end the graph's exit code is 3, with the file named."""
    recorder, start = graph.status["recorder"], len(graph.said)
    file = Path(_recorder_file(graph)[-1])
    if graph.disk is not None:
        _fill(graph.disk)
    else:
        size = file.stat().st_size
        resource.prlimit(recorder.pid, resource.RLIMIT_FSIZE, (size, size))
    said = graph.await_text("recording ended", "recorder", start)
    note("said", said.text.replace(str(file), file.name))
    graph.await_that("DEGRADED", lambda: graph.status["recorder"].state is NodeState.DEGRADED)
    graph.await_views()
    assert graph.status["recorder"].pid == recorder.pid
    assert graph.close() == 3
    assert re.search(f"^{file}: ", graph.out.read_text(), re.MULTILINE)
    with RecordingReader(file) as reader:
        assert sum(1 for _ in reader.messages(["perception/hidden_objects"])) > 0
        # what is missing stands in the file unless there was no room for that either: it then shows that it was cut
        assert reader.loss or (reader.losses is not None and reader.losses.ended)


# what is left behind


@pytest.mark.graph
def test_what_a_killed_graph_left_is_taken_over(note: Note) -> None:
    """SIGKILL to the supervisor: its nodes end with it, socket files and lock stay; the next graph runs in their
    place, and hears nothing of the dead."""
    with tempfile.TemporaryDirectory(prefix="mw") as name:
        root, pids = Path(name), []
        nodes = {"tick": {"module": "tests.graph.toy_nodes"}}
        (root / "toy.yaml").write_text(json.dumps({"name": "toy", "nodes": nodes}))
        for last in (False, True):
            graph = LiveGraph(root / "toy.yaml", root)
            try:
                graph.await_ready(["tick"], other_than=dict.fromkeys(["tick"], pids[-1] if pids else 0))
                pids.append(graph.pids()["tick"])
                assert (graph.run_dir / "supervisor.lock").read_text() != ""
            finally:
                code = graph.close() if last else graph.kill()
            assert code == (0 if last else -signal.SIGKILL)
            end_s = time.monotonic() + PATIENCE_S
            while processes_of(root) and time.monotonic() < end_s:
                time.sleep(0.01)
            assert processes_of(root) == []
            if not last:
                assert (graph.run_dir / "vehicle.state@tick").is_socket()
                assert (graph.run_dir / "supervisor.lock").read_text() != ""


REFUSED = {
    "parameters": ("nodes.recorder", {"path": 3}, "bad.params.path: Expected str, got int"),
    "model": ("nodes.dense_predictor", {"model": "net.onnx"}, "net.onnx: sha256 must be "),
}


@pytest.mark.graph
@pytest.mark.parametrize("name", REFUSED)
def test_what_a_node_refuses_ends_the_graph_at_once(
    name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """A module that is none, parameters and a flipped model that its node refuses: exit code 2, one line that names
    node, field and rule, no restart, no process left."""
    module, params, rule = REFUSED[name]
    if "model" in params:
        flipped(tmp_path)
        params = {"model": str(tmp_path / "net.onnx")}
    launch = tmp_path / "bad.yaml"
    launch.write_text(json.dumps({"name": "bad", "nodes": {"bad": {"module": module, "params": params}}}))
    with tempfile.TemporaryDirectory(prefix="mw") as rooms:
        monkeypatch.setenv("MIRRORWAVE_RUN_DIR", rooms)
        assert main(["launch", str(launch), "--domain", "g", "--runs-dir", f"{rooms}/runs"]) == 2
        assert processes_of(Path(rooms)) == []
    said = capsys.readouterr().out
    assert "restart" not in said
    assert "Traceback" not in said
    failed = [line for line in said.splitlines() if line.startswith("[supervisor] bad FAILED: ")]
    assert len(failed) == 1
    assert rule in failed[0]


# files that are not what they should be


ALIASES = "name: x\na: &a [1, 1]\nb: &b [*a, *a]\nnodes: {}\n"
NODE = "name: x\nnodes: {a: {module: nodes.geometry"
MISTAKES: dict[str, tuple[str | bytes | None, str]] = {
    "missing": (None, "No such file or directory"),
    "empty": ("", "expected a mapping, got nothing"),
    "no mapping": ("- 1\n- 2\n", "expected a mapping, got a list"),
    "no yaml": ("name: {", "line 1"),
    "alias bomb": (ALIASES, "aliases are refused"),
    "NaN": (NODE + ", hang_timeout_s: .nan}}", "hang_timeout_s must be finite and not negative, got nan"),
}


@pytest.mark.parametrize("name", MISTAKES)
def test_a_wrong_launch_file_is_one_line(
    name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Exit code 2, one line that names file, field and rule; nothing was started and nothing is left."""
    content, rule = MISTAKES[name]
    path = tmp_path / "wrong.yaml"
    if content is not None:
        path.write_bytes(content.encode() if isinstance(content, str) else content)
    _is_refused(path, rule, capsys, monkeypatch)


def test_a_launch_file_that_is_none_or_forbidden_is_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """A directory, and a file that may not be read."""
    (tmp_path / "wrong.yaml").mkdir()
    _is_refused(tmp_path / "wrong.yaml", "Is a directory", capsys, monkeypatch)
    forbidden = tmp_path / "forbidden.yaml"
    forbidden.write_text("name: x")
    forbidden.chmod(0)
    with _as_anybody(tmp_path):
        assert not os.access(forbidden, os.R_OK, effective_ids=True)
        _is_refused(forbidden, "Permission denied", capsys, monkeypatch)


@contextmanager
def _as_anybody(folder: Path) -> Iterator[None]:
    """Be another user where this is root, who may read everything, with a way to `folder`."""
    if os.geteuid() != 0:
        yield
        return
    ways = {way: way.stat().st_mode for way in (folder, *folder.parents)}
    for way, mode in ways.items():
        # root's group is kept: it may need its own permission
        if mode & ENTER != ENTER:
            way.chmod(mode | ENTER)
    try:
        os.seteuid(NOBODY)
        yield
    finally:
        os.seteuid(0)
        for way, mode in ways.items():
            if mode & ENTER != ENTER:
                way.chmod(stat.S_IMODE(mode))


def _is_refused(path: Path, rule: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    rooms = path.parent / "rooms"
    monkeypatch.setenv("MIRRORWAVE_RUN_DIR", str(rooms))
    assert main(["launch", str(path), "--domain", "g", "--runs-dir", str(path.parent / "runs")]) == 2
    said = capsys.readouterr()
    assert said.out == ""
    assert said.err.count("\n") == 1
    assert said.err.startswith(f"mirrorwave: {path}: ")
    assert re.search(rule, said.err), said.err
    assert not rooms.exists()
    assert not (path.parent / "runs").exists()


def model_copy(folder: Path, name: str = "net") -> Path:
    """The network in use and its card, to be broken."""
    for ending in (".onnx", ".json"):
        shutil.copy(WEIGHTS / f"compact_unet{ending}", folder / f"{name}{ending}")
    return folder / f"{name}.onnx"


def flipped(folder: Path) -> Path:
    """The network with one bit changed in its middle."""
    model = model_copy(folder)
    data = bytearray(model.read_bytes())
    data[len(data) // 2] ^= 1
    model.write_bytes(data)
    return model


def with_card(model: Path, data: bytes) -> None:
    """Write other bytes, and let the card vouch for them."""
    import hashlib

    model.write_bytes(data)
    card = json.loads(model.with_suffix(".json").read_text())
    model.with_suffix(".json").write_text(json.dumps(card | {"sha256": hashlib.sha256(data).hexdigest()}))


def _cut(model: Path) -> None:
    with_card(model, model.read_bytes()[:100_000])


def _empty(model: Path) -> None:
    with_card(model, b"")


def _huge(model: Path) -> None:
    os.truncate(model, 1 << 40)


def _other_network(model: Path) -> None:
    with_card(model, (WEIGHTS / "field_unet.int8.onnx").read_bytes())


def _other_opset(model: Path) -> None:
    data = model.read_bytes()
    # opset_import of the main domain: field 8, then domain "" and version, of one byte each
    at = re.search(rb"\x42(\x04\n\x00\x10|\x02\x10)", data)
    assert at is not None
    with_card(model, data[: at.end()] + b"\x7f" + data[at.end() + 1 :])


def _no_card(model: Path) -> None:
    model.with_suffix(".json").unlink()


def _huge_card(model: Path) -> None:
    os.truncate(model.with_suffix(".json"), 1 << 40)


BROKEN_MODELS = {
    "cut": (_cut, "must be a whole ONNX file"),
    "empty": (_empty, "must be a whole ONNX file"),
    "huge": (_huge, f"must be a file of at most {MAX_MODEL_BYTES} bytes"),
    "another opset": (_other_opset, "must be a whole ONNX file.*[Oo]pset"),
    "no card": (_no_card, "No such file or directory"),
    "huge card": (_huge_card, "must be a file of at most"),
}


@pytest.mark.parametrize("name", BROKEN_MODELS)
def test_a_broken_model_is_one_line(name: str, tmp_path: Path) -> None:
    """The node is not made; the error names the file and what is wrong with it (flipped bytes: above, in a graph)."""
    spoil, rule = BROKEN_MODELS[name]
    model = model_copy(tmp_path)
    spoil(model)
    with pytest.raises(ValueError, match=rule) as caught:
        load_node("nodes.dense_predictor", {"model": str(model)})
    assert str(tmp_path / "net") in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    """Three scans of short beams, as a whole recording."""
    path = tmp_path_factory.mktemp("recording") / "whole.mcap"
    short = ["--scans", "3", "--chirps-per-beam", "1", "--effects", "basic"]
    assert main(["sim", "run", "launch/scenes/two_hidden_vehicles.yaml", "--out", str(path), *short]) == 0
    return path.read_bytes()


@pytest.mark.slow
@pytest.mark.parametrize(("share", "scans"), [(0.0, None), (0.75, 2)])
def test_a_cut_recording_is_played_up_to_its_cut(
    share: float,
    scans: int | None,
    recording: bytes,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    caplog: pytest.LogCaptureFixture,
) -> None:
    """`process`, `bag play` and the player give every whole scan before the cut and say where the file ends: exit
    code 3. What holds nothing at all is refused in one line: exit code 2."""
    path = tmp_path / "cut.mcap"
    path.write_bytes(recording[: int(share * len(recording))])
    monkeypatch.setenv("MIRRORWAVE_RUN_DIR", tempfile.mkdtemp(prefix="mw", dir="/tmp"))
    capsys.readouterr()
    processed = main(["process", str(path), "--profile", "cfar", "--out", str(tmp_path / "out")])
    played = main(["bag", "play", str(path), "--rate", "0", "--domain", "g"])
    shutil.rmtree(os.environ["MIRRORWAVE_RUN_DIR"])
    said = capsys.readouterr()
    if scans is None:
        assert (processed, played) == (2, 2)
        assert said.err.count("\n") == 2
        with pytest.raises(ValueError, match=str(path)):
            player.create(player.Params(capture=str(path)))
        return
    assert (processed, played) == (3, 3)
    assert said.out.count(f"{path}: cut off at byte") == 2
    assert len((tmp_path / "out" / "objects.jsonl").read_text().splitlines()) == scans
    beams = sum(event.outgoing.topic == "radar/beam" for event in player.capture_events(path))
    assert beams >= 25 * scans
    assert "cut off at byte" in caplog.text


# clocks that are set


class Jumping(player.Player):
    """A scene whose stamps jump: `jump_ns(topic, scan, beam)` is added to each."""

    def __init__(self, jump_ns: Callable[[str, int, int], int], scans: int) -> None:
        params = player.Params(scene=SCENE, chirps_per_beam=1, scans=scans, ego_speed_mps=3.0, effects="basic")
        events = player.scene_events(player.scene_player(params), scans)
        super().__init__((self._moved(event) for event in events), 1.0, 0.3, restamp=False)
        self._jump_ns = jump_ns

    def _moved(self, event: player.Event) -> player.Event:
        topic, message = event.outgoing
        if topic == "radar/setup":
            return event
        period_ns = SECOND_NS * 3 // 10
        scan, beam = divmod(event.offset_ns, period_ns)
        by_ns = START_NS + self._jump_ns(topic, scan, beam // (period_ns // 25))
        return event._replace(outgoing=Outgoing(topic, player.moved(message, by_ns)))


def seen_with(
    jump_ns: Callable[[str, int, int], int], scans: int = 8
) -> tuple[dict[int, BevFrame], dict[int, Any], Any]:
    """Views and maps by scan, and the former, of a graph on a virtual clock whose sensors' clocks jump."""
    network = LocalNetwork(start_ns=START_NS)
    listener = network.bus("listener")
    for topic in ("perception/hidden_objects", "radar/ra_map"):
        listener.subscribe(topic)
    listener_messages: list[Any] = []
    former = ra_former.create(ra_former.Params())
    nodes = {
        "player": Jumping(jump_ns, scans),
        "ra_former": former,
        "dense_predictor": dense_predictor.create(dense_predictor.Params(method="cfar")),
        "geometry": geometry.create(geometry.Params()),
    }
    graph = InProcessGraph(network, nodes)
    for scan in range(scans + 3):
        graph.run(START_NS + (scan + 1) * SECOND_NS * 3 // 10)
        listener_messages += [one.message for one in listener.receive(0.0)]
    graph.run()
    listener_messages += [one.message for one in listener.receive(0.0)]
    graph.close()
    views = {one.scan_id: one for one in listener_messages if isinstance(one, BevFrame)}
    maps = {one.scan_id: one for one in listener_messages if isinstance(one, RangeAzimuthMap)}
    return views, maps, former


@pytest.mark.slow
@pytest.mark.parametrize("jump_s", [3600.0, -12.0])
def test_a_radar_clock_that_is_set_within_a_scan_is_flagged(jump_s: float, caplog: pytest.LogCaptureFixture) -> None:
    """Radar and vehicle on one clock that is set in the middle of scan 3, and back in the middle of scan 6: the beams
    after the jump do not belong to their scan, they are refused, counted and missing in its map; every other scan is
    whole, with the vehicle's motion."""

    def jump_ns(topic: str, scan: int, beam: int) -> int:
        return int(jump_s * SECOND_NS) if (3, 10) <= (scan, beam) < (6, 10) else 0

    views, maps, former = seen_with(jump_ns)
    assert sorted(views) == list(range(8))
    assert maps[3].missing_beams == maps[6].missing_beams == tuple(range(10, 25))
    assert not any(set(maps[scan].missing_beams) & set(range(10, 25)) for scan in (0, 1, 2, 4, 5, 7))
    assert sum(one.count for one in former.shed.counts() if one.reason == "refused") == 30
    assert "the radar's clock was set by" in caplog.text
    assert all(views[scan].ego is not None for scan in (0, 1, 2, 4, 5, 7))
    assert former.health()[0] is NodeState.READY


@pytest.mark.slow
@pytest.mark.parametrize("jump_s", [3600.0])
def test_a_vehicle_clock_that_is_set_costs_the_motion_until_it_is_right(jump_s: float) -> None:
    """The vehicle's stamps alone jump, before scan 2, and are right again from scan 5: meanwhile no state fits a scan,
    and views say so (`ego` is None); afterwards the motion is back."""

    def jump_ns(topic: str, scan: int, beam: int) -> int:
        return int(jump_s * SECOND_NS) if topic == "vehicle/state" and 2 <= scan < 5 else 0

    views, _, _ = seen_with(jump_ns)
    assert sorted(views) == list(range(8))
    assert [views[scan].ego is not None for scan in (0, 1)] == [True, True]
    assert views[4].ego is None
    assert [views[scan].ego is not None for scan in (6, 7)] == [True, True]


@pytest.mark.parametrize("jump_s", [1e6, -100.0])
def test_a_log_whose_clock_was_set_plays_on(jump_s: float, caplog: pytest.LogCaptureFixture) -> None:
    """A CAN log whose stamps jump after a second, as where its logger found the time of day: the frames behind go on
    in the pace of those before, and the jump is said."""
    stamps_ns = [at * SECOND_NS // 50 + (int(jump_s * SECOND_NS) if at >= 50 else 0) for at in range(100)]
    source = LogSource(LogFrame(can.Message(), START_NS + stamp_ns) for stamp_ns in stamps_ns)
    played, now_ns = [], 0
    while not source.ended:
        played += [frame.stamp_ns for frame in source.frames(now_ns)]
        now_ns = source.due_ns(now_ns, 10 * SECOND_NS)
    assert len(played) == 100
    assert set(np.diff(played)) == {SECOND_NS // 50}
    assert f"the log's clock was set by {jump_s + 0.02:+.0f} s" in caplog.text


# helpers


@contextmanager
def _joined(graph: LiveGraph, name: str, *topics: str) -> Iterator[ZmqBus]:
    bus = ZmqBus(name, graph.run_dir)
    try:
        for topic in topics:
            bus.subscribe(topic)
        yield bus
    finally:
        bus.close()


def _taken(bus: ZmqBus, topic: str, count: int) -> list[Any]:
    """So many messages of a topic."""
    taken: list[Any] = []
    end_s = time.monotonic() + PATIENCE_S
    while len(taken) < count:
        assert time.monotonic() < end_s, f"{len(taken)} of {count} messages of {topic} came"
        taken += [one for one in bus.receive(0.1) if one.topic == topic]
    return taken


def _first(bus: ZmqBus, topic: str) -> Any:
    return _taken(bus, topic, 1)[0]


def _scans_left_out(graph: LiveGraph) -> int:
    return sum(one.count for one in graph.status["ra_former"].shed if one.what == "scan")


def _require_can(car: Car) -> None:
    if not car.works:
        pytest.skip("this machine forbids multicast: no CAN bus between processes")


def _await_state(graph: LiveGraph, is_so: Callable[[VehicleState], bool]) -> tuple[VehicleState, float]:
    """The first vehicle state that fits, and after how long it came."""
    start_s = time.monotonic()
    with _joined(graph, "state_reader", "vehicle/state") as bus:
        while True:
            state = _first(bus, "vehicle/state").message
            if is_so(state):
                return state, time.monotonic() - start_s


def _await_motion(graph: LiveGraph, known: bool) -> None:
    """Views of scans from now on that know the vehicle's motion, or that do not."""
    since_ns = time.monotonic_ns()

    def fits() -> bool:
        view = graph.view
        return view is not None and view.stamp_ns > since_ns and (view.ego is not None and view.ego.valid) == known

    graph.await_that(f"a view with the motion {'known' if known else 'unknown'}", fits)


def _updates(page: ClientConnection, count: int) -> list[int]:
    """Numbers of so many updates, each taken in and acknowledged."""
    numbers: list[int] = []
    while len(numbers) < count:
        message = page.recv(PATIENCE_S)
        head = json.loads(message) if isinstance(message, str) else {}
        if head.get("type") == "update":
            for _ in range(head["messages"]):
                page.recv(PATIENCE_S)
            page.send(json.dumps({"type": "ack", "number": head["number"]}))
            numbers.append(head["number"])
    return numbers


def _size_between_requests(pid: int) -> int:
    """Virtual memory [bytes] of a node that asks for much now and then: the least of a second."""
    sizes = []
    for _ in range(20):
        sizes.append(psutil.Process(pid).memory_info().vms)
        time.sleep(0.05)
    return min(sizes)


def _recorder_file(graph: LiveGraph) -> list[Path]:
    """Recordings so far, the oldest first: all.mcap, all-2.mcap, ..."""
    found = (graph.run_dir.parent / "disk").glob("all*.mcap")
    return sorted(found, key=lambda path: (len(path.name), path.name))


def _fill(disk: Path) -> None:
    """Make a file system no larger than what it holds."""
    while True:
        found = os.statvfs(disk)
        used_kib = (found.f_blocks - found.f_bfree) * found.f_frsize // 1024
        # refused where it grew meanwhile
        if subprocess.run(["mount", "-o", f"remount,size={used_kib}k", disk], capture_output=True).returncode == 0:
            return
