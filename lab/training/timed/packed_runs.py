"""Run folders made small: weights in 16 or 8 bits, all folders in one archive, and that in parts of a few megabytes."""

from __future__ import annotations

import io
import tarfile
from collections.abc import Iterable
from pathlib import Path
from typing import Literal

import torch
from torch import Tensor

from lab.training.run_folder import BEST, CONFIG, CURVES, SUMMARY, load_state, save_state
from msgs.files.whole_files import write_whole

Bits = Literal["fp32", "fp16", "int8"]
PACKED = "packed.pt"
PART_BYTES = 15 * 2**20
#: Smaller tensors (biases, normalisations) are kept as they are.
SMALL = 4096


def packed(state: dict[str, Tensor], bits: Bits) -> dict[str, Tensor]:
    """Return the tensors of a network in fewer bits; int8: large ones with a scale for each first index."""
    small: dict[str, Tensor] = {}
    for name, tensor in state.items():
        tensor = tensor.detach().cpu()
        if not tensor.is_floating_point() or bits == "fp32":
            small[name] = tensor
        elif bits == "fp16" or tensor.numel() < SMALL or tensor.dim() < 2:
            small[name] = tensor if tensor.numel() < SMALL else tensor.half()
        else:
            scale = tensor.abs().flatten(1).amax(dim=1).clamp(min=1e-12) / 127.0
            small[name] = (tensor / _along_first(scale, tensor)).round().to(torch.int8)
            small[f"{name}:scale"] = scale
    return small


def unpacked(small: dict[str, Tensor]) -> dict[str, Tensor]:
    """Return the float32 tensors that `packed` left."""
    state = {}
    for name, tensor in small.items():
        if name.endswith(":scale"):
            continue
        if (scale := small.get(f"{name}:scale")) is not None:
            tensor = tensor.float() * _along_first(scale, tensor)
        state[name] = tensor.float() if tensor.is_floating_point() else tensor
    return state


def _along_first(scale: Tensor, tensor: Tensor) -> Tensor:
    return scale.reshape(-1, *[1] * (tensor.dim() - 1))


def write_parts(runs: Iterable[Path], folder: Path, name: str = "runs.tar") -> list[Path]:
    """Write run folders that hold packed weights as one archive in parts; returns those, in order."""
    content = io.BytesIO()
    with tarfile.open(fileobj=content, mode="w") as archive:
        for run in runs:
            for file in (CONFIG, CURVES, SUMMARY, PACKED):
                archive.add(run / file, f"{run.name}/{file}")
    data, paths = content.getvalue(), []
    for number, start in enumerate(range(0, len(data), PART_BYTES)):
        paths.append(folder / f"{name}.{number}")
        write_whole(paths[-1], data[start : start + PART_BYTES])
    return paths


def read_parts(folder: Path, out: Path, name: str = "runs.tar") -> list[Path]:
    """Write the run folders of an archive in parts as `mirrorwave export` reads them; returns them.

    Raises `ValueError` naming the folder where there is no archive, or none that can be read.
    """
    paths = sorted(folder.glob(f"{name}.*"), key=lambda path: int(path.suffix[1:]))
    if not paths:
        raise ValueError(f"{folder} must hold parts {name}.0, ..., holds none")
    try:
        with tarfile.open(fileobj=io.BytesIO(b"".join(path.read_bytes() for path in paths))) as archive:
            archive.extractall(out, filter="data")
            runs = sorted({out / member.split("/")[0] for member in archive.getnames()})
    except tarfile.TarError as error:
        raise ValueError(f"{folder}: the parts {name}.* must be one whole archive: {error}") from None
    for run in runs:
        state = load_state(run / PACKED)
        save_state(run / BEST, {"network": unpacked(state["network"]), "epoch": state["epoch"]})
        (run / PACKED).unlink()
    return runs
