"""Objects in direct sight."""

from __future__ import annotations

from sim_player.echoes import Echoes, cofocal, object_echoes
from sim_player.effect_names import bit
from sim_player.effects.tracing import Tracing
from sim_player.world import World

NAME = "los_objects"
ABOUT = "echoes of objects in direct sight"


def absent(world: World) -> str | None:
    """No object, no echo."""
    return None if len(world.centre_m) else "the scene holds no object"


def apply(tracing: Tracing) -> Echoes:
    """Scattering centres whose straight leg is free, out and back."""
    routes, legs = tracing.straight
    tracing.routes[NAME] = routes.take(legs.free)
    return object_echoes(tracing.view, tracing.routes[NAME], cofocal(tracing.routes[NAME]), bit(NAME))
