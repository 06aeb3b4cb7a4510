"""Where tracks were: their places of the last seconds, over ground, seen from where the radar is now."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from models.perception.tracking.odometry import ScanOdometry
from msgs.values.frames import Pose2
from msgs.values.perception import BevFrame
from msgs.values.units import NANOSECONDS_PER_SECOND
from msgs.values.vehicle import VehicleState

#: Length of a trail.
TRAIL_NS = 5 * NANOSECONDS_PER_SECOND
#: Scans kept at most, however fast they come.
MAX_PAST = 64


class Past(NamedTuple):
    """Tracks of one scan: where the radar was, in which odometry frame (None: nobody knows), their places [m]."""

    stamp_ns: int
    frame: int | None
    odom_from_radar: Pose2
    places_m: dict[int, tuple[float, float]]


class Trails:
    """Places of the radar and its tracks, scan by scan."""

    def __init__(self) -> None:
        self._odometry = ScanOdometry()
        self._past: deque[Past] = deque(maxlen=MAX_PAST)

    def add_state(self, state: VehicleState) -> None:
        """Take in the vehicle's motion."""
        self._odometry.add(state)

    def add_view(self, view: BevFrame, vehicle_from_radar: Pose2) -> None:
        """Take in a scan of a radar mounted so; what is not connected with it any more is forgotten."""
        place = self._odometry.at(view.stamp_ns)
        odom_from_vehicle = Pose2() if place is None else place.odom_from_vehicle
        now = Past(
            view.stamp_ns,
            None if place is None else place.frame,
            odom_from_vehicle @ vehicle_from_radar,
            {one.id: (one.x_m, one.y_m) for one in view.tracks},
        )
        self._past.append(now)
        while not belongs(self._past[0], now):
            self._past.popleft()

    @property
    def past(self) -> tuple[Past, ...]:
        """The scans that trails are drawn from, the newest last."""
        return tuple(self._past)


def belongs(before: Past, now: Past) -> bool:
    """Whether an earlier scan tells of the ground under `now`: same odometry frame, no longer ago than a trail."""
    if before is now:
        return True
    return before.frame is not None and before.frame == now.frame and 0 <= now.stamp_ns - before.stamp_ns <= TRAIL_NS


def trail_m(identity: int, past: Sequence[Past]) -> np.ndarray:
    """Earlier places [N, 2] of a track, the oldest first, in the radar's axes at the last scan of `past`.

    Ends with the place in that scan. A track's places stay where they were over ground while the radar moves on.
    """
    if not past:
        return np.zeros((0, 2))
    radar_from_odom = past[-1].odom_from_radar.inverse()
    found = [
        (radar_from_odom @ one.odom_from_radar).apply(np.array(one.places_m[identity]))
        for one in past
        if identity in one.places_m and belongs(one, past[-1])
    ]
    return np.array(found, np.float64).reshape(-1, 2)
