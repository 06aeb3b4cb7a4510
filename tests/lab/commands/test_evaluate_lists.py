"""`mirrorwave eval --against`: lists of every kind against a truth of every kind, and files that do not fit."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mirrorwave.cli import main
from msgs.recording.mcap import RecordingWriter
from msgs.values.perception import SceneTruth, TruthObject

SCAN_NS = 300_000_000
#: Car 3 drives away from (10, -2); a second report stands on nothing at (30, 9) in scan 1.
AT_M = [(10.0, -2.0), (10.5, -2.0), (11.0, -2.0)]


def truth_recording(path: Path) -> Path:
    nothing = np.zeros((0, 3), np.float32)
    with RecordingWriter(path, {}) as writer:
        for scan, (x_m, y_m) in enumerate(AT_M):
            car = {"object_class": "car", "y_m": y_m, "length_m": 4.0, "width_m": 2.0, "yaw_rad": 0.5}
            truth = SceneTruth(
                stamp_ns=10**9 + scan * SCAN_NS, scan_id=scan, los_points_m=nothing, mirrored_points_m=nothing,
                hidden_points_m=nothing, hidden_object=np.zeros(0, np.int32),
                objects=(TruthObject(id=3, x_m=x_m, hidden=True, **car), TruthObject(id=4, x_m=60.0, **car)),  # type: ignore[arg-type]
            )  # fmt: skip
            writer.write("sim/truth", truth, publisher="test", sequence=scan, sent_ns=truth.stamp_ns)
    return path


def track(key: int, x_m: float, y_m: float) -> dict[str, Any]:
    cov_m2 = [[0.1, 0.0], [0.0, 0.1]]
    return {"id": key, "x_m": x_m, "y_m": y_m, "velocity_x_mps": 1.0, "velocity_y_mps": 0.0, "age_s": 1.0,
            "cov_m2": cov_m2, "existence": 0.9 if key == 7 else 0.5}  # fmt: skip


def lines() -> list[dict[str, Any]]:
    """Track 7 stands 0.5 m beside the car in all scans, track 8 on nothing in one."""
    scans = [
        {"scan_id": scan, "stamp_ns": 10**9 + scan * SCAN_NS, "frame": "radar", "tracks": [track(7, x_m, y_m + 0.5)]}
        for scan, (x_m, y_m) in enumerate(AT_M)
    ]
    scans[1]["tracks"].append(track(8, 30.0, 9.0))  # type: ignore[attr-defined]
    return scans


def as_lines(path: Path, scans: list[dict[str, Any]]) -> Path:
    path.write_text("".join(json.dumps(scan) + "\n" for scan in scans))
    return path


def as_nuscenes(path: Path, scans: list[dict[str, Any]]) -> Path:
    results = {
        str(scan["scan_id"]): [
            {"sample_token": str(scan["scan_id"]), "translation": [each["x_m"], each["y_m"], 0.7],
             "size": [2.0, 4.0, 1.5], "rotation": [math.cos(0.25), 0.0, 0.0, math.sin(0.25)], "velocity": [1.0, 0.0],
             "tracking_id": f"t{each['id']}", "tracking_name": "car", "tracking_score": each["existence"]}
            for each in scan["tracks"]
        ]
        for scan in scans
    }  # fmt: skip
    path.write_text(json.dumps({"meta": {"use_radar": True}, "results": results}))
    return path


def as_kitti(path: Path, scans: list[dict[str, Any]]) -> Path:
    rows = [
        f"{scan['scan_id']} {each['id']} Car 0 0 -10 0 0 50 50 1.5 2.0 4.0 {-each['y_m']} 1.6 {each['x_m']} "
        f"{-0.5 - 0.5 * math.pi} {each['existence']}\n"
        for scan in scans
        for each in scan["tracks"]
    ]
    path.write_text("".join([*rows, "0 -1 DontCare -1 -1 -10 0 0 9 9 -1 -1 -1 -1000 -1000 -1000 -10\n"]))
    return path


def score(against: Path, truth: Path, capsys: pytest.CaptureFixture[str], *options: str) -> dict[str, Any]:
    assert main(["eval", "--against", str(against), "--truth-file", str(truth), "--json", *options]) == 0
    report: dict[str, Any] = json.loads(capsys.readouterr().out)
    return report


@pytest.mark.parametrize(("write", "name"), [(as_lines, "t.jsonl"), (as_nuscenes, "t.json"), (as_kitti, "t.txt")])
def test_a_list_of_each_kind_gives_the_scores_worked_out_by_hand(
    write: Any, name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Three objects, all found 0.5 m off by the surer reports, one report on nothing."""
    report = score(write(tmp_path / name, lines()), truth_recording(tmp_path / "truth.mcap"), capsys)
    objects, tracks = report["objects"], report["tracks"]
    assert (objects["recall"]["part"], objects["recall"]["whole"], objects["false"]["part"]) == (3, 3, 1)
    assert objects["average_precision"]["value"] == 1.0
    assert tracks["standard"]["mota"]["value"] == pytest.approx(1 - 1 / 3)
    assert tracks["standard"]["idf1"]["value"] == pytest.approx(6 / 7)
    # similarity 0.75 reaches 15 of 19 levels
    assert tracks["standard"]["deta"]["value"] == pytest.approx(15 / 19 * 3 / 4)
    assert tracks["gospa_pairs_m2"]["value"] == pytest.approx(0.25)


@pytest.mark.parametrize(("write", "name"), [(as_lines, "t.jsonl"), (as_nuscenes, "t.json"), (as_kitti, "t.txt")])
def test_a_list_against_itself_is_perfect_and_drives_add(
    write: Any, name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = write(tmp_path / name, lines())
    out = tmp_path / "out"
    twice = ("--against", str(path), "--truth-file", str(path), "--out", str(out))
    report = score(path, path, capsys, *twice)
    assert report["objects"]["recall"]["whole"] == 8
    assert {each["value"] for each in report["tracks"]["standard"].values()} == {1.0}
    assert "MOTA" in (out / "results.md").read_text()
    truth = (out / "mot/truth/00001/gt/gt.txt").read_text()
    assert truth == (out / "mot/reports/00001.txt").read_text()
    assert truth.count("\n") == 4


def test_objects_without_lasting_ids_have_no_track_scores(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    scans = lines()
    for scan in scans:
        scan["objects"] = [
            {name: each[name] for name in ("id", "x_m", "y_m", "cov_m2")}
            | {"length_m": 4.0, "width_m": 2.0, "yaw_rad": 0.0, "score": 0.5}
            for each in scan.pop("tracks")
        ]
    report = score(as_lines(tmp_path / "o.jsonl", scans), truth_recording(tmp_path / "truth.mcap"), capsys)
    assert report["tracks"] is None
    assert report["objects"]["recall"]["part"] == 3


def broken(scans: list[dict[str, Any]], fault: str) -> list[dict[str, Any]]:
    match fault:
        case "missing":
            del scans[1]
        case "unknown":
            scans[1]["scan_id"] = 77
        case "frame":
            scans[1]["frame"] = "map"
        case "field":
            del scans[1]["tracks"][0]["x_m"]
        case "nan":
            scans[1]["tracks"][0]["x_m"] = math.nan
        case "twice":
            scans[1]["tracks"][1]["id"] = 7
        case "again":
            scans[2]["scan_id"] = 0
        case "stamp":
            scans[1]["stamp_ns"] = 10**12
        case "empty":
            scans.clear()
    return scans


@pytest.mark.parametrize(
    ("write", "name", "fault", "rule"),
    [
        (as_lines, "t.jsonl", "missing", "t.jsonl: must list scan 1 of"),
        (as_lines, "t.jsonl", "unknown", "t.jsonl: scan 77 must be one of"),
        (as_lines, "t.jsonl", "frame", "t.jsonl: line 2: frame must be \"radar\", got 'map'"),
        (as_lines, "t.jsonl", "field", "t.jsonl: line 2: tracks[0]: Object missing required field x_m"),
        (as_lines, "t.jsonl", "nan", "t.jsonl: line 2: numbers must be finite, got NaN"),
        (as_lines, "t.jsonl", "twice", "t.jsonl: scan 1: id 7 must be there once"),
        (as_lines, "t.jsonl", "again", "t.jsonl: scan 0 must be there once"),
        (as_lines, "t.jsonl", "stamp", "t.jsonl: scan 1: stamp_ns must be within 1 s"),
        (as_lines, "t.jsonl", "empty", "t.jsonl: holds no scan"),
        (as_nuscenes, "t.json", "missing", "t.json: must list scan 1 of"),
        (as_nuscenes, "t.json", "unknown", "t.json: scan 77 must be one of"),
        (as_nuscenes, "t.json", "nan", "t.json: numbers must be finite, got NaN"),
        (as_nuscenes, "t.json", "twice", "t.json: scan 1: id 0 must be there once"),
        (as_nuscenes, "t.json", "empty", "t.json: holds no scan"),
        (as_kitti, "t.txt", "unknown", "t.txt: scan 77 must be one of"),
        (as_kitti, "t.txt", "nan", "t.txt: line 2: column 16 must be a finite number, got 'nan'"),
        (as_kitti, "t.txt", "twice", "t.txt: scan 1: id 7 must be there once"),
    ],
)
def test_a_list_that_does_not_fit_is_refused_in_one_line(
    write: Any, name: str, fault: str, rule: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path, truth = write(tmp_path / name, broken(lines(), fault)), truth_recording(tmp_path / "truth.mcap")
    assert main(["eval", "--against", str(path), "--truth-file", str(truth)]) == 2
    err = capsys.readouterr().err.strip()
    assert rule in err
    assert "\n" not in err


@pytest.mark.parametrize(
    ("name", "text", "rule"),
    [
        ("t.txt", "", "t.txt: holds no scan"),
        ("t.txt", "0 1 Car 0 0 -10 0 0 50 50\n", "t.txt: line 1: must have 17 columns of KITTI tracking, or 18"),
        ("t.txt", "0.5 1 Car" + " 0" * 14, "t.txt: line 1: frame must be a finite whole number, got '0.5'"),
        ("t.json", '{"results": {"0": [{}]}}', "t.json: results"),
        ("t.json", '{"results"', "t.json: must be JSON"),
        ("t.json", "[" * 100_000, "t.json: must be JSON"),
        ("t.jsonl", "{}\n", "t.jsonl: line 1: Object missing required field scan_id"),
        ("t.jsonl", '{"scan_id": 0, "stamp_ns": 0, "frame": "radar"}\n', "must hold objects or tracks"),
        ("t.csv", "", "t.csv: must end in .jsonl, .json, .txt, .mcap"),
    ],
)
def test_files_of_other_layouts_are_refused_in_one_line(
    name: str, text: str, rule: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / name
    path.write_text(text)
    assert main(["eval", "--against", str(path), "--truth-file", str(path)]) == 2
    err = capsys.readouterr().err.strip()
    assert rule in err
    assert "\n" not in err


def test_options_that_do_not_fit_are_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = str(as_lines(tmp_path / "t.jsonl", lines()))
    assert main(["eval", "--against", path]) == 2
    assert "--truth-file must be given once for each --against, got 0 for 1" in capsys.readouterr().err
    assert main(["eval", "--against", path, "--truth-file", path, "--objects"]) == 2
    assert "--objects must not be given with --against" in capsys.readouterr().err
