"""What smaller numbers cost: exported files of one network against the first of them, on the same scenes in one run.

Macro-F1 at the first card's threshold and the points lost against it, largest difference of a probability, file size,
memory of a fresh process that holds the network, milliseconds a map on 1 and 2 threads (network alone, files
interleaved round by round).
Usage: python -m benchmarks.perception.precision FP32.onnx [FP16.onnx INT8.onnx ...] --data DIR [--split test] [--scenes
324]
       [--rounds 50] [--seed 0] [--json]
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import os
import platform
import sys
import time
from pathlib import Path

import msgspec
import numpy as np
import onnxruntime
import psutil

from models.perception.detection.encoding import encode_map
from models.perception.detection.onnx_model import DensePredictor
from models.training.data.frames import DataSet, Frame, fixed_splits
from models.training.export.onnx import score_files

THREADS = (1, 2)


class Row(msgspec.Struct, kw_only=True):
    """One file."""

    file: str
    precision: str
    macro_f1: float
    lost_points: float
    largest_difference: float
    size_bytes: int
    memory_mib: float
    load_ms: float
    #: Threads to median and 90th percentile.
    map_ms: dict[int, tuple[float, float]]


def encoded_maps(path: Path, frames: list[Frame]) -> np.ndarray:
    encoding = DensePredictor(path).card.encoding
    return np.stack([encode_map(encoding, frame.ra_map) for frame in frames])


def map_times_ms(paths: list[Path], threads: int, maps: np.ndarray, rounds: int) -> list[tuple[float, float]]:
    """Median and 90th percentile of each file; every round times each file once, on the same map."""
    predictors = [DensePredictor(path, threads) for path in paths]
    times_ms = np.zeros((rounds, len(paths)))
    for index in range(rounds):
        for column, predictor in enumerate(predictors):
            start_ns = time.perf_counter_ns()
            predictor.infer(maps[index % len(maps)])
            times_ms[index, column] = (time.perf_counter_ns() - start_ns) / 1e6
    return [(float(np.median(column)), float(np.quantile(column, 0.9))) for column in times_ms.T]


def load_cost(path: Path) -> tuple[float, float]:
    """Memory [MiB] and time [ms] that loading and warming a network takes, in the calling process."""
    before = psutil.Process().memory_info().rss
    start_ns = time.perf_counter_ns()
    predictor = DensePredictor(path)
    load_ms = (time.perf_counter_ns() - start_ns) / 1e6
    predictor.infer(np.zeros(predictor.card.input_shape[1:], np.float32))
    return (psutil.Process().memory_info().rss - before) / 2**20, load_ms


def fresh_load_cost(path: Path) -> tuple[float, float]:
    with multiprocessing.get_context("spawn").Pool(1) as pool:
        return pool.apply(load_cost, (path,))


def run(paths: list[Path], data: Path, split: str, scenes: int, rounds: int, seed: int) -> list[Row]:
    selected = np.random.default_rng(seed).permutation(fixed_splits(data).of(split))[:scenes]
    dataset = DataSet(data)
    tallies = score_files(paths, dataset.frames(np.sort(selected)))
    maps = encoded_maps(paths[0], list(dataset.frames(selected[:16])))
    predictors = [DensePredictor(path) for path in paths]
    answers = [np.stack([predictor.infer(one) for one in maps]) for predictor in predictors]
    times_ms = {threads: map_times_ms(paths, threads, maps, rounds) for threads in THREADS}
    threshold = predictors[0].card.threshold
    rows = []
    for index, path in enumerate(paths):
        memory_mib, load_ms = fresh_load_cost(path)
        rows.append(
            Row(
                file=path.name,
                precision=predictors[index].card.precision,
                macro_f1=tallies[index].macro_f1(threshold),
                lost_points=100.0 * (tallies[0].macro_f1(threshold) - tallies[index].macro_f1(threshold)),
                largest_difference=float(np.abs(answers[index] - answers[0]).max()),
                size_bytes=path.stat().st_size,
                memory_mib=memory_mib,
                load_ms=load_ms,
                map_ms={threads: times_ms[threads][index] for threads in THREADS},
            )
        )
    return rows


def line(row: Row) -> str:
    times = "  ".join(f"{n} thr {median:6.1f} (p90 {p90:6.1f}) ms" for n, (median, p90) in row.map_ms.items())
    return (
        f"{row.file:24s} {row.precision:5s} Macro-F1 {row.macro_f1:.4f} lost {row.lost_points:+.2f} points  "
        f"differs {row.largest_difference:.1e}  {row.size_bytes / 1e6:6.2f} MB  {row.memory_mib:5.0f} MiB  "
        f"load {row.load_ms:5.0f} ms  {times}"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("files", type=Path, nargs="+")
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--split", default="test")
    parser.add_argument("--scenes", type=int, default=324)
    parser.add_argument("--rounds", type=int, default=50)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    command = f"python -m benchmarks.perception.precision {' '.join(sys.argv[1:])}"
    machine = (
        f"{platform.machine()}, {os.cpu_count()} cores, {platform.platform()}, onnxruntime {onnxruntime.__version__}"
    )
    rows = run(arguments.files, arguments.data, arguments.split, arguments.scenes, arguments.rounds, arguments.seed)
    if arguments.json:
        print(json.dumps({"command": command, "machine": machine, "rows": msgspec.to_builtins(rows)}))
        return
    print(command, machine, sep="\n")
    for row in rows:
        print(line(row))


if __name__ == "__main__":
    main()
