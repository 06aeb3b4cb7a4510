"""The planner's law over random places: no cell off by more than the budget, and what the planning saves.

Every scene is simulated with all effects and as planned under each budget, same noise, at the kernel level. Cells are
those of `sim_player.planner.cells`: range bins of every steering angle, and of every azimuth of the 512 x 256 map.
`--alone N` drops each used effect alone in the first N scenes: bound minus actual change. `--beats N` times the beats
of a whole scan of the first N scenes too. Times are processor times of this process: `all` is tracing and signal of
everything, `auto` planning and signal of what is left.
Usage: python -m benchmarks.simulator.planner_law [--scenes 500] [--alone 60] [--beats 0] [--seed 3] [--preset xband]
                                        [--out FILE.json] [--pictures DIR]
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import time
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
from rich.progress import track

from msgs.values.radar import RadarSetup
from sim_player.effects.table import ALL_EFFECTS
from sim_player.generate.places import random_place
from sim_player.planner.cells import cells_of
from sim_player.planner.plan import Plan, clean_profiles, manual_plan, noisy_profiles, plan_world
from sim_player.scene.world import World, prepare
from sim_player.signal.levels import beam_beats, noise_profiles, noise_rms

BUDGETS_DB = (-10.0, -20.0, -30.0)


def off_db(everything: np.ndarray, planned: np.ndarray, rms: np.ndarray, setup: RadarSetup) -> float:
    """The law's ratio in the worst cell of beams and map, in dB."""
    return float(20.0 * np.log10(max(cells_of(setup).off(everything, planned, rms).max(), 1e-15)))


def scene_rows(seed: int, index: int, preset: str, alone: bool) -> dict[str, Any]:
    scene = random_place(seed, index, preset)
    setup, world = scene.setup, prepare(scene, index)
    start = time.process_time()
    everything = manual_plan(world, setup)
    clean = clean_profiles(everything, setup, index)
    all_s = time.process_time() - start
    reference = clean + noise_profiles(setup, index, everything.signal, scene.radar.front_end)
    rms = noise_rms(setup, everything.signal, scene.radar.front_end)
    row: dict[str, Any] = {"scene": scene.name, "all_s": all_s, "paths": len(everything.echoes), "budgets": []}
    for budget_db in BUDGETS_DB:
        row["budgets"].append(_budget(world, setup, index, budget_db, reference, rms, all_s))
    if alone:
        row["alone"] = _alone(world, setup, index, everything, reference, rms)
    return row


def _budget(
    world: World, setup: RadarSetup, index: int, budget_db: float, reference: np.ndarray, rms: np.ndarray, all_s: float
) -> dict[str, Any]:
    """One scene under one budget, planned quickly and thoroughly."""
    start = time.process_time()
    quick = plan_world(world, setup, budget_db)
    clean_profiles(quick, setup, index)
    auto_s = time.process_time() - start
    thorough = plan_world(world, setup, budget_db, thorough=True)
    planned = noisy_profiles(thorough, setup, index)
    return {
        "budget_db": budget_db,
        "actual_db": off_db(reference, planned, rms, setup),
        "actual_quick_db": off_db(reference, noisy_profiles(quick, setup, index), rms, setup),
        "bound_db": thorough.spent_db,
        "auto_s": auto_s,
        "ratio": all_s / auto_s,
        "kept": len(quick.echoes),
        "used": sorted(thorough.used),
        "present": sorted(e.name for e in thorough.effects if e.bound_db is not None),
    }


def _alone(
    world: World, setup: RadarSetup, index: int, everything: Plan, reference: np.ndarray, rms: np.ndarray
) -> list[dict[str, Any]]:
    """Every effect that the scene has, dropped alone: its bound and what it changed."""
    plan = plan_world(world, setup, -300.0, thorough=True)
    found = []
    for effect in plan.effects:
        # without noise rounding is not white, and the law has no floor
        if effect.bound_db is None or effect.bound_db >= 200.0 or effect.name == "thermal_noise":
            continue
        without = manual_plan(world, setup, everything.used - {effect.name})
        actual_db = off_db(reference, noisy_profiles(without, setup, index), rms, setup)
        found.append({"effect": effect.name, "bound_db": effect.bound_db, "actual_db": actual_db})
    return found


def summary(rows: list[dict[str, Any]]) -> dict[str, Any]:
    out: dict[str, Any] = {"scenes": len(rows), "budgets": []}
    for position, budget_db in enumerate(BUDGETS_DB):
        mine = [row["budgets"][position] for row in rows]
        used, present = Counter(), Counter()
        for one in mine:
            used.update(one["used"])
            present.update(one["present"])
        out["budgets"].append(
            {
                "budget_db": budget_db,
                "violations": sum(one["actual_db"] > budget_db for one in mine),
                "violations_quick": sum(one["actual_quick_db"] > budget_db for one in mine),
                "actual_median_db": _median(one["actual_db"] for one in mine),
                "actual_worst_db": max(one["actual_db"] for one in mine),
                "ratio_median": _median(one["ratio"] for one in mine),
                "ratio_p10_p90": np.percentile([one["ratio"] for one in mine], [10, 90]).tolist(),
                "kept_share": _median(one["kept"] / max(row["paths"], 1) for one, row in zip(mine, rows, strict=True)),
                "used": {name: [used[name], present[name]] for name in sorted(present)},
            }
        )
    alone = [one for row in rows for one in row.get("alone", [])]
    slack = [one["bound_db"] - one["actual_db"] for one in alone]
    out["bound_minus_actual_db"] = {
        "median": float(np.median(slack)) if slack else None,
        "least": float(np.min(slack)) if slack else None,
        "count": len(slack),
        "by_effect": {
            name: _median(one["bound_db"] - one["actual_db"] for one in alone if one["effect"] == name)
            for name in sorted({one["effect"] for one in alone})
        },
    }
    return out


def _median(values: Any) -> float:
    return float(np.median(list(values)))


def beat_row(seed: int, index: int, preset: str) -> tuple[float, float]:
    """Processor time of the beats of all beams of one scene, tracing and planning included: (all, auto at -20 dB)."""
    scene = random_place(seed, index, preset)
    setup, world, front_end = scene.setup, prepare(scene, index), scene.radar.front_end
    times = []
    for plan_of in (lambda: manual_plan(world, setup), lambda: plan_world(world, setup, -20.0)):
        start = time.process_time()
        for paths, flags in plan_of().groups():
            beam_beats(setup, paths, flags, front_end)
        times.append(time.process_time() - start)
    return times[0], times[1]


def draw_worst(rows: list[dict[str, Any]], seed: int, preset: str, out: Path, count: int = 10) -> None:
    """The scenes nearest to their budget of -20 dB: map of all, and where the planned one is off."""
    from mirrorwave.plots.scene import draw_scene
    from mirrorwave.plots.style import handles_of, legend_of_figure, new_figure, save

    rank = sorted(range(len(rows)), key=lambda index: -rows[index]["budgets"][1]["actual_db"])[:count]
    figure = new_figure(10.0, 2.3 * len(rank) + 0.8)
    axes = figure.subplots(len(rank), 3, squeeze=False, width_ratios=(1.0, 1.2, 1.2))
    for (first, second, third), index in zip(axes, rank, strict=True):
        scene = random_place(seed, index, preset)
        setup, world = scene.setup, prepare(scene, index)
        plan = plan_world(world, setup, -20.0, thorough=True)
        everything = manual_plan(world, setup)
        reference, rms = (
            noisy_profiles(everything, setup, index),
            noise_rms(setup, everything.signal, scene.radar.front_end),
        )
        ratio = cells_of(setup).off(reference, noisy_profiles(plan, setup, index), rms)[len(setup.beams) :]
        grid = cells_of(setup).values(reference)[len(setup.beams) :]
        draw_scene(first, scene)
        first.set_title(f"{scene.name}: {rows[index]['budgets'][1]['actual_db']:.1f} dB off", fontsize=8)
        first.set_xlabel("y, left [m]", fontsize=8)
        first.set_ylabel("x, forward [m]", fontsize=8)
        extent = (0.0, 512 * setup.radar.range_bin_m, -60.0, 60.0)
        level_db = 20.0 * np.log10(np.maximum(np.abs(grid) / rms, 1e-3))
        for axis, image, limits, name in (
            (second, level_db, (0.0, 80.0), "all effects: level over noise [dB]"),
            (third, 20.0 * np.log10(np.maximum(ratio, 1e-6)), (-80.0, -20.0), "off by [dB], budget -20 dB"),
        ):
            shown = axis.imshow(image, aspect="auto", extent=extent, origin="lower", vmin=limits[0], vmax=limits[1])
            figure.colorbar(shown, ax=axis).ax.tick_params(labelsize=8)
            axis.set_title(name, fontsize=9)
            axis.set_xlabel("range [m]", fontsize=8)
            axis.set_ylabel("azimuth [deg]", fontsize=8)
    for axis in axes.ravel():
        axis.tick_params(labelsize=8)
    legend_of_figure(figure, handles_of(*axes[:, 0]), columns=3)
    out.mkdir(parents=True, exist_ok=True)
    save(figure, out / "planner_worst.png")


def report(found: dict[str, Any]) -> None:
    for one in found["budgets"]:
        print(
            f"budget {one['budget_db']:5.0f} dB  violations {one['violations']} (quick {one['violations_quick']}) of "
            f" {found['scenes']}  actual median {one['actual_median_db']:.1f} "
            f"worst {one['actual_worst_db']:.1f} dB  all/auto median {one['ratio_median']:.2f} "
            f"(p10..p90 {one['ratio_p10_p90'][0]:.2f}..{one['ratio_p10_p90'][1]:.2f})  "
            f"paths kept {100 * one['kept_share']:.0f} %"
        )
        print("   used of present: " + ", ".join(f"{k} {u}/{p}" for k, (u, p) in one["used"].items()))
    slack = found["bound_minus_actual_db"]
    if slack["count"]:
        print(
            f"one effect dropped alone: bound minus actual, median {slack['median']:.1f} dB, least "
            f"{slack['least']:.1f} dB, {slack['count']} cases"
        )
        print("   " + ", ".join(f"{name} {value:.1f}" for name, value in slack["by_effect"].items()))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scenes", type=int, default=500)
    parser.add_argument("--alone", type=int, default=60)
    parser.add_argument("--seed", type=int, default=3)
    parser.add_argument("--preset", choices=("xband", "77ghz"), default="xband")
    parser.add_argument("--beats", type=int, default=0)
    parser.add_argument("--out", type=Path)
    parser.add_argument("--pictures", type=Path)
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
    if arguments.beats:
        times = [beat_row(arguments.seed, index, arguments.preset) for index in range(arguments.beats)]
        ratios = [everything / auto for everything, auto in times]
        found["beats_ratio_median"] = float(np.median(ratios))
        print(
            f"beat level, {len(ratios)} scenes: all/auto median {found['beats_ratio_median']:.2f}, "
            f"all {np.median([t[0] for t in times]):.2f} s, auto {np.median([t[1] for t in times]):.2f} s"
        )
    if arguments.out:
        arguments.out.write_text(json.dumps({"summary": found, "rows": rows}))
    if arguments.pictures:
        draw_worst(rows, arguments.seed, arguments.preset, arguments.pictures)


if __name__ == "__main__":
    main()
