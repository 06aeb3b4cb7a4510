"""Columns as detections: units, signs, places, covariances, what is left out, mappings that are refused."""

from __future__ import annotations

import math
from typing import Any

import msgspec
import numpy as np
import pytest

from contrib.imports.detection_columns import DetectionMapping, detections_of, polar_covariance

POLAR: dict[str, Any] = {
    "range": {"column": "r"}, "azimuth": {"column": "a", "unit": "deg"},
    "range_std": {"value": 0.2}, "azimuth_std": {"value": 2.0, "unit": "deg"},
}  # fmt: skip
PLANE: dict[str, Any] = {
    "x": {"column": "x"}, "y": {"column": "y"}, "x_std": {"column": "sx"}, "y_std": {"value": 20.0, "unit": "cm"},
}  # fmt: skip


def mapping(**fields: Any) -> DetectionMapping:
    return msgspec.convert(fields, DetectionMapping)


def columns(**values: list[float]) -> dict[str | int, np.ndarray]:
    return {name: np.array(column, np.float64) for name, column in values.items()}


def test_polar_columns_in_their_units_and_signs() -> None:
    """Clockwise degrees over 0..360, speed positive towards the radar in km/h: all turned into REP-103 and SI."""
    rules = mapping(**(POLAR | {
        "sensor": "rear", "range": {"column": "r", "unit": "km"},
        "azimuth": {"column": "a", "unit": "deg", "negated": True}, "over_ground": True,
        "radial_speed": {"column": "v", "unit": "km/h", "negated": True}, "rcs": {"column": "p"},
        "mounting": {"x_m": -1.0, "yaw_deg": 180.0},
    }))  # fmt: skip
    found, left_out = detections_of(
        columns(r=[0.01, 0.02], a=[90.0, 300.0], v=[36.0, np.nan], p=[3.0, -4.0]), rules, 7, 2
    )
    assert np.allclose(found.range_m, [10.0, 20.0])
    assert np.allclose(np.degrees(found.azimuth_rad), [-90.0, 60.0])
    assert found.radial_speed_mps is not None
    assert found.radial_speed_mps[0] == -10.0
    assert np.isnan(found.radial_speed_mps[1])
    assert np.array_equal(found.rcs_dbsm, [3.0, -4.0])
    assert np.allclose(found.covariance, np.diag([0.04, math.radians(2.0) ** 2]))
    assert (found.stamp_ns, found.scan_id, found.sensor, found.over_ground) == (7, 2, "rear", True)
    assert (found.vehicle_from_radar.x_m, found.vehicle_from_radar.yaw_rad) == (-1.0, math.pi)
    assert found.elevation_rad is None
    assert not left_out


def test_points_of_space_have_range_azimuth_and_elevation() -> None:
    rules = mapping(**PLANE, z={"column": "z"})
    found, _ = detections_of(columns(x=[3.0, 0.0], y=[4.0, -2.0], z=[12.0, 0.0], sx=[0.1, 0.1]), rules, 0, 0)
    assert np.allclose(found.range_m, [13.0, 2.0])
    assert np.allclose(found.azimuth_rad, [math.atan2(4.0, 3.0), -math.pi / 2])
    assert np.allclose(found.elevation_rad, [math.atan2(12.0, 5.0), 0.0])


def test_covariances_of_the_plane_agree_with_drawn_points() -> None:
    """First order: 200 000 points of 0.1 and 0.3 m about (30, 20) m; sampling leaves 1 percent of an entry's scale."""
    rng = np.random.default_rng(5)
    centre_m, stds_m = np.array([30.0, 20.0]), np.array([0.1, 0.3])
    drawn_m = centre_m + stds_m * rng.standard_normal((200_000, 2))
    sampled = np.cov(np.hypot(*drawn_m.T), np.arctan2(drawn_m[:, 1], drawn_m[:, 0]))
    range_m, azimuth_rad = np.hypot(*centre_m)[None], np.arctan2(*centre_m[::-1])[None]
    ours = polar_covariance(range_m, azimuth_rad, stds_m[None] ** 2)[0]
    scale = np.sqrt(np.outer(np.diag(ours), np.diag(ours)))
    assert np.abs((ours - sampled) / scale).max() < 0.01
    found, _ = detections_of(columns(x=[30.0], y=[20.0], sx=[0.1]), mapping(**PLANE), 0, 0)
    assert np.allclose(found.covariance[0], polar_covariance(range_m, azimuth_rad, np.array([[0.01, 0.04]]))[0])


def test_rows_without_a_place_or_an_error_are_left_out_by_reason() -> None:
    rules = mapping(
        **(POLAR | {"range_std": {"column": "s"}}), elevation={"column": "e", "unit": "deg"}, max_range_m=100.0
    )
    rows = {
        "r": [5.0, np.nan, np.inf, -1.0, 0.0, 101.0, 5.0, 5.0, 5.0, 5.0, 100.0],
        "a": [0.0, 0.0, 0.0, 0.0, 0.0, 0.0, np.nan, 0.0, 0.0, 0.0, 0.0],
        "s": [0.1, 0.1, 0.1, 0.1, 0.1, 0.1, 0.1, 0.0, np.nan, 0.1, 0.1],
        "e": [np.nan, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 91.0, 90.0],
    }
    found, left_out = detections_of(columns(**rows), rules, 0, 0)
    assert np.array_equal(found.range_m, [5.0, 100.0])
    assert left_out == {
        "range is no number": 2, "azimuth is no number": 1, "range_std is no number": 1,
        "range is not within 0..100 m": 3, "range_std is not within 1e-9..1e5": 1,
        "elevation is not within +-90 deg": 1,
    }  # fmt: skip


def test_values_beyond_all_radars_are_taken_off_their_detections() -> None:
    rules = mapping(**POLAR, snr={"column": "q"})
    found, left_out = detections_of(columns(r=[5.0, 6.0, 7.0], a=[0.0] * 3, q=[np.inf, 20.0, -1e300]), rules, 0, 0)
    assert np.array_equal(np.isnan(found.snr_db), [True, False, True])
    assert left_out == {"snr is not within -300..300: the value alone": 2}


def test_no_more_than_a_message_holds() -> None:
    found, left_out = detections_of(columns(r=[5.0] * 16386, a=[0.0] * 16386), mapping(**POLAR), 0, 0)
    assert (len(found), left_out) == (16384, {"more than 16384 in a scan": 2})


def test_columns_may_be_numbers_and_scans_empty() -> None:
    rules = mapping(**(POLAR | {"range": {"column": 1}, "azimuth": {"column": 0}}))
    found, _ = detections_of({0: np.zeros(0), 1: np.zeros(0)}, rules, 0, 0)
    assert (len(found), found.covariance.shape) == (0, (0, 2, 2))


@pytest.mark.parametrize(
    ("changes", "rule"),
    [
        ({"azimuth": None}, "a position must be range and azimuth, or x and y; given: range"),
        ({"x": {"column": "x"}}, "given: range, azimuth, x"),
        ({"range_std": None, "azimuth_std": None}, "a standard deviation must be range_std and azimuth_std, or x_std"),
        ({"z": {"column": "z"}}, "elevation must stand beside range and azimuth, z beside x and y"),
        ({"range": {"column": "r", "unit": "feet"}}, "range.unit must be one of m, cm, mm, km, got 'feet'"),
        ({"range": {"column": "r", "value": 1.0}}, "either column or value must be given"),
        ({"range": {}}, "either column or value must be given"),
        ({"range": {"value": float("nan")}}, "value"),
        ({"stamp": {"column": "t", "unit": "min"}}, "stamp.unit must be one of s, ms, us, ns, got 'min'"),
        ({"scan": {"value": 1.0}}, "scan must be a column"),
        ({"table": {"delimiter": ";;"}}, "delimiter must be one character"),
        ({"table": {"skip_lines": -1}}, "skip_lines must be 0..1000000"),
        ({"max_range_m": 0.0}, "max_range_m must be finite and positive"),
        ({"rnge": {"column": "r"}}, "unknown field"),
    ],
)
def test_mappings_that_do_not_fit_are_refused(changes: dict, rule: str) -> None:
    fields = {name: value for name, value in (POLAR | changes).items() if value is not None}
    with pytest.raises(msgspec.ValidationError) as error:
        mapping(**fields)
    assert rule in str(error.value)


def test_a_column_that_is_not_there_is_named() -> None:
    with pytest.raises(ValueError, match=r"azimuth\.column must be one of r, b, got 'a'"):
        detections_of(columns(r=[1.0], b=[1.0]), mapping(**POLAR), 0, 0)
