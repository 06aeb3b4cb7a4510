"""Histograms of first photons of a whole measurement: expected, and drawn in closed form.

Photons arrive as a Poisson process whose rate repeats with the laser: Eqs. (11) and (12). Of each period the first
detection is kept, its time rounded down to a tick and sorted into the period's bins (section 2.2). Ticks and bins are
ratios of whole numbers, so that a histogram bin is exactly the span between two ticks. Ticks that count from the start
of the run lie differently in every period and come round again: after 33 periods with Table 2.

"gated" arming: the detector is re-armed at each pulse (or gate), whatever its dead time; periods are independent.
"free": always on, blind for the dead time after every detection, kept or not; armed when the measurement begins.
"""

from __future__ import annotations

import functools
import itertools
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from models.compiled import compiled
from models.physics.photons.dead_time import SHORTEST_SHARE, ArmedLaw, armed_laws, dead_time_grid, decimal, regained
from models.physics.photons.first_photon import first_photon_histogram, first_photon_probability
from models.physics.photons.flux import Pulses, counts_between, pulses_of
from msgs.values.lidar import SpadParams

MAX_PHASES = 4096
#: Bins of all phases and gates together, held in memory and drawn in closed form.
MAX_BINS = 1 << 22
#: Cells of a free detector's law in one standard deviation of the pulse.
CELLS_PER_RMS = 16


class Comb(NamedTuple):
    """Start of each histogram bin within a period once time stamps are ticks, for every phase of the ticks."""

    #: Time from which stamps fall into a bin, ascending, float64 [phases, bins].
    edges_s: np.ndarray
    #: Bin of the stamps before the first edge, whose tick began in the period before, int64 [phases].
    first_bin: np.ndarray


@functools.lru_cache(maxsize=16)
def comb(spad: SpadParams) -> Comb:
    """Return the edges of the bins as stamps see them: each moves up to the next tick.

    Raises `ValueError` if ticks of a run have more than `MAX_PHASES` phases within the periods, and for more than
    `MAX_BINS` in all phases and gates.
    """
    phases = _phases(spad)
    if phases * spad.bins * spad.gates > MAX_BINS:
        raise ValueError(
            f"spad.bins must not exceed {MAX_BINS // (phases * spad.gates)} with {phases} phases of ticks and "
            f"spad.gates {spad.gates}, got {spad.bins!r}"
        )
    if spad.tick_s == 0.0:
        return Comb(np.arange(spad.bins)[None] * spad.bin_s, np.array([spad.bins - 1]))
    tick = decimal(spad.tick_s)
    per_period = 1 / (decimal(spad.repetition_rate_hz) * tick)
    # whole numbers: ticks a bin are up / down, and a quotient of two integers is rounded once
    up, down = per_period.numerator, per_period.denominator * spad.bins
    unit_s = (tick.numerator, per_period.denominator * tick.denominator)
    edges_s, first_bin = np.empty((phases, spad.bins)), np.empty(phases, np.int64)
    for phase in range(phases):
        ticks = [-((phase * spad.bins + index) * up // -down) for index in range(spad.bins)]
        edges_s[phase] = [(edge * per_period.denominator - phase * up) * unit_s[0] / unit_s[1] for edge in ticks]
        first_bin[phase] = (ticks[0] - 1) * down // up % spad.bins
    return Comb(np.minimum(edges_s, spad.period_s), first_bin)


def _phases(spad: SpadParams) -> int:
    """Return the number of phases of the ticks within a period; ValueError for more than `MAX_PHASES`."""
    if spad.tick_s == 0.0 or spad.tick_from == "pulse":
        return 1
    per_period = 1 / (decimal(spad.repetition_rate_hz) * decimal(spad.tick_s))
    phases = min(per_period.denominator, spad.pulses)
    if phases > MAX_PHASES:
        raise ValueError(
            f"spad.tick_s must come round with the period within {MAX_PHASES} periods, got {phases} for "
            f"{spad.tick_s!r}: choose spad.tick_from 'pulse', or a tick whose ratio to the period is simpler"
        )
    return phases


def exact_draw(spad: SpadParams) -> bool:
    """Return whether `draw_histogram` has the exact law: periods are independent, as gated ones are."""
    return spad.arming == "gated" or spad.dead_time_s < SHORTEST_SHARE * spad.period_s or spad.pulses == 1


def expected_histogram(spad: SpadParams, delay_s: np.ndarray, photons: np.ndarray) -> np.ndarray:
    """Return the expected counts of the whole measurement, float64 [bins].

    `delay_s` [P], taken modulo the period, and `photons` [P], mean detected photons a pulse, of each path (Eq. (10)).
    Exact for gated arming; for free arming an error that falls with the square of `CELLS_PER_RMS` (`dead_time`).
    Raises `ValueError` for delays or photons that are negative or not finite, and for parameters that are too fine.
    """
    return _by_phase(spad, pulses_of(spad, delay_s, photons)).sum(axis=0)


def draw_histogram(spad: SpadParams, delay_s: np.ndarray, photons: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Draw the counts of a whole measurement in closed form, int64 [bins]; arguments, errors of `expected_histogram`.

    Exact where `exact_draw` says so. Elsewhere periods are drawn apart: means are right, and variances within a few
    percent of a bin's while the dead time is a small part of the period (Table 2); from a period on the sum of all bins
    hardly varies in truth (variance 25 times smaller with 100 ns), and here it does.
    """
    pulses = pulses_of(spad, delay_s, photons)
    if spad.arming == "gated":
        return sum(
            (
                _binned(first_photon_histogram(counts, periods, rng), comb(spad))
                for counts, periods in _gates(spad, pulses)
            ),
            np.zeros(spad.bins, np.int64),
        )
    expected = _by_phase(spad, pulses)
    periods = _phase_counts(0, spad.pulses, len(expected))
    share = expected / periods[:, None]
    share /= np.maximum(share.sum(axis=1, keepdims=True), 1.0)
    none = np.maximum(1.0 - share.sum(axis=1, keepdims=True), 0.0)
    return rng.multinomial(periods, np.concatenate([share, none], axis=1))[:, :-1].sum(axis=0)


def _shares(spad: SpadParams) -> list[tuple[int, int]]:
    """Return the first period of each gate's share of the measurement, and the one after its last."""
    each, more = divmod(spad.pulses, spad.gates)
    starts = [gate * each + min(gate, more) for gate in range(spad.gates + 1)]
    return list(itertools.pairwise(starts))


def _phase_counts(start: int, stop: int, phases: int) -> np.ndarray:
    """Return the number of periods from `start` until before `stop` with each phase of the ticks, int64 [phases]."""
    upto = [(end - np.arange(phases) + phases - 1) // phases for end in (start, stop)]
    return np.asarray(upto[1] - upto[0])


def _gates(spad: SpadParams, pulses: Pulses) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Yield each gate's mean counts, float64 [phases, bins + 1], the first before the first edge, and its periods."""
    edges_s = comb(spad).edges_s
    for gate, (start, stop) in enumerate(_shares(spad)):
        ends = np.array([gate, gate + 1]) * (spad.period_s / spad.gates)
        inner = np.clip(edges_s, *ends)
        rows = [counts_between(spad, pulses, np.concatenate([ends[:1], row, ends[1:]])) for row in inner]
        yield np.array(rows), _phase_counts(start, stop, len(edges_s))


def _binned(values: np.ndarray, bins: Comb) -> np.ndarray:
    """Return the histogram [bins] of values [phases, bins + 1] that start with those before the first edge."""
    histogram = values[:, 1:].sum(axis=0)
    np.add.at(histogram, bins.first_bin, values[:, 0])
    return histogram


def _by_phase(spad: SpadParams, pulses: Pulses) -> np.ndarray:
    """Return the expected counts of the periods of each phase, float64 [phases, bins]."""
    bins = comb(spad)
    values = np.zeros((len(bins.edges_s), spad.bins + 1))
    if spad.arming == "gated":
        for counts, periods in _gates(spad, pulses):
            values += periods[:, None] * first_photon_probability(counts)[0]
    else:
        _add_free(values, spad, pulses)
    histogram = values[:, 1:].copy()
    histogram[np.arange(len(values)), bins.first_bin] += values[:, 0]
    return histogram


def _add_free(values: np.ndarray, spad: SpadParams, pulses: Pulses) -> None:
    """Add expected counts [phases, bins + 1] of free arming, period by period while its law changes."""
    edges_s, grid = comb(spad).edges_s, dead_time_grid(spad, CELLS_PER_RMS)
    nodes_s = np.linspace(0.0, spad.period_s, grid.cells + 1)
    points_s = np.unique(np.concatenate([nodes_s, edges_s.ravel()]))
    between = counts_between(spad, pulses, points_s)
    node = np.searchsorted(points_s, nodes_s)
    counts = np.add.reduceat(between, node[:-1])
    edge = np.searchsorted(points_s, edges_s)
    cell = np.minimum(np.searchsorted(node, edge, side="right") - 1, grid.cells - 1)
    part = _since_node(between, node)[edge]
    # in the last cell all counts are complete at the period's end
    part = np.where(edge == node[-1], counts[-1], part)
    first = 0
    for law, periods in armed_laws(counts, grid, spad.pulses):
        weight = _phase_counts(first, first + periods, len(edges_s))
        some = np.flatnonzero(weight)
        values[some] += weight[some, None] * _between_edges(law, counts, cell[some], part[some])
        first += periods


def _since_node(between: np.ndarray, node: np.ndarray) -> np.ndarray:
    """Return counts at each point since the last node before it, or since it: summed within cells, never subtracted."""
    since = np.zeros(len(between) + 1)
    _sum_within(between, node, since)
    return since


def _between_edges(law: ArmedLaw, counts: np.ndarray, cell: np.ndarray, part: np.ndarray) -> np.ndarray:
    """Return the probability of the first photon between edges [phases, bins + 1]; edges are `part` into a cell."""
    whole = law.waiting * -np.expm1(-counts) + law.rejoining * regained(counts)
    until = np.concatenate([[0.0], np.cumsum(whole)])
    share = np.divide(part, counts[cell], out=np.zeros(part.shape), where=counts[cell] > 0.0)
    within = law.waiting[cell] * -np.expm1(-part) + law.rejoining[cell] * share * regained(part)
    return np.maximum(np.diff(until[cell] + within, axis=1, prepend=0.0, append=until[-1]), 0.0)


@compiled
def _sum_within(between, node, since):  # type: ignore[no-untyped-def]
    following, total = 0, 0.0
    for point in range(len(since)):
        if following < len(node) and node[following] == point:
            following, total = following + 1, 0.0
        since[point] = total
        if point < len(between):
            total += between[point]
