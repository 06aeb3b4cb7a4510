"""Open-field background: the radar's own leakage and mounting echoes, one chirp a beam, averaged over scans.

A beam of an open field holds the front end's leakage and the mounting's own echoes, the same in every scan, and noise,
which is not. Their coherent mean over chirps and scans keeps the first; its noise falls by 10 log N. Something that
moves through the field is in another cell, or at another phase, in each scan: cells far from their median are left out.
"""

from __future__ import annotations

import math

import msgspec
import numpy as np
from scipy import fft

from models.perception.form.slow_time_sums import fold_chirps
from msgs.values.radar import RadarBeam, RadarSetup
from msgs.values.units import db_from_ratio

#: A cell further from its median over scans than this many rms of noise is left out.
OUTLIER_SIGMAS = 4.0
#: Least number of scans for a usable median.
MIN_SCANS = 4


class BackgroundQuality(msgspec.Struct, frozen=True, kw_only=True):
    """Quality of a background; powers are per range bin of the plain mean over a beam's chirps, unwindowed."""

    scans: int
    beams: int
    #: Strongest static bin, its range, and the static power left there when the background of one half of the scans is
    #: subtracted from the other half; `removed_db` is limited by their noise.
    leakage_dbm: float
    leakage_range_m: float
    left_dbm: float
    removed_db: float
    #: Noise of one scan, of the background, and the noise expected after averaging.
    scan_noise_dbm: float
    noise_dbm: float
    expected_noise_dbm: float
    #: Noise in dBm after 1, 2, 4, ... scans.
    noise_by_scans_dbm: tuple[tuple[int, float], ...]
    #: Share of cells left out as moving, over cells in reach.
    outlier_share: float


def mean_chirp(beam: RadarBeam) -> np.ndarray:
    """Return the mean over a beam's chirps in codes, complex64 [samples]."""
    sums, _ = fold_chirps(beam.samples, 1)
    mean: np.ndarray = sums.astype(np.float32).view(np.complex64)[0, :, 0] / np.float32(len(beam.samples))
    return mean


def background_of(chirps: np.ndarray) -> tuple[np.ndarray, float]:
    """Return the background [beams, samples] of mean chirps [scans, beams, samples], and the share of cells left out.

    Works bin by bin of the chirp's spectrum, where a mover is in few cells. Raises ValueError under `MIN_SCANS` scans.
    """
    if len(chirps) < MIN_SCANS:
        raise ValueError(f"a background needs at least {MIN_SCANS} scans, got {len(chirps)}")
    result, left_out = np.empty(chirps.shape[1:], np.complex64), 0
    # beam by beam: the spectra of all beams would take as much memory as the chirps
    for beam in range(chirps.shape[1]):
        spectra = fft.fft(chirps[:, beam], axis=1)
        mean, outliers = _robust_mean(spectra)
        result[beam] = fft.ifft(mean)
        left_out += outliers
    return result, left_out / chirps.size


def _robust_mean(values: np.ndarray) -> tuple[np.ndarray, int]:
    """Return the mean over axis 0 of complex values [N, bins] without those far from their median, and how many
    those are.
    """
    median = np.median(values.real, axis=0) + 1j * np.median(values.imag, axis=0)
    off = np.abs(values - median)
    # a bin's own spread where 1/f noise makes it wide, never under that of all: of few scans one bin's says little
    own = np.median(off, axis=0)
    limit = OUTLIER_SIGMAS / math.sqrt(math.log(2.0)) * np.maximum(own, np.median(own))
    kept = off <= limit
    few = kept.sum(axis=0) < max(len(values) // 2, 1)
    # a bin that is never twice the same has no static part worth more than its median
    mean = np.where(few, median, (values * kept).sum(axis=0) / np.maximum(kept.sum(axis=0), 1))
    return mean.astype(np.complex64), int((~kept).sum())


def background_quality(chirps: np.ndarray, setup: RadarSetup, outlier_share: float) -> BackgroundQuality:
    """Return the quality of the background of mean chirps [scans, beams, samples], measured on scans it was not made
    from.

    Raises ValueError where all scans are the same: static power and noise cannot then be separated.
    """
    scans, beams, samples = chirps.shape
    half, other = _power_scale(setup, chirps[0::2]), _power_scale(setup, chirps[1::2])
    first, second = (_robust_halves(spectra) for spectra in (half, other))
    # the product of both halves has no noise of its own: its mean is the static power
    static = np.real(first * np.conj(second))
    beam, bin_ = np.unravel_index(int(np.argmax(static[:, : samples // 2])), (beams, samples // 2))
    leakage = float(static[beam, bin_])
    left = float(np.mean(np.abs(first - second)[:, bin_] ** 2))
    by_scans = noise_by_scans(_power_scale(setup, chirps))
    if not min(left, *(power for _, power in by_scans)) > 0.0:
        raise ValueError("a background needs scans that differ by noise: these repeat one another code by code")
    noise_dbm = db_from_ratio(by_scans[0][1])
    return BackgroundQuality(
        scans=scans,
        beams=beams,
        leakage_dbm=db_from_ratio(max(leakage, 1e-300)),
        leakage_range_m=float(bin_ * setup.radar.range_bin_m),
        left_dbm=db_from_ratio(left),
        removed_db=db_from_ratio(max(leakage, 1e-300) / left),
        scan_noise_dbm=noise_dbm,
        noise_dbm=db_from_ratio(by_scans[-1][1]) - db_from_ratio(scans / by_scans[-1][0]),
        expected_noise_dbm=noise_dbm - db_from_ratio(scans),
        noise_by_scans_dbm=tuple((count, db_from_ratio(power)) for count, power in by_scans),
        outlier_share=outlier_share,
    )


def _power_scale(setup: RadarSetup, chirps: np.ndarray) -> np.ndarray:
    """Return the spectra of mean chirps in sqrt(mW) per bin, complex64 [scans, beams, bins]."""
    scale = math.sqrt(setup.milliwatt_per_code_squared) / chirps.shape[-1]
    spectra: np.ndarray = fft.fft(chirps, axis=-1)
    if setup.beat_sign < 0:
        # beats of positive range at positive frequency: bin k of the conjugate
        spectra = np.conj(np.roll(spectra[..., ::-1], 1, axis=-1))
    return spectra * np.float32(scale)


def _robust_halves(spectra: np.ndarray) -> np.ndarray:
    """Return the robust mean over scans of spectra [scans, beams, bins]."""
    return np.stack([_robust_mean(spectra[:, beam])[0] for beam in range(spectra.shape[1])])


def noise_by_scans(spectra: np.ndarray) -> list[tuple[int, float]]:
    """Return the noise power per bin of the mean over 1, 2, 4, ... scans of spectra [scans, beams, bins], from
    differences of neighbouring means: what is static falls out.

    Median over bins, so that a mover does not set it.
    """
    powers, count = [], 1
    while 2 * count <= len(spectra):
        pairs = len(spectra) // (2 * count)
        means = spectra[: pairs * 2 * count].reshape(pairs, 2, count, *spectra.shape[1:]).mean(axis=2)
        power = np.abs(means[:, 0] - means[:, 1]) ** 2
        # |difference|^2 has twice the noise power; the median of an exponential is ln 2 of its mean
        powers.append((count, float(np.median(power) / (2.0 * math.log(2.0)))))
        count *= 2
    return powers
