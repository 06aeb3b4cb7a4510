"""`mirrorwave eval --objects`: sets of random places, every profile on the same beams, tables object by object."""

from __future__ import annotations

from mirrorwave.console import print_json, print_line, print_table
from mirrorwave.studies.evaluate.object_report import ObjectRequest, measured, page, tables
from mirrorwave.studies.report import write_report


def evaluate_objects(request: ObjectRequest, as_json: bool) -> None:
    """Run the sets, write `results.json` and `results.md` where a folder is given, and print the tables."""
    results = measured(request)
    if request.out is not None:
        write_report(request.out, "results", results, page(results))
    if as_json:
        print_json(results)
        return
    for title, columns, rows in tables(results):
        print_line(title)
        print_table(columns, rows)
    if request.out is not None:
        print_line(f"{request.out}: results.json and results.md")
