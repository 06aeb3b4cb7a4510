"""Two walls in a row: corners send an object's image on, split a wide beam, and return the radar itself.

Routes antenna -> first wall -> second wall -> centre, straight pieces of wall, by the image method taken twice; the
radar's own image in two walls (both ways round); and the structure of one wall seen in another. Third order is left
out. In a right-angled corner the way to the radar's own image meets the apex: each way round has half of its wave.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numba import njit
from scipy.special import fresnel

from models.physics.mirror import reflect
from sim_player.effects.los_surfaces import flash_weight
from sim_player.effects.names import bit
from sim_player.scene.world import Snapshot, World
from sim_player.trace.echoes import Echoes, cofocal, echo_amplitude, join_echoes, object_echoes, surface_echoes
from sim_player.trace.routes import Routes, dot, join_routes, make_routes, mirror_routes, norm, unit
from sim_player.trace.segments import free_segments
from sim_player.trace.snapshot import TraceContext

#: Ends of walls nearer than this are one corner.
SAME_END_M = 1e-6
#: Least share of the wave for which a loop by a corner's apex is followed.
DARKEST = 0.02


def absent(world: World) -> str | None:
    """It takes two walls."""
    count = int(world.is_flat.sum())
    return None if count >= 2 else f"{count} straight wall{'' if count == 1 else 's'}: none faces another"


def apply(tracing: TraceContext) -> Echoes:
    """Objects in two walls, the radar in corners, structure in another wall."""
    view = tracing.view
    routes = two_wall_routes(view, view.centre, tracing.owner)
    tracing.routes["second_relay"] = routes
    objects = object_echoes(view, routes, cofocal(routes))
    return join_echoes([objects, _loops(view), _mirrored_structure(view)])


def two_wall_routes(view: Snapshot, point_m: np.ndarray, owner: np.ndarray) -> Routes:
    """Free routes by two straight walls to points [N, 3]."""
    first, second, target = _candidates(view, point_m)
    end = point_m[target]
    image_1 = reflect(np.broadcast_to(view.antenna, end.shape), view.normal[first], view.offset[first])
    image_2 = reflect(end, view.normal[second], view.offset[second])
    # one straight line from image to image, cut by both walls
    at_second = _cut(image_1, image_2, view.normal[second], view.offset[second])
    at_first = _cut(image_1, at_second, view.normal[first], view.offset[first])
    return _routes(view, (first, second), target, (at_first, at_second, end), owner[target])


def _routes(
    view: Snapshot,
    walls: tuple[np.ndarray, np.ndarray],
    target: np.ndarray,
    points: tuple[np.ndarray, np.ndarray, np.ndarray],
    owner: np.ndarray | int,
    other: np.ndarray | float = 1.0,
) -> Routes:
    """Routes by points of two walls to their targets, as far as the walls are high enough and three legs are free."""
    (first, second), (at_first, at_second, end), height = walls, points, view.world.wall_height_m
    occlusion = free_segments((view.antenna, *points), view.blockers, owner)
    keep = occlusion.free & (at_first[:, 2] < height[first]) & (at_second[:, 2] < height[second])
    first, second, at_first, at_second, end = (row[keep] for row in (first, second, at_first, at_second, end))
    depart, arrive = unit(at_first - view.antenna), unit(end - at_second)
    coefficients_1 = view.world.reflection(first, np.abs(dot(depart[:, :2], view.normal[first])))
    coefficients_2 = view.world.reflection(second, np.abs(dot(arrive[:, :2], view.normal[second])))
    return make_routes(
        target[keep],
        norm(at_first - view.antenna) + norm(at_second - at_first) + norm(end - at_second),
        depart,
        arrive,
        occlusion.take(keep),
        bit("specular_relay") | bit("second_relay"),
        wall=first,
        wall2=second,
        whole=coefficients_1[0] * coefficients_2[0],
        front=coefficients_1[1] * coefficients_2[1],
        rough=coefficients_1[2] * coefficients_2[2],
        other=np.broadcast_to(other, len(keep))[keep],
    )


def _loops(view: Snapshot) -> Echoes:
    """The radar's own image in two walls: out by one, back by the other, both ways round."""
    routes = two_wall_routes(view, view.antenna[None], np.array([-1], np.int32))
    joined = _meeting(view.world, routes.wall, routes.wall2)[0]
    routes = join_routes([routes.take(~joined), _corners(view)])
    weight = flash_weight(view, routes.length_m)
    point = np.broadcast_to(view.antenna, (len(routes), 3)).copy()
    echoes = surface_echoes(view, routes, weight, point, routes.wall, bit("second_relay"))
    # the loop is one round trip: what is on it is met once
    return replace(
        echoes,
        weight=weight * routes.other,
        whole=routes.whole,
        front=routes.front,
        rough=routes.rough,
        foliage=routes.foliage,
        arrive=-routes.arrive,
        out_m=0.5 * routes.length_m,
        back_m=0.5 * routes.length_m,
        rate_mps=0.5 * dot((routes.arrive - routes.depart)[:, :2], view.radar_velocity),
    )


def _corners(view: Snapshot) -> Routes:
    """Loops by two walls that share an end, with the share of the wave that the apex leaves to each way round.

    The straight line between the radar's two images cuts both walls where they meet at less than 90 deg; at 90 deg it
    goes by the apex (two halves of one image, which is exact), above that the apex throws back what is left. The share
    is Fresnel's, its argument from the detour over the apex, cos(a) sqrt(8 d / (lambda (1 + sin a))).
    """
    first, second = _neighbours(view.world)
    _, apex, face_1, face_2 = _meeting(view.world, first, second)
    towards = unit(view.origin - apex)
    sine, cosine = _cross(face_1, face_2), dot(face_1, face_2)
    inside = (_cross(towards, face_2) * sine > 0.0) & (_cross(face_1, towards) * sine > 0.0)
    inside_walls = np.flatnonzero(inside)
    first, second, apex, cosine, sine = (
        first[inside_walls],
        second[inside_walls],
        apex[inside_walls],
        cosine[inside_walls],
        np.abs(sine[inside_walls]),
    )
    distance = norm(apex - view.origin)
    wavelength_m = view.world.radar.wavelength_m
    share = _share(cosine * np.sqrt(8.0 * distance / (wavelength_m * (1.0 + sine))))
    # beyond 90 deg the way is by the apex, longer than the line that the share is told for
    detour_m = 2.0 * distance * cosine**2 / (1.0 + sine)
    share = share * np.exp(np.where(cosine < 0.0, 2j * np.pi / wavelength_m * detour_m, 0.0))
    points, on = [], np.abs(share) > DARKEST
    for wall, face, other in (
        (first, face_1[inside_walls], face_2[inside_walls]),
        (second, face_2[inside_walls], face_1[inside_walls]),
    ):
        along = distance * np.maximum(cosine, 0.0) / np.maximum(dot(towards[inside_walls], other), 1e-9)
        on &= along <= norm(view.world.wall_b[wall] - view.world.wall_a[wall])
        points.append(np.column_stack([apex + along[:, None] * face, np.full(len(wall), view.antenna[2])]))
    on_both = np.flatnonzero(on)
    end = np.broadcast_to(view.antenna, (len(on_both), 3))
    vertices = (points[0][on_both], points[1][on_both], end)
    return _routes(view, (first[on_both], second[on_both]), np.zeros(len(on_both), int), vertices, -1, share[on_both])


def _neighbours(world: World) -> tuple[np.ndarray, np.ndarray]:
    """All ordered pairs of straight walls that share an end."""
    walls = np.flatnonzero(world.is_flat)
    ends = np.concatenate([world.wall_a[walls], world.wall_b[walls]])
    end_1, end_2 = np.nonzero(norm(ends[:, None] - ends[None]) <= SAME_END_M)
    first, second = np.tile(walls, 2)[end_1], np.tile(walls, 2)[end_2]
    return first[first != second], second[first != second]


def _meeting(
    world: World, first: np.ndarray, second: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Find the pairs of walls [N] that share an end, the nearest of their ends [N, 2], unit vectors along both."""
    ends = np.stack([world.wall_a, world.wall_b], axis=1)
    apart = norm(ends[first][:, :, None] - ends[second][:, None]).reshape(-1, 4)
    nearest = np.argmin(apart, axis=1)
    every = np.arange(len(first))
    apex = ends[first, nearest // 2]
    faces = unit(ends[first, 1 - nearest // 2] - apex), unit(ends[second, 1 - nearest % 2] - apex)
    return apart[every, nearest] <= SAME_END_M, apex, *faces


def _share(v: np.ndarray) -> np.ndarray:
    """Share of a wave that passes an edge at Fresnel's argument v: 0 in the dark, 1/2 at the border, 1 in the clear."""
    sine, cosine = fresnel(v)
    return np.asarray(0.5 + 0.5 * (1.0 + 1j) * (cosine - 1j * sine))


def _mirrored_structure(view: Snapshot) -> Echoes:
    """Small scatterers of one wall seen in another."""
    world = view.world
    specks = np.flatnonzero((world.speck_length_m == 0.0) & (world.wall_height_m[world.speck_wall] > view.antenna[2]))
    point = np.column_stack([world.speck_m[specks], np.full(len(specks), view.antenna[2])])
    routes, occlusion = mirror_routes(view, point, world.is_flat, np.full(len(specks), -1, np.int32))
    routes = routes.take(occlusion.free & (world.speck_wall[specks[routes.target]] != routes.wall))
    speck = specks[routes.target]
    weight = echo_amplitude(world.radar, world.speck_rcs_m2[speck], routes.length_m) * world.speck_phasor[speck]
    needs = bit("second_relay") | bit("los_surfaces")
    numbered = replace(routes, target=world.speck_id[speck])
    return surface_echoes(view, numbered, weight, point[routes.target], routes.wall, needs)


def _cut(start: np.ndarray, end: np.ndarray, normal: np.ndarray, offset: np.ndarray) -> np.ndarray:
    """Return where straight lines [N, 3] from one side of a wall's line to the other cut it: by the heights over it."""
    over = dot(start[:, :2], normal) + offset
    under = dot(end[:, :2], normal) + offset
    return start + (over / (over - under))[:, None] * (end - start)


def _cross(left: np.ndarray, right: np.ndarray) -> np.ndarray:
    return np.asarray(left[:, 0] * right[:, 1] - left[:, 1] * right[:, 0])


def _candidates(view: Snapshot, point_m: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """First wall, second wall and target of all routes that the law of reflection allows, ends included."""
    world = view.world
    walls = np.flatnonzero(world.is_flat)
    a, b = world.wall_a[walls], world.wall_b[walls]
    plan = np.ascontiguousarray(point_m[:, :2])
    wall_pairs = _search(view.origin, plan, a, b, view.normal[walls], view.offset[walls])
    return walls[wall_pairs[:, 0]], walls[wall_pairs[:, 1]], wall_pairs[:, 2]


@njit(cache=True, nogil=True, error_model="numpy")
def _search(origin, point, a, b, normal, offset):  # type: ignore[no-untyped-def]
    pairs = np.empty((64, 3), np.int64)
    count = 0
    for first in range(len(a)):
        nx, ny, d = normal[first, 0], normal[first, 1], offset[first]
        reach = origin[0] * nx + origin[1] * ny + d
        ix, iy = origin[0] - 2.0 * reach * nx, origin[1] - 2.0 * reach * ny
        for second in range(len(a)):
            if second == first or not _seen(ix, iy, reach, a, b, nx, ny, d, first, second):
                continue
            mx, my, e = normal[second, 0], normal[second, 1], offset[second]
            source = ix * mx + iy * my + e
            if abs(source) <= 1e-9:
                continue
            wx, wy = b[second, 0] - a[second, 0], b[second, 1] - a[second, 1]
            square = wx * wx + wy * wy
            source_share = ((ix - a[second, 0]) * wx + (iy - a[second, 1]) * wy) / square
            for target in range(len(point)):
                height = point[target, 0] * mx + point[target, 1] * my + e
                if not (height * source > 0.0 and abs(height) > 1e-9):
                    continue
                place = ((point[target, 0] - a[second, 0]) * wx + (point[target, 1] - a[second, 1]) * wy) / square
                # similar triangles: the feet of both, weighted by the other's height
                share = (source_share * height + place * source) / (height + source)
                if not 0.0 <= share <= 1.0:
                    continue
                # the leg from the image must leave through the first wall, towards the antenna's side
                x, y = a[second, 0] + share * wx, a[second, 1] + share * wy
                if not _leaves(ix, iy, reach, x, y, a, b, nx, ny, d, first):
                    continue
                if count == len(pairs):
                    grown = np.empty((2 * count, 3), np.int64)
                    grown[:count] = pairs
                    pairs = grown
                pairs[count] = first, second, target
                count += 1
    return pairs[:count]


@njit(cache=True, nogil=True, error_model="numpy")
def _place(ix, iy, reach, x, y, a, b, nx, ny, d, wall):  # type: ignore[no-untyped-def]
    """Return where on a wall, 0..1, the line from the image behind it to a point in front passes."""
    height = x * nx + y * ny + d
    share = reach / (height + reach)
    wx, wy = b[wall, 0] - a[wall, 0], b[wall, 1] - a[wall, 1]
    px, py = ix + share * (x - ix) - a[wall, 0], iy + share * (y - iy) - a[wall, 1]
    return (px * wx + py * wy) / (wx * wx + wy * wy)


@njit(cache=True, nogil=True, error_model="numpy")
def _leaves(ix, iy, reach, x, y, a, b, nx, ny, d, wall):  # type: ignore[no-untyped-def]
    """Return whether a point in front is visible from the image through the wall."""
    if x * nx + y * ny + d <= 1e-9:
        return False
    return 0.0 <= _place(ix, iy, reach, x, y, a, b, nx, ny, d, wall) <= 1.0


@njit(cache=True, nogil=True, error_model="numpy")
def _seen(ix, iy, reach, a, b, nx, ny, d, first, second):  # type: ignore[no-untyped-def]
    """False where no point of the second wall is seen from the image through the first; both ends tell."""
    low = a[second, 0] * nx + a[second, 1] * ny + d
    high = b[second, 0] * nx + b[second, 1] * ny + d
    if low <= 1e-9 or high <= 1e-9:
        # an end behind the first wall has no place on it: only if both are is the answer known
        return low > 1e-9 or high > 1e-9
    along_1 = _place(ix, iy, reach, a[second, 0], a[second, 1], a, b, nx, ny, d, first)
    along_2 = _place(ix, iy, reach, b[second, 0], b[second, 1], a, b, nx, ny, d, first)
    margin = 1e-9
    return max(along_1, along_2) >= -margin and min(along_1, along_2) <= 1.0 + margin
