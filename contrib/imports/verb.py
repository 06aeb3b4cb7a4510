"""`mirrorwave import sensors`: a LiDAR and a camera beside the radar (docs/guides/connect-my-radar.md)."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from mirrorwave.console import AsJson, ExitCode, print_json, print_line, progress_bar, require_new_file
from msgs.values.wording import counted


def sensors(
    sources: Annotated[
        list[Path], typer.Argument(metavar="SOURCE", help="A ROS bag; directories of clouds or images.")
    ],
    out: Annotated[Path, typer.Option(metavar="REC.mcap", help="New recording of lidar/points and camera/image.")],
    topic: Annotated[
        list[str] | None, typer.Option("--topic", help="Topic of the bag, where more than one fits; repeatable.")
    ] = None,
    rate_hz: Annotated[
        float, typer.Option("--rate-hz", metavar="HZ", help="Rate of files whose names are no stamps.")
    ] = 10.0,
    lidar_at: Annotated[
        str, typer.Option("--lidar-at", metavar="X,Y,Z,YAW", help="Place of the LiDAR on the vehicle: m, m, m, deg.")
    ] = "0,0,1.8,0",
    as_json: AsJson = False,
) -> int:
    """Clouds of a LiDAR and images of a camera beside the radar; exit code 3 if any are left out."""
    from contrib.imports.recorded_sensors import SideParams
    from contrib.imports.side_sensors import import_sensors
    from contrib.ros2.point_cloud2 import LidarMounting

    require_new_file(out)
    try:
        x_m, y_m, height_m, yaw_deg = map(float, lidar_at.split(","))
    except ValueError:
        raise ValueError(f"--lidar-at must be four numbers with commas between them, got {lidar_at!r}") from None
    mounting = LidarMounting(x_m=x_m, y_m=y_m, height_m=height_m, yaw_deg=yaw_deg)
    paths = tuple(map(str, sources))
    params = SideParams(sources=paths, topics=tuple(topic or ()), file_rate_hz=rate_hz, mounting=mounting)
    counts = import_sensors(params, out, progress_bar)
    for line in [*counts["refused"], *counts["notes"], *filter(None, [counts["loss"]])]:
        typer.echo(f"mirrorwave: {line}", err=True)
    if as_json:
        print_json({"recording": str(out), **counts})
    else:
        print_line(f"{out}: {counted(counts['clouds'], 'cloud')}, {counted(counts['images'], 'image')}")
    return ExitCode.DONE_WITH_LOSS if counts["refused"] or counts["loss"] else ExitCode.DONE
