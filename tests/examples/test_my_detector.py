"""The detector as ONNX: what is behind is mirrored, a network of torch takes the same card, faults are one line."""

from __future__ import annotations

import hashlib
import json
import runpy
import warnings
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch

from mirrorwave.api import Perception
from models.perception.find.onnx_model import DensePredictor
from msgs.files.shipped import CHECKOUT
from msgs.values.perception import PathClass
from msgs.values.radar import RangeAzimuthGrid, RangeAzimuthMap
from tests.builders import example_map

MAKE = CHECKOUT / "examples" / "my_detector" / "make_detector.py"


@pytest.fixture
def model(tmp_path: Path) -> Path:
    runpy.run_path(str(MAKE))["main"](tmp_path)
    return tmp_path / "my_detector.onnx"


def ra_map(*echoes: tuple[int, int, float]) -> RangeAzimuthMap:
    """Noise of 1 mW, and echoes at (range bin, azimuth, dB over it), a beam wide."""
    grid, rng = RangeAzimuthGrid(), np.random.default_rng(0)
    values = (rng.standard_normal(grid.shape) + 1j * rng.standard_normal(grid.shape)) / np.sqrt(2.0)
    azimuth = np.arange(grid.azimuth_bins)
    for row, column, level_db in echoes:
        values[row] += 10.0 ** (level_db / 20.0) * np.exp(-0.5 * ((azimuth - column) / 9.0) ** 2)
    return example_map(values, grid=grid)


def test_an_echo_behind_another_is_mirrored(model: Path) -> None:
    """A wall at bin 60, something behind it at 160, something free at 160 in another direction, and nothing else of
    sixty thousand cells of noise: classes and cells.
    """
    points = DensePredictor(model).points(ra_map((60, 60, 45.0), (160, 61, 35.0), (160, 180, 35.0)), 0.4, 3)
    found = {(round(row), PathClass(kind)) for (row, _), kind in zip(points.cells, points.path_class, strict=True)}
    assert found == {(60, PathClass.LOS), (160, PathClass.LOS), (160, PathClass.MIRRORED)}
    mirrored = points.cells[points.path_class == PathClass.MIRRORED]
    assert np.abs(mirrored - [160, 61]).max() <= 2.0


def test_a_network_of_torch_takes_the_card_of_the_guide(model: Path) -> None:
    network = torch.nn.Sequential(torch.nn.Conv2d(2, 2, 5, padding=2), torch.nn.Sigmoid()).eval()
    with warnings.catch_warnings():
        # torch announces the successor of this exporter at every call
        warnings.simplefilter("ignore")
        torch.onnx.export(network, (torch.zeros(1, 2, 320, 256),), str(model), dynamo=False)
    rewritten(model, sha256=hashlib.sha256(model.read_bytes()).hexdigest())
    confidence = DensePredictor(model).predict(ra_map())
    assert confidence.shape == (2, 512, 256)
    assert 0.0 < confidence[:, :320].min() < confidence.max() < 1.0


def rewritten(model: Path, **fields: object) -> None:
    """Change fields of the card."""
    card = model.with_suffix(".json")
    card.write_text(json.dumps(json.loads(card.read_text()) | fields))


def other_input(model: Path) -> None:
    rewritten(model, input_shape=[1, 2, 320, 128])


def coarser_encoding(model: Path) -> None:
    other = {"range_bins": 320, "columns": 128, "channels": ["level", "contrast"]}
    rewritten(model, input_shape=[1, 2, 320, 128], encoding=other)


@pytest.mark.parametrize(
    ("change", "line"),
    [
        (lambda model: model.with_suffix(".json").unlink(), "my_detector.json: No such file or directory; "),
        (
            lambda model: model.with_suffix(".json").write_text("{}"),
            "my_detector.json: lacks name, sha256, encoding, grid",
        ),
        (lambda model: model.unlink(), "my_detector.onnx: No such file or directory"),
        (lambda model: model.write_bytes(model.read_bytes()[:99]), "my_detector.onnx: sha256 must be "),
        (other_input, "card.input_shape must be (1, 2, 320, 256), got (1, 2, 320, 128)"),
        (coarser_encoding, "input must be (1, 2, 320, 128) as its card says, got (1, 2, 320, 256)"),
        (lambda model: rewritten(model, threshold="high"), "threshold: Expected `float`, got `str`"),
        (lambda model: rewritten(model, sha256="0" * 64), "sha256 must be 000000"),
    ],
)
def test_what_does_not_fit_is_one_line(model: Path, change: Callable[[Path], object], line: str) -> None:
    change(model)
    with pytest.raises(ValueError, match=r"docs/guides/own-parts\.md") as caught:
        Perception(overrides=[f"dense_predictor.model={model}"])
    assert line in str(caught.value)
    assert "\n" not in str(caught.value)
