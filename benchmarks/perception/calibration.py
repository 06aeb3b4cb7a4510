"""Calibration held against errors put in on purpose: mounting off by 0.2 m and 2 deg, the CAN clock by 80 ms.

A yard of three concrete walls, a drive with changing speed and yaw rate, raw beams with noise, bus states at 50 Hz with
noise of 0.03 m/s and 0.2 deg/s. The radar sits at (1.4, 0.2) m and 2 deg where the prior says (1.2, 0) m and 0 deg;
the bus stamps its states 80 ms late. All goes through the command's own code: beams, maps, CFAR, walls, solution.
Usage: python -m benchmarks.perception.calibration [--seeds 5] [--scans 60] [--chirps 8] [--record FILE] [--json]
"""

from __future__ import annotations

import argparse
import json
import math
import sys
import tempfile
from pathlib import Path

import msgspec
import numpy as np

from contrib.calibrate.drive import DriveParams, solve_drive
from contrib.calibrate.mounting import Mounting
from lab.studies.report import machine
from mirrorwave.console import progress_bar
from msgs.recording.mcap import RecordingWriter
from msgs.values.frames import Pose2
from sim_player.drive import Drive
from sim_player.player import ScenePlayer
from sim_player.scene.description import Scene, Surface

TRUE, PRIOR = Pose2(1.4, 0.2, math.radians(2.0)), Pose2(1.2, 0.0, 0.0)
LATE_S, START_NS = 0.08, 10_000_000_000
NOISE = 0.03, math.radians(0.2)
WALL = {"material": "concrete", "height_m": 6.0, "thickness_mm": 250.0, "roughness_mm": 0.5}


class Errors(msgspec.Struct, kw_only=True):
    """Found less true, of one drive, with the standard deviations it was told with."""

    seed: int
    x_m: float
    y_m: float
    yaw_deg: float
    clock_ms: float
    x_std_m: float
    y_std_m: float
    yaw_std_deg: float
    clock_std_ms: float
    rms_before_m: float
    rms_m: float


def yard() -> Scene:
    """Walls on three sides."""
    lines = (((75.0, -40.0), (75.0, 45.0)), ((5.0, 14.0), (50.0, 14.0)), ((10.0, -16.0), (60.0, -22.0)))
    surfaces = tuple(Surface(role="relay", polyline_m=line, **WALL) for line in lines)  # type: ignore[arg-type]
    return Scene(name="yard", surfaces=surfaces)


def winding(duration_s: float, seed: int) -> Drive:
    """2 to 6 m/s, up to 14 deg/s to either side; each seed begins elsewhere in both swings.

    One drive errs alike under any noise: only several tell a bias from chance.
    """
    time_s = np.arange(-3.0, duration_s + 3.0, 0.05)
    speed_rad, turn_rad = np.random.default_rng([seed, 22]).uniform(0.0, 2.0 * np.pi, 2)
    speed_mps = 4.0 + 2.0 * np.sin(2.0 * np.pi * time_s / 7.0 + speed_rad)
    return Drive(time_s, speed_mps, 0.25 * np.sin(2.0 * np.pi * time_s / 9.0 + turn_rad), TRUE)


def record(path: Path, seed: int, scans: int, chirps: int) -> None:
    """The drive as a recording: set-up, states, beams."""
    duration_s = scans * 0.3
    drive = winding(duration_s, seed)
    player = ScenePlayer(yard(), seed, start_ns=START_NS, chirps_per_beam=chirps, drive=drive)
    with RecordingWriter(path, {"scene": "yard", "seed": str(seed)}) as writer:
        writer.write("radar/setup", player.setup, publisher="player", sequence=0, sent_ns=0)
        for number, state in enumerate(drive.states(duration_s, START_NS, seed, NOISE, LATE_S)):
            writer.write("vehicle/state", state, publisher="player", sequence=number, sent_ns=state.stamp_ns)
        beams = len(player.setup.beams)
        with progress_bar("scans", scans) as advance:
            for number in range(scans * beams):
                beam = player.beam(*divmod(number, beams))
                writer.write("radar/beam", beam, publisher="player", sequence=number, sent_ns=beam.stamp_ns)
                if beam.beam_index == beams - 1:
                    advance()


def errors_of(one: Mounting, seed: int) -> Errors:
    return Errors(
        seed=seed,
        x_m=one.x_m.value - TRUE.x_m,
        y_m=one.y_m.value - TRUE.y_m,
        yaw_deg=math.degrees(one.yaw_rad.value - TRUE.yaw_rad),
        clock_ms=1e3 * (one.clock_offset_s.value + LATE_S),
        x_std_m=one.x_m.std,
        y_std_m=one.y_m.std,
        yaw_std_deg=math.degrees(one.yaw_rad.std),
        clock_std_ms=1e3 * one.clock_offset_s.std,
        rms_before_m=one.rms_before_m,
        rms_m=one.rms_m,
    )


def run(seed: int, scans: int, chirps: int) -> Errors:
    """One drive, simulated, recorded and calibrated."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "drive.mcap"
        record(path, seed, scans, chirps)
        return errors_of(solve_drive(path, DriveParams(prior=PRIOR)).mounting, seed)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--scans", type=int, default=60)
    parser.add_argument("--chirps", type=int, default=8)
    parser.add_argument("--record", type=Path, metavar="FILE", help="write the first seed's recording and end")
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    if arguments.record is not None:
        record(arguments.record, 0, arguments.scans, arguments.chirps)
        return
    found = [run(seed, arguments.scans, arguments.chirps) for seed in range(arguments.seeds)]
    if arguments.json:
        sys.stdout.write(json.dumps({"machine": machine(), "drives": msgspec.to_builtins(found)}) + "\n")
        return
    for name, unit, put_in in (("x_m", "m", 0.2), ("y_m", "m", 0.2), ("yaw_deg", "deg", 2.0), ("clock_ms", "ms", 80.0)):
        values = np.array([getattr(one, name) for one in found])
        told = np.mean([getattr(one, name.replace("_", "_std_", 1)) for one in found])
        sys.stdout.write(
            f"{name.split('_')[0]:6s} put in {put_in:g} {unit}: residual mean {values.mean():+.3f}, spread "
            f"{values.std(ddof=1 if len(values) > 1 else 0):.3f}, largest {np.abs(values).max():.3f} {unit}; "
            f"told standard deviation {told:.3f}\n"
        )


if __name__ == "__main__":
    main()
