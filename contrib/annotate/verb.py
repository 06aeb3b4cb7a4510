"""`mirrorwave annotate`: ground truth for a radar capture from LiDAR clouds of several viewpoints."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer

from mirrorwave.console import AsJson, ExitCode, print_json, print_line, print_table, progress_bar, require_picture
from msgs.values.wording import counted


def annotate(
    scene: Annotated[Path, typer.Argument(metavar="SCENE.yaml", help="Clouds, first poses, heights (YAML or JSON).")],
    out: Annotated[Path, typer.Option(metavar="DIR", help="Folder of scenes in the published layout.")],
    radar: Annotated[
        Path | None, typer.Option(metavar="RECORDING", help="Recording (MCAP) or SigMF; else the one SCENE.yaml names.")
    ] = None,
    frame: Annotated[str, typer.Option(metavar="NAME", help="Name of the frame within its scene.")] = "frame_000",
    kind: Annotated[
        Literal["real", "sim"], typer.Option(help="real: Welch power, 4.5 to 44 m; sim: complex map, 0 to 109 m.")
    ] = "real",
    plot: Annotated[Path | None, typer.Option(metavar="FILE.png", help="Picture of the labels over the map.")] = None,
    skip_refused: Annotated[
        bool, typer.Option(help="Leave out clouds that cannot be registered; exit code 3.")
    ] = False,
    as_json: AsJson = False,
) -> int:
    """Register LiDAR clouds to the radar and label a slice (LOS, hidden, mirrored, wall), with the radar's map."""
    from contrib.annotate.labelled_frames import annotate_scene, stages
    from contrib.annotate.manifest import load_manifest

    manifest = load_manifest(scene)
    capture = radar or (scene.parent / manifest.radar if manifest.radar else None)
    if capture is None:
        raise ValueError(f"{scene}: radar: must name a capture (or give --radar), got none")
    if not capture.is_file():
        raise FileNotFoundError(2, "no such capture", str(capture))
    if not frame or "/" in frame or frame.startswith("."):
        raise ValueError(f"--frame must be usable as a file's name, got {frame!r}")
    if plot is not None:
        require_picture(plot)
    with progress_bar("annotate", stages(manifest)) as advance:
        done = annotate_scene(manifest, scene.parent, capture, out, frame, kind, skip_refused, advance)
    if plot is not None:
        from contrib.annotate.picture import draw_annotation

        draw_annotation(done, kind, plot)
    for reason in done.refused.values():
        typer.echo(f"mirrorwave: left out: {reason}", err=True)
    if as_json:
        print_json({"folder": str(out / manifest.name), **done.report})
    else:
        columns = ("file", "points", "start", "fitness", "rmse_m", "hold", "conflict")
        print_table(columns, [[cloud.get(name) for name in columns] for cloud in done.report["clouds"]])
        counts = ", ".join(f"{count} {name.replace('_', ' ')}" for name, count in done.report["points"].items())
        print_line(f"{out / manifest.name / frame}: {counted(len(done.labels.walls_m), 'wall')}; points: {counts}")
    return ExitCode.DONE_WITH_LOSS if done.refused else ExitCode.DONE
