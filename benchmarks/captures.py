"""Captures that are no part of the project: the option of all benchmarks that read them."""

from __future__ import annotations

import os
from argparse import ArgumentParser
from pathlib import Path


def add_data_option(parser: ArgumentParser) -> None:
    """Add `--data`, the folder that holds the captures' folders; MIRRORWAVE_DATA names it, too."""
    parser.add_argument("--data", type=Path, default=os.environ.get("MIRRORWAVE_DATA"), help="folder of captures")


def capture_folder(parser: ArgumentParser, data: Path | None, name: str) -> Path:
    """Return a capture's folder; ends the program with one line where it is not there."""
    if data is None or not (folder := Path(data) / name).is_dir():
        parser.error(f"--data or MIRRORWAVE_DATA must name a folder that holds {name}/, got {data}")
    return folder
