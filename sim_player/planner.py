"""Which effects a scene calls for: bounds of what each could change in the map, and the least set that keeps a budget.

The law: |RA(planned) - RA(all)| / max(noise rms, strongest |RA(all)| within one range bin and half a beam) stays under
the budget in every cell, for the same noise. It is kept by construction: going from all effects to the planned ones is
a chain of steps, each drops one effect (or paths that are too weak to matter), the change of each step is bounded from
above in every cell by magnitudes added up, and the sum of these bounds over the denominator stays under the budget.

Paths are traced to know them (rays are cheap); what costs time is to turn them into a signal. A RA cell here is a
range bin of a steering angle, as the radar measures it and section 2.1.1 assembles it.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, field

import msgspec
import numpy as np

from models.physics.waveform import WINDOW_TAPS
from msgs.radar import RadarSetup
from sim_player.echoes import Echoes, as_paths, join_echoes, weights
from sim_player.effect_names import PATH_EFFECTS, SIGNAL_EFFECTS, WEIGHT_EFFECTS, bit, check_effects
from sim_player.effects import PATHS
from sim_player.effects.curved_wall import as_chords
from sim_player.effects.signal import absent_signal, receiver_change
from sim_player.effects.tracing import Tracing
from sim_player.envelope import Envelope, SweptPattern, noise_free_floor, swept_pattern
from sim_player.paths import Paths
from sim_player.ray_tracing import BASIC_EFFECTS, trace_each
from sim_player.scene import Scene
from sim_player.signal_effects import ALL, SignalEffects
from sim_player.signal_levels import RANGE_BINS, kernel_profiles, noise_density_mw
from sim_player.world import Snapshot, World, prepare, snapshot

#: Noise is taken off what surely stands in a cell at this many rms: it is less once in 10^7 cells.
SIGMAS = 4.0
#: Paths are dropped one by one while their bounds add up to this share of the budget.
PRUNED_SHARE = 0.5
#: Wall time on one core of the reference machine (docs/effects.md): tracing a leg, one path of signal per sweep term.
LEG_S, TONE_S = 2e-6, 5e-6
NOTHING_DB = -math.inf


class EffectPlan(msgspec.Struct, frozen=True, kw_only=True):
    """What was decided about one effect, and why."""

    name: str
    used: bool
    #: The most it can change in any cell, relative to noise or what stands there; None: nothing at all.
    bound_db: float | None
    cost_s: float
    reason: str


@dataclass(frozen=True)
class Plan:
    """The effects a scene calls for under a budget, and the paths that are left."""

    budget_db: float
    effects: tuple[EffectPlan, ...]
    #: Echoes that the used effects make and that matter.
    view: Snapshot
    echoes: Echoes
    traced: int
    #: Bound of the whole difference, as a ratio, the largest over the cells.
    spent: float
    timing_s: dict[str, float] = field(default_factory=dict)

    @property
    def used(self) -> frozenset[str]:
        """Names of the effects that are used."""
        return frozenset(effect.name for effect in self.effects if effect.used)

    @property
    def paths(self) -> Paths:
        """The planned paths, as the radar has them."""
        return as_paths(self.view, self.echoes, self.used)

    @property
    def signal(self) -> SignalEffects:
        """The planned effects of array, waveform and receiver."""
        return signal_effects(self.used)


def signal_effects(names: frozenset[str]) -> SignalEffects:
    """The switches of the signal for a set of effects; range migration goes with motion."""
    return SignalEffects(**{name: name in names for name in SIGNAL_EFFECTS}, range_migration="motion" in names)


def plan_effects(
    scene: Scene, setup: RadarSetup | None = None, budget_db: float = -20.0, seed: int = 0, time_s: float = 0.0
) -> Plan:
    """Decide which effects a scene needs so that no RA cell is off by more than the budget; ValueError if not negative.

    `seed` draws the scatterers as `prepare` does.
    """
    setup = scene.setup if setup is None else setup
    return plan_world(prepare(scene, seed, setup), setup, budget_db, time_s)


def plan_world(world: World, setup: RadarSetup, budget_db: float = -20.0, time_s: float = 0.0) -> Plan:
    """The same for a scene that is prepared already."""
    if not (math.isfinite(budget_db) and budget_db < 0.0):
        raise ValueError(f"budget_db must be finite and negative, got {budget_db!r}")
    planner = _Planner(world, setup, 10.0 ** (budget_db / 20.0), time_s)
    planner.run()
    return planner.plan(budget_db)


def planned_as(world: World, setup: RadarSetup, names: frozenset[str], time_s: float = 0.0) -> tuple[Snapshot, Echoes]:
    """Echoes of effects that were chosen by hand, all of their paths; ValueError for an unknown effect."""
    view = snapshot(world, time_s)
    return view, join_echoes(list(trace_each(view, check_effects(names)).values()))


class _Planner:
    """One decision: the state of the chain from all effects down to the planned ones."""

    def __init__(self, world: World, setup: RadarSetup, budget: float, time_s: float) -> None:
        self.world, self.setup, self.budget = world, setup, budget
        self.front_end = world.scene.radar.front_end
        self.view = snapshot(world, time_s)
        self.used = set(PATH_EFFECTS + WEIGHT_EFFECTS + SIGNAL_EFFECTS)
        self.found: dict[str, EffectPlan] = {}
        self.timing_s: dict[str, float] = {}

    def run(self) -> None:
        """All steps in turn."""
        self._timed("trace", self._trace)
        self._timed("floor", self._floor)
        self._timed("weights", self._weights)
        self._timed("paths", self._paths)
        self._timed("prune", self._prune)
        self._timed("signal", self._signal)

    def plan(self, budget_db: float) -> Plan:
        """What was decided, in the order of the effects."""
        order = PATH_EFFECTS + WEIGHT_EFFECTS + SIGNAL_EFFECTS
        return Plan(
            budget_db=budget_db,
            effects=tuple(self.found[name] for name in order),
            view=self.view,
            echoes=self.echoes,
            traced=self.traced,
            spent=float((self.spent / self.floor).max()),
            timing_s=self.timing_s,
        )

    def _timed(self, name: str, step: Callable[[], None]) -> None:
        start = time.perf_counter()
        step()
        self.timing_s[name] = time.perf_counter() - start

    def _trace(self) -> None:
        """Every path that any effect makes."""
        tracing = Tracing(self.view, frozenset(self.used))
        for name in PATH_EFFECTS:
            reason = PATHS[name].absent(self.world)
            if reason is not None:
                self._skip(name, NOTHING_DB, 0.0, reason)
            else:
                tracing.echoes[name] = PATHS[name].apply(tracing)
        if not tracing.echoes:
            tracing.echoes["los_objects"] = PATHS["los_objects"].apply(tracing)
        self.echoes = join_echoes(list(tracing.echoes.values()))
        self.traced = len(self.echoes)

    def _floor(self) -> None:
        """Denominator of the law from what is surely there, and an empty account of what was dropped."""
        everything = frozenset(self.used)
        paths = as_paths(self.view, self.echoes, everything)
        flags = signal_effects(everything)
        self.envelope = Envelope(self.setup, RANGE_BINS, flags, float(paths.length_m.max(initial=1.0)))
        self.step = self.envelope.step(paths)
        self.pattern = swept_pattern(self.setup, paths, flags, self.front_end)
        density = noise_density_mw(self.setup, np.arange(RANGE_BINS), flags, self.front_end)
        self.noise_rms = np.sqrt(density * np.sum(np.square(WINDOW_TAPS["hann"])))
        basic = self._needs_only(BASIC_EFFECTS)
        plain = msgspec.structs.replace(flags, squint=False, chirp_overlap=False, motion=False, iq_imbalance=False)
        profiles = kernel_profiles(self.setup, paths.take(basic), plain, self.front_end, precision="float32")
        self.floor = noise_free_floor(profiles, self._unknown(paths, basic), self.noise_rms, SIGMAS)
        self.spent = np.zeros_like(self.floor)

    def _unknown(self, paths: Paths, basic: np.ndarray) -> np.ndarray:
        """Bound of what the basic profiles leave out: all other paths, squint and overlap of the basic ones."""
        amplitude = np.abs(paths.amplitude)
        rest = self.envelope.of_terms(self._magnitude(amplitude * ~basic), self.step)
        swept = np.abs(self.pattern.terms) * (amplitude * basic)
        swept[0] = np.abs(self.pattern.terms[0] - self.pattern.middle) * (amplitude * basic)
        change = self.envelope.of_terms(swept, self.step, overlaps=False)
        overlap = self.envelope.of_overlap(self._magnitude(amplitude * basic).sum(axis=0), self.step)
        return np.asarray(rest + change + overlap)

    def _weights(self) -> None:
        """Effects that change the weights of the paths that are there."""
        bounds = {}
        for name in WEIGHT_EFFECTS:
            change = np.abs(self._amplitude() - self._amplitude(without=name))
            if not change.any():
                self._skip(name, NOTHING_DB, 0.0, _NO_CHANGE[name])
                continue
            bounds[name] = change
        for name in sorted(bounds, key=lambda name: float(bounds[name].max())):
            # with what was skipped before it off: the next step of the chain
            change = np.abs(self._amplitude() - self._amplitude(without=name))
            self._decide(name, self._bound(change), 0.0, _WEIGHT_REASON[name])

    def _paths(self) -> None:
        """Effects that make paths: the weakest first."""
        bounds = {name: self._path_bound(name) for name in PATH_EFFECTS if name not in self.found}
        for name in sorted(bounds, key=lambda name: float((bounds[name] / self.floor).max())):
            mine = self._made_by(name)
            bound = self._path_bound(name)
            reason = f"{int(mine.sum())} paths: {PATHS[name].ABOUT}"
            if self._decide(name, bound, float(mine.sum()) * TONE_S, reason):
                continue
            self._keep(~mine)
            if name == "curved_wall":
                self._add_chords()

    def _path_bound(self, name: str) -> np.ndarray:
        """Bound of the paths that would go with an effect, and of those that would come in their place."""
        bound = self._bound(np.abs(self._amplitude()) * self._made_by(name))
        if name == "curved_wall":
            chords = self._chords()
            amplitude = np.abs(weights(chords, self.world, frozenset(self.used)))
            paths = as_paths(self.view, chords, frozenset(self.used))
            pattern = swept_pattern(self.setup, paths, signal_effects(frozenset(self.used)), self.front_end)
            bound = bound + self.envelope.of_terms(np.abs(pattern.terms) * amplitude, self.envelope.step(paths))
        return bound

    def _prune(self) -> None:
        """Drop paths that are too weak to matter even together: used in part."""
        amplitude = np.abs(self._amplitude())
        strength = (self._magnitude(amplitude).sum(axis=0)).max(axis=0) / self.noise_rms.min()
        order = np.argsort(strength, kind="stable")
        # a plain sum first: no cell can get more than all of them
        low, high = int(np.searchsorted(np.cumsum(strength[order]), PRUNED_SHARE * self.budget)), len(order)
        limit = PRUNED_SHARE * self.budget * self.floor
        best = np.zeros_like(self.spent)
        while high - low > max(len(order) // 64, 1):
            middle = (low + high) // 2
            weak = np.zeros(len(order), bool)
            weak[order[:middle]] = True
            bound = self._bound(amplitude * weak)
            fits = bool((bound <= limit).all() and (self.spent + bound <= self.budget * self.floor).all())
            low, high = (middle, high) if fits else (low, middle)
        weak = np.zeros(len(order), bool)
        weak[order[:low]] = True
        best = self._bound(amplitude * weak)
        if low and bool((self.spent + best <= self.budget * self.floor).all()):
            self.spent = self.spent + best
            self._keep(~weak)

    def _signal(self) -> None:
        """Effects of antenna, waveform and receiver on the paths that are left."""
        amplitude = np.abs(self._amplitude())
        names = [name for name in SIGNAL_EFFECTS]
        bounds: dict[str, np.ndarray] = {}
        for name in names:
            reason = absent_signal(name, self.world, self.setup)
            if reason is not None:
                self._skip(name, NOTHING_DB, 0.0, reason)
            else:
                bounds[name] = self._signal_bound(name, amplitude)
        for name in sorted(bounds, key=lambda name: float((bounds[name] / self.floor).max())):
            bound = self._signal_bound(name, amplitude)
            terms = {"squint": 6.0, "chirp_overlap": 12.0}.get(name, 0.0)
            self._decide(name, bound, terms * len(self.echoes) * TONE_S, _SIGNAL_REASON[name])
            self.pattern = self._pattern_with(frozenset(self.used))

    def _signal_bound(self, name: str, amplitude: np.ndarray) -> np.ndarray:
        """Bound of what one effect of the signal changes, all others as they stand."""
        if name == "motion":
            return np.full_like(self.floor, np.inf)
        if name == "chirp_overlap":
            return self.envelope.of_overlap(self._magnitude(amplitude).sum(axis=0), self.step)
        if name in ("element_pattern", "quantised_phases", "mutual_coupling", "squint"):
            without = self._pattern_with(frozenset(self.used) - {name})
            change = np.abs(self.pattern.terms - without.terms) * amplitude
            return self.envelope.of_terms(change, self.step)
        everything = self._bound(amplitude)
        return receiver_change(name, self.setup, self.front_end, self.noise_rms, everything)

    def _pattern_with(self, names: frozenset[str]) -> SweptPattern:
        return swept_pattern(self.setup, as_paths(self.view, self.echoes, names), signal_effects(names), self.front_end)

    def _needs_only(self, names: frozenset[str]) -> np.ndarray:
        """Which echoes need no path effect but these."""
        allowed = sum(bit(name) for name in PATH_EFFECTS if name in names)
        return np.asarray((self.echoes.needs & ~np.uint32(allowed)) == 0)

    def _made_by(self, name: str) -> np.ndarray:
        return np.asarray((self.echoes.needs & np.uint32(bit(name))) != 0)

    def _amplitude(self, without: str = "") -> np.ndarray:
        """Weights of all echoes under the effects still used."""
        return weights(self.echoes, self.world, frozenset(self.used) - {without})

    def _magnitude(self, amplitude: np.ndarray) -> np.ndarray:
        """Magnitudes of the sweep's terms, [3, beams, paths]."""
        return np.asarray(np.abs(self.pattern.terms) * amplitude)

    def _bound(self, amplitude: np.ndarray) -> np.ndarray:
        """Bound of echoes of given magnitudes in all cells."""
        which = np.flatnonzero(amplitude)
        return self.envelope.of_terms(np.abs(self.pattern.terms[:, :, which]) * amplitude[which], self.step[which])

    def _keep(self, which: np.ndarray) -> None:
        """Forget all other echoes."""
        self.echoes, self.step = self.echoes.take(which), self.step[which]
        self.pattern = SweptPattern(self.pattern.terms[:, :, which], self.pattern.middle[:, which])

    def _chords(self) -> Echoes:
        """Curved walls as flat ones."""
        return as_chords(Tracing(self.view, frozenset(self.used)))

    def _add_chords(self) -> None:
        """Flat mirrors in place of curved ones."""
        self.echoes = join_echoes([self.echoes, self._chords()])
        paths = as_paths(self.view, self.echoes, frozenset(self.used))
        self.step = self.envelope.step(paths)
        self.pattern = self._pattern_with(frozenset(self.used))

    def _decide(self, name: str, bound: np.ndarray, cost_s: float, what: str) -> bool:
        """Use an effect, or skip it and book its bound; whether it is used."""
        ratio = float((bound / self.floor).max())
        bound_db = 20.0 * math.log10(ratio) if ratio > 0.0 else NOTHING_DB
        budget_db = 20.0 * math.log10(self.budget)
        if bool((self.spent + bound <= self.budget * self.floor).all()):
            self.spent = self.spent + bound
            self._skip(name, bound_db, cost_s, f"bound {bound_db:.0f} dB under budget {budget_db:g} dB: {what}")
            return False
        left = "over" if ratio > self.budget else "within, but with those skipped before it over,"
        reason = f"bound {bound_db:.0f} dB {left} budget {budget_db:g} dB: {what}"
        self.found[name] = EffectPlan(name=name, used=True, bound_db=_finite(bound_db), cost_s=cost_s, reason=reason)
        return True

    def _skip(self, name: str, bound_db: float, cost_s: float, reason: str) -> None:
        self.used.discard(name)
        self.found[name] = EffectPlan(name=name, used=False, bound_db=_finite(bound_db), cost_s=cost_s, reason=reason)


def _finite(bound_db: float) -> float | None:
    """JSON knows no infinity: nothing at all is None; without limit is 200 dB."""
    if bound_db == NOTHING_DB:
        return None
    return min(bound_db, 200.0)


_NO_CHANGE = {
    "rough_wall_loss": "no path meets a rough wall",
    "slab_resonance": "no path meets a wall whose back is seen",
    "vegetation": "no path crosses foliage",
    "atmosphere": "no path, no air",
}
_WEIGHT_REASON = {
    "rough_wall_loss": "mirrors weakened by roughness",
    "slab_resonance": "walls reflect by their whole build, not by their front face alone",
    "vegetation": "paths weakened by foliage",
    "atmosphere": "gases and rain along the paths",
}
_SIGNAL_REASON = {
    "motion": "Doppler, and the scene moves on from beam to beam",
    "element_pattern": "gain falls off the element's axis",
    "quantised_phases": "phase shifters round",
    "mutual_coupling": "columns couple into each other",
    "squint": "the beam turns with the frequency of the sweep",
    "chirp_overlap": "a chirp begins before the last one's echoes are in",
    "thermal_noise": "it is the floor",
    "flicker": "1/f noise of the receiver at short range",
    "leakage": "transmitter straight into the receiver",
    "adc": "rounding of the converter",
    "iq_imbalance": "gain and phase between I and Q",
    "spurs": "tones of the electronics",
}
