"""CPU time of the geometry stage and of its parts on seeded places: labels as peaks, so that no data set is needed.

Every round goes over all places once, each place first whole (`recover_bev`), then part by part; a place counts with
the least of its rounds, for the machine adds time and never takes any away. p50 and p99 are those over places.
Usage: python -m benchmarks.perception.geometry_speed [--count N] [--seed S] [--rounds R] [--json]
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Callable, Iterator
from typing import Any, TypeVar

import numpy as np

from benchmarks.perception.geometry_switches import labelled_peaks, machine
from models.perception.geometry.association import DirectReturns
from models.perception.geometry.clustering import dbscan
from models.perception.geometry.objects import form_objects
from models.perception.geometry.observability import observability
from models.perception.geometry.recovery import cartesian_covariance, recover
from models.perception.geometry.rejection import hidden_mask
from models.perception.geometry.stage import GeometryParams, recover_bev, warm
from models.perception.geometry.walls import find_walls
from msgs.values.frames import xy_from_polar
from msgs.values.perception import PathClass, Peaks
from sim_player.dataset.labelled_scan import labelled_scan
from sim_player.generate.places import random_place

WHOLE = "recover_bev"
Answer = TypeVar("Answer")


def place_peaks(seed: int, count: int) -> Iterator[Peaks]:
    """Labels of seeded places at rest as peaks, with the polar errors of good ones."""
    for index in range(count):
        scan = labelled_scan(random_place(seed, index), seed, "basic")
        yield labelled_peaks(scan.labels, scan.noise_power_mw, np.random.default_rng([seed, index]), index)


class Stopwatch:
    """CPU milliseconds of named calls."""

    def __init__(self) -> None:
        self.ms: dict[str, float] = {}

    def time(self, name: str, call: Callable[..., Answer], *arguments: Any) -> Answer:
        start = time.process_time()
        answer = call(*arguments)
        self.ms[name] = 1e3 * (time.process_time() - start)
        return answer


def timed(peaks: Peaks, params: GeometryParams) -> dict[str, float]:
    """CPU milliseconds of the whole stage on one scan, then of its parts in their order."""
    watch = Stopwatch()
    watch.time(WHOLE, recover_bev, peaks, params)
    direct = peaks.path_class == PathClass.LOS
    polar = peaks.range_m[direct], peaks.azimuth_rad[direct]
    points_m = xy_from_polar(*polar)
    covariance_m2 = watch.time("covariances", cartesian_covariance, *polar, peaks.covariance[direct])
    labels = watch.time("clusters", dbscan, points_m, params.cluster_eps_m, params.cluster_min_points)
    walls, wall = watch.time("walls", find_walls, points_m, covariance_m2, labels, params.walls)
    returns = DirectReturns(points_m, peaks.snr_db[direct], labels, wall)
    recovered = watch.time("folds", recover, peaks, walls, returns, params.recovery)
    hidden = watch.time("explained", hidden_mask, recovered, walls, returns, params.recovery)
    watch.time("objects", form_objects, recovered.take(hidden), walls, params.objects)
    watch.time("mask", observability, walls, peaks.sensitivity_db, params.grid, params.visibility)
    return watch.ms


def table(scans: list[Peaks], rounds: int) -> list[dict[str, Any]]:
    """One row for the stage and each part: mean, p50 and p99 over scans of the least of their rounds, in ms."""
    params = GeometryParams()
    warm(params)
    runs = [[timed(peaks, params) for peaks in scans] for _ in range(rounds)]
    rows = []
    for name in runs[0][0]:
        least = np.array([[scan[name] for scan in run] for run in runs]).min(axis=0)
        p50, p99 = np.quantile(least, [0.5, 0.99])
        rows.append({"part": name, "mean_ms": float(least.mean()), "p50_ms": float(p50), "p99_ms": float(p99)})
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=60)
    parser.add_argument("--seed", type=int, default=7)
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    scans = list(place_peaks(arguments.seed, arguments.count))
    rows = table(scans, arguments.rounds)
    about = {
        "machine": machine(),
        "command": " ".join(["python -m benchmarks.perception.geometry_speed", *sys.argv[1:]]),
        "places": len(scans),
        "peaks_mean": float(np.mean([len(peaks) for peaks in scans])),
    }
    if arguments.json:
        print(json.dumps({**about, "rows": rows}))
        return
    print("\n".join(f"{name}: {value}" for name, value in about.items()))
    for row in rows:
        print(f"{row['part']:12s} mean {row['mean_ms']:6.2f}  p50 {row['p50_ms']:6.2f}  p99 {row['p99_ms']:6.2f} ms")


if __name__ == "__main__":
    main()
