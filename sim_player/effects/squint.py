"""The beam turns with the frequency of the sweep: +-3.5 deg at 60 deg for X-band (`swept_echoes`)."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from sim_player.scene.world import World

if TYPE_CHECKING:
    from sim_player.planner.ablation import Chain

NAME = "squint"
ABOUT = "the beam turns with the frequency of the sweep"
COST_S = 30e-6


def absent(world: World) -> str | None:
    """Every radar has it."""
    return None


def change(chain: Chain) -> np.ndarray:
    """Bound of what the sweep adds to the pattern in its middle, over all paths."""
    return chain.squint_change(np.ones(len(chain.echoes), bool))
