"""Export of a trained network to the file and the card that the vehicle loads."""

from __future__ import annotations

import copy
import shutil
import tempfile
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import msgspec
import numpy as np
import onnxruntime
import torch
from torch import Tensor, nn

from lab.measures.point_scores import Counts
from lab.training.data.frames import DataSet, Frame, fixed_splits
from lab.training.data.samples import point_labels
from lab.training.export.quantize import quantize_int8
from lab.training.map_networks import FAMILIES, INPUTS
from lab.training.schedules import SCHEDULES
from lab.training.scoring import DetectionTally
from lab.training.train_dense import RunConfig, load_best, load_summary
from models.perception.find.encoding import Encoding, encode_map
from models.perception.find.onnx_model import ClassScores, DensePredictor, Fidelity, ModelCard, ScoresAt, card_path
from models.perception.find.peaks import PeakParams, pursued_points
from models.perception.trained_radar import TrainedRadar
from msgs.files.checksums import file_sha256, json_lines
from msgs.values.perception import PathClass
from msgs.values.wording import counted

OPSET = 17
#: Largest difference between torch and ONNX Runtime, in probability, that an fp32 export may show.
PARITY = 1e-4
#: Number of encoded maps for the parity check, beside random inputs.
PARITY_MAPS = 8

Precision = Literal["fp32", "fp16", "int8"]
Head = Literal["heatmap", "anchors"]


class Exported(nn.Module):
    """A network with the outputs of its file: probabilities of a heatmap, or logits and offsets of anchors.

    `half` computes in float16 inside; input and output are float32 either way.
    """

    def __init__(self, network: nn.Module, half: bool = False) -> None:
        super().__init__()
        self.network = copy.deepcopy(network).half() if half else network
        self.half_precision = half
        # only networks with anchors have a stride
        self.anchor_stride: int | None = getattr(network.config, "anchor_stride", None)
        self.head: Head = "heatmap" if self.anchor_stride is None else "anchors"
        self.eval()

    def forward(self, x: Tensor) -> Tensor:
        """Map encoded maps to answers."""
        answer = self.network(x.half() if self.half_precision else x).float()
        return torch.sigmoid(answer) if self.head == "heatmap" else answer


@dataclass(frozen=True, kw_only=True)
class ExportConfig:
    """Export of a run and the data that score it."""

    #: Data set of the run, for its splits and the card's text; None: the folder that the run names.
    data_dir: Path | None = None
    precision: Precision = "fp32"
    #: Encoded maps of the training split that set the ranges of int8.
    calibration_maps: int = 64


def export_onnx(model: Exported, path: Path, maps: Iterable[np.ndarray] = ()) -> str:
    """Write a network for one map at a time as ONNX; returns the file's sha256.

    Raises `ValueError` when, in fp32, ONNX Runtime's probabilities differ from torch's by more than 1e-4 over random
    inputs and the encoded `maps` [channels, range, columns].
    """
    config = model.network.config
    example = torch.zeros(1, config.in_channels, config.range_bins, config.columns)
    names = {"input_names": ["encoded"], "output_names": ["confidence" if model.head == "heatmap" else "answer"]}
    write_onnx(model, (example,), path, **names)
    if not model.half_precision and not (difference := parity(model, path, maps)) <= PARITY:
        raise ValueError(f"{path}: probabilities must agree with torch within {PARITY}, differ by {difference}")
    return file_sha256(path)


def write_onnx(network: nn.Module, example: tuple[Tensor, ...], path: Path, **names: Any) -> None:
    """Write a network as torch traces it with an example; `names` of its inputs, outputs and free axes."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with warnings.catch_warnings():
        # this exporter needs no further package; torch announces its successor at every call
        warnings.simplefilter("ignore")
        torch.onnx.export(network, example, str(path), dynamo=False, opset_version=OPSET, **names)


def parity(model: Exported, path: Path, maps: Iterable[np.ndarray] = ()) -> float:
    """Return the largest difference of the answers of torch and ONNX Runtime over random inputs and encoded maps."""
    shape = model.network.config.in_channels, model.network.config.range_bins, model.network.config.columns
    rng = np.random.default_rng(0)
    random = [(scale * rng.standard_normal(shape)).astype(np.float32) for scale in (0.0, 1.0, 10.0)]
    return largest_difference(model, path, [*random, *maps])


def largest_difference(model: Exported, path: Path, inputs: Iterable[np.ndarray]) -> float:
    """Return the largest difference of the answers of torch and of a file to inputs [channels, range, columns].

    Probabilities are compared, and offsets of anchors relative to the largest one (at least a cell).
    """
    session = onnxruntime.InferenceSession(path, providers=["CPUExecutionProvider"])
    differences = []
    for encoded in inputs:
        with torch.no_grad():
            expected = model(torch.from_numpy(encoded[None])).numpy()
        answer = session.run(None, {session.get_inputs()[0].name: encoded[None]})[0]
        differences.append(_difference(expected[0], answer[0], model.head))
    # a NaN makes the largest value NaN too
    return float(np.max(differences))


def _difference(expected: np.ndarray, answer: np.ndarray, head: Head) -> float:
    if head == "heatmap":
        return float(np.abs(answer - expected).max())
    classes = len(PathClass) + 1
    probabilities = [torch.softmax(torch.from_numpy(logits[:classes]), dim=0).numpy() for logits in (expected, answer)]
    largest_cells = max(1.0, float(np.abs(expected[classes:]).max()))
    offsets = np.abs(answer[classes:] - expected[classes:]).max() / largest_cells
    return float(max(np.abs(probabilities[0] - probabilities[1]).max(), offsets))


#: Thresholds to try for pursuit.
PURSUIT_THRESHOLDS = tuple(round(0.1 + 0.02 * step, 2) for step in range(16))


class _Scenes:
    """The run's data set with its splits, read and checked once."""

    def __init__(self, directory: Path) -> None:
        self.data, self.splits = DataSet(directory), fixed_splits(directory)

    @property
    def validation(self) -> Iterator[Frame]:
        """The frames of the validation split."""
        return self.data.frames(self.splits.of("validation"))


def export_run(
    run_dir: Path, model_path: Path, config: ExportConfig, report: Callable[[str], None] = lambda _: None
) -> ModelCard:
    """Export the best network of a run and write its card; the scores are those of the exported file.

    `report` receives the progress. Nothing is written at `model_path` before all is done. Raises `ValueError` if
    a folder holds no run or no data set, or when an fp32 export differs from torch.
    """
    require_onnx(model_path)
    network, run, epoch = load_best(run_dir)
    encoding = run.data.encoding
    scenes = _Scenes(config.data_dir or Path(run.data.directory))
    count = config.calibration_maps if config.precision == "int8" else PARITY_MAPS
    indices = np.random.default_rng(run.training.seed).permutation(scenes.splits.of("train"))[:count]
    maps = np.stack([encode_map(encoding, frame.ra_map) for frame in scenes.data.frames(indices)])
    model = Exported(network)
    with tempfile.TemporaryDirectory() as directory:
        reference, file = Path(directory) / "reference.onnx", Path(directory) / "export.onnx"
        report(f"exporting in {config.precision}")
        export_onnx(model, reference, maps[:PARITY_MAPS])
        _convert(model, reference, file, config.precision, maps)
        draft = _draft(model, run, encoding, epoch, run_dir, config)
        draft = msgspec.structs.replace(draft, radar=TrainedRadar.of(scenes.data.setup))
        for path in (reference, file):
            write_card(msgspec.structs.replace(draft, sha256=file_sha256(path)), path)
        tested = scenes.splits.of("test")
        report(f"scoring on {counted(len(tested), 'scene')}")
        paths = (file,) if config.precision == "fp32" else (reference, file)
        tallies = score_files(paths, scenes.data.frames(tested))
        exact, own = tallies[0], tallies[-1]
        if draft.head == "heatmap":
            report("choosing the threshold of pursuit on the validation scenes")
            draft = msgspec.structs.replace(draft, pursuit_threshold=best_pursuit_threshold(file, scenes.validation))
            write_card(msgspec.structs.replace(draft, sha256=file_sha256(file)), file)
        card = msgspec.structs.replace(
            draft,
            name=model_path.stem,
            sha256=file_sha256(file),
            scores=_scores(own),
            fidelity=Fidelity(
                largest_difference=largest_difference(model, file, maps[:PARITY_MAPS]),
                macro_f1_fp32=round(exact.macro_f1(), 4),
                lost_points=round(100.0 * (exact.macro_f1() - own.macro_f1()), 2),
                calibration_maps=len(maps) if config.precision == "int8" else 0,
            ),
            data={
                "training": _command(scenes.data.directory),
                "test_scenes": len(tested),
                "test": "its test split",
                "test_sha256": scenes.splits.test_sha256,
            },
        )
        model_path.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(file, model_path)
    write_card(card, model_path)
    return card


def export_scored(run_dir: Path, model_path: Path, tally: DetectionTally) -> ModelCard:
    """Export the best network of a run in fp32 at once: its card has the scores of `tally`, no probabilities, and does
    not say where the data came from.
    """
    network, run, epoch = load_best(run_dir)
    model = Exported(network)
    draft = _draft(model, run, run.data.encoding, epoch, run_dir, ExportConfig())
    card = msgspec.structs.replace(
        draft, name=model_path.stem, sha256=export_onnx(model, model_path), scores=_scores(tally)
    )
    write_card(card, model_path)
    return card


def write_card(card: msgspec.Struct, model_path: Path) -> None:
    """Write the card beside its network file."""
    card_path(model_path).write_bytes(json_lines(card))


def require_onnx(model_path: Path) -> None:
    """Raise `ValueError` unless a path names an ONNX file: its card takes the same name with .json."""
    if model_path.suffix != ".onnx":
        raise ValueError(f"{model_path} must end with .onnx, ends with {model_path.suffix!r}")


def score_files(paths: Sequence[Path], frames: Iterable[Frame]) -> list[DetectionTally]:
    """Return detections of exported files, as the vehicle runs them, over the same frames."""
    predictors = [DensePredictor(path) for path in paths]
    tallies = [DetectionTally(predictor.card.grid) for predictor in predictors]
    for frame in frames:
        for predictor, tally in zip(predictors, tallies, strict=True):
            points = predictor.points(frame.ra_map, min(tally.counts), PeakParams().min_distance)
            tally.add(points, point_labels(frame.labels, frame.ra_map.grid))
    return tallies


def _convert(model: Exported, reference: Path, file: Path, precision: Precision, maps: np.ndarray) -> None:
    """Write the file of a precision, from the network or from its fp32 export."""
    if precision == "int8":
        quantize_int8(reference, file, maps)
    elif precision == "fp16":
        export_onnx(Exported(model.network, half=True), file)
    else:
        shutil.copyfile(reference, file)


def _draft(
    model: Exported, run: RunConfig, encoding: Encoding, epoch: int, run_dir: Path, config: ExportConfig
) -> ModelCard:
    """Return the card without the results of the file and its scores."""
    training = run.training
    draft = ModelCard(
        name=run_dir.name,
        sha256="",
        parameters=sum(parameter.numel() for parameter in model.network.parameters()),
        network=training.network.family,
        precision=config.precision,
        head=model.head,
        anchor_stride=model.anchor_stride or 1,
        encoding=encoding,
        grid=run.data.grid,
        input_shape=(1, *encoding.shape),
        output_shape=(),
        threshold=load_summary(run_dir).best.best_threshold,
        scores=(),
        data={},
        training={
            "command": _training_command(run, run_dir),
            "chosen_epoch": epoch,
            "config": msgspec.json.decode(msgspec.json.encode(run)),
        },
    )
    return msgspec.structs.replace(draft, output_shape=draft.answer_shape)


def _training_command(run: RunConfig, run_dir: Path) -> str:
    """Return the command of a run as far as its folder states it; `config` on the card is complete."""
    if run.command:
        return run.command
    choice, schedule = run.training.network, run.training.schedule
    resolved, channels = choice.resolved, run.data.encoding.channels
    sizes = FAMILIES[choice.family].sizes.items()
    size = next((name for name, preset in sizes if replace(preset, in_channels=len(channels)) == resolved), "")
    inputs = next((name for name, preset in INPUTS.items() if preset == channels), "")
    options = {
        "data": run.data.directory,
        "out": run_dir,
        "network": f"{choice.family}:{size}".rstrip(":"),
        "input": inputs,
        "objective": run.training.objective.kind,
        "schedule": next((name for name, preset in SCHEDULES.items() if preset.kind == schedule.kind), ""),
        "epochs": schedule.epochs,
        "batch-size": schedule.batch_size,
        "learning-rate": schedule.learning_rate,
        "init": run.training.init,
        "seed": run.training.seed,
    }
    given = "".join(f" --{name} {value}" for name, value in options.items() if value != "")
    return "mirrorwave train dense" + given + "".join(f" --more {folder}" for folder in run.data.more)


def best_pursuit_threshold(file: Path, frames: Iterable[Frame]) -> float:
    """Return the threshold of the best Macro-F1 of peaks by pursuit, the lowest of equals."""
    predictor = DensePredictor(file)
    tally = DetectionTally(predictor.card.grid, PURSUIT_THRESHOLDS)
    for frame in frames:
        points = pursued_points(predictor.predict(frame.ra_map), PURSUIT_THRESHOLDS[0])
        tally.add(points, point_labels(frame.labels, frame.ra_map.grid))
    return max(PURSUIT_THRESHOLDS, key=tally.macro_f1)


def _scores(tally: DetectionTally) -> tuple[ScoresAt, ...]:
    def of(counts: Counts) -> ClassScores:
        return ClassScores(precision=round(counts.precision, 4), recall=round(counts.recall, 4), f1=round(counts.f1, 4))

    return tuple(
        ScoresAt(
            threshold=threshold,
            macro_f1=round(tally.macro_f1(threshold), 4),
            los=of(counts[PathClass.LOS]),
            mirrored=of(counts[PathClass.MIRRORED]),
        )
        for threshold, counts in tally.counts.items()
    )


#: Entries of a series that the command takes, and their options.
_RECIPE = {
    "places": "--places",
    "preset": "--preset",
    "effects": "--effects",
    "budget_db": "--budget-db",
    "purpose": "--for",
}


def _command(data_dir: Path) -> str:
    """Return the command that makes a data set again, from its folder's metadata."""
    try:
        series = msgspec.json.decode((data_dir / "series.json").read_bytes())
        if series.get("format") == "maps":
            return f"maps made elsewhere, imported to {data_dir}"
        shards = (data_dir / "manifest.jsonl").read_bytes().splitlines()
        count = sum(msgspec.json.decode(line)["scenes"] for line in shards)
    except (OSError, KeyError, msgspec.DecodeError) as error:
        raise ValueError(f"{data_dir} must hold a whole data set: {error}") from None
    # of drives, the manifest counts scans
    scans = series.get("scans")
    motion = "" if scans is None else f" --motion --scans {scans}"
    command = f"mirrorwave sim dataset --out {data_dir} --count {count // (scans or 1)} --seed {series['seed']}{motion}"
    recipe = {key: series[key] for key in _RECIPE if key in series}
    if recipe.get("effects") == "auto":
        # series from before purposes, or that named none, were of samples
        recipe.setdefault("purpose", "samples")
    return command + "".join(f" {_RECIPE[key]} {value}" for key, value in recipe.items())
