"""Evaluation and import on what must be refused, and on frames that hold nothing."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from lab.evaluate.method_runs import checked_frames, run_methods
from lab.evaluate.methods import build_method, parse_method
from lab.measures.frame_scores import bootstrap_weights, estimates
from lab.training.data.frames import DataSet
from lab.training.data.xradarnlos import POINTS_FOLDER, SPECTRUM, import_folder
from mirrorwave.cli import main
from models.perception.find.onnx_model import DEFAULT_MODEL
from msgs.values.radar import RangeAzimuthGrid


def write_maps(folder: Path, grid: dict[str, float] | None = None, spoil: bool = False) -> Path:
    """Six empty maps with noise and no truth at all, as an imported data set."""
    folder.mkdir()
    shape = RangeAzimuthGrid().shape
    rng = np.random.default_rng(0)
    values = (rng.standard_normal((6, *shape, 2)) @ np.array([1.0, 1.0j])).astype(np.complex64)
    values[1] = 0.0
    if spoil:
        values[4, 10, 20] = np.nan
    arrays = {"range_m": np.float32, "azimuth_rad": np.float32, "path_class": np.uint8}
    np.savez(
        folder / "shard-00000.npz",
        values=values,
        noise_power_mw=np.array([2.0, 0.0, 2.0, 2.0, 2.0, 2.0]),
        offset=np.zeros(7, np.int64),
        hidden_xy_m=np.zeros((0, 2), np.float32),
        sequence=np.array([f"drive {index}" for index in range(6)]),
        **{name: np.zeros(0, dtype) for name, dtype in arrays.items()},  # type: ignore[arg-type]
    )
    series = {"format": "maps", "grid": {"range_bins": 512} | (grid or {}), "power_only": False}
    (folder / "series.json").write_text(json.dumps(series))
    return folder


def refused(capsys: pytest.CaptureFixture[str], *words: str) -> str:
    """The one line that a refused command leaves, code 2."""
    assert main(list(words)) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    return error


@pytest.mark.slow
def test_frames_without_signal_or_truth_are_scored(tmp_path: Path) -> None:
    """Noise, an empty map, no noise power: every method answers, false alarms count, nothing is skipped or not finite
    but what has no value."""
    data = DataSet(write_maps(tmp_path / "data"))
    texts = ("cfar", "cfar-nlos,geometry=published", f"net={DEFAULT_MODEL},refine")
    methods = [build_method(parse_method(text)) for text in texts]
    run = run_methods(methods, checked_frames(data, range(6), methods))
    for one in run.runs:
        scores = run.scores(one)
        assert len(scores) == 6
        got = estimates(scores, bootstrap_weights(6, 20, 0))
        assert got["recovered_1m_recall"].value == 0.0
        assert np.isnan(got["recovered_chamfer_m"].value)
        assert np.isfinite(got["recovered_chamfer_capped_m"].value)
        share = got["recovered_infinite_share"].value + got["recovered_nothing_share"].value
        assert share == pytest.approx(1.0)


def test_another_grid_is_refused_before_any_frame(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = write_maps(tmp_path / "data", {"range_bin_m": 0.3})
    error = refused(capsys, "eval", "--data", str(folder), "--method", f"net={DEFAULT_MODEL}")
    assert "grid must be that of method net's card" in error
    assert "range_bin_m=0.3" in error


GOOD_POINTS = {"L": np.array([[0.0], [30.0], [0.0]]), "G": np.zeros((3, 0)), "T": np.zeros((3, 0))}
NAN_POINT = np.array([[0.0], [np.nan], [0.0]])
ONE = np.array([[1.0], [20.0], [0.0]])


@pytest.mark.parametrize(
    ("values", "points", "fault"),
    [
        (np.zeros((512, 255), complex), GOOD_POINTS, r"map must have shape \(512, 256\), got \(512, 255\)"),
        (np.zeros((512, 256)), GOOD_POINTS, "map must be complex, got float64"),
        (np.full((512, 256), np.nan + 0j), GOOD_POINTS, "map must be finite"),
        (None, {"L": GOOD_POINTS["L"], "G": GOOD_POINTS["G"]}, "must hold T, holds G, L"),
        (None, GOOD_POINTS | {"L": np.zeros((4, 2))}, r"L must have shape \(3, N\), got \(4, 2\)"),
        (None, GOOD_POINTS | {"L": NAN_POINT}, r"L must be finite, got nan at \(1, 0\)"),
        (None, GOOD_POINTS | {"G": ONE}, "images and true places must be as many, got 1 and 0"),
        (None, GOOD_POINTS | {"L": 9.0 * ONE}, r"points must lie on the grid, .*got 180.22 m"),
        (None, GOOD_POINTS | {"L": ONE[[1, 0, 2]]}, r"points must lie on the grid, .*-87.1 deg"),
        (None, GOOD_POINTS | {"L": np.array([["a"], ["b"], ["c"]])}, "L must be real, got <U1"),
    ],
)
def test_broken_simulated_captures(
    values: np.ndarray | None, points: dict[str, np.ndarray], fault: str, tmp_path: Path
) -> None:
    np.save(tmp_path / "a.npy", np.zeros((512, 256), complex) if values is None else values)
    np.savez(tmp_path / "a.npz", **points)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match=fault) as caught:
        import_folder(tmp_path, tmp_path / "out")
    assert str(tmp_path / "a.np") in str(caught.value)
    # left out and counted, but an import of nothing is no data set
    with pytest.raises(ValueError, match="captures must be readable, none is"):
        import_folder(tmp_path, tmp_path / "out2", skip_broken=True)


def test_files_without_partner_are_told(tmp_path: Path) -> None:
    np.savez(tmp_path / "points.npz", **GOOD_POINTS)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match=r"points.npz must have one map of its name \(.npy\), found 0"):
        import_folder(tmp_path, tmp_path / "out")
    np.save(tmp_path / "points.npy", np.zeros((512, 256), complex))
    np.save(tmp_path / "lonely.npy", np.zeros((512, 256), complex))
    with pytest.raises(ValueError, match=r"lonely.npy must have points of its name \(.npz\), found none"):
        import_folder(tmp_path, tmp_path / "out")
    summary = import_folder(tmp_path, tmp_path / "out", skip_broken=True)
    assert summary.frames == 1
    assert len(summary.broken) == 1


@pytest.mark.parametrize(
    ("content", "fault"),
    [
        ({"Pxx": np.zeros((512, 256), complex)}, r"Pxx must be power \(real\), got complex128"),
        ({"pxx": np.zeros((512, 256))}, "must hold Pxx, holds pxx"),
        ({"Pxx": np.full((512, 256), np.inf)}, "Pxx must be finite"),
        ({"Pxx": np.zeros((256, 512))}, r"Pxx must have shape \(512, 256\), got \(256, 512\)"),
    ],
)
def test_broken_spectra(content: dict[str, np.ndarray], fault: str, tmp_path: Path) -> None:
    np.savez(tmp_path / SPECTRUM, **content)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match=fault):
        import_folder(tmp_path, tmp_path / "out", "real")


def test_capture_without_its_points_is_refused_by_file(tmp_path: Path) -> None:
    np.savez(tmp_path / SPECTRUM, Pxx=np.ones((512, 256)))
    with pytest.raises(ValueError, match=r"los\.npy: must be a readable numpy file: No such file"):
        import_folder(tmp_path, tmp_path / "out", "real")
    (tmp_path / POINTS_FOLDER).mkdir()
    for name in ("los", "mirrored_nlos", "nlos"):
        np.save(tmp_path / POINTS_FOLDER / f"{name}.npy", np.zeros((0, 2)))
    assert import_folder(tmp_path, tmp_path / "out3", "real").frames == 1


def test_nothing_is_written_over(tmp_path: Path) -> None:
    np.save(tmp_path / "a.npy", np.zeros((512, 256), complex))
    np.savez(tmp_path / "a.npz", **GOOD_POINTS)  # type: ignore[arg-type]
    import_folder(tmp_path, tmp_path / "out")
    with pytest.raises(ValueError, match="must be empty or new"):
        import_folder(tmp_path, tmp_path / "out")
