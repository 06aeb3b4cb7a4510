"""Triangles of meshes: cut small, searched by rays through a tree of boxes, reflecting and radiating fields."""

from __future__ import annotations

import math

import numpy as np

from models.compiled import compiled
from models.physics.fresnel import half_space_reflection
from models.physics.materials import permittivity
from msgs.values.units import SPEED_OF_LIGHT_MPS

#: Faces of a leaf of the search tree, and entries of the reflection table over the cosine.
LEAF_FACES, TABLE_SIZE = 4, 2049


def reflection_table(material: str, wavelength_m: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the half-space reflection of TE and TM (Eq. (13)) over cosines 0..1 in `TABLE_SIZE` steps."""
    epsilon = permittivity(material, SPEED_OF_LIGHT_MPS / wavelength_m)
    cosine = np.linspace(0.0, 1.0, TABLE_SIZE)
    return half_space_reflection(np.array(epsilon), cosine), half_space_reflection(np.array(epsilon), cosine, "tm")


def cut_triangles(triangles: np.ndarray, longest_m: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the triangles halved at their longest edge until none is longer, [P, 3, 3], and where each came from."""
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


Tree = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]


def search_tree(corners: np.ndarray) -> Tree:
    """Return triangles in the order of a tree of boxes; its nodes: bounds [N, 2, 3], first child or face, faces."""
    return _ordered_tree(corners)[1]


def _ordered_tree(corners: np.ndarray) -> tuple[np.ndarray, Tree]:
    """Return the order of the triangles in the tree too."""
    low, high = (np.ascontiguousarray(side(axis=1)) for side in (corners.min, corners.max))
    order, bounds, first, count = _grow_tree(low, high, LEAF_FACES)
    return order, (np.ascontiguousarray(corners[order]), bounds, first, count)


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
def dot(a, b):  # type: ignore[no-untyped-def]
    """Return a . b."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@compiled
def cross(a, b):  # type: ignore[no-untyped-def]
    """Return a x b."""
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@compiled
def ahead(a, step, b):  # type: ignore[no-untyped-def]
    """Return a + step b."""
    return a[0] + step * b[0], a[1] + step * b[1], a[2] + step * b[2]


@compiled
def row(array, index):  # type: ignore[no-untyped-def]
    """Return a row of three numbers as a tuple."""
    return array[index, 0], array[index, 1], array[index, 2]


@compiled(error_model="numpy")
def first_hit(faces, bounds, first, count, root, start, direction, nearest):  # type: ignore[no-untyped-def]
    """Return distance and index of the first triangle on a ray from `root`; (inf, -1): none (Moeller-Trumbore)."""
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
            distance = meet(faces[face], start, direction)
            if nearest < distance < best:
                best, hit = distance, face
    return best, hit


@compiled
def _inverse(value):  # type: ignore[no-untyped-def]
    return 1.0 / value if abs(value) > 1e-30 else 1e30


@compiled
def meet(face, start, direction):  # type: ignore[no-untyped-def]
    """Return the distance along a ray to a triangle, -1 where it misses."""
    a = row(face, 0)
    ab, ac = ahead(row(face, 1), -1.0, a), ahead(row(face, 2), -1.0, a)
    p = cross(direction, ac)
    volume = dot(ab, p)
    if abs(volume) < 1e-300:
        return -1.0
    offset = ahead(start, -1.0, a)
    u = dot(offset, p) / volume
    q = cross(offset, ab)
    v = dot(direction, q) / volume
    if u < 0.0 or v < 0.0 or u + v > 1.0:
        return -1.0
    return dot(ac, q) / volume


@compiled
def any_free(faces, bounds, first, count, start, directions):  # type: ignore[no-untyped-def]
    """Return whether any of the directions [K, L, 3] from each start [K, 3] meets no face."""
    free = np.zeros(len(start), np.bool_)
    for i in range(len(start)):
        for j in range(directions.shape[1]):
            if first_hit(faces, bounds, first, count, 0, row(start, i), row(directions[i], j), 0.0)[1] < 0:
                free[i] = True
                break
    return free


@compiled
def _covered(faces, bounds, first, count, order, own, point, normal, reach):  # type: ignore[no-untyped-def]
    """Return which points [P, 3] of faces `own` [P] an earlier face of the same plane covers too."""
    covered = np.zeros(len(point), np.bool_)
    stack = np.empty(128, np.int64)
    for n in range(len(point)):
        start = ahead(row(point, n), reach, row(normal, n))
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
                if order[face] >= own[n] or not 0.0 < meet(faces[face], start, direction) < 2.0 * reach:
                    continue
                a = row(faces[face], 0)
                other = cross(ahead(row(faces[face], 1), -1.0, a), ahead(row(faces[face], 2), -1.0, a))
                if abs(dot(other, direction)) > 0.9999 * math.sqrt(dot(other, other)):
                    covered[n] = True
    return covered


def covered(corners: np.ndarray, own: np.ndarray, point: np.ndarray, normal: np.ndarray, reach_m: float) -> np.ndarray:
    """Return which points [P, 3] of triangles `own` [P] an earlier triangle in the same place covers too, bool [P]."""
    order, tree = _ordered_tree(corners)
    return np.asarray(_covered(*tree, order, own, point, normal, reach_m))


@compiled
def lookup(table, cosine):  # type: ignore[no-untyped-def]
    """Return the value of a table over cosines 0..1."""
    position = cosine * (len(table) - 1)
    index = min(int(position), len(table) - 2)
    return table[index] + (position - index) * (table[index + 1] - table[index])


@compiled
def sinc(x):  # type: ignore[no-untyped-def]
    """Return sin(x) / x."""
    return math.sin(x) / x if abs(x) > 1e-6 else 1.0 - x * x / 6.0


@compiled
def reflected(field, direction, out, normal, te, tm):  # type: ignore[no-untyped-def]
    """Return the field after a bounce: its part across the plane of incidence times te, the part within times tm."""
    s = cross(direction, normal)
    length = math.sqrt(dot(s, s))
    if length < 1e-9:
        # at normal incidence there is no such plane: any will do
        s = cross(direction, (0.0, 0.0, 1.0) if abs(direction[2]) < 0.9 else (1.0, 0.0, 0.0))
        length = math.sqrt(dot(s, s))
    s = (s[0] / length, s[1] / length, s[2] / length)
    across, within = te * dot(field, s), tm * dot(field, cross(s, direction))
    p = cross(s, out)
    return across * s[0] + within * p[0], across * s[1] + within * p[1], across * s[2] + within * p[2]


@compiled
def radiated_field(field, field_out, direction, out, normal, towards, receive):  # type: ignore[no-untyped-def]
    """Return half the radiation of the currents n x H and E x n of incident plus reflected field to the receiver."""
    h, h_out = cross(direction, field), cross(out, field_out)
    current = cross(normal, (h[0] + h_out[0], h[1] + h_out[1], h[2] + h_out[2]))
    total = (field[0] + field_out[0], field[1] + field_out[1], field[2] + field_out[2])
    magnetic = cross(towards, cross(normal, total))
    return 0.5 * (dot(receive, current) + dot(receive, magnetic))
