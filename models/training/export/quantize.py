"""Quantisation of an exported network: 8-bit integers calibrated on real maps."""

from __future__ import annotations

import tempfile
from collections.abc import Iterable
from pathlib import Path

import numpy as np
import onnx
from onnxruntime import quantization
from onnxruntime.quantization.shape_inference import quant_pre_process

#: Quantised operators: all that multiply by learned weights, and the sums between, which would else be converted twice.
#: Attention (products of two activations), softmax, norms and the final sigmoid stay in fp32.
QUANTIZED_OPS = ("Conv", "ConvTranspose", "Gemm", "MatMul", "Add")


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
        quantization.quantize_static(
            prepared,
            target,
            _Maps(entry.name, maps),
            quant_format=quantization.QuantFormat.QDQ,
            op_types_to_quantize=list(QUANTIZED_OPS),
            nodes_to_exclude=_attention(onnx.load(prepared).graph),
            per_channel=True,
            activation_type=quantization.QuantType.QUInt8,
            weight_type=quantization.QuantType.QInt8,
            calibrate_method=quantization.CalibrationMethod.MinMax,
        )


def _attention(graph: onnx.GraphProto) -> list[str]:
    """Return the names of the products of two activations."""
    learned = {tensor.name for tensor in graph.initializer}
    return [node.name for node in graph.node if node.op_type == "MatMul" and learned.isdisjoint(node.input)]
