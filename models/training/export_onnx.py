"""From a trained network to the file and the card that the vehicle loads."""

from __future__ import annotations

import hashlib
import warnings
from pathlib import Path

import msgspec
import numpy as np
import onnxruntime
import torch
from torch import Tensor, nn

from models.networks.compact_unet import CompactUNet
from models.perception.encoding import encode_columns
from models.perception.metrics import Counts
from models.perception.onnx_model import ClassScores, ModelCard, ScoresAt, card_path
from models.training.datasets import DenseSample, load_samples
from models.training.scoring import DEFAULT_THRESHOLD, DetectionTally
from models.training.train_dense import RunConfig, load_best
from msgs.perception import PathClass

OPSET = 17
#: Largest difference between torch and ONNX Runtime, in probability, that an export may show.
PARITY = 1e-4


class Confidence(nn.Module):
    """The network with its sigmoid: what is exported answers probabilities."""

    def __init__(self, network: CompactUNet) -> None:
        super().__init__()
        self.network = network

    def forward(self, x: Tensor) -> Tensor:
        """Encoded maps to probabilities."""
        return torch.sigmoid(self.network(x))


def export_onnx(network: CompactUNet, path: Path) -> str:
    """Write a network for one map at a time as ONNX fp32, checked against torch; returns the file's sha256.

    Raises `ValueError` when ONNX Runtime's probabilities differ from torch's by more than 1e-4.
    """
    config = network.config
    model = Confidence(network).eval()
    example = torch.zeros(1, config.in_channels, config.range_bins, config.columns)
    path.parent.mkdir(parents=True, exist_ok=True)
    with warnings.catch_warnings():
        # the exporter that needs no further package; torch announces its successor at every call
        warnings.simplefilter("ignore")
        torch.onnx.export(
            model,
            (example,),
            str(path),
            dynamo=False,
            opset_version=OPSET,
            input_names=["encoded"],
            output_names=["confidence"],
        )
    difference = parity(model, path)
    if difference > PARITY:
        raise ValueError(f"{path}: probabilities must agree with torch within {PARITY}, differ by {difference}")
    return hashlib.sha256(path.read_bytes()).hexdigest()


def parity(model: nn.Module, path: Path, seed: int = 0) -> float:
    """Largest difference of the probabilities of torch and ONNX Runtime over random inputs."""
    session = onnxruntime.InferenceSession(path, providers=["CPUExecutionProvider"])
    entry = session.get_inputs()[0]
    rng = np.random.default_rng(seed)
    differences = []
    for scale in (0.0, 1.0, 10.0):
        encoded = (scale * rng.standard_normal(entry.shape)).astype(np.float32)
        with torch.no_grad():
            wanted = model(torch.from_numpy(encoded)).numpy()
        differences.append(float(np.abs(session.run(None, {entry.name: encoded})[0] - wanted).max()))
    return max(differences)


def export_run(run_dir: Path, test_dir: Path, model_path: Path, data_dir: Path) -> ModelCard:
    """Export the best network of a run and write its card, with its scores on the scenes of `test_dir`.

    The scores are those of the exported file. `data_dir` is the data set the run was trained on: the card tells how it
    was made. Raises `ValueError` where a folder holds no run or no data set, or when the export differs from torch.
    """
    network, run, epoch = load_best(run_dir)
    samples = load_samples(test_dir, run.data)
    sha256 = export_onnx(network, model_path)
    card = ModelCard(
        name=model_path.stem,
        sha256=sha256,
        parameters=sum(parameter.numel() for parameter in network.parameters()),
        encoding=run.data.encoding,
        grid=run.data.grid,
        input_shape=(1, *run.data.encoding.shape),
        output_shape=(1, len(PathClass), run.data.encoding.range_bins, run.data.grid.azimuth_bins),
        threshold=DEFAULT_THRESHOLD,
        scores=_scores(_tally(model_path, samples, run)),
        data={"training": _command(data_dir), "test": _command(test_dir), "test_scenes": len(samples)},
        training={
            "command": f"mirrorwave train dense --data {data_dir} --out {run_dir} --epochs {run.training.epochs} "
            f"--seed {run.training.seed}",
            "chosen_epoch": epoch,
            "config": msgspec.json.decode(msgspec.json.encode(run)),
        },
    )
    write_card(card, model_path)
    return card


def write_card(card: ModelCard, model_path: Path) -> None:
    """Write the card beside its network file."""
    card_path(model_path).write_bytes(msgspec.json.format(msgspec.json.encode(card), indent=2) + b"\n")


def _tally(model_path: Path, samples: list[DenseSample], run: RunConfig) -> DetectionTally:
    """Detections of an exported file, as the vehicle runs it."""
    session = onnxruntime.InferenceSession(model_path, providers=["CPUExecutionProvider"])
    tally = DetectionTally(run.data.grid)
    for sample in samples:
        encoded = encode_columns(run.data.encoding, sample.columns, np.array(sample.noise_power_mw))
        tally.add(session.run(None, {session.get_inputs()[0].name: encoded[None]})[0][0], sample.labels)
    return tally


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


#: What a series says of itself and the command takes.
_RECIPE = ("places", "preset", "effects", "budget_db")


def _command(data_dir: Path) -> str:
    """The command that makes a data set again, from what its folder says."""
    try:
        series = msgspec.json.decode((data_dir / "series.json").read_bytes())
        shards = (data_dir / "manifest.jsonl").read_bytes().splitlines()
        count = sum(msgspec.json.decode(line)["scenes"] for line in shards)
    except (OSError, KeyError, msgspec.DecodeError) as error:
        raise ValueError(f"{data_dir} must hold a whole data set: {error}") from None
    command = f"mirrorwave sim dataset --out {data_dir} --count {count} --seed {series['seed']}"
    # folders from before series named their recipe hold the first generator's streets
    recipe = {"places": "street_v1"} | {key: series[key] for key in _RECIPE if key in series}
    return command + "".join(f" --{key.replace('_', '-')} {value}" for key, value in recipe.items())
