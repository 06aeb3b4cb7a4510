"""The hidden-object list: what each message says, what does not fit, and what a receiver makes of it."""

from __future__ import annotations

import math
import re
from pathlib import Path

import cantools
import msgspec
import numpy as np
import pytest

from models.vehicle.can_decoder import CanDecoder, Verdict
from models.vehicle.can_mapping import CanMapping, QuantityRule
from models.vehicle.end_to_end import crc8_sae_j1850
from models.vehicle.hidden_object_list import HiddenObjectList, ListFrame, message_rule, observable_share, worst_std_m
from msgs.values.perception import BevFrame, BevGrid, HiddenObject
from msgs.values.radar import MAP_FAULTS, WIRING_FAULTS
from msgs.values.vehicle import VehicleState

DBC = Path("launch/can/mirrorwave_out.dbc")
DATABASE = cantools.database.load_file(DBC)
LIST = HiddenObjectList(DATABASE)
MS = 1_000_000
LIMIT_NS = 1000 * MS
ONE = HiddenObject(
    id=7, x_m=12.34, y_m=-5.68, length_m=4.5, width_m=1.8, yaw_rad=0.5, score=0.85, cov_m2=((0.04, 0.0), (0.0, 0.01))
)


def view(objects: tuple[HiddenObject, ...] = (), **changes) -> BevFrame:
    grid = BevGrid(rows=10, columns=10)
    visibility = np.zeros((10, 10), np.uint8)
    visibility[:2], visibility[2:4] = 1, 2
    fields = {"stamp_ns": 0, "scan_id": 300, "objects": objects, "grid": grid, "visibility": visibility, **changes}
    return BevFrame(los_points_m=np.zeros((0, 2), np.float32), **fields)


def objects(count: int) -> tuple[HiddenObject, ...]:
    """Scores rise with the id."""
    return tuple(msgspec.structs.replace(ONE, id=i, x_m=1.0 + i, score=0.2 + 0.001 * i) for i in range(count))


def frames(shown: BevFrame | None, age_ns: int | None = 200 * MS, counter: int = 0) -> list[ListFrame]:
    return LIST.frames(shown, age_ns, LIMIT_NS, counter)


def decoded(sent: list[ListFrame]) -> dict[str, dict]:
    return {frame.message: DATABASE.decode_message(frame.arbitration_id, frame.data) for frame in sent}


def changed(**changes) -> dict[str, dict]:
    return decoded(frames(view((msgspec.structs.replace(ONE, **changes),))))


def test_an_object_is_said_to_half_a_step() -> None:
    said = decoded(frames(view((ONE,))))
    position, shape = said["MW_OBJECT_01_POSITION"], said["MW_OBJECT_01_SHAPE"]
    assert (position["VALID"], position["SATURATED"], position["ID"], shape["ID"]) == (1, 0, 7, 7)
    for values, name, value, step in (
        (position, "X", 12.34, 0.02), (position, "Y", -5.68, 0.02), (position, "POSITION_STD", 0.2, 0.01),
        (shape, "LENGTH", 4.5, 0.05), (shape, "WIDTH", 1.8, 0.05), (shape, "YAW", 0.5, 0.002),
        (shape, "SCORE", 0.85, 0.005),
    ):  # fmt: skip
        assert values[name] == pytest.approx(value, abs=0.5 * step + 1e-9), name


def test_the_place_is_the_centre_of_the_box() -> None:
    """The object's own position is its visible face, 2 m nearer here."""
    position = changed(centre_m=(14.34, -5.68))["MW_OBJECT_01_POSITION"]
    assert (position["X"], position["Y"]) == pytest.approx((14.34, -5.68), abs=0.01 + 1e-9)


def test_the_status_sums_the_view_up() -> None:
    ego = VehicleState(stamp_ns=0)
    said = decoded(frames(view((ONE,), ego=ego, flags=("spurs", "incoherent", "new_flag"))))["MW_OBJECT_LIST"]
    assert (said["VALID"], said["AGE"], said["OBJECT_COUNT"], said["SCAN_COUNTER"]) == (1, 200, 1, 300 - 256)
    assert (said["TRUNCATED"], said["SATURATED"], said["EGO_VALID"]) == (0, 0, 1)
    # 20 cells in a mirror, 60 unknown, 20 in direct sight
    assert said["OBSERVABLE_SHARE"] == 25.0
    assert {name for name, bit in said.items() if name.startswith("FAULT") and bit} == {
        "FAULT_SPURS", "FAULT_INCOHERENT", "FAULT_OTHER",
    }  # fmt: skip


@pytest.mark.parametrize("flag", sorted({"incoherent", "missing_beams", "saturated", *MAP_FAULTS} - set(WIRING_FAULTS)))
def test_every_condition_of_a_scan_has_its_bit(flag: str) -> None:
    said = decoded(frames(view(flags=(flag,))))["MW_OBJECT_LIST"]
    assert sum(bit for name, bit in said.items() if name.startswith("FAULT")) == 1
    assert said["FAULT_OTHER"] == 0


@pytest.mark.parametrize("count", [0, 1, 16, 40, 300])
def test_any_number_of_objects(count: int) -> None:
    """The 16 of the highest scores are sent; all frames of all places always are."""
    said = decoded(frames(view(objects(count))))
    assert len(said) == 33
    status = said["MW_OBJECT_LIST"]
    assert (status["VALID"], status["OBJECT_COUNT"], status["TRUNCATED"]) == (1, min(count, 255), count > 16)
    sent = [said[f"MW_OBJECT_{place:02d}_POSITION"] for place in range(1, 17)]
    assert [one["ID"] for one in sent if one["VALID"]] == list(range(count - 1, max(-1, count - 17), -1))
    empty = [said[f"MW_OBJECT_{place:02d}_{part}"] for place in range(count + 1, 17) for part in ("POSITION", "SHAPE")]
    assert not any(value for one in empty for name, value in one.items() if name not in ("CHECKSUM", "COUNTER"))


@pytest.mark.parametrize(
    ("field", "message", "signal", "low", "high"),
    [
        ("x_m", "POSITION", "X", -163.84, 163.82),
        ("y_m", "POSITION", "Y", -163.84, 163.82),
        ("length_m", "SHAPE", "LENGTH", 0.0, 51.15),
        ("width_m", "SHAPE", "WIDTH", 0.0, 51.15),
        ("id", "POSITION", "ID", 0, 1023),
        ("id", "SHAPE", "ID", 0, 1023),
    ],
)
def test_what_does_not_fit_stands_at_the_end_and_is_marked(
    field: str, message: str, signal: str, low: float, high: float
) -> None:
    step = {"id": 1, "x_m": 0.02, "y_m": 0.02}.get(field, 0.05)
    values = ((10**6, high), (-(10**6), low), (2**62, high), (high, high), (high + step, high), (low, low))
    allowed = {"id": (0, 2**62), "x_m": (-1e6, 1e6), "y_m": (-1e6, 1e6)}.get(field, (0, 1e6))
    for value, end in (pair for pair in values if allowed[0] <= pair[0] <= allowed[1]):
        said = changed(**{field: value})
        one = said[f"MW_OBJECT_01_{message}"]
        assert one[signal] == pytest.approx(end, abs=1e-9)
        beyond = not low <= value <= high
        assert (one["VALID"], one["SATURATED"], said["MW_OBJECT_LIST"]["SATURATED"]) == (1, beyond, beyond)


@pytest.mark.parametrize(
    ("cov_m2", "std_m"),
    [
        (((4.0, 0.0), (0.0, 9.0)), 3.0),
        # 45 deg: 2 along one diagonal, 0 along the other
        (((2.0, 2.0), (2.0, 2.0)), 2.0),
        (((0.0, 0.0), (0.0, 0.0)), 0.0),
    ],
)
def test_the_worst_direction_of_a_covariance(cov_m2, std_m: float) -> None:
    assert worst_std_m(msgspec.structs.replace(ONE, cov_m2=cov_m2)) == pytest.approx(std_m)


def test_a_huge_deviation_is_marked() -> None:
    position = changed(cov_m2=((1e12, 0.0), (0.0, 1.0)))["MW_OBJECT_01_POSITION"]
    assert (position["POSITION_STD"], position["SATURATED"], position["VALID"]) == (40.95, 1, 1)


@pytest.mark.parametrize("yaw_rad", [math.pi, -math.pi, 3.5, -3.5, 100.0])
def test_a_heading_is_the_same_heading(yaw_rad: float) -> None:
    shape = changed(yaw_rad=yaw_rad)["MW_OBJECT_01_SHAPE"]
    assert abs(math.remainder(shape["YAW"] - yaw_rad, math.tau)) <= 0.0011
    assert shape["SATURATED"] == 0


@pytest.mark.parametrize(
    ("age_ns", "valid", "age_ms"),
    [
        (0, 1, 0),
        (LIMIT_NS, 1, 1000),
        (LIMIT_NS + 1, 0, 1000),
        (20_000 * MS, 0, 16383),
        (10**18, 0, 16383),
        (-1, 0, 16383),
        (None, 0, 16383),
    ],
)
def test_a_list_holds_while_its_view_is_young(age_ns: int | None, valid: int, age_ms: int) -> None:
    """A stamp that lies ahead is of another clock: its age is not known."""
    said = decoded(frames(view(objects(3)), age_ns))
    assert (said["MW_OBJECT_LIST"]["VALID"], said["MW_OBJECT_LIST"]["AGE"]) == (valid, age_ms)
    assert sum(one["VALID"] for one in said.values()) == (7 if valid else 0)
    # what is no longer valid is no longer said either
    assert any(one.get("X") for one in said.values()) == bool(valid)


def test_before_the_first_view() -> None:
    said = decoded(frames(None, None))
    assert len(said) == 33
    assert not any(one["VALID"] or one["SATURATED"] for one in said.values())
    assert said["MW_OBJECT_LIST"]["AGE"] == 16383


def test_a_plane_in_direct_sight_hides_nothing() -> None:
    assert observable_share(view(visibility=np.ones((10, 10), np.uint8))) == 1.0
    assert observable_share(view(visibility=np.zeros((10, 10), np.uint8))) == 0.0


def receiver(message) -> CanDecoder:
    """The receiver that reads cars, set to one message of the list: two of its signals stand for speed and yaw rate."""
    names = {"MW_OBJECT_LIST": "AGE"}.get(message.name, "ID")
    rule = QuantityRule(message=message.name, signals=(names,), scale=1.0, low=-1.0, high=20_000.0)
    return CanDecoder(DATABASE, CanMapping(speed=rule, yaw_rate=rule, messages={message.name: message_rule(message)}))


def test_our_receiver_takes_every_message_and_no_damaged_one() -> None:
    receivers = {message.name: receiver(message) for message in DATABASE.messages}
    for step in range(40):
        for frame in frames(view(objects(20)), counter=step):
            judged = receivers[frame.message].add(frame.arbitration_id, frame.data, (step * 100 + 1) * MS)
            assert judged.verdict is (Verdict.COUNTED if step else Verdict.FIRST), judged
    for frame in frames(view(objects(20)), counter=40):
        for bit in range(64):
            data = bytearray(frame.data)
            data[bit // 8] ^= 1 << bit % 8
            judged = receivers[frame.message].add(frame.arbitration_id, bytes(data), 4001 * MS)
            assert judged.verdict is Verdict.WRONG_CHECKSUM


def test_frames_of_different_places_cannot_be_taken_for_each_other() -> None:
    """The same bytes under another id are refused: the id goes into the checksum."""
    sent = frames(view())
    assert len({frame.data for frame in sent if "LIST" not in frame.message}) > 1
    for frame in sent:
        data_id = frame.arbitration_id.to_bytes(2, "little")
        assert frame.data[0] == crc8_sae_j1850(data_id + frame.data[1:])


def test_all_messages_of_a_list_carry_its_counter() -> None:
    for counter in (0, 15, 16, 10**9):
        assert {one["COUNTER"] for one in decoded(frames(view((ONE,)), counter=counter)).values()} == {counter % 16}


def test_the_dbc_spreads_a_list_over_its_cycle() -> None:
    """The status first; never more than two frames at once; done before the next list; ids apart from the car's."""
    sent = frames(view())
    delays_ns = [frame.delay_ns for frame in sent]
    assert (sent[0].message, delays_ns[0], LIST.slots) == ("MW_OBJECT_LIST", 0, 16)
    assert max(delays_ns.count(delay_ns) for delay_ns in delays_ns) == 2
    assert delays_ns[-1] < LIST.period_ns == 100 * MS
    car = cantools.database.load_file("launch/can/mirrorwave.dbc")
    assert not {one.frame_id for one in car.messages} & {frame.arbitration_id for frame in sent}
    assert all(len(frame.data) == 8 and not frame.extended for frame in sent)


def test_every_signal_has_a_range_and_what_has_a_unit_says_so() -> None:
    units = {"X": "m", "Y": "m", "POSITION_STD": "m", "LENGTH": "m", "WIDTH": "m", "YAW": "rad", "AGE": "ms"}
    for message in DATABASE.messages:
        for signal in message.signals:
            assert signal.minimum < signal.maximum
            assert (signal.unit or "") == units.get(signal.name, "%" if signal.name == "OBSERVABLE_SHARE" else "")


@pytest.mark.parametrize(
    ("pattern", "becomes", "rule"),
    [
        ("MW_OBJECT_LIST", "OTHER", r"messages\.MW_OBJECT_LIST: the DBC has no such message"),
        ("MW_OBJECT_03_SHAPE", "OTHER", r"messages\.MW_OBJECT_03_SHAPE: the DBC has no such message"),
        (r"SG_ AGE :", "SG_ OLD :", r"messages\.MW_OBJECT_LIST: message MW_OBJECT_LIST of the DBC has no signal 'AGE'"),
        (r"\[-163.84\|163.82\]", "[-200|200]", r"messages\.MW_OBJECT_01_POSITION\.X: range must be within -163\.84"),
        (r'BA_ "E2EDataID" BO_ 785 785;\n', "", r"messages\.MW_OBJECT_01_SHAPE: the DBC has no attribute E2EDataID"),
        ('"GenMsgCycleTime" BO_ 785 100', '"GenMsgCycleTime" BO_ 785 50', "must be that of MW_OBJECT_LIST, 100 ms"),
        ('DelayTime" BO_ 785 5', 'DelayTime" BO_ 785 100', r"below the cycle time, got 100 ms"),
    ],
)
def test_a_dbc_that_does_not_fit_is_one_line(pattern: str, becomes: str, rule: str) -> None:
    text = re.sub(pattern, becomes, DBC.read_text())
    with pytest.raises(ValueError, match=rule) as caught:
        HiddenObjectList(cantools.database.load_string(text, "dbc", strict=False))
    assert "\n" not in str(caught.value)


def test_a_dbc_with_fewer_places_is_a_shorter_list() -> None:
    database = cantools.database.load_file(DBC)
    text = cantools.database.Database(
        [one for one in database.messages if "OBJECT_0" in one.name or one.name == "MW_OBJECT_LIST"]
    )
    short = HiddenObjectList(text)
    assert (short.slots, len(short.frames(view(objects(20)), 0, LIMIT_NS, 0))) == (9, 19)
