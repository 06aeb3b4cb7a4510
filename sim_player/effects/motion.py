"""Doppler within a beam, range migration, and a scene that moves on from beam to beam (`signal_effects`)."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from sim_player.scene.world import World

if TYPE_CHECKING:
    from sim_player.planner.ablation import Chain

NAME = "motion"
ABOUT = "Doppler, and the scene moves on from beam to beam"
COST_S = 0.0
#: Field of a bound that is none.
WITHOUT_BOUND = 1e30


def absent(world: World) -> str | None:
    """Only where something moves."""
    return None if world.scene.moves else "nothing moves"


def change(chain: Chain) -> np.ndarray:
    """Without a bound: a path that moves leaves its Doppler bin and its place."""
    return np.full(chain.shape, WITHOUT_BOUND)
