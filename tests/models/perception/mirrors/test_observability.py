from __future__ import annotations

import math

import numpy as np
import pytest

from models.perception.mirrors.observability import VisibilityParams, observability, sensitivity_db, visibility_at
from models.physics.mirror import blocked, reflect, specular_points
from msgs.values.perception import BevGrid, Visibility
from msgs.values.radar import PRESETS, RadarParams, RadarSetup
from tests.builders import wall_between

GRID = BevGrid()


def seen_at(mask: np.ndarray, x: float, y: float) -> int:
    return int(mask[int((y - GRID.y_min_m) / GRID.cell_m), int((x - GRID.x_min_m) / GRID.cell_m)])


def test_sensitivity_by_hand():
    """1.6 mW = 2.04 dBm; gain (15.05 + 4.1) dB twice; lambda^2 -30.46 dB; (4 pi)^3 32.98 dB: -23.1 dBm at 1 m.
    Noise -74.2 dBm less 60.2 dB for 2^20 samples, plus 1.76 dB of the Hann window: -132.7 dBm. Together 109.5 dB."""
    assert sensitivity_db(RadarSetup()) == pytest.approx(109.5, abs=0.2)


def test_one_way_sensitivity_lacks_the_transmitting_array():
    """77 GHz: lambda^2 -17.7 dB and one transmitting element for 32 columns x rows, -15.05 dB; 57 receiving for 32,
    +2.5 dB: 30.3 dB below X-band, to the 0.01 dB of the carriers' ratio."""
    assert sensitivity_db(RadarSetup()) - sensitivity_db(PRESETS["77ghz"]) == pytest.approx(30.27, abs=0.02)


def test_eight_chirps_are_twelve_decibels_less_than_128():
    few = RadarSetup(radar=RadarParams(chirps_per_beam=8))
    assert sensitivity_db(RadarSetup()) - sensitivity_db(few) == pytest.approx(10.0 * math.log10(16.0))


def test_without_walls_the_field_of_view_is_direct():
    mask = observability([], 110.0, GRID, VisibilityParams())
    assert seen_at(mask, 20.0, 0.0) == Visibility.DIRECT
    assert seen_at(mask, 5.0, 20.0) == Visibility.UNKNOWN  # 76 degrees off
    assert not (mask == Visibility.MIRRORED).any()


def test_facade_shows_what_the_occluder_hides():
    """Facade x = 20, occluder at y = 5: (12, 8) is hidden and seen in the facade, (26, 0) is behind the facade,
    (8, 20) is hidden, and its mirror point y = 12.5 lies past the facade's end."""
    mask = observability(
        [wall_between((20, -10), (20, 10)), wall_between((5, 5), (13, 5))], 110.0, GRID, VisibilityParams()
    )
    assert seen_at(mask, 16.0, 8.0) == Visibility.MIRRORED
    assert seen_at(mask, 26.0, 0.0) == Visibility.UNKNOWN
    assert seen_at(mask, 8.0, 20.0) == Visibility.UNKNOWN
    assert seen_at(mask, 10.0, 0.0) == Visibility.DIRECT


def test_agrees_with_the_forward_law_of_reflection():
    """Every mirrored cell has a specular point on one of the walls."""
    walls = [wall_between((20, -10), (22, 10)), wall_between((4, -6), (18, -7))]
    mask = observability(walls, 110.0, GRID, VisibilityParams())
    cells = GRID.cell_centres_m()[mask == Visibility.MIRRORED]
    assert len(cells) > 100
    points = [specular_points(np.zeros(2), cells, *(np.array(end) for end in one.ends_m)) for one in walls]
    assert (np.isfinite(points[0][:, 0]) | np.isfinite(points[1][:, 0])).all()


def test_reach_follows_the_radar_equation():
    """At boresight the threshold is met up to R = 10^((S + rcs - T) / 40): 40 m for S + rcs - T = 64.1 dB."""
    params = VisibilityParams(rcs_dbsm=0.0, threshold_db=13.0)
    mask = observability([], 13.0 + 40.0 * math.log10(40.0), GRID, params)
    assert seen_at(mask, 39.0, 0.1) == Visibility.DIRECT
    assert seen_at(mask, 41.0, 0.1) == Visibility.UNKNOWN


def test_a_fainter_object_is_seen_in_fewer_cells():
    walls = [wall_between((20, -10), (20, 10)), wall_between((5, 5), (13, 5))]
    counts = [
        int((observability(walls, 75.0, GRID, VisibilityParams(rcs_dbsm=rcs)) == Visibility.MIRRORED).sum())
        for rcs in (20.0, 10.0, 0.0)
    ]
    assert counts[0] > counts[1] > counts[2]


def loss_db(points: np.ndarray) -> np.ndarray:
    """24 dB (a / 80 deg)^2 and R^4 on the way there and back; infinite outside of 60 degrees and 109 m."""
    range_m, azimuth_deg = np.hypot(*points.T), np.degrees(np.arctan2(*points.T[::-1]))
    lost = 24.0 * (azimuth_deg / 80.0) ** 2 + 40.0 * np.log10(np.maximum(range_m, 1.0))
    return np.where((np.abs(azimuth_deg) <= 60.0) & (range_m <= 109.0), lost, np.inf)


@pytest.mark.parametrize("seed", range(6))
def test_mask_is_the_definition_cell_by_cell(seed: int) -> None:
    """Hidden: the ray to the cell is cut by a wall. Mirrored: the image is loud enough, its ray meets the wall between
    the ends, and neither that ray up to the wall nor the rest of the way is cut by another. Cells within a millimetre
    of a wall's line or of the way past an end are anyone's."""
    rng = np.random.default_rng(seed)
    ends = np.array([[[20, -10], [20, 10]], [[5, 5], [13, 5]], [[8, -9], [14, -8]], [[25, 12], [33, 14]]])
    ends = ends + rng.uniform(-2.0, 2.0, ends.shape)
    walls = [wall_between(tuple(a), tuple(b)) for a, b in ends]
    mask = observability(walls, 75.0, GRID, VisibilityParams()).ravel()
    cells = GRID.cell_centres_m().reshape(-1, 2)
    direct = (85.0 - loss_db(cells) >= 13.0) & ~blocked(np.zeros(2), cells, ends[:, 0], ends[:, 1])
    mirrored = np.zeros(len(cells), bool)
    for one, (a, b) in zip(walls, ends, strict=True):
        at = specular_points(np.zeros(2), cells, a, b)
        seen = np.isfinite(at[:, 0])
        others = ends[[other is not one for other in walls]]
        seen &= 79.0 - loss_db(reflect(cells, np.array(one.normal), one.offset_m)) >= 13.0
        seen[seen] &= ~blocked(np.zeros(2), at[seen], others[:, 0], others[:, 1])
        seen[seen] &= ~blocked(at[seen], cells[seen], others[:, 0], others[:, 1])
        mirrored |= seen
    expected = np.where(direct, Visibility.DIRECT, np.where(mirrored, Visibility.MIRRORED, Visibility.UNKNOWN))
    assert all((expected == kind).any() for kind in Visibility)
    assert (mask != expected).sum() <= 2


def test_grids_and_parameters_do_not_mix() -> None:
    """What is laid out once for a grid is not taken for another one, nor for other parameters."""
    small, narrow = BevGrid(rows=20, columns=10), VisibilityParams(azimuth_limit_deg=20.0)
    whole = observability([], 110.0, GRID, VisibilityParams())
    assert observability([], 110.0, small, VisibilityParams()).shape == (20, 10)
    assert (observability([], 110.0, GRID, narrow) == Visibility.DIRECT).sum() < (whole == Visibility.DIRECT).sum() / 2
    np.testing.assert_array_equal(observability([], 110.0, GRID, VisibilityParams()), whole)


def test_a_point_has_the_state_of_its_cell_and_none_off_the_grid() -> None:
    """Cells of 0.5 m from (0, -40) on: (10.2, 3.7) lies in column 20, row 87; the upper edges belong to no cell."""
    mask = np.zeros((GRID.rows, GRID.columns), np.uint8)
    mask[87, 20] = Visibility.MIRRORED
    points_m = np.array([[10.2, 3.7], [10.6, 3.7], [-0.1, 3.7], [10.2, 40.0], [np.nan, 0.0]])
    states = visibility_at(mask, GRID, points_m)
    np.testing.assert_array_equal(states, [Visibility.MIRRORED] + 4 * [Visibility.UNKNOWN])
    assert len(visibility_at(mask, GRID, np.zeros((0, 2)))) == 0
