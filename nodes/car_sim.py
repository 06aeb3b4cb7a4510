"""A simulated car on a real CAN bus: it sends its motion, and no other node of the graph talks to it."""

from __future__ import annotations

import math
from pathlib import Path
from typing import ClassVar

import msgspec

from msgs.bus.interface import Outgoing, Received
from msgs.files.shipped import shipped_path
from msgs.values.diagnostics import NodeState
from msgs.values.vehicle import VehicleState
from msgs.values.wording import counted
from nodes.can.bus import BusParams, CanLink, bus_frame, load_dbc, load_mapping
from nodes.node import Node
from sim_player.car import TRACK_M, SimulatedCar, steering_rad

#: The car's frames: those that `vehicle_can` reads unless told otherwise.
DBC, MAPPING = "launch/can/mirrorwave.dbc", "launch/can/mirrorwave.yaml"


class Params(BusParams, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """CAN bus of the car, and its motion."""

    formerly: ClassVar[dict[str, str]] = {"": "nodes.car_sim"}

    #: The car moves as the ego vehicle of this scene.
    scene: str | None = None
    #: Motion without a scene; if given, it overrides the scene's.
    speed_mps: float | None = None
    yaw_rate_rps: float | None = None


class CarSim(Node):
    """Constant motion -> CAN frames at the periods of the mapping."""

    def __init__(self, link: CanLink, car: SimulatedCar, motion: VehicleState) -> None:
        super().__init__()
        self._link, self._car, self._motion = link, car, motion
        self.sent = self.refused = 0

    def due_ns(self, now_ns: int) -> int:
        """Return the time of the next frame."""
        return self._car.due_ns()

    def step(self, inputs: list[Received], now_ns: int) -> list[Outgoing]:
        """Send the frames whose time has come."""
        for frame in self._car.frames(msgspec.structs.replace(self._motion, stamp_ns=now_ns)):
            if self._link.send(bus_frame(frame.arbitration_id, frame.data, frame.extended, now_ns), now_ns):
                self.sent += 1
            else:
                self.refused += 1
        return []

    def health(self) -> tuple[NodeState, str]:
        """Return DEGRADED while the bus takes no frames."""
        if self._link.trouble:
            return NodeState.DEGRADED, f"{self._link.trouble}; {counted(self.refused, 'frame')} not sent"
        return NodeState.READY, ""

    def close(self) -> None:
        """Close the bus."""
        self._link.close()


def motion_of(params: Params) -> VehicleState:
    """Return speed, yaw rate and the corresponding steering."""
    speed_mps, yaw_rate_rps = params.speed_mps, params.yaw_rate_rps
    if params.scene is not None:
        # imported here: a car whose motion is given needs no simulator
        from sim_player.scene.description import load_scene

        ego = load_scene(Path(params.scene)).ego
        speed_mps = ego.speed_mps if speed_mps is None else speed_mps
        yaw_rate_rps = math.radians(ego.yaw_rate_dps) if yaw_rate_rps is None else yaw_rate_rps
    speed_mps, yaw_rate_rps = speed_mps or 0.0, yaw_rate_rps or 0.0
    return VehicleState(
        stamp_ns=0, speed_mps=speed_mps, yaw_rate_rps=yaw_rate_rps, steering_rad=steering_rad(speed_mps, yaw_rate_rps),
        wheel_speed_difference_mps=TRACK_M * yaw_rate_rps,
    )  # fmt: skip


def create(params: Params) -> CarSim:
    """Return the node; `ValueError` for files that do not fit or a motion that the DBC's bits cannot hold."""
    database, mapping = load_dbc(shipped_path(DBC)), load_mapping(shipped_path(MAPPING))
    motion = motion_of(params)
    # an invalid motion is refused here, not while driving
    SimulatedCar(database, mapping).frames(motion)
    return CarSim(CanLink(params), SimulatedCar(database, mapping), motion)
