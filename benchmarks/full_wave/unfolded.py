"""What bends before a mirror would add: the mirrored group of `hidden` and `street`, unfolded.

The target stands at its image and the wall is gone, so that the tracer's own bends round the block are those before the
mirror. Without them the mirrored group differs from the whole by what is printed.
Usage: python -m benchmarks.full_wave.unfolded
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from benchmarks.full_wave.comparison import EFFECTS, GATE_M, SWEEP_HZ, level_db
from benchmarks.full_wave.rays import ray_field
from benchmarks.full_wave.scenes import MiniScene, scenes

CELLS_PER_WAVELENGTH = 20.0


def bends_left_out(scene: MiniScene) -> tuple[float, float]:
    """Return level [dB] and phase [deg] of the mirrored group without bends over the group with them.

    The scene's first surface is the mirror, along y; its second the block.
    """
    x_m, y_m = scene.targets["hidden"]
    image_m = (2.0 * scene.surfaces[0].polyline_m[0][0] - x_m, y_m)
    world = replace(scene, surfaces=scene.surfaces[1:]).world(image_m)
    rays = ray_field(world, EFFECTS, scene.grid(CELLS_PER_WAVELENGTH), SWEEP_HZ, np.ones(len(SWEEP_HZ), complex))
    straight = rays.name.index("direct")
    whole = rays.field[np.abs(rays.delay_m - rays.delay_m[straight]) < GATE_M].sum(axis=0)
    alone = rays.field[straight]
    return level_db(alone, whole), float(np.degrees(np.angle(np.vdot(whole, alone))))


def main() -> None:
    for scene in scenes(0):
        if "hidden" in scene.targets:
            level, phase_deg = bends_left_out(scene)
            print(f"{scene.name}: mirrored group without bends before the mirror {level:+.2f} dB, {phase_deg:+.1f} deg")


if __name__ == "__main__":
    main()
