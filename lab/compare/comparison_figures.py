"""The figure of a comparison: accuracy and level over range and roughness beside closed forms; walls, incidence."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import NullFormatter, StrMethodFormatter

from lab.compare.comparison_report import Report, Row, clear
from lab.compare.sensors import FALSE_ALARM
from lab.compare.sweeps import SWEEPS
from mirrorwave.plots.style import BLUE, GREEN, GREY, ORANGE, PAGE_INCH, VERMILION, legend_of_figure, new_figure, save

#: Colour and mark of each sensor: no two share either.
LOOKS = {
    "xband": (BLUE, "o"),
    "77ghz": (VERMILION, "s"),
    "spad": (GREY, "^"),
    "spad_gated": (ORANGE, "v"),
    "spad_long": (GREEN, "D"),
}
F1_LABEL = "recovered F1 within 1 m,\n95 % interval"
#: Closed forms are drawn down to here; levels below are noise.
LEAST_DB, LARGEST_LOSS_DB = -10.0, 60.0
#: Closed form of a row's loss.
BAND = ("least_loss_db", "most_loss_db")
#: On a logarithmic axis a smooth wall stands here, left of the least roughness by this factor.
SMOOTH_FACTOR = 0.3

Draw = Callable[[Axes, Report, str], None]
#: Height of a row of panels; those of one row share what is asked.
ROW_INCH = 2.9
#: Places of a row that a panel takes; bars of many walls need two.
WIDE = {"material": 2}


def draw_comparison(report: Report, path: Path) -> None:
    """Draw a panel for each question at the width of a page; those whose sweep did not run are left out.

    Equal numbers give equal bytes.
    """
    asked: tuple[tuple[tuple[Draw, str], ...], ...] = (
        ((_draw_f1, "range"), (_draw_f1, "range_glass"), (_draw_f1, "range_metal")),
        ((_draw_level, "range"), (_draw_level, "range_glass"), (_draw_level, "range_metal")),
        ((_draw_f1, "roughness"), (_draw_loss, "roughness"), (_draw_f1, "incidence")),
        ((_draw_bars, "material"), (_draw_bars, "places")),
    )
    rows = [drawn for row in asked if (drawn := [(draw, sweep) for draw, sweep in row if report.of(sweep)])]
    figure = new_figure(1.1 * PAGE_INCH, ROW_INCH * max(len(rows), 1) + 1.2)
    grid = figure.add_gridspec(max(len(rows), 1), 1)
    for index, row in enumerate(rows):
        widths = [WIDE.get(sweep, 1) for _, sweep in row]
        cells = grid[index].subgridspec(1, len(row), width_ratios=widths)
        for column, (draw, sweep) in enumerate(row):
            draw(figure.add_subplot(cells[column]), report, sweep)
        _one_scale(figure.axes[-len(row) :])
    for axes in figure.axes:
        axes.tick_params(labelsize=8)
        axes.xaxis.label.set_fontsize(9)
        axes.yaxis.label.set_fontsize(9)
        axes.title.set_fontsize(10)
    _legend(figure, report)
    save(figure, path, dpi=130)


def _one_scale(panels: list[Axes]) -> None:
    """Panels of a row with the same label share their vertical scale, so that they compare; the first names it."""
    for label in {axes.get_ylabel() for axes in panels}:
        alike = [axes for axes in panels if axes.get_ylabel() == label]
        low, high = min(axes.get_ylim()[0] for axes in alike), max(axes.get_ylim()[1] for axes in alike)
        for axes in alike:
            axes.set_ylim(low, high)
            axes.set_ylabel(label if axes is alike[0] else "")


def _legend(figure: Figure, report: Report) -> None:
    """All sensors, once for all panels, and what lines and bars mean."""
    shown = [
        Line2D([], [], color=LOOKS[name][0], marker=LOOKS[name][1], label=title)
        for name, title in report.sensors.items()
    ]
    shown.append(Line2D([], [], color="black", ls="--", label="closed form; band: over the object's points"))
    law = f"level passed by noise in {FALSE_ALARM:g} of cells (lower: radars, upper: photons)"
    shown.append(Line2D([], [], color="black", ls=":", label=law))
    shown.append(Line2D([], [], color="black", lw=0.0, marker="o", fillstyle="none", label="hollow: in the noise"))
    head = f"Three sensors at equal {report.equal}, one grid, one evaluation; {report.viewpoints} viewpoints a value"
    figure.suptitle(head, fontsize=11)
    legend_of_figure(figure, shown, columns=3)


def _at(rows: list[Row]) -> np.ndarray:
    """Values as numbers; a smooth wall a little left of the others, for a logarithmic axis."""
    values = np.array([float(row.value) for row in rows])
    least = values[values > 0.0].min(initial=np.inf)
    return np.where(values > 0.0, values, SMOOTH_FACTOR * (least if np.isfinite(least) else 1.0))


def _axis(axes: Axes, report: Report, sweep: str, smooth: bool = True) -> None:
    """Scale and label of a sweep; `smooth`: a perfectly smooth wall is drawn as well."""
    axes.set_xlabel(_label(sweep))
    axes.grid(alpha=0.25)
    if sweep == "incidence":
        return
    axes.set_xscale("log")
    if sweep == "roughness":
        if smooth and any(row.value == 0.0 for row in report.of(sweep)):
            axes.set_xlabel(f"{_label(sweep)},\nleftmost: perfectly smooth")
        return
    axes.set_xticks([7.0, 10.0, 15.0, 20.0, 30.0, 45.0, 70.0, 105.0])
    axes.xaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
    axes.xaxis.set_minor_formatter(NullFormatter())


def _draw_f1(axes: Axes, report: Report, sweep: str) -> None:
    """F1 within 1 m with its interval."""
    for name in report.sensors:
        rows = [row for row in report.of(sweep, name) if row.f1_1m is not None]
        colour, marker = LOOKS[name]
        bounds = [(row.f1_1m.low, row.f1_1m.value, row.f1_1m.high) for row in rows if row.f1_1m is not None]
        if not rows:
            continue
        low, value, high = np.array(bounds, np.float64).T
        axes.plot(_at(rows), value, color=colour, marker=marker, ms=4, lw=1.3)
        axes.fill_between(_at(rows), low, high, color=colour, alpha=0.13, lw=0.0)
    axes.set(ylim=(-0.03, 1.03), ylabel=F1_LABEL)
    axes.set_title(f"Accuracy {_topic(sweep)}")
    _axis(axes, report, sweep)


def _label(sweep: str) -> str:
    """A sweep's axis; the wall that the image lies behind stands in the panel's title."""
    head, behind, _ = SWEEPS[sweep].title.partition(" behind ")
    return f"{head} [m]" if behind else head


def _topic(sweep: str) -> str:
    """Return the subject of a panel, for the end of its title: a sweep's name without its unit."""
    topic = SWEEPS[sweep].title.partition(" [")[0]
    _, behind, wall = topic.partition(" behind ")
    return f"behind {wall}" if behind else f"over {topic}" if " [" in SWEEPS[sweep].title else f"by {topic}"


def _draw_level(axes: Axes, report: Report, sweep: str) -> None:
    """Strongest cell at the images, with the closed form."""
    for name in report.sensors:
        rows = [row for row in report.of(sweep, name) if row.snr_db is not None]
        colour, marker = LOOKS[name]
        if not rows:
            continue
        level_db = np.array([row.snr_db for row in rows], np.float64)
        axes.plot(_at(rows), np.where(level_db < LEAST_DB, np.nan, level_db), color=colour, marker=marker, ms=4, lw=0.0)
        expected = np.array([np.nan if row.predicted_snr_db is None else row.predicted_snr_db for row in rows])
        axes.plot(_at(rows), np.where(expected < LEAST_DB, np.nan, expected), color=colour, ls="--", lw=1.3)
    for level in sorted(set(report.threshold_db.values())):
        axes.axhline(level, color="black", ls=":", lw=1.0)
    axes.set_ylabel("strongest cell at the images\nover noise [dB], median")
    axes.set_title(f"Level {_topic(sweep)}")
    _axis(axes, report, sweep)


def _draw_loss(axes: Axes, report: Report, sweep: str) -> None:
    """Draw the loss by roughness; hollow where noise has taken over, where a level cannot fall further."""
    for name in report.sensors:
        rows = [row for row in report.of(sweep, name) if row.value and row.loss_db is not None]
        colour, marker = LOOKS[name]
        # who sees nothing in a smooth wall has nothing to lose
        if not rows or not any(clear(report, row) for row in report.of(sweep, name) if row.value == 0.0):
            continue
        at, loss_db = _at(rows), np.array([row.loss_db for row in rows], np.float64)
        over = np.array([clear(report, row) for row in rows])
        axes.plot(at[over], loss_db[over], color=colour, marker=marker, ms=4, lw=0.0)
        axes.plot(at[~over], loss_db[~over], color=colour, marker=marker, ms=4, lw=0.0, fillstyle="none")
        lower, upper = (np.array([getattr(row, name) for row in rows], np.float64) for name in BAND)
        shown = lower < LARGEST_LOSS_DB
        axes.fill_between(at[shown], lower[shown], upper[shown], color=colour, alpha=0.13, lw=0.0)
        axes.plot(at[shown], 0.5 * (lower + upper)[shown], color=colour, ls="--", lw=1.3)
    axes.set_ylabel("loss of level [dB]")
    axes.set_title("Loss by two rough bounces")
    _axis(axes, report, sweep, smooth=False)
    axes.set_ylim(-3.0, LARGEST_LOSS_DB)


def _draw_bars(axes: Axes, report: Report, sweep: str) -> None:
    """F1 within 1 m of each sensor, side by side for each value."""
    values = list(dict.fromkeys(row.value for row in report.rows if row.sweep == sweep))
    width = 0.8 / len(report.sensors)
    for index, name in enumerate(report.sensors):
        f1_by_value = {row.value: row.f1_1m for row in report.of(sweep, name)}
        for position, value in enumerate(values):
            f1, at = f1_by_value.get(value), position + (index - 0.5 * (len(report.sensors) - 1)) * width
            if f1 is None or f1.value is None:
                axes.text(
                    at, 0.01, "not known", rotation=90, ha="center", va="bottom", fontsize=8, color=LOOKS[name][0]
                )
                continue
            axes.bar(at, f1.value, width=0.92 * width, color=LOOKS[name][0])
            if f1.low is not None and f1.high is not None:
                axes.plot([at, at], [f1.low, f1.high], color="black", lw=0.9)
            # a bar of no height would look like one that is missing
            axes.plot(at, 0.0, marker=LOOKS[name][1], color=LOOKS[name][0], ms=4, clip_on=False)
    axes.set_xticks(range(len(values)), [str(value).replace("_", "\n") for value in values], fontsize=8)
    axes.set(ylim=(0.0, 1.03), ylabel=F1_LABEL)
    axes.set_title(f"Accuracy {_topic(sweep)}")
    axes.grid(alpha=0.25, axis="y")
