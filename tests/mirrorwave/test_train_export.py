from __future__ import annotations

import json
from pathlib import Path

import pytest

from mirrorwave.export import export
from mirrorwave.train import dense
from models.perception.onnx_model import DensePredictor
from sim_player.dataset import write_dataset


def test_from_data_set_to_a_model_that_loads(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A dozen scenes and one epoch: the verbs fit together, and what they leave loads on the vehicle's side."""
    write_dataset(tmp_path / "data", count=12, seed=1)
    dense(tmp_path / "data", tmp_path / "run", epochs=1, batch_size=4, seed=3, threads=1)
    assert "best Macro-F1 0." in capsys.readouterr().out
    model = tmp_path / "net.onnx"
    export(tmp_path / "run", model, precision="int8", calibration=2, as_json=True)
    printed = json.loads(capsys.readouterr().out)
    card = DensePredictor(model).card
    assert printed["sha256"] == card.sha256
    assert (card.precision, printed["precision"]) == ("int8", "int8")
    assert card.data["test_scenes"] == 2
    assert card.training["config"]["training"]["seed"] == 3
