"""Photon histograms of a single-photon LiDAR on the radar's range-azimuth grid: counts, and excess over ambient light.

Of W periods that still wait a bin takes a binomial share, so that pile-up needs no inverse and bins are uncorrelated.
"""

from __future__ import annotations

from contextlib import nullcontext
from dataclasses import dataclass
from fractions import Fraction
from functools import lru_cache

import numpy as np
from scipy import sparse

from models.perception.timing import Timed
from msgs.values.lidar import LidarSetup, PhotonHistograms, SpadParams
from msgs.values.radar import RangeAzimuthGrid, RangeAzimuthMap
from msgs.values.units import SPEED_OF_LIGHT_MPS

#: Least counts of a cell that is used to estimate the ambient rate: a median of fewer counts is not their mean.
LEAST_COUNTS = 25.0
#: Least number of such cells.
LEAST_CELLS = 4
LEAST_RATE_HZ = 1e-3
#: Least share of waiting periods in a usable cell, relative to the cell with most.
LEAST_WAITING = 0.05
#: Counts further than this many standard deviations from the expectation are not ambient light.
QUIET_SIGMAS = 3.0
#: Times and cells of a scan, over all azimuths: eight times those of the default, and about a second.
MAX_TIMES, MAX_CELLS = 1 << 20, 1 << 19


def project_counts(counts: np.ndarray, spad: SpadParams, grid: RangeAzimuthGrid) -> np.ndarray:
    """Return the counts [azimuth, bins] shared out over the range cells they overlap, float64 [range, azimuth].

    R = c t / 2, cell i about i range_bin_m (section 2.2). `ValueError` for counts of another shape.
    """
    _require_shape(np.shape(counts), spad, grid)
    return np.asarray(_overlaps(spad, grid) @ np.asarray(counts, np.float64).T)


class PhotonFormer:
    """Maps of one LiDAR; the counterpart of `FormingStage` for histograms."""

    def __init__(self, timed: Timed = nullcontext) -> None:
        self._setup: LidarSetup | None = None
        self._timed = timed

    def set_up(self, setup: LidarSetup) -> None:
        """Form by another set-up."""
        self._setup = setup

    def add(self, histograms: PhotonHistograms) -> RangeAzimuthMap:
        """Return the map of one scan; `ValueError` for histograms of another set-up, or before any."""
        if self._setup is None:
            raise ValueError(f"histograms of scan {histograms.scan_id} came before lidar/setup")
        with self._timed("map"):
            return photon_map(self._setup, histograms)


def photon_map(lidar: LidarSetup, histograms: PhotonHistograms) -> RangeAzimuthMap:
    """Return the excess of photons over ambient light in standard deviations: complex64 [range, azimuth], "photons".

    Without echoes |values|^2 has mean 1; with one it is the detection SNR; one count is the least deviation. Cells that
    no waiting period reaches are 0, `saturated_share` of those that the period reaches. The ambient rate is that of
    each azimuth's own counts. Ticks, gates and dead time by ambient light are allowed for; behind a strong echo "free"
    arming leaves negative values. `ValueError` for histograms of another set-up, and for one that would take too long.
    """
    spad, grid = lidar.spad, lidar.grid
    _require_tractable(spad, grid)
    counts = histograms.counts.astype(np.int64)
    _require_shape(counts.shape, spad, grid)
    if counts.size and (largest := int(counts.sum(axis=1).max())) > spad.pulses:
        raise ValueError(f"histograms.counts must sum to at most {spad.pulses} pulses an azimuth, got {largest}")
    pieces, cells = _pieces(spad), _cells(spad, grid)
    observed = project_counts(counts, spad, grid)
    waiting = _waiting(counts, pieces)
    rate_hz, fitted = _ambient_rate(spad, pieces, cells, waiting, observed)
    expected, variance = _expected(spad, pieces, cells, waiting, rate_hz)
    # a cell that the rate was fitted to pulls it along, and deviates the less
    variance = variance * (1.0 - np.where(fitted, expected, 0.0) / np.maximum((expected * fitted).sum(axis=0), 1.0))
    exposed = np.asarray(cells @ (waiting * pieces.exposure_s).T) > 0.0
    values = np.where(exposed, (observed - expected) / np.sqrt(np.maximum(variance, 1.0)), 0.0)
    reached = np.asarray(cells.sum(axis=1)).ravel() > 0.0
    return RangeAzimuthMap(
        stamp_ns=histograms.stamp_ns,
        scan_id=histograms.scan_id,
        grid=grid,
        values=values.astype(np.complex64),
        azimuth_stamp_ns=histograms.azimuth_stamp_ns,
        noise_power_mw=1.0,
        incoherent=np.zeros(grid.range_bins, bool),
        saturated_share=float(np.mean(~exposed[reached])) if reached.any() else 0.0,
        vehicle_from_radar=lidar.vehicle_from_lidar,
        mode="photons",
    )


@dataclass(frozen=True, eq=False)
class _Pieces:
    """The period cut at the edges of bins and of gates, in order of time; all [pieces]."""

    bin_index: np.ndarray
    exposure_s: np.ndarray
    #: Middle of each since the pulse.
    delay_s: np.ndarray
    #: Pulses of its gate, and the first piece of the gate.
    pulses: np.ndarray
    gate_start: np.ndarray


@lru_cache(maxsize=4)
def _pieces(spad: SpadParams) -> _Pieces:
    """Return the times at which events fall into each bin, gate by gate."""
    edges_s = _bin_edges_s(spad)
    gates_s = spad.period_s * np.arange(spad.gates + 1) / spad.gates
    cuts_s = np.union1d(edges_s, gates_s)
    delay_s, exposure_s = 0.5 * (cuts_s[1:] + cuts_s[:-1]), np.diff(cuts_s)
    # before the first edge: events of a tick that began in the period before, counted in its last bin
    bin_index = (np.searchsorted(edges_s, delay_s, side="right") - 1) % spad.bins
    gate = np.clip(np.searchsorted(gates_s, delay_s, side="right") - 1, 0, spad.gates - 1)
    pulses = spad.pulses // spad.gates + (np.arange(spad.gates) < spad.pulses % spad.gates)
    return _Pieces(
        bin_index=bin_index,
        exposure_s=exposure_s,
        delay_s=delay_s,
        pulses=pulses[gate].astype(np.float64),
        gate_start=np.searchsorted(gate, gate),
    )


def _bin_edges_s(spad: SpadParams) -> np.ndarray:
    """Return the times since the pulse from which events fall into each bin, ascending; of a run of ticks the mean."""
    edges_s, later_s = spad.bin_s * np.arange(spad.bins), 0.0
    if spad.tick_s:
        tick, bin_ = Fraction(str(spad.tick_s)), 1 / (Fraction(str(spad.repetition_rate_hz)) * spad.bins)
        if spad.tick_from == "run":
            # phases of later periods lie between those of the first, as many as until they repeat
            finest = tick / (bin_ * spad.bins / tick).denominator
            tick, later_s = finest, 0.5 * float(tick - finest)
        number, parts = bin_.numerator * tick.denominator, bin_.denominator * tick.numerator
        edges_s = float(tick) * np.array([float(-(-k * number // parts)) for k in range(spad.bins)])
    return np.minimum(edges_s + later_s, spad.period_s)


@lru_cache(maxsize=4)
def _overlaps(spad: SpadParams, grid: RangeAzimuthGrid) -> sparse.csr_array:
    """Return the share of each bin that lies in each range cell, sparse [range, bins]."""
    edges_m = 0.5 * SPEED_OF_LIGHT_MPS * spad.bin_s * np.arange(spad.bins + 1)
    cells_m = grid.range_bin_m * (np.arange(grid.range_bins + 1) - 0.5)
    cuts_m = np.union1d(edges_m, cells_m)
    cuts_m = cuts_m[(cuts_m >= 0.0) & (cuts_m <= min(edges_m[-1], cells_m[-1]))]
    middle_m = 0.5 * (cuts_m[1:] + cuts_m[:-1])
    at = (
        np.clip(np.searchsorted(cells_m, middle_m) - 1, 0, grid.range_bins - 1),
        np.clip(np.searchsorted(edges_m, middle_m) - 1, 0, spad.bins - 1),
    )
    return sparse.csr_array((np.diff(cuts_m) * spad.bins / edges_m[-1], at), shape=(grid.range_bins, spad.bins))


@lru_cache(maxsize=4)
def _cells(spad: SpadParams, grid: RangeAzimuthGrid) -> sparse.csr_array:
    """Return the share of each piece's counts that lies in each range cell, sparse [range, pieces]."""
    return _overlaps(spad, grid)[:, _pieces(spad).bin_index]


def _waiting(counts: np.ndarray, pieces: _Pieces) -> np.ndarray:
    """Return the periods without a photon so far at each piece, float64 [azimuth, pieces]; below one is none.

    A bin across the edge of two gates is shared as ambient light would, in two rounds.
    """
    waiting = np.broadcast_to(pieces.pulses, (len(counts), len(pieces.pulses)))
    is_cut = len(pieces.bin_index) > counts.shape[1]
    for _ in range(2 if is_cut else 1):
        taken = counts[:, pieces.bin_index] * (_share(waiting, pieces) if is_cut else 1.0)
        before = np.concatenate([np.zeros((len(counts), 1)), np.cumsum(taken, axis=1)], axis=1)
        waiting = pieces.pulses - (before[:, :-1] - before[:, pieces.gate_start])
        waiting = np.where(waiting >= 0.5, waiting, 0.0)
    return waiting


def _share(waiting: np.ndarray, pieces: _Pieces) -> np.ndarray:
    """Return the share of each piece in the ambient counts of its bin, [azimuth, pieces]."""
    weight = (waiting + 0.5) * pieces.exposure_s
    total = np.stack([np.bincount(pieces.bin_index, row) for row in weight])
    return np.asarray(weight / total[:, pieces.bin_index])


def _expected(
    spad: SpadParams, pieces: _Pieces, cells: sparse.csr_array, waiting: np.ndarray, rate_hz: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the counts of ambient light at rates [azimuth] and their variance, float64 [range, azimuth].

    Of "free" arming a share 1 / (1 + rate (dead time - t)) of those that wait at t is alive.
    """
    chance = -np.expm1(-rate_hz[:, None] * pieces.exposure_s)
    if spad.arming == "free":
        chance /= 1.0 + rate_hz[:, None] * np.maximum(spad.dead_time_s - pieces.delay_s, 0.0)
    taken = waiting * chance
    return np.asarray(cells @ taken.T), np.asarray(cells.multiply(cells) @ (taken * (1.0 - chance)).T)


def _ambient_rate(
    spad: SpadParams, pieces: _Pieces, cells: sparse.csr_array, waiting: np.ndarray, observed: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the ambient rate of each azimuth [azimuth], and the cells it is the mean of, bool [range, azimuth].

    The median over range cells, then the mean within `QUIET_SIGMAS` of it; the set-up's where counts are too few.
    """
    exposure_s = np.asarray(cells @ (waiting * pieces.exposure_s).T)
    long_seen = exposure_s > LEAST_WAITING * exposure_s.max(axis=0, initial=0.0)
    each_hz = np.where(long_seen, observed / np.where(long_seen, exposure_s, 1.0), 0.0)
    rate_hz = np.array(
        [np.median(rates[use]) if use.any() else 0.0 for rates, use in zip(each_hz.T, long_seen.T, strict=True)]
    )
    usable = long_seen & (np.maximum(rate_hz, spad.ambient_rate_hz) * exposure_s >= LEAST_COUNTS)
    is_measured = usable.sum(axis=0) >= LEAST_CELLS
    # above zero, so that it can rise from there
    rate_hz = np.where(is_measured, np.maximum(rate_hz, LEAST_RATE_HZ), spad.ambient_rate_hz)
    quiet = usable & is_measured
    for _ in range(2):
        expected, variance = _expected(spad, pieces, cells, waiting, rate_hz)
        quiet = (
            usable & is_measured & (np.abs(observed - expected) <= QUIET_SIGMAS * np.sqrt(np.maximum(variance, 1.0)))
        )
        total = (expected * quiet).sum(axis=0)
        rate_hz = rate_hz * np.where(
            total > 0.0, (observed * quiet).sum(axis=0) / np.where(total > 0.0, total, 1.0), 1.0
        )
    return rate_hz, quiet


def _require_tractable(spad: SpadParams, grid: RangeAzimuthGrid) -> None:
    times, cells = grid.azimuth_bins * (spad.bins + spad.gates), grid.azimuth_bins * grid.range_bins
    if times > MAX_TIMES or cells > MAX_CELLS:
        raise ValueError(
            f"lidar.grid must have at most {MAX_TIMES} azimuths times bins and gates, and {MAX_CELLS} cells, "
            f"got {times} and {cells}"
        )


def _require_shape(shape: tuple[int, ...], spad: SpadParams, grid: RangeAzimuthGrid) -> None:
    expected = grid.azimuth_bins, spad.bins
    if shape != expected:
        raise ValueError(f"histograms.counts must have shape {expected} as lidar/setup says, got {tuple(shape)}")
