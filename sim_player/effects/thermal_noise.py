"""White noise of k T0 f_s F (`receiver.thermal_noise`, `signal_levels.noise_profiles`)."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from sim_player.effects.noise_bounds import FAR_SIGMAS
from sim_player.scene.world import World

if TYPE_CHECKING:
    from sim_player.planner.ablation import Chain

NAME = "thermal_noise"
ABOUT = "it is the floor"
COST_S = 0.0


def absent(world: World) -> str | None:
    """Every radar has it."""
    return None


def change(chain: Chain) -> np.ndarray:
    """What noise draws reach."""
    return np.broadcast_to(FAR_SIGMAS * chain.noise_rms, chain.shape)
