"""A prescribed drive of a vehicle that carries the radar: any speed and yaw rate over time, any mounting."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from msgs.values.frames import Pose2, wrap_angle
from msgs.values.units import ns_from_s
from msgs.values.vehicle import VehicleState
from sim_player.scene.clear_path import first_meeting
from sim_player.scene.description import Scene
from sim_player.scene.world import RadarState

#: Time from one vehicle state to the next; states begin before and end after the scans, so that late ones cover them.
STATE_PERIOD_S, BEYOND_S = 0.02, 2.0


@dataclass(frozen=True)
class Drive:
    """Speed and yaw rate of the vehicle at times from 0 on, each [N]; straight lines between them."""

    time_s: np.ndarray
    speed_mps: np.ndarray
    yaw_rate_rps: np.ndarray
    vehicle_from_radar: Pose2 = field(default_factory=Pose2)

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

    @property
    def fastest_mps(self) -> float:
        """Greatest speed of the vehicle, either way."""
        return float(np.abs(self.speed_mps).max(initial=0.0))

    def radar(self, time_s: float) -> RadarState:
        """Return the radar's pose and velocity in the frame of the start: that of the vehicle and the turn about it."""
        pose, lever, at = self.pose(time_s), self.vehicle_from_radar, np.array(time_s)
        speed, yaw_rate = float(self.speed_at(at)), float(self.yaw_rate_at(at))
        in_vehicle = np.array([speed - yaw_rate * lever.y_m, yaw_rate * lever.x_m])
        return RadarState(pose @ lever, pose.rotate(in_vehicle))

    def meeting(self, scene: Scene) -> tuple[float, str] | None:
        """Return when the radar meets the first wall or object, in words which; None if it never does."""
        time_s = np.arange(0.0, float(self.time_s[-1]) + 0.05, 0.05)
        poses = [self.radar(float(at_s)).pose for at_s in time_s]
        return first_meeting(scene, time_s, np.array([(pose.x_m, pose.y_m) for pose in poses]))

    def state(self, stamp_ns: int, time_s: float) -> VehicleState:
        """Return the vehicle's state at a time, under a stamp."""
        at = np.array(time_s)
        return VehicleState(
            stamp_ns=stamp_ns, speed_mps=float(self.speed_at(at)), yaw_rate_rps=float(self.yaw_rate_at(at))
        )

    def states(
        self,
        duration_s: float,
        start_ns: int,
        seed: int = 0,
        noise: tuple[float, float] = (0.0, 0.0),
        late_s: float = 0.0,
    ) -> list[VehicleState]:
        """Return the bus's states around `duration_s`, `late_s` late, with noise of both [m/s, rad/s]."""
        rng = np.random.default_rng([seed, 21])
        time_s = np.arange(-BEYOND_S, duration_s + BEYOND_S, STATE_PERIOD_S)
        speed_mps = self.speed_at(time_s) + noise[0] * rng.standard_normal(len(time_s))
        yaw_rate_rps = self.yaw_rate_at(time_s) + noise[1] * rng.standard_normal(len(time_s))
        stamps_ns = [start_ns + ns_from_s(float(at_s) + late_s) for at_s in time_s]
        return [
            VehicleState(stamp_ns=stamp_ns, speed_mps=float(speed), yaw_rate_rps=float(yaw_rate))
            for stamp_ns, speed, yaw_rate in zip(stamps_ns, speed_mps, yaw_rate_rps, strict=True)
        ]
