"""The mirror: objects seen in a straight piece of wall, Eqs. (2)-(5), by the image method."""

from __future__ import annotations

from sim_player.scene.world import World
from sim_player.trace.echoes import Echoes, cofocal, object_echoes
from sim_player.trace.routes import clear_ways
from sim_player.trace.snapshot import TraceContext


def absent(world: World) -> str | None:
    """A mirror needs a wall and an object."""
    if not len(world.centre_m):
        return "the scene holds no object"
    return None if world.is_mirror.any() else "the scene holds no wall"


def apply(tracing: TraceContext) -> Echoes:
    """Centres in every straight piece of wall, both legs free, out and back by the same point."""
    clear = clear_ways(*tracing.mirrored)
    tracing.routes["specular_relay"] = clear
    return object_echoes(tracing.view, clear, cofocal(clear))
