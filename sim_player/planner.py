"""Which effects a scene calls for: bounds of what each could change in the map, and the least that keeps a budget.

The law: |RA(planned) - RA(all)| / max(noise rms, strongest |RA(all)| within one range bin and half a beam) stays under
the budget in every cell, for the same noise. It is kept by construction: from all effects to the planned ones leads a
chain of steps, each of which drops an effect, or only the paths for which it is too weak to matter. What a step changes
is bounded in every cell by magnitudes added up (`sim_player.envelope`) with all others as they then stand, and the sum
of these bounds over a lower bound of the denominator stays under the budget.

A RA cell here is a range bin of a steering angle, as the radar measures it and section 2.1.1 assembles it. Rays are
cheap: all paths are traced to know them. What costs time is their signal, most of all its sweep: squint takes a tone
per instant, overlap a stretch of samples per path. So these two are asked path by path.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass

import msgspec
import numpy as np

from models.physics.waveform import WINDOW_TAPS
from msgs.radar import RadarSetup
from sim_player.echoes import Echoes, as_paths, join_echoes, weights
from sim_player.effect_names import ALL_EFFECTS, PATH_EFFECTS, SIGNAL_EFFECTS, WEIGHT_EFFECTS, bit, check_effects
from sim_player.effects import PATHS
from sim_player.effects.curved_wall import as_chords
from sim_player.effects.signal import absent_signal, receiver_change
from sim_player.effects.tracing import Tracing
from sim_player.envelope import Envelope, sure_floor, swept_pattern
from sim_player.paths import Paths
from sim_player.ray_tracing import trace_echoes
from sim_player.scene import Scene
from sim_player.signal_effects import SignalEffects
from sim_player.signal_levels import RANGE_BINS, kernel_objections, kernel_profiles, noise_density_mw, noise_profiles
from sim_player.world import Snapshot, World, prepare, snapshot

BUDGET_DB = -20.0
#: Noise is taken off what surely stands in a cell at this many rms: it is less once in 10^7 cells.
SIGMAS = 4.0
#: Share of the budget that dropped paths may take, and each of the two dear effects of the sweep in part.
DROPPED_SHARE, SWEPT_SHARE = 0.5, 0.2
#: Rounds of the search for the strongest path that may be dropped.
ROUNDS = 7
#: What a path costs as a signal on one core of the reference machine (docs/effects.md), and what sweep and overlap add.
TONE_S, SQUINT_S, OVERLAP_S = 6e-6, 30e-6, 60e-6
#: Fewer paths than this cost less as profiles, with everything on, than the question what they need.
WORTH_ASKING = 3000
#: Bounds in JSON end here.
MOST_DB = 200.0
#: Effects whose use costs no time: only a thorough plan bounds them, a quick one uses them where the scene has them.
FREE = frozenset(WEIGHT_EFFECTS + SIGNAL_EFFECTS) - {"squint", "chirp_overlap"}


class EffectPlan(msgspec.Struct, frozen=True, kw_only=True):
    """What was decided about one effect, and why."""

    name: str
    used: bool
    #: The most it can change in any cell, relative to noise or what stands there; None: nothing, or not asked.
    bound_db: float | None
    cost_s: float
    reason: str


@dataclass(frozen=True)
class Plan:
    """The effects a scene calls for, with the paths that are left and the part of them that the dear effects touch."""

    budget_db: float
    effects: tuple[EffectPlan, ...]
    view: Snapshot
    echoes: Echoes
    #: Which echoes squint and which overlap, bool [E].
    squints: np.ndarray
    overlaps: np.ndarray
    #: Paths traced before any was dropped.
    traced: int
    #: Bound of the whole difference in any cell, in dB; None: no difference.
    spent_db: float | None
    timing_s: dict[str, float]

    @property
    def used(self) -> frozenset[str]:
        """Names of the effects that are used, wholly or in part."""
        return frozenset(effect.name for effect in self.effects if effect.used)

    @property
    def paths(self) -> Paths:
        """The planned paths, as the radar has them."""
        return as_paths(self.view, self.echoes, self.used)

    @property
    def signal(self) -> SignalEffects:
        """The planned effects of antenna, waveform and receiver."""
        return signal_effects(self.used)

    def groups(self) -> list[tuple[Paths, SignalEffects]]:
        """Paths that share the same effects of the sweep, at least one group."""
        paths, found = self.paths, []
        for squint in (True, False):
            for overlap in (True, False):
                which = (self.squints == squint) & (self.overlaps == overlap)
                flags = msgspec.structs.replace(self.signal, squint=squint, chirp_overlap=overlap)
                if which.any():
                    found.append((paths.take(which), flags))
        return found or [(paths, self.signal)]


def signal_effects(names: frozenset[str]) -> SignalEffects:
    """The switches of the signal for a set of effects; range migration goes with motion."""
    return SignalEffects(**{name: name in names for name in SIGNAL_EFFECTS}, range_migration="motion" in names)


def plan_effects(
    scene: Scene,
    setup: RadarSetup | None = None,
    budget_db: float = BUDGET_DB,
    seed: int = 0,
    time_s: float = 0.0,
    thorough: bool = True,
) -> Plan:
    """Decide which effects a scene needs so that no RA cell is off by more than the budget.

    `seed` draws the scatterers as `prepare` does. A quick plan (not `thorough`) does not bound effects that are free.
    Raises ValueError for a budget that is not negative, or a scene that cannot be simulated.
    """
    setup = scene.setup if setup is None else setup
    return plan_world(prepare(scene, seed, setup), setup, budget_db, time_s, thorough)


def plan_world(
    world: World,
    setup: RadarSetup,
    budget_db: float = BUDGET_DB,
    time_s: float = 0.0,
    thorough: bool = False,
    worth_asking: int = WORTH_ASKING,
) -> Plan:
    """The same for a prepared scene; with fewer paths than `worth_asking` a quick plan takes them all."""
    if not (math.isfinite(budget_db) and budget_db < 0.0):
        raise ValueError(f"budget_db must be finite and negative, got {budget_db!r}")
    planner = _Planner(world, setup, 10.0 ** (budget_db / 20.0), time_s, thorough)
    planner.run(0 if thorough else worth_asking)
    return planner.plan(budget_db)


def chosen(world: World, setup: RadarSetup, names: Iterable[str] = ALL_EFFECTS, time_s: float = 0.0) -> Plan:
    """A plan of effects named by hand, all their paths and nothing bounded; ValueError for an unknown effect.

    Effects that the scene has nothing of stay unused, whatever is asked.
    """
    wanted, view = check_effects(frozenset(names)), snapshot(world, time_s)
    start = time.perf_counter()
    echoes = trace_echoes(view, wanted)
    effects = tuple(_by_hand(name, wanted, world, setup) for name in PATH_EFFECTS + WEIGHT_EFFECTS + SIGNAL_EFFECTS)
    used = frozenset(effect.name for effect in effects if effect.used)
    every = np.ones(len(echoes), bool)
    return Plan(
        budget_db=-math.inf,
        effects=effects,
        view=view,
        echoes=echoes,
        squints=every & ("squint" in used),
        overlaps=every & ("chirp_overlap" in used),
        traced=len(echoes),
        spent_db=None,
        timing_s={"trace": time.perf_counter() - start},
    )


def choose(
    world: World,
    setup: RadarSetup,
    effects: str,
    budget_db: float = BUDGET_DB,
    time_s: float = 0.0,
    worth_asking: int = WORTH_ASKING,
) -> Plan | None:
    """The plan that a word asks for: "auto", "all", names with commas between them; None for "basic".

    Raises ValueError for an unknown effect, or an empty list.
    """
    if effects == "basic":
        return None
    if effects == "auto":
        return plan_world(world, setup, budget_db, time_s, worth_asking=worth_asking)
    if effects == "all":
        return chosen(world, setup, ALL_EFFECTS, time_s)
    names = frozenset(name.strip() for name in effects.split(",")) - {""}
    if not names:
        raise ValueError("effects: want auto, all, basic or names with commas between them, got nothing")
    return chosen(world, setup, names, time_s)


def planned_profiles(
    plan: Plan, setup: RadarSetup, seed: int = 0, noise: bool = True, precision: str = "float32"
) -> np.ndarray:
    """Range profiles of all beams under a plan, kernel level, sqrt(mW); complex [beams, 512].

    Raises ValueError, with the reason, where this level cannot hold the signal (motion, a clipping converter).
    """
    front_end = plan.view.world.scene.radar.front_end
    objections = kernel_objections(setup, plan.paths, plan.signal, front_end)
    if objections:
        raise ValueError(objections[0])
    profiles = clean_profiles(plan, setup, seed, precision)
    return profiles + noise_profiles(setup, seed, plan.signal, front_end) if noise else profiles


def clean_profiles(plan: Plan, setup: RadarSetup, seed: int = 0, precision: str = "float32") -> np.ndarray:
    """The same without noise and without asking whether the level can hold it."""
    front_end = plan.view.world.scene.radar.front_end
    (first, flags), *rest = plan.groups()
    profiles = kernel_profiles(setup, first, flags, front_end, precision=precision, seed=seed)
    for paths, flags in rest:
        # what the electronics add belongs to the whole, once
        alone = msgspec.structs.replace(flags, leakage=False, spurs=False)
        profiles = profiles + kernel_profiles(setup, paths, alone, front_end, precision=precision, seed=seed)
    return profiles


class _Planner:
    """One decision: the state of the chain from all effects down to the planned ones."""

    def __init__(self, world: World, setup: RadarSetup, budget: float, time_s: float, thorough: bool) -> None:
        self.world, self.setup, self.budget, self.thorough = world, setup, budget, thorough
        self.front_end = world.scene.radar.front_end
        self.view = snapshot(world, time_s)
        self.used = set(ALL_EFFECTS)
        self.found: dict[str, EffectPlan] = {}
        self.timing_s: dict[str, float] = {}

    def run(self, worth_asking: int) -> None:
        """All steps in turn."""
        self._timed("trace", self._trace)
        if self.traced < worth_asking:
            self._take_all()
            return
        for name, step in (
            ("floor", self._floor),
            ("paths", self._paths),
            ("prune", self._prune),
            ("sweep", self._sweep),
            ("free", self._free),
        ):
            self._timed(name, step)

    def _timed(self, name: str, step: Callable[[], None]) -> None:
        start = time.perf_counter()
        step()
        self.timing_s[name] = time.perf_counter() - start

    def _take_all(self) -> None:
        """Use everything that the scene has: to ask would cost more."""
        for name in (name for name in ALL_EFFECTS if name not in self.found):
            what = PATHS[name].ABOUT if name in PATHS else _WHAT[name]
            self._found(name, True, None, 0.0, f"not asked, {self.traced} paths cost less than the question: {what}")
        self.spent, self.floor = np.zeros(1), np.ones(1)
        every = np.ones(self.traced, bool)
        self.squints, self.overlaps = every & ("squint" in self.used), every & ("chirp_overlap" in self.used)

    def plan(self, budget_db: float) -> Plan:
        """What was decided, in the order of the effects."""
        spent = float((self.spent / self.floor).max())
        return Plan(
            budget_db=budget_db,
            effects=tuple(self.found[name] for name in PATH_EFFECTS + WEIGHT_EFFECTS + SIGNAL_EFFECTS),
            view=self.view,
            echoes=self.echoes,
            squints=self.squints,
            overlaps=self.overlaps,
            traced=self.traced,
            spent_db=_decibel(spent),
            timing_s=self.timing_s,
        )

    # --- what there is

    def _trace(self) -> None:
        """Every path that any effect makes."""
        tracing = Tracing(self.view, frozenset(self.used))
        for name in PATH_EFFECTS:
            reason = PATHS[name].absent(self.world)
            if reason is None:
                tracing.echoes[name] = PATHS[name].apply(tracing)
            else:
                self._skip(name, None, 0.0, reason)
        if not tracing.echoes:
            tracing.echoes["los_objects"] = PATHS["los_objects"].apply(tracing)
        self.echoes = join_echoes(list(tracing.echoes.values()))
        self.traced = len(self.echoes)
        for name in SIGNAL_EFFECTS:
            reason = absent_signal(name, self.world, self.setup)
            if reason is not None:
                self._skip(name, None, 0.0, reason)

    def _floor(self) -> None:
        """Denominator of the law from what is surely there, and an empty account of what was dropped.

        A thorough plan adds up everything. All paths as in mid-sweep are cheaper: sweep and overlap may then take off
        what they are bounded by.
        """
        flags, paths = self._flags(), self._as_paths()
        self.envelope = Envelope(self.setup, RANGE_BINS, float(paths.length_m.max(initial=1.0)))
        self._look_at(paths)
        density = noise_density_mw(self.setup, np.arange(RANGE_BINS), flags, self.front_end)
        self.noise_rms = np.sqrt(density * np.sum(np.square(WINDOW_TAPS["hann"])))
        steady = flags if self.thorough else msgspec.structs.replace(flags, **_STEADY)
        steady = msgspec.structs.replace(steady, motion=False)
        profiles = kernel_profiles(self.setup, paths, steady, self.front_end, precision="float32")
        every = np.full(len(paths), not self.thorough)
        unknown = self._squint_bound(every) + self._overlap_bound(every)
        self.floor = sure_floor(profiles, unknown, self.noise_rms, SIGMAS)
        self.spent = np.zeros_like(self.floor)
        self.squints = np.full(len(paths), "squint" in self.used)
        self.overlaps = np.full(len(paths), "chirp_overlap" in self.used)

    def _look_at(self, paths: Paths) -> None:
        """Pattern, range step and strength of every echo under the effects still used."""
        self.pattern = swept_pattern(self.setup, paths, self._flags(), self.front_end)
        self.step = self.envelope.step(paths)
        self.amplitude = np.abs(paths.amplitude)
        self.magnitude = self.pattern.magnitudes() * self.amplitude.astype(np.float32)

    # --- the steps of the chain

    def _paths(self) -> None:
        """Effects that make paths, the weakest first."""
        names = [name for name in PATH_EFFECTS if name not in self.found]
        peak = {name: self._strongest(name) for name in names}
        for name in sorted(names, key=peak.__getitem__):
            mine = self._made_by(name)
            count = int(mine.sum())
            reason = f"{count} path{'' if count == 1 else 's'}: {PATHS[name].ABOUT}"
            if not self.thorough and peak[name] > self.budget:
                self._found(name, True, None, count * TONE_S, f"one path alone is over the budget; {reason}")
                continue
            if self._decide(name, self._path_bound(name), count * TONE_S, reason):
                continue
            self._keep(~mine)
            if name == "curved_wall":
                self._put_chords()

    def _strongest(self, name: str) -> float:
        """The largest of an effect's paths in its own cell: no bound can be less."""
        cell = np.minimum(self.step // 2, RANGE_BINS - 1)
        mine = np.flatnonzero(self._made_by(name) & (self.step // 2 < RANGE_BINS))
        own = np.abs(self.pattern.middle[:, mine]) * self.amplitude[mine] / self.floor[:, cell[mine]]
        # half a bin off a Hann window's peak
        return float(0.8 * own.max(initial=0.0))

    def _path_bound(self, name: str) -> np.ndarray:
        """Bound of the paths that would go with an effect, and of those that would come in their place."""
        bound = self._bound(self.amplitude * self._made_by(name))
        if name == "non_cofocal" and self.world.scene.radar.separation_m > 0.0:
            return bound + self._bound(self.amplitude * self._separation())
        if name != "curved_wall":
            return bound
        chords = self._as_paths(as_chords(Tracing(self.view, frozenset(self.used))))
        pattern = swept_pattern(self.setup, chords, self._flags(), self.front_end)
        instead = pattern.magnitudes() * np.abs(chords.amplitude)
        return bound + self.envelope.of_terms(instead, self.envelope.step(chords))

    def _separation(self) -> np.ndarray:
        """How far arrays that stand apart turn and shift each echo, relative to its strength; [E]."""
        together = self.echoes.out_m + self.echoes.back_m
        moved_m = np.abs(self._as_paths().length_m - together)
        turn = np.minimum(2.0 * np.pi * moved_m / self.world.radar.wavelength_m, 2.0)
        # the range kernel's slope stays under two a bin
        return np.asarray(turn + moved_m / self.world.radar.range_bin_m)

    def _prune(self) -> None:
        """Drop the paths that are too weak to matter even together: effects used in part."""
        strength = self.magnitude.sum(axis=0).max(axis=0)
        weak, bound = self._weakest(strength, self._bound_of, self._room(DROPPED_SHARE))
        self.spent = self.spent + bound
        self._keep(~weak)

    def _sweep(self) -> None:
        """Squint and overlap for those paths alone that call for them."""
        for name, mask, bound_of, cost_s in (
            ("chirp_overlap", self.overlaps, self._overlap_bound, OVERLAP_S),
            ("squint", self.squints, self._squint_bound, SQUINT_S),
        ):
            if name in self.found:
                continue
            everything = bound_of(np.ones(len(self.echoes), bool))
            strength = self._sweep_strength(name)
            weak, bound = self._weakest(strength, bound_of, self._room(SWEPT_SHARE))
            self.spent = self.spent + bound
            mask[weak] = False
            left, count = int(mask.sum()), len(mask)
            reason = f"{left} of {count} paths: {_WHAT[name]}"
            ratio = float((everything / self.floor).max())
            self._found(name, bool(left), _decibel(ratio), left * cost_s, reason)

    def _free(self) -> None:
        """Effects that cost nothing: used, or in a thorough plan bounded like the others."""
        names = [name for name in WEIGHT_EFFECTS + SIGNAL_EFFECTS if name in FREE and name not in self.found]
        if not self.thorough:
            for name in names:
                self._found(name, True, None, 0.0, f"costs nothing: {_WHAT[name]}")
            return
        bounds = {name: self._free_bound(name) for name in names}
        for name in sorted(bounds, key=lambda name: float((bounds[name] / self.floor).max())):
            bound = self._free_bound(name)
            if not bound.any():
                self._skip(name, None, 0.0, _NOTHING.get(name, "it changes nothing"))
            elif not self._decide(name, bound, 0.0, _WHAT[name]):
                self._look_at(self._as_paths())

    def _free_bound(self, name: str) -> np.ndarray:
        """Bound of what one effect on weights, antenna or receiver changes, all others as they stand."""
        if name == "motion":
            return np.full_like(self.floor, np.inf)
        if name in WEIGHT_EFFECTS:
            left = frozenset(self.used)
            return self._bound(np.abs(self._weights(left) - self._weights(left - {name})))
        if name in ("element_pattern", "quantised_phases", "mutual_coupling"):
            without = frozenset(self.used) - {name}
            other = swept_pattern(self.setup, self._as_paths(), signal_effects(without), self.front_end)
            return self.envelope.of_terms(self.pattern.change(other) * self.amplitude, self.step)
        return receiver_change(name, self.setup, self.front_end, self.noise_rms, self._bound(self.amplitude))

    # --- bounds

    def _bound_of(self, which: np.ndarray) -> np.ndarray:
        """Bound of some echoes at their full strength."""
        return self._bound(self.amplitude * which)

    def _bound(self, amplitude: np.ndarray) -> np.ndarray:
        """Bound of echoes of given strengths [E] in all cells."""
        which = np.flatnonzero(amplitude)
        scale = (amplitude[which] / np.maximum(self.amplitude[which], 1e-300)).astype(np.float32)
        return self.envelope.of_terms(self.magnitude[:, :, which] * scale, self.step[which])

    def _squint_bound(self, which: np.ndarray) -> np.ndarray:
        """Bound of what squint changes for some paths."""
        if "squint" not in self.used:
            return np.zeros((len(self.setup.beams), RANGE_BINS))
        change = self.pattern.take(which).squint() * self.amplitude[which]
        return self.envelope.of_terms(change, self.step[which])

    def _overlap_bound(self, which: np.ndarray) -> np.ndarray:
        """Bound of what overlapping chirps change for some paths."""
        if "chirp_overlap" not in self.used:
            return np.zeros((len(self.setup.beams), RANGE_BINS))
        return self.envelope.of_overlap(self.magnitude[:, :, which].sum(axis=0), self.step[which])

    def _sweep_strength(self, name: str) -> np.ndarray:
        """How much each path matters to an effect of the sweep, [E]."""
        if name == "squint":
            return (self.pattern.squint() * self.amplitude).sum(axis=0).max(axis=0)
        # the missing rise of the window grows with the cube of the delay
        return self.magnitude.sum(axis=0).max(axis=0) * (1.0 + self.step) ** 3

    def _room(self, share: float) -> np.ndarray:
        """What a step may still change in every cell."""
        return np.minimum(share * self.budget * self.floor, self.budget * self.floor - self.spent)

    def _weakest(
        self, strength: np.ndarray, bound_of: Callable[[np.ndarray], np.ndarray], room: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """As many of the weakest as stay within some room, bool [E], and their bound."""
        order = np.argsort(strength, kind="stable")
        low, high, best = 0, len(order) + 1, np.zeros_like(self.spent)
        for _ in range(ROUNDS):
            middle = (low + high) // 2
            if middle == low:
                break
            bound = bound_of(_first(order, middle))
            if (bound <= room).all():
                low, best = middle, bound
            else:
                high = middle
        return _first(order, low), best

    # --- the state

    def _flags(self) -> SignalEffects:
        return signal_effects(frozenset(self.used))

    def _weights(self, names: frozenset[str]) -> np.ndarray:
        return weights(self.echoes, self.world, names)

    def _as_paths(self, echoes: Echoes | None = None) -> Paths:
        return as_paths(self.view, self.echoes if echoes is None else echoes, frozenset(self.used))

    def _made_by(self, name: str) -> np.ndarray:
        return np.asarray((self.echoes.needs & np.uint32(bit(name))) != 0)

    def _keep(self, which: np.ndarray) -> None:
        """Forget all other echoes."""
        if which.all():
            return
        self.echoes, self.step, self.amplitude = self.echoes.take(which), self.step[which], self.amplitude[which]
        self.pattern, self.magnitude = self.pattern.take(which), self.magnitude[:, :, which]
        self.squints, self.overlaps = self.squints[which], self.overlaps[which]

    def _put_chords(self) -> None:
        """Flat mirrors in place of curved ones."""
        chords = as_chords(Tracing(self.view, frozenset(self.used)))
        self.echoes = join_echoes([self.echoes, chords])
        self._look_at(self._as_paths())
        added = np.ones(len(chords), bool)
        self.squints = np.concatenate([self.squints, added & ("squint" in self.used)])
        self.overlaps = np.concatenate([self.overlaps, added & ("chirp_overlap" in self.used)])

    def _decide(self, name: str, bound: np.ndarray, cost_s: float, what: str) -> bool:
        """Use an effect, or skip it and book its bound; whether it is used."""
        ratio = float((bound / self.floor).max())
        fits = bool((self.spent + bound <= self.budget * self.floor).all())
        if fits:
            self.spent = self.spent + bound
            self._skip(name, _decibel(ratio), cost_s, what)
        else:
            self._found(name, True, _decibel(ratio), cost_s, what)
        return not fits

    def _skip(self, name: str, bound_db: float | None, cost_s: float, reason: str) -> None:
        self.used.discard(name)
        self._found(name, False, bound_db, cost_s, reason)

    def _found(self, name: str, used: bool, bound_db: float | None, cost_s: float, reason: str) -> None:
        if not used:
            self.used.discard(name)
        if bound_db is not None:
            budget_db = 20.0 * math.log10(self.budget)
            side = "over" if bound_db > budget_db else "under" if not used else "within, but not beside others in,"
            reason = f"bound {bound_db:.0f} dB {side} budget {budget_db:g} dB: {reason}"
        self.found[name] = EffectPlan(name=name, used=used, bound_db=bound_db, cost_s=cost_s, reason=reason)


def _by_hand(name: str, wanted: frozenset[str], world: World, setup: RadarSetup) -> EffectPlan:
    """One row of a plan that somebody made by hand."""
    absent = PATHS[name].absent(world) if name in PATH_EFFECTS else None
    if name in SIGNAL_EFFECTS:
        absent = absent_signal(name, world, setup)
    used = name in wanted and absent is None
    reason = "asked for" if used else absent or "not asked for"
    return EffectPlan(name=name, used=used, bound_db=None, cost_s=0.0, reason=reason)


def _first(order: np.ndarray, count: int) -> np.ndarray:
    """Mask of the first so many of an order."""
    mask = np.zeros(len(order), bool)
    mask[order[:count]] = True
    return mask


def _decibel(ratio: float) -> float | None:
    """A field ratio in dB as JSON can say it: None for nothing, at most `MOST_DB`."""
    return min(20.0 * math.log10(ratio), MOST_DB) if ratio > 0.0 else None


#: Switches of a signal without sweep, motion and what the electronics add.
_STEADY = {
    "squint": False,
    "chirp_overlap": False,
    "motion": False,
    "iq_imbalance": False,
    "leakage": False,
    "spurs": False,
}
_NOTHING = {
    "rough_wall_loss": "no path meets a rough wall",
    "slab_resonance": "no path meets a wall whose back is seen",
    "vegetation": "no path crosses foliage",
}
_WHAT = {
    "rough_wall_loss": "mirrors weakened by roughness",
    "slab_resonance": "walls reflect by their whole build, not by their front face alone",
    "vegetation": "paths weakened by foliage",
    "atmosphere": "gases and rain along the paths",
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
