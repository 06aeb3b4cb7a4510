"""Standard ROS 2 messages of what the graph says, of the types of one type store: for bags and for the live bridge."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from functools import partial
from typing import Any

import msgspec
import numpy as np

from contrib.ros2.point_cloud2 import NUMBERS
from msgs.values.arrays import Covariance
from msgs.values.camera import CameraImage
from msgs.values.diagnostics import NodeState, NodeStatus
from msgs.values.frames import Pose2
from msgs.values.lidar import LidarPoints
from msgs.values.perception import BevFrame, HiddenObject, Track, Visibility, Wall
from msgs.values.radar import RangeAzimuthMap
from msgs.values.vehicle import VehicleState
from nodes.recording.shapes import (
    OBJECT_COLOUR,
    OBJECT_HEIGHT_M,
    POINT_SIZE_M,
    TRACK_COLOUR,
    WALL_COLOUR,
    WALL_WIDTH_M,
    Colour,
    quaternion_zw,
    stamp_parts,
    wall_line_m,
)

#: The mask as an occupancy grid. It says nothing of occupancy; the values tell its three states apart.
OCCUPANCY = {Visibility.UNKNOWN: -1, Visibility.DIRECT: 0, Visibility.MIRRORED: 50}
POINT_DTYPE = np.dtype([("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("score", "<f4")])
#: Grey levels of a map's image for one dB of power over noise: 255 is 63.75 dB.
GREY_PER_DB = 4.0
#: Levels of a `DiagnosticStatus`: OK, WARN, STALE.
LEVELS = {NodeState.READY: 0, NodeState.DEGRADED: 1, NodeState.STARTING: 1, NodeState.STOPPING: 3}

_ORIGIN = Pose2()
_FLOAT32 = 7
_ARROW, _CUBE, _LINE_STRIP, _ADD, _DELETE_ALL = 0, 1, 4, 0, 3
#: A track's arrow is as long as the path of one second.
_TRACK_SHOWN_S = 1.0
#: Numbers of markers are int32.
_MARKER_NUMBERS = 0x7FFFFFFF
_UUID_BYTES = 16


class Frames(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Names of the frames in ROS 2."""

    radar: str = "radar"
    vehicle: str = "base_link"
    odom: str = "odom"

    def __post_init__(self) -> None:
        names = msgspec.structs.astuple(self)
        if len(set(names)) != len(names) or not all(name.strip() and not name.startswith("/") for name in names):
            raise ValueError(f"frames must have different names without a leading slash, got {', '.join(names)}")


class Ros2Messages:
    """Builds messages of the types of one type store, with stamps moved by `offset_ns` to the clock of the reader."""

    def __init__(self, types: Any, frames: Frames | None = None) -> None:
        self._types, self._frames = types, frames or Frames()
        self.offset_ns = 0

    def drafts(self, message: Any) -> dict[str, Callable[[], Any]]:
        """Return what a message of the graph becomes by itself: topics of ROS 2, and what builds each one's message."""
        builders: dict[str, Callable[[Any], Any]] = {}
        match message:
            case BevFrame():
                builders = {
                    "hidden_points": self.cloud, "hidden_objects": self.markers, "visibility": self.occupancy,
                    "hidden_detections": self.detections, "hidden_tracks": self.tracks,
                }  # fmt: skip
            case RangeAzimuthMap():
                builders = {"ra_map": self.map_image}
            case NodeStatus():
                builders = {"diagnostics": self.diagnostics}
            case LidarPoints():
                builders = {"lidar/points": self.lidar_cloud}
            case CameraImage():
                builders = {"camera/image/compressed": self.compressed_image}
        return {name: partial(build, message) for name, build in builders.items()}

    def cloud(self, frame: BevFrame) -> Any:
        """Recovered points: x, y, z (0) in metres and score, float32."""
        points = np.array([(point.x_m, point.y_m, 0.0, point.score) for point in frame.points], POINT_DTYPE)
        fields = [(name, 4 * at, _FLOAT32, 1) for at, name in enumerate(POINT_DTYPE.names or ())]
        data = np.frombuffer(points.tobytes(), np.uint8).reshape(len(points), POINT_DTYPE.itemsize)
        return self._cloud(frame.stamp_ns, self._frames.radar, fields, data)

    def lidar_cloud(self, points: LidarPoints) -> Any:
        """A LiDAR's cloud with all its fields, byte for byte, in the sensor's own frame."""
        fields = [(field.name, field.offset, NUMBERS[field.datatype], field.count) for field in points.fields]
        is_dense = len(points.positions_m()) == len(points.data)
        return self._cloud(points.stamp_ns, points.sensor or "lidar", fields, points.data, points.rows, is_dense)

    def _cloud(
        self, stamp_ns: int, frame: str, fields: Iterable[tuple[str, int, int, int]], data: np.ndarray,
        rows: int = 1, is_dense: bool = True,
    ) -> Any:  # fmt: skip
        """Return bytes [points, step] as a cloud; `fields` are name, offset, type and count of each."""
        width, step = len(data) // rows, data.shape[1]
        return self._make(
            "sensor_msgs/msg/PointCloud2",
            header=self._header(stamp_ns, frame),
            height=rows,
            width=width,
            fields=[
                self._make("sensor_msgs/msg/PointField", name=name, offset=offset, datatype=datatype, count=count)
                for name, offset, datatype, count in fields
            ],
            is_bigendian=False,
            point_step=step,
            row_step=step * width,
            data=np.ascontiguousarray(data).reshape(-1),
            is_dense=is_dense,
        )

    def compressed_image(self, image: CameraImage) -> Any:
        """A camera's JPEG as it is."""
        header = self._header(image.stamp_ns, image.sensor or "camera")
        return self._make("sensor_msgs/msg/CompressedImage", header=header, format="jpeg", data=image.jpeg)

    def markers(self, frame: BevFrame) -> Any:
        """All markers of a scan (walls, objects, tracks), after one that clears those of the scan before."""
        clear = self._marker(frame.stamp_ns, "", 0, _CUBE, action=_DELETE_ALL)
        walls = [self._wall(frame.stamp_ns, at, wall) for at, wall in enumerate(frame.walls)]
        objects = [self._object(frame.stamp_ns, hidden) for hidden in frame.objects]
        tracks = [self._track_arrow(frame.stamp_ns, track) for track in frame.tracks]
        return self._make("visualization_msgs/msg/MarkerArray", markers=[clear, *walls, *objects, *tracks])

    def detections(self, frame: BevFrame) -> Any:
        """Objects with box, class, score and covariance; an object is on the ground, its box half its height above."""
        detections = [self._detection(frame.stamp_ns, hidden) for hidden in frame.objects]
        header = self._header(frame.stamp_ns, self._frames.radar)
        return self._make("vision_msgs/msg/Detection3DArray", header=header, detections=detections)

    def tracks(self, frame: BevFrame) -> Any:
        """Tracks with position, velocity over ground and covariances; acceleration and size are 0: not estimated."""
        header = self._header(frame.stamp_ns, self._frames.radar)
        tracks = [self._radar_track(track) for track in frame.tracks]
        return self._make("radar_msgs/msg/RadarTracks", header=header, tracks=tracks)

    def map_image(self, ra_map: RangeAzimuthMap) -> Any:
        """Power over noise by `GREY_PER_DB`, mono8 [range, azimuth]: far is up, left is left."""
        noise_mw = max(ra_map.noise_power_mw, float(np.finfo(np.float32).tiny))
        with np.errstate(divide="ignore", over="ignore"):
            snr_db = 20.0 * np.log10(np.abs(ra_map.values)) - 10.0 * np.log10(noise_mw)
        grey = np.clip(np.nan_to_num(GREY_PER_DB * snr_db, nan=0.0), 0.0, 255.0).astype(np.uint8)[::-1, ::-1]
        height, width = grey.shape
        return self._make(
            "sensor_msgs/msg/Image",
            header=self._header(ra_map.stamp_ns, self._frames.radar),
            height=height,
            width=width,
            encoding="mono8",
            is_bigendian=0,
            step=width,
            data=np.ascontiguousarray(grey).ravel(),
        )

    def diagnostics(self, status: NodeStatus) -> Any:
        """A node's heartbeat as one status; values are texts."""
        values = {"cpu_s": f"{status.cpu_s:.2f}", "resident_mib": f"{status.resident_bytes / (1 << 20):.1f}"}
        values |= {f"{stage.name}_mean_ms": f"{stage.mean_ms:.3f}" for stage in status.stages}
        values |= {f"{count.topic} lost": str(count.lost) for count in status.received}
        values |= {f"{count.what} shed, {count.reason}": str(count.count) for count in status.shed}
        health = self._make(
            "diagnostic_msgs/msg/DiagnosticStatus",
            level=LEVELS[status.state],
            name=f"mirrorwave: {status.node}",
            message=status.reason or status.state.value,
            hardware_id="",
            values=[self._make("diagnostic_msgs/msg/KeyValue", key=key, value=value) for key, value in values.items()],
        )
        header = self._header(status.stamp_ns, "")
        return self._make("diagnostic_msgs/msg/DiagnosticArray", header=header, status=[health])

    def occupancy(self, frame: BevFrame) -> Any:
        """The observability mask by `OCCUPANCY`; rows run along y in both."""
        values = np.full(1 + max(Visibility), OCCUPANCY[Visibility.UNKNOWN], np.int8)
        for visibility, value in OCCUPANCY.items():
            values[visibility] = value
        grid = frame.grid
        info = self._make(
            "nav_msgs/msg/MapMetaData",
            map_load_time=self._time(frame.stamp_ns),
            resolution=grid.cell_m,
            width=grid.columns,
            height=grid.rows,
            origin=self._pose(Pose2(grid.x_min_m, grid.y_min_m)),
        )
        cells = np.minimum(frame.visibility, np.uint8(len(values) - 1))
        header = self._header(frame.stamp_ns, self._frames.radar)
        return self._make("nav_msgs/msg/OccupancyGrid", header=header, info=info, data=values[cells].ravel())

    def odometry(self, state: VehicleState, odom_from_vehicle: Pose2) -> Any:
        """Integrated pose and the state's own speed and yaw rate; covariances are 0, which means not known."""
        pose = self._make(
            "geometry_msgs/msg/PoseWithCovariance", pose=self._pose(odom_from_vehicle), covariance=np.zeros(36)
        )
        linear, angular = self._vector(state.speed_mps), self._vector(0.0, 0.0, state.yaw_rate_rps)
        twist = self._make("geometry_msgs/msg/Twist", linear=linear, angular=angular)
        return self._make(
            "nav_msgs/msg/Odometry",
            header=self._header(state.stamp_ns, self._frames.odom),
            child_frame_id=self._frames.vehicle,
            pose=pose,
            twist=self._make("geometry_msgs/msg/TwistWithCovariance", twist=twist, covariance=np.zeros(36)),
        )

    def transforms(self, *transforms: Any) -> Any:
        """Transforms as one message of `/tf` or `/tf_static`."""
        return self._make("tf2_msgs/msg/TFMessage", transforms=list(transforms))

    def odom_transform(self, stamp_ns: int, odom_from_vehicle: Pose2) -> Any:
        """The vehicle in the odometry frame."""
        return self._transform(stamp_ns, self._frames.odom, self._frames.vehicle, odom_from_vehicle)

    def mounting_transform(self, stamp_ns: int, vehicle_from_radar: Pose2 = _ORIGIN) -> Any:
        """The radar on the vehicle."""
        return self._transform(stamp_ns, self._frames.vehicle, self._frames.radar, vehicle_from_radar)

    def _transform(self, stamp_ns: int, parent: str, child: str, pose: Pose2) -> Any:
        transform = self._make(
            "geometry_msgs/msg/Transform",
            translation=self._vector(pose.x_m, pose.y_m),
            rotation=self._turn(pose.yaw_rad),
        )
        header = self._header(stamp_ns, parent)
        return self._make(
            "geometry_msgs/msg/TransformStamped", header=header, child_frame_id=child, transform=transform
        )

    def _wall(self, stamp_ns: int, at: int, wall: Wall) -> Any:
        return self._marker(
            stamp_ns,
            "walls",
            at,
            _LINE_STRIP,
            scale_m=(WALL_WIDTH_M, 0.0, 0.0),
            colour=WALL_COLOUR,
            line_m=wall_line_m(wall),
        )

    def _object(self, stamp_ns: int, hidden: HiddenObject) -> Any:
        return self._marker(
            stamp_ns,
            "objects",
            hidden.id & _MARKER_NUMBERS,
            _CUBE,
            pose=Pose2(*hidden.box_centre_m, hidden.yaw_rad),
            z_m=0.5 * OBJECT_HEIGHT_M,
            scale_m=(hidden.length_m, hidden.width_m, OBJECT_HEIGHT_M),
            colour=OBJECT_COLOUR,
            text=f"{hidden.object_class} score {hidden.score:.6g}".lstrip(),
        )

    def _track_arrow(self, stamp_ns: int, track: Track) -> Any:
        end_m = (track.x_m + _TRACK_SHOWN_S * track.velocity_x_mps, track.y_m + _TRACK_SHOWN_S * track.velocity_y_mps)
        return self._marker(
            stamp_ns,
            "tracks",
            track.id & _MARKER_NUMBERS,
            _ARROW,
            z_m=OBJECT_HEIGHT_M,
            scale_m=(0.5 * POINT_SIZE_M, POINT_SIZE_M, POINT_SIZE_M),
            colour=TRACK_COLOUR,
            line_m=((track.x_m, track.y_m), end_m),
            text=f"track {track.id}",
        )

    def _detection(self, stamp_ns: int, hidden: HiddenObject) -> Any:
        pose = self._pose(Pose2(hidden.x_m, hidden.y_m, hidden.yaw_rad), 0.5 * OBJECT_HEIGHT_M)
        covariance = np.zeros((6, 6))
        covariance[:2, :2] = hidden.cov_m2
        with_pose = self._make(
            "vision_msgs/msg/ObjectHypothesisWithPose",
            hypothesis=self._make("vision_msgs/msg/ObjectHypothesis", class_id=hidden.object_class, score=hidden.score),
            pose=self._make("geometry_msgs/msg/PoseWithCovariance", pose=pose, covariance=covariance.ravel()),
        )
        box = self._pose(Pose2(*hidden.box_centre_m, hidden.yaw_rad), 0.5 * OBJECT_HEIGHT_M)
        size = self._vector(hidden.length_m, hidden.width_m, OBJECT_HEIGHT_M)
        return self._make(
            "vision_msgs/msg/Detection3D",
            header=self._header(stamp_ns, self._frames.radar),
            results=[with_pose],
            bbox=self._make("vision_msgs/msg/BoundingBox3D", center=box, size=size),
            id=str(hidden.id),
        )

    def _radar_track(self, track: Track) -> Any:
        number = (track.id % (1 << 8 * _UUID_BYTES)).to_bytes(_UUID_BYTES, "big")
        unknown = np.zeros(6, np.float32)
        return self._make(
            "radar_msgs/msg/RadarTrack",
            uuid=self._make("unique_identifier_msgs/msg/UUID", uuid=np.frombuffer(number, np.uint8)),
            position=self._make("geometry_msgs/msg/Point", x=track.x_m, y=track.y_m, z=0.0),
            velocity=self._vector(track.velocity_x_mps, track.velocity_y_mps),
            acceleration=self._vector(0.0),
            size=self._vector(0.0),
            classification=0,
            position_covariance=_upper_triangle(track.cov_m2),
            velocity_covariance=_upper_triangle(track.velocity_cov_m2ps2),
            acceleration_covariance=unknown,
            size_covariance=unknown,
        )

    def _marker(
        self,
        stamp_ns: int,
        namespace: str,
        number: int,
        kind: int,
        *,
        action: int = _ADD,
        pose: Pose2 = _ORIGIN,
        z_m: float = 0.0,
        scale_m: Sequence[float] = (0.0, 0.0, 0.0),
        colour: Colour = (0.0, 0.0, 0.0, 0.0),
        line_m: Iterable[tuple[float, float]] = (),
        text: str = "",
    ) -> Any:
        none = np.zeros(0, np.uint8)
        time = self._make("builtin_interfaces/msg/Time", sec=0, nanosec=0)
        return self._make(
            "visualization_msgs/msg/Marker",
            header=self._header(stamp_ns, self._frames.radar),
            ns=namespace,
            id=number,
            type=kind,
            action=action,
            pose=self._pose(pose, z_m),
            scale=self._vector(*scale_m),
            color=self._make("std_msgs/msg/ColorRGBA", **dict(zip("rgba", colour, strict=True))),
            lifetime=self._make("builtin_interfaces/msg/Duration", sec=0, nanosec=0),
            frame_locked=False,
            points=[self._make("geometry_msgs/msg/Point", x=x, y=y, z=0.0) for x, y in line_m],
            colors=[],
            texture_resource="",
            texture=self._make(
                "sensor_msgs/msg/CompressedImage",
                header=self._make("std_msgs/msg/Header", stamp=time, frame_id=""),
                format="",
                data=none,
            ),
            uv_coordinates=[],
            text=text,
            mesh_resource="",
            mesh_file=self._make("visualization_msgs/msg/MeshFile", filename="", data=none),
            mesh_use_embedded_materials=False,
        )

    def _header(self, stamp_ns: int, frame: str) -> Any:
        return self._make("std_msgs/msg/Header", stamp=self._time(stamp_ns), frame_id=frame)

    def _time(self, stamp_ns: int) -> Any:
        seconds, nanoseconds = stamp_parts(stamp_ns + self.offset_ns)
        return self._make("builtin_interfaces/msg/Time", sec=seconds, nanosec=nanoseconds)

    def _pose(self, pose: Pose2, z_m: float = 0.0) -> Any:
        position = self._make("geometry_msgs/msg/Point", x=pose.x_m, y=pose.y_m, z=z_m)
        return self._make("geometry_msgs/msg/Pose", position=position, orientation=self._turn(pose.yaw_rad))

    def _turn(self, yaw_rad: float) -> Any:
        z, w = quaternion_zw(yaw_rad)
        return self._make("geometry_msgs/msg/Quaternion", x=0.0, y=0.0, z=z, w=w)

    def _vector(self, x: float, y: float = 0.0, z: float = 0.0) -> Any:
        return self._make("geometry_msgs/msg/Vector3", x=x, y=y, z=z)

    def _make(self, kind: str, **fields: Any) -> Any:
        return self._types[kind](**fields)


def _upper_triangle(covariance: Covariance | None) -> np.ndarray:
    """Return xx, xy, xz, yy, yz, zz, float32; zeros where it is not known."""
    (xx, xy), (_, yy) = covariance or ((0.0, 0.0), (0.0, 0.0))
    with np.errstate(over="ignore"):
        return np.array([xx, xy, 0.0, yy, 0.0, 0.0]).astype(np.float32)
