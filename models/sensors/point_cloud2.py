"""Columns of a ROS `sensor_msgs/PointCloud2`."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection
from typing import Any

import numpy as np

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
