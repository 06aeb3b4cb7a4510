"""Beams of moving scenes: compiled echoes against double precision and the literal level, and what a beam takes.

Random places in which the radar drives at 8 m/s and turns by 10 deg/s and every road user moves (pedestrians at 1.5
m/s, others at 8 m/s), all effects. Of each place some beams of the first scan:
- compiled and float64 echoes against the literal level, all chirps of a short beam: relative L2, and the largest
  difference in a range-Doppler cell over the strongest cell;
- echoes of tracked paths against those of paths traced at the beam's own time, the same two figures;
- processor time of tracing, of tracking, of echoes in float64 and compiled, of the codes, for a beam of full length.
Usage: OPENBLAS_NUM_THREADS=1 python -m benchmarks.simulator.moving_beams [--places 10] [--beams 4] [--chirps 4]
                                        [--seed 17] [--json]
"""

from __future__ import annotations

import argparse
import json
import math
import os
import platform
import time
from collections.abc import Callable
from typing import Any

import msgspec
import numpy as np
from rich.progress import track

from sim_player.effects.table import ALL_EFFECTS
from sim_player.generate.places import random_place
from sim_player.planner.plan import Plan, manual_plan
from sim_player.scene.description import Ego, Scene
from sim_player.scene.world import World, prepare
from sim_player.signal.fmcw import noise_bank
from sim_player.signal.levels import Terms, echo_terms, record_beam, with_electronics
from sim_player.signal.literal import literal_echoes
from sim_player.trace.path_tracks import PathTrack, tracing_step_s
from sim_player.trace.paths import Paths
from sim_player.trace.ray_tracing import trace

OWN_SPEED_MPS, YAW_RATE_DPS = 8.0, 10.0
FAST_MPS, SLOW_MPS = 8.0, 1.5


def moving(scene: Scene) -> Scene:
    """The same place with everything in motion."""
    users = tuple(
        msgspec.structs.replace(user, speed_mps=SLOW_MPS if user.class_ == "pedestrian" else FAST_MPS)
        for user in scene.objects
    )
    return msgspec.structs.replace(scene, objects=users, ego=Ego(speed_mps=OWN_SPEED_MPS, yaw_rate_dps=YAW_RATE_DPS))


def samples_of(terms: Terms) -> np.ndarray:
    beats, carrier, basis = terms
    return np.asarray((carrier[:, None] * basis.T) @ beats)


def apart_db(got: np.ndarray, wanted: np.ndarray) -> tuple[float, float]:
    """Relative L2 over all samples; largest difference in a windowed range-Doppler cell over the strongest cell.

    Nothing against nothing, where the radar has driven into something, is no difference.
    """
    window = np.hanning(wanted.shape[1] + 1)[:-1]
    cells = [np.fft.fft(np.fft.fft(one * window, axis=1)[:, :512], axis=0) for one in (got - wanted, wanted)]
    ratios = (
        np.linalg.norm(got - wanted) / max(np.linalg.norm(wanted), 1e-300),
        np.abs(cells[0]).max() / max(np.abs(cells[1]).max(), 1e-300),
    )
    level_db, cell_db = (20.0 * math.log10(max(ratio, 1e-15)) for ratio in ratios)
    return level_db, cell_db


def processor_ms(work: Callable[[], object], rounds: int = 3) -> float:
    """Least of several rounds after one that warms up."""
    times_s = []
    for _ in range(rounds + 1):
        start_s = time.process_time()
        work()
        times_s.append(time.process_time() - start_s)
    return 1e3 * min(times_s[1:])


class _Place:
    """One moving place and its plan of all effects."""

    def __init__(self, seed: int, index: int) -> None:
        self.world: World = prepare(moving(random_place(seed, index)), index)
        self.setup = self.world.setup
        self.plan: Plan = manual_plan(self.world, self.setup, ALL_EFFECTS)
        step_s = tracing_step_s(self.world, OWN_SPEED_MPS, self.setup.radar.scan_period_s)
        self.track = PathTrack(self.traced, step_s)

    def traced(self, time_s: float) -> Paths:
        return trace(self.world, time_s, self.plan.used)

    def time_of(self, beam: int) -> float:
        return 1e-9 * beam * self.setup.beam_interval_ns + 0.5 * self.setup.radar.beam_duration_s

    def errors(self, beam: int, chirps: int) -> dict[str, tuple[float, float]]:
        """Levels against the literal one on a few chirps, and tracked paths against traced ones."""
        front_end, signal = self.world.scene.radar.front_end, self.plan.signal
        radar = msgspec.structs.replace(self.setup.radar, chirps_per_beam=chirps)
        short = msgspec.structs.replace(self.setup, radar=radar)
        paths = self.traced(self.time_of(beam))
        literal = literal_echoes(short, paths, signal, front_end, beam, range(chirps))
        found = {
            precision: apart_db(samples_of(echo_terms(short, paths, signal, front_end, beam, precision)), literal)
            for precision in ("float32", "float64")
        }
        tracked, traced = (
            samples_of(echo_terms(self.setup, one, signal, front_end, beam, "float32"))
            for one in (self.track.at(self.time_of(beam)), paths)
        )
        return found | {"tracked": apart_db(tracked, traced)}

    def times(self) -> dict[str, float]:
        """Processor time of a beam's parts, ms."""
        setup, front_end, signal = self.setup, self.world.scene.radar.front_end, self.plan.signal
        beams = range(len(setup.beams))
        paths = self.traced(0.1)
        bank = noise_bank(setup.radar, 0)
        terms = with_electronics(setup, echo_terms(setup, paths, signal, front_end, 0, "float32"), signal, front_end)
        scan_s = setup.radar.scan_period_s
        rounds = iter(range(1, 100))

        def track_a_scan() -> None:
            start_s = next(rounds) * scan_s
            for beam in beams:
                self.track.at(start_s + self.time_of(beam))

        return {
            "paths": float(len(paths)),
            "trace": processor_ms(lambda: self.traced(0.1)),
            "track": processor_ms(track_a_scan) / len(beams),
            "float64": processor_ms(lambda: echo_terms(setup, paths, signal, front_end, 12, "float64"), 1),
            "float32": processor_ms(lambda: echo_terms(setup, paths, signal, front_end, 12, "float32")),
            "codes": processor_ms(lambda: record_beam(setup, terms, bank, [0, 5, 0, 0], signal, front_end)),
        }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--places", type=int, default=10)
    parser.add_argument("--beams", type=int, default=4, help="beams of each place, spread over the scan")
    parser.add_argument("--chirps", type=int, default=4, help="chirps of a beam at the literal level")
    parser.add_argument("--seed", type=int, default=17)
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    rows: list[dict[str, Any]] = []
    for index in track(range(arguments.places), transient=True):
        place = _Place(arguments.seed, index)
        count = len(place.setup.beams)
        beams = [round(share * (count - 1)) for share in np.linspace(0.0, 1.0, arguments.beams)]
        errors = [place.errors(beam, arguments.chirps) for beam in beams]
        by_name = {name: [one[name] for one in errors] for name in errors[0]}
        rows.append({"place": place.world.scene.name, "times_ms": place.times(), **by_name})
    machine = f"{platform.machine()}, {os.cpu_count()} cores"
    if arguments.json:
        print(json.dumps({"machine": machine, "seed": arguments.seed, "rows": rows}))
        return
    for name, against in (("float32", "literal"), ("float64", "literal"), ("tracked", "traced")):
        values = np.array([one for row in rows for one in row[name]])
        l2_db, cell_db = np.median(values, axis=0), values.max(axis=0)
        print(
            f"{name} against {against}: relative L2 median {l2_db[0]:.0f}, worst {cell_db[0]:.0f} dB; "
            f"worst cell median {l2_db[1]:.0f}, worst {cell_db[1]:.0f} dB"
        )
    for name in rows[0]["times_ms"]:
        times_ms = [row["times_ms"][name] for row in rows]
        print(f"{name:8s} median {np.median(times_ms):7.2f}  least {min(times_ms):7.2f}  most {max(times_ms):7.2f}")


if __name__ == "__main__":
    main()
