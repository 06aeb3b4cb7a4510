"""Types of ROS 2 messages, by the library rosbags, with those of `radar_msgs` and `vision_msgs` beside its own."""

from __future__ import annotations

from typing import Any

IMAGE, COMPRESSED_IMAGE = "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"
CLOUD, SCAN = "sensor_msgs/msg/PointCloud2", "radar_msgs/msg/RadarScan"
#: Types that become messages of sensors beside the radar.
SIDE_KINDS = (CLOUD, COMPRESSED_IMAGE, IMAGE)
#: Fields of a return in `radar_msgs`, all float32: m, rad, rad, m/s, dB.
RETURN_FIELDS = ("range", "azimuth", "elevation", "doppler_velocity", "amplitude")

#: Fields by type, as ROS 2 releases since Humble define them; their order makes the hash of a type.
_FIELDS = {
    "radar_msgs/msg/RadarReturn": tuple(f"float32 {name}" for name in RETURN_FIELDS),
    SCAN: ("std_msgs/Header header", "radar_msgs/RadarReturn[] returns"),
    "radar_msgs/msg/RadarTrack": (
        "unique_identifier_msgs/UUID uuid",
        "geometry_msgs/Point position",
        *(f"geometry_msgs/Vector3 {name}" for name in ("velocity", "acceleration", "size")),
        "uint16 classification",
        *(f"float32[6] {name}_covariance" for name in ("position", "velocity", "acceleration", "size")),
    ),
    "radar_msgs/msg/RadarTracks": ("std_msgs/Header header", "radar_msgs/RadarTrack[] tracks"),
    "vision_msgs/msg/ObjectHypothesis": ("string class_id", "float64 score"),
    "vision_msgs/msg/ObjectHypothesisWithPose": (
        "vision_msgs/ObjectHypothesis hypothesis",
        "geometry_msgs/PoseWithCovariance pose",
    ),
    "vision_msgs/msg/BoundingBox3D": ("geometry_msgs/Pose center", "geometry_msgs/Vector3 size"),
    "vision_msgs/msg/Detection3D": (
        "std_msgs/Header header",
        "vision_msgs/ObjectHypothesisWithPose[] results",
        "vision_msgs/BoundingBox3D bbox",
        "string id",
    ),
    "vision_msgs/msg/Detection3DArray": ("std_msgs/Header header", "vision_msgs/Detection3D[] detections"),
}


def type_store() -> Any:
    """Return the types of ROS 2 Jazzy; raises `ImportError` without rosbags."""
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores.ROS2_JAZZY)
    for name, fields in _FIELDS.items():
        store.register(get_types_from_msg("\n".join(fields), name))
    return store
