"""Evidence in the bird's-eye view: what a map shows of a place by a mirror."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import minimize_scalar

from models.perception.mirrors.mirror_table import WallArrays, wall_arrays
from models.perception.see.evidence_predictor import silent_map
from models.perception.see.gathering import BY_MIRROR, BirdsEyeGrid, Evidence, channel_names, gathered, odd_channels
from msgs.values.perception import Wall
from msgs.values.radar import RangeAzimuthMap
from tests.models.perception.see.fields import BINS, GRID

PLANE, MIRRORS = BirdsEyeGrid(), 2
FACADE = Wall(normal=(-1.0, 0.0), offset_m=20.0, ends_m=((20.0, -8.0), (20.0, 9.0)), inliers=9)
HEAT = np.zeros((2, BINS, GRID.azimuth_bins), np.float32)


def echo_at(image_m: np.ndarray) -> RangeAzimuthMap:
    """A map with one strong cell."""
    ra_map = silent_map(GRID)
    row = round(float(GRID.range_index(np.hypot(*image_m))))
    column = round(float(GRID.azimuth_index(np.arctan2(image_m[1], image_m[0]))))
    values = ra_map.values.copy()
    values[row, column] = 1e-4
    return RangeAzimuthMap(**{name: getattr(ra_map, name) for name in ra_map.__struct_fields__} | {"values": values})


def evidence_of(ra_map: RangeAzimuthMap, walls: WallArrays) -> Evidence:
    certainty, nothing = np.ones(len(walls)), np.zeros((0, 2))
    return gathered(PLANE, ra_map, HEAT, walls, certainty, nothing, np.zeros(0, int), MIRRORS)


def loudest_m(evidence: Evidence) -> np.ndarray:
    """The middle of the places whose likeliest mirror shows the echo."""
    level = np.where(evidence.mirror >= 0, evidence.channels[BY_MIRROR.index("level")], 0.0)
    row, column = np.nonzero(level > 0.9 * level.max())
    return np.array([PLANE.x_m[row].mean(), PLANE.y_m[column].mean()])


def test_an_image_stands_for_the_place_that_the_wall_mirrors() -> None:
    """A place at (14, -4) has its image in x = 20 at (26, -4); cells are 0.5 m."""
    evidence = evidence_of(echo_at(np.array([26.0, -4.0])), wall_arrays([FACADE]))
    np.testing.assert_allclose(loudest_m(evidence), [14.0, -4.0], atol=0.75)
    # no other wall stands before it: the gap that its rays come through is as wide as any
    assert set(evidence.channels[BY_MIRROR.index("gap")][evidence.mirror >= 0]) == {1.0}


@pytest.mark.parametrize("curvature_per_m", [0.04, -0.04])
def test_an_arc_mirrors_by_the_shortest_way(curvature_per_m: float) -> None:
    """By Fermat the way from the radar over the arc to a place is an extremum: its length and its direction at the
    radar are those of the image. Found apart from the tangent mirror, by a search along the arc.
    """
    place_m, length_m = np.array([13.0, -3.0]), 17.0
    wall = Wall(
        normal=(-1.0, 0.0),
        offset_m=20.0,
        ends_m=((20.0, -8.0), (20.0, 9.0)),
        inliers=9,
        curvature_per_m=curvature_per_m,
    )

    def on_arc(y_m: float) -> np.ndarray:
        t = y_m - 0.5
        rise = np.sqrt(1.0 - (0.5 * curvature_per_m * length_m) ** 2)
        return np.array([20.0 + (np.sqrt(1.0 - (curvature_per_m * t) ** 2) - rise) / curvature_per_m, y_m])

    def way_m(y_m: float) -> float:
        return float(np.hypot(*on_arc(y_m)) + np.hypot(*(place_m - on_arc(y_m))))

    mirror_m = on_arc(minimize_scalar(way_m, bounds=(-6.0, 7.0), method="bounded").x)
    image_m = way_m(minimize_scalar(way_m, bounds=(-6.0, 7.0), method="bounded").x) * mirror_m / np.hypot(*mirror_m)
    evidence = evidence_of(echo_at(image_m), wall_arrays([wall]))
    np.testing.assert_allclose(loudest_m(evidence), place_m, atol=0.9)


def test_a_wall_in_the_way_takes_the_free_way() -> None:
    """From the mirror at (20, -4.9) to the place at (14.25, -6.25) the way crosses x = 17 at y = -5.6."""
    before = Wall(normal=(-1.0, 0.0), offset_m=17.0, ends_m=((17.0, -10.0), (17.0, -4.0)), inliers=9)
    at = np.abs(PLANE.x_m - 14.25).argmin(), np.abs(PLANE.y_m + 6.25).argmin()
    second = BY_MIRROR.index("second_leg_free")
    free = evidence_of(echo_at(np.array([26.0, -6.0])), wall_arrays([FACADE]))
    blocked = evidence_of(echo_at(np.array([26.0, -6.0])), wall_arrays([FACADE, before]))
    assert free.channels[second][at] == 1.0
    # the wall in the way shows the place itself, before the facade
    assert blocked.mirror[at] == 1
    assert blocked.channels[len(BY_MIRROR) + second][at] == 0.0


def test_mirrors_of_a_place_are_counted_once_for_each_image() -> None:
    """By the facade (14, -4) has its image at (26, -4), by a wall to the right at (14, -16); a wall that lies 0.2 m
    behind the facade is the same mirror. The count is in quarters.
    """
    right = Wall(normal=(0.0, 1.0), offset_m=10.0, ends_m=((2.0, -10.0), (18.0, -10.0)), inliers=9)
    same = Wall(normal=(-1.0, 0.0), offset_m=20.2, ends_m=((20.2, -8.0), (20.2, 9.0)), inliers=9)
    at = np.abs(PLANE.x_m - 14.0).argmin(), np.abs(PLANE.y_m + 4.0).argmin()
    count = channel_names(MIRRORS).index("count")
    for walls, mirrors in (([FACADE], 1), ([FACADE, same], 1), ([FACADE, right], 2), ([same, right, FACADE], 2)):
        evidence = evidence_of(silent_map(GRID), wall_arrays(walls))
        assert evidence.channels[count][at] == mirrors / 4.0, walls


def test_heats_by_all_mirrors_of_a_place_are_added_up_and_ranked() -> None:
    """Of (14.25, -3.75): 0.4 by the facade, whose echo makes it the likeliest, 0.6 to the right, 0.2 to the left."""
    right, left = (
        Wall(
            normal=(0.0, -sign), offset_m=offset_m, ends_m=((2.0, sign * offset_m), (18.0, sign * offset_m)), inliers=9
        )
        for sign, offset_m in ((-1.0, 10.0), (1.0, 8.0))
    )
    x_m, y_m = 14.25, -3.75
    images_m, heats = [(40.0 - x_m, y_m), (x_m, -20.0 - y_m), (x_m, 16.0 - y_m)], [0.4, 0.6, 0.2]
    heat = HEAT.copy()
    for (image_x_m, image_y_m), value in zip(images_m, heats, strict=True):
        row = round(float(GRID.range_index(np.hypot(image_x_m, image_y_m))))
        heat[1, row, round(float(GRID.azimuth_index(np.arctan2(image_y_m, image_x_m))))] = value
    walls, nothing = wall_arrays([FACADE, right, left]), np.zeros((0, 2))
    echo = echo_at(np.array(images_m[0]))
    evidence = gathered(PLANE, echo, heat, walls, np.ones(3), nothing, np.zeros(0, int), MIRRORS)
    row, column = np.abs(PLANE.x_m - x_m).argmin(), np.abs(PLANE.y_m - y_m).argmin()
    found = dict(zip(channel_names(MIRRORS), evidence.channels[:, row, column], strict=True))
    assert (evidence.mirror[row, column], found["count"]) == (0, 0.75)
    assert [found[f"{name}_mirrored"] for name in ("most", "second", "sum")] == pytest.approx([0.6, 0.4, 0.6])
    assert [found[f"mirrored_{k}"] for k in range(MIRRORS)] == pytest.approx([0.4, 0.6])


def test_a_wall_mirrors_beyond_its_end_by_half_a_metre_and_two_deviations() -> None:
    """Straight on 20 m away a direction known to 0.035 rad is a place known to 0.7 m: 1.9 m beyond the end count."""
    valid = BY_MIRROR.index("valid")
    row = np.abs(PLANE.x_m - 12.0).argmin()
    column = np.abs(PLANE.y_m - 0.25).argmin()
    # the ray to the image of (12.25, 0.25) meets the wall at y = 0.18 m
    y_m = 20.0 * PLANE.y_m[column] / (40.0 - PLANE.x_m[row])
    for missed_m, is_seen in ((1.8, True), (2.0, False)):
        first_m = y_m + missed_m
        wall = Wall(normal=(-1.0, 0.0), offset_m=20.0, ends_m=((20.0, first_m), (20.0, first_m + 8.0)), inliers=9)
        evidence = evidence_of(silent_map(GRID), wall_arrays([wall]))
        assert bool(evidence.channels[valid][row, column]) == is_seen


def test_a_mirrored_map_gives_mirrored_evidence() -> None:
    """To the last digit but where rounding puts a place on another cell's border."""
    oblique = Wall(normal=(-0.8, -0.6), offset_m=18.0, ends_m=((22.5, 0.0), (13.5, 12.0)), inliers=9)
    turned = Wall(normal=(-0.8, 0.6), offset_m=18.0, ends_m=((22.5, 0.0), (13.5, -12.0)), inliers=9)
    ra_map = echo_at(np.array([25.0, 6.0]))
    flipped = RangeAzimuthMap(
        **{name: getattr(ra_map, name) for name in ra_map.__struct_fields__} | {"values": ra_map.values[:, ::-1]}
    )
    channels = evidence_of(ra_map, wall_arrays([oblique])).channels
    mirrored = evidence_of(flipped, wall_arrays([turned])).channels[..., ::-1].copy()
    mirrored[odd_channels(MIRRORS)] *= -1.0
    different = np.abs(channels - mirrored).max(axis=0) > 1e-5
    assert different.mean() < 0.005


def test_without_walls_nothing_is_mirrored() -> None:
    evidence = evidence_of(silent_map(GRID), wall_arrays([]))
    assert (evidence.mirror == -1).all()
    assert np.isfinite(evidence.channels).all()
    assert evidence.channels.shape == (len(channel_names(MIRRORS)), *PLANE.shape)
    assert not evidence.channels[: MIRRORS * len(BY_MIRROR)].any()


def test_bad_grids_are_refused() -> None:
    with pytest.raises(ValueError, match=r"grid\.cell_m must be .*positive"):
        BirdsEyeGrid(cell_m=0.0)
    with pytest.raises(ValueError, match=r"x_max_m - grid\.x_min_m must be .*positive"):
        BirdsEyeGrid(x_max_m=1.0)
