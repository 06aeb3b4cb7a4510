"""Weights of an exported network as the first ones of a training that goes on from it.

An exported file holds its norms within its convolutions. Here each convolution gets the file's weights and its norm
the file's bias, with mean 0 and variance 1: it answers what the file answers. A training first gives the norms the
statistics of its own data (`settle_norms`), by which they learn on as any other's do.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from lab.networks.swin_unet import WindowAttention
from models.perception.find.onnx_model import load_card
from models.perception.onnx_session import open_session

#: Largest difference of an answer between the file and the network, relative to the largest answer.
PARITY = 1e-4
#: Batches whose statistics the norms take before the training goes on.
SETTLING_BATCHES = 25


def load_exported(network: Any, path: Path) -> None:
    """Fill a dense network with an exported one, whose file answers probabilities; as `fill_exported`."""
    card = load_card(path)
    more = network.config.in_channels - len(card.encoding.channels)
    fill_exported(network, path, card.sha256, answer=torch.sigmoid, more_channels=max(more, 0))


@torch.no_grad()
def fill_exported(
    network: nn.Module,
    path: Path,
    sha256: str,
    *,
    answer: Callable[[Tensor], Tensor] = lambda logits: logits,
    more_channels: int = 0,
) -> None:
    """Fill a network with the weights of an exported one, the `answer` of which the file gives; `more_channels` that it
    alone reads, the last, weigh nothing.

    Raises `ValueError` naming a file that is none, is of another shape, or answers otherwise than its weights say.
    """
    import onnx
    from onnx import numpy_helper

    session = open_session(path, sha256, 1)
    graph = onnx.load(path).graph
    source = session.get_inputs()[0]
    cells = np.random.default_rng(0).standard_normal(source.shape).astype(np.float32)
    # one that answers probabilities holds it as its part
    values = {entry.name.removeprefix("network."): _tensor(numpy_helper.to_array(entry)) for entry in graph.initializer}
    try:
        widened = np.pad(cells, ((0, 0), (0, more_channels), (0, 0), (0, 0)))
        shown = torch.from_numpy(widened).to(next(network.parameters()).device)
        layers = _layers_in_order(network, shown)
        _fill_convolutions(layers, graph.node, values)
        _fill_products(layers, graph.node, values)
        _fill_position_biases(layers, graph.node, values)
        for name, parameter in network.named_parameters():
            if name in values and values[name].shape == parameter.shape:
                parameter.copy_(values[name])
    except (IndexError, KeyError, RuntimeError, ValueError) as error:
        first = str(error).splitlines()[0]
        raise ValueError(f"{path}: start must be a network of this shape in full precision: {first}") from None
    said, wanted = answer(network(shown)).cpu().numpy(), session.run(None, {source.name: cells})[0]
    difference = float(np.abs(said - wanted).max() / np.abs(wanted).max())
    if not difference <= PARITY:
        raise ValueError(f"{path}: weights must answer as the file does within {PARITY}, differ by {difference}")


@torch.no_grad()
def settle_norms(network: nn.Module, batches: Iterable[Tensor]) -> None:
    """Give all norms the means and variances that they see in some batches [batch, ...], and the weights by which they
    answer to every input as before.
    """
    norms = [module for module in network.modules() if isinstance(module, nn.BatchNorm2d)]
    if not norms:
        return
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


def _layers_in_order(network: nn.Module, shown: Tensor) -> list[nn.Module]:
    """Return the layers with weights in the order in which an input passes them, as the nodes of a file have it."""
    passed: list[nn.Module] = []
    kinds = (nn.Conv2d, nn.ConvTranspose2d, nn.BatchNorm2d, nn.Linear, WindowAttention)
    layers = [layer for layer in network.modules() if isinstance(layer, kinds)]
    hooks = [layer.register_forward_pre_hook(lambda layer, _: passed.append(layer)) for layer in layers]
    network.eval()(shown)
    for hook in hooks:
        hook.remove()
    return passed


def _fill_convolutions(layers: list[nn.Module], nodes: Iterable[Any], values: dict[str, Tensor]) -> None:
    """Fill all convolutions; a norm that follows one without a bias is held within it."""
    convolutions = [node for node in nodes if node.op_type in ("Conv", "ConvTranspose")]
    followed = [
        pair for pair in pairwise([*layers, nn.Identity()]) if isinstance(pair[0], nn.Conv2d | nn.ConvTranspose2d)
    ]
    for (convolve, norm), node in zip(followed, convolutions, strict=True):
        weight, *bias = (values[name.removeprefix("network.")] for name in node.input[1:])
        more = convolve.weight.shape[1] - weight.shape[1]
        convolve.weight.copy_(nn.functional.pad(weight, (0, 0, 0, 0, 0, max(more, 0))))
        if isinstance(norm, nn.BatchNorm2d) and convolve.bias is None:
            norm.weight.fill_(math.sqrt(1.0 + norm.eps))
            norm.bias.copy_(bias[0])
        elif bias:
            convolve.bias.copy_(bias[0])


def _fill_products(layers: list[nn.Module], nodes: Iterable[Any], values: dict[str, Tensor]) -> None:
    """Fill the linear layers, which the file holds as products with constants; a bias has its own name."""
    weights = [values[node.input[1]] for node in nodes if node.op_type == "MatMul" and node.input[1] in values]
    linear = [layer for layer in layers if isinstance(layer, nn.Linear)]
    for layer, weight in zip(linear, weights, strict=True):
        layer.weight.copy_(weight.T)


def _fill_position_biases(layers: list[nn.Module], nodes: Iterable[Any], values: dict[str, Tensor]) -> None:
    """Fill the position biases of attention, which the file holds spread to every pair of cells, without a name."""
    terms = [name for node in nodes if node.op_type == "Add" for name in node.input if name.startswith("onnx::Add")]
    attentions = [layer for layer in layers if isinstance(layer, WindowAttention)]
    for attention, name in zip(attentions, terms[: len(attentions)], strict=True):
        # a pair of cells that the seam of a shift does not part has its bias in some window: [heads, cells, cells]
        pairs = values[name].unflatten(0, (-1, attention.heads)).amax(dim=0)
        table = attention.relative_position_bias_table
        table[attention.relative_position_index.flatten()] = pairs.flatten(1).T.to(table)


def _tensor(values: np.ndarray) -> Tensor:
    return torch.from_numpy(np.array(values))
