"""Weights of an exported network as the first ones of a training that goes on from it.

An exported file holds its norms within its convolutions. Here each convolution gets the file's weights and its norm
the file's bias, with mean 0 and variance 1: it answers what the file answers. A training first gives the norms the
statistics of its own data (`settle_norms`), by which they learn on as any other's do.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from lab.networks.compact_unet import CompactUNet
from models.perception.find.onnx_model import load_card
from models.perception.onnx_session import open_session

#: Largest difference of an answer between the file and the network, relative to the largest answer.
PARITY = 1e-4
#: Batches whose statistics the norms take before the training goes on.
SETTLING_BATCHES = 25


def load_exported(network: CompactUNet, path: Path) -> None:
    """Fill a network with the weights of an exported one; channels that it alone reads, the last, weigh nothing.

    Raises `ValueError` naming a file that is none, is of another shape, or answers otherwise than its weights say.
    """
    import onnx
    from onnx import numpy_helper

    session = open_session(path, load_card(path).sha256, 1)
    graph = onnx.load(path).graph
    # it lies within one that answers probabilities
    values = {
        entry.name.removeprefix("network."): np.array(numpy_helper.to_array(entry)) for entry in graph.initializer
    }
    try:
        with torch.no_grad():
            _fill_convolutions(network, [node for node in graph.node if node.op_type == "Conv"], values)
            _fill_products(network, [node for node in graph.node if node.op_type == "MatMul"], values)
            for name, parameter in network.named_parameters():
                if name in values:
                    parameter.copy_(_tensor(values[name]))
    except (KeyError, RuntimeError, ValueError) as error:
        first = str(error).splitlines()[0]
        raise ValueError(f"{path}: start must be a network of this shape in full precision: {first}") from None
    source = session.get_inputs()[0]
    cells = np.random.default_rng(0).standard_normal(source.shape).astype(np.float32)
    _check_parity(network, path, cells, session.run(None, {source.name: cells})[0])


@torch.no_grad()
def settle_norms(network: nn.Module, batches: Iterable[Tensor]) -> None:
    """Give all norms the means and variances that they see in some batches [batch, ...], and the weights by which they
    answer to every input as before.
    """
    norms = [module for module in network.modules() if isinstance(module, nn.BatchNorm2d)]
    moments: dict[nn.Module, list[Tensor]] = {norm: [] for norm in norms}

    def watch(norm: nn.Module, inputs: tuple[Tensor, ...]) -> None:
        # float64: a spread that is small beside its mean would be lost in the difference of squares
        x = inputs[0].double()
        moments[norm].append(torch.stack([x.mean((0, 2, 3)), x.square().mean((0, 2, 3))]))

    hooks = [norm.register_forward_pre_hook(watch) for norm in norms]
    network.eval()
    for batch in batches:
        network(batch)
    for hook in hooks:
        hook.remove()
    for norm in norms:
        _restate(norm, *torch.stack(moments[norm]).mean(dim=0))


def _restate(norm: nn.BatchNorm2d, mean: Tensor, mean_square: Tensor) -> None:
    """Give a norm another mean and variance, with the weight and bias by which it stays the same function."""
    assert norm.running_mean is not None
    assert norm.running_var is not None
    variance = (mean_square - mean**2).clamp_min(0.0)
    slope = norm.weight.double() / torch.sqrt(norm.running_var.double() + norm.eps)
    norm.bias.add_(slope * (mean - norm.running_mean))
    norm.weight.copy_(slope * torch.sqrt(variance + norm.eps))
    norm.running_mean.copy_(mean)
    norm.running_var.copy_(variance)


def _convolutions(network: CompactUNet) -> Iterator[tuple[nn.Conv2d, nn.BatchNorm2d]]:
    """Return convolutions with their norms, in the order in which they are passed."""
    ways_down = chain.from_iterable(zip(network.encode, network.down, strict=True))
    parts = (network.stem, *ways_down, network.decode)
    layers = [layer for part in parts for layer in part.modules()]
    convolutions = [layer for layer in layers if isinstance(layer, nn.Conv2d)]
    norms = [layer for layer in layers if isinstance(layer, nn.BatchNorm2d)]
    return zip(convolutions, norms, strict=True)


def _fill_convolutions(network: CompactUNet, nodes: list[Any], values: dict[str, np.ndarray]) -> None:
    """Fill all convolutions whose norms the file holds within them, the last one of the head apart."""
    for (convolve, norm), node in zip(_convolutions(network), nodes[:-1], strict=True):
        weight, bias = (_tensor(values[name]) for name in node.input[1:])
        more = convolve.weight.shape[1] - weight.shape[1]
        convolve.weight.copy_(nn.functional.pad(weight, (0, 0, 0, 0, 0, max(more, 0))))
        norm.weight.fill_(math.sqrt(1.0 + norm.eps))
        norm.bias.copy_(bias)


def _fill_products(network: CompactUNet, nodes: list[Any], values: dict[str, np.ndarray]) -> None:
    """Fill the linear layers, which the file holds as products with constants."""
    weights = [values[node.input[1]] for node in nodes if node.input[1] in values]
    layers = [layer for layer in network.context.modules() if isinstance(layer, nn.Linear)]
    for layer, weight in zip(layers, weights, strict=True):
        layer.weight.copy_(_tensor(weight.T))


def _tensor(values: np.ndarray) -> Tensor:
    return torch.from_numpy(np.ascontiguousarray(values))


def _check_parity(network: CompactUNet, path: Path, cells: np.ndarray, wanted: np.ndarray) -> None:
    more = network.config.in_channels - cells.shape[1]
    shown = torch.from_numpy(np.pad(cells, ((0, 0), (0, more), (0, 0), (0, 0))))
    with torch.no_grad():
        answer = network.eval()(shown.to(next(network.parameters()).device))
    said = torch.sigmoid(answer).cpu().numpy()
    difference = float(np.abs(said - wanted).max() / np.abs(wanted).max())
    if not difference <= PARITY:
        raise ValueError(f"{path}: weights must answer as the file does within {PARITY}, differ by {difference}")
