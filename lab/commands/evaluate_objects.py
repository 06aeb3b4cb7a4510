"""`mirrorwave eval --objects`: sets of random places, every profile on the same beams, tables object by object.

`mirrorwave eval --against`: any list of objects or tracks by the same scores.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from lab.evaluate.against import ListRequest, compared
from lab.evaluate.against import tables as list_tables
from lab.evaluate.place_figure import draw_curves
from lab.evaluate.place_report import ObjectRequest, Table, measured, page, tables
from lab.studies.report import write_report
from mirrorwave.console import print_json, print_line, print_table


def evaluate_objects(request: ObjectRequest, as_json: bool) -> None:
    """Run the sets, write `results.json`, `results.md` and `curves.png` where a folder is given; print the tables."""
    results = measured(request)
    if request.out is not None:
        draw_curves(results["sets"], request.out / "curves.png")
    _show(results, list(tables(results)), request.out, as_json, "results.json, results.md and curves.png")


def evaluate_lists(
    lists: list[Path],
    truths: list[Path],
    draws: int,
    seed: int,
    out: Path | None,
    as_json: bool,
) -> None:
    """Score the lists, write the same files, and print the tables."""
    results = compared(ListRequest(lists=lists, truths=truths, draws=draws, seed=seed, out=out))
    _show(results, list(list_tables(results)), out, as_json, "results.json and results.md")


def _show(results: dict[str, Any], all_tables: list[Table], out: Path | None, as_json: bool, written: str) -> None:
    if out is not None:
        write_report(out, "results", results, page(results, all_tables))
    if as_json:
        print_json(results)
        return
    for title, columns, rows in all_tables:
        print_line(title)
        print_table(columns, rows)
    if out is not None:
        print_line(f"{out}: {written}")
