from __future__ import annotations

import math

import numpy as np
import pytest

from mirrorwave.bev_picture import box_corners_m, draw_bev
from msgs.perception import (
    BevFrame,
    BevGrid,
    HiddenObject,
    HiddenPoint,
    SceneTruth,
    Track,
    TruthObject,
    TruthSurface,
    Wall,
)
from msgs.radar import RangeAzimuthGrid, RangeAzimuthMap

PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"


def frame(filled: bool = True) -> BevFrame:
    grid = BevGrid(rows=40, columns=30, cell_m=1.0, y_min_m=-20.0)
    one = HiddenObject(
        id=0, x_m=12.0, y_m=8.0, length_m=4.0, width_m=1.8, yaw_rad=0.5, score=0.9, cov_m2=((0.2, 0.05), (0.05, 0.1))
    )
    moving = Track(
        id=3, x_m=12.0, y_m=8.0, velocity_x_mps=0.5, velocity_y_mps=-3.0, age_s=1.2,
        cov_m2=((0.1, 0.0), (0.0, 0.1)), time_to_appear_s=2.5,
    )  # fmt: skip
    return BevFrame(
        stamp_ns=1_500_000_000, scan_id=5, grid=grid, visibility=np.full((40, 30), 1 if filled else 0, np.uint8),
        walls=(Wall(normal=(-1.0, 0.0), offset_m=20.0, ends_m=((20.0, -9.0), (20.0, 9.0)), inliers=9),) * filled,
        points=(HiddenPoint(x_m=12.0, y_m=8.0, score=0.9, image_x_m=28.0, image_y_m=8.0, wall=0),) * filled,
        objects=(one,) * filled, tracks=(moving,) * filled,
        los_points_m=np.ones((4 * filled, 2), np.float32), flags=("incoherent",) * filled,
    )  # fmt: skip


def truth() -> SceneTruth:
    empty = np.zeros((0, 3), np.float32)
    car = {"object_class": "car", "length_m": 4.4, "width_m": 1.8, "yaw_rad": 0.4}
    return SceneTruth(
        stamp_ns=0, scan_id=5, los_points_m=empty, mirrored_points_m=empty, hidden_points_m=empty,
        hidden_object=np.zeros(0, np.int32),
        objects=(TruthObject(id=0, x_m=12.0, y_m=8.0, hidden=True, **car), TruthObject(id=1, x_m=9.0, y_m=-3.0, **car)),
        surfaces=(TruthSurface(role="relay", material="brick", polyline_m=((20.0, -9.0), (20.0, 9.0))),),
    )  # fmt: skip


def ra_map() -> RangeAzimuthMap:
    grid = RangeAzimuthGrid(range_bins=64, azimuth_bins=32)
    return RangeAzimuthMap(
        stamp_ns=0, scan_id=5, grid=grid, values=np.ones(grid.shape, np.complex64),
        azimuth_stamp_ns=np.zeros(32, np.int64), noise_power_mw=0.0, incoherent=np.zeros(64, bool),
    )  # fmt: skip


@pytest.mark.parametrize("filled", [True, False])
@pytest.mark.parametrize("with_map", [True, False])
def test_draws_full_and_empty_frames(tmp_path, filled, with_map):
    out = tmp_path / "bev.png"
    draw_bev(frame(filled), out, truth() if filled else None, ra_map() if with_map else None)
    assert out.read_bytes().startswith(PNG_SIGNATURE)


def test_equal_frames_give_equal_bytes(tmp_path):
    for name in ("a.png", "b.png"):
        draw_bev(frame(), tmp_path / name)
    assert (tmp_path / "a.png").read_bytes() == (tmp_path / "b.png").read_bytes()


def test_corners_of_a_turned_box():
    box = TruthObject(id=0, object_class="car", x_m=3.0, y_m=4.0, length_m=4.0, width_m=2.0, yaw_rad=math.pi / 2)
    np.testing.assert_allclose(box_corners_m(box), [[2.0, 6.0], [2.0, 2.0], [4.0, 2.0], [4.0, 6.0]], atol=1e-12)
