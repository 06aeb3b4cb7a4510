"""How likely a folded place is true: a logistic model of how it came about, fitted on simulated scenes.

A true image passes well within its wall, is strong, has company, and lands where the radar cannot see; a false one
misses the wall's end, lands in plain view, or shares its range with something stronger.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import msgspec
import numpy as np
from scipy.spatial import cKDTree

from models.perception.association import DirectReturns, Passing, RecoveryParams
from models.perception.mirrors import WallArrays, behind_walls, wall_arrays
from models.perception.recovery import Recovered
from models.physics.mirror import segment_distance_m
from msgs.frames import polar_from_xy
from msgs.perception import Wall

#: What the model sees of a place, in order; see `place_features`.
FEATURES = (
    "score_logit",
    "snr_db",
    "missed_m",
    "missed_sigmas",
    "log_depth_m",
    "twice",
    "walls_nearer",
    "walls_farther",
    "log_wall_length_m",
    "wall_angle_std_rad",
    "curved",
    "log_wall_returns",
    "near_return_1m",
    "near_return_2m",
    "near_return_4m",
    "behind_wall",
    "open_and_empty",
    "on_wall",
    "outside_view",
    "log_image_range_m",
    "log_range_m",
    "support_other_walls",
    "log_company",
    "log_sigma_m",
    "stronger_db",
)
#: The radar's half field of view.
VIEW_RAD = math.radians(60.0)
#: Range within which an echo may be another's side lobe.
SAME_RANGE_M = 0.5
#: Distances at which places support each other: of other walls, of the same.
SUPPORT_M, COMPANY_M = 1.0, 2.0


@dataclass(frozen=True)
class _Seen:
    recovered: Recovered
    walls: WallArrays
    returns: DirectReturns
    params: RecoveryParams


def place_features(
    recovered: Recovered, walls: list[Wall], returns: DirectReturns, params: RecoveryParams
) -> np.ndarray:
    seen = _Seen(recovered, wall_arrays(walls), returns, params)
    columns = {**_echo(seen), **_fold(seen), **_mirror(seen), **_surroundings(seen), **_company(seen)}
    return np.column_stack([np.asarray(columns[name], np.float64) for name in FEATURES]).reshape(-1, len(FEATURES))


def _echo(seen):
    recovered = seen.recovered
    score = np.clip(recovered.score, 0.01, 0.99)
    image_range_m, _ = polar_from_xy(recovered.images_m)
    return_range_m, _ = polar_from_xy(seen.returns.points_m)
    alike = np.abs(image_range_m[:, None] - return_range_m) < SAME_RANGE_M
    stronger = np.where(alike, seen.returns.snr_db - recovered.snr_db[:, None], 0.0).max(axis=1, initial=0.0)
    return {
        "score_logit": np.log(score / (1.0 - score)),
        "snr_db": np.clip(recovered.snr_db, 0.0, 60.0),
        "log_image_range_m": np.log(np.maximum(image_range_m, 1.0)),
        "stronger_db": np.minimum(stronger, 40.0),
    }


def _of_wall(values, wall):
    padded = np.hstack([values, np.zeros((len(values), 1))])
    return padded[np.arange(len(wall)), wall]


def _fold(seen):
    recovered, walls = seen.recovered, seen.walls
    image_range_m, _ = polar_from_xy(recovered.images_m)
    sigma_m = np.sqrt(np.trace(recovered.image_covariance_m2, axis1=1, axis2=2))
    passing = Passing.of(recovered.images_m, sigma_m / np.maximum(image_range_m, 1.0), walls)
    at = lambda values: np.nan_to_num(_of_wall(values, recovered.wall))
    missed_m = np.minimum(at(passing.missed_m), 4.0)
    sideways_m = np.maximum(at(passing.sideways_m), 0.3)
    to_wall_m = at(passing.to_wall_m)[:, None]
    long = walls.length_m > seen.params.vehicle_length_m
    passed = long & (passing.missed_m == 0.0) & passing.behind(seen.params.min_depth_m)
    return {
        "missed_m": missed_m,
        "missed_sigmas": np.minimum(missed_m / sideways_m, 4.0),
        "log_depth_m": np.log(np.clip(at(passing.depth_m), 0.5, 50.0)),
        "twice": recovered.second >= 0,
        "walls_nearer": np.minimum((passed & (passing.to_wall_m < to_wall_m - 1.0)).sum(1), 3),
        "walls_farther": np.minimum((passed & (passing.to_wall_m > to_wall_m + 1.0)).sum(1), 3),
    }


def _mirror(seen):
    wall, walls = seen.recovered.wall, seen.walls
    at = lambda values: np.append(values, 0.0)[wall]
    counts = np.bincount(seen.returns.wall[seen.returns.wall >= 0], minlength=len(walls)) if len(walls) else np.zeros(0)
    return {
        "log_wall_length_m": np.log(np.maximum(at(walls.length_m), 1.0)),
        "wall_angle_std_rad": np.minimum(at(walls.angle_std_rad), 0.2),
        "curved": at(walls.curvature_per_m) != 0.0,
        "log_wall_returns": np.log1p(at(counts)),
    }


def _surroundings(seen):
    points_m, walls, returns, params = seen.recovered.points_m, seen.walls, seen.returns, seen.params
    long = walls.length_m > params.vehicle_length_m
    on_long = np.append(long, False)[returns.wall]
    loose_m, any_m = _nearest_m(points_m, returns.points_m[~on_long]), _nearest_m(points_m, returns.points_m)
    hidden = behind_walls(points_m, walls.select(long), params.cut_depth_m)
    lw = walls.select(long)
    on_wall = np.logical_or.reduce(segment_distance_m(points_m, lw.a, lw.b) <= params.same_place_m, axis=1)
    range_m, azimuth_rad = polar_from_xy(points_m)
    outside = np.abs(azimuth_rad) > VIEW_RAD
    return {
        "near_return_1m": loose_m < 1.0,
        "near_return_2m": loose_m < 2.0,
        "near_return_4m": loose_m < 4.0,
        "behind_wall": hidden,
        "open_and_empty": ~hidden & ~outside & (any_m > 2.0),
        "on_wall": on_wall,
        "outside_view": outside,
        "log_range_m": np.log(np.maximum(range_m, 1.0)),
        "log_sigma_m": 0.5 * np.log(np.maximum(np.trace(seen.recovered.covariance_m2, axis1=1, axis2=2), 1e-4)),
    }


def _nearest_m(points_m, others_m):
    if len(others_m) == 0:
        return np.full(len(points_m), 99.0)
    return cKDTree(others_m).query(points_m)[0] if len(points_m) else np.zeros(0)


def _company(seen):
    r = seen.recovered
    distance_m = np.linalg.norm(r.points_m[:, None] - r.points_m, axis=-1)
    same = (r.wall[:, None] == r.wall) & (r.second[:, None] == r.second)
    other = np.where(same, 0.0, r.score * np.exp(-((distance_m / SUPPORT_M) ** 2)))
    mates = (same & (distance_m < COMPANY_M)).sum(axis=1) - 1
    return {"support_other_walls": other.max(axis=1, initial=0.0), "log_company": np.log1p(mates)}
