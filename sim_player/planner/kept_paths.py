"""What a scene at rest can do without, phases and all: the weakest paths, and the squint and overlap of others.

A guess by power says what may go, from the weakest on, as if phases were random. What it changes is then evaluated
(`sim_player.planner.evaluation`), with a bound of the error; a guess that changes too much is made again with less.
Overlap is short, so what goes of it is bounded by magnitudes.

By Cauchy and Schwarz an azimuth of the map changes by no more than its share of noise times the root of what all beams
change, squared and added up: so much may change, in every range bin,

    budget x (noise rms for `samples`, more for `peaks` and `objects`: `sim_player.planner.purposes`).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from models.compiled import compiled
from msgs.values.radar import RadarSetup
from sim_player.planner.cells import cells_of
from sim_player.planner.evaluation import NOTHING, SQUINT, WHOLE, error, evaluate, head_area, skirts
from sim_player.planner.purposes import LEAST, Purpose
from sim_player.planner.sweep_terms import SweepTerms
from sim_player.scene.front_end import FrontEnd
from sim_player.signal.levels import RANGE_BINS, noise_rms
from sim_player.signal.receiver import iq_factors
from sim_player.signal.switches import SignalEffects

#: Shares of the budget: of what goes by phases, half of it whole paths at most; of overlap; of all weights that go. The
#: errors of an evaluated map, and of beats in single precision, have what is left.
PHASE_SHARE, OVERLAP_SHARE, WEIGHT_SHARE = 0.55, 0.1, 0.05
#: The strongest bin stands so far over the root of the power that is guessed, and so often a guess is made.
PEAK, GUESSES = 1.4, 3
#: Fewer paths that would go, whole or their squint, cost less than to evaluate what they change.
FEWEST = 16
#: What two steps have of each other beyond their sum: a path of another weight squints and overlaps by that weight.
INFLATION = 1.02


@dataclass(frozen=True)
class Choice:
    """Paths that are kept, and those of them that squint and that overlap, bool [P]; the share of the budget spent."""

    kept: np.ndarray
    squints: np.ndarray
    overlaps: np.ndarray
    spent: float


class Limit:
    """The most that may change: a purpose and a budget (a field ratio) for one radar with some effects."""

    def __init__(
        self, setup: RadarSetup, effects: SignalEffects, front_end: FrontEnd, purpose: Purpose, budget: float
    ) -> None:
        gain = INFLATION * max(sum(abs(factor) for factor in iq_factors(front_end)), 1.0)
        #: The root of what all beams may change, squared and added up, in each range bin, sqrt(mW), [bins].
        self.over_beams = budget * LEAST[purpose] / gain * noise_rms(setup, effects, front_end)
        self.map_share = cells_of(setup).map_share
        #: The most that each of the beams may change, whatever the others do, [bins].
        self.each_beam = self.map_share * self.over_beams

    def spent(self, changed: np.ndarray, bound: np.ndarray | float) -> float:
        """Return the share of it that beams [B, bins] take with an error in each of them, [bins]."""
        together = np.sqrt(np.square(changed.real).sum(axis=0) + np.square(changed.imag).sum(axis=0))
        return float((together / self.over_beams + bound / self.each_beam).max())


def choose(setup: RadarSetup, terms: SweepTerms, effects: SignalEffects, limit: Limit) -> Choice:
    """Return what is kept of each path."""
    radar, (whole, squint) = setup.radar, terms.magnitudes
    heads = 2.0 * head_area(terms.head) if effects.chirp_overlap else np.zeros(len(terms))
    cell = np.minimum(terms.tone, RANGE_BINS - 1).astype(np.int64)
    power, turned = np.square(whole).sum(axis=1), np.square(squint).sum(axis=1)
    room = np.square(PHASE_SHARE / PEAK * limit.over_beams)
    least, every = float(limit.over_beams.min()), np.ones(len(terms), bool)
    for _ in range(GUESSES):
        used = np.zeros(RANGE_BINS + 2)
        kept = _over_power(np.argsort(power, kind="stable"), power, cell, 0.5 * room, used)
        squints = np.zeros_like(kept)
        if effects.squint:
            turned_kept = np.where(kept, turned, np.inf)
            squints = kept & _over_power(np.argsort(turned_kept, kind="stable"), turned_kept, cell, room, used)
        part = np.where(kept, np.where(squints | (not effects.squint), NOTHING, SQUINT), WHOLE)
        if np.count_nonzero(part) < FEWEST:
            kept, squints, spent = every, every & effects.squint, 0.0
        else:
            spent = limit.spent(evaluate(radar, terms, part, RANGE_BINS), error(radar, terms, part, RANGE_BINS))
        if spent <= PHASE_SHARE:
            overlaps, more = _overlaps(kept, squints, heads, (whole, squint), OVERLAP_SHARE * least)
            return Choice(kept, squints, overlaps & effects.chirp_overlap, spent + more / least)
        room = room * (0.9 * PHASE_SHARE / spent) ** 2
    return Choice(every, every & effects.squint, every & effects.chirp_overlap, 0.0)


def fits(setup: RadarSetup, terms: SweepTerms, change: np.ndarray, limit: Limit, share: float) -> bool:
    """Return whether all paths may change by a share of their field [P], whatever their phases, within `share`."""
    strength = change * np.sqrt(np.square(terms.magnitudes[0]).sum(axis=1))
    if strength.sum() <= share * limit.over_beams.min():
        return True
    if strength.max() > share * limit.over_beams.max():
        return False
    table = skirts(setup.radar, RANGE_BINS)
    cell = np.minimum(terms.tone.astype(np.int64), len(table) - 1)
    together = np.bincount(cell, strength, len(table)).astype(np.float32) @ table
    return bool((together <= share * limit.over_beams).all())


@compiled
def _over_power(order, power, cell, room, used):  # type: ignore[no-untyped-def]
    """Mask of those for which there is no room, in order, in their range bin and the two beside it, bool [P]; `used`
    is the power in each bin, from the one before the first to the one after the last.
    """
    stays = np.ones(len(power), np.bool_)
    for path in order:
        at = cell[path] + 1
        if used[at - 1] + used[at] + used[at + 1] + power[path] <= room[at - 1]:
            used[at] += power[path]
            stays[path] = False
    return stays


@compiled
def _overlaps(kept, squints, heads, fields, most):  # type: ignore[no-untyped-def]
    """Mask of the paths whose overlap stays, bool [P], and what all others change, added up over the beams."""
    whole, squint = fields
    beams = whole.shape[1]
    total, strength = np.zeros(beams), np.empty(len(kept))
    for path in range(len(kept)):
        # what goes has no start, and one without squint has that of another pattern
        squared = 0.0
        for beam in range(beams):
            squared += whole[path, beam] ** 2
            if not kept[path]:
                total[beam] += heads[path] * whole[path, beam]
            elif not squints[path]:
                total[beam] += heads[path] * squint[path, beam]
        strength[path] = heads[path] * np.sqrt(squared)
    stays, spent = kept.copy(), np.sqrt(np.sum(total * total))
    for path in np.argsort(strength):
        if not kept[path]:
            continue
        if strength[path] > most:
            break
        squared = 0.0
        for beam in range(beams):
            squared += (total[beam] + heads[path] * whole[path, beam]) ** 2
        if squared > most * most:
            break
        stays[path], spent = False, np.sqrt(squared)
        for beam in range(beams):
            total[beam] += heads[path] * whole[path, beam]
    return stays, spent
