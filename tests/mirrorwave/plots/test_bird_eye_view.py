from __future__ import annotations

import math

import msgspec
import numpy as np
import pytest
from matplotlib.axes import Axes
from matplotlib.colors import to_hex
from matplotlib.patches import Polygon

from mirrorwave.plots.bird_eye_view import box_corners_m, draw_bev
from mirrorwave.plots.style import DIRECT_AREA, MIRROR_IMAGE, RECOVERED, SEEN_DIRECTLY, TRACKED, TRUTH
from msgs.values.perception import (
    BevFrame,
    BevGrid,
    HiddenPoint,
    SceneTruth,
    Track,
    TruthObject,
    TruthSurface,
    Visibility,
    Wall,
)
from msgs.values.radar import RangeAzimuthGrid, RangeAzimuthMap
from tests.builders import example_map, example_object, example_truth
from tests.figures import assert_readable_at_page_width, legends_of

PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"


def frame(filled: bool = True) -> BevFrame:
    grid = BevGrid(rows=40, columns=30, cell_m=1.0, y_min_m=-20.0)
    one = example_object(x_m=12.0, y_m=8.0, width_m=1.8, yaw_rad=0.5, cov_m2=((0.2, 0.05), (0.05, 0.1)))
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
    car = {"object_class": "car", "length_m": 4.4, "width_m": 1.8, "yaw_rad": 0.4}
    return example_truth(
        scan_id=5,
        objects=(TruthObject(id=0, x_m=12.0, y_m=8.0, hidden=True, **car), TruthObject(id=1, x_m=9.0, y_m=-3.0, **car)),
        surfaces=(TruthSurface(role="relay", material="brick", polyline_m=((20.0, -9.0), (20.0, 9.0))),),
    )  # fmt: skip


def ra_map() -> RangeAzimuthMap:
    grid = RangeAzimuthGrid(range_bins=64, azimuth_bins=32)
    return example_map(np.ones(grid.shape, np.complex64), scan_id=5, grid=grid, noise_power_mw=0.0)


@pytest.mark.slow
@pytest.mark.parametrize("filled", [True, False])
@pytest.mark.parametrize("with_map", [True, False])
def test_draws_full_and_empty_frames(tmp_path, filled, with_map):
    out = tmp_path / "bev.png"
    draw_bev(frame(filled), out, truth() if filled else None, ra_map() if with_map else None)
    assert out.read_bytes().startswith(PNG_SIGNATURE)


@pytest.mark.slow
def test_equal_frames_give_equal_bytes(tmp_path):
    for name in ("a.png", "b.png"):
        draw_bev(frame(), tmp_path / name)
    assert (tmp_path / "a.png").read_bytes() == (tmp_path / "b.png").read_bytes()


def test_corners_of_a_turned_box():
    box = TruthObject(id=0, object_class="car", x_m=3.0, y_m=4.0, length_m=4.0, width_m=2.0, yaw_rad=math.pi / 2)
    np.testing.assert_allclose(box_corners_m(box), [[2.0, 6.0], [2.0, 2.0], [4.0, 2.0], [4.0, 6.0]], atol=1e-12)


def drawn(saved_figures, tmp_path, *what):
    """The figure of a view, with its panels by their titles."""
    draw_bev(frame(), tmp_path / "a.png", *what)
    return saved_figures[-1], {axes.get_title(): axes for axes in saved_figures[-1].axes}


@pytest.mark.slow
def test_the_legend_has_words_that_a_driver_knows(saved_figures, tmp_path):
    figure, _ = drawn(saved_figures, tmp_path, truth(), ra_map())
    (legend,) = legends_of(figure)
    words = [text.get_text().replace("\n", " ") for text in legend.get_texts()]
    assert words == [
        "area seen directly", "area a mirror shows (echoes of 10 m² or more)", "not seen: unknown",
        "wall, found by the radar", "echo seen directly", "mirror image", "echo of a hidden object, recovered",
        "hidden object (recovered)", "its position, 86 % sure", "true wall", "hidden object (truth)",
        "other object (truth)", "followed object; arrow: its way in 1 s",
    ]  # fmt: skip
    assert_readable_at_page_width(figure)


@pytest.mark.slow
def test_the_title_counts_and_says_conditions_in_words(saved_figures, tmp_path):
    figure, _ = drawn(saved_figures, tmp_path, truth())
    assert figure.get_suptitle().splitlines() == [
        "Scan 5 at 1.500 s: 1 hidden object found, 1 really there",
        "Echoes moved during the scan",
    ]
    figure, _ = drawn(saved_figures, tmp_path)
    assert figure.get_suptitle().splitlines()[0] == "Scan 5 at 1.500 s: 1 hidden object"


@pytest.mark.slow
def test_the_view_is_large_beside_the_map_and_both_axes_have_units(saved_figures, tmp_path):
    figure, panels = drawn(saved_figures, tmp_path, truth(), ra_map())
    view, small = panels["bird's-eye view"], panels["what the radar measures"]
    for axes in (view, small):
        assert (axes.get_xlabel(), axes.get_ylabel()) == ("y, left [m]", "x, forward [m]")
        # left is left, forward is up
        assert axes.get_xlim()[0] > axes.get_xlim()[1]
        assert axes.get_ylim()[0] < axes.get_ylim()[1]
    figure.canvas.draw()
    large = view.get_window_extent()
    assert large.width * large.height > 3.0 * small.get_window_extent().width * small.get_window_extent().height
    # radar, box, image at (28, 8) and wall fill it: nothing is more than 3 m beyond them but the least field
    assert view.get_ylim()[1] <= 31.0


def colours_of(axes: Axes) -> dict[str, str]:
    """Colour of every labelled sign: its edge, or its line."""
    found = {}
    for handle, label in zip(*axes.get_legend_handles_labels(), strict=True):
        colour = handle.get_edgecolor() if hasattr(handle, "get_edgecolor") else handle.get_color()
        found[label.replace("\n", " ")] = to_hex(
            np.atleast_2d(colour)[0][:3] if not isinstance(colour, str) else colour
        )
    return found


@pytest.mark.slow
def test_every_meaning_has_one_colour(saved_figures, tmp_path):
    _, panels = drawn(saved_figures, tmp_path, truth(), ra_map())
    meanings = {
        SEEN_DIRECTLY: ("area seen directly", "echo seen directly"),
        MIRROR_IMAGE: ("area a mirror shows (echoes of 10 m² or more)", "mirror image"),
        RECOVERED: ("echo of a hidden object, recovered", "hidden object (recovered)", "its position, 86 % sure"),
        TRUTH: ("true wall", "hidden object (truth)", "other object (truth)"),
        TRACKED: ("followed object; arrow: its way in 1 s",),
    }
    colours = colours_of(panels["bird's-eye view"])
    for colour, labels in meanings.items():
        assert {colours.pop(label) for label in labels} == {colour.lower()}
    assert not set(colours.values()) & {colour.lower() for colour in meanings}
    # the map's circles and diamonds have the colours of the view
    direct, images = panels["what the radar measures"].collections[1:]
    assert [to_hex(one.get_edgecolor()[0]) for one in (direct, images)] == [SEEN_DIRECTLY.lower(), MIRROR_IMAGE.lower()]


def direct_area(axes: Axes) -> Polygon:
    areas = [one for one in axes.patches if isinstance(one, Polygon) and one.get_path().vertices.size > 4]
    (found,) = [one for one in areas if to_hex(one.get_facecolor()) == DIRECT_AREA.lower()]
    return found


@pytest.mark.slow
def test_direct_sight_stops_at_the_true_wall(saved_figures, tmp_path):
    """The mask calls all cells seen; the true wall stands 20 m ahead, 9 m to either side (24.2 degrees)."""
    _, panels = drawn(saved_figures, tmp_path, truth())
    outline = direct_area(panels["bird's-eye view"]).get_path()
    # as drawn: y, x
    assert outline.contains_point((0.0, 19.9))
    assert not outline.contains_point((0.0, 20.1))
    assert not outline.contains_point((10.0, 25.0))
    assert outline.contains_point((12.0, 25.0))
    # the mask's own cells of direct sight, which go through the wall, are not drawn beside it
    (cells,) = [one for one in panels["bird's-eye view"].collections if one.get_array() is not None][:1]
    assert np.ma.count(cells.get_array()) == 0


def test_without_truth_the_areas_are_those_of_the_view(saved_figures, tmp_path):
    _, panels = drawn(saved_figures, tmp_path)
    (cells,) = [one for one in panels["bird's-eye view"].collections if one.get_array() is not None][:1]
    assert np.unique(cells.get_array().compressed()).tolist() == [Visibility.DIRECT]


def test_a_lone_far_echo_does_not_shrink_the_rest(saved_figures, tmp_path):
    near = frame()
    echoes = np.concatenate([np.tile([[10.0, 1.0]], (99, 1)), [[100.0, 50.0]]]).astype(np.float32)
    draw_bev(msgspec.structs.replace(near, los_points_m=echoes), tmp_path / "a.png")
    assert saved_figures[-1].axes[0].get_ylim()[1] < 35.0
