"""The mirror: objects seen in a straight piece of wall, Eqs. (2)-(5), by the image method."""

from __future__ import annotations

from sim_player.echoes import Echoes, cofocal, object_echoes
from sim_player.effects.tracing import Tracing
from sim_player.world import World

NAME = "specular_relay"
ABOUT = "objects seen in one wall"


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
