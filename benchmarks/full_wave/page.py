"""Table, page and picture of the comparison."""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from rich.table import Table

from benchmarks.full_wave.comparison import NAMED_DB, Comparison, Group, Roughness
from benchmarks.full_wave.lobe import LobeRow
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
#: Draws of the rough wall that have rows of their own.
SHOWN_DRAWS = 4
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
LOBES = """### The lobe over all angles

A plane wave square on rough concrete (`benchmarks/full_wave/lobe.py`): power that leaves between two angles from the
normal, over the smooth mirror, and what the lobes in the plane have over it. A surface names its lobe in
`diffuse_lobe`: `kirchhoff`, the default, or `lambert`.
"""


PLACES = """### What it changes

{places} random places, all effects, with Kirchhoff's lobe on every wall in place of Lambert's (`python -m
benchmarks.simulator.diffuse_lobe --places {places} --seed {seed}`). Cells are clear if either lobe lifts them 10 dB
over noise rms. In {maps_over_1_db} of {places} maps clear cells move by more than 1 dB.
"""
VERDICT = """The full wave decides for Kirchhoff's lobe at all angles: it is the default. Not measured:
correlation lengths of real walls (drawn from 5 to 100 mm), the lobe out of the plane (space and plane share one
expression), slopes beyond 0.2.
"""


@dataclass(frozen=True)
class RoughWalls:
    """All that is known of rough walls: their draws, the lobe over angle, and what the other lobe changes in places."""

    walls: list[Roughness]
    lobe: list[LobeRow]
    places: dict[str, Any]


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


def page(wanted: list[MiniScene], found: list[Comparison], rough: RoughWalls, options: argparse.Namespace) -> str:
    """Return the page of results in Markdown."""
    command = f"python -m benchmarks.full_wave --cells {options.cells:g} --seed {options.seed} --seeds {options.seeds}"
    draws = [scene.name for scene in wanted if scene.name.startswith("rough")]
    draws = [name for name in draws if int(name.partition("-")[2]) >= options.seed + SHOWN_DRAWS]
    wanted = [scene for scene in wanted if scene.name not in draws]
    found = [comparison for comparison in found if comparison.remainder.scene not in draws]
    parts = [INTRODUCTION.format(command=command, named=NAMED_DB)]
    parts += ["## Scenes\n", _markdown(("scene", "what", "cells", "steps"), _scene_rows(wanted, options.cells))]
    groups = [group for comparison in found for group in comparison.groups]
    rows = [(*row_of(group), _without(group)) for group in groups]
    parts += ["\n## Path groups\n", _markdown((*HEADS, "without"), rows)]
    head = ("scene", "target", "rays dB", "left over dB", "at m", "without")
    parts += ["\n## Whole runs\n", REMAINDERS, _markdown(head, _remainder_rows(found))]
    if rough.walls:
        parts += ["\n## Rough walls\n", _rough_text(rough.walls), LOBES, _lobe_text(rough.lobe)]
        parts += [PLACES.format(**rough.places), _places_text(rough.places), VERDICT]
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


def _rough_text(rough: list[Roughness]) -> str:
    return "\n".join(_wall_text(wall) for wall in rough)


def _wall_text(wall: Roughness) -> str:
    lobes = ", ".join(f"{level_db:.1f} ({lobe.capitalize()})" for lobe, level_db in wall.lobes_db.items())
    rows = [
        (
            "mirror, mean field of the draws",
            f"{wall.mean_db:.2f} +- {wall.mean_error_db:.2f}",
            f"{wall.kirchhoff_db:.2f} (Kirchhoff)",
        ),
        ("mirror, mean power in its gate", f"{wall.power_db:.2f}", ""),
        ("back from 20 to 33 deg, power", f"{wall.diffuse_db:.1f} +- {wall.diffuse_error_db:.1f}", lobes),
    ]
    head = f"{wall.about[0].upper()}{wall.about[1:]}; mean of {wall.draws} draws, dB over the smooth wall's mirror.\n"
    return head + "\n" + _markdown(("what", "full wave", "rays"), rows)


def _lobe_text(lobe: list[LobeRow]) -> str:
    rows: list[tuple[str, ...]] = [
        (
            f"{row.roughness_mm:g}",
            f"{row.angles_deg[0]:g}-{row.angles_deg[1]:g}",
            f"{row.wave_db:.1f} +- {row.error_db:.1f}",
            f"{row.lambert_db:+.1f}",
            f"{row.kirchhoff_db:+.1f}",
        )
        for row in lobe
    ]
    return _markdown(("rms height mm", "deg", "full wave dB", "Lambert dB", "Kirchhoff dB"), rows)


def _places_text(places: dict[str, Any]) -> str:
    shown = (
        ("share of clear cells that move by over 1 dB", "share_over_1_db", "{:.0%}"),
        ("power of all diffuse echoes, dB", "diffuse_db", "{:+.1f}"),
        ("of those 20 deg and more off the normal, dB", "oblique_db", "{:+.1f}"),
    )
    rows = [
        (what, *(form.format(places[name][share]) for share in ("p10", "p50", "p90"))) for what, name, form in shown
    ]
    return _markdown(("change from Lambert to Kirchhoff", "10 %", "median", "90 %"), rows)


def _without(group: Group) -> str:
    return ", ".join(
        f"{name} none" if value is None else f"{name} {value:+.2f}" for name, value in group.without.items()
    )


def _markdown(head: tuple[str, ...], rows: list[tuple[str, ...]]) -> str:
    return "\n".join(table(head, rows)) + "\n"


def draw(path: Path, wanted: list[MiniScene], found: list[Comparison]) -> None:
    """Draw the fields over delay, one panel a run that has groups, and below them the error of every group."""
    runs = [comparison for comparison in found if not comparison.remainder.scene.startswith(("rough", "wall"))]
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
    _draw_errors(
        errors, [group for run in found for group in run.groups if not run.remainder.scene.startswith("rough")]
    )
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
