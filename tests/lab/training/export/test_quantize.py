from __future__ import annotations

from pathlib import Path

import numpy as np
import onnx
import onnxruntime
import pytest
import torch

from lab.networks.compact_unet import CompactUNet, CompactUNetConfig
from lab.training.export.onnx import Exported, export_onnx
from lab.training.export.quantize import MAX_PAIR, quantize_int8, without_transposed_convolutions
from msgs.files.shipped import WEIGHTS

CONFIG = CompactUNetConfig(range_bins=32, columns=8, widths=(8, 16), attention_heads=2, attention_blocks=1)
MAPS = np.random.default_rng(0).standard_normal((4, 5, 32, 8)).astype(np.float32)


@pytest.fixture(scope="module")
def exported(tmp_path_factory: pytest.TempPathFactory) -> Path:
    torch.set_num_threads(1)
    torch.manual_seed(0)
    path = tmp_path_factory.mktemp("fp32") / "net.onnx"
    export_onnx(Exported(CompactUNet(CONFIG)), path)
    return path


@pytest.fixture(scope="module")
def quantized(exported: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("int8") / "net.onnx"
    quantize_int8(exported, path, MAPS)
    return path


def answers(path: Path) -> np.ndarray:
    session = onnxruntime.InferenceSession(path, providers=["CPUExecutionProvider"])
    return np.stack([session.run(None, {"encoded": one[None]})[0][0] for one in MAPS])


def test_int8_answers_what_fp32_answers_within_its_steps(exported: Path, quantized: Path) -> None:
    """256 steps an activation: probabilities near 0.1 move by less than a hundredth, and by more than rounding."""
    difference = np.abs(answers(quantized) - answers(exported)).max()
    assert 1e-6 < difference < 1e-2


def worst_pair(path: Path) -> int:
    """Return the largest sum of two neighbouring weights of an output, in either order in which kernels add."""
    graph = onnx.load(path).graph
    tensors = {tensor.name: onnx.numpy_helper.to_array(tensor) for tensor in graph.initializer}
    weights = {node.output[0]: tensors[node.input[0]] for node in graph.node if node.input[0] in tensors}
    multiplied = [
        weights[node.input[1]] if node.op_type == "Conv" else weights[node.input[1]].T
        for node in graph.node
        if node.op_type in ("Conv", "Gemm", "MatMul") and node.input[1] in weights
    ]
    orders = [each.reshape(len(each), -1) for each in multiplied]
    orders += [each.transpose(0, 2, 3, 1).reshape(len(each), -1) for each in multiplied if each.ndim == 4]
    assert all(order.dtype == np.int8 for order in orders)
    assert len(orders) > 10
    evens = [order[:, : order.shape[1] // 2 * 2].astype(int) for order in orders]
    return int(max(np.abs(even[:, ::2] + even[:, 1::2]).max() for even in evens))


def test_sums_of_two_products_stay_in_16_bits(quantized: Path) -> None:
    """AVX2 without VNNI cuts them off there: 255 x 128 is below 2^15, 255 x 129 is not."""
    for path in (quantized, *WEIGHTS.glob("*.int8.onnx")):
        assert 100 < worst_pair(path) <= MAX_PAIR == 2**15 // 255, path


def test_a_transposed_convolution_is_one_of_single_cells_moved_apart(exported: Path, tmp_path: Path) -> None:
    """The runtime has no transposed convolution of integers. In fp32 either form gives the same sums."""
    model = onnx.load(exported)
    count = sum(node.op_type == "ConvTranspose" for node in model.graph.node)
    onnx.save(without_transposed_convolutions(model), tmp_path / "net.onnx")
    kinds = [node.op_type for node in onnx.load(tmp_path / "net.onnx").graph.node]
    assert count == kinds.count("DepthToSpace") > 0
    assert "ConvTranspose" not in kinds
    np.testing.assert_allclose(answers(tmp_path / "net.onnx"), answers(exported), atol=1e-6)


def test_nothing_between_convolutions_is_converted_back(quantized: Path) -> None:
    """A rectifier after a convolution is the lower bound of the integers that come out of it."""
    graph = onnx.load(quantized).graph
    convolved = {node.output[0] for node in graph.node if node.op_type == "Conv"}
    assert not any(convolved & set(node.input) for node in graph.node if node.op_type == "Relu")
    rectified = {name for node in graph.node if node.op_type == "Relu" for name in node.input}
    made_by = {name: node for node in graph.node for name in node.output}
    before = [made_by[made_by[name].input[0]] for name in rectified if made_by[name].op_type == "DequantizeLinear"]
    assert not any(convolved & set(node.input) for node in before)


def test_learned_weights_are_bytes_and_attention_is_not(quantized: Path) -> None:
    graph = onnx.load(quantized).graph
    convolved = {node.input[1] for node in graph.node if node.op_type == "Conv"}
    made_by = {node.output[0]: node for node in graph.node}
    assert all(made_by[weight].op_type == "DequantizeLinear" for weight in convolved)
    stored = {tensor.name: tensor.data_type for tensor in graph.initializer}
    assert {stored[made_by[weight].input[0]] for weight in convolved} == {onnx.TensorProto.INT8}
    # a product of two activations is attention's
    softmax = [node.output[0] for node in graph.node if node.op_type == "Softmax"]
    products = [node for node in graph.node if node.op_type == "MatMul" and set(node.input) & set(softmax)]
    assert len(products) == CONFIG.attention_blocks


def test_every_output_channel_of_a_convolution_has_a_scale_of_its_own(quantized: Path) -> None:
    """A scale per channel: each channel's largest weight is a byte of 64 to 127, as large as its neighbours let it be,
    so that the scales are as different as the channels. One scale for all would leave such bytes to a few channels.
    """
    graph = onnx.load(quantized).graph
    stored = {tensor.name: onnx.numpy_helper.to_array(tensor) for tensor in graph.initializer}
    made_by = {node.output[0]: node for node in graph.node}
    dequantised = [made_by[node.input[1]] for node in graph.node if node.op_type == "Conv"]
    assert len(dequantised) > 4
    for node in dequantised:
        weights, scales = stored[node.input[0]], stored[node.input[1]]
        assert scales.shape == weights.shape[:1]
        assert (np.abs(weights.astype(int)).reshape(len(weights), -1).max(axis=1) >= MAX_PAIR // 2).all()
        assert len(np.unique(scales)) == len(scales)
    assert any(len(stored[node.input[1]]) > 1 for node in dequantised)


def test_same_maps_give_the_same_file(exported: Path, quantized: Path, tmp_path: Path) -> None:
    quantize_int8(exported, tmp_path / "again.onnx", MAPS)
    assert (tmp_path / "again.onnx").read_bytes() == quantized.read_bytes()


@pytest.mark.parametrize("maps", [MAPS[:0], MAPS[:, :3]])
def test_maps_that_the_network_does_not_take_are_refused(exported: Path, tmp_path: Path, maps: np.ndarray) -> None:
    with pytest.raises(ValueError, match=r"maps must have shape \(at least 1, 5, 32, 8\), got \("):
        quantize_int8(exported, tmp_path / "net.onnx", maps)
