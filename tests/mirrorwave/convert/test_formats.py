"""`mirrorwave bag convert`: what other readers find in what it wrote."""

from __future__ import annotations

import base64
import importlib.util
import json
import math
import os
import zipfile
from pathlib import Path
from typing import Any

import jsonschema
import msgspec
import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.writer import Writer

from mirrorwave.cli import main
from mirrorwave.console import progress_bar
from mirrorwave.convert.formats import Format, convert, format_of
from msgs.recording.mcap import RecordingReader, RecordingWriter
from msgs.recording.sigmf import SigmfCapture
from msgs.values.diagnostics import LogRecord
from msgs.values.perception import (
    BevFrame,
    BevGrid,
    HiddenPoint,
    SceneTruth,
    TruthObject,
    TruthSurface,
    Wall,
)
from msgs.values.radar import BeamGrid, RadarBeam, RadarParams, RadarSetup
from msgs.values.vehicle import VehicleState
from nodes.recording.shapes import Odometry, wall_line_m
from tests.builders import beam_of, example_object, example_status, example_track, example_truth

GRID = BevGrid(x_min_m=0.0, y_min_m=-2.0, cell_m=1.0, rows=4, columns=6)
SETUP = RadarSetup(
    radar=RadarParams(chirps_per_beam=2, samples_per_chirp=64),
    beams=BeamGrid(azimuth_deg=(-10.0, 0.0, 10.0)),
    background=np.full((3, 64), 1.0 + 2.0j, np.complex64),
)
WALL = Wall(normal=(-1.0, 0.0), offset_m=22.0, ends_m=((22.0, -10.0), (22.0, 16.0)), inliers=9)
SCANS = 3
SCAN_NS = 300_000_000

needs_rosbags = pytest.mark.skipif(
    importlib.util.find_spec("rosbags") is None, reason="rosbags is not installed (extra: convert)"
)


def beam(scan: int, index: int) -> RadarBeam:
    samples = np.random.default_rng([scan, index]).integers(-999, 999, (2, 64, 2), dtype=np.int16)
    return beam_of(SETUP, index, samples, stamp_ns=scan * SCAN_NS + index, scan_id=scan, beam_count=3)


def frame(scan: int) -> BevFrame:
    """`scan` objects, two points, one wall; cells 0, 1, 2, 0, 1, ..."""
    objects = tuple(
        example_object(id=number, x_m=11.0 + scan, y_m=9.0, length_m=4.5, width_m=1.8, yaw_rad=0.5, score=0.75)
        for number in range(scan)
    )
    points = tuple(
        HiddenPoint(x_m=10.0 + at, y_m=8.0, score=0.5 + 0.25 * at, image_x_m=30.0, image_y_m=8.0, wall=0)
        for at in range(2)
    )
    track = example_track(id=7, x_m=11.0, y_m=9.0, velocity_x_mps=3.0, velocity_y_mps=4.0)
    return BevFrame(
        stamp_ns=scan * SCAN_NS,
        scan_id=scan,
        walls=(WALL,),
        points=points,
        objects=objects,
        tracks=(track,),
        los_points_m=np.array([[5.0, 1.0]], np.float32),
        grid=GRID,
        visibility=(np.arange(24, dtype=np.uint8) % 3).reshape(4, 6),
        flags=("incoherent",),
    )


def truth(scan: int) -> SceneTruth:
    none = np.zeros((0, 3), np.float32)
    car = TruthObject(id=0, object_class="car", x_m=11.0, y_m=9.0, length_m=4.5, width_m=1.8, yaw_rad=0.0)
    return example_truth(
        stamp_ns=scan * SCAN_NS,
        scan_id=scan,
        los_points_m=none,
        mirrored_points_m=none,
        hidden_points_m=none,
        objects=(car,),
        surfaces=(TruthSurface(role="relay", material="concrete", polyline_m=WALL.ends_m),),
    )


def record(path: Path, *, setup: bool = True) -> Path:
    """Three scans of three beams, a view and a truth each; eleven states of a straight drive at 10 m/s, one invalid."""
    rows: list[tuple[int, str, Any]] = [(0, "radar/setup", SETUP)] * setup
    for scan in range(SCANS):
        rows += [(scan * SCAN_NS + 1 + index, "radar/beam", beam(scan, index)) for index in range(3)]
        rows.append((scan * SCAN_NS + 10, "sim/truth", truth(scan)))
        rows.append((scan * SCAN_NS + 20, "perception/hidden_objects", frame(scan)))
    for at in range(11):
        stamp_ns = at * 100_000_000
        rows.append((stamp_ns, "vehicle/state", VehicleState(stamp_ns=stamp_ns, speed_mps=10.0, valid=at != 10)))
    rows.append((5, "log", LogRecord(stamp_ns=5, node="geometry", level="warning", text="few inliers")))
    rows.append((6, "diagnostics/node", example_status(stamp_ns=6)))
    with RecordingWriter(path, {"scene": "corner"}) as writer:
        for sequence, (sent_ns, topic, message) in enumerate(sorted(rows, key=lambda row: row[0])):
            writer.write(topic, message, publisher="test", sequence=sequence, sent_ns=sent_ns)
    return path


def said(capsys: pytest.CaptureFixture[str], code: int, *words: object) -> dict[str, Any]:
    assert main(["bag", "convert", *map(str, words), "--json"]) == code
    found: dict[str, Any] = json.loads(capsys.readouterr().out)
    return found


def json_rows(path: Path) -> dict[str, list[tuple[str, int, dict[str, Any]]]]:
    """Schema name, log time and body of each message by topic, each held against the schema in the file."""
    rows: dict[str, list[tuple[str, int, dict[str, Any]]]] = {}
    with path.open("rb") as file:
        for schema, channel, message in make_reader(file, validate_crcs=True).iter_messages():
            assert schema is not None
            assert (schema.encoding, channel.message_encoding) == ("jsonschema", "json")
            body = json.loads(message.data)
            jsonschema.validate(body, json.loads(schema.data))
            rows.setdefault(channel.topic, []).append((schema.name, message.log_time, body))
    return rows


def test_foxglove(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "out.mcap"
    found = said(capsys, 0, record(tmp_path / "a.mcap"), out)
    assert found["format"] == "foxglove"
    assert found["not_converted"] == {"radar/beam": 9}
    assert found["converted"] == {
        "perception/hidden_objects": 3,
        "sim/truth": 3,
        "vehicle/state": 11,
        "log": 1,
        "diagnostics/node": 1,
    }
    assert found["left_out"] == {"radar/setup: says only how long a scan lasts": 1}
    rows = json_rows(out)
    assert {topic: (len(each), each[0][0]) for topic, each in rows.items()} == {
        "/hidden_objects/scene": (3, "foxglove.SceneUpdate"),
        "/hidden_objects/visibility": (3, "foxglove.Grid"),
        "/sim/truth": (3, "foxglove.SceneUpdate"),
        # the mounting with each view, the pose with each valid state
        "/tf": (13, "foxglove.FrameTransform"),
        "/views": (3, "mirrorwave.View"),
        "/vehicle/state": (11, "mirrorwave.Vehicle"),
        "/nodes": (1, "mirrorwave.Node"),
        "/log": (1, "foxglove.Log"),
    }
    _, log_time_ns, scene = rows["/hidden_objects/scene"][2]
    assert log_time_ns == 2 * SCAN_NS + 20
    entities = {entity["id"]: entity for entity in scene["entities"]}
    assert all(entity["timestamp"] == {"sec": 0, "nsec": 2 * SCAN_NS} for entity in entities.values())
    assert {entity["frame_id"] for entity in entities.values()} == {"radar"}
    assert [(p["x"], p["y"]) for p in entities["walls"]["lines"][0]["points"]] == [(22.0, -10.0), (22.0, 16.0)]
    assert len(entities["objects"]["cubes"]) == 2
    cube = entities["objects"]["cubes"][0]
    assert (cube["pose"]["position"]["x"], cube["size"]["x"], cube["size"]["y"]) == (13.0, 4.5, 1.8)
    assert 2.0 * math.atan2(cube["pose"]["orientation"]["z"], cube["pose"]["orientation"]["w"]) == pytest.approx(0.5)
    assert entities["objects"]["metadata"][0] == {"key": "object 0 score", "value": "0.75"}
    assert [sphere["pose"]["position"]["x"] for sphere in entities["points"]["spheres"]] == [10.0, 11.0]
    assert entities["tracks"]["arrows"][0]["shaft_length"] == pytest.approx(5.0)


def test_foxglove_grid_transform_and_log(tmp_path: Path) -> None:
    out = tmp_path / "out.mcap"
    assert convert(record(tmp_path / "a.mcap"), out, Format.FOXGLOVE, progress_bar).loss is None
    rows = json_rows(out)
    grid = rows["/hidden_objects/visibility"][0][2]
    cells = np.frombuffer(base64.b64decode(grid["data"]), np.uint8).reshape(-1, grid["row_stride"])
    np.testing.assert_array_equal(cells, frame(0).visibility)
    assert (grid["column_count"], grid["cell_size"], grid["pose"]["position"]["y"]) == (6, {"x": 1.0, "y": 1.0}, -2.0)
    frames = {(body["parent_frame_id"], body["child_frame_id"]) for _, _, body in rows["/tf"]}
    assert frames == {("vehicle", "radar"), ("odom", "vehicle")}
    last = [body for _, _, body in rows["/tf"] if body["child_frame_id"] == "vehicle"][-1]
    assert last["translation"]["x"] == pytest.approx(9.0), "0.9 s at 10 m/s"
    assert rows["/log"][0][2]["level"] == 3


def test_foxglove_file_opens_in_its_middle(tmp_path: Path) -> None:
    """A viewer reads the index at the end and jumps; it must not have to read all that comes before."""
    out = tmp_path / "out.mcap"
    assert convert(record(tmp_path / "a.mcap"), out, Format.FOXGLOVE, progress_bar).loss is None
    with out.open("rb") as file:
        reader = make_reader(file)
        summary = reader.get_summary()
        assert summary is not None
        assert summary.chunk_indexes
        assert summary.statistics is not None
        assert summary.statistics.message_count == sum(summary.statistics.channel_message_counts.values()) == 38
        late = [message.log_time for _, _, message in reader.iter_messages(starting_at=2 * SCAN_NS)]
        assert late == sorted(late)
        assert late[0] >= 2 * SCAN_NS


@needs_rosbags
def test_ros2(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    from rosbags.highlevel import AnyReader

    out = tmp_path / "drive.ros2"
    found = said(capsys, 0, record(tmp_path / "a.mcap"), out)
    assert found["not_converted"] == {"log": 1, "radar/beam": 9, "radar/setup": 1, "sim/truth": 3}
    seen: dict[str, list[tuple[int, Any]]] = {}
    with AnyReader([out]) as reader:
        for connection, time_ns, raw in reader.messages():
            seen.setdefault(connection.topic, []).append((time_ns, reader.deserialize(raw, connection.msgtype)))
    assert {topic: (len(each), each[0][1].__msgtype__) for topic, each in seen.items()} == {
        "/hidden_points": (3, "sensor_msgs/msg/PointCloud2"),
        "/hidden_objects": (3, "visualization_msgs/msg/MarkerArray"),
        "/visibility": (3, "nav_msgs/msg/OccupancyGrid"),
        "/hidden_detections": (3, "vision_msgs/msg/Detection3DArray"),
        "/hidden_tracks": (3, "radar_msgs/msg/RadarTracks"),
        "/diagnostics": (1, "diagnostic_msgs/msg/DiagnosticArray"),
        "/odom": (10, "nav_msgs/msg/Odometry"),
        "/tf": (10, "tf2_msgs/msg/TFMessage"),
    }
    time_ns, cloud = seen["/hidden_points"][1]
    assert (time_ns, cloud.header.stamp.nanosec, cloud.header.frame_id) == (SCAN_NS + 20, SCAN_NS, "radar")
    kinds = np.dtype([(field.name, "<f4") for field in cloud.fields])
    points = np.frombuffer(cloud.data.tobytes(), kinds)
    assert points.tolist() == [(10.0, 8.0, 0.0, 0.5), (11.0, 8.0, 0.0, 0.75)]
    clear, wall, *objects, track = seen["/hidden_objects"][2][1].markers
    assert (track.ns, track.type) == ("tracks", 0)
    assert (clear.action, wall.type, [(p.x, p.y) for p in wall.points]) == (3, 4, [(22.0, -10.0), (22.0, 16.0)])
    assert [(each.ns, each.id, each.type, each.pose.position.x) for each in objects] == [
        ("objects", 0, 1, 13.0),
        ("objects", 1, 1, 13.0),
    ]
    grid = seen["/visibility"][0][1]
    assert (grid.info.width, grid.info.height, grid.info.resolution, grid.info.origin.position.y) == (6, 4, 1.0, -2.0)
    assert grid.data[:6].tolist() == [-1, 0, 50, -1, 0, 50]
    odometry = seen["/odom"][-1][1]
    assert odometry.pose.pose.position.x == pytest.approx(9.0)
    assert (odometry.twist.twist.linear.x, odometry.child_frame_id) == (10.0, "base_link")
    assert [(each.header.frame_id, each.child_frame_id) for each in seen["/tf"][0][1].transforms] == [
        ("odom", "base_link"),
        ("base_link", "radar"),
    ]


def test_sigmf_beams_are_byte_equal(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    found = said(capsys, 0, record(tmp_path / "a.mcap"), tmp_path / "out.sigmf-meta")
    assert found["converted"] == {"radar/beam": 9, "radar/setup": 1}
    capture = SigmfCapture.open(tmp_path / "out")
    assert capture.setup.radar == SETUP.radar
    assert capture.setup.background is not None
    assert capture.setup.background.tobytes() == np.full((3, 64), 1.0 + 2.0j, np.complex64).tobytes()
    beams = list(capture.beams())
    assert [(each.scan_id, each.beam_index) for each in beams] == [(scan, at) for scan in range(3) for at in range(3)]
    for each in beams:
        expected = beam(each.scan_id, each.beam_index)
        assert each.samples.tobytes() == expected.samples.tobytes()
        assert (each.stamp_ns, each.azimuth_rad) == (expected.stamp_ns, pytest.approx(expected.azimuth_rad))


def test_sigmf_needs_a_setup_and_rising_beams(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    source = record(tmp_path / "a.mcap", setup=False)
    assert main(["bag", "convert", str(source), str(tmp_path / "out"), "--to", "sigmf"]) == 2
    assert f"{source}: holds no readable radar/setup" in capsys.readouterr().err
    silent = tmp_path / "silent.mcap"
    with RecordingWriter(silent, {}) as writer:
        writer.write("radar/setup", SETUP, publisher="radar", sequence=0, sent_ns=0)
    assert main(["bag", "convert", str(silent), str(tmp_path / "out"), "--to", "sigmf"]) == 2
    assert "holds no radar/beam; raw beams are recorded with `bag record --raw`" in capsys.readouterr().err
    assert not list(tmp_path.glob("out*"))
    twice = tmp_path / "twice.mcap"
    with RecordingWriter(twice, {}) as writer:
        writer.write("radar/setup", SETUP, publisher="radar", sequence=0, sent_ns=0)
        for at, index in enumerate((0, 1, 1, 0, 2)):
            writer.write("radar/beam", beam(0, index), publisher="radar", sequence=at, sent_ns=at + 1)
    found = said(capsys, 3, twice, tmp_path / "out", "--to", "sigmf")
    assert found["converted"] == {"radar/beam": 3, "radar/setup": 1}
    assert "2 messages of radar/beam: late or twice" in found["loss"]
    assert len(SigmfCapture.open(tmp_path / "out")) == 3


def test_numpy(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "arrays"
    found = said(capsys, 0, record(tmp_path / "a.mcap"), out, "--to", "numpy")
    assert found["not_converted"] == {}
    index = json.loads((out / "index.json").read_text())
    assert index["metadata"] == {"scene": "corner"}
    assert sum(topic["messages"] for topic in index["topics"].values()) == sum(found["converted"].values())
    beams = index["topics"]["radar/beam"]
    with np.load(out / beams["file"], allow_pickle=False) as arrays:
        assert arrays["azimuth_rad"].shape == (9,)
        for row in beams["rows"]:
            (name,) = row["arrays"]
            expected = beam(row["scan_id"], row["beam_index"])
            assert arrays[name].dtype == np.int16
            assert arrays[name].tobytes() == expected.samples.tobytes()
    setup = index["topics"]["radar/setup"]["rows"][0]
    assert setup["arrays"] == ["background/000000"]
    assert setup["fields"]["radar"]["samples_per_chirp"] == 64


def test_numpy_tables_and_texts(tmp_path: Path) -> None:
    out = tmp_path / "arrays.npz"
    convert(record(tmp_path / "a.mcap"), out, format_of(out, None), progress_bar)
    index = json.loads((out / "index.json").read_text())
    assert index["topics"]["perception/hidden_objects"]["rows"][1]["fields"]["flags"] == ["incoherent"]
    with np.load(out / "perception_hidden_objects.npz", allow_pickle=False) as arrays:
        assert arrays["objects.row"].tolist() == [1, 2, 2]
        assert arrays["objects.x_m"].tolist() == [12.0, 13.0, 13.0]
        assert arrays["objects.cov_m2"].shape == (3, 2, 2)
        assert np.isnan(arrays["tracks.time_to_appear_s"]).all()
        assert arrays["walls.ends_m"][0].tolist() == [[22.0, -10.0], [22.0, 16.0]]
        np.testing.assert_array_equal(arrays["visibility/000002"], frame(2).visibility)
    with np.load(out / "sim_truth.npz", allow_pickle=False) as arrays:
        assert arrays["objects.object_class"].tolist() == ["car"] * 3
        assert [json.loads(text) for text in arrays["surfaces.polyline_m"]] == [[[22.0, -10.0], [22.0, 16.0]]] * 3
    with np.load(out / "log.npz", allow_pickle=False) as arrays:
        assert arrays["text"].tolist() == ["few inliers"]
    with np.load(out / "vehicle_state.npz", allow_pickle=False) as arrays:
        assert arrays["valid"].tolist() == [True] * 10 + [False]


@pytest.mark.parametrize(
    "target", [Format.FOXGLOVE, pytest.param(Format.ROS2, marks=needs_rosbags), Format.SIGMF, Format.NUMPY]
)
def test_a_cut_recording_is_converted_as_far_as_it_goes(
    tmp_path: Path, target: Format, capsys: pytest.CaptureFixture[str]
) -> None:
    source = tmp_path / "a.mcap"
    with RecordingWriter(source, {}) as writer:
        writer.write("radar/setup", SETUP, publisher="radar", sequence=0, sent_ns=0)
        for scan in range(SCANS):
            # a chunk of beams and one of all else for each: the writer flushes after a second
            for index in range(3):
                sent_ns = scan * 2_000_000_000 + index
                writer.write("radar/beam", beam(scan, index), publisher="radar", sequence=index, sent_ns=sent_ns)
            sent_ns = scan * 2_000_000_000 + 10
            writer.write("perception/hidden_objects", frame(scan), publisher="geo", sequence=scan, sent_ns=sent_ns)
    with RecordingReader(source) as reader:
        last = reader._walk.chunks[-2].offset
    os.truncate(source, last + 20)
    found = said(capsys, 3, source, tmp_path / "out", "--to", target.value)
    assert "cut off" in found["loss"]
    topic = "radar/beam" if target is Format.SIGMF else "perception/hidden_objects"
    assert 0 < found["converted"][topic] < (9 if target is Format.SIGMF else 3)


def test_nothing_readable_leaves_nothing_behind(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    source = tmp_path / "a.mcap"
    with source.open("wb") as file:
        writer = Writer(file)
        writer.start()
        foreign = writer.register_channel("/camera", "cdr", 0)
        writer.add_message(foreign, log_time=0, data=b"1", publish_time=0)
        ours = writer.register_channel("log", "msgpack", 0)
        writer.add_message(ours, log_time=1, data=b"\xc1", publish_time=1)
        writer.finish()
    assert main(["bag", "convert", str(source), str(tmp_path / "out.mcap")]) == 2
    assert "holds no readable message for foxglove" in capsys.readouterr().err
    assert not (tmp_path / "out.mcap").exists()


def test_topics_of_others_and_unreadable_messages_are_counted(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    source = tmp_path / "a.mcap"
    good = msgspec.msgpack.encode(LogRecord(stamp_ns=1, node="geometry", level="info", text="ready"))
    with source.open("wb") as file:
        writer = Writer(file)
        writer.start()
        for topic, encoding, bodies in (("/camera", "cdr", [b"1"]), ("log", "msgpack", [good, b"\xc1"])):
            channel = writer.register_channel(topic, encoding, 0)
            for data in bodies:
                writer.add_message(channel, log_time=0, data=data, publish_time=0)
        writer.finish()
    found = said(capsys, 3, source, tmp_path / "out.mcap")
    assert (found["converted"], found["not_converted"]) == ({"log": 1}, {"/camera": 1})
    assert found["loss"] == "1 unreadable messages of log"


def test_refusals(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    source = record(tmp_path / "a.mcap")
    assert main(["bag", "convert", str(source), str(tmp_path / "out")]) == 2
    assert "--to must name a format, or the name must end in one of .mcap" in capsys.readouterr().err
    assert main(["bag", "convert", str(source), str(source)]) == 2
    assert "exists already" in capsys.readouterr().err
    (tmp_path / "out.sigmf-data").write_bytes(b"mine")
    assert main(["bag", "convert", str(source), str(tmp_path / "out"), "--to", "sigmf"]) == 2
    assert (tmp_path / "out.sigmf-data").read_bytes() == b"mine"
    states = tmp_path / "states.mcap"
    with RecordingWriter(states, {}) as writer:
        writer.write("vehicle/state", VehicleState(stamp_ns=0), publisher="car", sequence=0, sent_ns=0)
    assert main(["bag", "convert", str(states), str(tmp_path / "b"), "--to", "sigmf"]) == 2
    assert "holds nothing for sigmf, which takes radar/setup, radar/beam" in capsys.readouterr().err


def test_same_recording_same_archive(tmp_path: Path) -> None:
    source = record(tmp_path / "a.mcap")
    for name in ("a", "b"):
        convert(source, tmp_path / name, Format.NUMPY, progress_bar)
    for path in sorted((tmp_path / "a").iterdir()):
        assert path.read_bytes() == (tmp_path / "b" / path.name).read_bytes()
        assert path.suffix == ".json" or zipfile.is_zipfile(path)


def test_odometry_follows_an_exact_circle_and_holds_over_gaps() -> None:
    """A quarter of a circle of radius 10 m, whatever the step; nothing is made up where nothing is known."""
    odometry = Odometry()
    for at in range(11):
        stamp_ns = round(at * 1e8 * math.pi / 2)
        pose = odometry.advance(VehicleState(stamp_ns=stamp_ns, speed_mps=10.0, yaw_rate_rps=1.0))
    assert pose is not None
    assert (pose.x_m, pose.y_m, pose.yaw_rad) == pytest.approx((10.0, 10.0, math.pi / 2), abs=1e-6)
    later = VehicleState(stamp_ns=stamp_ns + 5_000_000_000, speed_mps=10.0)
    assert odometry.advance(later) == pose
    assert odometry.advance(later) is None


def test_odometry_takes_the_bias_of_the_yaw_rate_off() -> None:
    """Ten seconds of rest at 0.02 rad/s, then straight on for ten: it turned in the half second before it stood."""
    odometry, pose = Odometry(), None
    for step in range(1000):
        speed_mps = 0.0 if step < 500 else 5.0
        pose = odometry.advance(VehicleState(stamp_ns=step * 20_000_000, speed_mps=speed_mps, yaw_rate_rps=0.02))
    assert pose is not None
    assert pose.yaw_rad == pytest.approx(0.01, abs=1e-3)


def test_a_curved_wall_is_hollow_towards_its_normal() -> None:
    radius_m = 20.0
    wall = Wall(
        normal=(-1.0, 0.0), offset_m=22.0, ends_m=((22.0, -5.0), (22.0, 5.0)), inliers=5, curvature_per_m=1 / radius_m
    )
    line = np.array(wall_line_m(wall))
    centre = np.array([22.0 - math.sqrt(radius_m**2 - 25.0), 0.0])
    np.testing.assert_allclose(np.hypot(*(line - centre).T), radius_m)
    np.testing.assert_allclose(line[[0, -1]], wall.ends_m)
    assert line[8, 0] > 22.0
