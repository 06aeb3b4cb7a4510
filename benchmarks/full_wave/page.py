"""Table, page and picture of the comparison."""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
from rich.table import Table

from benchmarks.full_wave.comparison import NAMED_DB, Comparison, Group
from benchmarks.full_wave.scenes import MiniScene
from mirrorwave.plots.markdown import table
from mirrorwave.plots.style import (
    BLACK,
    GREY,
    ORANGE,
    PAGE_INCH,
    SKY,
    VERMILION,
    handles_of,
    legend_of_figure,
    new_figure,
    save,
)

#: Groups this far below the strongest of their run are beyond the aim, and drawn hollow.
CONSIDERED_DB = -30.0
#: Errors are drawn as far as this.
MAX_ERROR_DB = 4.0
#: Aims for the level: diffracted groups, all others.
AIMS_DB = (2.0, 0.5)
HEADS = (
    "scene",
    "target",
    "group",
    "round trip m",
    "strength dB",
    "level dB",
    "worst dB",
    "phase deg",
    "difference dB",
)
INTRODUCTION = """# Rays against the full wave

The ray tracer in its two-dimensional form beside a time-stepped (FDTD) solution of the same scenes: a line source at
10 GHz in vertical polarisation, the receiver in the same place, the chirp's sweep of 0.7 GHz. How it is done and what
it shows: [simulator](../explain/simulator.md#rays-against-the-full-wave). Written by

    {command}

A group is what one gate of delay holds: names of all echoes down to {named:.0f} dB below the strongest in it.
`strength` is the level of the full wave below the strongest gate of the run, `level` that of the rays over the full
wave (rms over the sweep), `worst` the largest deviation at one frequency, `phase` the mean one, `difference` that of
the complex fields. The last column names effects without which the level changes, and to what (none: no ray is left).
Aim: direct and mirrored groups within 0.5 dB, diffracted ones within 2 dB, where the group lies within 30 dB of the
strongest.

![rays against the full wave](../images/full-wave.png)
"""
REMAINDERS = """`rays`: difference of all rays to the full wave over the full wave, no gates. `left over`: what lies
outside all gates, below the strongest gate, and where it is strongest: echoes that the tracer does not have. `without`:
the difference when one effect is left out.
"""


def row_of(group: Group) -> tuple[str, ...]:
    """Return the cells of one group, without those of the effects left out."""
    low, high = group.delay_m
    delay = f"{low:.2f}" if high - low < 5e-3 else f"{low:.2f}-{high:.2f}"
    figures = (f"{group.level_db:+.2f}", f"{group.worst_db:.2f}", f"{group.phase_deg:+.1f}", f"{group.relative_db:.0f}")
    return (group.scene, group.target, group.name, delay, f"{group.strength_db:.0f}", *figures)


def as_table(found: list[Comparison]) -> Table:
    """Return all groups for the terminal."""
    table = Table(*HEADS)
    for comparison in found:
        for group in comparison.groups:
            table.add_row(*row_of(group))
    return table


def page(wanted: list[MiniScene], found: list[Comparison], options: argparse.Namespace) -> str:
    """Return the page of results in Markdown."""
    command = f"python -m benchmarks.full_wave --cells {options.cells:g}"
    parts = [INTRODUCTION.format(command=command, named=NAMED_DB)]
    parts += ["## Scenes\n", _markdown(("scene", "what", "cells", "steps"), _scene_rows(wanted, options.cells))]
    groups = [group for comparison in found for group in comparison.groups]
    rows = [(*row_of(group), _without(group)) for group in groups]
    parts += ["\n## Path groups\n", _markdown((*HEADS, "without"), rows)]
    head = ("scene", "target", "rays dB", "left over dB", "at m", "without")
    parts += ["\n## Whole runs\n", REMAINDERS, _markdown(head, _remainder_rows(found))]
    return "\n".join(parts)


def _scene_rows(wanted: list[MiniScene], cells: float) -> list[tuple[str, ...]]:
    rows = []
    for scene in wanted:
        grid = scene.grid(cells)
        steps = scene.longest_m / (0.7 * grid.cell_m)
        rows.append((scene.name, scene.about, f"{grid.cells[0]} x {grid.cells[1]}", f"{steps:.0f}"))
    return rows


def _remainder_rows(found: list[Comparison]) -> list[tuple[str, ...]]:
    rows = []
    for row in (comparison.remainder for comparison in found):
        without = ", ".join(f"{name} {value:.1f}" for name, value in row.without.items())
        rows.append(
            (row.scene, row.target, f"{row.relative_db:.1f}", f"{row.strength_db:.0f}", f"{row.delay_m:.2f}", without)
        )
    return rows


def _without(group: Group) -> str:
    return ", ".join(
        f"{name} none" if value is None else f"{name} {value:+.2f}" for name, value in group.without.items()
    )


def _markdown(head: tuple[str, ...], rows: list[tuple[str, ...]]) -> str:
    return "\n".join(table(head, rows)) + "\n"


def draw(path: Path, wanted: list[MiniScene], found: list[Comparison]) -> None:
    """Draw the fields over delay, one panel a run that has groups, and below them the error of every group."""
    runs = [comparison for comparison in found if not comparison.remainder.scene.startswith("wall")]
    rows = -(-len(runs) // 3)
    figure = new_figure(PAGE_INCH, 1.55 * rows + 2.8)
    grid = figure.add_gridspec(rows + 1, 3, height_ratios=[1.0] * rows + [1.7])
    panels = [figure.add_subplot(grid[index // 3, index % 3]) for index in range(len(runs))]
    for axes, run in zip(panels, runs, strict=True):
        top = float(run.waves_db.max())
        axes.plot(run.delay_m, run.waves_db - top, color=BLACK, lw=1.2, label="full wave")
        axes.plot(run.delay_m, run.rays_db - top, color=ORANGE, lw=1.0, ls="--", label="rays, all effects")
        longest = max(group.delay_m[1] for group in run.groups)
        axes.set(xlim=(0.5, longest + 0.8), ylim=(-60.0, 5.0))
        axes.set_title(f"{run.remainder.scene}: {run.remainder.target}", fontsize=8)
        axes.tick_params(labelsize=7)
        axes.grid(alpha=0.3)
    panels[0].set_ylabel("dB", fontsize=8)
    panels[-1].set_xlabel("round trip (m)", fontsize=8)
    errors = figure.add_subplot(grid[rows, :])
    _draw_errors(errors, [group for run in found for group in run.groups])
    legend_of_figure(figure, handles_of(panels[0], errors), 5)
    save(figure, path)


def _draw_errors(axes, groups: list[Group]) -> None:  # type: ignore[no-untyped-def]
    """Draw the level of every group: those within 30 dB of the strongest full, the others hollow."""
    names = sorted({_kind(group) for group in groups}, key=_KINDS.index)
    for near, label in ((True, "level of a group, within 30 dB of the strongest"), (False, "weaker group")):
        shown = [group for group in groups if (group.strength_db >= CONSIDERED_DB) == near]
        places = [names.index(_kind(group)) for group in shown]
        spread = np.linspace(-0.25, 0.25, max(len(shown), 1))
        levels = np.clip([group.level_db for group in shown], -MAX_ERROR_DB, MAX_ERROR_DB)
        axes.plot(
            np.array(places) + spread,
            levels,
            "o",
            ms=5,
            color=VERMILION if near else GREY,
            mfc=VERMILION if near else "none",
            label=label,
        )
    for index, name in enumerate(names):
        aim = AIMS_DB[0] if "diffracted" in name else AIMS_DB[1]
        axes.fill_between([index - 0.4, index + 0.4], -aim, aim, color=SKY, alpha=0.35, lw=0, label="aim")
    axes.set_xticks(range(len(names)), names, fontsize=8)
    axes.set_ylabel("rays over full wave (dB)", fontsize=8)
    axes.set_ylim(-1.05 * MAX_ERROR_DB, 1.05 * MAX_ERROR_DB)
    axes.tick_params(axis="y", labelsize=7)
    axes.grid(axis="y", alpha=0.3)


_KINDS = ["flash", "end", "direct", "mirrored", "twice mirrored", "mixed", "diffracted", "several"]


def _kind(group: Group) -> str:
    """Return the column of a group in the picture."""
    parts = set(group.name.split(" + "))
    for kind, names in {
        "flash": {"flash"},
        "end": {"end"},
        "direct": {"direct"},
        "mirrored": {"mirrored"},
        "twice mirrored": {"twice mirrored", "radar twice mirrored"},
        "mixed": {"mixed", "mixed, twice mirrored"},
        "diffracted": {"diffracted", "diffracted, mixed", "diffracted, mixed, twice mirrored"},
    }.items():
        if parts <= names:
            return kind
    return "several"
