"""Scenes a second of `sim dataset`, and whether the bytes are the same however a data set is made.

The same scenes are made with one worker and with several, then with a run that is killed (SIGKILL, parent alone) after
its first shard and goes on; with `--executors` also through Ray or submitit's own processes (the code that drives
Slurm, without Slurm). Times are of the whole call, start of the processes included; processor time too, as other work
on the machine does not count in it. With `--scans` the scenes are scans of drives, of which `--count` are made. Usage:
OPENBLAS_NUM_THREADS=1 python -m benchmarks.simulator.dataset_speed [--count 200] [--scans N] [--seed 3] [--workers 1 2]
[--effects auto] [--preset xband] [--executors ray slurm] [--out DIR] [--json]
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from mirrorwave.commands.sim.dataset import parse_effects
from sim_player.dataset.shards import Recipe
from sim_player.dataset.writer import write_dataset

_KILLED = """
import sys
from pathlib import Path
import msgspec
from sim_player.dataset.writer import Recipe, write_dataset
if __name__ == "__main__":
    recipe = msgspec.json.decode(sys.argv[4], type=Recipe)
    say = lambda shard: print(shard.shard, flush=True)
    write_dataset(Path(sys.argv[1]), int(sys.argv[2]), int(sys.argv[3]), recipe, int(sys.argv[5]), say)
"""


def contents(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in sorted(folder.iterdir())}


def timed(folder: Path, args: argparse.Namespace, recipe: Recipe, workers: int, executor: str) -> dict[str, Any]:
    start_s, before_s = time.perf_counter(), sum(os.times()[:4])
    # Slurm's code path on this machine: submitit starts the processes itself
    slurm = {"cluster": "local"} if executor == "slurm" else None
    write_dataset(folder, args.count, args.seed, recipe, workers, executor=executor, slurm=slurm)  # type: ignore[arg-type]
    seconds = time.perf_counter() - start_s
    return {
        "executor": "submitit, no Slurm" if slurm else executor,
        "workers": workers,
        "seconds": round(seconds, 2),
        "processor_s": round(sum(os.times()[:4]) - before_s, 2),
        "scenes_per_s": round(args.count * (args.scans or 1) / seconds, 2),
    }


def kill_and_go_on(folder: Path, args: argparse.Namespace, recipe: Recipe, workers: int) -> int:
    """SIGKILL after the first shard, then the same call again; the number of shards the kill left."""
    import msgspec

    call = [str(folder), str(args.count), str(args.seed), msgspec.json.encode(recipe).decode(), str(workers)]
    with subprocess.Popen([sys.executable, "-c", _KILLED, *call], stdout=subprocess.PIPE) as run:
        assert run.stdout is not None
        run.stdout.readline()
        os.kill(run.pid, signal.SIGKILL)
    left = len(list(folder.glob("shard-*.npz")))
    write_dataset(folder, args.count, args.seed, recipe, workers)
    return left


def measure(args: argparse.Namespace, folder: Path) -> dict[str, Any]:
    effects = parse_effects(args.effects)
    recipe = Recipe(preset=args.preset, effects=effects, scans=args.scans, scenes_per_shard=args.scenes_per_shard)
    runs = [timed(folder / f"local{workers}", args, recipe, workers, "local") for workers in args.workers]
    runs += [timed(folder / executor, args, recipe, max(args.workers), executor) for executor in args.executors]
    left = kill_and_go_on(folder / "killed", args, recipe, max(args.workers))
    made = {one.name: contents(one) for one in sorted(folder.iterdir())}
    first, *others = made.values()
    return {
        "machine": f"{platform.machine()}, {os.cpu_count()} cores, Python {platform.python_version()}",
        "series": recipe.described(args.seed) | {"count": args.count},
        "runs": runs,
        "shards_left_by_kill": left,
        "shards": sum(name.startswith("shard-") for name in first),
        "same_bytes": {name: one == first for name, one in made.items()},
        "all_same": all(one == first for one in others),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--count", type=int, default=200)
    parser.add_argument("--scans", type=int, default=None, help="scans of a drive; none: places at rest")
    parser.add_argument("--seed", type=int, default=3)
    parser.add_argument("--workers", type=int, nargs="+", default=[1, 2])
    parser.add_argument("--executors", nargs="*", default=[], choices=["ray", "slurm"])
    parser.add_argument("--effects", default=None)
    parser.add_argument("--preset", default="xband", choices=["xband", "77ghz"])
    parser.add_argument("--scenes-per-shard", type=int, default=25)
    parser.add_argument("--out", type=Path, help="Folder to keep the data sets in; none: a temporary one.")
    parser.add_argument("--json", action="store_true")
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        folder = args.out or Path(temporary)
        folder.mkdir(parents=True, exist_ok=True)
        found = measure(args, folder)
    if args.json:
        print(json.dumps(found))
        return
    print(f"{found['machine']}; {found['series']}")
    for run in found["runs"]:
        times = f"{run['seconds']:8.2f} s  {run['scenes_per_s']:6.2f}/s  processor {run['processor_s']:8.2f} s"
        print(f"{run['executor']:<20} {run['workers']} workers  {times}")
    print(f"killed after {found['shards_left_by_kill']} of {found['shards']} shards, then went on")
    print(f"same bytes: {found['same_bytes']}")


if __name__ == "__main__":
    main()
