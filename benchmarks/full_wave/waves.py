"""The full wave: time-stepped echoes of a scene with and without its target, kept on disk and not computed twice."""

from __future__ import annotations

import math
import os
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from benchmarks.full_wave.line_source import LineEcho, LineGrid, deviation_s, empty_echo, line_source_echo
from benchmarks.full_wave.scenes import MiniScene
from lab.full_wave.grid import HALF_LENGTH
from msgs.values.units import SPEED_OF_LIGHT_MPS

ORIGIN_M = (0.0, 0.0)


@dataclass(frozen=True)
class Waves:
    """Echo of free space, of the walls alone (the source's own field removed), and of each target among them."""

    grid: LineGrid
    empty: LineEcho
    walls: LineEcho
    targets: dict[str, LineEcho]


def solve(
    scene: MiniScene, cells_per_wavelength: float, work: Path, on_step: Callable[[str, float], None] | None = None
) -> Waves:
    """Return the echoes of a scene, computing those that `work` does not hold; `on_step(run, share done)`."""
    grid = scene.grid(cells_per_wavelength)
    pulse_m = SPEED_OF_LIGHT_MPS * 2.0 * HALF_LENGTH * deviation_s(empty_echo(grid, 1 << 11))
    steps = math.ceil((scene.longest_m + pulse_m) / (SPEED_OF_LIGHT_MPS * grid.step_s))
    empty = empty_echo(grid, steps)

    def echo(target: str | None) -> LineEcho:
        name = f"{scene.name}-{target or 'walls'}-{cells_per_wavelength:g}"
        path = work / f"{name}.npy"
        if path.exists() and len(kept := np.load(path)) == steps:
            return replace(empty, field=kept)

        def report(step: int) -> None:
            if on_step is not None:
                on_step(name, step / steps)

        found = line_source_echo(grid, scene.media(grid, target), ORIGIN_M, steps, report)
        work.mkdir(parents=True, exist_ok=True)
        part = path.with_suffix(".part.npy")
        np.save(part, found.field)
        os.replace(part, path)
        return found

    walls = echo(None)
    targets = {name: echo(name) for name in scene.targets}
    return Waves(
        grid,
        empty,
        replace(walls, field=walls.field - empty.field),
        {name: replace(walls, field=found.field - walls.field) for name, found in targets.items()},
    )
