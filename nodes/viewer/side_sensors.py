"""The sensors beside the radar on the page: the camera's image, and a slice of the LiDAR's cloud."""

from __future__ import annotations

from collections import deque
from typing import Any, Generic, TypeVar

import numpy as np

from msgs.values.camera import CameraImage
from msgs.values.frames import Pose2
from msgs.values.lidar import LidarPoints
from msgs.values.units import NANOSECONDS_PER_SECOND, s_from_ns

#: A message further than this from a view in time does not belong to it.
NEAR_NS = NANOSECONDS_PER_SECOND
#: Heights over the ground of the slice: above kerbs, up to the roof of a van.
SLICE_M = (0.3, 2.5)
#: One point in a square of this size, and at most so many of them.
CELL_M, MAX_SHOWN = 0.1, 20_000
#: Of the clouds and of the images that are kept: half a second of the largest clouds.
MAX_BYTES = 64 << 20
#: Coordinates of a tile are 16 bits wide.
_REACH_M = 3000.0

Message = TypeVar("Message", LidarPoints, CameraImage)


class Recent(Generic[Message]):
    """The last messages of a topic, in at most `MAX_BYTES`."""

    def __init__(self) -> None:
        self._messages: deque[Message] = deque()
        self._bytes = 0
        #: The one that the page was given last, and where the radar was mounted then.
        self.posted: tuple[Message, Pose2] | None = None

    def add(self, message: Message) -> None:
        """Take in a message; the oldest are let go."""
        self._messages.append(message)
        self._bytes += _size(message)
        while self._bytes > MAX_BYTES and len(self._messages) > 1:
            self._bytes -= _size(self._messages.popleft())

    def nearest(self, stamp_ns: int | None) -> Message | None:
        """Return the message nearest to a view in time; the newest where none is near, or there is no view."""
        if not self._messages or stamp_ns is None:
            return self._messages[-1] if self._messages else None
        nearest = min(self._messages, key=lambda message: abs(message.stamp_ns - stamp_ns))
        return nearest if abs(nearest.stamp_ns - stamp_ns) <= NEAR_NS else self._messages[-1]


def _size(message: LidarPoints | CameraImage) -> int:
    return message.data.nbytes if isinstance(message, LidarPoints) else message.jpeg.nbytes


def slice_cells(points: LidarPoints, vehicle_from_radar: Pose2) -> np.ndarray:
    """Return the cells [n, 2] of `CELL_M` in the radar's frame that hold a point between the heights of `SLICE_M`."""
    positions_m = points.positions_m()
    height_m = positions_m[:, 2] + points.lidar_height_m
    radar_from_lidar = vehicle_from_radar.inverse() @ points.vehicle_from_lidar
    plane_m = radar_from_lidar.apply(positions_m[(height_m >= SLICE_M[0]) & (height_m <= SLICE_M[1]), :2])
    plane_m = plane_m[(np.abs(plane_m) < _REACH_M).all(axis=1)]
    cells = np.unique(np.rint(plane_m / CELL_M).astype("<i2"), axis=0)
    return cells[:: -(-len(cells) // MAX_SHOWN) or 1]


def lidar_json(points: LidarPoints) -> dict[str, Any]:
    """Return what the page says of a cloud; its slice comes as a tile."""
    low_m, high_m = SLICE_M
    return {
        "type": "lidar",
        "stamp_s": round(s_from_ns(points.stamp_ns), 3),
        "text": f"{points.sensor or 'LiDAR'}, {len(points)} points, {low_m:g} to {high_m:g} m over the ground",
    }


def image_json(image: CameraImage) -> dict[str, Any]:
    """Return what the page says of an image; its JPEG comes beside it, as it is."""
    return {
        "type": "image",
        "stamp_s": round(s_from_ns(image.stamp_ns), 3),
        "text": f"{image.sensor or 'camera'}, {image.width_px} × {image.height_px} px",
    }
