"""Real 77 GHz detections against a LiDAR: `python -m benchmarks.perception.real_detections [--data DIR] [--blocks]`.

Six frames of a public data set (Astyx 6455 HiRes). Nothing was trained on them, but rules were made with them in view.
Frame 000036 holds mirror images of trucks and walls in the metal facade of a hall; the trucks are in plain sight too.
The others hold no verified image.

- Facade: the wall of the returns nearest to it, against a line through the LiDAR's points. The LiDAR is thinned evenly
  along the facade (medians of 1 m), once over its whole length, once over the part that the radar's wall covers.
- Truck: mean of the folded positions and mean of the direct returns within its labelled box and a margin; their
  distance. With this selection no distance can exceed the box.
- Left-hand walls: peaks of the folded y of images in the facade, and how far the LiDAR's walls are.
- Hidden objects: reported in each frame; in the five others all are taken to be false. `--blocks`: how many a frame of
  `astyx_77ghz_blocks`, frames without LiDAR.
"""

from __future__ import annotations

import argparse
import json
import math
import time
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.captures import add_data_option, capture_folder
from benchmarks.perception.astyx_frames import FRAMES, IMAGE_FRAME, SENSOR, AstyxFrame, Box, read_detections, read_frame
from models.perception.mirrors.lines import fit_line
from models.perception.mirrors.peaks_to_view import fold_scan
from models.perception.mirrors.recovery import Recovered
from models.perception.see.evidence_predictor import EvidencePredictor
from models.perception.target_lists.defaults import DETECTION_GEOMETRY
from models.perception.target_lists.targets_to_peaks import DetectionsStage
from models.perception.track.views_over_scans import ViewStage
from msgs.values.detections import RadarDetections
from msgs.values.frames import xy_from_polar
from msgs.values.perception import BevFrame, PathClass, Peaks, Wall

#: Line of the facade as the data's note states it, direction and a point, about which LiDAR points are looked for.
FACADE_DIRECTION, FACADE_POINT_M = (0.9999, 0.0147), (13.5, -11.7)
FACADE_X_M = (0.0, 36.0)
#: Points off the ground and below the eaves, and so near the line.
HEIGHTS_M, BAND_M = (-0.6, 3.0), 0.8
TRUCK_MARGIN_M = 1.0
#: Folded positions of the walls on the left: looked for this near the LiDAR's.
LEFT_WALLS_M, LEFT_BAND_M = (6.6, 19.0), 2.0


def run(data: Path) -> dict[str, Any]:
    """Return all figures."""
    frames = {name: read_frame(data, name, index) for index, name in enumerate(FRAMES)}
    view = Viewer()
    view(frames[IMAGE_FRAME].detections)
    results = {name: view(frame.detections) for name, frame in frames.items()}
    peaks, frame, _ = results[IMAGE_FRAME]
    recovered = fold_scan(peaks, DETECTION_GEOMETRY).recovered
    return {
        "facade": facade(frames[IMAGE_FRAME], frame),
        "trucks": [
            truck(box, recovered, peaks) for box in frames[IMAGE_FRAME].boxes if box.name == "Truck"
        ],
        "left_walls": [left_wall(recovered, y_m) for y_m in LEFT_WALLS_M],
        "hidden_objects": {name: len(frame.objects) for name, (_, frame, _) in results.items()},
        "walls": {name: len(frame.walls) for name, (_, frame, _) in results.items()},
        "detections": {name: len(frame.detections) for name, frame in frames.items()},
        "ms": {name: round(1e3 * seconds, 1) for name, (_, _, seconds) in results.items()},
    }  # fmt: skip


class Viewer:
    """Peaks of a frame, its view by itself, and the seconds that both take."""

    def __init__(self) -> None:
        self._stage, self._predictor = DetectionsStage(SENSOR, DETECTION_GEOMETRY), EvidencePredictor()

    def __call__(self, detections: RadarDetections) -> tuple[Peaks, BevFrame, float]:
        # frames stand alone: no wall of another drive
        stage = ViewStage(predictor=self._predictor, detections=DETECTION_GEOMETRY)
        start_s = time.perf_counter()
        peaks = self._stage.peaks(detections)
        view = stage.view(peaks)
        return peaks, view, time.perf_counter() - start_s


def hidden_a_frame(blocks: Path) -> float:
    """Return how many hidden objects are reported a frame of a folder of frames without LiDAR."""
    view, names = Viewer(), sorted(path.stem for path in (blocks / "radar_6455").glob("*.txt"))
    reports = [len(view(read_detections(blocks, name))[1].objects) for name in names]
    return float(np.mean(reports))


def facade(frame: AstyxFrame, view: BevFrame) -> dict[str, Any]:
    """Return the errors of the radar's wall against the LiDAR's lines: distance at the wall's middle, angle."""
    normal, offset_m = np.array([-FACADE_DIRECTION[1], FACADE_DIRECTION[0]]), 0.0
    offset_m = -float(normal @ FACADE_POINT_M)
    own = min(view.walls, key=lambda wall: abs(float(normal @ np.mean(wall.ends_m, axis=0)) + offset_m))
    x_m = np.sort(np.array(own.ends_m)[:, 0])
    shared = max(FACADE_X_M[0], x_m[0]), min(FACADE_X_M[1], x_m[1])
    return {
        "wall_ends_m": np.round(own.ends_m, 2).tolist(),
        "whole": against(own, *lidar_line(frame.lidar_m, FACADE_X_M)),
        "shared": against(own, *lidar_line(frame.lidar_m, shared)),
    }


def lidar_line(lidar_m: np.ndarray, x_m: tuple[float, float]) -> tuple[np.ndarray, float]:
    """Return normal [2] and offset of the facade's line over a span of x: a median a metre, outliers left out twice."""
    normal = np.array([-FACADE_DIRECTION[1], FACADE_DIRECTION[0]])
    high = (lidar_m[:, 2] > HEIGHTS_M[0]) & (lidar_m[:, 2] < HEIGHTS_M[1])
    points_m = lidar_m[high, :2]
    points_m = points_m[np.abs((points_m - FACADE_POINT_M) @ normal) < BAND_M]
    bins = [points_m[np.floor(points_m[:, 0]) == at] for at in range(math.ceil(x_m[0]), math.floor(x_m[1]))]
    middles_m = np.array([np.median(points, axis=0) for points in bins if len(points) >= 3])
    for _ in range(3):
        normal, offset_m, _, _ = fit_line(middles_m, np.tile(np.eye(2), (len(middles_m), 1, 1)))
        residual_m = np.abs(middles_m @ normal + offset_m)
        middles_m = middles_m[residual_m <= max(0.1, 2.0 * float(np.median(residual_m)))]
    return normal, offset_m


def against(wall: Wall, normal: np.ndarray, offset_m: float) -> dict[str, float]:
    """Return distance at the wall's middle [m] and angle [deg] between a wall and a line."""
    turn = float(np.cross(np.append(normal, 0.0), (*wall.normal, 0.0))[2])
    distance_m = float(normal @ np.mean(wall.ends_m, axis=0)) + offset_m
    return {"distance_m": round(distance_m, 3), "angle_deg": round(math.degrees(math.asin(turn)), 3)}


def truck(box: Box, recovered: Recovered, peaks: Peaks) -> dict[str, Any]:
    """Return where a truck's direct returns and its folded images stand, and how far they are from each other."""
    points_m = xy_from_polar(peaks.range_m, peaks.azimuth_rad)[peaks.path_class == PathClass.LOS]
    direct = points_m[box.holds(points_m, TRUCK_MARGIN_M)]
    folded = recovered.points_m[box.holds(recovered.points_m, TRUCK_MARGIN_M)]
    apart_m = np.linalg.norm(folded.mean(axis=0) - direct.mean(axis=0)) if len(folded) and len(direct) else np.nan
    return {
        "label_m": np.round(box.centre_m, 1).tolist(),
        "direct": len(direct),
        "folded": len(folded),
        "direct_m": np.round(direct.mean(axis=0), 2).tolist() if len(direct) else None,
        "folded_m": np.round(folded.mean(axis=0), 2).tolist() if len(folded) else None,
        "apart_m": round(float(apart_m), 2),
    }


def left_wall(recovered: Recovered, y_m: float) -> dict[str, float]:
    """Return the number and the median of folded y near a wall on the left, before the trucks."""
    x, y = recovered.points_m.T
    near = (x > 10.0) & (x < 60.0) & (np.abs(y - y_m) <= LEFT_BAND_M)
    return {"lidar_y_m": y_m, "folded": int(near.sum()), "median_y_m": round(float(np.median(y[near])), 2)}


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.perception.real_detections", description=__doc__)
    add_data_option(parser)
    parser.add_argument("--blocks", action="store_true")
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    if options.blocks:
        print(f"{hidden_a_frame(capture_folder(parser, options.data, 'astyx_77ghz_blocks')):.3f} hidden a frame")
        return
    figures = run(capture_folder(parser, options.data, "astyx_77ghz"))
    if options.json:
        print(json.dumps(figures, indent=1))
        return
    for name, value in figures.items():
        print(name, json.dumps(value))


if __name__ == "__main__":
    main()
