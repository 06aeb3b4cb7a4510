from __future__ import annotations

from pathlib import Path

import numpy as np
import onnxruntime
import pytest
import torch
from torch import nn

from models.networks.compact_unet import CompactUNet, CompactUNetConfig
from models.training.export_onnx import PARITY, Confidence, export_onnx, parity

CONFIG = CompactUNetConfig(range_bins=32, columns=8, widths=(8, 16), attention_heads=2, attention_blocks=1)


@pytest.fixture
def network() -> CompactUNet:
    torch.set_num_threads(1)
    torch.manual_seed(0)
    return CompactUNet(CONFIG).eval()


def test_export_has_fixed_shapes_and_answers_probabilities(network: CompactUNet, tmp_path: Path) -> None:
    path = tmp_path / "net.onnx"
    export_onnx(network, path)
    session = onnxruntime.InferenceSession(path)
    assert session.get_inputs()[0].shape == [1, 5, 32, 8]
    assert session.get_outputs()[0].shape == [1, 2, 32, 64]
    answer = session.run(None, {"encoded": np.full((1, 5, 32, 8), 100.0, np.float32)})[0]
    assert 0.0 <= answer.min() <= answer.max() <= 1.0


def test_parity_holds_and_notices_another_network(network: CompactUNet, tmp_path: Path) -> None:
    path = tmp_path / "net.onnx"
    export_onnx(network, path)
    assert parity(Confidence(network).eval(), path) < PARITY
    nn.init.constant_(network.head.bias, 0.0)
    assert parity(Confidence(network).eval(), path) > PARITY


def test_same_network_gives_the_same_file(network: CompactUNet, tmp_path: Path) -> None:
    assert export_onnx(network, tmp_path / "a.onnx") == export_onnx(network, tmp_path / "b.onnx")
