"""Radar cross section of meshes by shooting and bouncing rays: the reference of the bodies in scenes.

Fields are square roots of RCS with a phase: |field|^2 is the RCS in m^2, and far away the phase of a point p is
exp(+j k (s + r).p), s and r unit vectors to source and receiver (e^{+jwt}, origin of the mesh's frame at its foot).

Not modelled: diffraction by edges beyond physical optics, creeping waves, transmission through thin dielectric faces.
"""

from __future__ import annotations

import math

import numpy as np

from models.compiled import compiled
from models.physics.fresnel import Polarisation, half_space_reflection
from models.physics.materials import permittivity
from msgs.values.units import SPEED_OF_LIGHT_MPS
from sim_player.bodies.meshes import Mesh

#: Default largest spacing of rays as a share of a wavelength.
RAY_SPACING = 1.0 / 8.0
MAX_RAYS = 16_000_000
#: Faces of a leaf of the search tree, and entries of the reflection table over the cosine.
LEAF_FACES, TABLE_SIZE = 4, 2049


def mesh_field(
    mesh: Mesh,
    direction: np.ndarray,
    wavelength_m: float,
    bounces: int = 3,
    ray_spacing_m: float | None = None,
    polarisation: Polarisation = "te",
) -> complex:
    """Return the square root of the monostatic RCS with its phase: physical optics of the rays' currents at every
    bounce.

    A grid of rays no wider than `ray_spacing_m` (None: lambda / 8) falls on the mesh from `direction` and is followed
    through up to `bounces` faces, both sides of which reflect. At each, the total field n x H, E x n of the ray's tube
    radiates back if nothing blocks the radar; the tube's footprint is integrated in closed form on the face's
    plane, so the spacing only limits the accuracy at edges. Materials reflect as half-spaces (TE and TM apart).
    `te`: the radar's field is as upright as it can be. Raises ValueError for more than 16 million rays.
    """
    towards = np.asarray(direction, np.float64)
    if towards.shape != (3,) or not np.isfinite(towards).all() or not np.linalg.norm(towards) > 0.0:
        raise ValueError(f"direction must be three finite numbers, not all zero, got {direction!r}")
    if bounces < 1:
        raise ValueError(f"bounces must be at least 1, got {bounces!r}")
    towards = towards / np.linalg.norm(towards)
    across, up = _aperture_axes(towards)
    spacing = RAY_SPACING * wavelength_m if ray_spacing_m is None else ray_spacing_m
    start, cell = _ray_grid(mesh, towards, across, up, spacing)
    field = _shoot(
        *_search_tree(mesh.corners_m),
        start,
        towards,
        cell[0] * across,
        cell[1] * up,
        up if polarisation == "te" else across,
        2.0 * math.pi / wavelength_m,
        bounces,
        *_reflection_table(mesh.material, wavelength_m),
        1e-7 * float(mesh.extent_m.max()),
    )
    return complex(math.sqrt(4.0 * math.pi) / wavelength_m * cell[0] * cell[1] * field)


def _aperture_axes(towards: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the unit vectors across the line of sight: level, and as upright as possible."""
    across = np.cross([0.0, 0.0, 1.0], towards)
    # straight from above there is no level axis; y is as good as any
    across = np.array([0.0, 1.0, 0.0]) if np.linalg.norm(across) < 1e-9 else across / np.linalg.norm(across)
    return across, np.cross(towards, across)


def _ray_grid(
    mesh: Mesh, towards: np.ndarray, across: np.ndarray, up: np.ndarray, spacing_m: float
) -> tuple[np.ndarray, tuple[float, float]]:
    """Return the starts of all rays [N, 3] on a plane before the mesh, in the middles of cells that tile its
    outline's box.
    """
    if not (math.isfinite(spacing_m) and spacing_m > 0.0):
        raise ValueError(f"ray_spacing_m must be finite and positive, got {spacing_m!r}")
    projected = mesh.vertices_m @ np.stack([across, up, towards]).T
    least, size = projected.min(axis=0), np.ptp(projected, axis=0)
    # even numbers: no ray hits the middle edge of a symmetric corner
    count = 2.0 * np.maximum(np.ceil(0.5 * size[:2] / spacing_m * (1.0 - 1e-9)), 1.0)
    if count.prod() > MAX_RAYS:
        raise ValueError(
            f"ray_spacing_m: at most {MAX_RAYS} rays, got {count.prod():.3g} for {size[0]:.3g} x {size[1]:.3g} m "
            f"at {spacing_m:.3g} m"
        )
    cell = size[:2] / count
    columns, rows = (least[axis] + (np.arange(count[axis]) + 0.5) * cell[axis] for axis in (0, 1))
    before = (least[2] + size[2] + max(size[2], 1e-3)) * towards
    start = before + (columns[:, None, None] * across + rows[None, :, None] * up)
    return start.reshape(-1, 3), (float(cell[0]), float(cell[1]))


def _reflection_table(material: str, wavelength_m: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the half-space reflection of TE and TM over cosines 0..1 in `TABLE_SIZE` steps; TM with the sign of Eq.
    (13).
    """
    epsilon = permittivity(material, SPEED_OF_LIGHT_MPS / wavelength_m)
    cosine = np.linspace(0.0, 1.0, TABLE_SIZE)
    return half_space_reflection(np.array(epsilon), cosine), half_space_reflection(np.array(epsilon), cosine, "tm")


def cut_triangles(triangles: np.ndarray, longest_m: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the triangles halved at their longest edge until none is longer, [P, 3, 3], and the triangle each came
    from.
    """
    owner = np.arange(len(triangles))
    done, done_owner = [np.zeros((0, 3, 3))], [np.zeros(0, int)]
    while len(triangles):
        length = np.linalg.norm(np.roll(triangles, -1, axis=1) - triangles, axis=2)
        small = length.max(axis=1) <= longest_m
        done.append(triangles[small])
        done_owner.append(owner[small])
        triangles, owner, longest = triangles[~small], owner[~small], length[~small].argmax(axis=1)
        turned = np.take_along_axis(triangles, ((longest[:, None] + np.arange(3)) % 3)[:, :, None], axis=1)
        a, b, c = np.moveaxis(turned, 1, 0)
        middle = 0.5 * (a + b)
        triangles = np.concatenate([np.stack([a, middle, c], axis=1), np.stack([middle, b, c], axis=1)])
        owner = np.concatenate([owner, owner])
    return np.concatenate(done), np.concatenate(done_owner)


def triangle_areas(triangles: np.ndarray) -> np.ndarray:
    """Return the areas of triangles [P, 3, 3]."""
    a, b, c = np.moveaxis(triangles, 1, 0)
    return 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1)


def _search_tree(corners: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return the triangles in the order of a tree of boxes; of its nodes: bounds [N, 2, 3], first child or face,
    faces (or 0).
    """
    order, bounds, first, count = _grow_tree(
        np.ascontiguousarray(corners.min(axis=1)), np.ascontiguousarray(corners.max(axis=1)), LEAF_FACES
    )
    return np.ascontiguousarray(corners[order]), bounds, first, count


@compiled
def _grow_tree(
    least: np.ndarray, greatest: np.ndarray, leaf: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    faces = len(least)
    order = np.arange(faces)
    middle = 0.5 * (least + greatest)
    bounds = np.empty((2 * faces, 2, 3))
    first, count = np.zeros(2 * faces, np.int64), np.zeros(2 * faces, np.int64)
    stack = np.empty((128, 3), np.int64)
    stack[0] = (0, 0, faces)
    depth, nodes = 1, 1
    while depth:
        depth -= 1
        node, begin, end = stack[depth]
        for axis in range(3):
            low, high = np.inf, -np.inf
            for i in order[begin:end]:
                low, high = min(low, least[i, axis]), max(high, greatest[i, axis])
            bounds[node, 0, axis], bounds[node, 1, axis] = low, high
        if end - begin <= leaf:
            first[node], count[node] = begin, end - begin
            continue
        widest = np.argmax(bounds[node, 1] - bounds[node, 0])
        part = order[begin:end].copy()
        # halves by number: no split is ever empty, and the tree is as deep as the logarithm
        order[begin:end] = part[np.argsort(middle[part, widest], kind="mergesort")]
        half = (begin + end) // 2
        first[node] = nodes
        stack[depth] = (nodes, begin, half)
        stack[depth + 1] = (nodes + 1, half, end)
        depth, nodes = depth + 2, nodes + 2
    return order, bounds[:nodes], first[:nodes], count[:nodes]


@compiled
def _dot(a, b):  # type: ignore[no-untyped-def]
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@compiled
def _cross(a, b):  # type: ignore[no-untyped-def]
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@compiled
def _ahead(a, step, b):  # type: ignore[no-untyped-def]
    """Return a + step b."""
    return a[0] + step * b[0], a[1] + step * b[1], a[2] + step * b[2]


@compiled
def _row(array, index):  # type: ignore[no-untyped-def]
    return array[index, 0], array[index, 1], array[index, 2]


@compiled(error_model="numpy")
def _first_hit(faces, bounds, first, count, root, start, direction, nearest):  # type: ignore[no-untyped-def]
    """Return distance and index of the first triangle on a ray beyond `nearest`; (inf, -1): none (Moeller-Trumbore).

    `root`: the node that the tree begins with, of several in one.
    """
    best, hit = np.inf, -1
    inverse = (_inverse(direction[0]), _inverse(direction[1]), _inverse(direction[2]))
    stack = np.empty(64, np.int64)
    stack[0] = root
    depth = 1
    while depth:
        depth -= 1
        node = stack[depth]
        enter, leave = 0.0, best
        for axis in range(3):
            near_side = (bounds[node, 0, axis] - start[axis]) * inverse[axis]
            far_side = (bounds[node, 1, axis] - start[axis]) * inverse[axis]
            enter, leave = max(enter, min(near_side, far_side)), min(leave, max(near_side, far_side))
        # flat boxes: their two sides may differ by rounding
        if enter > leave * (1.0 + 1e-12) + 1e-12:
            continue
        if count[node] == 0:
            stack[depth], stack[depth + 1] = first[node], first[node] + 1
            depth += 2
            continue
        for face in range(first[node], first[node] + count[node]):
            distance = _meet(faces[face], start, direction)
            if nearest < distance < best:
                best, hit = distance, face
    return best, hit


@compiled
def _inverse(value):  # type: ignore[no-untyped-def]
    return 1.0 / value if abs(value) > 1e-30 else 1e30


@compiled
def _meet(face, start, direction):  # type: ignore[no-untyped-def]
    """Return the distance along a ray to a triangle, -1 where it misses."""
    a = _row(face, 0)
    ab, ac = _ahead(_row(face, 1), -1.0, a), _ahead(_row(face, 2), -1.0, a)
    p = _cross(direction, ac)
    volume = _dot(ab, p)
    if abs(volume) < 1e-300:
        return -1.0
    offset = _ahead(start, -1.0, a)
    u = _dot(offset, p) / volume
    q = _cross(offset, ab)
    v = _dot(direction, q) / volume
    if u < 0.0 or v < 0.0 or u + v > 1.0:
        return -1.0
    return _dot(ac, q) / volume


@compiled
def _any_free(faces, bounds, first, count, start, directions):  # type: ignore[no-untyped-def]
    """Return whether any of the directions [K, L, 3] from each start [K, 3] meets no face."""
    free = np.zeros(len(start), np.bool_)
    for i in range(len(start)):
        for j in range(directions.shape[1]):
            if _first_hit(faces, bounds, first, count, 0, _row(start, i), _row(directions[i], j), 0.0)[1] < 0:
                free[i] = True
                break
    return free


@compiled
def _covered(faces, bounds, first, count, order, own, point, normal, reach):  # type: ignore[no-untyped-def]
    """Return which points [P, 3] of faces `own` [P] an earlier face of the same plane covers too."""
    covered = np.zeros(len(point), np.bool_)
    stack = np.empty(128, np.int64)
    for n in range(len(point)):
        start = _ahead(_row(point, n), reach, _row(normal, n))
        direction = (-normal[n, 0], -normal[n, 1], -normal[n, 2])
        stack[0] = 0
        depth = 1
        while depth and not covered[n]:
            depth -= 1
            node, is_near = stack[depth], True
            for axis in range(3):
                is_near &= bounds[node, 0, axis] - reach <= point[n, axis] <= bounds[node, 1, axis] + reach
            if not is_near:
                continue
            if count[node] == 0:
                stack[depth], stack[depth + 1] = first[node], first[node] + 1
                depth += 2
                continue
            for face in range(first[node], first[node] + count[node]):
                if order[face] >= own[n] or not 0.0 < _meet(faces[face], start, direction) < 2.0 * reach:
                    continue
                a = _row(faces[face], 0)
                other = _cross(_ahead(_row(faces[face], 1), -1.0, a), _ahead(_row(faces[face], 2), -1.0, a))
                if abs(_dot(other, direction)) > 0.9999 * math.sqrt(_dot(other, other)):
                    covered[n] = True
    return covered


def covered(corners: np.ndarray, own: np.ndarray, point: np.ndarray, normal: np.ndarray, reach_m: float) -> np.ndarray:
    """Return which points [P, 3] of triangles `own` [P] an earlier triangle in the same place covers too, bool [P]."""
    order, bounds, first, count = _grow_tree(
        np.ascontiguousarray(corners.min(axis=1)), np.ascontiguousarray(corners.max(axis=1)), LEAF_FACES
    )
    faces = np.ascontiguousarray(corners[order])
    return np.asarray(_covered(faces, bounds, first, count, order, own, point, normal, reach_m))


@compiled
def _lookup(table, cosine):  # type: ignore[no-untyped-def]
    position = cosine * (len(table) - 1)
    index = min(int(position), len(table) - 2)
    return table[index] + (position - index) * (table[index + 1] - table[index])


@compiled
def _sinc(x):  # type: ignore[no-untyped-def]
    return math.sin(x) / x if abs(x) > 1e-6 else 1.0 - x * x / 6.0


@compiled
def _reflected(field, direction, out, normal, te, tm):  # type: ignore[no-untyped-def]
    """Return the field after a bounce: its part across the plane of incidence times te, the part within times tm."""
    s = _cross(direction, normal)
    length = math.sqrt(_dot(s, s))
    if length < 1e-9:
        # at normal incidence there is no such plane: any will do
        s = _cross(direction, (0.0, 0.0, 1.0) if abs(direction[2]) < 0.9 else (1.0, 0.0, 0.0))
        length = math.sqrt(_dot(s, s))
    s = (s[0] / length, s[1] / length, s[2] / length)
    across, within = te * _dot(field, s), tm * _dot(field, _cross(s, direction))
    p = _cross(s, out)
    return across * s[0] + within * p[0], across * s[1] + within * p[1], across * s[2] + within * p[2]


@compiled
def _radiated(field, field_out, direction, out, normal, towards, receive):  # type: ignore[no-untyped-def]
    """Return half the radiation of the currents n x H and E x n of incident plus reflected field to the receiver."""
    h, h_out = _cross(direction, field), _cross(out, field_out)
    current = _cross(normal, (h[0] + h_out[0], h[1] + h_out[1], h[2] + h_out[2]))
    total = (field[0] + field_out[0], field[1] + field_out[1], field[2] + field_out[2])
    magnetic = _cross(towards, _cross(normal, total))
    return 0.5 * (_dot(receive, current) + _dot(receive, magnetic))


@compiled
def _shoot(faces, bounds, first, count, start, towards, across, up, receive, wavenumber, bounces, te, tm, nearest):  # type: ignore[no-untyped-def]
    """Return the sum over rays and bounces of radiated field times footprint, in units of a ray's cross section."""
    towards_, receive_ = (towards[0], towards[1], towards[2]), (receive[0], receive[1], receive[2])
    total = 0.0j
    for ray in range(len(start)):
        position, direction = _row(start, ray), (-towards[0], -towards[1], -towards[2])
        phase_m = _dot(position, towards_)
        first_edge, second_edge = (across[0], across[1], across[2]), (up[0], up[1], up[2])
        field = (receive[0] + 0.0j, receive[1] + 0.0j, receive[2] + 0.0j)
        for bounce in range(bounces):
            distance, hit = _first_hit(faces, bounds, first, count, 0, position, direction, nearest)
            if hit < 0:
                break
            a = _row(faces[hit], 0)
            normal = _cross(_ahead(_row(faces[hit], 1), -1.0, a), _ahead(_row(faces[hit], 2), -1.0, a))
            slant = _dot(normal, direction)
            # the side that the ray meets
            scale = (-1.0 if slant > 0.0 else 1.0) / math.sqrt(_dot(normal, normal))
            normal = (scale * normal[0], scale * normal[1], scale * normal[2])
            cosine = min(-_dot(normal, direction), 1.0)
            if cosine < 1e-6:
                break
            position = _ahead(position, distance, direction)
            phase_m -= distance
            out = _ahead(direction, 2.0 * cosine, normal)
            field_out = _reflected(field, direction, out, normal, _lookup(te, cosine), _lookup(tm, cosine))
            # the tube's footprint on this face
            first_edge = _ahead(first_edge, _dot(normal, first_edge) / cosine, direction)
            second_edge = _ahead(second_edge, _dot(normal, second_edge) / cosine, direction)
            is_visible = _dot(normal, towards_) > 1e-9
            if is_visible and bounce > 0:
                is_visible = _first_hit(faces, bounds, first, count, 0, position, towards_, nearest)[1] < 0
            if is_visible:
                turn = _ahead(towards_, -1.0, direction)
                lobe = _sinc(0.5 * wavenumber * _dot(turn, first_edge)) * _sinc(
                    0.5 * wavenumber * _dot(turn, second_edge)
                )
                angle = wavenumber * (phase_m + _dot(towards_, position))
                radiated = _radiated(field, field_out, direction, out, normal, towards_, receive_)
                total += radiated * lobe / cosine * (math.cos(angle) + 1j * math.sin(angle))
            direction, field = out, field_out
    return total
