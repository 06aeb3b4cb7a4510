"""The table of all effects: one row each, by kind, in the order in which they act.

A path effect makes echoes, a weight effect changes them, an array effect changes the two-way pattern, any other signal
effect the waveform or the receiver. Packages bring path and weight effects (`effect_of`), behind ours, by name.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from msgs.files.plugins import EFFECTS as EFFECT_PLUGINS
from msgs.files.plugins import Plugin, plugins, reason_of
from sim_player.effects import (
    curved_wall,
    diffuse_scattering,
    edge_diffraction,
    ground_bounce,
    los_objects,
    los_surfaces,
    mirrored_diffraction,
    non_cofocal,
    object_interreflection,
    second_relay,
    specular_relay,
    wall_transmission,
    weights,
)
from sim_player.scene.world import World
from sim_player.signal import absences
from sim_player.trace.echoes import Echoes
from sim_player.trace.effect_names import MAX_PATH_EFFECTS, PATH_EFFECTS, PLUGGED_IN, bit
from sim_player.trace.snapshot import TraceContext

_LOG = logging.getLogger(__name__)

#: Cost of a path as a tone of a signal, on one core of the reference machine (docs/results/README.md).
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
    #: Cost of a path that has it, in a signal; of the air's echoes, of all.
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
    module.__name__.rpartition(".")[2]: PathEffect(about, module.absent, module.apply)
    for module, about in (
        (los_objects, "echoes of objects in direct sight"),
        (los_surfaces, "flashes and structure of walls in direct sight"),
        (specular_relay, "objects seen in one wall"),
        (diffuse_scattering, "diffuse return of rough walls in direct sight"),
        (curved_wall, "objects and the radar seen in curved walls"),
        (second_relay, "objects, the radar and walls seen by way of two walls"),
        (non_cofocal, "echoes that return by another way than they went"),
        (wall_transmission, "objects seen through walls"),
        (edge_diffraction, "echoes bent around walls' ends and corners"),
        (ground_bounce, "echoes of objects by way of the ground"),
        (object_interreflection, "echoes by way of two objects"),
        (mirrored_diffraction, "echoes bent before or after a mirror"),
    )
}
WEIGHTS: dict[str, WeightEffect] = {
    "rough_wall_loss": WeightEffect("mirrors weakened by roughness", weights.no_roughness, weights.rough_wall_loss),
    "slab_resonance": WeightEffect(
        "walls reflect by their whole build, not by their front face alone", weights.no_backs, weights.slab_resonance
    ),
    "vegetation": WeightEffect("paths weakened by foliage", weights.no_plants, weights.vegetation),
    "atmosphere": WeightEffect("gases, rain, snow and fog along the paths", always, weights.atmosphere),
}
SIGNAL: dict[str, SignalEffect] = {
    "motion": SignalEffect("Doppler, and the scene moves on from beam to beam", absences.no_motion),
    "element_pattern": ArrayEffect("gain falls off the element's axis", always),
    "quantised_phases": ArrayEffect("phase shifters round", absences.no_phase_steps),
    "mutual_coupling": ArrayEffect("columns couple into each other", absences.no_coupling),
    "squint": SignalEffect("the beam turns with the frequency of the sweep", always, cost_s=30e-6),
    "chirp_overlap": SignalEffect("a chirp begins before the last one's echoes are in", always, cost_s=60e-6),
    "rain_clutter": SignalEffect("echoes of rain, snow and fog in the beam", absences.no_rain, cost_s=6e-3),
    "thermal_noise": SignalEffect("it is the floor", always),
    "flicker": SignalEffect("1/f noise of the receiver at short range", absences.no_flicker),
    "leakage": SignalEffect("transmitter straight into the receiver", absences.no_leakage),
    "adc": SignalEffect("rounding of the converter", always),
    "iq_imbalance": SignalEffect("gain and phase between I and Q", absences.no_iq_imbalance),
    "spurs": SignalEffect("tones of the electronics", absences.no_spurs),
}
#: Those that come with the code.
SHIPPED = frozenset((*PATHS, *WEIGHTS, *SIGNAL))


def effect_of(plugin: Plugin) -> PathEffect | WeightEffect:
    """Return the effect that a package's module describes; `ValueError` for one that cannot be used.

    It has `ABOUT`, `absent(world)`, and `apply(tracing)` (its echoes) or `factor(echoes, world, used)` (weights).
    """
    if plugin.name in SHIPPED:
        raise ValueError(f"{plugin}: mirrorwave has an effect of this name")
    if plugin.name not in PLUGGED_IN and len(PLUGGED_IN) == MAX_PATH_EFFECTS - len(PATH_EFFECTS):
        raise ValueError(f"{plugin}: there are {len(PLUGGED_IN)} effects of other packages already")
    module = plugin.load("ABOUT", "absent")
    parts = [name for name in ("apply", "factor") if hasattr(module, name)]
    if len(parts) != 1:
        raise ValueError(
            f"{plugin}: {module.__name__} must define apply(tracing) or factor(echoes, world, used), one of"
        )
    if wrong := [name for name in ("absent", *parts) if not callable(getattr(module, name))]:
        raise ValueError(f"{plugin}: {', '.join(wrong)} of {module.__name__} must be a function")
    about, absent = str(module.ABOUT), _guarded(plugin, module.absent)
    if parts == ["factor"]:
        return WeightEffect(about, absent, _checked_factor(plugin, _guarded(plugin, module.factor)))
    return PathEffect(about, absent, _checked_echoes(plugin, _guarded(plugin, module.apply)))


def _guarded(plugin: Plugin, function: Callable[..., Any]) -> Callable[..., Any]:
    """Have whatever other people's code raises say whose it is."""

    def call(*arguments: Any) -> Any:
        try:
            return function(*arguments)
        except Exception as error:
            raise ValueError(f"effect {plugin}: {reason_of(error)}") from error

    return call


def _checked_echoes(plugin: Plugin, apply: Callable[..., Any]) -> Callable[[TraceContext], Echoes]:
    def checked(tracing: TraceContext) -> Echoes:
        echoes = apply(tracing)
        if not isinstance(echoes, Echoes):
            raise ValueError(f"effect {plugin}: apply must return Echoes, got {type(echoes).__name__}")
        if not np.isfinite(echoes.weight).all():
            raise ValueError(f"effect {plugin}: weights of echoes must be finite")
        # the planner drops an effect's paths by this bit
        if not (echoes.needs & np.uint32(bit(plugin.name))).all():
            raise ValueError(f"effect {plugin}: echoes must carry bit({plugin.name!r}) in needs")
        return echoes

    return checked


def _checked_factor(plugin: Plugin, factor: Callable[..., Any]) -> Callable[[Echoes, World, bool], np.ndarray]:
    def checked(echoes: Echoes, world: World, used: bool) -> np.ndarray:
        values = np.asarray(factor(echoes, world, used))
        if values.shape not in ((), (len(echoes),)) or values.dtype.kind not in "iufc":
            raise ValueError(
                f"effect {plugin}: factor must return a number or one for each of {len(echoes)} echoes, "
                f"got {values.dtype} {values.shape}"
            )
        if not np.isfinite(values).all():
            raise ValueError(f"effect {plugin}: factors must be finite")
        return values

    return checked


def _plug_in() -> None:
    """Add the effects of installed packages; a broken one is left out with a line in the log."""
    brought = plugins(EFFECT_PLUGINS)
    lines = [str(refusal) for refusal in brought.refused]
    for name, plugin in brought.usable.items():
        try:
            effect = effect_of(plugin)
        except ValueError as error:
            lines.append(str(error))
        else:
            table: dict[str, Any] = PATHS if isinstance(effect, PathEffect) else WEIGHTS
            table[name] = effect
    for line in lines:
        _LOG.warning("effect %s; it is left out", line)


_plug_in()
EFFECTS: dict[str, Effect] = {**PATHS, **WEIGHTS, **SIGNAL}
ALL_EFFECTS = frozenset(EFFECTS)


def named_effects(effects: str) -> frozenset[str]:
    """Return the names of effects in a text of "auto", "basic", "all", which give all, or names between commas.

    Raises ValueError for an unknown effect, or an empty list.
    """
    if effects in ("auto", "basic", "all"):
        return ALL_EFFECTS
    names = frozenset(name.strip() for name in effects.split(",")) - {""}
    if not names:
        raise ValueError("effects: want auto, all, basic or names with commas between them, got nothing")
    return check_effects(names)


def check_effects(names: frozenset[str]) -> frozenset[str]:
    """Return the same names; ValueError lists the unknown ones."""
    unknown = sorted(names - ALL_EFFECTS)
    if unknown:
        raise ValueError(f"effects: unknown {', '.join(unknown)}, known are {', '.join(sorted(ALL_EFFECTS))}")
    return names
