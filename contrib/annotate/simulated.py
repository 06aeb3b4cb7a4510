"""Simulated LiDAR clouds of a scene with the manifest that annotates them and the true poses."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from pathlib import Path

import msgspec
import numpy as np
import yaml

from contrib.annotate.manifest import Cloud, Manifest, Pose
from contrib.annotate.registration import import_open3d
from contrib.annotate.simulated_clouds import LidarParams, Viewpoint, lidar_cloud, rigid
from msgs.files.checksums import json_lines
from msgs.files.whole_files import write_whole
from msgs.files.yaml_loader import PlainDumper
from sim_player.scene.description import Scene

#: Standard deviations by which first poses in the manifest are off.
GUESS_M, GUESS_RAD = 0.3, math.radians(3.0)


def write_views(
    scene: Scene,
    viewpoints: Sequence[Viewpoint],
    params: LidarParams,
    seed: int,
    out: Path,
    tick: Callable[[], None] = lambda: None,
) -> None:
    """Write a cloud a viewpoint (PLY), `scene.yaml` for `mirrorwave annotate`, and the true poses in `truth.json`.

    The first viewpoint's pose is given as it is, as calibrated.
    """
    out.mkdir(parents=True, exist_ok=True)
    rng = np.random.default_rng([seed, 1])
    clouds, truth = [], []
    for index, viewpoint in enumerate(viewpoints):
        made = lidar_cloud(scene, viewpoint, params, seed + index)
        name = f"view_{index}.ply"
        _write_cloud(out / name, made.points_m)
        slip_m = rng.normal(0.0, GUESS_M, 3) * (1.0, 1.0, 0.3)
        slip = rigid(tuple(slip_m.tolist()), 0.0, 0.0, rng.normal(0.0, GUESS_RAD))
        true = Pose.of(made.radar_from_lidar)
        first = true if index == 0 else Pose.of(made.radar_from_lidar @ slip)
        clouds.append(Cloud(file=name, radar_from_lidar=first, calibrated=index == 0))
        truth.append({"file": name, "radar_from_lidar": msgspec.to_builtins(true)})
        tick()
    manifest = Manifest(name=scene.name, radar_height_m=scene.radar.height_m, clouds=tuple(clouds), seed=seed)
    content = msgspec.to_builtins(manifest)
    plain = {name: content[name] for name in ("name", "radar_height_m", "seed", "clouds")}
    write_whole(out / "scene.yaml", yaml.dump(plain, Dumper=PlainDumper, sort_keys=False).encode())
    write_whole(out / "truth.json", json_lines(truth))


def _write_cloud(path: Path, points_m: np.ndarray) -> None:
    """Write points [N, 3]; OSError where the library could not."""
    o3d = import_open3d()
    if not o3d.io.write_point_cloud(str(path), o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points_m))):
        raise OSError(5, "could not be written", str(path))
