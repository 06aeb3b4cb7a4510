"""What ten scenes call for, and what leaving out the rest saves: effects, paths, time, worst change against the law.

For each scene and purpose, `all` against `auto` at -20 dB, planning included, as ratios of processor times of this
process, both in turn, the least of some rounds: the kernel level (what data sets do), the beats of all beams (what
`sim run` does), the literal level (one path swept and one steady path are timed, and counted), and four scans of the
same scene in motion (objects at 5 m/s, the radar at 4 m/s and 5 deg/s: echoes of all beams, preparing included; `basic`
over `all` beside it). *Planning* is what asking takes beyond tracing and the map; *change* the worst cell of beams and
map over the law's reference, same noise.
Usage: OPENBLAS_NUM_THREADS=1 NUMBA_NUM_THREADS=1 python -m benchmarks.simulator.ten_scenes [--rounds 5]
                                        [--purposes objects samples] [--scenes NAME ...] [--levels kernel beats ...]
                                        [--json FILE]
"""

from __future__ import annotations

import argparse
import itertools
import json
import os
import platform
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from rich.progress import track
from threadpoolctl import threadpool_limits

from benchmarks.simulator.city import made_city
from lab.tradeoff.literal_signal import literal_echoes
from msgs.files.shipped import CHECKOUT
from sim_player.planner.cells import cells_of
from sim_player.planner.plan import Plan, clean_profiles, manual_plan, plan_world, planned_profiles
from sim_player.planner.purposes import Purpose
from sim_player.player import ScenePlayer
from sim_player.scene.description import Ego, Scene, SceneObject, Surface, Weather, load_scene
from sim_player.scene.world import prepare
from sim_player.signal.levels import noise_profiles, noise_rms

BUDGET_DB = -20.0
#: Scans in motion.
SCANS = 4
#: The columns of times.
LEVELS = ("kernel", "beats", "literal", "motion")


def wall(*points: tuple[float, float], role: str = "relay", **more: Any) -> Surface:
    """Return a concrete wall of 8 m."""
    plain = {"height_m": 8.0, "thickness_mm": 300.0, "roughness_mm": 0.5}
    return Surface(role=role, material="concrete", polyline_m=points, **{**plain, **more})  # type: ignore[arg-type]


def car(x_m: float, y_m: float, yaw_deg: float = 0.0) -> SceneObject:
    """Return a car."""
    return SceneObject(class_="car", x_m=x_m, y_m=y_m, yaw_deg=yaw_deg)


def scenes() -> dict[str, Scene]:
    """The ten scenes by name."""
    shipped = {name: load_scene(CHECKOUT / "launch" / "scenes" / f"{name}.yaml") for name in SHIPPED.values()}
    box = SceneObject(primitive="box", size_m=(1.0, 0.6, 0.5), material="metal", x_m=4.0, y_m=0.5, yaw_deg=20.0)
    return {
        "empty field": Scene(name="field", surfaces=(), objects=(car(25.0, 3.0, 30.0),)),
        "one wall": Scene(name="wall", surfaces=(wall((30.0, -15.0), (30.0, 15.0)),), objects=()),
        "corner": shipped["corner"],
        "corridor": Scene(
            name="corridor",
            surfaces=(wall((-5.0, 4.0), (60.0, 4.0)), wall((-5.0, -4.0), (60.0, -4.0))),
            objects=(car(35.0, 1.0), car(50.0, -1.5)),
        ),
        "rain": msgspec.structs.replace(shipped["facade_across_lane"], weather=Weather(rain_mm_per_h=25.0)),
        "metal box": Scene(name="box", surfaces=(wall((20.0, -10.0), (20.0, 10.0)),), objects=(box,)),
        "side street": shipped["parallel_street_wall"],
        "curved facade": Scene(
            name="curved",
            surfaces=(
                wall((22.0, -12.0), (22.0, 12.0), curvature_per_m=0.02),
                wall((1.0, 4.5), (9.0, 4.5), (9.0, 24.0), role="occluder"),
            ),
            objects=(car(14.0, 14.0, -90.0),),
        ),
        "city block": made_city(40),
        "77 GHz": shipped["hidden_car_77ghz"],
    }


SHIPPED = {
    "corner": "corner",
    "rain": "facade_across_lane",
    "side street": "parallel_street_wall",
    "77 GHz": "hidden_car_77ghz",
}


def in_turn(rounds: int, *calls: Callable[[], Any]) -> list[float]:
    """Least processor time of each call [s], all of them in turn; the first round compiles and fills what is kept."""
    least = [np.inf] * len(calls)
    for turn in range(rounds + 1):
        for index, call in enumerate(calls):
            start = time.process_time()
            call()
            if turn:
                least[index] = min(least[index], time.process_time() - start)
    return least


class Row:
    """One scene for one purpose."""

    def __init__(self, scene: Scene, purpose: Purpose, rounds: int) -> None:
        self._scene, self._purpose, self._rounds = scene, purpose, rounds
        self._world, self._setup, self._front_end = prepare(scene, 0), scene.setup, scene.radar.front_end
        self._all, self._auto = self._everything(), self._planned()

    def _everything(self) -> Plan:
        return manual_plan(self._world, self._setup)

    def _planned(self, profiles_only: bool = False) -> Plan:
        return plan_world(self._world, self._setup, BUDGET_DB, purpose=self._purpose, profiles_only=profiles_only)

    def found(self, levels: list[str]) -> dict[str, Any]:
        """All figures of some levels."""
        present = len(self._all.used)
        row = {"present": present, "used": len(self._auto.used), "traced": self._auto.traced}
        row |= {"paths": len(self._auto.echoes), "squints": int(self._auto.squints.sum())}
        row["left out"] = sorted(self._all.used - self._auto.used)
        row["change_db"] = self._change_db()
        timed = {"beats": self._beats, "literal": self._literal, "motion": self._motion}
        for level in levels:
            row |= timed[level]() if level in timed else {}
        return row | self._kernel()

    def _change_db(self) -> float:
        noise = noise_profiles(self._setup, 0, self._all.signal, self._front_end)
        wanted = clean_profiles(self._all, self._setup) + noise
        rms, cells = noise_rms(self._setup, self._all.signal, self._front_end), cells_of(self._setup)
        found = (clean_profiles(self._planned(True), self._setup), planned_profiles(self._auto, self._setup))
        worst = max(float(cells.off(wanted, one + noise, rms, self._purpose).max()) for one in found)
        return 20.0 * float(np.log10(max(worst, 1e-9)))

    def _kernel(self) -> dict[str, float]:
        all_s, auto_s, trace_s, ask_s = in_turn(
            self._rounds,
            lambda: clean_profiles(self._everything(), self._setup),
            lambda: clean_profiles(self._planned(True), self._setup),
            self._everything,
            self._planned,
        )
        return {"all_ms": 1e3 * all_s, "kernel": all_s / auto_s, "planning": max(ask_s - trace_s, 0.0) / all_s}

    def _beats(self) -> dict[str, float]:
        rounds = min(self._rounds, 2)
        all_s, auto_s = in_turn(rounds, lambda: self._everything().beats(), lambda: self._planned().beats())
        return {"beats_all_ms": 1e3 * all_s, "beats": all_s / auto_s}

    def _literal(self) -> dict[str, float]:
        """Seconds of one beam, from one path with squint and one without."""
        if not len(self._all.echoes):
            return {"literal": 1.0}
        one, flags = self._all.paths.take(np.array([0])), self._all.signal
        steady = msgspec.structs.replace(flags, squint=False)
        swept_s, steady_s, plan_s = in_turn(
            self._rounds,
            lambda: literal_echoes(self._setup, one, flags, self._front_end),
            lambda: literal_echoes(self._setup, one, steady, self._front_end),
            self._planned,
        )
        beams, groups = len(self._setup.beams), self._auto.groups()
        left_s = sum(len(paths) * (swept_s if flags.squint else steady_s) for paths, flags in groups)
        return {"literal": beams * len(self._all.echoes) * swept_s / (plan_s + beams * left_s)}

    def _motion(self) -> dict[str, float]:
        """Echoes of some scans in a row."""
        objects = tuple(msgspec.structs.replace(one, speed_mps=5.0) for one in self._scene.objects)
        scene = msgspec.structs.replace(self._scene, objects=objects, ego=Ego(speed_mps=4.0, yaw_rate_dps=5.0))

        def echoes(effects: str) -> None:
            player = ScenePlayer(scene, effects=effects, purpose=self._purpose)
            for scan, beam in itertools.product(range(SCANS), range(len(player.setup.beams))):
                player.echoes(scan, beam)

        words = ("all", "auto", "basic")
        all_s, auto_s, basic_s = in_turn(min(self._rounds, 2), *(partial(echoes, word) for word in words))
        return {"motion_all_ms": 1e3 * all_s / SCANS, "motion": all_s / auto_s, "basic": basic_s / all_s}


def table(rows: dict[str, dict[str, Any]]) -> str:
    """The figures as a page's table, with the medians of the ratios."""
    heads = (
        "scene",
        "effects",
        "paths",
        "swept",
        "all ms",
        "auto ms",
        "planning / all",
        *LEVELS,
        "basic / all",
        "worst change",
    )
    lines = [f"| {' | '.join(heads)} |", f"|{' --- |' * len(heads)}"]
    for name, row in rows.items():
        cells = [name, f"{row['used']} of {row['present']}", f"{row['paths']} of {row['traced']}", str(row["squints"])]
        cells += [f"{row['all_ms']:.1f}", f"{row['all_ms'] / row['kernel']:.1f}", f"{row['planning']:.2f}"]
        cells += [*(f"{row.get(level, np.nan):.1f}" for level in LEVELS)]
        cells += [f"{row.get('basic', np.nan):.2f}", f"{row['change_db']:.0f} dB"]
        lines.append(f"| {' | '.join(cells)} |")
    medians = {key: float(np.median([row.get(key, np.nan) for row in rows.values()])) for key in ("planning", *LEVELS)}
    ratios = " | ".join(f"**{medians[level]:.1f}**" for level in LEVELS)
    worst_db = max(row["change_db"] for row in rows.values())
    return "\n".join(
        [*lines, f"| median | | | | | | **{medians['planning']:.2f}** | {ratios} | | worst {worst_db:.0f} dB |"]
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--purposes", nargs="+", choices=list(Purpose), default=[Purpose.OBJECTS, Purpose.SAMPLES])
    parser.add_argument("--scenes", nargs="+", default=[])
    parser.add_argument("--levels", nargs="+", choices=LEVELS, default=list(LEVELS))
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    # processor time counts all threads
    threadpool_limits(1)
    asked = {name: scene for name, scene in scenes().items() if not arguments.scenes or name in arguments.scenes}
    found: dict[str, Any] = {"machine": f"{platform.machine()}, {os.cpu_count()} cores"}
    for purpose in arguments.purposes:
        rows = {
            name: Row(scene, Purpose(purpose), arguments.rounds).found(arguments.levels)
            for name, scene in track(asked.items(), transient=True)
        }
        found[purpose] = rows
        print(f"for {purpose}, {BUDGET_DB:g} dB, {found['machine']}\n\n{table(rows)}\n")
        print("\n".join(f"{name}: left out {', '.join(row['left out']) or 'nothing'}" for name, row in rows.items()))
    if arguments.json:
        arguments.json.write_text(json.dumps(found))


if __name__ == "__main__":
    main()
