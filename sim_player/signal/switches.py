"""Effects of array, waveform and receiver as switches, and the change of a set-up by each; off means ideal.

Antenna and waveform (an echo's own, `sim_player/signal/swept_echoes.py`):
- element_pattern: gain falls off the element's axis; off: peak gain everywhere in front (`isotropic`).
- quantised_phases: phase shifters round to 2 pi / 2^bits; off: exact (`exact_phases`).
- mutual_coupling: weights times the Toeplitz matrix of `models.physics.antenna.coupling_matrix`.
- squint: physical phases follow the sweep, ratio(t) = 1 + (S (t - tau) - B / 2) / f_c (`sweep_ratio`).
- chirp_overlap: for t < tau the echo is still the previous chirp's, a tone at S (tau - T_c).
- motion: phase 4 pi v c T_c / lambda from chirp to chirp c; range_migration: also along the sweep, and the way moved.

Air: rain_clutter, drawn beam by beam (`sim_player/signal/clutter.py`).

Receiver (samples of all echoes together, `sim_player/signal/receiver.py`): thermal_noise, flicker, leakage, spurs,
iq_imbalance, adc.
"""

from __future__ import annotations

import math

import msgspec
import numpy as np

from models.physics.antenna import coupling_matrix, setup_weights
from msgs.values.radar import RadarParams, RadarSetup
from msgs.values.units import SPEED_OF_LIGHT_MPS
from sim_player.scene.front_end import FrontEnd


class SignalEffects(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Switches of the effects of a signal; the defaults are the plain signal chain of `sim_player.signal.fmcw`."""

    element_pattern: bool = True
    quantised_phases: bool = True
    mutual_coupling: bool = False
    squint: bool = False
    chirp_overlap: bool = False
    motion: bool = True
    range_migration: bool = False
    rain_clutter: bool = False
    thermal_noise: bool = True
    flicker: bool = False
    leakage: bool = False
    adc: bool = True
    iq_imbalance: bool = False
    spurs: bool = False


#: The plain chain, and only the phases of echoes at rest.
PLAIN = SignalEffects()
IDEAL = SignalEffects(**dict.fromkeys(SignalEffects.__struct_fields__, False))


def isotropic(setup: RadarSetup) -> RadarSetup:
    """Return the set-up with elements of the same peak gain in every direction of the front hemisphere."""
    element = msgspec.structs.replace(setup.element, azimuth_hpbw_deg=math.inf, elevation_hpbw_deg=math.inf)
    return msgspec.structs.replace(setup, element=element)


def exact_phases(setup: RadarSetup) -> RadarSetup:
    """Return the set-up with phase shifters without steps; measured weights that the set-up brings stay as they are."""
    return msgspec.structs.replace(setup, array=msgspec.structs.replace(setup.array, phase_bits=0))


def column_weights(setup: RadarSetup, effects: SignalEffects, front_end: FrontEnd) -> np.ndarray:
    """Return the excitation of the columns: steering weights, exact or in steps, coupled or not; [beams, columns]."""
    weights = setup_weights(setup if effects.quantised_phases else exact_phases(setup))
    if not effects.mutual_coupling or front_end.coupling_db is None:
        return weights
    phase_rad = math.radians(front_end.coupling_phase_deg)
    return weights @ coupling_matrix(setup.array.columns, front_end.coupling_db, phase_rad)


def sweep_ratio(radar: RadarParams, since_sent_s: np.ndarray) -> np.ndarray:
    """Return f / f_c seen by the array when an echo comes in, `since_sent_s` = t - tau after its chirp began.

    The array is made for the middle of the sweep. Left out is S d^2 / 2, 1e-5 turns at d = 0.4 ns.
    """
    return 1.0 + (radar.chirp_slope_hz_per_s * since_sent_s - 0.5 * radar.bandwidth_hz) / radar.carrier_hz


def overlap_samples(radar: RadarParams, length_m: np.ndarray) -> np.ndarray:
    """Return the samples at the start of a chirp in which an echo is still the previous chirp's (t < tau); int64.

    ValueError for an echo later than a chirp. tau is the beam's middle's: at 30 m/s one sample may fall wrong.
    """
    samples = np.ceil(np.asarray(length_m, np.float64) / SPEED_OF_LIGHT_MPS * radar.sample_rate_hz).astype(np.int64)
    if samples.max(initial=0) >= radar.samples_per_chirp:
        limit_m, longest_m = radar.chirp_period_s * SPEED_OF_LIGHT_MPS, float(np.max(length_m))
        raise ValueError(f"length_m must be under one chirp ({limit_m:.1f} m) for overlap, got {longest_m!r}")
    return samples


def previous_length_m(radar: RadarParams, length_m: np.ndarray) -> np.ndarray:
    """Return the length whose beat is that of the previous chirp's echo: tau - T_c in place of tau."""
    return np.asarray(length_m, np.float64) - SPEED_OF_LIGHT_MPS * radar.chirp_period_s


def sampled(radar: RadarParams, beat_hz: np.ndarray) -> np.ndarray:
    """Return which beats pass the ideal low pass of Eq. (7), the anti-alias filter, +-f_s / 2."""
    return np.abs(beat_hz) <= 0.5 * radar.sample_rate_hz
