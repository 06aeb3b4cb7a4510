"""The hidden-object list on a bus: cycles on the virtual clock, silence and faults, and what a log of it shows."""

from __future__ import annotations

import itertools
import json
import logging
import re
from pathlib import Path

import can
import cantools
import numpy as np
import pytest

from mirrorwave.cli import main
from models.vehicle.end_to_end import crc8_sae_j1850
from models.vehicle.hidden_object_list import HiddenObjectList
from msgs.bus.interface import Outgoing, Received
from msgs.bus.local import LocalNetwork
from msgs.values.diagnostics import NodeState
from msgs.values.perception import BevFrame, HiddenObject
from nodes import can_out
from nodes.can.bus import BusParams, CanLink
from nodes.node import InProcessGraph, Node, load_node
from nodes.process.launch_file import read_launch_file
from tests.builders import example_view

DBC = Path("launch/can/mirrorwave_out.dbc")
DATABASE = cantools.database.load_file(DBC)
MS = 1_000_000
SECOND_NS = 1000 * MS
START_NS = 5 * SECOND_NS
ONE = HiddenObject(
    id=3, x_m=20.5, y_m=-7.0, length_m=4.5, width_m=1.8, yaw_rad=-0.25, score=0.5, cov_m2=((0.25, 0.0), (0.0, 0.01))
)
_channels = itertools.count()


def view(stamp_ns: int, scan_id: int = 1, objects: tuple[HiddenObject, ...] = (ONE,)) -> BevFrame:
    mask = np.array([[1, 2], [0, 2]], np.uint8)
    return example_view(stamp_ns=stamp_ns, scan_id=scan_id, objects=objects, visibility=mask)


class Views(Node):
    """Publishes views at their times; their first beam is 300 ms older."""

    outputs = ("perception/hidden_objects",)

    def __init__(self, times_ns: list[int]) -> None:
        super().__init__()
        self._times_ns, self._scan = times_ns, 0

    def due_ns(self, now_ns: int) -> int | None:
        return self._times_ns[self._scan] if self._scan < len(self._times_ns) else None

    def step(self, inputs: list[Received], now_ns: int) -> list[Outgoing]:
        self._scan += 1
        return [Outgoing("perception/hidden_objects", view(now_ns - 300 * MS, self._scan))]


@pytest.fixture
def bus() -> dict:
    """A virtual bus of its own for each test, whose frames keep the stamps of the virtual clock."""
    return {"interface": "virtual", "channel": f"out-{next(_channels)}", "options": {"preserve_timestamps": True}}


def run(bus: dict, duration_ms: int, view_times_ms: list[int]) -> list[can.Message]:
    """Frames that another participant of the bus hears."""
    with can.Bus(interface="virtual", channel=bus["channel"], ignore_config=True, preserve_timestamps=True) as listener:
        nodes = {
            "views": Views([START_NS + MS * at_ms for at_ms in view_times_ms]),
            "can_out": can_out.create(can_out.Params(**bus)),
        }
        graph = InProcessGraph(LocalNetwork(start_ns=START_NS), nodes)
        graph.run(START_NS + MS * duration_ms)
        graph.close()
        return list(iter(lambda: listener.recv(0.0), None))


def time_ms(frame: can.Message) -> float:
    # stamps go through python-can as seconds in double precision
    return round(1e3 * frame.timestamp - 1e-6 * START_NS, 3)


def said(frame: can.Message) -> dict:
    return DATABASE.decode_message(frame.arbitration_id, frame.data)


def test_every_message_comes_at_its_cycle_time_whatever_the_views_do(bus: dict) -> None:
    """No view for 0.45 s, then three at odd times, then none: 33 frames each 100 ms, each with its delay of the DBC."""
    heard = run(bus, 2999, [450, 733, 1101])
    assert len(heard) == 30 * 33
    for message in DATABASE.messages:
        delay_ms = message.dbc.attributes["GenMsgStartDelayTime"].value
        times_ms = [time_ms(frame) for frame in heard if frame.arbitration_id == message.frame_id]
        assert times_ms == [100.0 * cycle + delay_ms for cycle in range(30)]


def test_validity_follows_the_age_of_the_view(bus: dict) -> None:
    """Views at 450 and 733 ms, each 300 ms old: the list holds until the first beam is 1 s old."""
    status = [said(frame) for frame in run(bus, 1999, [450, 733]) if frame.arbitration_id == 0x300]
    assert [one["VALID"] for one in status] == [0] * 5 + [1] * 10 + [0] * 5
    assert [one["AGE"] for one in status[4:9]] == [16383, 350, 450, 550, 367]
    assert status[-1]["AGE"] == 1467
    assert [one["SCAN_COUNTER"] for one in status[4:9]] == [0, 1, 1, 1, 2]


def test_a_list_is_of_one_view(bus: dict) -> None:
    """A view that comes while a list is being sent waits for the next one; one counter holds a list together."""
    heard = run(bus, 399, [150])
    lists = [[said(frame) for frame in heard[33 * cycle : 33 * (cycle + 1)]] for cycle in range(4)]
    assert [{one["COUNTER"] for one in messages} for messages in lists] == [{0}, {1}, {2}, {3}]
    assert [sum(one["VALID"] for one in messages) for messages in lists] == [0, 0, 3, 3]
    assert (lists[2][1]["X"], lists[2][1]["Y"], lists[2][1]["POSITION_STD"]) == (20.5, -7.0, 0.5)


def candump_lines(text: str) -> list[tuple[float, int, bytes]]:
    """An independent reader of candump's log format: neither python-can nor cantools."""
    pattern = re.compile(r"^\((\d+\.\d+)\) (\S+) ([0-9A-F]{3})#((?:[0-9A-F]{2}){8})(?: [RT])?$")
    found = [pattern.match(line) for line in text.splitlines()]
    assert all(found)
    return [(float(one[1]), int(one[3], 16), bytes.fromhex(one[4])) for one in found if one]


def bits(data: bytes, start: int, length: int, signed: bool = False) -> int:
    """Little-endian signal of a payload."""
    raw = (int.from_bytes(data, "little") >> start) & ((1 << length) - 1)
    return raw - (1 << length) if signed and raw >> (length - 1) else raw


def write_log(bus: dict, path: Path) -> Path:
    with can.Logger(path) as logger:
        for frame in run(bus, 999, [50, 400]):
            frame.channel = "can0"
            logger(frame)
    return path


def test_a_candump_log_read_by_hand_says_the_same(bus: dict, tmp_path: Path) -> None:
    """Bits by the table of docs/guides/can-out.md, checksum, counter and age: as a receiver without our code would."""
    lines = candump_lines(write_log(bus, tmp_path / "out.log").read_text())
    assert len(lines) == 330
    last: dict[int, int] = {}
    for _, frame_id, data in lines:
        assert data[0] == crc8_sae_j1850(frame_id.to_bytes(2, "little") + data[1:])
        counter = bits(data, 8, 4)
        assert counter == (last.get(frame_id, counter - 1) + 1) % 16
        last[frame_id] = counter
    status = [data for _, frame_id, data in lines if frame_id == 0x300][-1]
    assert [bits(status, *place) for place in ((12, 1), (16, 8), (24, 8), (32, 14), (46, 8))] == [1, 2, 1, 800, 133]
    position = [data for _, frame_id, data in lines if frame_id == 0x310][-1]
    assert (bits(position, 12, 1), bits(position, 13, 1), bits(position, 14, 10)) == (1, 0, 3)
    assert (bits(position, 24, 14, True) * 0.02, bits(position, 38, 14, True) * 0.02) == (20.5, -7.0)
    assert bits(position, 52, 12) * 0.01 == 0.5
    shape = [data for _, frame_id, data in lines if frame_id == 0x311][-1]
    raw = [bits(shape, 24, 10), bits(shape, 34, 10), bits(shape, 44, 12, True), bits(shape, 56, 8)]
    assert raw == [90, 36, -125, 100]


def test_can_decode_shows_the_list(bus: dict, tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    path = write_log(bus, tmp_path / "out.log")
    arguments = ["can", "decode", str(path), "--dbc", str(DBC), "--signals"]
    assert main(arguments) == 0
    text = capsys.readouterr().out
    assert "MW_OBJECT_LIST" in text
    assert "330 of 330 frames in 0.98 s are of this DBC" in text
    assert main([*arguments, "--json", "--every", "0.5"]) == 0
    report = json.loads(capsys.readouterr().out)
    rows = {row["message"]: row for row in report["messages"]}
    assert len(rows) == 33
    assert {row["period_ms"] for row in rows.values()} == {100.0}
    assert {tuple(row["frames_by_verdict"].items()) for row in rows.values()} == {(("ok", 10),)}
    assert rows["MW_OBJECT_01_POSITION"]["signals"]["X"] == 20.5
    assert len(report["samples"]) == 66


@pytest.mark.slow
def test_can_decode_flags_damaged_and_lost_frames(bus: dict, tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    path = write_log(bus, tmp_path / "out.log")
    lines = path.read_text().splitlines()
    status = [index for index, line in enumerate(lines) if " 300#" in line]
    lines[status[2]] = lines[status[2]][:-6] + "5A5A R"
    kept = [line for index, line in enumerate(lines) if index not in status[4:7]]
    path.write_text("\n".join([*kept, "(9.0) can0 123#00", "(9.1) can0 300#00", "(9.2) can0 nonsense"]) + "\n")
    assert main(["can", "decode", str(path), "--dbc", str(DBC), "--signals", "--json"]) == 3
    report = json.loads(capsys.readouterr().out)
    assert report["messages"][0]["frames_by_verdict"] == {
        "ok": 5, "wrong checksum": 1, "wrong counter": 1, "wrong length": 1,
    }  # fmt: skip
    assert report["frames"] - report["known_frames"] == 1
    other = tmp_path / "other.log"
    other.write_text("(1.0) can0 123#00\n")
    assert main(["can", "decode", str(other), "--dbc", str(DBC), "--signals"]) == 1
    assert main(["can", "decode", str(other), "--dbc", str(DBC), "--signals", "--channel", "can7"]) == 2


class StubBus:
    """A bus that raises, or says of itself that it is off, while told to."""

    def __init__(self) -> None:
        self.error: Exception | None = None
        self.incoming: list[can.Message] = []
        self.sent: list[can.Message] = []
        self.state = can.BusState.ACTIVE

    def recv(self, timeout: float) -> can.Message | None:
        return self.incoming.pop(0) if self.incoming else None

    def send(self, frame: can.Message) -> None:
        if self.error is not None:
            raise self.error
        self.sent.append(frame)

    def shutdown(self) -> None:
        pass


class Stub:
    """A node on a stub bus and the clock it runs on."""

    def __init__(self) -> None:
        self.bus, self.opened, self.now_ns = StubBus(), 0, START_NS
        self.outlet = can_out.Outlet(CanLink(BusParams(interface="virtual", channel="stub"), self._open))
        self.node = can_out.CanOut(self.outlet, HiddenObjectList(DATABASE), SECOND_NS)

    def _open(self, params: BusParams) -> can.BusABC:
        self.opened += 1
        return self.bus  # type: ignore[return-value]

    def run(self, duration_ms: int) -> None:
        end_ns = self.now_ns + MS * duration_ms
        while (due_ns := self.node.due_ns(self.now_ns)) < end_ns:
            self.now_ns = max(self.now_ns, due_ns)
            self.node.step([], self.now_ns)
        self.now_ns = end_ns


def test_what_the_bus_does_not_take_is_counted_and_not_kept() -> None:
    stub = Stub()
    stub.run(200)
    assert (stub.outlet.sent, stub.outlet.refused, stub.node.health()) == (66, 0, (NodeState.READY, ""))
    stub.bus.error = can.CanOperationError("interface is down", error_code=100)
    stub.run(500)
    state, reason = stub.node.health()
    assert (state, reason) == (
        NodeState.DEGRADED, "virtual stub: interface is down [Error Code 100]; 165 frames not sent",
    )  # fmt: skip
    stub.bus.error = None
    stub.run(2000)
    assert stub.node.health() == (NodeState.READY, "")
    assert stub.outlet.sent + stub.outlet.refused == 27 * 33
    # each once: nothing is sent late
    assert len(stub.bus.sent) == stub.outlet.sent
    counters = [said(frame)["COUNTER"] for frame in stub.bus.sent[-33:]]
    assert counters == [26 % 16] * 33


@pytest.mark.parametrize("how", ["error frame", "state"])
def test_after_bus_off_the_interface_is_opened_again_with_growing_delays(
    how: str, caplog: pytest.LogCaptureFixture
) -> None:
    stub = Stub()
    stub.run(100)
    with caplog.at_level(logging.INFO):
        if how == "state":
            stub.bus.state = can.BusState.ERROR
            stub.run(2000)
            # 0.2, 0.4, 0.8 s and on
            assert stub.outlet.bus_offs == stub.opened == 4
            stub.bus.state = can.BusState.ACTIVE
        else:
            stub.bus.incoming.append(can.Message(is_error_frame=True, arbitration_id=0x40))
            stub.run(100)
            assert stub.outlet.bus_offs == 1
            assert stub.node.health()[0] is NodeState.DEGRADED
        stub.run(3000)
    assert stub.node.health() == (NodeState.READY, "")
    assert sum("bus-off" in record.message for record in caplog.records) == stub.outlet.bus_offs
    assert stub.outlet.refused > 0


def test_a_bus_that_is_not_there_yet_ends_nothing() -> None:
    node = can_out.create(can_out.Params(interface="socketcan", channel="nowhere0"))
    node.step([], START_NS)
    assert node.health()[0] is NodeState.DEGRADED
    node.close()


def test_a_late_node_keeps_the_grid_and_says_what_it_left_out() -> None:
    stub = Stub()
    stub.node.step([], START_NS)
    stub.node.step([], START_NS + 350 * MS)
    assert stub.node.due_ns(0) == START_NS + 355 * MS
    assert {(one.what, one.count) for one in stub.node.shed.counts()} == {("frame", 32), ("list", 2)}
    stub.now_ns = START_NS + 355 * MS
    stub.run(100)
    starts = [frame for frame in stub.bus.sent if frame.arbitration_id == 0x300]
    assert [round(1e3 * frame.timestamp) for frame in starts] == [5000, 5350, 5400]


def test_the_age_may_count_from_arrival(bus: dict) -> None:
    """A capture keeps the stamps it was recorded with."""
    received = Received("perception/hidden_objects", view(1_700_000_000 * SECOND_NS), 0)
    for age_from, valid in (("acquisition", 0), ("arrival", 1)):
        with can.Bus(interface="virtual", channel=bus["channel"], ignore_config=True) as listener:
            node = can_out.create(can_out.Params(**bus, age_from=age_from))
            node.step([received], START_NS)
            frame = listener.recv(0.0)
            assert said(frame)["VALID"] == valid
            node.close()


def test_the_launch_file_fits_its_nodes() -> None:
    launch = read_launch_file(Path("launch/corner_can_out.yaml"))
    load_node(launch.nodes["can_out"].module, launch.nodes["can_out"].params, "can_out").close()


@pytest.mark.parametrize(
    ("change", "rule"),
    [
        ({"max_age_s": 0.0}, r"max_age_s must be finite and positive, got 0\.0"),
        ({"max_age_s": 20.0}, r"max_age_s must be below 16383 ms, the DBC's AGE, got 20\.0"),
        ({"interface": "socketcon"}, "interface must be one of"),
        ({"dbc": "launch/can/mirrorwave.dbc"}, r"mirrorwave\.dbc: messages\.MW_OBJECT_LIST: the DBC has no such"),
        ({"dbc": "launch/can/mirrorwave.yaml"}, r"mirrorwave\.yaml: no DBC"),
    ],
)
def test_bad_parameters_are_one_line(change: dict, rule: str) -> None:
    with pytest.raises(ValueError, match=rule) as caught:
        can_out.create(can_out.Params(**{"interface": "virtual", **change}))
    assert "\n" not in str(caught.value)
