"""`mirrorwave eval --table 5`: systems of the specification and ours, from shipped weights, on the same places."""

from __future__ import annotations

from pathlib import Path

from lab.evaluate.specification_table import (
    OWN,
    TablePlan,
    cells,
    columns,
    make_table,
    markdown,
    reasons,
    run_table,
    table_rows,
)
from lab.studies.report import write_report
from mirrorwave.console import print_json, print_line, print_table, progress_bar


def evaluate_table(places: int, seed: int, effects: str, workers: int, out: Path | None, as_json: bool) -> None:
    """Run the table, or go on with it; write table.json, table.md and pictures, and print it."""
    import msgspec

    from lab.evaluate.table_figure import draw_table_scenes

    out = out or Path(f"runs/table5-{seed}")
    plan = TablePlan(seed=seed, places=places, rows=table_rows(), effects=effects)
    with progress_bar("places", places) as tick:
        results = run_table(plan, out, workers, tick)
    report = make_table(plan, results, f"mirrorwave eval --table 5 --count {places} --seed {seed} --effects {effects}")
    write_report(out, "table", report, markdown(report))
    pictures = draw_table_scenes(plan, results, out)
    if as_json:
        print_json(msgspec.to_builtins(report))
        return
    print_table(columns(), cells(report), list(reversed(OWN)))
    for line in reasons(report):
        print_line(line)
    print_line(f"{out}: {', '.join(['table.json', 'table.md', *pictures])}")
