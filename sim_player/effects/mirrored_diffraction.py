"""A bend and a mirror on the same way: soft borders of the shadows that walls' ends and corners throw on mirror images.

Routes antenna -> edge -> wall -> centre and antenna -> wall -> edge -> centre, one edge and one straight piece of wall,
by images: behind the mirror the ray goes on unfolded, so the bend is that of `edge_diffraction` with the lengths of the
unfolded way, and the mirror that of `specular_relay`. Edges on the mirror's own line are none of these: what an end of
the mirror bends is in `edge_diffraction`, whose reflection terms are those of that wall.
The legs may lead through walls too, but for those by a mirror to an edge. Left out: two edges on one way, two mirrors
and a bend, joints of two builds, arcs as mirrors, the ground, and bends that leave little (`LEAST_BEND`, `LEAST_BOTH`).
"""

from __future__ import annotations

import math

import numpy as np

from models.compiled import compiled
from models.physics.mirror import mirrored
from sim_player.effects.edge_diffraction import (
    BLOCKED,
    LEAST_BEND,
    NEAREST_EDGE_M,
    OPEN,
    Edges,
    bend_bound,
    bend_field,
    most_bent,
    most_factor,
    open_edges,
    point_groups,
    stands_beside,
    turn_from_face,
)
from sim_player.scene.bounce import below_top, bounce
from sim_player.scene.segments import Blockers, is_clear, is_screened, may_pass, series
from sim_player.scene.world import Snapshot, World, wall_lines
from sim_player.trace.echoes import LEAST_BOTH, Echoes, object_echoes, same_target
from sim_player.trace.effect_names import bit
from sim_player.trace.routes import ROUTE, Routes, direction_of, fill_bounce, fill_route, grown, owners
from sim_player.trace.snapshot import TraceContext

_BENT, _THROUGH = bit("mirrored_diffraction"), bit("wall_transmission")
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
    """Out and back by one such route, or back by another way to the same centre: clear, through walls, bent."""
    view = tracing.view
    routes, bends = mirrored_edge_routes(view, view.centre, tracing.owner, tracing.walls_let_through)
    tracing.routes["mirrored_diffraction"] = routes
    straight, bent = tracing.unbent_routes, tracing.clear_routes("edge_diffraction")
    every = Routes.joined([routes, straight, bent])
    left = np.concatenate([bends, np.minimum(np.abs(straight.other), 1.0), most_factor(bent)])
    out, back = same_target(routes.target, every.target)
    counts = (out <= back) & (left[out] * left[back] >= LEAST_BOTH)
    mixed = counts & (out < back)
    alike = out[counts & (out == back)]
    same = object_echoes(view, routes, (alike, alike), _BENT)
    return Echoes.joined([same, object_echoes(view, every, (out[mixed], back[mixed]), _BENT)])


def mirrored_edge_routes(
    view: Snapshot, point_m: np.ndarray, owner: np.ndarray, walls: bool = False
) -> tuple[Routes, np.ndarray]:
    """Routes by one edge and one straight wall, in either order, to points [N, 3], and what each bend leaves [M].

    The field over a free ray's, `LEAST_BEND` at least. Free routes, and through `walls` if asked.
    """
    world, flat = view.world, np.flatnonzero(view.world.is_flat)
    edges = open_edges(world).take(~open_edges(world).joint)
    scene = world.builds, (world.transmission, world.wall_build), view.blockers.pieces, world.radar.wavelength_m
    ahead = view.is_ahead(edges.point - view.origin) if view.ahead_only else np.ones(len(edges), bool)
    table, ends = edges.table, (point_m, owners(owner, len(point_m)))
    first = _edge_first(view.antenna, ends, (table, ahead), (flat, view.walls), scene, LEAST_BEND, False, walls)
    second = _mirror_first(view.antenna, ends, table, (flat, view.walls, view.lit_shares), scene, LEAST_BEND, walls)
    before, behind = (Routes(rows).with_columns(edge=edges.number[rows["edge"]]) for rows, _ in (first, second))
    routes = Routes.joined([before, behind.with_columns(edge=_BEHIND_MIRROR - behind.edge)])
    return routes, np.concatenate([first[1], second[1]])


def mirrors_beside(
    world: World, edges: Edges, asked: np.ndarray, ends: tuple[np.ndarray, np.ndarray, np.ndarray], blockers: Blockers
) -> np.ndarray:
    """Return which pieces of wall `asked` [W] send on to points what edges bend of a ray from an antenna, bool [W].

    `ends`: antenna [3], points [N, 3] and their owners [N].
    """
    antenna, point_m, owner = ends
    scene = world.builds, (world.transmission, world.wall_build), blockers.pieces, world.radar.wavelength_m
    lines = world.wall_a, world.wall_b, *wall_lines(world, antenna[:2]), world.wall_height_m
    points, every = (point_m, owners(owner, len(point_m))), np.ones(len(edges), bool)
    mirrors = np.flatnonzero(asked & world.is_flat), lines
    rows, _ = _edge_first(antenna, points, (edges.table, every), mirrors, scene, LEAST_BEND, True, True)
    beside = np.zeros(len(world.wall_a), bool)
    beside[rows["wall"]] = True
    return beside


@compiled(error_model="numpy")
def _images(groups, flat, normal, offset):  # type: ignore[no-untyped-def]
    """Return the groups' places mirrored at walls, and their heights over them, [M, G, 3]."""
    images = np.empty((len(flat), len(groups), 3))
    for m in range(len(flat)):
        nx, ny, over = normal[flat[m], 0], normal[flat[m], 1], offset[flat[m]]
        for g in range(len(groups)):
            x, y = groups[g, 0], groups[g, 1]
            images[m, g, 0], images[m, g, 1] = mirrored(x, y, nx, ny, over)
            images[m, g, 2] = x * nx + y * ny + over
    return images


@compiled(error_model="numpy")
def _edge_first(antenna, ends, edges, mirrors, scene, least, one_each, walls):  # type: ignore[no-untyped-def]
    """Return routes antenna -> edge -> wall -> points and what their bends leave; of each wall only one if asked."""
    (table, ahead), (point, owner) = edges, ends
    flat, (a, b, normal, offset, tops) = mirrors
    pieces, wavelength_m = scene[2], scene[3]
    rows, bends, count = np.empty(len(point), ROUTE), np.empty(len(point)), 0
    start = antenna[0], antenna[1], antenna[2]
    groups, low, top = point_groups(point, owner, start[2])
    images, is_done = _images(groups, flat, normal, offset), np.zeros(len(flat), np.bool_)
    for e in range(len(table)):
        x, y, _, _, face_rad, sense, n_half, height, _, _ = table[e]
        source_plan = math.hypot(x - start[0], y - start[1])
        to_source = turn_from_face(start[0] - x, start[1] - y, face_rad, sense)
        if not ahead[e] or to_source >= n_half * np.pi or source_plan <= NEAREST_EDGE_M:
            continue
        # seen at the greatest height at which a ray to any point may meet it; free if the lowest ray meets nothing
        if not may_pass((start, (x, y, top)), pieces, walls):
            continue
        is_open = is_clear((start, (x, y, low)), pieces)
        for m in range(len(flat)):
            w = flat[m]
            over = x * normal[w, 0] + y * normal[w, 1] + offset[w]
            if is_done[m] or abs(over) <= NEAREST_EDGE_M:
                continue
            line = normal[w, 0], normal[w, 1], offset[w]
            ax, ay, bx, by = a[w, 0] - x, a[w, 1] - y, b[w, 0] - x, b[w, 1] - y
            front, side = math.copysign(1.0, over), math.copysign(1.0, ax * by - ay * bx)
            away_a, away_b = math.sqrt(ax * ax + ay * ay), math.sqrt(bx * bx + by * by)
            for g in range(len(groups)):
                # the group stands before the wall, and its image, seen from the edge, not beside it
                radius, tx, ty = groups[g, 2], images[m, g, 0] - x, images[m, g, 1] - y
                if front * images[m, g, 2] <= -radius or side * (ax * ty - ay * tx) < -radius * away_a:
                    continue
                if is_done[m] or side * (tx * by - ty * bx) < -radius * away_b:
                    continue
                if most_bent(table[e], (to_source, source_plan), (tx, ty, radius), top - low, wavelength_m) < least:
                    continue
                if _is_hidden((x, y), (images[m, g, 0], images[m, g, 1]), groups[g], top, line, pieces):
                    continue
                for n in range(int(groups[g, 3]), int(groups[g, 4])):
                    at, is_met = _met(line, (x, y, over), (point[n, 0], point[n, 1]), a[w], b[w], (0.0, 1.0))
                    if not is_met:
                        continue
                    ix, iy = mirrored(point[n, 0], point[n, 1], line[0], line[1], line[2])
                    to_target = turn_from_face(ix - x, iy - y, face_rad, sense)
                    # Keller's cone: unfolded in plan, a ray rises in proportion to its length
                    rise = (point[n, 2] - start[2]) / (source_plan + math.hypot(ix - x, iy - y))
                    bend = x, y, start[2] + source_plan * rise
                    mirror = at[0], at[1], bend[2] + math.hypot(at[0] - x, at[1] - y) * rise
                    if to_target >= n_half * np.pi:
                        continue
                    depart, source_m = direction_of(start, bend)
                    onwards, target_m = direction_of(bend, (ix, iy, point[n, 2]))
                    reach = stands_beside(bend[2] - height, source_m, target_m, wavelength_m)
                    if reach == 0.0 or abs(reach) < least:
                        continue
                    lengths, stretch = (source_m, target_m), math.hypot(1.0, rise)
                    # the ray before the mirror by its edge, as long as it is
                    ray = source_m + math.hypot(at[0] - x, at[1] - y) * stretch
                    rest = source_m + target_m - ray
                    reach *= below_top(wavelength_m, tops[w] - mirror[2], ray, rest, onwards[2])
                    if abs(reach) < least:
                        continue
                    if bend_bound(table[e], to_source, (to_target, to_target), lengths, stretch, wavelength_m) < least:
                        continue
                    end = point[n, 0], point[n, 1], point[n, 2]
                    behind = series((bend, mirror, end), owner[n], pieces, walls)
                    blocked = behind[0] == 0.0
                    before = OPEN if is_open or blocked else series((start, bend), -1, pieces, walls)
                    passed = before[0] * behind[0] * reach
                    if passed == 0.0:
                        continue
                    bent = bend_field(table[e], (to_source, to_target), lengths, source_plan, scene)
                    if max(abs(bent[0]), abs(bent[1])) * abs(passed) < least:
                        continue
                    if count == len(rows):
                        rows, bends = grown(rows), grown(bends)
                    bends[count] = max(abs(bent[0]), abs(bent[1])) * abs(passed)
                    row = rows[count]
                    count += 1
                    arrive, _ = direction_of(mirror, end)
                    fill_route(row, n, source_m + target_m, depart, arrive, _BENT)
                    _fill_turns(row, (e, w), bent, (passed, before, behind), onwards, line, scene[0])
                    if one_each:
                        is_done[m] = True
                        break
    return rows[:count], bends[:count]


@compiled(error_model="numpy")
def _mirror_first(antenna, ends, table, mirrors, scene, least, walls):  # type: ignore[no-untyped-def]
    point, owner = ends
    flat, (a, b, normal, offset, tops), lit = mirrors
    pieces, wavelength_m = scene[2], scene[3]
    rows, bends, count = np.empty(len(point), ROUTE), np.empty(len(point)), 0
    start = antenna[0], antenna[1], antenna[2]
    groups, low, top = point_groups(point, owner, start[2])
    for w in flat:
        line = normal[w, 0], normal[w, 1], offset[w]
        over = start[0] * line[0] + start[1] * line[1] + line[2]
        if abs(over) <= 1e-9 or lit[w, 1] < lit[w, 0]:
            continue
        ix, iy = mirrored(start[0], start[1], line[0], line[1], line[2])
        for e in range(len(table)):
            x, y, _, _, face_rad, sense, n_half, height, _, _ = table[e]
            at, is_met = _met(line, (start[0], start[1], over), (x, y), a[w], b[w], (lit[w, 0], lit[w, 1]))
            if not is_met or abs(x * line[0] + y * line[1] + line[2]) <= NEAREST_EDGE_M:
                continue
            to_source = turn_from_face(ix - x, iy - y, face_rad, sense)
            if to_source >= n_half * np.pi:
                continue
            # which edges stand in a mirror is known of what nothing hides there (`sim_player.paths.reach`)
            if not may_pass((start, (at[0], at[1], top), (x, y, top)), pieces, False):
                continue
            is_open = is_clear((start, (at[0], at[1], low), (x, y, low)), pieces)
            source_plan, mirror_plan = math.hypot(x - ix, y - iy), math.hypot(at[0] - start[0], at[1] - start[1])
            for group in groups:
                circle = group[0] - x, group[1] - y, group[2]
                if most_bent(table[e], (to_source, source_plan), circle, top - low, wavelength_m) < least:
                    continue
                for n in range(int(group[3]), int(group[4])):
                    end = point[n, 0], point[n, 1], point[n, 2]
                    target_plan = math.hypot(end[0] - x, end[1] - y)
                    to_target = turn_from_face(end[0] - x, end[1] - y, face_rad, sense)
                    if to_target >= n_half * np.pi or target_plan <= NEAREST_EDGE_M:
                        continue
                    rise = (end[2] - start[2]) / (source_plan + target_plan)
                    mirror = at[0], at[1], start[2] + mirror_plan * rise
                    bend = x, y, start[2] + source_plan * rise
                    _, source_m = direction_of((ix, iy, start[2]), bend)
                    arrive, target_m = direction_of(bend, end)
                    ray = mirror_plan * math.hypot(1.0, rise)
                    reach = stands_beside(bend[2] - height, source_m, target_m, wavelength_m)
                    reach *= below_top(wavelength_m, tops[w] - mirror[2], ray, source_m + target_m - ray, arrive[2])
                    if reach == 0.0 or abs(reach) < least:
                        continue
                    lengths, stretch = (source_m, target_m), math.hypot(1.0, rise)
                    if bend_bound(table[e], to_source, (to_target, to_target), lengths, stretch, wavelength_m) < least:
                        continue
                    before = OPEN if is_open else series((start, mirror, bend), -1, pieces, False)
                    behind = series((bend, end), owner[n], pieces, walls) if before[0] != 0.0 else BLOCKED
                    passed = before[0] * behind[0] * reach
                    if passed == 0.0:
                        continue
                    bent = bend_field(table[e], (to_source, to_target), lengths, source_plan, scene)
                    if max(abs(bent[0]), abs(bent[1])) * abs(passed) < least:
                        continue
                    if count == len(rows):
                        rows, bends = grown(rows), grown(bends)
                    bends[count] = max(abs(bent[0]), abs(bent[1])) * abs(passed)
                    row = rows[count]
                    count += 1
                    depart, _ = direction_of(start, mirror)
                    fill_route(row, n, source_m + target_m, depart, arrive, _BENT)
                    _fill_turns(row, (e, w), bent, (passed, before, behind), depart, line, scene[0])
    return rows[:count], bends[:count]


@compiled(error_model="numpy")
def _is_hidden(edge, image, group, top, line, pieces):  # type: ignore[no-untyped-def]
    """Return whether one wall before a mirror hides all of a group from it, or its image from an edge, up to `top`."""
    ex, ey = mirrored(edge[0], edge[1], line[0], line[1], line[2])
    # where the way from the edge to the middle meets the mirror
    over = edge[0] * line[0] + edge[1] * line[1] + line[2]
    beyond = image[0] * line[0] + image[1] * line[1] + line[2]
    share = over / (over - beyond)
    at = edge[0] + share * (image[0] - edge[0]), edge[1] + share * (image[1] - edge[1])
    front = math.copysign(1.0, over)
    side = front * line[0], front * line[1], front * line[2]
    if is_screened(edge, (image[0], image[1], group[2]), (edge, at), top, side, pieces):
        return True
    place = group[0], group[1]
    return is_screened((ex, ey), (group[0], group[1], group[2]), (at, place), top, side, pieces)


@compiled(error_model="numpy")
def _met(line, first, second, a, b, share):  # type: ignore[no-untyped-def]
    """Return where a wall's line mirrors two points of the plan to each other, and whether on a share of it."""
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


@compiled(error_model="numpy")
def _fill_turns(row, turns, bent, passed, incident, line, builds):  # type: ignore[no-untyped-def]
    """Write what turns a route, an edge and a wall met along `incident`, with the factors of both together."""
    row.edge, wall = turns
    row.other, before, behind = passed
    row.foliage = before[1] * behind[1]
    if before[2] or behind[2]:
        row.needs |= _THROUGH
    whole, front, rough = bounce(builds, wall, abs(incident[0] * line[0] + incident[1] * line[1]))
    fill_bounce(row, wall, (bent[0] * whole, bent[1] * front, rough))
