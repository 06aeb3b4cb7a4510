"""Weights of an exported object network as the first ones of a training that goes on from it.

An exported file holds its norms within its convolutions. Here each convolution gets the file's weights and its norm
the file's bias, with mean 0 and variance 1, and stays so: before the first step it answers what the file answers.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import nn

from models.networks.object_unet import ObjectUNet
from models.perception.detection.onnx_model import open_session
from models.perception.objects.predictor import load_object_card

#: Largest difference of an answer between the file and the network, relative to the largest answer.
PARITY = 1e-4


def load_exported(network: ObjectUNet, path: Path) -> None:
    """Fill a network with the weights of an exported one; channels that it alone reads, the last, weigh nothing.

    Raises `ValueError` naming a file that is none, is of another shape, or answers otherwise than its weights say.
    """
    import onnx
    from onnx import numpy_helper

    card = load_object_card(path)
    session = open_session(path, card.sha256, 1)
    graph = onnx.load(path).graph
    values = {entry.name: np.array(numpy_helper.to_array(entry)) for entry in graph.initializer}
    try:
        with torch.no_grad():
            _fill_convolutions(network, [node for node in graph.node if node.op_type == "Conv"], values)
            _fill_products(network, [node for node in graph.node if node.op_type == "MatMul"], values)
            for name, parameter in network.named_parameters():
                if name in values:
                    parameter.copy_(_tensor(values[name]))
    except (KeyError, RuntimeError, ValueError) as error:
        first = str(error).splitlines()[0]
        raise ValueError(f"{path}: start must be an object network of this shape in full precision: {first}") from None
    channels, rows, columns = card.encoding.shape
    cells = np.random.default_rng(0).standard_normal((1, channels, rows, columns)).astype(np.float32)
    wanted = session.run(None, {session.get_inputs()[0].name: cells})[0]
    _check_parity(network, path, cells, wanted)


def freeze_norms(network: nn.Module) -> None:
    """Keep the means and variances of all norms as they are."""
    for module in network.modules():
        if isinstance(module, nn.BatchNorm2d):
            module.eval()


def _convolutions(network: ObjectUNet) -> Iterator[tuple[nn.Conv2d, nn.BatchNorm2d]]:
    """Return convolutions with their norms, in the order in which they are passed."""
    ways_down = chain.from_iterable(zip(network.encode, network.down, strict=True))
    parts = (network.stem, *ways_down, network.decode, network.head[0])
    layers = [layer for part in parts for layer in part.modules()]
    convolutions = [layer for layer in layers if isinstance(layer, nn.Conv2d)]
    norms = [layer for layer in layers if isinstance(layer, nn.BatchNorm2d)]
    return zip(convolutions, norms, strict=True)


def _fill_convolutions(network: ObjectUNet, nodes: list[Any], values: dict[str, np.ndarray]) -> None:
    """Fill all convolutions whose norms the file holds within them, the last one of the head apart."""
    for (convolve, norm), node in zip(_convolutions(network), nodes[:-1], strict=True):
        weight, bias = (_tensor(values[name]) for name in node.input[1:])
        more = convolve.weight.shape[1] - weight.shape[1]
        convolve.weight.copy_(nn.functional.pad(weight, (0, 0, 0, 0, 0, max(more, 0))))
        norm.weight.fill_(math.sqrt(1.0 + norm.eps))
        norm.bias.copy_(bias)


def _fill_products(network: ObjectUNet, nodes: list[Any], values: dict[str, np.ndarray]) -> None:
    """Fill the linear layers, which the file holds as products with constants."""
    weights = [values[node.input[1]] for node in nodes if node.input[1] in values]
    layers = [layer for layer in network.context.modules() if isinstance(layer, nn.Linear)]
    for layer, weight in zip(layers, weights, strict=True):
        layer.weight.copy_(_tensor(weight.T))


def _tensor(values: np.ndarray) -> torch.Tensor:
    return torch.from_numpy(np.ascontiguousarray(values))


def _check_parity(network: ObjectUNet, path: Path, cells: np.ndarray, wanted: np.ndarray) -> None:
    more = network.config.in_channels - cells.shape[1]
    shown = np.pad(cells, ((0, 0), (0, more), (0, 0), (0, 0)))
    with torch.no_grad():
        said = network.eval()(torch.from_numpy(shown)).numpy()
    difference = float(np.abs(said - wanted).max() / np.abs(wanted).max())
    if not difference <= PARITY:
        raise ValueError(f"{path}: weights must answer as the file does within {PARITY}, differ by {difference}")
