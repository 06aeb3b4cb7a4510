"""Text of other people's files: marks, UTF-16, and bytes of cp1252."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from contrib.annotate.clouds import read_cloud
from contrib.boards.config_file import read_config
from models.perception.cards import read_card
from models.perception.find.onnx_model import ModelCard
from msgs.files.shipped import WEIGHTS
from msgs.files.text_files import AS_CP1252, decode_text, read_text, without_mark
from msgs.recording.sigmf import _load_metadata
from nodes.can.bus import load_dbc
from nodes.process.launch_file import read_yaml_mapping
from sim_player.bodies.meshes import load_mesh
from sim_player.maps.geojson import read_geojson
from sim_player.maps.wall_rules import read_rules
from sim_player.scene.description import load_scene
from tests.captures import DATA
from tests.contrib.boards.test_import_dca1000 import CFG

ENCODINGS = ("utf-8", "utf-8-sig", "utf-16", "utf-16-le", "utf-32")
CUBE = "\n".join(
    [f"v {x} {y} {z}" for x in (0, 1) for y in (0, 1) for z in (0, 1)]
    + ["f 1 2 4", "f 1 4 3", "f 5 8 6", "f 5 7 8", "f 1 5 6", "f 1 6 2", "f 3 4 8", "f 3 8 7", "f 1 3 7", "f 1 7 5"]
)
HEADER = "VERSION 0.7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\nWIDTH 3\nHEIGHT 1\nPOINTS 3\nDATA ascii\n"
PLY = (
    "ply\nformat ascii 1.0\nelement vertex 3\n" + "".join(f"property float {name}\n" for name in "xyz") + "end_header\n"
)
POINTS = "1 2 3\n4 5 6\n7 8 9\n"
DBC = 'VERSION ""\nBO_ 5 A: 8 X\n SG_ V : 0|8@1+ (1,0) [0|0] "m/s" X\n'
POLYGON = '{"type":"Polygon","coordinates":[[[11.0,48.0],[11.1,48.0],[11.1,48.1],[11.0,48.0]]]}'


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_text_is_read_by_its_mark(tmp_path: Path, encoding: str) -> None:
    path = tmp_path / "a.txt"
    mark = "\ufeff" if encoding == "utf-16-le" else ""
    path.write_text(f"{mark}Prüfstand 5", encoding=encoding)
    assert read_text(path) == "Prüfstand 5"


def test_bytes_of_no_encoding() -> None:
    """A file of both: what is UTF-8 stays UTF-8, each other byte is of cp1252; 0x81 is a character of neither."""
    assert decode_text(b"Pr\xfcfstand \xc3\xbc \x80 \x81", AS_CP1252) == "Prüfstand ü € \ufffd"
    with pytest.raises(ValueError, match=r"must be UTF-8 text, got byte 0xfc at 2$"):
        decode_text(b"Pr\xfcf")


@pytest.mark.parametrize(
    ("name", "text", "read"),
    [
        ("a.geojson", POLYGON, lambda path: read_geojson(path).footprints),
        ("a.yaml", "a: 1\n", read_yaml_mapping),
        ("a.yaml", "name: x\nradar: {preset: xband}\nobjects: [{class: car, x_m: 5, y_m: 0}]\n", load_scene),
        ("a.yaml", "- {key: building, value: a, material: brick}\n", lambda path: read_rules([str(path)])[0]),
        ("a.dbc", DBC, lambda path: len(load_dbc(path).messages)),
        ("a.sigmf-meta", (DATA / "sigmf_alley" / "alley.sigmf-meta"), _load_metadata),
        ("a.json", WEIGHTS / "compact_unet.json", lambda path: read_card(path, ModelCard)),
        ("a.cfg", CFG, lambda path: read_config(path, None)),
    ],
    ids=["geojson", "launch", "scene", "walls", "dbc", "sigmf", "card", "cfg"],
)  # fmt: skip
@pytest.mark.parametrize("encoding", ENCODINGS[1:3])
def test_every_reader_takes_a_mark(
    tmp_path: Path, name: str, text: str | Path, read: Callable[[Path], object], encoding: str
) -> None:
    if isinstance(text, Path):
        if not text.is_file():
            pytest.skip(f"needs {text}")
        text = text.read_text()
    path = tmp_path / name
    path.write_text(text)
    expected = read(path)
    path.write_text(text, encoding=encoding)
    assert read(path) == expected


@pytest.mark.parametrize(
    ("name", "text", "read"),
    [
        ("a.obj", CUBE, lambda path: len(load_mesh(path).faces)),
        ("a.pcd", HEADER + POINTS, lambda path: read_cloud(path)[0].tolist()),
        ("a.xyz", POINTS, lambda path: read_cloud(path)[0].tolist()),
        ("a.ply", PLY + POINTS, lambda path: read_cloud(path)[0].tolist()),
    ],
    ids=["obj", "pcd", "xyz", "ply"],
)
def test_the_mark_of_a_mesh_or_a_cloud_takes_no_point_away(
    tmp_path: Path, name: str, text: str, read: Callable[[Path], object]
) -> None:
    path = tmp_path / name
    path.write_text(text)
    expected = read(path)
    path.write_text(text, encoding="utf-8-sig")
    assert read(path) == expected
    path.write_text("\ufeffno such thing")
    with pytest.raises(ValueError, match=rf"^{path}"):
        read(path)
    with without_mark(path) as plain:
        assert plain.read_text() == "no such thing"
    assert not plain.exists()
