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
from models.perception.onnx_model import ModelCard, card_path

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


def write_card(card: ModelCard, model_path: Path) -> None:
    """Write the card beside its network file."""
    card_path(model_path).write_bytes(msgspec.json.format(msgspec.json.encode(card), indent=2) + b"\n")
