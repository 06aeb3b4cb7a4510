"""Beats from paths: tones summed on a grid, slow time of moving paths in a few terms, noise, int16 codes.

m(t) = sum conj(W) exp{+j(2 pi S tau t + 2 pi f_c tau - pi S tau^2)}. Left out: range migration, overlap, squint,
coupling, flicker, I/Q imbalance: those are in `sim_player.signal.levels`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from scipy import fft

from models.compiled import compiled
from models.physics.antenna import setup_weights, two_way_pattern
from msgs.values.radar import RadarParams, RadarSetup, amplitude_per_code
from sim_player.trace.path_table import Paths

#: Gridding kernel: width in grid steps and oversampling. 12 at 2 is exact to about 1e-10 of the strongest tone.
KERNEL_WIDTH, OVERSAMPLING = 12, 2
#: Samples that the noise and rounding kernel works on at a time.
BLOCK = 2048
#: Largest error of the slow-time basis for any path, relative to that path.
SLOW_TIME_TOLERANCE = 1e-5
#: Terms of the series of their shares that are left out, relative to a path.
SERIES_TOLERANCE = 1e-9


def beam_weights(setup: RadarSetup, paths: Paths, beams: slice = slice(None)) -> np.ndarray:
    """Return the recorded weights conj(W) of all paths, antenna included, in sqrt(mW); complex128 [beams, paths]."""
    there = departure(paths)
    pattern = two_way_pattern(setup, setup_weights(setup)[beams], paths.azimuth_rad, paths.elevation_rad, *there)
    return np.conj(paths.amplitude * pattern)


def departure(paths: Paths) -> tuple[np.ndarray | None, np.ndarray | None]:
    """Return the azimuth and elevation of departure; None where all paths return along their outbound route."""
    azimuth_rad, elevation_rad = paths.departure_azimuth_rad, paths.departure_elevation_rad
    if np.array_equal(azimuth_rad, paths.azimuth_rad) and np.array_equal(elevation_rad, paths.elevation_rad):
        return None, None
    return azimuth_rad, elevation_rad


def grid_spread(position: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the grid steps next to each position, and the kernel's value there; [tones, KERNEL_WIDTH] each."""
    first = np.floor(position).astype(np.int64) - KERNEL_WIDTH // 2 + 1
    steps = first[:, None] + np.arange(KERNEL_WIDTH)
    return steps, _kaiser_bessel(position[:, None] - steps)


def _kernel_shape() -> float:
    """Return the beta of the Kaiser-Bessel kernel at this width and oversampling."""
    return math.pi * KERNEL_WIDTH * (1.0 - 0.5 / OVERSAMPLING) * 0.98


def _kaiser_bessel(offset: np.ndarray) -> np.ndarray:
    """Return the kernel at offsets in grid steps, zero beyond half its width."""
    inside = np.maximum(1.0 - np.square(2.0 * offset / KERNEL_WIDTH), 0.0)
    return np.i0(_kernel_shape() * np.sqrt(inside))


@lru_cache(maxsize=8)
def kernel_transform(count: int) -> np.ndarray:
    """Return the transform of the kernel at the centred samples, [count]."""
    turns = np.pi * KERNEL_WIDTH * (np.arange(count) - count // 2) / (OVERSAMPLING * count)
    argument = np.sqrt(_kernel_shape() ** 2 - turns**2)
    return KERNEL_WIDTH * np.sinh(argument) / argument


@dataclass(frozen=True)
class SlowTimeTable:
    """Phases of moving paths over a beam's chirps in few terms: exp(j w c) = carrier[c] sum_r share_r(w) basis[r, c].

    Chirps count from the beam's middle; a common turn is out, the rest in Slepian sequences.
    """

    #: Complex128 [chirps], and float64 [terms, chirps], symmetric and antisymmetric ones in turn.
    carrier: np.ndarray
    basis: np.ndarray
    #: With x = (w - middle) / widest in -1..1, the shares of symmetric terms are even in x, those of the others j x
    #: times an even function: Chebyshev series of all these over 2 x^2 - 1, float64 [terms, powers].
    series: np.ndarray
    middle_rad: float
    widest_rad: float

    def shares(self, turn_rad: np.ndarray) -> np.ndarray:
        """Return the share of each term in turns from chirp to chirp, complex128 [terms, turns]."""
        place = (turn_rad - self.middle_rad) / (self.widest_rad or 1.0)
        shares = np.polynomial.chebyshev.chebval(2.0 * place**2 - 1.0, self.series.T).astype(np.complex128)
        shares[1::2] *= 1j * place
        return shares


def slow_time_table(radar: RadarParams, turn_rad: np.ndarray, margin: float = 1.0) -> SlowTimeTable:
    """Return the terms for turns from chirp to chirp [rad] of paths; turns may be `margin` times as large."""
    least, greatest = (float(turn_rad.min()), float(turn_rad.max())) if len(turn_rad) else (0.0, 0.0)
    middle = 0.5 * (greatest + least)
    reach = max(abs(least), abs(greatest)) * (margin - 1.0)
    widest = _rounded_up(0.5 * (greatest - least) + reach)
    carrier = np.exp(1j * middle * _chirps(radar.chirps_per_beam))
    return SlowTimeTable(carrier, *_slow_time_basis(radar.chirps_per_beam, widest), middle, widest)


def _chirps(count: int) -> np.ndarray:
    """Return the numbers of chirps from the middle of a beam."""
    return np.arange(count) - 0.5 * (count - 1)


@lru_cache(maxsize=64)
def _slow_time_basis(chirps: int, widest_rad: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the orthonormal sequences [terms, chirps] of every |w| <= widest, and series of shares [terms, powers]."""
    basis = _sequences(chirps, widest_rad)
    # what rounding leaves of the other symmetry goes: codes are made of halves
    mirrored = basis[:, ::-1] * (-1.0) ** np.arange(len(basis))[:, None]
    basis = 0.5 * (basis + mirrored)
    count = int(0.25 * widest_rad * chirps) + 12 if widest_rad else 1
    node = np.cos(np.pi * (np.arange(count) + 0.5) / count)
    place = np.sqrt(0.5 * (1.0 + node))
    turns = np.multiply.outer(_chirps(chirps), widest_rad * place)
    values = np.empty((len(basis), count))
    values[::2], values[1::2] = basis[::2] @ np.cos(turns), basis[1::2] @ np.sin(turns) / place
    fit = np.polynomial.chebyshev.chebvander(node, count - 1) * (2.0 / count)
    fit[:, 0] *= 0.5
    series = values @ fit
    needed = np.abs(series).max(axis=0) > SERIES_TOLERANCE * math.sqrt(chirps)
    return basis, series[:, : int(np.flatnonzero(needed).max()) + 1]


def _sequences(chirps: int, widest_rad: float) -> np.ndarray:
    """Return the fewest Slepian sequences that hold the edges of a band, [terms, chirps]."""
    if widest_rad == 0.0:
        return np.full((1, chirps), 1.0 / math.sqrt(chirps))
    # imported here: the import takes half a second, which a restarted player does not need
    from scipy.signal.windows import dpss

    edge = np.exp(1j * widest_rad * _chirps(chirps))
    product = min(max(widest_rad * chirps / (2.0 * np.pi), 1e-3), 0.499 * chirps)
    for terms in range(1, chirps):
        basis = np.atleast_2d(dpss(chirps, product, terms)) if chirps > 1 else np.ones((1, 1))
        basis = basis / np.linalg.norm(basis, axis=1, keepdims=True)
        if np.linalg.norm(edge - basis.T @ (basis @ edge)) <= SLOW_TIME_TOLERANCE * math.sqrt(chirps):
            return basis
    return np.asarray(fft.dct(np.eye(chirps), axis=0, norm="ortho"))


def _rounded_up(value: float) -> float:
    """Return the next of few values (six in an octave), so that beams share their cached basis; zero stays zero."""
    return 2.0 ** (math.ceil(6.0 * math.log2(value)) / 6.0) if value > 1e-9 else 0.0


def noise_bank(radar: RadarParams, seed: int) -> np.ndarray:
    """Return white complex noise of power k T0 f_s F, float32 [2, slots * samples] in sqrt(mW), for `chirp_codes`.

    One slot more than a beam's chirps (64 at least): a beam reads its slots without overlap at a random shift.
    """
    size = (max(radar.chirps_per_beam, 64) + 1) * radar.samples_per_chirp
    rng = np.random.default_rng([seed, 3])
    return rng.standard_normal((2, size), np.float32) * np.float32(math.sqrt(0.5 * radar.noise_power_mw))


#: Float32 [2, samples] in sqrt(mW), where each chirp of a beam reads it, int64 [chirps], and the phasor that turns it
#: [chirps].
Noise = tuple[np.ndarray, np.ndarray, np.ndarray]


def noise_reads(radar: RadarParams, bank: np.ndarray, seed: list[int]) -> Noise:
    """Return how the chirps of a beam, which `seed` names, read their white noise from the bank."""
    rng = np.random.default_rng(seed)
    slots = bank.shape[1] // radar.samples_per_chirp - 1
    start = rng.permutation(slots)[: radar.chirps_per_beam] * radar.samples_per_chirp
    start += rng.integers(radar.samples_per_chirp)
    return bank, start, np.exp(2j * np.pi * rng.random(radar.chirps_per_beam))


def beam_codes(
    setup: RadarSetup,
    beats: np.ndarray,
    carrier: np.ndarray,
    basis: np.ndarray,
    noise: Noise,
    mixing: np.ndarray | None = None,
    step: int = 1,
) -> np.ndarray:
    """Return int16 I/Q codes of one beam, [chirps, samples, 2]: sum_r carrier basis[r] beats[r] plus noise.

    `beats` [terms, samples] in sqrt(mW). Every chirp reads its own stretch of the noise. `mixing` [2, 2] makes the
    receiver's I and Q of those that come in. Rounded to the nearest `step` codes (ties to even), saturated at the ends
    of int16.
    """
    radar = setup.radar
    per_milliwatt = 1.0 / amplitude_per_code(setup.full_scale_dbm)
    bank, start, turn = noise
    mixed = (np.eye(2) if mixing is None else mixing) / step
    codes = np.empty((radar.chirps_per_beam, radar.samples_per_chirp, 2), np.int16)
    _fill_codes(
        _halves(beats * per_milliwatt, basis),
        _halves(beats * per_milliwatt, basis, -1.0),
        carrier.astype(np.complex64),
        bank,
        start,
        (turn * per_milliwatt).astype(np.complex64),
        np.float32(setup.beat_sign),
        (*mixed.astype(np.float32).ravel(), np.int32(step)),
        # I and Q of a sample as one number: machines that this runs on have its low half first
        codes.view(np.int32)[..., 0],
    )
    return codes


def _halves(beats: np.ndarray, basis: np.ndarray, sign: float = 1.0) -> tuple[np.ndarray, np.ndarray]:
    """Return the terms that have a part symmetric over the chirps (antisymmetric with sign -1).

    Beats float32 [2, terms, samples], real parts first, and the basis over half of the chirps [chirps, terms].
    """
    part = 0.5 * (basis + sign * basis[:, ::-1])
    there = part.any(axis=1)
    rows = np.stack([beats.real[there], beats.imag[there]]).astype(np.float32)
    return rows, np.ascontiguousarray(part[there, : (basis.shape[1] + 1) // 2].T, np.float32)


@compiled(fastmath=True)
def _fill_codes(even, odd, carrier, bank, start, turn, sign, receiver, codes):  # type: ignore[no-untyped-def]
    chirps, count = codes.shape
    both, apart = np.empty((2, BLOCK), np.float32), np.empty((2, BLOCK), np.float32)
    # block by block: the terms of a block stay in the nearest cache for all chirps
    for first in range(0, count, BLOCK):
        size = min(BLOCK, count - first)
        # a chirp and its mirror image about the middle of the beam share their sums
        for half in range((chirps + 1) // 2):
            for c in range(2):
                _sum_terms(both[c], even[0][c], even[1][half], first, size)
                _sum_terms(apart[c], odd[0][c], odd[1][half], first, size)
            for chirp in range(half, chirps - half, max(chirps - 1 - 2 * half, 1)):
                other = np.float32(1.0) if chirp == half else np.float32(-1.0)
                noise_re = bank[0, start[chirp] + first : start[chirp] + first + size]
                noise_im = bank[1, start[chirp] + first : start[chirp] + first + size]
                out = codes[chirp, first : first + size]
                turns = (carrier[chirp], turn[chirp], sign)
                _write_codes(out, (both, apart, other), turns, (noise_re, noise_im), receiver)


@compiled(fastmath=True)
def _sum_terms(out, rows, factors, first, size):  # type: ignore[no-untyped-def]
    """Write sum_t factors[t] rows[t] of a block of samples, two terms at a time."""
    terms = len(factors)
    if not terms:
        out[:] = np.float32(0.0)
    for t in range(0, terms, 2):
        f, g = factors[t], factors[t + 1] if t + 1 < terms else np.float32(0.0)
        a, b = rows[t, first : first + size], rows[min(t + 1, terms - 1), first : first + size]
        if t:
            for n in range(size):
                out[n] += f * a[n] + g * b[n]
        else:
            for n in range(size):
                out[n] = f * a[n] + g * b[n]


@compiled(fastmath=True)
def _write_codes(out, sums, turns, noise, receiver):  # type: ignore[no-untyped-def]
    """Write the codes of a block of a chirp, rounded to nearest and saturated: I in the low half, Q in the high one."""
    both, apart, other = sums
    carrier, turn, sign = turns
    c, s, p, q = carrier.real, carrier.imag, turn.real, turn.imag
    ii, ij, ji, jj, step = receiver
    least, greatest = np.float32(-(32768 // step)), np.float32(32768 // step - 1)
    both_re, both_im, apart_re, apart_im = both[0], both[1], apart[0], apart[1]
    noise_re, noise_im = noise
    for n in range(len(out)):
        re, im = both_re[n] + other * apart_re[n], both_im[n] + other * apart_im[n]
        i = c * re - s * im + p * noise_re[n] - q * noise_im[n]
        j = sign * (s * re + c * im) + q * noise_re[n] + p * noise_im[n]
        low = np.int32(np.int32(min(max(np.rint(ii * i + ij * j), least), greatest)) * step)
        high = np.int32(np.int32(min(max(np.rint(ji * i + jj * j), least), greatest)) * step)
        out[n] = np.int32(high << np.int32(16)) | np.int32(low & np.int32(65535))
