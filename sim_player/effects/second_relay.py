"""Two walls in a row: corners send an object's image on, split a wide beam, and return the radar itself.

Routes antenna -> first wall -> second wall -> centre, straight pieces of wall by the image method taken twice, arcs by
Fermat's principle (`arc_pairs`); the radar's own image in two walls (both ways round); and the structure of one wall
seen in another. Third order is left out. In a right-angled corner the way to the radar's own image meets the apex: each
way round has half of its wave. An object's image there is one, by either order of the walls: on the line through the
apex one way stands for both.
"""

from __future__ import annotations

import cmath
import math

import numpy as np

from models.compiled import compiled
from models.physics.arc_pairs import arc_pairs
from models.physics.diffraction import FADES_TO, passed_edge_at, passed_share_at
from models.physics.mirror import mirrored
from sim_player.effects.curved_wall import arc_routes
from sim_player.effects.los_surfaces import END_SLACK_M, flash_weight
from sim_player.scene.bounce import all_below_top, below_top, bounce
from sim_player.scene.segments import STRAIGHT_SAGITTA, series
from sim_player.scene.world import LIT_MARGIN, Snapshot, World
from sim_player.trace.echoes import Echoes, cofocal, echo_amplitude, object_echoes, surface_echoes
from sim_player.trace.effect_names import bit
from sim_player.trace.routes import (
    LIT_SHARE,
    NEAREST_M,
    ROUTE,
    SHADOWED,
    Routes,
    bounce_routes,
    clear_ways,
    direction_of,
    dot,
    fill_bounce,
    fill_route,
    in_sight,
    may_be_seen,
    owners,
    plane_bounces,
)
from sim_player.trace.snapshot import TraceContext

#: What `_seconds` says of a view in which every wall may be seen in every other.
_ALL_IN_ALL = np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros((0, 2))
#: A way that passes a right-angled corner's apex as close as this is by the apex itself.
APEX_M = 1e-6
#: Least share of the wave for which a loop by a corner's apex is followed.
DARKEST = 0.02
_TWICE = bit("specular_relay") | bit("second_relay")


def absent(world: World) -> str | None:
    """It takes two walls."""
    count = int(world.is_mirror.sum())
    return None if count >= 2 else f"{count} wall{'' if count == 1 else 's'}: none faces another"


def apply(tracing: TraceContext) -> Echoes:
    """Objects in two walls, the radar in corners, structure in another wall."""
    view = tracing.view
    routes = two_wall_routes(view, view.centre, tracing.owner)
    tracing.routes["second_relay"] = routes
    objects = object_echoes(view, routes, cofocal(routes))
    return Echoes.joined([objects, _loops(view), _mirrored_structure(view)])


def two_wall_routes(view: Snapshot, point_m: np.ndarray, owner: np.ndarray) -> Routes:
    """Free routes by two walls to points [N, 3]."""
    walls = np.flatnonzero(view.world.is_flat)
    pairs = _search(view.origin, point_m, walls, view.walls, view.lit_shares, _seconds(view), 0.0)
    vertices = _two_bounces(view.antenna, point_m, pairs, view.walls)
    lit = in_sight(view, pairs[:, 0], vertices[:, 0])
    pairs, vertices = _without_apexes(view, point_m, pairs[lit], vertices[lit])
    gain = np.ones(len(pairs), np.complex128)
    if view.world.is_curved.any():
        also = _by_arcs(view, point_m)
        pairs, vertices = np.concatenate([pairs, also[0]]), np.concatenate([vertices, also[1]])
        gain = np.concatenate([gain, also[2]])
    return _routes(view, pairs, vertices, owners(owner, len(point_m))[pairs[:, 2]], gain)


def _by_arcs(view: Snapshot, point_m: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return `arc_pairs` of a view."""
    world = view.world
    bend = np.where(world.is_curved, world.wall_curvature_per_m, 0.0)
    walls, lines = (world.wall_a, world.wall_b, bend), (view.normal, view.offset)
    return arc_pairs(view.antenna, point_m, walls, lines, world.is_mirror)


def _without_apexes(
    view: Snapshot, point_m: np.ndarray, pairs: np.ndarray, vertices: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the ways, but one alone of those by either order of walls that meet a right-angled corner's apex."""
    corners = view.world.corners
    by_apex, at = _apex_ways(view.antenna, point_m, corners.pairs, corners.geometry, view.world.radar.wavelength_m)
    if not len(by_apex):
        return pairs, vertices
    lit = in_sight(view, by_apex[:, 0], at[:, 0])
    key = np.sort(pairs[:, :2], axis=1)
    same = (key[:, None] == by_apex[:, :2]).all(axis=2) & (pairs[:, 2:] == by_apex[:, 2])
    kept = ~same.any(axis=1)
    return np.concatenate([pairs[kept], by_apex[lit]]), np.concatenate([vertices[kept], at[lit]])


def _seconds(view: Snapshot) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the flat walls that may be seen in each wall: begins [W + 1], list [N], shares [N, 2]; or all empty."""
    if view.seen_pairs is None:
        return _ALL_IN_ALL
    flat = np.flatnonzero(view.world.is_flat[view.seen_pairs.second])
    start = np.searchsorted(view.seen_pairs.first[flat], np.arange(len(view.world.wall_a) + 1))
    return start, view.seen_pairs.second[flat], view.seen_pairs.share[flat]


def _routes(view: Snapshot, pairs: np.ndarray, vertices: np.ndarray, owner: np.ndarray, other: np.ndarray) -> Routes:
    """Routes by `vertices` [M, 3, 3] of `pairs` (two walls, target) [M, 3] of walls high enough, three legs free."""
    world, blockers = view.world, view.blockers.pieces
    scene = view.walls, world.is_curved, world.builds, blockers
    return Routes(_free_routes(view.antenna, pairs, vertices, owner, other, *scene))


def _loops(view: Snapshot) -> Echoes:
    """The radar's own image in two walls: out by one, back by the other, both ways round."""
    routes = Routes.joined([_between_walls(view), _corners(view)])
    weight = flash_weight(view, routes.length_m)
    point = np.broadcast_to(view.antenna, (len(routes), 3)).copy()
    echoes = surface_echoes(view, routes, weight, point, routes.wall, bit("second_relay"))
    # the loop is one round trip: what is on it is met once
    return echoes.with_columns(
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


def _between_walls(view: Snapshot) -> Routes:
    """Loops by two walls that share no end, with the share of the wave that the ends of both leave."""
    radar, wide = view.world.radar, FADES_TO * math.sqrt(0.125 * view.world.radar.wavelength_m)
    # the first leg and the last end at the radar: it sees both walls
    walls = np.flatnonzero(view.world.is_flat & (view.lit[:, 0] <= view.lit[:, 1]))
    every, of_all = np.tile([0.0, 1.0], (len(view.lit), 1)), _ALL_IN_ALL
    pairs = _search(view.origin, view.antenna[None], walls, view.walls, every, of_all, wide)
    pairs = pairs[~view.world.share_an_end(pairs[:, 0], pairs[:, 1])]
    vertices = _two_bounces(view.antenna, view.antenna[None], pairs, view.walls)
    share = _shares_of_ends(view.antenna, pairs, vertices, view.walls, view.blockers.pieces, radar.wavelength_m)
    if view.world.is_curved.any():
        also = _by_arcs(view, view.antenna[None])
        apart = ~view.world.share_an_end(also[0][:, 0], also[0][:, 1])
        pairs, vertices = np.concatenate([pairs, also[0][apart]]), np.concatenate([vertices, also[1][apart]])
        share = np.concatenate([share, also[2][apart]])
    left = share != 0.0
    return _routes(view, pairs[left], vertices[left], owners(-1, int(left.sum())), share[left])


def _corners(view: Snapshot) -> Routes:
    """Loops by two walls that share an end, with the share of the wave that the apex leaves to each way round.

    The straight line between the radar's two images cuts both walls where they meet at less than 90 deg; at 90 deg it
    goes by the apex (two halves of one image, which is exact), above that the apex throws back what is left. The share
    is Fresnel's, its argument from the detour over the apex, cos(a) sqrt(8 d / (lambda (1 + sin a))).
    """
    corners = view.world.corners
    pairs, vertices, share = _apex_loops(view.antenna, corners.pairs, corners.geometry, view.world.radar.wavelength_m)
    return _routes(view, pairs, vertices, owners(-1, len(pairs)), share)


def _mirrored_structure(view: Snapshot) -> Echoes:
    """Small scatterers of one wall seen in another."""
    world = view.world
    specks, point = world.structure
    wall, target, points = plane_bounces(view, view.antenna, point, world.is_flat)
    visible = may_be_seen(view, wall, world.speck_wall[specks[target]], point[target])
    bounces = wall[visible], target[visible], points[visible]
    routes = clear_ways(*bounce_routes(view, point, bounces, owners(-1, len(specks)), view.blockers))
    routes = Routes.joined([routes, arc_routes(view, point, owners(-1, len(specks)), world.speck_wall[specks])])
    # no wall mirrors its own structure
    routes = routes.take(world.speck_wall[specks[routes.target]] != routes.wall)
    speck = specks[routes.target]
    half = 0.5 * routes.length_m
    over = world.wall_height_m[world.speck_wall[speck]] - world.radar_height_m
    left = all_below_top(world.radar.wavelength_m, over, 2.0 * half, 2.0 * half, np.zeros(len(half)))
    weight = left * echo_amplitude(world.radar, world.speck_rcs_m2[speck], routes.length_m) * world.speck_phasor[speck]
    needs = bit("second_relay") | bit("los_surfaces")
    numbered = routes.with_columns(target=world.speck_id[speck])
    return surface_echoes(view, numbered, weight, point[routes.target], routes.wall, needs)


@compiled(error_model="numpy")
def _two_bounces(antenna, point, pairs, walls):  # type: ignore[no-untyped-def]
    """Points of both walls and the end: one straight line from image to image, cut by both; [M, 3, 3]."""
    normal, offset = walls[2], walls[3]
    vertices = np.empty((len(pairs), 3, 3))
    for m in range(len(pairs)):
        first, second, target = pairs[m]
        source, end = (antenna[0], antenna[1], antenna[2]), (point[target, 0], point[target, 1], point[target, 2])
        line_1 = (normal[first, 0], normal[first, 1], offset[first])
        line_2 = (normal[second, 0], normal[second, 1], offset[second])
        image_1 = _image(source, line_1)
        at_second = _cut(image_1, _image(end, line_2), line_2)
        at_first = _cut(image_1, at_second, line_1)
        for axis in range(3):
            vertices[m, 0, axis], vertices[m, 1, axis] = at_first[axis], at_second[axis]
            vertices[m, 2, axis] = end[axis]
    return vertices


@compiled(error_model="numpy")
def _free_routes(antenna, pairs, vertices, owner, other, walls, is_curved, builds, pieces):  # type: ignore[no-untyped-def]
    normal, top = walls[2], walls[4]
    rows, count = np.empty(len(pairs), ROUTE), 0
    start = antenna[0], antenna[1], antenna[2]
    for m in range(len(pairs)):
        first, second, target = pairs[m]
        at_first = vertices[m, 0, 0], vertices[m, 0, 1], vertices[m, 0, 2]
        at_second = vertices[m, 1, 0], vertices[m, 1, 1], vertices[m, 1, 2]
        end = vertices[m, 2, 0], vertices[m, 2, 1], vertices[m, 2, 2]
        depart, length_1 = direction_of(start, at_first)
        onward, length_2 = direction_of(at_first, at_second)
        arrive, length_3 = direction_of(at_second, end)
        over = below_top(builds[3], top[first] - at_first[2], length_1, length_2 + length_3, depart[2])
        over *= below_top(builds[3], top[second] - at_second[2], length_1 + length_2, length_3, depart[2])
        if over == 0.0:
            continue
        passed, foliage, _ = series((start, at_first, at_second, end), owner[m], pieces, False)
        if passed == 0.0:
            continue
        row = rows[count]
        count += 1
        needs = _TWICE if abs(over * passed) >= LIT_SHARE else _TWICE | SHADOWED
        fill_route(row, target, length_1 + length_2 + length_3, depart, arrive, needs)
        cosine_1 = abs(depart[0] * normal[first, 0] + depart[1] * normal[first, 1])
        cosine_2 = abs(arrive[0] * normal[second, 0] + arrive[1] * normal[second, 1])
        if is_curved[first] or is_curved[second]:
            # a bounce turns a ray by twice its cosine, whatever the normal
            cosine_1, cosine_2 = 0.5 * _apart(depart, onward), 0.5 * _apart(onward, arrive)
        by_first, by_second = bounce(builds, first, cosine_1), bounce(builds, second, cosine_2)
        fill_bounce(row, first, (by_first[0] * by_second[0], by_first[1] * by_second[1], by_first[2] * by_second[2]))
        row.wall2, row.foliage, row.other = second, foliage, other[m] * over * passed
    return rows[:count]


@compiled(error_model="numpy")
def _apart(first, second):  # type: ignore[no-untyped-def]
    """Return the length of the difference of two vectors."""
    x, y, z = first[0] - second[0], first[1] - second[1], first[2] - second[2]
    return math.sqrt(x * x + y * y + z * z)


@compiled(error_model="numpy")
def _apex_ways(antenna, point, pairs, geometry, wavelength_m):  # type: ignore[no-untyped-def]
    """Return first wall, second wall and target of all ways to points by right-angled corners' apexes, and the points.

    Right-angled: both images of the antenna within a share of the wavelength, the line from there as near the apex.
    """
    kept, vertices, count = np.empty((4, 3), np.int64), np.empty((4, 3, 3)), 0
    for corner in range(len(pairs)):
        ax, ay, x1, y1, x2, y2 = geometry[corner, :6]
        if pairs[corner, 0] > pairs[corner, 1] or geometry[corner, 8] != 0.0 or geometry[corner, 9] != 0.0:
            continue
        sx, sy, cosine = antenna[0] - ax, antenna[1] - ay, abs(x1 * x2 + y1 * y2)
        away = math.hypot(sx, sy)
        slack = 4.0 * cosine * away
        if slack > STRAIGHT_SAGITTA * wavelength_m or min(sx * x1 + sy * y1, sx * x2 + sy * y2) <= APEX_M:
            continue
        for target in range(len(point)):
            tx, ty = point[target, 0] - ax, point[target, 1] - ay
            if abs(sx * ty - sy * tx) > (APEX_M + slack) * math.hypot(sx + tx, sy + ty):
                continue
            if min(tx * x1 + ty * y1, tx * x2 + ty * y2) <= APEX_M:
                continue
            if count == len(kept):
                kept, vertices = np.concatenate((kept, kept)), np.concatenate((vertices, vertices))
            share = away / (away + math.hypot(tx, ty))
            kept[count, 0], kept[count, 1], kept[count, 2] = pairs[corner, 0], pairs[corner, 1], target
            vertices[count, :2, 0], vertices[count, :2, 1] = ax, ay
            vertices[count, :2, 2] = antenna[2] + share * (point[target, 2] - antenna[2])
            vertices[count, 2, 0], vertices[count, 2, 1] = point[target, 0], point[target, 1]
            vertices[count, 2, 2] = point[target, 2]
            count += 1
    return kept[:count], vertices[:count]


@compiled(error_model="numpy")
def _shares_of_ends(antenna, pairs, vertices, walls, pieces, wavelength_m):  # type: ignore[no-untyped-def]
    """Return the share of each loop that both walls' upright ends leave; nothing beside an end out of sight."""
    a, b, normal = walls[0], walls[1], walls[2]
    share = np.ones(len(pairs), np.complex128)
    for m in range(len(pairs)):
        x1, y1, x2, y2 = vertices[m, 0, 0], vertices[m, 0, 1], vertices[m, 1, 0], vertices[m, 1, 1]
        out = math.hypot(x1 - antenna[0], y1 - antenna[1])
        back = math.hypot(x2 - antenna[0], y2 - antenna[1])
        between = math.hypot(x2 - x1, y2 - y1)
        for side in range(2):
            w, x, y = pairs[m, side], vertices[m, side, 0], vertices[m, side, 1]
            before = back if side else out
            if before <= NEAREST_M:
                continue
            towards = abs((x - antenna[0]) * normal[w, 0] + (y - antenna[1]) * normal[w, 1]) / before
            wx, wy = b[w, 0] - a[w, 0], b[w, 1] - a[w, 1]
            long = math.hypot(wx, wy)
            along = ((x - a[w, 0]) * wx + (y - a[w, 1]) * wy) / long
            for clear, ex, ey in ((along, a[w, 0], a[w, 1]), (long - along, b[w, 0], b[w, 1])):
                share[m] *= passed_edge_at(clear * towards, before, out + back + between - before, wavelength_m)
                if clear < 0.0 and share[m] != 0.0:
                    near = max(1.0 - END_SLACK_M / math.hypot(ex - antenna[0], ey - antenna[1]), 0.0)
                    end = antenna[0] + near * (ex - antenna[0]), antenna[1] + near * (ey - antenna[1]), antenna[2]
                    # over tops both ways: the way out meets the end, and the other way round the way back does
                    share[m] *= series(((antenna[0], antenna[1], antenna[2]), end), -1, pieces, False)[0]
    return share


@compiled(error_model="numpy")
def _apex_loops(antenna, pairs, geometry, wavelength_m):  # type: ignore[no-untyped-def]
    """Walls, vertices and share of the wave of all loops by corners [C] that the radar is in.

    `geometry` [C, 10]: apex, unit vectors along both walls from there, lengths and bends of both walls.
    """
    kept, vertices = np.empty((len(pairs), 3), np.int64), np.empty((len(pairs), 3, 3))
    other, count = np.empty(len(pairs), np.complex128), 0
    for corner in range(len(pairs)):
        ax, ay, x1, y1, x2, y2, long_1, long_2, bend_1, bend_2 = geometry[corner]
        tx, ty = antenna[0] - ax, antenna[1] - ay
        distance = math.hypot(tx, ty)
        tx, ty = tx / max(distance, 1e-9), ty / max(distance, 1e-9)
        sine, cosine = x1 * y2 - y1 * x2, x1 * x2 + y1 * y2
        if not ((tx * y2 - ty * x2) * sine > 0.0 and (x1 * ty - y1 * tx) * sine > 0.0):
            continue
        sine = abs(sine)
        share = passed_share_at(cosine * math.sqrt(8.0 * distance / (wavelength_m * (1.0 + sine))))
        if cosine < 0.0:
            # beyond 90 deg the way is by the apex, longer than the line that the share is told for
            share *= cmath.exp(2j * np.pi / wavelength_m * (2.0 * distance * cosine * cosine / (1.0 + sine)))
        along_1 = distance * max(cosine, 0.0) / max(tx * x2 + ty * y2, 1e-9)
        along_2 = distance * max(cosine, 0.0) / max(tx * x1 + ty * y1, 1e-9)
        # the walls' other ends
        out = math.hypot(ax + along_1 * x1 - antenna[0], ay + along_1 * y1 - antenna[1])
        back = math.hypot(ax + along_2 * x2 - antenna[0], ay + along_2 * y2 - antenna[1])
        between = math.hypot(along_2 * x2 - along_1 * x1, along_2 * y2 - along_1 * y1)
        beside_1, beside_2 = abs(tx * y1 - ty * x1) * distance, abs(tx * y2 - ty * x2) * distance
        for clear, beside, before in ((long_1 - along_1, beside_1, out), (long_2 - along_2, beside_2, back)):
            share *= passed_edge_at(clear * beside / before, before, out + between + back - before, wavelength_m)
        if abs(share) <= DARKEST:
            continue
        kept[count, 0], kept[count, 1], kept[count, 2] = pairs[corner, 0], pairs[corner, 1], 0
        # on the walls themselves: an arc leaves its tangent
        leaves_1, leaves_2 = 0.5 * bend_1 * along_1 * along_1, 0.5 * bend_2 * along_2 * along_2
        vertices[count, 0, 0] = ax + along_1 * x1 - leaves_1 * y1
        vertices[count, 0, 1] = ay + along_1 * y1 + leaves_1 * x1
        vertices[count, 1, 0] = ax + along_2 * x2 - leaves_2 * y2
        vertices[count, 1, 1] = ay + along_2 * y2 + leaves_2 * x2
        vertices[count, 2, 0], vertices[count, 2, 1] = antenna[0], antenna[1]
        vertices[count, :, 2] = antenna[2]
        other[count] = share
        count += 1
    return kept[:count], vertices[:count], other[:count]


@compiled(error_model="numpy")
def _image(point, line):  # type: ignore[no-untyped-def]
    """Return a point mirrored in a line (normal and offset)."""
    nx, ny, offset = line
    x, y = mirrored(point[0], point[1], nx, ny, offset)
    return x, y, point[2]


@compiled(error_model="numpy")
def _cut(start, end, line):  # type: ignore[no-untyped-def]
    """Return where a straight line from one side of a wall's line to the other cuts it: by the heights over it."""
    nx, ny, offset = line
    over = start[0] * nx + start[1] * ny + offset
    share = over / (over - (end[0] * nx + end[1] * ny + offset))
    return (
        start[0] + share * (end[0] - start[0]),
        start[1] + share * (end[1] - start[1]),
        start[2] + share * (end[2] - start[2]),
    )


@compiled(error_model="numpy")
def _search(origin, point, flat, walls, lit, visible, wide):  # type: ignore[no-untyped-def]
    """First wall, second wall and target of all routes that the law of reflection allows, ends included; [M, 3].

    By what the radar sees of the first and, where `visible` says so, of the second in it. `wide` > 0: also beside it.
    """
    a, b, normal, offset, _ = walls
    start, seconds, shares = visible
    pairs = np.empty((64, 3), np.int64)
    count = 0
    for first in flat:
        low, high = max(lit[first, 0] - LIT_MARGIN, 0.0), min(lit[first, 1] + LIT_MARGIN, 1.0)
        nx, ny, d = normal[first, 0], normal[first, 1], offset[first]
        reach = origin[0] * nx + origin[1] * ny + d
        ix, iy = origin[0] - 2.0 * reach * nx, origin[1] - 2.0 * reach * ny
        offered, before = flat, 0
        if len(start):
            before = start[first]
            offered = seconds[before : start[first + 1]]
        for index in range(len(offered)):
            second, begin, end = offered[index], 0.0, 1.0
            if len(start):
                begin = max(shares[before + index, 0] - LIT_MARGIN, 0.0)
                end = min(shares[before + index, 1] + LIT_MARGIN, 1.0)
            if second == first or (wide == 0.0 and not _seen(ix, iy, reach, a, b, nx, ny, d, first, second)):
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
                margin_1, margin_2 = 0.0, 0.0
                if wide > 0.0:
                    across = (place - source_share) * math.sqrt(square)
                    ray = math.hypot(height + source, across)
                    margin_2 = wide * ray**1.5 / max(abs(height + source), 1e-9) / math.sqrt(square)
                if not begin - margin_2 <= share <= end + margin_2:
                    continue
                # the leg from the image must leave through the first wall, towards the antenna's side
                x, y = a[second, 0] + share * wx, a[second, 1] + share * wy
                if x * nx + y * ny + d <= 1e-9:
                    continue
                if wide > 0.0:
                    ux, uy = b[first, 0] - a[first, 0], b[first, 1] - a[first, 1]
                    over = max((x - ix) * nx + (y - iy) * ny, 1e-9) / math.hypot(x - ix, y - iy)
                    margin_1 = wide * math.sqrt(ray) / over / math.hypot(ux, uy)
                if not low - margin_1 <= _place(ix, iy, reach, x, y, a, b, nx, ny, d, first) <= high + margin_1:
                    continue
                if count == len(pairs):
                    grown = np.empty((2 * count, 3), np.int64)
                    grown[:count] = pairs
                    pairs = grown
                pairs[count] = first, second, target
                count += 1
    return pairs[:count]


@compiled(error_model="numpy")
def _place(ix, iy, reach, x, y, a, b, nx, ny, d, wall):  # type: ignore[no-untyped-def]
    """Return where on a wall, 0..1, the line from the image behind it to a point in front passes."""
    height = x * nx + y * ny + d
    share = reach / (height + reach)
    wx, wy = b[wall, 0] - a[wall, 0], b[wall, 1] - a[wall, 1]
    px, py = ix + share * (x - ix) - a[wall, 0], iy + share * (y - iy) - a[wall, 1]
    return (px * wx + py * wy) / (wx * wx + wy * wy)


@compiled(error_model="numpy")
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
