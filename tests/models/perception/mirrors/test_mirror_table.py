"""Walls as mirrors of single rays."""

from __future__ import annotations

import math

import numpy as np
import pytest

from models.perception.mirrors.mirror_table import mirrors_met, wall_arrays
from msgs.values.perception import Wall

#: The face x = 20 m, and the circle of 30 m about (-10, 0), hollow towards the radar, between +-30 degrees: its vertex
#: is at (20, 0), its chord at x = 15.98.
FLAT = Wall(normal=(-1.0, 0.0), offset_m=20.0, ends_m=((20.0, -15.0), (20.0, 15.0)), inliers=9, angle_std_rad=0.01)
CHORD_M = -10.0 + 30.0 * math.cos(math.radians(30.0))
ARC = Wall(
    normal=(-1.0, 0.0),
    offset_m=CHORD_M,
    ends_m=((CHORD_M, -15.0), (CHORD_M, 15.0)),
    inliers=9,
    angle_std_rad=0.01,
    curvature_per_m=1.0 / 30.0,
)


@pytest.mark.parametrize("along_rad", [-0.3, 0.0, 0.2])
def test_an_arc_is_its_tangent_where_the_ray_meets_it(along_rad: float) -> None:
    """The tangent at an angle about the centre has its normal towards the centre, and goes through the point met."""
    met_m = np.array([-10.0, 0.0]) + 30.0 * np.array([math.cos(along_rad), math.sin(along_rad)])
    images_m = 1.7 * np.stack([met_m, met_m])
    normal, offset_m = mirrors_met(images_m, np.array([0, 1]), wall_arrays([FLAT, ARC]))
    np.testing.assert_allclose(normal[0], [-1.0, 0.0])
    np.testing.assert_allclose(normal[1], [-math.cos(along_rad), -math.sin(along_rad)], atol=1e-9)
    assert offset_m[0] == pytest.approx(20.0)
    assert normal[1] @ met_m + offset_m[1] == pytest.approx(0.0, abs=1e-9)


def test_a_ray_that_never_meets_an_arc_is_mirrored_by_the_chord() -> None:
    """An arc that bulges away: the circle of 30 m about (46, 0) ends 30 m to the side, the ray passes it at 60 m."""
    hump = Wall(
        normal=(-1.0, 0.0),
        offset_m=20.0,
        ends_m=((20.0, -15.0), (20.0, 15.0)),
        inliers=9,
        angle_std_rad=0.01,
        curvature_per_m=-1.0 / 30.0,
    )
    normal, offset_m = mirrors_met(np.array([[1.0, 40.0]]), np.array([0]), wall_arrays([hump]))
    np.testing.assert_allclose(normal, [[-1.0, 0.0]])
    np.testing.assert_allclose(offset_m, [20.0])
