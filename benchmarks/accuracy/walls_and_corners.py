"""Curved walls and right-angle corners (Fig. 6): how far off recovered places are, with each way of folding.

Scenes are built and simulated here; labels, with the polar errors of good peaks (0.06 m, 0.7 degrees), are the peaks.
The error is that of a mirrored label's recovered point from its true place; a label that is not recovered counts as
infinitely far. A vehicle stands before a wall of 20 m, 24 m ahead, bent by -0.025..0.025 1/m (hollow to the radar: +);
or in a corner of two walls, 14..24 m ahead.
Usage: python -m benchmarks.accuracy.walls_and_corners [--draws 6] [--residual FILE] [--figure FILE] [--json]
"""

from __future__ import annotations

import argparse
import json
import math
import sys
from pathlib import Path

import msgspec
import numpy as np

from benchmarks.perception.geometry_switches import DEFAULT, labelled_peaks, machine, switched
from mirrorwave.plots.style import legend_below, new_figure, save
from models.perception.geometry.recovery import Residual
from models.perception.geometry.residual_model import LearnedResidual
from models.perception.geometry.stage import GeometryParams, fold_scan
from msgs.values.frames import polar_from_xy
from msgs.values.perception import PathClass, Peaks
from sim_player.dataset.labelled_scan import Labels, labelled_scan
from sim_player.scene.description import Scene, SceneObject, Surface

CURVATURES_PER_M = tuple(np.linspace(-0.025, 0.025, 11).round(4).tolist())
CORNERS_M = (14.0, 16.0, 18.0, 20.0, 22.0, 24.0)
WALL = {"role": "relay", "material": "concrete", "height_m": 6.0, "thickness_mm": 250.0, "roughness_mm": 1.0}


class Row(msgspec.Struct, kw_only=True):
    """One way of folding at one curvature or corner: errors of images seen by way of `order` mirrors."""

    scene: str
    at: float
    order: int
    way: str
    labels: int
    median_m: float | None
    within_1m: float


def curved_scene(curvature_per_m: float, rng: np.random.Generator) -> Scene:
    """A car before one wall, hollow to the radar where the curvature is positive."""
    wall = msgspec.convert(
        # the centre of a positive curvature lies left of the way: back towards the radar on the way up
        {**WALL, "polyline_m": [[24.0, -10.0], [24.0, 10.0]], "curvature_per_m": curvature_per_m},
        Surface,
    )
    x, y, yaw = rng.uniform(10.0, 16.0), rng.uniform(-6.0, 6.0), rng.uniform(-90.0, 90.0)
    car = SceneObject(class_="car", x_m=x, y_m=y, yaw_deg=yaw)
    return Scene(name="curved", surfaces=(wall,), objects=(car,))


def corner_scene(distance_m: float, rng: np.random.Generator) -> Scene:
    """A car before the right angle of two walls, the far one across the way."""
    polyline = [[distance_m, -8.0], [distance_m, 6.0], [distance_m - 10.0, 6.0]]
    x, y, yaw = distance_m - rng.uniform(5.0, 8.0), rng.uniform(-1.0, 2.0), rng.uniform(-90.0, 90.0)
    car = SceneObject(class_="van", x_m=x, y_m=y, yaw_deg=yaw)
    return Scene(name="corner", surfaces=(msgspec.convert({**WALL, "polyline_m": polyline}, Surface),), objects=(car,))


def errors_m(peaks: Peaks, labels: Labels, params: GeometryParams, residual: Residual | None) -> np.ndarray:
    """Error of each label [N], infinite where it has no recovered point; direct labels are NaN."""
    recovered = fold_scan(peaks, params, residual).recovered
    images, places = recovered.images_m, recovered.points_m
    found = np.full(len(peaks), np.inf)
    image_range_m, image_azimuth_rad = polar_from_xy(images)
    # a recovered point keeps its peak's place: that says whose it is
    for place, range_m, azimuth_rad in zip(places, image_range_m, image_azimuth_rad, strict=True):
        whose = int(np.hypot(peaks.range_m - range_m, 10.0 * (peaks.azimuth_rad - azimuth_rad)).argmin())
        found[whose] = np.linalg.norm(place - labels.hidden_xy_m[whose])
    return np.where(labels.path_class == PathClass.MIRRORED, found, np.nan)


def measure(draws: int, residual: Residual | None) -> list[Row]:
    """Rows of all scenes and ways."""
    straight = switched("walls", curved=False)
    curved_ways = {"straight": (straight, None), "arc": (DEFAULT, None)}
    corner_ways = {"folded once": (switched("recovery", second_order=False), None), "folded twice": (DEFAULT, None)}
    if residual is not None:
        curved_ways["straight + residual"] = (straight, residual)
        corner_ways["folded twice + residual"] = (DEFAULT, residual)
    found = []
    for name, values, scene_of, ways in (
        ("curved", CURVATURES_PER_M, curved_scene, curved_ways),
        ("corner", CORNERS_M, corner_scene, corner_ways),
    ):
        for at in values:
            errors: dict[tuple[str, int], list[float]] = {}
            for draw in range(draws):
                rng = np.random.default_rng([draw, 11])
                scan = labelled_scan(scene_of(at, rng), draw)
                peaks = labelled_peaks(scan.labels, scan.noise_power_mw, rng)
                for way, (params, correction) in ways.items():
                    error = errors_m(peaks, scan.labels, params, correction)
                    for order in (1, 2):
                        errors.setdefault((way, order), []).extend(error[scan.labels.order == order].tolist())
            found += [_row(name, at, *key, np.array(values)) for key, values in errors.items()]
    return found


def _row(scene: str, at: float, way: str, order: int, error_m: np.ndarray) -> Row:
    error_m = error_m[~np.isnan(error_m)]
    median_m = float(np.median(error_m)) if len(error_m) else math.inf
    return Row(
        scene=scene,
        at=at,
        order=order,
        way=way,
        labels=len(error_m),
        median_m=median_m if math.isfinite(median_m) else None,
        within_1m=float(np.mean(error_m < 1.0)) if len(error_m) else 0.0,
    )


def draw_figure(rows: list[Row], path: Path) -> None:
    """Two panels: error against curvature, and share of double images within a metre against the corner's distance."""
    figure = new_figure(10.0, 5.0)
    left, right = figure.subplots(1, 2)
    for way in dict.fromkeys(row.way for row in rows if row.scene == "curved"):
        own = [row for row in rows if row.scene == "curved" and row.order == 1 and row.way == way]
        left.plot(
            [row.at for row in own],
            [math.nan if row.median_m is None else row.median_m for row in own],
            "o-",
            label=way,
        )
    left.set(
        xlabel="curvature of the wall [1/m]\n(bulging  -  |  +  hollow towards the radar)",
        ylabel="median error of the recovered position [m]",
        title="Images in a curved wall",
        ylim=(0.0, None),
    )
    for way in dict.fromkeys(row.way for row in rows if row.scene == "corner"):
        for order, style in ((1, "o--"), (2, "s-")):
            own = [row for row in rows if row.scene == "corner" and row.order == order and row.way == way]
            mirrors = "one wall" if order == 1 else "two walls"
            right.plot(
                [row.at for row in own],
                [row.within_1m if row.labels else math.nan for row in own],
                style,
                label=f"image in {mirrors}, {way}",
            )
    right.set(
        xlabel="distance to the corner [m]",
        ylabel="share recovered within 1 m",
        title="Images at a right-angle corner",
        ylim=(0.0, 1.05),
    )
    for axes in (left, right):
        axes.grid(alpha=0.3)
        legend_below(axes, columns=2 if axes is left else 1, borderpad=1.4)
    path.parent.mkdir(parents=True, exist_ok=True)
    save(figure, path)


def line(row: Row) -> str:
    median = "   none" if row.median_m is None else f"{row.median_m:5.2f} m"
    return (
        f"{row.scene} {row.at:8.4g}  {row.order} mirror(s)  {row.way:24s} {row.labels:4d} labels  "
        f"median {median}  within 1 m {row.within_1m:.2f}"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--draws", type=int, default=6)
    parser.add_argument("--residual", type=Path, help="ONNX file of ResidualReflectNet, shown beside the others")
    parser.add_argument("--figure", type=Path)
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    residual = None if arguments.residual is None else LearnedResidual(arguments.residual)
    rows = measure(arguments.draws, residual)
    if arguments.figure:
        draw_figure(rows, arguments.figure)
    command = "python -m benchmarks.accuracy.walls_and_corners " + " ".join(sys.argv[1:])
    if arguments.json:
        print(json.dumps({"machine": machine(), "command": command, "rows": msgspec.to_builtins(rows)}))
        return
    print("\n".join([*map(line, rows), command, machine()]))


if __name__ == "__main__":
    main()
