"""Rejection of folded positions that directly visible objects explain; they stay among the points."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from models.perception.mirrors.clustering import NOISE, dbscan, fits_box
from models.perception.mirrors.image_walls import CUT_DEPTH_M, DirectReturns, RecoveryParams
from models.perception.mirrors.mirror_table import NO_WALL, WallArrays, behind_walls, wall_arrays
from models.perception.mirrors.recovery import Recovered
from models.physics.plane import segment_distance_m
from msgs.values.frames import polar_from_xy
from msgs.values.perception import Wall

#: Walls hide this much more than their ends show: a return may be missed.
OPEN_VIEW_MARGIN_M = 2.5
#: Direct returns count as the same object if at most this much weaker than the image.
COMPARABLE_DB = 6.0
#: Direct returns this near each other may be of one vehicle.
VEHICLE_EPS_M = 2.5

#: A return past a point lies so near its direction and so much farther, one before it likewise nearer.
PAST_RAD, PAST_M = math.radians(4.0), 2.0
BEFORE_RAD, BEFORE_M = math.radians(8.0), 0.5


def hidden_mask(recovered: Recovered, walls: list[Wall], returns: DirectReturns, params: RecoveryParams) -> np.ndarray:
    """Return which folded positions nothing in direct sight explains; bool [N].

    Explained are those without score, on a wall, at a direct return of like strength, in one vehicle with a group of
    these, and, with `reject_in_open_view`, those that nothing hides.
    """
    explained = recovered.score <= 0.0
    reach_m = params.same_place_m + params.same_place_sigmas * recovered.largest_std_m
    if params.reject_in_open_view:
        explained |= ~_behind_something(recovered, walls, returns, params)
    arrays = wall_arrays(walls)
    to_walls_m = segment_distance_m(recovered.points_m, arrays.a, arrays.b)
    explained |= np.logical_or.reduce(to_walls_m <= reach_m[:, None], axis=1)
    if len(returns.points_m):
        distance_m = np.linalg.norm(recovered.points_m[:, None] - returns.points_m, axis=-1)  # [N, M]
        alike = returns.snr_db >= recovered.snr_db[:, None] - COMPARABLE_DB
        alike &= _may_move_alike(recovered, returns, params)
        explained |= (alike & (distance_m <= reach_m[:, None])).any(axis=1)
        explained |= _on_visible_vehicle(recovered, arrays, returns, params)
    return ~explained


def _behind_something(
    recovered: Recovered, walls: list[Wall], returns: DirectReturns, params: RecoveryParams
) -> np.ndarray:
    """Return the positions that a wall, lengthened by the margin, or a vehicle's returns hide; bool [N]."""
    behind = ~in_open_view(recovered.points_m, walls, OPEN_VIEW_MARGIN_M)
    range_m, azimuth_rad = polar_from_xy(recovered.points_m)
    for group in _vehicle_groups(wall_arrays(walls), returns, params):
        group_range_m, group_azimuth_rad = polar_from_xy(returns.points_m[group])
        if fits_box(returns.points_m[group], params.vehicle_length_m, params.vehicle_width_m):
            between = (azimuth_rad > group_azimuth_rad.min()) & (azimuth_rad < group_azimuth_rad.max())
            behind |= between & (range_m > group_range_m.max() + params.same_place_m)
    return behind


def _vehicle_groups(walls: WallArrays, returns: DirectReturns, params: RecoveryParams) -> list[np.ndarray]:
    """Return the indices of each group of near returns off the long walls, with the others on their short walls."""
    long_walls = walls.length_m > params.vehicle_length_m + 1.0
    loose = np.flatnonzero(~np.append(long_walls, False)[returns.wall])
    labels = dbscan(returns.points_m[loose], VEHICLE_EPS_M, 2)
    return [_with_whole_walls(loose[labels == label], returns) for label in range(int(labels.max(initial=NOISE)) + 1)]


def _may_move_alike(recovered: Recovered, returns: DirectReturns, params: RecoveryParams) -> np.ndarray:
    """Return whether an image and a direct return are alike in moving by their radial speeds; bool [N, M]."""
    if params.moving_mps is None or returns.radial_speed_mps is None:
        return np.ones((len(recovered), len(returns.points_m)), bool)
    image_mps, return_mps = recovered.radial_speed_mps[:, None], returns.radial_speed_mps
    unlike = (np.abs(image_mps) > params.moving_mps) != (np.abs(return_mps) > params.moving_mps)
    return ~unlike | np.isnan(image_mps) | np.isnan(return_mps)


def _on_visible_vehicle(
    recovered: Recovered, walls: WallArrays, returns: DirectReturns, params: RecoveryParams
) -> np.ndarray:
    """Return the positions that are another side of a visible vehicle; bool [N].

    A group of direct returns off the long walls in a vehicle's box, in which the position fits by its own error.
    """
    long_walls = walls.length_m > params.vehicle_length_m + 1.0
    sigma_m = np.sqrt(np.linalg.eigvalsh(recovered.image_covariance_m2)[:, 1])
    explained = np.zeros(len(recovered), bool)
    for group in _vehicle_groups(walls, returns, params):
        points_m = returns.points_m[group]
        near = np.abs(recovered.points_m - points_m.mean(axis=0)).max(axis=1) <= 2.0 * params.vehicle_length_m
        near &= recovered.snr_db <= returns.snr_db[group].max() + COMPARABLE_DB
        candidates = np.flatnonzero(near & ~explained)
        # most groups do not fit by themselves: then no further point fits
        slack_m = sigma_m[candidates].max(initial=0.0)
        if not fits_box(points_m, params.vehicle_length_m + slack_m, params.vehicle_width_m + slack_m):
            continue
        for i in candidates:
            together = np.vstack([points_m, recovered.points_m[i]])
            length_m, width_m = params.vehicle_length_m + sigma_m[i], params.vehicle_width_m + sigma_m[i]
            explained[i] = fits_box(together, length_m, width_m)
    return explained & ~behind_walls(recovered.points_m, walls.take(long_walls), CUT_DEPTH_M)


def _with_whole_walls(group: np.ndarray, returns: DirectReturns) -> np.ndarray:
    """Return a group's returns and all others on its walls: a missed return must not split one front into two."""
    # one more entry, at the end, for the returns on no wall (-1)
    touched = np.zeros(returns.wall.max(initial=NO_WALL) + 2, bool)
    touched[returns.wall[group]] = True
    touched[NO_WALL] = False
    together = touched[returns.wall]
    together[group] = True
    return np.flatnonzero(together)


def in_open_view(points_m: np.ndarray, walls: list[Wall], margin_m: float) -> np.ndarray:
    """Return the points [N, 2] that no wall hides, each lengthened by `margin_m` at both ends; bool [N]."""
    arrays = wall_arrays(walls)
    outward = margin_m * (arrays.b - arrays.a) / np.maximum(arrays.length_m, 1e-9)[:, None]
    longer = replace(arrays, a=arrays.a - outward, b=arrays.b + outward)
    return ~behind_walls(points_m, longer, 0.0)


def in_plain_sight(points_m: np.ndarray, walls: list[Wall], returns: DirectReturns) -> np.ndarray:
    """Return the points [N, 2] that the radar looks past: a direct return lies farther on in their direction, and
    neither a wall nor a return stands before them; bool [N].
    """
    range_m, azimuth_rad = (values[:, None] for values in polar_from_xy(points_m))
    return_range_m, return_azimuth_rad = polar_from_xy(returns.points_m)
    apart_rad = np.abs(azimuth_rad - return_azimuth_rad)
    past = (apart_rad <= PAST_RAD) & (return_range_m > range_m + PAST_M)
    before = (apart_rad <= BEFORE_RAD) & (return_range_m < range_m - BEFORE_M)
    return in_open_view(points_m, walls, OPEN_VIEW_MARGIN_M) & past.any(axis=1) & ~before.any(axis=1)
