"""The law of plans of scenes that move, and how long a selection of paths holds.

Random places in which every object moves at 1 to 15 m/s (pedestrians at 1 to 2 m/s) and the radar at 0.5 to 8 m/s,
turning by up to 20 deg/s. For each purpose:
- every beam of 12 scans: what is left out (echoes are a sum), in each range bin of eight Doppler bins, over the noise's
  rms or the threshold; the same on the 256 azimuths of the map that the beams make, each of its own time. A violation
  is a scan with a cell over the budget;
- a selection that is kept beyond its span: the number of beams until what it leaves out breaks the law.
`--rows FILE` keeps the rows of places that are done (JSON lines), and goes on where it ended.
Usage: OPENBLAS_NUM_THREADS=1 NUMBA_NUM_THREADS=1 python -m benchmarks.simulator.moving_plans [--places 30]
                                        [--budget-db -20] [--seed 23] [--json]
"""

from __future__ import annotations

import argparse
import json
import os
import platform
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from rich.progress import track

from models.perception.forming.slow_time_sums import group_edges
from sim_player.generate.places import random_place
from sim_player.planner.cells import cells_of
from sim_player.planner.plan import plan_world
from sim_player.planner.purposes import Purpose
from sim_player.scene.description import Ego, Scene
from sim_player.scene.world import prepare
from sim_player.signal.levels import RANGE_BINS, echo_terms, noise_rms
from sim_player.signal.slow_time_profiles import group_profiles
from sim_player.trace.path_tracks import PathTrack
from sim_player.trace.paths import Paths
from sim_player.trace.ray_tracing import trace

SCANS = 12
PURPOSES = tuple(Purpose)


def in_motion(scene: Scene, rng: np.random.Generator) -> Scene:
    """Return the same place with everything in motion, speeds drawn evenly in their logarithm."""

    def speed_mps(least: float, most: float) -> float:
        return float(np.exp(rng.uniform(np.log(least), np.log(most))))

    users = tuple(
        msgspec.structs.replace(user, speed_mps=speed_mps(1.0, 2.0 if user.class_ == "pedestrian" else 15.0))
        for user in scene.objects
    )
    ego = Ego(speed_mps=speed_mps(0.5, 8.0), yaw_rate_dps=float(rng.uniform(-20.0, 20.0)))
    return msgspec.structs.replace(scene, objects=users, ego=ego)


class _Place:
    """One moving place under the plan of a purpose: everything, and what the plan leaves out."""

    def __init__(self, seed: int, index: int, purpose: Purpose, budget_db: float) -> None:
        scene = in_motion(random_place(seed, index), np.random.default_rng([seed, index]))
        self.world, self.setup = prepare(scene, index), scene.setup
        self.plan = plan_world(self.world, self.setup, budget_db, purpose=purpose)
        self.front_end = scene.radar.front_end
        self.edges = group_edges(self.setup.radar.chirps_per_beam, 8)
        self.cells = cells_of(self.setup)
        nothing = np.zeros((len(self.setup.beams), RANGE_BINS), np.complex64)
        self.reference = self.cells.floor(
            nothing, noise_rms(self.setup, self.plan.signal, self.front_end), purpose=purpose
        )
        self._traced: dict[float, Paths] = {}
        assert self.plan.spans is not None
        self._kept, self.paths, self.dropped = self.plan.spans.kept, 0, 0
        self.everything = PathTrack(self._trace, self.plan.holds_s)
        self.left_out = PathTrack(self._trace, self.plan.holds_s, self._weak)

    def _trace(self, time_s: float) -> Paths:
        if time_s not in self._traced:
            self._traced = dict(list(self._traced.items())[-3:]) | {time_s: trace(self.world, time_s, self.plan.used)}
        return self._traced[time_s]

    def _weak(self, first: Paths, last: Paths, step_s: float) -> np.ndarray:
        weak = ~self._kept(first, last, step_s)
        self.paths, self.dropped = self.paths + len(weak), self.dropped + int(weak.sum())
        return weak

    def time_of(self, scan: int, beam: int) -> float:
        """Middle of a beam, s."""
        start_s = scan * self.setup.radar.scan_period_s + 1e-9 * beam * self.setup.beam_interval_ns
        return start_s + 0.5 * (self.setup.radar.beam_duration_s - self.setup.radar.chirp_period_s)

    def doppler(self, paths: Paths, beam: int) -> np.ndarray:
        """Echoes of some paths in the range and Doppler bins of a beam, sqrt(mW), complex [8, bins]."""
        if not len(paths):
            return np.zeros((8, RANGE_BINS), np.complex64)
        terms = echo_terms(self.setup, paths, self.plan.signal, self.front_end, beam, "float32")
        sums = group_profiles(self.setup, terms, self.edges, self.plan.signal, self.front_end)
        return np.asarray(np.fft.fft(sums, axis=0))

    def ratios(self, scan: int) -> tuple[float, float]:
        """What is left out of a scan over the law's reference: the largest in the beams and on the map."""
        beams = range(len(self.setup.beams))
        left = np.stack([self.doppler(self.left_out.at(self.time_of(scan, beam)), beam) for beam in beams], axis=1)
        ratio = np.max([np.abs(self.cells.values(profiles)) / self.reference for profiles in left], axis=0)
        return float(ratio[: len(beams)].max()), float(ratio[len(beams) :].max())

    def beams_until_broken(self, scan: int, budget: float) -> int:
        """Number of beams of a scan in which the paths left out at its start may go, at most all."""
        chains = self.left_out.at(self.time_of(scan, 0)).chain
        for beam in range(len(self.setup.beams)):
            paths = self.everything.at(self.time_of(scan, beam))
            left = self.doppler(paths.take(np.isin(paths.chain, chains)), beam)
            if (np.abs(left) / self.reference[beam]).max() > budget:
                return beam
        return len(self.setup.beams)


def law_row(seed: int, index: int, purpose: Purpose, budget_db: float) -> dict[str, Any]:
    """The law over 12 scans of a place, and how long its selections hold."""
    place, budget = _Place(seed, index, purpose, budget_db), 10.0 ** (budget_db / 20.0)
    ratios = np.array([place.ratios(scan) for scan in range(SCANS)])
    return {
        "place": place.world.scene.name,
        "purpose": purpose,
        "paths": place.plan.traced,
        "left_out": place.dropped / max(place.paths, 1),
        "holds_beams": place.plan.holds_s / (1e-9 * place.setup.beam_interval_ns),
        "violations": int((ratios > budget).any(axis=1).sum()),
        "beams_db": (20.0 * np.log10(np.maximum(ratios[:, 0], 1e-10))).tolist(),
        "map_db": (20.0 * np.log10(np.maximum(ratios[:, 1], 1e-10))).tolist(),
        "until_broken": [place.beams_until_broken(scan, budget) for scan in range(0, SCANS, 6)],
    }


def law_rows(arguments: argparse.Namespace) -> Iterator[dict[str, Any]]:
    """Rows of all places; those that are there already are read."""
    done = []
    if arguments.rows and arguments.rows.exists():
        done = [json.loads(line) for line in arguments.rows.read_text().splitlines()]
    yield from done
    asked = [(index, purpose) for index in range(arguments.places) for purpose in PURPOSES]
    for index, purpose in track(asked[len(done) :], transient=True):
        row = law_row(arguments.seed, index, purpose, arguments.budget_db)
        if arguments.rows:
            with arguments.rows.open("a") as file:
                file.write(json.dumps(row) + "\n")
        yield row


def report(laws: list[dict[str, Any]]) -> None:
    """Print the figures of each purpose."""
    for purpose in PURPOSES:
        mine = [row for row in laws if row["purpose"] == purpose]
        values = {name: np.array([row[name] for row in mine]) for name in ("paths", "left_out", "holds_beams")}
        spread = {name: np.quantile(value, [0.5, 0.0, 1.0]) for name, value in values.items()}
        beams_db, map_db = (np.concatenate([row[name] for row in mine]) for name in ("beams_db", "map_db"))
        broken = np.concatenate([row["until_broken"] for row in mine])
        print(
            f"{purpose:7s} {len(beams_db)} scans of {len(mine)} places, {sum(row['violations'] for row in mine)} "
            f"violations; changes by {beams_db.max():.1f} dB at most in beams (median {np.median(beams_db):.1f}), "
            f"{map_db.max():.1f} on maps (median {np.median(map_db):.1f})"
        )
        for name, (middle, least, most) in spread.items():
            print(f"        {name:12s} median {middle:.3g}, least {least:.3g}, most {most:.3g}")
        print(
            f"        kept beyond its span a selection breaks the law after {np.median(broken):.0f} beams (median), "
            f"in {np.mean(broken < 25):.0%} of scans before their end"
        )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--places", type=int, default=30)
    parser.add_argument("--budget-db", type=float, default=-20.0)
    parser.add_argument("--seed", type=int, default=23)
    parser.add_argument("--rows", type=Path)
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    laws = list(law_rows(arguments))
    if arguments.json:
        machine = f"{platform.machine()}, {os.cpu_count()} cores"
        print(json.dumps({"machine": machine, "seed": arguments.seed, "laws": laws}))
        return
    report(laws)


if __name__ == "__main__":
    main()
