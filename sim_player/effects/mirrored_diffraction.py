"""A bend and a mirror on the same way: soft borders of the shadows that walls' ends and corners throw on mirror images.

Routes antenna -> edge -> wall -> centre and antenna -> wall -> edge -> centre, one edge and one straight piece of wall,
by images: behind the mirror the ray goes on unfolded, so the bend is that of `edge_diffraction` with the lengths of the
unfolded way, and the mirror that of `specular_relay`. Edges on the mirror's own line are none of these: what an end of
the mirror bends is in `edge_diffraction`, whose reflection terms are those of that wall.
Left out: two edges on one way, two mirrors and a bend, arcs as mirrors, the ground, and bends that leave little
(`LEAST_BEND`, `LEAST_BOTH`).
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from models.physics.mirror import mirrored
from sim_player.effects.edge_diffraction import (
    NEAREST_EDGE_M,
    Edges,
    bend_field,
    height_span,
    open_edges,
    turn_from_face,
)
from sim_player.effects.names import bit
from sim_player.scene.world import Snapshot, World, wall_lines
from sim_player.trace.bounce import bounce
from sim_player.trace.echoes import Echoes, join_echoes, object_echoes, same_target
from sim_player.trace.routes import (
    ROUTE,
    Routes,
    direction_of,
    fill_bounce,
    fill_route,
    grown,
    join_routes,
    lit_shares,
    owners,
)
from sim_player.trace.segments import clear_series, passage
from sim_player.trace.snapshot import TraceContext

#: Bends that leave less than this of the field of a free ray as long are left out, and echoes of which the bends out
#: and back together leave less than that (-60 dB).
LEAST_BEND = 0.03
LEAST_BOTH = 1e-3
_BENT = bit("mirrored_diffraction")
#: Number of an edge behind the mirror, in `Routes.edge`: -2 and less, so that both orders are told apart.
_BEHIND_MIRROR = -2


def absent(world: World) -> str | None:
    """An object, a straight wall as the mirror, and another wall whose edge bends."""
    if not len(world.centre_m):
        return "the scene holds no object"
    if not world.is_flat.any():
        return "the scene holds no straight wall"
    return None if world.is_mirror.sum() >= 2 else "the scene holds one wall: none has an edge beside it"


def apply(tracing: TraceContext) -> Echoes:
    """Out and back by one such route, or back by another way to the same centre: clear, bent or the like."""
    view = tracing.view
    routes, bends = mirrored_edge_routes(view, view.centre, tracing.owner)
    tracing.routes["mirrored_diffraction"] = routes
    clear = tracing.clear_routes("los_objects", "specular_relay", "curved_wall", "second_relay")
    bent = tracing.clear_routes("edge_diffraction")
    every = join_routes([routes, clear, bent])
    left = np.concatenate([bends, np.ones(len(clear)), most_factor(bent)])
    out, back = same_target(routes.target, every.target)
    counts = (out <= back) & (left[out] * left[back] >= LEAST_BOTH)
    mixed = counts & (out < back)
    alike = out[counts & (out == back)]
    same = object_echoes(view, routes, (alike, alike), _BENT)
    return join_echoes([same, object_echoes(view, every, (out[mixed], back[mixed]), _BENT)])


def most_factor(rows: Routes | Echoes) -> np.ndarray:
    """Return the greatest field factor that routes or echoes have with whole walls or their front faces alone, [N]."""
    return np.asarray(np.maximum(np.abs(rows.whole), np.abs(rows.front)))


def mirrored_edge_routes(view: Snapshot, point_m: np.ndarray, owner: np.ndarray) -> tuple[Routes, np.ndarray]:
    """Free routes by one edge and one straight wall, in either order, to points [N, 3], and what each bend leaves [M].

    That is the field over that of a free ray as long, `LEAST_BEND` at least.
    """
    world, edges, flat = view.world, open_edges(view.world), np.flatnonzero(view.world.is_flat)
    scene = world.builds, (world.transmission, world.wall_build), view.blockers.pieces, world.radar.wavelength_m
    ahead = view.is_ahead(edges.point - view.origin) if view.ahead_only else np.ones(len(edges), bool)
    table, ends = edges.table(), (point_m, owners(owner, len(point_m)))
    first = _edge_first(view.antenna, ends, (table, ahead), (flat, view.walls), scene, LEAST_BEND)
    second = _mirror_first(view.antenna, ends, table, (flat, view.walls, lit_shares(view)), scene, LEAST_BEND)
    before, behind = (Routes(rows).with_columns(edge=edges.number[rows["edge"]]) for rows, _ in (first, second))
    routes = join_routes([before, behind.with_columns(edge=_BEHIND_MIRROR - behind.edge)])
    return routes, np.concatenate([first[1], second[1]])


def mirrors_beside(
    world: World, edges: Edges, antenna: np.ndarray, point_m: np.ndarray, owner: np.ndarray
) -> np.ndarray:
    """Return which pieces of wall may send on to points [N, 3] what edges bend of a ray from an antenna [3], bool [W].

    What stands in the way is not asked.
    """
    normal, offset = wall_lines(world, antenna[:2])
    walls = np.flatnonzero(world.is_flat), (world.wall_a, world.wall_b, normal, offset)
    groups, low, top = _groups(point_m, owners(owner, len(point_m)), antenna[2])
    return _beside(antenna, edges.table(), walls, groups, top - low, world.radar.wavelength_m, LEAST_BEND)


@njit(cache=True, nogil=True, error_model="numpy")
def _beside(antenna, table, walls, groups, climb, wavelength_m, least):  # type: ignore[no-untyped-def]
    flat, (a, b, normal, offset) = walls
    beside = np.zeros(len(a), np.bool_)
    for w in flat:
        line = normal[w, 0], normal[w, 1], offset[w]
        for e in range(len(table)):
            if beside[w] or _most_bent_to(table[e], antenna, climb, a[w], b[w], wavelength_m) < least:
                continue
            for group in groups:
                if _most_bent(table[e], antenna, group, climb, line, a[w], b[w], wavelength_m) >= least:
                    beside[w] = True
                    break
    return beside


@njit(cache=True, nogil=True, error_model="numpy")
def _groups(point, owner, height):  # type: ignore[no-untyped-def]
    """Return circles around the points of each object, [G, 5]: place, radius, first and last point; heights' span."""
    groups, count, first = np.empty((len(point), 5)), 0, 0
    for n in range(len(point)):
        if n + 1 < len(point) and owner[n + 1] == owner[n]:
            continue
        x, y, radius = point[first : n + 1, 0].mean(), point[first : n + 1, 1].mean(), 0.0
        for m in range(first, n + 1):
            radius = max(radius, math.hypot(point[m, 0] - x, point[m, 1] - y))
        groups[count] = x, y, radius + 1e-6, float(first), float(n + 1)
        count, first = count + 1, n + 1
    low, top = height_span(height, point)
    return groups[:count], low, top


@njit(cache=True, nogil=True, error_model="numpy")
def _edge_first(antenna, ends, edges, mirrors, scene, least):  # type: ignore[no-untyped-def]
    (table, ahead), (point, owner) = edges, ends
    flat, (a, b, normal, offset, tops) = mirrors
    pieces, wavelength_m = scene[2], scene[3]
    rows, bends, count = np.empty(len(point), ROUTE), np.empty(len(point)), 0
    start = antenna[0], antenna[1], antenna[2]
    groups, low, top = _groups(point, owner, start[2])
    for e in range(len(table)):
        x, y, _, _, face_rad, sense, n_half, height = table[e]
        source_plan = math.hypot(x - start[0], y - start[1])
        to_source = turn_from_face(start[0] - x, start[1] - y, face_rad, sense)
        if not ahead[e] or to_source >= n_half * np.pi or source_plan <= NEAREST_EDGE_M:
            continue
        # seen at the greatest height at which a ray to any point may meet it; free if the lowest ray meets nothing
        if not passage(start, (x, y, top), -1, pieces, True)[0]:
            continue
        is_open = clear_series((start, (x, y, low)), -1, pieces) == 1.0
        for w in flat:
            line = normal[w, 0], normal[w, 1], offset[w]
            over = x * line[0] + y * line[1] + line[2]
            if abs(over) <= NEAREST_EDGE_M:
                continue
            if _most_bent_to(table[e], start, top - low, a[w], b[w], wavelength_m) < least:
                continue
            for group in groups:
                if _most_bent(table[e], start, group, top - low, line, a[w], b[w], wavelength_m) < least:
                    continue
                for n in range(int(group[3]), int(group[4])):
                    at, is_met = _met(line, (x, y, over), (point[n, 0], point[n, 1]), a[w], b[w], (0.0, 1.0))
                    if not is_met:
                        continue
                    ix, iy = mirrored(point[n, 0], point[n, 1], line[0], line[1], line[2])
                    to_target = turn_from_face(ix - x, iy - y, face_rad, sense)
                    # Keller's cone: unfolded in plan, a ray rises in proportion to its length
                    rise = (point[n, 2] - start[2]) / (source_plan + math.hypot(ix - x, iy - y))
                    bend = x, y, start[2] + source_plan * rise
                    mirror = at[0], at[1], bend[2] + math.hypot(at[0] - x, at[1] - y) * rise
                    if to_target >= n_half * np.pi or bend[2] >= height or mirror[2] >= tops[w]:
                        continue
                    depart, source_m = direction_of(start, bend)
                    onwards, target_m = direction_of(bend, (ix, iy, point[n, 2]))
                    lengths, stretch = (source_m, target_m), math.hypot(1.0, rise)
                    if _bound(table[e], to_source, (to_target, to_target), lengths, stretch, wavelength_m) < least:
                        continue
                    end = point[n, 0], point[n, 1], point[n, 2]
                    behind = clear_series((bend, mirror, end), owner[n], pieces)
                    before = 1.0 if is_open or behind < 0.0 else clear_series((start, bend), -1, pieces)
                    if behind < 0.0 or before < 0.0:
                        continue
                    bent = bend_field(table[e], (to_source, to_target), lengths, source_plan, scene)
                    if max(abs(bent[0]), abs(bent[1])) < least:
                        continue
                    if count == len(rows):
                        rows, bends = grown(rows), grown(bends)
                    bends[count] = max(abs(bent[0]), abs(bent[1]))
                    row = rows[count]
                    count += 1
                    arrive, _ = direction_of(mirror, end)
                    fill_route(row, n, source_m + target_m, depart, arrive, _BENT)
                    row.edge, row.foliage = e, before * behind
                    _fill_fields(row, w, bent, bounce(scene[0], w, abs(onwards[0] * line[0] + onwards[1] * line[1])))
    return rows[:count], bends[:count]


@njit(cache=True, nogil=True, error_model="numpy")
def _mirror_first(antenna, ends, table, mirrors, scene, least):  # type: ignore[no-untyped-def]
    point, owner = ends
    flat, (a, b, normal, offset, tops), lit = mirrors
    pieces, wavelength_m = scene[2], scene[3]
    rows, bends, count = np.empty(len(point), ROUTE), np.empty(len(point)), 0
    start = antenna[0], antenna[1], antenna[2]
    low, top = height_span(start[2], point)
    for w in flat:
        line = normal[w, 0], normal[w, 1], offset[w]
        over = start[0] * line[0] + start[1] * line[1] + line[2]
        if abs(over) <= 1e-9 or lit[w, 1] < lit[w, 0]:
            continue
        ix, iy = mirrored(start[0], start[1], line[0], line[1], line[2])
        for e in range(len(table)):
            x, y, _, _, face_rad, sense, n_half, height = table[e]
            at, is_met = _met(line, (start[0], start[1], over), (x, y), a[w], b[w], (lit[w, 0], lit[w, 1]))
            if not is_met or abs(x * line[0] + y * line[1] + line[2]) <= NEAREST_EDGE_M:
                continue
            to_source = turn_from_face(ix - x, iy - y, face_rad, sense)
            if to_source >= n_half * np.pi:
                continue
            if clear_series((start, (at[0], at[1], top), (x, y, top)), -1, pieces) < 0.0:
                continue
            is_open = clear_series((start, (at[0], at[1], low), (x, y, low)), -1, pieces) == 1.0
            source_plan, mirror_plan = math.hypot(x - ix, y - iy), math.hypot(at[0] - start[0], at[1] - start[1])
            for n in range(len(point)):
                end = point[n, 0], point[n, 1], point[n, 2]
                target_plan = math.hypot(end[0] - x, end[1] - y)
                to_target = turn_from_face(end[0] - x, end[1] - y, face_rad, sense)
                if to_target >= n_half * np.pi or target_plan <= NEAREST_EDGE_M:
                    continue
                rise = (end[2] - start[2]) / (source_plan + target_plan)
                mirror = at[0], at[1], start[2] + mirror_plan * rise
                bend = x, y, start[2] + source_plan * rise
                if bend[2] >= height or mirror[2] >= tops[w]:
                    continue
                _, source_m = direction_of((ix, iy, start[2]), bend)
                arrive, target_m = direction_of(bend, end)
                lengths, stretch = (source_m, target_m), math.hypot(1.0, rise)
                if _bound(table[e], to_source, (to_target, to_target), lengths, stretch, wavelength_m) < least:
                    continue
                before = 1.0 if is_open else clear_series((start, mirror, bend), -1, pieces)
                behind = clear_series((bend, end), owner[n], pieces) if before >= 0.0 else -1.0
                if behind < 0.0:
                    continue
                bent = bend_field(table[e], (to_source, to_target), lengths, source_plan, scene)
                if max(abs(bent[0]), abs(bent[1])) < least:
                    continue
                if count == len(rows):
                    rows, bends = grown(rows), grown(bends)
                bends[count] = max(abs(bent[0]), abs(bent[1]))
                row = rows[count]
                count += 1
                depart, _ = direction_of(start, mirror)
                fill_route(row, n, source_m + target_m, depart, arrive, _BENT)
                row.edge, row.foliage = e, before * behind
                _fill_fields(row, w, bent, bounce(scene[0], w, abs(depart[0] * line[0] + depart[1] * line[1])))
    return rows[:count], bends[:count]


@njit(cache=True, nogil=True, error_model="numpy")
def _most_bent_to(edge, source, climb, a, b, wavelength_m):  # type: ignore[no-untyped-def]
    """Return a bound of what an edge (a row of `Edges.table`) bends from a source to a wall from a to b.

    Over the field of free rays as long, which rise by `climb` at most.
    """
    x, y, face_rad, sense = edge[0], edge[1], edge[4], edge[5]
    wx, wy = b[0] - a[0], b[1] - a[1]
    share = min(max(((x - a[0]) * wx + (y - a[1]) * wy) / (wx * wx + wy * wy), 0.0), 1.0)
    nearest, source_plan = (
        math.hypot(a[0] + share * wx - x, a[1] + share * wy - y),
        math.hypot(source[0] - x, source[1] - y),
    )
    to_source = turn_from_face(source[0] - x, source[1] - y, face_rad, sense)
    first = turn_from_face(a[0] - x, a[1] - y, face_rad, sense)
    last = first + _half_turn(turn_from_face(b[0] - x, b[1] - y, face_rad, sense) - first)
    stretch = math.hypot(1.0, climb / (source_plan + nearest))
    return _bound(edge, to_source, (first, last), (source_plan, nearest), stretch, wavelength_m)


@njit(cache=True, nogil=True, error_model="numpy")
def _half_turn(angle):  # type: ignore[no-untyped-def]
    """Return an angle as one between -pi and pi."""
    return angle - 2.0 * np.pi * np.rint(angle / (2.0 * np.pi))


@njit(cache=True, nogil=True, error_model="numpy")
def _most_bent(edge, source, group, climb, line, a, b, wavelength_m):  # type: ignore[no-untyped-def]
    """Return a bound of what an edge (a row of `Edges.table`) bends from a source by a wall to a group of points.

    Over the field of free rays as long, which rise by `climb` at most; 0 where the wall mirrors none of the group.
    """
    x, y, face_rad, sense, n = edge[0], edge[1], edge[4], edge[5], edge[6]
    over = x * line[0] + y * line[1] + line[2]
    facing = math.copysign(1.0, over) * (group[0] * line[0] + group[1] * line[1] + line[2])
    if abs(over) <= NEAREST_EDGE_M or facing <= -group[2]:
        return 0.0
    # seen from the edge, the group's image must not lie beside the wall
    ax, ay, bx, by = a[0] - x, a[1] - y, b[0] - x, b[1] - y
    ix, iy = mirrored(group[0], group[1], line[0], line[1], line[2])
    tx, ty = ix - x, iy - y
    side = math.copysign(group[2], ax * by - ay * bx)
    beside_a, beside_b = (ax * ty - ay * tx) / side, (tx * by - ty * bx) / side
    if beside_a < -math.hypot(ax, ay) or beside_b < -math.hypot(bx, by):
        return 0.0
    away, source_plan = math.hypot(tx, ty), math.hypot(source[0] - x, source[1] - y)
    if away <= 2.0 * group[2]:
        return np.inf
    to_source = turn_from_face(source[0] - x, source[1] - y, face_rad, sense)
    if to_source >= n * np.pi:
        return 0.0
    middle, half = turn_from_face(tx, ty, face_rad, sense), math.asin(group[2] / away)
    stretch = math.hypot(1.0, climb / (source_plan + away - group[2]))
    lengths = source_plan, away - group[2]
    return _bound(edge, to_source, (middle - half, middle + half), lengths, stretch, wavelength_m)


@njit(cache=True, nogil=True, error_model="numpy")
def _bound(edge, to_source, to_target, lengths, stretch, wavelength_m):  # type: ignore[no-untyped-def]
    """Return a bound of `bend_field` for targets between two turns: |F| <= 1, four cotangents that peak at the ends.

    `lengths` of both legs, which are `stretch` times (at most) as long as in plan.
    """
    n = edge[6]
    # across the first face turns begin again
    if min(to_target) < 0.0 or max(to_target) > 2.0 * np.pi:
        return np.inf
    # what a free end lets through may add to what it hides
    total, hidden = 0.0, 2.0 if edge[2] == edge[3] else 1.0
    for side, weight in ((-1.0, hidden), (1.0, 1.0)):
        for sign in (-1.0, 1.0):
            first = (np.pi + sign * (to_target[0] + side * to_source)) / (2.0 * n)
            last = (np.pi + sign * (to_target[1] + side * to_source)) / (2.0 * n)
            flattest = min(abs(math.tan(first)), abs(math.tan(last)))
            if flattest < 1e-9 or math.floor(first / np.pi) != math.floor(last / np.pi):
                return np.inf
            total += weight / flattest
    # 1 / (2 n sqrt(2 pi k s s' / (s + s')) sin(skew))
    turns = lengths[0] * lengths[1] / ((lengths[0] + lengths[1]) * wavelength_m)
    return total * stretch / (4.0 * np.pi * n * math.sqrt(turns))


@njit(cache=True, nogil=True, error_model="numpy")
def _met(line, first, second, a, b, share):  # type: ignore[no-untyped-def]
    """Return where a wall's line mirrors two points of the plan to each other, and whether that is on a share of it.

    `first` has its height over the line as its third number.
    """
    nx, ny, offset = line
    height = second[0] * nx + second[1] * ny + offset
    if height * first[2] <= 0.0 or abs(height) <= 1e-9:
        return (0.0, 0.0), False
    wx, wy = b[0] - a[0], b[1] - a[1]
    # similar triangles: the feet of both, weighted by the other's height
    part = first[2] / (first[2] + height)
    fx, fy = first[0] - first[2] * nx, first[1] - first[2] * ny
    sx, sy = second[0] - height * nx, second[1] - height * ny
    x, y = fx + part * (sx - fx), fy + part * (sy - fy)
    along = ((x - a[0]) * wx + (y - a[1]) * wy) / (wx * wx + wy * wy)
    return (x, y), share[0] <= along <= share[1]


@njit(cache=True, nogil=True, error_model="numpy")
def _fill_fields(row, wall, bent, mirrored_by):  # type: ignore[no-untyped-def]
    """Write the mirror of a route and the factors of bend and mirror together."""
    fill_bounce(row, wall, (bent[0] * mirrored_by[0], bent[1] * mirrored_by[1], mirrored_by[2]))
