"""`mirrorwave sim lidar`: LiDAR clouds of a scene from several viewpoints, with the manifest that annotates them."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import msgspec
import numpy as np
import typer
import yaml

from mirrorwave.console import print_line, progress_bar
from msgs.values.wording import counted

if TYPE_CHECKING:
    from sim_player.lidar.clouds import Viewpoint


def lidar(
    scene: Annotated[Path, typer.Argument(help="Scene file (YAML).")],
    out: Annotated[Path, typer.Option(metavar="DIR", help="Folder for clouds, manifest and truth; new or empty.")],
    viewpoint: Annotated[
        list[str] | None,
        typer.Option(metavar="X,Y[,YAW_DEG]", help="Where the LiDAR stands; may be repeated. Default: chosen."),
    ] = None,
    channels: Annotated[int, typer.Option(min=2, max=1024)] = 128,
    azimuths: Annotated[int, typer.Option(min=16, max=8192, help="Rays a turn.")] = 1024,
    range_noise_m: Annotated[float, typer.Option(min=0.0, max=1.0, help="Standard deviation along the ray.")] = 0.02,
    guess_m: Annotated[
        float, typer.Option(min=0.0, max=100.0, help="Standard deviation of first poses in the manifest.")
    ] = 0.3,
    guess_deg: Annotated[float, typer.Option(min=0.0, max=180.0, help="The same of their headings.")] = 3.0,
    no_guess: Annotated[bool, typer.Option(help="Give no first poses: they are to be searched for.")] = False,
    seed: Annotated[int, typer.Option(min=0)] = 0,
) -> None:
    """LiDAR clouds of a scene (PLY), `scene.yaml` for `mirrorwave annotate`, and the true poses in `truth.json`.

    The first viewpoint's pose counts as calibrated; give the radar's own place first.
    """
    from mirrorwave.annotate.manifest import Cloud, Manifest, Pose
    from models.training.files import json_lines, write_whole
    from sim_player.lidar.clouds import LidarParams, choose_viewpoints, lidar_cloud, rigid
    from sim_player.scene.description import load_scene

    if out.exists() and any(out.iterdir()):
        raise FileExistsError(17, "must be empty or new", str(out))
    world = load_scene(scene)
    places = tuple(_viewpoint(text) for text in viewpoint) if viewpoint else choose_viewpoints(world)
    params = LidarParams(channels=channels, azimuths=azimuths, range_noise_m=range_noise_m)
    out.mkdir(parents=True, exist_ok=True)
    rng = np.random.default_rng([seed, 1])
    clouds, truth = [], []
    with progress_bar("viewpoints", len(places)) as advance:
        for index, place in enumerate(places):
            made = lidar_cloud(world, place, params, seed + index)
            name = f"view_{index}.ply"
            _write_cloud(out / name, made.points_m)
            slip_m = rng.normal(0.0, guess_m, 3) * (1.0, 1.0, 0.3)
            slip = rigid(tuple(slip_m.tolist()), 0.0, 0.0, math.radians(rng.normal(0.0, guess_deg)))
            true = Pose.of(made.radar_from_lidar)
            first = true if index == 0 else None if no_guess else Pose.of(made.radar_from_lidar @ slip)
            clouds.append(Cloud(file=name, radar_from_lidar=first, calibrated=index == 0))
            truth.append({"file": name, "radar_from_lidar": msgspec.to_builtins(true)})
            advance()
    manifest = Manifest(name=world.name, radar_height_m=world.radar.height_m, clouds=tuple(clouds), seed=seed)
    content = msgspec.to_builtins(manifest)
    plain = {name: content[name] for name in ("name", "radar_height_m", "seed", "clouds")}
    write_whole(out / "scene.yaml", yaml.safe_dump(plain, sort_keys=False).encode())
    write_whole(out / "truth.json", json_lines(truth))
    print_line(f"{out}: {counted(len(places), 'cloud')} of {world.name}, scene.yaml and truth.json, seed {seed}")


def _write_cloud(path: Path, points_m: np.ndarray) -> None:
    """Write points [N, 3]; OSError where the library could not."""
    from models.annotation.registration import import_open3d

    o3d = import_open3d()
    if not o3d.io.write_point_cloud(str(path), o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points_m))):
        raise OSError(5, "could not be written", str(path))


def _viewpoint(text: str) -> Viewpoint:
    """A viewpoint from X,Y or X,Y,YAW_DEG."""
    from sim_player.lidar.clouds import Viewpoint

    try:
        numbers = [float(part) for part in text.split(",")]
    except ValueError:
        numbers = []
    if len(numbers) not in (2, 3) or not all(map(math.isfinite, numbers)):
        raise ValueError(f"--viewpoint must be X,Y or X,Y,YAW_DEG, got {text!r}")
    return Viewpoint(x_m=numbers[0], y_m=numbers[1], yaw_deg=numbers[2] if len(numbers) == 3 else 0.0)
