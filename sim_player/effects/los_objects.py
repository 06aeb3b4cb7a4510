"""Objects in direct sight."""

from __future__ import annotations

from sim_player.scene.world import World
from sim_player.trace.echoes import Echoes, cofocal, object_echoes
from sim_player.trace.effect_names import bit
from sim_player.trace.routes import clear_ways
from sim_player.trace.snapshot import TraceContext


def absent(world: World) -> str | None:
    """No object, no echo."""
    return None if len(world.centre_m) else "the scene holds no object"


def apply(tracing: TraceContext) -> Echoes:
    """Scattering centres whose straight leg is free, out and back."""
    clear = clear_ways(*tracing.straight)
    tracing.routes["los_objects"] = clear
    return object_echoes(tracing.view, clear, cofocal(clear), bit("los_objects"))
