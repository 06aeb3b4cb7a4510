"""One scene through several sensors: their maps side by side from above, with walls, truth and what each recovers."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.patheffects import Normal, Stroke
from scipy.ndimage import maximum_filter

from lab.compare.comparison_scenes import ShownPoints, shown_points
from lab.compare.peak_scores import found_peaks, recovered_places, score
from lab.compare.sensors import GRID, SENSORS, Equal, Sensor, Sight, SpadSensor
from lab.measures.point_scores import Counts
from mirrorwave.console import error_line
from mirrorwave.plots.style import MIRROR_IMAGE, RECOVERED, TRUTH, handles_of, legend_of_figure, new_figure, save
from models.perception.find.peaks import echo_power
from msgs.values.frames import xy_from_polar
from sim_player.generate.placement import chords
from sim_player.scene.description import Scene

#: Sensors of the picture; of a scene with a LiDAR of its own that one in the last place.
PICTURE, OWN = ("xband", "77ghz", "spad_long"), "scene"
#: Levels that are drawn, dB over the mean noise: from where noise ends to where nothing is added.
LEVELS_DB = (8.0, 50.0)
#: White lines stay lines on white paper.
OUTLINE = [Stroke(linewidth=3.6, foreground="black"), Normal()]
#: What is equal. A LiDAR of the scene's own has the power that its panel names.
HEADS: dict[Equal, str] = {
    "power": "1.6 mW each, for its own time",
    "energy": "1.6 mW each, as much energy a scan as X-band",
}
MARGIN_M, PANEL_INCH = 4.0, 3.3


@dataclass(frozen=True)
class View:
    """One sensor's look at the scene; without a sight the reason why it has none."""

    sensor: Sensor
    sight: Sight | None
    #: Recovered places [N, 2] and what they score.
    places_m: np.ndarray
    truth: ShownPoints
    figures: dict[str, Any]

    def summary(self) -> dict[str, Any]:
        """Return the printed summary."""
        return {"sensor": self.sensor.name, **self.figures}


def sensors_of(scene: Scene, names: Sequence[str] = ()) -> list[Sensor]:
    """Sensors by their names, none: those of the picture; `OWN` is the LiDAR that a scene of preset "spad" describes.

    ValueError for an unknown one.
    """
    by_name, picture = dict(SENSORS), list(PICTURE)
    if scene.radar.preset == "spad":
        spad = scene.radar.spad
        own = SpadSensor(OWN, f"SPAD of the scene, {1e3 * spad.average_power_w:g} mW", spad)
        by_name[OWN], picture[-1] = own, OWN
    for name in names:
        if name not in by_name:
            raise ValueError(f"--sensor must be one of {', '.join(by_name)}, got {name!r}")
    return [by_name[name] for name in dict.fromkeys(names or picture)]


def scene_through(
    scene: Scene, sensors: Sequence[Sensor], equal: Equal, seed: int = 0, tick: Callable[[], None] = lambda: None
) -> list[View]:
    """Compute each sensor's view of a scene at rest, in the position of its own; one that cannot see it gives the
    reason.

    ValueError for a negative seed, a scene that moves, and where no sensor can look.
    """
    if scene.moves:
        raise ValueError(f"scene {scene.name!r} must be at rest, got one that moves")
    truth = shown_points(scene, seed)
    views = []
    for sensor in sensors:
        views.append(_view(scene, sensor, equal, seed, truth))
        tick()
    if all(view.sight is None for view in views):
        raise ValueError(f"scene {scene.name!r}: {views[0].figures['failed']}")
    return views


def _view(scene: Scene, sensor: Sensor, equal: Equal, seed: int, truth: ShownPoints) -> View:
    none: dict[str, Any] = dict.fromkeys(("F1 1 m", "F1 2 m", "found", "hidden", "false objects", "SNR [dB]"))
    try:
        sight = sensor.look(scene, seed, seed, equal)
    except ValueError as error:
        return View(sensor, None, np.zeros((0, 2)), truth, {**none, "failed": error_line(error)})
    scores = score(sight, scene, truth)
    figures = {
        "F1 1 m": Counts(*scores.within_1m).f1,
        "F1 2 m": Counts(*scores.within_2m).f1,
        "found": scores.found,
        "hidden": scores.hidden,
        "false objects": scores.false_objects,
        "SNR [dB]": scores.snr_db,
        "failed": None,
    }
    return View(sensor, sight, recovered_places(found_peaks(sight), scene), truth, figures)


def draw_scene_through(scene: Scene, views: Sequence[View], equal: Equal, path: Path) -> None:
    """A panel a sensor; equal numbers give equal bytes."""
    limits = _limits(scene, views)
    width, height = limits[1] - limits[0], limits[3] - limits[2]
    panel = PANEL_INCH * height / width
    figure = new_figure(PANEL_INCH * len(views) + 0.9, float(np.clip(panel, 2.6, 6.0)) + 1.6)
    panels = figure.subplots(1, len(views), squeeze=False, sharey=True)[0]
    mesh = None
    for axes, view in zip(panels, views, strict=True):
        mesh = _draw_view(axes, scene, view) or mesh
        axes.set(xlim=(limits[1], limits[0]), ylim=(limits[2], limits[3]), xlabel="y, left [m]")
        axes.set_aspect("equal")
    panels[0].set_ylabel("x, forward [m]")
    figure.suptitle(f"{scene.name}: {HEADS[equal]}; known walls, one detector")
    if mesh is not None:
        figure.colorbar(mesh, ax=panels.tolist(), label="level over noise [dB]", fraction=0.03, pad=0.01)
    legend_of_figure(figure, handles_of(*panels), columns=6)
    save(figure, path, dpi=150)


def _limits(scene: Scene, views: Sequence[View]) -> tuple[float, float, float, float]:
    """Right, left, back and front ends [m] of what is drawn: sensor, objects, and what mirrors show of them."""
    points = [np.zeros((1, 2)), *(item.corners_m() for item in scene.objects)]
    points += [view.truth.image_m for view in views]
    every = np.concatenate(points)
    low, high = every.min(axis=0) - MARGIN_M, every.max(axis=0) + MARGIN_M
    # no panel is more than twice as tall as wide, or the other way round
    short = 0.5 * max(high - low)
    low, high = np.minimum(low, 0.5 * (low + high - short)), np.maximum(high, 0.5 * (low + high + short))
    return float(low[1]), float(high[1]), float(low[0]), float(high[0])


def _draw_view(axes: Axes, scene: Scene, view: View) -> Any:
    """Map, walls, truth, recovered places of one sensor; the map's mesh, None without one."""
    axes.set_facecolor("#e8e8e8")
    mesh = None if view.sight is None else _draw_map(axes, view.sight)
    for index, surface in enumerate(candidate for candidate in scene.surfaces if candidate.role != "ground"):
        line = chords(surface)
        # a label with an underscore stays out of the legend
        label = "wall" if index == 0 else "_wall"
        axes.plot(line[:, 1], line[:, 0], color="white", lw=2.0, zorder=4, label=label, path_effects=OUTLINE)
    for index, item in enumerate(scene.objects):
        corners = item.corners_m()
        hidden = index in view.truth.hidden
        first = index == next(
            candidate for candidate in range(len(scene.objects)) if (candidate in view.truth.hidden) == hidden
        )
        label = ("hidden object" if hidden else "other object") if first else "_object"
        colour = TRUTH if hidden else "#bbbbbb"
        axes.fill(corners[:, 1], corners[:, 0], fill=False, edgecolor=colour, lw=2.0, zorder=5, label=label)
    image_m, places_m = view.truth.image_m, view.places_m
    axes.scatter(
        image_m[:, 1],
        image_m[:, 0],
        s=26,
        marker="D",
        fc="none",
        ec=MIRROR_IMAGE,
        lw=1.2,
        zorder=6,
        label="its image in the wall",
    )
    axes.scatter(places_m[:, 1], places_m[:, 0], s=42, marker="x", color=RECOVERED, lw=1.8, zorder=7, label="recovered")
    axes.plot(0.0, 0.0, marker="^", ms=11, color="black", mec="white", ls="none", zorder=8, label="sensor")
    axes.set_title(_title(view), fontsize=10, loc="left")
    if view.sight is None:
        reason = textwrap.fill(str(view.figures["failed"]), 36)
        axes.text(0.5, 0.5, reason, transform=axes.transAxes, ha="center", va="center", fontsize=10, zorder=9)
    return mesh


def _title(view: View) -> str:
    """Return the sensor's name and its result."""
    name = view.sensor.title
    if view.sight is None:
        return f"{name}\ncannot look at this scene"
    level = view.figures["SNR [dB]"]
    snr = "" if level is None else f", image {level:.0f} dB over noise"
    return f"{name}\nF1 {view.figures['F1 1 m']:.2f} within 1 m{snr}"


def _draw_map(axes: Axes, sight: Sight) -> Any:
    """Level over noise in the plane, each cell as bright as its brightest neighbour: a lone one would be too small."""
    power = echo_power(sight.ra_map) / sight.ra_map.noise_power_mw
    level_db = 10.0 * np.log10(np.maximum(maximum_filter(power, 3), 1e-3))
    step, limit = GRID.azimuth_step_rad, math.radians(GRID.azimuth_limit_deg)
    azimuth = np.linspace(-limit - 0.5 * step, limit + 0.5 * step, GRID.azimuth_bins + 1)
    range_m = GRID.range_bin_m * np.maximum(np.arange(GRID.range_bins + 1) - 0.5, 0.0)
    corners = xy_from_polar(*np.meshgrid(range_m, azimuth, indexing="ij"))
    low, high = LEVELS_DB
    return axes.pcolormesh(
        corners[..., 1], corners[..., 0], level_db, cmap="cividis", vmin=low, vmax=high, rasterized=True
    )
