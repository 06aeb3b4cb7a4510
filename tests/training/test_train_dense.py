from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from models.networks.compact_unet import CompactUNetConfig
from models.perception.encoding import Encoding
from models.training.datasets import DataConfig, DenseSample, PointLabels, TrainingData
from models.training.train_dense import CURVES, DenseTraining, EpochReport, TrainDenseConfig, load_best
from msgs.radar import RangeAzimuthGrid

GRID = RangeAzimuthGrid(range_bins=32, azimuth_bins=64)
ENCODING = Encoding(range_bins=32, columns=8)
NETWORK = CompactUNetConfig(range_bins=32, columns=8, widths=(8, 16), attention_heads=2, attention_blocks=1)


def scene(rng: np.random.Generator) -> DenseSample:
    """One bright return: LOS where nothing stands nearer, mirrored behind a second one in the same direction."""
    columns = 1e-2 * (rng.standard_normal((32, 8)) + 1j * rng.standard_normal((32, 8)))
    column = int(rng.integers(8))
    rows = np.array([rng.integers(2, 12), rng.integers(18, 30)])
    columns[rows, column] = 1.0
    labels = PointLabels(
        row=rows.astype(float), column=np.full(2, 8 * column + 4.0), path_class=np.array([0, 1], np.uint8)
    )
    return DenseSample(columns=columns.astype(np.complex64), noise_power_mw=1e-4, labels=labels)


def data(count: int = 16) -> TrainingData:
    rng = np.random.default_rng(0)
    return TrainingData(
        train=[[scene(rng)] for _ in range(count)],
        validation=[scene(rng) for _ in range(4)],
        config=DataConfig(encoding=ENCODING, grid=GRID),
    )


def config(**changes: object) -> TrainDenseConfig:
    settings: dict[str, object] = {"epochs": 3, "batch_size": 8, "mixed_precision": False, "network": NETWORK}
    return TrainDenseConfig(**settings | changes)  # type: ignore[arg-type]


class KilledError(Exception):
    pass


def test_learns_which_return_stands_behind_another(tmp_path: Path) -> None:
    """32 scenes, 40 epochs of a tiny network: chance level of the class is 0.5, so 0.8 means that it was learned."""
    training = DenseTraining(config(epochs=40, learning_rate=1e-2, batch_size=4), data(32), tmp_path)
    best = training.run(lambda report: None)
    assert best.macro_f1 > 0.8
    assert training.reports[-1].train_loss < 0.3 * training.reports[0].train_loss


def test_killed_run_ends_as_one_that_was_not(tmp_path: Path) -> None:
    whole = DenseTraining(config(), data(), tmp_path / "whole")
    whole.run(lambda report: None)

    def kill(report: EpochReport) -> None:
        raise KilledError

    with pytest.raises(KilledError):
        DenseTraining(config(), data(), tmp_path / "killed").run(kill)
    resumed = DenseTraining(config(), data(), tmp_path / "killed")
    assert len(resumed.reports) == 1
    resumed.run(lambda report: None)
    assert resumed.reports == whole.reports
    for name, wanted in whole.network.state_dict().items():
        assert torch.equal(resumed.network.state_dict()[name], wanted), name


def test_run_folder_holds_curves_and_the_best_network(tmp_path: Path) -> None:
    training = DenseTraining(config(), data(), tmp_path)
    best = training.run(lambda report: None)
    assert [row["epoch"] for row in json.loads((tmp_path / CURVES).read_text())] == [0, 1, 2]
    network, run_config, epoch = load_best(tmp_path)
    assert epoch == best.epoch
    assert run_config == training.run_config
    assert not network.training


def test_other_configuration_needs_another_folder(tmp_path: Path) -> None:
    DenseTraining(config(), data(), tmp_path)
    with pytest.raises(ValueError, match=r"config\.json must hold the configuration of this run"):
        DenseTraining(config(learning_rate=1e-3), data(), tmp_path)


def test_folder_without_a_network_is_named(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"config\.json must exist: the run folder holds no trained network"):
        load_best(tmp_path)


def test_network_must_fit_encoding_and_grid(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"network must take the encoding's shape \(5, 32, 8\), takes \(5, 64, 8\)"):
        DenseTraining(config(network=replace(NETWORK, range_bins=64)), data(), tmp_path)
    with pytest.raises(ValueError, match=r"azimuth_factor must spread 8 columns to 64 azimuths, got 4"):
        DenseTraining(config(network=replace(NETWORK, azimuth_factor=4)), data(), tmp_path)


def test_settings_out_of_range_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"train\.epochs must be at least 1, got 0"):
        config(epochs=0)
    with pytest.raises(ValueError, match=r"train\.learning_rate must be positive, got -1\.0"):
        config(learning_rate=-1.0)
    with pytest.raises(ValueError, match=r"train\.batch_size must be at most the 4 scenes, got 8"):
        DenseTraining(config(), data(4), tmp_path)
