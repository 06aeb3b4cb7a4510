"""Quantisation of an exported network: 8-bit integers calibrated on real maps."""

from __future__ import annotations

import tempfile
from collections.abc import Iterable
from pathlib import Path

import numpy as np
import onnx
from onnxruntime import quantization
from onnxruntime.quantization.shape_inference import quant_pre_process

#: Quantised operators: all that multiply by learned weights, and what lies between, or it would be converted twice.
#: Attention (products of two activations), softmax, norms and the final sigmoid stay in fp32.
QUANTIZED_OPS = ("Conv", "Gemm", "MatMul", "Add", "Relu", "Concat", "DepthToSpace")

#: Two weights of one sign times activations of 255 that add up to at most 2^15 - 1.
MAX_PAIR = 128


class _Maps(quantization.CalibrationDataReader):
    """Encoded maps one after the other, as the calibration requests them."""

    def __init__(self, name: str, maps: Iterable[np.ndarray]) -> None:
        self._name, self._maps = name, iter(maps)

    def get_next(self) -> dict[str, np.ndarray] | None:
        """Return the next input, or None after the last."""
        encoded = next(self._maps, None)
        return None if encoded is None else {self._name: encoded[None]}


def quantize_int8(source: Path, target: Path, maps: np.ndarray) -> None:
    """Write an fp32 network as int8: static, weights per output channel, ranges of activations from `maps`.

    `maps` are encoded inputs float32 [maps, channels, range, columns]; ranges are the smallest and the largest value:
    percentiles cut the rare strong cells, which are the returns (99.999 % is no nearer to fp32, 99.99 % further).
    Input and output stay float32. Raises `ValueError` without maps or with maps of another shape.
    """
    entry = onnx.load(source).graph.input[0]
    shape = tuple(axis.dim_value for axis in entry.type.tensor_type.shape.dim)
    if len(maps) == 0 or maps.shape[1:] != shape[1:]:
        raise ValueError(f"maps must have shape (at least 1, {str(shape[1:])[1:]}, got {maps.shape}")
    with tempfile.TemporaryDirectory() as directory:
        prepared = Path(directory) / "prepared.onnx"
        quant_pre_process(source, prepared, skip_symbolic_shape=True)
        onnx.save(without_transposed_convolutions(onnx.load(prepared)), prepared)
        quantization.quantize_static(
            prepared,
            target,
            _Maps(entry.name, maps),
            quant_format=quantization.QuantFormat.QDQ,
            op_types_to_quantize=list(QUANTIZED_OPS),
            nodes_to_exclude=_exact(onnx.load(prepared).graph),
            per_channel=True,
            activation_type=quantization.QuantType.QUInt8,
            weight_type=quantization.QuantType.QInt8,
            calibrate_method=quantization.CalibrationMethod.MinMax,
        )
        onnx.save(limit_pair_sums(onnx.load(target), onnx.load(prepared)), target)


def limit_pair_sums(quantized: onnx.ModelProto, source: onnx.ModelProto) -> onnx.ModelProto:
    """Return an int8 network whose weights are rounded anew from those of its `source`, no sum of two products of which
    leaves 16 bits.

    x86 processors with AVX2 and without VNNI multiply two unsigned activations by two signed weights and add both in 16
    bits: two neighbours of one sign that add up to over `MAX_PAIR` are cut off there. A channel's scale is the one
    with the least squared error once such neighbours are lowered.
    """
    tensors = {tensor.name: tensor for tensor in quantized.graph.initializer}
    exact = {tensor.name: onnx.numpy_helper.to_array(tensor) for tensor in source.graph.initializer}
    made = {output: node for node in quantized.graph.node for output in node.output}

    def value(name: str) -> np.ndarray:
        return np.asarray(onnx.numpy_helper.to_array(tensors[name]))

    def set_value(name: str, array: np.ndarray) -> None:
        tensors[name].CopyFrom(onnx.numpy_helper.from_array(array, name))

    for node in quantized.graph.node:
        if node.op_type not in ("Conv", "Gemm", "MatMul") or not (entry := made.get(node.input[1])):
            continue
        if entry.input[0] not in tensors:
            continue
        # output channels first, then the order in which the kernels add: cells of the kernel, input channels last
        axis = 0 if node.op_type == "Conv" else 1
        weights = np.moveaxis(exact[entry.input[0].removesuffix("_quantized")], axis, 0)
        codes, scale = _paired_codes(weights.reshape(len(weights), weights.shape[1], -1).swapaxes(1, 2))
        codes = np.moveaxis(codes.swapaxes(1, 2).reshape(weights.shape), 0, axis)
        set_value(entry.input[0], np.ascontiguousarray(codes))
        before = value(entry.input[1])
        set_value(entry.input[1], scale)
        for bias in (made[name] for name in node.input[2:] if name in made):
            set_value(bias.input[0], np.round(value(bias.input[0]) * (before / scale)).astype(np.int32))
            set_value(bias.input[1], value(bias.input[1]) * (scale / before))
    return quantized


def _paired_codes(weights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return int8 codes of weights [channels, cells, inputs] and the scale of each channel."""
    largest = np.abs(weights).max(axis=(1, 2))
    # a channel of nothing has any scale
    largest[largest == 0.0] = 1.0
    best, codes, scale = np.full(len(weights), np.inf), np.zeros(weights.shape, np.int8), np.zeros(len(weights))
    for stretch in np.linspace(1.0, 127.0 / (MAX_PAIR / 2), 41):
        step = largest * stretch / 127.0
        tried = _lowered(np.round(weights / step[:, None, None]))
        error = np.square(tried * step[:, None, None] - weights).sum(axis=(1, 2))
        better = error < best
        best[better], codes[better], scale[better] = error[better], tried[better], step[better]
    return codes, scale.astype(np.float32)


def _lowered(codes: np.ndarray) -> np.ndarray:
    """Lower neighbours of one sign whose sum leaves 16 bits, in both orders in which kernels may add."""
    while True:
        over = 0
        for order in ((0, 1, 2), (0, 2, 1)):
            rows = codes.transpose(order).reshape(len(codes), -1).copy()
            pairs = rows[:, : rows.shape[1] // 2 * 2].reshape(len(codes), -1, 2)
            excess = np.maximum(np.abs(pairs.sum(axis=-1)) - MAX_PAIR, 0.0)
            pairs[..., 0] -= np.sign(pairs[..., 0]) * np.ceil(excess / 2.0)
            pairs[..., 1] -= np.sign(pairs[..., 1]) * np.floor(excess / 2.0)
            rows[:, : rows.shape[1] // 2 * 2] = pairs.reshape(len(codes), -1)
            shape = tuple(codes.shape[axis] for axis in order)
            codes = rows.reshape(shape).transpose(order)
            over += int((excess > 0.0).sum())
        if not over:
            return codes


def without_transposed_convolutions(model: onnx.ModelProto) -> onnx.ModelProto:
    """Return a network in which each transposed convolution whose steps are as wide as its kernel is a convolution of
    one cell whose channels then move to the finer grid: the same sums, which the runtime has in integers.
    """
    weights = {tensor.name: tensor for tensor in model.graph.initializer}
    nodes: list[onnx.NodeProto] = []
    for node in model.graph.node:
        block = _block(node, weights)
        nodes += [node] if block == 0 else _of_one_cell(node, weights, block)
    del model.graph.node[:]
    model.graph.node.extend(nodes)
    return model


def _block(node: onnx.NodeProto, weights: dict[str, onnx.TensorProto]) -> int:
    """Return the width of the square kernel of a transposed convolution with steps as wide; 0 for any other node."""
    if node.op_type != "ConvTranspose" or any(name not in weights for name in node.input[1:]):
        return 0
    attributes = {item.name: onnx.helper.get_attribute_value(item) for item in node.attribute}
    kernel = list(weights[node.input[1]].dims[2:])
    plain = not any(attributes.get("pads", ())) and not any(attributes.get("output_padding", ()))
    plain &= attributes.get("group", 1) == 1 and kernel[0] == kernel[1]
    return kernel[0] if plain and list(attributes.get("strides", ())) == kernel else 0


def _of_one_cell(node: onnx.NodeProto, weights: dict[str, onnx.TensorProto], block: int) -> list[onnx.NodeProto]:
    """Return a convolution and the move of its channels in place of a transposed one; changes its weights."""
    kernel = weights[node.input[1]]
    # [in, out, down, across] -> [out * down * across, in, 1, 1]
    by_cell = onnx.numpy_helper.to_array(kernel).transpose(1, 2, 3, 0)
    kernel.CopyFrom(onnx.numpy_helper.from_array(by_cell.reshape(-1, by_cell.shape[-1], 1, 1).copy(), kernel.name))
    for bias in (weights[name] for name in node.input[2:]):
        repeated = np.repeat(onnx.numpy_helper.to_array(bias), block**2)
        bias.CopyFrom(onnx.numpy_helper.from_array(repeated, bias.name))
    coarse = f"{node.output[0]}_coarse"
    return [
        onnx.helper.make_node("Conv", list(node.input), [coarse], name=node.name, kernel_shape=[1, 1]),
        onnx.helper.make_node(
            "DepthToSpace", [coarse], list(node.output), name=f"{node.name}_moved", blocksize=block, mode="CRD"
        ),
    ]


def _exact(graph: onnx.GraphProto) -> list[str]:
    """Return the names of the products of two activations, and of what gives the answer: a step there is an error of a
    wall or a centre.
    """
    learned, answers = {tensor.name for tensor in graph.initializer}, {value.name for value in graph.output}
    products = [node.name for node in graph.node if node.op_type == "MatMul" and learned.isdisjoint(node.input)]
    return products + [node.name for node in graph.node if not answers.isdisjoint(node.output)]
