"""Centres of bodies of known shape: cells of their faces, the ways by several of these, spheres, cylinders.

Triangles of a face are gathered in cells of `CELL_M`, under a range bin; a body of no more than `WHOLE_M` has one
centre a side. One that is not convex hides parts of itself and mirrors in itself, by two and three faces in a row, at
the point where these meet. A sphere is one centre, a cylinder's side one for each `CELL_M` of height. Bounds:
`MAX_CENTRES` cells, `MAX_PIECES` triangles, the `MAX_MIRRORS` largest plane and convex faces, `MAX_SEQUENCES` ways of
two and of three. Not modelled: creeping waves, edges beyond physical optics, transmission through thin dielectric
faces, curved mirrors, four bounces.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from itertools import permutations, product
from typing import Any

import numpy as np

from sim_player.bodies.fields import FACE_CORNERS
from sim_player.bodies.meshes import Mesh, components, cylinder, directed_edges
from sim_player.bodies.triangles import any_free, covered, cut_triangles, reflection_table, search_tree, triangle_areas

CELL_M, WHOLE_M = 0.15, 0.5
#: Longest side of a triangle, and how straight its phase is to be for a radar at the distance of the start: 0.1 m at
#: 5 m and 10 GHz. The phases of its corners are exact at any distance.
PIECE_M, PIECE_RAD = 0.2, 0.1
MAX_CENTRES, MAX_PIECES = 400, 20_000
MAX_MIRRORS, MAX_SEQUENCES = 16, 64
#: Directions that are looked at from each side of a piece of a body that may hide it, for pieces seen from nowhere.
LOOKS = 32
#: Share of a body's size under which distances are rounding.
ROUNDING = 1e-6
#: Faces further from a right angle than this send nothing back by two bounces that their own lobes would show.
RIGHT_ANGLE_SINE = 0.5
#: Rows of `Bodies.span`.
SPANS = 9


@dataclass(frozen=True, eq=False)
class Body:
    """Centres of one object, K of them, in its own frame turned as it stands; T triangles, P plane faces, Q ways."""

    #: Positions and normals [K, 3], greatest RCS [K]; radius and height of round ones, else 0 [K, 2].
    position_m: np.ndarray
    normal: np.ndarray
    peak_rcs_m2: np.ndarray
    size_m: np.ndarray
    #: First and number of triangles, first and number of ways of each centre, int64 [K, 4].
    span: np.ndarray
    #: Triangles [T, 3, 3], their unit normals [T, 3].
    piece_m: np.ndarray
    piece_normal: np.ndarray
    #: Corners [P, FACE_CORNERS, 3], their number [P], unit normals [P, 3]: of a hollow body inward.
    face_m: np.ndarray
    face_corners: np.ndarray
    face_normal: np.ndarray
    #: Faces of each way in order, -1 for no third one, int64 [Q, 3].
    sequence: np.ndarray
    #: Triangles that may stand in the way, [F, 3, 3]; none of a convex body.
    blocking_m: np.ndarray
    #: Both sides of its faces reflect; all of it lies on one side of each face.
    two_sided: bool
    hollow: bool
    material: str

    def turned(self, yaw_rad: float) -> Body:
        """Return the body turned about the upright axis."""
        c, s = math.cos(yaw_rad), math.sin(yaw_rad)
        turn = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
        names = ("position_m", "normal", "piece_m", "piece_normal", "face_m", "face_normal", "blocking_m")
        parts: dict[str, Any] = {name: getattr(self, name) @ turn for name in names}
        return replace(self, **parts)


#: Bodies as compiled code takes them: see `joined_bodies`.
Bodies = tuple[np.ndarray | tuple[np.ndarray, ...], ...]


def body_of(mesh: Mesh, wavelength_m: float, primitive: str | None = None, range_m: float = math.inf) -> Body:
    """Return the centres of a mesh (of a sphere or cylinder by name the round shape's) looked at from `range_m` on."""
    size_m = mesh.extent_m
    low_m = float(mesh.vertices_m[:, 2].min())
    if primitive == "sphere":
        return _round(mesh, wavelength_m, 0.5 * float(size_m[2]), np.array([low_m + 0.5 * float(size_m[2])]), 0.0)
    if primitive == "cylinder":
        return _cylinder(mesh, wavelength_m, float(size_m[0]), float(size_m[2]), low_m)
    return _faceted(mesh, wavelength_m, range_m)


def joined_bodies(bodies: list[Body], wavelength_m: float) -> Bodies:
    """Return all centres of some bodies as compiled code takes them, in order.

    Positions [C, 3], sizes [C, 2], spans [C, SPANS] (triangles, ways, faces: first and number; root of the search tree
    or -1; material; two-sided), triangles relative to the centre [T, 3, 3] and their normals, faces [P, ...], their
    corners, normals, offsets, shortest distances [C], search trees, reflection tables [M, 2, ...], ways [Q, 3].
    """
    materials = sorted({body.material for body in bodies} | {"metal"})
    spans, roots, trees = [np.zeros((0, SPANS), np.int64)], [], []
    triangles = sequences = faces = tree_faces = nodes = 0
    for body in bodies:
        root = -1
        if len(body.blocking_m):
            corners, bounds, first, count = search_tree(body.blocking_m)
            root = nodes
            trees.append((corners, bounds, first + np.where(count > 0, tree_faces, nodes), count))
            tree_faces, nodes = tree_faces + len(corners), nodes + len(bounds)
        roots.append(root)
        hollow = [faces, len(body.face_m) if body.hollow else 0]
        shared = [*hollow, root, materials.index(body.material), int(body.two_sided)]
        own = body.span + np.array([triangles, 0, sequences, 0])
        spans.append(np.column_stack([own, np.tile(shared, (len(own), 1))]).astype(np.int64))
        triangles, sequences = triangles + len(body.piece_m), sequences + len(body.sequence)
        faces += len(body.face_m)

    def joined(name: str, *shape: int, kind: type = np.float64) -> np.ndarray:
        return np.concatenate([np.zeros((0, *shape), kind), *(getattr(body, name) for body in bodies)])

    span = np.concatenate(spans)
    position_m, face_normal = joined("position_m", 3), joined("face_normal", 3)
    face_m = joined("face_m", FACE_CORNERS, 3)
    owner = np.repeat(np.arange(len(span)), span[:, 1])
    shift = np.cumsum([0, *(len(body.face_m) for body in bodies)])
    numbered = [np.where(body.sequence >= 0, body.sequence + shift[i], -1) for i, body in enumerate(bodies)]
    extent = [np.ptp(body.blocking_m.reshape(-1, 3), axis=0).max() if len(body.blocking_m) else 1.0 for body in bodies]
    empty = np.zeros((0, 3, 3)), np.zeros((0, 2, 3)), np.zeros(0, np.int64), np.zeros(0, np.int64)
    tables = np.array([reflection_table(material, wavelength_m) for material in materials])
    return (
        position_m,
        joined("size_m", 2),
        span,
        joined("piece_m", 3, 3) - position_m[owner][:, None],
        joined("piece_normal", 3),
        face_m,
        joined("face_corners", kind=np.int64),
        face_normal,
        np.einsum("pi,pi->p", face_normal, face_m[:, 0]),
        ROUNDING * np.repeat(np.array(extent), [len(body.position_m) for body in bodies]),
        tuple(np.concatenate([empty[i], *(tree[i] for tree in trees)]) for i in range(4)),
        tables,
        np.concatenate([np.zeros((0, 3), np.int64), *numbered]),
    )


def _empty(mesh: Mesh) -> Body:
    """Return a body of no centres."""
    none = np.zeros((0, 3))
    return Body(
        position_m=none,
        normal=none,
        peak_rcs_m2=np.zeros(0),
        size_m=np.zeros((0, 2)),
        span=np.zeros((0, 4), np.int64),
        piece_m=np.zeros((0, 3, 3)),
        piece_normal=none,
        face_m=np.zeros((0, FACE_CORNERS, 3)),
        face_corners=np.zeros(0, np.int64),
        face_normal=none,
        sequence=np.zeros((0, 3), np.int64),
        blocking_m=np.zeros((0, 3, 3)),
        two_sided=False,
        hollow=False,
        material=mesh.material,
    )


def _round(mesh: Mesh, wavelength_m: float, radius_m: float, height_m: np.ndarray, length_m: float) -> Body:
    """Return spheres (length 0) or pieces of an upright cylinder's side at heights of the axis."""
    count = len(height_m)
    peak = math.pi * radius_m**2 if length_m == 0.0 else 2.0 * math.pi * radius_m * length_m**2 / wavelength_m
    return replace(
        _empty(mesh),
        position_m=np.column_stack([np.zeros((count, 2)), height_m]),
        normal=np.tile([1.0, 0.0, 0.0], (count, 1)),
        peak_rcs_m2=np.full(count, peak),
        size_m=np.tile([radius_m, length_m], (count, 1)),
        span=np.zeros((count, 4), np.int64),
    )


def _cylinder(mesh: Mesh, wavelength_m: float, diameter_m: float, height_m: float, low_m: float) -> Body:
    """Return the side of an upright cylinder in pieces, and its two ends as discs of the same area."""
    count = 1 if height_m <= WHOLE_M else math.ceil(height_m / CELL_M)
    piece_m = height_m / count
    side = _round(mesh, wavelength_m, 0.5 * diameter_m, low_m + piece_m * (np.arange(count) + 0.5), piece_m)
    sides = max(32, math.ceil(math.pi * diameter_m / CELL_M))
    # a polygon of the circle's area
    wider = math.sqrt(2.0 * math.pi / (sides * math.sin(2.0 * math.pi / sides)))
    solid = cylinder(wider * diameter_m, height_m, mesh.material, sides)
    level = np.abs(solid.normals[:, 2]) > 0.5
    ends = solid.corners_m[level] + [0.0, 0.0, low_m]
    return _joined(side, _cells_of(_empty(mesh), ends, solid.normals[level], wavelength_m, CELL_M))


def _joined(first: Body, second: Body) -> Body:
    """Return the centres of two bodies of which the first has no triangles."""
    names = "position_m", "normal", "peak_rcs_m2", "size_m", "span"
    joined: dict[str, Any] = {name: np.concatenate([getattr(first, name), getattr(second, name)]) for name in names}
    return replace(second, **joined)


def _faceted(mesh: Mesh, wavelength_m: float, range_m: float) -> Body:
    """Return the centres of a body of plane faces."""
    size_m = float(mesh.extent_m.max())
    two_sided, (convex, hollow) = not mesh.closed, _one_sided(mesh)
    # 8 times the bend over half a side, there and back
    straight_m = math.sqrt(8.0 * PIECE_RAD * max(range_m, 1.0) * wavelength_m / (4.0 * math.pi))
    fewest_m = 2.0 * math.sqrt(mesh.areas_m2.sum() / MAX_PIECES)
    pieces, owner = cut_triangles(mesh.corners_m, max(min(PIECE_M, straight_m), fewest_m))
    normal, middle = mesh.normals[owner], pieces.mean(axis=1)
    once = ~covered(mesh.corners_m, owner, middle, normal, 10.0 * ROUNDING * size_m)
    pieces, normal = pieces[once], normal[once]
    body = replace(_empty(mesh), two_sided=two_sided)
    if not convex:
        pieces, normal = _visible(mesh, pieces, normal, two_sided)
        faces, turned = _mirrors(mesh, hollow)
        sequences, at_m = _sequences(faces, turned, two_sided, ROUNDING * size_m)
        padded = [np.concatenate([face, np.tile(face[-1], (FACE_CORNERS - len(face), 1))]) for face in faces]
        body = replace(
            body,
            face_m=np.array(padded).reshape(-1, FACE_CORNERS, 3),
            face_corners=np.array([len(face) for face in faces], np.int64),
            face_normal=turned,
            blocking_m=mesh.corners_m,
            hollow=hollow,
            sequence=sequences,
        )
    if len(pieces) > MAX_PIECES:
        pieces, normal = _merged(pieces, normal)
    if len(body.sequence) and size_m <= WHOLE_M:
        return _one_centre(body, pieces, normal, at_m[0], wavelength_m)
    cells = _cells_of(body, pieces, normal, wavelength_m, 1.01 * WHOLE_M if size_m <= WHOLE_M else CELL_M)
    return _with_corners(cells, at_m, wavelength_m) if len(body.sequence) else cells


def _one_sided(mesh: Mesh) -> tuple[bool, bool]:
    """Return whether a mesh hides nothing of itself, and whether all of it lies on one side of each of its faces."""
    planes = np.unique(
        np.round(np.column_stack([mesh.normals, np.einsum("fi,fi->f", mesh.normals, mesh.corners_m[:, 0])]), 6), axis=0
    )
    if len(planes) > 4096:
        return False, False
    above = mesh.vertices_m @ planes[:, :3].T - planes[:, 3]
    slack = 1e-5 * float(mesh.extent_m.max())
    low, high = (above > -slack).all(axis=0), (above < slack).all(axis=0)
    flat = bool((low & high).all())
    return flat or (mesh.closed and bool(high.all())), len(planes) <= 2 * MAX_MIRRORS and bool((low | high).all())


def _visible(mesh: Mesh, pieces: np.ndarray, normal: np.ndarray, two_sided: bool) -> tuple[np.ndarray, np.ndarray]:
    """Return the pieces that something outside can see, and their normals."""
    tree, step = search_tree(mesh.corners_m), 10.0 * ROUNDING * float(mesh.extent_m.max())
    height = (np.arange(LOOKS) + 0.5) / LOOKS
    turn = np.pi * (3.0 - math.sqrt(5.0)) * np.arange(LOOKS)
    level = np.sqrt(1.0 - height**2)
    looks = np.column_stack([level * np.cos(turn), level * np.sin(turn), height])
    first = pieces[:, 1] - pieces[:, 0]
    first = first / np.linalg.norm(first, axis=1, keepdims=True)
    local = np.stack([first, np.cross(normal, first), normal], axis=1)
    sequences = np.einsum("la,kai->kli", looks, local)
    middle = pieces.mean(axis=1)
    visible = any_free(*tree, middle + step * normal, sequences)
    if two_sided:
        visible |= any_free(*tree, middle - step * normal, -sequences)
    return pieces[visible], normal[visible]


def _merged(pieces: np.ndarray, normal: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return so many fewer pieces: neighbours of nearly one direction as a parallelogram of their second moments."""
    cell_m = math.sqrt(2.0 * triangle_areas(pieces).sum() / MAX_PIECES)
    while True:
        label = _labels(pieces, normal, cell_m, 4.0)
        if 2 * (label.max() + 1) <= MAX_PIECES:
            break
        cell_m *= 1.2
    area = triangle_areas(pieces)
    total = np.bincount(label, area)
    middle = pieces.mean(axis=1)
    centre, axis = _mean(middle, area, label), _mean(normal, area, label)
    flatness = np.linalg.norm(axis, axis=1)
    axis /= flatness[:, None]
    corner, offset = pieces - middle[:, None], middle - centre[label]
    within = np.einsum("pvi,pvj->pij", corner, corner) / 12.0 + offset[:, :, None] * offset[:, None, :]
    moments = _mean(within.reshape(-1, 9), area, label).reshape(-1, 3, 3)
    flat = np.eye(3) - axis[:, :, None] * axis[:, None, :]
    size, direction = np.linalg.eigh(flat @ moments @ flat)
    edge = np.swapaxes(direction[:, :, 1:], 1, 2) * np.sqrt(np.maximum(12.0 * size[:, 1:], 1e-18))[:, :, None]
    # the area as the flat piece that reflects alike
    edge *= np.sqrt(total * flatness / np.linalg.norm(np.cross(edge[:, 0], edge[:, 1]), axis=1))[:, None, None]
    first, second = edge[:, 0], edge[:, 1]
    turned = np.einsum("pi,pi->p", np.cross(first, second), axis) < 0.0
    second = np.where(turned[:, None], -second, second)
    a = centre - 0.5 * (first + second)
    halves = [
        np.stack([a, a + first, a + first + second], axis=1),
        np.stack([a, a + first + second, a + second], axis=1),
    ]
    return np.concatenate(halves), np.concatenate([axis, axis])


def _mean(values: np.ndarray, area: np.ndarray, label: np.ndarray) -> np.ndarray:
    """Return the means of values [N, D] by area over each label."""
    sums = np.stack([np.bincount(label, area * column) for column in values.T], axis=1)
    return np.asarray(sums / np.bincount(label, area)[:, None])


def _labels(pieces: np.ndarray, normal: np.ndarray, cell_m: float, steps: float) -> np.ndarray:
    """Return the number of the cell that each piece belongs to, by place and direction, no number left out."""
    points = pieces.reshape(-1, 3)
    middle = 0.5 * (points.min(axis=0) + points.max(axis=0))
    cell = np.floor((pieces.mean(axis=1) - middle) / cell_m + 0.5 + 1e-6).astype(np.int64)
    key = np.column_stack([cell, np.round(steps * normal).astype(np.int64)])
    return np.asarray(np.unique(key, axis=0, return_inverse=True)[1]).ravel()


def _cells_of(body: Body, pieces: np.ndarray, normal: np.ndarray, wavelength_m: float, cell_m: float) -> Body:
    """Return a body with its pieces gathered in cells, each a centre."""
    steps = 2.0
    while (label := _labels(pieces, normal, cell_m, steps)).max() >= MAX_CENTRES:
        # bodies of more directions than that are gathered by place alone
        cell_m, steps = 1.1 * cell_m, steps if cell_m < np.ptp(pieces) else 0.0
    order = np.argsort(label, kind="stable")
    count = np.bincount(label)
    area = triangle_areas(pieces)
    first = np.cumsum(count) - count
    axis = _mean(normal, area, label)
    return replace(
        body,
        position_m=_mean(pieces.mean(axis=1), area, label),
        normal=axis / np.maximum(np.linalg.norm(axis, axis=1), 1e-9)[:, None],
        peak_rcs_m2=4.0 * np.pi * (np.bincount(label, area) / wavelength_m) ** 2,
        size_m=np.zeros((len(count), 2)),
        span=np.column_stack([first, count, np.zeros((len(count), 2), np.int64)]),
        piece_m=pieces[order],
        piece_normal=normal[order],
    )


def _one_centre(body: Body, pieces: np.ndarray, normal: np.ndarray, apex: np.ndarray, wavelength_m: float) -> Body:
    """Return a body all of which is one centre."""
    axis = pieces.mean(axis=(0, 1)) - apex
    reach_m2 = triangle_areas(pieces).sum() * (1.0 + 0.5 * len(body.sequence))
    return replace(
        body,
        position_m=apex[None],
        normal=(axis / max(float(np.linalg.norm(axis)), 1e-9))[None],
        peak_rcs_m2=np.array([4.0 * math.pi * (reach_m2 / wavelength_m) ** 2]),
        size_m=np.zeros((1, 2)),
        span=np.array([[0, len(pieces), 0, len(body.sequence)]]),
        piece_m=pieces,
        piece_normal=normal,
    )


def _with_corners(body: Body, at_m: np.ndarray, wavelength_m: float) -> Body:
    """Return a body with a centre at each point to which ways by several faces belong, [Q, 3]."""
    _, first, label = np.unique(np.round(at_m, 6), axis=0, return_index=True, return_inverse=True)
    label = label.ravel()
    order, count = np.argsort(label, kind="stable"), np.bincount(label)
    # corners of a face beyond their number repeat the last one
    around = np.cross(body.face_m[:, 1:-1] - body.face_m[:, :1], body.face_m[:, 2:] - body.face_m[:, :1]).sum(axis=1)
    area = 0.5 * np.linalg.norm(around, axis=1)[body.sequence[:, 0]]
    peak = 4.0 * np.pi * (np.bincount(label, area) / wavelength_m) ** 2
    starts = np.cumsum(count) - count
    spans = np.column_stack([np.zeros((len(count), 2), np.int64), starts, count])
    toward = body.position_m.mean(axis=0) - at_m[first]
    toward /= np.maximum(np.linalg.norm(toward, axis=1), 1e-9)[:, None]
    corners = replace(
        body,
        position_m=at_m[first],
        normal=toward,
        peak_rcs_m2=peak,
        size_m=np.zeros((len(count), 2)),
        span=spans,
    )
    return replace(_joined(corners, body), sequence=body.sequence[order])


def _mirrors(mesh: Mesh, hollow: bool) -> tuple[list[np.ndarray], np.ndarray]:
    """Return the largest plane and convex faces of a mesh, corners of each, and unit normals [P, 3].

    Triangles of one plane that share edges are one face if they fill their hull, else a face each. Normals of a hollow
    body point inward; it keeps all its faces or is none (`FACE_CORNERS` and `MAX_MIRRORS` are then no bound).
    """
    faces, normals = [], []
    for members in _plane_parts(mesh):
        normal = mesh.normals[members[0]]
        corners = mesh.corners_m[members]
        hull = _hull(corners.reshape(-1, 3), normal)
        if len(hull) <= FACE_CORNERS and _polygon_area(hull) <= 1.001 * mesh.areas_m2[members].sum():
            faces.append(hull)
            normals.append(normal)
        else:
            faces.extend(corners)
            normals.extend([normal] * len(members))
    order = np.argsort([-_polygon_area(face) for face in faces], kind="stable")[: MAX_MIRRORS if not hollow else None]
    turned = np.array(normals)[order]
    faces = [faces[index] for index in order]
    if hollow:
        inner = [
            np.sign(((mesh.vertices_m - face[0]) @ normal).sum()) for face, normal in zip(faces, turned, strict=True)
        ]
        turned = turned * np.where(np.array(inner) < 0.0, -1.0, 1.0)[:, None]
    return faces, turned


def _plane_parts(mesh: Mesh) -> list[np.ndarray]:
    """Return the triangles of each plane part of a mesh that hangs together by edges."""
    label = np.unique(np.sort(directed_edges(mesh.faces), axis=1), axis=0, return_inverse=True)[1].ravel()
    order = np.argsort(label, kind="stable")
    first, second = order[:-1] // 3, order[1:] // 3
    flat = np.abs(np.einsum("ei,ei->e", mesh.normals[first], mesh.normals[second])) > 1.0 - 1e-9
    joins = (label[order[:-1]] == label[order[1:]]) & flat
    number, part = components(len(mesh.faces), first[joins], second[joins])
    by_part = np.argsort(part, kind="stable")
    parts = np.split(by_part, np.cumsum(np.bincount(part, minlength=number))[:-1])
    largest = sorted(parts, key=lambda members: -float(mesh.areas_m2[members].sum()))
    # smaller ones are not among the mirrors
    return largest[: 4 * MAX_MIRRORS]


def _hull(points: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """Return the corners of the convex hull of points in a plane, in order."""
    points = np.unique(np.round(points, 12), axis=0)
    first = np.cross(normal, [0.0, 0.0, 1.0] if abs(normal[2]) < 0.9 else [1.0, 0.0, 0.0])
    first /= np.linalg.norm(first)
    flat = points @ np.stack([first, np.cross(normal, first)]).T
    order = np.lexsort((flat[:, 1], flat[:, 0]))
    slack = 1e-9 * float(np.ptp(flat)) ** 2

    def turn(a: int, b: int, c: int) -> float:
        first, second = flat[b] - flat[a], flat[c] - flat[a]
        return float(first[0] * second[1] - first[1] * second[0])

    def half(rows: np.ndarray) -> list[int]:
        kept: list[int] = []
        for row in rows:
            while len(kept) >= 2 and turn(kept[-2], kept[-1], row) <= slack:
                kept.pop()
            kept.append(int(row))
        return kept[:-1]

    return np.asarray(points[half(order) + half(order[::-1])])


def _polygon_area(corners: np.ndarray) -> float:
    """Return the area of a plane convex polygon [N, 3]."""
    around = np.cross(corners[1:-1] - corners[0], corners[2:] - corners[0]).sum(axis=0)
    return 0.5 * float(np.linalg.norm(around))


def _sequences(
    faces: list[np.ndarray], normal: np.ndarray, two_sided: bool, slack: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return the ways by two and three faces [Q, 3] that can send a wave back, largest first, and where these meet [Q,
    3].

    By two where these stand nearly at right angles, by three wherever each shows itself to the next.
    """
    count = min(len(faces), MAX_MIRRORS)
    shown = np.zeros((count, count), bool)
    for i, j in permutations(range(count), 2):
        above = (faces[j] - faces[i][0]) @ normal[i]
        shown[i, j] = above.max() > slack or (two_sided and above.min() < -slack)
    faces_each_other = shown & shown.T
    area = np.array([_polygon_area(face) for face in faces])
    square = np.abs(normal[:count] @ normal[:count].T) < RIGHT_ANGLE_SINE
    twice = [(i, j, -1) for i, j in permutations(range(count), 2) if faces_each_other[i, j] and square[i, j]]
    thrice = [
        (i, j, k)
        for (i, j), k in product(permutations(range(count), 2), range(count))
        if k != j and faces_each_other[i, j] and faces_each_other[j, k]
    ]
    both: list[tuple[int, int, int]] = []
    for sequences in (thrice, twice):
        # corners of right angles first: they send back in all directions
        sequences.sort(key=lambda meet: _rank(meet, square, area))
        both += sequences[:MAX_SEQUENCES]
    corners = [_meeting(faces, sequence, slack) for sequence in both]
    apexes = [
        ({*sequence}, point)
        for sequence, point in zip(both, corners, strict=True)
        if point is not None and len({*sequence} - {-1}) == 3
    ]
    at_m = []
    for sequence, point in zip(both, corners, strict=True):
        own = {*sequence} - {-1}
        if point is None:
            point = np.mean([faces[face].mean(axis=0) for face in own], axis=0)
        # an edge of a small corner belongs to its apex
        near = [apex for meet, apex in apexes if own < meet and np.linalg.norm(apex - point) <= WHOLE_M]
        at_m.append(near[0] if near else point)
    return np.array(both, np.int64).reshape(-1, 3), np.array(at_m).reshape(-1, 3)


def _rank(sequence: tuple[int, int, int], square: np.ndarray, area: np.ndarray) -> tuple[bool, bool, float]:
    """Return the order of a sequence of faces: right angles first, then three faces, then by the smallest of them."""
    first, second, third = sequence
    right = square[first, second] and (third < 0 or square[second, third])
    return not right, first == third, -min(area[face] for face in sequence if face >= 0)


def _meeting(faces: list[np.ndarray], sequence: tuple[int, int, int], slack: float) -> np.ndarray | None:
    """Return the middle of the corners that the faces of a way share, None where they share none."""
    first, *rest = [faces[face] for face in sorted({*sequence} - {-1})]
    shared = np.ones(len(first), bool)
    for face in rest:
        shared &= (np.linalg.norm(first[:, None] - face[None], axis=2) < 10.0 * slack).any(axis=1)
    return np.asarray(first[shared].mean(axis=0)) if shared.any() else None
