"""Physical constants and the conversions used on input (degrees, dB, dBm)."""

from __future__ import annotations

import math

SPEED_OF_LIGHT_MPS = 299_792_458.0
BOLTZMANN_J_PER_K = 1.380_649e-23
PLANCK_J_S = 6.626_070_15e-34
REFERENCE_TEMPERATURE_K = 290.0

NANOSECONDS_PER_SECOND = 1_000_000_000


def ratio_from_db(level_db: float) -> float:
    """Return power ratio of a level in dB."""
    return 10.0 ** (level_db / 10.0)


def db_from_ratio(power_ratio: float) -> float:
    """Return level in dB of a power ratio; zero gives -inf, a negative ratio is refused."""
    if power_ratio < 0.0:
        raise ValueError(f"power ratio must not be negative, got {power_ratio!r}")
    return 10.0 * math.log10(power_ratio) if power_ratio > 0.0 else -math.inf


def ns_from_s(duration_s: float) -> int:
    """Return nanoseconds of a duration in seconds, rounded to the nearest."""
    return round(duration_s * NANOSECONDS_PER_SECOND)


def s_from_ns(duration_ns: int) -> float:
    """Return seconds of a duration in nanoseconds."""
    return duration_ns / NANOSECONDS_PER_SECOND
