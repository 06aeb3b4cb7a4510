"""Recorded clouds and images into the graph, into a recording and out again; what cannot be read costs one line."""

from __future__ import annotations

import importlib.util
import io
import json
import logging
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from PIL import Image

from contrib.imports.jpeg import jpeg_of_pixels
from contrib.imports.recorded_sensors import Params, create
from contrib.ros2.point_cloud2 import LidarMounting
from contrib.ros2.ros2_inputs import CloudInput, ImageInput
from mirrorwave.cli import main
from msgs.bus.interface import Outgoing, Received
from msgs.bus.local import LocalNetwork
from msgs.recording.mcap import RecordingReader
from msgs.values.camera import CameraImage
from msgs.values.diagnostics import NodeState
from msgs.values.lidar import LidarPoints
from nodes.node import InProcessGraph, Node
from tests.side_sensors import compressed_image, header, jpeg, ouster_points, point_cloud2, write_bag

CLOUD, COMPRESSED, RAW = (f"sensor_msgs/msg/{name}" for name in ("PointCloud2", "CompressedImage", "Image"))
EPOCH_NS = 1_700_000_000_000_000_000
PERIOD_NS = 100_000_000
needs_rosbags = pytest.mark.skipif(
    importlib.util.find_spec("rosbags") is None, reason="rosbags is not installed (extra: convert)"
)


def held(path: Path) -> tuple[list[LidarPoints], list[CameraImage]]:
    with RecordingReader(path) as reader:
        messages = [each.message for each in reader.messages()]
    return (
        [each for each in messages if isinstance(each, LidarPoints)],
        [each for each in messages if isinstance(each, CameraImage)],
    )


def imported(capsys: pytest.CaptureFixture[str], out: Path, *words: str) -> tuple[int, dict[str, Any], str]:
    code = main(["import", "sensors", *words, "--out", str(out), "--json"])
    said = capsys.readouterr()
    return code, json.loads(said.out) if said.out else {}, said.err


def rig_bag(path: Path, count: int = 3, storage: str = "mcap") -> tuple[list[np.ndarray], list[bytes]]:
    """A bag of clouds and images; their points and JPEGs."""
    clouds, images = [ouster_points(seed=at) for at in range(count)], [jpeg(seed=at) for at in range(count)]
    messages = []
    for at in range(count):
        stamp_ns = EPOCH_NS + at * PERIOD_NS
        cloud = point_cloud2(clouds[at], header=header(stamp_ns, "os_lidar"))
        messages.append(("/ouster/points", CLOUD, stamp_ns + 5, cloud))
        messages.append(("/cam/compressed", COMPRESSED, stamp_ns + 7, compressed_image(images[at], stamp_ns + 2)))
        # of the same camera, uncompressed: passed over
        pixels = SimpleNamespace(
            header=header(stamp_ns + 2, "front"), height=1, width=1, encoding="rgb8", is_bigendian=0, step=3,
            data=np.zeros(3, np.uint8),
        )  # fmt: skip
        messages.append(("/cam", RAW, stamp_ns + 6, pixels))
    write_bag(path, messages, storage)
    return clouds, images


@needs_rosbags
@pytest.mark.parametrize("storage", ["mcap", "sqlite3"])
def test_a_bag_goes_in_and_out_byte_for_byte(tmp_path: Path, capsys: pytest.CaptureFixture[str], storage: str) -> None:
    """In as a recording, out as a bag, in again: fields, points, images and stamps are the same; Foxglove's too."""
    clouds, images = rig_bag(tmp_path / "bag", storage=storage)
    code, counts, _ = imported(capsys, tmp_path / "a.mcap", str(tmp_path / "bag"), "--lidar-at", "1,0.5,2,90")
    assert (code, counts["clouds"], counts["images"], counts["refused"], counts["notes"]) == (0, 3, 3, [], [])
    assert main(["bag", "convert", str(tmp_path / "a.mcap"), str(tmp_path / "out"), "--to", "ros2"]) == 0
    capsys.readouterr()
    code, counts, _ = imported(capsys, tmp_path / "b.mcap", str(tmp_path / "out"))
    assert (code, counts["clouds"], counts["images"]) == (0, 3, 3)
    for path in (tmp_path / "a.mcap", tmp_path / "b.mcap"):
        points, shots = held(path)
        assert [each.data.tobytes() for each in points] == [each.tobytes() for each in clouds]
        assert [each.jpeg.tobytes() for each in shots] == images
        assert [each.stamp_ns for each in points] == [EPOCH_NS + at * PERIOD_NS for at in range(3)]
        assert [each.stamp_ns for each in shots] == [EPOCH_NS + 2 + at * PERIOD_NS for at in range(3)]
        assert [(each.scan_id, each.rows, each.sensor) for each in points] == [(at, 4, "os_lidar") for at in range(3)]
        assert points[0].table()["ring"].tolist() == clouds[0]["ring"].tolist()
    mounting = held(tmp_path / "a.mcap")[0][0]
    assert (mounting.vehicle_from_lidar.x_m, mounting.lidar_height_m) == (1.0, 2.0)
    foxglove = foxglove_messages(tmp_path / "a.mcap", tmp_path / "fox.mcap")
    assert [each["data"] for each in foxglove["/lidar/points"]] == [each.tobytes() for each in clouds]
    assert [each["data"] for each in foxglove["/camera/image"]] == images
    assert foxglove["/lidar/points"][0]["fields"][3] == {"name": "intensity", "offset": 16, "type": 7}
    assert foxglove["/camera/image"][0]["format"] == "jpeg"


def foxglove_messages(recording: Path, out: Path) -> dict[str, list[dict[str, Any]]]:
    import base64

    from mcap.reader import make_reader

    assert main(["bag", "convert", str(recording), str(out)]) == 0
    messages: dict[str, list[dict[str, Any]]] = {}
    with out.open("rb") as file:
        for _, channel, message in make_reader(file).iter_messages():
            body = json.loads(message.data)
            messages.setdefault(channel.topic, []).append(body | {"data": base64.b64decode(body["data"])})
    return messages


def rig_folders(folder: Path, count: int = 4) -> tuple[Path, Path]:
    clouds, images = folder / "clouds", folder / "images"
    clouds.mkdir()
    images.mkdir()
    for at in range(count):
        points = np.full((5, 4), at, np.float32)
        np.save(clouds / f"{at}.npy", points) if at % 2 else (clouds / f"{at}.bin").write_bytes(points.tobytes())
        (images / f"{at}.jpg").write_bytes(jpeg(seed=at))
    return clouds, images


class Listener(Node):
    inputs = ("lidar/points", "camera/image")

    def __init__(self) -> None:
        super().__init__()
        self.messages: list[Any] = []

    def step(self, inputs: list[Received], now_ns: int) -> list[Outgoing]:
        self.messages += [each.message for each in inputs]
        return []


def test_directories_play_on_the_bus_clock_and_again(tmp_path: Path) -> None:
    """Ten clouds and images a second in the order of their numbers; at the end it begins again."""
    clouds, images = rig_folders(tmp_path, 12)
    network = LocalNetwork(start_ns=5_000_000_000)
    listener = Listener()
    node = create(Params(sources=(str(clouds), str(images)), loop=True, mounting=LidarMounting(height_m=2.5)))
    graph = InProcessGraph(network, {"rig": node, "listener": listener})
    graph.run(until_ns=5_000_000_000 + 13 * PERIOD_NS)
    points = [each for each in listener.messages if isinstance(each, LidarPoints)]
    shots = [each for each in listener.messages if isinstance(each, CameraImage)]
    assert [each.positions_m()[0, 0] for each in points] == [*range(12), 0, 1]
    assert {each.lidar_height_m for each in points} == {2.5}
    assert [each.jpeg.tobytes() for each in shots] == [jpeg(seed=at) for at in (*range(12), 0, 1)]
    for messages in (points, shots):
        assert [each.stamp_ns for each in messages] == [5_000_000_000 + at * PERIOD_NS for at in range(14)]
    assert node.health() == (NodeState.READY, "")
    graph.close()


PLY = (
    "ply\nformat {} 1.0\nelement vertex 2\nproperty float x\nproperty float y\nproperty float z\n"
    "property uchar i\nend_header\n"
)
PCD = (
    "VERSION 0.7\nFIELDS x y z _ i\nSIZE 4 4 4 1 1\nTYPE F F F U U\nCOUNT 1 1 1 3 1\nWIDTH 2\nHEIGHT 1\n"
    "VIEWPOINT 0 0 0 1 0 0 0\nPOINTS 2\nDATA {}\n"
)


@pytest.mark.parametrize("name", ["text.ply", "little.ply", "big.ply", "text.pcd", "binary.pcd"])
def test_files_of_clouds_keep_their_fields_and_cut_ones_are_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], name: str
) -> None:
    kind = {"text": "ascii", "little": "binary_little_endian", "big": "binary_big_endian", "binary": "binary"}
    stem, suffix = name.split(".")
    order = ">" if stem == "big" else "<"
    gap = [("gap", "3u1")] if suffix == "pcd" else []
    table = np.zeros(2, [*((axis, f"{order}f4") for axis in "xyz"), *gap, ("i", "u1")])
    table["x"], table["i"] = (1.5, np.nan), (7, 200)
    lines = [f"{x} 0 0 {'0 0 0 ' if gap else ''}{i}" for x, i in zip(table["x"], table["i"], strict=True)]
    body = "\n".join(lines).encode() if stem == "text" else table.tobytes()
    content = (PLY if suffix == "ply" else PCD).format(kind[stem]).encode() + body
    (tmp_path / f"0.{suffix}").write_bytes(content)
    # of text the cut takes the last line
    (tmp_path / f"1.{suffix}").write_bytes(content[: -len(lines[1]) - 1 if stem == "text" else -1])
    code, counts, err = imported(capsys, tmp_path / "a.mcap", str(tmp_path))
    assert (code, counts["clouds"], len(counts["refused"])) == (3, 1, 1)
    assert f"1.{suffix}: header promises 2 points, the file ends before: it is cut off" in err
    (points,) = held(tmp_path / "a.mcap")[0]
    assert [field.name for field in points.fields] == ["x", "y", "z", "i"]
    assert (points.table()["x"][0], points.table()["i"].tolist()) == (1.5, [7, 200])
    assert len(points.positions_m()) == 1


def test_names_that_are_stamps_are_kept(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    names = ("1700000000.5", "1700000000_250000000", "1700000000750", "1700000001000000000")
    for at, name in enumerate(names):
        (tmp_path / f"{name}.jpg").write_bytes(jpeg(seed=at))
    assert imported(capsys, tmp_path / "a.mcap", str(tmp_path))[0] == 0
    stamps_s = [1e-9 * (each.stamp_ns - EPOCH_NS) for each in held(tmp_path / "a.mcap")[1]]
    assert stamps_s == pytest.approx([0.25, 0.5, 0.75, 1.0])


def png(width: int = 8) -> bytes:
    out = io.BytesIO()
    Image.new("RGB", (width, 4), (200, 10, 10)).save(out, "PNG")
    return out.getvalue()


def sized(data: bytes, width: int, height: int) -> bytes:
    """A JPEG whose header claims another size."""
    at = data.index(b"\xff\xc0")
    return data[: at + 5] + height.to_bytes(2, "big") + width.to_bytes(2, "big") + data[at + 9 :]


def field(name: str, offset: int, datatype: int, count: int = 1) -> SimpleNamespace:
    return SimpleNamespace(name=name, offset=offset, datatype=datatype, count=count)


XYZ = [field("x", 0, 7), field("y", 4, 7), field("z", 8, 7)]
BAD_CLOUDS: dict[str, tuple[dict[str, Any], str]] = {
    "cut off": ({"data": np.zeros(100, np.uint8)}, "data must hold 1536 bytes"),
    "empty": ({"width": 0, "row_step": 0, "data": np.zeros(0, np.uint8)}, "cloud must hold a point, got 4 x 0"),
    "no step": ({"point_step": 0, "row_step": 0}, "cloud must hold a point"),
    "no z": ({"fields": XYZ[:2]}, "must hold z as float32 or float64, there are x, y"),
    "z of whole numbers": ({"fields": [*XYZ[:2], field("z", 8, 5)]}, "must hold z as float32 or float64, is int32"),
    "outside": ({"fields": [*XYZ, field("far", 46, 7)]}, "'far' must end within the point's 48 bytes, ends at 50"),
    "one name twice": ({"fields": [*XYZ, field("x", 12, 7)]}, "must have different names"),
    "unknown type": ({"fields": [*XYZ, field("odd", 12, 99)]}, "field 'odd' of type 99 at 12 must be of type 1..11"),
    "absurd": ({"width": 1 << 31, "row_step": 48}, "cloud must have at most 15728640 bytes"),
    "large point": ({"point_step": 1 << 31, "row_step": 1 << 31}, "cloud must have at most 15728640 bytes"),
}
BAD_IMAGES: dict[str, tuple[bytes, str]] = {
    "no image": (b"#!/bin/sh\n", "image must be a JPEG"),
    "empty": (b"", "image must be a JPEG, it is empty"),
    "cut off": (jpeg()[:-200], "image must be a whole JPEG, it is cut off"),
    "cut in its header": (jpeg()[:30], "image must be a whole JPEG, it is cut off"),
    "absurd": (sized(jpeg(), 65535, 65535), "pixels a side and 67108864 in all, got 65535 x 65535"),
    "large": (jpeg()[:-2] + bytes(8 << 20) + b"\xff\xd9", "image must have at most 7340032 bytes"),
    "cut PNG": (png(400)[:60], "image cannot be read"),
}


@pytest.mark.parametrize("name", BAD_CLOUDS)
def test_a_bad_cloud_is_one_line(name: str) -> None:
    changes, said = BAD_CLOUDS[name]
    with pytest.raises(ValueError) as refused:
        CloudInput(LidarMounting()).convert(point_cloud2(**changes), 5)
    assert said in str(refused.value)
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize("name", BAD_IMAGES)
def test_a_bad_image_is_one_line(name: str) -> None:
    data, said = BAD_IMAGES[name]
    with pytest.raises(ValueError) as refused:
        ImageInput().convert(compressed_image(data), 5)
    assert said in str(refused.value)
    assert "\n" not in str(refused.value)


def test_points_without_a_position_are_kept_and_clouds_turned_to_little_endian() -> None:
    points = ouster_points()
    points["x"][3] = np.nan
    points["z"][5] = np.inf
    message = CloudInput(LidarMounting()).convert(point_cloud2(points), 5).message
    assert isinstance(message, LidarPoints)
    assert message.data.tobytes() == points.tobytes()
    assert len(message.positions_m()) == len(points) - 2
    big = points.astype(points.dtype.newbyteorder(">"))
    turned = CloudInput(LidarMounting()).convert(point_cloud2(big, is_bigendian=True), 5).message
    assert isinstance(turned, LidarPoints)
    for column in points.dtype.names or ():
        assert turned.table()[column].tobytes() == points[column].tobytes()


@pytest.mark.parametrize(("encoding", "colour"), [("rgb8", (250, 20, 30)), ("bgr8", (30, 20, 250)), ("mono8", 120)])
def test_raw_pixels_are_compressed(encoding: str, colour: Any) -> None:
    """Rows may be longer than their pixels; red stays red."""
    pixels = np.zeros((16, 3 * 16 + 5 if encoding != "mono8" else 21), np.uint8)
    pixels[:, : 16 * np.size(colour)] = np.tile(colour, 16)
    image = SimpleNamespace(encoding=encoding, width=16, height=16, step=pixels.shape[1], data=pixels.ravel())
    shown = np.asarray(Image.open(io.BytesIO(jpeg_of_pixels(image))).convert("RGB"))[8, 8]
    expected = (250, 20, 30) if encoding != "mono8" else (120,) * 3
    assert shown == pytest.approx(expected, abs=12)
    for changes, said in ({"encoding": "yuv422"}, "encoding must be"), ({"height": 99}, "data must hold 99 rows"):
        with pytest.raises(ValueError, match=said):
            jpeg_of_pixels(SimpleNamespace(**(vars(image) | changes)))


@needs_rosbags
def test_bad_messages_and_files_cost_a_line_each_and_nothing_else(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], caplog: pytest.LogCaptureFixture
) -> None:
    """Of a bag and of directories, at import and live; exit code 3, and all that is sound comes through."""
    good = [("/p", CLOUD, EPOCH_NS + at, point_cloud2(header=header(EPOCH_NS + at, "l"))) for at in range(2)]
    nan = ouster_points()
    nan["x"][:7] = np.nan
    bad = [point_cloud2(**{"header": header(EPOCH_NS, "l"), **changes}) for changes, _ in BAD_CLOUDS.values()]
    clouds = [*good, *(("/p", CLOUD, EPOCH_NS + 10 + at, each) for at, each in enumerate(bad))]
    clouds.append(("/p", CLOUD, EPOCH_NS + 30, point_cloud2(nan, header=header(EPOCH_NS + 30, "l"))))
    images = [
        ("/i", COMPRESSED, EPOCH_NS + 40 + at, compressed_image(data, EPOCH_NS + 40 + at))
        for at, data in enumerate([jpeg(), *(data for data, _ in BAD_IMAGES.values()), png()])
    ]
    write_bag(tmp_path / "bag", [*clouds, *images])
    folder = tmp_path / "files"
    folder.mkdir()
    np.save(folder / "a.npy", np.ones((3, 4), np.float32))
    (folder / "b.npy").write_bytes((folder / "a.npy").read_bytes()[:-9])
    (folder / "c.bin").write_bytes(bytes(17))
    (folder / "d.bin").write_bytes(b"")
    (folder / "e.jpg").write_bytes(png())
    (folder / "f.png").write_bytes(png())
    code, counts, err = imported(capsys, tmp_path / "a.mcap", str(tmp_path / "bag"), str(folder))
    assert code == 3
    assert (counts["clouds"], counts["images"]) == (4, 3)
    assert counts["notes"] == ["7 points of 1 cloud have no position and are kept"]
    assert len(counts["refused"]) == len(BAD_CLOUDS) + len(BAD_IMAGES) + 4
    assert err.count("\n") == len(counts["refused"]) + 1
    for path in ("b.npy", "c.bin", "d.bin", "e.jpg"):
        assert any(str(folder / path) in line for line in counts["refused"])
    with caplog.at_level(logging.INFO):
        node = create(Params(sources=(str(tmp_path / "bag"), str(folder))))
        graph = InProcessGraph(LocalNetwork(), {"rig": node})
        graph.run()
        graph.close()
    assert sum(count.count for count in node.shed.counts()) == len(counts["refused"])
    assert sum("7 of 32 points have no position" in record.message for record in caplog.records) == 1


@pytest.mark.parametrize(
    ("make", "words", "said"),
    [
        (lambda path: path.mkdir(), (), "must hold clouds or images, by the ends of their names"),
        (lambda path: None, (), "must be a ROS bag or a directory"),
        (lambda path: path.write_bytes(b"x"), (), "must be a ROS bag or a directory"),
        (lambda path: rig_bag(path), ("--topic", "/none"), "topics must be of sensor_msgs/msg/PointCloud2"),
        (lambda path: rig_bag(path), ("--topic", "/cam", "--topic", "/cam/compressed"), "topics must name one with"),
        (lambda path: rig_bag(path), ("--rate-hz", "0"), "file_rate_hz must be"),
        (lambda path: rig_bag(path), ("--lidar-at", "1,2"), "--lidar-at must be four numbers"),
        (lambda path: rig_bag(path), ("--lidar-at", "nan,0,0,0"), "mounting.x_m and y_m must lie"),
    ],
)
@needs_rosbags
def test_sources_that_are_none_are_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], make: Callable[[Path], Any], words: tuple[str, ...], said: str
) -> None:
    make(tmp_path / "source")
    code, _, err = imported(capsys, tmp_path / "a.mcap", str(tmp_path / "source"), *words)
    assert (code, err.count("\n")) == (2, 1)
    assert said in err
    assert not (tmp_path / "a.mcap").exists()
