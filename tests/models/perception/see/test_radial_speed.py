"""Radial speeds of reports: of the loudest cell near the image that has one, with the error of its level."""

from __future__ import annotations

import numpy as np
import pytest

from models.perception.see.detections import Detections
from models.perception.see.radial_speed import radial_speeds
from msgs.values.radar import RangeAzimuthMap, speed_codes
from tests.models.perception.see.networks_by_hand import GRID, empty_map

ROW, COLUMN = 100, 128
NOISE_MW = 1e-12


def report(row: int, column: int) -> Detections:
    one = np.zeros((1, 2))
    return Detections(
        score=np.ones(1),
        place_m=one,
        covariance_m2=np.zeros((1, 2, 2)),
        centre_m=one,
        size_m=one,
        yaw_rad=np.zeros(1),
        object_class=np.zeros(1, int),
        range_m=np.array([row * GRID.range_bin_m]),
        azimuth_rad=GRID.azimuth_rad[[column]],
        away_rad=np.array([2.5]),
    )


def moving(*cells: tuple[int, int, float, float], compensated: bool = True) -> RangeAzimuthMap:
    """A map whose cells (row, column) have an amplitude over the noise and a radial speed (NaN: none)."""
    values, speeds = np.full(GRID.shape, 1e-9, np.complex64), np.full(GRID.shape, np.nan)
    for row, column, level, speed_mps in cells:
        values[row, column], speeds[row, column] = level * np.sqrt(NOISE_MW), speed_mps
    return empty_map(
        values=values,
        noise_power_mw=NOISE_MW,
        radial_speed_cmps=speed_codes(speeds),
        radial_speed_unit_std_mps=8.0,
        ego_compensated=compensated,
    )


@pytest.mark.parametrize(("row", "column"), [(3, 2), (-3, -2), (3, -2), (-3, 2)])
def test_the_speed_is_that_of_the_loudest_cell_within_three_bins_and_two_columns(row: int, column: int) -> None:
    """A cell at the corner of the reach says 5 m/s; louder ones beyond it, and one without a speed, say nothing."""
    ra_map = moving(
        (ROW, COLUMN, 10.0, 1.0),
        (ROW + row, COLUMN + column, 20.0, 5.0),
        (ROW + row + np.sign(row), COLUMN, 40.0, 7.0),
        (ROW, COLUMN + column + np.sign(column), 40.0, 9.0),
        (ROW + 1, COLUMN, 40.0, np.nan),
    )
    (speed,) = radial_speeds(report(ROW, COLUMN), ra_map)
    assert speed is not None
    assert (speed.azimuth_rad, speed.speed_mps) == (2.5, 5.0)
    # 8 m/s at an amplitude of the noise's, a twentieth of it here
    assert speed.std_mps == pytest.approx(0.4)


def test_no_speed_is_surer_than_a_fifth_of_a_metre_per_second() -> None:
    (speed,) = radial_speeds(report(ROW, COLUMN), moving((ROW, COLUMN, 1000.0, -3.0)))
    assert speed is not None
    assert (speed.speed_mps, speed.std_mps) == (-3.0, 0.2)


@pytest.mark.parametrize(("row", "column"), [(0, 0), (511, 255)])
def test_the_reach_ends_at_the_edge_of_the_map(row: int, column: int) -> None:
    """Of the first cell the neighbour at (3, 2) counts, of the last that at (-3, -2): none of the other edge."""
    inward = 1 if row == 0 else -1
    ra_map = moving((row + 3 * inward, column + 2 * inward, 10.0, 4.0), (511 - row, 255 - column, 90.0, 8.0))
    (speed,) = radial_speeds(report(row, column), ra_map)
    assert speed is not None
    assert speed.speed_mps == 4.0


def test_no_speed_is_said_beyond_the_map_nor_over_an_unknown_ground() -> None:
    ra_map = moving((0, COLUMN, 10.0, 4.0))
    assert radial_speeds(report(-4, COLUMN), ra_map) == [None]
    assert radial_speeds(report(0, COLUMN), moving((0, COLUMN, 10.0, 4.0), compensated=False)) == [None]
    assert radial_speeds(report(0, COLUMN), empty_map(ego_compensated=True)) == [None]
