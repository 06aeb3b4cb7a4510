"""Matching of a heatmap to the ridges of the map: class and score from the network, range and azimuth from the
ridge.
"""

from __future__ import annotations

import msgspec
import numpy as np

from models.perception.find.peaks import PeakParams, local_maxima, peaks_at
from models.perception.find.ridges import RidgeParams, find_ridges
from msgs.values.perception import PathClass, Peaks
from msgs.values.radar import RangeAzimuthMap


class RidgeMatchingParams(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Distance and height at which a heatmap's response matches a ridge."""

    ridges: RidgeParams = RidgeParams()
    #: Largest distance from the ridge to the heatmap's response in cells (range, azimuth).
    reach: tuple[int, int] = (2, 8)
    threshold: float = 0.2


def ridge_matched_peaks(
    heatmap: np.ndarray, ra_map: RangeAzimuthMap, peaks: PeakParams, params: RidgeMatchingParams
) -> Peaks:
    """Return the ridges that match the heatmap [2, range, azimuth], then its own maxima away from ridges of their
    class.
    """
    # imported here: as in `find_ridges`
    from scipy import ndimage

    near = np.stack(
        [ndimage.maximum_filter(channel, size=[2 * reach + 1 for reach in params.reach]) for channel in heatmap]
    )
    power = np.square(np.abs(ra_map.values))
    matched = near.max(axis=0) >= params.threshold
    cells, fractional = find_ridges(power, matched, ra_map.noise_power_mw, ra_map.grid.range_m, params.ridges)
    path_class = near[:, cells[:, 0], cells[:, 1]].argmax(axis=0)
    for label in PathClass:
        own = local_maxima(heatmap[label], peaks.threshold, peaks.min_distance)
        own = own[_far_from(own, cells[path_class == label], params.ridges.spacing)]
        cells, fractional = np.concatenate([cells, own]), np.concatenate([fractional, own])
        path_class = np.concatenate([path_class, np.full(len(own), label)])
    score = near[path_class, cells[:, 0], cells[:, 1]]
    return peaks_at(ra_map, cells, fractional, score, path_class, peaks)


def _far_from(cells: np.ndarray, reference: np.ndarray, spacing: tuple[int, int]) -> np.ndarray:
    """Return which cells [N, 2] lie further than `spacing`, in one axis at least, from all reference cells [M, 2]; bool
    [N].
    """
    apart = np.abs(cells[:, None] - reference[None])
    return ~np.logical_and.reduce(apart <= spacing, axis=-1).any(axis=1)
