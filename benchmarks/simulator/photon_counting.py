"""Photon histograms of one scan: closed form against counting event by event, and what the closed form is off by.

Every azimuth has Table 2's numbers (450,000 pulses), a wall at 5 m that sends back 10 photons a pulse and a weak path,
0.05 photons, between 5 and 9.9 m; times are the processor's, of all azimuths, compiled code warm. The error of expected
counts is against a grid eight times finer, in counts of 450,000 and in standard deviations of a bin; also for a bright
path (3 photons) just before the period's end, whose dead time reaches the next one. Spread: variance of counts event by
event over that of independent periods, of single bins and of their sum.
Usage: OPENBLAS_NUM_THREADS=1 python -m benchmarks.simulator.photon_counting [--azimuths 256] [--seed 0] [--json]
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import time

import msgspec
import numpy as np

from models.physics.photons.counting import CELLS_PER_RMS, draw_histogram, event_histogram, expected_histogram
from msgs.values.lidar import SpadParams
from msgs.values.units import SPEED_OF_LIGHT_MPS

WALL_M, WALL_PHOTONS, WEAK_PHOTONS = 5.0, 10.0, 0.05


def paths(azimuths: int, seed: int) -> list[tuple[np.ndarray, np.ndarray]]:
    weak_m = np.random.default_rng(seed).uniform(WALL_M, 9.9, azimuths)
    photons = np.array([WALL_PHOTONS, WEAK_PHOTONS])
    return [(2.0 * np.array([WALL_M, one]) / SPEED_OF_LIGHT_MPS, photons) for one in weak_m]


def seconds(count, spad: SpadParams, scan: list, seed: int) -> float:
    """Processor seconds of one scan."""
    count(spad, *scan[0], np.random.default_rng(seed))
    start_s = time.process_time()
    for index, one in enumerate(scan):
        count(spad, *one, np.random.default_rng([seed, index]))
    return time.process_time() - start_s


def errors(spad: SpadParams, layout: tuple[np.ndarray, np.ndarray]) -> dict:
    """Largest error of expected counts, in counts and in standard deviations."""
    fine = expected_histogram(spad, *layout, cells_per_rms=8 * CELLS_PER_RMS)
    off = {cells: np.abs(expected_histogram(spad, *layout, cells_per_rms=cells) - fine) for cells in (8, 16)}
    deviation = np.sqrt(np.maximum(fine, 1.0))
    return {
        "counts": float(off[16].max()),
        "deviations": float((off[16] / deviation).max()),
        "counts_coarser": float(off[8].max()),
    }


def spread(spad: SpadParams, layout: tuple[np.ndarray, np.ndarray], runs: int, seed: int) -> dict:
    """Variance of event counts over that of independent periods: mean of the bins, and of their sum."""
    counts = np.array([event_histogram(spad, *layout, np.random.default_rng([seed, run])) for run in range(runs)])
    share = expected_histogram(spad, *layout) / spad.pulses
    seen = share * spad.pulses > 20.0
    bins = counts.var(axis=0, ddof=1)[seen] / (spad.pulses * share * (1.0 - share))[seen]
    total = share.sum()
    return {
        "bins": float(bins.mean()),
        "sum": float(counts.sum(axis=1).var(ddof=1) / (spad.pulses * total * (1.0 - total))),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--azimuths", type=int, default=256)
    parser.add_argument("--runs", type=int, default=300, help="measurements of 45,000 pulses for the spread")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    scan = paths(arguments.azimuths, arguments.seed)
    late = (np.array([1e-9, 65e-9]), np.array([0.5, 3.0]))
    result: dict = {
        "seed": arguments.seed,
        "machine": platform.machine(),
        "cores": os.cpu_count(),
        "azimuths": arguments.azimuths,
        "scan_cpu_s": {},
        "error": {},
        "variance_ratio": {},
    }
    for arming in ("gated", "free"):
        for tick_from in ("pulse", "run"):
            spad = SpadParams(arming=arming, tick_from=tick_from)
            closed_s, events_s = (seconds(one, spad, scan, arguments.seed) for one in (draw_histogram, event_histogram))
            result["scan_cpu_s"][f"{arming}, ticks from {tick_from}"] = {
                "closed": round(closed_s, 3),
                "events": round(events_s, 3),
                "ratio": round(events_s / closed_s, 1),
            }
    for name, layout in {"wall": scan[0], "late": late}.items():
        result["error"][name] = errors(SpadParams(), layout)
    for dead_time_s in (4e-9, 30e-9, 100e-9):
        spad = msgspec.structs.replace(SpadParams(), dead_time_s=dead_time_s, measurement_time_s=0.003)
        found = spread(spad, scan[0], arguments.runs, arguments.seed)
        result["variance_ratio"][f"{1e9 * dead_time_s:g} ns"] = found
    print(json.dumps(result) if arguments.json else json.dumps(result, indent=1))


if __name__ == "__main__":
    main()
