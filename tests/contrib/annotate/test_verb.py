"""`mirrorwave annotate` and `sim lidar` from end to end, and what they refuse."""

from __future__ import annotations

import json
from pathlib import Path

import msgspec
import numpy as np
import pytest
import yaml

from benchmarks.perception.annotation import pose_error
from contrib.annotate.clouds import read_cloud
from contrib.annotate.manifest import Pose, load_manifest
from lab.training.data.frames import DataSet
from mirrorwave.cli import main
from tests.side_sensors import jpeg

SCENE = "launch/scenes/facade_across_lane.yaml"
FEW = ("--chirps-per-beam", "2", "--effects", "basic")


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Clouds and a capture of one scene."""
    folder = tmp_path_factory.mktemp("annotate")
    lidar = ["sim", "lidar", SCENE, "--out", str(folder / "lidar"), "--channels", "48", "--azimuths", "480"]
    assert main(lidar) == 0
    assert main(["sim", "run", SCENE, "--out", str(folder / "scan.mcap"), *FEW]) == 0
    return folder


def run(made: Path, out: Path, *more: str) -> int:
    return main(
        ["annotate", str(made / "lidar/scene.yaml"), "--radar", str(made / "scan.mcap"), "--out", str(out), *more]
    )


def changed(made: Path, file: str, fields: dict[str, object]) -> Path:
    """The manifest with other fields, beside the first."""
    content = yaml.safe_load((made / "lidar/scene.yaml").read_text()) | fields
    path = made / "lidar" / file
    path.write_text(yaml.safe_dump(content))
    return path


@pytest.mark.slow
def test_annotation_returns_the_truth_it_was_made_from(
    made: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Poses to 3 cm and 0.2 deg; images (of sides of a car at x 10.1..11.9 in the facade x = 22) to 5 cm; the import
    takes the frame; the picture is there; equal input gives equal bytes; an existing frame is left alone."""
    capsys.readouterr()
    assert run(made, tmp_path / "truth", "--json", "--plot", str(tmp_path / "a.png")) == 0
    report = json.loads(capsys.readouterr().out)
    truth = json.loads((made / "lidar/truth.json").read_text())
    for cloud, true in zip(report["clouds"], truth, strict=True):
        poses = [msgspec.convert(one["radar_from_lidar"], Pose).transform() for one in (true, cloud)]
        away_m, turned_rad = pose_error(*poses)
        assert away_m < 0.03
        assert np.degrees(turned_rad) < 0.2
    labelled = tmp_path / "truth/facade_across_lane/frame_000/labeled_points"
    image, place, wall = (np.load(labelled / f"{name}.npy") for name in ("mirrored_nlos", "nlos", "wall"))
    assert len(image) == len(place) == report["points"]["mirrored"] > 10
    assert image[:, 1] == pytest.approx(44.0 - place[:, 1], abs=0.05)
    assert image[:, 0] == pytest.approx(place[:, 0], abs=0.05)
    off_m = np.min(np.abs(wall[:, 1:] - 22.0), axis=1)
    assert np.count_nonzero(off_m < 0.1) > 40
    assert (tmp_path / "a.png").stat().st_size > 10_000
    assert (
        main(["import", "xradarnlos", str(tmp_path / "truth"), "--kind", "real", "--out", str(tmp_path / "data")]) == 0
    )
    assert len(DataSet(tmp_path / "data").frame(0).labels.range_m) == report["points"]["los"] + len(image)
    capsys.readouterr()
    assert run(made, tmp_path / "truth") == 2
    assert "exists already" in capsys.readouterr().err
    assert run(made, tmp_path / "again") == 0
    files = sorted(path.relative_to(tmp_path / "again") for path in (tmp_path / "again").rglob("*") if path.is_file())
    assert len(files) == 7
    assert all((tmp_path / "again" / one).read_bytes() == (tmp_path / "truth" / one).read_bytes() for one in files)


@pytest.mark.slow
def test_one_recording_of_radar_lidar_and_camera_is_enough(
    made: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The same labels as from files of the clouds, to the rounding of a millimetre; the mounting is the first pose."""
    images = tmp_path / "images"
    images.mkdir()
    for at in range(3):
        (images / f"{at}.jpg").write_bytes(jpeg(seed=at))
    rig, merged = tmp_path / "rig.mcap", tmp_path / "all.mcap"
    words = ["import", "sensors", str(made / "lidar"), str(images), "--out", str(rig)]
    assert main(words) == 0
    assert main(["bag", "merge", str(made / "scan.mcap"), str(rig), "--out", str(merged)]) == 0
    content = yaml.safe_load((made / "lidar/scene.yaml").read_text())
    for scan, cloud in enumerate(content["clouds"]):
        cloud |= {"file": "all.mcap", "scan": scan}
    del content["clouds"][0]["radar_from_lidar"]
    scene = tmp_path / "scene.yaml"
    scene.write_text(yaml.safe_dump(content | {"radar": "all.mcap"}))
    assert main(["annotate", str(scene), "--out", str(tmp_path / "one")]) == 0
    assert run(made, tmp_path / "files") == 0
    folders = [tmp_path / name / "facade_across_lane/frame_000" for name in ("one", "files")]
    labels = [np.load(folder / "labeled_points/mirrored_nlos.npy") for folder in folders]
    assert len(labels[0]) == pytest.approx(len(labels[1]), abs=2)
    assert labels[0].mean(axis=0) == pytest.approx(labels[1].mean(axis=0), abs=0.05)
    notes = next((tmp_path / "one").rglob("camera.jpg"))
    assert notes.read_bytes() == jpeg(seed=0)
    assert json.loads((notes.parent / "annotation.json").read_text())["camera"]["stamp_ns"] == 0
    capsys.readouterr()
    content["clouds"][1]["scan"] = 7
    scene.write_text(yaml.safe_dump(content | {"radar": "all.mcap"}))
    assert main(["annotate", str(scene), "--out", str(tmp_path / "none")]) == 2
    assert "all.mcap: scan must be one of its 3 messages on lidar/points" in capsys.readouterr().err


@pytest.mark.slow
def test_a_cloud_that_cannot_be_registered_is_refused_or_left_out(
    made: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A first pose 90 m away: no overlap. Refused with one line, and nothing is written; or left out, exit code 3."""
    content = yaml.safe_load((made / "lidar/scene.yaml").read_text())
    content["clouds"][2]["radar_from_lidar"]["x_m"] = 90.0
    scene = changed(made, "far.yaml", content)
    more = ["--radar", str(made / "scan.mcap"), "--out", str(tmp_path / "truth")]
    assert main(["annotate", str(scene), *more]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert "clouds[2].file view_2.ply: overlap must be at least 0.3" in error
    assert not list(tmp_path.rglob("*.npy"))
    assert main(["annotate", str(scene), *more, "--skip-refused", "--json"]) == 3
    assert list(json.loads(capsys.readouterr().out)["refused"]) == ["clouds[2]"]


@pytest.mark.parametrize(
    ("fields", "said"),
    [
        ({"radar_height_m": -1.0}, "radar_height_m must be in 0..100, got -1.0"),
        ({"clouds": []}, "clouds must hold at least one cloud"),
        ({"clouds": [{"file": "view_0.ply"}]}, "clouds: one must have calibrated: true"),
        ({"clouds": [{"file": "view_0.ply", "scan": 1}]}, "clouds: scan is for recordings (.mcap)"),
        ({"clouds": [{"file": "a.mcap", "scan": -1}]}, "clouds[0].scan: Expected int >= 0"),
        ({"slice": {"thickness_m": 0.0}}, "slice.thickness_m: Expected float > 0.0"),
        ({"registration": {"min_hold": 2.0}}, "registration.min_hold: Expected float <= 1.0"),
        ({"walls": {"min_lenght_m": 1.0}}, "min_lenght_m"),
        ({"name": "../up"}, "name must be usable as a folder's name"),
        ({"walls": {"given_m": [[[0.0, float("nan")], [1.0, 1.0]]]}}, "given_m"),
        ({"walls": {"given_m": [[[3.0, 1.0], [3.0, 1.0]]]}}, "walls.given_m[0] must be longer than 0.12 m"),
        ({"walls": {"objects": [{"x_m": 1.0, "y_m": 1.0, "radius_m": -1.0}]}}, "radius_m: Expected float > 0.0"),
        ({"seed": "many"}, "seed"),
    ],
)
def test_a_manifest_that_does_not_fit_is_refused(
    made: Path, fields: dict[str, object], said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    path = changed(made, "wrong.yaml", fields)
    assert main(["annotate", str(path), "--radar", str(made / "scan.mcap"), "--out", str(made / "none")]) == 2
    error = capsys.readouterr().err
    assert "wrong.yaml" in error
    assert said in error
    assert error.count("\n") == 1


@pytest.mark.parametrize("text", ["", "[1, 2]", "name: [", "\x00"])
def test_what_is_no_manifest_is_refused(tmp_path: Path, text: str) -> None:
    (tmp_path / "scene.yaml").write_text(text)
    with pytest.raises(ValueError, match=r"scene\.yaml"):
        load_manifest(tmp_path / "scene.yaml")


def test_a_capture_that_is_missing_or_empty_is_refused(
    made: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    scene, out = str(made / "lidar/scene.yaml"), str(tmp_path / "out")
    (tmp_path / "empty.mcap").write_bytes(b"")
    for more, said in (
        ([], "radar: must name a capture"),
        (["--radar", str(tmp_path / "no.mcap")], "no.mcap: no such capture"),
        (["--radar", str(tmp_path / "empty.mcap")], "empty.mcap"),
        (["--radar", str(made / "scan.mcap"), "--frame", "../x"], "--frame"),
        (["--radar", str(made / "scan.mcap"), "--plot", str(tmp_path / "a.txt")], "a.txt: a picture's name must end"),
        (["--radar", str(made / "scan.mcap"), "--plot", str(tmp_path / "no/a.png")], "its directory does not exist"),
    ):
        assert main(["annotate", scene, "--out", out, *more]) == 2
        assert said in capsys.readouterr().err


def street() -> np.ndarray:
    rng = np.random.default_rng(0)
    return rng.uniform([-20.0, -20.0, 0.0], [20.0, 20.0, 3.0], (2000, 3))


def test_clouds_of_all_formats_are_read(tmp_path: Path) -> None:
    """PLY, PCD and XYZ as open3d writes them, NPY, millimetres as metres; what is not finite is left out."""
    from contrib.annotate.registration import import_open3d

    o3d = import_open3d()
    points = street()
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points))
    for suffix, packed in (("ply", False), ("pcd", False), ("pcd", True), ("xyz", False)):
        o3d.io.write_point_cloud(str(tmp_path / f"a.{suffix}"), cloud, compressed=packed)
        assert read_cloud(tmp_path / f"a.{suffix}")[0] == pytest.approx(points, abs=1e-5)
    np.save(tmp_path / "a.npy", np.concatenate([1e3 * points, [[np.nan, 0.0, 0.0], [0.0, np.inf, 0.0]]]))
    read, dropped = read_cloud(tmp_path / "a.npy", "mm")
    assert dropped == 2
    assert read == pytest.approx(points)


@pytest.mark.parametrize("suffix", ["ply", "pcd"])
@pytest.mark.parametrize("form", [{}, {"write_ascii": True}, {"compressed": True}], ids=["binary", "text", "packed"])
def test_a_cloud_that_is_cut_off_is_refused(tmp_path: Path, suffix: str, form: dict[str, bool]) -> None:
    """No cut in the points or the header may come through."""
    from contrib.annotate.registration import import_open3d

    o3d = import_open3d()
    path = tmp_path / f"a.{suffix}"
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(street()))
    o3d.io.write_point_cloud(str(path), cloud, **form)
    whole = path.read_bytes()
    assert len(read_cloud(path)[0]) == 2000
    for share in (0.0, 0.001, 0.3, 0.9, 0.995):
        path.write_bytes(whole[: int(share * len(whole))])
        with pytest.raises(ValueError, match=f"a.{suffix}"):
            read_cloud(path)


PLY = b"ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\nend_header\n"
PLY += b"0 0 1\n4 4 4\n1 2 3\n"
PCD = b"VERSION 0.7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\nWIDTH 3\nHEIGHT 1\nPOINTS 3\nDATA ascii\n"
PCD += b"0 0 1\n4 4 4\n1 2 3\n"


@pytest.mark.parametrize("suffix", ["xyz", "pcd"])
@pytest.mark.parametrize("line", ["1,5 2 3", "1.5m 2 3", "1; 2 3", "1_0 2 3", "one 2 3", "1 2 0x3"])
def test_a_line_that_is_no_point_is_named(tmp_path: Path, suffix: str, line: str) -> None:
    """Other readers leave such a line out, or take the beginnings of its words."""
    head = {"xyz": "// X Y Z\n# a remark\n", "pcd": PCD.decode().partition("0 0 1")[0]}[suffix]
    path = tmp_path / f"a.{suffix}"
    path.write_text(f"{head}-1.5e0 2. .5\r\n4 5 nan\n7 8 9")
    assert read_cloud(path)[0].tolist() == [[-1.5, 2.0, 0.5], [7.0, 8.0, 9.0]]
    path.write_text(f"{head}1 2 3\n{line}\n7 8 9\n")
    number = head.count("\n") + 2
    with pytest.raises(ValueError, match=rf"a\.{suffix}: line {number}: must be numbers with blanks .*, got '{line}'"):
        read_cloud(path)


def test_double_coordinates_of_a_pcd_are_read(tmp_path: Path) -> None:
    """open3d gave 0 for each. Fields before and between the coordinates, one of several values."""
    points = np.zeros(2000, [("i", "<u2"), ("x", "<f8"), ("y", "<f4"), ("n", "u1", (3,)), ("z", "<f8")])
    points["x"], points["y"], points["z"] = street().T
    head = "FIELDS i x y n z\nSIZE 2 8 4 1 8\nTYPE U F F U F\nCOUNT 1 1 1 3 1\nPOINTS 2000\nDATA binary\n"
    (tmp_path / "a.pcd").write_bytes(head.encode() + points.tobytes())
    assert read_cloud(tmp_path / "a.pcd")[0] == pytest.approx(street(), abs=1e-5)


def test_pulses_without_echo_and_strays_are_left_out(tmp_path: Path) -> None:
    """Zeros where a scanner got no echo, one point beyond all numbers and one that is none."""
    odd = np.array([[0.0, 0.0, 0.0], [1e30, 0.0, 0.0], [np.nan, 1.0, 1.0]])
    np.save(tmp_path / "a.npy", np.concatenate([street(), odd]))
    points_m, left_out = read_cloud(tmp_path / "a.npy")
    assert (len(points_m), left_out) == (len(street()), 3)


@pytest.mark.parametrize(
    ("name", "content", "said"),
    [
        ("a.npy", 1e3 * street(), "extent must be 2..1000 m, got .* with unit m: is it mm"),
        ("a.npy", 1e-3 * street(), "is it mm"),
        ("a.npy", np.full((9, 3), np.nan), "must be finite and not at the sensor .*, none of 9 is"),
        ("a.npy", np.zeros((0, 3)), "shape"),
        ("a.npy", np.zeros((4, 2)), "shape"),
        ("a.npy", np.array([["a", "b", "c"]]), "numbers of shape"),
        ("a.npy", b"\x93NUMPY\x01", "readable numpy array"),
        ("a.ply", b"", "header must end with end_header"),
        ("a.ply", PLY.replace(b"4 4 4", b"4 4"), "3 points.*cut off"),
        ("a.ply", PLY.replace(b"float z", b"float w"), "must have x, y and z, got x, y, w"),
        ("a.ply", PLY.replace(b"vertex 3", b"vertex 1000000000.0"), "no line of a PLY header: 'element vertex 1000"),
        ("a.ply", PLY.replace(b"format", b"comment end_header\nformat").replace(b"3\n", b"9\n"), "9 points.*cut off"),
        ("a.pcd", PCD.replace(b"4 4 4\n1", b"4\n1"), "3 points.*cut off"),
        ("a.pcd", PCD.replace(b"1 2 3\n", b"1 2 \0\n"), "line 12: must be numbers"),
        ("a.pcd", PCD.replace(b"DATA ascii\n", b""), "header must end with DATA"),
        (
            "a.ply",
            b"ply\nformat binary_little_endian 1.0\nelement vertex 99\nproperty float x\nend_header\n",
            "99 points.*cut off",
        ),
        ("a.pcd", b"not a cloud", "header must end with DATA"),
        ("a.las", b"LASF", "format must be one of"),
    ],
)
def test_a_cloud_that_does_not_fit_is_refused(tmp_path: Path, name: str, content: object, said: str) -> None:
    path = tmp_path / name
    path.write_bytes(content) if isinstance(content, bytes) else np.save(path, content)
    with pytest.raises(ValueError, match=f"{name}.*{said}"):
        read_cloud(path)


def test_sim_lidar_refuses(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "a").write_text("")
    assert main(["sim", "lidar", SCENE, "--out", str(tmp_path / "full")]) == 2
    assert "must be empty or new" in capsys.readouterr().err
    assert main(["sim", "lidar", SCENE, "--out", str(tmp_path / "new"), "--viewpoint", "1;2"]) == 2
    assert "--viewpoint must be X,Y" in capsys.readouterr().err
    assert not (tmp_path / "new").exists()
