"""Objects in direct sight."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from sim_player.effects.names import TONE_S, bit
from sim_player.scene.world import World
from sim_player.trace.echoes import Echoes, cofocal, object_echoes
from sim_player.trace.snapshot import Tracing

if TYPE_CHECKING:
    from sim_player.planner.ablation import Chain

NAME = "los_objects"
ABOUT = "echoes of objects in direct sight"
COST_S = TONE_S


def absent(world: World) -> str | None:
    """No object, no echo."""
    return None if len(world.centre_m) else "the scene holds no object"


def apply(tracing: Tracing) -> Echoes:
    """Scattering centres whose straight leg is free, out and back."""
    routes, legs = tracing.straight
    tracing.routes[NAME] = routes.take(legs.free)
    return object_echoes(tracing.view, tracing.routes[NAME], cofocal(tracing.routes[NAME]), bit(NAME))


def change(chain: Chain) -> np.ndarray:
    """Bound of its paths."""
    return chain.path_change(NAME)
