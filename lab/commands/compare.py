"""`mirrorwave compare`: the same hidden scenes through X-band, 77 GHz and single-photon LiDAR."""

from __future__ import annotations

import re
import shlex
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from mirrorwave.console import AsJson, print_json, print_line, print_table, progress_bar

if TYPE_CHECKING:
    from lab.compare.comparison_report import Report
    from lab.compare.sweeps import Plan

#: Viewpoints of a value: for a coffee, and for the record.
QUICK, WHOLE = 2, 12


def compare(
    sweep: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME", help="range, range_glass, range_metal, roughness, material, incidence, places; default all."
        ),
    ] = None,
    sensor: Annotated[
        list[str] | None,
        typer.Option(metavar="NAME", help="xband, 77ghz, spad, spad_gated, spad_long; scene: its own; default all."),
    ] = None,
    scene: Annotated[
        Path | None, typer.Option(metavar="FILE", help="One scene through three sensors, a picture, instead of sweeps.")
    ] = None,
    out: Annotated[Path, typer.Option(metavar="DIR", help="A run that was stopped goes on in it.")] = Path(
        "runs/compare"
    ),
    quick: Annotated[bool, typer.Option("--quick", help="A few values of each sweep.")] = False,
    viewpoints: Annotated[int | None, typer.Option(help=f"Of each value; default {WHOLE}, quick {QUICK}.")] = None,
    equal: Annotated[
        str, typer.Option(metavar="WHAT", help="power: 1.6 mW each; energy: a scan's energy as well.")
    ] = "power",
    seed: Annotated[int, typer.Option(help="Of the viewpoints, the places and the noise.")] = 11,
    workers: Annotated[int, typer.Option(min=1, help="Processes at a time.")] = 1,
    as_json: AsJson = False,
) -> None:
    """Equal power, one grid, one evaluation: reach, roughness, material, incidence; JSON, Markdown, a figure."""
    import msgspec

    from lab.compare.comparison_figures import draw_comparison
    from lab.compare.comparison_report import make_report, markdown
    from lab.compare.sensors import SENSORS, equal_of
    from lab.compare.sweeps import SWEEPS, Plan, run_plan
    from lab.studies.report import write_report

    if scene is not None:
        if sweep or quick or viewpoints is not None:
            raise ValueError(f"--sweep, --quick and --viewpoints do not go with --scene, got {str(scene)!r}")
        _one_scene(scene, sensor, equal, seed, out, as_json)
        return
    names = list(dict.fromkeys(sweep or SWEEPS))
    plan = Plan(
        seed=seed,
        viewpoints=(QUICK if quick else WHOLE) if viewpoints is None else viewpoints,
        equal=equal_of(equal),
        sensors=list(dict.fromkeys(sensor or SENSORS)),
        values={name: _values(name, quick) for name in names},
    )
    with progress_bar("scenes", len(plan.jobs)) as tick:
        results = run_plan(plan, out, workers, tick)
    report = make_report(plan, results, _command(plan, names, quick))
    write_report(out, "compare", report, markdown(report))
    draw_comparison(report, out / "compare.png")
    if as_json:
        print_json(msgspec.to_builtins(report))
        return
    _show(report, out)


def _values(name: str, quick: bool) -> list[float | str]:
    """Values of a sweep; ValueError for an unknown one."""
    from lab.compare.sweeps import SWEEPS

    if name not in SWEEPS:
        raise ValueError(f"--sweep must be one of {', '.join(SWEEPS)}, got {name!r}")
    return list(SWEEPS[name].quick if quick else SWEEPS[name].whole)


def _one_scene(scene: Path, sensors: list[str] | None, equal: str, seed: int, out: Path, as_json: bool) -> None:
    """The picture of one scene, and what each sensor made of it."""
    from lab.compare.one_scene import draw_scene_through, scene_through, sensors_of
    from lab.compare.sensors import equal_of
    from sim_player.scene.description import load_scene

    loaded, equal_measure = load_scene(scene), equal_of(equal)
    compared = sensors_of(loaded, sensors or ())
    with progress_bar("sensors", len(compared)) as tick:
        views = scene_through(loaded, compared, equal_measure, seed, tick)
    out.mkdir(parents=True, exist_ok=True)
    # a name may hold what a file's must not
    picture = out / f"{re.sub(r'[^A-Za-z0-9_.-]', '_', loaded.name)}.png"
    draw_scene_through(loaded, views, equal_measure, picture)
    summaries = [view.summary() for view in views]
    if as_json:
        print_json(summaries)
        return
    print_table(list(summaries[0]), [list(summary.values()) for summary in summaries])
    print_line(str(picture))


def _command(plan: Plan, sweeps: list[str], quick: bool) -> str:
    """Return the command that repeats the run."""
    from lab.compare.sensors import SENSORS
    from lab.compare.sweeps import SWEEPS

    words = ["mirrorwave", "compare", *(["--quick"] if quick else [])]
    if sweeps != list(SWEEPS):
        words += [word for name in sweeps for word in ("--sweep", name)]
    if plan.sensors != list(SENSORS):
        words += [word for name in plan.sensors for word in ("--sensor", name)]
    words += ["--viewpoints", str(plan.viewpoints), "--equal", plan.equal, "--seed", str(plan.seed)]
    return shlex.join(words)


def _show(report: Report, out: Path) -> None:
    from lab.compare.comparison_report import COLUMNS, LEAST, cells

    print_table(("sweep", "value", *COLUMNS), [[row.sweep, *cells(row)] for row in report.rows], LEAST)
    for failed in (row for row in report.rows if row.failed is not None):
        print_line(
            f"{failed.sensor} failed at {report.viewpoints - failed.scans} viewpoints ({failed.value}): {failed.failed}"
        )
    print_line(f"{out}: compare.json, compare.md, compare.png")
