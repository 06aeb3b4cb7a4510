"""Upper bounds of what an effect changes in any cell, all others as they stand in the ablation.

A path effect adds its paths, a weight effect changes the weight of paths, an array effect the two-way pattern; each
kind has one bound. The effects in `_OWN_BOUND` have a bound of their own.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from models.physics.waveform import window_noise_gain
from msgs.values.radar import RadarParams
from sim_player.effects.curved_wall import as_chords
from sim_player.effects.table import EFFECTS, ArrayEffect, PathEffect, WeightEffect
from sim_player.planner.ablation import EffectAblation
from sim_player.signal.receiver import (
    converter_step,
    flicker_ratio,
    iq_factors,
    leakage_profile,
    quantisation_power_mw,
    spur_profile,
)
from sim_player.trace.snapshot import TraceContext

#: Noise draws reach this many rms once in 10^13 cells.
FAR_SIGMAS = 5.5
#: Field that stands for a change without bound.
WITHOUT_BOUND = 1e30


def change_bound(ablation: EffectAblation, name: str) -> np.ndarray:
    """Bound what an effect changes, [beams, bins], sqrt(mW); KeyError for an effect without a bound."""
    if name in _OWN_BOUND:
        return _OWN_BOUND[name](ablation)
    match EFFECTS[name]:
        case PathEffect():
            return ablation.path_change(name)
        case WeightEffect():
            return ablation.weight_change(name)
        case ArrayEffect():
            return ablation.pattern_change(name)
    raise KeyError(f"effect {name} has no bound")


def _curved_wall(ablation: EffectAblation) -> np.ndarray:
    """Bound its paths and those that chords put in their place."""
    return ablation.path_change("curved_wall") + ablation.bound_of(as_chords(TraceContext(ablation.view)))


def _non_cofocal(ablation: EffectAblation) -> np.ndarray:
    """Bound its paths, and how far arrays that stand apart turn and shift every echo."""
    bound = ablation.path_change("non_cofocal")
    if ablation.world.scene.radar.separation_m == 0.0:
        return bound
    moved_m = np.abs(ablation.as_paths().length_m - ablation.echoes.out_m - ablation.echoes.back_m)
    turn = np.minimum(2.0 * np.pi * moved_m / ablation.world.radar.wavelength_m, 2.0)
    # the range kernel's slope stays under two a bin
    shift = moved_m / ablation.world.radar.range_bin_m
    return bound + ablation.bound(ablation.amplitude * (turn + shift))


def _motion(ablation: EffectAblation) -> np.ndarray:
    """Give no bound: a path that moves leaves its Doppler bin and its cell."""
    return np.full(ablation.shape, WITHOUT_BOUND)


def _squint(ablation: EffectAblation) -> np.ndarray:
    """Bound what the sweep adds to the pattern in its middle, over all paths."""
    return ablation.squint_change(np.ones(len(ablation.echoes), bool))


def _chirp_overlap(ablation: EffectAblation) -> np.ndarray:
    """Bound what the start of the chirp changes, over all paths."""
    return ablation.overlap_change(np.ones(len(ablation.echoes), bool))


def _thermal_noise(ablation: EffectAblation) -> np.ndarray:
    """Bound what noise draws reach."""
    return np.broadcast_to(FAR_SIGMAS * ablation.noise_rms, ablation.shape)


def _flicker(ablation: EffectAblation) -> np.ndarray:
    """Bound the same noise draws, wider at low beat frequencies."""
    radar = ablation.setup.radar
    beat_hz = np.arange(ablation.shape[1]) / radar.chirp_period_s
    added_mw = radar.noise_power_mw * flicker_ratio(radar, beat_hz, ablation.front_end.flicker_corner_hz)
    return np.broadcast_to(FAR_SIGMAS * _added_rms(radar, added_mw), ablation.shape)


def _leakage(ablation: EffectAblation) -> np.ndarray:
    """Bound it by its own profile."""
    power_dbm = ablation.front_end.leakage_dbm
    if power_dbm is None:
        return np.zeros(ablation.shape)
    profile = leakage_profile(ablation.setup.radar, power_dbm, range(ablation.shape[1]))
    return np.broadcast_to(np.abs(profile), ablation.shape)


def _adc(ablation: EffectAblation) -> np.ndarray:
    """Bound the same noise draws, wider by the power of rounding."""
    power_mw = quantisation_power_mw(ablation.setup, converter_step(ablation.front_end))
    added_mw = np.full(ablation.shape[1], power_mw)
    return np.broadcast_to(FAR_SIGMAS * _added_rms(ablation.setup.radar, added_mw), ablation.shape)


def _iq_imbalance(ablation: EffectAblation) -> np.ndarray:
    """Bound the change of gain on all that is there, and the image's skirts: from +f at -f, by the window alone."""
    wanted, image = iq_factors(ablation.front_end)
    echoes = ablation.bound(ablation.amplitude)
    gain = abs(wanted - 1.0) * (echoes + FAR_SIGMAS * ablation.noise_rms)
    return np.asarray(gain + abs(image) * _image(echoes))


def _spurs(ablation: EffectAblation) -> np.ndarray:
    """Bound them by their own profiles; phases are drawn, magnitudes are not."""
    bins, radar = range(ablation.shape[1]), ablation.setup.radar
    profiles = [np.abs(spur_profile(radar, spur, 0.0, bins)) for spur in ablation.front_end.spurs]
    return np.broadcast_to(np.sum(profiles, axis=0), ablation.shape)


_OWN_BOUND: dict[str, Callable[[EffectAblation], np.ndarray]] = {
    "curved_wall": _curved_wall,
    "non_cofocal": _non_cofocal,
    "motion": _motion,
    "squint": _squint,
    "chirp_overlap": _chirp_overlap,
    "thermal_noise": _thermal_noise,
    "flicker": _flicker,
    "leakage": _leakage,
    "adc": _adc,
    "iq_imbalance": _iq_imbalance,
    "spurs": _spurs,
}


def _added_rms(radar: RadarParams, added_mw: np.ndarray) -> np.ndarray:
    """Change of the rms of a Hann-windowed profile's bins when a power per sample is added to thermal noise; [bins]."""
    gain = math.sqrt(window_noise_gain("hann") / (radar.samples_per_chirp * radar.chirps_per_beam))
    change = np.sqrt(radar.noise_power_mw + added_mw) - math.sqrt(radar.noise_power_mw)
    # neighbouring bins come in through the window's taps: take the largest
    padded = np.pad(change, 1, mode="edge")
    return np.asarray(gain * np.maximum.reduce([padded[:-2], padded[1:-1], padded[2:]]))


def _image(echoes: np.ndarray) -> np.ndarray:
    """Bound the mirrored profile: an echo at bin b reaches bin i over i + b bins, Hann skirts fall as 1 / x^3."""
    bins = np.arange(echoes.shape[1])
    away = bins[:, None] + bins[None]
    return np.asarray(echoes @ np.where(away < 2, 1.0, 1.0 / np.maximum(away, 2.0) ** 3))
