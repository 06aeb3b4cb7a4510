"""Walls of a scene as a map would know them: exact, or with errors and gaps; vehicle frame."""

from __future__ import annotations

import math
from itertools import pairwise
from typing import Literal

import msgspec
import numpy as np

from msgs.values.environment import (
    MAX_PRIOR_WALLS,
    MAX_WALL_DISTANCE_M,
    MAX_WALL_LENGTH_M,
    MIN_WALL_LENGTH_M,
    PriorWall,
    WallPriors,
)
from msgs.values.frames import Pose2
from sim_player.scene.description import Scene, Surface
from sim_player.scene.world import vehicle_pose

#: What a scene tells of its walls: nothing, all of them as they are, or as a poor map has them.
WallKnowledge = Literal["none", "true", "noisy"]


class MapErrors(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Standard deviations of a map's walls, independent from wall to wall, and the share of walls it lacks."""

    offset_std_m: float = 0.2
    angle_std_rad: float = math.radians(0.5)
    end_std_m: float = 0.5
    missing_share: float = 0.2


#: Straight walls stand for an arc within this distance.
SAGITTA_M = 0.05
#: Errors that are stated with exact walls: none is zero, and a scan's own errors are larger.
EXACT = MapErrors(offset_std_m=0.01, angle_std_rad=math.radians(0.05), end_std_m=0.05, missing_share=0.0)
POOR = MapErrors()


def known_walls(scene: Scene, time_s: float, stamp_ns: int, seed: int, knowledge: WallKnowledge) -> WallPriors:
    """Return what a scene tells of its walls, `true` or `noisy`, so long after its start."""
    errors = POOR if knowledge == "noisy" else None
    return scene_walls(scene, vehicle_pose(scene, time_s), stamp_ns, seed, errors)


def scene_walls(
    scene: Scene, start_from_vehicle: Pose2, stamp_ns: int, seed: int, errors: MapErrors | None = None
) -> WallPriors:
    """Return the nearest walls about the vehicle, straight pieces, with a map's `errors` by the seed; None: exact."""
    stated = EXACT if errors is None else errors
    pieces = [
        _drawn(np.array(ends_m), errors, [seed, 31, number, piece])
        for number, surface in enumerate(scene.surfaces)
        if surface.role != "ground"
        for piece, ends_m in enumerate(pairwise(_vertices_m(surface)))
    ]
    to_vehicle = start_from_vehicle.inverse()
    walls = [to_vehicle.apply(ends_m) for ends_m in pieces if ends_m is not None]
    fitting = (
        ends_m
        for ends_m in walls
        if MIN_WALL_LENGTH_M <= float(np.hypot(*(ends_m[1] - ends_m[0]))) <= MAX_WALL_LENGTH_M
        and (np.abs(ends_m) <= MAX_WALL_DISTANCE_M).all()
    )
    nearest = sorted(fitting, key=_distance_m)[:MAX_PRIOR_WALLS]
    return WallPriors(
        stamp_ns=stamp_ns,
        source="scene",
        walls=tuple(
            PriorWall(
                ends_m=((float(ax), float(ay)), (float(bx), float(by))),
                offset_std_m=stated.offset_std_m,
                angle_std_rad=stated.angle_std_rad,
                end_std_m=stated.end_std_m,
            )
            for (ax, ay), (bx, by) in nearest
        ),
    )


def _vertices_m(surface: Surface) -> list[np.ndarray]:
    """Return the ends of the straight walls that stand for a surface, in order; of arcs those of short chords."""
    line_m = np.array(surface.polyline_m)
    if surface.curvature_per_m == 0.0:
        return list(line_m)
    return [line_m[0], *(point for a, b in pairwise(line_m) for point in _chords_m(a, b, surface.curvature_per_m))]


def _chords_m(a: np.ndarray, b: np.ndarray, curvature_per_m: float) -> list[np.ndarray]:
    """Return the far ends of the chords of an arc from `a` to `b`, each off the arc by `SAGITTA_M` at most."""
    along = b - a
    length_m = float(np.hypot(*along))
    count = math.ceil(length_m * math.sqrt(abs(curvature_per_m) / (8.0 * SAGITTA_M)))
    left = np.array([-along[1], along[0]]) / length_m
    share = np.arange(1, count + 1) / count
    # height of the circle over the chord, without its radius: that of a nearly straight wall is huge
    half, at = 0.5 * length_m, (share - 0.5) * length_m
    roots = np.sqrt(1.0 - (curvature_per_m * at) ** 2) + math.sqrt(1.0 - (curvature_per_m * half) ** 2)
    height_m = curvature_per_m * (at**2 - half**2) / roots
    return list(a + share[:, None] * along + height_m[:, None] * left)


def _drawn(ends_m: np.ndarray, errors: MapErrors | None, seed: list[int]) -> np.ndarray | None:
    """Return the ends [2, 2] of a wall as a map has them; None: the map lacks it."""
    if errors is None:
        return ends_m
    rng = np.random.default_rng(seed)
    is_missing = rng.random() < errors.missing_share
    across, turn, *along = rng.standard_normal(4)
    length_m = float(np.hypot(*(ends_m[1] - ends_m[0])))
    if is_missing or length_m < MIN_WALL_LENGTH_M:
        return None
    tangent = (ends_m[1] - ends_m[0]) / length_m
    angle_rad = math.atan2(tangent[1], tangent[0]) + errors.angle_std_rad * turn
    turned = np.array([math.cos(angle_rad), math.sin(angle_rad)])
    middle_m = ends_m.mean(axis=0) + errors.offset_std_m * across * np.array([-tangent[1], tangent[0]])
    # ends keep their order, however short the wall
    reach_m = np.maximum(0.5 * length_m + errors.end_std_m * np.array(along), 0.5 * MIN_WALL_LENGTH_M)
    return middle_m + np.array([[-reach_m[0]], [reach_m[1]]]) * turned


def _distance_m(ends_m: np.ndarray) -> float:
    """Return the distance of a wall from the vehicle."""
    along = ends_m[1] - ends_m[0]
    share = float(np.clip(-(ends_m[0] @ along) / (along @ along), 0.0, 1.0))
    return float(np.hypot(*(ends_m[0] + share * along)))
