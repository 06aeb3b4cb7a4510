"""The ablation from all effects to the planned ones: what stands in every cell, what was dropped, and what the next
step changes.

A scene at rest has known phases, so each step is evaluated (`sim_player.planner.evaluation`), not bounded by adding up
magnitudes; errors of the evaluation are bounded and booked with it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property, lru_cache

import numpy as np

from msgs.values.radar import RadarParams, RadarSetup
from sim_player.effects.names import bit
from sim_player.effects.table import ALL_EFFECTS, SIGNAL
from sim_player.planner.cells import cells_of
from sim_player.planner.evaluation import NOTHING, SQUINT, WHOLE, HeadChange, error, evaluate
from sim_player.planner.purposes import DETECTION, Purpose
from sim_player.planner.selection import ANYTHING, Selection, keep_all, select
from sim_player.planner.sweep_terms import SweepTerms, sweep_terms
from sim_player.scene.reach import reachable_snapshot
from sim_player.scene.world import World
from sim_player.signal.clutter import profile_power_mw
from sim_player.signal.levels import RANGE_BINS, noise_rms
from sim_player.signal.rain_volume import clutter_at
from sim_player.signal.receiver import iq_factors, leakage_profile, spur_profile
from sim_player.signal.switches import SignalEffects
from sim_player.trace.conversion import as_paths
from sim_player.trace.echoes import Echoes
from sim_player.trace.paths import Paths
from sim_player.trace.ray_tracing import trace_echoes

#: Noise is taken off what surely stands in a cell at this many rms; it stands against it by more in 8 of 10^9 cells.
SIGMAS = 4.0
#: Noise draws reach this many rms once in 10^13 cells.
FAR_SIGMAS = 5.5
#: What the terms along the sweep of all paths of a range bin may leave out, and what the overlap of the weakest paths
#: may, as shares of the least change that the law allows: for a map, and where single effects are bounded.
MAP_SPARE, BOUND_SPARE = 0.04, 1e-3
#: Range bins to either side that share what the terms of their paths may leave out: those that a window reaches.
NEAR_BINS = 2
#: No path is followed further below the noise than this share of it.
LEAST_TOLERANCE = 1e-7
#: What two steps have of each other beyond their sum: a path without squint overlaps by another pattern, some percent.
INFLATION = 1.02


@dataclass(frozen=True)
class Change:
    """What a step changes: evaluated, complex [B, bins], and a bound of what was not evaluated, [B, bins] or [bins]."""

    values: np.ndarray
    bound: np.ndarray

    def __add__(self, other: Change) -> Change:
        return Change(self.values + other.values, self.bound + other.bound)


@dataclass(frozen=True)
class Answer:
    """Profiles of everything, I and Q unbalanced, complex64 [B, bins]; bound of their error over the law's reference.

    Without leakage and spurs.
    """

    profiles: np.ndarray
    off: float


def _mirrored(echoes: np.ndarray) -> np.ndarray:
    """Bound of what echoes at +f leave at -f by the skirts of the window alone, [B, bins]."""
    return np.asarray(echoes @ _mirror_skirts(echoes.shape[1]))


@lru_cache(maxsize=2)
def _mirror_skirts(count: int) -> np.ndarray:
    """Return what an echo of each bin leaves in each bin at -f at most, float64 [bins, bins]."""
    bins = np.arange(count)
    # an echo at bin b reaches bin i over i + b bins, its skirts fall as 1 / x^3
    away = bins[:, None] + bins[None]
    return np.where(away < 2, 1.0, 1.0 / np.maximum(away, 2.0) ** 3)


def _crowd(radar: RadarParams, paths: Paths) -> np.ndarray:
    """Number of paths in each path's range bin and the bins beside it, [P]."""
    cell = (0.5 * paths.length_m / radar.range_bin_m).astype(np.int64)
    return np.convolve(np.bincount(cell, minlength=1), np.ones(2 * NEAR_BINS + 1))[NEAR_BINS:][cell]


def signal_effects(names: frozenset[str]) -> SignalEffects:
    """The switches of the signal for a set of effects; range migration goes with motion."""
    return SignalEffects(**{name: name in names for name in SIGNAL}, range_migration="motion" in names)


class EffectAblation:
    """State of the ablation for one scene at rest: starts with every effect and every path."""

    def __init__(
        self,
        world: World,
        setup: RadarSetup,
        time_s: float,
        purpose: Purpose,
        budget: float,
        thorough: bool = False,
    ) -> None:
        """Trace; a thorough one looks all round and leaves out less, so that single effects can be bounded."""
        self.world, self.setup, self.purpose, self.budget = world, setup, purpose, budget
        self._spare = BOUND_SPARE if thorough else MAP_SPARE
        self.radar, self.front_end = setup.radar, world.scene.radar.front_end
        # behind the antenna nothing is seen, unless an element is asked to see all round
        self.view = reachable_snapshot(world, time_s, ahead_only=not (thorough or world.scene.moves))
        self.used = set(ALL_EFFECTS)
        self.echoes = trace_echoes(self.view, ALL_EFFECTS)
        self.shape = (len(setup.beams), RANGE_BINS)
        #: Whether anything was asked; only then is there a `selection` of what is left.
        self.begun = False

    def begin(self) -> None:
        """Evaluate everything, and find a lower bound of the law's reference in every cell."""
        self.begun = True
        self.paths = as_paths(self.view, self.echoes, frozenset(self.used))
        self.noise_rms = noise_rms(self.setup, self.flags(), self.front_end)
        least = self.budget * (1.0 if self.purpose is Purpose.SAMPLES else DETECTION)
        self._least = max(least, LEAST_TOLERANCE) * float(self.noise_rms.min())
        self.terms = self.terms_of(self.paths)
        self.selection = keep_all(self.terms, RANGE_BINS)
        self._head_change = self._heads(self.terms)
        every = np.ones(len(self.terms), bool)
        self.evaluated = Change(*self._change_of(np.full(len(self.terms), WHOLE), every))
        everything = self.evaluated + self._electronics()
        self._cells = cells_of(self.setup)
        floor = self._cells.floor(everything.values, self.noise_rms, everything.bound, SIGMAS, self.purpose)
        asked = self._cells.asked(self.setup, self.purpose, self.paths, self.noise_rms)
        allowed = self.budget * (floor if asked is None else np.where(asked, floor, np.inf))
        self._allowed = np.minimum(allowed, ANYTHING).astype(np.float32)
        self._inverse = INFLATION * self._gain() / self._allowed
        self.spent = Change(np.zeros(self.shape, np.complex64), np.zeros(RANGE_BINS))

    def select(self, share: float) -> Selection:
        """Drop the paths, and the squint and overlap of paths, that a share of the budget can do without."""
        limit = share * self._cells.nearest(self._allowed)
        ratio = lambda change, loose: self._ratios(Change(change, loose)).max(axis=0) / share  # noqa: E731
        self.selection = select(self.radar, self.terms, self._change_of, limit, ratio)
        self.spent = Change(self.selection.change, self.selection.error)
        return self.selection

    def settle(self) -> None:
        """Go on with the paths that are left, as they are left."""
        selection, kept = self.selection, ~self.selection.dropped
        self.echoes, self.paths = self.echoes.take(kept), self.paths.take(kept)
        self.terms = self.terms.take(kept).unsquinted(~selection.squints[kept])
        self.selection = replace(
            selection, dropped=~kept[kept], squints=selection.squints[kept], overlaps=selection.overlaps[kept]
        )

    def refresh(self) -> None:
        """Look at the echoes under the effects that are still used."""
        self.paths = as_paths(self.view, self.echoes, frozenset(self.used))
        self.terms = self.terms_of(self.paths).unsquinted(~self.selection.squints)

    def ratio(self, change: Change) -> float:
        """A change over what the law's reference is, the largest over all cells; for `spent`, what has been spent."""
        return self.budget * float(self._ratios(change).max())

    def answer(self) -> Answer | None:
        """Return the evaluated profiles of everything, where their own error stays under the budget."""
        wanted, image = iq_factors(self.front_end)
        bound = np.broadcast_to(self.evaluated.bound, self.shape)
        if image != 0.0:
            bound = bound + abs(image) * _mirrored(np.abs(self.evaluated.values) + bound)
        worst = float((self._cells.bounds(bound.astype(np.float32)) * self._inverse).max())
        if worst > 1.0:
            return None
        factor = np.complex64(wanted if self.setup.beat_sign > 0 else np.conj(wanted))
        return Answer(self.evaluated.values * factor, self.budget * worst)

    def fits(self, change: Change) -> bool:
        """Return whether a change stays under the budget together with all that was dropped."""
        return bool((self._ratios(self.spent + change) <= 1.0).all())

    def _ratios(self, change: Change) -> np.ndarray:
        """A change over what is allowed, [rows, bins]."""
        loose = self._cells.bounds(np.broadcast_to(np.asarray(change.bound, np.float32), self.shape))
        return np.asarray((np.abs(self._cells.values(change.values)) + loose) * self._inverse)

    def _gain(self) -> float:
        """Return what unbalanced I and Q make of a change at most."""
        return max(sum(abs(factor) for factor in iq_factors(self.front_end)), 1.0)

    def _electronics(self) -> Change:
        """What leakage adds, and what drops, spurs of unknown phase and unbalanced I and Q may take off."""
        bound = self.spurs() + SIGMAS * self.clutter_rms
        if iq_factors(self.front_end)[1] != 0.0:
            bound = bound + self.unbalanced(self.evaluated)
        return Change(np.broadcast_to(self.leakage(), self.shape), bound)

    def leakage(self) -> np.ndarray:
        """Profile of the leakage, complex64 [bins]."""
        power_dbm = self.front_end.leakage_dbm
        if power_dbm is None:
            return np.zeros(RANGE_BINS, np.complex64)
        return leakage_profile(self.radar, power_dbm, self.front_end.leakage_range_m, range(RANGE_BINS)).astype(
            np.complex64
        )

    @cached_property
    def clutter_rms(self) -> np.ndarray:
        """Rms of the echoes of rain, snow and fog, sqrt(mW), float64 [B, bins]."""
        if "rain_clutter" not in self.used:
            return np.zeros(self.shape)
        clutter = clutter_at(self.view, self.flags())
        return np.sqrt(profile_power_mw(self.setup, clutter, self.flags(), self.front_end))

    def spurs(self) -> np.ndarray:
        """Sum of the magnitudes of all spurs, float64 [bins]: their phases are drawn."""
        bins = range(RANGE_BINS)
        profiles = [np.abs(spur_profile(self.radar, spur, 0.0, bins)) for spur in self.front_end.spurs]
        return np.asarray(sum(profiles, np.zeros(RANGE_BINS)))

    def unbalanced(self, echoes: Change) -> np.ndarray:
        """Bound of what I/Q imbalance changes, [B, bins]: the gain of all that is there, and its image's skirts."""
        wanted, image = iq_factors(self.front_end)
        there = np.abs(echoes.values) + echoes.bound
        return np.asarray(abs(wanted - 1.0) * (there + FAR_SIGMAS * self.noise_rms) + abs(image) * _mirrored(there))

    # --- evaluation

    def terms_of(self, paths: Paths, names: frozenset[str] | None = None) -> SweepTerms:
        """The terms of some paths under some signal effects, or those still used."""
        effects = self.flags() if names is None else signal_effects(names)
        tolerance = self._spare * self._least / _crowd(self.radar, paths)
        return sweep_terms(self.setup, paths, effects, self.front_end, tolerance)

    def whole(self, terms: SweepTerms, mask: np.ndarray | None = None, overlaps: np.ndarray | None = None) -> Change:
        """Evaluate all of some echoes, bool [P]; of some of them with overlap."""
        mask = np.ones(len(terms), bool) if mask is None else mask
        return self.part(terms, np.where(mask, WHOLE, NOTHING)) + self.head(
            terms, mask if overlaps is None else mask & overlaps
        )

    def part(self, terms: SweepTerms, part: np.ndarray) -> Change:
        """Evaluate parts of echoes without overlap."""
        return Change(evaluate(self.radar, terms, part, RANGE_BINS), error(self.radar, terms, part, RANGE_BINS))

    def _change_of(self, part: np.ndarray, overlaps: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Evaluate parts of the echoes and the overlap of some, complex64 [B, bins]; a bound of the error [bins]."""
        change = self.part(self.terms, part) + Change(*self._head_change(overlaps))
        return change.values, change.bound

    def squint(self) -> Change:
        """Evaluate what squint changes."""
        return self.part(self.terms, np.full(len(self.terms), SQUINT))

    def head(self, terms: SweepTerms, mask: np.ndarray) -> Change:
        """Evaluate what overlapping chirps change, of some echoes."""
        return Change(*self._heads(terms)(mask))

    def _heads(self, terms: SweepTerms) -> HeadChange:
        return HeadChange(self.radar, terms, RANGE_BINS, self._spare * self._least)

    # --- state

    def flags(self) -> SignalEffects:
        """Switches of the signal as they stand."""
        return signal_effects(frozenset(self.used))

    def made_by(self, name: str, echoes: Echoes | None = None) -> np.ndarray:
        """Return the mask of the echoes that an effect makes, bool [E]."""
        needs = (self.echoes if echoes is None else echoes).needs
        return np.asarray((needs & np.uint32(bit(name))) != 0)
