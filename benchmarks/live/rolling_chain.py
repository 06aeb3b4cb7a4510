"""Processor time of one rolling view by stage: beams folded, last beam and map, peaks, geometry, tracking.

One process and one thread, without a bus, on the scene of the launch file (seed 0) at rest; processor time, so that
other work shows little. Geometry includes the object network. The scans before the fourth are left out.
Usage: OPENBLAS_NUM_THREADS=1 python -m benchmarks.live.rolling_chain [--rolling-beams 5] [--scans 8]
       [--profile default]
"""

from __future__ import annotations

import argparse
import time
from collections import defaultdict
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np

from benchmarks.live.bandwidth import played
from mirrorwave.node_chain import stage_params
from mirrorwave.profiles import read_profile
from nodes import dense_predictor, geometry, ra_former

_SETTLING_SCANS = 3


class Clock:
    """Processor times of stages in ms."""

    def __init__(self) -> None:
        self.times_ms: defaultdict[str, list[float]] = defaultdict(list)

    @contextmanager
    def __call__(self, stage: str) -> Iterator[None]:
        start_s = time.process_time()
        yield
        self.times_ms[stage].append(1e3 * (time.process_time() - start_s))


def measure(rolling_beams: int, scans: int, profile: str) -> dict[str, list[float]]:
    """Return the processor times of each stage, one a view (of the beams between two views: one a beam)."""
    params = read_profile(profile)
    radar = played()
    clock = Clock()
    formers = params.get("ra_former", {}) | {"rolling_beams": rolling_beams}
    former = ra_former.forming_stage(stage_params("ra_former", formers))
    former.set_up(radar.setup)
    detector = dense_predictor.detector_for(
        stage_params("dense_predictor", params.get("dense_predictor", {})), radar.setup
    )
    viewer = geometry.view_stage(stage_params("geometry", params.get("geometry", {})), clock)
    for scan in range(scans):
        if scan == _SETTLING_SCANS:
            clock.times_ms.clear()
        for index in range(len(radar.setup.beams)):
            beam = radar.beam(scan, index)
            start_s = time.process_time()
            maps = former.add(beam)
            stage = "last beam and map" if maps else "each beam before"
            clock.times_ms[stage].append(1e3 * (time.process_time() - start_s))
            for ra_map in maps:
                with clock("peaks"):
                    peaks = detector.detect(ra_map)
                viewer.view(peaks, ra_map)
    return clock.times_ms


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rolling-beams", type=int, default=5)
    parser.add_argument("--scans", type=int, default=8)
    parser.add_argument("--profile", default="default")
    arguments = parser.parse_args()
    print("| stage | views or beams | p50 [ms] | p99 [ms] |")
    print("|" + " --- |" * 4)
    for stage, times_ms in measure(arguments.rolling_beams, arguments.scans, arguments.profile).items():
        p50_ms, p99_ms = np.percentile(times_ms, [50, 99]).round(1)
        print(f"| {stage} | {len(times_ms)} | {p50_ms} | {p99_ms} |")


if __name__ == "__main__":
    main()
