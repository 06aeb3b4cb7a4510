"""What roughness leaves of a mirror: the Kirchhoff factor exp(-(4 pi s cos / lambda)^2) of power, a bounce."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from sim_player.scene.world import World
from sim_player.trace.echoes import Echoes

if TYPE_CHECKING:
    from sim_player.planner.ablation import Chain

NAME = "rough_wall_loss"
ABOUT = "mirrors weakened by roughness"
COST_S = 0.0


def absent(world: World) -> str | None:
    """Smooth walls lose nothing."""
    rough = (world.wall_roughness_m[world.is_mirror] > 0.0).any()
    ground = world.ground is not None and world.ground.roughness_mm > 0.0
    return None if rough or ground else "no wall is rough"


def apply(echoes: Echoes, world: World, used: bool) -> np.ndarray | float:
    """Field factor of every echo."""
    return echoes.rough if used else 1.0


def change(chain: Chain) -> np.ndarray:
    """Bound of what it changes: magnitudes of all paths' differences."""
    return chain.weight_change(NAME)
