"""The labelled slice from above over the radar's map."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from mirrorwave.annotate_run import Annotated
from models.perception.slice_labels import PointLabel
from models.training.xradarnlos import REAL_RANGE_M, Kind, grid_of
from msgs.frames import xy_from_polar

SKY, GREEN, ORANGE, BLUE = "#56B4E9", "#009E73", "#E69F00", "#0072B2"
DYNAMIC_RANGE_DB = 50.0


def draw_annotation(done: Annotated, kind: Kind, out_path: Path) -> None:
    """Write the picture (format by the suffix): map in grey, LOS, hidden, mirrored and wall points, fitted walls."""
    figure = Figure(figsize=(9.0, 8.0), layout="constrained")
    FigureCanvasAgg(figure)
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
        axes.plot([a[1], b[1]], [a[0], b[0]], color=BLUE, linewidth=1.2, zorder=3, label=label)
    on_wall = labels.label == PointLabel.WALL
    groups = (
        ("wall, in sight (LOS)", labels.points_m[on_wall & labels.visible], "o", SKY, 9),
        ("wall, out of sight", labels.points_m[on_wall & ~labels.visible], "o", "#BBBBBB", 6),
        ("object, in sight (LOS)", labels.points_m[labels.label == PointLabel.LOS], "s", BLUE, 16),
        ("hidden", labels.hidden_m, "s", GREEN, 12),
        ("mirrored", labels.image_m, "D", ORANGE, 14),
    )
    for name, points_m, marker, colour, size in groups:
        if len(points_m):
            axes.scatter(points_m[:, 1], points_m[:, 0], s=size, marker=marker, color=colour, label=name, zorder=4)
    axes.plot(0.0, 0.0, marker="^", markersize=12, color="black", markeredgecolor="white", zorder=5)
    every = np.concatenate([np.zeros((1, 2)), labels.points_m, labels.image_m])
    low, high = every.min(axis=0) - 2.0, every.max(axis=0) + 2.0
    axes.set(xlim=(high[1], low[1]), ylim=(low[0], high[0]), xlabel="y, left [m]", ylabel="x, forward [m]")
    axes.set_aspect("equal")
    axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.08), ncols=3, frameon=False, fontsize=9)
    axes.set_title(f"{done.report['name']}: labels of the slice over the radar's map", fontsize=11)
    figure.savefig(out_path, dpi=110, metadata={"Software": None} if out_path.suffix == ".png" else None)
