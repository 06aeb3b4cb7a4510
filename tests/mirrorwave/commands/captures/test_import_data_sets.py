"""`mirrorwave import detections` of published sets, on files made to their layouts, and five bad ones of each."""

from __future__ import annotations

import io
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mirrorwave.cli import main
from msgs.recording.mcap import RecordingReader
from msgs.values.detections import RadarDetections

FIELDS = [
    "x", "y", "z", "dyn_prop", "id", "rcs", "vx", "vy", "vx_comp", "vy_comp", "is_quality_valid", "ambig_state",
    "x_rms", "y_rms", "invalid_state", "pdh0", "vx_rms", "vy_rms",
]  # fmt: skip
SIZES, TYPES = "444124444411111111", "FFFIIFFFFFIIIIIIII"
NAME = "n015__RADAR_FRONT__1532402927647951.pcd"


def pcd(*points: dict[str, float]) -> bytes:
    """A radar cloud as nuScenes publishes it."""
    count = len(points)
    head = f"# .PCD v0.7\nVERSION 0.7\nFIELDS {' '.join(FIELDS)}\nSIZE {' '.join(SIZES)}\nTYPE {' '.join(TYPES)}\n"
    head += f"COUNT {' '.join('1' * 18)}\nWIDTH {count}\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {count}\n"
    dtype = np.dtype([(name, f"<{kind.lower()}{size}") for name, kind, size in zip(FIELDS, TYPES, SIZES, strict=True)])
    rows = np.zeros(count, dtype)
    rows["ambig_state"] = 3
    for row, point in zip(rows, points, strict=True):
        for name, value in point.items():
            row[name] = value
    return f"{head}DATA binary\n".encode() + rows.tobytes()


def call(source: Path, out: Path, *words: str) -> int:
    return main(["import", "detections", str(source), "--out", str(out), *words])


def refused(source: Path, rule: str, capsys: pytest.CaptureFixture[str], *words: str) -> None:
    """A source gives one line that names it and its rule, and nothing else."""
    out = source.with_name("a.mcap")
    assert call(source, out, *words) == 2
    err = capsys.readouterr().err.strip()
    assert f"{source.name}: {rule}" in err
    assert "\n" not in err
    assert not out.exists()


def imported(path: Path) -> list[RadarDetections]:
    with RecordingReader(path) as reader:
        messages = [item.message for item in reader.messages(("radar/detections",))]
    return [message for message in messages if isinstance(message, RadarDetections)]


def test_a_cloud_of_nuscenes(tmp_path: Path) -> None:
    """Speed along the line of sight, 3/5 of 5 m/s; what the sensor calls invalid or ambiguous is left out."""
    points: tuple[dict[str, float], ...] = (
        {"x": 3, "y": 4, "rcs": -5, "vx_comp": 5},
        {"x": 9, "invalid_state": 4},
        {"x": 9, "ambig_state": 1},
    )
    (tmp_path / NAME).write_bytes(pcd(*points))
    assert call(tmp_path / NAME, tmp_path / "a.mcap") == 3
    (scan,) = imported(tmp_path / "a.mcap")
    assert (scan.stamp_ns, scan.range_m.tolist(), scan.over_ground) == (1_532_402_927_647_951_000, [5.0], True)
    assert scan.azimuth_rad == pytest.approx([np.arctan2(4, 3)])
    assert scan.radial_speed_mps == pytest.approx([3.0])
    assert scan.rcs_dbsm == pytest.approx([-5.0])


def test_a_folder_of_view_of_delft(tmp_path: Path) -> None:
    folder = tmp_path / "velodyne"
    folder.mkdir()
    for frame in (8, 7):
        np.array([[4, 3, 0, 1.5, -2, -1, 0], [1, 0, 0, 0, 0, 0, 0]][: frame - 6], "<f4").tofile(
            folder / f"{frame:05}.bin"
        )
    assert call(folder, tmp_path / "a.mcap") == 0
    first, second = imported(tmp_path / "a.mcap")
    assert (first.stamp_ns, second.stamp_ns) == (700_000_000, 800_000_000)
    assert (first.range_m.tolist(), second.range_m.tolist()) == ([5.0], [5.0, 1.0])
    assert first.radial_speed_mps is not None
    assert first.radial_speed_mps.tolist() == [-1.0]


@pytest.mark.parametrize(
    ("name", "content", "rule"),
    [
        (NAME, pcd({"x": 1})[:-1], "must hold 1 points of 43 bytes, got 42 bytes"),
        (NAME, pcd({"x": 1})[:100], "head must be that of a PCD in binary"),
        (NAME, pcd({"x": 1}).replace(b"DATA binary", b"DATA ascii"), "head must be that of a PCD in binary"),
        (NAME, pcd({"x": 1}).replace(b" ambig_state", b" ambiguous_"), "FIELDS must hold ambig_state"),
        ("cloud.pcd", pcd({"x": 1}), "name must end in __ and 16 digits"),
        (NAME, pcd({"x": 1}, {"x": np.nan}), "x must be finite, got nan in row 1"),
        (NAME, pcd({"x": 1}).replace(b"VERSION 0.7", b"VERSION 0.6"), "VERSION must be 0.7, got 0.6"),
        ("00001.bin", b"1" * 27, "must hold whole rows of 28 bytes"),
        ("00001.bin", b"", "gives no detection"),
        ("00001.bin", np.full(7, np.nan, "<f4").tobytes(), "x must be finite, got nan in row 0"),
        ("radar.bin", b"1" * 28, "name must be the number of a frame of View-of-Delft"),
    ],
)
def test_files_that_are_cut_or_of_another_layout_are_refused_in_one_line(
    name: str, content: bytes, rule: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / name).write_bytes(content)
    refused(tmp_path / name, rule, capsys)


def test_a_frame_that_comes_twice(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = tmp_path / "velodyne"
    folder.mkdir()
    for name in ("00007.bin", "7.bin"):
        np.ones(7, "<f4").tofile(folder / name)
    assert call(folder, tmp_path / "a.mcap") == 2
    assert "7.bin: name must be of another frame than that of 00007.bin" in capsys.readouterr().err


def npy(rows: Any, dtype: str = "<f8") -> bytes:
    """A sparse tensor as K-Radar publishes it: x, y, z, power."""
    file = io.BytesIO()
    np.save(file, np.array(rows, dtype))
    return file.getvalue()


TENSOR = [[10.0, 0.0, 0.0, 1.0], [3.0, 4.0, 0.0, 100.0]]


def test_a_folder_of_k_radar(tmp_path: Path) -> None:
    """Strongest first, level over the weakest; Doppler beside it is not taken."""
    folder = tmp_path / "1"
    folder.mkdir()
    (folder / "sprdr_00010.npy").write_bytes(npy(TENSOR))
    (folder / "sprdr_00009.npy").write_bytes(npy([[*TENSOR[1], 1.5]]))
    assert call(folder, tmp_path / "a.mcap") == 0
    first, second = imported(tmp_path / "a.mcap")
    assert (first.stamp_ns, second.stamp_ns) == (900_000_000, 1_000_000_000)
    assert (second.range_m.tolist(), second.radial_speed_mps) == ([5.0, 10.0], None)
    assert second.snr_db is not None
    assert second.snr_db == pytest.approx([20.0, 0.0])


@pytest.mark.parametrize(
    ("name", "content", "rule"),
    [
        ("sprdr_00001.npy", npy(TENSOR)[:-8], "must be an array of NumPy: mmap length is greater"),
        ("sprdr_00001.npy", npy(TENSOR).replace(b"NUMPY\x01", b"NUMPY\x09"), "must be an array of NumPy: "),
        ("sprdr_00001.npy", npy([[1.0, 2.0, 3.0]]), "must hold rows of x, y, z, power (and Doppler), floats"),
        ("sprdr_00001.npy", npy([[1, 2, 3, 4]], "<i4"), "must hold rows of x, y, z, power (and Doppler), floats"),
        ("sprdr_00001.npy", npy([TENSOR[0], [np.nan] * 4]), "x must be finite, got nan in row 1"),
        ("tensor.npy", npy(TENSOR), "name must be the number of a frame of K-Radar, such as sprdr_00123.npy"),
    ],
)  # fmt: skip
def test_tensors_that_are_none_are_refused_in_one_line(
    name: str, content: bytes, rule: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / name).write_bytes(content)
    refused(tmp_path / name, rule, capsys)


SCENES_DTYPE = np.dtype(
    [
        ("timestamp", "<i8"), ("sensor_id", "u1"), ("range_sc", "<f4"), ("azimuth_sc", "<f4"), ("rcs", "<f4"),
        ("vr", "<f4"), ("vr_compensated", "<f4"), ("x_cc", "<f4"), ("y_cc", "<f4"), ("x_seq", "<f4"), ("y_seq", "<f4"),
        ("uuid", "S32"), ("track_id", "S32"), ("label_id", "u1"),
    ]
)  # fmt: skip
GHOST_DTYPE = np.dtype(
    [
        ("frame", "<i8"), ("frame_timestamp", "<f8"), ("timestamp", "<f8"), ("sensor", "S5"), ("x_cc", "<f8"),
        ("y_cc", "<f8"), ("r_sc", "<f8"), ("phi_sc", "<f8"), ("vr_sc", "<f8"), ("amp", "<f8"), ("uuid", "S32"),
        ("label_id", "<i8"), ("instance_id", "<i8"),
    ]
)  # fmt: skip


def table(dtype: np.dtype, **columns: Any) -> np.ndarray:
    rows = np.zeros(len(next(iter(columns.values()))), dtype)
    for name, values in columns.items():
        rows[name] = values
    return rows


def scenes(**changed: Any) -> np.ndarray:
    """Rows of sensors 1 and 2, whose measurements lie between each other."""
    columns = {
        "timestamp": [156862647501, 156862659751, 156862659751, 156862735209], "sensor_id": [1, 2, 2, 2],
        "range_sc": [5, 10, 20, 30], "azimuth_sc": [0, 0.5, -0.5, 0], "rcs": [1, 2, 3, 4],
        "vr_compensated": [0, -1, 0, 2],
    }  # fmt: skip
    return table(SCENES_DTYPE, **{**columns, **changed})


def ghosts(**changed: Any) -> np.ndarray:
    columns = {
        "frame": [0, 0, 0, 1], "frame_timestamp": [0, 0, 0, 0.1], "timestamp": [0, 0, 0.02, 0.1],
        "sensor": [b"left", b"left", b"right", b"left"], "r_sc": [5, 6, 7, 8], "phi_sc": [0.1, 0.2, 0.3, 0.4],
        "vr_sc": [0, 1, 0, -1],
    }  # fmt: skip
    return table(GHOST_DTYPE, **{**columns, **changed})


def hdf5(path: Path, **tables: np.ndarray) -> Path:
    h5py = pytest.importorskip("h5py")
    with h5py.File(path, "w") as file:
        for name, rows in tables.items():
            file[name] = rows
    return path


def test_a_drive_of_radar_scenes(tmp_path: Path) -> None:
    path = hdf5(tmp_path / "radar_data.h5", radar_data=scenes(), odometry=np.zeros(3))
    assert call(path, tmp_path / "a.mcap", "--topic", "2") == 0
    first, second = imported(tmp_path / "a.mcap")
    assert (first.stamp_ns, second.stamp_ns) == (156_862_659_751_000, 156_862_735_209_000)
    assert (first.sensor, first.over_ground, first.range_m.tolist()) == ("radar_scenes_2", True, [10.0, 20.0])
    assert first.azimuth_rad == pytest.approx([0.5, -0.5])
    assert (first.vehicle_from_radar.x_m, first.vehicle_from_radar.y_m) == (3.86, -0.7)
    assert first.vehicle_from_radar.yaw_rad == pytest.approx(-0.436, abs=1e-3)
    assert second.radial_speed_mps is not None
    assert second.radial_speed_mps.tolist() == [2.0]


def test_a_sequence_of_the_radar_ghost_set(tmp_path: Path) -> None:
    path = hdf5(tmp_path / "scenario-01_sequence-01_ped_train.h5", radar=ghosts(), lidar=np.zeros(3))
    assert call(path, tmp_path / "a.mcap", "--topic", "left") == 0
    first, second = imported(tmp_path / "a.mcap")
    assert (first.stamp_ns, second.stamp_ns) == (0, 100_000_000)
    assert (first.sensor, first.over_ground, first.range_m.tolist()) == ("radar_ghost_left", False, [5.0, 6.0])
    assert first.vehicle_from_radar.yaw_rad == pytest.approx(np.radians(30.0))


def cut(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:-500])


def corrupted(path: Path) -> None:
    path.write_bytes(bytes(64) + path.read_bytes()[64:])


def without(rows: np.ndarray, name: str) -> np.ndarray:
    return np.array(rows[[each for each in rows.dtype.names or () if each != name]].tolist(), [
        (each, rows.dtype[each]) for each in rows.dtype.names or () if each != name
    ])  # fmt: skip


@pytest.mark.parametrize(
    ("tables", "damage", "topic", "rule"),
    [
        ({"radar_data": scenes()}, cut, "2", "no HDF5 that can be read: "),
        ({"radar_data": scenes()}, corrupted, "2", "no HDF5 that can be read: "),
        ({"radar_data": without(scenes(), "range_sc")}, None, "2", "radar_data must hold the column range_sc, got "),
        ({"radar_data": np.zeros(4)}, None, "2", "radar_data must be a table with named columns"),
        ({"points": scenes()}, None, "2", "must hold the dataset radar_data or radar, got points"),
        ({"radar_data": scenes(timestamp=[1, 9, 9, 5])}, None, "2", "timestamp must not go back, got 5 after 9"),
        ({"radar_data": scenes(timestamp=[1, 9, -9, 9])}, None, "2", "timestamp must be a time, got -9 in row 1"),
        ({"radar_data": scenes(range_sc=[1, 2, np.nan, 4])}, None, "2", "range_sc must be finite, got nan in row 1"),
        ({"radar_data": scenes()}, None, "5", "--topic must name one of its sensors: 1, 2; got '5'"),
        ({"radar_data": scenes()}, None, None, "--topic must name one of its sensors: 1, 2; got none"),
        ({"radar": ghosts(timestamp=[0, 0, 0, -1])}, None, "left", "timestamp must be a time, got -1.0 in row 2"),
        ({"radar": ghosts(timestamp=[2, 2, 2, 1])}, None, "left", "timestamp must not go back, got 1.0 after 2.0"),
        ({"radar": ghosts(timestamp=np.nan)}, None, "left", "timestamp must be a time, got nan in row 0"),
    ],
)  # fmt: skip
def test_drives_that_do_not_fit_are_refused_in_one_line(
    tables: dict[str, np.ndarray],
    damage: Callable[[Path], None] | None,
    topic: str | None,
    rule: str,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    path = hdf5(tmp_path / "a.h5", **tables)
    if damage is not None:
        damage(path)
    refused(path, rule, capsys, *(["--topic", topic] if topic else []))


def test_a_drive_may_not_promise_more_than_a_hundred_times_its_file(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """What was never written reads as zeros: two kilobytes took seven gigabytes."""
    with pytest.importorskip("h5py").File(tmp_path / "a.h5", "w") as file:
        file.create_dataset("radar_data", shape=(50_000_000,), dtype=scenes().dtype, chunks=(1 << 20,))
    refused(tmp_path / "a.h5", "radar_data must be at most 8", capsys, "--topic", "2")


def test_drives_need_their_library(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "h5py", None)
    (tmp_path / "a.h5").write_bytes(b"")
    assert call(tmp_path / "a.h5", tmp_path / "a.mcap") != 0
    assert "a package is missing: h5py, which reads HDF5 (pip install mirrorwave[convert])" in capsys.readouterr().err


ARS = {
    "Cluster": "uint8 id\ngeometry_msgs/PoseWithCovariance position\n"
    "geometry_msgs/TwistWithCovariance relative_velocity\nint8 dynamic_property\nint8 class_type\n"
    "int8 prob_of_exist\nint8 ambig_state\nint8 invalid_state\n",
    "ClusterList": "std_msgs/Header header\nars_40X/Cluster[] clusters\n",
}
#: As the package was before positions had covariances.
OLD_ARS = {**ARS, "Cluster": "uint8 id\ngeometry_msgs/Pose position\ngeometry_msgs/Twist relative_velocity\n"}


def ars_bag(path: Path, lists: list[list[dict[str, float]]], kinds: dict[str, str] = ARS) -> Path:
    """A ROS 1 bag of the published package: lists of clusters, 70 ms apart."""
    pytest.importorskip("rosbags")
    from rosbags.rosbag1 import Writer
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore
    from rosbags.typesys.msg import MSGParser

    MSGParser.PackageName = MSGParser.MixedSnake
    store = get_typestore(Stores.ROS1_NOETIC)
    for name, text in kinds.items():
        store.register(get_types_from_msg(text, f"ars_40X/msg/{name}"))

    def make(kind: str, **fields: Any) -> Any:
        return store.types[kind](**fields)

    def vector(kind: str, x: float, y: float, **more: float) -> Any:
        return make(f"geometry_msgs/msg/{kind}", x=x, y=y, z=0.0, **more)

    def cluster(at: int, row: dict[str, float]) -> Any:
        pose = make("geometry_msgs/msg/Pose", position=vector("Point", row["x"], row["y"]),
                    orientation=vector("Quaternion", 0.0, 0.0, w=1.0))  # fmt: skip
        twist = make("geometry_msgs/msg/Twist", linear=vector("Vector3", row.get("vx", 0.0), 0.0),
                     angular=vector("Vector3", 0.0, 0.0))  # fmt: skip
        if kinds is OLD_ARS:
            return make("ars_40X/msg/Cluster", id=at, position=pose, relative_velocity=twist)
        covariance = np.zeros(36)
        covariance[[0, 7]] = row.get("variance", 0.0)
        return make(
            "ars_40X/msg/Cluster", id=at, dynamic_property=0, class_type=0, prob_of_exist=7, ambig_state=3,
            position=make("geometry_msgs/msg/PoseWithCovariance", pose=pose, covariance=covariance),
            relative_velocity=make("geometry_msgs/msg/TwistWithCovariance", twist=twist, covariance=np.zeros(36)),
            invalid_state=int(row.get("invalid", 0)),
        )  # fmt: skip

    with Writer(path) as writer:
        connection = writer.add_connection("/ars_40X/clusters", "ars_40X/msg/ClusterList", typestore=store)
        for at, rows in enumerate(lists):
            time_ns = 1_000_000_000 + 70_000_000 * at
            stamp = make("builtin_interfaces/msg/Time", sec=1, nanosec=time_ns - 1_000_000_000)
            header = make("std_msgs/msg/Header", seq=at, stamp=stamp, frame_id="radar")
            clusters = [cluster(number, row) for number, row in enumerate(rows)]
            message = make("ars_40X/msg/ClusterList", header=header, clusters=clusters)
            writer.write(connection, time_ns, store.serialize_ros1(message, "ars_40X/msg/ClusterList"))
    return path


def test_a_bag_of_an_ars_408(tmp_path: Path) -> None:
    """Errors of its quality frames, else of the data sheet; a mirror image (6) is kept, an artefact (2) is not."""
    rows = [{"x": 30.0, "y": 40.0, "vx": -5.0, "variance": 0.25}, {"x": 9.0, "y": 0.0, "invalid": 6},
            {"x": 1.0, "y": 0.0, "invalid": 2}]  # fmt: skip
    assert call(ars_bag(tmp_path / "a.bag", [rows, rows[:1]]), tmp_path / "a.mcap") == 3
    first, second = imported(tmp_path / "a.mcap")
    assert (first.stamp_ns, second.stamp_ns) == (1_000_000_000, 1_070_000_000)
    assert first.range_m.tolist() == [50.0, 9.0]
    assert first.radial_speed_mps == pytest.approx([-3.0, 0.0])
    assert np.sqrt(first.covariance[:, 0, 0]) == pytest.approx([0.5, 0.4])
    assert first.rcs_dbsm is not None
    assert np.isnan(first.rcs_dbsm).all()


@pytest.mark.parametrize(
    ("bag", "rule"),
    [
        (lambda path: path.write_bytes(ars_bag(path, [[{"x": 1, "y": 1}]]).read_bytes()[:300]), "no ROS bag that can"),
        (lambda path: path.write_bytes(b"#ROSBAG V1.2\n" + ars_bag(path, [[{"x": 1, "y": 1}]]).read_bytes()[13:]),
         "no ROS bag that can be read"),
        (lambda path: ars_bag(path, [[{"x": 1, "y": 1}]], OLD_ARS), "gives no detection; left out: 1 message: "),
        (lambda path: ars_bag(path, [[{"x": np.nan, "y": 1}]]), "gives no detection; left out: 1 range is no number"),
        (lambda path: ars_bag(path, [[]]), "gives no detection"),
    ],
)  # fmt: skip
def test_bags_of_an_ars_408_that_do_not_fit_are_refused_in_one_line(
    bag: Callable[[Path], Any], rule: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "a.bag"
    bag(path)
    refused(path, rule, capsys)
