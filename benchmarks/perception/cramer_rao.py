"""Cramer-Rao bounds of range and azimuth for any unbiased estimate from one scan of beams.

An echo of complex amplitude a at fractional range bin q and azimuth A puts a s_n(q) g_k(A) into sample n of beam k,
noise white and equal in all of them. Data is a product of range and azimuth, so the Fisher information of any number
of echoes is made of products of small Gram matrices. Unknown are amplitude (two parts), range and azimuth of each
echo; the phase of the amplitude is free, so the carrier carries no information about range.

The amplitude is that of an ideal beam steered at the echo, on its bin, at the start of the chirp; element gain is
part of it. Noise is a beam's per bin of the windowed profile. A cell of the default map has 0.58 of that noise.
"""

from __future__ import annotations

import numpy as np

from models.physics.antenna import column_response, setup_weights
from models.physics.waveform import WINDOW_TAPS, tone_profile, window_covariance, window_noise_gain
from msgs.values.arrays import require_positive
from msgs.values.radar import RadarSetup

#: Step of the central differences, in bins and in radians: errors of 1e-8 of a slope.
_STEP = 1e-4
#: Least singular value of the information's root, tangents of length one: smaller ones are rounding.
_LEAST_SIZE = 1e-16
#: Value (0) or slope (1), in order, for (Re a, Im a, range, azimuth), and its factor.
_TANGENTS = ((0, 0, 1.0), (0, 0, 1.0j), (1, 0, 1.0), (0, 1, 1.0))


def raw_bound(
    setup: RadarSetup, range_bin: np.ndarray, azimuth_rad: np.ndarray, amplitude: np.ndarray, noise_power_mw: float
) -> np.ndarray:
    """Return the covariance bound [P, 2, 2] of (range [m], azimuth [rad]) of P echoes seen together, from raw samples.

    No window, every sample: nothing that the receiver delivers is lost. `amplitude` complex [P] in sqrt(mW);
    `noise_power_mw` that of a Hann bin, 1.5 times what the samples put in a bin. Raises ValueError where that is not
    positive. Variances of parameters that the samples do not determine are huge or infinite.
    """
    count = setup.radar.samples_per_chirp
    turns = np.arange(count) / count
    tone = np.exp(2j * np.pi * np.multiply.outer(np.asarray(range_bin, np.float64), turns)) / np.sqrt(count)
    # a slope about the middle of the chirp: there range and phase are uncorrelated
    slope = 2j * np.pi * (turns - turns.mean()) * tone
    white = noise_power_mw / window_noise_gain("hann")
    return _bound(setup, np.stack([tone, slope]), azimuth_rad, amplitude, white)


def windowed_bound(
    setup: RadarSetup,
    range_bin: np.ndarray,
    azimuth_rad: np.ndarray,
    amplitude: np.ndarray,
    noise_power_mw: float,
    bins: np.ndarray,
    window: str = "hann",
) -> np.ndarray:
    """Return the same from some consecutive `bins` of the windowed range profiles, noise as the window correlates it.

    Many bins undo the window and approach the raw bound; few cannot.
    """
    at = np.asarray(range_bin, np.float64)
    count, first = setup.radar.samples_per_chirp, int(bins[0])
    before, here, after = (tone_profile(count, at + k * _STEP, len(bins), window, first) for k in (-1, 0, 1))
    white = np.linalg.inv(np.linalg.cholesky(window_covariance(window, len(bins))))
    response = np.stack([here, (after - before) / (2.0 * _STEP)]) @ white.T
    return _bound(setup, response, azimuth_rad, amplitude, noise_power_mw)


def periodogram_range_loss(window: str = "hann", samples: int = 4096) -> float:
    """Return the standard deviation of the peak of a windowed periodogram relative to the raw bound (Hann: 1.531).

    The usual estimator, window included: sqrt(sum w^2 t^2 sum t^2) / sum w t^2 over the chirp.
    """
    t = (np.arange(samples) + 0.5) / samples - 0.5
    reach = len(WINDOW_TAPS[window]) // 2
    # taps alternate in sign for a window that is centred in the chirp
    order = np.arange(-reach, reach + 1)
    signed = np.array(WINDOW_TAPS[window]) * (-1.0) ** order
    w = np.cos(2.0 * np.pi * np.multiply.outer(t, order)) @ signed
    return float(np.sqrt(np.sum((w * t) ** 2) * np.sum(t**2)) / np.sum(w * t**2))


def azimuth_response(setup: RadarSetup, azimuth_rad: np.ndarray) -> np.ndarray:
    """Return the recorded field of unit echoes in all beams, as set, without element gain; complex128 [echoes, beams].

    An ideal beam steered at the echo would hold 1.
    """
    azimuth_rad = np.asarray(azimuth_rad, np.float64)
    columns = column_response(setup.array, setup.radar.wavelength_m, azimuth_rad, np.zeros_like(azimuth_rad))
    return ((columns @ setup_weights(setup).T / setup.array.columns) ** setup.array.steered_ways).conj()


def _bound(
    setup: RadarSetup, range_parts: np.ndarray, azimuth_rad: np.ndarray, amplitude: np.ndarray, noise_power_mw: float
) -> np.ndarray:
    require_positive("noise_power_mw", noise_power_mw)
    azimuth_rad = np.asarray(azimuth_rad, np.float64)
    before, here, after = (azimuth_response(setup, azimuth_rad + k * _STEP) for k in (-1, 0, 1))
    azimuth_parts = np.stack([here, (after - before) / (2.0 * _STEP)])
    scaled = np.asarray(amplitude, np.complex128) / np.sqrt(noise_power_mw)
    covariance = _inverse_information(range_parts, azimuth_parts, scaled)
    count = len(scaled)
    own = np.arange(count)
    blocks = covariance.reshape(4, count, 4, count)
    covariances = np.stack([[blocks[row, own, column, own] for column in (2, 3)] for row in (2, 3)])
    metres = np.array([setup.radar.range_bin_m, 1.0])
    return np.moveaxis(covariances, -1, 0) * np.multiply.outer(metres, metres)


def _inverse_information(range_parts: np.ndarray, azimuth_parts: np.ndarray, amplitude: np.ndarray) -> np.ndarray:
    """Return the inverse of the information from the singular values of its root, [4P, 4P]: Re a, Im a, range, azimuth.

    In a matrix of squares the difference of echoes 1e-3 deg apart is lost: its own inverse has negative
    variances. A parameter that changes no sample (azimuth at endfire) has infinite variance.
    """
    left, right = _coordinates(range_parts), _coordinates(azimuth_parts)
    rows = [
        f * (np.ones_like(amplitude) if k < 2 else amplitude)[:, None]
        * np.einsum("im,ib->imb", left[q], right[a]).reshape(len(amplitude), -1)
        for k, (q, a, f) in enumerate(_TANGENTS)
    ]  # fmt: skip
    root = np.concatenate(rows) * np.sqrt(2.0)
    # zeros: at least as many columns as unknowns, or undetermined ones would be missing
    root = np.concatenate([root.real, root.imag, np.zeros((len(root), len(root)))], axis=1)
    # tangents of one length: amplitudes, bins and radians have different units
    length = np.linalg.norm(root, axis=1)
    determined = length > 0.0
    directions, size, _ = np.linalg.svd(root[determined] / length[determined, None], full_matrices=False)
    spread = directions / np.maximum(size, _LEAST_SIZE) / length[determined, None]
    covariance = np.diag(np.where(determined, 0.0, np.inf))
    covariance[np.ix_(determined, determined)] = spread @ spread.T
    return covariance


def _coordinates(parts: np.ndarray) -> np.ndarray:
    """Return parts [2, P, rows] in an orthonormal basis of their own, [2, P, at most 2P]: inner products stay."""
    flat = parts.reshape(-1, parts.shape[-1])
    return np.linalg.qr(flat.T).R.T.reshape(*parts.shape[:2], -1)
