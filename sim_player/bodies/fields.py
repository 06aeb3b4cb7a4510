"""Field of a body's centre between a source and a receiver: physical optics of its faces, closed forms of the rest.

Square roots of RCS with a phase, for source and receiver at points, near or far; time convention e^{+jwt}, and the
phase is that of the way by the centre. Physical optics: currents n x H and E x n of incident plus reflected field on
what is lit (Ruck, Radar Cross Section Handbook, 1970, 2.2). The phase is linear over a triangle between the exact ones
at its corners, so a body may stand in the radar's near field.
"""

from __future__ import annotations

import math

import numpy as np

from models.compiled import compiled
from sim_player.bodies.triangles import ahead, cross, dot, first_hit, lookup, radiated_field, reflected, row, sinc

#: Largest number of corners of a face, and of such a face cut by two beams.
FACE_CORNERS, CUT_CORNERS = 12, 48
#: Phase error of a triangle whose sides are straight in phase; it is halved until it is smaller.
PHASE_RAD = 0.2
#: The same of a piece of a cylinder's line, and the largest number of these.
STRIP_RAD, MAX_STRIPS = 0.02, 64
#: Sides of a triangle are halved no further than this share of it.
FINEST = 1.0 / 32.0
#: Corners of a face nearer than this are one; a smaller part of a face is an edge that two of them share.
SAME_M, LEAST_M2 = 1e-9, 1e-9
#: A spread of phases under which a triangle's integral is its series.
SMALL_RAD = 1e-3


@compiled(error_model="numpy")
def body_echo(bodies, centre, wavenumber, there, here):  # type: ignore[no-untyped-def]
    """Return the field of a centre, the lengths to it of both routes, and where on the body that is, from its position.

    `bodies`: `sim_player.bodies.centres.joined_bodies`; `there` and `here`: routes out and back, in either order.
    """
    size = bodies[1]
    source, receiver = ahead((0.0, 0.0, 0.0), -there.length_m, there.arrive), (0.0, 0.0, 0.0)
    same = there.length_m == here.length_m and (
        there.arrive[0] == here.arrive[0] and there.arrive[1] == here.arrive[1] and there.arrive[2] == here.arrive[2]
    )
    receiver = source if same else ahead((0.0, 0.0, 0.0), -here.length_m, here.arrive)
    if size[centre, 0] > 0.0:
        return _round_field(bodies, centre, source, receiver, wavenumber)
    field = _flat_field(bodies, centre, source, receiver, wavenumber)
    return field, there.length_m, here.length_m, (0.0, 0.0, 0.0)


@compiled(error_model="numpy")
def _unit(a):  # type: ignore[no-untyped-def]
    length = math.sqrt(dot(a, a))
    return a[0] / length, a[1] / length, a[2] / length


@compiled(error_model="numpy")
def _upright(towards):  # type: ignore[no-untyped-def]
    """Return the unit vector across a direction that is as upright as it can be."""
    flat = math.hypot(towards[0], towards[1])
    # straight from above: as `mesh_field` has it
    if flat < 1e-9:
        return cross(towards, (0.0, 1.0, 0.0))
    return -towards[2] * towards[0] / flat, -towards[2] * towards[1] / flat, flat


@compiled(error_model="numpy")
def _detour(point, end):  # type: ignore[no-untyped-def]
    """Return how much longer the way from an end to a point is than that to the origin, free of cancellation."""
    far = math.sqrt(dot(end, end))
    away = ahead(end, -1.0, point)
    return (dot(point, point) - 2.0 * dot(end, point)) / (math.sqrt(dot(away, away)) + far)


@compiled(error_model="numpy")
def _between(first, last):  # type: ignore[no-untyped-def]
    """Return the mean of e^{j phase} over a line of linear phase."""
    middle = 0.5 * (first + last)
    return (math.cos(middle) + 1j * math.sin(middle)) * sinc(0.5 * (last - first))


@compiled(error_model="numpy")
def triangle_mean(phases):  # type: ignore[no-untyped-def]
    """Return the mean of e^{j phase} over a triangle from the phases at its corners and at its middle.

    Exact for a phase of second degree; a series where the phases are nearly alike.
    """
    bend = 0.75 * phases[3] - 0.25 * (phases[0] + phases[1] + phases[2])
    a, b, c = phases[0] + bend, phases[1] + bend, phases[2] + bend
    low, high = min(a, b, c), max(a, b, c)
    middle, mean = a + b + c - low - high, (a + b + c) / 3.0
    if high - low < SMALL_RAD:
        spread = (a * a + b * b + c * c - a * b - b * c - c * a) / 18.0
        return (math.cos(mean) + 1j * math.sin(mean)) * (1.0 - 0.5 * spread)
    return 2.0 * (_between(middle, high) - _between(low, middle)) / (1j * (high - low))


@compiled(error_model="numpy")
def _mirrored(field, direction, normal, cosine, te, tm):  # type: ignore[no-untyped-def]
    """Return the direction and the field after a bounce."""
    out = ahead(direction, 2.0 * cosine, normal)
    return out, reflected(field, direction, out, normal, lookup(te, cosine), lookup(tm, cosine))


@compiled(error_model="numpy")
def _sent_back(field, direction, normal, towards, te, tm):  # type: ignore[no-untyped-def]
    """Return what a face with a field upon it radiates, for each of its m^2, in units of sqrt(4 pi) / lambda."""
    cosine = min(-dot(normal, direction), 1.0)
    out, field_out = _mirrored(field, direction, normal, cosine, te, tm)
    return radiated_field(field, field_out, direction, out, normal, towards, _upright(towards))


@compiled(error_model="numpy")
def _sent(source, normal, towards, te, tm):  # type: ignore[no-untyped-def]
    """Return what a face lit from a direction radiates to another, for each of its m^2, both as upright as can be."""
    upright = _upright(source)
    field = (upright[0] + 0.0j, upright[1] + 0.0j, upright[2] + 0.0j)
    return _sent_back(field, (-source[0], -source[1], -source[2]), normal, towards, te, tm)


@compiled(error_model="numpy")
def _free(trees, root, start, end, nearest):  # type: ignore[no-untyped-def]
    """Return whether no face of a body stands between two points."""
    onward = ahead(end, -1.0, start)
    length = math.sqrt(dot(onward, onward))
    distance, _ = first_hit(trees[0], trees[1], trees[2], trees[3], root, start, _unit(onward), nearest)
    return distance > length - nearest


@compiled(error_model="numpy")
def _is_inside(bodies, centre, point):  # type: ignore[no-untyped-def]
    """Return whether all faces of a hollow body show a point their inner side."""
    spans, normals, offsets = bodies[2], bodies[7], bodies[8]
    for face in range(spans[centre, 4], spans[centre, 4] + spans[centre, 5]):
        if dot(row(normals, face), point) - offsets[face] <= 0.0:
            return False
    return spans[centre, 5] > 0


@compiled(error_model="numpy")
def _flat_field(bodies, centre, source, receiver, wavenumber):  # type: ignore[no-untyped-def]
    """Return the field of a centre's triangles and of the ways by two or three faces that belong to it."""
    local, spans = bodies[0], bodies[2]
    start, end = ahead(row(local, centre), 1.0, source), ahead(row(local, centre), 1.0, receiver)
    # nothing of a convex body, and nothing seen from within a hollow one, hides anything
    is_hidden = spans[centre, 6] >= 0 and not (_is_inside(bodies, centre, start) and _is_inside(bodies, centre, end))
    root = spans[centre, 6] if is_hidden else -1
    total = _triangles(bodies, centre, (source, receiver), root, wavenumber)
    if spans[centre, 3] > 0:
        cut = np.empty((2, CUT_CORNERS, 3))
        waiting = np.empty((64, 3, 3))
        orders = 1 if source == receiver else 2
        for _ in range(orders):
            for sequence in range(spans[centre, 2], spans[centre, 2] + spans[centre, 3]):
                total += _sequence(bodies, centre, sequence, (start, end), root, wavenumber, cut, waiting) / orders
            start, end = end, start
    return total * wavenumber / math.sqrt(math.pi)


@compiled(error_model="numpy")
def _triangles(bodies, centre, ends, root, wavenumber):  # type: ignore[no-untyped-def]
    """Return the sum over a centre's lit triangles, in units of sqrt(4 pi) / lambda."""
    local, spans, pieces, normals, trees, tables = bodies[0], bodies[2], bodies[3], bodies[4], bodies[10], bodies[11]
    source, receiver = ends
    origin, nearest = row(local, centre), bodies[9][centre]
    te, tm = tables[spans[centre, 7], 0], tables[spans[centre, 7], 1]
    towards, back = _unit(source), _unit(receiver)
    out_m, back_m = math.sqrt(dot(source, source)), math.sqrt(dot(receiver, receiver))
    total, last, sent = 0.0j, (2.0, 2.0, 2.0), 0.0j
    for piece in range(spans[centre, 0], spans[centre, 0] + spans[centre, 1]):
        normal = row(normals, piece)
        side = dot(normal, towards)
        if side < 0.0 and spans[centre, 8]:
            side, normal = -side, (-normal[0], -normal[1], -normal[2])
        if side < 1e-9 or dot(normal, back) < 1e-9:
            continue
        a, b, c = row(pieces[piece], 0), row(pieces[piece], 1), row(pieces[piece], 2)
        middle = _middle(a, b, c)
        if root >= 0:
            start = ahead(origin, 1.0, middle)
            if not _free(trees, root, start, ahead(origin, 1.0, source), nearest):
                continue
            if source != receiver and not _free(trees, root, start, ahead(origin, 1.0, receiver), nearest):
                continue
        if normal != last:
            last, sent = normal, _sent(towards, normal, back, te, tm)
            if source != receiver:
                sent = 0.5 * (sent + _sent(back, normal, towards, te, tm))
        there, here = _detour(middle, source), _detour(middle, receiver)
        phases = (
            -wavenumber * (_detour(a, source) + _detour(a, receiver)),
            -wavenumber * (_detour(b, source) + _detour(b, receiver)),
            -wavenumber * (_detour(c, source) + _detour(c, receiver)),
            -wavenumber * (there + here),
        )
        # spreading and slant are those of the triangle, not of the centre
        spread = (out_m / (out_m + there) * back_m / (back_m + here)) ** 1.5
        total += sent * spread * _size(a, b, c) * triangle_mean(phases)
    return total


@compiled(error_model="numpy")
def _clipped(polygon, count, normal, offset, result):  # type: ignore[no-untyped-def]
    """Write the part of a convex polygon before a plane (Sutherland and Hodgman); return its number of corners."""
    kept = 0
    for i in range(count):
        a, b = row(polygon, i), row(polygon, (i + 1) % count)
        above, next_above = dot(normal, a) - offset, dot(normal, b) - offset
        if above >= 0.0:
            result[kept, 0], result[kept, 1], result[kept, 2] = a
            kept += 1
        if (above >= 0.0) != (next_above >= 0.0):
            corner = ahead(a, above / (above - next_above), ahead(b, -1.0, a))
            result[kept, 0], result[kept, 1], result[kept, 2] = corner
            kept += 1
    return kept


@compiled(error_model="numpy")
def _area(polygon, count):  # type: ignore[no-untyped-def]
    first, around = row(polygon, 0), (0.0, 0.0, 0.0)
    for i in range(2, count):
        a, b = ahead(row(polygon, i - 1), -1.0, first), ahead(row(polygon, i), -1.0, first)
        around = ahead(around, 0.5, cross(a, b))
    return math.sqrt(dot(around, around))


@compiled(error_model="numpy")
def _in_beam(face, corners, window, apex, plane, other):  # type: ignore[no-untyped-def]
    """Write into `window` [corners, 3] what of a face lies in the beam from an apex through it; return its corners."""
    beam = window[:corners].copy()
    middle = (0.0, 0.0, 0.0)
    for i in range(corners):
        middle = ahead(middle, 1.0 / corners, row(beam, i))
    count = _clipped(face, len(face), plane[0], plane[1], window)
    for i in range(corners):
        corner = row(beam, i)
        edge = ahead(row(beam, (i + 1) % corners), -1.0, corner)
        # corners that fall together have no edge
        if dot(edge, edge) < SAME_M * SAME_M:
            continue
        normal = cross(ahead(corner, -1.0, apex), edge)
        if dot(normal, ahead(middle, -1.0, corner)) < 0.0:
            normal = (-normal[0], -normal[1], -normal[2])
        if count < 3 or count > CUT_CORNERS - 2:
            return 0
        count = _clipped(window, count, normal, dot(normal, corner), other)
        window[:count] = other[:count]
    return count


@compiled(error_model="numpy")
def _sequence(bodies, centre, sequence, ends, root, wavenumber, cut, waiting):  # type: ignore[no-untyped-def]
    """Return the way by two or three faces by images and beams, on the last physical optics; sqrt(4 pi) / lambda."""
    spans, polygons, corners, plane_normals, offsets = bodies[2], bodies[5], bodies[6], bodies[7], bodies[8]
    faces = bodies[12][sequence]
    bounces = 3 if faces[2] >= 0 else 2
    normals, apexes = np.empty((3, 3)), np.empty((3, 3))
    apex, count, plane = ends[0], 0, ((0.0, 0.0, 0.0), 0.0)
    for bounce in range(bounces):
        face = faces[bounce]
        if bounce == 0:
            count = corners[face]
            cut[0, :count] = polygons[face, :count]
        else:
            count = _in_beam(polygons[face, : corners[face]], count, cut[0], apex, plane, cut[1])
        if count < 3 or _area(cut[0], count) < LEAST_M2:
            return 0.0j
        normal, offset = row(plane_normals, face), offsets[face]
        height = dot(normal, apex) - offset
        # the side that faces the beam
        if height < 0.0 and spans[centre, 8]:
            height, offset, normal = -height, -offset, (-normal[0], -normal[1], -normal[2])
        if height < 1e-9:
            return 0.0j
        normals[bounce, 0], normals[bounce, 1], normals[bounce, 2] = normal
        apexes[bounce, 0], apexes[bounce, 1], apexes[bounce, 2] = apex
        plane = (normal, offset)
        apex = ahead(apex, -2.0 * height, normal)
    return _last_face(bodies, centre, (normals, apexes, bounces), (cut[0], count), ends, root, wavenumber, waiting)


@compiled(error_model="numpy")
def _last_face(bodies, centre, beam, lit, ends, root, wavenumber, waiting):  # type: ignore[no-untyped-def]
    """Return the radiation of the lit part of a beam's last face, cut into triangles of nearly linear phase."""
    local = bodies[0]
    _, apexes, bounces = beam
    polygon, count = lit
    apex = row(apexes, bounces - 1)
    origin = row(local, centre)
    before, after = ahead(apex, -1.0, row(polygon, 0)), ahead(ends[1], -1.0, row(polygon, 0))
    bend = wavenumber * (1.0 / math.sqrt(dot(before, before)) + 1.0 / math.sqrt(dot(after, after)))
    longest = math.sqrt(8.0 * PHASE_RAD / bend)
    lengths = _apart(origin, ends[0]), _apart(origin, ends[1])
    total = 0.0j
    for third in range(2, count):
        waiting[0, 0], waiting[0, 1], waiting[0, 2] = polygon[0], polygon[third - 1], polygon[third]
        waits, allowed = 1, 0.0
        while waits:
            waits -= 1
            a, b, c = row(waiting[waits], 0), row(waiting[waits], 1), row(waiting[waits], 2)
            # the longest side first
            for _ in range(2):
                if _apart(b, c) > _apart(a, b) or _apart(c, a) > _apart(a, b):
                    a, b, c = b, c, a
            side = _apart(a, b)
            if allowed == 0.0:
                allowed = max(longest if root < 0 else min(longest, 0.25 * side), FINEST * side)
            if side > allowed and waits < 60:
                middle = ahead(ahead((0.0, 0.0, 0.0), 0.5, a), 0.5, b)
                for half, end in ((0, a), (1, b)):
                    waiting[waits + half, 0, 0], waiting[waits + half, 0, 1], waiting[waits + half, 0, 2] = middle
                    waiting[waits + half, 1, 0], waiting[waits + half, 1, 1], waiting[waits + half, 1, 2] = c
                    waiting[waits + half, 2, 0], waiting[waits + half, 2, 1], waiting[waits + half, 2, 2] = end
                waits += 2
                continue
            sent = _from_triangle(bodies, centre, beam, (a, b, c), ends, root)
            if sent != 0.0:
                round_m = lengths[0] + lengths[1]
                phases = (
                    wavenumber * (round_m - _length(apex, a, ends[1])),
                    wavenumber * (round_m - _length(apex, b, ends[1])),
                    wavenumber * (round_m - _length(apex, c, ends[1])),
                    wavenumber * (round_m - _length(apex, _middle(a, b, c), ends[1])),
                )
                total += sent * triangle_mean(phases) * lengths[0] * lengths[1]
    return total


@compiled(error_model="numpy")
def _middle(a, b, c):  # type: ignore[no-untyped-def]
    """Return the middle of a triangle."""
    return (a[0] + b[0] + c[0]) / 3.0, (a[1] + b[1] + c[1]) / 3.0, (a[2] + b[2] + c[2]) / 3.0


@compiled(error_model="numpy")
def _size(a, b, c):  # type: ignore[no-untyped-def]
    """Return the area of a triangle."""
    edge = cross(ahead(b, -1.0, a), ahead(c, -1.0, a))
    return 0.5 * math.sqrt(dot(edge, edge))


@compiled(error_model="numpy")
def _apart(a, b):  # type: ignore[no-untyped-def]
    between = ahead(b, -1.0, a)
    return math.sqrt(dot(between, between))


@compiled(error_model="numpy")
def _length(apex, point, end):  # type: ignore[no-untyped-def]
    return _apart(apex, point) + _apart(point, end)


@compiled(error_model="numpy")
def _from_triangle(bodies, centre, beam, triangle, ends, root):  # type: ignore[no-untyped-def]
    """Return the area of a triangle of the last face times its radiation, over both lengths; 0 where it is hidden."""
    spans, trees, tables = bodies[2], bodies[10], bodies[11]
    te, tm = tables[spans[centre, 7], 0], tables[spans[centre, 7], 1]
    normals, apexes, bounces = beam
    a, b, c = triangle
    middle = _middle(a, b, c)
    normal, apex = row(normals, bounces - 1), row(apexes, bounces - 1)
    direction, back = ahead(middle, -1.0, apex), ahead(ends[1], -1.0, middle)
    lengths = math.sqrt(dot(direction, direction)) * math.sqrt(dot(back, back))
    direction, back = _unit(direction), _unit(back)
    if dot(normal, back) < 1e-9:
        return 0.0j
    if root >= 0 and _is_hidden(trees, root, (normals, apexes, bounces), middle, ends[1], bodies[9][centre]):
        return 0.0j
    # back to the source, then on again with the field
    for bounce in range(bounces - 2, -1, -1):
        turned = row(normals, bounce)
        direction = ahead(direction, -2.0 * dot(turned, direction), turned)
    upright = _upright((-direction[0], -direction[1], -direction[2]))
    field = (upright[0] + 0.0j, upright[1] + 0.0j, upright[2] + 0.0j)
    for bounce in range(bounces - 1):
        turned = row(normals, bounce)
        cosine = min(max(-dot(turned, direction), 0.0), 1.0)
        direction, field = _mirrored(field, direction, turned, cosine, te, tm)
    return _size(a, b, c) * _sent_back(field, direction, normal, back, te, tm) / lengths


@compiled(error_model="numpy")
def _is_hidden(trees, root, beam, point, receiver, nearest):  # type: ignore[no-untyped-def]
    """Return whether some face stands in the way of a ray by a beam's faces to a point, or from there on."""
    normals, apexes, bounces = beam
    if not _free(trees, root, point, receiver, nearest):
        return True
    for bounce in range(bounces - 1, 0, -1):
        # where the line to the image meets the face before, whose plane is half-way between two images
        apex, image_of = row(apexes, bounce), row(apexes, bounce - 1)
        normal = row(normals, bounce - 1)
        offset = 0.5 * (dot(normal, apex) + dot(normal, image_of))
        above, below = dot(normal, point) - offset, dot(normal, apex) - offset
        at = ahead(point, above / (above - below), ahead(apex, -1.0, point))
        if not _free(trees, root, point, at, nearest):
            return True
        point = at
    return not _free(trees, root, point, row(apexes, 0), nearest)


@compiled(error_model="numpy")
def _strip(length, source, receiver, wavenumber):  # type: ignore[no-untyped-def]
    """Return the mean of the phasor along an upright line about the origin, in pieces of nearly straight phase."""
    bend = wavenumber * (1.0 / math.sqrt(dot(source, source)) + 1.0 / math.sqrt(dot(receiver, receiver)))
    count = min(int(length * math.sqrt(bend / (8.0 * STRIP_RAD))) + 1, MAX_STRIPS)
    total = 0.0j
    for i in range(count):
        low, high = (0.0, 0.0, length * (i / count - 0.5)), (0.0, 0.0, length * ((i + 1) / count - 0.5))
        first = _detour(low, source) + _detour(low, receiver)
        total += _between(-wavenumber * first, -wavenumber * (_detour(high, source) + _detour(high, receiver)))
    return total / count


@compiled(error_model="numpy")
def _round_field(bodies, centre, source, receiver, wavenumber):  # type: ignore[no-untyped-def]
    """Return the field of a sphere, or of a piece of an upright cylinder's side, as `body_echo`.

    Stationary phase at the point that mirrors the source to the receiver: pi a^2 of a sphere, k a L^2 cos sinc^2 of a
    cylinder (Ruck, 3.2 and 4.3), with the spreading of a spherical wave from nearby.
    """
    size, spans, tables = bodies[1], bodies[2], bodies[11]
    radius, length = size[centre, 0], size[centre, 1]
    te, tm = tables[spans[centre, 7], 0], tables[spans[centre, 7], 1]
    towards, back = _unit(source), _unit(receiver)
    axis = ahead(towards, 1.0, back)
    if length > 0.0:
        axis = (axis[0], axis[1], 0.0)
    along = math.sqrt(dot(axis, axis))
    out_m, back_m = math.sqrt(dot(source, source)), math.sqrt(dot(receiver, receiver))
    if along < 1e-6:
        return 0.0j, out_m, back_m, (0.0, 0.0, 0.0)
    normal = (axis[0] / along, axis[1] / along, axis[2] / along)
    point = ahead((0.0, 0.0, 0.0), radius, normal)
    towards, back = ahead(source, -1.0, point), ahead(receiver, -1.0, point)
    out_m, back_m = math.sqrt(dot(towards, towards)), math.sqrt(dot(back, back))
    towards, back = _unit(towards), _unit(back)
    if dot(normal, towards) < 1e-9 or dot(normal, back) < 1e-9:
        return 0.0j, out_m, back_m, point
    sent = 0.5 * (_sent(towards, normal, back, te, tm) + _sent(back, normal, towards, te, tm))
    # how fast the way grows beside the mirroring point: in the plane of both directions, and across it
    height = dot(normal, towards) + dot(normal, back)
    across = cross(towards, back)
    if length > 0.0:
        tangent = (-normal[1], normal[0], 0.0)
    elif dot(across, across) > 1e-12:
        tangent = _unit(cross(_unit(across), normal))
    else:
        tangent = _unit(cross((0.0, 0.0, 1.0) if abs(normal[2]) < 0.9 else (1.0, 0.0, 0.0), normal))
    within = height + radius * ((1.0 - dot(tangent, towards) ** 2) / out_m + (1.0 - dot(tangent, back) ** 2) / back_m)
    if length > 0.0:
        lobe = _strip(length, ahead(source, -1.0, point), ahead(receiver, -1.0, point), wavenumber)
        area = length * lobe * math.sqrt(2.0 * math.pi * radius / (wavenumber * within))
        turn = math.sqrt(0.5) * (1.0 - 1.0j)
    else:
        beside = height + radius * (1.0 / out_m + 1.0 / back_m)
        area = 2.0 * math.pi * radius / (wavenumber * math.sqrt(within * beside)) + 0.0j
        turn = -1.0j
    return sent * area * turn * wavenumber / math.sqrt(math.pi), out_m, back_m, point
