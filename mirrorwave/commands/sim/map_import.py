"""`mirrorwave sim import`: scenes from what others have measured."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from mirrorwave.console import (
    AsJson,
    ExitCode,
    print_json,
    print_line,
    print_table,
    progress_bar,
    require_new_file,
    require_picture,
)
from msgs.values.wording import as_utf8, counted

if TYPE_CHECKING:
    from sim_player.maps.map_scene import MapScene

app = typer.Typer(no_args_is_help=True, help="Scenes from what others have measured.")


@app.callback()
def _group() -> None:
    """Scenes from what others have measured."""


@app.command("map")
def import_map(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="Footprints: .geojson, .json, or OSM XML (.osm, .xml).")],
    position: Annotated[str, typer.Option(metavar="LAT,LON", help="The radar, in degrees; X,Y with --metric.")],
    out: Annotated[Path, typer.Option(metavar="SCENE.yaml", help="Scene to write.")] = Path("scene.yaml"),
    heading: Annotated[float, typer.Option(metavar="DEG", help="Where it looks, from north, clockwise.")] = 0.0,
    radius: Annotated[float, typer.Option(metavar="M", help="Buildings within this distance.")] = 165.0,
    materials: Annotated[
        list[str] | None,
        typer.Option(
            metavar="RULE|FILE", help="KEY=VALUE:MATERIAL[,THICKNESS_MM[,ROUGHNESS_MM]], or a .yaml; may be repeated."
        ),
    ] = None,
    ground: Annotated[
        str | None, typer.Option(metavar="MATERIAL", help="Level ground of this; none: no ground.")
    ] = None,
    height_m: Annotated[float, typer.Option(metavar="M", help="The radar's height over the ground.")] = 1.0,
    metric: Annotated[
        bool, typer.Option("--metric", help="The file's coordinates are metres, east and north.")
    ] = False,
    skip_broken: Annotated[bool, typer.Option(help="Leave out footprints that are none; exit code 3.")] = False,
    plot: Annotated[Path | None, typer.Option(help="Picture of the scene (PNG).")] = None,
    as_json: AsJson = False,
) -> int:
    """A scene file from the building footprints of a map around a position and heading, with materials by rule."""
    from sim_player.maps.local_frame import MapPose
    from sim_player.maps.map_scene import map_scene, read_map
    from sim_player.maps.wall_rules import read_rules
    from sim_player.scene.description import SceneRadar

    require_new_file(out)
    if plot is not None:
        require_picture(plot)
    pose, rules = MapPose(*_position(position), heading, metric), read_rules(materials or [])
    with progress_bar(f"reading {file.name}"):
        footprints = read_map(file, metric)
    name = f"{as_utf8(file.stem)} at {position}, heading {heading:g} deg"
    try:
        with progress_bar("walls"):
            made = map_scene(footprints, pose, radius, rules, name, SceneRadar(height_m=height_m), ground)
    except ValueError as error:
        raise ValueError(f"{file}: {error}") from None
    if made.broken and not skip_broken:
        more = f" (and {len(made.broken) - 1} more; --skip-broken leaves them out)" if len(made.broken) > 1 else ""
        raise ValueError(f"{file}: {made.broken[0]}{more}")
    for reason in made.broken:
        typer.echo(f"mirrorwave: left out: {reason}", err=True)
    out.write_text(made.yaml, encoding="utf-8")
    if plot is not None:
        from mirrorwave.plots.scene import write_scene

        write_scene(plot, made.scene)
    _report(out, made, as_json)
    return ExitCode.DONE_WITH_LOSS if made.broken else ExitCode.DONE


def _position(text: str) -> tuple[float, float]:
    """Two numbers with a comma between them."""
    try:
        first, second = (float(part) for part in text.split(","))
    except ValueError:
        first = second = math.nan
    if not (math.isfinite(first) and math.isfinite(second)):
        raise ValueError(f"--position must be LAT,LON in degrees (X,Y in metres with --metric), got {text!r}")
    return first, second


def _report(out: Path, made: MapScene, as_json: bool) -> None:
    """Print what became of the map."""
    if as_json:
        print_json(
            {
                "scene": str(out),
                "buildings": made.buildings,
                "walls": made.walls,
                "materials": made.materials,
                "default_heights": made.default_heights,
                "left_out": made.left_out | {"broken": len(made.broken)},
                "broken": list(made.broken),
            }
        )
        return
    print_table(("walls of", "number"), sorted(made.materials.items()))
    print_table(("left out", "number"), [*made.left_out.items(), ("broken footprints", len(made.broken))])
    print_line(
        f"{out}: {counted(made.buildings, 'building')}, {counted(made.walls, 'wall')}; "
        f"{counted(made.default_heights, 'building')} without a height on the map"
    )
