"""Meshes at the door: four formats give one car, and what is broken is refused in one line.

The files in tests/data/meshes hold one car of two closed boxes (4.2 x 1.8 m, 1.4 m high, cabin behind the middle), off
the origin: OBJ in metres, PLY and STL in millimetres, GLB in metres with y up and its front along +z.
"""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from msgs.files.shipped import CHECKOUT
from sim_player.bodies import meshes
from sim_player.bodies.meshes import Mesh, Unit, load_mesh, mesh_from_arrays, primitive_mesh

FILES = CHECKOUT / "tests" / "data" / "meshes"
CAR = {"two_box_car.obj": "m", "two_box_car_mm.ply": "mm", "two_box_car_mm.stl": "mm", "two_box_car.glb": "m"}
TETRAHEDRON = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"


def volume_m3(mesh: Mesh) -> float:
    """Enclosed volume, positive for outward normals."""
    a, b, c = np.moveaxis(mesh.corners_m, 1, 0)
    return float(np.einsum("ij,ij->", a, np.cross(b, c)) / 6.0)


def written(folder: Path, text: str, name: str = "x.obj") -> Path:
    path = folder / name
    path.write_text(text, encoding="utf-8")
    return path


@pytest.mark.parametrize(("name", "unit"), CAR.items())
def test_four_formats_give_one_car(name: str, unit: Unit) -> None:
    """Same size, place and volume; the cabin (above 1 m) lies behind the middle; normals point outward."""
    car = load_mesh(FILES / name, unit, "metal")
    assert car.extent_m == pytest.approx([4.2, 1.8, 1.4], abs=1e-5)
    assert car.vertices_m.min(axis=0) == pytest.approx([-2.1, -0.9, 0.0], abs=1e-5)
    assert car.vertices_m[car.vertices_m[:, 2] > 1.0].mean(axis=0) == pytest.approx([-0.5, 0.0, 1.4], abs=1e-5)
    assert (car.closed, len(car.faces), len(car.vertices_m)) == (True, 24, 16)
    assert volume_m3(car) == pytest.approx(4.2 * 1.8 * 0.8 + 2.0 * 1.6 * 0.6, rel=1e-5)
    assert (car.name, car.material) == (Path(name).stem, "metal")


def test_up_may_be_said() -> None:
    """The OBJ read as y up: its y becomes z, its z becomes x (front), its x becomes y."""
    car = load_mesh(FILES / "two_box_car.obj", up="y")
    assert car.extent_m == pytest.approx([1.4, 4.2, 1.8])


@pytest.mark.parametrize(
    ("name", "unit", "complaint"),
    [
        ("two_box_car_mm.ply", "m", r"unit: .* 0\.05\.\.40 m, got 4200 m in m: give unit: mm\?"),
        ("two_box_car.obj", "mm", r"unit: .* got 0\.0042 m in mm: give unit: m\?"),
        ("two_box_car.obj", "cm", "unit: must be m or mm, got 'cm'"),
        ("none.obj", "m", "no such mesh file"),
    ],
)
def test_wrong_units_are_refused(name: str, unit: Unit, complaint: str) -> None:
    with pytest.raises(ValueError, match=complaint) as caught:
        load_mesh(FILES / name, unit)
    assert str(caught.value).startswith(f"{FILES / name}: ")


def test_no_size_passes_in_both_units() -> None:
    """The plausible ranges, 0.05..40 m and 50..40000 mm, share no number."""
    least, most = meshes.EXTENT_M
    assert most < 1e3 * least


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("", "faces: must hold at least one triangle"),
        ("v 0 0 0\nv 1 0 0\nv 0 1 0\n", "faces: must hold at least one triangle"),
        ("v 0 0 0\nv 1 0 0\nv nan 1 0\nf 1 2 3\n", r"vertices\[2\]: must be finite, got \[nan, 1\.0, 0\.0\]"),
        ("v 0 0 0\nv 1 0 0\nv 2 0 0\nf 1 2 3\nf 1 2 2\n", r"faces: all 2 are degenerate"),
        ("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 9\n", "not a readable obj file: index 8 is out of bounds"),
        (TETRAHEDRON.removesuffix(" 4\n"), "cut off within its last face"),
    ],
)
def test_broken_meshes_are_refused(text: str, complaint: str, tmp_path: Path) -> None:
    path = written(tmp_path, text)
    with pytest.raises(ValueError, match=complaint) as caught:
        load_mesh(path)
    assert str(caught.value).startswith(f"{path}: ")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("name", [name for name in CAR if not name.endswith("obj")])
@pytest.mark.parametrize("share", [0.0, 0.02, 0.5, 0.99])
def test_cut_off_files_are_refused(name: str, share: float, tmp_path: Path) -> None:
    """Binary formats know their length: every cut is found."""
    whole = (FILES / name).read_bytes()
    path = tmp_path / name
    path.write_bytes(whole[: int(share * len(whole))])
    with pytest.raises(ValueError, match=r"not a readable|faces: must hold") as caught:
        load_mesh(path, CAR[name])  # type: ignore[arg-type]
    assert "\n" not in str(caught.value)


def test_unknown_format_and_absurd_sizes_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(ValueError, match=r"format: must be one of \.obj, .*, got '\.dae'"):
        load_mesh(written(tmp_path, TETRAHEDRON, "x.dae"))
    path = written(tmp_path, TETRAHEDRON)
    monkeypatch.setattr(meshes, "MAX_FACES", 3)
    with pytest.raises(ValueError, match="faces: at most 3, got 4: simplify"):
        load_mesh(path)
    monkeypatch.setattr(meshes, "MAX_BYTES", 10)
    with pytest.raises(ValueError, match="size: at most"):
        load_mesh(path)


def test_faces_without_area_are_dropped_and_counted(tmp_path: Path) -> None:
    mesh = load_mesh(written(tmp_path, TETRAHEDRON + "f 1 2 2\nf 3 3 3\n"))
    assert (len(mesh.faces), mesh.closed) == (4, True)


def test_any_winding_ends_outward() -> None:
    """Faces of two tetrahedra turned over at random: volume positive, normals off the middle of each."""
    rng = np.random.default_rng([5, 0])
    one = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
    faces = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])
    for _ in range(20):
        turned = np.array([rng.permutation(face) for face in np.concatenate([faces, faces + 4])])
        mesh = mesh_from_arrays(np.concatenate([one, one + 3.0]), turned, "metal", "two")
        assert mesh.closed
        assert volume_m3(mesh) == pytest.approx(2.0 / 6.0)


def test_open_mesh_is_wound_alike() -> None:
    """A plate of 2 x 8 triangles with faces turned over at random: all normals agree."""
    rng = np.random.default_rng([5, 1])
    x, y = np.meshgrid(np.arange(5.0), np.arange(3.0), indexing="ij")
    cell = np.array([[0, 3, 4], [0, 4, 1]])
    faces = np.concatenate([cell + 3 * i + j for i in range(4) for j in range(2)])
    turned = np.where(rng.random(len(faces))[:, None] < 0.5, faces[:, ::-1], faces)
    mesh = mesh_from_arrays(np.column_stack([x.ravel(), y.ravel(), np.zeros(15)]), turned, "metal", "sheet")
    assert not mesh.closed
    assert np.abs(mesh.normals.sum(axis=0)) == pytest.approx([0, 0, 16])


@pytest.mark.parametrize(
    ("mesh", "extent", "area", "volume"),
    [
        (meshes.box(4.0, 2.0, 1.5), (4.0, 2.0, 1.5), 34.0, 12.0),
        (meshes.plate(2.0, 3.0), (0.0, 2.0, 3.0), 6.0, None),
        (meshes.dihedral(1.0, 3.0), (math.sqrt(0.5), math.sqrt(2.0), 3.0), 6.0, None),
        (meshes.trihedral(1.0), (math.sqrt(1 / 3), math.sqrt(2.0), math.sqrt(1.5)), 1.5, None),
        (meshes.cylinder(1.0, 2.0, sides=360), (1.0, 1.0, 2.0), 2.5 * math.pi, 0.5 * math.pi),
        (meshes.sphere(1.0, rounds=5), (1.0, 1.0, 1.0), math.pi, math.pi / 6.0),
    ],
    ids=lambda value: value.name if isinstance(value, Mesh) else "",
)
def test_primitives(mesh: Mesh, extent: tuple[float, ...], area: float, volume: float | None) -> None:
    """Size, surface, volume (round ones to 0.1 %: flat faces lie inside), on the ground and centred."""
    assert mesh.extent_m == pytest.approx(extent, rel=1e-3, abs=1e-12)
    assert mesh.areas_m2.sum() == pytest.approx(area, rel=1e-3)
    assert mesh.closed == (volume is not None)
    if volume is not None:
        assert volume_m3(mesh) == pytest.approx(volume, rel=2e-3)
    assert mesh.vertices_m[:, 2].min() == pytest.approx(0.0, abs=1e-12)
    middle = 0.5 * (mesh.vertices_m.min(axis=0) + mesh.vertices_m.max(axis=0))
    assert middle[:2] == pytest.approx([0.0, 0.0], abs=1e-12)


def test_corner_reflectors_open_forward() -> None:
    """A ray along -x meets faces whose normals have +x: 45 deg for the dihedral, arccos(1/sqrt 3) for the trihedral."""
    assert meshes.dihedral(1.0, 1.0).normals[:, 0] == pytest.approx(np.full(4, math.sqrt(0.5)))
    assert meshes.trihedral(1.0).normals[:, 0] == pytest.approx(np.full(3, math.sqrt(1.0 / 3.0)))


@pytest.mark.parametrize(
    ("name", "size_m", "complaint"),
    [
        ("cone", (1.0,), "primitive: must be one of box, plate"),
        ("box", (1.0, 2.0), r"size_m: a box takes \[length, width, height\], got \[1\.0, 2\.0\]"),
        ("sphere", (-1.0,), "size_m: must be finite and positive"),
        ("plate", (math.nan, 1.0), "size_m: must be finite and positive"),
        ("sphere", (0.01,), r"size_m: the longest must lie in 0\.05\.\.40 m"),
        ("box", (4500.0, 1800.0, 1500.0), r"size_m: the longest must lie in 0\.05\.\.40 m"),
    ],
)
def test_bad_primitives_are_refused(name: str, size_m: tuple[float, ...], complaint: str) -> None:
    with pytest.raises(ValueError, match=complaint):
        primitive_mesh(name, size_m)
