"""A picture of one scan: the range-azimuth map on the left, the bird's-eye view of what is hidden on the right.

Colours are from the Okabe-Ito set, safe for colour-blind readers, and every kind of mark has its own shape.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure
from matplotlib.patches import Ellipse, Polygon

from msgs.frames import xy_from_polar
from msgs.perception import BevFrame, HiddenObject, SceneTruth, TruthObject, Visibility
from msgs.radar import RangeAzimuthMap

BLUE, SKY, GREEN, ORANGE, VERMILION, GREY = "#0072B2", "#56B4E9", "#009E73", "#E69F00", "#D55E00", "#555555"
#: Direct sight, seen in a mirror: light enough to draw upon.
SHADES = {Visibility.DIRECT: "#E3F1FA", Visibility.MIRRORED: "#FBE9C6"}
#: What the map shows below its strongest cell.
DYNAMIC_RANGE_DB = 55.0
#: An ellipse of two sigma holds 86 % of a plane's normal distribution.
ELLIPSE_SIGMAS = 2.0


def draw_bev(
    frame: BevFrame, out_path: Path, truth: SceneTruth | None = None, ra_map: RangeAzimuthMap | None = None
) -> None:
    """Write the picture (format by the suffix of `out_path`); without a map, the bird's-eye view alone."""
    limits = _limits(frame, truth)
    columns = 1 if ra_map is None else 2
    figure = Figure(figsize=_size_inch(limits, columns), layout="constrained")
    FigureCanvasAgg(figure)
    panels = figure.subplots(1, columns, squeeze=False)[0]
    if ra_map is not None:
        _draw_map(panels[0], frame, ra_map)
        _finish(panels[0], limits)
    _draw_view(panels[-1], frame, truth)
    _finish(panels[-1], limits)
    panels[-1].legend(loc="upper left", bbox_to_anchor=(1.01, 1.0), borderaxespad=0.0, frameon=False, fontsize=9)
    figure.suptitle(_title(frame), fontsize=13)
    # without a date or version in the file, equal frames give equal bytes
    figure.savefig(out_path, dpi=120, metadata={"Software": None} if Path(out_path).suffix == ".png" else None)


def _size_inch(limits: tuple[float, float, float], columns: int) -> tuple[float, float]:
    """Figure size that the equal scales of the panels fill, with room for legend and colour bar."""
    forward, left, right = limits
    panel_width = 6.8
    height = panel_width * (forward + 2.0) / (left + right) + 1.4
    return columns * panel_width + 2.2 + (columns - 1) * 1.2, float(np.clip(height, 5.0, 14.0))


def _title(frame: BevFrame) -> str:
    """Scan, counts and conditions."""
    counts = ", ".join(
        f"{count} {name}{'' if count == 1 else 's'}"
        for count, name in (
            (len(frame.objects), "hidden object"),
            (len(frame.points), "hidden point"),
            (len(frame.walls), "wall"),
        )
    )
    conditions = f"  [{', '.join(frame.flags)}]" if frame.flags else ""
    return f"scan {frame.scan_id} at {frame.stamp_ns * 1e-9:.3f} s: {counts}{conditions}"


def _limits(frame: BevFrame, truth: SceneTruth | None) -> tuple[float, float, float]:
    """Forward reach, and left and right reach [m], that show all there is with a margin, in steps of 5 m."""
    points = [np.zeros((1, 2)), np.asarray(frame.los_points_m, np.float64)]
    points += [np.array([[p.x_m, p.y_m], [p.image_x_m, p.image_y_m]]) for p in frame.points]
    points += [np.array(wall.ends_m) for wall in frame.walls]
    if truth is not None:
        points += [np.array([[one.x_m, one.y_m]]) for one in truth.objects]
        points += [np.array(surface.polyline_m) for surface in truth.surfaces]
    every = np.concatenate(points)
    # a single far return must not shrink everything else
    reach_x, reach_y = np.quantile(every[:, 0], 0.98), np.quantile(np.abs(every[:, 1]), 0.98)
    forward = 5.0 * math.ceil((max(float(reach_x), 15.0) + 3.0) / 5.0)
    side = max(5.0 * math.ceil((float(reach_y) + 2.0) / 5.0), 0.5 * forward)
    return forward, side, side


def _finish(axes: Axes, limits: tuple[float, float, float]) -> None:
    """Forward up, left to the left: the horizontal axis is y and runs backwards."""
    forward, left, right = limits
    axes.set(xlim=(left, -right), ylim=(-2.0, forward), xlabel="y, left [m]", ylabel="x, forward [m]")
    axes.set_aspect("equal")
    axes.plot(0.0, 0.0, marker="^", markersize=13, color="black", markeredgecolor="white", zorder=10)
    axes.annotate("radar", (0.0, 0.0), (8, -4), textcoords="offset points", fontsize=9, zorder=10)


def _draw_map(axes: Axes, frame: BevFrame, ra_map: RangeAzimuthMap) -> None:
    """Level of the map over its noise in the plane, with the returns the view stands on."""
    grid = ra_map.grid
    power = np.square(np.abs(ra_map.values)).astype(np.float64)
    level_db = 10.0 * np.log10(np.maximum(power, 1e-30) / max(ra_map.noise_power_mw, 1e-30))
    corners = xy_from_polar(*np.meshgrid(_edges(grid.range_m), _edges(grid.azimuth_rad), indexing="ij"))
    top = float(level_db.max())
    axes.set_facecolor("black")
    mesh = axes.pcolormesh(
        corners[..., 1],
        corners[..., 0],
        level_db,
        cmap="cividis",
        vmin=top - DYNAMIC_RANGE_DB,
        vmax=top,
        rasterized=True,
    )
    axes.figure.colorbar(mesh, ax=axes, label="level over noise [dB]", shrink=0.9, fraction=0.05)
    axes.scatter(
        frame.los_points_m[:, 1], frame.los_points_m[:, 0], s=26, facecolors="none", edgecolors=SKY, linewidths=1.2
    )
    images = np.array([[point.image_x_m, point.image_y_m] for point in frame.points]).reshape(-1, 2)
    axes.scatter(images[:, 1], images[:, 0], s=34, marker="D", facecolors="none", edgecolors=ORANGE, linewidths=1.4)
    axes.set_title("range-azimuth map: direct returns (circles), mirror images (diamonds)", fontsize=11)


def _edges(centres: np.ndarray) -> np.ndarray:
    """Cell edges of evenly spaced centres."""
    half = 0.5 * (centres[1] - centres[0])
    return np.append(centres - half, centres[-1] + half)


def _draw_view(axes: Axes, frame: BevFrame, truth: SceneTruth | None) -> None:
    """Mask, truth, walls, returns, images and objects, from below to above."""
    _draw_visibility(axes, frame)
    if truth is not None:
        _draw_truth(axes, truth)
    for index, wall in enumerate(frame.walls):
        ends = np.array(wall.ends_m)
        axes.plot(
            ends[:, 1], ends[:, 0], color=BLUE, linewidth=4, solid_capstyle="round", zorder=4, **_once("wall", index)
        )
    axes.scatter(
        frame.los_points_m[:, 1], frame.los_points_m[:, 0], s=14, color=SKY, edgecolors=BLUE, linewidths=0.5, zorder=5,
        label="direct return",
    )  # fmt: skip
    _draw_points(axes, frame)
    for index, one in enumerate(frame.objects):
        _draw_object(axes, one, index)
    _draw_tracks(axes, frame)
    axes.set_title("bird's-eye view", fontsize=11)


def _once(label: str, index: int) -> dict[str, Any]:
    """A label for the first of its kind only, so that the legend names it once."""
    return {"label": label} if index == 0 else {}


def _draw_visibility(axes: Axes, frame: BevFrame) -> None:
    """Shade the cells in direct sight and those a mirror shows; what stays white is unknown."""
    grid = frame.grid
    y = grid.y_min_m + grid.cell_m * np.arange(grid.rows + 1)
    x = grid.x_min_m + grid.cell_m * np.arange(grid.columns + 1)
    colours = ListedColormap(["white", *(SHADES[kind] for kind in (Visibility.DIRECT, Visibility.MIRRORED))])
    axes.pcolormesh(y, x, frame.visibility.T, cmap=colours, vmin=-0.5, vmax=2.5, rasterized=True, zorder=0)
    axes.fill([], [], color=SHADES[Visibility.DIRECT], label="in direct sight")
    axes.fill(
        [], [], color=SHADES[Visibility.MIRRORED], label=f"{frame.visibility_rcs_dbsm:g} dBsm seen in a mirror"
    )  # fmt: skip
    axes.fill([], [], facecolor="white", edgecolor="lightgrey", label="unknown")


def _draw_points(axes: Axes, frame: BevFrame) -> None:
    """Images behind the wall, and a thin line from each to where it stands."""
    if not frame.points:
        return
    place = np.array([[point.x_m, point.y_m] for point in frame.points])
    image = np.array([[point.image_x_m, point.image_y_m] for point in frame.points])
    axes.plot([image[:, 1], place[:, 1]], [image[:, 0], place[:, 0]], color=ORANGE, linewidth=0.7, alpha=0.7, zorder=3)
    axes.scatter(
        image[:, 1], image[:, 0], s=30, marker="D", facecolors="white", edgecolors=ORANGE, linewidths=1.3, zorder=6,
        label="mirror image",
    )  # fmt: skip
    axes.scatter(place[:, 1], place[:, 0], s=34, marker="x", color=VERMILION, zorder=7, label="folded back, Eq. (19)")


def box_corners_m(one: HiddenObject | TruthObject) -> np.ndarray:
    """Corners [4, 2] of an oriented box in metres."""
    cos, sin = math.cos(one.yaw_rad), math.sin(one.yaw_rad)
    half = 0.5 * np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]]) * [one.length_m, one.width_m]
    return half @ np.array([[cos, sin], [-sin, cos]]) + [one.x_m, one.y_m]


def _draw_object(axes: Axes, one: HiddenObject, index: int) -> None:
    """Box, two-sigma ellipse of its centre, identity and score."""
    axes.add_patch(
        Polygon(box_corners_m(one)[:, ::-1], facecolor=VERMILION, alpha=0.25, edgecolor="none", zorder=7)
    )  # fmt: skip
    axes.add_patch(
        Polygon(
            box_corners_m(one)[:, ::-1], fill=False, edgecolor=VERMILION, linewidth=2.2, zorder=8,
            **_once("hidden object", index),
        )
    )  # fmt: skip
    variances, vectors = np.linalg.eigh(np.array(one.cov_m2))
    width_m, height_m = 2.0 * ELLIPSE_SIGMAS * np.sqrt(np.maximum(variances[::-1], 0.0))
    # the axes show (y, x): the angle of the major axis in that plane
    angle_deg = math.degrees(math.atan2(vectors[0, 1], vectors[1, 1]))
    axes.add_patch(
        Ellipse(
            (one.y_m, one.x_m), width_m, height_m, angle=angle_deg, fill=False, edgecolor="black", linestyle="--",
            linewidth=1.2, zorder=9, **_once(f"{ELLIPSE_SIGMAS:g} sigma of its centre", index),
        )
    )  # fmt: skip
    axes.annotate(
        f"#{one.id}  {one.score:.2f}", (one.y_m, one.x_m), (12, 12), textcoords="offset points", fontsize=10, zorder=11,
        bbox={"boxstyle": "round,pad=0.2", "facecolor": "white", "edgecolor": VERMILION, "alpha": 0.9},
    )  # fmt: skip


def _draw_tracks(axes: Axes, frame: BevFrame) -> None:
    """Where each track is, how far it comes in a second, and when it comes into sight."""
    for index, one in enumerate(frame.tracks):
        axes.plot(
            one.y_m, one.x_m, "s", markersize=9, fillstyle="none", color="black", zorder=10, **_once("track", index)
        )
        axes.annotate(
            "", (one.y_m + one.velocity_y_mps, one.x_m + one.velocity_x_mps), (one.y_m, one.x_m), zorder=10,
            arrowprops={"arrowstyle": "->", "linewidth": 1.8},
        )  # fmt: skip
        sight = "" if one.time_to_appear_s is None else f", in sight in {one.time_to_appear_s:.1f} s"
        axes.annotate(
            f"track {one.id}{sight}", (one.y_m, one.x_m), (12, -18), textcoords="offset points", fontsize=9, zorder=11
        )


def _draw_truth(axes: Axes, truth: SceneTruth) -> None:
    """True surfaces and objects as grey and green outlines."""
    for index, surface in enumerate(truth.surfaces):
        line = np.array(surface.polyline_m)
        axes.plot(line[:, 1], line[:, 0], color=GREY, linewidth=1.5, zorder=2, **_once("true surface", index))
    for hidden, colour, label in ((True, GREEN, "true hidden object"), (False, GREY, "true visible object")):
        for index, one in enumerate(other for other in truth.objects if other.hidden == hidden):
            axes.add_patch(
                Polygon(
                    box_corners_m(one)[:, ::-1], fill=False, edgecolor=colour, linewidth=1.8, zorder=6,
                    **_once(label, index),
                )
            )  # fmt: skip
