"""Made cities of 8 to 10,000 pieces of wall: what tracing them whole costs, the part that echoes reach, and plans.

All effects, radar at rest at a crossing, 12 road users. Seconds of the process, one thread, the least of some rounds:
`whole` traces every wall, `part` finds the part that matters (surroundings anew each time) and traces it. `ahead` does
so without what lies behind the antenna, as a plan does, `again` with the surroundings kept. `signal` makes the profiles
of all paths of the whole. Of each purpose the seconds of a plan, from finding to the evaluated answer, and paths left.
The change of the map is the law's (docs/explain/simulator.md), the largest of any cell over its reference, against
every path of the whole world, or of the part where the whole is not traced; kernel level. `--far`: walls beyond reach.
Usage: OPENBLAS_NUM_THREADS=1 NUMBA_NUM_THREADS=1 python -m benchmarks.simulator.cities [--kinds terraced detached]
[--walls 8 40 200 400 1000 2000 10000] [--whole-up-to 1000] [--rounds 3] [--budget-db -20] [--seeds 0] [--far] [--json]
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
from sim_player.generate.city import made_city

from mirrorwave.studies.report import table
from sim_player.effects.table import ALL_EFFECTS
from sim_player.planner.ablation import signal_effects
from sim_player.planner.cells import cells_of
from sim_player.planner.plan import Plan, clean_profiles, plan_world, planned_profiles
from sim_player.planner.purposes import Purpose
from sim_player.scene.description import Scene, Surface, scene_from_yaml, scene_to_yaml
from sim_player.scene.reach import WHOLE_WALLS, reach_m, reachable_snapshot
from sim_player.scene.world import Snapshot, World, prepare, snapshot
from sim_player.signal.levels import kernel_profiles, noise_profiles, noise_rms
from sim_player.trace.conversion import as_paths
from sim_player.trace.echoes import Echoes
from sim_player.trace.paths import Paths
from sim_player.trace.ray_tracing import trace_echoes

#: Distances of walls beyond reach.
FAR_M = (170.0, 250.0, 350.0)
FLAGS = msgspec.structs.replace(signal_effects(ALL_EFFECTS), motion=False)


def seconds(work: Callable[[], Any], rounds: int) -> float:
    """Least time of the process that a piece of work takes."""
    least = float("inf")
    for _ in range(rounds):
        start = time.process_time()
        work()
        least = min(least, time.process_time() - start)
    return least


class Everything:
    """The map of all paths of a view, with noise, and the law's ratio of others to it."""

    def __init__(self, view: Snapshot, echoes: Echoes) -> None:
        self.world, self.setup, self.front_end = view.world, view.world.setup, view.world.scene.radar.front_end
        self.paths = as_paths(view, echoes, ALL_EFFECTS)
        self.noise = noise_profiles(self.setup, 0, FLAGS, self.front_end)
        self.profiles = self.profiles_of(self.paths)
        self.rms = noise_rms(self.setup, FLAGS, self.front_end)

    def profiles_of(self, paths: Paths, precision: str = "float64") -> np.ndarray:
        """Profiles of some paths, all effects."""
        return kernel_profiles(self.setup, paths, FLAGS, self.front_end, precision=precision)

    def change_db(self, profiles: np.ndarray, purpose: Purpose = Purpose.SAMPLES) -> float:
        """Largest change of a cell over the purpose's reference where other profiles take the place of all."""
        cells = cells_of(self.setup)
        off = cells.off(self.profiles + self.noise, profiles + self.noise, self.rms, purpose).max()
        return float(20.0 * np.log10(max(off, 1e-20)))

    def plan_db(self, plan: Plan) -> float:
        """The same of a plan, by its paths or by its evaluated answer, whichever changes more."""
        answers = (part(plan, self.setup) for part in (planned_profiles, clean_profiles))
        return max(self.change_db(answer, plan.purpose) for answer in answers)


def measured(kind: str, walls: int, with_whole: bool, arguments: argparse.Namespace, seed: int) -> dict[str, Any]:
    """One row of the tables."""
    scene = made_city(walls, kind, seed=seed)  # type: ignore[arg-type]
    text, rounds = scene_to_yaml(scene), arguments.rounds
    row: dict[str, Any] = {"kind": kind, "walls": walls, "seed": seed}
    row["load_s"] = seconds(lambda: scene_from_yaml(text), 1)
    row["prepare_s"] = seconds(lambda: prepare(scene, seed), 1)
    world = prepare(scene, seed)
    part = reachable_snapshot(world)
    echoes = trace_echoes(part, ALL_EFFECTS)
    row |= {"in_reach": len(part.blockers.a) - len(part.world.face_a), "kept": len(part.world.wall_a)}
    row |= {"paths": len(echoes), "part_s": seconds(lambda: traced(world), rounds)}
    row |= {"ahead": len(traced(world, True)), "ahead_s": seconds(lambda: traced(world, True), rounds)}
    row["again_s"] = seconds(lambda: traced(world, True, anew=False), rounds)
    everything = Everything(part, echoes)
    if with_whole:
        view = snapshot(world)
        every = trace_echoes(view, ALL_EFFECTS)
        row |= {"whole_paths": len(every), "whole_s": seconds(lambda: trace_echoes(view, ALL_EFFECTS), rounds)}
        row["missing"] = int((~np.isin(within(view, every).chain, echoes.chain)).sum())
        row["added"] = int((~np.isin(echoes.chain, every.chain)).sum())
        row["ratio"] = row["whole_s"] / row["ahead_s"]
        of_part, everything = everything.profiles, Everything(view, every)
        row["change_db"] = everything.change_db(of_part)
        row["signal_s"] = seconds(lambda: everything.profiles_of(everything.paths, "float32"), rounds)
    for purpose in Purpose:
        row |= planned(world, everything, purpose, arguments)
    row["peak_mib"] = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0
    return row


def traced(world: World, ahead_only: bool = False, anew: bool = True) -> Echoes:
    """Find and trace what echoes reach."""
    if anew:
        world.kept.clear()
    return trace_echoes(reachable_snapshot(world, ahead_only=ahead_only), ALL_EFFECTS)


def planned(world: World, everything: Everything, purpose: Purpose, arguments: argparse.Namespace) -> dict[str, Any]:
    """Seconds, paths and law of one purpose's plan."""

    def plan() -> Plan:
        world.kept.clear()
        return plan_world(world, world.setup, arguments.budget_db, purpose=purpose)

    made = plan()
    change_db = everything.plan_db(made)
    return {
        f"{purpose}_s": seconds(plan, arguments.rounds),
        f"{purpose}_left": len(made.echoes),
        f"{purpose}_db": change_db,
        f"{purpose}_violated": int(change_db > arguments.budget_db),
    }


def far_wall(material: str, x_m: float) -> dict[str, Any]:
    """What leaving out a wall 40 m wide, square on beyond reach, changes over the noise: with its flash or without it.

    Behind the radar stand as many walls as it takes to be traced in part.
    """
    behind = tuple(
        Surface(role="relay", material="brick", polyline_m=((-20.0 - n, 9.0), (-20.0 - n, 30.0)))
        for n in range(WHOLE_WALLS)
    )
    far = Surface(role="relay", material=material, polyline_m=((x_m, -20.0), (x_m, 20.0)), height_m=10.0)
    world = prepare(Scene(name="far", surfaces=(far, *behind)))
    view, part = snapshot(world), reachable_snapshot(world)
    everything, kept = Everything(view, trace_echoes(view, ALL_EFFECTS)), trace_echoes(part, ALL_EFFECTS)
    row: dict[str, Any] = {"kind": material, "distance_m": x_m}
    for name, echoes in (("left_out_db", within(part, kept)), ("kept_db", kept)):
        change = everything.profiles - everything.profiles_of(as_paths(part, echoes, ALL_EFFECTS))
        ratio = cells_of(world.setup).off(np.zeros_like(change), change, everything.rms).max()
        row[name] = float(20.0 * np.log10(ratio))
    return row


def within(view: Snapshot, echoes: Echoes) -> Echoes:
    """Return the echoes up to the reach of a map."""
    return echoes.take(echoes.out_m + echoes.back_m <= 2.0 * reach_m(view.world.setup))


TRACED = (
    ("walls", "d"), ("seed", "d"), ("in_reach", "d"), ("kept", "d"), ("load_s", ".2f"), ("prepare_s", ".2f"),
    ("whole_s", ".3f"), ("part_s", ".3f"), ("ahead_s", ".3f"), ("again_s", ".3f"), ("ratio", ".0f"),
    ("whole_paths", "d"), ("paths", "d"), ("ahead", "d"), ("missing", "d"), ("added", "d"), ("change_db", ".0f"),
    ("peak_mib", ".0f"),
)  # fmt: skip
PLANNED = (
    ("walls", "d"), ("seed", "d"), ("signal_s", ".2f"),
    *((f"{purpose}_{what}", form) for purpose in Purpose
      for what, form in (("s", ".2f"), ("left", "d"), ("db", ".1f"), ("violated", "d"))),
)  # fmt: skip


def show(rows: list[dict[str, Any]], columns: tuple[tuple[str, str], ...]) -> None:
    """Print a table."""
    cells = [
        [row["kind"], *(format(row[name], form) if name in row else "-" for name, form in columns)] for row in rows
    ]
    print("\n".join(["", *table(["kind", *(name for name, _ in columns)], cells)]))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--kinds", nargs="+", default=["terraced", "detached"])
    parser.add_argument("--walls", nargs="+", type=int, default=[8, 40, 200, 400, 1000, 2000, 10_000])
    parser.add_argument("--whole-up-to", type=int, default=1000)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--budget-db", type=float, default=-20.0)
    parser.add_argument("--seeds", nargs="+", type=int, default=[0])
    parser.add_argument("--far", action="store_true")
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    if arguments.far:
        far = [far_wall(material, x_m) for material in ("metal", "concrete") for x_m in FAR_M]
        show(far, (("distance_m", "g"), ("left_out_db", ".1f"), ("kept_db", ".1f")))
        return
    cases = [(kind, walls, seed) for kind in arguments.kinds for walls in arguments.walls for seed in arguments.seeds]
    rows = [
        measured(kind, walls, walls <= arguments.whole_up_to, arguments, seed)
        for kind, walls, seed in track(cases, transient=True)
    ]
    if arguments.json:
        print(json.dumps(rows))
        return
    show(rows, TRACED)
    show(rows, PLANNED)


if __name__ == "__main__":
    main()
