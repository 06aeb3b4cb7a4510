"""Walls of a map about a vehicle whose place is measured with an error: what `environment/walls` takes."""

from __future__ import annotations

import math

import msgspec
import numpy as np

from msgs.values.environment import GnssPose, WallPriors
from msgs.values.frames import Pose2, wrap_angle
from sim_player.maps.footprints import FootprintFile
from sim_player.maps.local_frame import MapPose
from sim_player.maps.map_scene import map_surfaces
from sim_player.scene.description import Scene
from sim_player.scene.wall_priors import POOR, MapErrors, scene_walls

#: Buildings about a place that are kept as walls, and how far the vehicle goes from it until others are taken: the
#: rest is the radar's reach.
TILE_M, KEPT_M = 250.0, 120.0
SOURCE = "map"


class MapWalls:
    """Walls of a map about a vehicle."""

    def __init__(self, footprints: FootprintFile) -> None:
        self._footprints = footprints
        self._tile: tuple[MapPose, Scene] | None = None

    def at(self, pose: GnssPose) -> WallPriors:
        """Return the nearest walls in the vehicle's frame; their errors are those of maps and of the pose together."""
        origin, scene = self._tile_at(pose)
        walls = scene_walls(scene, _on(origin, pose), pose.stamp_ns, seed=0)
        return msgspec.structs.replace(
            with_pose_errors(walls, POOR, pose.position_std_m, math.radians(pose.heading_std_deg)), source=SOURCE
        )

    def _tile_at(self, pose: GnssPose) -> tuple[MapPose, Scene]:
        if self._tile is not None:
            on = _on(self._tile[0], pose)
            if math.hypot(on.x_m, on.y_m) <= KEPT_M:
                return self._tile
        origin = MapPose(pose.latitude_deg, pose.longitude_deg, 0.0)
        self._tile = origin, Scene(name=SOURCE, surfaces=map_surfaces(self._footprints, origin, TILE_M))
        return self._tile


def _on(origin: MapPose, pose: GnssPose) -> Pose2:
    """Return the vehicle's pose in the frame of a place on the map."""
    ((x_m, y_m),) = origin.local(np.array([[pose.longitude_deg, pose.latitude_deg]]))
    return Pose2(float(x_m), float(y_m), wrap_angle(math.radians(origin.heading_deg - pose.heading_deg)))


def with_pose_errors(walls: WallPriors, stated: MapErrors, position_std_m: float, heading_std_rad: float) -> WallPriors:
    """Return walls whose errors are those of the map, `stated`, and of the pose that it was placed by."""
    return msgspec.structs.replace(
        walls,
        walls=tuple(
            msgspec.structs.replace(
                wall,
                offset_std_m=math.hypot(stated.offset_std_m, position_std_m),
                angle_std_rad=min(math.hypot(stated.angle_std_rad, heading_std_rad), math.pi),
                end_std_m=math.hypot(stated.end_std_m, position_std_m),
            )
            for wall in walls.walls
        ),
    )
