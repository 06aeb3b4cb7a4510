"""Ray tracing of a scene at a time by the image method: every path effect in turn, geometry first, fields second."""

from __future__ import annotations

from sim_player.effects.curved_wall import as_chords
from sim_player.effects.table import PATHS
from sim_player.scene.world import Snapshot, World, snapshot
from sim_player.trace.conversion import as_paths
from sim_player.trace.echoes import Echoes, join_echoes
from sim_player.trace.paths import Paths
from sim_player.trace.snapshot import TraceContext

#: Direct echoes and flat mirrors with all effects of one bounce.
BASIC_EFFECTS = frozenset(
    {
        "los_objects",
        "los_surfaces",
        "specular_relay",
        "diffuse_scattering",
        "curved_wall",
        "rough_wall_loss",
        "slab_resonance",
    }
)


def trace(world: World, time_s: float = 0.0, effects: frozenset[str] = BASIC_EFFECTS) -> Paths:
    """Return all paths at a time after start, of the given effects."""
    view = snapshot(world, time_s)
    return as_paths(view, trace_echoes(view, effects), effects)


def trace_echoes(view: Snapshot, effects: frozenset[str]) -> Echoes:
    """Return the echoes of all given path effects, in the order of `PATH_EFFECTS`."""
    return join_echoes(list(trace_each(view, effects).values()))


def trace_each(view: Snapshot, effects: frozenset[str]) -> dict[str, Echoes]:
    """Return the echoes of every given path effect, by name."""
    tracing, echoes = TraceContext(view), dict[str, Echoes]()
    for name, effect in PATHS.items():
        if name in effects and effect.absent(view.world) is None:
            echoes[name] = effect.apply(tracing)
        elif name == "curved_wall" and "specular_relay" in effects:
            echoes[name] = as_chords(tracing)
    return echoes or {"los_objects": PATHS["los_objects"].apply(tracing)}
