"""CAN to vehicle/state: buses that fail, logs of three formats, a car on a bus between nodes."""

from __future__ import annotations

import gc
import itertools
import logging
import math
import time
from collections.abc import Callable
from pathlib import Path

import can
import msgspec
import pytest

from msgs.bus.local import LocalNetwork
from msgs.values.diagnostics import NodeState
from msgs.values.vehicle import VehicleState
from nodes import car_sim, player, vehicle_can
from nodes.can.bus import BusParams, CanLink, LogFrame, frame_stamp_ns, load_dbc, load_decoder, load_mapping
from nodes.can.log_file import read_log
from nodes.node import InProcessGraph, load_node
from nodes.process.launch_file import read_launch_file
from sim_player.car import SimulatedCar
from tests.ports import free_udp_port

DBC, MAPPING = Path("launch/can/mirrorwave.dbc"), Path("launch/can/mirrorwave.yaml")
SECOND_NS = 1_000_000_000
#: Nothing is measured against this: it ends a test that would wait for ever.
PATIENCE_S = 60.0
EPOCH_NS = 1_700_000_000 * SECOND_NS
MOTION = VehicleState(stamp_ns=0, speed_mps=7.0, yaw_rate_rps=-0.1, steering_rad=-0.5)
_channels = itertools.count()


@pytest.fixture
def bus() -> dict:
    """A virtual bus of its own for each test, whose frames keep the stamps of the virtual clock."""
    return {"interface": "virtual", "channel": f"test-{next(_channels)}", "options": {"preserve_timestamps": True}}


def drive(count: int = 25, start_ns: int = EPOCH_NS) -> list[can.Message]:
    """Half a second of frames, 50 of each message a second."""
    car = SimulatedCar(load_dbc(DBC), load_mapping(MAPPING), start_ns)
    return [
        can.Message(
            timestamp=1e-9 * now_ns, arbitration_id=frame.arbitration_id, data=frame.data, is_extended_id=False,
            channel="can0",
        )
        for now_ns in range(start_ns, start_ns + count * 20_000_000, 20_000_000)
        for frame in car.frames(msgspec.structs.replace(MOTION, stamp_ns=now_ns))
    ]  # fmt: skip


def heard(nodes: dict, until_ns: int | None = None, start_ns: int = 5 * SECOND_NS) -> list[VehicleState]:
    """States that a listener hears on the virtual clock."""
    network = LocalNetwork(start_ns=start_ns)
    listener = network.bus("listener")
    listener.subscribe("vehicle/state")
    graph = InProcessGraph(network, nodes)
    graph.run(until_ns)
    states = [item.message for item in listener.receive(0.0)]
    graph.close()
    return states


def write_log(path: Path, frames: list[can.Message]) -> Path:
    with can.Logger(path) as logger:
        for frame in frames:
            logger(frame)
    return path


def test_a_car_on_a_bus_is_heard(bus: dict) -> None:
    """50 states a second, valid as soon as counters have been seen twice, on the bus clock."""
    car = car_sim.create(car_sim.Params(**bus, speed_mps=7.0, yaw_rate_rps=-0.1))
    node = vehicle_can.create(vehicle_can.Params(**bus))
    states = heard({"vehicle_can": node, "car": car}, until_ns=6 * SECOND_NS)
    valid = [state for state in states if state.valid]
    assert len(valid) == pytest.approx(48, abs=2)
    assert {(state.speed_mps, round(state.yaw_rate_rps, 9)) for state in valid} == {(7.0, -0.1)}
    # a right turn: both negative
    assert all(state.steering_rad < 0.0 for state in valid)
    intervals_ns = {b.stamp_ns - a.stamp_ns for a, b in itertools.pairwise(valid)}
    # stamps go through python-can as seconds in double precision
    assert all(abs(interval_ns - 20_000_000) < 1000 for interval_ns in intervals_ns)
    assert node.health() == (NodeState.READY, "")
    assert car.health() == (NodeState.READY, "")
    assert car.sent >= 98


def test_silence_is_said_and_shows_in_health(bus: dict) -> None:
    node = vehicle_can.create(vehicle_can.Params(**bus))
    states = heard({"vehicle_can": node}, until_ns=6 * SECOND_NS)
    assert not any(state.valid for state in states)
    gaps_ns = [b.stamp_ns - a.stamp_ns for a, b in itertools.pairwise(states)]
    assert max(gaps_ns) <= 100_000_000
    state, reason = node.health()
    assert state is NodeState.DEGRADED
    assert reason == states[-1].reason
    assert reason.startswith("speed: no MW_SPEED yet")


class StubBus:
    """A bus that gives frames, and raises where the script holds an error."""

    state = can.BusState.ACTIVE

    def __init__(self, script: list) -> None:
        self._script = script
        self.is_closed = False

    def recv(self, timeout: float) -> can.Message | None:
        if not self._script:
            return None
        item = self._script.pop(0)
        if isinstance(item, Exception):
            raise item
        return item

    def send(self, frame: can.Message) -> None:
        self.recv(0.0)

    def shutdown(self) -> None:
        self.is_closed = True


class Opener:
    """Opens scripted buses one after the other and keeps the times."""

    def __init__(self, *buses: list | Exception) -> None:
        self._buses = list(buses)
        self.opened: list[StubBus] = []

    def __call__(self, params: BusParams) -> can.BusABC:
        item = self._buses.pop(0) if self._buses else []
        if isinstance(item, Exception):
            raise item
        self.opened.append(StubBus(item))
        return self.opened[-1]  # type: ignore[return-value]


def link(*buses: list | Exception) -> tuple[CanLink, Opener]:
    opener = Opener(*buses)
    return CanLink(BusParams(interface="virtual", channel="stub"), opener), opener


DOWN = can.CanOperationError("interface is down", error_code=100)


def test_a_bus_that_breaks_is_opened_again_with_growing_delays() -> None:
    """0.2 s, then twice as long each time, 5 s at most; the first good frame starts the delays again."""
    bus_link, opener = link(*([DOWN] for _ in range(8)), [can.Message(), DOWN])
    tries_ns: list[int] = []
    for now_ns in range(0, 30 * SECOND_NS, 10_000_000):
        before = len(opener.opened)
        bus_link.receive(now_ns)
        tries_ns += [now_ns] * (len(opener.opened) - before)
    assert [round(1e-9 * (b - a), 2) for a, b in itertools.pairwise(tries_ns)] == [
        0.2,
        0.4,
        0.8,
        1.6,
        3.2,
        5.0,
        5.0,
        5.0,
        0.2,
    ]
    assert all(stub.is_closed for stub in opener.opened[:-1])


@pytest.mark.parametrize(
    "error",
    [
        OSError(19, "No such device"),
        can.CanInitializationError("no vcan0"),
        ValueError("bad channel"),
        ImportError("driver"),
    ],
    ids=lambda error: type(error).__name__,
)
def test_a_bus_that_cannot_be_opened_is_trouble_not_an_end(error: Exception) -> None:
    bus_link, _ = link(error, [can.Message(arbitration_id=5)])
    assert bus_link.receive(0) == []
    assert bus_link.trouble.startswith("virtual stub: cannot be opened: ")
    assert not bus_link.send(can.Message(), 0)
    assert [frame.arbitration_id for frame in bus_link.receive(SECOND_NS)] == [5]
    assert bus_link.trouble == ""


def test_frames_read_before_the_bus_broke_are_kept() -> None:
    bus_link, _ = link([can.Message(arbitration_id=1), can.Message(arbitration_id=2), DOWN])
    assert [frame.arbitration_id for frame in bus_link.receive(0)] == [1, 2]
    assert bus_link.trouble == "virtual stub: interface is down [Error Code 100]"


def test_one_unreadable_frame_does_not_cost_the_bus() -> None:
    """A stranger's datagram on a multicast group cannot be unpacked; three in a row are a broken bus."""
    garbage = can.CanOperationError("could not unpack received message")
    bus_link, opener = link([garbage, can.Message(arbitration_id=1), garbage, garbage, garbage])
    frames = [frame.arbitration_id for now_ns in range(5) for frame in bus_link.receive(now_ns)]
    assert frames == [1]
    assert opener.opened[0].is_closed
    assert (bus_link.trouble, bus_link.unreadable) == ("virtual stub: could not unpack received message", 4)


def bus_off() -> can.Message:
    return can.Message(is_error_frame=True, arbitration_id=0x40)


def test_bus_off_is_said_until_frames_come_again() -> None:
    bus_link, opener = link([bus_off(), None, None, can.Message()])
    bus_link.receive(0)
    assert bus_link.trouble == "virtual stub: bus-off"
    opener.opened[0].state = can.BusState.ERROR
    bus_link.receive(1)
    assert bus_link.trouble == "virtual stub: bus-off"
    opener.opened[0].state = can.BusState.ACTIVE
    bus_link.receive(2)
    assert bus_link.trouble == ""


def live_node(script: Callable[[int], list]) -> vehicle_can.VehicleCanNode:
    """A node on a bus that gives `script(number of the bus)`; bus after bus as they fail."""
    numbers = itertools.count()
    bus_link = CanLink(BusParams(interface="virtual", channel="stub"), lambda params: StubBus(script(next(numbers))))  # type: ignore[arg-type,return-value]
    return vehicle_can.VehicleCanNode(load_decoder(DBC, MAPPING), vehicle_can.LiveSource(bus_link))


@pytest.mark.parametrize("error", [DOWN, can.CanError("broken"), OSError(100, "Network is down")], ids=repr)
def test_a_broken_bus_invalidates_and_heals(error: Exception, caplog: pytest.LogCaptureFixture) -> None:
    """Said within 0.1 s with the bus's own words; after reconnecting the state is valid again."""
    start_ns = 5 * SECOND_NS
    second_ns = start_ns + 400_000_000

    def script(number: int) -> list:
        if number == 0:
            return [*drive(5, start_ns), error, error, error]
        return drive(5, second_ns) if number == 1 else []

    with caplog.at_level(logging.WARNING):
        node = live_node(script)
        states = heard({"vehicle_can": node}, until_ns=start_ns + 800_000_000)
    said = [(state.stamp_ns - start_ns, state.reason) for state in states if "virtual stub" in state.reason]
    assert 0 < said[0][0] <= 120_000_000
    assert str(error) in said[0][1]
    assert states[2].valid
    healed = next(state for state in states if state.valid and state.stamp_ns > start_ns + 100_000_000)
    assert healed.speed_mps == 7.0
    assert any("virtual stub" in record.message for record in caplog.records)


def test_garbage_frames_are_counted_and_harmless(bus: dict) -> None:
    garbage = [
        can.Message(arbitration_id=0x100, data=b"\x01\x02", is_extended_id=False),
        can.Message(arbitration_id=0x100, data=bytes(8), is_extended_id=False),
        can.Message(arbitration_id=0x100, is_remote_frame=True, dlc=8, is_extended_id=False),
        can.Message(is_error_frame=True, arbitration_id=0x1),
        can.Message(arbitration_id=0x1FFFFFFF, data=bytes(8)),
        can.Message(arbitration_id=0x101, data=bytes(64), is_fd=True, is_extended_id=False),
        can.Message(arbitration_id=0x101, data=bytes(8), timestamp=math.nan, is_extended_id=False),
    ]
    start_ns = 5 * SECOND_NS
    for frame in garbage[:-1]:
        frame.timestamp = 5.0
    frames = drive(5, start_ns)
    node = live_node(lambda number: [frame for pair in zip(frames, itertools.cycle(garbage)) for frame in pair])
    states = heard({"vehicle_can": node}, until_ns=start_ns + 50_000_000)
    assert states[-1].valid
    counts = {str(verdict): count for verdict, count in node._decoder.counts.items()}
    expected = {"remote frame", "error frame", "unknown id", "wrong length", "wrong checksum"}
    assert expected <= set(counts)


@pytest.mark.parametrize("suffix", [".log", ".asc", ".blf", ".asc.gz"])
def test_logs_of_all_formats_read_back_equally(tmp_path: Path, suffix: str) -> None:
    """Same frames, same stamps of the epoch to 1 microsecond (what candump and ASC write; doubles hold 0.24)."""
    frames = drive()
    path = write_log(tmp_path / f"drive{suffix}", frames)
    read = list(read_log(path))
    assert [(item.frame.arbitration_id, bytes(item.frame.data)) for item in read] == [
        (frame.arbitration_id, bytes(frame.data)) for frame in frames
    ]
    expected_ns = [EPOCH_NS + 20_000_000 * step for step in range(25) for _ in range(2)]
    assert max(abs(item.stamp_ns - at_ns) for item, at_ns in zip(read, expected_ns, strict=True)) <= 1000


def test_an_asc_log_may_count_each_stamp_from_the_one_before(tmp_path: Path) -> None:
    path = tmp_path / "drive.asc"
    lines = [f" {0.0 if step == 0 else 0.02:.6f} 1  100             Rx   d 2 01 02" for step in range(4)]
    head = ["date Tue Nov 14 10:13:20.000 pm 2023", "base hex  timestamps {}", "internal events logged"]
    spans = {}
    for mode in ("absolute", "relative"):
        path.write_text("\n".join([*head, *lines]).format(mode) + "\n")
        stamps_ns = [item.stamp_ns for item in read_log(path)]
        spans[mode] = [round(1e-6 * (stamp_ns - stamps_ns[0])) for stamp_ns in stamps_ns]
    assert spans == {"absolute": [0, 20, 20, 20], "relative": [0, 20, 40, 60]}


@pytest.mark.parametrize("suffix", [".log", ".asc", ".blf"])
def test_a_log_is_played_at_its_own_pace(tmp_path: Path, suffix: str) -> None:
    path = write_log(tmp_path / f"drive{suffix}", drive())
    node = vehicle_can.create(vehicle_can.Params(log=str(path)))
    states = heard({"vehicle_can": node})
    valid = [state for state in states if state.valid]
    assert len(valid) == 23
    assert {state.speed_mps for state in valid} == {7.0}
    # the first frame is played as the node starts
    assert valid[0].stamp_ns == pytest.approx(5 * SECOND_NS + 40_000_000, abs=2000)
    assert valid[-1].stamp_ns == pytest.approx(5 * SECOND_NS + 480_000_000, abs=2000)
    assert node.finished()


def test_a_log_can_be_laid_beside_a_recording(tmp_path: Path) -> None:
    """`log_start_ns` sets the stamps, `rate` the pace; ages are those of the log at any rate."""
    path = write_log(tmp_path / "drive.log", drive())
    params = vehicle_can.Params(log=str(path), log_start_ns=77 * SECOND_NS, rate=4.0)
    states = heard({"vehicle_can": vehicle_can.create(params)})
    stamps_ns = [state.stamp_ns for state in states if state.valid]
    assert len(stamps_ns) == 23
    assert stamps_ns[-1] == pytest.approx(77 * SECOND_NS + 480_000_000, abs=2000)


@pytest.mark.parametrize("source", ["bus", "log"])
def test_the_clock_offset_moves_the_stamps_and_nothing_else(bus: dict, tmp_path: Path, source: str) -> None:
    """Stamps of the bus plus 0.25 s are times of the radar, for a live bus and for a log: 250 ms on each."""

    def played(clock_offset_s: float) -> list[VehicleState]:
        if source == "bus":
            node = vehicle_can.create(vehicle_can.Params(**bus, clock_offset_s=clock_offset_s))
            return heard({"vehicle_can": node, "car": car_sim.create(car_sim.Params(**bus))}, 5_200_000_000)
        log = str(write_log(tmp_path / "drive.log", drive()))
        return heard({"vehicle_can": vehicle_can.create(vehicle_can.Params(log=log, clock_offset_s=clock_offset_s))})

    plain, moved = played(0.0), played(0.25)
    assert any(state.valid for state in plain)
    assert moved == [msgspec.structs.replace(one, stamp_ns=one.stamp_ns + 250_000_000) for one in plain]


def test_a_gap_in_a_log_is_silence(tmp_path: Path) -> None:
    frames = [frame for frame in drive(50) if not 0.21 < frame.timestamp - 1e-9 * EPOCH_NS < 0.69]
    node = vehicle_can.create(vehicle_can.Params(log=str(write_log(tmp_path / "drive.log", frames))))
    states = heard({"vehicle_can": node})
    silent_ms = [round(1e-6 * (state.stamp_ns - 5 * SECOND_NS)) for state in states if "for 0." in state.reason]
    # the last frame before the gap came at 200 ms; ten periods later it is too old
    assert silent_ms[:4] == [400, 500, 600, 700]
    assert states[-1].valid


def test_one_channel_of_a_log(tmp_path: Path) -> None:
    frames = drive()
    other = [on_channel(frame, "can1") for frame in frames]
    path = write_log(tmp_path / "drive.log", [frame for pair in zip(frames, other, strict=True) for frame in pair])
    assert len(list(read_log(path))) == 100
    assert len(list(read_log(path, "can1"))) == 50
    with pytest.raises(ValueError, match=r"drive\.log: holds no frames of channel can7; its channels are can0, can1"):
        list(read_log(path, "can7"))


def on_channel(frame: can.Message, channel: str) -> can.Message:
    return can.Message(
        timestamp=frame.timestamp, arbitration_id=frame.arbitration_id, data=frame.data, is_extended_id=False,
        channel=channel,
    )  # fmt: skip


@pytest.mark.parametrize("name", ["bad.log", "bad.asc", "bad.blf", "bad.asc.gz", "bad.pcap"])
@pytest.mark.parametrize("content", [b"", b"\x00\xff\xfe" * 40, b"(1.0) can0 100#GG\n", b"LOGG" + bytes(200)])
def test_garbage_as_a_log_is_one_line(tmp_path: Path, name: str, content: bytes) -> None:
    path = tmp_path / name
    path.write_bytes(content)
    with pytest.raises(ValueError, match="bad") as caught:
        vehicle_can.create(vehicle_can.Params(log=str(path)))
    assert "\n" not in str(caught.value)
    del caught
    gc.collect()


def test_a_log_that_breaks_off_ends_the_play(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    path = write_log(tmp_path / "drive.log", drive())
    path.write_text(path.read_text() + "(1700000000.6) can0 nonsense\n")
    with caplog.at_level(logging.ERROR):
        node = vehicle_can.create(vehicle_can.Params(log=str(path)))
        states = heard({"vehicle_can": node})
    assert sum(state.valid for state in states) == 23
    assert "drive.log: cannot be read after 50 frames" in caplog.text


@pytest.mark.parametrize("timestamp_s", [1e300, -1e300, float("inf"), float("nan")])
def test_a_stamp_that_is_no_time_is_negative(timestamp_s: float) -> None:
    """1e300 s is finite, and infinite in nanoseconds."""
    assert frame_stamp_ns(can.Message(timestamp=timestamp_s)) < 0


def test_a_frame_without_a_time_does_not_hold_up_the_log() -> None:
    frames = [LogFrame(frame, -1 if index < 3 else index * 1000) for index, frame in enumerate(drive(5))]
    source = vehicle_can.LogSource(iter(frames))
    source.stamp_ns(100)
    assert [frame.stamp_ns for frame in source.frames(100_000)] == [100 + 1000 * step for step in range(7)]


def round_trip(params: dict) -> list[VehicleState]:
    """Car and node on a real bus until the node has made ten valid states."""
    car, node = (
        car_sim.create(car_sim.Params(**params, speed_mps=7.0)),
        vehicle_can.create(vehicle_can.Params(**params)),
    )
    states: list[VehicleState] = []
    end_s = time.monotonic() + PATIENCE_S
    try:
        node.step([], time.monotonic_ns())
        while sum(state.valid for state in states) < 10:
            assert time.monotonic() < end_s, states[-1:]
            car.step([], time.monotonic_ns())
            states += [message for _, message in node.step([], time.monotonic_ns())]
            time.sleep(0.02)
    finally:
        car.close()
        node.close()
    return states


def test_between_processes_buses_work_the_same() -> None:
    """Frames over udp_multicast on this machine, stamped by the kernel; on `virtual` where the network forbids it."""
    multicast = {
        "interface": "udp_multicast",
        "channel": "239.74.163.2",
        "options": {"port": free_udp_port(), "hop_limit": 0},
    }
    start_ns = time.monotonic_ns()
    probe = CanLink(BusParams(**multicast))
    works = probe.send(can.Message(), 0)
    probe.close()
    states = round_trip(multicast if works else {"interface": "virtual", "channel": "round-trip"})
    valid = [state for state in states if state.valid]
    assert {state.speed_mps for state in valid} == {7.0}
    # the bus clock, not the clock of the interface
    assert all(start_ns - SECOND_NS < state.stamp_ns <= time.monotonic_ns() for state in valid)


def test_the_scene_moves_the_car(tmp_path: Path) -> None:
    text = Path("launch/scenes/facade_across_lane.yaml").read_text()
    scene = tmp_path / "moving.yaml"
    scene.write_text(text + "\nego: {speed_mps: 4.0, yaw_rate_dps: 10.0}\n" if "\nego:" not in text else text)
    motion = car_sim.motion_of(car_sim.Params(interface="virtual", scene=str(scene)))
    assert (motion.speed_mps, motion.yaw_rate_rps) == (4.0, pytest.approx(math.radians(10.0)))
    assert motion.steering_rad > 0.0
    assert car_sim.motion_of(car_sim.Params(interface="virtual", scene=str(scene), speed_mps=1.0)).speed_mps == 1.0


def test_the_player_can_leave_the_motion_to_the_car() -> None:
    params = player.Params(
        scene="launch/scenes/facade_across_lane.yaml", scans=1, chirps_per_beam=1, publish_vehicle_state=False
    )
    assert heard({"player": player.create(params)}) == []


def test_the_launch_file_fits_its_nodes() -> None:
    launch = read_launch_file(Path("launch/corner_can.yaml"))
    for name in ("car", "vehicle_can"):
        entry = launch.nodes[name]
        load_node(entry.module, entry.params, name).close()
    assert launch.nodes["player"].params["publish_vehicle_state"] is False


@pytest.mark.parametrize(
    ("module", "change", "rule"),
    [
        (vehicle_can, {"interface": "socketcon"}, r"interface must be one of .*socketcan.*: 'socketcon'"),
        (vehicle_can, {"rate": 0.0}, r"rate must be finite and positive, got 0\.0"),
        (vehicle_can, {"rate": math.nan}, "rate must be finite and positive"),
        (vehicle_can, {"mapping": "launch/can/mirrorwave.dbc"}, r"mirrorwave\.dbc"),
        (vehicle_can, {"dbc": "launch/can/mirrorwave.yaml"}, r"mirrorwave\.yaml: no DBC"),
        (
            vehicle_can,
            {"mapping": "launch/can/motec_sample.yaml"},
            r"motec_sample\.yaml: speed\.message: the DBC has no",
        ),
        (car_sim, {"speed_mps": 1e6}, r"speed_mps must be within -1000\.\.1000, got 1000000"),
    ],
)
def test_bad_parameters_are_one_line(module, change: dict, rule: str) -> None:
    with pytest.raises(ValueError, match=rule) as caught:
        module.create(module.Params(**{"interface": "virtual", **change}))
    assert "\n" not in str(caught.value)


def test_a_dbc_with_overlapping_signals_is_read_with_a_warning(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    path = tmp_path / "overlap.dbc"
    path.write_text('VERSION ""\nBO_ 16 A: 8 X\n SG_ V : 0|16@1+ (1,0) [0|1] "" X\n SG_ W : 8|16@1+ (1,0) [0|1] "" X\n')
    with caplog.at_level(logging.WARNING):
        assert [message.name for message in load_dbc(path).messages] == ["A"]
    assert "overlap.dbc: not a clean DBC, read all the same" in caplog.text
