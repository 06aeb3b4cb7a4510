"""Figures of the trade-off: the front of accuracy over latency, and where the time goes."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from matplotlib.ticker import LogLocator, NullFormatter, StrMethodFormatter

from lab.tradeoff.row_report import Report, Row, point_of
from lab.tradeoff.row_runs import PARTS
from lab.tradeoff.rows import PROFILE
from mirrorwave.plots.style import BLACK, VERMILION, handles_of, legend_of_figure, new_figure, save
from msgs.values.wording import counted

PART_OF = {"ra_former": "forming", "dense_predictor": "detection", "geometry": "geometry"}
COLOURS = {"transport": "#9aa5b1", "forming": "#3b6fb6", "detection": "#d9822b", "geometry": "#3d9970"}


def draw_front(report: Report, path: Path) -> None:
    """F1 of objects over median latency with the deadline; the front is joined and numbered, profiles are named."""
    rows = [row for row in report.rows if point_of(row) is not None]
    figure = new_figure(10.0, 7.6)
    axes = figure.subplots()
    profiles = {row.name: row for row in report.rows if row.switch == PROFILE}
    for row in rows:
        _draw_point(axes, row, _colour(row, profiles.get(row.over)))
    _name_profiles(axes, [row for row in rows if row.switch == PROFILE])
    ordered = sorted((row for row in rows if row.pareto), key=lambda row: point_of(row) or (0.0, 0.0))
    front = [point for row in ordered if (point := point_of(row))]
    for number, point in enumerate(front, 1):
        axes.annotate(str(number), point, xytext=(0, 7), textcoords="offset points", fontsize=9, ha="center")
    axes.step(
        *np.reshape(front, (-1, 2)).T,
        where="post",
        color=BLACK,
        lw=1.2,
        label="front: nothing here is both faster and better",
    )
    axes.axvline(report.deadline_ms, color=VERMILION, ls="--", lw=1.2, label="deadline: the next scan is there")
    axes.set_xscale("log")
    axes.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 3.0, 5.0, 7.0)))
    axes.xaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
    axes.xaxis.set_minor_formatter(NullFormatter())
    axes.set_xlabel("from the last beam to the view: median, line to the 99th percentile [ms]")
    axes.set_ylabel("hidden objects found within 1 m, F1, with its 95 % interval")
    axes.set_title(
        f"What accuracy costs in time: {counted(len(rows), 'setting')} on the same {counted(report.frames, 'place')}",
        loc="left",
    )
    axes.grid(alpha=0.25, which="both")
    for part in ("forming", "detection", "geometry"):
        axes.plot([], [], "o", color=COLOURS[part], label=f"changes {part} alone")
    axes.plot([], [], "o", color=BLACK, label="changes several")
    axes.plot([], [], "s", color=VERMILION, label="profile")
    numbers = [
        Line2D([], [], ls="", marker=f"${number}$", color=BLACK, ms=6, label=f"on the front: {row.name}")
        for number, row in enumerate(ordered, 1)
    ]
    legend_of_figure(figure, [*handles_of(axes), *numbers], columns=2)
    save(figure, path)


def _draw_point(axes: Axes, row: Row, colour: str) -> None:
    point, total, accuracy = point_of(row), row.end_to_end_ms, row.accuracy["object_f1"]
    if point is None or total is None:
        return
    profile = row.switch == PROFILE
    slow = total.p99 or total.p90 or point[0]
    axes.plot([point[0], slow], [point[1]] * 2, color=colour, lw=0.7, alpha=0.6)
    if accuracy.low is not None and accuracy.high is not None:
        axes.plot([point[0]] * 2, [accuracy.low, accuracy.high], color=colour, lw=0.7, alpha=0.4)
    axes.plot(*point, "s" if profile else "o", color=colour, ms=8 if profile else 5)


def _name_profiles(axes: Axes, rows: Sequence[Row]) -> None:
    """Write the names of profiles beside their points; those of the same parameters share one."""
    names: dict[tuple[float, float], list[str]] = {}
    for row in rows:
        if point := point_of(row):
            names.setdefault(point, []).append(row.name)
    for point, shared in names.items():
        text = ", ".join(shared)
        axes.annotate(text, point, xytext=(4, -15), textcoords="offset points", fontsize=10, weight="bold", zorder=5)


def _colour(row: Row, profile: Row | None) -> str:
    """Return the colour of the stage that a row changes of its profile; profiles and rows that change several have
    their own.
    """
    if row.switch == PROFILE:
        return VERMILION
    before = {} if profile is None else profile.params
    changed = [part for stage, part in PART_OF.items() if row.params.get(stage) != before.get(stage)]
    return COLOURS[changed[0]] if len(changed) == 1 else BLACK


def draw_stages(report: Report, path: Path) -> None:
    """Median time of each part of every row, fastest first."""
    rows = sorted((row for row in report.rows if point_of(row) is not None), key=lambda row: point_of(row) or (0, 0))
    figure = new_figure(10.0, 1.8 + 0.24 * len(rows))
    axes = figure.subplots()
    left, at = np.zeros(len(rows)), np.arange(len(rows))
    for part in PARTS:
        widths = np.array([row.stages_ms[part].p50 or 0.0 for row in rows])
        axes.barh(at, widths, left=left, color=COLOURS[part], label=part, height=0.8)
        left += widths
    axes.set_yticks(at, [row.name for row in rows], fontsize=8)
    axes.invert_yaxis()
    axes.margins(y=0.01)
    axes.set_xlabel("median time of each part [ms]")
    axes.set_title("Where the time goes after the last beam", loc="left")
    # above: the figure may be longer than a screen
    legend_of_figure(figure, handles_of(axes), columns=len(PARTS), loc="outside upper center")
    axes.grid(alpha=0.25, axis="x")
    save(figure, path)
