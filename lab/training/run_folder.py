"""Contents of a run folder: the resolved configuration, the last state, the best network, the curves."""

from __future__ import annotations

from pathlib import Path
from typing import Any, TypeVar

import msgspec
import torch

from msgs.files.checksums import json_lines
from msgs.files.whole_files import whole, write_whole

LAST, BEST, CONFIG, CURVES, SUMMARY = "last.pt", "best.pt", "config.json", "curves.json", "summary.json"

Config = TypeVar("Config")


def adopt_config(run_dir: Path, config: object) -> None:
    """Write the resolved configuration, or require that the run's own is the same."""
    path, content = run_dir / CONFIG, json_lines(config)
    if path.exists():
        if path.read_bytes() != content and not _says(path, config):
            raise ValueError(f"{path} must hold the configuration of this run; use another run folder for another one")
    else:
        run_dir.mkdir(parents=True, exist_ok=True)
        write_whole(path, content)


def _says(path: Path, config: object) -> bool:
    """Return whether a file says the same configuration, if not in the same words: older ones lack newer fields."""
    try:
        return bool(load_json(path, type(config)) == config)
    except ValueError:
        return False


def load_config(run_dir: Path, kind: type[Config]) -> Config:
    """Return the configuration of a run that has a best network; raises `ValueError` naming a missing file."""
    for name in (CONFIG, BEST):
        if not (run_dir / name).exists():
            raise ValueError(f"{run_dir / name} must exist: the run folder holds no trained network")
    return load_json(run_dir / CONFIG, kind)


def load_json(path: Path, kind: type[Config]) -> Config:
    """Return a value of a type from a file; raises `ValueError` naming the file."""
    try:
        return msgspec.json.decode(path.read_bytes(), type=kind)
    except OSError as error:
        raise ValueError(f"{path} must be readable: {error.strerror}") from None
    except (msgspec.DecodeError, ValueError, RecursionError) as error:
        raise ValueError(f"{path}: {error}") from None


def save_state(path: Path, state: dict[str, Any]) -> None:
    """Save tensors and plain values whole or not at all."""
    with whole(path) as part:
        torch.save(state, part)


def load_state(path: Path, device: torch.device | str = "cpu") -> Any:
    """Return a checkpoint's tensors and plain values; raises `ValueError` naming an invalid file."""
    if not path.is_file():
        raise ValueError(f"{path} must be a checkpoint file: there is none")
    try:
        return torch.load(path, map_location=device, weights_only=True)
    except Exception as error:
        # torch passes on any exception of its readers, each with pages of advice
        raise ValueError(f"{path} must be a checkpoint of tensors only, torch cannot read it as one") from error
