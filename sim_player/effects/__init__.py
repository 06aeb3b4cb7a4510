"""The effects of the simulator: one file each, and the tables that name them all.

Every module has `NAME`, `ABOUT`, `COST_S` (a path's share of it in a signal), `absent(world)` (why a scene has none of
it, else None) and `change(chain)` (upper bound of what it changes in any cell, all others as they stand in the chain
from all effects to the planned ones). Path effects add `apply(tracing)`, their echoes; weight effects add
`apply(echoes, world, used)`, a factor with and without; an effect of the signal is a switch of its name in
`SignalEffects`, and its physics stands where the signal is made.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Protocol

import numpy as np

from sim_player.effects import (
    adc,
    atmosphere,
    chirp_overlap,
    curved_wall,
    diffuse_scattering,
    edge_diffraction,
    element_pattern,
    flicker,
    ground_bounce,
    iq_imbalance,
    leakage,
    los_objects,
    los_surfaces,
    motion,
    mutual_coupling,
    non_cofocal,
    object_interreflection,
    quantised_phases,
    rough_wall_loss,
    second_relay,
    slab_resonance,
    specular_relay,
    spurs,
    squint,
    thermal_noise,
    vegetation,
    wall_transmission,
)
from sim_player.effects.names import ALL_EFFECTS, PATH_EFFECTS, SIGNAL_EFFECTS, WEIGHT_EFFECTS
from sim_player.scene.world import World
from sim_player.trace.echoes import Echoes
from sim_player.trace.snapshot import Tracing

if TYPE_CHECKING:
    from sim_player.planner.ablation import Chain

__all__ = ["ALL_EFFECTS", "EFFECTS", "PATHS", "PATH_EFFECTS", "SIGNAL_EFFECTS", "WEIGHTS", "WEIGHT_EFFECTS"]


class Effect(Protocol):
    """What the module of any effect answers to."""

    NAME: str
    ABOUT: str
    COST_S: float

    def absent(self, world: World) -> str | None:
        """Why a scene has none of it; None where it may."""

    def change(self, chain: Chain) -> np.ndarray:
        """Bound of what it changes, [beams, bins]."""


class PathEffect(Effect, Protocol):
    """An effect that makes echoes."""

    def apply(self, tracing: Tracing) -> Echoes:
        """Its echoes; ways it found may serve the effects after it."""


class WeightEffect(Effect, Protocol):
    """An effect that changes the echoes that are there."""

    def apply(self, echoes: Echoes, world: World, used: bool) -> np.ndarray | float:
        """Field factor of every echo, with it or without."""


_PATHS: tuple[PathEffect, ...] = (
    los_objects,
    los_surfaces,
    specular_relay,
    diffuse_scattering,
    curved_wall,
    second_relay,
    non_cofocal,
    wall_transmission,
    edge_diffraction,
    ground_bounce,
    object_interreflection,
)
_WEIGHTS: tuple[WeightEffect, ...] = (rough_wall_loss, slab_resonance, vegetation, atmosphere)
_SIGNAL: tuple[Effect, ...] = (
    motion,
    element_pattern,
    quantised_phases,
    mutual_coupling,
    squint,
    chirp_overlap,
    thermal_noise,
    flicker,
    leakage,
    adc,
    iq_imbalance,
    spurs,
)
PATHS: dict[str, PathEffect] = {module.NAME: module for module in _PATHS}
WEIGHTS: dict[str, WeightEffect] = {module.NAME: module for module in _WEIGHTS}
#: All effects in the order in which they act.
EFFECTS: dict[str, Effect] = {module.NAME: module for module in (*_PATHS, *_WEIGHTS, *_SIGNAL)}
