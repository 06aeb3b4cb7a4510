"""Confocal scans of point scatterers, written out by hand."""

from __future__ import annotations

import numpy as np

from lab.transients.scan import ConfocalTransients
from msgs.values.units import SPEED_OF_LIGHT_MPS

HALF_WIDTH_M, BIN_S = 0.2, 16e-12


def scan_of(counts: np.ndarray, half_width_m: float = HALF_WIDTH_M, bin_s: float = BIN_S) -> ConfocalTransients:
    return ConfocalTransients(counts.astype(np.uint32), half_width_m, bin_s)


def point_scan(
    place_m: tuple[float, float, float], points: int = 16, bins: int = 256, exponent: int = 2, photons: float = 1e4
) -> ConfocalTransients:
    """A scatterer at (x, y) behind the wall's middle and depth z: photons r^-exponent in the bin of 2 r / c."""
    wall_m = HALF_WIDTH_M * ((np.arange(points) + 0.5) * 2.0 / points - 1.0)
    range_m = np.sqrt(
        np.square(wall_m[:, None] - place_m[0]) + np.square(wall_m[None] - place_m[1]) + np.square(place_m[2])
    )
    counts = np.zeros((points, points, bins))
    at = (2.0 * range_m / SPEED_OF_LIGHT_MPS / BIN_S).astype(int)
    rows, columns = np.indices(range_m.shape)
    counts[rows, columns, at] = np.rint(photons * (place_m[2] / range_m) ** exponent)
    return scan_of(counts)
