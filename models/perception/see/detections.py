"""What the evidence network answers of a place, number by number, and the objects that are read off its answers."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from msgs.values.array_table import ArrayTable
from msgs.values.perception import HiddenObject, RadialSpeed

#: Classes in the order of their logits.
CLASSES = ("pedestrian", "bicycle", "car", "van", "truck", "bus")
#: Numbers of a place, in order: logit of an object, of its class; from the place to what the radar sees of it [m] and
#: the logarithms of its errors [m]; logarithms of length and width [m]; cosine and sine of twice the heading; from that
#: position to the centre of its box [m].
OBJECT, CLASS, PLACE, LOG_STD, LOG_SIZE, HEADING, CENTRE = (
    slice(0, 1), slice(1, 7), slice(7, 9), slice(9, 11), slice(11, 13), slice(13, 15), slice(15, 17),
)  # fmt: skip
ANSWERS = 17
#: Bounds of the logarithms of errors and sizes.
LOG_STD_LIMITS, LOG_SIZE_LIMITS = (-4.0, 2.0), (-1.5, 3.0)
#: Reports nearer than this are one object, and those of which one box has more than this share of its ground within the
#: other: chosen by loss and average precision on 1,000 validation places (seed 6112).
SAME_PLACE_M, SHARED_GROUND = 0.6, 0.1
#: Points of a box that stand for its ground, in lengths and widths from its centre.
_GROUND = np.stack(np.meshgrid(*[np.linspace(-0.45, 0.45, 7)] * 2), axis=-1).reshape(-1, 2)


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


def distinct(reports: Detections, tie: np.ndarray) -> np.ndarray:
    """Return the indices of reports of different objects, best first, then lower `tie`."""
    kept: list[int] = []
    reach_m = 0.5 * np.hypot(*reports.size_m.T)
    for index in np.lexsort((tie, -reports.score)):
        away_m = np.linalg.norm(reports.place_m[kept] - reports.place_m[index], axis=1)
        apart_m = np.linalg.norm(reports.centre_m[kept] - reports.centre_m[index], axis=1)
        near = np.array(kept, int)[apart_m < reach_m[kept] + reach_m[index]]
        if (away_m >= SAME_PLACE_M).all() and not any(_share_ground(reports, index, other) for other in near):
            kept.append(int(index))
    return np.array(kept, int)


def _share_ground(reports: Detections, first: int, second: int) -> bool:
    """Return whether too many points of the box of either lie within that of the other."""
    return max(_part_within(reports, first, second), _part_within(reports, second, first)) > SHARED_GROUND


def _part_within(reports: Detections, inner: int, outer: int) -> float:
    """Return the share of the points of one box that lie within another."""
    points_m = reports.centre_m[inner] + (_GROUND * reports.size_m[inner]) @ _axes(reports.yaw_rad[inner])
    offset_m = (points_m - reports.centre_m[outer]) @ _axes(reports.yaw_rad[outer]).T
    return float((np.abs(offset_m) <= 0.5 * reports.size_m[outer]).all(axis=1).mean())


def _axes(yaw_rad: float) -> np.ndarray:
    """Return the directions of length and width, as rows."""
    along = np.array([np.cos(yaw_rad), np.sin(yaw_rad)])
    return np.stack([along, [-along[1], along[0]]])


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
