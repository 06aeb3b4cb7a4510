"""Several radars of one vehicle in one scene: the same world and motion, each with its mounting and its own noise."""

from __future__ import annotations

from typing import Any

import msgspec
import numpy as np

from msgs.values.frames import Pose2, wrap_angle
from msgs.values.perception import PathClass, SceneTruth, TruthObject, TruthSurface
from msgs.values.radar import RadarSetup
from msgs.values.units import s_from_ns
from msgs.values.vehicle import VehicleState
from sim_player.paths.truth import objects_of
from sim_player.player import ScenePlayer
from sim_player.scene.description import Scene

#: Between the noise seeds of two radars.
_SEED_STEP = 7919


class RadarRig:
    """The radars of a scene that names several, in one time, on bands apart; `params` of each `ScenePlayer`."""

    def __init__(self, scene: Scene, seed: int = 0, **params: Any) -> None:
        self.scene = scene
        self.players = {
            name: ScenePlayer(scene.of_radar(name), seed=seed, noise_seed=seed + number * _SEED_STEP, **params)
            for number, name in enumerate(scene.radars)
        }
        self._first = next(iter(self.players.values()))

    @property
    def setup(self) -> RadarSetup:
        """Set-up of each radar, but for its mounting."""
        return self._first.setup

    def stamp_ns(self, scan: int, beam: int = 0) -> int:
        """Return when a beam of each radar starts."""
        return self._first.stamp_ns(scan, beam)

    def described(self) -> dict[str, str]:
        """Return what the beams of the first radar were made of."""
        return self._first.described()

    def vehicle_state(self, stamp_ns: int) -> VehicleState:
        """Return the vehicle's motion, as its bus would report it."""
        return self._first.vehicle_state(stamp_ns)

    def truth(self, scan: int) -> SceneTruth:
        """Return the truth at the start of a scan in the vehicle's frame: hidden is what no radar sees directly."""
        truths = [
            _in_vehicle(player.truth(scan), self.scene.radars[name].vehicle_from_radar)
            for name, player in self.players.items()
        ]
        time_s = s_from_ns(self.stamp_ns(scan) - self.stamp_ns(0))
        paths = [player.paths(time_s) for player in self.players.values()]
        mirrored, direct = (
            frozenset().union(*(objects_of(item, kind) for item in paths))
            for kind in (PathClass.MIRRORED, PathClass.LOS)
        )
        objects = (msgspec.structs.replace(item, hidden=item.id in mirrored - direct) for item in truths[0].objects)
        points = {
            name: np.concatenate([getattr(truth, name) for truth in truths])
            for name in ("los_points_m", "mirrored_points_m", "hidden_points_m", "hidden_object")
        }
        return msgspec.structs.replace(truths[0], objects=tuple(objects), **points)


def _in_vehicle(truth: SceneTruth, pose: Pose2) -> SceneTruth:
    """Return a radar's truth in the vehicle's frame, `pose` the radar's there; heights stay over the antenna."""

    def moved(points_m: np.ndarray) -> np.ndarray:
        xy = pose.apply(points_m[:, :2].astype(np.float64))
        return np.column_stack([xy, points_m[:, 2]]).astype(np.float32)

    return msgspec.structs.replace(
        truth,
        los_points_m=moved(truth.los_points_m),
        mirrored_points_m=moved(truth.mirrored_points_m),
        hidden_points_m=moved(truth.hidden_points_m),
        objects=tuple(_moved_object(item, pose) for item in truth.objects),
        surfaces=tuple(_moved_surface(item, pose) for item in truth.surfaces),
    )


def _moved_object(item: TruthObject, pose: Pose2) -> TruthObject:
    x_m, y_m = pose.apply(np.array([item.x_m, item.y_m])).tolist()
    vx, vy = pose.rotate(np.array([item.velocity_x_mps, item.velocity_y_mps])).tolist()
    yaw_rad = wrap_angle(item.yaw_rad + pose.yaw_rad)
    return msgspec.structs.replace(item, x_m=x_m, y_m=y_m, yaw_rad=yaw_rad, velocity_x_mps=vx, velocity_y_mps=vy)


def _moved_surface(item: TruthSurface, pose: Pose2) -> TruthSurface:
    polyline_m = pose.apply(np.array(item.polyline_m)).tolist()
    return msgspec.structs.replace(item, polyline_m=tuple((x_m, y_m) for x_m, y_m in polyline_m))
