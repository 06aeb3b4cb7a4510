"""Ray tracing of a scene at a time by the image method: every path effect in turn, geometry first, fields second."""

from __future__ import annotations

import math

import numpy as np

from msgs.values.perception import PathClass
from msgs.values.units import SPEED_OF_LIGHT_MPS
from sim_player.effects.curved_wall import as_chords
from sim_player.effects.table import PATHS
from sim_player.paths.conversion import as_paths
from sim_player.paths.reach import LATEST, reachable_snapshot
from sim_player.scene.world import Snapshot, World
from sim_player.trace.echoes import Echoes
from sim_player.trace.path_table import Paths
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
    view = reachable_snapshot(world, time_s)
    return as_paths(view, trace_echoes(view, effects), effects)


def trace_echoes(view: Snapshot, effects: frozenset[str]) -> Echoes:
    """Return the echoes of all given path effects, in the order of `PATH_EFFECTS`."""
    echoes = Echoes.joined(list(trace_each(view, effects).values()))
    if math.isfinite(view.world.reach_m):
        echoes = echoes.take(is_kept(view, echoes))
    return _within_a_chirp(view, echoes)


def trace_each(view: Snapshot, effects: frozenset[str]) -> dict[str, Echoes]:
    """Return the echoes of every given path effect, by name: also those that come from beyond a part's reach."""
    tracing, echoes = TraceContext(view), dict[str, Echoes]()
    for name, effect in PATHS.items():
        if name in effects and effect.absent(view.world) is None:
            echoes[name] = effect.apply(tracing)
        elif name == "curved_wall" and "specular_relay" in effects and view.world.is_curved.any():
            echoes[name] = as_chords(tracing)
    return echoes or {"los_objects": PATHS["los_objects"].apply(tracing)}


def _within_a_chirp(view: Snapshot, echoes: Echoes) -> Echoes:
    """Return the echoes that come back before the next chirp is over: later ones are of no chirp that is mixed."""
    length_m = echoes.out_m + echoes.back_m
    latest_m = LATEST * SPEED_OF_LIGHT_MPS * view.world.radar.chirp_period_s
    return echoes if length_m.max(initial=0.0) < latest_m else echoes.take(length_m < latest_m)


def is_kept(view: Snapshot, echoes: Echoes) -> np.ndarray:
    """Return which echoes of a part of a world are those of the whole, bool [E]: within reach, or distant flashes.

    If asked for, only those that neither leave nor arrive behind the antenna.
    """
    kept = echoes.out_m + echoes.back_m <= 2.0 * view.world.reach_m
    if len(view.distant):
        kept |= (echoes.kind == PathClass.LOS) & np.isin(echoes.surface, view.distant)
    if view.ahead_only:
        kept &= view.is_ahead(echoes.depart) & view.is_ahead(echoes.arrive)
    return np.asarray(kept)
