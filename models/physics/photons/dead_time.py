"""A detector that is always on, blind for its dead time after each detection: the law of its first photon in a period.

With A(t) the probability of being armed and r(t) the rate of detections, A' = -flux A + r(t - dead time) and
r = flux A: a detector re-arms one dead time after a detection. Dead time of the last period reaches into this one,
so that A at its start is the state of a Markov chain. Of the armed detectors, B have no detection yet in this
period: B starts as A does and regains only detections from before the period. The first photon has the rate flux B.

Cells are chosen so that the dead time is a whole number of them to one part in 1e8 of the period. Flux within a cell
is exact except in one respect: detectors that re-arm within a cell do so in step with the cell's flux. The error
falls with the square of the cell.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from fractions import Fraction
from typing import NamedTuple

import numpy as np

from models.compiled import compiled
from msgs.values.lidar import SpadParams

MAX_CELLS = 1 << 22
#: Dead time (beyond whole periods) below this share of a period changes no first photon: it is left out.
SHORTEST_SHARE = 2.0**-18
#: Maximum periods stepped through while the detector forgets its initial state, and cells of them all.
START_PERIODS, START_CELLS = 64, 1 << 24
#: Maximum cells swept over in the search for the stationary law.
LASTING_CELLS = 1 << 24
SETTLED, FORGOTTEN = 1e-12, 1e-10


class DeadTimeGrid(NamedTuple):
    """Cells of one period, and the dead time as whole periods and whole cells."""

    cells: int
    periods: int
    shift: int


class ArmedLaw(NamedTuple):
    """For one period and each of its cells, float64 [cells]: detectors still waiting for the period's first photon."""

    #: Armed at the start of the cell.
    waiting: np.ndarray
    #: Armed again within the cell.
    rejoining: np.ndarray


def decimal(value: float) -> Fraction:
    """Return a parameter as the decimal it was written as: 55e-12 is 55 / 10^12, not the double next to it."""
    return Fraction(repr(float(value)))


def dead_time_grid(spad: SpadParams, cells_per_rms: int) -> DeadTimeGrid:
    """Return the cells of a period: about so many per standard deviation of the pulse, a divisor of the dead time.

    Raises `ValueError` if that takes more than `MAX_CELLS`.
    """
    periods, rest = divmod(decimal(spad.dead_time_s), 1 / decimal(spad.repetition_rate_hz))
    share = float(rest * decimal(spad.repetition_rate_hz))
    share = share if share >= SHORTEST_SHARE else 0.0
    minimum = math.ceil(cells_per_rms * max(spad.period_s / spad.timing_rms_s, 64.0, 0.25 / share if share else 0.0))
    if minimum > MAX_CELLS:
        raise ValueError(
            f"spad.irf_fwhm_s must be wider, {spad.irf_fwhm_s:g} s takes {minimum} cells a period of at most "
            f"{MAX_CELLS}: choose spad.arming 'gated'"
        )
    candidates = np.arange(minimum, minimum + min(minimum, 1 << 16))
    cells = int(candidates[np.argmin(np.abs(candidates * share - np.rint(candidates * share)))])
    return DeadTimeGrid(cells, min(int(periods), spad.pulses), round(cells * share))


def armed_laws(counts: np.ndarray, grid: DeadTimeGrid, pulses: int) -> Iterator[tuple[ArmedLaw, int]]:
    """Yield the laws of successive periods and for how many each holds; the detector is armed at the first one's start.

    `counts` [cells] are mean detections of an always armed detector. The start is stepped through until the detector
    has forgotten it, `START_PERIODS` at most; the stationary law holds for the rest. If the dead time lasts for
    several periods the memory may last longer: less than one count of the whole measurement.
    """
    cells = _Cells(counts, grid)
    law, before = cells.lasting()
    past: list[np.ndarray] = []
    armed = 1.0
    for period in range(min(pulses, START_PERIODS, START_CELLS // grid.cells)):
        back = period - grid.periods
        newer = past[back] if 0 <= back < period else cells.nothing
        older = past[back - 1] if back >= 1 else cells.nothing
        if grid.periods == 0 and period and np.abs(past[-1] - before).max() <= FORGOTTEN * before.max():
            yield law, pulses - period
            return
        own, detected, armed = cells.period(armed, older, newer)
        past.append(detected)
        yield own, 1
    if pulses > len(past):
        yield law, pulses - len(past)


class _Cells:
    """Cells of one period, and the propagation of a detector's state through them."""

    def __init__(self, counts: np.ndarray, grid: DeadTimeGrid) -> None:
        self.counts, self.grid = counts, grid
        self.nothing = np.zeros(grid.cells)
        self.hit, self.late = -np.expm1(-counts), regained(counts)

    def period(self, armed: float, older: np.ndarray, newer: np.ndarray) -> tuple[ArmedLaw, np.ndarray, float]:
        """Return first-photon law and detections [cells] of one period, and the probability of being armed at its end.

        `older` and `newer` are detections of the periods from which some come back in its first and later cells;
        `newer` is not read where that is the period itself.
        """
        if self.grid.periods == 0 and self.grid.shift == 0:
            before = np.exp(-np.concatenate([[0.0], np.cumsum(self.counts)[:-1]]))
            return ArmedLaw(before, self.nothing), self.counts, 1.0
        arrays = (np.empty(self.grid.cells) for _ in range(3))
        waiting, rejoining, detected, armed = _period(
            self.hit, self.late, armed, older, newer, self.grid.shift, self.grid.periods > 0, False, *arrays
        )
        return ArmedLaw(waiting, rejoining), detected, armed

    def lasting(self) -> tuple[ArmedLaw, np.ndarray]:
        """Return the stationary law, and the detections of a period.

        Whole periods of dead time scale it: A and r obey the same equation, and A(0) + r integrated over the dead time
        is 1. Sweeps that have not settled by then circle about it: their later half is averaged.
        """
        shift, whole = self.grid.shift, self.grid.periods
        armed = 1.0 / (1.0 + self.counts[self.grid.cells - shift :].sum())
        detected = armed * self.counts
        if shift == 0:
            scale = 1.0 / (1.0 + whole * self.counts.sum())
            law = ArmedLaw(np.full(self.grid.cells, scale), detected * scale)
            return (law if whole else self.period(1.0, self.nothing, self.nothing)[0]), detected * scale
        sweeps = max(LASTING_CELLS // self.grid.cells, 2)
        total = np.zeros((3, self.grid.cells))
        for sweep in range(sweeps):
            arrays = (np.empty(self.grid.cells) for _ in range(3))
            *laws, armed = _period(self.hit, self.late, armed, detected, detected, shift, False, whole > 0, *arrays)
            # every detector is armed or within a dead time; rounding drifts off that
            total_probability = armed + laws[2][self.grid.cells - shift :].sum()
            armed, laws = armed / total_probability, [part / total_probability for part in laws]
            change, detected = np.abs(laws[2] - detected).max(), laws[2]
            if change <= SETTLED * detected.max():
                total[:] = laws
                break
            if 2 * sweep >= sweeps:
                total += np.array(laws) / (sweeps - (sweeps + 1) // 2)
        waiting, rejoining, detected = total / (1.0 + whole * total[2].sum())
        return ArmedLaw(waiting, rejoining), detected


def regained(counts: np.ndarray) -> np.ndarray:
    """Return the share re-arming evenly over m counts who are detected before these end, 1 - (1 - e^-m) / m."""
    small = counts < 0.1
    series, safe = np.zeros(counts.shape), np.where(small, 1.0, counts)
    # m / 2 - m^2 / 6 + m^3 / 24 ..: the next term is below a rounding
    for term in range(12, 1, -1):
        series = np.where(small, counts, 0.0) / term * (1.0 - series)
    return np.where(small, series, 1.0 + np.expm1(-safe) / safe)


@compiled
def _period(  # type: ignore[no-untyped-def]
    hit, late, armed, older, newer, shift, apart, alike, waiting, rejoining, detected
):
    """Return one period's laws. `apart`: no detection re-arms within it; `alike`: every armed detector waits."""
    cells, left = len(hit), armed
    for cell in range(cells):
        if cell < shift:
            source = older[cells + cell - shift]
        else:
            source = newer[cell - shift] if apart else detected[cell - shift]
        # of the re-armed detectors only those from earlier periods still wait for their first photon
        joins = source if cell < shift or apart or alike else 0.0
        waiting[cell], rejoining[cell] = left, joins
        detected[cell] = armed * hit[cell] + source * late[cell]
        armed = armed * (1.0 - hit[cell]) + source * (1.0 - late[cell])
        left = left * (1.0 - hit[cell]) + joins * (1.0 - late[cell])
    return waiting, rejoining, detected, armed
