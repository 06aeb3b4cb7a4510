"""The ablation from all effects to the planned ones: what is left, what was dropped, and bounds of the next step.

Bounds add up magnitudes (`sim_player.planner.bounds`) with everything else as it stands in the ablation, so the sum of
all steps bounds the whole difference, whatever the phases.
"""

from __future__ import annotations

import msgspec
import numpy as np

from msgs.values.radar import RadarSetup
from sim_player.effects.names import bit
from sim_player.effects.table import ALL_EFFECTS, SIGNAL
from sim_player.planner.bounds import STEPS, Envelope, swept_pattern
from sim_player.planner.cells import cells_of
from sim_player.scene.reach import reachable_snapshot
from sim_player.scene.world import World
from sim_player.signal.levels import RANGE_BINS, kernel_profiles, noise_rms
from sim_player.signal.switches import SignalEffects
from sim_player.trace.conversion import as_paths, weights
from sim_player.trace.echoes import Echoes, join_echoes
from sim_player.trace.paths import Paths
from sim_player.trace.ray_tracing import trace_echoes

#: Noise is taken off what surely stands in a cell at this many rms; it stands against it by more in 2 of 10^4 cells.
SIGMAS = 2.5
#: Switches of a signal without sweep, motion and what the electronics add.
STEADY = dict.fromkeys(("squint", "chirp_overlap", "motion", "iq_imbalance", "leakage", "spurs"), False)


def signal_effects(names: frozenset[str]) -> SignalEffects:
    """The switches of the signal for a set of effects; range migration goes with motion."""
    return SignalEffects(**{name: name in names for name in SIGNAL}, range_migration="motion" in names)


class EffectAblation:
    """State of the ablation for one scene at one instant: starts with every effect and every path."""

    def __init__(self, world: World, setup: RadarSetup, time_s: float) -> None:
        self.world, self.setup = world, setup
        self.front_end = world.scene.radar.front_end
        self.view = reachable_snapshot(world, time_s)
        self.used = set(ALL_EFFECTS)
        self.shape = (len(setup.beams), RANGE_BINS)
        #: Bound of everything that was dropped, [beams, bins].
        self.spent = np.zeros(self.shape)
        self.echoes = trace_echoes(self.view, ALL_EFFECTS)
        every = np.ones(len(self.echoes), bool)
        #: Which echoes squint and overlap.
        self.squints, self.overlaps = every.copy(), every.copy()

    def begin(self, exact: bool) -> None:
        """Look at all echoes, and find a lower bound of the law's denominator in every cell.

        `exact` adds up everything with its sweep. Without, all paths are added up as in mid-sweep, which is cheaper:
        sweep and overlap may then take off what they are bounded by.
        """
        paths, flags = self.as_paths(), self.flags()
        self.envelope = Envelope(self.setup, RANGE_BINS, float(paths.length_m.max(initial=1.0)))
        self.look()
        self.noise_rms = noise_rms(self.setup, flags, self.front_end)
        shown = msgspec.structs.replace(flags, **({"motion": False} if exact else STEADY))
        profiles = kernel_profiles(self.setup, paths, shown, self.front_end, precision="float32")
        unknown = np.full(len(paths), not exact)
        left = self.squint_change(unknown) + self.overlap_change(unknown)
        self._cells = cells_of(self.setup)
        self._floor = self._cells.floor(profiles, self.noise_rms, left, SIGMAS)

    def ratio(self, bound: np.ndarray) -> float:
        """A bound [beams, bins] over the denominator, the largest over all cells."""
        return float((self._cells.bounds(bound) / self._floor).max())

    def fits(self, bound: np.ndarray, budget: float, share: float = 1.0) -> bool:
        """Return whether a bound stays under a share of the budget, and with all that was dropped under the budget."""
        alone, together = self._cells.bounds(bound), self._cells.bounds(self.spent + bound)
        return bool((alone <= share * budget * self._floor).all() and (together <= budget * self._floor).all())

    def look(self) -> None:
        """Pattern, range step and strength of every echo under the effects still used."""
        paths = self.as_paths()
        self.pattern = swept_pattern(self.setup, paths, self.flags(), self.front_end)
        self.step = self.envelope.step(paths)
        self.amplitude = np.abs(paths.amplitude)
        self.magnitude = self.pattern.magnitudes() * self.amplitude.astype(np.float32)

    # --- bounds, [beams, bins]

    def bound(self, amplitude: np.ndarray) -> np.ndarray:
        """Bound of echoes of given strengths [E]."""
        changed = np.flatnonzero(amplitude)
        scale = (amplitude[changed] / np.maximum(self.amplitude[changed], 1e-300)).astype(np.float32)
        return self.envelope.of_terms(self.magnitude[:, :, changed] * scale, self.step[changed])

    def bound_of(self, echoes: Echoes) -> np.ndarray:
        """Bound of echoes that are not in the ablation."""
        paths = self.as_paths(echoes)
        pattern = swept_pattern(self.setup, paths, self.flags(), self.front_end)
        return self.envelope.of_terms(pattern.magnitudes() * np.abs(paths.amplitude), self.envelope.step(paths))

    def path_change(self, name: str) -> np.ndarray:
        """Bound of all paths that an effect makes."""
        return self.bound(self.amplitude * self.made_by(name))

    def weight_change(self, name: str) -> np.ndarray:
        """Bound of what an effect on weights changes."""
        used = frozenset(self.used)
        change = weights(self.echoes, self.world, used) - weights(self.echoes, self.world, used - {name})
        return self.bound(np.abs(change))

    def pattern_change(self, name: str) -> np.ndarray:
        """Bound of what an effect on the antenna changes."""
        flags = signal_effects(frozenset(self.used) - {name})
        other = swept_pattern(self.setup, self.as_paths(), flags, self.front_end)
        return self.envelope.of_terms(self.pattern.change(other) * self.amplitude, self.step)

    def squint_change(self, selection: np.ndarray) -> np.ndarray:
        """Bound of what squint changes for some paths, bool [E]."""
        if "squint" not in self.used:
            return np.zeros(self.shape)
        return self.envelope.of_terms(
            self.pattern.take(selection).squint() * self.amplitude[selection], self.step[selection]
        )

    def overlap_change(self, selection: np.ndarray) -> np.ndarray:
        """Bound of what overlapping chirps change for some paths, bool [E]."""
        if "chirp_overlap" not in self.used:
            return np.zeros(self.shape)
        return self.envelope.of_overlap(self.magnitude[:, :, selection].sum(axis=0), self.step[selection])

    def strongest(self, name: str) -> float:
        """The largest ratio of one of an effect's paths in its own cell: no bound of the effect can be less."""
        cell = self.step // STEPS
        mine = np.flatnonzero(self.made_by(name) & (cell < RANGE_BINS))
        own = np.abs(self.pattern.middle[:, mine]) * self.amplitude[mine] / self._floor[: self.shape[0], cell[mine]]
        # a bin off a Hann window's peak at most: half of it
        return float(0.5 * own.max(initial=0.0))

    # --- state

    def flags(self) -> SignalEffects:
        """Switches of the signal as they stand."""
        return signal_effects(frozenset(self.used))

    def as_paths(self, echoes: Echoes | None = None) -> Paths:
        """The echoes (or others) as the radar has them."""
        return as_paths(self.view, self.echoes if echoes is None else echoes, frozenset(self.used))

    def made_by(self, name: str) -> np.ndarray:
        """Return the mask of the echoes that an effect makes, bool [E]."""
        return np.asarray((self.echoes.needs & np.uint32(bit(name))) != 0)

    def keep(self, selection: np.ndarray) -> None:
        """Forget all other echoes."""
        if selection.all():
            return
        self.echoes, self.step, self.amplitude = (
            self.echoes.take(selection),
            self.step[selection],
            self.amplitude[selection],
        )
        self.pattern, self.magnitude = self.pattern.take(selection), self.magnitude[:, :, selection]
        self.squints, self.overlaps = self.squints[selection], self.overlaps[selection]

    def add(self, echoes: Echoes) -> None:
        """Take in echoes that stand in for dropped ones."""
        self.echoes = join_echoes([self.echoes, echoes])
        self.look()
        added = np.ones(len(echoes), bool)
        self.squints = np.concatenate([self.squints, added & ("squint" in self.used)])
        self.overlaps = np.concatenate([self.overlaps, added & ("chirp_overlap" in self.used)])
