"""Pictures of scenes from above: walls by material, objects, and the ways of their echoes."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from msgs.perception import PathClass
from msgs.wording import counted
from sim_player.paths import Paths
from sim_player.scene import Scene

MATERIAL_COLOURS = {
    "glass": "#5aa9d6",
    "window": "#5aa9d6",
    "double_glazing": "#5aa9d6",
    "metal": "#7d8590",
    "container": "#7d8590",
    "sound_barrier": "#7d8590",
    "brick": "#b5533c",
    "wood": "#a9825a",
    "vegetation": "#5d9c59",
}
LOS_COLOUR, MIRRORED_COLOUR = "#2166ac", "#e08214"


def draw_scene(axes: Any, scene: Scene) -> None:
    """Walls, objects and the radar on matplotlib axes, x up and y to the left."""
    from models.physics.curved_mirror import arc_points

    for surface in scene.surfaces:
        if surface.role == "ground":
            continue
        colour = MATERIAL_COLOURS.get(surface.material, "#444444")
        for a, b in zip(surface.polyline_m[:-1], surface.polyline_m[1:], strict=True):
            line = arc_points(np.array(a), np.array(b), surface.curvature_per_m, np.linspace(0.0, 1.0, 33))
            style = "-" if surface.role == "relay" else (0, (4, 1))
            axes.plot(line[:, 1], line[:, 0], color=colour, linewidth=2.5, linestyle=style, solid_capstyle="butt")
    for thing in scene.objects:
        corners = thing.corners_m()
        axes.fill(corners[:, 1], corners[:, 0], facecolor="#dddddd", edgecolor="#222222", linewidth=1.0, zorder=3)
        axes.text(thing.y_m, thing.x_m, thing.object_class, fontsize=6, ha="center", va="center", zorder=4)
    axes.plot(0.0, 0.0, marker="^", color="#c51b7d", markersize=9, zorder=5)
    axes.set_aspect("equal")
    axes.invert_xaxis()


def draw_paths(out: Path, scene: Scene, paths: Paths, ways: list[np.ndarray], power_mw: np.ndarray) -> None:
    """PNG of a scene with the way out of every path, the stronger the darker."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8.0, 8.0), dpi=130)
    axes = figure.subplots()
    level = np.log10(np.maximum(power_mw, 1e-30))
    shade = 0.05 + 0.45 * (level - level.min(initial=0.0)) / max(float(np.ptp(level)) if len(level) else 1.0, 1e-9)
    for index in np.argsort(power_mw):
        mirrored = paths.kind[index] == PathClass.MIRRORED
        way = ways[index]
        colour = MIRRORED_COLOUR if mirrored else LOS_COLOUR
        axes.plot(way[:, 1], way[:, 0], color=colour, alpha=float(np.clip(shade[index], 0.03, 0.6)), linewidth=0.8)
    draw_scene(axes, scene)
    axes.set_xlabel("y, left (m)")
    axes.set_ylabel("x, ahead (m)")
    axes.set_title(f"{scene.name}: {counted(len(paths), 'path')} (blue direct, orange by mirrors)", fontsize=10)
    figure.savefig(out, bbox_inches="tight")
