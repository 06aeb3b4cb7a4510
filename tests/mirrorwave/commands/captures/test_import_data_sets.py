"""`mirrorwave import detections` of nuScenes clouds and View-of-Delft lists, on files made to their layouts."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from mirrorwave.cli import main
from msgs.recording.mcap import RecordingReader
from msgs.values.detections import RadarDetections

FIELDS = [
    "x",
    "y",
    "z",
    "dyn_prop",
    "id",
    "rcs",
    "vx",
    "vy",
    "vx_comp",
    "vy_comp",
    "is_quality_valid",
    "ambig_state",
    "x_rms",
    "y_rms",
    "invalid_state",
    "pdh0",
    "vx_rms",
    "vy_rms",
]
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


def call(source: Path, out: Path) -> int:
    return main(["import", "detections", str(source), "--out", str(out)])


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
        (NAME, pcd({"x": 1}).replace(b"TYPE F", b"TYPE Q"), "head must be that of a PCD in binary"),
        (NAME, pcd({"x": 1}).replace(b" ambig_state", b" ambiguous_"), "FIELDS must hold ambig_state"),
        (NAME, b"", "head must be that of a PCD in binary"),
        ("cloud.pcd", pcd({"x": 1}), "name must end in __ and 16 digits"),
        (NAME, pcd({"x": np.nan}), "gives no detection; left out: 1 range_"),
        ("00001.bin", b"1" * 27, "must hold whole rows of 28 bytes"),
        ("00001.bin", b"", "gives no detection"),
        ("00001.bin", np.full(7, np.nan, "<f4").tobytes(), "gives no detection; left out: 1"),
        ("radar.bin", b"1" * 28, "name must be the number of a frame of View-of-Delft"),
    ],
)
def test_files_that_are_cut_or_of_another_layout_are_refused_in_one_line(
    name: str, content: bytes, rule: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / name).write_bytes(content)
    assert call(tmp_path / name, tmp_path / "a.mcap") == 2
    err = capsys.readouterr().err.strip()
    assert rule.replace("range_", "range is no number") in err
    assert "\n" not in err
    assert not (tmp_path / "a.mcap").exists()
