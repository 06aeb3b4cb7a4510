"""Annotated frames in the published layout: the reader of the release must take them, point by point."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from contrib.annotate.annotated_capture import frame_points, mean_map, on_map, write_frame
from contrib.annotate.slice_labels import SliceLabels
from lab.training.data.frames import DataSet
from lab.training.data.xradarnlos import KINDS, REAL_RANGE_M, Kind, import_folder
from msgs.values.perception import PathClass
from msgs.values.radar import RangeAzimuthGrid, RangeAzimuthMap
from tests.builders import example_map

GRID = RangeAzimuthGrid()


def labels() -> SliceLabels:
    """A wall's point in sight, one out of sight, a hidden point with its image, one without, one behind the radar."""
    return SliceLabels(
        points_m=np.array([[20.0, -3.0], [20.0, 12.0], [14.0, 8.0], [5.0, 30.0], [-5.0, 1.0]]),
        visible=np.array([True, False, False, False, True]),
        wall_of_point=np.array([0, 0, -1, -1, -1]),
        walls_m=np.array([[[20.0, -8.0], [20.0, 16.0]]]),
        image_m=np.array([[26.0, 8.0]]),
        image_point=np.array([2]),
        image_wall=np.array([0]),
    )


def bright_map(row: int, column: int, scan_id: int = 0) -> RangeAzimuthMap:
    values = np.full(GRID.shape, 1e-3 + 1e-3j, np.complex64)
    values[row, column] = 1.0j
    return example_map(values, scan_id=scan_id, grid=GRID, noise_power_mw=2e-6)


@pytest.mark.parametrize("kind", KINDS)
def test_what_is_written_is_imported_as_it_was(kind: Kind, tmp_path: Path) -> None:
    """LOS, image and true place come back in the radar's frame to 1e-5 m; a bright cell stays where it was (to one
    bin); the point behind the radar is left out and counted."""
    points = frame_points(labels(), kind)
    assert (len(points.los_m), len(points.wall_m), points.off_map) == (1, 2, 1)
    write_frame(tmp_path / "in" / "street", "frame_000", kind, mean_map([bright_map(120, 40)], kind), points)
    summary = import_folder(tmp_path / "in", tmp_path / "out", kind)
    assert (summary.frames, summary.los_points, summary.mirrored_points, summary.broken) == (1, 1, 1, [])
    frame = DataSet(tmp_path / "out").frame(0)
    grid = frame.ra_map.grid
    row, column = np.unravel_index(np.abs(frame.ra_map.values).argmax(), grid.shape)
    assert grid.range_at(row) == pytest.approx(GRID.range_m[120], abs=GRID.range_bin_m)
    assert column == 40
    found = frame.labels
    xy_m = np.stack([found.range_m * np.cos(found.azimuth_rad), found.range_m * np.sin(found.azimuth_rad)], axis=1)
    assert found.path_class.tolist() == [PathClass.LOS, PathClass.MIRRORED]
    assert xy_m == pytest.approx(np.array([[20.0, -3.0], [26.0, 8.0]]), abs=1e-5)
    assert found.hidden_xy_m[1] == pytest.approx([14.0, 8.0], abs=1e-5)


@pytest.mark.parametrize("kind", KINDS)
def test_a_scene_with_nothing_hidden_is_imported(kind: Kind, tmp_path: Path) -> None:
    empty = SliceLabels(
        *(getattr(labels(), name)[:1] for name in ("points_m", "visible", "wall_of_point", "walls_m")),
        np.zeros((0, 2)), np.zeros(0, int), np.zeros(0, int),
    )  # fmt: skip
    points = frame_points(empty, kind)
    write_frame(tmp_path / "in" / "street", "frame_000", kind, mean_map([bright_map(120, 40)], kind), points)
    summary = import_folder(tmp_path / "in", tmp_path / "out", kind)
    assert (summary.los_points, summary.mirrored_points) == (1, 0)


def test_scans_are_averaged() -> None:
    """Two scans with one bright cell each: half the field (sim), half the power (real, where the cell's place on the
    release's axis is interpolated: the largest within one row of it)."""
    maps = [bright_map(120, 40), bright_map(160, 41, 1)]
    field = mean_map(maps, "sim")
    assert abs(field[120, 40]) == pytest.approx(0.5, rel=2e-3)
    power = mean_map(maps, "real")
    row = int(power[:, 40].argmax())
    assert np.linspace(*REAL_RANGE_M, 512)[row] == pytest.approx(GRID.range_m[120], abs=0.08)
    assert 0.3 < power[row, 40] <= 0.5


def test_the_real_map_begins_at_its_first_range() -> None:
    """A point 3 m away stands on the simulated axis and before the real one; 60 m are beyond the real one."""
    points_m = np.array([[3.0, 0.0], [60.0, 0.0], [10.0, 0.0]])
    assert on_map(points_m, "sim").tolist() == [True, True, True]
    assert on_map(points_m, "real").tolist() == [False, False, True]


def test_a_map_on_another_grid_or_none_is_refused() -> None:
    with pytest.raises(ValueError, match="at least one complete scan"):
        mean_map([], "real")
