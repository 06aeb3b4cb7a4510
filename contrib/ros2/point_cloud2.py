"""A ROS `sensor_msgs/PointCloud2` as columns of numbers, and as the cloud of a LiDAR with all its fields."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from typing import Any

import msgspec
import numpy as np

from msgs.values.arrays import require_within
from msgs.values.frames import Pose2
from msgs.values.lidar import MAX_CLOUD_BYTES, MAX_NAME_LENGTH, POINT_TYPES, LidarPoints, PointField

#: Types of `sensor_msgs/PointField`, by number; 9 to 11 are those of newer drivers.
_TYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8", 9: "i8", 10: "u8", 11: "?"}


def cloud_columns(cloud: Any, wanted: Collection[str | int]) -> dict[str | int, np.ndarray]:
    """Return the fields of a cloud as float64 [points], without padding and those of several values a point.

    Raises `ValueError` for wanted fields that lie outside a point, have an unknown type or the name of another, and for
    data that are too short; such fields are left out where nobody asks for them.
    """
    order = ">" if cloud.is_bigendian else "<"
    # writers of PCL leave the count of a single value at 0
    fields = [field for field in cloud.fields if field.count in (0, 1) and field.name]
    names = Counter(field.name for field in fields)
    sound = []
    for field in fields:
        if fault := _fault(field, cloud.point_step, names[field.name]):
            if field.name in wanted:
                raise ValueError(fault)
        else:
            sound.append(field)
    layout: Any = {
        "names": [field.name for field in sound],
        "formats": [order + _TYPES[field.datatype] for field in sound],
        "offsets": [field.offset for field in sound],
        "itemsize": cloud.point_step,
    }
    points = _points(cloud, np.dtype(layout))
    return {field.name: points[field.name].astype(np.float64) for field in sound}


class LidarMounting(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Place of a LiDAR on the vehicle: forward, left, turned left, and over the ground."""

    x_m: float = 0.0
    y_m: float = 0.0
    yaw_deg: float = 0.0
    height_m: float = 1.8

    def __post_init__(self) -> None:
        require_within("mounting.height_m", 0.0, 100.0, self.height_m)
        require_within("mounting.x_m and y_m", -100.0, 100.0, self.x_m, self.y_m)
        require_within("mounting.yaw_deg", -360.0, 360.0, self.yaw_deg)

    @property
    def vehicle_from_lidar(self) -> Pose2:
        """The mounting as a transform."""
        return Pose2(self.x_m, self.y_m, math.radians(self.yaw_deg))


#: The same for the fields of a `LidarPoints`; a flag is a byte.
DATATYPES = {number: {"?": "uint8"}.get(kind) or np.dtype(kind).name for number, kind in _TYPES.items()}
NUMBERS = {name: number for number, name in reversed(DATATYPES.items())}


def lidar_points(cloud: Any, stamp_ns: int, scan_id: int, mounting: LidarMounting) -> LidarPoints:
    """Return a cloud with all its fields, byte for byte; those of a big-endian sender turned round.

    Raises `ValueError` for data that are too short, more than `MAX_CLOUD_BYTES`, no point, and fields of unknown type,
    outside a point, with the name of another, or without x, y, z.
    """
    size = cloud.width * cloud.height * cloud.point_step
    if size > MAX_CLOUD_BYTES:
        shape = f"{cloud.height} x {cloud.width} points of {cloud.point_step} bytes"
        raise ValueError(f"cloud must have at most {MAX_CLOUD_BYTES} bytes, got {shape}")
    if not size:
        raise ValueError(f"cloud must hold a point, got {cloud.height} x {cloud.width} of {cloud.point_step} bytes")
    for field in cloud.fields:
        if field.datatype not in _TYPES:
            place = f"field {field.name!r} of type {field.datatype} at {field.offset}"
            raise ValueError(f"{place} must be of type {min(_TYPES)}..{max(_TYPES)}")
    # writers of PCL name what fills a point up "_" or nothing, and leave the count of a single value at 0
    fields = tuple(
        PointField(
            name=field.name, offset=field.offset, datatype=DATATYPES[field.datatype], count=max(field.count, 1)
        )
        for field in cloud.fields
        if field.name not in ("", "_")
    )  # fmt: skip
    data = _points(cloud, np.dtype((np.void, cloud.point_step))).view(np.uint8).reshape(-1, cloud.point_step)
    data = data.copy() if cloud.is_bigendian else data
    points = LidarPoints(
        stamp_ns=stamp_ns, scan_id=scan_id, sensor=cloud.header.frame_id[:MAX_NAME_LENGTH], fields=fields, data=data,
        rows=cloud.height, vehicle_from_lidar=mounting.vehicle_from_lidar, lidar_height_m=mounting.height_m,
    )  # fmt: skip
    if cloud.is_bigendian:
        _turn_round(data, fields)
    return points


def columns_cloud(columns: Mapping[str, np.ndarray]) -> tuple[tuple[PointField, ...], np.ndarray]:
    """Return fields and data [points, bytes] of a cloud of columns of numbers [points], in their order and types."""
    if not columns:
        raise ValueError("cloud must have fields x, y and z, has none")
    kinds = {name: column.dtype.newbyteorder("<") for name, column in columns.items()}
    known = {np.dtype(kind): name for name, kind in POINT_TYPES.items()}
    for name, kind in kinds.items():
        if kind not in known:
            raise ValueError(f"{name} must be numbers of type {', '.join(POINT_TYPES)}, got {kind}")
    table = np.empty(len(next(iter(columns.values()))), list(kinds.items()))
    for name, column in columns.items():
        table[name] = column
    offsets = {name: table.dtype.fields[name][1] for name in kinds} if table.dtype.fields else {}
    fields = tuple(PointField(name=name, offset=offsets[name], datatype=known[kinds[name]]) for name in kinds)
    return fields, table.view(np.uint8).reshape(len(table), table.itemsize)


def _turn_round(data: np.ndarray, fields: Sequence[PointField]) -> None:
    """Turn the bytes of every value round, in place; fields may share bytes, which are turned once."""
    turned: set[int] = set()
    for field in fields:
        size = np.dtype(POINT_TYPES[field.datatype]).itemsize
        for start in range(field.offset, field.end, size):
            if size > 1 and start not in turned:
                turned.add(start)
                data[:, start : start + size] = data[:, start : start + size][:, ::-1]


def _fault(field: Any, point_step: int, same_name: int) -> str:
    """Return why a field cannot be read; empty if it can."""
    place = f"field {field.name!r} of type {field.datatype} at {field.offset}"
    if same_name > 1:
        return f"{place} must have a name of its own, {same_name} have it"
    if field.datatype not in _TYPES:
        return f"{place} must be of type {min(_TYPES)}..{max(_TYPES)}"
    fits = 0 <= field.offset <= point_step - np.dtype(_TYPES[field.datatype]).itemsize
    return "" if fits else f"{place} does not fit into points of {point_step} bytes"


def _points(cloud: Any, dtype: np.dtype) -> np.ndarray:
    """Return all points in order; rows may be longer than their points."""
    data = np.asarray(cloud.data, np.uint8)
    used = cloud.width * cloud.point_step
    if used and cloud.row_step < used and cloud.height > 1:
        raise ValueError(f"row_step must be at least {used} bytes, got {cloud.row_step}")
    step = max(cloud.row_step, used)
    wanted = step * (cloud.height - 1) + used if cloud.height else 0
    if len(data) < wanted:
        raise ValueError(f"data must hold {wanted} bytes for {cloud.height} x {cloud.width} points, got {len(data)}")
    if not wanted:
        return np.zeros(0, dtype)
    rows = np.lib.stride_tricks.as_strided(data[:wanted], (cloud.height, used), (step, 1), writeable=False)
    return np.frombuffer(rows.tobytes(), dtype)
