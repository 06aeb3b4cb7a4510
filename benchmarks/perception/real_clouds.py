"""Registration of `mirrorwave annotate` on two pairs of real LiDAR clouds with reference poses.

    python -m benchmarks.perception.real_clouds --data DIR [--seeds 20] [--out FILE.json]

DIR holds the folder `lidar_pairs`. First poses are the reference off by a normal step (0.3 m) and a normal turn
(3 deg) about each axis, one sigma. A plain point-to-point ICP starts from the same poses: open3d, all returns, partners
within 1 m, at most 100 steps. "Apart" is the median distance of nearest neighbours, the score that a plain ICP follows,
of all points and of the ground about the sensor alone.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from benchmarks.captures import add_data_option, capture_folder
from benchmarks.perception.annotation import pose_error
from contrib.annotate.clouds import read_cloud
from contrib.annotate.registration import PosedCloud, Registration, RegistrationParams, import_open3d, moved, register

PARAMS = RegistrationParams()
STEP_M, TURN_DEG = 0.3, 3.0
#: A pose counts as recovered within these of the reference.
RIGHT_M, RIGHT_DEG = 0.1, 1.0
REACH_M = 1.0
#: Points below this and nearer than this are ground about the sensor.
GROUND_Z_M, GROUND_REACH_M = -1.4, 10.0


@dataclass(frozen=True, eq=False)
class Pair:
    """Points [N, 3] of two clouds as their sensors saw them, and the reference pose [4, 4]."""

    name: str
    source_m: np.ndarray
    target_m: np.ndarray
    target_from_source: np.ndarray
    #: Another published pose of the same pair.
    second_reference: np.ndarray | None = None


def street_pair(data: Path) -> Pair:
    """Return a street in two successive scans; most points are rings on the ground, which slide along themselves."""
    folder = data / "lidar_pairs" / "small_gicp"
    (source_m, _), (target_m, _) = (read_cloud(folder / f"{name}.ply") for name in ("source", "target"))
    return Pair("street", source_m, target_m, np.loadtxt(folder / "T_target_source.txt"))


def car_pair(data: Path) -> Pair:
    """Return two scans of a tilted sensor; the reference is the list's pose of the second."""
    folder = data / "lidar_pairs" / "libpointmatcher"
    rows = (folder / "carCloudList.csv").read_text().splitlines()[2].split(",")
    reference = np.array([float(value) for value in rows[1:]]).reshape(4, 4)
    clouds = [_csv_points(folder / f"car_cloud{number}.csv") for number in (401, 400)]
    second = np.linalg.inv(np.loadtxt(folder / "defaultIdentityDataPointsFilter.ref_trans"))
    return Pair("car", clouds[0], clouds[1], reference, second)


def _csv_points(path: Path) -> np.ndarray:
    """Return points [N, 3] of a table with commas or blanks, with a header or without."""
    rows = (line.replace(",", " ").split() for line in path.read_text().splitlines() if not line.startswith("x"))
    return np.array([[float(value) for value in row[:3]] for row in rows if row])


def first_pose(pair: Pair, seed: int) -> np.ndarray:
    """Return the reference off by a random step and turn."""
    rng = np.random.default_rng(seed)
    slip = np.eye(4)
    slip[:3, :3] = Rotation.from_rotvec(np.radians(rng.normal(0.0, TURN_DEG, 3))).as_matrix()
    slip[:3, 3] = rng.normal(0.0, STEP_M, 3)
    return np.asarray(pair.target_from_source @ slip)


def registered(pair: Pair, first: np.ndarray | None, seed: int = 0) -> Registration:
    """Return the pose that `mirrorwave annotate` finds, without its verdict."""
    return register(pair.source_m, [PosedCloud(pair.target_m, np.eye(4))], first, seed)


def plain_icp(pair: Pair, first: np.ndarray) -> np.ndarray:
    """Return the pose [4, 4] of a point-to-point ICP over all returns."""
    o3d = import_open3d()
    clouds = [o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points)) for points in (pair.source_m, pair.target_m)]
    icp = o3d.pipelines.registration
    estimation, criteria = icp.TransformationEstimationPointToPoint(), icp.ICPConvergenceCriteria(1e-7, 1e-7, 100)
    return np.asarray(icp.registration_icp(*clouds, REACH_M, first, estimation, criteria).transformation)


def ground(points_m: np.ndarray) -> np.ndarray:
    """Return which points [N, 3] belong to the ground about the sensor; bool [N]."""
    return np.asarray((points_m[:, 2] < GROUND_Z_M) & (np.hypot(points_m[:, 0], points_m[:, 1]) < GROUND_REACH_M))


def apart_m(pair: Pair, pose: np.ndarray) -> tuple[float, ...]:
    """Return the median distance of nearest neighbours under a pose, of all source points and of its ground if any."""
    distance_m = cKDTree(pair.target_m).query(moved(pose, pair.source_m))[0]
    subsets = (distance_m, distance_m[ground(pair.source_m)])
    return tuple(float(np.median(subset)) for subset in subsets if len(subset))


def errors(pair: Pair, poses: list[np.ndarray]) -> dict[str, Any]:
    """Return median and maximum errors of poses against the reference, and the number that is right."""
    away = np.array([pose_error(pair.target_from_source, pose) for pose in poses]).reshape(-1, 2)
    away_m, turned_deg = away[:, 0], np.degrees(away[:, 1])
    right = int(np.count_nonzero((away_m <= RIGHT_M) & (turned_deg <= RIGHT_DEG)))
    if not poses:
        return {"right": right}
    return {
        "right": right,
        "median_max_m": [round(float(np.median(away_m)), 4), round(float(away_m.max()), 4)],
        "median_max_deg": [round(float(np.median(turned_deg)), 3), round(float(turned_deg.max()), 3)],
    }


def measure(pair: Pair, seeds: int) -> dict[str, Any]:
    """Return the row of a pair."""
    firsts = [first_pose(pair, seed) for seed in range(seeds)]
    given = [registered(pair, first) for first in firsts]
    accepted = [one.target_from_source for one in given if one.fault(PARAMS) is None]
    # without any point of the ground
    above = replace(
        pair, source_m=pair.source_m[pair.source_m[:, 2] > 0.0], target_m=pair.target_m[pair.target_m[:, 2] > 0.0]
    )
    everywhere = registered(pair, None)
    best = max(given, key=lambda one: one.score)
    return {
        "pair": pair.name,
        "points": [len(pair.source_m), len(pair.target_m)],
        "seeds": seeds,
        "first_poses": errors(pair, firsts),
        "annotate": errors(pair, [one.target_from_source for one in given]),
        "annotate_accepted": errors(pair, accepted) | {"count": len(accepted)},
        "annotate_without_first_pose": errors(pair, [everywhere.target_from_source]),
        "annotate_above_sensor": errors(pair, [registered(above, pair.target_from_source).target_from_source]),
        "second_reference": errors(pair, [] if pair.second_reference is None else [pair.second_reference]),
        "plain_icp": errors(pair, [plain_icp(pair, first) for first in firsts]),
        "apart_m_all_ground": {
            name: [round(value, 4) for value in apart_m(pair, pose)]
            for name, pose in (
                ("no motion", np.eye(4)), ("reference", pair.target_from_source), ("annotate", best.target_from_source)
            )
        },
        "best": {
            "fitness": round(best.fitness, 3), "rmse_m": round(best.rmse_m, 4), "hold": round(best.hold.least, 4),
            "weakest": best.hold.weakest, "conflict": round(best.conflict, 5), "fault": best.fault(PARAMS),
        },
    }  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    add_data_option(parser)
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--out", type=Path)
    options = parser.parse_args()
    data = capture_folder(parser, options.data, "lidar_pairs").parent
    rows = []
    for pair in (street_pair(data), car_pair(data)):
        rows.append(measure(pair, options.seeds))
        print(json.dumps(rows[-1], indent=1), flush=True)
    if options.out:
        options.out.write_text(json.dumps(rows, indent=2) + "\n")


if __name__ == "__main__":
    main()
