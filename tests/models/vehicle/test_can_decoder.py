"""Frames to vehicle state: what counts, for how long, and why not."""

from __future__ import annotations

from pathlib import Path

import cantools
import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from models.vehicle.can_decoder import AGE_PERIODS, MAX_STAMP_NS, CanDecoder, StampMapper, StateReporter, Verdict
from models.vehicle.can_mapping import CanMapping, DbcRange, MessageRule, QuantityRule, SignRule, WheelSpeedsRule
from models.vehicle.end_to_end import CounterRule
from msgs.bus.codec import encode_inline
from msgs.values.vehicle import VehicleState
from nodes.can.bus import decode_frame, load_dbc, load_decoder, load_mapping
from nodes.can.log_file import read_log
from sim_player.car import CarFrame, SimulatedCar
from tests.captures import DATA, needs

DBC, MAPPING = Path("launch/can/mirrorwave.dbc"), Path("launch/can/mirrorwave.yaml")
DATABASE, RULES = load_dbc(DBC), load_mapping(MAPPING)
SPEED_ID, MOTION_ID = 0x100, 0x101
PERIOD_NS = 20_000_000
LIMIT_NS = AGE_PERIODS * PERIOD_NS
MOTION = VehicleState(stamp_ns=0, speed_mps=12.5, yaw_rate_rps=0.2, steering_rad=0.6)
REAL = DATA / "can_motec_subaru"


class Drive:
    """A simulated car and the decoder that listens to it, period by period."""

    def __init__(self) -> None:
        self.decoder = CanDecoder(DATABASE, RULES)
        self.car = SimulatedCar(DATABASE, RULES)
        self.now_ns = 0

    def period(self, change=lambda frame: frame, motion: VehicleState = MOTION) -> VehicleState:
        """One period, each frame changed by `change` (None: lost); the state at its end."""
        for frame in self.car.frames(msgspec.structs.replace(motion, stamp_ns=self.now_ns)):
            if (changed := change(frame)) is not None:
                self.decoder.add(changed.arbitration_id, changed.data, self.now_ns, changed.extended)
        state = self.decoder.state(self.now_ns)
        self.now_ns += PERIOD_NS
        return state

    def periods(self, count: int, change=lambda frame: frame, motion: VehicleState = MOTION) -> list[VehicleState]:
        return [self.period(change, motion) for _ in range(count)]


def driving() -> Drive:
    drive = Drive()
    assert drive.periods(3)[-1].valid
    return drive


def only(arbitration_id: int, change):
    return lambda frame: change(frame) if frame.arbitration_id == arbitration_id else frame


def lost(frame: CarFrame) -> None:
    return None


def corrupt(frame: CarFrame) -> CarFrame:
    return frame._replace(data=frame.data[:3] + bytes([frame.data[3] ^ 0x10]) + frame.data[4:])


class Stuck:
    """A sender that repeats its first frame for ever."""

    def __init__(self) -> None:
        self.first: CarFrame | None = None

    def __call__(self, frame: CarFrame) -> CarFrame:
        self.first = self.first or frame
        return self.first


def test_the_state_is_what_the_car_does() -> None:
    """Within half a step of the DBC: 0.05 mm/s, 0.5 microrad/s, 0.25 mrad."""
    state = driving().period()
    assert state.valid
    assert state.reason == ""
    assert state.speed_mps == pytest.approx(MOTION.speed_mps, abs=0.5e-4)
    assert state.yaw_rate_rps == pytest.approx(MOTION.yaw_rate_rps, abs=0.5e-6)
    assert state.steering_rad == pytest.approx(MOTION.steering_rad, abs=0.25e-3)
    assert state.age_s == 0.0


def test_nothing_is_valid_before_everything_has_come() -> None:
    drive = Drive()
    reason = "speed: no MW_SPEED yet; yaw rate: no MW_MOTION yet; steering: no MW_MOTION yet"
    assert drive.decoder.state(0).reason == reason
    # the first frame only tells where the counter stands
    assert not drive.period().valid
    assert drive.period().valid


@pytest.mark.parametrize(
    ("fault", "reason"),
    [
        (lost, "speed: no MW_SPEED for 0.20 s"),
        (corrupt, "speed: no good MW_SPEED for 0.20 s (wrong checksum: 0x"),
        (Stuck(), "speed: no good MW_SPEED for 0.20 s (counter stands at "),
        (
            lambda frame: frame._replace(data=frame.data[:7]),
            "speed: no good MW_SPEED for 0.20 s (wrong length: 7 bytes",
        ),
        (lambda frame: frame._replace(extended=True), "speed: no MW_SPEED for 0.20 s"),
        (lambda frame: frame._replace(arbitration_id=0x7FF), "speed: no MW_SPEED for 0.20 s"),
    ],
    ids=["silence", "checksum", "counter", "length", "extended", "other id"],
)
def test_a_fault_ages_out_in_ten_periods_and_heals(fault, reason: str) -> None:
    """The last good frame holds for ten periods, not longer; two good frames (one where no gap was) bring it back."""
    drive = driving()
    change = only(SPEED_ID, fault)
    # the frame at which a sender gets stuck is a good one
    drive.period(change if isinstance(fault, Stuck) else lambda frame: frame)
    last_good_ns = drive.now_ns - PERIOD_NS
    states = drive.periods(AGE_PERIODS, change)
    assert [state.valid for state in states] == [True] * (AGE_PERIODS - 1) + [False]
    assert states[-1].stamp_ns - last_good_ns == LIMIT_NS
    assert states[-1].reason.startswith(reason)
    # the other message is well: no word of it
    assert "MW_MOTION" not in states[-1].reason
    assert drive.periods(2)[-1].valid


def test_age_is_that_of_the_oldest_signal() -> None:
    drive = driving()
    states = drive.periods(4, only(MOTION_ID, lost))
    assert [state.age_s for state in states] == pytest.approx([0.02, 0.04, 0.06, 0.08])


def test_one_lost_frame_is_forgiven_two_are_not() -> None:
    drive = driving()
    for losses, verdict in ((1, Verdict.COUNTED), (2, Verdict.WRONG_COUNTER)):
        drive.periods(losses, only(SPEED_ID, lost))
        before = drive.decoder.counts[verdict]
        drive.period(only(MOTION_ID, lost))
        assert drive.decoder.counts[verdict] == before + 1
        assert drive.period().valid


def test_a_frame_after_long_silence_does_not_count_alone() -> None:
    """A sender that stands still and speaks once in a while is never believed."""
    drive = driving()
    stuck = Stuck()
    for _ in range(5):
        drive.periods(AGE_PERIODS, lost)
        state = drive.period(only(SPEED_ID, stuck))
        assert state.reason.startswith("speed: no good MW_SPEED for ")


def test_a_value_out_of_range_is_named_and_not_used() -> None:
    drive = driving()
    fast = msgspec.structs.replace(MOTION, speed_mps=99.0)
    state = drive.period(motion=fast)
    assert not state.valid
    assert state.reason == "speed: SPEED gives 99, outside the mapping's -80..80"
    assert state.speed_mps == pytest.approx(MOTION.speed_mps)
    assert drive.decoder.counts[Verdict.OUT_OF_RANGE] == 1
    assert drive.period().valid


def test_the_dbcs_own_range_holds_too() -> None:
    rules = msgspec.structs.replace(RULES, speed=msgspec.structs.replace(RULES.speed, high=500.0))
    drive = driving()
    drive.decoder = CanDecoder(DATABASE, rules)
    drive.periods(2)
    state = drive.period(motion=msgspec.structs.replace(MOTION, speed_mps=100.5))
    assert state.reason == "speed: SPEED = 100.5 m/s is outside the DBC's -100..100"


def test_a_wrong_dbc_says_so() -> None:
    decoder = CanDecoder(DATABASE, RULES)
    for index in range(100):
        assert decoder.add(0x2B0, bytes(8), index * 1_000_000).verdict is Verdict.UNKNOWN_ID
    state = decoder.state(100_000_000)
    assert not state.valid
    assert state.reason.endswith("100 frames of other ids came: wrong DBC?")


def test_late_frames_are_refused_and_a_new_start_is_taken() -> None:
    drive = driving()
    drive.now_ns -= 3 * PERIOD_NS
    drive.car = SimulatedCar(DATABASE, RULES)
    drive.period()
    assert drive.decoder.counts[Verdict.LATE] == 2
    drive = driving()
    drive.now_ns = 10_000_000_000
    drive.periods(3)
    # the clock was set back by ten seconds: old stamps must not look fresh, new ones must count
    drive.now_ns = 0
    drive.car = SimulatedCar(DATABASE, RULES)
    assert [state.valid for state in drive.periods(3)] == [False, True, True]


@pytest.mark.parametrize("stamp_ns", [-1, MAX_STAMP_NS, 1 << 200])
def test_a_stamp_that_is_no_time_is_refused(stamp_ns: int) -> None:
    drive = driving()
    assert drive.decoder.add(SPEED_ID, bytes(8), stamp_ns).verdict is Verdict.BAD_STAMP
    assert drive.period().valid


def own_decoder(dbc: str, **changes) -> CanDecoder:
    database = cantools.database.load_string(dbc, "dbc", strict=False)
    rules = {
        "speed": QuantityRule(message="A", signals=("V",), unit="m/s", low=-100.0, high=100.0),
        "yaw_rate": QuantityRule(message="A", signals=("W",), unit="rad/s", low=-2.0, high=2.0),
        "messages": {"A": MessageRule(period_s=0.02)},
        **changes,
    }
    return CanDecoder(database, CanMapping(**rules))


CAR = """VERSION ""
BO_ 16 A: 8 X
 SG_ V : 0|16@1+ (0.01,0) [0|655.35] "km/h" X
 SG_ W : 16|16@1- (0.01,0) [0|0] "deg/s" X
 SG_ V2 : 32|16@1+ (0.01,0) [0|655.35] "km/h" X
 SG_ BACK : 48|1@1+ (1,0) [0|1] "" X
BO_ 17 B: 1 X
 SG_ REVERSE : 0|1@1+ (1,0) [0|1] "" X
"""


def car_data(v: int, w: int, v2: int = 0, back: int = 0) -> bytes:
    return v.to_bytes(2, "little") + w.to_bytes(2, "little", signed=True) + v2.to_bytes(2, "little") + bytes([back, 0])


def test_units_signs_and_means() -> None:
    """km/h of two wheels and deg/s counted to the right become m/s and rad/s counted to the left."""
    decoder = own_decoder(
        CAR,
        speed=QuantityRule(message="A", signals=("V", "V2"), scale=1 / 3.6, low=-50.0, high=50.0),
        yaw_rate=QuantityRule(message="A", signals=("W",), scale=np.pi / 180, offset=0.01, sign=-1, low=-2.0, high=2.0),
    )
    decoder.add(16, car_data(3600, -900, 3960), 0)
    state = decoder.state(0)
    assert state.valid
    assert state.speed_mps == pytest.approx((36.0 + 39.6) / 2 / 3.6)
    assert state.yaw_rate_rps == pytest.approx(-(np.radians(-9.0) + 0.01))


def test_an_angle_and_its_fraction_are_summed() -> None:
    """Coarse steps of 1.5 deg and a fraction of 0.1 deg: 16.5 - 0.7 deg; the mean would be half of it."""
    dbc = (
        CAR
        + """BO_ 18 S: 2 X
 SG_ ANGLE : 0|8@1- (1.5,0) [-150|150] "deg" X
 SG_ FRACTION : 8|4@1- (0.1,0) [-0.7|0.7] "deg" X
"""
    )
    steering = QuantityRule(message="S", signals=("ANGLE", "FRACTION"), combine="sum", sign=-1, low=-9.0, high=9.0)
    periods = {"A": MessageRule(period_s=0.02), "S": MessageRule(period_s=0.02)}
    decoder = own_decoder(dbc, steering=steering, messages=periods)
    decoder.add(18, bytes([11, (-7) & 0x0F]), 0)
    decoder.add(16, car_data(0, 0), 0)
    state = decoder.state(0)
    assert state.valid
    assert state.steering_rad == pytest.approx(-np.radians(15.8))


def test_a_gear_lever_says_the_direction() -> None:
    """Of the gears 0, 1 and 2 the last one is reverse: any number but zero would be wrong."""
    dbc = CAR.replace("SG_ BACK : 48|1@1+ (1,0) [0|1]", "SG_ BACK : 48|2@1+ (1,0) [0|3]")
    rule = QuantityRule(
        message="A", signals=("V",), negative_while=SignRule(message="A", signal="BACK", values=(2,)), low=-99.0,
        high=99.0,
    )  # fmt: skip
    decoder = own_decoder(dbc, speed=rule)
    speeds = []
    for step, gear in enumerate((0, 1, 2)):
        decoder.add(16, car_data(1800, 0, back=gear), step * PERIOD_NS)
        speeds.append(decoder.state(step * PERIOD_NS).speed_mps)
    assert speeds == pytest.approx([5.0, 5.0, -5.0])


WHEELS = """BO_ 19 R: 8 X
 SG_ FL : 0|16@1+ (0.01,0) [0|300] "km/h" X
 SG_ FR : 16|16@1+ (0.01,0) [0|300] "km/h" X
 SG_ RL : 32|16@1+ (0.01,0) [0|300] "km/h" X
 SG_ RR : 48|16@1+ (0.01,0) [0|300] "km/h" X
"""


def test_the_difference_of_the_wheels_is_right_less_left() -> None:
    """Left 36.0 and 37.8 km/h, right 39.6 and 41.4: 1 m/s, and -1 m/s backwards; without them the state stays valid."""
    rule = WheelSpeedsRule(
        message="R", left=("FL", "RL"), right=("FR", "RR"), negative_while=SignRule(message="A", signal="BACK")
    )
    periods = {"A": MessageRule(period_s=0.02), "R": MessageRule(period_s=0.02)}
    decoder = own_decoder(CAR + WHEELS, wheel_speeds=rule, messages=periods)
    decoder.add(16, car_data(500, 0), 0)
    assert (decoder.state(0).valid, decoder.state(0).wheel_speed_difference_mps) == (True, None)
    data = b"".join(round(100 * speed).to_bytes(2, "little") for speed in (36.0, 39.6, 37.8, 41.4))
    decoder.add(19, data, 0)
    assert decoder.state(0).wheel_speed_difference_mps == pytest.approx(1.0)
    decoder.add(16, car_data(500, 0, back=1), PERIOD_NS)
    decoder.add(19, data, PERIOD_NS)
    assert decoder.state(PERIOD_NS).wheel_speed_difference_mps == pytest.approx(-1.0)
    # one wheel beyond its range: no difference, and the state says nothing of it
    assert decoder.add(19, b"\xff\xff" + data[2:], 2 * PERIOD_NS).verdict is Verdict.OUT_OF_RANGE
    state = decoder.state(2 * PERIOD_NS)
    assert (state.valid, state.wheel_speed_difference_mps) == (True, None)
    decoder.add(19, data, 3 * PERIOD_NS)
    assert decoder.state(3 * PERIOD_NS).wheel_speed_difference_mps is not None
    # ten periods later they are old
    decoder.add(16, car_data(500, 0), 13 * PERIOD_NS)
    state = decoder.state(13 * PERIOD_NS)
    assert (state.valid, state.wheel_speed_difference_mps) == (True, None)


RAW_DBC, RAW_MAPPING = Path("launch/can/raw_ranges.dbc"), Path("launch/can/raw_ranges.yaml")


def raw_drive(mapping: CanMapping) -> list[VehicleState]:
    """States of 10 s of turns to the left and to the right, the yaw rate 0.41 deg/s too low; frames of that DBC."""
    database = load_dbc(RAW_DBC)
    car, decoder = SimulatedCar(database, load_mapping(RAW_MAPPING)), CanDecoder(database, mapping)
    states = []
    for step in range(500):
        now_ns = step * PERIOD_NS
        turn_rps = 0.2 * np.sin(0.02 * step)
        motion = VehicleState(
            stamp_ns=now_ns, speed_mps=10.0, yaw_rate_rps=float(turn_rps - np.radians(0.41)),
            steering_rad=float(4.0 * turn_rps), wheel_speed_difference_mps=float(1.5 * turn_rps),
        )  # fmt: skip
        for frame in car.frames(motion):
            decoder.add(frame.arbitration_id, frame.data, now_ns)
        states.append(decoder.state(now_ns))
        if states[-1].valid:
            # half a step of the DBC: 0.01 km/h, 0.244 deg/s, 0.1 deg (of the wheels two steps may add up)
            assert states[-1].speed_mps == pytest.approx(10.0, abs=0.005 / 3.6)
            assert states[-1].yaw_rate_rps == pytest.approx(motion.yaw_rate_rps, abs=np.radians(0.123))
            assert states[-1].steering_rad == pytest.approx(motion.steering_rad, abs=np.radians(0.0501))
            assert states[-1].wheel_speed_difference_mps == pytest.approx(1.5 * turn_rps, abs=0.0101 / 3.6)
    return states


def test_a_dbc_with_ranges_in_raw_counts_is_read_by_a_mapping_alone() -> None:
    """Read as deg/s the range 0..65535 of the yaw rate takes out every turn to the right."""
    mapping = load_mapping(RAW_MAPPING)
    decoder = load_decoder(RAW_DBC, RAW_MAPPING)
    assert decoder.warnings == (
        "yaw_rate.signals: the DBC's range 0..65535 of YAW_RATE is taken as raw counts, -125..124.612 deg/s; "
        "yaw_rate.dbc_range: physical overrules this",
    )
    states = raw_drive(mapping)
    assert all(state.valid for state in states)
    to_the_right = [state for state in states if state.yaw_rate_rps < -np.radians(0.5 * 0.244)]
    assert len(to_the_right) > 150
    as_written = msgspec.structs.replace(mapping.yaw_rate, dbc_range=DbcRange.PHYSICAL)
    refused = [state for state in raw_drive(msgspec.structs.replace(mapping, yaw_rate=as_written)) if not state.valid]
    assert [state.stamp_ns for state in refused] == [state.stamp_ns for state in to_the_right]
    assert "yaw rate: YAW_RATE = -0.316 deg/s is outside the DBC's 0..65535" in {state.reason for state in refused}


def test_a_sign_bit_of_the_same_message() -> None:
    rule = QuantityRule(
        message="A",
        signals=("V",),
        unit="m/s",
        negative_while=SignRule(message="A", signal="BACK"),
        low=-99.0,
        high=99.0,
    )
    decoder = own_decoder(CAR, speed=rule)
    decoder.add(16, car_data(500, 0, back=1), 0)
    assert decoder.state(0).speed_mps == -5.0
    decoder.add(16, car_data(500, 0), 20_000_000)
    assert decoder.state(20_000_000).speed_mps == 5.0
    decoder.add(16, car_data(0, 0, back=1), 40_000_000)
    assert str(decoder.state(40_000_000).speed_mps) == "0.0"


def test_a_reverse_gear_in_another_message_must_be_known() -> None:
    rule = QuantityRule(
        message="A",
        signals=("V",),
        unit="m/s",
        negative_while=SignRule(message="B", signal="REVERSE"),
        low=-99.0,
        high=99.0,
    )
    periods = {"A": MessageRule(period_s=0.02), "B": MessageRule(period_s=1.0)}
    decoder = own_decoder(CAR, speed=rule, messages=periods)
    decoder.add(16, car_data(500, 0), 0)
    assert decoder.state(0).reason == "speed: no B yet"
    decoder.add(17, b"\x01", 1_000_000)
    decoder.add(16, car_data(500, 0), 20_000_000)
    assert decoder.state(20_000_000) == VehicleState(stamp_ns=20_000_000, speed_mps=-5.0)
    for step in range(2, 520):
        decoder.add(16, car_data(500, 0), step * PERIOD_NS)
    assert decoder.state(519 * PERIOD_NS).reason == "speed: no B for 10.38 s"


def test_a_multiplexed_signal_ages_on_its_own() -> None:
    """The message goes on, the signal does not come any more: it must age out."""
    dbc = """VERSION ""
BO_ 16 A: 8 X
 SG_ M M : 0|8@1+ (1,0) [0|255] "" X
 SG_ V : 8|16@1+ (0.01,0) [0|655.35] "" X
 SG_ W m1 : 24|16@1- (0.01,0) [-300|300] "" X
 SG_ U m2 : 24|16@1- (0.01,0) [-300|300] "" X
"""
    decoder = own_decoder(dbc)
    assert decoder.add(16, b"\x01" + bytes(7), 0).verdict is Verdict.COUNTED
    verdicts = [decoder.add(16, b"\x02" + bytes(7), step * PERIOD_NS).verdict for step in range(1, 11)]
    assert set(verdicts) == {Verdict.COUNTED}
    assert decoder.state(9 * PERIOD_NS).valid
    assert decoder.state(10 * PERIOD_NS).reason == "yaw rate: no A for 0.20 s"


def test_a_float_that_is_no_number_is_out_of_range() -> None:
    dbc = """VERSION ""
BO_ 16 A: 8 X
 SG_ V : 0|32@1- (1,0) [0|0] "" X
 SG_ W : 32|32@1- (1,0) [0|0] "" X
SIG_VALTYPE_ 16 V : 1;
SIG_VALTYPE_ 16 W : 1;
"""
    decoder = own_decoder(dbc)
    for value in (float("nan"), float("inf"), float("-inf")):
        data = np.array([value, 0.0], "<f4").tobytes()
        assert decoder.add(16, data, 0).verdict is Verdict.OUT_OF_RANGE
    assert not decoder.state(0).valid
    assert decoder.add(16, np.array([3.0, 0.5], "<f4").tobytes(), 0).verdict is Verdict.COUNTED
    assert (decoder.state(0).speed_mps, decoder.state(0).yaw_rate_rps) == (3.0, 0.5)


def test_can_fd_padding_is_no_fault() -> None:
    dbc = CAR.replace("BO_ 16 A: 8 X", "BO_ 16 A: 10 X")
    verdicts = {
        length: own_decoder(dbc).add(16, car_data(500, 0) + bytes(length - 8), 0).verdict for length in range(8, 17)
    }
    assert [length for length, verdict in verdicts.items() if verdict is Verdict.COUNTED] == [10, 11, 12]


@pytest.mark.parametrize(
    ("changes", "rule"),
    [
        ({"speed": {"message": "MW_SPED"}}, r"speed\.message: the DBC has no message 'MW_SPED'"),
        ({"yaw_rate": {"signals": ("YAW",)}}, r"yaw_rate\.signals: message MW_MOTION of the DBC has no signal 'YAW'"),
        (
            {"speed": {"negative_while": SignRule(message="MW_MOTION", signal="R")}},
            r"speed\.negative_while\.signal: message MW_MOTION of the DBC has no signal 'R'",
        ),
    ],
)
def test_a_mapping_that_does_not_fit_names_its_field(changes: dict, rule: str) -> None:
    fields = {name: msgspec.structs.replace(getattr(RULES, name), **change) for name, change in changes.items()}
    with pytest.raises(ValueError, match=rule):
        CanDecoder(DATABASE, msgspec.structs.replace(RULES, **fields))


def test_messages_need_a_period_and_a_use() -> None:
    with pytest.raises(ValueError, match=r"messages\.A\.period_s: must be given, the DBC states no cycle time"):
        own_decoder(CAR, messages={})
    with pytest.raises(ValueError, match=r"messages\.B: no quantity is taken from this message"):
        own_decoder(CAR, messages={"A": MessageRule(period_s=0.02), "B": MessageRule(period_s=1.0)})
    with pytest.raises(ValueError, match=r"messages\.A\.counter\.signal"):
        own_decoder(CAR, messages={"A": MessageRule(period_s=0.02, counter=CounterRule(signal="NONE"))})


@pytest.mark.parametrize(
    ("change", "rule"),
    [
        ({"signals": ()}, "signals must name at least one signal"),
        ({"scale": 0.0}, r"scale must be finite and not zero, got 0\.0"),
        ({"offset": float("nan")}, "offset must be finite"),
        ({"low": 5.0}, r"low must be below high, both finite, got 5\.0 and 1\.0"),
    ],
)
def test_rules_refuse_what_makes_no_sense(change: dict, rule: str) -> None:
    with pytest.raises(ValueError, match=rule):
        QuantityRule(**{"message": "A", "signals": ("V",), "low": 0.0, "high": 1.0, **change})


def test_reporter_speaks_at_the_speed_messages_rate_and_in_silence() -> None:
    """Valid states come with each speed frame alone; when they stop, the state says so as it expires and each 0.1 s."""
    drive = Drive()
    reporter = StateReporter(drive.decoder, 0)
    said: list[VehicleState] = []
    for now_ns in range(0, 1_000_000_000, 1_000_000):
        if now_ns < 400_000_000:
            for frame in drive.car.frames(msgspec.structs.replace(MOTION, stamp_ns=now_ns)):
                judged = drive.decoder.add(frame.arbitration_id, frame.data, now_ns)
                said += [state for state in [reporter.frame(judged, now_ns)] if state]
        said += [state for state in [reporter.tick(now_ns)] if state]
    times_ms = [(state.stamp_ns // 1_000_000, state.valid) for state in said]
    # the first frames only show where the counters stand; speed comes before yaw rate, so one more state is not valid
    assert times_ms[:3] == [(0, False), (20, False), (40, True)]
    assert times_ms[2:20] == [(20 * step, True) for step in range(2, 20)]
    assert times_ms[20:] == [(time_ms, False) for time_ms in range(580, 1000, 100)]


def test_trouble_of_the_bus_makes_the_state_invalid_at_once() -> None:
    drive = driving()
    reporter = StateReporter(drive.decoder, drive.now_ns)
    assert reporter.tick(drive.now_ns).valid
    assert reporter.tick(drive.now_ns + 50_000_000) is None
    state = reporter.tick(drive.now_ns + 100_000_000, "bus-off")
    assert (state.valid, state.reason) == (False, "bus-off")


def test_stamps_of_another_clock_are_mapped() -> None:
    """Epoch stamps, arrivals 0.1 to 3 ms later on a clock that counts from boot: the fastest frame sets the offset."""
    mapper = StampMapper()
    rng = np.random.default_rng(7)
    offset_ns = -1_700_000_000_000_000_000
    worst_ns = 0
    for stamp_ns in range(0, 5_000_000_000, 10_000_000):
        arrival_ns = stamp_ns + int(rng.uniform(100_000, 3_000_000))
        mapped_ns = mapper.map(stamp_ns - offset_ns, arrival_ns)
        assert mapped_ns <= arrival_ns
        worst_ns = max(worst_ns, abs(mapped_ns - stamp_ns)) if stamp_ns > 1_000_000_000 else 0
    # 100 or more frames a window: the fastest takes less than 0.5 ms
    assert worst_ns < 500_000


@pytest.mark.parametrize("step_s", [-5, 5])
def test_a_clock_that_is_set_is_followed_within_two_seconds(step_s: int) -> None:
    mapper = StampMapper()
    errors_ns = []
    for now_ns in range(0, 6_000_000_000, 10_000_000):
        shift_ns = step_s * 1_000_000_000 if now_ns >= 3_000_000_000 else 0
        errors_ns.append((now_ns, mapper.map(10**18 + now_ns + shift_ns, now_ns) - now_ns))
    assert {error for now_ns, error in errors_ns if not 3_000_000_000 <= now_ns < 5_000_000_000} == {0}


@pytest.mark.parametrize("off_s", [-3600, -6, 6, 10**9])
def test_one_stamp_that_is_off_moves_no_other(off_s: int) -> None:
    """As interfaces have stamped a received frame six seconds ahead of those around it."""
    mapper = StampMapper()
    for now_ns in range(0, 6_000_000_000, 10_000_000):
        off_ns = off_s * 1_000_000_000 if now_ns == 3_000_000_000 else 0
        assert mapper.map(10**18 + now_ns + off_ns, now_ns) == now_ns


@pytest.mark.slow
@settings(max_examples=200, deadline=None)
@given(
    st.lists(
        st.tuples(
            st.sampled_from([SPEED_ID, MOTION_ID, 0x102, 0x1FFFFFFF]) | st.integers(0, 0x1FFFFFFF),
            st.binary(max_size=64),
            st.integers(-(10**6), 10**18) | st.integers(0, 10**9),
            st.booleans(),
        ),
        max_size=30,
    )
)
def test_no_frame_is_fatal_and_no_garbage_is_believed(frames: list[tuple[int, bytes, int, bool]]) -> None:
    decoder = CanDecoder(DATABASE, RULES)
    reporter = StateReporter(decoder, 0)
    for arbitration_id, data, stamp_ns, extended in frames:
        judged = decoder.add(arbitration_id, data, stamp_ns, extended)
        reporter.frame(judged, stamp_ns)
        reporter.tick(max(stamp_ns, 0))
        state = decoder.state(max(stamp_ns, 0))
        assert not state.valid
        encode_inline(state)
    assert decoder.counts.total() == len(frames)


@pytest.mark.slow
@settings(max_examples=200, deadline=None)
@given(st.lists(st.tuples(st.sampled_from([16, 17]), st.binary(min_size=8, max_size=8)), max_size=20))
def test_what_is_believed_is_in_range(frames: list[tuple[int, bytes]]) -> None:
    """A car without checksums: any bytes may count, none may leave the ranges."""
    decoder = own_decoder(CAR)
    for step, (arbitration_id, data) in enumerate(frames):
        decoder.add(arbitration_id, data, step * 1_000_000)
        state = decoder.state(step * 1_000_000)
        assert -100.0 <= state.speed_mps <= 100.0
        assert -2.0 <= state.yaw_rate_rps <= 2.0
        assert state.valid == (state.reason == "")


needs_real_log = needs(REAL)


@pytest.fixture(scope="module")
def real_drive() -> tuple[CanDecoder, list[VehicleState], list]:
    decoder = load_decoder(REAL / "sample_can_spec.dbc", Path("launch/can/motec_sample.yaml"))
    states, faults = [], []
    reporter: StateReporter | None = None
    for frame, stamp_ns in read_log(REAL / "can_sample.log"):
        reporter = reporter or StateReporter(decoder, stamp_ns)
        judged = decode_frame(decoder, frame, stamp_ns)
        if judged.why:
            faults.append((judged, stamp_ns))
        states += [state for state in (reporter.tick(stamp_ns), reporter.frame(judged, stamp_ns)) if state]
    return decoder, states, faults


@pytest.mark.slow
@needs_real_log
def test_a_real_drive_is_read(real_drive) -> None:
    """90 s of one car: standstill to 36.0 m/s, 50 states a second, nothing older than a period."""
    decoder, states, _ = real_drive
    assert decoder.counts.total() == 82558
    valid = [state for state in states if state.valid]
    assert max(state.speed_mps for state in valid) == pytest.approx(36.0, abs=0.02)
    assert min(abs(state.speed_mps) for state in valid) == 0.0
    assert len(states) / 90.28 == pytest.approx(50.0, abs=0.2)
    assert max(state.age_s for state in valid) < 0.02
    # standing, the yaw rate is that of the gyroscope at rest
    resting = [state.yaw_rate_rps for state in valid if abs(state.speed_mps) < 0.1]
    assert abs(np.mean(resting)) < 1e-3


@needs_real_log
def test_left_is_positive_for_yaw_rate_and_steering(real_drive) -> None:
    """The DBC counts yaw to the left and steering to the right, and drives backwards at first.

    For a car without slip yaw rate = speed * steering / (ratio * wheelbase): positive correlation, and a ratio times
    wheelbase of cars, 13..20 times 2.5..3 m; slip at speed raises it.
    """
    _, states, _ = real_drive
    yaw, speed, steering = np.array(
        [(state.yaw_rate_rps, state.speed_mps, state.steering_rad) for state in states if state.valid]
    ).T
    assert np.corrcoef(yaw, speed * steering)[0, 1] > 0.95
    assert 30.0 < np.polyfit(yaw, speed * steering, 1)[0] < 60.0
    backwards, forwards = speed < -0.3, speed > 0.3
    assert backwards.sum() > 100
    for part in (backwards, forwards):
        assert np.corrcoef(yaw[part], (speed * steering)[part])[0, 1] > 0.9


@pytest.mark.slow
@needs_real_log
def test_the_signs_are_those_of_the_road(real_drive) -> None:
    """In a left turn the right wheels go the longer way: (right - left) / track is the yaw rate, whatever gyros say."""
    _, states, _ = real_drive
    database = load_dbc(REAL / "sample_can_spec.dbc")
    wheels = [
        (stamp_ns, database.decode_message(0xD4, frame.data))
        for frame, stamp_ns in read_log(REAL / "can_sample.log")
        if frame.arbitration_id == 0xD4
    ]
    difference = np.array([(item["WS_RR"] - item["WS_RL"] + item["WS_FR"] - item["WS_FL"]) / 2 for _, item in wheels])
    valid = [state for state in states if state.valid and abs(state.speed_mps) > 0.3]
    stamps_ns = [stamp_ns for stamp_ns, _ in wheels]
    at = np.searchsorted(stamps_ns, [state.stamp_ns for state in valid]).clip(0, len(wheels) - 1)
    signed = difference[at] * np.sign([state.speed_mps for state in valid])
    yaw = np.array([state.yaw_rate_rps for state in valid])
    assert np.corrcoef(yaw, signed)[0, 1] > 0.9
    assert np.polyfit(yaw, signed, 1)[0] == pytest.approx(1.5, abs=0.2)


@needs_real_log
def test_the_wheels_of_a_real_car_turn_with_it(real_drive) -> None:
    """Difference of the wheels by yaw rate is the track, 1.5 m of this car within slip and steps of 0.0155 m/s."""
    _, states, _ = real_drive
    rows = [
        (state.yaw_rate_rps, state.wheel_speed_difference_mps)
        for state in states
        if state.valid and state.wheel_speed_difference_mps is not None and abs(state.speed_mps) > 0.3
    ]
    assert len(rows) > 3900
    yaw, difference = np.array(rows).T
    assert np.polyfit(yaw, difference, 1)[0] == pytest.approx(1.5, abs=0.2)


@needs_real_log
def test_steering_beyond_the_dbcs_range_is_flagged(real_drive) -> None:
    """Full lock while parking: 457.3 degrees, in a DBC that says 450."""
    _, states, faults = real_drive
    assert len(faults) == 71
    assert {judged.verdict for judged, _ in faults} == {Verdict.OUT_OF_RANGE}
    assert any("STEER_ANGLE = -457.3 deg is outside the DBC's -450..450" in judged.why for judged, _ in faults)
    flagged = [state for state in states if state.reason.startswith("steering: STEER_ANGLE")]
    assert len(flagged) == 71
    assert not any(state.valid for state in flagged)
    assert max(abs(state.steering_rad) for state in states) <= np.radians(450.05)
