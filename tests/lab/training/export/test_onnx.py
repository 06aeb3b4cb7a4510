from __future__ import annotations

from pathlib import Path

import numpy as np
import onnxruntime
import pytest
import torch
from torch import nn

from lab.networks.compact_unet import CompactUNet, CompactUNetConfig
from lab.networks.radar_tensor_network import RadarTensorNetwork, RadarTensorNetworkConfig
from lab.training.export.onnx import PARITY, Exported, export_onnx, parity

CONFIG = CompactUNetConfig(range_bins=32, columns=8, widths=(8, 16), attention_heads=2, attention_blocks=1)
ANCHORS = RadarTensorNetworkConfig(
    range_bins=16, columns=8, anchor_stride=2, widths=(4, 8), blocks=(1, 1), neck_width=4, in_channels=3
)


@pytest.fixture
def network() -> CompactUNet:
    torch.set_num_threads(1)
    torch.manual_seed(0)
    return CompactUNet(CONFIG).eval()


@pytest.fixture
def maps() -> np.ndarray:
    return np.random.default_rng(1).standard_normal((2, 5, 32, 8)).astype(np.float32)


def test_export_has_fixed_shapes_and_answers_probabilities(network: CompactUNet, tmp_path: Path) -> None:
    path = tmp_path / "net.onnx"
    export_onnx(Exported(network), path)
    session = onnxruntime.InferenceSession(path)
    assert session.get_inputs()[0].shape == [1, 5, 32, 8]
    assert session.get_outputs()[0].shape == [1, 2, 32, 64]
    answer = session.run(None, {"encoded": np.full((1, 5, 32, 8), 100.0, np.float32)})[0]
    assert 0.0 <= answer.min() <= answer.max() <= 1.0


def test_parity_holds_and_notices_another_network(network: CompactUNet, tmp_path: Path, maps: np.ndarray) -> None:
    path = tmp_path / "net.onnx"
    export_onnx(Exported(network), path, maps)
    assert parity(Exported(network), path, maps) < PARITY
    nn.init.constant_(network.head.bias, 0.0)
    assert parity(Exported(network), path) > PARITY


def test_export_that_differs_on_a_map_is_refused(
    network: CompactUNet, tmp_path: Path, maps: np.ndarray, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The exporter is made to write a network whose stem is shifted: random inputs or maps, something notices."""
    shifted = Exported(CompactUNet(CONFIG))
    write = torch.onnx.export
    monkeypatch.setattr(torch.onnx, "export", lambda model, *rest, **more: write(shifted, *rest, **more))
    with pytest.raises(ValueError, match=r"net\.onnx: probabilities must agree with torch within 0\.0001, differ by"):
        export_onnx(Exported(network), tmp_path / "net.onnx", maps)


def test_weights_that_are_no_numbers_are_refused(network: CompactUNet, tmp_path: Path) -> None:
    nn.init.constant_(network.head.bias, float("nan"))
    with pytest.raises(ValueError, match=r"must agree with torch within 0\.0001, differ by nan"):
        export_onnx(Exported(network), tmp_path / "net.onnx")


def test_same_network_gives_the_same_file(network: CompactUNet, tmp_path: Path) -> None:
    one, two = (export_onnx(Exported(network), tmp_path / name) for name in ("a.onnx", "b.onnx"))
    assert one == two


def test_half_precision_halves_the_file_and_keeps_float32_at_its_ends(
    network: CompactUNet, tmp_path: Path, maps: np.ndarray
) -> None:
    """float16 has 11 bits: probabilities near 0.1 agree to 1e-3, and the torch network stays what it was."""
    whole, half = tmp_path / "fp32.onnx", tmp_path / "fp16.onnx"
    before = [parameter.dtype for parameter in network.parameters()]
    export_onnx(Exported(network), whole)
    export_onnx(Exported(network, half=True), half)
    assert [parameter.dtype for parameter in network.parameters()] == before
    session = onnxruntime.InferenceSession(half, providers=["CPUExecutionProvider"])
    assert session.get_inputs()[0].type == session.get_outputs()[0].type == "tensor(float)"
    weights = sum(parameter.numel() for parameter in network.parameters())
    assert whole.stat().st_size - half.stat().st_size == pytest.approx(2 * weights, rel=0.1)
    assert 0.0 < parity(Exported(network), half, maps) < 1e-2


def test_anchors_answer_logits_and_offsets(tmp_path: Path) -> None:
    """Class logits and offsets come out as the network makes them; another offset layer is noticed."""
    torch.manual_seed(0)
    network = RadarTensorNetwork(ANCHORS).eval()
    path = tmp_path / "rtn.onnx"
    encoded = np.random.default_rng(0).standard_normal((3, 16, 8)).astype(np.float32)
    export_onnx(Exported(network), path, [encoded])
    session = onnxruntime.InferenceSession(path, providers=["CPUExecutionProvider"])
    with torch.no_grad():
        wanted = network(torch.from_numpy(encoded[None])).numpy()
    np.testing.assert_allclose(session.run(None, {"encoded": encoded[None]})[0], wanted, atol=1e-4)
    nn.init.constant_(network.locate.bias, 1.0)
    assert parity(Exported(network), path) > PARITY
