"""The published layout, written by hand: a known cell and its point must meet again on our grid."""

from __future__ import annotations

import hashlib
import json
from contextlib import nullcontext
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from lab.evaluate.method_runs import truth_of_labels
from lab.training.data.frames import DataSet
from lab.training.data.xradarnlos import (
    POINTS_FOLDER,
    REAL_RANGE_M,
    SPECTRUM,
    _check_on_grid,
    grid_of,
    import_folder,
    noise_of,
    resampled,
)
from msgs.values.frames import xy_from_polar
from msgs.values.perception import PathClass
from msgs.values.radar import RangeAzimuthGrid

AZIMUTH_RAD = np.radians(np.linspace(-60.0, 60.0, 256))
SIM_RANGE_M = np.linspace(0.0, 109.4, 512)
REAL_M = np.linspace(*REAL_RANGE_M, 512)


def source_xy(range_m: float, azimuth_rad: float) -> tuple[float, float]:
    """A point as the release states it: x = r sin(-azimuth), y = r cos(azimuth)."""
    return range_m * np.sin(-azimuth_rad), range_m * np.cos(azimuth_rad)


def bright_map(row: int, column: int, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    values = rng.standard_normal((512, 256, 2)) @ np.array([1.0, 1.0j])
    values[row, column] = 100.0
    return values


def write_sim(folder: Path, name: str, row: int = 100, column: int = 200) -> tuple[Path, Path]:
    """One simulated capture: a direct point at a bright cell, an image at 60 m and its true place."""
    folder.mkdir(parents=True, exist_ok=True)
    x, y = source_xy(SIM_RANGE_M[row], AZIMUTH_RAD[column])
    image_x, image_y = source_xy(60.0, 0.1)
    np.save(folder / f"{name}.npy", bright_map(row, column, row))
    np.savez(
        folder / f"{name}.npz",
        L=np.array([[x], [y], [1.5]]),
        G=np.array([[image_x], [image_y], [1.0]]),
        T=np.array([[-7.0], [12.0], [1.0]]),
    )
    return folder / f"{name}.npy", folder / f"{name}.npz"


def write_real(folder: Path, row: int = 300, column: int = 40) -> None:
    """One real capture: power with a bright cell, some of it negative, and the labelled points."""
    (folder / POINTS_FOLDER).mkdir(parents=True)
    power = np.square(np.abs(bright_map(row, column)))
    power[5, 5] = -0.25
    np.savez(folder / SPECTRUM, Pxx=power)
    points = {"los": [source_xy(REAL_M[row], AZIMUTH_RAD[column])], "mirrored_nlos": [source_xy(30.0, 0.2)]}
    points |= {"nlos": [(3.0, 8.0)], "wall": [(0.0, 20.0), (1.0, 20.0)]}
    for name, rows in points.items():
        np.save(folder / POINTS_FOLDER / f"{name}.npy", np.array(rows))


def test_simulated_point_lies_on_its_bright_cell(tmp_path: Path) -> None:
    """Bright cell (100, 200), 34.5 degrees to the left: the label is there within a tenth of a cell, and its class,
    place and the image's true place are right: source (-7, 12) is 12 m ahead and 7 m to the left."""
    ra_path, points_path = write_sim(tmp_path / "scenes", "a", 100, 200)
    np.save(tmp_path / "a.npy", np.zeros((512, 256, 5)))  # a label map of the release, of the same name
    summary = import_folder(tmp_path, tmp_path / "out")
    frame = DataSet(tmp_path / "out").frame(0)
    labels, grid = frame.labels, frame.ra_map.grid
    assert np.unravel_index(np.abs(frame.ra_map.values).argmax(), grid.shape) == (100, 200)
    assert grid.range_index(labels.range_m)[0] == pytest.approx(100.0, abs=0.1)
    assert grid.azimuth_index(labels.azimuth_rad)[0] == pytest.approx(200.0, abs=1e-3)
    assert labels.azimuth_rad[0] > 0.5
    assert labels.path_class.tolist() == [PathClass.LOS, PathClass.MIRRORED]
    assert labels.hidden_xy_m[0] == pytest.approx(
        xy_from_polar(labels.range_m[:1], labels.azimuth_rad[:1])[0], abs=1e-5
    )
    assert labels.hidden_xy_m[1].tolist() == [12.0, 7.0]
    assert (summary.frames, summary.los_points, summary.mirrored_points, summary.broken) == (1, 1, 1, [])
    series = json.loads((tmp_path / "out" / "series.json").read_text())
    assert series["format"] == "maps"
    assert series["power_only"] is False
    files = series["source"]["frames"][0]["files"]
    assert files == {
        f"scenes/{path.name}": hashlib.sha256(path.read_bytes()).hexdigest() for path in (ra_path, points_path)
    }


def test_real_point_lies_on_its_bright_cell_after_resampling(tmp_path: Path) -> None:
    """Bright source row 300 (27.7 m): its label and the map's peak agree within one bin of 0.086 m; no phase is left;
    one cell was below zero; what lies before 4.521 m holds the noise."""
    write_real(tmp_path / "in" / "alley" / "capture_1")
    summary = import_folder(tmp_path / "in", tmp_path / "out", "real")
    frame = DataSet(tmp_path / "out").frame(0)
    grid = frame.ra_map.grid
    row, column = np.unravel_index(np.abs(frame.ra_map.values).argmax(), grid.shape)
    assert grid.range_at(row) == pytest.approx(REAL_M[300], abs=grid.range_bin_m)
    assert column == 40
    assert abs(grid.range_index(frame.labels.range_m)[0] - row) <= 1.0
    assert frame.labels.azimuth_rad[0] < 0.0  # column 40 is to the right
    assert not frame.ra_map.values.imag.any()
    assert frame.sequence == "alley"
    assert summary.negative_cells == 1
    near = np.square(np.abs(frame.ra_map.values[grid.range_m < REAL_RANGE_M[0]]))
    assert near == pytest.approx(frame.ra_map.noise_power_mw, rel=1e-5, abs=0.0)


def test_resampling_keeps_a_ramp_and_the_far_end() -> None:
    """Power that grows with range is its own linear interpolation, to 1e-9."""
    power, _ = resampled(np.repeat(REAL_M[:, None], 256, axis=1))
    range_m = grid_of("real").range_m
    far = range_m >= REAL_RANGE_M[0]
    assert power[far, 0] == pytest.approx(range_m[far], abs=1e-9)
    assert range_m[-1] == pytest.approx(REAL_RANGE_M[1])


def test_noise_is_that_of_the_quiet_cells() -> None:
    """Exponential noise of mean 3 with a tenth of the cells 40 dB up: within 20 %."""
    rng = np.random.default_rng(0)
    power = rng.exponential(3.0, (512, 256))
    power[:51] *= 1e4
    assert noise_of(power) == pytest.approx(3.0, rel=0.2)
    assert noise_of(np.zeros((512, 256))) == 0.0


def test_same_input_same_bytes(tmp_path: Path) -> None:
    write_sim(tmp_path / "in", "a")
    write_sim(tmp_path / "in", "b", 50, 20)
    for name in ("one", "two"):
        import_folder(tmp_path / "in", tmp_path / name)
    for name in ("shard-00000.npz", "series.json"):
        assert (tmp_path / "one" / name).read_bytes() == (tmp_path / "two" / name).read_bytes()


def test_labelled_clouds_need_not_pair(tmp_path: Path) -> None:
    """Real captures label clouds: two true places for one image. The places are kept together, none given to a label,
    and the evaluation asks for both."""
    folder = tmp_path / "in" / "alley" / "capture_1"
    write_real(folder)
    np.save(folder / POINTS_FOLDER / "nlos.npy", np.array([(3.0, 8.0), (4.0, 8.0)]))
    import_folder(tmp_path / "in", tmp_path / "out", "real")
    frame = DataSet(tmp_path / "out").frame(0)
    assert np.isnan(frame.labels.hidden_xy_m[frame.labels.path_class == PathClass.MIRRORED]).all()
    assert frame.places_m is not None
    assert frame.places_m.tolist() == [[8.0, -3.0], [8.0, -4.0]]
    assert truth_of_labels(frame).places_m.tolist() == [[8.0, -3.0], [8.0, -4.0]]


@pytest.mark.parametrize(
    ("row", "column", "inside"),
    [(0.0, 0.0, True), (510.999, 254.999, True), (511.1, 9.0, False), (9.0, -0.1, False), (9.0, 255.1, False)],
)
def test_points_off_the_grid_are_named(row: float, column: float, inside: bool) -> None:
    grid, capture = RangeAzimuthGrid(), SimpleNamespace(point_paths=[Path("points.npy")])
    values = np.array([grid.range_at(row)]), np.array([grid.azimuth_at(column)])
    with nullcontext() if inside else pytest.raises(ValueError, match=r"points\.npy: points must lie on the grid"):
        _check_on_grid(capture, *values, grid)  # type: ignore[arg-type]
