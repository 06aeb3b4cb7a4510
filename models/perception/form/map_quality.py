"""Hardware checks from a scan itself, without truth; severities and false alarms: docs/explain/faults.md."""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np
import scipy.fft

from msgs.values.units import ratio_from_db

#: Number of codes of a chirp that are inspected to detect a lost chirp.
_LOOKED_AT = 128
#: Number of chirps of a beam whose bits are inspected.
_BIT_CHIRPS = 4
#: Range bins this near hold the transmitter's leakage, which fills all beams by nature.
_NEAR_BINS = 4
#: A silent beam's mean power stays under the first over at least so many bins in which some beam is over the second:
#: the side lobes of echoes this loud bring every live beam over it (docs/explain/faults.md). Their echoes come from so
#: many directions: a lone one has nulls. At 40 dB a live beam towards smooth walls may hold noise alone.
_SILENT_DB, _LOUD_DB, _LOUD_BINS, _LOUD_DIRECTIONS = 5.0, 50.0, 12, 4
#: Noise of a beam over the median of all beams from which the beam is left out.
_INTERFERED_DB = 6.0
#: A spur stands this far over the noise in every beam, within this spread; echoes differ by 26 dB and more.
_SPUR_DB, _SPUR_SPREAD_DB = 15.0, 8.0
#: Ranges whose echoes count for the array check, and how many it needs.
_HEARD_DB, _LEAST_RANGES = 20.0, 8
#: Bins of a spectrum about zero that leakage fills on both sides, whatever the window.
_LEAKAGE_BINS = 32
#: Share of the power in which both sides of a spectrum depend on each other, from which there is one channel alone.
_ONE_CHANNEL = 0.9
#: Of the ranges this far over the noise so many must be, and this share of them be louder by the second on the wrong
#: side, for I and Q to be exchanged.
_SIDE_DB, _SIDE_BINS, _SIDE_SHARE, _WRONG_SIDE_DB = 13.0, 8, 0.9, 6.0
#: Deviation of the array from which the map says so; 99 of 100 random places without fault stay under it.
ARRAY_LIMIT = 0.12


def lost_chirps(samples: np.ndarray) -> int:
    """Count the chirps of int16 codes [chirps, samples, 2] that a link filled with zeros: noise never is all zeros."""
    step = max(samples.shape[1] // _LOOKED_AT, 1)
    return int(np.count_nonzero(~samples[:, ::step].any(axis=(1, 2))))


def changing_bits(samples: np.ndarray) -> np.ndarray:
    """Return the bits of I and of Q that change, uint16 [2], over some chirps of int16 codes [chirps, samples, 2]."""
    pairs = np.ascontiguousarray(samples[:: max(len(samples) // _BIT_CHIRPS, 1)]).view(np.uint32)
    changing = np.bitwise_or.reduce(pairs, axis=None) & ~np.bitwise_and.reduce(pairs, axis=None)
    return np.array([changing & 0xFFFF, changing >> 16], np.uint16)


def converter_faults(changing: np.ndarray) -> tuple[str, ...]:
    """Return the faults of the two converters by the bits that change in each beam [beams, 2], names in `MAP_FAULTS`.

    In no beam does one channel alone change. A still bit of the scan between two that change is broken; low bits may be
    lacking, high ones unused.
    """
    is_still = changing == 0
    stuck = (is_still & ~is_still[:, ::-1]).any(axis=0)
    filled = [int(bits) | (int(bits) - 1) if bits else 0 for bits in np.bitwise_or.reduce(changing)]
    return (
        *(f"{name}_stuck" for name, holds in zip("iq", stuck, strict=True) if holds),
        *(f"{name}_bit_stuck" for name, bits in zip("iq", filled, strict=True) if bits & (bits + 1)),
    )


class ChannelTerms(NamedTuple):
    """What the spectrum Y of a beam's mean chirp says of its channels, beyond `_LEAKAGE_BINS`.

    With one channel the sum of Y(f) Y(-f) is the whole power, turned by 0 (Q stuck), pi (I) or +-pi/2 (equal or
    opposite); of echoes on one side alone it is nothing.
    """

    #: Of ranges beyond the leakage, where their echoes belong and at the opposite frequencies; float32 [2, range].
    sides: np.ndarray
    #: Mean power of both sides, and sum of Y(f) Y(-f).
    power: float
    product: complex


def channel_terms(sums: np.ndarray, beat_sign: int, range_bins: int) -> ChannelTerms:
    """Return the terms of slow-time sums, int32 I/Q [groups, samples, 2], of a map with so many range bins."""
    chirp = sums.sum(axis=0, dtype=np.float32).view(np.complex64)[:, 0]
    spectrum = scipy.fft.fft((chirp - chirp.mean()) * _hann(len(chirp)), overwrite_x=True)
    first, middle = min(_LEAKAGE_BINS, len(chirp) // 16), (len(chirp) + 1) // 2
    above, below = spectrum[first:middle], spectrum[len(chirp) - first : len(chirp) - middle : -1]
    power, product = float(np.vdot(above, above).real + np.vdot(below, below).real), complex(np.dot(above, below))
    sides = np.abs(np.stack([above, below][::beat_sign])[:, : range_bins - first])
    return ChannelTerms(np.square(sides), 0.5 * power, product)


@lru_cache(maxsize=4)
def _hann(length: int) -> np.ndarray:
    return np.hanning(length).astype(np.float32)


def wiring_faults(sides: np.ndarray, power: float, product: complex) -> tuple[str, ...]:
    """Return the faults of two channels in `MAP_FAULTS`; arguments are sums of `ChannelTerms`."""
    if not power > 0.0:
        return ("i_stuck", "q_stuck")
    if abs(product) > _ONE_CHANNEL * power:
        quarter_turns = round(float(np.angle(product)) / (0.5 * np.pi))
        return (("q_stuck",), ("i_equals_q",), ("i_stuck",))[abs(quarter_turns)]
    right, wrong = sides
    loud = np.maximum(right, wrong) > ratio_from_db(_SIDE_DB) * np.median(np.minimum(right, wrong))
    is_wrong = loud & (wrong > ratio_from_db(_WRONG_SIDE_DB) * right)
    few = max(_SIDE_BINS, _SIDE_SHARE * np.count_nonzero(loud))
    return ("iq_exchanged",) if np.count_nonzero(is_wrong) >= few else ()


def silent_beams(profiles: np.ndarray, noise_power_mw: float) -> np.ndarray:
    """Return the beams of noise alone where others hold loud echoes; bool [beams] of complex [beams, range]."""
    power = _power(profiles[:, _NEAR_BINS:])
    loud = power.max(axis=0, initial=0.0) > ratio_from_db(_LOUD_DB) * noise_power_mw
    if np.count_nonzero(loud) < _LOUD_BINS or len(np.unique(power[:, loud].argmax(axis=0))) < _LOUD_DIRECTIONS:
        return np.zeros(len(power), np.bool_)
    return np.asarray(power[:, loud].mean(axis=1) < ratio_from_db(_SILENT_DB) * noise_power_mw)


def interfered_beams(noise_power_mw: np.ndarray) -> np.ndarray:
    """Return the beams far noisier than the median between two good ones, bool [beams] of the noise (nan: missing)."""
    loud = noise_power_mw > ratio_from_db(_INTERFERED_DB) * np.nanmedian(noise_power_mw)
    useless = np.pad(loud | np.isnan(noise_power_mw), 1)
    return np.asarray(loud & ~useless[:-2] & ~useless[2:])


def has_spurs(profiles: np.ndarray, noise_power_mw: float) -> bool:
    """Return whether a range bin beyond the near ones is equally full in every beam [beams, range]: no echo is."""
    power = _power(profiles[:, _NEAR_BINS:])
    if len(power) < 3 or not noise_power_mw > 0.0:
        return False
    least, largest = power.min(axis=0), power.max(axis=0)
    full = least > ratio_from_db(_SPUR_DB) * noise_power_mw
    return bool((full & (largest < ratio_from_db(_SPUR_SPREAD_DB) * least)).any())


def array_deviation(coefficients: np.ndarray, noise_power_mw: float) -> float:
    """Return the deviation of the array from its set-up; zero where too few ranges are usable.

    `coefficients` complex [range, 2N-1] of the co-array. Of a lone echo c[k+1] c[k-1] / c[k]^2 keeps only what the
    columns' gains and phases make: the rms over k of the logarithm of its median over ranges. A turn linear over the
    columns stays unseen.
    """
    power = _power(coefficients).mean(axis=1)
    heard = (power > ratio_from_db(_HEARD_DB) * noise_power_mw) & (power > 0.0)
    if np.count_nonzero(heard) < _LEAST_RANGES:
        return 0.0
    before, here, after = (coefficients[heard, first : first + coefficients.shape[1] - 2] for first in range(3))
    gain = _level(after) + _level(before) - 2.0 * _level(here)
    turn = np.exp(1j * (np.angle(after) + np.angle(before) - 2.0 * np.angle(here)))
    turn_rad = np.angle(np.median(turn.real, axis=0) + 1j * np.median(turn.imag, axis=0))
    return float(np.sqrt(np.mean(np.square(np.median(gain, axis=0)) + np.square(turn_rad))))


def _level(values: np.ndarray) -> np.ndarray:
    """Return the logarithm of magnitudes; that of nothing is far down, not infinite."""
    return np.log(np.maximum(np.abs(values), np.finfo(np.float32).tiny))


def _power(values: np.ndarray) -> np.ndarray:
    return np.square(values.real, dtype=np.float64) + np.square(values.imag, dtype=np.float64)
