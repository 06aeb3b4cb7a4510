"""Export of a trained object network to the file and the card that the vehicle loads."""

from __future__ import annotations

import shutil
import tempfile
from pathlib import Path

import msgspec
import numpy as np
import torch
from scipy.special import expit

from models.networks.object_unet import ObjectUNet
from models.perception.detection.detectors import NetworkDetector
from models.perception.detection.onnx_model import DEFAULT_MODEL
from models.perception.objects.answers import ANSWERS
from models.perception.objects.hypotheses import HYPOTHESES
from models.perception.objects.predictor import ObjectCard, ObjectPredictor
from models.training.data.frames import DataSet
from models.training.data.object_samples import SampleMaker
from models.training.data.object_store import load_samples
from models.training.export.onnx import require_onnx, write_card, write_onnx
from models.training.export.quantize import quantize_int8
from models.training.files import file_sha256
from models.training.object_probabilities import with_probabilities
from models.training.train_objects import ObjectRunConfig, load_best_objects

#: Largest difference of an answer between torch and ONNX Runtime, relative to the largest answer.
PARITY = 1e-4
#: Scans of the parity check.
PARITY_SCANS = 4


def export_objects_run(run_dir: Path, validation: list[Path], model_path: Path) -> ObjectCard:
    """Export the best network of a run and write its card: threshold, calibration and scores by the exported file on
    files of validation samples.

    Raises `ValueError` if the folder holds no run, or where the file answers otherwise than torch.
    """
    require_onnx(model_path)
    network, run, epoch = load_best_objects(run_dir)
    with tempfile.TemporaryDirectory() as directory:
        file = Path(directory) / model_path.name
        write_onnx(
            network, (torch.zeros(1, *run.encoding.shape),), file, input_names=["cells"], output_names=["answer"]
        )
        draft = _draft(network, run, epoch, file_sha256(file), model_path.stem, _command(run, run_dir))
        write_card(draft, file)
        _check_parity(model_path, network, ObjectPredictor(file), validation)
        card = with_probabilities(draft, ObjectPredictor(file, flip_test=True), validation, run.training.false_cost)
        model_path.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(file, model_path)
    write_card(card, model_path)
    return card


def quantize_objects(source: Path, data: DataSet, count: int, model_path: Path) -> ObjectCard:
    """Write an exported object network in 8-bit integers, its ranges set on the first `count` scans of a data set that
    it was trained on, and its card: threshold and tables are those of the source.

    Raises `ValueError` naming a source that is no object network, or a data set of another radar.
    """
    require_onnx(model_path)
    exact = ObjectPredictor(source)
    card = exact.card
    maker = SampleMaker(card.encoding, NetworkDetector(data.setup, DEFAULT_MODEL))
    scans = range(min(count, len(data)))
    cells = [maker.sample(frame.ra_map, frame.labels, frame.truth or ())[0].cells for frame in data.frames(scans)]
    inputs = np.stack(cells).astype(np.float32)
    with tempfile.TemporaryDirectory() as directory:
        file = Path(directory) / model_path.name
        quantize_int8(source, file, inputs)
        command = (
            f"mirrorwave export {source} --precision int8 --data {data.directory} --calibration {count} "
            f"--out {model_path}"
        )
        card = msgspec.structs.replace(
            card,
            name=model_path.stem,
            sha256=file_sha256(file),
            training={**card.training, "quantized": {"command": command, "source_sha256": card.sha256}},
            scores={},
        )
        write_card(card, file)
        difference = _probability_difference(exact, ObjectPredictor(file), inputs)
        card = msgspec.structs.replace(card, scores={"largest_probability_difference": round(difference, 4)})
        model_path.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(file, model_path)
    write_card(card, model_path)
    return card


def _probability_difference(exact: ObjectPredictor, rounded: ObjectPredictor, inputs: np.ndarray) -> float:
    """Return the largest difference of a probability of existence over inputs [N, channels, rows, columns]."""
    answers = [
        [expit(predictor.answer(cells).reshape(HYPOTHESES, ANSWERS, *cells.shape[1:])[:, 0]) for cells in inputs]
        for predictor in (exact, rounded)
    ]
    return float(np.abs(np.array(answers[0]) - np.array(answers[1])).max())


def _command(run: ObjectRunConfig, run_dir: Path) -> str:
    """Return the command of a run."""
    schedule, data = run.training.schedule, run.data
    folders = "".join(f" --data {path}" for path in data["train"].split())
    folders += "".join(f" --validation {path}" for path in data["validation"].split())
    options = (
        f" --epochs {schedule.epochs} --batch-size {schedule.batch_size} --learning-rate {schedule.learning_rate:g}"
    )
    options += f" --start {run.training.start}" if run.training.start else ""
    options += f" --seed {run.training.seed}{'' if run.training.mixed_precision else ' --full-precision'}"
    return f"mirrorwave train objects{folders} --out {run_dir} --model {data['detector']}{options}"


def _draft(network: ObjectUNet, run: ObjectRunConfig, epoch: int, sha256: str, name: str, command: str) -> ObjectCard:
    """Return the card without scores."""
    config = network.config
    return ObjectCard(
        name=name,
        sha256=sha256,
        parameters=sum(parameter.numel() for parameter in network.parameters()),
        encoding=run.encoding,
        radar=run.radar,
        input_shape=(1, config.in_channels, config.rows, config.columns),
        output_shape=(1, config.hypotheses * config.answers, config.rows, config.columns),
        threshold=0.0,
        calibration=(),
        scores={},
        data=dict(run.data),
        training={
            "command": command,
            "chosen_epoch": epoch,
            "config": msgspec.json.decode(msgspec.json.encode(run.training)),
        },
    )


def _check_parity(path: Path, network: ObjectUNet, predictor: ObjectPredictor, files: list[Path]) -> None:
    for stored in load_samples(files[0])[:PARITY_SCANS]:
        cells = stored.sample.cells.astype(np.float32)
        with torch.no_grad():
            wanted = network(torch.from_numpy(cells[None]))[0].numpy()
        difference = float(np.abs(predictor.look(cells) - wanted).max() / np.abs(wanted).max())
        if not difference <= PARITY:
            raise ValueError(f"{path}: answers must agree with torch within {PARITY}, differ by {difference}")
