"""Drives without a standstill, whose gyroscope has a constant bias, and the heading that the odometry gives of them.

Made drives: a car with a lag between steering and yaw, understeer, a steering wheel that is not centred and drifts with
the camber of the road, tyres of unequal size, noise. Its frames are sent and decoded by `launch/can/raw_ranges.*`, so
every signal has the steps of that DBC (yaw rate 0.244 deg/s). None of its constants is known to the estimator. The
truth is the yaw rate that was driven. Kinds: town (3 to 15 m/s with turns), slow (2.5 to 5 m/s), motorway (30 m/s,
hardly a turn), on which the bias cannot be told from the other constants.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import msgspec
import numpy as np
from scipy.ndimage import gaussian_filter1d

from mirrorwave.convert.can_log import log_states
from models.perception.track.odometry import Odometry
from models.perception.track.yaw_rate_bias import BiasSource
from models.vehicle.can_decoder import CanDecoder, StateReporter
from msgs.files.shipped import CHECKOUT
from msgs.values.frames import wrap_angle
from msgs.values.units import ns_from_s, s_from_ns
from msgs.values.vehicle import VehicleState
from nodes.can.bus import load_dbc, load_decoder, load_mapping
from nodes.can.log_file import read_log
from sim_player.car import SimulatedCar

CAN = CHECKOUT / "launch" / "can"
STEP_S, PERIODS_S = 0.02, {"speed": 6.0, "turn": 3.0}
#: (lowest and highest speed, m/s; largest curvature, 1/m), by kind of drive.
KINDS = {"town": (3.0, 15.0, 0.03), "slow": (2.5, 5.0, 0.08), "motorway": (29.5, 30.5, 0.0008)}
MAX_LATERAL_MPS2 = 3.0
#: Time from steering to yawing, s.
LAG_S = 0.12


def read_states(log: Path, dbc: Path, mapping: Path) -> list[VehicleState]:
    """All states of a log; raises ValueError naming the file that says nothing, else OSError."""
    states = [state for step in log_states(load_decoder(dbc, mapping), read_log(log)) for state in step.states]
    if not any(state.valid for state in states):
        why = states[-1].reason if states else "it holds no frames"
        raise ValueError(f"{log}: no valid vehicle state: {why}")
    return states


class Drive(NamedTuple):
    """What the car says, and how it truly turned since the first state, rad."""

    states: list[VehicleState]
    heading_rad: float


class Outcome(msgspec.Struct, kw_only=True):
    """What became of one drive."""

    error_before_deg: float
    error_after_deg: float
    bias_error_dps: float
    bias_std_dps: float
    #: None: never.
    learnt_after_s: float | None


def made_drive(kind: str, seed: int, duration_s: float, bias_rps: float) -> Drive:
    """A drive of `duration_s` without a standstill; decoded frames, with the error of each sensor."""
    rng = np.random.default_rng([seed, list(KINDS).index(kind)])
    time_s = np.arange(0.0, duration_s, STEP_S)
    speed_mps, curvature = _course(kind, rng, time_s)
    yaw_rate_rps = _lagged(speed_mps * curvature)
    said = _sensed(rng, time_s, speed_mps, curvature, yaw_rate_rps, bias_rps)
    states = list(decoded(said))
    first = round(s_from_ns(states[0].stamp_ns) / STEP_S)
    last = round(s_from_ns(states[-1].stamp_ns) / STEP_S)
    return Drive(states, float(np.trapezoid(yaw_rate_rps[first : last + 1], dx=STEP_S)))


def _course(kind: str, rng: np.random.Generator, time_s: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Speed and curvature over time: levels and turns drawn, then smoothed."""
    slowest, fastest, sharpest = KINDS[kind]
    knots = {name: np.arange(0.0, time_s[-1] + 2 * period_s, period_s) for name, period_s in PERIODS_S.items()}
    speeds = rng.uniform(slowest, fastest, len(knots["speed"]))
    turns = rng.choice([0, 0, 0, 1, -1], len(knots["turn"])) * rng.uniform(0.2, 1.0, len(knots["turn"])) * sharpest
    speed_mps = gaussian_filter1d(np.interp(time_s, knots["speed"], speeds), 1.0 / STEP_S, mode="nearest")
    curvature = gaussian_filter1d(np.interp(time_s, knots["turn"], turns), 0.6 / STEP_S, mode="nearest")
    limit = MAX_LATERAL_MPS2 / speed_mps**2
    return speed_mps, np.clip(curvature, -limit, limit)


def _lagged(wanted: np.ndarray) -> np.ndarray:
    """What follows `wanted` with a time constant of `LAG_S`."""
    found = np.zeros_like(wanted)
    for index in range(1, len(wanted)):
        found[index] = found[index - 1] + STEP_S / LAG_S * (wanted[index] - found[index - 1])
    return found


def _sensed(
    rng: np.random.Generator, time_s: np.ndarray, speed_mps: np.ndarray, curvature: np.ndarray,
    yaw_rate_rps: np.ndarray, bias_rps: float,
) -> list[VehicleState]:  # fmt: skip
    """What the sensors of a car with constants of its own measure, not yet in steps."""
    wheelbase_m, ratio = rng.uniform(2.55, 2.85), rng.uniform(13.0, 18.0)
    understeer, track_m = rng.uniform(0.0008, 0.0025), rng.uniform(1.48, 1.62)
    camber_rad = _wander(rng, len(time_s), math.radians(0.8), 20.0)
    steering = ratio * wheelbase_m * curvature * (1.0 + understeer * speed_mps**2)
    steering += camber_rad + math.radians(rng.normal(0.0, 2.0))
    tyres = rng.normal(0.0, 0.003)
    wheels_mps = yaw_rate_rps * track_m * (1.0 + 0.5 * tyres) + tyres * speed_mps
    noise = rng.standard_normal((3, len(time_s))) * np.array([[math.radians(0.1)], [math.radians(0.1)], [0.01]])
    columns = np.stack([speed_mps, yaw_rate_rps + bias_rps + noise[0], steering + noise[1], wheels_mps + noise[2]])
    return [
        VehicleState(
            stamp_ns=ns_from_s(at_s), speed_mps=speed, yaw_rate_rps=rate, steering_rad=angle,
            wheel_speed_difference_mps=difference,
        )
        for at_s, (speed, rate, angle, difference) in zip(time_s.tolist(), columns.T.tolist(), strict=True)
    ]  # fmt: skip


def _wander(rng: np.random.Generator, count: int, std: float, time_s: float) -> np.ndarray:
    """An Ornstein-Uhlenbeck process from zero on."""
    found, share = np.zeros(count), STEP_S / time_s
    for index, draw in enumerate(rng.standard_normal(count - 1), start=1):
        found[index] = (1.0 - share) * found[index - 1] + math.sqrt(2.0 * share) * std * draw
    return found


def decoded(said: Sequence[VehicleState]) -> Iterator[VehicleState]:
    """The valid states that a car's frames give by the DBC with ranges in raw counts."""
    database, mapping = load_dbc(CAN / "raw_ranges.dbc"), load_mapping(CAN / "raw_ranges.yaml")
    car, decoder = SimulatedCar(database, mapping), CanDecoder(database, mapping)
    reporter = StateReporter(decoder, 0)
    for state in said:
        frames = [(frame, decoder.add(*frame[:2], state.stamp_ns)) for frame in car.frames(state)]
        for found in (reporter.frame(judged, state.stamp_ns) for _, judged in frames):
            if found is not None and found.valid:
                yield decoder.state(state.stamp_ns)


def limited(states: Sequence[VehicleState], steering: bool, wheels: bool) -> list[VehicleState]:
    """The states as a car without some of the sensors says them."""
    gone = {**({} if steering else {"steering_rad": 0.0}), **({} if wheels else {"wheel_speed_difference_mps": None})}
    return [msgspec.structs.replace(state, **gone) for state in states]


def run(drive: Drive, bias_rps: float) -> Outcome:
    """One drive through the odometry."""
    odometry, learnt_ns, turned = Odometry(), None, 0.0
    last: VehicleState | None = None
    for state in drive.states:
        odometry.add(state)
        if learnt_ns is None and odometry.yaw_rate_bias.source is not BiasSource.NONE:
            learnt_ns = state.stamp_ns
        if last is not None:
            turned += 0.5 * (last.yaw_rate_rps + state.yaw_rate_rps) * s_from_ns(state.stamp_ns - last.stamp_ns)
        last = state
    assert last is not None
    place, driving = odometry.at(last.stamp_ns), odometry.driving_bias
    assert place is not None
    after = wrap_angle(place.odom_from_vehicle.yaw_rad - drive.heading_rad)
    start_ns = drive.states[0].stamp_ns
    return Outcome(
        error_before_deg=abs(math.degrees(turned - drive.heading_rad)),
        error_after_deg=abs(math.degrees(after)),
        bias_error_dps=math.degrees(driving.rps - bias_rps),
        bias_std_dps=math.degrees(driving.std_rps),
        learnt_after_s=None if learnt_ns is None else s_from_ns(learnt_ns - start_ns),
    )
