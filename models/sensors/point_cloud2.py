"""Columns of a ROS `sensor_msgs/PointCloud2`."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

#: Types of `sensor_msgs/PointField`, by number.
_TYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}


def cloud_columns(cloud: Any) -> dict[str | int, np.ndarray]:
    """Return the fields of a cloud as float64 [points], without those of several values a point.

    Raises `ValueError` for fields that lie outside a point or have an unknown type, and for data that are too short.
    """
    order = ">" if cloud.is_bigendian else "<"
    fields = [field for field in cloud.fields if field.count == 1]
    for field in fields:
        size = np.dtype(_TYPES[field.datatype]).itemsize if field.datatype in _TYPES else cloud.point_step + 1
        if field.offset + size > cloud.point_step:
            raise ValueError(f"field {field.name!r} of type {field.datatype} at {field.offset} does not fit into "
                             f"points of {cloud.point_step} bytes")  # fmt: skip
    names = _unique([field.name for field in fields])
    kinds = [order + _TYPES[field.datatype] for field in fields]
    offsets = [field.offset for field in fields]
    dtype = np.dtype({"names": names, "formats": kinds, "offsets": offsets, "itemsize": cloud.point_step})
    points = _points(cloud, dtype)
    return {name: points[name].astype(np.float64) for name in names}


def _unique(names: Sequence[str]) -> list[str]:
    if len(set(names)) != len(names) or not all(names):
        raise ValueError(f"fields must have different names, got {', '.join(map(repr, names))}")
    return list(names)


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
