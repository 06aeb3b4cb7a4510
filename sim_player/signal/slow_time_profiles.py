"""The kernel level of scenes that move: a beam as the profiles of its slow-time sums, without its chirps.

All that the former does of a beam but the choice of the Doppler bin is linear, and its echoes are a few slow-time terms
(`Terms`): the terms' profiles times each group's sums are the former's, to 1e-5 of the strongest echo. Noise and
rounding are drawn per bin. Left out: within a beam (0.7 ms) a path keeps direction and radial speed; of N columns this
turns an echo by up to pi (N - 1) v T_f / (2 R) at the beam's ends (0.03 at 8 m/s and 2 m), cancelled to first order,
and its phase errs by pi v^2 T_f^2 / (2 R lambda) (5e-3 at 30 m/s and 5 m).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy import fft

from msgs.values.radar import RadarSetup
from sim_player.scene.front_end import NO_FAULTS, FrontEnd
from sim_player.signal.levels import RANGE_BINS, Terms, hann_profiles, noise_density_mw, windowed_noise
from sim_player.signal.receiver import dither_objection, iq_factors, iq_imbalance, overload_objection
from sim_player.signal.switches import PLAIN, SignalEffects


def group_profiles(
    setup: RadarSetup,
    terms: Terms,
    group_edges: np.ndarray,
    effects: SignalEffects = PLAIN,
    front_end: FrontEnd = NO_FAULTS,
    sample_phase: np.ndarray | None = None,
) -> np.ndarray:
    """Return the Hann-windowed profiles of a beam's sums over groups of chirps, as shares of the mean over all.

    Sqrt(mW), complex [groups, 512], without noise. `terms` of `levels.echo_terms` with `levels.with_electronics`;
    `group_edges` first chirps and their number; `sample_phase` [samples] moves the sums along range, without the
    faults.
    """
    beats, carrier, basis = terms
    count = setup.radar.samples_per_chirp
    chirps = int(group_edges[-1])
    shares = np.add.reduceat((carrier * basis)[:, :chirps], group_edges[:-1], axis=1).T / chirps
    shares = shares.astype(beats.dtype)
    phase = np.ones(1, np.complex64) if sample_phase is None else sample_phase
    profiles = shares @ hann_profiles(beats * phase, count)
    if not effects.iq_imbalance or iq_factors(front_end)[1] == 0.0:
        return np.asarray(profiles)
    # the image's tones lie at -f, and are moved along range like the others
    negative = shares @ hann_profiles(beats * np.conj(phase), count, range(1 - RANGE_BINS, 1))
    return iq_imbalance(profiles, negative[:, ::-1], front_end, setup.beat_sign)


def group_noise(
    setup: RadarSetup,
    group_edges: np.ndarray,
    seed: Sequence[int],
    effects: SignalEffects = PLAIN,
    front_end: FrontEnd = NO_FAULTS,
    shift_bins: float = 0.0,
) -> np.ndarray:
    """Return the noise of the same profiles, complex128 [groups, 512], moved along range by `shift_bins`.

    Drawn per range and Doppler bin; ValueError where rounding is no white noise.
    """
    chirps, groups = int(group_edges[-1]), len(group_edges) - 1
    doppler = fft.fftfreq(groups, 1.0 / groups) / chirps
    bins = doppler[:, None] + np.arange(-1, RANGE_BINS + 1) - shift_bins
    density_mw = noise_density_mw(setup, bins.ravel(), effects, front_end).reshape(bins.shape)
    # of fewer chirps than a beam has, the mean is noisier
    density_mw *= setup.radar.chirps_per_beam / chirps
    noise = fft.ifft(windowed_noise(np.random.default_rng([*seed, 6]), density_mw), axis=0, norm="ortho")
    return np.asarray(noise * np.sqrt(np.diff(group_edges) / chirps)[:, None])


def converter_objection(
    setup: RadarSetup, terms: Terms, effects: SignalEffects = PLAIN, front_end: FrontEnd = NO_FAULTS
) -> str | None:
    """Return why drawn noise cannot stand for the converter in a beam, or None: little dither, clipping."""
    reason = dither_objection(setup, front_end, effects.thermal_noise)
    if reason is not None:
        return reason
    beats, carrier, basis = terms
    fixed = 5.0 * np.sqrt(0.5 * setup.radar.noise_power_mw) if effects.thermal_noise else 0.0
    gain = sum(map(abs, iq_factors(front_end))) if effects.iq_imbalance else 1.0
    bound = float((np.abs(basis).max(axis=1) @ np.abs(beats)).max(initial=0.0))
    if overload_objection(setup, gain * (bound + fixed)) is None:
        return None
    peak = max(float(np.abs(row @ beats).max()) for row in (carrier * basis).T.astype(beats.dtype))
    return overload_objection(setup, gain * (peak + fixed))
