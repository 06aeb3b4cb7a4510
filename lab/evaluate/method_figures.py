"""Pictures of an evaluation: scenes side by side (section 4)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from lab.evaluate.method_runs import Run
from lab.measures.frame_scores import FrameAnswer, FrameTruth
from lab.training.data.frames import Frame
from mirrorwave.plots.bird_eye_view import DYNAMIC_RANGE_DB
from mirrorwave.plots.style import (
    BLUE,
    GREEN,
    GREY,
    ORANGE,
    SKY,
    VERMILION,
    handles_of,
    legend_of_figure,
    new_figure,
    save,
)
from msgs.values.frames import xy_from_polar
from msgs.values.perception import PathClass
from msgs.values.radar import RangeAzimuthMap

TRUE_PLACE = "true position of a mirror image"
#: Scenes of the qualitative figure, and those of a picture, wide enough to be read.
SHOWN, COLUMNS = 9, 3
SCENE_INCH = 4.2


def shown_frames(run: Run) -> list[int]:
    """Positions of the frames of the qualitative figure: evenly over those with something hidden, chosen by nothing."""
    with_hidden = [position for position, truth in enumerate(run.truth) if len(truth.hidden_m)]
    if not with_hidden:
        return []
    return [with_hidden[index] for index in np.unique(np.linspace(0, len(with_hidden) - 1, SHOWN).astype(int))]


@dataclass(frozen=True)
class _Column:
    """One scene of the qualitative figure."""

    frame: Frame
    truth: FrameTruth
    answers: list[FrameAnswer]
    limits_m: tuple[float, float]


def draw_scenes(run: Run, frames: Sequence[Frame], positions: Sequence[int], reference: str, out: Path) -> None:
    """Write pictures of three scenes, a column each: `out`, and with -2, -3 behind its name those that do not fit.

    Rows: from above, the map, the peaks of the first method and of the reference, the places the reference recovers.
    """
    columns = [
        _Column(
            frame, run.truth[position], [item.answers[position] for item in run.runs], _limits_m(run.truth[position])
        )
        for frame, position in zip(frames, positions, strict=True)
    ]
    names = [method_run.method.name for method_run in run.runs]
    shown = list(dict.fromkeys((0, names.index(reference))))
    labels = ["scene", "map", *(f"{names[index]}: peaks" for index in shown), f"{reference}: recovered"]
    for start in range(0, len(columns), COLUMNS):
        part = columns[start : start + COLUMNS]
        figure, panels = scene_panels(labels, len(part))
        for index, column in enumerate(part):
            _draw_column(panels[:, index], column, shown)
        legend_of_figure(figure, handles_of(*panels[2:].ravel(), *panels[0]), columns=len(part), fontsize=10)
        save(figure, out if not start else out.with_stem(f"{out.stem}-{start // COLUMNS + 1}"), dpi=100)


def scene_panels(labels: Sequence[str], columns: int) -> tuple[Figure, np.ndarray]:
    """Return a figure of a column a scene, with its rows named."""
    figure = new_figure(SCENE_INCH * columns + 0.6, SCENE_INCH * len(labels))
    panels = figure.subplots(len(labels), columns, squeeze=False)
    for axes, label in zip(panels[:, 0], labels, strict=True):
        axes.set_ylabel(label, fontsize=12)
    return figure, panels


def _draw_column(panels: np.ndarray, column: _Column, shown: Sequence[int]) -> None:
    _draw_scene(panels[0], column)
    draw_map(panels[1], column.frame.ra_map, column.limits_m)
    for axes, index in zip(panels[2:-1], shown, strict=True):
        draw_peaks(axes, column.truth, column.answers[index])
    _draw_places(panels[-1], column.truth, column.answers[shown[-1]])
    panels[0].set_title(f"{column.frame.index}: {column.frame.place or column.frame.sequence}", fontsize=11)
    forward, side = column.limits_m
    for axes in panels:
        axes.set(xlim=(side, -side), ylim=(-2.0, forward), aspect="equal")
        axes.plot(0.0, 0.0, marker="^", color="black", markersize=6)
        axes.tick_params(labelsize=9)


def _draw_scene(axes: Axes, column: _Column) -> None:
    if column.frame.scene_yaml:
        from mirrorwave.plots.scene import draw_scene
        from sim_player.scene.description import scene_from_yaml

        draw_scene(axes, scene_from_yaml(column.frame.scene_yaml))
    _draw_truth(axes, column.truth)
    places_m = column.truth.places_m
    axes.scatter(
        places_m[:, 1],
        places_m[:, 0],
        s=22,
        facecolors="none",
        edgecolors=GREEN,
        linewidths=1.0,
        zorder=6,
        label=TRUE_PLACE,
    )


def _draw_truth(axes: Axes, truth: FrameTruth) -> None:
    """Truth points as they appear: dots and crosses in grey."""
    for path_class, mark, label in (
        (PathClass.LOS, ".", "true direct"),
        (PathClass.MIRRORED, "x", "true mirror image"),
    ):
        points_m = truth.points_m[truth.path_class == path_class]
        axes.scatter(
            points_m[:, 1], points_m[:, 0], s=9, marker=mark, color=GREY, linewidths=0.6, alpha=0.7, label=label
        )


def draw_map(axes: Axes, ra_map: RangeAzimuthMap, limits_m: tuple[float, float]) -> None:
    """Draw a map in the plane, as far forward and sideways as the limits."""
    grid = ra_map.grid
    forward, side = limits_m
    bins = min(int(np.hypot(forward, side) / grid.range_bin_m) + 2, grid.range_bins)
    power = np.square(np.abs(ra_map.values[:bins, ::2])).astype(np.float64)
    level_db = 10.0 * np.log10(np.maximum(power, 1e-30))
    centres = xy_from_polar(*np.meshgrid(grid.range_m[:bins], grid.azimuth_rad[::2], indexing="ij"))
    top = float(level_db.max())
    axes.set_facecolor("black")
    axes.pcolormesh(
        centres[..., 1],
        centres[..., 0],
        level_db,
        cmap="cividis",
        vmin=top - DYNAMIC_RANGE_DB,
        vmax=top,
        shading="nearest",
        rasterized=True,
    )


def draw_peaks(axes: Axes, truth: FrameTruth, answer: FrameAnswer) -> None:
    """Draw peaks by class over the truth."""
    _draw_truth(axes, truth)
    for path_class, colour, mark, label in (
        (PathClass.LOS, BLUE, "o", "peak taken as direct"),
        (PathClass.MIRRORED, ORANGE, "D", "peak taken as mirror image"),
    ):
        points_m = answer.points_m[answer.path_class == path_class]
        axes.scatter(
            points_m[:, 1], points_m[:, 0], s=16, marker=mark, facecolors="none", edgecolors=colour, linewidths=1.0,
            label=label,
        )  # fmt: skip


def _draw_places(axes: Axes, truth: FrameTruth, answer: FrameAnswer) -> None:
    """Recovered places, the true ones about them; those of objects that mirrors alone show are filled."""
    direct_m = answer.points_m[answer.path_class == PathClass.LOS]
    marks: tuple[tuple[np.ndarray, dict[str, Any]], ...] = (
        (direct_m, {"s": 6, "color": SKY, "label": "direct peak"}),
        (truth.places_m, {"s": 34, "facecolors": "none", "edgecolors": GREEN, "linewidths": 1.2, "label": TRUE_PLACE}),
        (truth.hidden_m, {"s": 34, "color": GREEN, "alpha": 0.4, "label": "of an object that mirrors alone show"}),
        (answer.recovered_m, {"s": 26, "marker": "x", "color": VERMILION, "linewidths": 1.2, "label": "recovered"}),
    )
    for points_m, style in marks:
        axes.scatter(points_m[:, 1], points_m[:, 0], **style)


def _limits_m(truth: FrameTruth) -> tuple[float, float]:
    """Forward and sideways reach that shows the truth."""
    every = np.concatenate([truth.points_m, truth.places_m, [[20.0, 10.0]]])
    forward, side = np.quantile(every[:, 0], 0.98) + 4.0, np.quantile(np.abs(every[:, 1]), 0.98) + 4.0
    return float(max(forward, 1.2 * side)), float(max(side, 0.6 * forward))
