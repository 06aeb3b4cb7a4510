"""Effects of motion, antenna, waveform and receiver: when a scene has none of them, and the receiver's bounds.

What each does is in `sim_player.signal_effects`, `swept_echoes` and `receiver`; bounds of the antenna's and the
waveform's effects come from the paths (`sim_player.envelope`).
"""

from __future__ import annotations

import math

import numpy as np

from models.physics.waveform import WINDOW_TAPS
from msgs.radar import RadarSetup
from sim_player.front_end import FrontEnd
from sim_player.receiver import (
    converter_step,
    flicker_ratio,
    iq_factors,
    leakage_profile,
    quantisation_power_mw,
    spur_profile,
)
from sim_player.world import World

#: Noise draws reach this many rms once in 10^13 cells.
FAR_SIGMAS = 5.5


def absent_signal(name: str, world: World, setup: RadarSetup) -> str | None:
    """Why a scene's radar has none of an effect; None where it has."""
    scene, front_end = world.scene, world.scene.radar.front_end
    nothing = {
        "motion": (not scene.moves, "nothing moves"),
        "quantised_phases": (setup.array.phase_bits == 0 or setup.steering_weights is not None, "phases are exact"),
        "mutual_coupling": (front_end.coupling_db is None, "the columns do not couple"),
        "flicker": (front_end.flicker_corner_hz == 0.0, "the receiver has no 1/f noise"),
        "leakage": (front_end.leakage_dbm is None, "no leakage is stated"),
        "iq_imbalance": (iq_factors(front_end)[1] == 0.0, "I and Q agree"),
        "spurs": (not front_end.spurs, "no spurs are stated"),
    }
    is_absent, reason = nothing.get(name, (False, ""))
    return reason if is_absent else None


def receiver_change(
    name: str, setup: RadarSetup, front_end: FrontEnd, noise_rms: np.ndarray, echoes: np.ndarray
) -> np.ndarray:
    """Bound [beams, bins] of what a receiver effect changes; `echoes` bounds the profiles that reach it."""
    radar, bins = setup.radar, range(echoes.shape[1])
    if name == "thermal_noise":
        return np.broadcast_to(noise_rms * FAR_SIGMAS, echoes.shape)
    if name == "leakage":
        assert front_end.leakage_dbm is not None
        return np.broadcast_to(np.abs(leakage_profile(radar, front_end.leakage_dbm, bins)), echoes.shape)
    if name == "spurs":
        # their phases are drawn; magnitudes are not
        one = sum(np.abs(spur_profile(radar, spur, 0.0, bins)) for spur in front_end.spurs)
        return np.broadcast_to(np.asarray(one), echoes.shape)
    if name == "iq_imbalance":
        wanted, image = iq_factors(front_end)
        # the image of an echo at +f stands at -f: in the map only by the window's skirts
        return np.asarray(abs(wanted - 1.0) * (echoes + FAR_SIGMAS * noise_rms) + abs(image) * _image(echoes))
    added = (
        radar.noise_power_mw
        * flicker_ratio(radar, np.arange(echoes.shape[1]) / radar.chirp_period_s, front_end.flicker_corner_hz)
        if name == "flicker"
        else np.full(echoes.shape[1], quantisation_power_mw(setup, converter_step(front_end)))
    )
    return np.broadcast_to(FAR_SIGMAS * _wider(radar.noise_power_mw, added, radar), echoes.shape)


def _wider(thermal_mw: float, added_mw: np.ndarray, radar) -> np.ndarray:  # type: ignore[no-untyped-def]
    """How much wider the same noise draws get when a density is added, in a windowed profile."""
    gain = math.sqrt(np.sum(np.square(WINDOW_TAPS["hann"])) / (radar.samples_per_chirp * radar.chirps_per_beam))
    wider = np.sqrt(thermal_mw + added_mw) - math.sqrt(thermal_mw)
    # neighbouring bins come in through the window's taps: take the largest
    padded = np.pad(wider, 1, mode="edge")
    return np.asarray(gain * np.maximum.reduce([padded[:-2], padded[1:-1], padded[2:]]))


def _image(echoes: np.ndarray) -> np.ndarray:
    """Bound of the mirrored profile: an echo at bin b reaches bin i over i + b bins, Hann skirts fall as 1 / x^3."""
    away = np.arange(echoes.shape[1])[:, None] + np.arange(echoes.shape[1])[None]
    skirt = np.where(away < 2, 1.0, 1.0 / np.maximum(away, 2.0) ** 3)
    return np.asarray(echoes @ skirt)
