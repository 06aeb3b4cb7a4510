"""The table of all effects: one row each, by kind, in the order in which they act.

A path effect makes echoes, a weight effect changes those that are there, an array effect changes the two-way pattern,
and any other signal effect changes the waveform or the receiver. What an effect can change at most is the planner's
business (`sim_player.planner.changes`).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from sim_player.effects import (
    curved_wall,
    diffuse_scattering,
    edge_diffraction,
    ground_bounce,
    los_objects,
    los_surfaces,
    non_cofocal,
    object_interreflection,
    second_relay,
    signal,
    specular_relay,
    wall_transmission,
    weights,
)
from sim_player.scene.world import World
from sim_player.trace.echoes import Echoes
from sim_player.trace.snapshot import TraceContext

#: Cost of a path as a tone of a signal, on one core of the reference machine (docs/results/simulator.md).
TONE_S = 6e-6


def always(world: World) -> str | None:
    """Return None: every scene has it."""
    return None


@dataclass(frozen=True)
class Effect:
    """One effect: its name and kind, why a scene has none of it, and its cost."""

    about: str
    #: Why a scene has none of it; None where it may have.
    absent: Callable[[World], str | None]
    #: Cost of a path that has it, in a signal.
    cost_s: float = field(default=0.0, kw_only=True)


@dataclass(frozen=True)
class PathEffect(Effect):
    """An effect that makes echoes; the routes that it finds may serve the effects after it."""

    apply: Callable[[TraceContext], Echoes]
    cost_s: float = field(default=TONE_S, kw_only=True)


@dataclass(frozen=True)
class WeightEffect(Effect):
    """An effect that changes the echoes that are there: the field factor of each, with it or without."""

    apply: Callable[[Echoes, World, bool], np.ndarray | float]


class SignalEffect(Effect):
    """An effect of motion, antenna, waveform or receiver: a switch of its name in `SignalEffects`."""


class ArrayEffect(SignalEffect):
    """A signal effect that changes nothing but the two-way pattern."""


PATHS: dict[str, PathEffect] = {
    "los_objects": PathEffect("echoes of objects in direct sight", los_objects.absent, los_objects.apply),
    "los_surfaces": PathEffect(
        "flashes and structure of walls in direct sight", los_surfaces.absent, los_surfaces.apply
    ),
    "specular_relay": PathEffect("objects seen in one wall", specular_relay.absent, specular_relay.apply),
    "diffuse_scattering": PathEffect(
        "diffuse return of rough walls in direct sight", diffuse_scattering.absent, diffuse_scattering.apply
    ),
    "curved_wall": PathEffect("objects and the radar seen in curved walls", curved_wall.absent, curved_wall.apply),
    "second_relay": PathEffect(
        "objects, the radar and walls seen by way of two walls", second_relay.absent, second_relay.apply
    ),
    "non_cofocal": PathEffect(
        "echoes that return by another way than they went", non_cofocal.absent, non_cofocal.apply
    ),
    "wall_transmission": PathEffect("objects seen through walls", wall_transmission.absent, wall_transmission.apply),
    "edge_diffraction": PathEffect(
        "echoes bent around walls' ends and corners", edge_diffraction.absent, edge_diffraction.apply
    ),
    "ground_bounce": PathEffect("echoes of objects by way of the ground", ground_bounce.absent, ground_bounce.apply),
    "object_interreflection": PathEffect(
        "echoes by way of two objects", object_interreflection.absent, object_interreflection.apply
    ),
}
WEIGHTS: dict[str, WeightEffect] = {
    "rough_wall_loss": WeightEffect("mirrors weakened by roughness", weights.no_roughness, weights.rough_wall_loss),
    "slab_resonance": WeightEffect(
        "walls reflect by their whole build, not by their front face alone", weights.no_backs, weights.slab_resonance
    ),
    "vegetation": WeightEffect("paths weakened by foliage", weights.no_plants, weights.vegetation),
    "atmosphere": WeightEffect("gases and rain along the paths", always, weights.atmosphere),
}
SIGNAL: dict[str, SignalEffect] = {
    "motion": SignalEffect("Doppler, and the scene moves on from beam to beam", signal.no_motion),
    "element_pattern": ArrayEffect("gain falls off the element's axis", always),
    "quantised_phases": ArrayEffect("phase shifters round", signal.no_phase_steps),
    "mutual_coupling": ArrayEffect("columns couple into each other", signal.no_coupling),
    "squint": SignalEffect("the beam turns with the frequency of the sweep", always, cost_s=30e-6),
    "chirp_overlap": SignalEffect("a chirp begins before the last one's echoes are in", always, cost_s=60e-6),
    "thermal_noise": SignalEffect("it is the floor", always),
    "flicker": SignalEffect("1/f noise of the receiver at short range", signal.no_flicker),
    "leakage": SignalEffect("transmitter straight into the receiver", signal.no_leakage),
    "adc": SignalEffect("rounding of the converter", always),
    "iq_imbalance": SignalEffect("gain and phase between I and Q", signal.no_iq_imbalance),
    "spurs": SignalEffect("tones of the electronics", signal.no_spurs),
}
EFFECTS: dict[str, Effect] = {**PATHS, **WEIGHTS, **SIGNAL}
ALL_EFFECTS = frozenset(EFFECTS)


def check_effects(names: frozenset[str]) -> frozenset[str]:
    """Return the same names; ValueError lists the unknown ones."""
    unknown = sorted(names - ALL_EFFECTS)
    if unknown:
        raise ValueError(f"effects: unknown {', '.join(unknown)}, known are {', '.join(sorted(ALL_EFFECTS))}")
    return names
