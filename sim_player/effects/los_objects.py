"""Objects in direct sight."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from sim_player.echoes import Echoes, cofocal, object_echoes
from sim_player.effect_names import TONE_S, bit
from sim_player.effects.tracing import Tracing
from sim_player.world import World

if TYPE_CHECKING:
    from sim_player.chain import Chain

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
