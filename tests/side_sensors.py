"""A cloud and a JPEG for tests: of a LiDAR and a camera beside the radar."""

from __future__ import annotations

import io
from collections.abc import Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
from PIL import Image

from contrib.ros2.point_cloud2 import LidarMounting, lidar_points
from msgs.values.lidar import LidarPoints

#: Fields of a point as the driver of an Ouster lays them out: name, offset, type by ROS's number; 48 bytes a point.
OUSTER = (
    ("x", 0, 7), ("y", 4, 7), ("z", 8, 7), ("intensity", 16, 7), ("t", 20, 6), ("reflectivity", 24, 4), ("ring", 26, 4),
    ("ambient", 28, 4), ("range", 32, 6),
)  # fmt: skip
_NUMPY = {4: "<u2", 6: "<u4", 7: "<f4"}
OUSTER_DTYPE = np.dtype(
    {
        "names": [name for name, _, _ in OUSTER],
        "formats": [_NUMPY[kind] for _, _, kind in OUSTER],
        "offsets": [offset for _, offset, _ in OUSTER],
        "itemsize": 48,
    }
)


def jpeg(width: int = 32, height: int = 16, seed: int = 0) -> bytes:
    out = io.BytesIO()
    pixels = np.random.default_rng(seed).integers(0, 256, (height, width, 3), np.uint8)
    Image.fromarray(pixels).save(out, "JPEG", quality=80)
    return out.getvalue()


def ouster_points(rows: int = 4, columns: int = 8, seed: int = 0) -> np.ndarray:
    """A turn of an Ouster [rows * columns]: a wall 10 m ahead, and ground."""
    rng = np.random.default_rng(seed)
    points = np.zeros(rows * columns, OUSTER_DTYPE)
    points["x"], points["y"] = 10.0, np.tile(np.linspace(-5.0, 5.0, columns, dtype=np.float32), rows)
    points["z"] = np.repeat(np.linspace(-1.8, 0.8, rows, dtype=np.float32), columns)
    points["intensity"] = rng.random(len(points), np.float32)
    points["ring"], points["t"] = np.repeat(np.arange(rows), columns), np.arange(len(points))
    return points


def point_cloud2(points: np.ndarray | None = None, rows: int = 4, **changes: Any) -> SimpleNamespace:
    """The points as a `sensor_msgs/PointCloud2`."""
    points = ouster_points(rows) if points is None else points
    fields = [SimpleNamespace(name=name, offset=offset, datatype=kind, count=1) for name, offset, kind in OUSTER]
    values: dict[str, Any] = {
        "header": SimpleNamespace(frame_id="os_lidar", stamp=SimpleNamespace(sec=1, nanosec=5)),
        "height": rows, "width": len(points) // rows, "point_step": 48, "row_step": 48 * (len(points) // rows),
        "fields": fields, "is_bigendian": False, "data": np.frombuffer(points.tobytes(), np.uint8), "is_dense": True,
    }  # fmt: skip
    return SimpleNamespace(**(values | changes))


def cloud(points: np.ndarray | None = None, stamp_ns: int = 1, scan_id: int = 0, rows: int = 4) -> LidarPoints:
    return lidar_points(point_cloud2(points, rows), stamp_ns, scan_id, LidarMounting())


def as_ros(store: Any, kind: str, value: Any) -> Any:
    """Plain fields as a message of a type store of rosbags."""
    if not isinstance(value, SimpleNamespace):
        return value
    inner = {"header": "std_msgs/msg/Header", "stamp": "builtin_interfaces/msg/Time"}
    fields = {name: as_ros(store, inner.get(name, ""), field) for name, field in vars(value).items()}
    if "fields" in fields:
        fields["fields"] = [store.types["sensor_msgs/msg/PointField"](**vars(field)) for field in fields["fields"]]
    return store.types[kind](**fields)


def write_bag(path: Path, messages: Sequence[tuple[str, str, int, Any]], storage: str = "mcap") -> Path:
    """A ROS 2 bag folder of (topic, type, time, fields), written by rosbags with its own types."""
    from rosbags.rosbag2 import StoragePlugin, Writer
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_JAZZY)

    with Writer(path, version=9, storage_plugin=StoragePlugin[storage.upper()]) as bag:
        connections: dict[str, Any] = {}
        for topic, kind, time_ns, fields in messages:
            if topic not in connections:
                connections[topic] = bag.add_connection(topic, kind, typestore=store)
            bag.write(connections[topic], time_ns, store.serialize_cdr(as_ros(store, kind, fields), kind))
    return path


def header(stamp_ns: int, frame_id: str) -> SimpleNamespace:
    seconds, nanoseconds = divmod(stamp_ns, 10**9)
    return SimpleNamespace(stamp=SimpleNamespace(sec=seconds, nanosec=nanoseconds), frame_id=frame_id)


def compressed_image(data: bytes, stamp_ns: int = 1, kind: str = "jpeg") -> SimpleNamespace:
    return SimpleNamespace(header=header(stamp_ns, "front"), format=kind, data=np.frombuffer(data, np.uint8))
