"""`mirrorwave tradeoff`: what every choice costs in time and buys in accuracy, measured on this machine."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from mirrorwave.completion import complete_profiles
from mirrorwave.console import AsJson, print_json, print_line, print_table, progress_bar

if TYPE_CHECKING:
    from lab.tradeoff.row_report import Report
    from lab.tradeoff.row_runs import Plan
    from lab.tradeoff.rows import Setting
    from mirrorwave.console import Progress

#: Places for a coffee, and for the record; times each is timed.
QUICK, FULL, REPEATS = 24, 240, 2


def tradeoff(
    full: Annotated[
        bool, typer.Option("--full/--quick", help="240 places for the record, or 24 for a coffee.")
    ] = False,
    out: Annotated[Path, typer.Option(metavar="DIR", help="A run that was stopped goes on in it.")] = Path(
        "runs/tradeoff"
    ),
    row: Annotated[
        list[str] | None, typer.Option(metavar="NAME", help="Only rows of this name or switch, and their profiles.")
    ] = None,
    profile: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME|FILE",
            help="Only this profile, beside rows of --row. May be given again.",
            autocompletion=complete_profiles,
            show_default=False,
        ),
    ] = None,
    count: Annotated[int | None, typer.Option(min=1, help="Places; default 24, or 240.")] = None,
    seed: Annotated[int, typer.Option(min=0, help="Of the places, and of the order of the stages.")] = 11,
    simulator: Annotated[bool, typer.Option("--simulator", help="The simulator's own choices instead.")] = False,
    memory: Annotated[bool, typer.Option(help="Measure peak memory, a process a row.")] = True,
    as_json: AsJson = False,
) -> None:
    """Every switch that trades accuracy for time, on the same raw beams in one run: JSON, Markdown, figures."""
    if simulator:
        _simulator(out, full, seed, as_json)
        return
    from lab.studies.report import write_report
    from lab.tradeoff.row_figures import draw_front, draw_stages
    from lab.tradeoff.row_report import make_report, markdown
    from lab.tradeoff.row_runs import Plan, peak_memory_mib, run_plan
    from lab.tradeoff.rows import DEFAULT_SETTINGS, read_settings
    from mirrorwave.profiles import profile_names

    asked = [*(row or []), *(profile or [])]
    by_file = [name for name in dict.fromkeys(profile or []) if name not in profile_names()]
    rows = _selected_rows(read_settings(DEFAULT_SETTINGS, by_file), asked)
    plan = Plan(rows=rows, frames=count or (FULL if full else QUICK), repeats=REPEATS, seed=seed)
    with progress_bar("places", plan.frames) as tick:
        _warn_of_load(tick)
        results = run_plan(plan, out, tick)
    failed = {name for result in results for name in result.failed}
    running = [setting for setting in plan.rows if setting.name not in failed] if memory else []
    with progress_bar("memory", len(running)) as tick:
        memory_mib = peak_memory_mib(running, tick)
    report = make_report(plan, results, memory_mib, _command(plan, row or [], profile or []))
    write_report(out, "tradeoff", report, markdown(report))
    draw_front(report, out / "front.png")
    draw_stages(report, out / "stages.png")
    _show(report, out, as_json)


def _simulator(out: Path, full: bool, seed: int, as_json: bool) -> None:
    """Signal levels, effect budgets, rays and FDTD cells against the most complete answer."""
    import msgspec

    from lab.studies.report import write_report
    from lab.tradeoff.simulator import run_simulator, simulator_markdown, simulator_plan
    from lab.tradeoff.simulator_figures import draw_simulator

    with progress_bar("cases", len(simulator_plan(full, seed).jobs)) as tick:
        _warn_of_load(tick)
        report = run_simulator(out, full, seed, tick)
    write_report(out, "tradeoff-simulator", report, simulator_markdown(report))
    draw_simulator(report, out / "tradeoff-simulator.png")
    if as_json:
        print_json(msgspec.to_builtins(report))
        return
    print_line(simulator_markdown(report))
    print_line(f"{out}: tradeoff-simulator.json, .md, .png")


def _warn_of_load(tick: Progress) -> None:
    """Say before a run that its times will not count."""
    from lab.studies.report import busy_reason, load_per_core

    if busy := busy_reason(load_per_core()):
        tick.print(f"mirrorwave: the machine is busy, times will not count: {busy}")


def _selected_rows(rows: list[Setting], names: list[str]) -> list[Setting]:
    """The rows asked for and the profiles that they are laid over; all where none is."""
    row_names = {name for row in rows for name in (row.name, row.switch)}
    for name in names:
        if name not in row_names:
            raise ValueError(f"--row must be one of {', '.join(sorted(row_names))}, got {name!r}")
    asked = [row for row in rows if not names or {row.name, row.switch} & set(names)]
    bases = {row.over for row in asked}
    return [row for row in rows if row in asked or row.name in bases]


def _command(plan: Plan, names: list[str], profiles: list[str]) -> str:
    """Return the command that repeats the run."""
    words = ["mirrorwave", "tradeoff", "--count", str(plan.frames), "--seed", str(plan.seed)]
    words += [word for name in profiles for word in ("--profile", name)]
    return shlex.join([*words, *(word for name in names for word in ("--row", name))])


def _show(report: Report, out: Path, as_json: bool) -> None:
    import msgspec

    from lab.tradeoff.row_report import COLUMNS, LEAST, cells

    if as_json:
        print_json(msgspec.to_builtins(report))
        return
    print_table(COLUMNS, [cells(row) for row in report.rows], LEAST)
    if report.busy:
        print_line(f"the times do not count, the machine was busy: {report.busy}")
    print_line(f"{out}: tradeoff.json, tradeoff.md, front.png, stages.png")
