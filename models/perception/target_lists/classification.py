"""Classes of returns without a map or a network: walls told by point statistics, images by the walls they lie behind.

A return is an image where its own ray crosses a wall between its ends, below the wall's top, and it lies behind it.
What is surely below the ground came by way of the ground and is left out. An image surely higher than any road user,
or among such images, is one of the building opposite, and an image in a wall that does not repeat what stands before it
is what stands behind: both are folded like any other and form no object.
"""

from __future__ import annotations

import msgspec
import numpy as np

from models.perception.find.cfar import drawn_in
from models.perception.mirrors.image_walls import associate_crossing, seen_through
from models.perception.mirrors.mirror_table import RADAR, behind_walls, hits, wall_arrays
from models.perception.mirrors.peaks_to_view import GeometryParams, direct_structure
from models.perception.target_lists.mirror_evidence import shows_what_is_before
from models.perception.target_lists.returns import Returns
from models.perception.target_lists.sensor import DetectionSensor
from models.perception.target_lists.wall_points import MAX_SPEED_MPS
from msgs.values.frames import xy_from_polar
from msgs.values.perception import PathClass, Peaks, Wall

#: Least depth of an image behind its wall, which rough walls and their posts do not reach.
MIN_DEPTH_M = 1.5
#: Road users end below this height over ground, and nothing lies so far below it.
MAX_HEIGHT_M = 4.5
GROUND_MARGIN_M = 0.5
#: Images belong to a building or a tree where such a share of those within reach is higher.
TALL_REACH_M = 2.5
TALL_SHARE = 0.5
#: Heights count so many standard deviations.
HEIGHT_SIGMAS = 1.0


def classified_peaks(returns: Returns, blank: Peaks, sensor: DetectionSensor, geometry: GeometryParams) -> Peaks:
    """Return the peaks of returns with their classes; without those from below the ground, and of no score where their
    height says that they are no road user's, or their wall shows nothing else that stands before it.

    `blank` has the message's own fields.
    """
    margin_m = HEIGHT_SIGMAS * returns.height_std_m
    # comparisons with NaN are false: an unknown height explains nothing
    below = returns.height_m + margin_m < -sensor.height_m - GROUND_MARGIN_M
    too_high = returns.height_m - margin_m > MAX_HEIGHT_M - sensor.height_m
    returns, too_high = returns.take(~below), too_high[~below]
    peaks = as_peaks(returns, blank)
    mirrored = mirrored_mask(returns, peaks, geometry)
    path_class = np.where(mirrored, PathClass.MIRRORED, PathClass.LOS).astype(np.uint8)
    image = np.flatnonzero(mirrored)
    tall = share_near(returns.points_m[image], too_high[image], TALL_REACH_M) >= TALL_SHARE
    unproven = in_unproven_wall(peaks, image, geometry, sensor)
    score = peaks.score.copy()
    score[image] = np.where(tall | too_high[image] | unproven, 0.0, score[image])
    return msgspec.structs.replace(peaks, path_class=path_class, score=score)


def in_unproven_wall(peaks: Peaks, image: np.ndarray, geometry: GeometryParams, sensor: DetectionSensor) -> np.ndarray:
    """Return which of the images, indices [M], are seen in a wall that does not repeat what stands before it; bool [M].

    An image that moves proves itself: clutter stands.
    """
    direct = np.ones(len(peaks), bool)
    direct[image] = False
    returns, walls = direct_structure(peaks.take(np.flatnonzero(direct)), geometry)
    images_m = xy_from_polar(peaks.range_m[image], peaks.azimuth_rad[image])
    arrays = wall_arrays(walls)
    opaque = ~seen_through(arrays, returns, geometry.recovery)
    wall, _ = associate_crossing(images_m, np.sqrt(peaks.covariance[image, 1, 1]), arrays, geometry.recovery, opaque)
    proven = np.append(shows_what_is_before(walls, returns, images_m, sensor.max_range_m), True)
    speed_mps = np.zeros(len(image)) if peaks.radial_speed_mps is None else peaks.radial_speed_mps[image]
    return ~proven[wall] & ~(np.abs(speed_mps) > MAX_SPEED_MPS)


def share_near(points_m: np.ndarray, marked: np.ndarray, reach_m: float) -> np.ndarray:
    """Return the share of marked ones among the points [N, 2] within reach of each, itself included; [N]."""
    near = np.hypot(*np.moveaxis(points_m[:, None] - points_m, -1, 0)) <= reach_m
    return np.asarray((near & marked).sum(axis=1) / near.sum(axis=1))


def as_peaks(returns: Returns, blank: Peaks) -> Peaks:
    """Return the returns as direct peaks; the score 1 - 1 / sqrt(SNR) is that of CFAR peaks."""
    count = len(returns)
    return msgspec.structs.replace(
        blank,
        range_m=returns.range_m,
        azimuth_rad=returns.azimuth_rad,
        score=1.0 - 1.0 / np.sqrt(np.maximum(10.0 ** (0.1 * returns.snr_db), 1.0)),
        path_class=np.full(count, PathClass.LOS, np.uint8),
        covariance=returns.covariance,
        peak_stamp_ns=np.full(count, blank.stamp_ns),
        snr_db=returns.snr_db,
        radial_speed_mps=returns.speed_mps,
        radial_speed_std_mps=returns.speed_std_mps,
    )


def mirrored_mask(returns: Returns, peaks: Peaks, geometry: GeometryParams) -> np.ndarray:
    """Return which direct peaks are images behind a wall that nearer returns form; bool [N].

    Walls are fitted again among the rest, so that no image makes a wall, until no wall hides a direct return.
    """
    mirrored = np.zeros(len(peaks), bool)
    for _ in range(geometry.walls.max_walls):
        direct = np.flatnonzero(~mirrored)
        structure, walls = direct_structure(peaks.take(direct), geometry)
        hidden = hidden_behind(returns.take(direct), walls, structure.wall)
        if not hidden.any():
            break
        mirrored[direct[hidden]] = True
    return mirrored


def hidden_behind(returns: Returns, walls: list[Wall], wall_of_return: np.ndarray) -> np.ndarray:
    """Return the returns behind the walls that they form, bool [N]; nearest wall first, and none that is an image
    itself for the most part.
    """
    points_m = returns.points_m
    hidden = np.zeros(len(returns), bool)
    for index in sorted(range(len(walls)), key=lambda index: walls[index].offset_m):
        own = wall_of_return == index
        if not own.any() or hidden[own].mean() > 0.5:
            continue
        behind = behind_walls(points_m, drawn_in(walls[index]), MIN_DEPTH_M) & ~own
        hidden |= behind & ~passes_over(returns, walls[index], returns.height_m[own])
    return hidden


def passes_over(returns: Returns, wall: Wall, wall_heights_m: np.ndarray) -> np.ndarray:
    """Return the returns [N] whose ray crosses a wall surely above its highest returns; bool [N]."""
    known = wall_heights_m[~np.isnan(wall_heights_m)]
    if len(known) == 0:
        return np.zeros(len(returns), bool)
    share = hits(RADAR, returns.points_m, drawn_in(wall)).along_ray[:, 0]
    lowest_m = (returns.height_m - HEIGHT_SIGMAS * returns.height_std_m) * share
    return np.asarray(lowest_m > np.quantile(known, 0.95))
