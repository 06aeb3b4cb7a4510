"""Target lists of radars of the ARS 408 kind, CAN frame by CAN frame: a status, one a target, one for its quality.

Pure: a frame is an id, bytes and a stamp; time is only what the caller says it is. The layout is that of
`launch/can/target_radar.dbc`. Ids of sensor N are 16 N higher.
"""

from __future__ import annotations

import math
from collections import Counter
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import msgspec
import numpy as np

from contrib.imports.detection_columns import polar_covariance
from msgs.values.arrays import require_within
from msgs.values.detections import RadarDetections
from msgs.values.frames import Mounting, polar_from_xy
from msgs.values.units import ns_from_s

if TYPE_CHECKING:
    from cantools.database import Database
    from cantools.database.can import Message

#: Bits of an id that hold the sensor's.
_SENSOR_BITS, _SENSOR_STEP = 0x70, 0x10
#: Codes of standard deviations: at most 5 mm times this to the code; the last code is invalid.
_STD_FIRST, _STD_RATIO, _STD_INVALID = 0.005, 2000.0 ** (1.0 / 30.0), 31
#: Steps of distances [m] and speeds [m/s] in a frame: a value lies anywhere within its step.
_DISTANCE_STEP_M, _SPEED_STEP_MPS = 0.2, 0.25
#: A target nearer than this has no direction.
_LEAST_RANGE_M = 0.15
#: Counters that go on by more than this began anew.
_MAX_MISSED = 1000
#: States that are no detections. A cluster that the sensor calls a mirror image (6) is what this program looks for.
CLUSTER_REFUSED = {1: "low RCS", 2: "near-field artefact", 3: "far cluster not confirmed near",
                    7: "outside the field of view", 14: "harmonic"}  # fmt: skip
OBJECT_REFUSED = {0: "deleted", 3: "predicted, not measured", 4: "deleted by a merge"}


#: A measurement that lasts longer is published as it is: cycles last 60 to 100 ms.
MEASUREMENT_TIMEOUT_S = 0.2
#: Errors of targets without a quality frame: those of the sensor's data sheet.
RANGE_STD_M = 0.4
AZIMUTH_STD_DEG = 1.0


class TargetListParams(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Sensor, its list and its place on the vehicle."""

    #: Id that the sensor is set to.
    sensor_id: int = 0
    kind: Literal["clusters", "objects"] = "clusters"
    mounting: Mounting = Mounting()
    #: The sensor's lateral distance is positive to the left; false where it is built in the other way up.
    left_positive: bool = True

    def __post_init__(self) -> None:
        require_within("sensor_id", 0, 7, self.sensor_id)


class _Layout(NamedTuple):
    """Names in the DBC of what one kind of list is made of."""

    status: str
    general: str
    quality: str
    counts: tuple[str, ...]
    state: str
    refused: dict[int, str]


_LAYOUTS = {
    "clusters": _Layout("CLUSTER_STATUS", "CLUSTER_GENERAL", "CLUSTER_QUALITY", ("NEAR_COUNT", "FAR_COUNT"),
                        "VALIDITY", CLUSTER_REFUSED),
    "objects": _Layout("OBJECT_STATUS", "OBJECT_GENERAL", "OBJECT_QUALITY", ("COUNT",), "MEASUREMENT_STATE",
                       OBJECT_REFUSED),
}  # fmt: skip


class _Measurement:
    """A measurement whose frames arrive: its targets and their qualities by id."""

    def __init__(self, stamp_ns: int, announced: int) -> None:
        self.stamp_ns, self.announced = stamp_ns, announced
        self.targets: dict[int, dict[str, Any]] = {}
        self.qualities: dict[int, dict[str, Any]] = {}


class TargetListReader:
    """Collects the frames of one sensor into detections: a measurement ends when all that it announced has arrived,
    when the next one begins, or after a timeout.

    Whether quality frames follow is taken from the measurement before. Raises `ValueError` for a DBC without a message
    or signal of the layout.
    """

    def __init__(self, database: Database, params: TargetListParams, sensor: str = "") -> None:
        self._params, self._sensor = params, sensor
        self._layout = _LAYOUTS[params.kind]
        self._messages = {message.frame_id: message for message in database.messages}
        _require_signals(self._messages, self._layout)
        self._open: _Measurement | None = None
        self._sends_quality: bool | None = None
        self._counter: int | None = None
        self._scan_id = -1
        #: Frames that were passed over, by reason.
        self.refused: Counter[str] = Counter()
        #: Targets that arrived and are no detections, by reason.
        self.left_out: Counter[str] = Counter()
        #: Targets that were announced and did not arrive, and measurements between two counters.
        self.lost = self.missed = 0
        #: Frames of other sensors, by their id.
        self.strangers: Counter[int] = Counter()

    def add(self, arbitration_id: int, data: bytes, stamp_ns: int) -> list[RadarDetections]:
        """Take a frame with an id of 11 bits; returns the measurements that it ends, at most two."""
        message = self._messages.get(arbitration_id & ~_SENSOR_BITS)
        if message is None:
            return []
        sensor_id = (arbitration_id & _SENSOR_BITS) // _SENSOR_STEP
        if sensor_id != self._params.sensor_id:
            self.strangers[sensor_id] += 1
        elif message.name not in self._layout:
            self.refused[f"{message.name}: the list is to be of {self._params.kind}"] += 1
        elif len(data) < message.length:
            self.refused[f"{message.name}: shorter than {message.length} bytes"] += 1
        else:
            return self._take(message, data, stamp_ns)
        return []

    def tick(self, now_ns: int) -> list[RadarDetections]:
        """Return the open measurement if its time is over."""
        limit_ns = ns_from_s(MEASUREMENT_TIMEOUT_S)
        return self._end() if self._open is not None and now_ns - self._open.stamp_ns > limit_ns else []

    def _take(self, message: Message, data: bytes, stamp_ns: int) -> list[RadarDetections]:
        values: dict[str, Any] = message.decode(data[: message.length], decode_choices=False)  # type: ignore[assignment]
        ended: list[RadarDetections] = []
        if message.name == self._layout.status:
            ended = self._end()
            self._begin(values, stamp_ns)
        elif self._counter is None:
            # heard from the middle of a measurement on
            return []
        elif message.name == self._layout.general:
            ended = self._add_target(values)
        else:
            self._add_quality(values)
        return [*ended, *self._end()] if self._is_whole() else ended

    def _begin(self, status: dict[str, Any], stamp_ns: int) -> None:
        counter = int(status["MEASUREMENT_COUNTER"])
        step = 1 if self._counter is None else (counter - self._counter) % (1 << 16)
        if not 1 <= step <= _MAX_MISSED:
            step = 1
        self.missed += step - 1
        self._counter = counter
        self._scan_id += step
        self._open = _Measurement(stamp_ns, sum(int(status[name]) for name in self._layout.counts))

    def _add_target(self, values: dict[str, Any]) -> list[RadarDetections]:
        """Take a target; one of the next measurement, whose status is lost, ends the open one."""
        number, name = int(values["ID"]), self._layout.general
        if self._open is None:
            self.refused[f"{name}: no measurement is open"] += 1
        elif number in self._open.targets or self._open.qualities:
            reason = "an id twice" if number in self._open.targets else "after the qualities"
            self.refused[f"{name}: {reason} in a measurement"] += 1
            return self._end()
        elif len(self._open.targets) >= self._open.announced:
            self.refused[f"{name}: more than announced"] += 1
        else:
            self._open.targets[number] = values
        return []

    def _add_quality(self, values: dict[str, Any]) -> None:
        number = int(values["ID"])
        if self._open is None:
            # none was expected: the next measurement waits for them
            self._sends_quality = True
            self.refused[f"{self._layout.quality}: no measurement is open"] += 1
        elif number not in self._open.targets:
            self.refused[f"{self._layout.quality}: of no target"] += 1
        else:
            self._open.qualities[number] = values

    def _is_whole(self) -> bool:
        if self._open is None or len(self._open.targets) < self._open.announced:
            return False
        if self._sends_quality is None:
            # of the first measurement only the next one's status tells
            return self._open.announced == 0 or len(self._open.qualities) == self._open.announced
        return not self._sends_quality or len(self._open.qualities) == self._open.announced

    def _end(self) -> list[RadarDetections]:
        if self._open is None:
            return []
        ended, self._open = self._open, None
        if ended.targets:
            self._sends_quality = bool(ended.qualities)
        lost = max(0, ended.announced - len(ended.targets))
        self.lost += lost
        return [self._detections(ended, lost)]

    def _detections(self, ended: _Measurement, lost: int) -> RadarDetections:
        rows = []
        for number, target in ended.targets.items():
            quality = ended.qualities.get(number)
            reason = self._layout.refused.get(int(quality[self._layout.state])) if quality else None
            if reason is None and math.hypot(*_position_m(target)) < _LEAST_RANGE_M:
                reason = "at the sensor"
            if reason is None:
                rows.append(_Row(target, quality))
            else:
                self.left_out[reason] += 1
        return _as_detections(rows, self._params, msgspec.structs.replace(
            _NOTHING, stamp_ns=ended.stamp_ns, scan_id=self._scan_id, sensor=self._sensor, lost=lost,
        ))  # fmt: skip


class _Row(NamedTuple):
    target: dict[str, Any]
    quality: dict[str, Any] | None


_NOTHING = RadarDetections(
    stamp_ns=0, scan_id=0, range_m=np.zeros(0), azimuth_rad=np.zeros(0), covariance=np.zeros((0, 2, 2))
)


def std_of_code(code: int) -> float:
    """Return the upper bound of a standard deviation [m or m/s] of a code 0..30; NaN for 31, which is invalid."""
    return math.nan if code >= _STD_INVALID else _STD_FIRST * _STD_RATIO**code


def _position_m(target: dict[str, Any]) -> tuple[float, float]:
    return float(target["DISTANCE_LONGITUDINAL"]), float(target["DISTANCE_LATERAL"])


def _as_detections(rows: list[_Row], params: TargetListParams, head: RadarDetections) -> RadarDetections:
    sign = np.array([1.0, 1.0 if params.left_positive else -1.0])
    position_m = np.array([_position_m(row.target) for row in rows]).reshape(-1, 2) * sign
    velocity_mps = np.array([_pair(row.target, "SPEED") for row in rows]).reshape(-1, 2) * sign
    range_m, azimuth_rad = polar_from_xy(position_m)
    direction = position_m / range_m[:, None]
    speed_variance = _variances(rows, "SPEED", _SPEED_STEP_MPS)
    return msgspec.structs.replace(
        head,
        range_m=range_m,
        azimuth_rad=azimuth_rad,
        covariance=_covariance(rows, range_m, azimuth_rad),
        radial_speed_mps=(velocity_mps * direction).sum(axis=-1),
        radial_speed_std_mps=np.sqrt((speed_variance * direction**2).sum(axis=-1)),
        rcs_dbsm=np.array([float(row.target["RCS"]) for row in rows]),
        vehicle_from_radar=params.mounting.vehicle_from_radar,
    )


def _covariance(rows: list[_Row], range_m: np.ndarray, azimuth_rad: np.ndarray) -> np.ndarray:
    """Return polar covariances [N, 2, 2] of the codes; of the data sheet where a target has no valid ones."""
    plane = polar_covariance(range_m, azimuth_rad, _variances(rows, "DISTANCE", _DISTANCE_STEP_M))
    fallback = np.diag([RANGE_STD_M**2, math.radians(AZIMUTH_STD_DEG) ** 2])
    return np.where(np.isfinite(plane).all(axis=(1, 2))[:, None, None], plane, fallback)


def _variances(rows: list[_Row], quantity: str, step: float) -> np.ndarray:
    """Return variances [N, 2] along and across, with that of a uniform error within the frame's step."""
    codes = [_pair(row.quality, quantity, "_STD") if row.quality else (_STD_INVALID, _STD_INVALID) for row in rows]
    stds = np.array([[std_of_code(int(code)) for code in pair] for pair in codes]).reshape(-1, 2)
    return np.asarray(stds**2 + step**2 / 12.0)


def _pair(values: dict[str, Any], quantity: str, end: str = "") -> tuple[float, float]:
    return float(values[f"{quantity}_LONGITUDINAL{end}"]), float(values[f"{quantity}_LATERAL{end}"])


def _require_signals(messages: dict[int, Message], layout: _Layout) -> None:
    pairs = [f"{quantity}_{side}" for quantity in ("DISTANCE", "SPEED") for side in ("LONGITUDINAL", "LATERAL")]
    wanted = {
        layout.status: ("MEASUREMENT_COUNTER", *layout.counts),
        layout.general: ("ID", "RCS", *pairs),
        layout.quality: ("ID", layout.state, *(f"{name}_STD" for name in pairs)),
    }
    by_name = {message.name: message for message in messages.values()}
    for name, signals in wanted.items():
        if name not in by_name:
            raise ValueError(f"the DBC has no message {name!r}")
        known = {signal.name for signal in by_name[name].signals}
        if absent := [signal for signal in signals if signal not in known]:
            raise ValueError(f"{name}: the DBC has no signal {absent[0]!r}")
