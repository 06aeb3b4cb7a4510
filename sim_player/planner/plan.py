"""Plan of the effects that a scene needs: bounds of what each could change in the map, and the least that keeps a
budget.

The law: |RA(planned) - RA(all)| / max(noise rms, strongest |RA(all)| within one range bin and half a beam) stays under
the budget in every cell, for the same noise. It is kept by construction: an ablation goes from all effects to the
planned ones in steps, each of which drops an effect, or only the paths for which it is too weak to matter. What a step
changes is bounded in every cell by magnitudes added up (`sim_player.planner.bounds`, by kind of effect in
`sim_player.planner.changes`) with all others as they then stand, and the sum of these bounds over a lower bound of the
denominator stays under the budget.

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
from sim_player.effects.curved_wall import as_chords
from sim_player.effects.table import ALL_EFFECTS, EFFECTS, PATHS, check_effects
from sim_player.planner.ablation import EffectAblation, signal_effects
from sim_player.planner.changes import change_bound
from sim_player.scene.reach import reachable_snapshot
from sim_player.scene.world import Snapshot, World
from sim_player.signal.levels import kernel_profiles, noise_profiles
from sim_player.signal.switches import SignalEffects
from sim_player.trace.conversion import as_paths
from sim_player.trace.echoes import Echoes
from sim_player.trace.paths import Paths
from sim_player.trace.ray_tracing import trace_echoes
from sim_player.trace.snapshot import TraceContext

BUDGET_DB = -20.0
#: Share of the budget that dropped paths may take, and each of the two dear effects of the sweep in part.
DROPPED_SHARE, SWEPT_SHARE = 0.5, 0.2
#: Rounds of the search for the strongest path that may be dropped.
ROUNDS = 7
#: Fewer paths than this cost less as profiles, with everything on, than the question what they need.
MIN_PATHS_TO_PLAN = 3000
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
) -> Plan:
    """The same for a prepared scene; a quick plan takes few paths unasked."""
    if not (math.isfinite(budget_db) and budget_db < 0.0):
        raise ValueError(f"budget_db must be finite and negative, got {budget_db!r}")
    start = time.perf_counter()
    planner = _Planner(EffectAblation(world, setup, time_s), 10.0 ** (budget_db / 20.0), thorough)
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


def resolve_plan(
    world: World,
    setup: RadarSetup,
    effects: str,
    budget_db: float = BUDGET_DB,
    time_s: float = 0.0,
) -> Plan | None:
    """The plan that a word asks for: "auto", "all", names with commas between them; None for "basic".

    Raises ValueError for an unknown effect, or an empty list.
    """
    if effects == "basic":
        return None
    if effects == "auto":
        return plan_world(world, setup, budget_db, time_s)
    if effects == "all":
        return manual_plan(world, setup, ALL_EFFECTS, time_s)
    names = frozenset(name.strip() for name in effects.split(",")) - {""}
    if not names:
        raise ValueError("effects: want auto, all, basic or names with commas between them, got nothing")
    return manual_plan(world, setup, names, time_s)


def noisy_profiles(plan: Plan, setup: RadarSetup, seed: int = 0, precision: str = "float32") -> np.ndarray:
    """The same without asking whether the level can hold it."""
    noise = noise_profiles(setup, seed, plan.signal, plan.view.world.scene.radar.front_end)
    return clean_profiles(plan, setup, seed, precision) + noise


def clean_profiles(plan: Plan, setup: RadarSetup, seed: int = 0, precision: str = "float32") -> np.ndarray:
    """The same without the noise."""
    front_end = plan.view.world.scene.radar.front_end
    (first, flags), *rest = plan.groups()
    profiles = kernel_profiles(setup, first, flags, front_end, precision=precision, seed=seed)
    for paths, flags in rest:
        # what the electronics add belongs to the whole, once
        alone = msgspec.structs.replace(flags, leakage=False, spurs=False)
        profiles = profiles + kernel_profiles(setup, paths, alone, front_end, precision=precision, seed=seed)
    return profiles


class _Planner:
    """Takes the steps of the ablation, books each one, and states why."""

    def __init__(self, ablation: EffectAblation, budget: float, thorough: bool) -> None:
        self.ablation, self.budget, self.thorough = ablation, budget, thorough
        self.found: dict[str, EffectPlan] = {}
        self.traced = len(ablation.echoes)
        self.timing_s: dict[str, float] = {}

    def run(self) -> None:
        """All steps in turn."""
        for name, effect in EFFECTS.items():
            reason = effect.absent(self.ablation.world)
            if reason is not None:
                self._row(name, False, None, 0, reason)
        if self.traced < MIN_PATHS_TO_PLAN and not self.thorough:
            self._take_all()
            return
        self._timed("floor", lambda: self.ablation.begin(exact=self.thorough))
        for name, step in (
            ("paths", self._paths),
            ("prune", self._prune),
            ("sweep", self._sweep),
            ("free", self._free),
        ):
            self._timed(name, step)

    def plan(self, budget_db: float) -> Plan:
        """Return the decisions, in the order of the effects."""
        ablation = self.ablation
        return Plan(
            budget_db=budget_db,
            effects=tuple(self.found[name] for name in EFFECTS),
            view=ablation.view,
            echoes=ablation.echoes,
            squints=ablation.squints,
            overlaps=ablation.overlaps,
            traced=self.traced,
            spent_db=self._ratio_db(ablation.spent),
            timing_s=self.timing_s,
        )

    def _timed(self, name: str, step: Callable[[], None]) -> None:
        start = time.perf_counter()
        step()
        self.timing_s[name] = time.perf_counter() - start

    def _take_all(self) -> None:
        """Use everything that the scene has: to ask would cost more."""
        for name in (name for name in EFFECTS if name not in self.found):
            reason = f"not asked, {self.traced} paths cost less than the question: {EFFECTS[name].about}"
            self._row(name, True, None, self.traced, reason)

    def _paths(self) -> None:
        """Effects that make paths, the weakest first."""
        names = [name for name in PATHS if name not in self.found]
        peak = {name: self.ablation.strongest(name) for name in names}
        for name in sorted(names, key=peak.__getitem__):
            mine = self.ablation.made_by(name)
            count = int(mine.sum())
            text = f"{count} path{'' if count == 1 else 's'}: {PATHS[name].about}"
            if not self.thorough and peak[name] > self.budget:
                self._row(name, True, None, count, f"one path alone is over the budget; {text}")
            elif not self._decide(name, count, text):
                self.ablation.keep(~mine)
                if name == "curved_wall":
                    self.ablation.add(as_chords(TraceContext(self.ablation.view)))

    def _prune(self) -> None:
        """Drop the paths that are too weak to matter even together: effects used in part."""
        ablation = self.ablation
        strength = ablation.magnitude.sum(axis=0).max(axis=0)
        ablation.keep(
            ~self._weakest(strength, lambda selection: ablation.bound(ablation.amplitude * selection), DROPPED_SHARE)
        )

    def _sweep(self) -> None:
        """Squint and overlap for those paths alone that call for them."""
        ablation = self.ablation
        if "chirp_overlap" not in self.found:
            # the missing rise of the window grows with the cube of the delay
            strength = ablation.magnitude.sum(axis=0).max(axis=0) * (1.0 + ablation.step) ** 3
            self._in_part("chirp_overlap", ablation.overlaps, strength, ablation.overlap_change)
        if "squint" not in self.found:
            strength = (ablation.pattern.squint() * ablation.amplitude).sum(axis=0).max(axis=0)
            self._in_part("squint", ablation.squints, strength, ablation.squint_change)

    def _in_part(
        self, name: str, mask: np.ndarray, strength: np.ndarray, change_of: Callable[[np.ndarray], np.ndarray]
    ) -> None:
        """Spare as many paths as the budget allows one effect of the sweep."""
        bound_db = self._ratio_db(change_bound(self.ablation, name))
        mask[self._weakest(strength, change_of, SWEPT_SHARE)] = False
        left = int(mask.sum())
        self._row(name, bool(left), bound_db, left, f"{left} of {len(mask)} paths: {EFFECTS[name].about}")

    def _free(self) -> None:
        """Effects that cost nothing: used, or in a thorough plan bounded like the others."""
        names = [name for name in EFFECTS if name not in self.found]
        if not self.thorough:
            for name in names:
                self._row(name, True, None, 0, f"costs nothing: {EFFECTS[name].about}")
            return
        size = {name: self.ablation.ratio(change_bound(self.ablation, name)) for name in names}
        for name in sorted(names, key=size.__getitem__):
            if not self._decide(name, 0, EFFECTS[name].about):
                self.ablation.look()

    def _decide(self, name: str, count: int, text: str) -> bool:
        """Use an effect, or skip it and book its bound; whether it is used."""
        ablation = self.ablation
        bound = change_bound(ablation, name)
        fits = ablation.fits(bound, self.budget)
        if fits:
            ablation.spent = ablation.spent + bound
        self._row(name, not fits, self._ratio_db(bound), count, text)
        return not fits

    def _weakest(self, strength: np.ndarray, bound_of: Callable[[np.ndarray], np.ndarray], share: float) -> np.ndarray:
        """As many of the weakest as a share of the budget allows, bool [E]; booked."""
        ablation, order = self.ablation, np.argsort(strength, kind="stable")
        low, high, best = 0, len(order) + 1, np.zeros_like(ablation.spent)
        for _ in range(ROUNDS):
            middle = (low + high) // 2
            if middle == low:
                break
            bound = bound_of(_first(order, middle))
            if ablation.fits(bound, self.budget, share):
                low, best = middle, bound
            else:
                high = middle
        ablation.spent = ablation.spent + best
        return _first(order, low)

    def _ratio_db(self, bound: np.ndarray) -> float | None:
        return _decibel(self.ablation.ratio(bound)) if bound.any() else None

    def _row(self, name: str, used: bool, bound_db: float | None, count: int, text: str) -> None:
        """Write down one decision."""
        if not used:
            self.ablation.used.discard(name)
        if bound_db is not None:
            budget_db = 20.0 * math.log10(self.budget)
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


def _first(order: np.ndarray, count: int) -> np.ndarray:
    """Mask of the first so many of an order."""
    mask = np.zeros(len(order), bool)
    mask[order[:count]] = True
    return mask


def _decibel(ratio: float) -> float | None:
    """A field ratio in dB as JSON can say it: None for nothing, at most `MAX_DB`."""
    return min(20.0 * math.log10(ratio), MAX_DB) if ratio > 0.0 else None
