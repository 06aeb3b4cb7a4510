"""Initial weights from a file: Swin-T of ImageNet, the authors' published checkpoints, or a run of ours.

Every tensor of the file and every parameter of the network is accounted for: it is loaded, derived from the shape, or
without a counterpart by definition. Anything else is refused by name, and the network is unchanged.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass
from math import isqrt
from pathlib import Path

import torch
from torch import Tensor, nn
from torch.nn import functional

from lab.training.run_folder import load_state

#: Buffers that the published files hold and that follow from the window and the map's size.
DERIVED = ("relative_position_index", "attn_mask")
BIAS_TABLE = "relative_position_bias_table"
#: Maximum names of a kind in an error; more are only counted.
MAX_NAMES = 3


@dataclass(frozen=True, kw_only=True)
class InitReport:
    """Result for every tensor: names of the network, but for `derived` and `unused`, which are the file's."""

    #: Recognised kind of the file.
    source: str
    loaded: tuple[str, ...]
    #: Among the loaded: position biases resampled for another window.
    interpolated: tuple[str, ...]
    #: Buffers that the network derives itself.
    derived: tuple[str, ...]
    #: Tensors without a counterpart: the classifier of ImageNet.
    unused: tuple[str, ...]
    #: Parameters that the file cannot fill; they keep their random start.
    fresh: tuple[str, ...]


@dataclass(frozen=True, kw_only=True)
class Layout:
    """Correspondence of the names of a kind of checkpoint to those of a network."""

    source: str
    #: Names in the network that a name of the file fills.
    targets: Callable[[str], tuple[str, ...]]
    #: Whether the file must fill a name of the network.
    covers: Callable[[str], bool] = lambda name: True
    #: Prefixes of ignored names.
    unused: tuple[str, ...] = ()
    #: Whether position biases may come from another window.
    interpolates: bool = False


def _swin_targets(name: str) -> tuple[str, ...]:
    """Return encoder stage i and its mirror in the decoder, layers_up 3-i; the bottleneck has none."""
    mirrored = re.fullmatch(r"layers\.([012])\.(blocks\..+)", name)
    return (name, f"layers_up.{3 - int(mirrored[1])}.{mirrored[2]}") if mirrored else (name,)


def _in_swin(name: str) -> bool:
    return name.startswith(("patch_embed.", "layers.", "norm.")) or ".blocks." in name


SWIN_T = Layout(
    source="Swin-T of ImageNet", targets=_swin_targets, covers=_in_swin, unused=("head.",), interpolates=True
)
STAGE_1 = Layout(source="published stage 1", targets=lambda name: (name.removeprefix("swin_unet."),))
STAGE_2 = Layout(source="published stage 2", targets=lambda name: (name.removeprefix("g_"),))
OWN = Layout(source="own run", targets=lambda name: (name,))


def load_initial(network: nn.Module, path: Path) -> InitReport:
    """Fill a network from a checkpoint file and report the result for every tensor.

    Raises `ValueError`, with the network untouched, if the file is no checkpoint or a tensor is missing, foreign, of
    another shape or not finite.
    """
    tensors, wrapped = _read(path)
    layout = OWN if wrapped else _recognise(tensors)
    state = network.state_dict()
    derived = tuple(name for name in tensors if _is_derived(name, layout, state))
    unused = tuple(name for name in tensors if name.startswith(layout.unused))
    learned = {name: tensor for name, tensor in tensors.items() if name not in {*derived, *unused}}
    sources = {target: name for name in learned for target in layout.targets(name) if target in state}
    fitted = {target: _fit(network, target, learned[name], layout) for target, name in sources.items()}
    _refuse(
        path,
        layout,
        {
            "missing": [name for name in state if name not in sources and layout.covers(name)],
            "foreign": [name for name in learned if name not in sources.values()],
            "of another shape": _misshapen(fitted, state, sources),
            "not finite": [name for name, tensor in learned.items() if not torch.isfinite(tensor).all()],
        },
    )
    for name, tensor in fitted.items():
        state[name].copy_(tensor)
    return InitReport(
        source=layout.source,
        loaded=tuple(fitted),
        interpolated=tuple(name for name, tensor in fitted.items() if tensor is not learned[sources[name]]),
        derived=derived,
        unused=unused,
        fresh=tuple(name for name in state if name not in fitted),
    )


def _read(path: Path) -> tuple[dict[str, Tensor], bool]:
    """Return the tensors of a file by name, and whether they are from one of our runs."""
    content = load_state(path)
    wrapped = isinstance(content, dict) and "network" in content
    for wrapper in ("network", "model"):
        if isinstance(content, dict) and wrapper in content:
            content = content[wrapper]
    if not isinstance(content, dict) or not content:
        raise ValueError(f"{path} must hold named tensors, got {type(content).__name__}")
    for name, tensor in content.items():
        if not isinstance(name, str) or not isinstance(tensor, Tensor):
            raise ValueError(f"{path} must hold named tensors only, got {type(tensor).__name__} at {name!r}")
    return content, wrapped


def _recognise(tensors: dict[str, Tensor]) -> Layout:
    """Return the kind of a checkpoint, from its names."""

    def holds(prefix: str) -> bool:
        return any(name.startswith(prefix) for name in tensors)

    if holds("swin_unet."):
        return STAGE_1
    if holds("g_query_encoder."):
        return STAGE_2
    return SWIN_T if holds("layers.0.blocks.") and not holds("layers_up.") else OWN


def _is_derived(name: str, layout: Layout, state: dict[str, Tensor]) -> bool:
    """Return whether a tensor is a derived buffer of a module that the network has."""
    module, _, leaf = name.rpartition(".")
    parents = tuple(f"{target}." for target in layout.targets(module))
    return leaf in DERIVED and any(parameter.startswith(parents) for parameter in state)


def _fit(network: nn.Module, name: str, tensor: Tensor, layout: Layout) -> Tensor:
    """Return the tensor itself, or a table of position biases resampled for the window of the network."""
    module, _, leaf = name.rpartition(".")
    if not layout.interpolates or leaf != BIAS_TABLE or tensor.shape == network.get_parameter(name).shape:
        return tensor
    window = network.get_submodule(module).window
    return interpolate_biases(tensor, (2 * window[0] - 1, 2 * window[1] - 1))


def interpolate_biases(table: Tensor, offsets: tuple[int, int]) -> Tensor:
    """Return biases of a square window's offsets, [side * side, heads], at other (row, column) offsets, bicubic.

    The farthest offsets of one window become those of the other, and offset zero stays zero. A table that belongs to
    no square window is returned unchanged.
    """
    if table.dim() != 2 or isqrt(len(table)) ** 2 != len(table):
        return table
    side = isqrt(len(table))
    # [1, heads, side, side]
    grid = table.T.reshape(1, -1, side, side).float()
    return functional.interpolate(grid, offsets, mode="bicubic", align_corners=True).flatten(2)[0].T


def _misshapen(fitted: dict[str, Tensor], state: dict[str, Tensor], sources: dict[str, str]) -> list[str]:
    return [
        f"{sources[name]} must be {tuple(state[name].shape)}, got {tuple(tensor.shape)}"
        for name, tensor in fitted.items()
        if tensor.shape != state[name].shape
    ]


def _refuse(path: Path, layout: Layout, problems: dict[str, list[str]]) -> None:
    """Raise `ValueError` that counts the problems of each kind and names the first few."""
    messages = []
    for kind, names in problems.items():
        if names:
            rest = ", ..." if len(names) > MAX_NAMES else ""
            messages.append(f"{len(names)} {kind} ({', '.join(names[:MAX_NAMES])}{rest})")
    if messages:
        raise ValueError(
            f"{path} must hold every parameter of the network as {layout.source}, got {'; '.join(messages)}"
        )
