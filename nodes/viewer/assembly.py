"""Assembles the contents of a page and posts them: data of one scan, and data derived from many."""

from __future__ import annotations

from typing import Any

import msgspec

from msgs.values.camera import CameraImage
from msgs.values.frames import Pose2
from msgs.values.lidar import LidarPoints
from msgs.values.perception import BevFrame, Peaks, SceneTruth
from msgs.values.radar import RangeAzimuthMap
from msgs.values.units import NANOSECONDS_PER_SECOND
from msgs.values.vehicle import VehicleState
from nodes.inputs.view_latency import Setup, on_one_clock
from nodes.viewer.driver_warnings import DriverWarning, warnings_json
from nodes.viewer.newest import Board, json_text
from nodes.viewer.side_sensors import NEAR_NS, Recent, image_json, lidar_json
from nodes.viewer.trails import Past
from nodes.viewer.view_model import (
    age_limits_ms,
    age_ms,
    map_json,
    map_tile,
    mask_tile,
    points_tile,
    sensor_json,
    view_json,
)
from nodes.viewer.watch import Watch

#: Message types that the assembly accepts.
TOPICS_SHOWN = (
    "perception/hidden_objects",
    "radar/ra_map",
    "perception/peaks",
    "sim/truth",
    "vehicle/state",
    "diagnostics/node",
    "radar/setup",
    "lidar/setup",
    "lidar/points",
    "camera/image",
)
#: Interval between posts of the node table, and maximum interval between those of the warnings.
TABLE_PERIOD_NS = NANOSECONDS_PER_SECOND // 2
#: Truth and view of a scan arrive within this many scans of each other.
_KEPT_TRUTHS = 8
#: While views miss their deadline, pictures of maps are posted no more often than this: the first work to be shed.
LATE_MAP_PERIOD_NS = 2 * NANOSECONDS_PER_SECOND


class ScanAssembly:
    """Data of one scan: view with truth and vehicle, map with peaks. Posts newest-only; belongs to one thread.

    With `sheds_maps` it drops most pictures of maps while views are late; `maps_shed` counts them.
    """

    def __init__(self, board: Board, sheds_maps: bool = False) -> None:
        self._board = board
        self._sheds_maps = sheds_maps
        self.maps_shed = 0
        self._map_posted_ns: int | None = None
        self._is_late = False
        self._frame: BevFrame | None = None
        self._past: tuple[Past, ...] = ()
        #: Number of views so far: a page that misses some can count them, however often each was posted.
        self._number = 0
        #: Of the newest view: latency on arrival (None: not measured by this graph), and the limits of its age.
        self._facts: dict[str, Any] = {}
        #: Waits for the view of its scan, so that both change together.
        self._map: RangeAzimuthMap | None = None
        self._peaks: Peaks | None = None
        self._truths: dict[int, SceneTruth] = {}
        self._vehicle: VehicleState | None = None
        self._vehicle_from_radar = Pose2()
        self._clouds: Recent[LidarPoints] = Recent()
        self._images: Recent[CameraImage] = Recent()

    def take(
        self,
        message: msgspec.Struct,
        now_ns: int,
        past: tuple[Past, ...] = (),
        watch: Watch | None = None,
        since_ns: int = 0,
    ) -> None:
        """Process one message of `TOPICS_SHOWN`; post what it completes. `past` comes with a view.

        `watch` has taken the message before, and tells of a live view how late it came. Without one, `since_ns` is when
        the graph's first node started: the latency of what was measured earlier is not known.
        """
        match message:
            case BevFrame():
                self._number += 1
                self._frame, self._past = message, past
                since_ns, sensor = (since_ns, None) if watch is None else (watch.since_ns, watch.sensor)
                self._is_late = watch is not None and watch.is_late
                is_ours = on_one_clock(message.stamp_ns, now_ns, since_ns)
                latency_ms = age_ms(message.stamp_ns, now_ns) if is_ours else None
                self._facts = {"latency_ms": latency_ms, **age_limits_ms(sensor, self._is_late)}
                self._post_view(now_ns)
                self._post_map(now_ns)
                self._post_side_sensors(now_ns)
            case RangeAzimuthMap():
                # no view came for the map before: better shown alone than not at all
                self._post_map(now_ns)
                self._map, self._vehicle_from_radar = message, message.vehicle_from_radar
            case Peaks():
                self._peaks, self._vehicle_from_radar = message, message.vehicle_from_radar
            case LidarPoints():
                self._clouds.add(message)
                self._post_without_view(message.stamp_ns, now_ns)
            case CameraImage():
                self._images.add(message)
                self._post_without_view(message.stamp_ns, now_ns)
            case SceneTruth():
                self._truths.pop(message.scan_id, None)
                self._truths[message.scan_id] = message
                while len(self._truths) > _KEPT_TRUTHS:
                    del self._truths[next(iter(self._truths))]
                if self._frame is not None and self._frame.scan_id == message.scan_id:
                    self._post_view(now_ns)
            case VehicleState():
                self._vehicle = message

    def _post_view(self, now_ns: int) -> None:
        assert self._frame is not None
        frame, vehicle, past, truth = self._frame, self._vehicle, self._past, self._truths.get(self._frame.scan_id)
        facts = {"number": self._number, "age_ms": age_ms(frame.stamp_ns, now_ns), **self._facts}
        self._board.post(
            "view", lambda: (json_text({**view_json(frame, truth, vehicle, past), **facts}), mask_tile(frame))
        )

    def _post_map(self, now_ns: int) -> None:
        if self._map is None:
            return
        if self._is_map_shed(now_ns):
            self.maps_shed += 1
        else:
            ra_map, peaks, age = self._map, self._peaks, {"age_ms": age_ms(self._map.stamp_ns, now_ns)}
            self._board.post("map", lambda: (json_text({**map_json(ra_map, peaks), **age}), map_tile(ra_map)))
            self._map_posted_ns = now_ns
        self._map = None

    def _post_without_view(self, stamp_ns: int, now_ns: int) -> None:
        """Post the newest of the sensors beside the radar while there is no view that they belong to."""
        if self._frame is None or abs(stamp_ns - self._frame.stamp_ns) > NEAR_NS:
            self._post_side_sensors(now_ns)

    def _post_side_sensors(self, now_ns: int) -> None:
        """Post what the sensors beside the radar saw nearest to the time of the view; the first work to be shed."""
        if self._is_map_shed(now_ns):
            return
        stamp_ns = None if self._frame is None else self._frame.stamp_ns
        pose = self._vehicle_from_radar
        cloud, image = self._clouds.nearest(stamp_ns), self._images.nearest(stamp_ns)
        if cloud is not None and (cloud, pose) != self._clouds.posted:
            self._clouds.posted = cloud, pose
            cloud_age = {"age_ms": age_ms(cloud.stamp_ns, now_ns)}
            self._board.post("lidar", lambda: (json_text({**lidar_json(cloud), **cloud_age}), points_tile(cloud, pose)))
        if image is not None and (image, pose) != self._images.posted:
            self._images.posted = image, pose
            image_age = {"age_ms": age_ms(image.stamp_ns, now_ns)}
            self._board.post("image", lambda: (json_text({**image_json(image), **image_age}), image.jpeg.tobytes()))

    def _is_map_shed(self, now_ns: int) -> bool:
        if not (self._sheds_maps and self._is_late) or self._map_posted_ns is None:
            return False
        return now_ns - self._map_posted_ns < LATE_MAP_PERIOD_NS


class Assembly:
    """Processes messages of a live graph in order of arrival and posts a page's contents. Belongs to one thread."""

    def __init__(self, board: Board, sheds_maps: bool = False) -> None:
        self._board = board
        self._scans = ScanAssembly(board, sheds_maps)
        self._watch: Watch | None = None
        self._sheds = sheds_maps
        self._series_posted_ns: int | None = None
        self._table_due_ns: int | None = None

    @property
    def maps_shed(self) -> int:
        """Number of pictures of maps shed so far."""
        return self._scans.maps_shed

    def take(self, message: msgspec.Struct, now_ns: int) -> None:
        """Process one message of `TOPICS_SHOWN`; post what it completes."""
        watch = self._watching(now_ns)
        watch.take(message, now_ns)
        self._scans.take(message, now_ns, watch.past, watch)
        if isinstance(message, BevFrame):
            self._post_warnings(now_ns)
        elif message is watch.sensor:
            post_sensor(self._board, watch.sensor)

    def table_due_ns(self, now_ns: int) -> int:
        """Return when the node table is to be posted next."""
        if self._table_due_ns is None:
            self._table_due_ns = now_ns
        return self._table_due_ns

    def post_table(self, now_ns: int) -> None:
        """Post the current node table and warnings."""
        self._table_due_ns = now_ns + TABLE_PERIOD_NS
        table = self._watching(now_ns).table(now_ns)
        self._board.post("nodes", lambda: (json_text(table),))
        self._post_warnings(now_ns)
        # post new samples, as seldom as maps while views are late
        is_shed = self._sheds and self._watching(now_ns).is_late and (self._series_posted_ns is not None)
        if not is_shed or now_ns - (self._series_posted_ns or 0) >= LATE_MAP_PERIOD_NS:
            self._series_posted_ns = now_ns
            self._board.series.advance(now_ns)
            self._board.post_series()

    def _watching(self, now_ns: int) -> Watch:
        self._watch = self._watch or Watch(now_ns, self._board.series)
        return self._watch

    def _post_warnings(self, now_ns: int) -> None:
        post_warnings(self._board, self._watching(now_ns).warnings(now_ns), now_ns)


def post_warnings(board: Board, warnings: tuple[DriverWarning, ...], now_ns: int) -> None:
    """Post the warnings of a time."""
    board.post("warnings", lambda: (json_text({"type": "warnings", "warnings": warnings_json(warnings, now_ns)}),))


def post_sensor(board: Board, setup: Setup) -> None:
    """Post the sensor of a page."""
    board.post("sensor", lambda: (json_text(sensor_json(setup)),))
