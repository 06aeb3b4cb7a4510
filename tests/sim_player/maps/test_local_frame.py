"""Positions of a map in the radar's frame, against geodesy in closed form."""

from __future__ import annotations

import math

import numpy as np
import pytest

from sim_player.maps.local_frame import MapPose


def test_north_lies_ahead_of_a_radar_that_looks_north_and_east_on_its_right() -> None:
    """At 50 deg a second of latitude is 30.9 m and one of longitude 19.9 m: the ellipsoid's radii of curvature are
    6,372,955.926 m along the meridian and 6,390,702.044 m across it.
    """
    second = 1.0 / 3600.0
    local = MapPose(50.0, 10.0, 0.0).local(np.array([[10.0, 50.0 + second], [10.0 + second, 50.0], [10.0, 50.0]]))
    north_m, east_m = (
        6_372_955.926 * math.radians(second),
        6_390_702.044 * math.cos(math.radians(50.0)) * math.radians(second),
    )
    assert local[0] == pytest.approx([north_m, 0.0], abs=1e-4)
    # a parallel bends towards the pole: east d, north d^2 tan(50 deg) / (2 R) = 37 um
    assert local[1] == pytest.approx([0.0, -east_m], abs=1e-4)
    assert local[2] == pytest.approx([0.0, 0.0], abs=1e-9)


@pytest.mark.parametrize("heading", [0.0, 37.0, 90.0, -120.0, 270.0])
def test_the_heading_turns_the_frame_clockwise(heading: float) -> None:
    """What lies in the heading's direction lies ahead."""
    towards = math.radians(heading)
    ahead, left = ([100.0 * math.sin(turn), 100.0 * math.cos(turn)] for turn in (towards, towards - math.pi / 2.0))
    pose = MapPose(0.0, 0.0, heading, metric=True)
    assert pose.local(np.array([ahead, left])) == pytest.approx(np.array([[100.0, 0.0], [0.0, 100.0]]), abs=1e-9)


@pytest.mark.parametrize("latitude", [0.0, 48.0, -70.0])
def test_distances_are_those_on_the_ellipsoid(latitude: float) -> None:
    """1 km along the meridian: the plane shortens it by d^3 / (6 R^2) = 4 um, and 1 um is rounding of degrees."""
    local = MapPose(latitude, 30.0, 0.0).local(np.array([[30.0, latitude + 1.0 / 111.0]]))
    # arc of the meridian by Simpson's rule over its radius of curvature
    e2, a = 6.69437999014e-3, 6_378_137.0
    points = np.radians(np.linspace(latitude, latitude + 1.0 / 111.0, 3))
    radius = a * (1.0 - e2) / (1.0 - e2 * np.sin(points) ** 2) ** 1.5
    arc_m = (points[2] - points[0]) / 6.0 * (radius @ [1.0, 4.0, 1.0])
    assert local[0, 0] == pytest.approx(arc_m - arc_m**3 / 6.0 / 6.37e6**2, abs=2e-6)


def test_the_date_line_is_no_border() -> None:
    local = MapPose(0.0, 179.9999, 90.0).local(np.array([[-179.9999, 0.0]]))
    assert local[0] == pytest.approx([6_378_137.0 * math.radians(0.0002), 0.0], abs=1e-6)


@pytest.mark.parametrize(
    ("pose", "line"),
    [
        ((91.0, 0.0, 0.0), "latitude must be within 89.9 deg, got 91.0"),
        ((0.0, 181.0, 0.0), "longitude must be -180..180 deg, got 181.0"),
        ((0.0, 0.0, 400.0), "--heading must be -360..360"),
        ((0.0, 0.0, math.nan), "must be finite"),
    ],
)
def test_a_pose_that_is_none_is_refused(pose: tuple[float, float, float], line: str) -> None:
    with pytest.raises(ValueError, match=line):
        MapPose(*pose)
