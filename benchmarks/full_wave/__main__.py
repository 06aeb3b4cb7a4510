"""Rays against a full-wave solution of miniature scenes: error of every path group, with all effects and without each.

Echoes of time steps are kept in the work folder; what is there is not computed again. Run from the root of the
checkout: python -m benchmarks.full_wave [--scene NAME ...] [--seed 0] [--seeds 4] [--cells 20] [--work runs/full-wave]
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

from benchmarks.full_wave.comparison import Comparison, Roughness, compare, roughness
from benchmarks.full_wave.lobe import LobeRow, lobe_rows
from benchmarks.full_wave.page import RoughWalls, as_table, draw, page
from benchmarks.full_wave.scenes import ROUGH_M, MiniScene, scenes
from benchmarks.full_wave.waves import Waves, solve
from benchmarks.simulator.diffuse_lobe import PLACES, SEED, changes


def main() -> None:
    """Solve, compare, print; write what is asked for."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--scene", nargs="+", help="only these scenes; rough and rougher are all draws of a rough wall")
    parser.add_argument("--seed", type=int, default=0, help="first draw of each rough wall")
    parser.add_argument("--seeds", type=int, default=4, help="draws of each rough wall")
    parser.add_argument("--cells", type=float, default=20.0, help="cells per wavelength in air")
    parser.add_argument("--work", type=Path, default=Path("runs/full-wave"), help="folder of kept echoes")
    parser.add_argument("--figure", type=Path, help="picture to write")
    parser.add_argument("--table", type=Path, help="page to write")
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    options = parser.parse_args()
    every = scenes(options.seeds, options.seed)
    known = list(dict.fromkeys(_family(scene) for scene in every))
    if unknown := set(options.scene or ()) - set(known):
        parser.error(f"--scene: unknown {', '.join(sorted(unknown))}, known are {', '.join(known)}")
    wanted = [scene for scene in every if _family(scene) in (options.scene or known)]
    console = Console(stderr=options.json)
    solved = _solve(wanted, options.cells, options.work, console)
    found = [compare(scene, waves, target) for scene, waves in solved for target in (None, *scene.targets)]
    families = [[pair for pair in solved if _family(pair[0]) == family] for family in ROUGH_M]
    rough = [roughness(draws) for draws in families if draws]
    lobe = lobe_rows(options.seeds, options.seed, options.work) if rough else []
    if options.json:
        print(json.dumps(_report(found, rough, lobe), indent=1))
    else:
        console.print(as_table(found))
        for rows in (rough, lobe):
            console.print(*rows, sep="\n")
    if options.table is not None:
        places = changes(PLACES, SEED) if rough else {}
        rough_walls = RoughWalls(rough, lobe, places)
        options.table.write_text(page([scene for scene, _ in solved], found, rough_walls, options))
    if options.figure is not None:
        draw(options.figure, [scene for scene, _ in solved], found)


def _family(scene: MiniScene) -> str:
    return scene.name.partition("-")[0]


def _solve(wanted: list[MiniScene], cells: float, work: Path, console: Console) -> list[tuple[MiniScene, Waves]]:
    """Return the echoes of the scenes, with a bar for every run."""
    with Progress(console=console) as progress:
        bars: dict[str, int] = {}

        def report(run: str, share: float) -> None:
            if run not in bars:
                bars[run] = progress.add_task(run, total=1.0)
            progress.update(bars[run], completed=share)  # type: ignore[arg-type]

        return [(scene, solve(scene, cells, work, report)) for scene in wanted]


def _report(found: list[Comparison], rough: list[Roughness], lobe: list[LobeRow]) -> dict[str, object]:
    return {
        "groups": [asdict(group) for comparison in found for group in comparison.groups],
        "remainders": [asdict(comparison.remainder) for comparison in found],
        "rough": [asdict(wall) for wall in rough],
        "lobe": [asdict(row) for row in lobe],
    }


if __name__ == "__main__":
    sys.exit(main())
