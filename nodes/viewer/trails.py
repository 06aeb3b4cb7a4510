"""Trails of tracks: their positions of the last seconds, over ground, in the radar's axes of now."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from models.perception.track.odometry import ScanOdometry
from msgs.values.frames import Pose2
from msgs.values.perception import BevFrame
from msgs.values.units import NANOSECONDS_PER_SECOND
from msgs.values.vehicle import VehicleState

#: Length of a trail.
TRAIL_NS = 5 * NANOSECONDS_PER_SECOND
#: Scans kept at most, however fast they come.
MAX_PAST = 64


class Past(NamedTuple):
    """Tracks of one scan: the radar's pose, its odometry frame (None: unknown), their positions [m]."""

    stamp_ns: int
    frame: int | None
    odom_from_radar: Pose2
    places_m: dict[int, tuple[float, float]]


class Trails:
    """Positions of the radar and its tracks, scan by scan."""

    def __init__(self) -> None:
        self._odometry = ScanOdometry()
        self._past: deque[Past] = deque(maxlen=MAX_PAST)

    def add_state(self, state: VehicleState) -> None:
        """Add the vehicle's motion."""
        self._odometry.add(state)

    def add_view(self, view: BevFrame, vehicle_from_radar: Pose2) -> None:
        """Add a scan of a radar with this mounting; unconnected earlier scans are forgotten."""
        odometry = self._odometry.at(view.stamp_ns)
        odom_from_vehicle = Pose2() if odometry is None else odometry.odom_from_vehicle
        now = Past(
            view.stamp_ns,
            None if odometry is None else odometry.frame,
            odom_from_vehicle @ vehicle_from_radar,
            {track.id: (track.x_m, track.y_m) for track in view.tracks},
        )
        self._past.append(now)
        while not belongs(self._past[0], now):
            self._past.popleft()

    @property
    def past(self) -> tuple[Past, ...]:
        """The scans of the trails, the newest last."""
        return tuple(self._past)


def belongs(before: Past, now: Past) -> bool:
    """Return whether an earlier scan belongs to the trails of `now`: same odometry frame, within a trail's length."""
    if before is now:
        return True
    return before.frame is not None and before.frame == now.frame and 0 <= now.stamp_ns - before.stamp_ns <= TRAIL_NS


def trail_m(identity: int, past: Sequence[Past]) -> np.ndarray:
    """Return earlier positions [N, 2] of a track, the oldest first, in the radar's axes at the last scan of `past`.

    Ends with the position in that scan. A track's positions are fixed over ground while the radar moves on.
    """
    if not past:
        return np.zeros((0, 2))
    radar_from_odom = past[-1].odom_from_radar.inverse()
    positions_m = [
        (radar_from_odom @ scan.odom_from_radar).apply(np.array(scan.places_m[identity]))
        for scan in past
        if identity in scan.places_m and belongs(scan, past[-1])
    ]
    return np.array(positions_m, np.float64).reshape(-1, 2)
