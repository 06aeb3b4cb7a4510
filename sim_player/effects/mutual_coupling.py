"""Columns couple into their neighbours (`models.physics.antenna.coupling_matrix`)."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from sim_player.scene.world import World

if TYPE_CHECKING:
    from sim_player.planner.ablation import Chain

NAME = "mutual_coupling"
ABOUT = "columns couple into each other"
COST_S = 0.0


def absent(world: World) -> str | None:
    """Only where the front end states it."""
    return "the columns do not couple" if world.scene.radar.front_end.coupling_db is None else None


def change(chain: Chain) -> np.ndarray:
    """Bound of what it changes: the pattern with and without it."""
    return chain.pattern_change(NAME)
