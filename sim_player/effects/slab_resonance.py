"""Walls have a back: layers resonate, Eq. (13) taken through the whole stack. Skipped: their front face alone."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from sim_player.scene.world import World
from sim_player.trace.echoes import Echoes

if TYPE_CHECKING:
    from sim_player.planner.ablation import Chain

NAME = "slab_resonance"
ABOUT = "walls reflect by their whole build, not by their front face alone"
COST_S = 0.0


def absent(world: World) -> str | None:
    """Walls without a back have nothing to resonate."""
    backs = any(len(layers) > 1 or math.isfinite(layers[-1][1]) for layers in world.stacks)
    return None if backs else "no wall has a back"


def apply(echoes: Echoes, world: World, used: bool) -> np.ndarray | float:
    """Field factor of every echo: all its bounces."""
    return echoes.whole if used else echoes.front


def change(chain: Chain) -> np.ndarray:
    """Bound of what it changes: magnitudes of all paths' differences."""
    return chain.weight_change(NAME)
