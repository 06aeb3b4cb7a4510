"""Triangle meshes as objects: read from OBJ, PLY, STL or glTF, or built as primitives; validated on input.

Frame of its own: x forward, y left, z up, on the ground (min z = 0) and centred in plan by its box.
"""

from __future__ import annotations

import contextlib
import json
import math
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import numpy as np

from msgs.files.text_files import without_mark

Unit = Literal["m", "mm"]
UpAxis = Literal["y", "z"]

#: Formats and the axis that is up in them unless a scene says otherwise; glTF 2.0 fixes +y.
UP_AXIS: dict[str, UpAxis] = {".obj": "z", ".ply": "z", ".stl": "z", ".glb": "y", ".gltf": "y"}
#: Longest extent of a plausible object. The same numbers never pass both as metres and as millimetres.
EXTENT_M = (0.05, 40.0)
MAX_FACES = 1_000_000
MAX_BYTES = 256 * 2**20
#: Placements of parts in a glTF and its parts, and changes of material in an OBJ.
MAX_PARTS = 1000
#: Vertices nearer than this share of the longest extent are one.
WELD_SHARE = 1e-7
#: A triangle whose height is less than this share of its longest edge counts as degenerate.
FLAT_SHARE = 1e-6


@dataclass(frozen=True, eq=False)
class Mesh:
    """Triangles of one material: V vertices, F faces, counter-clockwise seen from outside where there is an outside."""

    vertices_m: np.ndarray
    faces: np.ndarray
    material: str
    name: str

    @cached_property
    def corners_m(self) -> np.ndarray:
        """Corners of all faces, [F, 3, 3]."""
        return self.vertices_m[self.faces]

    @cached_property
    def _doubled_normals(self) -> np.ndarray:
        a, b, c = np.moveaxis(self.corners_m, 1, 0)
        return np.cross(b - a, c - a)

    @cached_property
    def areas_m2(self) -> np.ndarray:
        """Area of each face, [F]."""
        return 0.5 * np.linalg.norm(self._doubled_normals, axis=1)

    @cached_property
    def normals(self) -> np.ndarray:
        """Unit normal of each face by its winding, [F, 3]; outward where the mesh is closed."""
        return self._doubled_normals / (2.0 * self.areas_m2[:, None])

    @cached_property
    def closed(self) -> bool:
        """True where every edge joins exactly two faces that are wound alike, so that there is an inside."""
        edges = directed_edges(self.faces)
        _, count = np.unique(np.sort(edges, axis=1), axis=0, return_counts=True)
        return bool((count == 2).all()) and len(np.unique(edges, axis=0)) == len(edges)

    @property
    def extent_m(self) -> np.ndarray:
        """Size of the box along x, y, z, [3]."""
        return np.ptp(self.vertices_m, axis=0)


def load_mesh(path: Path, unit: Unit = "m", material: str = "metal", up: UpAxis | None = None) -> Mesh:
    """Return a mesh from an OBJ, PLY, STL, GLB or glTF file, in metres, z up, on the ground, centred in plan.

    glTF (and `up="y"`) is turned so that its front, +z, is x. Closed parts are wound outward; open ones keep the file's
    winding, made consistent. ValueError in one line: file, field, value, rule.
    """
    if unit not in ("m", "mm"):
        raise ValueError(f"{path}: unit: must be m or mm, got {unit!r}")
    if path.suffix.lower() not in UP_AXIS:
        raise ValueError(f"{path}: format: must be one of {', '.join(UP_AXIS)}, got {path.suffix!r}")
    vertices, faces = _read(path)
    try:
        _check_arrays(vertices, faces)
        vertices = vertices * (1e-3 if unit == "mm" else 1.0)
        _check_extent(float(np.ptp(vertices[faces].reshape(-1, 3), axis=0).max()), unit)
        if (up or UP_AXIS[path.suffix.lower()]) == "y":
            vertices = vertices[:, [2, 0, 1]]
        return mesh_from_arrays(vertices, faces, material, path.stem)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None


def mesh_from_arrays(vertices_m: np.ndarray, faces: np.ndarray, material: str, name: str) -> Mesh:
    """Return a mesh from arrays: welded, wound outward, on the ground, centred; ValueError for no area."""
    vertices_m, faces = np.asarray(vertices_m, np.float64), np.asarray(faces, np.int64)
    # vertices at one position are one, so that faces share them with their neighbours
    step = WELD_SHARE * max(float(np.ptp(vertices_m, axis=0).max()), 1e-12)
    _, first, label = np.unique(np.round(vertices_m / step), axis=0, return_index=True, return_inverse=True)
    vertices_m, faces = vertices_m[first], label.ravel()[faces]
    corners = vertices_m[faces]
    edges = np.roll(corners, -1, axis=1) - corners
    doubled = np.linalg.norm(np.cross(edges[:, 0], edges[:, 1]), axis=1)
    solid = doubled > FLAT_SHARE * np.linalg.norm(edges, axis=2).max(axis=1) ** 2
    if not solid.any():
        raise ValueError(f"faces: all {len(faces)} are degenerate (no area)")
    kept, label = np.unique(faces[solid], return_inverse=True)
    vertices_m, faces = vertices_m[kept], label.reshape(-1, 3)
    _, first = np.unique(np.sort(faces, axis=1), axis=0, return_index=True)
    faces = faces[np.sort(first)]
    # each part wound alike, and outward where it encloses a volume
    part, flipped, closed = _parts(faces)
    faces = np.where(flipped[:, None], faces[:, ::-1], faces)
    a, b, c = np.moveaxis(vertices_m[faces] - vertices_m.mean(axis=0), 1, 0)
    inward = closed & (np.bincount(part, np.einsum("ij,ij->i", a, np.cross(b, c))) < 0.0)
    faces = np.where(inward[part][:, None], faces[:, ::-1], faces)
    least, middle = vertices_m.min(axis=0), 0.5 * (vertices_m.min(axis=0) + vertices_m.max(axis=0))
    return Mesh(vertices_m - np.array([middle[0], middle[1], least[2]]), faces, material, name)


def box(length_m: float, width_m: float, height_m: float, material: str = "metal") -> Mesh:
    """Return a closed box: length along x, width along y."""
    unit = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], np.float64)
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    return mesh_from_arrays(unit * (length_m, width_m, height_m), _halved(quads), material, "box")


def plate(width_m: float, height_m: float, material: str = "metal") -> Mesh:
    """Return an upright plate without thickness that faces +x; both sides reflect."""
    y, z = np.array([0.0, width_m, width_m, 0.0]), np.array([0.0, 0.0, height_m, height_m])
    return mesh_from_arrays(np.column_stack([np.zeros(4), y, z]), _halved([(0, 1, 2, 3)]), material, "plate")


def dihedral(width_m: float, height_m: float, material: str = "metal") -> Mesh:
    """Return two upright plates of a width that meet at 90 degrees along z and open towards +x."""
    reach = width_m / math.sqrt(2.0)
    plan = np.array([[0.0, 0.0], [reach, reach], [reach, -reach]])
    vertices = np.concatenate([np.column_stack([plan, np.full(3, z)]) for z in (0.0, height_m)])
    return mesh_from_arrays(vertices, _halved([(0, 1, 4, 3), (0, 3, 5, 2)]), material, "dihedral")


def trihedral(edge_m: float, material: str = "metal") -> Mesh:
    """Return a triangular corner reflector of three faces at right angles, its axis of symmetry along +x."""
    axis = np.array([1.0, 1.0, 1.0]) / math.sqrt(3.0)
    left = np.array([-1.0, 1.0, 0.0]) / math.sqrt(2.0)
    vertices = np.concatenate([np.zeros((1, 3)), edge_m * np.eye(3)]) @ np.stack([axis, left, np.cross(axis, left)]).T
    return mesh_from_arrays(vertices, np.array([(0, 1, 2), (0, 2, 3), (0, 3, 1)]), material, "trihedral")


def cylinder(diameter_m: float, height_m: float, material: str = "metal", sides: int = 192) -> Mesh:
    """Return a closed upright cylinder of flat sides."""
    angle = 2.0 * np.pi * np.arange(sides) / sides
    ring = 0.5 * diameter_m * np.column_stack([np.cos(angle), np.sin(angle), np.zeros(sides)])
    top_middle = np.array([[0.0, 0.0, height_m]])
    vertices = np.concatenate([ring, ring + top_middle, 0.0 * top_middle, top_middle])
    low, high = np.arange(sides), np.arange(sides) + sides
    next_low, next_high = np.roll(low, -1), np.roll(high, -1)
    bottom, top = np.full(sides, 2 * sides), np.full(sides, 2 * sides + 1)
    triangles = [(low, next_low, next_high), (low, next_high, high), (bottom, next_low, low), (top, high, next_high)]
    return mesh_from_arrays(vertices, np.concatenate([np.stack(t, axis=1) for t in triangles]), material, "cylinder")


def sphere(diameter_m: float, material: str = "metal", rounds: int = 4) -> Mesh:
    """Return a closed sphere: an icosahedron whose faces are cut in four `rounds` times (20 * 4^rounds faces)."""
    golden = 0.5 * (1.0 + math.sqrt(5.0))
    corners = [(0.0, a, b * golden) for a in (-1.0, 1.0) for b in (-1.0, 1.0)]
    vertices = np.array([np.roll(corner, turn) for turn in range(3) for corner in corners])
    # the faces of an icosahedron: triples of corners at the edge length, 2
    near = np.abs(np.linalg.norm(vertices[:, None] - vertices[None], axis=2) - 2.0) < 1e-9
    faces = np.argwhere(near[:, :, None] & near[:, None, :] & near[None, :, :])
    triangles = vertices[faces[(np.diff(faces, axis=1) > 0).all(axis=1)]]
    for _ in range(rounds):
        a, b, c = np.moveaxis(triangles, 1, 0)
        ab, bc, ca = 0.5 * (a + b), 0.5 * (b + c), 0.5 * (c + a)
        quarters = (a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca)
        triangles = np.concatenate([np.stack(quarter, axis=1) for quarter in quarters])
    triangles *= 0.5 * diameter_m / np.linalg.norm(triangles, axis=2, keepdims=True)
    return mesh_from_arrays(triangles.reshape(-1, 3), np.arange(3 * len(triangles)).reshape(-1, 3), material, "sphere")


#: Primitives by name: constructor and meaning of `size_m`.
PRIMITIVES: dict[str, tuple[Any, tuple[str, ...]]] = {
    "box": (box, ("length", "width", "height")),
    "plate": (plate, ("width", "height")),
    "dihedral": (dihedral, ("width", "height")),
    "trihedral": (trihedral, ("edge",)),
    "cylinder": (cylinder, ("diameter", "height")),
    "sphere": (sphere, ("diameter",)),
}


def primitive_mesh(name: str, size_m: tuple[float, ...], material: str = "metal") -> Mesh:
    """Return a primitive by name; ValueError where the sizes do not fit it or the extent is not plausible."""
    if name not in PRIMITIVES:
        raise ValueError(f"primitive: must be one of {', '.join(PRIMITIVES)}, got {name!r}")
    build, sizes = PRIMITIVES[name]
    if len(size_m) != len(sizes):
        raise ValueError(f"size_m: a {name} takes [{', '.join(sizes)}], got {list(size_m)}")
    if not all(math.isfinite(size) and size > 0.0 for size in size_m):
        raise ValueError(f"size_m: must be finite and positive, got {list(size_m)}")
    if not EXTENT_M[0] <= max(size_m) <= EXTENT_M[1]:
        raise ValueError(f"size_m: the longest must lie in {EXTENT_M[0]:g}..{EXTENT_M[1]:g} m, got {list(size_m)}")
    mesh: Mesh = build(*size_m, material=material)
    return mesh


def _halved(quads: list[tuple[int, int, int, int]]) -> np.ndarray:
    """Return two triangles of each quadrangle."""
    return np.array([half for a, b, c, d in quads for half in ((a, b, c), (a, c, d))])


def _read(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Return the vertices [V, 3] and faces [F, 3] as the file has them, all parts of it in one."""
    import trimesh

    if not path.is_file():
        raise ValueError(f"{path}: no such mesh file")
    size = path.stat().st_size
    if size > MAX_BYTES:
        raise ValueError(f"{path}: size: at most {MAX_BYTES // 2**20} MiB are read, got {size / 2**20:.0f}")
    try:
        _refuse_cut_obj(path)
        _refuse_promises(path)
        # glTF is JSON, which has no mark, and names files beside it
        with contextlib.nullcontext(path) if path.suffix.lower() == ".gltf" else without_mark(path) as plain:
            whole = trimesh.load_scene(plain, process=False, skip_materials=True).to_mesh()
        return np.array(whole.vertices, np.float64), np.array(whole.faces, np.int64)
    except Exception as error:  # noqa: BLE001  a reader of foreign files may raise anything; all of it means one thing
        raise ValueError(f"{path}: not a readable {path.suffix[1:]} file: {' '.join(str(error).split())}") from None


def _refuse_cut_obj(path: Path) -> None:
    """Raise ValueError where an OBJ's last face has under three corners: readers drop such a line silently."""
    if path.suffix.lower() != ".obj":
        return
    with path.open("rb") as file:
        file.seek(max(path.stat().st_size - 4096, 0))
        last = file.read().split(b"\n")[-1].split()
    if last and last[0] == b"f" and len(last) < 4:
        raise ValueError("cut off within its last face")


def _refuse_promises(path: Path) -> None:
    """Raise ValueError where a file asks its reader for far more than it holds."""
    if path.suffix.lower() == ".obj":
        # the reader looks through all corners of the file for each change of material
        parts = path.read_bytes().count(b"usemtl")
        if parts > MAX_PARTS:
            raise ValueError(f"at most {MAX_PARTS} changes of material are read, got {parts}")
    elif path.suffix.lower() in (".gltf", ".glb"):
        tree = _gltf_tree(path)
        primitives = sum(len(mesh["primitives"]) for mesh in tree.get("meshes", ()))
        for name, parts in (("nodes", len(tree.get("nodes", ()))), ("primitives", primitives)):
            if parts > MAX_PARTS:
                raise ValueError(f"{name}: at most {MAX_PARTS} are read, got {parts}")
        for number, accessor in enumerate(tree.get("accessors", ())):
            # zeros that no buffer holds
            count = accessor.get("count", 0)
            if "bufferView" not in accessor and count > MAX_FACES:
                raise ValueError(f"accessors[{number}].count: at most {MAX_FACES} without data, got {count}")


def _gltf_tree(path: Path) -> dict[str, Any]:
    """Return the JSON of a glTF file, of a binary one that of its first chunk."""
    data = path.read_bytes()
    if path.suffix.lower() == ".glb":
        data = data[20 : 20 + int.from_bytes(data[12:16], "little")]
    tree = json.loads(data)
    if not isinstance(tree, dict):
        raise ValueError(f"must be a JSON object, got {type(tree).__name__}")
    return tree


def _check_arrays(vertices: np.ndarray, faces: np.ndarray) -> None:
    """Check shapes, the number of faces, finite vertices and valid corner indices."""
    if vertices.shape[1:] != (3,) or faces.shape[1:] != (3,):
        raise ValueError(f"vertices and faces: must have three numbers each, got {vertices.shape} and {faces.shape}")
    if not len(faces):
        raise ValueError("faces: must hold at least one triangle, got 0 (empty, or cut off)")
    if len(faces) > MAX_FACES:
        raise ValueError(f"faces: at most {MAX_FACES}, got {len(faces)}: simplify the mesh")
    bad = ~np.isfinite(vertices).all(axis=1)
    if bad.any():
        raise ValueError(f"vertices[{bad.argmax()}]: must be finite, got {vertices[bad.argmax()].tolist()}")
    if faces.min() < 0 or faces.max() >= len(vertices):
        raise ValueError(f"faces: corners must be 0..{len(vertices) - 1}, got {faces.min()}..{faces.max()}")


def _check_extent(extent_m: float, unit: Unit) -> None:
    """Check that the longest extent is plausible for an object in this unit."""
    if EXTENT_M[0] <= extent_m <= EXTENT_M[1]:
        return
    other_unit, other_m = ("mm", extent_m * 1e-3) if unit == "m" else ("m", extent_m * 1e3)
    hint = f": give unit: {other_unit}?" if EXTENT_M[0] <= other_m <= EXTENT_M[1] else ""
    raise ValueError(
        f"unit: the longest extent must lie in {EXTENT_M[0]:g}..{EXTENT_M[1]:g} m, got {extent_m:g} m in {unit}{hint}"
    )


def directed_edges(faces: np.ndarray) -> np.ndarray:
    """Return the three edges of every face, in the order of its corners, [3 F, 2]."""
    return np.stack([faces, np.roll(faces, -1, axis=1)], axis=2).reshape(-1, 2)


def _parts(faces: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the connected part of each face, which faces to turn over for one winding, which parts are closed.

    Two nodes a face, as it is and turned over, joined where wound alike: two components (a Moebius strip: one).
    """
    count = len(faces)
    edges = directed_edges(faces)
    _, label, shared = np.unique(np.sort(edges, axis=1), axis=0, return_inverse=True, return_counts=True)
    label = label.ravel()
    order = np.argsort(label, kind="stable")
    pairs = order[shared[label[order]] == 2].reshape(-1, 2)
    first_face, second_face = pairs[:, 0] // 3, pairs[:, 1] // 3
    alike = edges[pairs[:, 0], 0] != edges[pairs[:, 1], 0]
    _, part = components(count, first_face, second_face)
    same = np.where(alike, 0, count)
    _, sheet = components(
        2 * count,
        np.concatenate([first_face, first_face + count]),
        np.concatenate([second_face + same, second_face + count - same]),
    )
    # the sheet of each part's first face stays as it is
    _, first = np.unique(part, return_index=True)
    flipped = sheet[:count] != sheet[first][part]
    closed = np.bincount(part, (shared[label].reshape(-1, 3) != 2).any(axis=1)) == 0
    return part, flipped, closed


def components(count: int, first: np.ndarray, second: np.ndarray) -> tuple[int, np.ndarray]:
    """Return the connected components of an undirected graph: their number and the label of each node."""
    # imported here: most scenes have no mesh
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    graph = coo_array((np.ones(len(first), np.int8), (first, second)), shape=(count, count))
    number, label = connected_components(graph, directed=False)
    return int(number), label
