"""References of the signal chain: chirps in time, the receiver's whole input, all effects at once."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from lab.tradeoff.literal_signal import chirp_turns
from msgs.values.radar import RadarParams, RadarSetup
from msgs.values.units import SPEED_OF_LIGHT_MPS
from sim_player.scene.front_end import NO_FAULTS, FrontEnd
from sim_player.signal.fmcw import Noise, beam_codes, noise_reads
from sim_player.signal.levels import Terms, echo_terms, with_electronics
from sim_player.signal.receiver import flicker_noise, iq_imbalance
from sim_player.signal.switches import PLAIN, SignalEffects
from sim_player.trace.path_table import Paths

ALL = SignalEffects(**dict.fromkeys(SignalEffects.__struct_fields__, True))


def literal_beats(radar: RadarParams, length_m: np.ndarray, weights: np.ndarray, chirps: int = 1) -> np.ndarray:
    """Return the reference: transmit Eq. (6), delay, mix with the conjugate; complex128 [chirps, samples], for few
    samples.

    Written out in time with no closed form: g(t) g*(t - tau) summed over paths with recorded weights conj(W)
    [paths]. Complex mixing leaves no sum frequency, so the low pass has nothing to remove. Chirps repeat.
    """
    time_s = np.arange(radar.samples_per_chirp) / radar.sample_rate_hz
    transmitted = _chirp(radar, time_s)
    mixed = np.zeros(radar.samples_per_chirp, np.complex128)
    for length, weight in zip(length_m, weights, strict=True):
        mixed += weight * transmitted * np.conj(_chirp(radar, time_s - length / SPEED_OF_LIGHT_MPS))
    return np.tile(mixed, (chirps, 1))


def beat_terms(
    setup: RadarSetup,
    paths: Paths,
    effects: SignalEffects = PLAIN,
    front_end: FrontEnd = NO_FAULTS,
    beam: int = 0,
    seed: Sequence[int] = (0,),
) -> Terms:
    """Return the noise-free input of the receiver in one beam: sum_r carrier[c] basis[r, c] beats[r].

    Echoes in slow-time terms, leakage and spurs as two more terms each. Returns beats complex128 [terms, samples],
    carrier complex128 [chirps], basis float64 [terms, chirps]. `seed` names the beam.
    """
    return with_electronics(setup, echo_terms(setup, paths, effects, front_end, beam), effects, front_end, seed)


def received_samples(
    setup: RadarSetup,
    terms: Terms,
    bank: np.ndarray,
    seed: list[int],
    effects: SignalEffects = PLAIN,
    front_end: FrontEnd = NO_FAULTS,
) -> np.ndarray:
    """Return the input of the converter: echoes, noise and I/Q imbalance, in sqrt(mW); complex128 [chirps, samples]."""
    beats, carrier, basis = terms
    samples = (carrier[:, None] * basis.T) @ beats
    if setup.beat_sign < 0:
        samples = np.conj(samples)
    if effects.thermal_noise:
        _, start, turn = noise_reads(setup.radar, bank, seed)
        index = start[:, None] + np.arange(setup.radar.samples_per_chirp)
        samples = samples + turn[:, None] * (bank[0][index] + 1j * bank[1][index])
    if effects.flicker:
        samples = samples + flicker_noise(setup.radar, front_end.flicker_corner_hz, seed)
    return iq_imbalance(samples, samples, front_end) if effects.iq_imbalance else samples


def quiet(radar: RadarParams) -> Noise:
    """Return no noise at all for every chirp."""
    return np.zeros((2, radar.samples_per_chirp), np.float32), np.zeros(radar.chirps_per_beam, int), np.ones(1024)


def converted(codes: np.ndarray, step: int = 1) -> np.ndarray:
    """Return what a converter makes of one chirp of complex samples, given in codes: int16 [samples, 2]."""
    setup = RadarSetup(radar=RadarParams(samples_per_chirp=len(codes), chirps_per_beam=1))
    beat, one = codes * np.sqrt(setup.milliwatt_per_code_squared), np.ones(1)
    return beam_codes(setup, beat[None], one, one[None], quiet(setup.radar), step=step)[0]


def _chirp(radar: RadarParams, time_s: np.ndarray) -> np.ndarray:
    """Return the Eq. (6): g(t) = exp(j(2 pi f_c t + pi S t^2)), phase reduced before the exponential."""
    return np.exp(2j * np.pi * (chirp_turns(radar, time_s) % 1.0))
