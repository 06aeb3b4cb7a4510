"""A picture of one scan: the bird's-eye view large, beside it the radar's map and what every sign means.

One colour for each meaning (`plot_style`), in map and view: blue was seen directly, orange is a mirror image, vermilion
was recovered, green is the truth. Where the truth is known, the areas end at the true walls.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure
from matplotlib.patches import Ellipse, Polygon

from mirrorwave.plots.style import (
    DIRECT_AREA,
    MIRROR_AREA,
    MIRROR_IMAGE,
    RECOVERED,
    SEEN_DIRECTLY,
    TRACKED,
    TRUTH,
    WALL,
    new_figure,
    save,
)
from mirrorwave.plots.visibility import direct_sight, mirror_sight, true_segments
from msgs.values.frames import xy_from_polar
from msgs.values.perception import BevFrame, HiddenObject, SceneTruth, TruthObject, Visibility
from msgs.values.radar import RangeAzimuthGrid, RangeAzimuthMap
from nodes.viewer.driver_warnings import FLAG_WORDS

DPI = 130
#: What the map shows below its strongest cell.
DYNAMIC_RANGE_DB = 55.0
#: An ellipse of two sigma holds 86 % of a plane's normal distribution.
ELLIPSE_SIGMAS, ELLIPSE_SHARE = 2.0, 0.86
#: Width of the bird's-eye view and of the column beside it, and the least and largest height, in inches.
VIEW_INCH, SIDE_INCH, HEIGHTS_INCH = 6.4, 3.2, (7.4, 9.6)
#: Least height of a view without a map beside it.
LEAST_VIEW_INCH = 5.0
#: Share of the echoes that the picture holds: a single far one must not shrink everything else.
SHOWN_SHARE = 0.98
MARGIN_M, LEAST_FORWARD_M, LEAST_SIDE_M = 2.0, 15.0, 6.0


class Limits(NamedTuple):
    """Ends of what is drawn [m]: least and largest x, least and largest y."""

    back: float
    front: float
    right: float
    left: float

    @property
    def shape(self) -> float:
        """Height over width as drawn, x upwards."""
        return (self.front - self.back) / (self.left - self.right)

    @property
    def reach_m(self) -> float:
        """Distance beyond all corners from the radar."""
        return abs(self.back) + self.front + abs(self.right) + abs(self.left)


def draw_bev(
    frame: BevFrame, out_path: Path, truth: SceneTruth | None = None, ra_map: RangeAzimuthMap | None = None
) -> None:
    """Write the picture (format by the suffix of `out_path`); without a map, the bird's-eye view alone."""
    save(bev_figure(frame, truth, ra_map), Path(out_path), dpi=DPI)


def bev_figure(frame: BevFrame, truth: SceneTruth | None = None, ra_map: RangeAzimuthMap | None = None) -> Figure:
    """Return the picture of a scan as a figure."""
    limits = limits_of(frame, truth)
    least, most = HEIGHTS_INCH
    height = float(np.clip(VIEW_INCH * limits.shape + 1.0, least if ra_map is not None else LEAST_VIEW_INCH, most))
    figure = new_figure(VIEW_INCH + SIDE_INCH, height)
    names = [["view", "map"], ["view", "signs"]] if ra_map is not None else [["view", "signs"]]
    panels: dict[str, Axes] = figure.subplot_mosaic(names, width_ratios=(VIEW_INCH, SIDE_INCH))
    limit_deg = (ra_map.grid if ra_map is not None else RangeAzimuthGrid()).azimuth_limit_deg
    draw_view(panels["view"], frame, truth, limits, math.radians(limit_deg))
    finish(panels["view"], limits)
    if ra_map is not None:
        _draw_map(panels["map"], frame, ra_map)
        finish(panels["map"], limits)
    panels["signs"].set_axis_off()
    panels["signs"].legend(
        *panels["view"].get_legend_handles_labels(),
        loc="upper left",
        borderaxespad=0.0,
        frameon=False,
        # a flat street with all there can be: twelve signs in half the height
        fontsize=9,
        labelspacing=0.3,
    )
    figure.suptitle(_title(frame, truth), fontsize=13)
    return figure


def map_figure(ra_map: RangeAzimuthMap) -> Figure:
    """Return the picture of a map in the plane, to its largest range."""
    side_m = float(ra_map.grid.range_m[-1] * math.sin(math.radians(ra_map.grid.azimuth_limit_deg)))
    limits = Limits(0.0, max(float(ra_map.grid.range_m[-1]), ra_map.grid.range_bin_m), -side_m, side_m)
    figure = new_figure(VIEW_INCH, 0.78 * VIEW_INCH)
    axes = figure.subplots()
    _draw_levels(axes, ra_map)
    finish(axes, limits)
    axes.set_title(f"Scan {ra_map.scan_id} at {ra_map.stamp_ns * 1e-9:.3f} s, {ra_map.mode}", fontsize=11)
    return figure


def _title(frame: BevFrame, truth: SceneTruth | None) -> str:
    """Scan, how many hidden objects were found and are there, conditions in words."""
    count = len(frame.objects)
    line = f"Scan {frame.scan_id} at {frame.stamp_ns * 1e-9:.3f} s: {count} hidden object{'' if count == 1 else 's'}"
    if truth is not None:
        line += f" found, {sum(true_object.hidden for true_object in truth.objects)} really there"
    conditions = [FLAG_WORDS[flag][0] if flag in FLAG_WORDS else flag.replace("_", " ") for flag in frame.flags]
    return "\n".join([line, ". ".join(conditions)]) if conditions else line


def limits_of(frame: BevFrame, truth: SceneTruth | None) -> Limits:
    """Return ends that hold radar, objects and nearly all echoes, images and walls."""
    objects: list[HiddenObject | TruthObject] = list(frame.objects)
    if truth is not None:
        objects += [item for item in truth.objects if item.hidden]
    held = [np.zeros((1, 2)), *(box_corners_m(item) for item in objects)]
    held += [np.array([[item.x_m, item.y_m]]) for item in frame.tracks]
    points = [np.zeros((1, 2)), np.asarray(frame.los_points_m, np.float64)]
    points += [np.array([[p.x_m, p.y_m], [p.image_x_m, p.image_y_m]]) for p in frame.points]
    points += [np.array(wall.ends_m) for wall in frame.walls]
    every = np.concatenate(points)
    low = np.minimum(np.quantile(every, 1.0 - SHOWN_SHARE, axis=0), np.concatenate(held).min(axis=0)) - MARGIN_M
    high = np.maximum(np.quantile(every, SHOWN_SHARE, axis=0), np.concatenate(held).max(axis=0)) + MARGIN_M
    back, front = max(float(low[0]), -MARGIN_M), max(float(high[0]), LEAST_FORWARD_M)
    return Limits(back, front, min(float(low[1]), -LEAST_SIDE_M), max(float(high[1]), LEAST_SIDE_M))


def finish(axes: Axes, limits: Limits) -> None:
    """Turn forward up, left to the left: the horizontal axis is y and runs backwards."""
    axes.set(
        xlim=(limits.left, limits.right),
        ylim=(limits.back, limits.front),
        xlabel="y, left [m]",
        ylabel="x, forward [m]",
    )
    axes.set_aspect("equal", anchor="N")
    axes.plot(0.0, 0.0, marker="^", markersize=13, color="black", markeredgecolor="white", zorder=10)
    axes.annotate("radar", (0.0, 0.0), (9, -4), textcoords="offset points", fontsize=9, zorder=10)


def _draw_map(axes: Axes, frame: BevFrame, ra_map: RangeAzimuthMap) -> None:
    """Level of the map over its noise in the plane, with the returns the view stands on."""
    _draw_levels(axes, ra_map)
    los_m = frame.los_points_m
    axes.scatter(los_m[:, 1], los_m[:, 0], s=22, facecolors="none", edgecolors=SEEN_DIRECTLY, linewidths=1.2)
    images = np.array([[point.image_x_m, point.image_y_m] for point in frame.points]).reshape(-1, 2)
    axes.scatter(images[:, 1], images[:, 0], s=26, marker="D", facecolors="none", edgecolors=MIRROR_IMAGE)
    axes.set_title("what the radar measures", fontsize=11)


def _draw_levels(axes: Axes, ra_map: RangeAzimuthMap) -> None:
    grid = ra_map.grid
    power = np.square(np.abs(ra_map.values.astype(np.complex128)))
    # one bad cell must not spoil the scale of all others
    power = np.where(np.isfinite(power), power, 0.0)
    level_db = 10.0 * np.log10(np.maximum(power, 1e-30) / max(ra_map.noise_power_mw, 1e-30))
    corners = xy_from_polar(*np.meshgrid(_edges(grid.range_m), _edges(grid.azimuth_rad), indexing="ij"))
    top = float(level_db.max())
    axes.set_facecolor("lightgrey")
    mesh = axes.pcolormesh(
        corners[..., 1], corners[..., 0], level_db, cmap="Greys_r", vmin=top - DYNAMIC_RANGE_DB, vmax=top,
        rasterized=True,
    )  # fmt: skip
    assert axes.figure is not None
    axes.figure.colorbar(mesh, ax=axes, label="level over noise [dB]", location="bottom", shrink=0.9, aspect=30)


def _edges(centres: np.ndarray) -> np.ndarray:
    """Cell edges of evenly spaced centres."""
    half = 0.5 * (centres[1] - centres[0])
    return np.append(centres - half, centres[-1] + half)


def draw_view(axes: Axes, frame: BevFrame, truth: SceneTruth | None, limits: Limits, limit_rad: float) -> None:
    """Draw areas, walls, echoes, images and objects, from below to above; the truth's outlines over what was found."""
    axes.set_title("bird's-eye view", fontsize=11)
    segments = None if truth is None else true_segments(truth)
    _draw_areas(axes, frame, segments, limits.reach_m, limit_rad)
    for index, wall in enumerate(frame.walls):
        ends = np.array(wall.ends_m)
        label = _once("wall, found by the radar", index)
        axes.plot(ends[:, 1], ends[:, 0], color=WALL, linewidth=4.5, solid_capstyle="butt", zorder=4, **label)
    axes.scatter(
        frame.los_points_m[:, 1], frame.los_points_m[:, 0], s=20, color="white", edgecolors=SEEN_DIRECTLY,
        linewidths=1.3, zorder=5, label="echo seen directly",
    )  # fmt: skip
    _draw_points(axes, frame)
    for index, hidden in enumerate(frame.objects):
        _draw_object(axes, hidden, index)
    if truth is not None:
        _draw_truth(axes, truth)
    _draw_tracks(axes, frame)


def _once(label: str, index: int) -> dict[str, Any]:
    """A label for the first of its kind only, so that the legend names it once."""
    return {"label": label} if index == 0 else {}


def _draw_areas(
    axes: Axes, frame: BevFrame, segments: tuple[np.ndarray, np.ndarray] | None, reach_m: float, limit_rad: float
) -> None:
    """Shade what is seen directly and what mirrors show; what stays white is unknown.

    With true walls (`segments`) both areas end at them; without, they are as the view has them.
    """
    grid, mask = frame.grid, frame.visibility
    shown = [Visibility.MIRRORED] if segments is not None else [Visibility.DIRECT, Visibility.MIRRORED]
    if segments is not None:
        cells = np.argwhere(mask == Visibility.MIRRORED)
        mirrored = mirror_sight(grid.cell_centres_m()[cells[:, 0], cells[:, 1]], frame.walls, *segments)
        mask = mask.copy()
        mask[tuple(cells[~mirrored].T)] = Visibility.UNKNOWN
        polygon = direct_sight(*segments, reach_m, limit_rad)
        axes.add_patch(Polygon(polygon[:, ::-1], facecolor=DIRECT_AREA, edgecolor="none", zorder=1))
    y = grid.y_min_m + grid.cell_m * np.arange(grid.rows + 1)
    x = grid.x_min_m + grid.cell_m * np.arange(grid.columns + 1)
    colours = ListedColormap([DIRECT_AREA, MIRROR_AREA])
    hidden = np.ma.masked_array(mask.T, mask=~np.isin(mask.T, shown))
    axes.pcolormesh(y, x, hidden, cmap=colours, vmin=0.5, vmax=2.5, rasterized=True, zorder=0)
    square_m = 10.0 ** (frame.visibility_rcs_dbsm / 10.0)
    for colour, edge, label in (
        (DIRECT_AREA, SEEN_DIRECTLY, "area seen directly"),
        (MIRROR_AREA, MIRROR_IMAGE, f"area a mirror shows\n(echoes of {square_m:.3g} m² or more)"),
        ("white", "lightgrey", "not seen: unknown"),
    ):
        axes.fill([], [], facecolor=colour, edgecolor=edge, linewidth=0.6, label=label)


def _draw_points(axes: Axes, frame: BevFrame) -> None:
    """Images behind the wall, and a thin line from each to where it stands."""
    if not frame.points:
        return
    position_m = np.array([[point.x_m, point.y_m] for point in frame.points])
    image = np.array([[point.image_x_m, point.image_y_m] for point in frame.points])
    lines = [image[:, 1], position_m[:, 1]], [image[:, 0], position_m[:, 0]]
    axes.plot(*lines, color=MIRROR_IMAGE, linewidth=0.9, linestyle=":", zorder=3)
    axes.scatter(
        image[:, 1], image[:, 0], s=34, marker="D", facecolors="white", edgecolors=MIRROR_IMAGE, linewidths=1.4,
        zorder=6, label="mirror image",
    )  # fmt: skip
    axes.scatter(
        position_m[:, 1],
        position_m[:, 0],
        s=36,
        marker="x",
        color=RECOVERED,
        zorder=7,
        label="echo of a hidden object,\nrecovered",
    )


def box_corners_m(box: HiddenObject | TruthObject) -> np.ndarray:
    """Corners [4, 2] of an oriented box in metres."""
    cos, sin = math.cos(box.yaw_rad), math.sin(box.yaw_rad)
    half = 0.5 * np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]]) * [box.length_m, box.width_m]
    centre_m = box.box_centre_m if isinstance(box, HiddenObject) else (box.x_m, box.y_m)
    return half @ np.array([[cos, sin], [-sin, cos]]) + centre_m


def _draw_object(axes: Axes, hidden: HiddenObject, index: int) -> None:
    """Box, two-sigma ellipse of its position, identity and score."""
    corners = box_corners_m(hidden)[:, ::-1]
    axes.add_patch(Polygon(corners, facecolor=RECOVERED, alpha=0.25, edgecolor="none", zorder=7))
    label = _once("hidden object (recovered)", index)
    axes.add_patch(Polygon(corners, fill=False, edgecolor=RECOVERED, linewidth=2.4, zorder=8, **label))
    variances, vectors = np.linalg.eigh(np.array(hidden.cov_m2))
    width_m, height_m = 2.0 * ELLIPSE_SIGMAS * np.sqrt(np.maximum(variances[::-1], 0.0))
    # the axes show (y, x): the angle of the major axis in that plane
    angle_deg = math.degrees(math.atan2(vectors[0, 1], vectors[1, 1]))
    axes.add_patch(
        Ellipse(
            (hidden.y_m, hidden.x_m), width_m, height_m, angle=angle_deg, fill=False, edgecolor=RECOVERED,
            linestyle="--", linewidth=1.3, zorder=9,
            **_once(f"its position, {100.0 * ELLIPSE_SHARE:.0f} % sure", index),
        )
    )  # fmt: skip
    name = f"#{hidden.id} {hidden.object_class}".rstrip()
    axes.annotate(
        f"{name}, score {hidden.score:.2f}", (hidden.y_m, hidden.x_m), (14, 14), textcoords="offset points",
        fontsize=10, zorder=11,
        bbox={"boxstyle": "round,pad=0.2", "facecolor": "white", "edgecolor": RECOVERED, "alpha": 0.9},
    )  # fmt: skip


def _draw_tracks(axes: Axes, frame: BevFrame) -> None:
    """Draw each track, its path of the next second, and when it comes into sight."""
    for index, track in enumerate(frame.tracks):
        label = _once("followed object;\narrow: its way in 1 s", index)
        axes.plot(track.y_m, track.x_m, "s", markersize=9, fillstyle="none", color=TRACKED, zorder=10, **label)
        axes.annotate(
            "", (track.y_m + track.velocity_y_mps, track.x_m + track.velocity_x_mps), (track.y_m, track.x_m), zorder=10,
            arrowprops={"arrowstyle": "->", "linewidth": 1.8, "color": TRACKED},
        )  # fmt: skip
        sight = "" if track.time_to_appear_s is None else f", in sight in {track.time_to_appear_s:.1f} s"
        sure = "" if track.existence is None else f", {100.0 * track.existence:.0f} %"
        axes.annotate(
            f"track {track.id}{sure}{sight}", (track.y_m, track.x_m), (14, -20), textcoords="offset points", fontsize=9,
            zorder=11, color=TRACKED,
        )  # fmt: skip


def _draw_truth(axes: Axes, truth: SceneTruth) -> None:
    """True walls and objects as outlines; what is in sight is dotted."""
    for index, surface in enumerate(truth.surfaces):
        line = np.array(surface.polyline_m)
        axes.plot(line[:, 1], line[:, 0], color=TRUTH, linewidth=1.6, zorder=4.5, **_once("true wall", index))
    for hidden, style, label in ((True, "-", "hidden object (truth)"), (False, ":", "other object (truth)")):
        for index, true_object in enumerate(other for other in truth.objects if other.hidden == hidden):
            corners = box_corners_m(true_object)[:, ::-1]
            shape = Polygon(corners, fill=False, edgecolor=TRUTH, linewidth=1.8, linestyle=style, zorder=8.5)
            shape.set_label(label if index == 0 else "")
            axes.add_patch(shape)
