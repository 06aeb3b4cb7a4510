"""`mirrorwave sim lidar`: LiDAR clouds of a scene from several viewpoints, with the manifest that annotates them."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from mirrorwave.console import print_line, progress_bar
from msgs.values.wording import counted

if TYPE_CHECKING:
    from contrib.annotate.simulated_clouds import Viewpoint


def lidar(
    scene: Annotated[Path, typer.Argument(metavar="SCENE", help="Scene file (YAML).")],
    out: Annotated[Path, typer.Option(metavar="DIR", help="Folder for clouds, manifest and truth; new or empty.")],
    viewpoint: Annotated[
        list[str] | None,
        typer.Option(metavar="X,Y[,YAW_DEG]", help="Where the LiDAR stands; may be repeated. Default: chosen."),
    ] = None,
    channels: Annotated[int, typer.Option(min=2, max=1024)] = 128,
    azimuths: Annotated[int, typer.Option(min=16, max=8192, help="Rays a turn.")] = 1024,
    seed: Annotated[int, typer.Option(min=0)] = 0,
) -> None:
    """LiDAR clouds of a scene (PLY), `scene.yaml` for `mirrorwave annotate`, and the true poses in `truth.json`.

    The first viewpoint's pose counts as calibrated; give the radar's own place first.
    """
    from contrib.annotate.simulated import write_views
    from contrib.annotate.simulated_clouds import LidarParams, choose_viewpoints
    from sim_player.scene.description import load_scene

    if out.exists() and any(out.iterdir()):
        raise FileExistsError(17, "must be empty or new", str(out))
    world = load_scene(scene)
    viewpoints = tuple(_viewpoint(text) for text in viewpoint) if viewpoint else choose_viewpoints(world)
    params = LidarParams(channels=channels, azimuths=azimuths)
    with progress_bar("viewpoints", len(viewpoints)) as advance:
        write_views(world, viewpoints, params, seed, out, advance)
    print_line(f"{out}: {counted(len(viewpoints), 'cloud')} of {world.name}, scene.yaml and truth.json, seed {seed}")


def _viewpoint(text: str) -> Viewpoint:
    """A viewpoint from X,Y or X,Y,YAW_DEG."""
    from contrib.annotate.simulated_clouds import Viewpoint

    try:
        numbers = [float(part) for part in text.split(",")]
    except ValueError:
        numbers = []
    if len(numbers) not in (2, 3) or not all(map(math.isfinite, numbers)):
        raise ValueError(f"--viewpoint must be X,Y or X,Y,YAW_DEG, got {text!r}")
    return Viewpoint(x_m=numbers[0], y_m=numbers[1], yaw_deg=numbers[2] if len(numbers) == 3 else 0.0)
