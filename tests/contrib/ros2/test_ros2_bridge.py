"""Node `ros2`: what another program in its domain receives, what it takes from there, and what it refuses."""

from __future__ import annotations

import importlib.util
import itertools
import json
import logging
import os
import select
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import psutil
import pytest

from contrib.ros2 import ros2_link
from contrib.ros2.point_cloud2 import LidarMounting
from contrib.ros2.ros2_bridge import (
    CameraParams,
    DetectionParams,
    LidarParams,
    OdometryParams,
    Params,
    Ros2Bridge,
    RosClock,
    create,
)
from contrib.ros2.ros2_messages import Frames
from contrib.ros2.ros2_topics import PUBLISHED, Ros2Topic
from msgs.bus.interface import Envelope, Outgoing, Received
from msgs.bus.topics import TOPICS
from msgs.files.shipped import CHECKOUT
from msgs.values.diagnostics import NodeState
from msgs.values.frames import Pose2
from msgs.values.perception import Peaks
from msgs.values.vehicle import VehicleState
from nodes.node import load_node
from tests.fuzz.cases import no_peaks, ra_map, status, view
from tests.side_sensors import as_ros, compressed_image, jpeg, ouster_points, point_cloud2

needs_rosbags = pytest.mark.skipif(
    importlib.util.find_spec("rosbags") is None, reason="rosbags is not installed (extra: ros2)"
)
needs_dds = pytest.mark.skipif(
    importlib.util.find_spec("cyclonedds") is None, reason="cyclonedds is not installed (extra: ros2)"
)
NOW_NS = 10**12
PEER = Path(__file__).with_name("ros2_peer.py")
#: What type support of ROS 2 Jazzy announces for nav_msgs/msg/OccupancyGrid.
HASH = "typehash=RIHS01_8d348150c12913a31ee0ec170fbf25089e4745d17035792a1ba94d6f0bc0cfc7;"
#: A process that hears nothing for so long is stuck.
PATIENCE_S = 60.0
_DOMAINS = itertools.count(os.getpid() % 100)


def own_domain() -> int:
    """A domain that no other test of this machine is likely to use; ROS 2 itself uses 0 to 101."""
    return 120 + next(_DOMAINS) % 100


def received(message: Any) -> Received:
    topic = next(name for name, facts in TOPICS.items() if facts.type is type(message))
    return Received(topic, message, Envelope(publisher="test", topic=topic, sequence=0, sent_ns=0))


# without DDS: a link that keeps what is written


class StandInEnd:
    """Both ends of a topic: keeps what is written, gives what is put in."""

    def __init__(self, topic: Ros2Topic) -> None:
        self.topic, self.name = topic, topic.name
        self.sent: list[bytes] = []
        self.waiting: list[bytes] = []
        self.policy = ""
        self.is_wanted = self.takes = True

    def write(self, cdr: bytes) -> bool:
        if self.takes:
            self.sent.append(cdr)
        return self.takes

    def take(self) -> list[bytes]:
        taken, self.waiting = self.waiting, []
        return taken

    def mismatch(self) -> str:
        policy, self.policy = self.policy, ""
        return policy


class StandInLink:
    """A link without a network."""

    descriptor = -1

    def __init__(self) -> None:
        self.ends: dict[str, StandInEnd] = {}

    def writer(self, topic: Ros2Topic) -> StandInEnd:
        return self.ends.setdefault(topic.name, StandInEnd(topic))

    reader = writer

    def clear(self) -> None:
        pass

    def close(self) -> None:
        pass


class Stand:
    """The node on a stand-in link."""

    def __init__(self, **params: Any) -> None:
        from contrib.ros2.ros2_types import type_store

        self.store, self.link = type_store(), StandInLink()
        self.node = Ros2Bridge(Params(**params), self.link, self.store)  # type: ignore[arg-type]

    def sent(self, name: str) -> list[Any]:
        """Messages of a topic, by its name in ROS 2."""
        end = self.link.ends[name]
        return [self.store.deserialize_cdr(cdr, end.topic.kind) for cdr in end.sent]

    def step(self, *messages: Any, now_ns: int = NOW_NS) -> list[Outgoing]:
        return self.node.step([received(message) for message in messages], now_ns)

    def put(self, name: str, kind: str, message: Any) -> bytes:
        cdr = bytes(self.store.serialize_cdr(message, kind))
        self.link.ends[name].waiting.append(cdr)
        return cdr


def states(count: int = 3) -> list[VehicleState]:
    return [VehicleState(stamp_ns=NOW_NS + at * 10**8, speed_mps=10.0) for at in range(count)]


@needs_rosbags
def test_each_topic_carries_what_the_graph_says() -> None:
    stand = Stand()
    stand.step(view(3, NOW_NS), ra_map(3, NOW_NS), *states(), no_peaks(3, NOW_NS), status(NOW_NS))
    stand.step(no_peaks(4, NOW_NS))
    assert {name: len(end.sent) for name, end in stand.link.ends.items()} == {
        **dict.fromkeys(PUBLISHED, 1), "odom": 3, "tf": 3
    }  # fmt: skip
    (transform,) = stand.sent("tf")[-1].transforms
    assert (transform.header.frame_id, transform.child_frame_id) == ("odom", "base_link")
    assert transform.transform.translation.x == pytest.approx(2.0)
    (mount,) = stand.sent("tf_static")[0].transforms
    assert (mount.header.frame_id, mount.child_frame_id) == ("base_link", "radar")


@needs_rosbags
def test_an_empty_map_and_no_noise_are_an_image_too() -> None:
    stand = Stand()
    silent = msgspec.structs.replace(ra_map(0, NOW_NS), values=np.zeros((48, 64), np.complex64), noise_power_mw=0.0)
    stand.step(silent)
    assert not stand.sent("ra_map")[0].data.any()


@needs_rosbags
def test_stamps_are_those_of_the_wall_clock() -> None:
    stand = Stand()
    now_ns = time.monotonic_ns()
    before_ns = time.time_ns() - 50_000_000
    stand.step(view(0, now_ns - 50_000_000), now_ns=now_ns)
    stamp = stand.sent("visibility")[0].header.stamp
    assert before_ns <= stamp.sec * 10**9 + stamp.nanosec <= time.time_ns()


@needs_rosbags
def test_stamps_of_another_clock_become_those_of_arrival() -> None:
    stand = Stand(stamps="arrival")
    before_ns = time.time_ns()
    stand.step(view(0, 5), view(1, 6), now_ns=time.monotonic_ns())
    for grid in stand.sent("visibility"):
        stamp_ns = grid.header.stamp.sec * 10**9 + grid.header.stamp.nanosec
        assert before_ns - 10**9 < stamp_ns <= time.time_ns()


def test_the_clock_follows_steps_and_no_jitter(monkeypatch: pytest.MonkeyPatch, caplog: Any) -> None:
    clock, wall_ns = RosClock(), [10**18]
    monkeypatch.setattr(time, "time_ns", lambda: wall_ns[0])
    assert clock.update(0) == 10**18
    wall_ns[0] += 300_000_000
    assert clock.update(0) == 10**18, "a busy machine"
    wall_ns[0] = 10**18 - 1000
    assert clock.update(0) == 10**18 - 1000, "a better measurement"
    wall_ns[0] = 10**18 + 5 * 10**9
    with caplog.at_level(logging.WARNING):
        assert clock.update(0) == 10**18 + 5 * 10**9
    assert "the wall clock was set by 5.000 s" in caplog.text


@needs_rosbags
def test_names_frames_and_what_is_left_out() -> None:
    frames = Frames(radar="corner_radar", vehicle="car", odom="world")
    stand = Stand(frames=frames, topics={"hidden_objects": "/corner/objects", "ra_map": ""})
    assert "radar/ra_map" not in stand.node.inputs
    stand.step(view(0, NOW_NS), *states(1))
    assert stand.sent("corner/objects")[0].markers[1].header.frame_id == "corner_radar"
    assert stand.sent("odom")[0].child_frame_id == "car"


@needs_rosbags
def test_nothing_is_built_without_a_reader_but_what_late_joiners_get() -> None:
    stand = Stand()
    for end in stand.link.ends.values():
        end.is_wanted = end.topic.latched
    stand.step(view(0, NOW_NS), *states(1))
    assert {name for name, end in stand.link.ends.items() if end.sent} == {"visibility"}


@needs_rosbags
def test_a_reader_that_takes_nothing_is_counted() -> None:
    stand = Stand()
    stand.link.ends["hidden_points"].takes = False
    stand.step(view(0, NOW_NS), view(1, NOW_NS))
    (count,) = stand.node.shed.counts()
    assert (count.what, count.reason, count.count) == ("/hidden_points message", "a reader takes nothing", 2)


@needs_rosbags
@pytest.mark.parametrize("broken", [msgspec.structs.replace(view(0, NOW_NS), stamp_ns=1 << 62)], ids=["stamp"])
def test_a_message_that_ros_2_cannot_hold_is_one_line(broken: Any, caplog: Any) -> None:
    stand = Stand()
    with caplog.at_level(logging.WARNING):
        stand.step(broken, broken)
    assert [record.getMessage().startswith("message refused: BevFrame: ") for record in caplog.records] == [True]
    assert stand.node.health()[0] is NodeState.DEGRADED
    assert stand.node.shed.counts()[0].count == 2


@needs_rosbags
def test_a_state_that_is_not_valid_moves_nothing() -> None:
    stand = Stand()
    stand.step(VehicleState(stamp_ns=NOW_NS, valid=False))
    assert not stand.link.ends["odom"].sent
    assert stand.node.shed.counts()[0].what == "state"


@needs_rosbags
def test_a_mounting_is_published_again_once_it_changes() -> None:
    stand = Stand()
    first = no_peaks(0, NOW_NS)
    moved: Peaks = msgspec.structs.replace(first, vehicle_from_radar=Pose2(1.0, 0.5, 0.1))
    stand.step(first, first, moved, moved)
    assert [each.transforms[0].transform.translation.x for each in stand.sent("tf_static")] == [0.0, 1.0]


@needs_rosbags
def test_a_mismatch_of_quality_is_one_line_with_topic_and_policy(caplog: Any) -> None:
    stand = Stand(detections=DetectionParams(topic="/radar/points"))
    stand.link.ends["hidden_points"].policy = "durability"
    stand.link.ends["radar/points"].policy = "reliability"
    with caplog.at_level(logging.WARNING):
        stand.step(now_ns=NOW_NS)
        stand.step(now_ns=NOW_NS + 10**6)
    assert [record.getMessage() for record in caplog.records] == [
        "/hidden_points: a reader has another quality of service and is left out: durability",
        "/radar/points: a publisher has another quality of service and is left out: reliability",
    ]


# what comes from ROS 2


def scan_message(stand: Stand, rows: list[tuple[float, ...]], stamp_ns: int) -> Any:
    types = stand.store.types
    stamp = types["builtin_interfaces/msg/Time"](sec=stamp_ns // 10**9, nanosec=stamp_ns % 10**9)
    header = types["std_msgs/msg/Header"](stamp=stamp, frame_id="radar")
    names = ("range", "azimuth", "elevation", "doppler_velocity", "amplitude")
    returns = [types["radar_msgs/msg/RadarReturn"](**dict(zip(names, row, strict=True))) for row in rows]
    return types["radar_msgs/msg/RadarScan"](header=header, returns=returns)


def scan_stand() -> Stand:
    return Stand(detections=DetectionParams(type="scan"), stamps="arrival")


SCAN = "radar_msgs/msg/RadarScan"


@needs_rosbags
def test_returns_become_detections_and_those_that_are_no_numbers_are_counted() -> None:
    stand = scan_stand()
    rows = [(20.0, 0.1, 0.0, -3.0, 5.0), (float("nan"), 0.1, 0.0, 0.0, 5.0), (30.0, -0.2, 0.0, 1.0, 9.0)]
    stand.put("radar/detections", SCAN, scan_message(stand, rows, 0))
    ((topic, detections),) = stand.step()
    assert (topic, detections.stamp_ns, len(detections)) == ("radar/detections", NOW_NS, 2)
    np.testing.assert_allclose(detections.azimuth_rad, [0.1, -0.2], rtol=1e-6)
    np.testing.assert_allclose(detections.radial_speed_mps, [-3.0, 1.0])
    (count,) = stand.node.shed.counts()
    assert (count.what, count.reason, count.count) == ("detection", "range is no number", 1)


@needs_rosbags
def test_a_message_cut_at_any_byte_is_refused_or_whole(caplog: Any) -> None:
    stand = scan_stand()
    whole = stand.put("radar/detections", SCAN, scan_message(stand, [(20.0, 0.1, 0.0, -3.0, 5.0)] * 3, 0))
    stand.step()
    for size in range(len(whole)):
        stand.link.ends["radar/detections"].waiting.append(whole[:size])
        assert len(stand.step()) <= 1
    assert stand.node.health()[0] is NodeState.DEGRADED
    stand.link.ends["radar/detections"].waiting.append(whole)
    assert len(stand.step()) == 1
    assert stand.node.health()[0] is NodeState.READY


@needs_rosbags
def test_a_length_of_billions_is_refused_at_once() -> None:
    stand = scan_stand()
    whole = bytearray(stand.put("radar/detections", SCAN, scan_message(stand, [], 0)))
    whole[-4:] = b"\xff\xff\xff\xff"
    stand.link.ends["radar/detections"].waiting = [bytes(whole)]
    assert stand.step() == []


def cloud_message(stand: Stand, **changes: Any) -> Any:
    types = stand.store.types
    header = scan_message(stand, [], 0).header
    names = ("x", "y", "z", "doppler", "rcs")
    point = types["sensor_msgs/msg/PointField"]
    fields = [point(name=name, offset=4 * at, datatype=7, count=1) for at, name in enumerate(names)]
    data = np.array([[20.0, 2.0, 0.5, -3.0, 5.0]] * 4, "<f4")
    given = {"header": header, "height": 1, "width": 4, "fields": fields, "is_bigendian": False, "point_step": 20,
             "row_step": 80, "data": np.frombuffer(data.tobytes(), np.uint8), "is_dense": True}  # fmt: skip
    return types["sensor_msgs/msg/PointCloud2"](**(given | changes))


@needs_rosbags
def test_a_cloud_becomes_detections() -> None:
    stand = Stand(detections=DetectionParams(), stamps="arrival")
    stand.put("radar/detections", "sensor_msgs/msg/PointCloud2", cloud_message(stand))
    ((_, detections),) = stand.step()
    np.testing.assert_allclose(detections.range_m, np.full(4, np.sqrt(20.0**2 + 2.0**2 + 0.5**2)))


@needs_rosbags
@pytest.mark.parametrize(
    ("changes", "rule"),
    [
        ({"width": 5}, "data must hold 100 bytes"),
        ({"point_step": 8}, "does not fit into points of 8 bytes"),
        ({"width": 4_000_000_000, "height": 4_000_000_000}, "row_step must be at least"),
        ({"fields": []}, "x.column must be one of"),
    ],
)
def test_a_malformed_cloud_is_one_line(changes: dict[str, Any], rule: str, caplog: Any) -> None:
    stand = Stand(detections=DetectionParams(), stamps="arrival")
    with caplog.at_level(logging.WARNING):
        for _ in range(3):
            stand.put("radar/detections", "sensor_msgs/msg/PointCloud2", cloud_message(stand, **changes))
        assert stand.step() == []
    (record,) = caplog.records
    assert record.getMessage().startswith("message refused: /radar/detections: ")
    assert rule in record.getMessage()


@needs_rosbags
def test_a_stamp_of_another_clock_is_one_line() -> None:
    stand = Stand(detections=DetectionParams(type="scan"))
    stand.put("radar/detections", SCAN, scan_message(stand, [(20.0, 0.1, 0.0, -3.0, 5.0)], 12_345))
    assert stand.step() == []
    state, reason = stand.node.health()
    assert state is NodeState.DEGRADED
    assert "header.stamp must be within 60 s of now" in reason
    assert "stamps: arrival" in reason


@needs_rosbags
@pytest.mark.parametrize(("speed_mps", "is_good"), [(12.5, True), (float("nan"), False), (1e300, False)])
def test_odometry_becomes_a_state(speed_mps: float, is_good: bool) -> None:
    stand = Stand(odometry=OdometryParams())
    assert "tf" not in stand.link.ends
    assert "vehicle/state" not in stand.node.inputs
    graph_state = VehicleState(stamp_ns=0, speed_mps=1.0, yaw_rate_rps=0.2)
    odometry = Stand().node._build.odometry(graph_state, Pose2())
    odometry.twist.twist.linear.x = speed_mps
    wall_ns = time.time_ns()
    odometry.header.stamp.sec, odometry.header.stamp.nanosec = divmod(wall_ns, 10**9)
    stand.put("odom", "nav_msgs/msg/Odometry", odometry)
    outgoing = stand.step(now_ns=time.monotonic_ns())
    assert bool(outgoing) is is_good
    if is_good:
        state = outgoing[0].message
        assert (state.speed_mps, state.yaw_rate_rps) == (12.5, 0.2)
        assert abs(state.stamp_ns - time.monotonic_ns()) < 60 * 10**9


# parameters


@needs_rosbags
def test_clouds_and_images_come_in_byte_for_byte_and_what_is_none_is_one_line(caplog: Any) -> None:
    stand = Stand(stamps="arrival", lidar=LidarParams(mounting=LidarMounting(x_m=1.0)), camera=CameraParams())
    assert {"lidar/points", "camera/image"} == set(stand.node.outputs)
    assert not {"lidar/points", "camera/image"} & set(stand.node.inputs)
    points, picture = ouster_points(), jpeg()
    lidar, camera = "ouster/points", "camera/image_raw/compressed"
    kinds = {lidar: "sensor_msgs/msg/PointCloud2", camera: "sensor_msgs/msg/CompressedImage"}

    def put(name: str, message: Any) -> None:
        stand.put(name, kinds[name], as_ros(stand.store, kinds[name], message))

    for name, good, bad in (
        (lidar, point_cloud2(points), point_cloud2(data=np.zeros(9, np.uint8))),
        (camera, compressed_image(picture), compressed_image(b"GIF89a")),
    ):
        put(name, bad)
        put(name, good)
    out = stand.step(now_ns=NOW_NS)
    assert [each.topic for each in out] == ["lidar/points", "camera/image"]
    cloud, image = (each.message for each in out)
    assert cloud.data.tobytes() == points.tobytes()
    assert (cloud.stamp_ns, cloud.sensor, cloud.vehicle_from_lidar.x_m) == (NOW_NS, "os_lidar", 1.0)
    assert (image.jpeg.tobytes(), image.width_px, image.height_px) == (picture, 32, 16)
    lines = [record.getMessage() for record in caplog.records if "refused" in record.getMessage()]
    assert len(lines) == 2
    assert "/ouster/points: data must hold 1536 bytes for 4 x 8 points, got 9" in lines[0]
    assert "/camera/image_raw/compressed: image must be a JPEG, or PNG" in lines[1]


@pytest.mark.parametrize(
    ("params", "rule"),
    [
        ({"lidar": {"mounting": {"height_m": -1.0}}}, "mounting.height_m must lie in 0..100, got -1.0"),
        ({"camera": {"type": "h264"}}, "ros2_bridge.params.camera.type: Invalid enum value 'h264'"),
        ({"domain": -1}, "domain must be 0..232, got -1"),
        ({"domain": 233}, "domain must be 0..232, got 233"),
        ({"interface": "no_such0"}, "interface must be one of .*lo.*, got 'no_such0'"),
        ({"interface": ""}, "interface must be one of .*, got ''"),
        ({"topics": {"objects": "/x"}}, "topics.objects is not published; hidden_objects, .* are"),
        ({"topics": {"ra_map": "a b"}}, "topics.ra_map must be letters.*got 'a b'"),
        ({"topics": {"ra_map": "/odom"}}, "topics must have different names in ROS 2, got odom twice"),
        ({"frames": {"radar": "odom"}}, "frames must have different names"),
        ({"detections": {"topic": "9x"}}, "topic must be letters"),
        ({"detections": {"type": "list"}}, "ros2_bridge.params.detections.type: Invalid enum value 'list'"),
        ({"detections": {"mapping": "nowhere.yaml"}}, "nowhere.yaml"),
        ({"stamps": "now"}, "ros2_bridge.params.stamps"),
    ],
)
@needs_dds
@needs_rosbags
def test_wrong_parameters_are_one_line(params: dict[str, Any], rule: str) -> None:
    given = {"domain": own_domain()} | params
    with pytest.raises((ValueError, OSError), match=rule) as caught:
        load_node("contrib.ros2.ros2_bridge", given)
    assert "\n" not in str(caught.value)


@needs_dds
@needs_rosbags
def test_an_interface_that_is_down_is_one_line(monkeypatch: pytest.MonkeyPatch, domain: int) -> None:
    monkeypatch.setattr(psutil, "net_if_addrs", lambda: {"down0": []})
    with pytest.raises(OSError, match=rf"^domain {domain} cannot be joined on down0: is it up, with an address\?$"):
        create(Params(domain=domain, interface="down0"))


@pytest.mark.parametrize("library", ["cyclonedds", "rosbags"])
@needs_dds
@needs_rosbags
def test_without_its_libraries_it_names_the_extra(library: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, library, None)
    with pytest.raises(ValueError, match=rf"needs {library}, which is not installed: pip install 'mirrorwave\[ros2\]'"):
        load_node("contrib.ros2.ros2_bridge", {})


def test_the_configuration_keeps_to_one_interface() -> None:
    assert '<NetworkInterface name="lo"/>' in ros2_link.domain_config("lo")
    assert "<AllowMulticast>false" in ros2_link.domain_config("lo")
    assert "AllowMulticast" not in ros2_link.domain_config("eth0")
    assert """name='"/&gt;&lt;x'""" in ros2_link.domain_config('"/><x')


def test_the_guide_has_the_table_of_the_code() -> None:
    text = (CHECKOUT / "docs/guides/ros2.md").read_text(encoding="utf-8")
    rows = [line.strip("| ").split(" | ") for line in text.splitlines() if line.startswith("| `/")]
    promised = {row[0].strip("`/"): (row[1].strip("`"), row[3]) for row in rows}
    expected = {
        name: (
            topic.kind,
            f"{'reliable' if topic.reliable else 'best effort'}, "
            f"{'transient local' if topic.latched else 'volatile'}, depth {topic.depth}",
        )
        for name, topic in PUBLISHED.items()
    }
    assert promised == expected


# with DDS: another program in the domain


@contextmanager
def peer(*words: str | int) -> Iterator[subprocess.Popen[str]]:
    """Another process in the domain; it ends with the block."""
    command = [sys.executable, str(PEER), *map(str, words)]
    process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, bufsize=1)
    try:
        yield process
    finally:
        process.communicate(timeout=PATIENCE_S)


def until(is_done: Callable[[], bool], step: Callable[[], object]) -> None:
    """Step until a condition holds."""
    end_s = time.monotonic() + PATIENCE_S
    while not is_done():
        assert time.monotonic() < end_s, "nothing came"
        step()
        time.sleep(0.02)


def lines_of(process: subprocess.Popen[str], count: int) -> list[dict[str, Any]]:
    assert process.stdout is not None
    return [json.loads(process.stdout.readline()) for _ in range(count)]


@pytest.fixture
def domain() -> int:
    return own_domain()


@pytest.mark.graph
@needs_dds
@needs_rosbags
def test_a_late_joiner_gets_the_latched_grid_with_type_and_hash(domain: int) -> None:
    node = create(Params(domain=domain))
    try:
        node.step([received(view(0, NOW_NS))], NOW_NS)
        with peer("listen", domain, "rt/visibility", "OccupancyGrid", "latched", "reliable") as process:
            about, first = lines_of(process, 2)
    finally:
        node.close()
    assert about["user_data"] == HASH
    assert about["type"] == "nav_msgs::msg::dds_::OccupancyGrid_"
    grid = first["message"]
    assert (grid["info"]["width"], grid["info"]["height"], grid["header"]["frame_id"]) == (5, 6, "radar")
    assert set(grid["data"]) == {50}


@pytest.mark.graph
@needs_dds
@needs_rosbags
def test_a_program_in_another_domain_hears_nothing(domain: int) -> None:
    """It began to listen before one in the same domain, which has heard the latched grid meanwhile."""
    node = create(Params(domain=domain))
    words = "rt/visibility", "OccupancyGrid", "latched", "reliable"
    try:
        node.step([received(view(0, NOW_NS))], NOW_NS)
        with peer("listen", own_domain(), *words) as stranger, peer("listen", domain, *words) as process:
            lines_of(process, 2)
            heard, _, _ = select.select([stranger.stdout], [], [], 1.0)
    finally:
        node.close()
    assert not heard


@pytest.mark.graph
@needs_dds
@needs_rosbags
@pytest.mark.skipif(not os.environ.get("MIRRORWAVE_RCLPY"), reason="MIRRORWAVE_RCLPY names no interpreter with rclpy")
def test_a_node_of_ros_2_receives_and_knows_the_types(domain: int) -> None:
    """Every topic whose types that ROS 2 has; those that ROS 2 itself brings are among them."""
    node = create(Params(domain=domain))
    script = CHECKOUT / "tests/contrib/ros2/ros2_subscriber.py"
    environment = os.environ | {"ROS_DOMAIN_ID": str(domain), "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}
    environment.pop("PYTHONPATH", None)
    command = [os.environ["MIRRORWAVE_RCLPY"], str(script)]
    process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=environment)
    try:
        (about,) = lines_of(process, 1)
        names = [name.removeprefix("/") for name in about["subscribed"]]
        until(lambda: all(node._writers[name].is_wanted for name in names), lambda: None)
        now_ns = time.monotonic_ns()
        stepped = [view(3, now_ns), ra_map(3, now_ns), states(1)[0], no_peaks(3, now_ns), status(now_ns)]
        node.step([received(message) for message in stepped], now_ns)
        topics = {line["topic"] for line in lines_of(process, len(names))}
    finally:
        # the subscriber compares the hashes once it is told to end, while the node is there
        out, _ = process.communicate(timeout=PATIENCE_S)
        node.close()
    assert {"hidden_objects", "hidden_points", "visibility", "ra_map", "odom", "diagnostics"} <= set(names)
    assert topics == set(about["subscribed"])
    hashes = [json.loads(line) for line in out.splitlines()]
    assert {line["hash_of"] for line in hashes if line["agrees"]} == topics


@pytest.mark.graph
@needs_dds
@needs_rosbags
def test_a_reader_with_another_quality_is_named(domain: int, caplog: Any) -> None:
    node = create(Params(domain=domain))
    try:
        with peer("listen", domain, "rt/hidden_tracks", "RadarTracks", "latched", "reliable"):
            until(lambda: bool(caplog.records), lambda: node.step([], time.monotonic_ns()))
    finally:
        node.close()
    line = "/hidden_tracks: a reader has another quality of service and is left out: durability"
    assert [record.getMessage() for record in caplog.records] == [line]


@pytest.mark.graph
@needs_dds
@needs_rosbags
def test_detections_and_odometry_of_another_program(domain: int) -> None:
    node = create(
        Params(domain=domain, stamps="arrival", detections=DetectionParams(type="scan"), odometry=OdometryParams())
    )
    out: list[Outgoing] = []
    returns = {"returns": [{"range": 20.0, "azimuth": 0.1, "doppler_velocity": -3.0, "amplitude": 5.0}]}
    twist = {"twist": {"twist": {"linear": {"x": 7.0}, "angular": {"z": 0.25}}}}
    try:
        with (
            peer("publish", domain, "rt/radar/detections", "RadarScan", json.dumps(returns)),
            peer("publish", domain, "rt/odom", "Odometry", json.dumps(twist)),
        ):
            until(
                lambda: {each.topic for each in out} == {"radar/detections", "vehicle/state"},
                lambda: out.extend(node.step([], time.monotonic_ns())),
            )
    finally:
        node.close()
    detections = next(each.message for each in out if each.topic == "radar/detections")
    state = next(each.message for each in out if each.topic == "vehicle/state")
    np.testing.assert_allclose(detections.range_m, [20.0])
    assert (state.speed_mps, state.yaw_rate_rps) == (7.0, 0.25)


@needs_dds
@needs_rosbags
def test_it_leaves_the_domain_and_comes_back(domain: int) -> None:
    for _ in range(3):
        node = create(Params(domain=domain, detections=DetectionParams()))
        assert node.watched()
        node.close()
