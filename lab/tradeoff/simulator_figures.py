"""Figure of the simulator's trade-off: error of every choice beside its time, and how far a budget is kept."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes

from lab.tradeoff.simulator import SimulatorReport, SimulatorRow
from lab.tradeoff.simulator_cases import MIRRORS, SAME_DB
from mirrorwave.plots.style import BLUE, GREEN, GREY, ORANGE, VERMILION, handles_of, legend_below, new_figure, save

#: Left of the smallest budget stand the rows without one, so far apart in dB.
STEP_DB = 8.0
ERRORS = ("median", "worst")
ERROR_LABEL = "error: median place, line to the worst"


def draw_simulator(report: SimulatorReport, path: Path) -> None:
    """A panel a group; one that has no sound row stays empty. Equal numbers give equal bytes."""
    figure = new_figure(10.0, 13.0)
    names = [["budget", "budget"], ["without", "level"], ["rays", "fdtd"]]
    panels: dict[str, Axes] = figure.subplot_mosaic(names, height_ratios=(1.15, 1.2, 1.0))
    draw: dict[str, tuple[str, Callable[[Axes, list[SimulatorRow]], None]]] = {
        "budget": ("effect budget", _draw_budget),
        "level": ("signal level", _draw_levels),
        "without": ("all but", _draw_without),
        "rays": ("rays", _draw_rays),
        "fdtd": ("fdtd", _draw_cells),
    }
    for name, (group, draw_group) in draw.items():
        rows = [row for row in report.of(group) if row.times_ms["wall"].p50 is not None]
        if rows:
            draw_group(panels[name], rows)
        else:
            panels[name].set_axis_off()
    save(figure, path)


def _draw_budget(axes: Axes, rows: list[SimulatorRow]) -> None:
    """Worst cell over the budget, with the law's line; time of planning, profiles and beats on the other axis."""
    budgets = [float(row.value) for row in rows if isinstance(row.value, float)]
    lower, upper = min(budgets, default=0.0), max(budgets, default=0.0)
    words = {"all": lower - STEP_DB, "basic": lower - 2.0 * STEP_DB}
    at = np.array([words[row.value] if isinstance(row.value, str) else row.value for row in rows])
    right = axes.twinx()
    _draw_times(right, at, rows)
    # the bars lie behind
    axes.set_zorder(right.get_zorder() + 1)
    axes.patch.set_visible(False)
    median, worst = (np.array([getattr(row.errors["worst_cell_db"], name) for row in rows]) for name in ERRORS)
    differs = median > SAME_DB
    for mine in (differs & (at >= lower), differs & (at < lower)):
        reach = np.stack([np.zeros(mine.sum()), (worst - median)[mine]])
        axes.errorbar(at[mine], median[mine], reach, color=BLUE, marker="o", lw=1.8, capsize=3, label=ERROR_LABEL)
    for where in at[~differs]:
        axes.annotate("no cell differs", (where, 0.03), xycoords=("data", "axes fraction"), rotation=90, ha="center")
    axes.plot([lower, upper], [lower, upper], color=VERMILION, ls="--", lw=1.4, label="no cell may be over the budget")
    axes.set_xticks(at, [row.name for row in rows])
    axes.set_xlabel("effects of the simulation: basic, all, or planned under a budget")
    axes.set_ylabel("worst cell of a place against all effects [dB]\nmedian place, line to the worst", color=BLUE)
    axes.set_title("Error against effect budget", loc="left")
    shown = {str(handle.get_label()): handle for handle in handles_of(axes, right)}
    legend_below(axes, columns=2, handles=list(shown.values()))
    axes.grid(alpha=0.25)


def _draw_times(axes: Axes, at: np.ndarray, rows: list[SimulatorRow]) -> None:
    """Draw the time of a scan: finding the paths and asking for each effect, then its profiles, or its beats."""
    paths, signal, beats = (_medians(rows, part) for part in ("paths", "signal", "beats"))
    width = 0.2 * STEP_DB
    for side, quantity, label, colour in (
        (-0.5, signal, "signal, kernel level", ORANGE),
        (0.5, beats, "signal, beat level", GREEN),
    ):
        axes.bar(at + side * width, paths, width=width, color=GREY, alpha=0.4, label="paths and planning")
        axes.bar(at + side * width, quantity, width=width, bottom=paths, color=colour, alpha=0.5, label=label)
    axes.set_ylabel("bars: median wall time of a scan [ms]")
    axes.set_ylim(0.0, 1.3 * max(float((paths + np.maximum(signal, beats)).max()), 1e-3))


def _medians(rows: list[SimulatorRow], part: str) -> np.ndarray:
    return np.array([row.times_ms[part].p50 or 0.0 for row in rows])


def _draw_levels(axes: Axes, rows: list[SimulatorRow]) -> None:
    """Error over time, a point a level."""
    finite = [row.errors["worst_cell_db"].worst for row in rows if row.errors["worst_cell_db"].worst > SAME_DB]
    floor = min(finite, default=-100.0) - 25.0
    for index, row in enumerate(rows):
        worst, wall_ms = row.errors["worst_cell_db"].worst, row.times_ms["wall"].p50 or 0.0
        reference, up = worst <= SAME_DB, 1 if index % 2 else -1
        at = (wall_ms, max(worst, floor))
        axes.plot(*at, "v" if reference else "o", color=BLUE, ms=8)
        axes.annotate(
            f"{row.name}: the reference" if reference else row.name,
            at,
            xytext=(0, 12 * up),
            textcoords="offset points",
            ha="right" if reference else "center",
            va="center",
        )
    axes.set_xscale("log")
    axes.set_xlabel("median wall time of a scan's signal [ms]")
    axes.set_ylabel("worst cell of all places against the literal level [dB]")
    axes.set_title("Levels of signal", loc="left")
    axes.margins(x=0.25, y=0.15)
    axes.grid(alpha=0.25)


def _draw_without(axes: Axes, rows: list[SimulatorRow]) -> None:
    """Draw the effect of leaving out an effect: the worst cell of the worst place, and the time it saves."""
    whole_ms = next((row.times_ms["wall"].p50 for row in rows if row.name == "all"), None) or 0.0
    left_out = sorted(
        (row for row in rows if row.errors["worst_cell_db"].worst > SAME_DB),
        key=lambda row: row.errors["worst_cell_db"].worst,
    )
    worst = [row.errors["worst_cell_db"].worst for row in left_out]
    bottom = min(worst, default=0.0) - 5.0
    at = np.arange(len(left_out))
    axes.barh(at, np.array(worst) - bottom, left=bottom, color=BLUE, alpha=0.6)
    for where, row in zip(at, left_out, strict=True):
        spared_ms = whole_ms - (row.times_ms["wall"].p50 or 0.0)
        axes.annotate(f"{spared_ms:.0f} ms", (bottom + 1.0, where), va="center", fontsize=8)
    axes.set_yticks(at, ["every mirror" if row.name == MIRRORS else row.name for row in left_out], fontsize=8)
    axes.axvline(0.0, color=GREY, lw=0.8)
    axes.set_xlabel("worst cell of all places [dB]; number: time spared a scan")
    axes.set_title("All effects but one", loc="left")
    axes.grid(alpha=0.25, axis="x")


def _draw_rays(axes: Axes, rows: list[SimulatorRow]) -> None:
    _draw_resolution(axes, rows, "field", "rays a wavelength", "error of a body's field, share of the strongest")
    axes.set_title("Rays shot at a mesh", loc="left")


def _draw_cells(axes: Axes, rows: list[SimulatorRow]) -> None:
    _draw_resolution(axes, rows, "r", "cells a wavelength", "error of a wall's complex r, 0..80 deg")
    axes.set_title("Finite differences", loc="left")


def _draw_resolution(axes: Axes, rows: list[SimulatorRow], measure: str, finer: str, label: str) -> None:
    """Error and time over a resolution, all axes logarithmic."""
    at = [float(row.value) for row in rows]
    error = [row.errors[measure] for row in rows]
    axes.plot(at, [spread.median for spread in error], color=BLUE, marker="o", label="median case")
    axes.plot(at, [spread.worst for spread in error], color=BLUE, marker="^", ls=":", label="worst case")
    right = axes.twinx()
    wall_ms = _medians(rows, "wall")
    right.plot(at, wall_ms, color=ORANGE, marker="s")
    right.set_yscale("log")
    # whole decades, so that the axis has numbers
    right.set_ylim(10.0 ** np.floor(np.log10(wall_ms.min())), 10.0 ** np.ceil(np.log10(wall_ms.max())))
    right.set_ylabel("median wall time [ms]", color=ORANGE)
    axes.set_xscale("log", base=2)
    axes.set_yscale("log")
    axes.set_xticks(at, [f"{value:g}" for value in at])
    axes.set_xlabel(finer)
    axes.set_ylabel(label, color=BLUE)
    legend_below(axes, columns=2)
    axes.grid(alpha=0.25)
