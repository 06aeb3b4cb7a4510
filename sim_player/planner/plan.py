"""Plan of the effects that a scene needs: the least that keeps the law of a purpose within a budget.

The law (`sim_player.planner.purposes`): |RA(planned) - RA(all)| <= budget x reference in every cell of the purpose, for
the same noise. It is kept by construction: an ablation goes from all effects to the planned ones in steps, each of
which drops paths, the squint or overlap of paths, or an effect. What the steps change together is evaluated in every
cell, phases and all, over a lower bound of the reference (`sim_player.planner.ablation`).

A plan of a scene at rest holds as long as nothing moves. In a scene that moves the phases turn within a wavelength and
paths come and go: there only effects are left out that the scene has nothing of, which holds at any time, and the
weakest paths, by magnitudes alone, which holds from one instant of tracing to the next (`sim_player.planner.spans`).

Cells are range bins of every steering angle, as the radar measures them and section 2.1.1 assembles them, and of every
azimuth of the map that the co-array inversion makes of them (`sim_player.planner.cells`). Rays are cheap: all paths are
traced to know them. What costs time is their signal, most of all its sweep: squint takes a tone per instant, overlap a
stretch of samples per path. So these two are asked path by path.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import cached_property

import msgspec
import numpy as np

from msgs.values.radar import RadarSetup
from msgs.values.wording import counted
from sim_player.effects.table import ALL_EFFECTS, EFFECTS, PATHS, check_effects
from sim_player.planner.ablation import Answer, EffectAblation, signal_effects
from sim_player.planner.changes import change_of
from sim_player.planner.purposes import Purpose
from sim_player.planner.spans import SpanSelection
from sim_player.scene.reach import reachable_snapshot
from sim_player.scene.world import Snapshot, World
from sim_player.signal.clutter import clutter_profiles, profile_power_mw
from sim_player.signal.levels import kernel_profiles, noise_profiles
from sim_player.signal.rain_volume import clutter_at
from sim_player.signal.receiver import dither_objection
from sim_player.signal.switches import SignalEffects
from sim_player.trace.conversion import as_paths
from sim_player.trace.echoes import Echoes
from sim_player.trace.path_tracks import scene_step_s
from sim_player.trace.paths import Paths
from sim_player.trace.ray_tracing import trace_echoes

BUDGET_DB = -20.0
#: Share of the budget that dropped paths, squint and overlap may take; effects that cost nothing have the rest.
SELECTED_SHARE = 0.8
#: For `samples` no file with fewer paths than this is asked for: those made by earlier versions stay as they are.
MIN_PATHS_TO_PLAN = 3000
#: Why no effect that a moving scene has is left out, and no path where none is asked for.
MOVES = "kept at any time, the scene moves"
WEAKEST = "kept at any time, the scene moves; its weakest paths are left out from one instant of tracing to the next"
#: Bounds in JSON end here.
MAX_DB = 200.0


class EffectPlan(msgspec.Struct, frozen=True, kw_only=True):
    """Decision on one effect, with its reason."""

    name: str
    used: bool
    #: The most it can change in any cell, relative to noise or what stands there; None: nothing, or not asked.
    bound_db: float | None
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
    #: Which echoes squint and which overlap, bool [E].
    squints: np.ndarray
    overlaps: np.ndarray
    #: Paths traced before any was dropped.
    traced: int
    #: Bound of the whole difference in any cell, in dB; None: no difference.
    spent_db: float | None
    timing_s: dict[str, float]
    #: The answer at the kernel level, found on the way to the plan: profiles of all echoes with all effects but leakage
    #: and spurs; None where nothing was evaluated or the error is over the budget; complex64 [beams, bins].
    evaluated: np.ndarray | None = None
    #: What chooses the paths of a scene that moves, from one instant of tracing to the next; None: all of them.
    spans: SpanSelection | None = None
    #: How long what is left out stays so before it is chosen again: from one instant of tracing to the next.
    holds_s: float = math.inf

    @cached_property
    def used(self) -> frozenset[str]:
        """Names of the effects that are used, wholly or in part."""
        return frozenset(effect.name for effect in self.effects if effect.used)

    @cached_property
    def paths(self) -> Paths:
        """The planned paths, as the radar has them."""
        return as_paths(self.view, self.echoes, self.used)

    @cached_property
    def signal(self) -> SignalEffects:
        """The planned effects of antenna, waveform and receiver."""
        return signal_effects(self.used)

    def groups(self) -> list[tuple[Paths, SignalEffects]]:
        """Paths that share the same effects of the sweep, at least one group."""
        paths, groups = self.paths, []
        for squint in (True, False):
            for overlap in (True, False):
                in_group = (self.squints == squint) & (self.overlaps == overlap)
                flags = msgspec.structs.replace(self.signal, squint=squint, chirp_overlap=overlap)
                if in_group.any():
                    groups.append((paths.take(in_group), flags))
        return groups or [(paths, self.signal)]


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

    Where only profiles are wanted, no beats, paths are selected only if the evaluated profiles miss the budget. Raises
    ValueError for a budget that is not negative.
    """
    if not (math.isfinite(budget_db) and budget_db < 0.0):
        raise ValueError(f"budget_db must be finite and negative, got {budget_db!r}")
    start = time.perf_counter()
    ablation = EffectAblation(world, setup, time_s, purpose, 10.0 ** (budget_db / 20.0), thorough)
    planner = _Planner(ablation, thorough, profiles_only)
    planner.timing_s["trace"] = time.perf_counter() - start
    planner.run()
    return planner.plan(budget_db)


def manual_plan(world: World, setup: RadarSetup, names: Iterable[str] = ALL_EFFECTS, time_s: float = 0.0) -> Plan:
    """A plan of effects named by hand, all their paths and nothing bounded; ValueError for an unknown effect.

    Effects that the scene has nothing of stay unused, whatever is asked.
    """
    wanted, view = check_effects(frozenset(names)), reachable_snapshot(world, time_s)
    start = time.perf_counter()
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
        squints=every & ("squint" in used),
        overlaps=every & ("chirp_overlap" in used),
        traced=len(echoes),
        spent_db=None,
        timing_s={"trace": time.perf_counter() - start},
    )


def resolve_plan(
    world: World,
    setup: RadarSetup,
    effects: str,
    budget_db: float = BUDGET_DB,
    time_s: float = 0.0,
    purpose: Purpose = Purpose.SAMPLES,
) -> Plan | None:
    """The plan that a word asks for: "auto", "all", names with commas between them; None for "basic".

    Raises ValueError for an unknown effect, or an empty list.
    """
    if effects == "basic":
        return None
    if effects == "auto":
        return plan_world(world, setup, budget_db, time_s, purpose=purpose)
    if effects == "all":
        return manual_plan(world, setup, ALL_EFFECTS, time_s)
    names = frozenset(name.strip() for name in effects.split(",")) - {""}
    if not names:
        raise ValueError("effects: want auto, all, basic or names with commas between them, got nothing")
    return manual_plan(world, setup, names, time_s)


def noisy_profiles(plan: Plan, setup: RadarSetup, seed: int = 0, precision: str = "float32") -> np.ndarray:
    """Return the profiles of a plan with noise, without asking whether the level can hold it."""
    noise = noise_profiles(setup, seed, plan.signal, plan.view.world.scene.radar.front_end)
    return clean_profiles(plan, setup, seed, precision) + noise


def clean_profiles(plan: Plan, setup: RadarSetup, seed: int = 0, precision: str = "float32") -> np.ndarray:
    """Return the same without the noise: in single precision what the plan has evaluated, wherever it has."""
    front_end = plan.view.world.scene.radar.front_end
    if plan.evaluated is None or precision != "float32":
        return planned_profiles(plan, setup, seed, precision)
    echoes = plan.evaluated + _of_the_air(plan, setup, seed).astype(plan.evaluated.dtype)
    faults = (plan.signal.leakage and front_end.leakage_dbm is not None) or (plan.signal.spurs and front_end.spurs)
    if not faults:
        return echoes
    nothing = plan.paths.take(np.zeros(0, int))
    return echoes + kernel_profiles(setup, nothing, plan.signal, front_end, precision=precision, seed=seed)


def planned_profiles(plan: Plan, setup: RadarSetup, seed: int = 0, precision: str = "float32") -> np.ndarray:
    """Return the profiles of the paths that are left, with what is left of their sweep: as the beats have them."""
    front_end = plan.view.world.scene.radar.front_end
    (first, flags), *rest = plan.groups()
    profiles = kernel_profiles(setup, first, flags, front_end, precision=precision, seed=seed)
    for paths, flags in rest:
        # what the electronics add belongs to the whole, once
        alone = msgspec.structs.replace(flags, leakage=False, spurs=False)
        profiles = profiles + kernel_profiles(setup, paths, alone, front_end, precision=precision, seed=seed)
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
    """Takes the steps of the ablation, books each one, and states why."""

    def __init__(self, ablation: EffectAblation, thorough: bool, profiles_only: bool) -> None:
        self.ablation, self.thorough, self.profiles_only = ablation, thorough, profiles_only
        self.answer: Answer | None = None
        self.spans: SpanSelection | None = None
        self.spent = 0.0
        self.found: dict[str, EffectPlan] = {}
        self.traced = len(ablation.echoes)
        self.timing_s: dict[str, float] = {}

    def run(self) -> None:
        """All steps in turn."""
        for name, effect in EFFECTS.items():
            reason = effect.absent(self.ablation.world)
            if reason is not None:
                self._row(name, False, None, 0, reason)
        few = self.ablation.purpose is Purpose.SAMPLES and self.traced < MIN_PATHS_TO_PLAN and not self.thorough
        if self.ablation.world.scene.moves:
            self.spans = None if few else self._spans()
            self._take_all(MOVES if self.spans is None else WEAKEST)
            return
        if few:
            self._take_all(f"not asked, {self.traced} paths are few")
            return
        self._timed("floor", self._evaluate)
        if self.answer is not None and self.profiles_only:
            self._take_all("evaluated with all others, under the budget")
            self.spent = self.answer.off
            return
        # what each effect alone would change is asked before anything is left out
        self._timed("alone", self._alone)
        self._timed("select", self._select)
        self._timed("free", self._free)
        self.spent = self.ablation.ratio(self.ablation.spent)

    def plan(self, budget_db: float) -> Plan:
        """Return the decisions, in the order of the effects."""
        ablation, every = self.ablation, np.ones(len(self.ablation.echoes), bool)
        return Plan(
            purpose=ablation.purpose,
            budget_db=budget_db,
            effects=tuple(self.found[name] for name in EFFECTS),
            view=ablation.view,
            setup=ablation.setup,
            echoes=ablation.echoes,
            squints=ablation.selection.squints if ablation.begun else every & ("squint" in ablation.used),
            overlaps=ablation.selection.overlaps if ablation.begun else every & ("chirp_overlap" in ablation.used),
            traced=self.traced,
            spent_db=_decibel(self.spent),
            timing_s=self.timing_s,
            evaluated=None if self.answer is None else self.answer.profiles,
            spans=self.spans,
            holds_s=math.inf if self.spans is None else scene_step_s(ablation.world),
        )

    def _spans(self) -> SpanSelection | None:
        """Return what chooses the paths of a scene that moves; None where rounding is no noise that adds to them."""
        ablation = self.ablation
        setup, front_end = ablation.setup, ablation.front_end
        if dither_objection(setup, front_end, thermal=True) is not None:
            return None
        self.spent = ablation.budget
        return SpanSelection(setup, ablation.flags(), front_end, ablation.purpose, ablation.budget)

    def _timed(self, name: str, step: Callable[[], None]) -> None:
        start = time.perf_counter()
        step()
        self.timing_s[name] = time.perf_counter() - start

    def _evaluate(self) -> None:
        """Evaluate everything, and see whether that is an answer."""
        self.ablation.begin()
        self.answer = self.ablation.answer()

    def _take_all(self, why: str) -> None:
        """Use everything that the scene has."""
        for name in (name for name in EFFECTS if name not in self.found):
            self._row(name, True, None, self.traced, f"{why}: {EFFECTS[name].about}")

    def _alone(self) -> None:
        """Largest change by each effect alone, if it is asked for."""
        names = [name for name in EFFECTS if name not in self.found] if self.thorough else []
        changes = {name: self.ablation.ratio(change_of(self.ablation, name)) for name in names}
        self.alone_db = {name: _decibel(change) for name, change in changes.items()}

    def _select(self) -> None:
        """Drop paths, squint and overlap of paths; the effects that are left with none are skipped."""
        ablation = self.ablation
        made = {name: ablation.made_by(name) for name in PATHS if name not in self.found}
        selection = ablation.select(SELECTED_SHARE)
        for name, mine in made.items():
            count, left = int(mine.sum()), int((mine & ~selection.dropped).sum())
            text = f"{left} of {counted(count, 'path')}: {PATHS[name].about}"
            # arrays that stand apart move every echo, not those alone that this effect makes
            apart = name == "non_cofocal" and ablation.world.scene.radar.separation_m > 0.0
            self._row(name, apart or bool(left), self.alone_db.get(name), left, text)
        kept = ~selection.dropped
        for name, mask in (("squint", selection.squints), ("chirp_overlap", selection.overlaps)):
            if name not in self.found:
                left = int(mask.sum())
                text = f"{left} of {counted(int(kept.sum()), 'path')} left: {EFFECTS[name].about}"
                self._row(name, bool(left), self.alone_db.get(name), left, text)
        ablation.settle()

    def _free(self) -> None:
        """Effects that cost nothing: used, or in a thorough plan dropped while the budget lasts."""
        ablation = self.ablation
        names = [name for name in EFFECTS if name not in self.found]
        if not self.thorough:
            for name in names:
                self._row(name, True, None, 0, f"costs nothing: {EFFECTS[name].about}")
            return
        for name in sorted(names, key=lambda name: self.alone_db[name] or -math.inf):
            change = change_of(ablation, name)
            fits = ablation.fits(change)
            self._row(name, not fits, self.alone_db[name], 0, EFFECTS[name].about)
            if fits:
                ablation.spent = ablation.spent + change
                ablation.refresh()

    def _row(self, name: str, used: bool, bound_db: float | None, count: int, text: str) -> None:
        """Write down one decision."""
        if not used:
            self.ablation.used.discard(name)
        if bound_db is not None:
            budget_db = 20.0 * math.log10(self.ablation.budget)
            side = "over" if bound_db > budget_db else "under" if not used else "within, but not beside others in,"
            text = f"bound {bound_db:.0f} dB {side} budget {budget_db:g} dB: {text}"
        cost_s = count * EFFECTS[name].cost_s
        self.found[name] = EffectPlan(name=name, used=used, bound_db=bound_db, cost_s=cost_s, reason=text)


def _by_hand(name: str, wanted: frozenset[str], world: World) -> EffectPlan:
    """One row of a plan that somebody made by hand."""
    absent = EFFECTS[name].absent(world)
    used = name in wanted and absent is None
    reason = "asked for" if used else absent or "not asked for"
    return EffectPlan(name=name, used=used, bound_db=None, cost_s=0.0, reason=reason)


def _decibel(ratio: float) -> float | None:
    """A field ratio in dB as JSON can say it: None for nothing, at most `MAX_DB`."""
    return min(20.0 * math.log10(ratio), MAX_DB) if ratio > 1e-15 else None
