"""A radar on a vehicle with a prescribed drive: beams and truth from any path and mounting, and vehicle states.

Unlike `sim_player.player`, whose radar moves at constant speed and yaw rate along its own x axis, the vehicle's speed
and yaw rate change over time and the radar sits somewhere on it, turned. Each beam is traced from its own position.
"""

from __future__ import annotations

from dataclasses import dataclass

import msgspec
import numpy as np

from msgs.values.frames import Pose2, wrap_angle
from msgs.values.perception import SceneTruth
from msgs.values.radar import RadarBeam, RadarSetup
from msgs.values.units import ns_from_s, s_from_ns
from msgs.values.vehicle import VehicleState
from sim_player.paths.conversion import as_paths
from sim_player.paths.path_tracks import PathTrack, tracing_step_s
from sim_player.paths.ray_tracing import BASIC_EFFECTS, trace_echoes
from sim_player.paths.reach import reachable_snapshot
from sim_player.paths.truth import scene_truth
from sim_player.planner.plan import resolve_plan
from sim_player.scene.clear_path import first_meeting, meeting_text
from sim_player.scene.description import Ego, Scene
from sim_player.scene.world import RadarState, prepare, snapshot
from sim_player.signal.clutter import Clutter, drawn_cells, with_clutter
from sim_player.signal.fmcw import noise_bank
from sim_player.signal.levels import Terms, echo_terms, record_beam, with_electronics
from sim_player.signal.rain_volume import clutter_at
from sim_player.signal.swept_echoes import check_precision
from sim_player.signal.switches import PLAIN
from sim_player.trace.path_table import Paths


@dataclass(frozen=True)
class Drive:
    """Speed and yaw rate of the vehicle at times from 0 on, each [N]; straight lines between them."""

    time_s: np.ndarray
    speed_mps: np.ndarray
    yaw_rate_rps: np.ndarray

    def pose(self, time_s: float) -> Pose2:
        """Return `start_from_vehicle` at a time: integrated in steps of a millisecond at most."""
        steps = max(int(abs(time_s) / 1e-3), 1)
        at_s = (np.arange(steps) + 0.5) * time_s / steps
        step_s = time_s / steps
        turned_rad = self.yaw_rate_at(at_s) * step_s
        heading_rad = np.cumsum(turned_rad) - 0.5 * turned_rad
        step_m = self.speed_at(at_s) * step_s
        x_m, y_m = float(step_m @ np.cos(heading_rad)), float(step_m @ np.sin(heading_rad))
        return Pose2(x_m, y_m, wrap_angle(float(turned_rad.sum())))

    def speed_at(self, time_s: np.ndarray) -> np.ndarray:
        """Return the speed at times; held before the first and after the last."""
        return np.interp(time_s, self.time_s, self.speed_mps)

    def yaw_rate_at(self, time_s: np.ndarray) -> np.ndarray:
        """Return the yaw rate at times; held before the first and after the last."""
        return np.interp(time_s, self.time_s, self.yaw_rate_rps)


class DrivePlayer:
    """Beams of a scene, given in the vehicle's frame at the start, along a drive; same seed, same bytes.

    Stamps count from `start_ns`. `effects`: "basic" (direct echoes and single mirrors), "all", or names with commas
    between them; `precision` ("float64", "float32") is that of the echoes. Raises
    ValueError for a scene that moves its radar itself (`ego`), for "auto" (the planner knows no drive), and for
    unknown effects or precisions, and once the radar has driven into a wall.
    """

    def __init__(
        self,
        scene: Scene,
        drive: Drive,
        vehicle_from_radar: Pose2,
        seed: int = 0,
        start_ns: int = 0,
        chirps_per_beam: int | None = None,
        effects: str = "basic",
        precision: str = "float32",
    ) -> None:
        if scene.ego != Ego():
            raise ValueError(f"scene {scene.name!r}: ego must stand still: the drive says how the vehicle moves")
        if effects == "auto":
            raise ValueError("effects must be basic, all or names with commas between them on a drive, got 'auto'")
        check_precision(precision)
        setup = scene.setup
        if chirps_per_beam is not None:
            radar = msgspec.structs.replace(setup.radar, chirps_per_beam=chirps_per_beam)
            setup = msgspec.structs.replace(setup, radar=radar)
        self.setup: RadarSetup = msgspec.structs.replace(setup, stamp_ns=start_ns)
        self.drive, self.vehicle_from_radar = drive, vehicle_from_radar
        self._seed, self._start_ns = seed, start_ns
        self._world = prepare(scene, seed, setup)
        self._bank = noise_bank(setup.radar, seed)
        self._precision = precision
        plan = resolve_plan(self._world, setup, effects)
        self._used = BASIC_EFFECTS if plan is None else plan.used
        self._signal = PLAIN if plan is None else plan.signal
        self._traced: tuple[float, Paths] | None = None
        self._drawn: tuple[int, Clutter, np.ndarray] | None = None
        self._meeting = _meeting(scene, drive, vehicle_from_radar)
        fastest_mps = float(np.abs(drive.speed_mps).max(initial=0.0))
        step_s = tracing_step_s(self._world, fastest_mps, setup.radar.scan_period_s)
        self._track = PathTrack(self._trace, step_s)

    def _elapsed_s(self, stamp_ns: int) -> float:
        """Return the time since the start; ValueError once the radar has met a wall."""
        time_s = s_from_ns(stamp_ns - self._start_ns)
        if self._meeting is not None and time_s > self._meeting[0]:
            raise ValueError(
                f"scene {self._world.scene.name!r}: {meeting_text(self._meeting)}, asked for {time_s:.2f} s"
            )
        return time_s

    def stamp_ns(self, scan: int, beam: int = 0) -> int:
        """Return when a beam starts."""
        period_ns = ns_from_s(self.setup.radar.scan_period_s)
        return self._start_ns + scan * period_ns + beam * self.setup.beam_interval_ns

    def beam(self, scan: int, index: int) -> RadarBeam:
        """Return one steering angle's raw samples, at the radar's position and speed at that time."""
        setup, front_end = self.setup, self._world.scene.radar.front_end
        seed = [self._seed, 5, scan, index]
        terms = self._echoes(scan, index)
        if self._signal.rain_clutter:
            clutter, cells = self._air(scan)
            terms = with_clutter(setup, terms, clutter, cells[index], index)
        terms = with_electronics(setup, terms, self._signal, front_end, seed)
        return RadarBeam(
            stamp_ns=self.stamp_ns(scan, index),
            scan_id=scan,
            beam_index=index,
            beam_count=len(setup.beams),
            azimuth_rad=float(setup.beams.azimuth_rad[index]),
            samples=record_beam(setup, terms, self._bank, seed, self._signal, front_end),
            full_scale_dbm=setup.full_scale_dbm,
        )

    def _air(self, scan: int) -> tuple[Clutter, np.ndarray]:
        """Return the echoes of rain, snow and fog around the radar at the start of a scan, and their draws."""
        if self._drawn is None or self._drawn[0] != scan:
            time_s, front_end = self._elapsed_s(self.stamp_ns(scan)), self._world.scene.radar.front_end
            radar = RadarState(self._pose(time_s), self._velocity(time_s))
            clutter = clutter_at(snapshot(self._world, time_s, radar), self._signal)
            self._drawn = scan, clutter, drawn_cells(self.setup, clutter, self._signal, front_end, self._seed, scan)
        return self._drawn[1:]

    def _echoes(self, scan: int, index: int) -> Terms:
        """Return the terms of one beam's echoes: beats [terms, samples], carrier [chirps], basis [terms, chirps]."""
        setup = self.setup
        # slow time counts from the middle of the beam
        middle_s = 0.5 * (setup.radar.beam_duration_s - setup.radar.chirp_period_s)
        time_s = self._elapsed_s(self.stamp_ns(scan, index)) + middle_s
        paths, front_end = self._track.at(time_s), self._world.scene.radar.front_end
        return echo_terms(setup, paths, self._signal, front_end, index, self._precision)

    def truth(self, scan: int) -> SceneTruth:
        """Return the truth at the start of a scan, in the radar's frame."""
        stamp_ns = self.stamp_ns(scan)
        time_s = self._elapsed_s(stamp_ns)
        paths, pose = self.paths(time_s), self._pose(time_s)
        return scene_truth(self._world, self.setup, paths, time_s, stamp_ns, scan, pose)

    def states(
        self, duration_s: float, period_s: float = 0.02, noise: tuple[float, float] = (0.0, 0.0), late_s: float = 0.0
    ) -> list[VehicleState]:
        """Return the vehicle states over `duration_s`, stamped `late_s` late; noise of speed [m/s] and yaw rate
        [rad/s].

        They begin two seconds before and end two seconds after, so that shifted stamps still cover the scans.
        """
        rng = np.random.default_rng([self._seed, 21])
        time_s = np.arange(-2.0, duration_s + 2.0, period_s)
        speed_mps = self.drive.speed_at(time_s) + noise[0] * rng.standard_normal(len(time_s))
        yaw_rate_rps = self.drive.yaw_rate_at(time_s) + noise[1] * rng.standard_normal(len(time_s))
        stamps_ns = [self._start_ns + ns_from_s(float(at_s) + late_s) for at_s in time_s]
        return [
            VehicleState(stamp_ns=stamp_ns, speed_mps=float(speed), yaw_rate_rps=float(yaw_rate))
            for stamp_ns, speed, yaw_rate in zip(stamps_ns, speed_mps, yaw_rate_rps, strict=True)
        ]

    def paths(self, time_s: float) -> Paths:
        """Return all paths from the radar's position at a time after the start [s]; those of the last time are
        cached.
        """
        if self._traced is None or self._traced[0] != time_s:
            self._traced = time_s, self._trace(time_s)
        return self._traced[1]

    def _trace(self, time_s: float) -> Paths:
        view = reachable_snapshot(self._world, time_s, RadarState(self._pose(time_s), self._velocity(time_s)))
        return as_paths(view, trace_echoes(view, self._used), self._used)

    def _pose(self, time_s: float) -> Pose2:
        """Return `start_from_radar` at a time."""
        return self.drive.pose(time_s) @ self.vehicle_from_radar

    def _velocity(self, time_s: float) -> np.ndarray:
        """Return the radar's velocity in the scene's frame, [2]: that of the vehicle and the turn about it."""
        lever, at = self.vehicle_from_radar, np.array(time_s)
        speed, yaw_rate = float(self.drive.speed_at(at)), float(self.drive.yaw_rate_at(at))
        in_vehicle = np.array([speed - yaw_rate * lever.y_m, yaw_rate * lever.x_m])
        return self.drive.pose(time_s).rotate(in_vehicle)


def _meeting(scene: Scene, drive: Drive, vehicle_from_radar: Pose2) -> tuple[float, int] | None:
    """Return when the radar meets the first wall on a drive, and the number of its surface; None if it never does."""
    time_s = np.arange(0.0, float(drive.time_s[-1]) + 0.05, 0.05)
    poses = [drive.pose(float(at_s)) @ vehicle_from_radar for at_s in time_s]
    return first_meeting(scene, time_s, np.array([(pose.x_m, pose.y_m) for pose in poses]))
