"""The lines of `objects.jsonl`: the fields of the contract, plain numbers."""

from __future__ import annotations

import json

from mirrorwave.convert.result_lines import bev_to_json
from msgs.values.perception import HiddenObject, HiddenPoint, Wall
from tests.builders import example_view

WALL = Wall(normal=(0.0, -1.0), offset_m=5.0, ends_m=((4.0, 5.0), (24.0, 5.0)), inliers=9)
OBJECT = HiddenObject(
    id=4, stamp_ns=11, x_m=15.0, y_m=9.0, length_m=2.0, width_m=1.0, yaw_rad=0.3, score=0.7,
    cov_m2=((0.2, 0.01), (0.01, 0.1)),
)  # fmt: skip


def test_json_line_has_the_fields_of_the_contract() -> None:
    point = HiddenPoint(x_m=0.1, y_m=2.0, score=0.5, image_x_m=3.0, image_y_m=4.0, wall=0)
    frame = example_view(stamp_ns=12, scan_id=3, walls=(WALL,), points=(point,), objects=(OBJECT,))
    line = bev_to_json(frame)
    assert json.loads(json.dumps(line, allow_nan=False)) == line
    assert set(line) == {"scan_id", "stamp_ns", "frame", "walls", "points", "objects"}
    assert line["walls"] == [
        {"normal": [0.0, -1.0], "offset_m": 5.0, "ends_m": [[4.0, 5.0], [24.0, 5.0]], "inliers": 9}
    ]
    assert line["points"] == [{"x_m": 0.1, "y_m": 2.0, "score": 0.5}]
    assert line["objects"] == [
        {
            "id": 4, "stamp_ns": 11, "x_m": 15.0, "y_m": 9.0, "centre_m": None, "length_m": 2.0, "width_m": 1.0,
            "yaw_rad": 0.3, "score": 0.7,
            "cov_m2": [[0.2, 0.01], [0.01, 0.1]], "object_class": "", "radial_speed": None,
        }
    ]  # fmt: skip
