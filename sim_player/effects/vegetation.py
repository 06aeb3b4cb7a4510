"""Foliage thins what passes it (ITU-R P.833 form); it is no mirror. Skipped: nothing stands there."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from sim_player.scene.world import World
from sim_player.trace.echoes import Echoes

if TYPE_CHECKING:
    from sim_player.planner.ablation import Chain

NAME = "vegetation"
ABOUT = "paths weakened by foliage"
COST_S = 0.0


def absent(world: World) -> str | None:
    """Only where something grows."""
    return "nothing grows here" if world.is_mirror.all() else None


def apply(echoes: Echoes, world: World, used: bool) -> np.ndarray | float:
    """Field factor of every echo."""
    return echoes.foliage if used else 1.0


def change(chain: Chain) -> np.ndarray:
    """Bound of what it changes: magnitudes of all paths' differences."""
    return chain.weight_change(NAME)
