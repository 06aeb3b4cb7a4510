"""Picture of what is found against false reports."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from mirrorwave.plots.style import handles_of, legend_of_figure, new_figure, save

#: Panels side by side at most.
COLUMNS = 2


def draw_curves(sets: Mapping[str, Mapping[str, Any]], path: Path) -> None:
    """Write the curve of recall against false reports of every profile, a panel a set, as far as thresholds let it."""
    columns = min(COLUMNS, len(sets))
    rows = math.ceil(len(sets) / columns)
    figure = new_figure(4.2 * columns, 0.6 + 3.2 * rows)
    panels = figure.subplots(rows, columns, squeeze=False, sharey=True).flat
    for axes in panels[len(sets) :]:
        axes.set_axis_off()
    for axes, (name, set_report) in zip(panels, sets.items(), strict=False):
        for profile, report in set_report["profiles"].items():
            points = report.recall_at_false
            axes.plot([float(rate) for rate in points], list(points.values()), "o-", markersize=4, label=profile)
        axes.set(xscale="log", xlim=(0.015, 1.3), ylim=(0.0, 1.0), xlabel="false reports a scan", title=name)
        axes.set_xticks([0.02, 0.05, 0.1, 0.24, 0.5, 1.0], ["0.02", "0.05", "0.1", "0.24", "0.5", "1"])
        axes.minorticks_off()
        axes.grid(color="#DDDDDD", linewidth=0.6)
    panels[0].set_ylabel("found, of one mirror at 25 dB on")
    legend_of_figure(figure, handles_of(panels[0]), columns=columns)
    save(figure, path)
