"""Walls in direct sight: the flash of a wall that is met square on, and its structure (edges, frames, joints).

A flash is the radar's own image: field r lambda sqrt(P) / (4 pi 2d), from the mirror law alone. Where a wall ends, its
edge sends back too, by the uniform theory (Kouyoumjian and Pathak, 1974) with source and target in one place: where the
foot of the perpendicular passes the end, the flash ends and the edge's echo changes its sign, and their sum is the
Fresnel integral over the wall, half a flash at the end itself. Walls that meet are one wedge: a joint of two pieces in
one line is no edge, one of two materials sends back the difference of what they reflect. Over a wall's top the
integral over heights does the same (`passed_edge_at`), and where something else hides a part of the wall, the integral
is over what is in sight. Left out: that the border of such a shadow is soft itself (with an occluder half-way it is
-10 dB where this says -6), glass and foliage as occluders, and shadows of arcs beyond their chords.

Structure is small scatterers every 1-3 m; their level is an engineering choice, not a measurement.
"""

from __future__ import annotations

import cmath
import math

import numpy as np

from models.compiled import compiled
from models.physics.diffraction import FADES_TO, passed_edge_at, reflected_term_at, wedge_terms_at
from sim_player.effects.edge_diffraction import turn_from_face
from sim_player.scene.bounce import bounce
from sim_player.scene.segments import VOLUME, series
from sim_player.scene.wall_ends import NODE_M
from sim_player.scene.world import Snapshot, World
from sim_player.trace.echoes import Echoes, echo_amplitude, surface_echoes
from sim_player.trace.effect_names import bit
from sim_player.trace.routes import NEAREST_M, NONE, ROUTE, Routes, fill_route, scatterer_routes
from sim_player.trace.snapshot import TraceContext

#: Ends that send back less than this of a mirror as far away send nothing: such are joints of one facade.
FAINTEST = 1e-5
#: An end is looked at from the radar up to here before it: what ends in the same place does not hide it.
END_SLACK_M = 1.1 * NODE_M
#: A foot so near to a shadow is looked at no more: the shadow knows.
BESIDE_M = 1e-4
#: So many shadows on one wall at most.
MAX_SHADOWS = 32
#: Least of 1 - distance / radius at an arc's end: nearer to the focus the uniform theory does not hold.
LEAST_BENT = 0.05


def absent(world: World) -> str | None:
    """No wall, no return."""
    return None if len(world.wall_a) else "the scene holds no wall"


def apply(tracing: TraceContext) -> Echoes:
    """Flashes of straight walls, then structure."""
    return Echoes.joined([_flashes(tracing.view), structure(tracing.view)])


def flash_weight(view: Snapshot, length_m: np.ndarray) -> np.ndarray:
    """Weight of the radar's own image over a round trip, before any reflection."""
    radar = view.world.radar
    return np.asarray(math.sqrt(1e3 * radar.transmit_power_w) * radar.wavelength_m / (4.0 * np.pi * length_m))


def structure(view: Snapshot) -> Echoes:
    """Small scatterers of all walls in direct sight."""
    world = view.world
    specks, point = world.structure
    visible, routes = scatterer_routes(view, specks, point)
    visible_specks = specks[visible]
    weight = (
        echo_amplitude(world.radar, world.speck_rcs_m2[visible_specks], routes.length_m)
        * world.speck_phasor[visible_specks]
    )
    return surface_echoes(view, routes, weight, point[visible], world.speck_wall[visible_specks], bit("los_surfaces"))


def _flashes(view: Snapshot) -> Echoes:
    """The foot of the perpendicular on every straight piece of wall, where it lies on it and is in sight; all ends."""
    world = view.world
    nodes = world.end_nodes
    scene = world.builds, view.blockers.pieces, world.radar.wavelength_m
    ends = nodes.position, nodes.node_of, nodes.face_rad_of
    stands = view.blockers.kind != VOLUME
    screens = view.blockers.a[stands], view.blockers.b[stands], view.blockers.height_m[stands]
    wall, point, rows = _feet(view.antenna, np.flatnonzero(world.is_flat), view.walls, ends, screens, scene)
    # a number that is no scatterer's
    feet = Routes(rows).with_columns(target=NONE - world.wall_id[wall])
    node, end_point, end_rows = _ends(view.antenna, nodes.arrays, view.walls[4], scene)
    end = nodes.end[node]
    end_wall = end // 2
    edges = Routes(end_rows).with_columns(edge=2 * (2 * world.wall_id[end_wall] + end % 2) + Routes(end_rows).edge)
    routes = Routes.joined([feet, edges])
    points, walls = np.concatenate([point, end_point]), np.concatenate([wall, end_wall])
    weight = flash_weight(view, 2.0 * routes.length_m)
    return surface_echoes(view, routes, weight, points, walls, bit("los_surfaces"))


@compiled(error_model="numpy")
def _feet(antenna, flat, walls, ends, screens, scene):  # type: ignore[no-untyped-def]
    """Walls, their points and the routes there (half a round trip each), with what is in sight of the integral."""
    _, _, normal, offset, top = walls
    position, node_of, face_rad = ends
    builds, pieces, wavelength_m = scene
    wall, point, rows, count = np.empty(len(flat), np.int64), np.empty((len(flat), 3)), np.empty(len(flat), ROUTE), 0
    start = antenna[0], antenna[1], antenna[2]
    for w in flat:
        nx, ny = normal[w, 0], normal[w, 1]
        distance = nx * start[0] + ny * start[1] + offset[w]
        if distance <= NEAREST_M:
            continue
        over = passed_edge_at(top[w] - start[2], distance, distance, wavelength_m)
        if over == 0.0:
            continue
        # along the wall from its foot to its ends, low one first; whether the foot is on the wall's side of each
        places, on = np.empty(2), np.empty(2, np.bool_)
        for end in range(2):
            # as in the end's own echo, so that both say the same to the last digit
            x, y = start[0] - position[node_of[w, end], 0], start[1] - position[node_of[w, end], 1]
            turn = min(turn_from_face(x, y, face_rad[w, end], 1.0), turn_from_face(x, y, face_rad[w, end], -1.0))
            places[end], on[end] = ny * x - nx * y, np.pi - 2.0 * turn >= 0.0
        if places[0] > places[1]:
            places, on = places[::-1].copy(), on[::-1].copy()
        zone = FADES_TO * math.sqrt(0.25 * wavelength_m * distance)
        if places[0] > zone or places[1] < -zone:
            continue
        line = nx, ny, offset[w], distance
        shadows, is_hidden = _shadows(start, line, places, zone, screens, wavelength_m), False
        for low, high in shadows:
            # rays stop a clearance beside what stands
            is_hidden |= low - BESIDE_M < 0.0 < high + BESIDE_M
        # beyond the zone nothing counts
        near = np.array([max(places[0], -zone), min(places[1], zone)])
        share, middle = _share_in_sight(near, on, shadows, distance, wavelength_m)
        if abs(share) < FAINTEST:
            continue
        foot = start[0] - distance * nx, start[1] - distance * ny, start[2]
        # the foot itself is looked at, or the middle of what is in sight
        aside = middle if is_hidden or not (on[0] and on[1]) else 0.0
        at = foot[0] - ny * aside, foot[1] + nx * aside, foot[2]
        before, foliage, _ = series((start, at), -1, pieces, False)
        if before == 0.0:
            continue
        fill_route(rows[count], NONE, distance, (-nx, -ny, 0.0), (-nx, -ny, 0.0), 0)
        whole, front, rough = bounce(builds, w, 1.0)
        rows[count].whole, rows[count].front = cmath.sqrt(whole), cmath.sqrt(front)
        rows[count].rough, rows[count].foliage = math.sqrt(rough), foliage
        rows[count].other = cmath.sqrt(over * share) * before
        wall[count] = w
        point[count, 0], point[count, 1], point[count, 2] = foot
        count += 1
    return wall[:count], point[:count], rows[:count]


@compiled(error_model="numpy")
def _shadows(start, line, places, zone, screens, wavelength_m):  # type: ignore[no-untyped-def]
    """Return from where to where along a wall, from its foot, something before it hides it from the radar, [N, 2].

    In order, apart, within `zone`; `line`: normal, offset and distance. What meets the wall is no screen but a corner.
    """
    a, b, height = screens
    nx, ny, offset, distance = line
    fx, fy = start[0] - distance * nx, start[1] - distance * ny
    shadows, count = np.empty((MAX_SHADOWS, 2)), 0
    near, far = END_SLACK_M, distance - NEAREST_M
    for m in range(len(a)):
        over_a, over_b = a[m, 0] * nx + a[m, 1] * ny + offset, b[m, 0] * nx + b[m, 1] * ny + offset
        if max(over_a, over_b) <= near or min(over_a, over_b) >= far:
            continue
        at_a, at_b = (fy - a[m, 1]) * -nx + (fx - a[m, 0]) * ny, (fy - b[m, 1]) * -nx + (fx - b[m, 0]) * ny
        meets = False
        for over, at in ((over_a, at_a), (over_b, at_b)):
            meets |= abs(over) <= near and places[0] - near <= at <= places[1] + near
        if meets:
            continue
        # the part of it between wall and radar
        low, high = 0.0, 1.0
        rise = over_b - over_a
        if rise != 0.0:
            first, second = (near - over_a) / rise, (far - over_a) / rise
            low, high = max(low, min(first, second)), min(high, max(first, second))
        if low >= high:
            continue
        ends = np.empty(2)
        for end in range(2):
            part = high if end else low
            over, at = over_a + part * rise, at_a + part * (at_b - at_a)
            ends[end] = at * distance / (distance - over)
        over = over_a + 0.5 * (low + high) * rise
        # what is only just high enough is left to the ray itself
        stands = passed_edge_at(height[m] - start[2], distance - over, distance + over, wavelength_m) == 1.0
        if ends.max() < -zone or ends.min() > zone or not stands or count == MAX_SHADOWS:
            continue
        shadows[count, 0], shadows[count, 1] = ends.min(), ends.max()
        count += 1
    shadows = shadows[:count][np.argsort(shadows[:count, 0])]
    joined = 0
    for m in range(count):
        if joined and shadows[m, 0] <= shadows[joined - 1, 1] + 1e-9:
            shadows[joined - 1, 1] = max(shadows[joined - 1, 1], shadows[m, 1])
        else:
            shadows[joined] = shadows[m]
            joined += 1
    return shadows[:joined]


@compiled(error_model="numpy")
def _share_in_sight(places, on, shadows, distance, wavelength_m):  # type: ignore[no-untyped-def]
    """Return the Fresnel integral over what is visible of a wall without its ends in sight, and the middle of most.

    1 where nothing hides it and its foot is on it, 0 off it. `places` of its ends along it from the foot.
    """
    if len(shadows) == 0:
        return (1.0 if on[0] and on[1] else 0.0) + 0.0j, 0.0
    share, place, in_sight = 0.0j, places[0], np.ones(2, np.bool_)
    longest, middle = 0.0, 0.0
    for low, high in shadows:
        for end in range(2):
            in_sight[end] &= not low + END_SLACK_M < places[end] < high - END_SLACK_M
        until = min(low, places[1])
        if until > place:
            share += _below(until, distance, wavelength_m) - _below(place, distance, wavelength_m)
            if until - place > longest:
                longest, middle = until - place, 0.5 * (until + place)
        place = max(place, min(high, places[1]))
    share += _below(places[1], distance, wavelength_m) - _below(place, distance, wavelength_m)
    if places[1] - place > longest:
        longest, middle = places[1] - place, 0.5 * (places[1] + place)
    if in_sight[0]:
        share += _below(places[0], distance, wavelength_m) if on[0] else -_below(-places[0], distance, wavelength_m)
    if in_sight[1]:
        share += _below(-places[1], distance, wavelength_m) if on[1] else -_below(places[1], distance, wavelength_m)
    return (share if longest > 0.0 else 0.0j), middle


@compiled(error_model="numpy")
def _below(place, distance, wavelength_m):  # type: ignore[no-untyped-def]
    """Return the share of a flash that a wall up to some place along it, from the foot, sends back."""
    return passed_edge_at(place, distance, distance, wavelength_m)


@compiled(error_model="numpy")
def _ends(antenna, nodes, top, scene):  # type: ignore[no-untyped-def]
    """Nodes, their points and the routes there; `Routes.edge` tells two of one node apart.

    Of each node the wedge of air that the radar is in; in a corner of 90 deg or less its images are all there is.
    """
    position, start_of, slack_m, face_wall, face_rad, curvature = nodes
    builds, pieces, wavelength_m = scene
    room = 2 * len(position)
    node, point, rows, count = np.empty(room, np.int64), np.empty((room, 3)), np.empty(room, ROUTE), 0
    start = antenna[0], antenna[1], antenna[2]
    for i in range(len(position)):
        x, y = start[0] - position[i, 0], start[1] - position[i, 1]
        away = math.hypot(x, y)
        first = _first_face(x, y, face_rad, start_of[i], start_of[i + 1])
        last = first + 1 if first + 1 < start_of[i + 1] else start_of[i]
        n = 2.0 if first == last else (face_rad[last] - face_rad[first]) % (2.0 * np.pi) / np.pi
        if away <= NEAREST_M or n <= 0.5:
            continue
        spread = math.sqrt(2.0 / away)
        built, front, left = np.zeros(2, np.complex128), np.zeros(2, np.complex128), np.ones(2)
        # in the order of the walls, whichever side they are seen from
        turned = face_wall[last] < face_wall[first]
        for face in range(2):
            f, sense = (last, -1.0) if (face == 0) == turned else (first, 1.0)
            w, turn = face_wall[f], turn_from_face(x, y, face_rad[f], sense)
            over = passed_edge_at(top[w] - start[2], away, away, wavelength_m)
            # an arc's foot moves along it the slower or faster by its bend, and so does the border
            bent = 1.0 - sense * curvature[f] * away
            bent = math.copysign(max(abs(bent), LEAST_BENT), bent)
            if abs(bent - 1.0) > 1e-6:
                # an arc has its foot at the right angle too, and beyond its focus on the other side of that
                turn -= math.copysign(1e-14, bent)
            term = reflected_term_at(n, turn, 0.5 * away / bent, wavelength_m)
            if n > 1.0:
                # currents that send back r send as much forwards: of a sheet, and of metal, exactly
                term -= 0.5 * wedge_terms_at(n, turn, turn, 0.5 * away, wavelength_m, 1.0)[0]
            whole, of_front, left[face] = bounce(builds, w, min(abs(math.sin(turn)), 1.0))
            built[face], front[face] = whole * term * spread * over, of_front * term * spread * over
        alike = left[0] == left[1] or builds[0][face_wall[first], 2] == builds[0][face_wall[last], 2]
        if alike:
            # what roughness leaves is that of the face that sends back more
            left[0] = left[0] if abs(built[0]) >= abs(built[1]) else left[1]
            built[0], front[0] = built[0] + built[1], front[0] + front[1]
        if max(np.abs(built).max(), np.abs(front).max()) < FAINTEST:
            continue
        # looked at up to just before it: walls that meet there hide nothing of it
        share = max(1.0 - slack_m[i] / away, 0.0)
        before = start[0] - share * x, start[1] - share * y, start[2]
        passed, foliage, _ = series((start, before), -1, pieces, False)
        if passed == 0.0:
            continue
        direction = (-x / away, -y / away, 0.0)
        for face in range(1 if alike else 2):
            fill_route(rows[count], NONE, away, direction, direction, 0)
            rows[count].whole, rows[count].front = cmath.sqrt(built[face]), cmath.sqrt(front[face])
            rows[count].rough, rows[count].foliage, rows[count].other = math.sqrt(left[face]), foliage, passed
            rows[count].edge = face
            node[count] = i
            point[count, 0], point[count, 1], point[count, 2] = position[i, 0], position[i, 1], start[2]
            count += 1
    return node[:count], point[:count], rows[:count]


@compiled(error_model="numpy")
def _first_face(x, y, face_rad, begin, end):  # type: ignore[no-untyped-def]
    """Return the face from which the least turn to the left leads to a direction."""
    first, least = begin, np.inf
    for f in range(begin, end):
        turn = turn_from_face(x, y, face_rad[f], 1.0)
        if turn < least:
            first, least = f, turn
    return first
