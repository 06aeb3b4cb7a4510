"""The mirror: objects seen in a straight piece of wall, Eqs. (2)-(5), by the image method."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from sim_player.effects.names import TONE_S
from sim_player.scene.world import World
from sim_player.trace.echoes import Echoes, cofocal, object_echoes
from sim_player.trace.snapshot import Tracing

if TYPE_CHECKING:
    from sim_player.planner.ablation import Chain

NAME = "specular_relay"
ABOUT = "objects seen in one wall"
COST_S = TONE_S


def absent(world: World) -> str | None:
    """A mirror needs a wall and an object."""
    if not len(world.centre_m):
        return "the scene holds no object"
    return None if world.is_mirror.any() else "the scene holds no wall"


def apply(tracing: Tracing) -> Echoes:
    """Centres in every straight piece of wall, both legs free, out and back by the same point."""
    routes, legs = tracing.mirrored
    tracing.routes[NAME] = routes.take(legs.free)
    return object_echoes(tracing.view, tracing.routes[NAME], cofocal(tracing.routes[NAME]))


def change(chain: Chain) -> np.ndarray:
    """Bound of its paths."""
    return chain.path_change(NAME)
