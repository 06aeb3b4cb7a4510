"""One evaluation for every sensor: peaks over the noise, folded back in the true walls, held against the same truth.

Privileged as the CFAR-NLOS baseline of section 4.1: the walls are known. What lies behind one is an image.
"""

from __future__ import annotations

import math
from itertools import pairwise

import msgspec
import numpy as np

from lab.compare.comparison_scenes import ShownPoints
from lab.compare.sensors import GRID, Sight
from lab.measures.point_scores import Counts, recovered_counts
from models.perception.find.peaks import echo_power, peaks_at
from models.perception.find.ridges import find_ridges
from models.perception.mirrors.clustering import dbscan
from models.perception.mirrors.image_walls import MIN_DEPTH_M, DirectReturns, RecoveryParams
from models.perception.mirrors.mirror_table import behind_walls, wall_arrays
from models.perception.mirrors.recovery import recover
from models.perception.mirrors.rejection import hidden_mask
from models.physics.materials import is_volume
from models.physics.mirror import wall_from_ends
from models.physics.plane import segment_distance_m
from msgs.values.frames import polar_from_xy, xy_from_polar
from msgs.values.perception import PathClass, Peaks, Wall
from msgs.values.units import db_from_ratio
from sim_player.scene.description import Scene, SceneObject

#: Gates of the recovered F1, and how near an object a point counts as having found it.
GATES_M, OBJECT_GATE_M = (1.0, 2.0), 2.0
#: The strongest cell is looked for so near an image.
NEAR_RANGE_M, NEAR_AZIMUTH_RAD = 1.0, math.radians(1.0)
#: A place so near a true wall is that wall, seen in another one.
RECOVERY = RecoveryParams(same_place_m=0.5)


class Score(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """One scan of one sensor against the truth."""

    #: True positives, false positives, false negatives of `recovered_counts` within 1 m and 2 m.
    within_1m: tuple[int, int, int]
    within_2m: tuple[int, int, int]
    #: Hidden objects, and those with a recovered point within `OBJECT_GATE_M` of their box.
    hidden: int
    found: int
    #: Groups of recovered points none of which is that near to any object that a mirror shows.
    false_objects: int
    #: Strongest cell at the images over the mean noise [dB]; None where there is no image.
    snr_db: float | None


def found_peaks(sight: Sight) -> Peaks:
    """Ridges of a map over the threshold of its noise, side lobes left out; all of class LOS."""
    ra_map = sight.ra_map
    power = echo_power(ra_map)
    range_m = ra_map.grid.range_m
    loud, has_lobes = power > sight.threshold, ra_map.mode != "photons"
    cells, fractional = find_ridges(power, loud, ra_map.noise_power_mw, range_m, sight.ridges, has_lobes)
    score = power[cells[:, 0], cells[:, 1]] / ra_map.noise_power_mw
    return peaks_at(ra_map, cells, fractional, score, np.full(len(cells), PathClass.LOS, np.uint8), sight.peaks)


def true_walls(scene: Scene) -> list[Wall]:
    """The upright walls of a scene as recovery knows them; foliage mirrors nothing and is none."""
    walls = []
    for surface in scene.surfaces:
        if surface.role == "ground" or is_volume(surface.material):
            continue
        for a, b in pairwise(surface.polyline_m):
            normal, offset_m = wall_from_ends(np.array(a), np.array(b), np.zeros(2))
            left = normal @ np.array([a[1] - b[1], b[0] - a[0]]) > 0.0
            wall = Wall(
                normal=(float(normal[0]), float(normal[1])),
                offset_m=offset_m,
                ends_m=(a, b),
                inliers=0,
                curvature_per_m=surface.curvature_per_m if left else -surface.curvature_per_m,
            )
            walls.append(wall)
    return walls


def recovered_places(peaks: Peaks, scene: Scene) -> np.ndarray:
    """Places [N, 2] of all peaks behind a true wall, folded back in the one their ray meets, Eq. (19); no walls."""
    walls = true_walls(scene)
    points_m = xy_from_polar(peaks.range_m, peaks.azimuth_rad)
    images = behind_walls(points_m, wall_arrays(walls), MIN_DEPTH_M)
    path_class = np.where(images, PathClass.MIRRORED, PathClass.LOS).astype(np.uint8)
    nothing = DirectReturns(np.zeros((0, 2)), np.zeros(0), np.zeros(0, np.int64), np.zeros(0, np.int64))
    recovered = recover(msgspec.structs.replace(peaks, path_class=path_class), walls, nothing, RECOVERY)
    return recovered.points_m[hidden_mask(recovered, walls, nothing, RECOVERY)]


def score(sight: Sight, scene: Scene, truth: ShownPoints) -> Score:
    """All figures of one scan."""
    places_m = recovered_places(found_peaks(sight), scene)
    within_1m, within_2m = (_triple(recovered_counts(places_m, truth.position_m, gate_m)) for gate_m in GATES_M)
    near = {
        object_index: _near_box(places_m, scene.objects[object_index])
        for object_index in sorted(set(truth.object_index.tolist()))
    }
    return Score(
        within_1m=within_1m,
        within_2m=within_2m,
        hidden=len(truth.hidden),
        found=sum(bool(near[object_index].any()) for object_index in truth.hidden),
        false_objects=_false_groups(
            places_m, np.logical_or.reduce(list(near.values()) or [np.zeros(len(places_m), bool)])
        ),
        snr_db=strongest_db(sight, truth),
    )


def _triple(counts: Counts) -> tuple[int, int, int]:
    return counts.true_positives, counts.false_positives, counts.false_negatives


def _near_box(places_m: np.ndarray, box: SceneObject) -> np.ndarray:
    """Return which positions [N, 2] lie in an object's box or within `OBJECT_GATE_M` of it."""
    corners = box.corners_m()
    away_m = segment_distance_m(places_m, corners, np.roll(corners, -1, axis=0)).min(axis=1)
    return np.asarray(box.contains(places_m) | (away_m <= OBJECT_GATE_M))


def _false_groups(places_m: np.ndarray, near: np.ndarray) -> int:
    """Groups of places [N, 2] without any that is near an object."""
    labels = dbscan(places_m, OBJECT_GATE_M, 1)
    return len(set(labels.tolist()) - set(labels[near].tolist()))


def strongest_db(sight: Sight, truth: ShownPoints) -> float | None:
    """Strongest cell near the images of hidden objects over the map's mean noise, dB; None without one."""
    shown = truth.image_m[np.isin(truth.object_index, list(truth.hidden))]
    if not len(shown):
        return None
    range_m, azimuth_rad = polar_from_xy(shown)
    rows = np.abs(GRID.range_m[:, None] - range_m) <= NEAR_RANGE_M
    columns = np.abs(GRID.azimuth_rad[:, None] - azimuth_rad) <= NEAR_AZIMUTH_RAD
    near = rows.astype(np.float32) @ columns.T.astype(np.float32) > 0.0
    power = echo_power(sight.ra_map)[near]
    return db_from_ratio(max(float(power.max()) / sight.ra_map.noise_power_mw, 1e-3))
