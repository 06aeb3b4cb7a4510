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


def distinct(reports: Detections, tie: np.ndarray, same_m: float, same_share: float) -> np.ndarray:
    """Return the indices of reports of different objects, best first, then lower `tie`: `same_m` or a share apart."""
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
