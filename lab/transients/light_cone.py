"""The light-cone transform: confocal transients of hidden surfaces as one convolution, and its Wiener inverse.

Light from a wall point to a voxel at depth z and back takes the time 2 r / c with r^2 = z^2 + |x - x'|^2. In v = r^2
and u = z^2 that is v = u + |x - x'|^2: the same cone for every voxel, a convolution in (x, y, v) once the loss over
distance, r^-2 of retroreflectors and r^-4 of matt surfaces, is taken out. Bins are re-sorted into v by the overlap of
cells, so that counts are conserved. Source: O'Toole, Lindell, Wetzstein, Nature 555 (2018), 338-341.
"""

from __future__ import annotations

from functools import cached_property
from typing import Literal

import numpy as np
from scipy import fft, sparse

from lab.transients.scan import ConfocalTransients, require_layout

Falloff = Literal["retroreflective", "matt"]
#: Exponents of r.
FALLOFFS: dict[Falloff, int] = {"retroreflective": 2, "matt": 4}
#: Power of the signal over the noise at a frequency whose cone has its mean power; higher is sharper and noisier.
DEFAULT_SNR = 1.0


class LightCone:
    """The operator of one scan's grid: volumes [points, points, bins] over depth to transients over time, and back."""

    def __init__(self, scan: ConfocalTransients, falloff: Falloff = "retroreflective") -> None:
        if falloff not in FALLOFFS:
            raise ValueError(f"falloff must be one of {', '.join(FALLOFFS)}, got {falloff!r}")
        self._shape = scan.counts.shape
        self._cone_cells = np.square(2.0 * scan.half_width_m / len(scan.counts) / scan.range_bin_m) / scan.bins
        self._by_square = _overlaps(scan.bins)
        self._loss = ((np.arange(scan.bins) + 0.5) / scan.bins) ** (0.5 * FALLOFFS[falloff])

    def forward(self, volume: np.ndarray) -> np.ndarray:
        """Return the transients of a volume of reflectances, float32 [points, points, bins]."""
        squared = self._along_bins(self._by_square, volume)
        return self._along_bins(self._by_time, self._convolved(squared, self._cone) / self._loss)

    def adjoint(self, transients: np.ndarray) -> np.ndarray:
        """Return the backprojection of transients, the transpose of `forward`: each count over its sphere."""
        squared = self._along_bins(self._by_time.T, transients) / self._loss
        return self._along_bins(self._by_square.T, self._convolved(squared, np.conj(self._cone)))

    def invert(self, transients: np.ndarray, snr: float = DEFAULT_SNR) -> np.ndarray:
        """Return the volume of these transients by a Wiener filter, reflectance in a cell of u, float32 as they are.

        Raises `ValueError` unless `snr` is finite and positive.
        """
        if not (np.isfinite(snr) and snr > 0.0):
            raise ValueError(f"snr must be finite and positive, got {snr!r}")
        squared = self._along_bins(self._by_square, transients) * self._loss
        power = np.square(np.abs(self._cone))
        wiener = np.conj(self._cone) / (power + power.mean() / np.float32(snr))
        # the mean over a bin's cells: noise grows with depth no faster than loss is taken out
        return self._along_bins(self._by_square.T, self._convolved(squared, wiener))

    @cached_property
    def _by_time(self) -> sparse.csr_array:
        """Share of each cell of the square in each bin of time (or depth)."""
        width = np.asarray(self._by_square.sum(axis=1)).ravel()
        return sparse.csr_array((self._by_square.multiply(1.0 / width[:, None])).T.astype(np.float32))

    @cached_property
    def _cone(self) -> np.ndarray:
        """Spectrum of the cone, complex64, of twice the size: nothing wraps round."""
        points, _, bins = self._shape
        away = np.square(np.minimum(np.arange(2 * points), 2 * points - np.arange(2 * points)))
        cells = (away[:, None] + away[None]) * self._cone_cells
        row, column = np.nonzero(cells < bins - 1)
        first = np.floor(cells[row, column]).astype(np.int64)
        rest = cells[row, column] - first
        cone = np.zeros((2 * points, 2 * points, 2 * bins), np.float32)
        cone[row, column, first] = 1.0 - rest
        cone[row, column, first + 1] = rest
        return np.asarray(fft.rfftn(cone, workers=-1))

    def _convolved(self, values: np.ndarray, spectrum: np.ndarray) -> np.ndarray:
        points, _, bins = self._shape
        padded = (2 * points, 2 * points, 2 * bins)
        product = fft.rfftn(values.astype(np.float32), s=padded, workers=-1)
        product *= spectrum
        return np.asarray(fft.irfftn(product, s=padded, workers=-1)[:points, :points, :bins])

    def _along_bins(self, matrix: sparse.csr_array, values: np.ndarray) -> np.ndarray:
        require_layout("transients", np.shape(values))
        if np.shape(values) != self._shape:
            raise ValueError(f"transients must have shape {self._shape}, got {np.shape(values)}")
        flat = np.asarray(values, np.float32).reshape(-1, self._shape[2])
        return np.asarray((matrix @ flat.T).T).reshape(self._shape)


def _overlaps(bins: int) -> sparse.csr_array:
    """Return the share of each of so many equal bins of 0..1 in each equal cell of the square, sparse [cells, bins]."""
    edges, cells = np.arange(bins + 1.0), np.sqrt(np.arange(bins + 1.0) * bins)
    cuts = np.union1d(edges, cells)
    middle = 0.5 * (cuts[1:] + cuts[:-1])
    at = (
        np.clip(np.searchsorted(cells, middle) - 1, 0, bins - 1),
        np.clip(np.searchsorted(edges, middle) - 1, 0, bins - 1),
    )
    return sparse.csr_array((np.diff(cuts).astype(np.float32), at), shape=(bins, bins))


def reconstruct(scan: ConfocalTransients, first_bin: int, falloff: Falloff = "retroreflective") -> np.ndarray:
    """Return the reflectance of the hidden volume over depth, float32 [points, points, bins], not below 0.

    Bins before `first_bin` hold the return of the wall itself and count as dark. Raises `ValueError` for a bin that
    does not exist.
    """
    if not 0 <= first_bin < scan.bins:
        raise ValueError(f"first_bin must lie in 0..{scan.bins - 1}, got {first_bin!r}")
    counts = scan.counts.astype(np.float32)
    counts[..., :first_bin] = 0.0
    return np.maximum(LightCone(scan, falloff).invert(counts), 0.0)
