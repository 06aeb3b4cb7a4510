"""The simulated car: its periods, its protection, and that a decoder hears what it says."""

from __future__ import annotations

import math
from pathlib import Path

import cantools
import msgspec
import pytest

from models.vehicle.can_decoder import CanDecoder, Verdict
from models.vehicle.can_mapping import CanMapping, MessageRule, QuantityRule, SignRule
from msgs.values.vehicle import VehicleState
from nodes.can.bus import load_dbc, load_mapping
from sim_player.car import SimulatedCar, steering_rad

DATABASE = load_dbc(Path("launch/can/mirrorwave.dbc"))
RULES = load_mapping(Path("launch/can/mirrorwave.yaml"))
STATE = VehicleState(stamp_ns=0, speed_mps=-3.21, yaw_rate_rps=0.4, steering_rad=-1.5)


def at(stamp_ns: int) -> VehicleState:
    return msgspec.structs.replace(STATE, stamp_ns=stamp_ns)


def test_each_message_comes_at_its_period() -> None:
    car = SimulatedCar(DATABASE, RULES, start_ns=5)
    assert car.due_ns() == 5
    assert car.frames(at(4)) == []
    assert [frame.arbitration_id for frame in car.frames(at(5))] == [0x100, 0x101]
    assert car.due_ns() == 20_000_005
    assert car.frames(at(20_000_004)) == []
    # late by a second: what was missed is not made up for
    assert len(car.frames(at(1_020_000_005))) == 2
    assert car.due_ns() == 1_040_000_005


def test_counters_roll_and_payloads_differ() -> None:
    car = SimulatedCar(DATABASE, RULES)
    frames = [car.frames(at(step * 20_000_000))[0] for step in range(32)]
    assert [frame.data[1] & 0xF for frame in frames] == 2 * list(range(16))
    assert len({frame.data for frame in frames}) == 16


def test_same_motion_same_bytes() -> None:
    runs = [[SimulatedCar(DATABASE, RULES).frames(at(0))] for _ in range(2)]
    assert runs[0] == runs[1]


def test_a_foreign_dbc_is_spoken_too() -> None:
    """Right-counted yaw in deg/s, km/h of two wheels, a reverse gear in a message of its own, a checksum at the end."""
    dbc = """VERSION ""
BO_ 16 A: 8 X
 SG_ V1 : 0|16@1+ (0.01,0) [0|655.35] "km/h" X
 SG_ V2 : 16|16@1+ (0.01,0) [0|655.35] "km/h" X
 SG_ CHECK : 56|8@1+ (1,0) [0|255] "" X
BO_ 17 B: 4 X
 SG_ W : 7|16@0- (0.005,-1.5) [-100|100] "deg/s" X
 SG_ REVERSE : 23|1@0+ (1,0) [0|1] "" X
"""
    mapping = CanMapping(
        speed=QuantityRule(
            message="A",
            signals=("V1", "V2"),
            scale=1 / 3.6,
            negative_while=SignRule(message="B", signal="REVERSE"),
            low=-20.0,
            high=60.0,
        ),
        yaw_rate=QuantityRule(message="B", signals=("W",), scale=math.pi / 180, sign=-1, low=-1.5, high=1.5),
        messages={
            "A": msgspec.convert({"period_s": 0.01, "checksum": {"signal": "CHECK", "algorithm": "xor8"}}, MessageRule),
            "B": MessageRule(period_s=0.05),
        },
    )
    database = cantools.database.load_string(dbc, "dbc")
    car, decoder = SimulatedCar(database, mapping), CanDecoder(database, mapping)
    for step in range(11):
        for frame in car.frames(at(step * 10_000_000)):
            assert decoder.add(frame.arbitration_id, frame.data, step * 10_000_000).verdict is Verdict.COUNTED
    state = decoder.state(100_000_000)
    assert state.valid
    assert state.speed_mps == pytest.approx(STATE.speed_mps, abs=0.005 / 3.6)
    assert state.yaw_rate_rps == pytest.approx(STATE.yaw_rate_rps, abs=math.radians(0.0025))


def test_wheels_and_summed_angles_are_spoken() -> None:
    """A turn to the left at 10 m/s: the right wheels are the faster ones; 33.3 deg are 33 and a fraction of 0.3."""
    database = load_dbc(Path("launch/can/raw_ranges.dbc"))
    car = SimulatedCar(database, load_mapping(Path("launch/can/raw_ranges.yaml")))
    state = VehicleState(
        stamp_ns=0, speed_mps=10.0, steering_rad=math.radians(33.3), wheel_speed_difference_mps=0.5
    )  # fmt: skip
    said = {
        frame.arbitration_id: database.decode_message(frame.arbitration_id, frame.data) for frame in car.frames(state)
    }
    wheels = {"WHEEL_FR": 36.9, "WHEEL_FL": 35.1, "WHEEL_RR": 36.9, "WHEEL_RL": 35.1}
    assert said[170] == pytest.approx(wheels, abs=0.01)
    assert said[37] == pytest.approx({"ANGLE": 33.0, "ANGLE_FRACTION": 0.3})
    assert said[180]["SPEED"] == pytest.approx(36.0)


def test_steering_goes_with_the_turn() -> None:
    """A car on a circle of 20 m: tan(wheel angle) = wheelbase / radius; backwards the wheel points the other way."""
    expected_rad = 15.0 * math.atan(2.7 / 20.0)
    assert steering_rad(10.0, 0.5) == pytest.approx(expected_rad)
    assert steering_rad(-10.0, 0.5) == pytest.approx(-expected_rad)
    assert steering_rad(0.0, 0.5) == 0.0
    assert steering_rad(1e-9, -0.5) == -9.0


def test_a_motion_beyond_the_bits_is_refused() -> None:
    with pytest.raises(ValueError, match=r"SPEED"):
        SimulatedCar(DATABASE, RULES).frames(VehicleState(stamp_ns=0, speed_mps=1e3))


def test_a_mapping_that_does_not_fit_is_refused() -> None:
    rules = msgspec.structs.replace(RULES, speed=msgspec.structs.replace(RULES.speed, message="GONE"))
    with pytest.raises(ValueError, match=r"messages\.GONE: the DBC has no message 'GONE'"):
        SimulatedCar(DATABASE, rules)
