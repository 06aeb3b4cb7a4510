"""Kernel, beat and literal level on one scene: how far apart, how long each takes, what each effect costs.

The scene: echoes of random streets, traced and laid over each other until there are enough, all static effects on
(element pattern, six-bit phases, mutual coupling, squint, overlap of chirps). What is timed is a scan's range profiles
(25 beams, 512 bins; beat and literal include window and FFT of one chirp a beam). The literal level runs on a few beams
and its scan time is scaled from them. Usage: OPENBLAS_NUM_THREADS=1 python -m benchmarks.simulator.signal_levels
[--paths 1000] [--literal-beams 2] [--rounds 7] [--seed 0] [--json]
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import time
from collections.abc import Callable
from functools import partial

import msgspec
import numpy as np

from msgs.values.radar import RadarSetup
from sim_player.dataset.labelled_scan import clean_profiles
from sim_player.generate.streets import random_street
from sim_player.scene.front_end import FrontEnd
from sim_player.scene.world import prepare
from sim_player.signal.levels import beam_beats, hann_profiles, kernel_profiles
from sim_player.signal.literal import literal_profiles
from sim_player.signal.switches import PLAIN, SignalEffects
from sim_player.trace.paths import Paths
from sim_player.trace.ray_tracing import trace

FAULTS = FrontEnd(coupling_db=-18.0, coupling_phase_deg=40.0)
STATIC = SignalEffects(motion=False, mutual_coupling=True, squint=True, chirp_overlap=True)
#: Effects whose cost is shown one by one, on top of the plain signal.
SINGLE = ("mutual_coupling", "squint", "chirp_overlap")


def scene_paths(least: int, seed: int) -> Paths:
    """Echoes of as many random streets as it takes."""
    parts: list[Paths] = []
    while sum(map(len, parts)) < least:
        parts.append(trace(prepare(random_street(seed, len(parts)), seed)))
    return Paths.joined(parts)


def timed(work: Callable[[], np.ndarray], rounds: int) -> tuple[np.ndarray, np.ndarray]:
    """Result, and medians of wall and processor time in seconds; the first of several rounds only warms up."""
    seconds = []
    for _ in range(rounds):
        start_s = np.array([time.perf_counter(), time.process_time()])
        result = work()
        seconds.append(np.array([time.perf_counter(), time.process_time()]) - start_s)
    return result, np.median(seconds[1:] or seconds, axis=0)


def apart(got: np.ndarray, reference: np.ndarray) -> float:
    return float(np.linalg.norm(got - reference) / np.linalg.norm(reference))


def cpu_ms(work: Callable[[], np.ndarray], rounds: int) -> float:
    return round(1e3 * float(timed(work, rounds)[1][1]), 2)


def levels(setup: RadarSetup, paths: Paths, literal_beams: int, rounds: int) -> dict:
    """Distances between the levels over the literal level's beams (kernel and beat: all), and a scan's wall times."""
    beams = np.unique(np.linspace(0, len(setup.beams) - 1, literal_beams).round().astype(int))
    double, double_s = timed(lambda: kernel_profiles(setup, paths, STATIC, FAULTS), rounds)
    single, single_s = timed(lambda: kernel_profiles(setup, paths, STATIC, FAULTS, precision="float32"), rounds)
    beat, beat_s = timed(
        lambda: hann_profiles(beam_beats(setup, paths, STATIC, FAULTS), setup.radar.samples_per_chirp),
        max(rounds // 2, 1),
    )
    literal, literal_s = timed(lambda: literal_profiles(setup, paths, STATIC, FAULTS, beams), 1)
    per_beam = len(setup.beams) / len(beams)
    scan_s = {"kernel32": single_s, "kernel64": double_s, "beat": beat_s, "literal": literal_s * per_beam}
    return {
        "paths": len(paths),
        "longest_m": round(float(paths.length_m.max()), 1),
        "literal_beams": beams.tolist(),
        "apart": {
            "kernel64_beat": apart(double, beat),
            "kernel32_beat": apart(single, beat),
            "kernel64_literal": apart(double[beams], literal),
            "kernel32_literal": apart(single[beams], literal),
            "beat_literal": apart(beat[beams], literal),
        },
        "scan_wall_s": {name: float(seconds[0]) for name, seconds in scan_s.items()},
        "scan_cpu_s": {name: float(seconds[1]) for name, seconds in scan_s.items()},
        "literal_over_wall": {name: float((scan_s["literal"] / seconds)[0]) for name, seconds in scan_s.items()},
        "literal_over_cpu": {name: float((scan_s["literal"] / seconds)[1]) for name, seconds in scan_s.items()},
    }


def costs(setup: RadarSetup, paths: Paths, rounds: int) -> list[dict]:
    """Kernel and beat level, processor ms a scan, by effect and number of paths; direct: `clean_profiles`' matrix
    product.
    """
    rows = []
    for count in (10, 100, 500, len(paths)):
        some = paths.take(np.random.default_rng(0).permutation(len(paths))[:count])
        row: dict = {"paths": len(some), "direct64": cpu_ms(lambda some=some: clean_profiles(setup, some), rounds)}
        cases = {name: msgspec.structs.replace(PLAIN, motion=False, **{name: True}) for name in SINGLE}
        for name, effects in {"plain": msgspec.structs.replace(PLAIN, motion=False), **cases, "all": STATIC}.items():
            for precision in ("float32", "float64"):
                work = partial(kernel_profiles, setup, some, effects, FAULTS, precision=precision)
                row[f"{name}{precision[-2:]}"] = cpu_ms(work, rounds)
            row[f"{name}_beat"] = cpu_ms(lambda some=some, effects=effects: beam_beats(setup, some, effects, FAULTS), 3)
        rows.append(row)
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--paths", type=int, default=1000)
    parser.add_argument("--literal-beams", type=int, default=2)
    parser.add_argument("--rounds", type=int, default=7)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    setup, paths = RadarSetup(), scene_paths(arguments.paths, arguments.seed)
    result = {
        "seed": arguments.seed,
        "machine": platform.machine(),
        "cores": os.cpu_count(),
        "threads": os.environ.get("OPENBLAS_NUM_THREADS"),
        **levels(setup, paths, arguments.literal_beams, arguments.rounds),
        "cpu_ms": costs(setup, paths, arguments.rounds),
    }
    print(json.dumps(result) if arguments.json else json.dumps(result, indent=1))


if __name__ == "__main__":
    main()
