"""The map of everything in every cell, and what it would be without one effect: the bounds that `sim effects` shows.

A scene at rest has known phases, so each change is evaluated (`sim_player.planner.evaluation`), not bounded by adding
up magnitudes; errors of the evaluation are bounded and booked with it.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np

from msgs.values.radar import RadarParams, RadarSetup
from sim_player.effects.table import ALL_EFFECTS, EFFECTS, SIGNAL
from sim_player.paths.conversion import as_paths
from sim_player.paths.ray_tracing import trace_echoes
from sim_player.paths.reach import reachable_snapshot
from sim_player.planner.cells import cells_of
from sim_player.planner.evaluation import NOTHING, SQUINT, WHOLE, HeadChange, error, evaluate
from sim_player.planner.purposes import LEAST, Purpose
from sim_player.planner.sweep_terms import SweepTerms, sweep_terms
from sim_player.scene.world import Snapshot, World
from sim_player.signal.clutter import profile_bound_mw
from sim_player.signal.levels import RANGE_BINS, noise_rms
from sim_player.signal.rain_volume import clutter_at
from sim_player.signal.receiver import iq_factors, leakage_profile, spur_profile
from sim_player.signal.switches import SignalEffects
from sim_player.trace.effect_names import bit
from sim_player.trace.path_table import Paths

#: Noise is taken off what surely stands in a cell at this many rms; it stands against it by more in 8 of 10^9 cells.
SIGMAS = 4.0
#: Noise draws reach this many rms once in 10^13 cells.
FAR_SIGMAS = 5.5
#: What the terms along the sweep of all paths of a range bin may leave out, and what the overlap of the weakest paths
#: may, as shares of the least change that the law allows.
SPARE = 1e-3
#: Range bins to either side that share what the terms of their paths may leave out: those that a window reaches.
NEAR_BINS = 2
#: No path is followed further below the noise than this share of it.
LEAST_TOLERANCE = 1e-7


@dataclass(frozen=True)
class Change:
    """What a step changes: evaluated, complex [B, bins], and a bound of what was not evaluated, [B, bins] or [bins]."""

    values: np.ndarray
    bound: np.ndarray

    def __add__(self, other: Change) -> Change:
        return Change(self.values + other.values, self.bound + other.bound)


def mirrored(echoes: np.ndarray) -> np.ndarray:
    """Bound of what echoes at +f leave at -f by the skirts of the window alone, [B, bins]."""
    return np.asarray(echoes @ _mirror_skirts(echoes.shape[1]))


@lru_cache(maxsize=2)
def _mirror_skirts(count: int) -> np.ndarray:
    """Return what an echo of each bin leaves in each bin at -f at most, float64 [bins, bins]."""
    bins = np.arange(count)
    # an echo at bin b reaches bin i over i + b bins, its skirts fall as 1 / x^3
    away = bins[:, None] + bins[None]
    return np.where(away < 2, 1.0, 1.0 / np.maximum(away, 2.0) ** 3)


def crowd(radar: RadarParams, paths: Paths) -> np.ndarray:
    """Number of paths in each path's range bin and the bins beside it, [P]."""
    cell = (0.5 * paths.length_m / radar.range_bin_m).astype(np.int64)
    return np.convolve(np.bincount(cell, minlength=1), np.ones(2 * NEAR_BINS + 1))[NEAR_BINS:][cell]


def signal_effects(names: frozenset[str]) -> SignalEffects:
    """The switches of the signal for a set of effects; range migration goes with motion."""
    return SignalEffects(**{name: name in names for name in SIGNAL}, range_migration="motion" in names)


def clutter_rms(view: Snapshot, setup: RadarSetup, effects: SignalEffects) -> np.ndarray:
    """Return a bound of the rms of the echoes of rain, snow and fog, sqrt(mW), float64 [B, bins]."""
    front_end = view.world.scene.radar.front_end
    return np.asarray(np.sqrt(profile_bound_mw(setup, clutter_at(view, effects), effects, front_end)))


class EffectAblation:
    """Every effect and every path of one scene at rest, all round: evaluated, with the law's reference in each cell."""

    def __init__(self, world: World, setup: RadarSetup, time_s: float, purpose: Purpose, budget: float) -> None:
        self.world, self.setup = world, setup
        self.radar, self.front_end = setup.radar, world.scene.radar.front_end
        self.view = reachable_snapshot(world, time_s)
        self.echoes = trace_echoes(self.view, ALL_EFFECTS)
        self.shape = (len(setup.beams), RANGE_BINS)
        self.flags = signal_effects(ALL_EFFECTS)
        self.paths = as_paths(self.view, self.echoes, ALL_EFFECTS)
        self.noise_rms = noise_rms(setup, self.flags, self.front_end)
        self._least = max(budget * LEAST[purpose], LEAST_TOLERANCE) * float(self.noise_rms.min())
        self.terms = self.terms_of(self.paths)
        self.evaluated = self.whole(self.terms)
        everything = self.evaluated + self._electronics()
        self._cells = cells_of(setup)
        self._floor = self._cells.floor(everything.values, self.noise_rms, everything.bound, SIGMAS, purpose)

    def ratio(self, change: Change) -> float:
        """A change over what the law's reference is, the largest over all cells."""
        loose = self._cells.bounds(np.broadcast_to(np.asarray(change.bound, np.float32), self.shape))
        gain = max(sum(abs(factor) for factor in iq_factors(self.front_end)), 1.0)
        return gain * float(((np.abs(self._cells.values(change.values)) + loose) / self._floor).max())

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
        if EFFECTS["rain_clutter"].absent(self.world) is not None:
            return np.zeros(self.shape)
        return clutter_rms(self.view, self.setup, self.flags)

    def spurs(self) -> np.ndarray:
        """Sum of the magnitudes of all spurs, float64 [bins]: their phases are drawn."""
        bins = range(RANGE_BINS)
        profiles = [np.abs(spur_profile(self.radar, spur, 0.0, bins)) for spur in self.front_end.spurs]
        return np.asarray(sum(profiles, np.zeros(RANGE_BINS)))

    def unbalanced(self, echoes: Change) -> np.ndarray:
        """Bound of what I/Q imbalance changes, [B, bins]: the gain of all that is there, and its image's skirts."""
        wanted, image = iq_factors(self.front_end)
        there = np.abs(echoes.values) + echoes.bound
        return np.asarray(abs(wanted - 1.0) * (there + FAR_SIGMAS * self.noise_rms) + abs(image) * mirrored(there))

    # --- evaluation

    def terms_of(self, paths: Paths, names: frozenset[str] = ALL_EFFECTS) -> SweepTerms:
        """The terms of some paths under some signal effects."""
        tolerance = SPARE * self._least / crowd(self.radar, paths)
        return sweep_terms(self.setup, paths, signal_effects(names), self.front_end, tolerance)

    def whole(self, terms: SweepTerms, mask: np.ndarray | None = None) -> Change:
        """Evaluate all of some echoes, bool [P]."""
        mask = np.ones(len(terms), bool) if mask is None else mask
        return self._part(terms, np.where(mask, WHOLE, NOTHING)) + self.overlap(terms, mask)

    def _part(self, terms: SweepTerms, part: np.ndarray) -> Change:
        """Evaluate parts of echoes without overlap."""
        return Change(evaluate(self.radar, terms, part, RANGE_BINS), error(self.radar, terms, part, RANGE_BINS))

    def squint(self) -> Change:
        """Evaluate what squint changes."""
        return self._part(self.terms, np.full(len(self.terms), SQUINT))

    def overlap(self, terms: SweepTerms, mask: np.ndarray) -> Change:
        """Evaluate what overlapping chirps change, of some echoes."""
        return Change(*HeadChange(self.radar, terms, RANGE_BINS, SPARE * self._least)(mask))

    def made_by(self, name: str) -> np.ndarray:
        """Return the mask of the echoes that an effect makes, bool [E]."""
        return np.asarray((self.echoes.needs & np.uint32(bit(name))) != 0)
