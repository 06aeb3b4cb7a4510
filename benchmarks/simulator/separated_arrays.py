"""Mixed echoes of arrays that stand apart: both orders with their own lengths, against one echo of twice the field.

Random places whose transmitter and receiver stand apart, all effects, at rest, no noise. Compared are the cells (beams
and map, `sim_player.planner.cells`) that either form lifts 10 dB over noise rms.
Usage: python -m benchmarks.simulator.separated_arrays [--places 300] [--seed 3] [--json]
"""

from __future__ import annotations

import argparse
import json
from dataclasses import replace

import msgspec
import numpy as np
from rich.progress import track

from sim_player.effects.table import ALL_EFFECTS
from sim_player.generate.places import random_place
from sim_player.planner.ablation import signal_effects
from sim_player.planner.cells import cells_of
from sim_player.scene.world import World, prepare, snapshot
from sim_player.signal.levels import kernel_profiles, noise_rms
from sim_player.trace.conversion import as_paths
from sim_player.trace.ray_tracing import trace_echoes

CLEAR_DB = 10.0


def largest_change_db(world: World) -> tuple[float, float]:
    """Largest change of a clear cell between the two forms in dB, and the share of clear cells off by over 1 dB."""
    setup, front_end = world.setup, world.scene.radar.front_end
    view, flags = snapshot(world, 0.0), msgspec.structs.replace(signal_effects(ALL_EFFECTS), motion=False)
    scene = msgspec.structs.replace(world.scene, radar=msgspec.structs.replace(world.scene.radar, separation_m=0.0))
    together = snapshot(replace(world, scene=scene), 0.0)
    level_db = []
    for echoes in (trace_echoes(view, ALL_EFFECTS), trace_echoes(together, ALL_EFFECTS)):
        paths = as_paths(view, echoes, ALL_EFFECTS)
        values = cells_of(setup).values(kernel_profiles(setup, paths, flags, front_end, precision="float64"))
        level_db.append(20.0 * np.log10(np.maximum(np.abs(values) / noise_rms(setup, flags, front_end), 1e-6)))
    clear = np.maximum(*level_db) > CLEAR_DB
    change_db = np.abs(level_db[0] - level_db[1])[clear]
    return float(change_db.max(initial=0.0)), float((change_db > 1.0).mean()) if change_db.size else 0.0


def quantiles(values: np.ndarray) -> dict[str, float]:
    return {f"p{share}": round(float(np.percentile(values, share)), 4) for share in (10, 50, 90)}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--places", type=int, default=300)
    parser.add_argument("--seed", type=int, default=3)
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    found = []
    for index in track(range(arguments.places), transient=True):
        scene = random_place(arguments.seed, index)
        if scene.radar.separation_m > 0.0:
            found.append(largest_change_db(prepare(scene, index)))
    change_db, share = np.array(found).reshape(-1, 2).T
    answer = {
        "places": arguments.places,
        "seed": arguments.seed,
        "apart": len(found),
        "over_1_db": int((change_db > 1.0).sum()),
        "largest_change_db": quantiles(change_db),
        "share_of_clear_cells_over_1_db": quantiles(share),
    }
    if arguments.json:
        print(json.dumps(answer))
        return
    print(f"{answer['apart']} of {arguments.places} places have arrays apart; {answer['over_1_db']} move by over 1 dB")
    print("largest change of a clear cell [dB]:", answer["largest_change_db"])
    print("clear cells off by over 1 dB:", answer["share_of_clear_cells_over_1_db"])


if __name__ == "__main__":
    main()
