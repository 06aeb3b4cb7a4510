"""`mirrorwave train confidence` on a handful of scenes: the file, what it says, and methods that use it."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import typer
from typer.testing import CliRunner

from lab.commands.train_confidence import confidence
from lab.evaluate.methods import build_method, parse_method
from lab.training.data.frames import DataSet
from models.perception.find.onnx_model import DEFAULT_MODEL, load_card
from models.perception.mirrors.confidence import load_confidence
from sim_player.dataset.writer import write_dataset

app = typer.Typer()
app.command()(confidence)


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("scenes")
    write_dataset(folder, 8, seed=3)
    return folder


@pytest.mark.slow
def test_a_fitted_file_drops_places_of_a_method(data: Path, tmp_path: Path) -> None:
    """The verb writes the same bytes again; with it a method keeps a part of its places, in order."""
    out = tmp_path / "confidence.json"
    options = ["--data", str(data), "--out", str(out), "--json"]
    result = CliRunner().invoke(app, options)
    assert result.exit_code == 0, result.output
    fitted = load_confidence(out)
    assert json.loads(result.stdout)["threshold"] == fitted.threshold
    card = load_card(DEFAULT_MODEL)
    assert fitted.detector == f"{card.sha256}/pursuit"
    assert f"--model {DEFAULT_MODEL} --seed 0" in fitted.command
    before = out.read_bytes()
    CliRunner().invoke(app, options)
    assert out.read_bytes() == before
    plain, manual_plan = (
        build_method(parse_method(f"net={DEFAULT_MODEL},refine=pursuit{word}")) for word in ("", f",confidence={out}")
    )
    for frame in DataSet(data).frames(range(8)):
        peaks = plain.detect(frame)
        everything, kept = plain.place(peaks)[0], manual_plan.place(peaks)[0]
        assert np.isin(kept, everything).all()
        assert len(kept) <= len(everything)


def test_a_missing_model_and_the_published_geometry_are_named(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"--method truth: .*nowhere\.json"):
        build_method(parse_method(f"truth,confidence={tmp_path / 'nowhere.json'}"))
    with pytest.raises(ValueError, match="confidence must go with geometry=ours, got specification"):
        parse_method("truth,confidence=file.json,geometry=published")
