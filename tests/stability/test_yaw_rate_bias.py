"""Hard cases of the yaw-rate bias: values that no car has, speeds near zero, backwards, gaps, clocks that are set."""

from __future__ import annotations

import math

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from models.perception.track.odometry import Odometry
from models.perception.track.yaw_rate_bias import BiasSource, DrivingBias, YawRateBias
from msgs.values.arrays import MAX_SPEED_MPS
from msgs.values.vehicle import MAX_YAW_RATE_RPS, VehicleState
from tests.models.perception.track.test_yaw_rate_bias import BIAS_RPS, drive, learnt, town, turns
from tests.stability.catalogue import Errors

EPOCH_NS = 1_763_750_000_123_456_789
STEP_NS = 20_000_000


def bias_after(states: list[VehicleState]) -> float:
    bias = DrivingBias()
    for state in states:
        bias.add(state)
    return bias.bias_rps


@pytest.mark.hard("models.perception.track.yaw_rate_bias", "stamps of the epoch as seconds in float32", 1e-12, "rad/s",
                  "integers: the same blocks, whatever the clock counts from")  # fmt: skip
def test_the_clock_of_the_epoch_changes_nothing(errors: Errors) -> None:
    """Stamps since 1970 against stamps since the start: float32 has steps of 128 s there, so that no block is whole."""
    states = drive(60.0, town, turns)
    shifted = [msgspec.structs.replace(state, stamp_ns=state.stamp_ns + EPOCH_NS) for state in states]
    rounded = [
        msgspec.structs.replace(state, stamp_ns=int(np.float32(state.stamp_ns * 1e-9) * 1e9)) for state in shifted
    ]
    wanted = bias_after(states)
    errors(naive=abs(bias_after(rounded) - wanted), ours=abs(bias_after(shifted) - wanted))


@pytest.mark.slow
def test_the_covariance_stays_one_over_an_hour() -> None:
    """An hour of town without a rest: no eigenvalue below zero, and a standard deviation that has settled."""
    bias, part = DrivingBias(), drive(60.0, town, turns)
    for minute in range(60):
        for state in part[:: 1 if minute < 2 else 5]:
            bias.add(msgspec.structs.replace(state, stamp_ns=state.stamp_ns + minute * 60_000_000_000))
        if minute % 20 == 0:
            eigenvalues = np.linalg.eigvalsh(0.5 * (bias._cov + bias._cov.T))
            assert eigenvalues[0] > 0.0
    assert bias.bias_rps == pytest.approx(BIAS_RPS, abs=math.radians(0.05))
    assert 0.0 < math.degrees(bias.std_rps) < 0.1


def test_backwards_and_creeping_teach_nothing() -> None:
    for speed_mps in (-5.0, -0.2, 0.2, 0.99, 60.1, MAX_SPEED_MPS):
        bias = learnt(drive(20.0, lambda time_s, speed=speed_mps: speed))
        assert bias.driving.rps == 0.0
        assert bias.estimate(0).source is BiasSource.NONE


def test_stop_and_go_without_settling_uses_the_parts_that_drive() -> None:
    """Stops of 0.3 s, shorter than a rest: the blocks between them count, none over a stop."""

    def speed(time_s: float) -> float:
        return 0.0 if time_s % 6.0 < 0.3 else town(time_s)

    found = learnt(drive(90.0, speed, turns)).estimate(0)
    assert found.source is BiasSource.DRIVING
    assert math.degrees(found.rps) == pytest.approx(-0.41, abs=0.1)


@pytest.mark.parametrize("gap_s", [0.3, 0.9, 60.0, 86_400.0])
def test_a_gap_is_no_block_and_what_was_learnt_stays(gap_s: float) -> None:
    """States of the two sides of a gap never meet in a block; the longer the gap, the less is known after it."""
    states = drive(60.0, town, turns)
    before = learnt(states)
    after = learnt(states)
    for state in drive(0.6, town, turns):
        moved = msgspec.structs.replace(state, stamp_ns=state.stamp_ns + states[-1].stamp_ns + round(gap_s * 1e9))
        after.add(moved, 0.0)
    assert after.driving.rps == pytest.approx(before.driving.rps, abs=0.3 * after.driving.std_rps)
    if gap_s > 3600.0:
        assert after.driving.std_rps > before.driving.std_rps


def test_a_clock_set_back_does_not_stop_the_learning() -> None:
    """Odometry begins a new frame; the bias goes on from what it had."""
    odometry = Odometry()
    for offset_ns in (EPOCH_NS, EPOCH_NS - 3_600_000_000_000):
        for state in drive(40.0, town, turns):
            odometry.add(msgspec.structs.replace(state, stamp_ns=state.stamp_ns + offset_ns))
    assert odometry.yaw_rate_bias.source is BiasSource.DRIVING
    assert odometry.yaw_rate_bias_rps == pytest.approx(BIAS_RPS, abs=math.radians(0.1))


def test_sensors_that_come_and_go() -> None:
    """Wheels known in every other second, steering zero at first: blocks take what all their states have."""
    states = [
        msgspec.structs.replace(
            state,
            steering_rad=state.steering_rad if index > 1000 else 0.0,
            wheel_speed_difference_mps=state.wheel_speed_difference_mps if index // 50 % 2 else None,
        )
        for index, state in enumerate(drive(90.0, town, turns))
    ]
    found = learnt(states).estimate(0)
    assert found.source is BiasSource.DRIVING
    assert math.degrees(found.rps) == pytest.approx(-0.41, abs=3.0 * math.degrees(found.std_rps))


numbers = st.one_of(st.floats(-20.0, 20.0), st.sampled_from([0.0, -0.0, 5e-324, 0.05, 1.0, 60.0]))


@pytest.mark.slow
@settings(max_examples=50, deadline=None)
@given(
    st.lists(
        st.tuples(
            st.one_of(numbers, st.sampled_from([MAX_SPEED_MPS, -MAX_SPEED_MPS])),
            st.one_of(numbers, st.sampled_from([MAX_YAW_RATE_RPS, -MAX_YAW_RATE_RPS])),
            st.one_of(numbers, st.sampled_from([1e3, -1e3])),
            st.one_of(st.none(), numbers, st.just(MAX_SPEED_MPS)),
            st.sampled_from([*[STEP_NS] * 3, 240_000_000, 400_000_000, 2_000_000_000, -STEP_NS, 0, -(10**12)]),
            st.integers(1, 60),
        ),
        max_size=12,
    )
)
def test_whatever_comes_the_bias_is_a_number_within_its_limit(runs: list[tuple]) -> None:
    """Runs of equal states with steps of any kind between them."""
    bias, odometry, stamp_ns = YawRateBias(), Odometry(), EPOCH_NS
    for speed, rate, steering, wheels, step_ns, count in runs:
        for _ in range(count):
            stamp_ns += step_ns
            state = VehicleState(
                stamp_ns=stamp_ns, speed_mps=speed, yaw_rate_rps=rate, steering_rad=steering,
                wheel_speed_difference_mps=wheels,
            )  # fmt: skip
            bias.add(state, max(step_ns, 0) * 1e-9)
            odometry.add(state)
            found = bias.estimate(stamp_ns)
            assert abs(found.rps) <= 0.05
            assert 0.0 < found.std_rps < math.inf
            assert math.isfinite(bias.corrected(state))
            assert abs(odometry.yaw_rate_bias_rps) <= 0.05
            assert str(found)
