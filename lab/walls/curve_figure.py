"""Pictures of what walls reflect and let through over angle."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np

from lab.walls.curves import Answer, answer, field_db
from lab.walls.wall_question import Method, Wall, title_of
from mirrorwave.plots.style import handles_of, legend_of_figure, new_figure, save


def draw_wall_curves(wall: Wall, answers: list[Answer], path: Path) -> None:
    """Write a picture of R, specular gain (where rough) and T (where any) over angle; marks are simulated waves."""
    panels = {"reflection |r|² [dB]": lambda curves: field_db(curves.r)}
    if wall.roughness_m > 0.0:
        title = f"specular gain [dB], roughness {1e3 * wall.roughness_m:g} mm"
        panels[title] = lambda curves: field_db(curves.specular_gain**0.5)
    if any(abs(answer.te.t).max() > 0.0 for answer in answers):
        panels["transmission |t|² [dB]"] = lambda curves: field_db(curves.t)
    figure = new_figure(0.6 + 3.2 * max(len(panels), 2), 4.6)
    for axes, (title, level_db) in zip(figure.subplots(1, len(panels), squeeze=False)[0], panels.items(), strict=True):
        _draw_panel(axes, title, level_db, wall, answers)
    legend_of_figure(figure, handles_of(axes), columns=4)
    figure.suptitle(title_of(wall), fontsize=12)
    save(figure, path, dpi=120)


def _draw_panel(axes: Any, title: str, level_db: Any, wall: Wall, answers: list[Answer]) -> None:
    """Lines of the exact curves over a fine grid: a colour a frequency, solid TE, dashed TM."""
    exact = dataclasses.replace(wall, method=Method.EXACT)
    lowest = -3.0
    for colour, result in zip(
        ("#0072B2", "#D55E00", "#009E73", "#E69F00", "#555555") * len(answers), answers, strict=False
    ):
        angles_deg = np.linspace(result.angles_deg[0], result.angles_deg[-1], 361)
        fine = answer(exact, result.frequency_hz, angles_deg)
        for name, style, mark in (("te", "-", "o"), ("tm", "--", "s")):
            label = ", ".join([f"{result.frequency_hz / 1e9:g} GHz {name.upper()}", *result.note.split()[:1]])
            level = level_db(getattr(fine, name))
            axes.plot(angles_deg, level, style, color=colour, label=label, linewidth=1.6)
            if wall.method is Method.FDTD:
                axes.plot(
                    result.angles_deg, level_db(getattr(result, name)), mark, color=colour, markersize=4, label="_"
                )
            lowest = min(lowest, float(np.nanmin(level)) if np.isfinite(level).any() else 0.0)
    axes.set_title(title, fontsize=10)
    axes.set_xlabel("angle of incidence [deg]")
    axes.set_ylim(max(1.08 * lowest, -100.0 if "transmission" in title else -50.0), 1.0)
    axes.grid(color="#DDDDDD", linewidth=0.6)
    axes.spines[["top", "right"]].set_visible(False)
