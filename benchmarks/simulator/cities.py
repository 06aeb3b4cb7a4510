"""Made cities of 8 to 10,000 pieces of wall: what tracing them whole costs, and the part that echoes reach.

All effects, radar at rest at a crossing, 12 road users. Seconds of the process, one thread, the least of some rounds:
`whole` traces every wall, `reach` finds the part that matters (surroundings anew each time) and `part` traces it. The
change of the map is the law's (docs/explain/simulator.md): the largest of any cell over noise or what stands there,
kernel level in double precision.
Usage: OPENBLAS_NUM_THREADS=1 NUMBA_NUM_THREADS=1 python -m benchmarks.simulator.cities [--kinds terraced detached]
[--walls 8 40 200 400 1000 2000 10000] [--whole-up-to 1000] [--rounds 3] [--seed 0] [--json]
"""

from __future__ import annotations

import argparse
import json
import resource
import time
from collections.abc import Callable
from typing import Any

import msgspec
import numpy as np
from rich.progress import track

from sim_player.effects.table import ALL_EFFECTS
from sim_player.generate.city import made_city
from sim_player.planner.ablation import signal_effects
from sim_player.planner.cells import cells_of
from sim_player.scene.description import scene_from_yaml, scene_to_yaml
from sim_player.scene.reach import reach_m, reachable_snapshot
from sim_player.scene.world import Snapshot, World, prepare, snapshot
from sim_player.signal.levels import kernel_profiles, noise_rms
from sim_player.trace.conversion import as_paths
from sim_player.trace.echoes import Echoes
from sim_player.trace.ray_tracing import trace_echoes

#: Noise is taken off what surely stands in a cell, as the planner does.
SIGMAS = 2.5


def seconds(work: Callable[[], Any], rounds: int) -> float:
    """Least time of the process that a piece of work takes."""
    least = float("inf")
    for _ in range(rounds):
        start = time.process_time()
        work()
        least = min(least, time.process_time() - start)
    return least


def map_change_db(world: World, views: tuple[Snapshot, Snapshot], echoes: tuple[Echoes, Echoes]) -> float:
    """Largest change of a cell by what the part leaves out, over noise or what stands there."""
    setup, front_end = world.setup, world.scene.radar.front_end
    flags = msgspec.structs.replace(signal_effects(ALL_EFFECTS), motion=False)
    cells, noise = cells_of(setup), noise_rms(setup, flags, front_end)
    whole, part = (
        kernel_profiles(setup, as_paths(view, found, ALL_EFFECTS), flags, front_end, precision="float64")
        for view, found in zip(views, echoes, strict=True)
    )
    floor = cells.floor(whole, noise, np.zeros(whole.shape), SIGMAS)
    ratio = (np.abs(cells.values(part - whole)) / floor).max()
    return float(20.0 * np.log10(max(ratio, 1e-20)))


def measured(kind: str, walls: int, with_whole: bool, rounds: int, seed: int) -> dict[str, Any]:
    """One row of the table."""
    scene = made_city(walls, kind, seed=seed)  # type: ignore[arg-type]
    text = scene_to_yaml(scene)
    row: dict[str, Any] = {"kind": kind, "walls": walls, "load_s": seconds(lambda: scene_from_yaml(text), 1)}
    row["prepare_s"] = seconds(lambda: prepare(scene, seed), 1)
    world = prepare(scene, seed)

    def reached() -> Snapshot:
        world.kept.clear()
        return reachable_snapshot(world)

    part = reached()
    echoes = trace_echoes(part, ALL_EFFECTS)
    row |= {"in_reach": len(part.blockers.a) - len(part.world.face_a), "kept": len(part.world.wall_a)}
    row |= {"paths": len(echoes), "reach_s": seconds(reached, rounds)}
    row["again_s"] = seconds(lambda: reachable_snapshot(world), rounds)
    row["part_s"] = seconds(lambda: trace_echoes(part, ALL_EFFECTS), rounds)
    if with_whole:
        view = snapshot(world)
        every = trace_echoes(view, ALL_EFFECTS)
        row |= {"whole_paths": len(every), "whole_s": seconds(lambda: trace_echoes(view, ALL_EFFECTS), rounds)}
        within = every.take(every.out_m + every.back_m <= 2.0 * reach_m(world.setup))
        row["missing"] = int((~np.isin(within.chain, echoes.chain)).sum())
        row["added"] = int((~np.isin(echoes.chain, every.chain)).sum())
        row["ratio"] = row["whole_s"] / (row["reach_s"] + row["part_s"])
        row["change_db"] = map_change_db(world, (view, part), (every, echoes))
    row["peak_mib"] = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0
    return row


COLUMNS = (
    ("walls", "d"), ("in_reach", "d"), ("kept", "d"), ("load_s", ".2f"), ("prepare_s", ".2f"), ("whole_s", ".3f"),
    ("reach_s", ".3f"), ("part_s", ".3f"), ("ratio", ".1f"), ("whole_paths", "d"), ("paths", "d"), ("missing", "d"),
    ("added", "d"), ("change_db", ".0f"), ("peak_mib", ".0f"),
)  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--kinds", nargs="+", default=["terraced", "detached"])
    parser.add_argument("--walls", nargs="+", type=int, default=[8, 40, 200, 400, 1000, 2000, 10_000])
    parser.add_argument("--whole-up-to", type=int, default=1000)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    cases = [(kind, walls) for kind in arguments.kinds for walls in arguments.walls]
    rows = [
        measured(kind, walls, walls <= arguments.whole_up_to, arguments.rounds, arguments.seed)
        for kind, walls in track(cases, transient=True)
    ]
    if arguments.json:
        print(json.dumps(rows))
        return
    print("| kind | " + " | ".join(name for name, _ in COLUMNS) + " |")
    print("|" + " --- |" * (len(COLUMNS) + 1))
    for row in rows:
        cells = [format(row[name], form) if name in row else "-" for name, form in COLUMNS]
        print(f"| {row['kind']} | " + " | ".join(cells) + " |")


if __name__ == "__main__":
    main()
