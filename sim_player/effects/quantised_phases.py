"""Phase shifters round to 2 pi / 2^bits. Skipped: exact phases."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from sim_player.scene.world import World

if TYPE_CHECKING:
    from sim_player.planner.ablation import Chain

NAME = "quantised_phases"
ABOUT = "phase shifters round"
COST_S = 0.0


def absent(world: World) -> str | None:
    """Ideal shifters, or measured weights: nothing to round."""
    exact = world.setup.array.phase_bits == 0 or world.setup.steering_weights is not None
    return "phases are exact" if exact else None


def change(chain: Chain) -> np.ndarray:
    """Bound of what it changes: the pattern with and without it."""
    return chain.pattern_change(NAME)
