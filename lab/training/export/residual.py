"""Export of a trained residual network to the file and the card that the geometry stage loads."""

from __future__ import annotations

import shutil
import tempfile
from pathlib import Path

import msgspec
import numpy as np
import torch

from lab.networks.residual_reflect_net import ResidualReflectNet
from lab.training.data.residual_samples import FoldedImages, RecoveredScores, recovered_scores
from lab.training.export.onnx import require_onnx, write_card, write_onnx
from lab.training.train_residual import ResidualRunConfig, load_best_residual, network_offsets
from models.perception.mirrors.recovery import NEIGHBOURS
from models.perception.mirrors.residual_model import INPUTS, LearnedResidual, ResidualCard
from msgs.files.checksums import file_sha256

#: Largest difference between torch and ONNX Runtime, in metres, that an export may show.
PARITY_M = 1e-3


def export_residual_onnx(network: ResidualReflectNet, path: Path) -> str:
    """Write a network for any number of images as ONNX fp32; returns the file's sha256."""
    # two, because a batch of one may be folded into the graph
    example = (torch.zeros(2, 2), torch.zeros(2, NEIGHBOURS, 2), torch.zeros(2, 6))
    axes = {name: {0: "images"} for name in (*INPUTS, "residual")}
    names = {"input_names": list(INPUTS), "output_names": ["residual"], "dynamic_axes": axes}
    write_onnx(network.eval(), example, path, **names)
    return file_sha256(path)


def export_residual_run(run_dir: Path, test: FoldedImages, model_path: Path, command: str = "") -> ResidualCard:
    """Export the best network of a run and write its card, with the file's own scores on the images of test scenes.

    Nothing is written at `model_path` before all is done. Raises `ValueError` if the folder holds no run, or when
    the file's residuals differ from torch's by more than 1e-3 m.
    """
    require_onnx(model_path)
    network, run, epoch = load_best_residual(run_dir)
    with tempfile.TemporaryDirectory() as directory:
        file = Path(directory) / model_path.name
        draft = _draft(network, run, epoch, export_residual_onnx(network, file), model_path.stem, command)
        write_card(draft, file)
        offsets_m = LearnedResidual(file)(test.reflection)
        _check_parity(model_path, offsets_m, network_offsets(network, test))
        model_path.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(file, model_path)
    card = msgspec.structs.replace(draft, metrics=_metrics(test, offsets_m, run.training.reach_m))
    write_card(card, model_path)
    return card


def _draft(
    network: ResidualReflectNet, run: ResidualRunConfig, epoch: int, sha256: str, name: str, command: str
) -> ResidualCard:
    """Return the card without scores."""
    return ResidualCard(
        name=name,
        sha256=sha256,
        parameters=sum(parameter.numel() for parameter in network.parameters()),
        frame="wall",
        neighbours=NEIGHBOURS,
        source="peaks",
        geometry="published",
        seed=run.training.seed,
        command=command,
        data=dict(run.data),
        metrics={},
        training={"chosen_epoch": epoch, "config": msgspec.json.decode(msgspec.json.encode(run))},
    )


def _check_parity(path: Path, offsets_m: np.ndarray, wanted_m: np.ndarray) -> None:
    difference_m = float(np.abs(offsets_m - wanted_m).max(initial=0.0))
    if difference_m > PARITY_M:
        raise ValueError(f"{path}: residuals must agree with torch within {PARITY_M} m, differ by {difference_m}")


def _metrics(test: FoldedImages, offsets_m: np.ndarray, reach_m: float) -> dict[str, float]:
    """Return scores with and without the residual, and the number of their images."""

    def suffixed(scores: RecoveredScores, suffix: str) -> dict[str, float]:
        return {name + suffix: round(value, 4) for name, value in msgspec.structs.asdict(scores).items()}

    sizes = {
        "scenes": float(len(np.union1d(test.scene, test.truth_scene))),
        "images": float(len(test)),
        "images_within_reach": float(test.within(reach_m).sum()),
    }
    without = recovered_scores(test, np.zeros_like(test.folded_m), reach_m)
    return sizes | suffixed(recovered_scores(test, offsets_m, reach_m), "") | suffixed(without, "_without")
