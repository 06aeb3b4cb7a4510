"""Training of the object network on made cells: an object wherever one channel is loud."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np
import pytest
import torch

from models.evaluation.object_rows import ReportRow, ScanRow
from models.networks.object_unet import ObjectUNet
from models.perception.detection.encoding import Encoding
from models.perception.detection.score_calibration import calibrated
from models.perception.geometry.mirrors import WallArrays
from models.perception.objects.answers import ANSWERS
from models.perception.objects.encoding import ObjectEncoding
from models.perception.objects.hypotheses import HYPOTHESES
from models.perception.objects.predictor import ObjectPredictor, load_object_card
from models.training.data.frames import FrameLabels
from models.training.data.object_samples import ObjectSample, ObjectTargets
from models.training.data.object_store import StoredSample, save_samples
from models.training.export.objects import export_objects_run
from models.training.exported_weights import load_exported
from models.training.object_probabilities import probability_table
from models.training.object_scoring import ObjectTally
from models.training.objectives.objects import (
    ObjectLossConfig,
    TrueHypotheses,
    existence_loss,
    laplace_loss,
    object_loss,
)
from models.training.run_folder import LAST
from models.training.schedules import ScheduleConfig
from models.training.train_objects import ObjectRunConfig, ObjectTraining, TrainObjectsConfig, load_best_objects
from msgs.values.perception import PathClass, TruthObject
from msgs.values.radar import RangeAzimuthGrid

#: A small map: 16 rows of two bins, 8 columns.
ENCODING = ObjectEncoding(
    levels=Encoding(range_bins=32, columns=8), grid=RangeAzimuthGrid(range_bins=32, azimuth_bins=64)
)
WALL = WallArrays(
    normal=np.array([[-1.0, 0.0]]), offset_m=np.array([1.0]), a=np.array([[1.0, -9.0]]), b=np.array([[1.0, 9.0]]),
    angle_std_rad=np.zeros(1), offset_std_m=np.zeros(1), curvature_per_m=np.zeros(1),
)  # fmt: skip


def stored(rng: np.random.Generator) -> StoredSample:
    """One object behind the wall x = 1 m, at a random cell that the first channel says; its image is a point."""
    _, rows, columns = ENCODING.shape
    row, column = int(rng.integers(8, rows - 2)), int(rng.integers(2, columns - 2))
    cells = rng.normal(0.0, 0.1, ENCODING.shape).astype(np.float16)
    cells[0, row, column] = 3.0
    range_m, azimuth_rad = ENCODING.cells.range_m[row], ENCODING.cells.azimuth_rad[column]
    image_m = range_m * np.array([np.cos(azimuth_rad), np.sin(azimuth_rad)])
    true_m = np.array([2.0 - image_m[0], image_m[1]])
    wall = np.full((HYPOTHESES, rows, columns), -1, np.int16)
    wall[0] = 0
    pair = np.zeros((1, 2), np.float32)
    targets = ObjectTargets(
        np.array([[0, row, column]]), np.zeros(1, int), np.full(1, 2), pair, pair + np.float32(0.5), pair, pair
    )
    labels = FrameLabels(
        range_m=np.array([range_m]), azimuth_rad=np.array([azimuth_rad]),
        path_class=np.array([PathClass.MIRRORED], np.uint8), order=np.ones(1, int), hidden_xy_m=true_m[None],
        power_mw=np.ones(1), object_index=np.zeros(1, int), object_class=np.array(["car"]),
    )  # fmt: skip
    car = TruthObject(
        id=0, object_class="car", x_m=float(true_m[0]), y_m=float(true_m[1]), length_m=1.6, width_m=1.6, yaw_rad=0.0,
        hidden=True,
    )  # fmt: skip
    sample = ObjectSample(cells, wall, np.full_like(wall, -1), targets)
    return StoredSample(sample, WALL, labels, (car,), 1e-3, np.zeros(columns, int), ego_compensated=False)


@pytest.fixture
def files(tmp_path: Path) -> list[Path]:
    rng = np.random.default_rng(0)
    paths = [tmp_path / f"samples-{index:05d}.npz" for index in range(2)]
    for path in paths:
        save_samples(path, [stored(rng) for _ in range(16)])
    return paths


DATA = {"train": "a b", "validation": "c", "detector": "peaks.onnx"}


def config(epochs: int) -> ObjectRunConfig:
    schedule = ScheduleConfig(epochs=epochs, batch_size=8, learning_rate=1e-2, weight_decay=0.0, clip_norm=5.0)
    training = TrainObjectsConfig(widths=(8, 8, 16, 16), schedule=schedule)
    return ObjectRunConfig(training=training, encoding=ENCODING, data=DATA)


@pytest.mark.slow
def test_it_learns_where_objects_are(files: list[Path], tmp_path: Path) -> None:
    """Of 16 validation scans nearly all objects are found, within the cell that says them, with few false reports."""
    best = ObjectTraining(config(40), files[:1], files[1:], tmp_path / "run").run()
    assert best.recall >= 0.8
    assert best.false_per_scan <= 0.2
    network, run, epoch = load_best_objects(tmp_path / "run")
    assert (run, epoch) == (config(40), best.epoch)
    with torch.no_grad():
        answer = network(torch.zeros(1, *ENCODING.shape))
    assert answer.shape == (1, HYPOTHESES * ANSWERS, *ENCODING.shape[1:])
    exported = tmp_path / "object_unet.onnx"
    card = export_objects_run(tmp_path / "run", files[1:], exported)
    assert (card.name, card.training["chosen_epoch"], card.scores["scans"]) == ("object_unet", best.epoch, 16.0)
    assert card.training["command"] == (
        f"mirrorwave train objects --data a --data b --validation c --out {tmp_path / 'run'} --model peaks.onnx"
        " --epochs 40 --batch-size 8 --learning-rate 0.01 --seed 0"
    )
    # finer thresholds than the run's own choose at least as well
    assert card.scores["loss_per_scan"] <= best.loss_per_scan + 1e-4
    assert ObjectPredictor(exported).card == card == load_object_card(exported)


def exported_network(files: list[Path], folder: Path) -> Path:
    """A network of one epoch, exported."""
    ObjectTraining(config(1), files[:1], files[1:], folder / "run").run()
    path = folder / "object_unet.onnx"
    export_objects_run(folder / "run", files[1:], path)
    return path


def object_network(run: ObjectRunConfig) -> ObjectUNet:
    torch.manual_seed(5)
    return ObjectUNet(run.network)


def test_a_training_goes_on_from_an_exported_network(files: list[Path], tmp_path: Path) -> None:
    """Before the first step it answers what the file answers, whatever new channels show; its norms then learn on."""
    path = exported_network(files, tmp_path)
    wider = msgspec.structs.replace(ENCODING, speeds=True)
    run = replace(config(1), encoding=wider)
    network = object_network(run)
    load_exported(network, path)
    cells = np.random.default_rng(2).standard_normal(wider.shape).astype(np.float32)
    with torch.no_grad():
        said = network.eval()(torch.from_numpy(cells[None]))[0].numpy()
    np.testing.assert_allclose(said, ObjectPredictor(path).look(cells[: ENCODING.shape[0]]), atol=1e-4)

    started = replace(config(1), training=replace(config(1).training, start=str(path)))
    training = ObjectTraining(started, files[:1], files[1:], tmp_path / "more")
    with torch.no_grad():
        settled = training.network.eval()(torch.from_numpy(cells[None, : ENCODING.shape[0]]))[0].numpy()
    np.testing.assert_allclose(settled, said, atol=1e-3)
    before = {name: tensor.clone() for name, tensor in training.network.state_dict().items()}
    training.run()
    after = training.network.state_dict()
    assert not any(torch.equal(before[name], after[name]) for name in before if "running_mean" in name)
    assert not torch.equal(before["stem.0.weight"], after["stem.0.weight"])


def test_a_start_of_another_shape_is_refused(files: list[Path], tmp_path: Path) -> None:
    path = exported_network(files, tmp_path)
    narrow = replace(config(1), training=replace(config(1).training, widths=(8, 8, 8, 8)))
    with pytest.raises(ValueError, match=r"object_unet\.onnx: start must be a network of this shape"):
        load_exported(object_network(narrow), path)
    with pytest.raises(ValueError, match=r"nothing\.json: No such file"):
        load_exported(object_network(config(1)), tmp_path / "nothing.onnx")


@pytest.mark.slow
def test_a_run_that_was_killed_ends_with_the_same_weights(files: list[Path], tmp_path: Path) -> None:
    whole = ObjectTraining(config(3), files[:1], files[1:], tmp_path / "whole")
    whole.run()
    stopped = ObjectTraining(config(3), files[:1], files[1:], tmp_path / "stopped")

    def stop(report: object) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        stopped.run(stop)
    assert (tmp_path / "stopped" / LAST).exists()
    resumed = ObjectTraining(config(3), files[:1], files[1:], tmp_path / "stopped")
    assert len(resumed.reports) == 1
    resumed.run()
    assert resumed.reports == whole.reports
    for name, tensor in whole.network.state_dict().items():
        assert torch.equal(tensor, resumed.network.state_dict()[name]), name


def test_existence_is_a_focal_loss_worked_out_by_hand() -> None:
    """At an object p = 0.8: (0.2)^2 ln 0.8; beside it, target 0.5 and p = 0.3: 0.5^4 0.3^2 ln 0.7."""
    logits = torch.logit(torch.tensor([0.8, 0.3]))
    wanted = -(0.2**2 * np.log(0.8) + 0.5**4 * 0.3**2 * np.log(0.7))
    assert existence_loss(logits, torch.tensor([1.0, 0.5])).item() == pytest.approx(wanted, rel=1e-5)


def test_laplace_loss_is_least_at_the_true_deviation() -> None:
    """Errors of mean magnitude m have a standard deviation of sqrt(2) m under Laplace's law."""
    error_m = torch.tensor([[0.1], [-0.3]])
    at = [
        laplace_loss(error_m, torch.full((2, 1), np.log(std)), torch.zeros(2, 1)).item() for std in (0.2, 0.2828, 0.4)
    ]
    assert at[1] == min(at)


def test_without_an_object_only_existence_counts() -> None:
    answer = torch.zeros(1, HYPOTHESES * ANSWERS, 4, 4)
    heat = torch.zeros(1, HYPOTHESES, 4, 4)
    nothing = TrueHypotheses(
        torch.zeros((0, 4), dtype=torch.int64), torch.zeros(0, dtype=torch.int64), *[torch.zeros(0, 2)] * 4
    )
    loss = object_loss(answer, heat, nothing, ObjectLossConfig())
    assert loss.item() == pytest.approx(HYPOTHESES * 16 * 0.25 * np.log(2.0), rel=1e-5)


def test_numbers_that_are_not_finite_end_the_run_by_name(files: list[Path], tmp_path: Path) -> None:
    bad = stored(np.random.default_rng(1))
    bad.sample.cells[0, 0, 0] = np.nan
    save_samples(tmp_path / "bad.npz", [bad] * 8)
    training = ObjectTraining(config(1), [tmp_path / "bad.npz"], files[1:], tmp_path / "run")
    with pytest.raises(ValueError, match="loss must be finite, got nan in epoch 0, batch 0"):
        training.run()


def test_a_batch_larger_than_the_data_is_refused(files: list[Path], tmp_path: Path) -> None:
    save_samples(tmp_path / "few.npz", [stored(np.random.default_rng(1))] * 3)
    with pytest.raises(ValueError, match="batch_size must be at most the 3 scans, got 8"):
        ObjectTraining(config(1), [tmp_path / "few.npz"], files[1:], tmp_path / "run")


def test_calibration_counts_reports_that_are_objects() -> None:
    """200 reports at 0.3 of which 60 are objects, 200 at 0.7 of which 160 are: those shares, one of each kind added."""
    tally = ObjectTally(ENCODING, [0.1])
    for score, true in ((0.3, 60), (0.7, 160)):
        reports = [
            ReportRow(score=score, found=index < true, error_m=None, centre_m=None, box_m=None) for index in range(200)
        ]
        tally.rows[0.1].append(ScanRow(place=len(tally.rows[0.1]), scan=0, hidden=[], reports=reports))
    table = probability_table(tally.rows)
    at = calibrated(table, np.array([0.3, 0.7]))
    np.testing.assert_allclose(at, [0.3, 0.8], atol=0.05)


def test_a_fainter_report_takes_no_object_from_a_surer_one() -> None:
    """In each of 100 scans a report at 0.75 finds the object where lists begin at 0.5; in 40 one at 0.15 lies nearer
    and takes it where they begin at 0.1. Each counts in its own list: 0.4 and 1, one of each kind added to groups.
    """
    tally = ObjectTally(ENCODING, [0.1, 0.5])

    def report(score: float, found: bool) -> ReportRow:
        return ReportRow(score=score, found=found, error_m=None, centre_m=None, box_m=None)

    for scan in range(100):
        nearer = scan % 5 < 2
        both = [report(0.75, not nearer), report(0.15, nearer)]
        tally.rows[0.1].append(ScanRow(place=scan, scan=0, hidden=[], reports=both))
        tally.rows[0.5].append(ScanRow(place=scan, scan=0, hidden=[], reports=[report(0.75, True)]))
    at = calibrated(probability_table(tally.rows), np.array([0.15, 0.75]))
    np.testing.assert_allclose(at, [0.4, 0.97], atol=0.03)
