"""Pictures of scenes from above: walls by material, objects, and the paths of their echoes."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from mirrorwave.plots.style import BLACK, MIRROR_IMAGE, SEEN_DIRECTLY, handles_of, legend_of_figure, new_figure, save
from msgs.values.perception import PathClass
from msgs.values.wording import counted
from sim_player.scene.description import Scene
from sim_player.trace.effect_names import bit
from sim_player.trace.path_table import Paths

MATERIAL_COLOURS = {
    "glass": "#44aa99",
    "window": "#44aa99",
    "double_glazing": "#44aa99",
    "metal": "#7d8590",
    "container": "#7d8590",
    "sound_barrier": "#7d8590",
    "brick": "#b5533c",
    "wood": "#a9825a",
    "vegetation": "#5d9c59",
}
#: A wall that was built to be looked round with, and any other.
ROLE_STYLES = {"relay": "-", "occluder": (0, (4, 1))}
#: Opacity of the strongest path and of those weaker by the span or more.
PALE, DARK, SPAN_DB = 0.15, 0.75, 60.0
#: Colour says by how many mirrors a path leads, the dashes how it passes walls.
MIRRORS = (("direct", SEEN_DIRECTLY), ("by one mirror", MIRROR_IMAGE), ("by two mirrors or more", "#8a5200"))
PASSAGES: tuple[tuple[str, Any], ...] = (
    ("", "-"),
    (", through a wall", (0, (5, 2))),
    (", bent at a wall's end (drawn straight)", (0, (1, 2))),
)


def draw_scene(axes: Axes, scene: Scene) -> None:
    """Draw walls, objects and the radar, x up and y to the left, the first of each kind with a label."""
    from models.physics.curved_mirror import arc_points

    labels: set[str] = set()
    for surface in scene.surfaces:
        if surface.role == "ground":
            continue
        colour = MATERIAL_COLOURS.get(surface.material, "#444444")
        words = f"wall of {surface.material.replace('_', ' ')}, {surface.role}"
        style = ROLE_STYLES["relay" if surface.role == "relay" else "occluder"]
        for a, b in zip(surface.polyline_m[:-1], surface.polyline_m[1:], strict=True):
            line = arc_points(np.array(a), np.array(b), surface.curvature_per_m, np.linspace(0.0, 1.0, 33))
            axes.plot(
                line[:, 1], line[:, 0], color=colour, linewidth=2.5, linestyle=style, solid_capstyle="butt",
                label=_first(words, labels),
            )  # fmt: skip
    for item in scene.objects:
        corners = item.corners_m()
        axes.fill(
            corners[:, 1], corners[:, 0], facecolor="#dddddd", edgecolor=BLACK, linewidth=1.0, zorder=3,
            label=_first("object", labels),
        )  # fmt: skip
        axes.text(item.y_m, item.x_m, item.object_class, fontsize=7, ha="center", va="center", zorder=4)
    axes.plot(0.0, 0.0, marker="^", color="black", markersize=9, linestyle="", zorder=5, label="radar")
    axes.set_aspect("equal")
    axes.invert_xaxis()


def write_scene(out: Path, scene: Scene) -> None:
    """Write the picture of a scene."""
    save(scene_figure(scene), out, dpi=130)


def scene_figure(scene: Scene) -> Figure:
    """Return the picture of a scene as a figure."""
    figure = new_figure(8.0, 9.0)
    axes = figure.subplots()
    draw_scene(axes, scene)
    axes.set(xlabel="y, left [m]", ylabel="x, forward [m]", title=scene.name)
    legend_of_figure(figure, handles_of(axes), columns=2)
    return figure


def _first(words: str, labels: set[str]) -> str:
    """A label for the first of its kind; one with an underscore stays out of the legend."""
    shown = f"_{words}" if words in labels else words
    labels.add(words)
    return shown


def path_kinds(paths: Paths) -> tuple[np.ndarray, np.ndarray]:
    """Return each path's index into `MIRRORS` and into `PASSAGES`, int [P] each."""
    mirrors = np.where(paths.kind == PathClass.MIRRORED, np.clip(paths.order, 1, 2), 0)
    through = (paths.needs & np.uint32(bit("wall_transmission"))) != 0
    bent = (paths.needs & np.uint32(bit("edge_diffraction") | bit("mirrored_diffraction"))) != 0
    return mirrors, np.where(bent, 2, np.where(through, 1, 0))


def draw_paths(out: Path, scene: Scene, paths: Paths, polylines: list[np.ndarray], power_mw: np.ndarray) -> None:
    """Write the picture of a scene with the outbound vertices of every path, the stronger the darker."""
    figure = new_figure(8.0, 9.0)
    axes = figure.subplots()
    level_db = 10.0 * np.log10(np.maximum(power_mw, 1e-30))
    top_db = float(level_db.max(initial=-300.0))
    opacity = PALE + (DARK - PALE) * np.clip(1.0 + (level_db - top_db) / SPAN_DB, 0.0, 1.0)
    mirrors, passages = path_kinds(paths)
    # mirrored paths above the many direct ones, strong ones above weak ones
    for index in np.lexsort((power_mw, mirrors)):
        polyline, colour, style = polylines[index], MIRRORS[mirrors[index]][1], PASSAGES[passages[index]][1]
        axes.plot(
            polyline[:, 1], polyline[:, 0], color=colour, linestyle=style, alpha=float(opacity[index]), linewidth=0.9,
        )  # fmt: skip
    draw_scene(axes, scene)
    axes.set(xlabel="y, left [m]", ylabel="x, forward [m]")
    axes.set_title(f"{scene.name}: {counted(len(paths), 'path')} out to what returns them")
    signs = [*_kind_signs(mirrors, passages), *_level_signs(top_db)] if len(paths) else []
    legend_of_figure(figure, [*signs, *handles_of(axes)], columns=2)
    save(figure, out, dpi=130)


def _kind_signs(mirrors: np.ndarray, passages: np.ndarray) -> list[Line2D]:
    """A sign for each kind of path that is there, with their number."""
    signs = []
    for mirror, (mirror_words, colour) in enumerate(MIRRORS):
        for passage, (passage_words, style) in enumerate(PASSAGES):
            count = int(np.count_nonzero((mirrors == mirror) & (passages == passage)))
            if count:
                label = f"{mirror_words}{passage_words}: {count}"
                signs.append(Line2D([], [], color=colour, linestyle=style, linewidth=1.6, label=label))
    return signs


def _level_signs(top_db: float) -> list[Line2D]:
    """A sign for the darkest and one for the palest path."""
    words = (f"dark: {top_db:.0f} dBm", DARK), (f"pale: {top_db - SPAN_DB:.0f} dBm or less", PALE)
    return [Line2D([], [], color=BLACK, alpha=opacity, linewidth=1.6, label=label) for label, opacity in words]
