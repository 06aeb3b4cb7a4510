"""The bias of the yaw rate: at rest, while driving, and where it cannot be told."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable

import numpy as np
import pytest

from benchmarks.perception.yaw_bias import limited, made_drive, run
from models.perception.track.odometry import Odometry
from models.perception.track.yaw_rate_bias import BIAS, BiasSource, YawRateBias
from msgs.values.vehicle import VehicleState

STEP_S = 0.02
BIAS_RPS = math.radians(-0.41)
#: A car without errors: 1/m, yaw rate by steering and speed without understeer, and the track in metres.
RATIO, TRACK_M = 0.025, 1.5


def drive(
    duration_s: float,
    speed: Callable[[float], float],
    curvature: Callable[[float], float] = lambda time_s: 0.0,
    *,
    bias_rps: float = BIAS_RPS,
    tyres: float = 0.0,
    centre_rad: float = 0.0,
    start_s: float = 0.0,
) -> list[VehicleState]:
    """States of a car that turns as it steers; `tyres` is the share by which the right ones are the smaller."""
    states = []
    for step in range(round(duration_s / STEP_S)):
        at_s = start_s + step * STEP_S
        speed_mps, turn = speed(at_s), curvature(at_s)
        states.append(
            VehicleState(
                stamp_ns=round(at_s * 1e9),
                speed_mps=speed_mps,
                yaw_rate_rps=speed_mps * turn + bias_rps,
                steering_rad=turn / RATIO + centre_rad,
                wheel_speed_difference_mps=speed_mps * turn * TRACK_M + tyres * speed_mps,
            )
        )
    return states


def learnt(states: Iterable[VehicleState]) -> YawRateBias:
    """The estimator after all states."""
    bias, last = YawRateBias(), None
    for state in states:
        bias.add(state, 0.0 if last is None else 1e-9 * (state.stamp_ns - last.stamp_ns))
        last = state
    return bias


def town(time_s: float) -> float:
    """3 to 15 m/s."""
    return 9.0 - 6.0 * math.cos(0.3 * time_s)


def turns(time_s: float) -> float:
    """Turns to both sides, 50 m at the sharpest; less sharp at speed, so that no lateral acceleration is unusual."""
    return 0.02 * math.sin(0.7 * time_s) * min(1.0, 6.0 / town(time_s))


@pytest.mark.parametrize("sensors", ["steering", "wheels", "both"])
@pytest.mark.parametrize("bias_dps", [-2.0, -0.41, 0.0, 1.0])
def test_a_drive_at_several_speeds_tells_the_bias(sensors: str, bias_dps: float) -> None:
    """Errors of the car, tyres 0.4 % apart and a wheel 2 deg off centre, do not go into it.

    Without noise the filter is left with its own prior, which pulls by less than the standard deviation it states.
    """
    states = drive(
        60.0, town, turns, bias_rps=math.radians(bias_dps), tyres=0.004, centre_rad=math.radians(2.0)
    )  # fmt: skip
    bias = learnt(limited(states, sensors != "wheels", sensors != "steering"))
    found = bias.estimate(states[-1].stamp_ns)
    assert found.source is BiasSource.DRIVING
    assert math.degrees(found.rps) == pytest.approx(bias_dps, abs=math.degrees(found.std_rps))
    assert math.degrees(found.std_rps) < 0.3
    assert bias.corrected(states[-1]) == states[-1].yaw_rate_rps - found.rps


def test_one_high_speed_does_not_tell_it() -> None:
    """Straight on at 30 m/s a wheel off centre, tyres and the bias are one constant: nothing is taken off, and why."""
    bias = learnt(drive(120.0, lambda time_s: 30.0, centre_rad=math.radians(2.0), tyres=0.004))
    found = bias.estimate(120_000_000_000)
    assert (found.source, found.rps) == (BiasSource.NONE, 0.0)
    assert found.why.startswith("the vehicle never stood, and 120 s of driving at 30.0 to 30.0 m/s leave a standard")
    assert str(found).startswith("yaw rate bias is not observable: the vehicle never stood")
    state = drive(0.02, lambda time_s: 30.0)[0]
    assert bias.corrected(state) == state.yaw_rate_rps


def test_without_sensors_it_says_so() -> None:
    bias = learnt(limited(drive(60.0, town, turns), steering=False, wheels=False))
    found = bias.estimate(0)
    assert found.source is BiasSource.NONE
    assert found.why == "the vehicle never stood, and neither steering nor wheel speeds are known"
    assert found.driven_s == pytest.approx(60.0, abs=0.05)
    assert YawRateBias().estimate(0).why == "the vehicle has neither stood nor driven yet"


def test_a_standstill_has_priority_for_ten_minutes() -> None:
    """Driving says -0.41 deg/s, the rest after it 0.5: that of the rest is taken off, driving's after ten minutes."""
    driven = drive(60.0, town, turns)
    rest = drive(5.0, lambda time_s: 0.0, bias_rps=math.radians(0.5), start_s=60.0)
    bias = learnt([*driven, *rest])
    at_rest = bias.estimate(65_000_000_000)
    assert (at_rest.source, math.degrees(at_rest.rps)) == (BiasSource.REST, pytest.approx(0.5))
    later = drive(30.0, town, turns, start_s=65.0)
    last_ns = 0
    for state in later:
        bias.add(state, STEP_S)
        last_ns = state.stamp_ns
    held = bias.estimate(last_ns)
    assert (held.source, held.rps) == (BiasSource.REST, at_rest.rps)
    assert bias.estimate(last_ns + 601_000_000_000).source is BiasSource.DRIVING


@pytest.mark.slow
def test_a_bias_that_drifts_after_a_rest_is_followed() -> None:
    """0.2 deg/s at rest, then 40 minutes in town at -0.41: ten minutes after the rest it is that of the drive."""
    rest = drive(5.0, lambda time_s: 0.0, bias_rps=math.radians(0.2))
    part = drive(60.0, town, turns, start_s=5.0)
    bias = learnt(rest)
    last_ns = 0
    for minute in range(40):
        for state in part:
            bias.add(
                VehicleState(
                    stamp_ns=state.stamp_ns + minute * 60_000_000_000, speed_mps=state.speed_mps,
                    yaw_rate_rps=state.yaw_rate_rps, steering_rad=state.steering_rad,
                    wheel_speed_difference_mps=state.wheel_speed_difference_mps,
                ),
                STEP_S,
            )  # fmt: skip
            last_ns = state.stamp_ns + minute * 60_000_000_000
    found = bias.estimate(last_ns)
    assert found.source is BiasSource.DRIVING
    assert math.degrees(found.rps) == pytest.approx(-0.41, abs=0.1)


def test_a_bias_beyond_the_limit_is_none() -> None:
    """2.9 deg/s at the most: more is a sensor that is broken, or signals that do not belong together."""
    bias = learnt(drive(200.0, town, turns, bias_rps=math.radians(6.0)))
    found = bias.estimate(200_000_000_000)
    assert (found.source, found.rps) == (BiasSource.NONE, 0.0)


def test_steering_that_counts_the_other_way_does_no_harm() -> None:
    """A wrong sign in the mapping: the wheels alone give the bias, and without them nothing far off is believed."""
    wrong = [
        VehicleState(stamp_ns=state.stamp_ns, speed_mps=state.speed_mps, yaw_rate_rps=state.yaw_rate_rps,
                     steering_rad=-state.steering_rad, wheel_speed_difference_mps=state.wheel_speed_difference_mps)
        for state in drive(60.0, town, turns)
    ]  # fmt: skip
    both = learnt(wrong).estimate(0)
    assert both.source is BiasSource.DRIVING
    assert math.degrees(both.rps) == pytest.approx(-0.41, abs=0.3)
    alone = learnt(limited(wrong, steering=True, wheels=False)).estimate(0)
    assert alone.source is BiasSource.NONE or math.degrees(alone.rps) == pytest.approx(-0.41, abs=0.6)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["town", "slow"])
def test_heading_of_made_drives(kind: str) -> None:
    """58 s with -0.41 deg/s and no standstill, 23.8 deg before; noise, steps of 0.244 deg/s, camber, understeer.

    Four seeds; what is left is mostly turned before the bias is known. The bound on each is that, and three standard
    deviations after it; none is worse than before.
    """
    drives = [made_drive(kind, seed, 58.0, BIAS_RPS) for seed in range(4)]
    outcomes = [run(one, BIAS_RPS) for one in drives]
    assert [one.error_before_deg for one in outcomes] == pytest.approx([23.8] * 4, abs=0.5)
    assert np.median([one.error_after_deg for one in outcomes]) < 12.0
    for one in outcomes:
        assert one.learnt_after_s is not None
        bound_deg = 0.41 * one.learnt_after_s + 3.0 * 0.3 * (58.0 - one.learnt_after_s)
        assert one.error_after_deg < min(bound_deg, one.error_before_deg)
    assert np.mean([(one.bias_error_dps / one.bias_std_dps) ** 2 for one in outcomes]) < 2.0


def test_a_motorway_leaves_the_heading_as_it_is() -> None:
    """What cannot be told is not guessed: the same error as before."""
    outcome = run(made_drive("motorway", 1, 58.0, BIAS_RPS), BIAS_RPS)
    assert outcome.learnt_after_s is None
    assert outcome.error_after_deg == pytest.approx(outcome.error_before_deg, abs=0.2)


def test_odometry_takes_it_off() -> None:
    odometry, states = Odometry(), drive(60.0, town, turns)
    for state in states:
        odometry.add(state)
    place, found = odometry.at(states[-1].stamp_ns), odometry.yaw_rate_bias
    assert place is not None
    assert found.source is BiasSource.DRIVING
    assert place.yaw_rate_rps == states[-1].yaw_rate_rps - found.rps
    assert odometry.yaw_rate_bias_rps == found.rps


def test_after_a_standstill_the_bias_is_independent_of_steering_and_wheels() -> None:
    """Driving ties the bias to the car's constants; a standstill measures it alone: no covariance is left."""
    bias = learnt(drive(20.0, town, turns))
    driving = bias._driving
    others = [index for index in range(6) if index != BIAS]
    assert np.abs(driving._cov[BIAS, others]).max() > 0.0
    driving.set_bias(0.01)
    np.testing.assert_array_equal(driving._cov[BIAS, others], 0.0)
    np.testing.assert_array_equal(driving._cov[others, BIAS], 0.0)
    assert driving.bias_rps == 0.01
