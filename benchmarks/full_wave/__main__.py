"""Rays against a full-wave solution of miniature scenes: error of every path group, with all effects and without each.

Echoes of time steps are kept in the work folder; what is there is not computed again. Run from the root of the
checkout: python -m benchmarks.full_wave [--scene NAME ...] [--cells 20] [--work runs/full-wave]
       [--figure FILE] [--table FILE] [--json]
"""

from __future__ import annotations

import argparse
import json
import sys
from dataclasses import asdict
from pathlib import Path

from rich.console import Console
from rich.progress import Progress

from benchmarks.full_wave.comparison import Comparison, compare
from benchmarks.full_wave.page import as_table, draw, page
from benchmarks.full_wave.scenes import MiniScene, scenes
from benchmarks.full_wave.waves import Waves, solve


def main() -> None:
    """Solve, compare, print; write what is asked for."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--scene", nargs="+", help="only these scenes")
    parser.add_argument("--cells", type=float, default=20.0, help="cells per wavelength in air")
    parser.add_argument("--work", type=Path, default=Path("runs/full-wave"), help="folder of kept echoes")
    parser.add_argument("--figure", type=Path, help="picture to write")
    parser.add_argument("--table", type=Path, help="page to write")
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    options = parser.parse_args()
    every = {scene.name: scene for scene in scenes()}
    if unknown := set(options.scene or ()) - set(every):
        parser.error(f"--scene: unknown {', '.join(sorted(unknown))}, known are {', '.join(every)}")
    wanted = [every[name] for name in dict.fromkeys(options.scene or every)]
    console = Console(stderr=options.json)
    solved = _solve(wanted, options.cells, options.work, console)
    found = [compare(scene, waves, target) for scene, waves in solved for target in (None, *scene.targets)]
    if options.json:
        print(json.dumps(_report(found), indent=1))
    else:
        console.print(as_table(found))
    if options.table is not None:
        options.table.write_text(page([scene for scene, _ in solved], found, options))
    if options.figure is not None:
        draw(options.figure, [scene for scene, _ in solved], found)


def _solve(wanted: list[MiniScene], cells: float, work: Path, console: Console) -> list[tuple[MiniScene, Waves]]:
    """Return the echoes of the scenes, with a bar for every run."""
    with Progress(console=console) as progress:
        bars: dict[str, int] = {}

        def report(run: str, share: float) -> None:
            if run not in bars:
                bars[run] = progress.add_task(run, total=1.0)
            progress.update(bars[run], completed=share)  # type: ignore[arg-type]

        return [(scene, solve(scene, cells, work, report)) for scene in wanted]


def _report(found: list[Comparison]) -> dict[str, object]:
    return {
        "groups": [asdict(group) for comparison in found for group in comparison.groups],
        "remainders": [asdict(comparison.remainder) for comparison in found],
    }


if __name__ == "__main__":
    sys.exit(main())
