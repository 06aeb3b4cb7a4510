"""Bias of the yaw-rate gyroscope: estimated at rest, and while driving from steering and wheel speeds.

Their own constant errors grow with the speed, the bias does not: a drive at several speeds separates them.
"""

from __future__ import annotations

import math
from enum import StrEnum
from typing import NamedTuple

import numpy as np

from msgs.values.units import ns_from_s, s_from_ns
from msgs.values.vehicle import VehicleState

#: States are averaged over blocks of this length; a gap ends a block unused.
_BLOCK_S, _MAX_STEP_S = 0.5, 0.25
#: Range of the models of steering and wheels: forward, no racing, no wheel that spins or locks.
_MIN_SPEED_MPS, _MAX_SPEED_MPS, _MAX_YAW_RATE_RPS = 1.0, 60.0, 1.0
_MAX_LATERAL_MPS2, _MAX_ALONG_MPS2 = 4.0, 3.0
#: Larger steering angles and wheel differences are implausible.
_MAX_STEERING_RAD, _MAX_WHEELS_MPS = 20.0, 10.0
#: Errors of steering and wheels last for several blocks (camber, side wind): so many count as one.
_BLOCKS_PER_ERROR = 4.0
#: An error beyond this many standard deviations counts less.
_OUTLIER = 2.5
#: Blocks over which the size of the errors is estimated.
_ERROR_BLOCKS = 40.0

#: Unknowns: bias [rad/s]; curvature of a steering wheel at zero [1/m]; curvature by steering angle [1/(m rad)];
#: understeer [s^2/m^2]; yaw rate of equal wheel speeds by speed [1/m]; yaw rate by difference of the wheels [1/m].
BIAS, CENTRE, RATIO, UNDERSTEER, TYRES, TRACK = range(6)
#: Passenger cars: steering ratio 12 to 22, wheelbase 2.4 to 3.5 m, track 1.4 to 1.75 m, tyres alike within 0.5 %.
_PRIOR = np.array([0.0, 0.0, 0.024, 0.0015, 0.0, 0.645])
_PRIOR_STD = np.array([math.radians(1.0), 1.2e-3, 0.012, 0.001, 3e-3, 0.1])
#: Random walk of each unknown, per square root of a second. The road's camber moves the straight position of the wheel.
_WALK = np.array([3.6e-5, 9e-5, 1e-4, 0.0, 1.7e-5, 1e-4])
_MAX_UNDERSTEER = 0.01
#: A longer pause counts as one of this length.
_MAX_PAUSE_S = 600.0
#: Standard deviation of a bias learnt at rest: the steps of a gyroscope do not average out completely.
_REST_STD_RPS = math.radians(0.03)


STANDSTILL_SPEED_MPS = 0.05
#: The vehicle is at rest once it has been this slow for so long: a car rocks as it stops.
SETTLE_S = 0.5
#: Time constant of the bias after the first so many seconds, in which it is their plain mean.
BIAS_TIME_S = 10.0
#: A yaw rate at rest beyond this is no bias: a turntable, a ferry.
MAX_BIAS_RPS = 0.05
#: A bias learnt while driving is subtracted once its standard deviation is below this.
MAX_DRIVING_STD_RPS = math.radians(0.3)
#: A bias learnt at rest holds for so long, whatever driving shows.
REST_HOLDS_S = 600.0


class BiasSource(StrEnum):
    """Source of the bias that is subtracted."""

    NONE = "none"
    REST = "standstill"
    DRIVING = "driving"


class BiasEstimate(NamedTuple):
    """The bias that is subtracted from the yaw rate, its source, and the reason for none (empty if there is one)."""

    rps: float
    #: Standard deviation; without a source, that of the prior knowledge.
    std_rps: float
    source: BiasSource
    why: str = ""
    #: Time that the vehicle has driven so far, s.
    driven_s: float = 0.0

    def __str__(self) -> str:
        if self.source is BiasSource.NONE:
            return f"yaw rate bias is not observable: {self.why}"
        bias, std = math.degrees(self.rps), math.degrees(self.std_rps)
        return f"yaw rate bias {bias:.2f} deg/s, standard deviation {std:.2f} deg/s, from {self.source}"


class YawRateBias:
    """Estimator of the bias from vehicle states in order of their stamps; a standstill precedes driving."""

    def __init__(self) -> None:
        self._driving = DrivingBias()
        self._slow_since_ns: int | None = None
        self._rested_s = 0.0
        self._rest_rps = 0.0
        self._last_rest_ns: int | None = None
        self._driven_s = 0.0

    def interrupt(self) -> None:
        """Clear the current block and standstill after missed states; the estimate stays."""
        self._slow_since_ns = None
        self._driving.interrupt()

    def add(self, state: VehicleState, elapsed_s: float) -> None:
        """Take in a valid state, `elapsed_s` after the one before."""
        if abs(state.speed_mps) > STANDSTILL_SPEED_MPS:
            self._slow_since_ns = None
            self._driven_s += elapsed_s
            self._driving.add(state)
            return
        self._driving.interrupt()
        if self._slow_since_ns is None:
            self._slow_since_ns = state.stamp_ns
        if self.rests(state):
            self._rested_s = min(self._rested_s + elapsed_s, BIAS_TIME_S)
            gain = min(elapsed_s / max(self._rested_s, 1e-9), 1.0)
            self._rest_rps += gain * (state.yaw_rate_rps - self._rest_rps)
            self._last_rest_ns = state.stamp_ns
            if self._rested_s > 0.0:
                self._driving.set_bias(self._rest_rps)

    def rests(self, state: VehicleState) -> bool:
        """Return whether the vehicle stands on ground that does not turn."""
        since_ns = self._slow_since_ns
        stands = since_ns is not None and state.stamp_ns - since_ns >= ns_from_s(SETTLE_S)
        return stands and abs(state.yaw_rate_rps) <= MAX_BIAS_RPS

    def corrected(self, state: VehicleState) -> float:
        """Return the yaw rate without bias; none at all while the vehicle rests."""
        return 0.0 if self.rests(state) else state.yaw_rate_rps - self.estimate(state.stamp_ns).rps

    def estimate(self, stamp_ns: int) -> BiasEstimate:
        """Return the bias that is subtracted at a time."""
        driving = self._driving
        is_learnt = driving.std_rps <= MAX_DRIVING_STD_RPS and abs(driving.bias_rps) <= MAX_BIAS_RPS
        if self._rested_s > 0.0 and self._last_rest_ns is not None:
            rest_s = s_from_ns(stamp_ns - self._last_rest_ns)
            if rest_s <= REST_HOLDS_S or not is_learnt:
                return BiasEstimate(self._rest_rps, _REST_STD_RPS, BiasSource.REST, driven_s=self._driven_s)
        if is_learnt:
            return BiasEstimate(driving.bias_rps, driving.std_rps, BiasSource.DRIVING, driven_s=self._driven_s)
        return BiasEstimate(0.0, driving.std_rps, BiasSource.NONE, self._why_not(), self._driven_s)

    @property
    def driving(self) -> BiasEstimate:
        """Bias from driving alone, accurate enough to be subtracted or not."""
        return BiasEstimate(self._driving.bias_rps, self._driving.std_rps, BiasSource.DRIVING, "", self._driven_s)

    def _why_not(self) -> str:
        driving, limit = self._driving, math.degrees(MAX_DRIVING_STD_RPS)
        if self._driven_s == 0.0:
            return "the vehicle has neither stood nor driven yet"
        if not (driving.has_steering or driving.has_wheels):
            return "the vehicle never stood, and neither steering nor wheel speeds are known"
        if driving.std_rps <= MAX_DRIVING_STD_RPS:
            max_bias_deg_s = math.degrees(MAX_BIAS_RPS)
            return f"driving gives {math.degrees(driving.bias_rps):.2f} deg/s, which is beyond {max_bias_deg_s:.2f}"
        return (
            f"the vehicle never stood, and {driving.used_s:.0f} s of driving{self._speeds()} leave a standard "
            f"deviation of {math.degrees(driving.std_rps):.2f} deg/s, more than {limit:.2f}"
        )

    def _speeds(self) -> str:
        slowest_mps, fastest_mps = self._driving.slowest_mps, self._driving.fastest_mps
        return f" at {slowest_mps:.1f} to {fastest_mps:.1f} m/s" if fastest_mps else ""


class _Errors(NamedTuple):
    """Standard deviation of a block's yaw rate by one source: floor, by yaw rate, by its change, by speed [1/m]."""

    floor_rps: float
    of_rate: float
    of_change: float
    of_speed: float

    def variance(self, block: _Block) -> float:
        """Return the variance of the error of a block."""
        turning_rps = math.hypot(self.of_rate * block.yaw_rate_rps, self.of_change * block.yaw_change_rps)
        return self.floor_rps**2 + turning_rps**2 + (self.of_speed * block.speed_mps) ** 2


class _Block(NamedTuple):
    """Means over a block: yaw rate, speed, speed * steering angle, difference of the wheels (None: not known)."""

    yaw_rate_rps: float
    speed_mps: float
    steered: float
    wheels_mps: float | None
    #: From its first state to its last one.
    yaw_change_rps: float
    speed_change_mps: float


class _Source:
    """Fit of the model of one source: the mean square of its errors over the expected one."""

    def __init__(self, errors: _Errors) -> None:
        self._errors = errors
        self._excess = 1.0

    def variance(self, block: _Block) -> float:
        """Return the variance of an error, the many blocks that it lasts for taken into account."""
        return _BLOCKS_PER_ERROR * max(self._excess, 1.0) * self._errors.variance(block)

    def note(self, error_rps: float, block: _Block) -> None:
        """Learn from the error that a block has left."""
        ratio = min(error_rps * error_rps / self._errors.variance(block), 100.0)
        self._excess += (ratio - self._excess) / _ERROR_BLOCKS


class DrivingBias:
    """Extended Kalman filter over the bias and the constants of steering and wheels, fed by blocks of states."""

    def __init__(self) -> None:
        self._mean = _PRIOR.copy()
        self._cov = np.diag(_PRIOR_STD**2)
        self._states: list[VehicleState] = []
        self._walked_ns: int | None = None
        self._steering = _Source(_Errors(math.radians(0.12), 0.08, 0.3, 0.0))
        self._wheels = _Source(_Errors(math.radians(0.12), 0.05, 0.1, 3e-4))
        self.has_steering = self.has_wheels = False
        #: Driving that was used, and its speeds.
        self.used_s, self.slowest_mps, self.fastest_mps = 0.0, math.inf, 0.0

    @property
    def bias_rps(self) -> float:
        """Mean of the bias."""
        return float(self._mean[BIAS])

    @property
    def std_rps(self) -> float:
        """Standard deviation of the bias."""
        return math.sqrt(max(float(self._cov[BIAS, BIAS]), 0.0))

    def interrupt(self) -> None:
        """Leave the block that has begun unused."""
        self._states.clear()

    def set_bias(self, bias_rps: float) -> None:
        """Take the bias from a standstill; the estimates of steering and wheels stay."""
        self._mean[BIAS] = bias_rps
        self._cov[BIAS, :] = self._cov[:, BIAS] = 0.0
        self._cov[BIAS, BIAS] = _REST_STD_RPS**2

    def add(self, state: VehicleState) -> None:
        """Take in a state of a moving vehicle; one beyond the range of the models ends the block unused."""
        if not _is_covered(state):
            self.interrupt()
            return
        # a steering wheel at exactly zero all the time is not measured
        self.has_steering |= state.steering_rad != 0.0
        states = self._states
        if states and not 0.0 < s_from_ns(state.stamp_ns - states[-1].stamp_ns) <= _MAX_STEP_S:
            states.clear()
        states.append(state)
        elapsed_s = s_from_ns(state.stamp_ns - states[0].stamp_ns)
        if elapsed_s >= _BLOCK_S:
            self._walk(state.stamp_ns, elapsed_s)
            self._take(_block_of(states), elapsed_s)
            # the last state of a block is the first of the next one
            del states[:-1]

    def _walk(self, stamp_ns: int, elapsed_s: float) -> None:
        """Let all unknowns walk since the last block; after a clock that was set back, for the length of this one."""
        pause_s = 0.0 if self._walked_ns is None else s_from_ns(stamp_ns - self._walked_ns)
        self._walked_ns = stamp_ns
        self._cov[np.diag_indices(6)] += min(max(pause_s, elapsed_s), _MAX_PAUSE_S) * _WALK**2

    def _take(self, block: _Block, elapsed_s: float) -> None:
        if not _is_usable(block, elapsed_s) or not (self.has_steering or block.wheels_mps is not None):
            return
        self.used_s += elapsed_s
        self.slowest_mps = min(self.slowest_mps, block.speed_mps)
        self.fastest_mps = max(self.fastest_mps, block.speed_mps)
        if self.has_steering:
            self._update(*self._by_steering(block), self._steering, block)
        if block.wheels_mps is not None:
            self.has_wheels = True
            slope = np.array([1.0, 0.0, 0.0, 0.0, block.speed_mps, block.wheels_mps])
            self._update(float(slope @ self._mean), slope, self._wheels, block)

    def _by_steering(self, block: _Block) -> tuple[float, np.ndarray]:
        """Return the yaw rate of the steering with its derivatives; understeer takes from it at speed."""
        bias_rps, centre, ratio, understeer, _, _ = self._mean
        speed_mps, steered = block.speed_mps, block.steered
        grip = 1.0 + understeer * speed_mps**2
        turn_rps = (centre * speed_mps + ratio * steered) / grip
        slope = np.array([1.0, speed_mps / grip, steered / grip, -turn_rps * speed_mps**2 / grip, 0.0, 0.0])
        return bias_rps + turn_rps, slope

    def _update(self, expected_rps: float, slope: np.ndarray, source: _Source, block: _Block) -> None:
        """Update the filter with the measured yaw rate of a block; outliers count less."""
        error_rps = block.yaw_rate_rps - expected_rps
        spread = self._cov @ slope
        prior = float(slope @ spread)
        variance = source.variance(block)
        far = abs(error_rps) / (_OUTLIER * math.sqrt(prior + variance))
        variance *= max(far, 1.0) ** 2
        gain = spread / (prior + variance)
        self._mean = self._mean + gain * error_rps
        self._mean[UNDERSTEER] = min(max(self._mean[UNDERSTEER], 0.0), _MAX_UNDERSTEER)
        # Joseph's form: stays positive definite whatever is rounded
        keep = np.eye(6) - np.outer(gain, slope)
        self._cov = keep @ self._cov @ keep.T + variance * np.outer(gain, gain)
        source.note(error_rps * variance / (prior + variance), block)


def _block_of(states: list[VehicleState]) -> _Block:
    wheels = [state.wheel_speed_difference_mps for state in states]
    measured = [value for value in wheels if value is not None]
    return _Block(
        yaw_rate_rps=_mean([state.yaw_rate_rps for state in states]),
        speed_mps=_mean([state.speed_mps for state in states]),
        steered=_mean([state.speed_mps * state.steering_rad for state in states]),
        wheels_mps=_mean(measured) if len(measured) == len(states) else None,
        yaw_change_rps=states[-1].yaw_rate_rps - states[0].yaw_rate_rps,
        speed_change_mps=states[-1].speed_mps - states[0].speed_mps,
    )


def _mean(values: list[float]) -> float:
    return math.fsum(values) / len(values)


def _is_covered(state: VehicleState) -> bool:
    return (
        _MIN_SPEED_MPS <= state.speed_mps <= _MAX_SPEED_MPS
        and abs(state.yaw_rate_rps) <= _MAX_YAW_RATE_RPS
        and abs(state.steering_rad) <= _MAX_STEERING_RAD
        and abs(state.wheel_speed_difference_mps or 0.0) <= _MAX_WHEELS_MPS
    )


def _is_usable(block: _Block, elapsed_s: float) -> bool:
    """Return whether the vehicle neither slides nor brakes hard."""
    return (
        abs(block.speed_mps * block.yaw_rate_rps) <= _MAX_LATERAL_MPS2
        and abs(block.speed_change_mps) <= _MAX_ALONG_MPS2 * elapsed_s
    )
