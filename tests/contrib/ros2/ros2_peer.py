"""Another program in the domain: cyclonedds with types written by hand, none of our code.

    python ros2_peer.py listen DOMAIN TOPIC TYPE [latched] [reliable]
    python ros2_peer.py publish DOMAIN TOPIC TYPE JSON

The first writes a line of JSON for each message and each publisher, the second sends the message ten times a second.
Both end when their standard input is closed.
"""

import dataclasses
import json
import sys
import threading
from dataclasses import dataclass
from typing import Any

from cyclonedds.core import Policy, Qos
from cyclonedds.domain import Domain, DomainParticipant
from cyclonedds.idl import IdlStruct
from cyclonedds.idl.types import array, float32, float64, int8, int32, sequence, uint8, uint16, uint32
from cyclonedds.pub import DataWriter
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic

CONFIG = """<CycloneDDS><Domain Id="any"><General><Interfaces><NetworkInterface name="lo"/></Interfaces>
<AllowMulticast>false</AllowMulticast></General><Discovery><ParticipantIndex>auto</ParticipantIndex>
<MaxAutoParticipantIndex>32</MaxAutoParticipantIndex><Peers><Peer Address="127.0.0.1"/></Peers></Discovery>
</Domain></CycloneDDS>"""


@dataclass
class Time(IdlStruct, typename="builtin_interfaces.msg.dds_.Time_"):
    sec: int32
    nanosec: uint32


@dataclass
class Header(IdlStruct, typename="std_msgs.msg.dds_.Header_"):
    stamp: Time
    frame_id: str


@dataclass
class Point(IdlStruct, typename="geometry_msgs.msg.dds_.Point_"):
    x: float64
    y: float64
    z: float64


@dataclass
class Vector3(IdlStruct, typename="geometry_msgs.msg.dds_.Vector3_"):
    x: float64
    y: float64
    z: float64


@dataclass
class Quaternion(IdlStruct, typename="geometry_msgs.msg.dds_.Quaternion_"):
    x: float64
    y: float64
    z: float64
    w: float64


@dataclass
class Pose(IdlStruct, typename="geometry_msgs.msg.dds_.Pose_"):
    position: Point
    orientation: Quaternion


@dataclass
class PoseWithCovariance(IdlStruct, typename="geometry_msgs.msg.dds_.PoseWithCovariance_"):
    pose: Pose
    covariance: array[float64, 36]


@dataclass
class Twist(IdlStruct, typename="geometry_msgs.msg.dds_.Twist_"):
    linear: Vector3
    angular: Vector3


@dataclass
class TwistWithCovariance(IdlStruct, typename="geometry_msgs.msg.dds_.TwistWithCovariance_"):
    twist: Twist
    covariance: array[float64, 36]


@dataclass
class Odometry(IdlStruct, typename="nav_msgs.msg.dds_.Odometry_"):
    header: Header
    child_frame_id: str
    pose: PoseWithCovariance
    twist: TwistWithCovariance


@dataclass
class MapMetaData(IdlStruct, typename="nav_msgs.msg.dds_.MapMetaData_"):
    map_load_time: Time
    resolution: float32
    width: uint32
    height: uint32
    origin: Pose


@dataclass
class OccupancyGrid(IdlStruct, typename="nav_msgs.msg.dds_.OccupancyGrid_"):
    header: Header
    info: MapMetaData
    data: sequence[int8]


@dataclass
class UUID(IdlStruct, typename="unique_identifier_msgs.msg.dds_.UUID_"):
    uuid: array[uint8, 16]


@dataclass
class RadarTrack(IdlStruct, typename="radar_msgs.msg.dds_.RadarTrack_"):
    uuid: UUID
    position: Point
    velocity: Vector3
    acceleration: Vector3
    size: Vector3
    classification: uint16
    position_covariance: array[float32, 6]
    velocity_covariance: array[float32, 6]
    acceleration_covariance: array[float32, 6]
    size_covariance: array[float32, 6]


@dataclass
class RadarTracks(IdlStruct, typename="radar_msgs.msg.dds_.RadarTracks_"):
    header: Header
    tracks: sequence[RadarTrack]


@dataclass
class RadarReturn(IdlStruct, typename="radar_msgs.msg.dds_.RadarReturn_"):
    range: float32
    azimuth: float32
    elevation: float32
    doppler_velocity: float32
    amplitude: float32


@dataclass
class RadarScan(IdlStruct, typename="radar_msgs.msg.dds_.RadarScan_"):
    header: Header
    returns: sequence[RadarReturn]


@dataclass
class Transform(IdlStruct, typename="geometry_msgs.msg.dds_.Transform_"):
    translation: Vector3
    rotation: Quaternion


@dataclass
class TransformStamped(IdlStruct, typename="geometry_msgs.msg.dds_.TransformStamped_"):
    header: Header
    child_frame_id: str
    transform: Transform


@dataclass
class TFMessage(IdlStruct, typename="tf2_msgs.msg.dds_.TFMessage_"):
    transforms: sequence[TransformStamped]


def quality(options: list[str], **more: Any) -> Qos:
    reliable, latched = Policy.Reliability.Reliable(1_000_000_000), Policy.Durability.TransientLocal
    return Qos(
        reliable if "reliable" in options else Policy.Reliability.BestEffort,
        latched if "latched" in options else Policy.Durability.Volatile,
        Policy.History.KeepLast(10),
        Policy.DataRepresentation(use_cdrv0_representation=True, use_xcdrv2_representation=False),
    )


def build(kind: Any, value: dict[str, Any]) -> Any:
    """A message from plain data, by the fields of its type; zeros where nothing is given."""
    fields = {}
    for field in dataclasses.fields(kind):
        given = value.get(field.name)
        if dataclasses.is_dataclass(field.type):
            fields[field.name] = build(field.type, given or {})
        elif field.name == "returns":
            fields[field.name] = [build(RadarReturn, each) for each in given or []]
        elif field.name == "covariance":
            fields[field.name] = [0.0] * 36
        else:
            fields[field.name] = given if given is not None else "" if field.type is str else 0
    return kind(**fields)


def listen(participant: DomainParticipant, topic: Topic, options: list[str], closed: threading.Event) -> None:
    reader = DataReader(participant, topic, qos=quality(options))
    hashes: set[str] = set()
    while not closed.wait(0.02):
        for handle in reader.get_matched_publications():
            data = reader.get_matched_publication_data(handle)
            text = "" if data is None else next((each.data.decode() for each in data.qos if is_userdata(each)), "")
            if text not in hashes:
                hashes.add(text)
                say({"user_data": text, "type": topic.typename})
        for sample in reader.take(N=10):
            say({"message": dataclasses.asdict(sample)})


def is_userdata(policy: Any) -> bool:
    return isinstance(policy, Policy.Userdata)


def publish(participant: DomainParticipant, topic: Topic, message: Any, closed: threading.Event) -> None:
    writer = DataWriter(participant, topic, qos=quality(["reliable"]))
    while not closed.wait(0.1):
        writer.write(message)


def say(value: dict[str, Any]) -> None:
    print(json.dumps(value, default=list), flush=True)


def main() -> None:
    verb, domain, name, kind, *options = sys.argv[1:]
    closed = threading.Event()

    def wait_for_end() -> None:
        sys.stdin.read()
        closed.set()

    threading.Thread(target=wait_for_end, daemon=True).start()
    whole = Domain(int(domain), CONFIG)
    participant = DomainParticipant(int(domain))
    topic = Topic(participant, name, globals()[kind])
    if verb == "listen":
        listen(participant, topic, options, closed)
    else:
        publish(participant, topic, build(globals()[kind], json.loads(options[0])), closed)
    del whole


if __name__ == "__main__":
    main()
