"""Every number of every message: what no sensor gives is refused when a message is made and when it is read."""

from __future__ import annotations

import math
from enum import Enum
from typing import Annotated, Any, get_args, get_origin, get_type_hints

import msgspec
import numpy as np
import pytest

from msgs.bus.codec import CodecError, decode_inline, encode_inline
from msgs.bus.topics import TOPICS
from msgs.values.arrays import Array
from msgs.values.lidar import PointField
from tests.side_sensors import jpeg

#: Where NaN says "not measured", infinity "no limit".
LEGAL = {
    **dict.fromkeys(
        (
            "Peaks.radial_speed_mps", "Peaks.radial_speed_std_mps", "RadarDetections.elevation_rad",
            "RadarDetections.elevation_std_rad", "RadarDetections.radial_speed_mps",
            "RadarDetections.radial_speed_std_mps", "RadarDetections.rcs_dbsm", "RadarDetections.snr_db",
        ),
        (math.nan,),
    ),
    **dict.fromkeys(("ElementPattern.azimuth_hpbw_deg", "ElementPattern.elevation_hpbw_deg"), (math.inf, 1e300)),
}  # fmt: skip
#: Fields whose numbers may be negative.
SIGNED = {
    "BeamGrid.azimuth_deg", "BevFrame.los_points_m", "BevFrame.visibility_rcs_dbsm", "BevGrid.x_min_m",
    "BevGrid.y_min_m", "ElementPattern.peak_gain_dbi", "ElementPattern.sidelobe_floor_db", "HiddenObject.centre_m",
    "GnssPose.heading_deg", "GnssPose.latitude_deg", "GnssPose.longitude_deg", "HiddenObject.x_m",
    "HiddenObject.y_m", "HiddenObject.yaw_rad", "HiddenPoint.image_x_m", "HiddenPoint.image_y_m", "HiddenPoint.wall",
    "HiddenPoint.x_m",
    "HiddenPoint.y_m", "Peaks.azimuth_rad", "Peaks.radial_speed_mps", "Peaks.sensitivity_db", "Peaks.snr_db",
    "Pose2.x_m", "Pose2.y_m", "Pose2.yaw_rad", "PriorWall.ends_m", "RadarBeam.azimuth_rad", "RadarBeam.full_scale_dbm",
    "RadarDetections.azimuth_rad", "RadarDetections.elevation_rad", "RadarDetections.radial_speed_mps",
    "RadarDetections.rcs_dbsm", "RadarDetections.snr_db", "RadarParams.noise_figure_db", "RadarSetup.background",
    "RadarSetup.beat_sign", "RadarSetup.full_scale_dbm", "RadarSetup.radar_height_m", "RadarSetup.steering_weights",
    "RadialSpeed.azimuth_rad", "RadialSpeed.speed_mps", "RangeAzimuthMap.values", "SceneTruth.hidden_object",
    "SceneTruth.hidden_points_m", "SceneTruth.los_points_m", "SceneTruth.mirrored_points_m",
    "SensorLimits.threshold_db", "Track.velocity_x_mps", "Track.velocity_y_mps", "Track.x_m", "Track.y_m",
    "TruthObject.velocity_x_mps", "TruthObject.velocity_y_mps", "TruthObject.x_m", "TruthObject.y_m",
    "TruthObject.yaw_rad", "TruthSurface.polyline_m", "VehicleState.speed_mps", "VehicleState.steering_rad",
    "VehicleState.wheel_speed_difference_mps", "VehicleState.yaw_rate_rps", "Wall.curvature_per_m", "Wall.ends_m",
    "Wall.normal", "Wall.offset_m",
}  # fmt: skip
#: Codes of which every one means something.
CODES = {
    "RadarBeam.samples", "RangeAzimuthMap.radial_speed_cmps", "PhotonHistograms.counts", "LidarPoints.data",
    "CameraImage.jpeg",
}  # fmt: skip
#: What no rule of a single field tells.
GIVEN: dict[str, dict[str, Any]] = {
    "Wall": {"normal": (-1.0, 0.0)},
    "PriorWall": {"ends_m": ((1.0, 0.0), (5.0, 0.0))},
    "WallPriors": {"source": "map"},
    "RadarBeam": {"beam_count": 2},
    "CameraImage": {"width_px": 32, "height_px": 16, "jpeg": np.frombuffer(jpeg(32, 16), np.uint8)},
    "PointField": {"datatype": "float32"},
    "LidarPoints": {
        "fields": tuple(PointField(name=name, offset=4 * k, datatype="float32") for k, name in enumerate("xyz")),
        "data": np.zeros((2, 12), np.uint8),
    },
}


def options(hint: Any) -> list[Any]:
    return [option for option in get_args(hint) if option is not type(None)]


def plain(hint: Any, message: type, done: dict[str, Any]) -> Any:
    """Return a value that a type allows: the least."""
    rules = options(hint)[1:] if get_origin(hint) is Annotated else []
    for rule in rules:
        if isinstance(rule, Array):
            return np.zeros([length(step, done) for step in rule.shape], rule.dtype)
        if isinstance(rule, msgspec.Meta):
            return max(rule.ge or 0, 0) or (rule.le if rule.gt is not None else 0)
    if get_origin(hint) is tuple:
        return () if Ellipsis in get_args(hint) else tuple(plain(option, message, done) for option in options(hint))
    if isinstance(hint, type) and issubclass(hint, msgspec.Struct):
        return made(hint)
    if isinstance(hint, type) and issubclass(hint, Enum):
        return next(iter(hint))
    return {int: 0, float: 1.0, str: "a"}.get(hint)


def length(step: int | str | None, done: dict[str, Any]) -> int:
    if not isinstance(step, str):
        return 2 if step is None else step
    name, _, inner = step.partition(".")
    return getattr(done[name], inner) if inner else len(done[name])


def made(kind: type[msgspec.Struct]) -> msgspec.Struct:
    hints, done = get_type_hints(kind, include_extras=True), {}
    for field in msgspec.structs.fields(kind):
        default = field.default if field.default is not msgspec.NODEFAULT else plain(hints[field.name], kind, done)
        done[field.name] = GIVEN.get(kind.__name__, {}).get(field.name, default)
    return kind(**done)


def spoiled(hint: Any, bad: float, message: Any) -> list[Any]:
    """Return the values of a type with a bad number in each place that has one."""
    if get_origin(hint) is Annotated:
        rule = next((rule for rule in options(hint)[1:] if isinstance(rule, Array)), None)
        return spoiled(options(hint)[0], bad, message) if rule is None else spoiled_arrays(rule, bad, message)
    if type(None) in get_args(hint):
        return [value for option in options(hint) for value in spoiled(option, bad, message)]
    if get_origin(hint) is tuple:
        if Ellipsis in get_args(hint):
            return [(value,) for value in spoiled(options(hint)[0], bad, message)]
        whole = plain(hint, type(message), {})
        return [
            (*whole[:index], value, *whole[index + 1 :])
            for index, option in enumerate(options(hint))
            for value in spoiled(option, bad, message)
        ]
    if hint is int:
        return [int(min(max(bad, -(2.0**63)), 2.0**63))] if bad == bad and abs(bad) < math.inf else []
    return [bad] if hint is float else []


def spoiled_arrays(rule: Array, bad: float, message: Any) -> list[Any]:
    done = {name: getattr(message, name) for name in message.__struct_fields__}
    array = np.zeros([length(step, done) for step in rule.shape], rule.dtype)
    if array.dtype.kind in "bV" or (array.dtype.kind in "iu" and not abs(bad) < math.inf):
        return []
    ends = np.iinfo(array.dtype) if array.dtype.kind in "iu" else None
    if ends is not None and bad < 0 and ends.min == 0:
        return []
    with np.errstate(over="ignore"):
        array.flat[-1] = bad if ends is None else min(max(int(bad), ends.min), ends.max)
    return [array]


def kinds() -> list[type[msgspec.Struct]]:
    """Return all types that travel."""
    found: list[Any] = []
    waiting: list[Any] = [topic.type for topic in TOPICS.values()]
    while waiting:
        kind = waiting.pop()
        if isinstance(kind, type) and issubclass(kind, msgspec.Struct) and kind not in found:
            found.append(kind)
            waiting += get_type_hints(kind).values()
        waiting += get_args(kind)
    return sorted(found, key=lambda kind: kind.__name__)


FIELDS = [(kind, field) for kind in kinds() for field in kind.__struct_fields__]


def read(kind: type[msgspec.Struct], field: str, value: Any) -> None:
    """Read a message as another program may write it, with one value changed."""
    body = msgspec.msgpack.decode(encode_inline(made(kind)))
    if isinstance(value, np.ndarray):
        value = {"dtype": value.dtype.str, "shape": value.shape, "data": value.tobytes()}
    decode_inline(kind, msgspec.msgpack.encode({**body, field: value}))


@pytest.mark.parametrize("kind", kinds(), ids=lambda kind: kind.__name__)
def test_what_no_sensor_gives_is_refused(kind: type[msgspec.Struct]) -> None:
    message, hints, known = made(kind), get_type_hints(kind, include_extras=True), []
    whole = "pose" if kind.__name__ == "Pose2" else ""
    read(kind, kind.__struct_fields__[0], getattr(message, kind.__struct_fields__[0]))
    for field in kind.__struct_fields__:
        name = f"{kind.__name__}.{field}"
        # a stamp may be of before the clock of this host began
        is_signed = name in SIGNED or field.endswith("stamp_ns")
        bad = [math.nan, math.inf, -math.inf, 1e300, -1e300, *([] if is_signed else [-1.0])]
        for number in bad:
            if name in CODES or number in LEGAL.get(name, ()):
                continue
            for value in spoiled(hints[field], number, message):
                known.append(name)
                with pytest.raises(ValueError, match=whole or field):
                    msgspec.structs.replace(message, **{field: value})
                with pytest.raises(CodecError, match=whole or field):
                    read(kind, field, value)
    for name in LEGAL:
        if name.startswith(f"{kind.__name__}."):
            field = name.partition(".")[2]
            (value,) = spoiled(hints[field], LEGAL[name][0], message)
            msgspec.structs.replace(message, **{field: value})
    assert set(known) >= {name for name in SIGNED if name.startswith(f"{kind.__name__}.")}
