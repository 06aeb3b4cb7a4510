"""`mirrorwave train residual` on a handful of scenes: the run folder, going on, and one-line errors."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import typer
from click.testing import Result
from typer.testing import CliRunner

from lab.commands.train_residual import CURVES_PICTURE, MODEL_FILE, SAMPLES, residual
from models.perception.mirrors.residual_model import LearnedResidual
from sim_player.dataset.writer import write_dataset

app = typer.Typer()
app.command()(residual)


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("scenes")
    write_dataset(folder, 6, seed=3)
    return folder


def train(data: Path, out: Path, *options: str) -> Result:
    return CliRunner().invoke(app, ["--data", str(data), "--out", str(out), "--epochs", "1", *options])


@pytest.mark.slow
def test_a_run_ends_as_a_file_the_geometry_stage_loads(data: Path, tmp_path: Path) -> None:
    """One epoch; asked for again, the run that is done trains no more and exports the same bytes."""
    run = tmp_path / "run"
    options = ("--reach-m", "5")
    result = train(data, run, *options)
    assert result.exit_code == 0, result.output
    assert "on test scenes recovered l1" in result.output
    card = LearnedResidual(run / MODEL_FILE).card
    assert (card.source, card.frame, card.geometry, card.seed) == ("peaks", "wall", "published", 0)
    assert "--reach-m 5 --epochs 1 --seed 0" in card.command
    assert card.data["test_sha256"] == json.loads((data / "splits.json").read_text())["test_sha256"]
    names = {"config.json", "curves.json", CURVES_PICTURE, *map(SAMPLES.format, ("train", "validation", "test"))}
    assert names <= {path.name for path in run.iterdir()}
    before = (run / MODEL_FILE).read_bytes(), (run / "last.pt").stat().st_mtime_ns
    assert train(data, run, *options).exit_code == 0
    assert before == ((run / MODEL_FILE).read_bytes(), (run / "last.pt").stat().st_mtime_ns)


def test_another_configuration_is_refused(data: Path, tmp_path: Path) -> None:
    out = tmp_path / "run"
    out.mkdir()
    (out / "config.json").write_text("{}")
    result = train(data, out)
    assert isinstance(result.exception, ValueError)
    assert "config.json must hold the configuration of this run" in str(result.exception)


def test_a_folder_without_scenes_and_a_missing_detector_are_named(data: Path, tmp_path: Path) -> None:
    assert "must hold shards" in str(train(tmp_path, tmp_path / "run").exception)
    result = train(data, tmp_path / "run", "--model", str(tmp_path / "nowhere.onnx"))
    assert "nowhere.json" in str(result.exception)
