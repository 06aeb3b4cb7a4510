"""Seconds for 256 azimuths of one scene through each sensor, and where the time goes.

The radars: paths, kernel-level profiles of all beams, interpolation to 256 azimuths; with `--beats` also raw int16
beams (all 128 chirps) through the whole former. The LiDAR: rays, histograms of 256 azimuths, map; in closed form and
event by event. Every part is run once before it is timed, then `--rounds` times: the median counts. Two threads where a
part uses threads at all. Usage: OPENBLAS_NUM_THREADS=2 python -m benchmarks.accuracy.three_sensors
[--scene launch/scenes/two_hidden_vehicles.yaml] [--rounds 5] [--seed 1] [--beats] [--json]
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import statistics
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from models.perception.forming.coarray import AzimuthInterpolator
from models.perception.forming.photon_map import photon_map
from models.perception.forming.ra_former import RaFormer
from msgs.values.lidar import LidarSetup, PhotonHistograms, SpadParams
from sim_player.dataset.labelled_scan import clean_profiles, noise_power_mw, profile_noise
from sim_player.lidar.spad import SpadOptions, optical_paths, spad_histograms
from sim_player.player import ScenePlayer
from sim_player.scene.description import Scene, load_scene
from sim_player.scene.world import prepare
from sim_player.trace.ray_tracing import trace

#: Table 2 in both ways of arming, and a period long enough for the whole map.
LIDARS = {
    "spad, free running": SpadParams(),
    "spad, gated": SpadParams(arming="gated"),
    "spad, 733 ns, 11 gates": SpadParams(repetition_rate_hz=15e6 / 11, arming="gated", gates=11),
}


def seconds(call: Callable[[], Any], rounds: int) -> float:
    """Median time of a call that has run once before."""
    call()
    times = []
    for _ in range(rounds):
        start_s = time.perf_counter()
        call()
        times.append(time.perf_counter() - start_s)
    return statistics.median(times)


def seen_by(scene: Scene, preset: str) -> Scene:
    """The same place through another sensor."""
    return msgspec.structs.replace(scene, radar=msgspec.structs.replace(scene.radar, preset=preset))


def radar_rows(scene: Scene, preset: str, args: argparse.Namespace) -> list[dict[str, Any]]:
    """Kernel level, and the whole way by raw beams."""
    scene = seen_by(scene, preset)
    setup, world = scene.setup, prepare(scene, args.seed)
    paths = trace(world)
    interpolator = AzimuthInterpolator(setup)

    def profiles() -> np.ndarray:
        return (clean_profiles(setup, paths) + profile_noise(setup, args.seed)).astype(np.complex64)

    made, noise = profiles(), noise_power_mw(setup)
    parts = {
        "paths": seconds(lambda: trace(world), args.rounds),
        "signal": seconds(profiles, args.rounds),
        "map": seconds(lambda: interpolator.interpolate(made, noise), args.rounds),
    }
    rows = [row(preset, "kernel", parts)]
    return [*rows, beats_row(scene, preset, args)] if args.beats else rows


def beats_row(scene: Scene, preset: str, args: argparse.Namespace) -> dict[str, Any]:
    """Raw int16 beams of one scan, and the former that a vehicle runs."""
    player, former = ScenePlayer(scene, args.seed), RaFormer(scene.setup)
    beams = range(len(scene.setup.beams))
    scans = iter(range(1000))

    def form() -> None:
        scan = next(scans)
        for index in beams:
            former.add(msgspec.structs.replace(recorded[index], scan_id=scan))

    recorded = [player.beam(0, index) for index in beams]
    parts = {
        "signal": seconds(lambda: [player.beam(0, index) for index in beams], 1),
        "map": seconds(form, args.rounds),
    }
    return row(preset, "raw beams", parts)


def lidar_rows(scene: Scene, name: str, spad: SpadParams, args: argparse.Namespace) -> list[dict[str, Any]]:
    """Closed form where it is exact, and event by event."""
    lidar, world = (
        LidarSetup(spad=spad, lidar_height_m=scene.radar.height_m),
        prepare(seen_by(scene, "spad"), args.seed),
    )
    paths = optical_paths(world, lidar)
    rows = []
    for engine in ("closed", "events") if spad.arming == "gated" else ("events",):
        options = SpadOptions(engine=engine)

        def draw(options: SpadOptions = options) -> np.ndarray:
            return spad_histograms(lidar, paths, [args.seed, 0], options)

        stamps = np.zeros(lidar.grid.azimuth_bins, np.int64)
        histograms = PhotonHistograms(stamp_ns=0, scan_id=0, counts=draw().astype(np.uint32), azimuth_stamp_ns=stamps)

        def form(histograms: PhotonHistograms = histograms) -> object:
            return photon_map(lidar, histograms)

        parts = {
            "paths": seconds(lambda: optical_paths(world, lidar), args.rounds),
            "signal": seconds(draw, args.rounds if engine == "closed" else 1),
            "map": seconds(form, args.rounds),
        }
        rows.append(row(name, engine, parts))
    return rows


def row(sensor: str, level: str, parts: dict[str, float]) -> dict[str, Any]:
    """One line of the table."""
    return {"sensor": sensor, "level": level, **parts, "total": sum(parts.values())}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scene", type=Path, default=Path("launch/scenes/two_hidden_vehicles.yaml"))
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--beats", action="store_true")
    parser.add_argument("--json", action="store_true")
    args = parser.parse_args()
    scene = load_scene(args.scene)
    rows = [line for preset in ("xband", "77ghz") for line in radar_rows(scene, preset, args)]
    rows += [line for name, spad in LIDARS.items() for line in lidar_rows(scene, name, spad, args)]
    machine = f"{platform.machine()}, {os.cpu_count()} cores, Python {platform.python_version()}"
    if args.json:
        print(json.dumps({"machine": machine, "scene": scene.name, "seed": args.seed, "rows": rows}, indent=1))
        return
    print(f"{scene.name}, seed {args.seed}; {machine}; seconds, median of {args.rounds}")
    print(f"{'sensor':24s} {'level':10s} {'paths':>8s} {'signal':>8s} {'map':>8s} {'total':>8s}")
    for one in rows:
        times = " ".join(f"{one.get(part, float('nan')):8.3f}" for part in ("paths", "signal", "map", "total"))
        print(f"{one['sensor']:24s} {one['level']:10s} {times}")


if __name__ == "__main__":
    main()
