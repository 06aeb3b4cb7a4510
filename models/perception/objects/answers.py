"""Answers of the object network: their layout, and the objects that they say.

Each hypothesis of each cell has `ANSWERS` numbers. Positions are told within the image, along and across the ray of the
cell's centre, in metres: what the walls' errors do to an image is then in the map itself, where the network sees it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import expit, logit

from models.perception.geometry.mirrors import WallArrays, mirrors_met
from models.perception.objects.hypotheses import HYPOTHESES, CellGrid, CellHypotheses
from msgs.values.array_table import ArrayTable
from msgs.values.perception import HiddenObject, RadialSpeed

#: Classes in the order of their logits.
CLASSES = ("pedestrian", "bicycle", "car", "van", "truck", "bus")
#: Numbers of a hypothesis, in order: logit of an object, of its class; position of what the radar sees of it and the
#: logarithms of its errors [m]; logarithms of length and width [m]; cosine and sine of twice the heading against the
#: ray; from that position to the centre of its box [m].
OBJECT, CLASS, PLACE, LOG_STD, LOG_SIZE, HEADING, CENTRE = (
    slice(0, 1), slice(1, 7), slice(7, 9), slice(9, 11), slice(11, 13), slice(13, 15), slice(15, 17),
)  # fmt: skip
ANSWERS = 17
#: Bounds of the logarithms of errors and sizes.
LOG_STD_LIMITS, LOG_SIZE_LIMITS = (-4.0, 2.0), (-1.5, 3.0)
#: Share of a threshold that no rounding of a probability reaches.
_ROUNDING = 1.0 - 1e-9
#: Reports nearer than this, or than a share of the longer one, are one object.
SAME_OBJECT_M, SAME_OBJECT_SHARE = 1.5, 0.45


@dataclass(frozen=True)
class Detections(ArrayTable):
    """Objects that a network sees, N of them, best first; the plane is the radar's."""

    score: np.ndarray
    #: Position of what is seen of it [N, 2], covariance [N, 2, 2], centre of its box [N, 2].
    place_m: np.ndarray
    covariance_m2: np.ndarray
    centre_m: np.ndarray
    #: Length and width [N, 2]; axis of its length.
    size_m: np.ndarray
    yaw_rad: np.ndarray
    #: Index into `CLASSES`.
    object_class: np.ndarray
    #: Range and azimuth of the image; azimuth of the way on at the object, as the mirrors turn it.
    range_m: np.ndarray
    azimuth_rad: np.ndarray
    away_rad: np.ndarray

    def __len__(self) -> int:
        return len(self.score)


def detections(
    answer: np.ndarray, hypotheses: CellHypotheses, grid: CellGrid, walls: WallArrays, threshold: float
) -> Detections:
    """Return the objects of an answer [K * answers, R, C] whose probability reaches a threshold, one report each."""
    said = answer.reshape(HYPOTHESES, ANSWERS, *answer.shape[1:])
    reports = _folded(said, _peaks(said[:, 0], hypotheses, threshold), hypotheses, grid, walls)
    # of equal scores, which int8 networks often have, the one that knows its place better comes first: an order that
    # left and right do not change
    spread_m2 = np.trace(reports.covariance_m2, axis1=1, axis2=2)
    return reports.take(distinct(reports, spread_m2, SAME_OBJECT_M, SAME_OBJECT_SHARE))


def _peaks(object_logit: np.ndarray, hypotheses: CellHypotheses, threshold: float) -> np.ndarray:
    """Return the hypotheses (which, row, column) [N, 3] that are the likeliest among their neighbours, by the
    logits [K, R, C] of an object.
    """
    count, rows, columns = object_logit.shape
    padded = np.full((count, rows + 2, columns + 2), -np.inf, object_logit.dtype)
    inside = padded[:, 1:-1, 1:-1]
    np.copyto(inside, object_logit, where=hypotheses.wall >= 0)
    # a little less than the threshold: probabilities are taken and compared about the few cells alone that may reach it
    likely = np.argwhere(inside >= logit(_ROUNDING * threshold))
    windows = np.lib.stride_tricks.sliding_window_view(padded, (3, 3), axis=(1, 2))
    probability = expit(windows[tuple(likely.T)].astype(np.float64))
    own = probability[:, 1, 1]
    return np.asarray(likely[(own >= threshold) & (own >= probability.max(axis=(-2, -1)))])


def _folded(
    said: np.ndarray, at: np.ndarray, hypotheses: CellHypotheses, grid: CellGrid, walls: WallArrays
) -> Detections:
    """Return what is said at hypotheses [N, 3] (which, row, column), folded back by their walls."""
    which, row, column = at.T
    values = said[which, :, row, column].astype(np.float64)
    along, across = values[:, PLACE].T
    range_m = np.maximum(grid.range_m[row] + along, 0.1)
    azimuth_rad = grid.azimuth_rad[column] + across / np.maximum(grid.range_m[row], 1.0)
    ray = np.stack([np.cos(azimuth_rad), np.sin(azimuth_rad)], axis=1)
    # columns: along the ray and across it, turned by the mirrors like the image itself
    axes = np.stack([ray, np.stack([-ray[:, 1], ray[:, 0]], axis=1)], axis=2)
    place_m = range_m[:, None] * ray
    wall, second = hypotheses.wall[which, row, column], hypotheses.second[which, row, column]
    place_m, axes = _mirrored(place_m, axes, *mirrors_met(place_m, wall, walls))
    twice = np.flatnonzero(second >= 0)
    normal, offset_m = walls.normal[second[twice]], walls.offset_m[second[twice]]
    place_m[twice], axes[twice] = _mirrored(place_m[twice], axes[twice], normal, offset_m)
    std_m = np.exp(np.clip(values[:, LOG_STD], *LOG_STD_LIMITS))
    heading = axes @ _half_angle(values[:, HEADING])[..., None]
    return Detections(
        score=expit(values[:, 0]),
        place_m=place_m,
        covariance_m2=(axes * std_m[:, None] ** 2) @ axes.transpose(0, 2, 1),
        centre_m=place_m + (axes @ values[:, CENTRE, None])[..., 0],
        size_m=np.exp(np.clip(values[:, LOG_SIZE], *LOG_SIZE_LIMITS)),
        yaw_rad=np.arctan2(heading[:, 1, 0], heading[:, 0, 0]),
        object_class=values[:, CLASS].argmax(axis=1),
        range_m=range_m,
        azimuth_rad=azimuth_rad,
        away_rad=np.arctan2(axes[:, 1, 0], axes[:, 0, 0]),
    )


def _mirrored(
    place_m: np.ndarray, axes: np.ndarray, normal: np.ndarray, offset_m: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return places [N, 2] and the axes at them [N, 2, 2] in mirrors [N, 2], [N]."""
    height_m = np.sum(place_m * normal, axis=1) + offset_m
    turned = np.einsum("ni,nij->nj", normal, axes)
    return place_m - 2.0 * height_m[:, None] * normal, axes - 2.0 * normal[:, :, None] * turned[:, None, :]


def _half_angle(doubled: np.ndarray) -> np.ndarray:
    """Return unit vectors [N, 2] at half the angle of vectors [N, 2]."""
    half_rad = 0.5 * np.arctan2(doubled[:, 1], doubled[:, 0])
    return np.stack([np.cos(half_rad), np.sin(half_rad)], axis=1)


def distinct(reports: Detections, tie: np.ndarray, same_m: float, same_share: float) -> np.ndarray:
    """Return the indices of reports of different objects, best first: a better one within `same_m`, or within a share
    of the longer one, says the same object. Of equal scores the lower `tie` [N] comes first.
    """
    kept: list[int] = []
    reach_m = np.maximum(same_m, same_share * reports.size_m[:, 0])
    for index in np.lexsort((tie, -reports.score)):
        away_m = np.linalg.norm(reports.place_m[kept] - reports.place_m[index], axis=1)
        if (away_m > np.maximum(reach_m[kept], reach_m[index])).all():
            kept.append(int(index))
    return np.array(kept, int)


def hidden_objects(
    reports: Detections, stamp_ns: np.ndarray, radial_speeds: Sequence[RadialSpeed | None] | None = None
) -> tuple[HiddenObject, ...]:
    """Return detections as a view reports them, measured at the times [N], with the radial speeds [N] if any."""
    return tuple(
        HiddenObject(
            id=index,
            x_m=float(reports.place_m[index, 0]),
            y_m=float(reports.place_m[index, 1]),
            length_m=float(reports.size_m[index, 0]),
            width_m=float(reports.size_m[index, 1]),
            yaw_rad=float(reports.yaw_rad[index]),
            score=float(reports.score[index]),
            cov_m2=tuple(map(tuple, reports.covariance_m2[index].tolist())),  # type: ignore[arg-type]
            centre_m=tuple(reports.centre_m[index].tolist()),
            stamp_ns=int(stamp_ns[index]),
            object_class=CLASSES[reports.object_class[index]],
            radial_speed=radial_speeds[index] if radial_speeds else None,
        )
        for index in range(len(reports))
    )
