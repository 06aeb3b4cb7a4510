"""Plan of the effects that a scene needs: the least that keeps the law of a purpose within a budget.

The law (`sim_player.planner.purposes`): |RA(planned) - RA(all)| <= budget x reference in every cell of beams and map,
for the same noise. Questions go from cheap to dear, and asking ends with the first answer:

1. what the scene has nothing of is absent, whatever its strength;
2. all other paths are traced: hardly an effect stays under the law in whole, and what costs most is the signal;
3. the weakest paths go, the squint and the overlap of others, and weights that change too little
   (`sim_player.planner.kept_paths`); an effect whose paths all go is skipped;
4. where the map is all that is wanted, what is left is evaluated with a bound of its error
   (`sim_player.planner.answer`), which is the map.

Every caller asks the same questions, so what `sim effects` shows is what runs; a thorough plan only adds what each
effect alone would change (`sim_player.planner.changes`). In a scene that moves each beam leaves out its weakest paths,
and the overlap of others (`sim_player.planner.weakest`); effects are left out only that it has nothing of.
"""

from __future__ import annotations

import itertools
import math
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import cached_property

import msgspec
import numpy as np

from msgs.values.radar import RadarSetup
from msgs.values.wording import counted
from sim_player.effects.table import ALL_EFFECTS, EFFECTS, PATHS, WEIGHTS, check_effects, named_effects
from sim_player.paths.conversion import as_paths, weights
from sim_player.paths.ray_tracing import trace_echoes
from sim_player.paths.reach import reachable_snapshot
from sim_player.paths.truth import may_be_seen
from sim_player.planner.ablation import FAR_SIGMAS, EffectAblation, clutter_rms, crowd, signal_effects
from sim_player.planner.answer import Law, evaluated
from sim_player.planner.changes import change_of
from sim_player.planner.kept_paths import WEIGHT_SHARE, Choice, Limit, choose, fits
from sim_player.planner.purposes import Purpose
from sim_player.planner.sweep_terms import sweep_terms
from sim_player.planner.weakest import Weakest
from sim_player.scene.world import Snapshot, World
from sim_player.signal.clutter import clutter_profiles, profile_power_mw
from sim_player.signal.levels import group_beats, kernel_profiles, noise_profiles
from sim_player.signal.rain_volume import clutter_at
from sim_player.signal.receiver import dither_objection
from sim_player.signal.switches import SignalEffects
from sim_player.trace.echoes import Echoes
from sim_player.trace.effect_names import bit
from sim_player.trace.path_table import Paths

BUDGET_DB = -20.0
#: So many paths that lack squint or overlap have a signal of their own.
FEWEST = 64
#: Effects along the sweep: each path costs.
SWEPT = "squint", "chirp_overlap"
#: Share of the budget that echoes of rain, snow and fog may take if they go.
RAIN_SHARE = 0.05
#: Share that the terms along the sweep of all paths of a range bin may leave out.
TERMS_SHARE = 0.1
#: What beats in single precision miss in a range bin, of the sum of their echoes at the array's peak; measured: 7e-7.
SINGLE = 1.5e-6
#: Why nothing is left out that a scene has.
MOVES = "kept, the scene moves"
WEAKEST = "kept, the scene moves; each beam leaves out its weakest paths"
ROUNDS = "kept, rounding is no noise here and nothing bounds it"
#: Bounds in JSON end here.
MAX_DB = 200.0


class EffectPlan(msgspec.Struct, frozen=True, kw_only=True):
    """Decision on one effect, with its reason."""

    name: str
    used: bool
    #: The most it can change in any cell, relative to noise or what stands there; None: nothing, or not asked.
    bound_db: float | None
    #: What it costs a signal as planned.
    cost_s: float
    reason: str


@dataclass(frozen=True)
class Plan:
    """The effects a scene calls for, with the paths that are left and the part of them that the dear effects touch."""

    purpose: Purpose
    budget_db: float
    effects: tuple[EffectPlan, ...]
    view: Snapshot
    setup: RadarSetup
    echoes: Echoes
    #: The same with those that truth is made of, whatever their size.
    labels: Echoes
    #: Which echoes squint and which overlap, bool [E].
    squints: np.ndarray
    overlaps: np.ndarray
    #: Which of them keep the law in single precision where their beats are made, bool [E].
    single: np.ndarray
    #: Paths traced before any was dropped.
    traced: int
    #: Bound of the whole difference in any cell, in dB; None: no difference.
    spent_db: float | None
    #: Processor times of the questions.
    timing_s: dict[str, float]
    #: What is left out of the costs of the effects.
    saved_s: float
    #: Names of the effects under which labels are made: of all that the scene has.
    present: frozenset[str]
    #: The answer at the kernel level, found on the way to the plan: profiles of its echoes with all effects but leakage
    #: and spurs; None where nothing was evaluated or the error is over the budget; complex64 [beams, bins].
    evaluated: np.ndarray | None = None
    #: What chooses the paths of each beam of a scene that moves; None: all of them.
    weakest: Weakest | None = None

    @cached_property
    def used(self) -> frozenset[str]:
        """Names of the effects that are used, wholly or in part."""
        return frozenset(effect.name for effect in self.effects if effect.used)

    @cached_property
    def paths(self) -> Paths:
        """The planned paths, as the radar has them."""
        return as_paths(self.view, self.echoes, self.used)

    @cached_property
    def labelled(self) -> Paths:
        """The paths that labels are made of, with all effects that the scene has on them: as without a plan."""
        return as_paths(self.view, self.labels, self.present)

    @cached_property
    def signal(self) -> SignalEffects:
        """The planned effects of antenna, waveform and receiver."""
        return signal_effects(self.used)

    def share_of(self, effect: EffectPlan) -> float:
        """Return what an effect costs of what all cost together, in percent; 0 where nothing costs anything."""
        whole_s = self.saved_s + sum(other.cost_s for other in self.effects)
        return 100.0 * effect.cost_s / whole_s if whole_s else 0.0

    def beats(self) -> np.ndarray:
        """Return the echoes of one chirp of each beam of a scene at rest, in sqrt(mW); complex [beams, samples]."""
        front_end = self.view.world.scene.radar.front_end
        made = [
            group_beats(self.setup, self.groups(mask), front_end, precision=precision)
            for mask, precision in ((self.single, "float32"), (~self.single, "float64"))
            if mask.any() or not len(mask)
        ]
        return made[0] if len(made) == 1 else made[0] + made[1]

    def groups(self, among: np.ndarray | bool = True) -> list[tuple[Paths, SignalEffects]]:
        """Paths (of a mask, bool [E]) that share the same effects of the sweep, up to four groups; a few go with those
        that have them all.
        """
        whole = self.signal.squint, self.signal.chirp_overlap
        kinds: dict[tuple[bool, bool], np.ndarray] = {}
        for squints, overlaps in itertools.product((False, True), repeat=2):
            mask = (self.squints == squints) & (self.overlaps == overlaps) & among
            kind = (squints, overlaps) if mask.sum() >= FEWEST else whole
            kinds[kind] = kinds.get(kind, np.zeros_like(mask)) | mask
        return [
            (
                self.paths if mask.all() else self.paths.take(mask),
                msgspec.structs.replace(self.signal, squint=squints, chirp_overlap=overlaps),
            )
            for (squints, overlaps), mask in kinds.items()
            if mask.any() or len(kinds) == 1
        ]


def plan_world(
    world: World,
    setup: RadarSetup,
    budget_db: float = BUDGET_DB,
    time_s: float = 0.0,
    thorough: bool = False,
    purpose: Purpose = Purpose.SAMPLES,
    profiles_only: bool = False,
) -> Plan:
    """Return the plan of a prepared scene for a purpose; a thorough one asks what each effect alone would change.

    Where only profiles are wanted, no beats, they are evaluated on the way. Raises ValueError for a budget that is not
    negative.
    """
    if not (math.isfinite(budget_db) and budget_db < 0.0):
        raise ValueError(f"budget_db must be finite and negative, got {budget_db!r}")
    planner = _Planner(world, setup, time_s, purpose, budget_db, profiles_only)
    planner.run()
    if thorough:
        planner.bound_each()
    return planner.plan()


def manual_plan(world: World, setup: RadarSetup, names: Iterable[str] = ALL_EFFECTS, time_s: float = 0.0) -> Plan:
    """A plan of effects named by hand, all their paths and nothing bounded; ValueError for an unknown effect.

    Effects that the scene has nothing of stay unused, whatever is asked.
    """
    wanted, view = check_effects(frozenset(names)), reachable_snapshot(world, time_s)
    start = time.process_time()
    echoes = trace_echoes(view, wanted)
    effects = tuple(_by_hand(name, wanted, world) for name in EFFECTS)
    used = frozenset(effect.name for effect in effects if effect.used)
    every = np.ones(len(echoes), bool)
    return Plan(
        purpose=Purpose.SAMPLES,
        budget_db=-math.inf,
        effects=effects,
        view=view,
        setup=setup,
        echoes=echoes,
        labels=echoes,
        squints=every & ("squint" in used),
        overlaps=every & ("chirp_overlap" in used),
        single=~every,
        traced=len(echoes),
        spent_db=None,
        saved_s=0.0,
        present=used,
        timing_s={"trace": time.process_time() - start},
    )


def resolve_plan(
    world: World,
    setup: RadarSetup,
    effects: str,
    budget_db: float = BUDGET_DB,
    purpose: Purpose = Purpose.SAMPLES,
) -> Plan | None:
    """The plan that a word asks for: "auto", "all", names with commas between them; None for "basic".

    Raises ValueError for an unknown effect, or an empty list.
    """
    if effects == "basic":
        return None
    if effects == "auto":
        return plan_world(world, setup, budget_db, purpose=purpose)
    return manual_plan(world, setup, named_effects(effects))


def noisy_profiles(plan: Plan, setup: RadarSetup, seed: int = 0, precision: str = "float32") -> np.ndarray:
    """Return the profiles of a plan with noise, without asking whether the level can hold it."""
    noise = noise_profiles(setup, seed, plan.signal, plan.view.world.scene.radar.front_end)
    return clean_profiles(plan, setup, seed, precision) + noise


def clean_profiles(plan: Plan, setup: RadarSetup, seed: int = 0, precision: str = "float32") -> np.ndarray:
    """Return the same without the noise: in single precision what the plan has evaluated, wherever it has."""
    front_end = plan.view.world.scene.radar.front_end
    if plan.evaluated is None or precision != "float32":
        # one sweep for all paths costs less than one for each group
        echoes = kernel_profiles(setup, plan.paths, plan.signal, front_end, precision=precision, seed=seed)
        return echoes + _of_the_air(plan, setup, seed).astype(echoes.dtype)
    echoes = plan.evaluated + _of_the_air(plan, setup, seed).astype(plan.evaluated.dtype)
    faults = (plan.signal.leakage and front_end.leakage_dbm is not None) or (plan.signal.spurs and front_end.spurs)
    if not faults:
        return echoes
    nothing = plan.paths.take(np.zeros(0, int))
    return echoes + kernel_profiles(setup, nothing, plan.signal, front_end, precision=precision, seed=seed)


def planned_profiles(plan: Plan, setup: RadarSetup, seed: int = 0) -> np.ndarray:
    """Return the profiles of the paths that are left, with what is left of their sweep: as the beats have them."""
    front_end = plan.view.world.scene.radar.front_end
    (first, flags), *rest = plan.groups()
    profiles = kernel_profiles(setup, first, flags, front_end, precision="float32", seed=seed)
    for paths, flags in rest:
        # what the electronics add belongs to the whole, once
        alone = msgspec.structs.replace(flags, leakage=False, spurs=False)
        profiles = profiles + kernel_profiles(setup, paths, alone, front_end, precision="float32", seed=seed)
    return profiles + _of_the_air(plan, setup, seed).astype(profiles.dtype)


def air_power_mw(plan: Plan, setup: RadarSetup) -> np.ndarray | None:
    """Return the mean power of the echoes of rain, snow and fog, mW, [beams, bins]; None where the plan has none."""
    if not plan.signal.rain_clutter:
        return None
    clutter = clutter_at(plan.view, plan.signal)
    return profile_power_mw(setup, clutter, plan.signal, plan.view.world.scene.radar.front_end)


def _of_the_air(plan: Plan, setup: RadarSetup, seed: int) -> np.ndarray:
    """Return the drawn echoes of rain, snow and fog, complex [beams, bins]; one zero where the plan has none."""
    if not plan.signal.rain_clutter:
        return np.zeros(1)
    clutter = clutter_at(plan.view, plan.signal)
    return clutter_profiles(setup, clutter, plan.signal, plan.view.world.scene.radar.front_end, seed)


class _Planner:
    """Asks the questions in turn, books each answer, and states why."""

    def __init__(
        self, world: World, setup: RadarSetup, time_s: float, purpose: Purpose, budget_db: float, profiles_only: bool
    ) -> None:
        self.world, self.setup, self.time_s, self.purpose, self.budget_db = world, setup, time_s, purpose, budget_db
        self.budget, self.profiles_only = 10.0 ** (budget_db / 20.0), profiles_only
        self.front_end = world.scene.radar.front_end
        self.found: dict[str, EffectPlan] = {}
        self.timing_s: dict[str, float] = {}
        self.profiles: np.ndarray | None = None
        self.limit: Limit | None = None
        self.spent = self.saved_s = 0.0

    def run(self) -> None:
        """All questions."""
        world = self.world
        for name, effect in EFFECTS.items():
            if (reason := effect.absent(world)) is not None:
                self._row(name, False, reason)
        self.present = frozenset(EFFECTS).difference(self.found)
        self.flags = signal_effects(self.present)
        self._timed("trace", self._trace)
        every = np.ones(len(self.echoes), bool)
        self.choice = Choice(every, every & self.flags.squint, every & self.flags.chirp_overlap, 0.0)
        self.truth, self.single = every, ~every
        if dither_objection(self.setup, self.front_end, thermal=True) is not None:
            self._take_all(MOVES if world.scene.moves else ROUNDS)
            return
        self.limit = Limit(self.setup, self.flags, self.front_end, self.purpose, self.budget)
        if world.scene.moves:
            self.spent = 1.0
            self._take_all(WEAKEST)
            return
        self._timed("choose", self._choose)
        if self.profiles_only:
            self._timed("evaluate", self._evaluate)
        else:
            self._round_beats()

    def bound_each(self) -> None:
        """Add what each effect alone would change of everything at most; where the scene moves nothing bounds it."""
        if self.world.scene.moves or self.limit is None:
            return
        ablation = EffectAblation(self.world, self.setup, self.time_s, self.purpose, self.budget)
        for name in self.present:
            bound_db = _decibel(ablation.ratio(change_of(ablation, name)))
            self.found[name] = msgspec.structs.replace(self.found[name], bound_db=bound_db)

    def plan(self) -> Plan:
        """Return the decisions, in the order of the effects."""
        kept, truth = self.choice.kept, self.choice.kept | self.truth
        selects = self.world.scene.moves and self.limit is not None
        return Plan(
            purpose=self.purpose,
            budget_db=self.budget_db,
            effects=tuple(self.found[name] for name in EFFECTS),
            view=self.view,
            setup=self.setup,
            echoes=self.echoes if kept.all() else self.echoes.take(kept),
            labels=self.echoes if truth.all() else self.echoes.take(truth),
            squints=self.choice.squints[kept],
            overlaps=self.choice.overlaps[kept],
            single=self.single[kept],
            traced=len(kept),
            spent_db=_decibel(self.budget * self.spent),
            timing_s=self.timing_s,
            saved_s=self.saved_s,
            present=self.present,
            evaluated=self.profiles,
            weakest=Weakest(self.setup, self.flags, self.front_end, self.purpose, self.budget) if selects else None,
        )

    def _timed(self, name: str, step: Callable[[], None]) -> None:
        start = time.process_time()
        step()
        self.timing_s[name] = time.process_time() - start

    def _trace(self) -> None:
        """Trace what the scene has; behind the antenna, where its elements are blind, nothing that is at rest."""
        self.view = reachable_snapshot(self.world, self.time_s, ahead_only=not self.world.scene.moves)
        self.echoes = trace_echoes(self.view, self.present)

    def _choose(self) -> None:
        """Leave out by magnitudes; the effects that are left with nothing are skipped."""
        assert self.limit is not None
        self.paths = paths = as_paths(self.view, self.echoes, self.present)
        tolerance = TERMS_SHARE * float(self.limit.each_beam.min()) / crowd(self.setup.radar, paths)
        self.terms = sweep_terms(self.setup, paths, self.flags, self.front_end, tolerance)
        self.truth = may_be_seen(self.setup, paths, self.terms.full)
        self.choice = choice = choose(self.setup, self.terms, self.flags, self.limit)
        self.spent = choice.spent
        for name in [name for name in EFFECTS if name not in self.found]:
            if name in PATHS:
                self._row_of_paths(name)
            elif name in SWEPT:
                mask = choice.squints if name == "squint" else choice.overlaps
                left = int(mask.sum())
                text = f"{left} of {counted(int(choice.kept.sum()), 'path')} left: {EFFECTS[name].about}"
                self._row(name, bool(left), text, left, len(paths))
            elif name == "rain_clutter":
                self._row_of_rain()
            elif name in WEIGHTS:
                self._row_of_weights(name, paths)
            else:
                self._row(name, True, f"costs nothing: {EFFECTS[name].about}")

    def _row_of_paths(self, name: str) -> None:
        mine = (self.echoes.needs & np.uint32(bit(name))) != 0
        count, left = int(mine.sum()), int((mine & self.choice.kept).sum())
        # a path costs once: it is booked to the last effect that it needs
        own = mine & (self.echoes.needs < np.uint32(2 * bit(name)))
        # arrays that stand apart move every echo, not those alone that this effect makes
        apart = name == "non_cofocal" and self.world.scene.radar.separation_m > 0.0
        text = f"{left} of {counted(count, 'path')}: {PATHS[name].about}"
        self._row(name, apart or bool(left), text, int((own & self.choice.kept).sum()), int(own.sum()))

    def _row_of_rain(self) -> None:
        """Skip echoes of the air whose draws stay under a share of the budget."""
        assert self.limit is not None
        most = FAR_SIGMAS * clutter_rms(self.view, self.setup, self.flags) / self.limit.each_beam
        fits = float(most.max()) <= RAIN_SHARE
        self.spent += RAIN_SHARE if fits else 0.0
        text = f"draws reach {float(most.max()):.2g} of what may change: {EFFECTS['rain_clutter'].about}"
        self._row("rain_clutter", not fits, text, of=1)

    def _row_of_weights(self, name: str, paths: Paths) -> None:
        """Skip a weight that changes too little, whatever phases are."""
        assert self.limit is not None
        parts = sum(weight in self.present for weight in WEIGHTS)
        without = weights(self.echoes, self.world, self.present - {name})
        change = np.abs(paths.amplitude - without) / np.maximum(np.abs(paths.amplitude), 1e-300) * self.choice.kept
        fit = fits(self.setup, self.terms, change, self.limit, WEIGHT_SHARE / parts)
        changes = change > 0.0
        self.spent += WEIGHT_SHARE / parts if fit and changes.any() else 0.0
        most_db = 20.0 * math.log10(1.0 + float(change.max(initial=0.0)))
        text = f"changes {counted(int(changes.sum()), 'path')} by {most_db:.2g} dB at most: {EFFECTS[name].about}"
        self._row(name, not fit, text)

    def _evaluate(self) -> None:
        """Make the map of what is left; weights that go are in it, for their terms are there."""
        assert self.limit is not None
        law = Law(self.purpose, self.budget, self.limit.each_beam, 1.0 - self.spent)
        flags = signal_effects(self.used)
        answer = evaluated(self.setup, self.terms, self.choice, flags, self.front_end, law)
        if answer is not None:
            self.profiles, self.spent = answer.profiles, self.spent + answer.spent

    def _round_beats(self) -> None:
        """Have the beats of all but the strongest paths in single precision, as far as the budget goes."""
        assert self.limit is not None
        missed = SINGLE * self.terms.full * self.choice.kept / float(self.limit.each_beam.min())
        order = np.argsort(missed)
        self.single[order] = np.cumsum(missed[order]) <= 1.0 - self.spent
        if np.count_nonzero(self.single & self.choice.kept) < FEWEST and not self.single.all():
            self.single = np.zeros_like(self.single)
        self.spent += float(missed[self.single].sum())

    @property
    def used(self) -> frozenset[str]:
        """Names of the effects that are used as far as is known."""
        return frozenset(name for name, effect in self.found.items() if effect.used)

    def _take_all(self, why: str) -> None:
        """Use everything that the scene has."""
        for name in (name for name in EFFECTS if name in self.present):
            count = len(self.echoes) if name in SWEPT else None
            if name in PATHS:
                count = int(((self.echoes.needs >> np.uint32(int(math.log2(bit(name))))) == 1).sum())
            self._row(name, True, f"{why}: {EFFECTS[name].about}", count)

    def _row(self, name: str, used: bool, text: str, count: int | None = None, of: int = 0) -> None:
        """Write down one decision: `count` paths of its kind are left, `of` so many; None: it costs as a whole."""
        count, cost_s = int(used) if count is None else count, EFFECTS[name].cost_s
        self.found[name] = EffectPlan(
            name=name,
            used=used,
            bound_db=None,
            cost_s=count * cost_s,
            reason=text,
        )
        self.saved_s += max(of - count, 0) * cost_s


def _by_hand(name: str, wanted: frozenset[str], world: World) -> EffectPlan:
    """One row of a plan that somebody made by hand."""
    absent = EFFECTS[name].absent(world)
    used = name in wanted and absent is None
    reason = "asked for" if used else absent or "not asked for"
    return EffectPlan(name=name, used=used, bound_db=None, cost_s=0.0, reason=reason)


def _decibel(ratio: float) -> float | None:
    """A field ratio in dB as JSON can say it: None for nothing, at most `MAX_DB`."""
    return min(20.0 * math.log10(ratio), MAX_DB) if ratio > 1e-15 else None
