"""A mounting as a file for `launch --params-file`, and in lines for people."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Any

import yaml

from msgs.files.whole_files import write_whole
from msgs.values.wording import counted

if TYPE_CHECKING:
    from contrib.calibrate.mounting import CalibratedQuantity, Mounting


def write_params(out: Path, params: dict[str, Any], mounting: Mounting) -> None:
    """A file for `launch --params-file`, with what its figures rest on as comments."""
    evidence = f"{counted(mounting.sightings, 'sighting')} of {counted(len(mounting.walls), 'wall')}"
    notes = [
        f"# {counted(mounting.scans, 'scan')}, {evidence}, rms {mounting.rms_m:.3f} m",
        *(f"# {line}" for line in mounting_lines(mounting)),
    ]
    write_whole(out, ("\n".join(notes) + "\n" + yaml.safe_dump(params, sort_keys=False)).encode())


def mounting_lines(mounting: Mounting) -> list[str]:
    """Return what is known and what is not, one line each."""
    degree = math.degrees(1.0)
    return [
        _line("x", mounting.x_m, "m", 1.0),
        _line("y", mounting.y_m, "m", 1.0),
        _line("yaw", mounting.yaw_rad, "deg", degree),
        _line("clock offset", mounting.clock_offset_s, "ms", 1e3),
    ]


def _line(name: str, quantity: CalibratedQuantity, unit: str, factor: float) -> str:
    value, std = factor * quantity.value, factor * quantity.std
    if quantity.observed:
        return f"{name}: {value:.3f} {unit}, standard deviation {std:.3f}"
    if quantity.std == 0.0:
        return f"{name}: {value:.3f} {unit}, as given"
    return f"{name}: {value:.3f} {unit}, as given: this drive does not tell (standard deviation {std:.3f})"
