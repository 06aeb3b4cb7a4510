"""Histograms of first photons of a whole measurement: expected, drawn in closed form, and counted event by event.

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

import msgspec
import numpy as np

from models.compiled import compiled
from models.physics.photons.dead_time import SHORTEST_SHARE, ArmedLaw, armed_laws, dead_time_grid, decimal, regained
from models.physics.photons.first_photon import first_photon_histogram, first_photon_probability
from models.physics.photons.flux import Pulses, cell_of, counts_at, counts_between, flux_table, pulses_of, time_at
from msgs.values.lidar import SpadParams

MAX_PHASES = 4096
#: Bins of all phases and gates together, held in memory and drawn in closed form.
MAX_BINS = 1 << 22
#: Detections counted event by event: about four minutes.
MAX_DETECTIONS = 10**9
CELLS_PER_RMS = 16
#: Waiting times drawn at a time; bounds the memory of counting event by event.
CHUNK = 1 << 16


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


def exact_closed_form(spad: SpadParams) -> bool:
    """Return whether `draw_histogram` has the exact law: periods are independent, as gated ones are."""
    return spad.arming == "gated" or spad.dead_time_s < SHORTEST_SHARE * spad.period_s or spad.pulses == 1


def expected_histogram(
    spad: SpadParams, delay_s: np.ndarray, photons: np.ndarray, cells_per_rms: int = CELLS_PER_RMS
) -> np.ndarray:
    """Return the expected counts of the whole measurement, float64 [bins].

    `delay_s` [P], taken modulo the period, and `photons` [P], mean detected photons a pulse, of each path (Eq. (10)).
    Exact for gated arming; for free arming an error that falls with the square of `cells_per_rms` (`dead_time`).
    Raises `ValueError` for delays or photons that are negative or not finite, and for parameters that are too fine
    (`comb`, `dead_time_grid`).
    """
    return _by_phase(spad, pulses_of(spad, delay_s, photons), cells_per_rms).sum(axis=0)


def draw_histogram(spad: SpadParams, delay_s: np.ndarray, photons: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Draw the counts of a whole measurement in closed form, int64 [bins]; arguments, errors of `expected_histogram`.

    Exact where `exact_closed_form` says so. Elsewhere each period has the right law but is drawn independently, as if
    the dead time of its neighbours did not tie them together. Means are right. So are variances within a few percent of
    a bin's while the dead time is a small part of the period (Table 2); from a period on the sum of all bins hardly
    varies in truth (variance 25 times smaller with 100 ns), and here it does.
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
    expected = _by_phase(spad, pulses, CELLS_PER_RMS)
    periods = _phase_counts(0, spad.pulses, len(expected))
    share = expected / periods[:, None]
    share /= np.maximum(share.sum(axis=1, keepdims=True), 1.0)
    none = np.maximum(1.0 - share.sum(axis=1, keepdims=True), 0.0)
    return rng.multinomial(periods, np.concatenate([share, none], axis=1))[:, :-1].sum(axis=0)


def event_histogram(spad: SpadParams, delay_s: np.ndarray, photons: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Draw the counts of a whole measurement, event by event, int64 [bins]; arguments, errors of `expected_histogram`.

    Exact for any dead time. Memory is constant; time goes with detections, of which there are at most as many as dead
    times in the measurement, and one a period where there is none.
    """
    if spad.dead_time_s < SHORTEST_SHARE * spad.period_s:
        # nothing ties the periods together: only the first photon matters
        spad = msgspec.structs.replace(spad, arming="gated")
    bins, histogram, last = comb(spad), np.zeros(spad.bins, np.int64), -1
    for period, time_s in detections(spad, delay_s, photons, rng):
        first = np.diff(period, prepend=last) != 0
        _fill(histogram, *bins, period[first], time_s[first])
        last = int(period[-1])
    return histogram


def detections(
    spad: SpadParams, delay_s: np.ndarray, photons: np.ndarray, rng: np.random.Generator
) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Yield detections in order of time, in chunks: number of the period, int64, and time within it, float64 seconds.

    Free arming yields those that are not kept too, gated arming one a period at most. Drawn are photons that meet an
    armed detector: the next one comes when as many mean counts have passed as an exponential variable says, which is
    the law of Eqs. (11) and (12) without the rest. Errors of `expected_histogram`, and if there would be more
    than `MAX_DETECTIONS`.
    """
    table = flux_table(spad, pulses_of(spad, delay_s, photons))
    free = spad.arming == "free"
    _bounded(spad, float(table.counts[-1]))
    whole, rest = divmod(decimal(spad.dead_time_s), 1 / decimal(spad.repetition_rate_hz))
    for gate, (start, stop) in enumerate(_shares(spad)):
        open_s, close_s = gate * spad.period_s / spad.gates, (gate + 1) * spad.period_s / spad.gates
        window = (open_s, counts_at(open_s, *table), counts_at(close_s, *table))
        dead = (min(int(whole), spad.pulses), float(rest), spad.period_s)
        period, time_s = start, open_s
        while period < stop and window[2] > window[1]:
            count, period, time_s, periods, times_s = _detect(
                rng.standard_exponential(CHUNK), *table, *window, *dead, free, period, stop, time_s
            )
            if count:
                yield periods[:count], times_s[:count]


def _bounded(spad: SpadParams, counts: float) -> None:
    """Raise ValueError where detections of so many mean counts a period would take too long to count."""
    # upper limit of the mean number of detections: each takes a dead time, or the rest of its gate
    a_period = counts / (1.0 + counts * spad.dead_time_s / spad.period_s) if spad.arming == "free" else min(counts, 1.0)
    if spad.pulses * a_period > MAX_DETECTIONS:
        raise ValueError(
            f"spad.measurement_time_s must hold at most {MAX_DETECTIONS} detections event by event, got about "
            f"{spad.pulses * a_period:.0e} in {spad.measurement_time_s!r} s: count in closed form"
        )


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


def _by_phase(spad: SpadParams, pulses: Pulses, cells_per_rms: int) -> np.ndarray:
    """Return the expected counts of the periods of each phase, float64 [phases, bins]."""
    bins = comb(spad)
    values = np.zeros((len(bins.edges_s), spad.bins + 1))
    if spad.arming == "gated":
        for counts, periods in _gates(spad, pulses):
            values += periods[:, None] * first_photon_probability(counts)[0]
    else:
        _add_free(values, spad, pulses, cells_per_rms)
    histogram = values[:, 1:].copy()
    histogram[np.arange(len(values)), bins.first_bin] += values[:, 0]
    return histogram


def _add_free(values: np.ndarray, spad: SpadParams, pulses: Pulses, cells_per_rms: int) -> None:
    """Add expected counts [phases, bins + 1] of free arming, period by period while its law changes."""
    edges_s, grid = comb(spad).edges_s, dead_time_grid(spad, cells_per_rms)
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


@compiled
def _detect(  # type: ignore[no-untyped-def]
    waits, table_s, counts, rate_hz, open_s, low, high, dead_periods, dead_s, period_s, free, period, stop, time_s
):
    """Return detections until the waiting times or the periods are used up, and the state for the next call."""
    periods, times_s, count = np.empty(len(waits), np.int64), np.empty(len(waits)), 0
    for wait in waits:
        level = wait + max(counts_at(time_s, table_s, counts, rate_hz) - low, 0.0)
        # whole periods (gates) without a photon
        ratio = level / (high - low)
        if ratio >= stop - period:
            period = stop
            break
        passed = int(ratio)
        period += passed
        time_s = time_at(low + max(level - passed * (high - low), 0.0), table_s, counts, rate_hz)
        periods[count], times_s[count] = period, time_s
        count += 1
        if free:
            time_s, period = time_s + dead_s, period + dead_periods
            if time_s >= period_s:
                time_s, period = time_s - period_s, period + 1
        else:
            time_s, period = open_s, period + 1
        if period >= stop:
            break
    return count, period, time_s, periods, times_s


@compiled
def _fill(histogram, edges_s, first_bin, period, time_s):  # type: ignore[no-untyped-def]
    for photon in range(len(period)):
        phase = period[photon] % len(edges_s)
        index = cell_of(time_s[photon], edges_s[phase])
        histogram[index if index >= 0 else first_bin[phase]] += 1
