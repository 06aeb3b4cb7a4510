"""The labelled slice from above over the radar's map."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from contrib.annotate.labelled_frames import Annotated
from contrib.annotate.slice_labels import PointLabel
from lab.training.data.xradarnlos import REAL_RANGE_M, Kind, grid_of
from mirrorwave.plots.style import (
    GREY,
    MIRROR_IMAGE,
    SEEN_DIRECTLY,
    SKY,
    TRUTH,
    WALL,
    handles_of,
    legend_of_figure,
    new_figure,
    save,
)
from msgs.values.frames import xy_from_polar

DYNAMIC_RANGE_DB = 50.0


def draw_annotation(done: Annotated, kind: Kind, out_path: Path) -> None:
    """Write the picture (format by the suffix): map in grey, points by what the labels say, fitted walls."""
    figure = new_figure(7.5, 8.6)
    axes = figure.subplots()
    grid = grid_of(kind)
    range_m = np.linspace(*REAL_RANGE_M, grid.range_bins) if kind == "real" else grid.range_m
    power = done.values if kind == "real" else np.abs(done.values.astype(np.complex128)) ** 2
    level_db = 10.0 * np.log10(np.maximum(power / max(float(power.max()), 1e-300), 1e-12))
    cells_m = xy_from_polar(*np.meshgrid(range_m, grid.azimuth_rad, indexing="ij"))
    mesh = axes.pcolormesh(
        cells_m[..., 1], cells_m[..., 0], level_db, cmap="Greys", vmin=-DYNAMIC_RANGE_DB, vmax=10.0,
        shading="nearest", rasterized=True,
    )  # fmt: skip
    figure.colorbar(mesh, ax=axes, label="power below the map's strongest cell [dB]", shrink=0.8)
    labels = done.labels
    for index, (a, b) in enumerate(labels.walls_m):
        label = "fitted wall" if index == 0 else None
        axes.plot([a[1], b[1]], [a[0], b[0]], color=WALL, linewidth=1.2, zorder=3, label=label)
    on_wall = labels.label == PointLabel.WALL
    groups = (
        ("wall, seen directly", labels.points_m[on_wall & labels.visible], "o", SKY, 9),
        ("wall, out of sight", labels.points_m[on_wall & ~labels.visible], "o", GREY, 6),
        ("object, seen directly", labels.points_m[labels.label == PointLabel.LOS], "s", SEEN_DIRECTLY, 16),
        ("hidden object", labels.hidden_m, "s", TRUTH, 12),
        ("mirror image of it", labels.image_m, "D", MIRROR_IMAGE, 14),
    )
    for name, points_m, marker, colour, size in groups:
        if len(points_m):
            axes.scatter(points_m[:, 1], points_m[:, 0], s=size, marker=marker, color=colour, label=name, zorder=4)
    axes.plot(0.0, 0.0, marker="^", markersize=12, color="black", markeredgecolor="white", zorder=5)
    every = np.concatenate([np.zeros((1, 2)), labels.points_m, labels.image_m])
    low, high = every.min(axis=0) - 2.0, every.max(axis=0) + 2.0
    axes.set(xlim=(high[1], low[1]), ylim=(low[0], high[0]), xlabel="y, left [m]", ylabel="x, forward [m]")
    axes.set_aspect("equal")
    legend_of_figure(figure, handles_of(axes), columns=3)
    axes.set_title(f"{done.report['name']}: labels of the slice over the radar's map", fontsize=11)
    save(figure, out_path, dpi=130)
