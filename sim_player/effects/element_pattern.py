"""Gain falls off the element's axis (section 2.1.1). Skipped: peak gain everywhere in front."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from sim_player.scene.world import World

if TYPE_CHECKING:
    from sim_player.planner.ablation import Chain

NAME = "element_pattern"
ABOUT = "gain falls off the element's axis"
COST_S = 0.0


def absent(world: World) -> str | None:
    """Every radar has it."""
    return None


def change(chain: Chain) -> np.ndarray:
    """Bound of what it changes: the pattern with and without it."""
    return chain.pattern_change(NAME)
