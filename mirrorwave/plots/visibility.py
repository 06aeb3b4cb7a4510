"""Sight in the true scene: the area seen directly, and the part of a mirror's area that true walls leave free."""

from __future__ import annotations

import numpy as np

from models.physics.mirror import blocked, crossing_parameters, specular_points
from msgs.values.frames import xy_from_polar
from msgs.values.perception import SceneTruth, Wall

#: Steps of the field of view, and the angle to either side of a wall's end.
AZIMUTH_STEP_RAD, END_RAD = np.radians(0.25), 1e-6
#: A fitted wall stands this near its true one: crossings so near to a mirror are the mirror itself.
MIRROR_TOLERANCE_M = 1.0
ORIGIN = np.zeros(2)


def true_segments(truth: SceneTruth) -> tuple[np.ndarray, np.ndarray]:
    """Return both ends of all pieces of all true walls, [M, 2] each in metres; an arc is the chord of its ends."""
    lines = [np.array(surface.polyline_m, np.float64).reshape(-1, 2) for surface in truth.surfaces]
    starts, ends = [line[:-1] for line in lines], [line[1:] for line in lines]
    none = np.zeros((0, 2))
    return np.concatenate([none, *starts]), np.concatenate([none, *ends])


def direct_sight(a: np.ndarray, b: np.ndarray, reach_m: float, limit_rad: float) -> np.ndarray:
    """Return the polygon [N, 2] in metres that the radar at the origin sees past walls a -> b [M, 2].

    It spans azimuths up to `limit_rad` to either side and ends at the nearest wall or at `reach_m`. Every wall ends
    sight, whatever it is made of; vehicles do not.
    """
    sweep = np.linspace(-limit_rad, limit_rad, int(np.ceil(2.0 * limit_rad / AZIMUTH_STEP_RAD)) + 1)
    ends = np.concatenate([a, b])
    corners = np.arctan2(ends[:, 1], ends[:, 0])
    azimuth = np.concatenate([sweep, corners - END_RAD, corners + END_RAD])
    azimuth = np.unique(azimuth[np.abs(azimuth) <= limit_rad])
    far = xy_from_polar(np.full(len(azimuth), reach_m), azimuth)
    share = np.ones(len(azimuth))
    if len(a):
        along_ray, along_wall = crossing_parameters(ORIGIN, far, a, b)
        met = (along_ray > 0.0) & (along_wall >= 0.0) & (along_wall <= 1.0)
        share = np.minimum(1.0, np.where(met, along_ray, 1.0).min(axis=1))
    return np.concatenate([ORIGIN[None], share[:, None] * far])


def mirror_sight(points_m: np.ndarray, walls: tuple[Wall, ...], a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return which points [N, 2] some wall shows by a path that no true wall a -> b [M, 2] cuts; bool [N].

    Crossings within 1 m of the specular point are the mirror's own true wall. An arc is taken as its chord.
    """
    visible = np.zeros(len(points_m), bool)
    for wall in walls:
        at = specular_points(ORIGIN, points_m, *np.array(wall.ends_m))
        rows = np.flatnonzero(~np.isnan(at[:, 0]) & ~visible)
        at, target = at[rows], points_m[rows]
        occluded = blocked(np.zeros_like(at), _towards(at, np.zeros_like(at)), a, b)
        occluded |= blocked(_towards(at, target), target, a, b)
        visible[rows] = ~occluded
    return visible


def _towards(start: np.ndarray, end: np.ndarray) -> np.ndarray:
    """Points [N, 2] the tolerance away from `start` towards `end`, `end` where that is nearer."""
    offset = end - start
    length_m = np.linalg.norm(offset, axis=1, keepdims=True)
    return start + offset * np.minimum(MIRROR_TOLERANCE_M / np.maximum(length_m, 1e-12), 1.0)
