"""Training of the residual network: images of a facade that all fold the same way wrong."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np
import pytest
import torch

from lab.training.data.residual_samples import FoldedImages, SampleConfig
from lab.training.export.residual import export_residual_onnx, export_residual_run
from lab.training.run_folder import BEST
from lab.training.train_residual import (
    ResidualRunConfig,
    ResidualTraining,
    TrainResidualConfig,
    residual_loss,
)
from models.perception.find.onnx_model import card_path
from models.perception.mirrors.residual_model import LearnedResidual, load_residual_card

#: What the mirror law leaves over here: along the wall away from the foot, and towards the radar.
ALONG_M, TOWARDS_M = 0.8, -0.6


def images(count: int, seed: int = 0, scenes: int = 4) -> FoldedImages:
    """Images behind walls that face the radar from any direction, their error the same in wall coordinates."""
    rng = np.random.default_rng(seed)
    angle_rad, offset_m = rng.uniform(-1.0, 1.0, count), rng.uniform(8.0, 16.0, count)
    away = np.stack([np.cos(angle_rad), np.sin(angle_rad)], axis=1)
    left = np.stack([-away[:, 1], away[:, 0]], axis=1)
    along_m = rng.uniform(-6.0, 6.0, (count, 1))
    depth_m = rng.uniform(2.0, 8.0, (count, 1))
    foot_m = offset_m[:, None] * away
    images_m = foot_m + along_m * left + depth_m * away
    folded_m = foot_m + along_m * left - depth_m * away
    target_m = ALONG_M * np.sign(along_m) * left - TOWARDS_M * away
    scene = np.sort(rng.integers(0, scenes, count))
    return FoldedImages(
        images_m=images_m,
        patch_m=foot_m[:, None] + np.linspace(-5.0, 5.0, 16)[:, None] * left[:, None],
        state=np.column_stack([images_m, -away, offset_m, np.zeros(count)]),
        folded_m=folded_m, target_m=target_m, scene=scene,
        truth_m=folded_m + target_m, truth_scene=scene,
    )  # fmt: skip


def config(**changes: object) -> ResidualRunConfig:
    settings = {"epochs": 3, "batch_size": 32} | changes
    return ResidualRunConfig(
        training=TrainResidualConfig(**settings),  # type: ignore[arg-type]
        samples=SampleConfig(),
        data={"directory": "none"},
    )


@pytest.mark.slow
def test_learns_what_the_mirror_law_leaves_over(tmp_path: Path) -> None:
    """l1 is 0.8 + 0.6 m in wall coordinates without, F1 at 1 m near 0 for the places are 1 m off; found to 0.4 m."""
    training = ResidualTraining(config(epochs=12, learning_rate=3e-3), images(256), images(64, 1), tmp_path)
    best = training.run(lambda report: None)
    assert best.recovered_l1_m < 0.4 < best.recovered_l1_without_m
    assert best.recovered_f1 > 0.95


def test_seed_decides(tmp_path: Path) -> None:
    data = images(64), images(32, 1)
    runs = [ResidualTraining(config(epochs=1, seed=seed), *data, tmp_path / str(i)) for i, seed in enumerate((0, 0, 1))]
    one, same, other = (run.run(lambda report: None).train_loss for run in runs)
    assert one == same != other


def test_a_run_may_start_from_the_weights_of_another(tmp_path: Path) -> None:
    data = images(64), images(32, 1)
    first = ResidualTraining(config(epochs=1), *data, tmp_path / "first")
    first.run(lambda report: None)
    second = ResidualTraining(config(seed=1, init=str(tmp_path / "first" / BEST)), *data, tmp_path / "second")
    for name, wanted in first.network.state_dict().items():
        assert torch.equal(second.network.state_dict()[name], wanted), name
    with pytest.raises(ValueError, match=r"nowhere\.pt must be a checkpoint file"):
        ResidualTraining(config(init=str(tmp_path / "nowhere.pt")), *data, tmp_path / "third")


def test_loss_that_is_no_number_names_its_batch(tmp_path: Path) -> None:
    """97 images in batches of 32: the one with the broken patch, alone in scene 9, is in the epoch's batch."""
    data = images(97)
    data.patch_m[5, 2], data.scene[5] = np.nan, 9
    training = ResidualTraining(config(), data, images(32, 1), tmp_path)
    with pytest.raises(ValueError, match=r"loss must be finite, got nan in epoch 0, batch [0-3], of scenes .*9\]"):
        training.run(lambda report: None)


def test_images_beyond_reach_are_not_learned_from(tmp_path: Path) -> None:
    """A third of the images lie 20 m off, all the same way: with them in the loss the answer would move."""
    data = images(96)
    far = data.target_m.copy()
    far[::3] = [20.0, 0.0]
    runs = [
        ResidualTraining(config(reach_m=2.0), part, images(32, 1), tmp_path / name)
        for name, part in (("all", replace(data, target_m=far)), ("near", data.select(np.arange(96) % 3 > 0)))
    ]
    one, two = (run.run(lambda report: None) for run in runs)
    assert one.train_loss == two.train_loss


def test_loss_by_hand() -> None:
    """Errors (3, -4), (1, 1) and (0, 2) weighing 1, 0.5 and 0: (7 + 1) / 1.5; nothing where nothing weighs."""
    answer = torch.tensor([[3.0, -4.0], [1.0, 1.0], [0.0, 2.0]])
    assert residual_loss(answer, torch.zeros(3, 2), torch.tensor([1.0, 0.5, 0.0])).item() == pytest.approx(8.0 / 1.5)
    assert residual_loss(answer, torch.zeros(3, 2), torch.zeros(3)).item() == 0.0


def test_data_that_teaches_nothing_is_refused(tmp_path: Path) -> None:
    nothing = images(8)
    nothing.target_m[:] = np.nan
    with pytest.raises(ValueError, match=r"train scenes must give images within 2\.0 m of their true place, gave none"):
        ResidualTraining(config(), nothing, images(8), tmp_path)
    with pytest.raises(ValueError, match=r"validation scenes must give images"):
        ResidualTraining(config(), images(8), nothing, tmp_path)


@pytest.mark.parametrize("reach_m", [-1.0, float("nan")])
def test_a_reach_out_of_range_is_refused(reach_m: float) -> None:
    with pytest.raises(ValueError, match=rf"train\.reach_m must be positive, got {reach_m}"):
        config(reach_m=reach_m)


def test_export_says_what_the_file_is_and_how_good(tmp_path: Path) -> None:
    ResidualTraining(config(epochs=1), images(64), images(32, 1), tmp_path).run(lambda report: None)
    test = images(40, 2)
    card = export_residual_run(tmp_path, test, tmp_path / "residual.onnx", "the command")
    assert card == load_residual_card(tmp_path / "residual.onnx")
    assert (card.frame, card.source, card.command, card.parameters) == ("wall", "peaks", "the command", 120_706)
    assert card.training["chosen_epoch"] == 0
    assert msgspec.convert(card.training["config"], ResidualRunConfig) == config(epochs=1)
    assert card.metrics["images"] == card.metrics["images_within_reach"] == 40.0
    offsets_m = LearnedResidual(tmp_path / "residual.onnx")(test.reflection)
    wanted = np.abs(offsets_m - test.target_m).sum(axis=1).mean()
    assert card.metrics["l1_m"] == pytest.approx(wanted, abs=1e-4)
    assert card_path(tmp_path / "residual.onnx").exists()


def test_same_network_gives_the_same_file(tmp_path: Path) -> None:
    training = ResidualTraining(config(), images(32), images(16, 1), tmp_path / "run")
    one, two = (export_residual_onnx(training.network, tmp_path / name) for name in ("a.onnx", "b.onnx"))
    assert one == two
