"""How far two sets of echoes of one scene are apart, as the planner's law counts it."""

from __future__ import annotations

import msgspec
import numpy as np

from sim_player.effects.table import ALL_EFFECTS
from sim_player.paths.conversion import as_paths
from sim_player.planner.ablation import signal_effects
from sim_player.planner.cells import cells_of
from sim_player.scene.world import Snapshot, World
from sim_player.signal.levels import kernel_profiles, noise_rms
from sim_player.trace.echoes import Echoes


def change_db(world: World, first: tuple[Snapshot, Echoes], second: tuple[Snapshot, Echoes]) -> float:
    """Return the largest change of a cell over the noise or what stands there, kernel level in double precision."""
    front_end = world.scene.radar.front_end
    flags = msgspec.structs.replace(signal_effects(ALL_EFFECTS), motion=False)
    everything, left = (
        kernel_profiles(world.setup, as_paths(view, echoes, ALL_EFFECTS), flags, front_end, precision="float64")
        for view, echoes in (first, second)
    )
    off = cells_of(world.setup).off(everything, left, noise_rms(world.setup, flags, front_end))
    return float(20.0 * np.log10(max(off.max(), 1e-20)))
