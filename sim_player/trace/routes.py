"""One-way routes between the antenna and points of the scene: the geometry of every echo.

A route leaves the antenna in some direction, meets walls, ground or an edge, and arrives at its target; by reciprocity
it is also the return route. Field of a route: product of its factors / length. The factors that effects exchange are
kept apart, so that an echo's weight can be computed with and without them ("geometry first, fields second").
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from models.compiled import compiled
from sim_player.scene.bounce import all_below_top, below_top, bounce
from sim_player.scene.segments import Blockers, Occlusion, all_faded, is_left, passage, without
from sim_player.scene.world import LIT_MARGIN, Snapshot
from sim_player.trace.effect_names import bit
from sim_player.trace.row_table import Column, RowTable

#: Least length of a route: spherical spreading does not hold nearer than this.
NEAREST_M = 0.1
NONE = -1


class Routes(RowTable):
    """N one-way routes, in the scene's frame (heights over the ground)."""

    #: Index of the target it arrives at.
    target = Column("i4")
    #: First and second mirror from the antenna, -1 for none.
    wall = Column("i4")
    wall2 = Column("i4")
    #: Number of the edge at which it bends (`Edges.number`), -1 for none, -2 - number for one behind a mirror.
    edge = Column("i4")
    #: Bits of all effects that it needs.
    needs = Column("u4")
    #: Met the ground.
    ground = Column("?")
    length_m = Column("f8")
    #: Unit vectors of travel at the antenna and at the target, [N, 3].
    depart = Column("f8", 3)
    arrive = Column("f8", 3)
    #: Field factors: all bounces at walls as built and at their front faces alone, roughness, foliage, all else.
    whole = Column("c16")
    front = Column("c16")
    rough = Column("f8")
    foliage = Column("f8")
    other = Column("c16")


ROUTE = Routes.dtype
#: What `plane_bounces` returns.
Bounces = tuple[np.ndarray, np.ndarray, np.ndarray]
_MIRROR = bit("specular_relay")
#: Where tops leave less of the field, the geometrical ray is blocked, and what passes is bent.
LIT_SHARE, SHADOWED = 0.5, bit("edge_diffraction")


def make_routes(
    target: np.ndarray,
    length_m: np.ndarray,
    depart: np.ndarray,
    arrive: np.ndarray,
    occlusion: Occlusion,
    needs: np.ndarray | int,
    **further: Any,
) -> Routes:
    """Return the routes from their geometry and the occlusion of their segments; factors not given are one."""
    defaults = {"wall": NONE, "wall2": NONE, "edge": NONE, "ground": False}
    factors = {"whole": 1.0, "front": 1.0, "rough": 1.0, "other": 1.0}
    geometry = {"target": target, "length_m": np.maximum(length_m, NEAREST_M), "depart": depart, "arrive": arrive}
    columns = defaults | factors | geometry | {"foliage": occlusion.foliage, "needs": needs} | further
    return Routes.of(len(target), **columns)


def straight_routes(view: Snapshot, point_m: np.ndarray, owner: np.ndarray | int = -1) -> tuple[Routes, Occlusion]:
    """Return the straight routes from the antenna to points [N, 3], blocked ones too, and their occlusion.

    What the antenna is not to see counts as blocked.
    """
    rows, *occlusion = _straight(view.antenna, point_m, owners(owner, len(point_m)), view.blockers.pieces)
    routes, met = Routes(rows), Occlusion(*occlusion)
    return routes, met.where(view.is_ahead(routes.depart)) if view.ahead_only else met


def clear_ways(routes: Routes, occlusion: Occlusion) -> Routes:
    """Return those of some routes that nothing blocks, with what passes over the tops on their way.

    Where that is less than half the field, the way is there by diffraction alone.
    """
    free = np.flatnonzero(occlusion.free)
    routes, passed = routes.take(free), all_faded(occlusion.over[free])
    needs = routes.needs | np.where(np.abs(passed) < LIT_SHARE, SHADOWED, 0).astype(routes.needs.dtype)
    return routes.with_columns(other=routes.other * passed, needs=needs)


def scatterer_routes(view: Snapshot, specks: np.ndarray, point_m: np.ndarray) -> tuple[np.ndarray, Routes]:
    """Return which of some walls' scatterers (numbers and points [N]) are seen, and the straight routes to them.

    Each has the share of the wall below its top that the wall's mirror has.
    """
    world = view.world
    away_m = norm(point_m - view.antenna)
    over_m = world.wall_height_m[world.speck_wall[specks]] - view.antenna[2]
    left = all_below_top(world.radar.wavelength_m, over_m, away_m, away_m, np.zeros(len(specks)))
    there = np.flatnonzero(left)
    routes, occlusion = straight_routes(view, point_m[there])
    routes = routes.with_columns(target=world.speck_id[specks[there]], other=np.sqrt(left[there]))
    return there[occlusion.free], clear_ways(routes, occlusion)


def plane_bounces(view: Snapshot, source: np.ndarray, point_m: np.ndarray, mirrors: np.ndarray) -> Bounces:
    """Return all (piece of wall, point) pairs where the piece mirrors the point to a source [3], without occlusion.

    Pieces [M] and points [M] of the pairs, and their specular points and images, [M, 2, 3].
    The specular point comes from the heights over the wall of both ends: exact, and no line intersection is needed.
    `mirrors` [W]: the pieces to test.
    """
    wavelength_m = view.world.radar.wavelength_m
    return _plane_bounces(source, point_m, np.flatnonzero(mirrors), view.walls, view.lit_shares, wavelength_m)


def in_sight(view: Snapshot, wall: np.ndarray, point_m: np.ndarray) -> np.ndarray:
    """Return which points [N, 3] of pieces of wall [N] may be in direct sight, bool [N]."""
    start, lit = view.world.wall_a[wall], view.lit_shares[wall]
    along = view.world.wall_b[wall] - start
    share = dot(point_m[:, :2] - start, along) / dot(along, along)
    # a point at an end may lie beyond it by rounding
    return np.asarray((share >= lit[:, 0] - LIT_MARGIN) & (share <= lit[:, 1] + LIT_MARGIN))


def may_be_seen(view: Snapshot, mirror: np.ndarray, wall: np.ndarray, point_m: np.ndarray) -> np.ndarray:
    """Return which points [N, 3] of pieces of wall [N] may be seen in other pieces [N], bool [N]."""
    pairs = view.seen_pairs
    if pairs is None:
        return np.ones(len(mirror), bool)
    walls = len(view.world.wall_a)
    asked, known = mirror * walls + wall, pairs.first * walls + pairs.second
    if not len(known):
        return np.zeros(len(mirror), bool)
    at = np.minimum(np.searchsorted(known, asked), len(known) - 1)
    start = view.world.wall_a[wall]
    along = view.world.wall_b[wall] - start
    share = dot(point_m[:, :2] - start, along) / dot(along, along)
    low, high = pairs.share[at].T
    # an arc's points are beside its chord, and all of it is taken for seen
    share = np.where(view.world.is_curved[wall], 0.5, share)
    return np.asarray((known[at] == asked) & (share >= low - LIT_MARGIN) & (share <= high + LIT_MARGIN))


def mirror_routes(
    view: Snapshot, point_m: np.ndarray, mirrors: np.ndarray, owner: np.ndarray, ignore_wall: int | None = None
) -> tuple[Routes, Occlusion]:
    """Return the routes by one straight mirror to points [N, 3], blocked ones too, and their occlusion.

    `ignore_wall` is a piece of wall that blocks no segment.
    """
    blockers = view.blockers if ignore_wall is None else without(view.blockers, ignore_wall)
    return bounce_routes(view, point_m, plane_bounces(view, view.antenna, point_m, mirrors), owner, blockers)


def bounce_routes(
    view: Snapshot, point_m: np.ndarray, bounces: Bounces, owner: np.ndarray, blockers: Blockers
) -> tuple[Routes, Occlusion]:
    """Return the routes by pairs of pieces of wall and points [N, 3], blocked ones too, and their occlusion."""
    builds, who = view.world.builds, owners(owner, len(point_m))
    rows, *occlusion = _mirrored(view.antenna, point_m, who, bounces, view.walls, builds, blockers.pieces)
    return Routes(rows), Occlusion(*occlusion)


def owners(owner: np.ndarray | int, count: int) -> np.ndarray:
    """Return the object of each of some points, int32 [count]."""
    if isinstance(owner, np.ndarray):
        return np.ascontiguousarray(owner, np.int32)
    return np.full(count, owner, np.int32)


@compiled(error_model="numpy")
def fill_route(row, target, length_m, depart, arrive, needs):  # type: ignore[no-untyped-def]
    """Write a route that meets nothing; `depart` and `arrive` are three numbers each."""
    row.target, row.wall, row.wall2, row.edge = target, NONE, NONE, NONE
    row.needs, row.ground = needs, False
    row.length_m = max(length_m, NEAREST_M)
    there, here = row.depart, row.arrive
    there[0], there[1], there[2] = depart
    here[0], here[1], here[2] = arrive
    row.whole, row.front, row.rough, row.foliage, row.other = 1.0, 1.0, 1.0, 1.0, 1.0


@compiled(error_model="numpy")
def fill_bounce(row, wall, factors):  # type: ignore[no-untyped-def]
    """Write the wall of a route's only bounce and its field factors."""
    row.wall = wall
    row.whole, row.front, row.rough = factors


@compiled(error_model="numpy")
def _straight(antenna, point, owner, pieces):  # type: ignore[no-untyped-def]
    count = len(point)
    rows, free, foliage = np.empty(count, ROUTE), np.empty(count, np.bool_), np.empty(count)
    over, through = np.empty(count, np.complex128), np.empty(count, np.complex128)
    start = antenna[0], antenna[1], antenna[2]
    for n in range(count):
        end = point[n, 0], point[n, 1], point[n, 2]
        over[n], through[n], foliage[n] = passage(start, end, owner[n], pieces, False)
        free[n] = is_left(over[n])
        direction, length = direction_of(start, end)
        fill_route(rows[n], n, length, direction, direction, 0)
        rows[n].foliage = foliage[n]
    return rows, free, over, through, foliage


@compiled(error_model="numpy")
def direction_of(start, end):  # type: ignore[no-untyped-def]
    """Return the unit vector from one point to another, three numbers each, and their distance."""
    x, y, z = end[0] - start[0], end[1] - start[1], end[2] - start[2]
    length = math.sqrt(x * x + y * y + z * z)
    safe = max(length, 1e-9)
    return (x / safe, y / safe, z / safe), length


@compiled(error_model="numpy")
def grown(rows):  # type: ignore[no-untyped-def]
    """Return the same rows with room for as many again."""
    more = np.empty(2 * len(rows) + 16, rows.dtype)
    more[: len(rows)] = rows
    return more


@compiled(error_model="numpy")
def _plane_bounces(source, point, mirrors, walls, lit, wavelength_m):  # type: ignore[no-untyped-def]
    a, b, normal, offset, top = walls
    wall, target, points = np.empty(0, np.int64), np.empty(0, np.int64), np.empty((0, 2, 3))
    count = 0
    for w in mirrors:
        nx, ny = normal[w, 0], normal[w, 1]
        source_height = nx * source[0] + ny * source[1] + offset[w]
        if abs(source_height) <= 1e-9:
            continue
        wx, wy = b[w, 0] - a[w, 0], b[w, 1] - a[w, 1]
        squared = wx * wx + wy * wy
        start = wx * a[w, 0] + wy * a[w, 1]
        source_share = (wx * source[0] + wy * source[1]) / squared - start / squared
        reach = abs(source_height)
        for n in range(len(point)):
            height = nx * point[n, 0] + ny * point[n, 1] + offset[w]
            if height * source_height <= 0.0 or abs(height) <= 1e-9:
                continue
            target_share = (wx * point[n, 0] + wy * point[n, 1] - start) / squared
            # similar triangles: the feet of both, weighted by the other's height
            share = (source_share * height + target_share * source_height) / (height + source_height)
            if not lit[w, 0] <= share <= lit[w, 1]:
                continue
            portion = reach / (reach + abs(height))
            rise = source[2] + portion * (point[n, 2] - source[2])
            if rise >= top[w]:
                dx, dy, dz = point[n, 0] - source[0], point[n, 1] - source[1], point[n, 2] - source[2]
                ray = math.sqrt(dx * dx + dy * dy + dz * dz + 4.0 * source_height * height)
                if below_top(wavelength_m, top[w] - rise, portion * ray, (1.0 - portion) * ray, dz / ray) == 0.0:
                    continue
            if count == len(wall):
                wall, target = grown(wall), grown(target)
                more = np.empty((len(wall), 2, 3))
                more[:count] = points
                points = more
            distance = height / (nx * nx + ny * ny)
            ix, iy = point[n, 0] - 2.0 * distance * nx, point[n, 1] - 2.0 * distance * ny
            wall[count], target[count] = w, n
            points[count, 0, 0] = source[0] + portion * (ix - source[0])
            points[count, 0, 1] = source[1] + portion * (iy - source[1])
            points[count, 0, 2] = rise
            points[count, 1, 0], points[count, 1, 1], points[count, 1, 2] = ix, iy, point[n, 2]
            count += 1
    return wall[:count], target[:count], points[:count]


@compiled(error_model="numpy")
def _mirrored(antenna, point, owner, bounces, walls, builds, pieces):  # type: ignore[no-untyped-def]
    wall, target, points = bounces
    normal, top, count = walls[2], walls[4], len(wall)
    rows, free, foliage = np.empty(count, ROUTE), np.empty(count, np.bool_), np.empty(count)
    over, through = np.empty(count, np.complex128), np.empty(count, np.complex128)
    start = antenna[0], antenna[1], antenna[2]
    for m in range(count):
        n, w = target[m], wall[m]
        specular = points[m, 0, 0], points[m, 0, 1], points[m, 0, 2]
        image = points[m, 1, 0], points[m, 1, 1], points[m, 1, 2]
        end = point[n, 0], point[n, 1], point[n, 2]
        there = passage(start, specular, -1, pieces, False)
        on = passage(specular, end, owner[n], pieces, False)
        over[m], through[m], foliage[m] = there[0] * on[0], there[1] * on[1], there[2] * on[2]
        free[m] = is_left(over[m])
        depart, length = direction_of(start, image)
        nx, ny = normal[w, 0], normal[w, 1]
        towards = depart[0] * nx + depart[1] * ny
        arrive = (depart[0] - 2.0 * towards * nx, depart[1] - 2.0 * towards * ny, depart[2])
        fill_route(rows[m], n, length, depart, arrive, _MIRROR)
        fill_bounce(rows[m], w, bounce(builds, w, abs(towards)))
        rows[m].foliage = foliage[m]
        portion = (specular[0] - start[0]) * depart[0] + (specular[1] - start[1]) * depart[1]
        portion /= max(1.0 - depart[2] * depart[2], 1e-12)
        rows[m].other = below_top(builds[3], top[w] - specular[2], portion, length - portion, depart[2])
        if abs(rows[m].other) < LIT_SHARE:
            rows[m].needs |= SHADOWED
    return rows, free, over, through, foliage


def norm(vectors: np.ndarray) -> np.ndarray:
    """Return the lengths of vectors [..., D]."""
    return np.sqrt(dot(vectors, vectors))


def dot(left: np.ndarray, right: np.ndarray) -> np.ndarray:
    """Return the scalar products over the last axis."""
    return np.einsum("...i,...i->...", left, right)


def unit(vectors: np.ndarray) -> np.ndarray:
    """Return the vectors of length one; zero vectors stay."""
    return vectors / np.maximum(norm(vectors), 1e-9)[..., None]
