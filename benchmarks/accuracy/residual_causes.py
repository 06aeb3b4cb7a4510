"""Residuals that the mirror law leaves behind fitted walls, by cause and place, and what a network takes off them.

Each image of the test scenes that has a true counterpart gets the first cause that holds: two mirrors; no wall (eta of
1); another wall than the one that mirrored it; a curved, a rough, a thinly sampled wall; none of these. The mirror that
truly made it bisects image and object: its wall is that of the scene nearest to where its ray meets the bisector.
Usage: python -m benchmarks.accuracy.residual_causes --data DIR [--model FILE] [--residual FILE ...]
       [--source peaks|truth] [--back-end specification|ours] [--limit N] [--out DIR]
"""

from __future__ import annotations

import argparse
from collections import defaultdict
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.progress import track

from mirrorwave.plots.style import BLUE, ORANGE, new_figure, save
from mirrorwave.studies.report import table
from models.evaluation.metrics import match_points
from models.perception.detection.detectors import NetworkDetector
from models.perception.detection.onnx_model import DEFAULT_MODEL
from models.perception.geometry.association import DirectReturns
from models.perception.geometry.mirrors import NO_WALL
from models.perception.geometry.recovery import reflection_state
from models.perception.geometry.residual_model import LearnedResidual
from models.perception.geometry.stage import BackEnd, GeometryParams, fold_scan
from models.physics.curved_mirror import arc_points
from models.training.data.frames import DataSet, Frame, fixed_splits
from models.training.data.residual_samples import truth_peaks
from msgs.values.frames import xy_from_polar
from msgs.values.perception import PathClass, Peaks, Wall
from sim_player.scene.description import scene_from_yaml

CAUSES = ("two mirrors", "no wall", "wrong wall", "curved wall", "rough wall", "few returns", "flat wall")
#: A detected image is one of the truth within this; a point is on a wall of the scene within this.
GATE_M, ON_WALL_M = 2.0, 1.5
#: The same mirror for all that matters: its direction, and its distance at the point that mirrors.
SAME_DEG, SAME_M = 5.0, 1.0
#: The roughest walls of the places have 2 mm (Rayleigh's limit at 3 cm and normal incidence is 3.75 mm); so few returns
#: hardly fix a wall's direction.
ROUGH_MM, FEW = 1.0, 4


@dataclass(frozen=True)
class Surfaces:
    """Walls of a scene as points [P, 2], each with the index, curvature [1/m] and roughness [mm] of its wall."""

    points_m: np.ndarray
    index: np.ndarray
    curvature_per_m: np.ndarray
    roughness_mm: np.ndarray

    @classmethod
    def of(cls, scene_yaml: str) -> Surfaces:
        points, facts = [], []
        for index, surface in enumerate(scene_from_yaml(scene_yaml).surfaces):
            if surface.role == "ground":
                continue
            for a, b in zip(surface.polyline_m[:-1], surface.polyline_m[1:], strict=True):
                count = max(int(np.hypot(b[0] - a[0], b[1] - a[1]) / 0.25), 2)
                line = arc_points(np.array(a), np.array(b), surface.curvature_per_m, np.linspace(0.0, 1.0, count))
                points.append(line)
                facts += [(index, surface.curvature_per_m, surface.roughness_mm)] * count
        index, curvature, roughness = np.array(facts).T
        return cls(np.concatenate(points), index.astype(int), curvature, roughness)

    def nearest(self, points_m: np.ndarray) -> np.ndarray:
        """Row of the nearest point of each [N, 2]; -1 where none is near."""
        distance_m = np.linalg.norm(points_m[:, None] - self.points_m, axis=-1)
        row = distance_m.argmin(axis=1)
        return np.where(distance_m[np.arange(len(row)), row] <= ON_WALL_M, row, -1)


@dataclass(frozen=True)
class Residuals:
    """Images of a scene with their cause: residuals [m], what the peak's own error is of it, and those after each
    network.
    """

    cause: list[str]
    before_m: np.ndarray
    peak_m: np.ndarray
    after_m: list[np.ndarray]


def residuals_of(frame: Frame, peaks: Peaks, back_end: BackEnd, networks: list[LearnedResidual]) -> Residuals:
    scan = fold_scan(peaks, GeometryParams(back_end=back_end))
    returns, walls, recovered = scan.returns, scan.walls, scan.recovered
    labels = frame.labels
    truth = labels.take((labels.path_class == PathClass.MIRRORED) & np.isfinite(labels.hidden_xy_m).all(axis=1))
    images_m = xy_from_polar(truth.range_m.astype(np.float64), truth.azimuth_rad.astype(np.float64))
    pairs = match_points(recovered.images_m, images_m, GATE_M)
    own, other = pairs[:, 0], pairs[:, 1]
    objects_m = truth.hidden_xy_m.astype(np.float64)[other]
    folded_m = recovered.points_m
    shifts = [network(reflection_state(recovered, walls, returns)) for network in networks]
    return Residuals(
        cause=causes_of(frame, truth.order[other], recovered.wall[own], images_m[other], objects_m, walls, returns),
        before_m=np.linalg.norm(objects_m - folded_m[own], axis=1),
        peak_m=np.linalg.norm(images_m[other] - recovered.images_m[own], axis=1),
        after_m=[np.linalg.norm(objects_m - (folded_m + shift)[own], axis=1) for shift in shifts],
    )


def causes_of(
    frame: Frame, order: np.ndarray, used: np.ndarray, images_m: np.ndarray, objects_m: np.ndarray,
    walls: list[Wall], returns: DirectReturns,
) -> list[str]:  # fmt: skip
    """The first cause of each image [N] that holds."""
    surfaces = Surfaces.of(frame.scene_yaml)
    across = images_m - objects_m
    normal = across / np.maximum(np.linalg.norm(across, axis=1, keepdims=True), 1e-9)
    middle = 0.5 * (images_m + objects_m)
    along = np.sum(normal * middle, axis=1) / np.where(np.abs(d := np.sum(normal * images_m, axis=1)) > 1e-6, d, 1e-6)
    turn_m = along[:, None] * images_m
    mirror = surfaces.nearest(turn_m)
    on = surfaces.nearest(returns.points_m) if len(returns.points_m) else np.zeros(0, int)
    causes = []
    for i, wall in enumerate(used):
        if order[i] > 1:
            causes.append("two mirrors")
        elif wall == NO_WALL:
            causes.append("no wall")
        elif _is_other(
            walls[wall], normal[i], turn_m[i], surfaces.index[on[returns.wall == wall]], surfaces, mirror[i]
        ):
            causes.append("wrong wall")
        elif mirror[i] >= 0 and surfaces.curvature_per_m[mirror[i]]:
            causes.append("curved wall")
        elif mirror[i] >= 0 and surfaces.roughness_mm[mirror[i]] >= ROUGH_MM:
            causes.append("rough wall")
        else:
            causes.append("few returns" if walls[wall].inliers <= FEW else "flat wall")
    return causes


def _is_other(
    wall: Wall, normal: np.ndarray, turn_m: np.ndarray, under: np.ndarray, surfaces: Surfaces, mirror: int
) -> bool:
    """Whether the wall in use lies neither on the mirror's surface nor where the mirror is."""
    if mirror >= 0 and len(under) and np.bincount(under).argmax() == surfaces.index[mirror]:
        return False
    angle_deg = np.degrees(np.arccos(np.clip(abs(normal @ np.array(wall.normal)), 0.0, 1.0)))
    return bool(angle_deg > SAME_DEG or abs(np.array(wall.normal) @ turn_m + wall.offset_m) > SAME_M)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, default=Path("data/places_v1"))
    parser.add_argument("--model", type=Path, default=DEFAULT_MODEL)
    parser.add_argument("--residual", type=Path, nargs="*", default=[])
    parser.add_argument("--source", choices=("peaks", "truth"), default="peaks")
    parser.add_argument("--back-end", choices=("specification", "ours"), default="specification")
    parser.add_argument("--limit", type=int)
    parser.add_argument("--out", type=Path, default=Path("runs/residual_causes"))
    options = parser.parse_args()
    data = DataSet(options.data)
    networks = [LearnedResidual(path) for path in options.residual]
    detector = NetworkDetector(data.setup, options.model, refine=False)
    indices = fixed_splits(options.data).test[: options.limit]
    for network in networks:
        network.require_trained_for(options.back_end)
    rows: dict[str, list[np.ndarray]] = defaultdict(list)
    places: dict[str, list[np.ndarray]] = defaultdict(list)
    for frame in track(data.frames(indices), "scenes", len(indices), console=Console(stderr=True)):
        peaks = truth_peaks(frame.labels) if options.source == "truth" else detector.detect(frame.ra_map)
        found = residuals_of(frame, peaks, options.back_end, networks)
        for cause, *values in zip(found.cause, found.before_m, found.peak_m, *found.after_m, strict=True):
            rows[cause].append(np.array(values))
            places[frame.place].append(np.array(values))
    options.out.mkdir(parents=True, exist_ok=True)
    by_cause = {cause: np.array(rows[cause]) for cause in CAUSES if rows[cause]}
    by_cause["all"] = np.concatenate(list(by_cause.values()))
    names = [path.parent.name for path in options.residual]
    print("\n".join(table(*_table(by_cause, names))))
    by_place = {place: np.array(values) for place, values in sorted(places.items())}
    print("\n".join(table(*_table({**by_place, "all": by_cause["all"]}, names))))
    _draw(by_cause, names, options.out / f"residual_causes_{options.source}.png")


def _table(by_cause: dict[str, np.ndarray], names: list[str]) -> tuple[list[str], list[list[str]]]:
    columns = ["cause", "images", "share", "residual p50 [m]", "p90", "within 1 m", "all within would add"]
    columns += ["the peak's own error p50 [m]"]
    columns += [f"{name}: {what}" for name in names for what in ("p50", "within 1 m")]
    total, rows = len(by_cause["all"]), []
    for cause, values in by_cause.items():
        p50, p90 = np.quantile(values[:, 0], (0.5, 0.9))
        row = [cause, str(len(values)), f"{100.0 * len(values) / total:.0f} %", f"{p50:.2f}", f"{p90:.2f}"]
        row += [_share(values[:, 0]), f"{100.0 * np.sum(values[:, 0] > 1.0) / total:.1f} %"]
        row += [f"{np.median(values[:, 1]):.2f}"]
        for after_m in values[:, 2:].T:
            row += [f"{np.median(after_m):.2f}", _share(after_m)]
        rows.append(row)
    return columns, rows


def _share(residual_m: np.ndarray) -> str:
    return f"{100.0 * np.mean(residual_m <= 1.0):.1f} %"


def _draw(by_cause: dict[str, np.ndarray], names: list[str], path: Path) -> None:
    """Boxes of the residuals by cause, before and after the first network."""
    figure = new_figure(8.0, 1.0 + 0.8 * len(by_cause))
    axes = figure.subplots()
    shown = [("mirror law alone", BLUE, 0)] + ([(f"with residual {names[0]}", ORANGE, 2)] if names else [])
    for offset, (label, colour, column) in zip((0.18, -0.18), shown, strict=False):
        at = [position + offset for position in range(len(by_cause))]
        boxes = axes.boxplot(
            [np.maximum(values[:, column], 1e-3) for values in by_cause.values()], positions=at, widths=0.3,
            orientation="horizontal", whis=(5.0, 95.0), showfliers=False, patch_artist=True, manage_ticks=False,
            medianprops={"color": "black"},
        )  # fmt: skip
        for box in boxes["boxes"]:
            box.set_facecolor(colour)
        boxes["boxes"][0].set_label(label)
    axes.axvline(1.0, color="grey", linestyle="--", linewidth=1.0)
    axes.set_yticks(range(len(by_cause)), [f"{cause} ({len(values)})" for cause, values in by_cause.items()])
    axes.set(xscale="log", xlim=(0.03, 60.0), xlabel="distance from the true position [m]; box: half, line: 90 %")
    axes.invert_yaxis()
    axes.legend(loc="upper left")
    save(figure, path)


if __name__ == "__main__":
    main()
