"""What `mirrorwave annotate` makes of simulated LiDAR clouds, against the scenes they were made from.

    python -m benchmarks.perception.annotation [--seeds 5] [--out FILE.json]

A row is a scene: pose errors of registered clouds (first poses off by 0.3 m and 3 deg, one sigma; and none given),
labels against the scene's own geometry (trucks named as objects by hand), and images against true images and against
the simulator's `SceneTruth`.
"""

from __future__ import annotations

import argparse
import json
import math
from pathlib import Path
from typing import Any

import numpy as np

from contrib.annotate.registration import PosedCloud, RegistrationParams, moved, register, rounded_pose
from contrib.annotate.simulated_clouds import LidarCloud, LidarParams, choose_viewpoints, lidar_cloud, rigid
from contrib.annotate.slice_labels import (
    MIN_HEIGHT_M,
    Disc,
    PointLabel,
    SliceLabels,
    SliceParams,
    WallRules,
    label_slice,
)
from models.physics.mirror import blocked, reflect, wall_from_ends
from models.physics.plane import segment_distance_m
from msgs.files.shipped import CHECKOUT
from nodes import player
from sim_player.generate.placement import Boxes, chords
from sim_player.scene.description import Scene, load_scene

SCENES = CHECKOUT / "launch" / "scenes"
NAMES = ("corner", "two_hidden_vehicles", "facade_across_lane", "oblique_container", "parallel_street_wall")
PARAMS = RegistrationParams()
ORIGIN = np.zeros(2)


def pose_error(a_from_b: np.ndarray, a_from_c: np.ndarray) -> tuple[float, float]:
    """Return distance [m] and angle [rad] between two rigid transforms [4, 4]."""
    difference = np.linalg.inv(a_from_b) @ a_from_c
    turned = 0.5 * np.linalg.norm(difference[:3, :3] - difference[:3, :3].T) / math.sqrt(2.0)
    angle_rad = math.atan2(turned, 0.5 * (np.trace(difference[:3, :3]) - 1.0))
    return float(np.linalg.norm(difference[:3, 3])), angle_rad


def placed_clouds(clouds: list[LidarCloud], seed: int, given: bool, row: dict[str, Any]) -> list[PosedCloud]:
    """Clouds registered in the order they are ready, as the command does; errors of all go into the row."""
    rng = np.random.default_rng([seed, 1])
    placed = [PosedCloud(clouds[0].points_m, clouds[0].radar_from_lidar)]
    guesses = [
        one.radar_from_lidar
        @ rigid(tuple(rng.normal(0.0, 0.3, 3) * (1, 1, 0.3)), 0.0, 0.0, math.radians(rng.normal(0.0, 3.0)))
        for one in clouds[1:]
    ]
    waiting = list(zip(clouds[1:], guesses, strict=True))
    how = "given" if given else "global"
    while waiting:
        tried = (
            (index, cloud, register(cloud.points_m, placed, guess if given else None, seed))
            for index, (cloud, guess) in enumerate(waiting)
        )
        held = next((one for one in tried if one[2].fault(PARAMS) is None), None)
        if held is None:
            row[f"{how}_refused"] = row.get(f"{how}_refused", 0) + len(waiting)
            break
        index, cloud, found = held
        del waiting[index]
        placed.append(PosedCloud(cloud.points_m, found.target_from_source))
        away_m, turned_rad = pose_error(cloud.radar_from_lidar, rounded_pose(found.target_from_source))
        row.setdefault(f"{how}_m", []).append(away_m)
        row.setdefault(f"{how}_deg", []).append(math.degrees(turned_rad))
    return placed


def by_hand(scene: Scene) -> WallRules:
    """What a person would say of the scene: its trucks and buses, as tall and straight as walls, are objects."""
    tall = [thing for thing in scene.objects if thing.kind.height_m >= MIN_HEIGHT_M]
    discs = [Disc(x_m=thing.x_m, y_m=thing.y_m, radius_m=0.5 * thing.kind.length_m + 0.5) for thing in tall]
    return WallRules(objects=tuple(discs))


def geometry(scene: Scene) -> tuple[np.ndarray, np.ndarray]:
    """True walls [W, 2, 2] and sides of objects [F, 2, 2]."""
    lines = [chords(surface) for surface in scene.surfaces if surface.role != "ground"]
    walls = np.concatenate([np.stack([line[:-1], line[1:]], axis=1) for line in lines])
    return walls, np.stack(Boxes.of(scene.objects).faces, axis=1)


def sight(points_m: np.ndarray, walls: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Which points the radar sees, a hand's breadth before them; bool [N]."""
    range_m = np.hypot(points_m[:, 0], points_m[:, 1])[:, None]
    every = np.concatenate([walls, faces])
    return ~blocked(ORIGIN, points_m * (1.0 - 0.1 / range_m), every[:, 0], every[:, 1])


def on_outline(points_m: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """The nearest points [N, 2] of the objects' sides."""
    index = segment_distance_m(points_m, faces[:, 0], faces[:, 1]).argmin(axis=1)
    a, along = faces[index, 0], faces[index, 1] - faces[index, 0]
    share = np.clip(np.sum((points_m - a) * along, axis=1) / np.sum(along**2, axis=1), 0.0, 1.0)
    return a + share[:, None] * along


def image_errors_m(labels: SliceLabels, walls: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Distance [K] of each image from the true place's image in the true wall it belongs to."""
    place = on_outline(labels.points_m[labels.image_point], faces)
    errors = []
    for k, image in enumerate(labels.image_m):
        fitted = labels.walls_m[labels.image_wall[k]]
        a, b = walls[segment_distance_m(fitted.mean(axis=0)[None], walls[:, 0], walls[:, 1])[0].argmin()]
        errors.append(np.linalg.norm(reflect(place[k], *wall_from_ends(a, b, ORIGIN)) - image))
    return np.array(errors)


def measure(name: str, seed: int, row: dict[str, Any]) -> None:
    """One scene, one seed."""
    path = SCENES / f"{name}.yaml"
    scene = load_scene(path)
    clouds = [
        lidar_cloud(scene, place, LidarParams(), 100 * seed + index)
        for index, place in enumerate(choose_viewpoints(scene))
    ]
    row["clouds"] = len(clouds)
    placed_clouds(clouds, seed, False, row)
    placed = placed_clouds(clouds, seed, True, row)
    merged_m = np.concatenate([moved(one.target_from_sensor, one.points_m) for one in placed])
    labels = label_slice(merged_m, -scene.radar.height_m, SliceParams(), by_hand(scene), seed)
    walls, faces = geometry(scene)
    to_wall = segment_distance_m(labels.points_m, walls[:, 0], walls[:, 1]).min(axis=1)
    to_face = segment_distance_m(labels.points_m, faces[:, 0], faces[:, 1]).min(axis=1, initial=np.inf)
    visible = sight(labels.points_m, walls, faces)
    truth = np.where(to_wall <= to_face, PointLabel.WALL, np.where(visible, PointLabel.LOS, PointLabel.HIDDEN))
    np.add.at(row.setdefault("confusion", np.zeros((3, 3), int)), (truth, labels.label), 1)
    of_wall = truth == PointLabel.WALL
    seen = sight(labels.points_m[of_wall], walls, faces)
    row["wall_points"] = row.get("wall_points", 0) + int(of_wall.sum())
    row["wall_sight_wrong"] = row.get("wall_sight_wrong", 0) + int((seen != labels.visible[of_wall]).sum())
    row.setdefault("image_m", []).extend(image_errors_m(labels, walls, faces))
    centres = player.scene_player(player.Params(scene=str(path), seed=seed)).truth(0).mirrored_points_m[:, :2]
    if len(labels.image_m):
        apart = np.linalg.norm(centres[:, None] - labels.image_m[None], axis=-1).min(axis=1)
        row.setdefault("scene_truth_m", []).extend(apart)


def finished(name: str, row: dict[str, Any]) -> dict[str, Any]:
    """A row as it is printed."""

    def spread(key: str) -> list[float]:
        return [round(float(value), 4) for value in np.quantile(row.get(key) or [np.nan], [0.5, 0.9, 1.0])]

    keys = ("given_m", "given_deg", "global_m", "global_deg", "image_m", "scene_truth_m")
    counts = {key: row.get(key, 0) for key in ("given_refused", "global_refused", "wall_points", "wall_sight_wrong")}
    registered = {key: len(row.get(key) or []) for key in ("given_m", "global_m")}
    return {
        "scene": name, "clouds": row["clouds"], **counts, "registered": registered,
        "median_p90_max": {key: spread(key) for key in keys}, "images": len(row["image_m"]),
        "confusion_true_los_hidden_wall": row["confusion"].tolist(),
    }  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--out", type=Path)
    options = parser.parse_args()
    rows = []
    for name in NAMES:
        row: dict[str, Any] = {}
        for seed in range(options.seeds):
            measure(name, seed, row)
        rows.append(finished(name, row))
        print(json.dumps(rows[-1]), flush=True)
    if options.out:
        options.out.write_text(json.dumps(rows, indent=2) + "\n")


if __name__ == "__main__":
    main()
