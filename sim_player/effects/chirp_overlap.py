"""Chirps are back to back: for t < tau an echo is still the last chirp's, 13 % of the chirp at 109 m."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from sim_player.scene.world import World

if TYPE_CHECKING:
    from sim_player.planner.ablation import Chain

NAME = "chirp_overlap"
ABOUT = "a chirp begins before the last one's echoes are in"
COST_S = 60e-6


def absent(world: World) -> str | None:
    """Every radar has it."""
    return None


def change(chain: Chain) -> np.ndarray:
    """Bound of what the start of the chirp changes, over all paths."""
    return chain.overlap_change(np.ones(len(chain.echoes), bool))
