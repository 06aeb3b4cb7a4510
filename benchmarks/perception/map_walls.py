"""Walls of a map about a place that GNSS gives: what target lists of drawn drives show with them, by its error.

    python -m benchmarks.perception.map_walls [--seed S] [--drives N]

The map holds a building for every wall of the drive's scene. A position error of its standard deviation is drawn for
each drive, along each axis, with 0.5 deg of heading, and stated. Poses go to the node `map_walls`, its walls to the
view.
"""

from __future__ import annotations

import argparse
import math
from itertools import pairwise

import numpy as np

from benchmarks.perception.simulated_lists import listed_scans, print_found
from lab.evaluate.labelled_beams import LabelledPlace
from lab.measures.object_rows import ScanRow, scan_row
from models.perception.see.evidence_predictor import EvidencePredictor
from models.perception.target_lists.defaults import DETECTION_GEOMETRY
from models.perception.track.views_over_scans import ViewStage
from msgs.values.environment import GnssPose
from msgs.values.frames import Pose2
from msgs.values.units import s_from_ns
from sim_player.maps.footprints import Footprint, FootprintFile
from sim_player.maps.map_walls import MapWalls
from sim_player.scene.description import Scene
from sim_player.scene.world import vehicle_pose

#: Errors of the position [m]; None: no map.
ERRORS_M = (None, 0.0, 1.0, 3.0)
HEADING_STD_DEG = 0.5
SCANS = 8
#: A building reaches so far behind its wall.
DEPTH_M = 0.3
#: Metres of a degree of latitude and of longitude where the scene begins, on the equator.
PER_DEGREE_M = 110_574.4, 111_319.5


def geodetic(points_m: np.ndarray) -> np.ndarray:
    """Return longitudes and latitudes [N, 2] of points of a scene, which begins looking north."""
    return np.stack([-points_m[:, 1] / PER_DEGREE_M[1], points_m[:, 0] / PER_DEGREE_M[0]], axis=1)


def footprints(scene: Scene) -> FootprintFile:
    """Return a building for each closed line of wall, and one for each straight piece of an open one."""
    rings = []
    for surface in scene.surfaces:
        line_m = np.array(surface.polyline_m)
        if surface.role == "ground":
            continue
        if len(line_m) > 3 and np.allclose(line_m[0], line_m[-1]):
            rings.append(line_m[:-1])
            continue
        for a, b in pairwise(line_m):
            left = np.array([a[1] - b[1], b[0] - a[0]]) / math.dist(a, b)
            # away from where the drive begins
            back = DEPTH_M * left * (1.0 if a @ left > 0.0 else -1.0)
            rings.append(np.array([a, b, b + back, a + back]))
    outer = (tuple(map(tuple, geodetic(ring).tolist())) for ring in rings)
    return FootprintFile(tuple(Footprint("wall", ring, (), {}) for ring in outer), (), False, {})


def gnss(place: LabelledPlace, stamp_ns: int, std_m: float) -> GnssPose:
    """Return the pose that a receiver believes; its error is the drive's."""
    rng = np.random.default_rng([6, place.index])
    elapsed_s = s_from_ns(stamp_ns - place.player.stamp_ns(0))
    off_m, turn_deg = std_m * rng.standard_normal(2), HEADING_STD_DEG * rng.standard_normal()
    pose = vehicle_pose(place.scene, elapsed_s) @ Pose2(float(off_m[0]), float(off_m[1]))
    ((longitude_deg, latitude_deg),) = geodetic(np.array([[pose.x_m, pose.y_m]])).tolist()
    heading_deg = -math.degrees(pose.yaw_rad) + (float(turn_deg) if std_m else 0.0)
    return GnssPose(
        stamp_ns=stamp_ns,
        latitude_deg=latitude_deg,
        longitude_deg=longitude_deg,
        heading_deg=heading_deg,
        position_std_m=std_m,
        heading_std_deg=HEADING_STD_DEG if std_m else 0.0,
    )


def main() -> None:
    """Print a line a case."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seed", type=int, default=48004)
    parser.add_argument("--drives", type=int, default=12)
    options = parser.parse_args()
    predictor = EvidencePredictor()
    rows: dict[float | None, list[ScanRow]] = {error_m: [] for error_m in ERRORS_M}
    for index in range(options.drives):
        place = LabelledPlace(options.seed, index, "all", scans=SCANS)
        walls = MapWalls(footprints(place.scene))
        views = {error_m: ViewStage(predictor=predictor, detections=DETECTION_GEOMETRY) for error_m in ERRORS_M}
        for scan in listed_scans(place):
            for error_m, view in views.items():
                view.add_state(scan.state)
                if error_m is not None:
                    view.add_walls(walls.at(gnss(place, scan.peaks.stamp_ns, error_m)))
                frame = view.view(scan.peaks)
                rows[error_m].append(scan_row(index, frame.objects, scan.truth, scan.images))
    for error_m in ERRORS_M:
        print_found("no map" if error_m is None else f"map, position within {error_m:g} m", rows[error_m])


if __name__ == "__main__":
    main()
