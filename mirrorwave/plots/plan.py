"""Picture of a plan: maps with all effects and as planned, what that changes under its law, and the time it saves."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TypeVar, cast

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import SubFigure

from mirrorwave.plots.style import BLUE, GREEN, GREY, ORANGE, SKY, legend_below, new_figure, save
from msgs.values.radar import RangeAzimuthGrid
from msgs.values.wording import counted
from sim_player.planner.cells import cells_of
from sim_player.planner.plan import Plan, clean_profiles, manual_plan, plan_world
from sim_player.signal.levels import noise_profiles, noise_rms

T = TypeVar("T")
#: Level of the maps over the noise, and of what is changed, in dB.
LEVEL_DB, LEAST_DB = (0.0, 60.0), -60.0
#: Parts of a plan's time as the bar names them, and their colours, what is saved last.
PARTS = {"trace": "trace", "choose": "questions", "evaluate": "signal of what is left"}
COLOURS = (ORANGE, SKY, BLUE, GREEN)


def write_plan(out: Path, plan: Plan, seed: int = 0) -> None:
    """Write the picture of a plan; of a scene that moves the first instant, with the paths of its first span."""
    setup, world = plan.setup, plan.view.world
    front_end = world.scene.radar.front_end
    # compiled and cached before anything is timed
    everything, _ = _everything(plan)
    all_s, (everything, wanted) = _timed(lambda: _everything(plan))
    parts, planned = _planned(plan)
    noise = noise_profiles(setup, seed, everything.signal, front_end)
    rms = noise_rms(setup, everything.signal, front_end)
    cells = cells_of(setup)
    off = cells.off(wanted + noise, planned + noise, rms, plan.purpose)[len(setup.beams) :]
    figure = new_figure(11.0, 6.2)
    upper, lower = cast("tuple[SubFigure, SubFigure]", figure.subfigures(2, 1, height_ratios=(4.6, 1.6)))
    axes = upper.subplots(1, 3)
    figure.suptitle(_title(plan), fontsize=11)
    map_rms = cells.floor(np.zeros_like(wanted), rms)[len(setup.beams) :]
    for axis, profiles, name in ((axes[0], wanted, "all effects"), (axes[1], planned, "as planned")):
        level_db = 20.0 * np.log10(np.maximum(np.abs(cells.values(profiles + noise)[len(setup.beams) :]), 1e-30))
        level_db -= 20.0 * np.log10(map_rms)
        _show(axis, level_db, LEVEL_DB, f"{name}: level over noise [dB]", setup.radar.range_bin_m)
    changed_db = 20.0 * np.log10(np.maximum(off, 1e-9))
    budget_db = 0.0 if math.isinf(plan.budget_db) else plan.budget_db
    worst = f"change over the law's reference [dB]\nworst {changed_db.max():.0f}, budget {budget_db:g}"
    _show(axes[2], changed_db, (LEAST_DB, budget_db), worst, setup.radar.range_bin_m)
    _bar(lower.subplots(), all_s, parts)
    save(figure, out)


def _title(plan: Plan) -> str:
    used = f"{sum(effect.used for effect in plan.effects)} of {counted(len(plan.effects), 'effect')}"
    what = "chosen by hand" if math.isinf(plan.budget_db) else f"for {plan.purpose}"
    return f"{plan.view.world.scene.name}: {used}, {len(plan.echoes)} of {counted(plan.traced, 'path')}, {what}"


def _timed(call: Callable[[], T]) -> tuple[float, T]:
    start = time.process_time()
    answer = call()
    return time.process_time() - start, answer


def _still(plan: Plan) -> Plan:
    """Return a plan without motion, as maps of one instant have it."""
    return replace(plan, effects=tuple(effect for effect in plan.effects if effect.name != "motion"))


def _everything(plan: Plan) -> tuple[Plan, np.ndarray]:
    """Return the plan of everything and its profiles, at one instant."""
    everything = _still(manual_plan(plan.view.world, plan.setup))
    return everything, clean_profiles(everything, plan.setup)


def _planned(plan: Plan) -> tuple[dict[str, float], np.ndarray]:
    """Return the times of a plan's parts and of the profiles of what is left, and these."""
    world, setup = plan.view.world, plan.setup

    def asked() -> Plan:
        if math.isinf(plan.budget_db):
            return manual_plan(world, setup, plan.used)
        return plan_world(world, setup, plan.budget_db, purpose=plan.purpose, profiles_only=True)

    asked()
    plan_s, again = _timed(asked)
    still = _still(again)
    if again.weakest is not None:
        kept = np.any([again.weakest.selected(again.paths, beam)[0] for beam in range(len(setup.beams))], axis=0)
        still = replace(still, echoes=again.echoes.take(kept))
    clean_profiles(still, setup)
    signal_s, planned = _timed(lambda: clean_profiles(still, setup))
    whole_s = sum(again.timing_s.values())
    parts = {PARTS[name]: taken_s / whole_s * plan_s for name, taken_s in again.timing_s.items()}
    parts[PARTS["evaluate"]] = parts.get(PARTS["evaluate"], 0.0) + signal_s
    return parts, planned


def _show(axis: Axes, image: np.ndarray, limits: tuple[float, float], name: str, range_bin_m: float) -> None:
    """Draw one map, range up and azimuth to the left."""
    grid = RangeAzimuthGrid()
    far_m, side_deg = image.shape[1] * range_bin_m, float(np.degrees(grid.azimuth_rad[-1]))
    shown = axis.imshow(
        image.T, origin="lower", aspect="auto", extent=(-side_deg, side_deg, 0.0, far_m), vmin=limits[0], vmax=limits[1]
    )
    axis.set(xlabel="azimuth, left [deg]", ylabel="range [m]")
    axis.invert_xaxis()
    axis.set_title(name, fontsize=9)
    assert axis.figure is not None
    axis.figure.colorbar(shown, ax=axis)


def _bar(axis: Axes, all_s: float, parts: dict[str, float]) -> None:
    """Draw the time of everything as one bar: kept, and saved."""
    at, left = 0.0, {"saved": max(all_s - sum(parts.values()), 0.0)}
    for (name, taken_s), colour in zip((parts | left).items(), COLOURS[-len(parts) - 1 :], strict=True):
        axis.barh(0.0, 1e3 * taken_s, left=at, color=colour, label=f"{name}, {1e3 * taken_s:.1f} ms")
        at += 1e3 * taken_s
    axis.axvline(1e3 * all_s, color=GREY, linestyle="--", label=f"all effects, {1e3 * all_s:.1f} ms")
    axis.set(yticks=[], xlabel="time of one map at the kernel level, of one core [ms]")
    legend_below(axis, columns=5)
