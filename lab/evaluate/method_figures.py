"""Picture of an evaluation: precision against recall (section 4)."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from lab.evaluate.method_report import CURVES
from mirrorwave.plots.style import (
    BLUE,
    GREEN,
    ORANGE,
    SKY,
    VERMILION,
    handles_of,
    legend_of_figure,
    new_figure,
    save,
)

#: Okabe-Ito, with a mark of its own for each when colours come round again.
COLOURS = (BLUE, VERMILION, GREEN, ORANGE, SKY, "#CC79A7", "#000000")
MARKS = "osD^vP*X"
TITLES = {
    "los": "LOS peaks",
    "mirrored": "mirrored peaks",
    "recovered_1m": "recovered places, 1 m",
    "hidden_1m": "hidden objects alone, 1 m",
}
#: Width of a figure that is read at the width of a page, and columns of its legend.
PAGE_FIGURE_INCH, LEGEND_COLUMNS = 10.0, 3


def draw_curves(report: dict[str, Any], out: Path) -> None:
    """Precision against recall over the threshold; a mark where each method works, its interval not shown."""
    columns = min(2, len(CURVES))
    rows, legend_rows = -(-len(CURVES) // columns), -(-len(report["methods"]) // LEGEND_COLUMNS)
    figure = new_figure(PAGE_FIGURE_INCH, 3.9 * rows + 0.2 * legend_rows + 0.4)
    panels = figure.subplots(rows, columns, squeeze=False)
    for axes, curve in zip(panels.ravel(), CURVES, strict=True):
        for index, method in enumerate(report["methods"]):
            line = [(point[curve]["recall"], point[curve]["precision"]) for point in method["sweep"]]
            colour, mark = _style(index)
            axes.plot(*zip(*line, strict=True), color=colour, linewidth=1.4, alpha=0.8)
            at = [point[curve] for point in method["sweep"] if point["threshold"] == method["threshold"]]
            axes.plot(
                [point["recall"] for point in at],
                [point["precision"] for point in at],
                color=colour,
                marker=mark,
                markersize=8,
                label=method["name"],
            )
        axes.set(xlim=(0.0, 1.0), ylim=(0.0, 1.02), xlabel="recall", ylabel="precision", title=TITLES[curve])
        axes.grid(alpha=0.3)
    legend_of_figure(figure, handles_of(panels[0, 0]), columns=LEGEND_COLUMNS)
    save(figure, out, dpi=100)


def _style(index: int) -> tuple[str, str]:
    return COLOURS[index % len(COLOURS)], MARKS[index % len(MARKS)]
