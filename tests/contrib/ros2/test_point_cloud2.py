"""Clouds of ROS as columns: types, byte order, rows with rests, fields that do not fit."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from contrib.ros2.point_cloud2 import cloud_columns


def field(name: str, offset: int, datatype: int, count: int = 1) -> SimpleNamespace:
    return SimpleNamespace(name=name, offset=offset, datatype=datatype, count=count)


def cloud(**changes: Any) -> SimpleNamespace:
    """Two rows of two points: x float32 at 0, a gap, a speed int16 at 6; rows end with 3 bytes of nothing."""
    order = ">" if changes.get("is_bigendian") else "<"
    layout = np.dtype({"names": ["x", "v"], "formats": [order + "f4", order + "i2"], "offsets": [0, 6], "itemsize": 8})
    points = np.zeros(4, layout)
    points["x"], points["v"] = [1.5, -2.5, 3.0, 4.0], [-1, 2, -3, 4]
    data = points[:2].tobytes() + b"abc" + points[2:].tobytes()
    fields = [field("x", 0, 7), field("v", 6, 3), field("spare", 4, 2, count=2)]
    values: dict[str, Any] = {"height": 2, "width": 2, "point_step": 8, "row_step": 19, "is_bigendian": False}
    return SimpleNamespace(**(values | {"fields": fields, "data": np.frombuffer(data, np.uint8)} | changes))


@pytest.mark.parametrize("is_bigendian", [False, True])
def test_fields_are_read_where_they_lie(is_bigendian: bool) -> None:
    found = cloud_columns(cloud(is_bigendian=is_bigendian), ("x",))
    assert {name: column.tolist() for name, column in found.items()} == {
        "x": [1.5, -2.5, 3.0, 4.0], "v": [-1.0, 2.0, -3.0, 4.0],
    }  # fmt: skip


def test_an_empty_cloud_has_empty_columns() -> None:
    found = cloud_columns(cloud(width=0, height=1, data=np.zeros(0, np.uint8), row_step=0), ("x",))
    assert {name: column.shape for name, column in found.items()} == {"x": (0,), "v": (0,)}


@pytest.mark.parametrize(
    "other",
    [
        [field("t", 0, 10)], [field("ok", 7, 11)], [field("_", 4, 2), field("_", 5, 2)], [field("", 4, 2)],
        [field("far", 8, 7)], [field("odd", 0, 99)], [field("x2", 0, 7, count=0)], [field("big", 0, 7, count=1 << 31)],
    ],
    ids=["uint64", "bool", "padding", "unnamed", "outside", "unknown", "count of 0", "many"],
)  # fmt: skip
def test_fields_that_nobody_wants_are_no_hindrance(other: list[SimpleNamespace]) -> None:
    found = cloud_columns(cloud(fields=[field("x", 0, 7), *other]), ("x", "v"))
    assert found["x"].tolist() == [1.5, -2.5, 3.0, 4.0]
    assert not {"_", "", "far", "odd", "big"} & found.keys()


def test_whole_numbers_of_64_bits_and_flags() -> None:
    layout = np.dtype({"names": ["i", "u", "b"], "formats": ["<i8", "<u8", "?"], "offsets": [0, 8, 16], "itemsize": 17})
    points = np.array([(-5, 1 << 40, True), (6, 7, False)], layout)
    fields = [field("i", 0, 9), field("u", 8, 10), field("b", 16, 11)]
    changes = {"height": 1, "point_step": 17, "row_step": 34, "fields": fields}
    found = cloud_columns(cloud(data=np.frombuffer(points.tobytes(), np.uint8), **changes), tuple("iub"))
    assert {name: column.tolist() for name, column in found.items()} == {
        "i": [-5.0, 6.0], "u": [2.0**40, 7.0], "b": [1.0, 0.0],
    }  # fmt: skip


@pytest.mark.parametrize(
    ("changes", "rule"),
    [
        ({"fields": [field("x", 6, 7)]}, "field 'x' of type 7 at 6 does not fit into points of 8 bytes"),
        ({"fields": [field("x", 0, 12)]}, "field 'x' of type 12 at 0 must be of type 1..11"),
        (
            {"fields": [field("x", 0, 7), field("x", 4, 7)]},
            "field 'x' of type 7 at 0 must have a name of its own, 2 have it",
        ),
        ({"data": np.zeros(34, np.uint8)}, "data must hold 35 bytes for 2 x 2 points, got 34"),
        ({"width": 1 << 31, "row_step": 1 << 34}, "data must hold"),
        ({"row_step": 15}, "row_step must be at least 16 bytes, got 15"),
    ],
)
def test_clouds_that_contradict_themselves_are_refused(changes: dict, rule: str) -> None:
    with pytest.raises(ValueError, match=rule):
        cloud_columns(cloud(**changes), ("x",))
