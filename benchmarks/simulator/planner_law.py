"""The laws of the planner's purposes over random places: no cell off by more than the budget, and what planning saves.

Every scene is simulated with all effects and as planned for each purpose under each budget, same noise, at the kernel
level. Cells are those of `sim_player.planner.cells`: range bins of every steering angle, and of every azimuth of the
512 x 256 map. Two answers are held against each law: the profiles of a plan that is asked for profiles only (the kernel
level), and the paths that are left by one that is asked for beats.
`--alone N` drops each effect alone in the first N scenes: bound minus actual change, both laws. Times are processor
times of this process at the kernel level: `all` is tracing and signal of everything, `auto` planning (tracing included)
and signal of what is left.
Usage: python -m benchmarks.simulator.planner_law [--scenes 500] [--alone 60] [--seed 3]
                                        [--preset xband] [--out FILE.json]
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import time
from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import numpy as np
from rich.progress import track

from msgs.values.radar import RadarSetup
from sim_player.effects.table import ALL_EFFECTS, PATHS
from sim_player.generate.places import random_place
from sim_player.planner.cells import cells_of
from sim_player.planner.plan import Plan, clean_profiles, manual_plan, noisy_profiles, plan_world, planned_profiles
from sim_player.planner.purposes import DETECTION, Purpose
from sim_player.scene.world import World, prepare
from sim_player.signal.levels import noise_profiles, noise_rms
from sim_player.trace.effect_names import bit

Preset = Literal["xband", "77ghz"]
BUDGETS_DB = (-10.0, -20.0, -30.0)
#: Single effects that change less are told apart from rounding no more.
LEAST_DB = -80.0


def timed(call: Callable[[], Any]) -> tuple[float, Any]:
    """Processor time of a call [s], and its answer."""
    start = time.process_time()
    answer = call()
    return time.process_time() - start, answer


@dataclass(frozen=True)
class Place:
    """One random place with everything on."""

    seed: int
    index: int
    preset: Preset

    @cached_property
    def world(self) -> World:
        return prepare(random_place(self.seed, self.index, self.preset), self.index)

    @property
    def setup(self) -> RadarSetup:
        return self.world.scene.setup

    @cached_property
    def everything(self) -> tuple[float, Plan]:
        # what the world keeps for all traces (bodies of objects) is no cost of one
        manual_plan(self.world, self.setup)
        return timed(lambda: manual_plan(self.world, self.setup))

    @cached_property
    def clean(self) -> tuple[float, np.ndarray]:
        return timed(lambda: clean_profiles(self.everything[1], self.setup, self.index))

    @property
    def all_s(self) -> float:
        return self.everything[0] + self.clean[0]

    @cached_property
    def rms(self) -> np.ndarray:
        return noise_rms(self.setup, self.everything[1].signal, self.world.scene.radar.front_end)

    def noise(self, plan: Plan) -> np.ndarray:
        return noise_profiles(self.setup, self.index, plan.signal, self.world.scene.radar.front_end)

    @cached_property
    def reference(self) -> np.ndarray:
        return self.clean[1] + self.noise(self.everything[1])

    def off_db(self, reference: np.ndarray, planned: np.ndarray, purpose: Purpose) -> float:
        """The law's ratio in the worst cell of beams and map, in dB."""
        cells = cells_of(self.setup)
        ratio = cells.off(reference, planned, self.rms, purpose).max()
        return float(20.0 * np.log10(max(ratio, 1e-15)))

    def moved_db(self, planned: np.ndarray) -> tuple[float, int]:
        """What a level over the detection threshold moves by at most [dB], and how many cells cross the threshold."""
        cells = cells_of(self.setup)
        threshold = DETECTION * cells.floor(np.zeros_like(self.reference), self.rms)
        before, after = np.abs(cells.values(self.reference)), np.abs(cells.values(planned))
        over = before >= threshold
        moved = np.abs(20.0 * np.log10(np.maximum(after, 1e-30) / np.maximum(before, 1e-30)))
        return float(moved[over].max(initial=0.0)), int((over != (after >= threshold)).sum())


def scene_rows(seed: int, index: int, preset: Preset, alone: bool) -> dict[str, Any]:
    """All plans of one scene."""
    place = Place(seed, index, preset)
    row: dict[str, Any] = {"scene": place.world.scene.name, "all_s": place.all_s}
    row |= {"trace_s": place.everything[0], "paths": len(place.everything[1].echoes)}
    row["plans"] = [_plan_row(place, purpose, budget_db) for purpose in Purpose for budget_db in BUDGETS_DB]
    if alone:
        row["alone"] = [one for purpose in (Purpose.SAMPLES, Purpose.PEAKS) for one in _alone(place, purpose)]
    return row


def _plan_row(place: Place, purpose: Purpose, budget_db: float) -> dict[str, Any]:
    """One scene for one purpose under one budget."""
    answer_s, answer = timed(
        lambda: plan_world(place.world, place.setup, budget_db, purpose=purpose, profiles_only=True)
    )
    signal_s, clean = timed(lambda: clean_profiles(answer, place.setup, place.index))
    select_s, plan = timed(lambda: plan_world(place.world, place.setup, budget_db, purpose=purpose))
    left = planned_profiles(plan, place.setup, place.index) + place.noise(plan)
    moved_db, crossings = place.moved_db(left)
    return {
        "purpose": purpose.value,
        "budget_db": budget_db,
        "left_db": place.off_db(place.reference, left, purpose),
        "evaluated_db": place.off_db(place.reference, clean + place.noise(answer), purpose),
        "answered": answer.evaluated is not None,
        "bound_db": plan.spent_db,
        "moved_db": moved_db,
        "crossings": crossings,
        "plan_s": answer_s - place.everything[0],
        "select_s": select_s - answer_s,
        "auto_s": answer_s + signal_s,
        "kept": len(plan.echoes),
        "squints": int(plan.squints.sum()),
        "overlaps": int(plan.overlaps.sum()),
        "used": sorted(plan.used),
        "present": sorted(place.everything[1].used),
    }


def _alone(place: Place, purpose: Purpose) -> list[dict[str, Any]]:
    """Every effect that the scene has, dropped alone: its bound and what it changed."""
    plan = plan_world(place.world, place.setup, -20.0, thorough=True, purpose=purpose)
    everything = place.everything[1]
    reference = noisy_profiles(everything, place.setup, place.index, "float64")
    found = []
    for effect in plan.effects:
        # without noise rounding is not white, and the law has no floor
        if effect.bound_db is None or effect.bound_db >= 200.0 or effect.name == "thermal_noise":
            continue
        without = _without(place, effect.name)
        planned = noisy_profiles(without, place.setup, place.index, "float64")
        actual_db = place.off_db(reference, planned, purpose)
        row = {"purpose": purpose.value, "effect": effect.name, "bound_db": effect.bound_db, "actual_db": actual_db}
        found.append(row)
    return found


def _without(place: Place, name: str) -> Plan:
    """Everything but one effect, its paths taken away as plans do: to trace without it would lose routes of others."""
    everything = place.everything[1]
    plan = manual_plan(place.world, place.setup, everything.used - {name})
    if name not in PATHS or name == "curved_wall":
        return plan
    left = (everything.echoes.needs & np.uint32(bit(name))) == 0
    parts = {part: getattr(everything, part)[left] for part in ("squints", "overlaps")}
    return replace(plan, echoes=everything.echoes.take(left), **parts)


# --- what it adds up to


def summary(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Everything that is reported."""
    plans = [
        _summary_of(rows, position, purpose, budget_db)
        for position, (purpose, budget_db) in enumerate((p, b) for p in Purpose for b in BUDGETS_DB)
    ]
    alone = [one for row in rows for one in row.get("alone", []) if one["actual_db"] > LEAST_DB]
    return {"scenes": len(rows), "plans": plans, "alone": [_slack(alone, purpose) for purpose in Purpose if alone]}


def _summary_of(rows: list[dict[str, Any]], position: int, purpose: Purpose, budget_db: float) -> dict[str, Any]:
    mine = [row["plans"][position] for row in rows]
    used, present = Counter[str](), Counter[str]()
    for one in mine:
        used.update(one["used"])
        present.update(one["present"])

    def median(values: Iterable[float]) -> float:
        return float(np.median(list(values)))

    both = list(zip(mine, rows, strict=True))
    ratios = [row["all_s"] / one["auto_s"] for one, row in both]
    return {
        "purpose": purpose.value,
        "budget_db": budget_db,
        "violations": sum(max(one["left_db"], one["evaluated_db"]) > budget_db for one in mine),
        "over_bound": sum(one["bound_db"] is not None and one["left_db"] > one["bound_db"] + 0.1 for one in mine),
        "left_median_db": median(one["left_db"] for one in mine),
        "left_worst_db": max(one["left_db"] for one in mine),
        "evaluated_worst_db": max(one["evaluated_db"] for one in mine),
        "moved_worst_db": max(one["moved_db"] for one in mine),
        "crossings_median": median(one["crossings"] for one in mine),
        "answered": sum(one["answered"] for one in mine),
        "planning_share": median(one["plan_s"] / row["all_s"] for one, row in both),
        "ratio_median": median(ratios),
        "ratio_p10_p90": np.percentile(ratios, [10, 90]).tolist(),
        **{
            name: median(one[name] / max(row["paths"], 1) for one, row in both)
            for name in ("kept", "squints", "overlaps")
        },
        "used": {name: [used[name], present[name]] for name in sorted(present)},
    }


def _slack(alone: list[dict[str, Any]], purpose: Purpose) -> dict[str, Any]:
    mine = [one for one in alone if one["purpose"] == purpose.value]
    slack = {name: [] for name in sorted({one["effect"] for one in mine})}  # type: dict[str, list[float]]
    for one in mine:
        slack[one["effect"]].append(one["bound_db"] - one["actual_db"])
    every = [value for values in slack.values() for value in values] or [0.0]
    return {
        "purpose": purpose.value,
        "cases": len(mine),
        "median_db": float(np.median(every)),
        "least_db": float(np.min(every)),
        "by_effect": {name: [float(np.median(values)), len(values)] for name, values in slack.items()},
    }


def report(found: dict[str, Any]) -> None:
    """Print it."""
    for one in found["plans"]:
        low, high = one["ratio_p10_p90"]
        print(
            f"{one['purpose']:7s} budget {one['budget_db']:4.0f} dB  violations {one['violations']} of "
            f"{2 * found['scenes']}, over its bound {one['over_bound']}  median {one['left_median_db']:.1f} worst "
            f"{one['left_worst_db']:.1f} (evaluated {one['evaluated_worst_db']:.1f}) dB  level over threshold moves "
            f"{one['moved_worst_db']:.2f} dB at most, {one['crossings_median']:.0f} cells cross\n"
            f"    {one['answered']} evaluated, planning / all {one['planning_share']:.2f}  all / auto "
            f"{one['ratio_median']:.2f} (p10..p90 {low:.2f}..{high:.2f})  left: paths {one['kept']:.2f}, "
            f"squint {one['squints']:.2f}, overlap {one['overlaps']:.2f}"
        )
        print("    used of present: " + ", ".join(f"{k} {u}/{p}" for k, (u, p) in one["used"].items()))
    for one in found["alone"]:
        if one["cases"]:
            print(
                f"one effect dropped alone, {one['purpose']}: bound minus actual, median {one['median_db']:.1f} dB, "
                f"least {one['least_db']:.1f} dB, {one['cases']} cases"
            )
            print("    " + ", ".join(f"{name} {value:.1f}" for name, (value, _) in one["by_effect"].items()))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scenes", type=int, default=500)
    parser.add_argument("--alone", type=int, default=60)
    parser.add_argument("--seed", type=int, default=3)
    parser.add_argument("--preset", choices=("xband", "77ghz"), default="xband")
    parser.add_argument("--out", type=Path)
    arguments = parser.parse_args()
    scene_rows(arguments.seed, 0, arguments.preset, False)  # compiles and fills the kernels
    rows = [
        scene_rows(arguments.seed, index, arguments.preset, index < arguments.alone)
        for index in track(range(arguments.scenes), transient=True)
    ]
    found = summary(rows)
    machine = f"{platform.machine()}, {os.cpu_count()} cores, {platform.platform()}"
    found |= {"machine": machine, "seed": arguments.seed, "preset": arguments.preset, "effects": sorted(ALL_EFFECTS)}
    report(found)
    if arguments.out:
        arguments.out.write_text(json.dumps({"summary": found, "rows": rows}))


if __name__ == "__main__":
    main()
