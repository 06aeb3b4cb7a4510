"""Recordings as a ROS 2 bag (MCAP storage) with standard messages, written by the library rosbags."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np

from msgs.recording.mcap import Recorded, RecordingReader
from msgs.values.frames import Pose2
from msgs.values.perception import BevFrame, HiddenObject, Visibility, Wall
from msgs.values.vehicle import VehicleState
from nodes.bridges.shapes import (
    OBJECT_COLOUR,
    OBJECT_HEIGHT_M,
    WALL_COLOUR,
    WALL_WIDTH_M,
    Account,
    Colour,
    Odometry,
    counted,
    quaternion_zw,
    stamp_parts,
    wall_line_m,
)

TOPICS = ("perception/hidden_objects", "vehicle/state")
RADAR, VEHICLE, ODOM = "radar", "base_link", "odom"
#: Of the metadata file: ROS 2 Jazzy's.
BAG_VERSION: Literal[9] = 9
#: The mask as an occupancy grid. It says nothing of occupancy; the values tell its three states apart.
OCCUPANCY = {Visibility.UNKNOWN: -1, Visibility.DIRECT: 0, Visibility.MIRRORED: 50}
POINT_DTYPE = np.dtype([("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("score", "<f4")])

_ORIGIN = Pose2()
_FLOAT32 = 7
_CUBE, _LINE_STRIP, _ADD, _DELETE_ALL = 1, 4, 0, 3


def require_library() -> None:
    """Raise `ImportError` that names the package where rosbags is not installed."""
    try:
        import rosbags.rosbag2  # noqa: F401
    except ImportError as error:
        raise ImportError("rosbags, which --to ros2 needs (pip install rosbags)") from error


def write(
    reader: RecordingReader, out: Path, topics: tuple[str, ...], account: Account, advance: Callable[[], None]
) -> None:
    """Write the topics as a bag folder; bag times are those of the recording, header stamps the messages' own."""
    require_library()
    from rosbags.rosbag2 import StoragePlugin, Writer

    with Writer(out, version=BAG_VERSION, storage_plugin=StoragePlugin.MCAP) as bag:
        sink = _Sink(bag, account)
        for recorded in counted(reader, topics, account, advance):
            sink.take(recorded)


class _Sink:
    """Turns messages into ROS's and writes them."""

    def __init__(self, bag: Any, account: Account) -> None:
        from rosbags.typesys import Stores, get_typestore

        self._bag, self._account = bag, account
        self._store = get_typestore(Stores.ROS2_JAZZY)
        self._build = _Builder(self._store.types)
        self._connections: dict[str, Any] = {}
        self._odometry = Odometry()

    def take(self, recorded: Recorded) -> None:
        """Write what a message becomes."""
        message, time_ns = recorded.message, recorded.log_time_ns
        if isinstance(message, BevFrame):
            self._put("/hidden_points", self._build.cloud(message), time_ns)
            self._put("/hidden_objects", self._build.markers(message), time_ns)
            self._put("/visibility", self._build.occupancy(message), time_ns)
        elif isinstance(message, VehicleState):
            self._take_state(message, recorded)

    def _take_state(self, state: VehicleState, recorded: Recorded) -> None:
        pose = self._odometry.advance(state)
        if pose is None:
            self._account.leave_out(recorded.topic, Odometry.REFUSED)
            return
        self._put("/odom", self._build.odometry(state, pose), recorded.log_time_ns)
        self._put("/tf", self._build.transforms(state, pose), recorded.log_time_ns)

    def _put(self, topic: str, message: Any, time_ns: int) -> None:
        kind = message.__msgtype__
        if topic not in self._connections:
            self._connections[topic] = self._bag.add_connection(topic, kind, typestore=self._store)
        self._bag.write(self._connections[topic], time_ns, self._store.serialize_cdr(message, kind))


class _Builder:
    """Builds standard messages of the types of one type store."""

    def __init__(self, types: Any) -> None:
        self._types = types

    def cloud(self, frame: BevFrame) -> Any:
        """Recovered points: x, y, z (0) in metres and score, float32."""
        points = np.array([(point.x_m, point.y_m, 0.0, point.score) for point in frame.points], POINT_DTYPE)
        names = POINT_DTYPE.names or ()
        fields = [
            self._make("sensor_msgs/msg/PointField", name=name, offset=4 * at, datatype=_FLOAT32, count=1)
            for at, name in enumerate(names)
        ]
        return self._make(
            "sensor_msgs/msg/PointCloud2",
            header=self._header(frame.stamp_ns, RADAR),
            height=1,
            width=len(points),
            fields=fields,
            is_bigendian=False,
            point_step=POINT_DTYPE.itemsize,
            row_step=points.nbytes,
            data=np.frombuffer(points.tobytes(), np.uint8),
            is_dense=True,
        )

    def markers(self, frame: BevFrame) -> Any:
        """All markers of a scan, after one that clears those of the scan before."""
        clear = self._marker(frame.stamp_ns, "", 0, _CUBE, action=_DELETE_ALL)
        walls = [self._wall(frame.stamp_ns, at, wall) for at, wall in enumerate(frame.walls)]
        objects = [self._object(frame.stamp_ns, hidden) for hidden in frame.objects]
        return self._make("visualization_msgs/msg/MarkerArray", markers=[clear, *walls, *objects])

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
        header = self._header(frame.stamp_ns, RADAR)
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
            header=self._header(state.stamp_ns, ODOM),
            child_frame_id=VEHICLE,
            pose=pose,
            twist=self._make("geometry_msgs/msg/TwistWithCovariance", twist=twist, covariance=np.zeros(36)),
        )

    def transforms(self, state: VehicleState, odom_from_vehicle: Pose2) -> Any:
        """odom -> base_link, and base_link -> radar as the same place."""
        chain = ((ODOM, VEHICLE, odom_from_vehicle), (VEHICLE, RADAR, _ORIGIN))
        return self._make(
            "tf2_msgs/msg/TFMessage", transforms=[self._transform(state.stamp_ns, *each) for each in chain]
        )

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
            hidden.id,
            _CUBE,
            pose=Pose2(hidden.x_m, hidden.y_m, hidden.yaw_rad),
            z_m=0.5 * OBJECT_HEIGHT_M,
            scale_m=(hidden.length_m, hidden.width_m, OBJECT_HEIGHT_M),
            colour=OBJECT_COLOUR,
            text=f"{hidden.object_class} score {hidden.score:.6g}".lstrip(),
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
        time = self._time(0)
        return self._make(
            "visualization_msgs/msg/Marker",
            header=self._header(stamp_ns, RADAR),
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
        seconds, nanoseconds = stamp_parts(stamp_ns)
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
