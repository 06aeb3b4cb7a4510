"""`mirrorwave eval`: methods on the same frames, profiles on random places, lists of anybody, systems as published."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from lab.commands.complete_sets import complete_object_sets
from mirrorwave.completion import complete_profiles
from mirrorwave.console import AsJson, print_json, print_line, print_table, progress_bar
from msgs.values.wording import counted

if TYPE_CHECKING:
    from lab.evaluate.method_report import Context
    from lab.evaluate.method_runs import Run
    from lab.evaluate.methods import Method
    from lab.training.data.frames import DataSet
    from msgs.values.radar import RadarSetup


#: Bootstrap draws of the intervals.
DRAWS = 1000
Split = Literal["test", "validation", "train", "all"]
Walls = Literal["none", "true", "noisy"]


def evaluate(
    data: Annotated[
        Path | None, typer.Option(metavar="DIR", help="Data set of `sim dataset` or `import xradarnlos`.")
    ] = None,
    objects: Annotated[
        bool, typer.Option("--objects", help="Profiles on random places, object by object, in place of --data.")
    ] = False,
    against: Annotated[
        list[Path] | None,
        typer.Option(
            metavar="FILE", help="List of objects or tracks, one a drive: .jsonl, .mcap, nuScenes .json, KITTI .txt."
        ),
    ] = None,
    truth_file: Annotated[
        list[Path] | None,
        typer.Option(metavar="FILE", help="Truth of each --against: a recording, or a list of those kinds."),
    ] = None,
    published_table: Annotated[
        int | None,
        typer.Option(
            "--table",
            metavar="5",
            min=5,
            max=5,
            help="The specification's systems, shipped, and ours.",
            show_default=False,
        ),
    ] = None,
    profile: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME|FILE",
            help="With --objects; default `default`. May be given again.",
            autocompletion=complete_profiles,
            show_default=False,
        ),
    ] = None,
    sets: Annotated[
        list[str] | None,
        typer.Option(
            "--set",
            metavar="NAME",
            help="With --objects: a committed set of places. May be given again.",
            autocompletion=complete_object_sets,
            show_default=False,
        ),
    ] = None,
    count: Annotated[
        int | None, typer.Option(min=1, help="With --table, or --objects and no --set: places of --seed [100].")
    ] = None,
    moving: Annotated[
        bool, typer.Option("--moving", help="With --objects and no --set: radar and road users move.")
    ] = False,
    effects: Annotated[
        str, typer.Option(metavar="all|auto|basic|LIST", help="With --table, or --objects and no --set: effects.")
    ] = "all",
    walls: Annotated[
        Walls, typer.Option(help="With --objects: walls that a map tells, as they are or as a poor map has them.")
    ] = "none",
    workers: Annotated[int, typer.Option(min=1, help="With --objects, --table: places measured at a time.")] = 1,
    method: Annotated[
        list[str] | None,
        typer.Option(
            metavar="[NAME=]SPEC",
            help="cfar, cfar-nlos, truth or FILE.onnx, then with commas: refine[=WAY], residual=FILE, "
            "geometry=ours|specification, threshold=T, GROUP.KEY=VALUE. "
            "May be given again; the others are compared with the last.",
            show_default=False,
        ),
    ] = None,
    split: Annotated[Split, typer.Option(help="Scenes to evaluate.")] = "test",
    out: Annotated[
        Path | None,
        typer.Option(
            metavar="DIR",
            help="results.json, results.md, qualitative.png; with --objects and --table "
            "[runs/table5-SEED] also a file a place: the same command goes on where it stopped.",
        ),
    ] = None,
    limit: Annotated[int | None, typer.Option(min=1, help="Only the first N frames of the split.")] = None,
    threads: Annotated[int, typer.Option(min=1, help="CPU threads of each network.")] = 1,
    seed: Annotated[int, typer.Option(min=0, help="Of the bootstrap, and of the places drawn for --objects.")] = 0,
    as_json: AsJson = False,
) -> None:
    """Score methods on a data set, profiles on random places, or any list of objects; no frame is skipped."""
    of_places: dict[str, object] = {"--profile": profile, "--set": sets, "--moving": moving or None}
    of_places["--walls"] = None if walls == "none" else walls
    of_methods: dict[str, object] = {"--data": data, "--method": method, "--limit": limit}
    given = of_methods | of_places
    if against or truth_file:
        _refuse("--against", given | {"--objects": objects or None, "--table": published_table, "--count": count})
        from lab.commands.evaluate_objects import evaluate_lists

        evaluate_lists(against or [], truth_file or [], DRAWS, seed, out, as_json)
        return
    if published_table is not None:
        _refuse("--table", given | {"--objects": objects or None})
        from lab.commands.evaluate_table import evaluate_table

        evaluate_table(count or 100, seed, effects, workers, out, as_json)
        return
    if objects:
        _refuse("--objects", of_methods)
        from lab.commands.evaluate_objects import evaluate_objects
        from lab.evaluate.place_report import ObjectRequest

        evaluate_objects(
            ObjectRequest(
                sets=sets or [], profiles=profile or ["default"], places=count, moving=moving,
                effects=effects, walls=walls, seed=seed, draws=DRAWS, workers=workers, out=out,
            ),
            as_json,
        )  # fmt: skip
        return
    _refuse("--data", of_places | {"--count": count})
    if data is None:
        raise ValueError("--data must name a data set, or --objects ask for random places")
    from lab.evaluate.method_report import Context, make_report, write_report
    from lab.evaluate.method_runs import checked_frames, run_methods
    from lab.training.data.frames import DataSet, fixed_splits

    dataset, splits = DataSet(data), fixed_splits(data)
    methods = _methods(method or _default_methods(), threads, dataset.setup)
    indices = splits.of(split)[:limit]
    with progress_bar("frames", len(indices)) as tick:
        run = run_methods(methods, checked_frames(dataset, indices, methods), tick)
    context = Context(
        data=str(data), split=split, test_sha256=splits.test_sha256, seed=seed, draws=DRAWS, threads=threads,
        reference=methods[-1].name,
    )  # fmt: skip
    report = make_report(run, context)
    if out is not None:
        out.mkdir(parents=True, exist_ok=True)
        write_report(report, out)
        _draw(run, dataset, context, out)
    _show(report, out, as_json)


def _refuse(word: str, options: dict[str, object]) -> None:
    """Raise `ValueError` where options were given that say nothing beside `word`."""
    if given := [name for name, value in options.items() if value is not None]:
        raise ValueError(f"{given[0]} must not be given with {word}")


def _default_methods() -> list[str]:
    """Both classical ways, and the network in use as the vehicle runs it."""
    from models.perception.find.onnx_model import DEFAULT_MODEL

    return ["cfar", "cfar-nlos", f"ours={DEFAULT_MODEL},refine"]


def _methods(texts: list[str], threads: int, setup: RadarSetup) -> list[Method]:
    from lab.evaluate.methods import build_method, parse_method

    specs = [parse_method(text) for text in texts]
    names = [spec.name for spec in specs]
    for name in names:
        if names.count(name) > 1:
            raise ValueError(f"--method names must differ, got {name!r} twice: put NAME= before one")
    return [build_method(spec, threads, setup) for spec in specs]


def _draw(run: Run, dataset: DataSet, context: Context, out: Path) -> None:
    from lab.evaluate.method_figures import draw_scenes, shown_frames

    if positions := shown_frames(run):
        frames = [dataset.frame(run.indices[position]) for position in positions]
        draw_scenes(run, frames, positions, context.reference, out / "qualitative.png")


def _show(report: dict[str, Any], out: Path | None, as_json: bool) -> None:
    from lab.evaluate.method_report import headline_columns, headline_rows

    if as_json:
        print_json({key: value for key, value in report.items() if key != "per_frame"})
        return
    print_line(f"{counted(report['frames'], 'frame')} of {report['split']}; test set {report['test_sha256']}")
    columns = headline_columns()
    least = [name for name in reversed(columns[1:]) if name not in ("dense Macro-F1", "recovered F1 1 m")]
    print_table(columns, headline_rows(report), least)
    if out is not None:
        print_line(f"{out}: results.json, results.md and qualitative.png")
