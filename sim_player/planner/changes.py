"""What an effect alone changes in every cell, all others on.

Dropping a path effect takes its paths away, a weight effect changes the weight of paths, an array effect the two-way
pattern: all that is evaluated. What the receiver adds is bounded by its statistics or its own profile. The effects in
`_OWN_CHANGE` have one of their own.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from models.physics.waveform import window_noise_gain
from msgs.values.radar import RadarParams
from sim_player.effects.curved_wall import as_chords
from sim_player.effects.table import ALL_EFFECTS, EFFECTS, ArrayEffect, PathEffect, WeightEffect
from sim_player.paths.conversion import as_paths, weights
from sim_player.planner.ablation import FAR_SIGMAS, Change, EffectAblation
from sim_player.planner.sweep_terms import SweepTerms
from sim_player.signal.receiver import converter_step, flicker_ratio, quantisation_power_mw
from sim_player.trace.snapshot import TraceContext

#: Field that stands for a change without bound.
WITHOUT_BOUND = 1e30


def change_of(ablation: EffectAblation, name: str) -> Change:
    """Return what dropping an effect takes away, sqrt(mW); KeyError for an effect of which nothing is known."""
    if name in _OWN_CHANGE:
        return _OWN_CHANGE[name](ablation)
    match EFFECTS[name]:
        case PathEffect():
            return ablation.whole(ablation.terms, ablation.made_by(name))
        case WeightEffect():
            return _weight_change(ablation, name)
        case ArrayEffect():
            return _difference(ablation, ablation.terms_of(ablation.paths, ALL_EFFECTS - {name}))
    raise KeyError(f"effect {name} has no bound")


def _difference(ablation: EffectAblation, other: SweepTerms) -> Change:
    """Return what the echoes have over the same echoes otherwise."""
    then = ablation.whole(other)
    return Change(ablation.evaluated.values - then.values, ablation.evaluated.bound + then.bound)


def _weight_change(ablation: EffectAblation, name: str) -> Change:
    """Evaluate the echoes with the difference of both weights."""
    change = ablation.paths.amplitude - weights(ablation.echoes, ablation.world, ALL_EFFECTS - {name})
    return ablation.whole(ablation.terms_of(replace(ablation.paths, amplitude=change)))


def _curved_wall(ablation: EffectAblation) -> Change:
    """Evaluate its paths, and those that chords put in their place."""
    mine = ablation.whole(ablation.terms, ablation.made_by("curved_wall"))
    chords = as_paths(ablation.view, as_chords(TraceContext(ablation.view)), ALL_EFFECTS)
    instead = ablation.whole(ablation.terms_of(chords))
    return Change(mine.values - instead.values, mine.bound + instead.bound)


def _non_cofocal(ablation: EffectAblation) -> Change:
    """Evaluate its paths, and how far arrays that stand apart turn and shift every other echo."""
    mine = ablation.made_by("non_cofocal")
    if ablation.world.scene.radar.separation_m == 0.0:
        return ablation.whole(ablation.terms, mine)
    together = as_paths(ablation.view, ablation.echoes, ALL_EFFECTS - {"non_cofocal"})
    amplitude = np.where(mine, 0.0, together.amplitude)
    return _difference(ablation, ablation.terms_of(replace(together, amplitude=amplitude)))


def _bounded(ablation: EffectAblation, bound: np.ndarray | float) -> Change:
    """Return a change of which a bound is known alone."""
    return Change(np.zeros(ablation.shape, np.complex64), np.broadcast_to(bound, ablation.shape))


def _flicker(ablation: EffectAblation) -> Change:
    """Bound the same noise draws, wider at low beat frequencies."""
    radar = ablation.setup.radar
    beat_hz = np.arange(ablation.shape[1]) / radar.chirp_period_s
    added_mw = radar.noise_power_mw * flicker_ratio(radar, beat_hz, ablation.front_end.flicker_corner_hz)
    return _bounded(ablation, FAR_SIGMAS * _added_rms(radar, added_mw))


def _adc(ablation: EffectAblation) -> Change:
    """Bound the same noise draws, wider by the power of rounding."""
    power_mw = quantisation_power_mw(ablation.setup, converter_step(ablation.front_end))
    added_mw = np.full(ablation.shape[1], power_mw)
    return _bounded(ablation, FAR_SIGMAS * _added_rms(ablation.setup.radar, added_mw))


_OWN_CHANGE: dict[str, Callable[[EffectAblation], Change]] = {
    "curved_wall": _curved_wall,
    "non_cofocal": _non_cofocal,
    # a path that moves leaves its Doppler bin and its cell
    "motion": lambda ablation: _bounded(ablation, WITHOUT_BOUND),
    "squint": EffectAblation.squint,
    "chirp_overlap": lambda ablation: ablation.overlap(ablation.terms, np.ones(len(ablation.terms), bool)),
    "rain_clutter": lambda ablation: _bounded(ablation, FAR_SIGMAS * ablation.clutter_rms),
    "thermal_noise": lambda ablation: _bounded(ablation, FAR_SIGMAS * ablation.noise_rms),
    "flicker": _flicker,
    "leakage": lambda ablation: Change(np.broadcast_to(ablation.leakage(), ablation.shape), np.zeros(ablation.shape)),
    "adc": _adc,
    "iq_imbalance": lambda ablation: _bounded(ablation, ablation.unbalanced(ablation.evaluated)),
    # phases are drawn, magnitudes are not
    "spurs": lambda ablation: _bounded(ablation, ablation.spurs()),
}


def _added_rms(radar: RadarParams, added_mw: np.ndarray) -> np.ndarray:
    """Change of the rms of a Hann-windowed profile's bins when a power per sample is added to thermal noise; [bins]."""
    gain = math.sqrt(window_noise_gain("hann") / (radar.samples_per_chirp * radar.chirps_per_beam))
    change = np.sqrt(radar.noise_power_mw + added_mw) - math.sqrt(radar.noise_power_mw)
    # neighbouring bins come in through the window's taps: take the largest
    padded = np.pad(change, 1, mode="edge")
    return np.asarray(gain * np.maximum.reduce([padded[:-2], padded[1:-1], padded[2:]]))
