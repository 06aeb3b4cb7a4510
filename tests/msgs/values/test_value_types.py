"""Known numbers of the specification, and what the value types refuse."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from msgs.values.frames import Pose2, polar_from_xy, wrap_angle, xy_from_polar
from msgs.values.perception import BevGrid, Peaks, Wall
from msgs.values.radar import (
    ArrayParams,
    BeamGrid,
    ElementPattern,
    RadarBeam,
    RadarParams,
    RadarSetup,
    RangeAzimuthGrid,
    RangeAzimuthMap,
    mps_from_speed_codes,
    speed_codes,
)
from msgs.values.units import db_from_ratio, ns_from_s, ratio_from_db, s_from_ns
from msgs.values.vehicle import ego_motion

METRES = st.floats(-200.0, 200.0)
ANGLES = st.floats(-3.1, 3.1)


def test_table_1_numbers() -> None:
    """Table 1 and the figures derived from it; tolerance: the digits that the specification prints."""
    radar = RadarParams()
    assert radar.chirp_period_s == pytest.approx(5.461e-6, rel=1e-4)
    assert radar.chirp_slope_hz_per_s == pytest.approx(1.2817e14, rel=1e-4)
    assert radar.range_bin_m == pytest.approx(0.21414, rel=1e-4)
    assert 511 * radar.range_bin_m == pytest.approx(109.42, abs=0.005)
    assert radar.chirps_per_beam * radar.samples_per_chirp == 2**20
    assert radar.beam_duration_s == pytest.approx(0.70e-3, rel=2e-3)
    assert radar.wavelength_m / (2 * radar.beam_duration_s) == pytest.approx(21.4, abs=0.1)
    assert db_from_ratio(radar.noise_power_mw) == pytest.approx(-74.2, abs=0.05)
    assert math.degrees(0.886 * radar.wavelength_m / (8 * radar.wavelength_m / 2)) == pytest.approx(12.7, abs=0.05)


def test_a_scan_is_100_mib() -> None:
    radar, beams = RadarParams(), BeamGrid()
    assert len(beams) * radar.chirps_per_beam * radar.samples_per_chirp * 2 * 2 == 100 * 2**20
    assert RadarSetup().beam_interval_ns == 12_000_000


def test_grids() -> None:
    grid, beams = RangeAzimuthGrid(), BeamGrid()
    assert beams.azimuth_deg[0] == -60.0
    assert beams.azimuth_deg[-1] == 60.0
    assert len(beams) == 25
    assert grid.shape == (512, 256)
    assert grid.range_m[-1] == pytest.approx(109.42, abs=0.005)
    assert np.degrees(grid.azimuth_rad[[0, -1]]) == pytest.approx([-60.0, 60.0])
    index = np.arange(256)
    np.testing.assert_allclose(grid.azimuth_index(grid.azimuth_at(index)), index, atol=1e-9)
    np.testing.assert_allclose(grid.range_index(grid.range_m), np.arange(512), atol=1e-9)


@given(METRES, METRES, ANGLES, METRES, METRES, ANGLES)
def test_poses_compose_and_invert(x: float, y: float, yaw: float, u: float, v: float, turn: float) -> None:
    """Composition equals applying twice, the inverse undoes; tolerance: rounding at 400 m."""
    outer_from_middle, middle_from_inner = Pose2(x, y, yaw), Pose2(u, v, turn)
    points_m = np.array([[1.0, 2.0], [-30.0, 4.0]])
    there_m = (outer_from_middle @ middle_from_inner).apply(points_m)
    np.testing.assert_allclose(there_m, outer_from_middle.apply(middle_from_inner.apply(points_m)), atol=1e-9)
    np.testing.assert_allclose(
        outer_from_middle.inverse().apply(outer_from_middle.apply(points_m)), points_m, atol=1e-9
    )


@given(st.floats(-1e6, 1e6))
def test_wrapped_angle_is_the_same_angle_in_range(angle: float) -> None:
    wrapped = wrap_angle(angle)
    assert -math.pi < wrapped <= math.pi
    assert math.cos(wrapped - angle) == pytest.approx(1.0, abs=1e-9)


@given(st.floats(0.1, 110.0), st.floats(-1.5, 1.5))
def test_polar_round_trip(range_m: float, azimuth_rad: float) -> None:
    back_range_m, back_azimuth_rad = polar_from_xy(xy_from_polar(np.array(range_m), np.array(azimuth_rad)))
    assert back_range_m == pytest.approx(range_m, rel=1e-12)
    assert back_azimuth_rad == pytest.approx(azimuth_rad, abs=1e-12)


def test_units() -> None:
    assert ratio_from_db(3.0103) == pytest.approx(2.0, rel=1e-5)
    assert db_from_ratio(0.0) == -math.inf
    assert s_from_ns(ns_from_s(0.3)) == 0.3
    with pytest.raises(ValueError, match="power ratio"):
        db_from_ratio(-1.0)


def beam(**changes: object) -> RadarBeam:
    fields = {
        "stamp_ns": 0, "scan_id": 0, "beam_index": 0, "beam_count": 25, "azimuth_rad": 0.0,
        "samples": np.zeros((1, 8, 2), "<i2"), "full_scale_dbm": -20.0,
    }  # fmt: skip
    return RadarBeam(**{**fields, **changes})  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("change", "rule"),
    [
        ({"samples": np.zeros((1, 8, 2), "<f4")}, "beam.samples must have dtype <i2, got <f4"),
        ({"samples": np.zeros((1, 8), "<i2")}, "beam.samples must have shape"),
        ({"samples": [1, 2]}, "beam.samples must be an array"),
        ({"beam_index": 25}, "beam.beam_index must be 0..beam_count-1, got 25 of 25"),
    ],
)
def test_beam_refuses(change: dict, rule: str) -> None:
    with pytest.raises(ValueError, match=rule.replace(".", r"\.")):
        beam(**change)


@pytest.mark.parametrize(
    ("make", "rule"),
    [
        (lambda: RadarParams(carrier_hz=0.0), "radar.carrier_hz must lie in"),
        (lambda: RadarParams(bandwidth_hz=2e10), "radar.bandwidth_hz must be below twice radar.carrier_hz"),
        (lambda: RadarParams(chirps_per_beam=0), "radar.chirps_per_beam"),
        (lambda: ArrayParams(phase_bits=17), "array.phase_bits must be 0..16, got 17"),
        (lambda: BeamGrid(azimuth_deg=()), "at least one beam"),
        (lambda: BeamGrid(azimuth_deg=(95.0,)), "inside -90..90"),
        (lambda: RangeAzimuthGrid(range_bins=0), "grid.range_bins must be 1..8192, got 0"),
        (lambda: RadarSetup(beat_sign=0), "setup.beat_sign must be"),
        (lambda: RadarSetup(steering_weights=np.ones((3, 8), "<c8")), "setup.steering_weights must have shape 25x8"),
        (lambda: Wall(normal=(1.0, 1.0), offset_m=0.0, ends_m=((0, 0), (1, 1)), inliers=2), "length 1"),
        (lambda: BevGrid(rows=0), "bev_grid.rows"),
        # found by the fuzz of the nodes: what follows of these overflows, or takes all memory
        (lambda: ElementPattern(azimuth_hpbw_deg=5e-324), "element.azimuth_hpbw_deg must lie in 0.001..inf"),
        (lambda: BeamGrid(azimuth_deg=(0.0,) * 1025), "at most 1024 beams, got 1025"),
    ],
)
def test_parameters_refuse(make, rule: str) -> None:
    with pytest.raises(ValueError, match=rule.replace(".", r"\.")):
        make()


def test_map_and_peaks_refuse_what_is_not_finite_or_not_theirs() -> None:
    grid = RangeAzimuthGrid(range_bins=4, azimuth_bins=3)
    fields = {
        "stamp_ns": 0, "scan_id": 0, "grid": grid, "values": np.zeros((4, 3), "<c8"),
        "azimuth_stamp_ns": np.zeros(3, "<i8"), "noise_power_mw": 1e-9, "incoherent": np.zeros(4, bool),
    }  # fmt: skip
    RangeAzimuthMap(**fields)
    with pytest.raises(ValueError, match="mode"):
        RangeAzimuthMap(**{**fields, "mode": "magic"})
    none = np.zeros(0)
    with pytest.raises(ValueError, match=r"peaks\.azimuth_rad must have shape 0"):
        Peaks(
            stamp_ns=0, scan_id=0, range_m=none, azimuth_rad=np.zeros(1), score=none, path_class=none.astype("u1"),
            covariance=np.zeros((0, 2, 2)), peak_stamp_ns=none.astype("<i8"), snr_db=none,
        )  # fmt: skip


def test_peaks_are_taken_with_all_their_columns() -> None:
    count = np.arange(3.0)
    peaks = Peaks(
        stamp_ns=0, scan_id=0, range_m=count, azimuth_rad=count, score=0.5 * count, path_class=np.zeros(3, np.uint8),
        covariance=np.zeros((3, 2, 2)), peak_stamp_ns=np.zeros(3, np.int64), snr_db=count, radial_speed_mps=count,
    )  # fmt: skip
    assert peaks.take(np.array([2, 0])).radial_speed_mps.tolist() == [2.0, 0.0]  # type: ignore[union-attr]
    masked = peaks.take(count > 0.5)
    assert (masked.range_m.tolist(), masked.radial_speed_std_mps) == ([1.0, 2.0], None)


def test_radial_speeds_are_whole_centimetres_a_second() -> None:
    """Beyond int16 the nearest, and its least number alone is none."""
    codes = speed_codes(np.array([1.234, -1.236, 400.0, -400.0, np.nan]))
    assert codes.tolist() == [123, -124, 32767, -32767, -32768]
    np.testing.assert_allclose(mps_from_speed_codes(codes), [1.23, -1.24, 327.67, -327.67, np.nan])


@pytest.mark.parametrize(
    ("turns", "x_m", "y_m", "yaw_rad"),
    [(0.25, 10.0, 10.0, 0.5 * math.pi), (-0.75, -10.0, -10.0, 0.5 * math.pi), (1.25, 10.0, 10.0, 0.5 * math.pi)],
)
def test_a_vehicle_drives_circles_and_heads_along_them(turns: float, x_m: float, y_m: float, yaw_rad: float) -> None:
    """A circle of 10 m radius, to the left or, where the turns are negative, to the right."""
    pose = ego_motion(10.0, math.copysign(1.0, turns), 2.0 * math.pi * abs(turns))
    assert (pose.x_m, pose.y_m, pose.yaw_rad) == pytest.approx((x_m, y_m, yaw_rad), abs=1e-9)
