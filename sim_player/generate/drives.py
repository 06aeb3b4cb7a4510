"""Random drives from a seed: the places of `sim_player.generate.places` with the radar and road users in motion.

All keep heading (the radar its yaw rate) and speed, which is lowered until nobody runs into a wall or another.
"""

from __future__ import annotations

import dataclasses
import math

import numpy as np
from msgspec.structs import replace

from models.physics.plane import segment_distance_m
from msgs.values.vehicle import ego_motion
from sim_player.generate.layouts import PlaceKind
from sim_player.generate.placement import Walls
from sim_player.generate.places import MAX_SPEED_MPS, RADAR_ROOM_M, WALL_ROOM_M, Place, draw_place
from sim_player.generate.wall_kinds import Preset
from sim_player.scene.description import OBJECT_KINDS, Ego, Scene, SceneObject

#: Share of each class among road users that are not parked. An assumption, no count: mostly cars, one in eight on foot.
#: Small ones fit more easily out of sight, so that about one in five hidden road users is a pedestrian (places at
#: rest: one in three).
STREET_MIX = {"car": 0.55, "van": 0.13, "truck": 0.08, "bus": 0.04, "bicycle": 0.08, "pedestrian": 0.12}
#: Shares of a drawn speed that are tried in turn; what fits none of them stands.
SPEED_SHARES = (1.0, 0.8, 0.6, 0.45, 0.3, 0.2, 0.1)
#: Speeds and yaw rates drawn for the radar until it need not stand.
EGO_ATTEMPTS = 4
MAX_EGO_SPEED_MPS, MAX_YAW_RATE_DPS = 15.0, 10.0
#: Distance that moving road users keep from walls and others, beyond their discs.
ROOM_M = 0.1
#: Greatest way between two looks.
STEP_M = 0.5

#: Discs of one road user over the drive: centres [times, discs, 2] and their radius.
Discs = tuple[np.ndarray, float]


def draw_drive(seed: int, index: int, preset: Preset, duration_s: float, kind: PlaceKind | None = None) -> Place:
    """Return place `index` of series `seed` in motion for `duration_s`, by `STREET_MIX`; ValueError as `draw_place`."""
    if not duration_s > 0.0:
        raise ValueError(f"duration_s must be positive, got {duration_s!r}")
    place = draw_place(seed, index, preset, kind, class_mix=STREET_MIX)
    rng = np.random.default_rng([seed, index, 13])
    traffic = _Traffic(place.scene, duration_s)
    ego = traffic.start_radar(rng)
    objects = [
        road_user if number < place.parked else traffic.set_in_motion(rng, number)
        for number, road_user in enumerate(place.scene.objects)
    ]
    scene = replace(place.scene, name=f"drive_{place.scene.name}", objects=tuple(objects), ego=ego)
    return dataclasses.replace(place, scene=scene)


class _Traffic:
    """All road users and the radar over the time of a drive, at rest until they are set in motion."""

    def __init__(self, scene: Scene, duration_s: float) -> None:
        fastest_mps = max(MAX_EGO_SPEED_MPS, *MAX_SPEED_MPS.values())
        self.time_s = np.linspace(0.0, duration_s, math.ceil(fastest_mps * duration_s / STEP_M) + 1)
        walls = tuple(surface for surface in scene.surfaces if surface.role != "ground")
        self._walls = Walls.of(walls).footing
        self._objects = list(scene.objects)
        self._discs = [self._discs_of(road_user) for road_user in scene.objects]
        self._radar_m = np.zeros((len(self.time_s), 2))

    def start_radar(self, rng: np.random.Generator) -> Ego:
        """Return the radar's motion through all that stands, and let it go so."""
        for _ in range(EGO_ATTEMPTS):
            speed_mps = rng.uniform(0.0, MAX_EGO_SPEED_MPS)
            yaw_rate_dps = rng.uniform(-MAX_YAW_RATE_DPS, MAX_YAW_RATE_DPS)
            for share in SPEED_SHARES:
                ego = Ego(speed_mps=float(share * speed_mps), yaw_rate_dps=float(yaw_rate_dps))
                poses = [ego_motion(ego.speed_mps, math.radians(ego.yaw_rate_dps), at_s) for at_s in self.time_s]
                way_m = np.array([(pose.x_m, pose.y_m) for pose in poses])
                if segment_distance_m(way_m, *self._walls).min(initial=np.inf) < WALL_ROOM_M:
                    continue
                if all(_nearest_m(way_m[:, None], discs) > RADAR_ROOM_M for discs in self._discs):
                    self._radar_m = way_m
                    return ego
        return Ego()

    def set_in_motion(self, rng: np.random.Generator, number: int) -> SceneObject:
        """Set a road user in motion, either way along its heading, at the greatest share of a drawn speed."""
        at_rest = self._objects[number]
        speed_mps = float(rng.uniform(0.0, MAX_SPEED_MPS[str(at_rest.class_)]))
        turns_deg = rng.permutation([0.0, 180.0])
        for share in SPEED_SHARES:
            for turn_deg in turns_deg:
                yaw_deg = math.remainder(at_rest.yaw_deg + float(turn_deg), 360.0)
                moving = replace(at_rest, yaw_deg=yaw_deg, speed_mps=share * speed_mps)
                if self._allows(number, discs := self._discs_of(moving)):
                    self._discs[number] = discs
                    return moving
        return at_rest

    def _allows(self, number: int, discs: Discs) -> bool:
        """Return whether a road user can move so."""
        centres_m, radius_m = discs
        if segment_distance_m(centres_m.reshape(-1, 2), *self._walls).min(initial=np.inf) < radius_m + ROOM_M:
            return False
        if _nearest_m(self._radar_m[:, None], discs) < RADAR_ROOM_M:
            return False
        rest = (other for index, other in enumerate(self._discs) if index != number)
        return all(_nearest_m(centres_m, other) > radius_m + ROOM_M for other in rest)

    def _discs_of(self, road_user: SceneObject) -> Discs:
        """Return the discs that cover a road user's outline, in a row along it."""
        size = OBJECT_KINDS[str(road_user.class_)]
        count = math.ceil(size.length_m / size.width_m)
        along_m = (np.arange(count) + 0.5) * (size.length_m / count) - 0.5 * size.length_m
        yaw_rad = math.radians(road_user.yaw_deg)
        heading = np.array([math.cos(yaw_rad), math.sin(yaw_rad)])
        way_m = np.array([road_user.x_m, road_user.y_m]) + road_user.speed_mps * self.time_s[:, None] * heading
        return way_m[:, None] + along_m[:, None] * heading, 0.5 * math.hypot(size.width_m, size.length_m / count)


def _nearest_m(points_m: np.ndarray, discs: Discs) -> float:
    """Return the least distance of points [times, N, 2] from discs at the same times."""
    centres_m, radius_m = discs
    return float(np.linalg.norm(points_m[:, :, None] - centres_m[:, None], axis=-1).min() - radius_m)
