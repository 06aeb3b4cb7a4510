"""Parameters of the geometry for a radar that gives detections: many more returns than a map has peaks, unjudged.

Chosen as docs/explain/perception.md says; a wall is longer than a car, dense and straight, and what neither a wall nor
a vehicle hides is no hidden object.
"""

from __future__ import annotations

import math

import msgspec
from msgspec.structs import replace

from models.perception.mirrors.image_walls import RecoveryParams
from models.perception.mirrors.peaks_to_view import GeometryParams
from models.perception.mirrors.recovered_objects import ObjectParams
from models.perception.mirrors.walls import WallParams

DETECTION_GEOMETRY = GeometryParams(
    cluster_eps_m=3.0,
    cluster_min_points=3,
    wall_points=True,
    walls=WallParams(
        min_length_m=6.5,
        min_inliers=8,
        max_gap_m=5.0,
        sparse_gap_m=6.0,
        max_angle_std_rad=math.radians(2.0),
        flatness_m=0.15,
        corner_reach_m=0.0,
        curved=False,
        max_walls=20,
    ),
    recovery=RecoveryParams(
        reject_in_open_view=True, same_place_sigmas=2.0, moving_mps=0.6, vehicle_length_m=9.0, vehicle_width_m=3.0
    ),
    # a single return is no object: its score may not reach the least. Of objects with three or more, 24 of 47 are true,
    # whatever the scores of their points: simulated places 0 to 39 and 140 to 199 of the set `validation`
    objects=ObjectParams(min_points=3, single_min_score=1.01, score_table=((0.0, 0.0), (1.0, 0.5))),
)


class DetectionWalls(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What makes a wall."""

    #: Least returns of a wall: a radar of few targets shows fewer of them.
    min_inliers: int = DETECTION_GEOMETRY.walls.min_inliers


class DetectionGeometry(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Parameters of the geometry for a radar that gives detections."""

    walls: DetectionWalls = DetectionWalls()

    @property
    def geometry(self) -> GeometryParams:
        """All of them."""
        walls = replace(DETECTION_GEOMETRY.walls, min_inliers=self.walls.min_inliers)
        return replace(DETECTION_GEOMETRY, walls=walls)
