from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from lab.networks.compact_unet import CompactUNetConfig
from lab.training.data.frames import Scan
from lab.training.data.samples import DataConfig, Perturbation, SampleFormer, TrainingData
from lab.training.map_networks import NetworkChoice, choice_of
from lab.training.run_folder import CURVES, SUMMARY
from lab.training.schedules import ScheduleConfig
from lab.training.train_dense import DenseTraining, EpochReport, TrainDenseConfig, load_best
from models.perception.find.encoding import Encoding
from msgs.values.radar import RangeAzimuthGrid
from tests.lab.training.data.map_scans import map_scan

GRID = RangeAzimuthGrid(range_bins=32, azimuth_bins=64)
ENCODING = Encoding(range_bins=32, columns=8)
NETWORK = CompactUNetConfig(range_bins=32, columns=8, widths=(8, 16), attention_heads=2, attention_blocks=1)
DATA = DataConfig(encoding=ENCODING, grid=GRID, clean_share=1.0, perturbation=Perturbation())


def scene(rng: np.random.Generator, index: int = 0) -> Scan:
    """One bright return: LOS where nothing stands nearer, mirrored behind a second one in the same direction."""
    values = 1e-2 * (rng.standard_normal((32, 64)) + 1j * rng.standard_normal((32, 64)))
    column = int(rng.integers(8))
    rows = np.array([rng.integers(2, 12), rng.integers(18, 30)])
    values[rows, 8 * column : 8 * column + 8] = 1.0
    return map_scan(GRID, values, rows, np.full(2, 8 * column + 4.0), [0, 1], index)


def data(count: int = 16) -> TrainingData:
    rng = np.random.default_rng(0)
    former = SampleFormer(DATA)
    return TrainingData(
        train=[scene(rng, index) for index in range(count)],
        validation=[former.sample(scene(rng)) for _ in range(4)],
        config=DATA,
    )


def config(network: CompactUNetConfig = NETWORK, **schedule: float) -> TrainDenseConfig:
    return TrainDenseConfig(
        network=choice_of("compact_unet", network),
        schedule=ScheduleConfig(**{"epochs": 3, "batch_size": 8} | schedule),  # type: ignore[arg-type]
        mixed_precision=False,
    )


class KilledError(Exception):
    pass


@pytest.mark.slow
def test_learns_which_return_stands_behind_another(tmp_path: Path) -> None:
    """32 scenes, 40 epochs of a tiny network: chance level of the class is 0.5, so 0.8 means that it was learned."""
    training = DenseTraining(config(epochs=40, learning_rate=1e-2, batch_size=4), data(32), tmp_path)
    training.run()
    best = training.summary().best
    assert best.macro_f1 > 0.8
    assert training.reports[-1].train_loss < 0.3 * training.reports[0].train_loss


def test_killed_run_ends_as_one_that_was_not(tmp_path: Path) -> None:
    whole = DenseTraining(config(), data(), tmp_path / "whole")
    whole.run()

    def kill(report: EpochReport) -> None:
        raise KilledError

    with pytest.raises(KilledError):
        DenseTraining(config(), data(), tmp_path / "killed").run(kill)
    resumed = DenseTraining(config(), data(), tmp_path / "killed")
    assert len(resumed.reports) == 1
    resumed.run()
    assert resumed.reports == whole.reports
    for name, wanted in whole.network.state_dict().items():
        assert torch.equal(resumed.network.state_dict()[name], wanted), name


def test_run_folder_holds_curves_and_the_best_network(tmp_path: Path) -> None:
    training = DenseTraining(config(), data(), tmp_path)
    training.run()
    best = training.summary().best
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
    with pytest.raises(ValueError, match=r"answer on 32 ranges and the grid.s 64 azimuths, answers on \(32, 32\)"):
        DenseTraining(config(network=replace(NETWORK, azimuth_factor=4)), data(), tmp_path)


def test_settings_out_of_range_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"schedule\.epochs must be positive, got 0"):
        config(epochs=0)
    with pytest.raises(ValueError, match=r"schedule\.learning_rate must be positive, got -1\.0"):
        config(learning_rate=-1.0)
    with pytest.raises(ValueError, match=r"schedule\.batch_size must be at most the 4 scenes, got 8"):
        DenseTraining(config(), data(4), tmp_path)
    with pytest.raises(ValueError, match=r"network must be one of compact_unet, .*, got 'resnet'"):
        NetworkChoice(family="resnet", config={})
    with pytest.raises(ValueError, match=r"network compact_unet: .*range_bins"):
        _ = NetworkChoice(family="compact_unet", config={"range_bins": "many"}).resolved


def test_loss_that_is_no_number_stops_with_its_batch(tmp_path: Path) -> None:
    training = DenseTraining(config(), data(), tmp_path)
    with torch.no_grad():
        training.network.head.bias.fill_(torch.nan)
    with pytest.raises(ValueError, match=r"loss must be finite, got nan in epoch 0, batch 0, scenes \d+, "):
        training.run()
    assert not (tmp_path / CURVES).exists()


def test_summary_tells_the_budget_and_whether_the_score_still_rises(tmp_path: Path) -> None:
    training = DenseTraining(config(), data(), tmp_path)
    training.run()
    summary = json.loads((tmp_path / SUMMARY).read_text())
    assert summary["sample_steps"] == 3 * 16
    assert summary["scenes"] == 16
    rising = [replace(training.reports[0], best_macro_f1=0.05 * epoch) for epoch in range(10)]
    training.reports = rising
    assert training.summary().unconverged
    training.reports = [replace(report, best_macro_f1=min(report.best_macro_f1, 0.2)) for report in rising]
    assert not training.summary().unconverged


@pytest.mark.parametrize("kind", ["one_cycle", "constant", "steps"])
def test_learning_rate_follows_its_schedule(kind: str) -> None:
    """Layout: 10 epochs of 10 steps. One cycle: up over 15 steps, then down to nothing; steps: a tenth from epoch 5."""
    schedule = ScheduleConfig(kind=kind, epochs=10, step_epoch=5)  # type: ignore[arg-type]
    factors = [schedule.factor(step, 10) for step in range(100)]
    wanted = {"one_cycle": (0.04, 1.0, 1e-3), "constant": (1.0, 1.0, 1.0), "steps": (1.0, 1.0, 0.1)}[kind]
    assert (factors[0], max(factors), factors[-1]) == pytest.approx(wanted, abs=2e-3)
    if kind == "one_cycle":
        assert int(np.argmax(factors)) == 15
