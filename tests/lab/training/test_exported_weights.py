"""Exported dense networks as first weights."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import nn

from lab.networks.compact_unet import WIDE, CompactUNet, CompactUNetConfig
from lab.networks.unet import UNetConfig
from lab.training.data.frames import Scan
from lab.training.data.samples import DataConfig, SampleFormer, TrainingData
from lab.training.exported_weights import load_exported, settle_norms
from lab.training.map_networks import INPUTS, choice_of, preset_network
from lab.training.schedules import ScheduleConfig
from lab.training.train_dense import DenseTraining, TrainDenseConfig
from models.perception.cards import learned_path
from models.perception.find.encoding import Encoding
from models.perception.find.onnx_model import DEFAULT_MODEL, DensePredictor, load_card
from msgs.values.radar import RangeAzimuthGrid
from tests.lab.training.data.map_scans import map_scan

CONFIG = CompactUNetConfig(in_channels=7)


def probabilities(network: CompactUNet, encoded: np.ndarray) -> np.ndarray:
    with torch.no_grad():
        return np.asarray(torch.sigmoid(network.eval()(torch.from_numpy(encoded))).numpy())


def test_a_dense_network_answers_what_its_file_answers() -> None:
    """With an eighth channel too, which nothing has learned to read."""
    encoded = np.random.default_rng(1).standard_normal((1, 8, 320, 32)).astype(np.float32)
    wanted = DensePredictor(DEFAULT_MODEL).infer(encoded[0, :7])
    for channels in (7, 8):
        network = CompactUNet(replace(CONFIG, in_channels=channels))
        load_exported(network, DEFAULT_MODEL)
        np.testing.assert_allclose(probabilities(network, encoded[:, :channels])[0], wanted, atol=1e-5)


@pytest.mark.parametrize(
    ("config", "path", "rule"),
    [
        (replace(WIDE, in_channels=7), DEFAULT_MODEL, "start must be a network of this shape in full precision"),
        (CONFIG, DEFAULT_MODEL.with_name("compact_unet.int8.onnx"), "start must be a network of this shape in full"),
        (CONFIG, DEFAULT_MODEL.with_name("evidence_unet.onnx"), r"evidence_unet\.json: lacks grid"),
        (CONFIG, Path("nothing.onnx"), r"nothing\.json: No such file"),
    ],
)
def test_a_file_of_another_network_is_refused(config: CompactUNetConfig, path: Path, rule: str) -> None:
    with pytest.raises(ValueError, match=rule):
        load_exported(CompactUNet(config), path)


def test_settled_norms_have_the_statistics_of_the_data_and_answer_as_before() -> None:
    torch.manual_seed(0)
    network = nn.Sequential(nn.Conv2d(2, 4, 3, bias=False), nn.BatchNorm2d(4), nn.ReLU(), nn.Conv2d(4, 1, 1)).eval()
    batches = [3.0 + 0.5 * torch.randn(8, 2, 16, 16) for _ in range(4)]
    with torch.no_grad():
        before = network(batches[0])
        settle_norms(network, batches)
        torch.testing.assert_close(network(batches[0]), before, atol=1e-5, rtol=1e-5)
        shown = network[0](torch.cat(batches))
    torch.testing.assert_close(network[1].running_mean, shown.mean((0, 2, 3)), atol=1e-4, rtol=1e-4)
    torch.testing.assert_close(network[1].running_var, shown.var((0, 2, 3), correction=0), atol=1e-4, rtol=1e-3)


def test_a_training_goes_on_from_an_exported_network(tmp_path: Path) -> None:
    """It validates as the file does before its first step, and its norms then learn."""
    card = load_card(DEFAULT_MODEL)
    config = DataConfig(encoding=card.encoding, grid=card.grid)
    former = SampleFormer(config)
    scans = [_scan(np.random.default_rng(seed), card.grid) for seed in range(8)]
    data = TrainingData(train=scans, validation=[former.sample(scan) for scan in scans[:2]], config=config)
    training = DenseTraining(
        TrainDenseConfig(
            network=choice_of("compact_unet", CONFIG),
            schedule=ScheduleConfig(epochs=1),
            mixed_precision=False,
            init=str(DEFAULT_MODEL),
        ),
        data,
        tmp_path / "run",
    )
    encoded = former.encode([former.sample(scans[0])])
    wanted = DensePredictor(DEFAULT_MODEL).infer(encoded[0])
    assert isinstance(training.network, CompactUNet)
    np.testing.assert_allclose(probabilities(training.network, encoded)[0], wanted, atol=1e-4)
    before = {name: tensor.clone() for name, tensor in training.network.state_dict().items()}
    training.run()
    after = training.network.state_dict()
    assert all(not torch.equal(before[name], after[name]) for name in before if "running_mean" in name)


@pytest.mark.parametrize("family", ["swin_unet", "unet"])
def test_networks_of_the_specification_answer_what_their_files_answer(family: str) -> None:
    """Attention's position biases and layers without a norm: parity with the file is checked on the way."""
    network = preset_network(family, "compact", "complex")[0].build()
    load_exported(network, learned_path(f"{family}.compact"))


def test_a_file_of_another_family_is_refused_before_the_folder_is_taken(tmp_path: Path) -> None:
    network = UNetConfig(range_bins=512, columns=256, widths=(2, 2), patch=16)
    config = DataConfig(encoding=Encoding(range_bins=512, columns=256, channels=INPUTS["complex"]))
    data = TrainingData(train=[_scan(np.random.default_rng(0), config.grid)], validation=[], config=config)
    training = TrainDenseConfig(
        network=choice_of("unet", network), schedule=ScheduleConfig(batch_size=1), init=str(DEFAULT_MODEL)
    )
    with pytest.raises(ValueError, match=r"compact_unet\.onnx: start must be a network of this shape"):
        DenseTraining(training, data, tmp_path / "run")
    assert not (tmp_path / "run").exists()


def _scan(rng: np.random.Generator, grid: RangeAzimuthGrid) -> Scan:
    """A map of noise with one loud return."""
    values = 1e-2 * (rng.standard_normal(grid.shape) + 1j * rng.standard_normal(grid.shape))
    row, column = int(rng.integers(20, 300)), int(rng.integers(16, 240))
    values[row, column - 8 : column + 9] = 1.0
    return map_scan(grid, values, np.array([row]), np.array([column]), [0], row)
