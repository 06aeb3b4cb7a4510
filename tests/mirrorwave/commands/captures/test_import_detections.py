"""`mirrorwave import detections`: tables and ROS bags as radar/detections; what does not fit is counted or named."""

from __future__ import annotations

import importlib.util
import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.writer import IndexType, Writer

from mirrorwave.cli import main
from msgs.recording.mcap import RecordingReader
from msgs.values.detections import RadarDetections
from tests.captures import DATA, needs

TABLE = "launch/detections/table.yaml"
HEAD = "stamp_s,range_m,azimuth_deg,radial_speed_mps,rcs_dbsm\n"
EPOCH_NS = 1_700_000_000_123_456_789
CLOUD, SCAN = "sensor_msgs/msg/PointCloud2", "radar_msgs/msg/RadarScan"

needs_rosbags = pytest.mark.skipif(
    importlib.util.find_spec("rosbags") is None, reason="rosbags is not installed (extra: convert)"
)


def imported(path: Path) -> list[RadarDetections]:
    with RecordingReader(path) as reader:
        return [item.message for item in reader.messages(("radar/detections",))]


def put(folder: Path, text: str | bytes, name: str = "a.csv") -> Path:
    path = folder / name
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return path


def call(source: Path, out: Path, *words: str) -> int:
    return main(["import", "detections", str(source), "--out", str(out), "--json", *words])


def test_a_table_becomes_scans(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Rows of one stamp are a scan; stamps keep every nanosecond that is written; an empty cell is no value."""
    rows = "1700000000.123456789,10,30,-2,5\n1700000000.123456789,20,-45,,\n\n# pause\n1700000000.2,30,0,1,0\n"
    out = tmp_path / "a.mcap"
    assert call(put(tmp_path, "\ufeff" + HEAD + rows), out, "--mapping", TABLE) == 0
    said = json.loads(capsys.readouterr().out)
    assert said == {"recording": str(out), "scans": 2, "detections": 3, "left_out": {}, "loss": None}
    first, second = imported(out)
    assert (first.stamp_ns, second.stamp_ns) == (EPOCH_NS, 1_700_000_000_200_000_000)
    assert (first.scan_id, second.scan_id) == (0, 1)
    assert first.range_m.tolist() == [10.0, 20.0]
    assert np.degrees(first.azimuth_rad) == pytest.approx([30.0, -45.0])
    assert first.radial_speed_mps is not None
    assert np.array_equal(first.radial_speed_mps, [-2.0, np.nan], equal_nan=True)
    with RecordingReader(out) as reader:
        facts = reader.info().metadata
    assert "table.yaml" in json.dumps(facts)


def test_another_column_can_group_rows(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """No head, semicolons, a preamble, columns by number, stamps in ms that run through a scan."""
    mapping = put(tmp_path, """
x: {column: 2}
y: {column: 3}
x_std: {value: 0.1}
y_std: {value: 0.1}
stamp: {column: 0, unit: ms}
scan: {column: 1}
table: {delimiter: ";", header: false, skip_lines: 2, comment: ""}
""", "m.yaml")  # fmt: skip
    text = "made by hand\nx;y\n1;7;1;0\n2;7;2;0\n3;8;0;-3\n"
    assert call(put(tmp_path, text), tmp_path / "a.mcap", "--mapping", str(mapping)) == 0
    first, second = imported(tmp_path / "a.mcap")
    assert (first.stamp_ns, first.range_m.tolist()) == (1_000_000, [1.0, 2.0])
    assert (second.stamp_ns, second.azimuth_rad.tolist()) == (3_000_000, [-np.pi / 2])


ASTYX = """
x: {column: X}
y: {column: Y}
z: {column: Z}
radial_speed: {column: V_r}
snr: {column: Mag}
x_std: {value: 0.1}
y_std: {value: 0.1}
stamp: {value: 2.5}
table: {delimiter: " "}
"""


@pytest.mark.parametrize(
    ("cell", "value"),
    [
        ("-1,5", -1.5), ("+1,5e1", 15.0), ("7", 7.0), ("", np.nan), ("NaN", np.nan), ("N/A", np.nan), (" - ", np.nan),
        ("1.234", None), ("1.234,5", None), ("1 234", None), ("1_000", None), ("1,5 m/s", None), ("1,5,0", None),
        ("x", None), ("\u22121,5", None), ("\u0661", None), ("--", None),
    ],
)  # fmt: skip
@pytest.mark.parametrize(("decimal", "encoding"), [(".", "utf-8-sig"), (",", "utf-16")])
def test_a_cell_is_a_number_or_empty_or_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], cell: str, value: float | None, decimal: str, encoding: str
) -> None:
    """Of an optional column, in both notations: never taken for not measured, never for another number."""
    text = Path(TABLE).read_text().replace('delimiter: ","', f'delimiter: ";", decimal: "{decimal}"')
    mapping = put(tmp_path, text, "m.yaml")
    if decimal == ".":
        cell = cell.translate(str.maketrans(".,", ",."))
    table = f"{HEAD}\n# a remark\n1,10,30,{{}},5\n".replace(",", ";").format(cell)
    code = call(put(tmp_path, table.encode(encoding)), tmp_path / "a.mcap", "--mapping", str(mapping))
    said = capsys.readouterr().err
    if value is None:
        assert code == 2
        assert f"a.csv: line 4: column 'radial_speed_mps' must be a number or empty, got {cell!r}" in said
        assert ("for decimal commas" in said) == (decimal == "." and "," in cell)
        return
    (scan,) = imported(tmp_path / "a.mcap")
    assert code == 0
    assert np.array_equal(scan.radial_speed_mps, [value], equal_nan=True)
    assert scan.range_m.tolist() == [10.0]


def test_a_table_can_be_one_scan(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    mapping = put(tmp_path, ASTYX, "m.yaml")
    table = put(tmp_path, "\nX Y Z V_r Mag\n3 4 0 1.5 50\n0 -2 0 -1 60\n", "a.txt")
    assert call(table, tmp_path / "a.mcap", "--mapping", str(mapping)) == 0
    (scan,) = imported(tmp_path / "a.mcap")
    assert (scan.stamp_ns, scan.range_m.tolist()) == (2_500_000_000, [5.0, 2.0])


@needs(DATA / "astyx_77ghz")
def test_the_points_of_a_real_radar_come_in(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Each frame of a 77 GHz radar with elevation, against numpy's reader of the same text: nothing is left out."""
    mapping = put(tmp_path, ASTYX, "m.yaml")
    frames = sorted((DATA / "astyx_77ghz" / "radar_6455").glob("*.txt"))
    assert len(frames) == 6
    for frame in frames:
        x_m, y_m, z_m, speed_mps, level_db = np.loadtxt(frame, skiprows=2).T
        out = tmp_path / f"{frame.stem}.mcap"
        assert call(frame, out, "--mapping", str(mapping)) == 0
        (scan,) = imported(out)
        assert np.allclose(scan.range_m, np.sqrt(x_m**2 + y_m**2 + z_m**2), rtol=1e-12)
        assert np.allclose(scan.azimuth_rad, np.arctan2(y_m, x_m), rtol=1e-12)
        assert scan.elevation_rad is not None
        assert np.allclose(scan.elevation_rad, np.arctan2(z_m, np.hypot(x_m, y_m)), rtol=1e-12)
        assert np.array_equal(scan.radial_speed_mps, speed_mps)
        assert np.array_equal(scan.snr_db, level_db)


@pytest.mark.parametrize("set_s", [-5.0, 1e6, 1.7e9])
@pytest.mark.parametrize("lasts", [True, False])
def test_a_clock_that_was_set_leaves_nothing_out(
    set_s: float, lasts: bool, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """Set back, all that follows came before what was there; set ahead, years would pass."""
    stamps_s = [100.0 + 0.1 * at + set_s * (at >= 7 if lasts else at == 7) for at in range(20)]
    rows = "".join(f"{stamp_s:.3f},{10 + at},0,0,0\n" for at, stamp_s in enumerate(stamps_s))
    assert call(put(tmp_path, HEAD + rows), tmp_path / "a.mcap", "--mapping", TABLE) == 0
    scans = imported(tmp_path / "a.mcap")
    assert [float(scan.range_m[0]) for scan in scans] == [10.0 + at for at in range(20)]
    assert [scan.stamp_ns for scan in scans] == [100_000_000_000 + at * 100_000_000 for at in range(20)]
    assert "a.csv: the clock was" in caplog.text


def test_what_is_left_out_is_counted(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rows = "1,nan,0,0,0\n1,5000,0,0,0\n1,5,0,0,0\n1,5\nsoon,5,0,0,0\n-1,5,0,0,0\n0.5,5,0,0,0\n0.5,5,0,0,0\n"
    assert call(put(tmp_path, HEAD + rows), tmp_path / "a.mcap", "--mapping", TABLE) == 3
    captured = capsys.readouterr()
    assert json.loads(captured.out)["left_out"] == {
        "range is no number": 1,
        "range is not within 0..1000 m": 1,
        "row has another number of columns": 1,
        "stamp is no time": 2,
        "stamp is not after that of the scan before": 2,
    }
    assert "a.csv: left out: 2: stamp is no time" in captured.err
    assert [len(each) for each in imported(tmp_path / "a.mcap")] == [1]


@pytest.mark.parametrize(
    ("text", "rule"),
    [
        ("", "a.csv: holds no row"),
        (HEAD, "a.csv: gives no detection"),
        ("t,r\n1,2\n", "a.csv: range.column must be one of t, r, got 'range_m'"),
        ("range_m,range_m\n", "a.csv: columns must have different names, got range_m, range_m"),
        (HEAD + "1,nan,0,0,0\n", "a.csv: gives no detection; left out: 1 range is no number"),
        (HEAD.encode() + b"1,\xff,0,0,0\n", "a.csv: line 2: column 'range_m' must be a number or empty, got 'ÿ'"),
        (HEAD + '1,"5,0,0,0\n', "a.csv: line 2: row that ends here: unexpected end of data"),
        (HEAD + "1" * 70000, "a.csv: line 2: must be at most 65536 characters"),
        (HEAD + "1," * 2000 + "\n", "a.csv: line 2: at most 1024 columns, got 2001"),
        (bytes(2000), "a.csv: range.column must be one of"),
    ],
)
def test_tables_that_cannot_be_read_are_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], text: str | bytes, rule: str
) -> None:
    assert call(put(tmp_path, text), tmp_path / "a.mcap", "--mapping", TABLE) == 2
    said = capsys.readouterr().err
    assert rule in said
    assert len(said.splitlines()) == 1
    assert not (tmp_path / "a.mcap").exists()


def test_doors_are_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "a.mcap"
    assert call(put(tmp_path, HEAD), out) == 2
    assert "--mapping must name what the columns are" in capsys.readouterr().err
    assert call(put(tmp_path, HEAD, "a.pcap"), out) == 2
    assert "a.pcap: must be a table, a data set or a ROS bag, by the end of its name: .csv" in capsys.readouterr().err
    assert call(put(tmp_path, HEAD), out, "--mapping", TABLE, "--topic", "/radar") == 2
    assert "--topic is for bags" in capsys.readouterr().err
    assert call(tmp_path / "none.csv", out, "--mapping", TABLE) == 2
    assert "none.csv: No such file" in capsys.readouterr().err
    bad = put(tmp_path, "range: {column: r}\n", "m.yaml")
    assert call(put(tmp_path, HEAD), out, "--mapping", str(bad)) == 2
    assert "m.yaml: a position must be range and azimuth, or x and y; given: range" in capsys.readouterr().err
    put(tmp_path, HEAD, "there.mcap")
    assert call(put(tmp_path, HEAD), tmp_path / "there.mcap", "--mapping", TABLE) == 2
    assert (tmp_path / "there.mcap").read_text() == HEAD


def test_a_mapping_of_a_table_needs_stamps(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert call(put(tmp_path, HEAD), tmp_path / "a.mcap", "--mapping", "launch/detections/radar_scan.yaml") == 2
    assert "radar_scan.yaml: stamp must be given" in capsys.readouterr().err


def test_bags_need_their_library(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "rosbags", None)
    monkeypatch.setitem(sys.modules, "rosbags.highlevel", None)
    assert call(put(tmp_path, b"#ROSBAG V2.0\n", "a.bag"), tmp_path / "a.mcap") != 0
    said = capsys.readouterr().err
    assert "a package is missing: rosbags, which reads ROS bags (pip install mirrorwave[convert])" in said


class Bag:
    """A bag in the making: clouds and scans of three detections, header stamps of their own."""

    def __init__(self, path: Path, store: Any) -> None:
        from rosbags.rosbag1 import Writer as Writer1
        from rosbags.rosbag2 import StoragePlugin, Writer
        from rosbags.typesys import get_types_from_msg

        self.is_first = path.suffix == ".bag"
        self.writer = Writer1(path) if self.is_first else Writer(path, version=9, storage_plugin=StoragePlugin.MCAP)
        self.store = store
        if SCAN not in store.types:
            fields = ["range", "azimuth", "elevation", "doppler_velocity", "amplitude"]
            text = "\n".join(f"float32 {name}" for name in fields)
            store.register(get_types_from_msg(text, "radar_msgs/msg/RadarReturn"))
            store.register(get_types_from_msg("std_msgs/Header header\nradar_msgs/RadarReturn[] returns", SCAN))
        self.connections: dict[str, Any] = {}

    def make(self, kind: str, **fields: Any) -> Any:
        return self.store.types[kind](**fields)

    def header(self, stamp_ns: int) -> Any:
        seconds, rest_ns = divmod(stamp_ns, 10**9)
        stamp = self.make("builtin_interfaces/msg/Time", sec=seconds, nanosec=rest_ns)
        first = {"seq": 0} if self.is_first else {}
        return self.make("std_msgs/msg/Header", **first, stamp=stamp, frame_id="radar")

    def write(self, topic: str, message: Any, time_ns: int) -> None:
        kind = message.__msgtype__
        if topic not in self.connections:
            self.connections[topic] = self.writer.add_connection(topic, kind, typestore=self.store)
        serialize = self.store.serialize_ros1 if self.is_first else self.store.serialize_cdr
        self.writer.write(self.connections[topic], time_ns, bytes(serialize(message, kind)))

    def cloud(self, stamp_ns: int, names: tuple[str, ...], rows: list[tuple[float, ...]]) -> Any:
        data = np.array(rows, np.float32)
        fields = [
            self.make("sensor_msgs/msg/PointField", name=name, offset=4 * at, datatype=7, count=1)
            for at, name in enumerate(names)
        ]
        return self.make(
            CLOUD, header=self.header(stamp_ns), height=1, width=len(rows), fields=fields, is_bigendian=False,
            point_step=4 * len(names), row_step=data.nbytes, is_dense=True,
            data=np.frombuffer(data.tobytes(), np.uint8),
        )  # fmt: skip

    def scan(self, stamp_ns: int, rows: list[tuple[float, ...]]) -> Any:
        names = ("range", "azimuth", "elevation", "doppler_velocity", "amplitude")
        returns = [self.make("radar_msgs/msg/RadarReturn", **dict(zip(names, row, strict=True))) for row in rows]
        return self.make(SCAN, header=self.header(stamp_ns), returns=returns)


def bag(path: Path) -> Path:
    """Two clouds, two scans and a topic of something else."""
    from rosbags.typesys import Stores, get_typestore

    made = Bag(path, get_typestore(Stores.ROS1_NOETIC if path.suffix == ".bag" else Stores.ROS2_JAZZY))
    with made.writer:
        for at in range(2):
            stamp_ns = EPOCH_NS + at * 50_000_000
            points = [(3.0, 4.0, 0.0, -1.5, 7.0), (float("nan"), 0.0, 0.0, 0.0, 0.0), (5.0, -5.0, 1.0, 2.0, -3.0)]
            cloud = made.cloud(stamp_ns, ("x", "y", "z", "doppler", "rcs"), points[: 3 - at])
            made.write("/radar/points", cloud, stamp_ns + 1000)
            scan = made.scan(stamp_ns, [(10.0, 0.5, 0.0, -1.0, 4.0), (20.0, -0.5, 0.25 * at, 1.0, 5.0)])
            made.write("/radar/scan", scan, stamp_ns + 2000)
            made.write("/text", made.make("std_msgs/msg/String", data="a"), stamp_ns)
    return path


@needs_rosbags
@pytest.mark.parametrize("name", ["a.bag", "a"])
def test_clouds_of_bags_become_scans(tmp_path: Path, capsys: pytest.CaptureFixture[str], name: str) -> None:
    """ROS 1 and ROS 2 alike; stamps are the headers', and a point that is no number is left out."""
    out = tmp_path / "out.mcap"
    assert call(bag(tmp_path / name), out, "--topic", "/radar/points") == 3
    said = json.loads(capsys.readouterr().out)
    assert (said["scans"], said["detections"], said["topic"]) == (2, 3, "/radar/points")
    assert said["left_out"] == {"range is no number": 2}
    first, second = imported(out)
    assert (first.stamp_ns, second.stamp_ns - first.stamp_ns) == (EPOCH_NS, 50_000_000)
    assert first.range_m == pytest.approx([5.0, np.sqrt(51.0)])
    assert first.azimuth_rad == pytest.approx([np.arctan2(4.0, 3.0), -np.pi / 4])
    assert first.elevation_rad == pytest.approx([0.0, np.arctan2(1.0, np.sqrt(50.0))])
    assert first.radial_speed_mps == pytest.approx([-1.5, 2.0])
    assert first.rcs_dbsm == pytest.approx([7.0, -3.0])


@needs_rosbags
@pytest.mark.parametrize("name", ["a.bag", "a"])
def test_radar_scans_of_bags_become_scans(tmp_path: Path, capsys: pytest.CaptureFixture[str], name: str) -> None:
    """An elevation that is 0 throughout was not measured: NaN; the other scan has one."""
    out = tmp_path / "out.mcap"
    assert call(bag(tmp_path / name), out, "--topic", "/radar/scan") == 0
    first, second = imported(out)
    assert first.range_m.tolist() == [10.0, 20.0]
    assert first.azimuth_rad.tolist() == [0.5, -0.5]
    assert (first.radial_speed_mps.tolist(), first.rcs_dbsm.tolist()) == ([-1.0, 1.0], [4.0, 5.0])  # type: ignore[union-attr]
    assert first.elevation_rad is not None
    assert np.isnan(first.elevation_rad).all()
    assert second.elevation_rad is not None
    assert second.elevation_rad.tolist() == [0.0, 0.25]


@needs_rosbags
def test_a_topic_is_asked_for_where_it_is_not_the_only_one(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path, out = bag(tmp_path / "a.bag"), tmp_path / "out.mcap"
    assert call(path, out) == 2
    assert "--topic must name one of its topics" in capsys.readouterr().err
    assert call(path, out, "--topic", "/text") == 2
    assert "(/radar/points, /radar/scan), got '/text'" in capsys.readouterr().err
    assert not out.exists()


@needs_rosbags
def test_a_bag_of_mcap_needs_neither_summary_nor_end(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Of a bag without an index all scans, and of one that is cut off those before, with its loss."""
    whole = next(bag(tmp_path / "bag").glob("*.mcap"))
    words = "--topic", "/radar/scan"
    assert call(whole, tmp_path / "a.mcap", *words) == 0
    path = tmp_path / "b.mcap"
    with path.open("wb") as file, whole.open("rb") as source:
        writer = Writer(file, index_types=IndexType.NONE, repeat_channels=False, repeat_schemas=False)
        writer.start("ros2")
        for schema, channel, raw in make_reader(source).iter_messages():
            kind = writer.register_schema(schema.name, schema.encoding, schema.data)
            number = writer.register_channel(channel.topic, channel.message_encoding, kind)
            writer.add_message(number, raw.log_time, raw.data, raw.publish_time)
        writer.finish()
    assert call(path, tmp_path / "c.mcap", *words) == 0
    path.write_bytes(path.read_bytes()[:-20])
    capsys.readouterr()
    assert call(path, tmp_path / "d.mcap", *words) == 3
    assert "b.mcap: cut off at byte" in capsys.readouterr().err
    expected = [scan.range_m.tolist() for scan in imported(tmp_path / "a.mcap")]
    for name in ("c.mcap", "d.mcap"):
        assert [scan.range_m.tolist() for scan in imported(tmp_path / name)] == expected


@needs_rosbags
def test_bags_that_cannot_be_read_are_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    whole = bag(tmp_path / "whole.bag").read_bytes()
    for name, content in {
        "empty.bag": b"", "words.bag": b"no bag at all\n", "cut.bag": whole[: len(whole) // 2], "words.db3": b"nothing",
        "words.mcap": b"nothing",
    }.items():  # fmt: skip
        assert call(put(tmp_path, content, name), tmp_path / "out.mcap") == 2, name
        said = capsys.readouterr().err
        rule = "is not an MCAP recording" if name == "words.mcap" else "no ROS bag that can be read"
        assert f"{name}: {rule}" in said
        assert len(said.splitlines()) == 1
    (tmp_path / "folder").mkdir()
    assert call(tmp_path / "folder", tmp_path / "out.mcap") == 2
    assert "folder: no ROS bag that can be read" in capsys.readouterr().err


@needs_rosbags
def test_a_cloud_that_contradicts_itself_is_lost_alone(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    from rosbags.typesys import Stores, get_typestore

    made = Bag(tmp_path / "a", get_typestore(Stores.ROS2_JAZZY))
    with made.writer:
        names = ("x", "y", "z", "doppler", "rcs")
        for at in range(3):
            cloud = made.cloud(at + 1, names, [(1.0, 2.0, 3.0, 4.0, 5.0)])
            cloud.width = 1 << 20 if at == 1 else 1
            made.write("/points", cloud, at)
    assert call(tmp_path / "a", tmp_path / "out.mcap") == 3
    said = json.loads(capsys.readouterr().out)
    assert (said["scans"], said["topic"]) == (2, "/points")
    (reason,) = said["left_out"]
    assert reason.startswith("message: ValueError: data must hold")


@needs_rosbags
def test_another_cloud_needs_another_mapping(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    from rosbags.typesys import Stores, get_typestore

    made = Bag(tmp_path / "a", get_typestore(Stores.ROS2_JAZZY))
    with made.writer:
        made.write("/points", made.cloud(5, ("range", "bearing"), [(10.0, 0.5)]), 5)
    assert call(tmp_path / "a", tmp_path / "out.mcap") == 2
    assert "a: x.column must be one of range, bearing, got 'x'" in capsys.readouterr().err
    mapping = put(tmp_path, """
range: {column: range}
azimuth: {column: bearing, negated: true}
range_std: {value: 0.1}
azimuth_std: {value: 1, unit: deg}
""", "m.yaml")  # fmt: skip
    assert call(tmp_path / "a", tmp_path / "out.mcap", "--mapping", str(mapping)) == 0
    (found,) = imported(tmp_path / "out.mcap")
    assert (found.range_m[0], found.azimuth_rad[0]) == (10.0, -0.5)
