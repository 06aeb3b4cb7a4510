"""Comparison of our one-way routes with the paths of a foreign tracer: common, missing, extra, each with its reason."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from lab.foreign.export import ExportedSurface, SurfaceKind
from lab.foreign.one_way import OneWayPaths, as_routes, meets_own_object, surface_columns
from sim_player.bodies.triangles import first_hit, search_tree
from sim_player.effects.curved_wall import arc_routes
from sim_player.effects.second_relay import two_wall_routes
from sim_player.effects.table import PATHS
from sim_player.scene.segments import BODY, WALL, segment_occlusion, without
from sim_player.scene.world import Snapshot
from sim_player.trace.routes import Routes, mirror_routes
from sim_player.trace.snapshot import TraceContext

#: Effects whose routes are specular paths from the antenna to a point.
ROUTE_EFFECTS = ("los_objects", "specular_relay", "curved_wall", "second_relay", "ground_bounce")
#: A path that passes an edge nearer than this is decided by rounding: single precision shifts vertices by up to
#: 0.4 mm at 60 m to get off a surface.
ROUNDING_M = 1e-3
#: Hits this near to a vertex are the surface that the vertex lies on.
SELF_M = 1e-6

EDGE = f"within {1e3 * ROUNDING_M:g} mm of an edge: rounding decides"
UNEXPLAINED = "unexplained"

Key = tuple[int, int, int, bool]


@dataclass(frozen=True)
class Unmatched:
    """A path that only one of the tracers has."""

    group: str
    reason: str
    #: Field over that of the strongest common path to the same point, one way; inf where there is none.
    level_db: float


@dataclass(frozen=True)
class Comparison:
    """Paths of one place, or of several: C common ones with their differences (foreign minus ours), and the rest."""

    #: Kind of path, str [C].
    group: np.ndarray
    length_m: np.ndarray
    #: Angle between the two directions at the antenna and at the point.
    depart_rad: np.ndarray
    arrive_rad: np.ndarray
    #: Reflection coefficients, for paths by single flat slabs (else NaN).
    amplitude_db: np.ndarray
    phase_rad: np.ndarray
    missing: tuple[Unmatched, ...]
    extra: tuple[Unmatched, ...]


@dataclass(frozen=True)
class Place:
    """A snapshot, its export, and the paths of both tracers to the points of `end_points`."""

    view: Snapshot
    surfaces: tuple[ExportedSurface, ...]
    ours: Routes
    foreign: OneWayPaths

    @property
    def own(self) -> int:
        """Index of the antenna itself as a point."""
        return len(self.view.centre)


#: Paths of the foreign tracer from one source [3] to one point [3].
TraceAgain = Callable[[np.ndarray, np.ndarray], OneWayPaths]


def end_points(view: Snapshot) -> np.ndarray:
    """Return the points that both tracers reach: all scattering centres, then the antenna itself, [K + 1, 3]."""
    return np.concatenate([view.centre, view.antenna[None]])


def our_routes(view: Snapshot) -> Routes:
    """Return all specular routes to `end_points`, whatever echoes they would give."""
    tracing = TraceContext(view)
    for name in ROUTE_EFFECTS:
        if PATHS[name].absent(view.world) is None:
            PATHS[name].apply(tracing)
    made = (tracing.routes[name] for name in ROUTE_EFFECTS if name in tracing.routes)
    return Routes.joined([*made, _own_images(view)])


def _own_images(view: Snapshot) -> Routes:
    """Return the routes by one or two walls back to the antenna."""
    point, nobody = view.antenna[None], np.array([-1], np.int32)
    once, occlusion = mirror_routes(view, point, view.world.is_flat, nobody)
    parts = [once.take(occlusion.free), arc_routes(view, point, nobody), two_wall_routes(view, point, nobody)]
    routes = Routes.joined(parts)
    return routes.with_columns(target=len(view.centre))


def compare(place: Place, trace_again: TraceAgain) -> Comparison:
    """Match the paths of both tracers by target and surfaces, then give the others their reasons."""
    theirs = as_routes(place.foreign, place.surfaces)
    by_object = _meets(place, SurfaceKind.OBJECT)
    pairs, missing, extra = _match(place.ours, theirs, np.flatnonzero(~by_object))
    extra = np.concatenate([np.flatnonzero(by_object), extra])
    ours, foreign = place.ours.take(pairs[:, 0]), theirs.take(pairs[:, 1])
    strongest = np.zeros(place.own + 1)
    np.maximum.at(strongest, ours.target, _field(ours))
    ratio = np.where(_is_comparable(place, ours), foreign.whole / ours.whole, np.nan)
    return Comparison(
        group=_groups(place, ours),
        length_m=foreign.length_m - ours.length_m,
        depart_rad=np.linalg.norm(foreign.depart - ours.depart, axis=1),
        arrive_rad=np.linalg.norm(foreign.arrive - ours.arrive, axis=1),
        amplitude_db=20.0 * np.log10(np.abs(ratio)),
        phase_rad=np.angle(ratio),
        missing=_missing(place, missing, strongest, trace_again),
        extra=_extra(place, theirs, extra, strongest),
    )


def join_comparisons(parts: list[Comparison]) -> Comparison:
    """Return the paths of several places as one."""
    columns = ("group", "length_m", "depart_rad", "arrive_rad", "amplitude_db", "phase_rad")
    return Comparison(
        **{name: np.concatenate([getattr(part, name) for part in parts]) for name in columns},
        missing=tuple(path for part in parts for path in part.missing),
        extra=tuple(path for part in parts for path in part.extra),
    )


def _match(ours: Routes, theirs: Routes, free: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return pairs [C, 2] of the same target and surfaces, nearest lengths first, and what is left of both."""
    waiting: dict[Key, list[int]] = defaultdict(list)
    for index in free:
        waiting[_key(theirs, index)].append(int(index))
    pairs, missing = [], []
    for index in range(len(ours)):
        candidates = waiting[_key(ours, index)]
        if not candidates:
            missing.append(index)
            continue
        nearest = min(candidates, key=lambda other: abs(theirs.length_m[other] - ours.length_m[index]))
        candidates.remove(nearest)
        pairs.append((index, nearest))
    extra = [index for indices in waiting.values() for index in indices]
    return np.array(pairs, int).reshape(-1, 2), np.array(missing, int), np.array(extra, int)


def _key(routes: Routes, index: int) -> Key:
    return (int(routes.target[index]), int(routes.wall[index]), int(routes.wall2[index]), bool(routes.ground[index]))


def _field(routes: Routes) -> np.ndarray:
    """Return the field of each route but for roughness and foliage, 1/m."""
    return np.asarray(np.abs(routes.whole * routes.other) / routes.length_m)


def _level_db(routes: Routes, strongest: np.ndarray) -> np.ndarray:
    """Return `Unmatched.level_db` of routes."""
    with np.errstate(divide="ignore"):
        return np.asarray(20.0 * np.log10(_field(routes) / strongest[routes.target]))


def _meets(place: Place, kind: SurfaceKind) -> np.ndarray:
    """Return which foreign paths meet a kind of surface, bool [N]."""
    return np.asarray((surface_columns(place.surfaces)[0][place.foreign.surface] == kind).any(axis=1))


def _by_arc(place: Place, routes: Routes) -> np.ndarray:
    """Return which routes meet an arc, bool [N]."""
    curved = np.append(place.view.world.is_curved, False)
    return np.asarray(curved[routes.wall] | curved[routes.wall2])


def _groups(place: Place, routes: Routes) -> np.ndarray:
    """Return the kind of each path by its mirrors."""
    walls = (routes.wall >= 0).astype(int) + (routes.wall2 >= 0)
    names = np.array([["direct", "ground"], ["one wall", "wall and ground"], ["two walls", "two walls and ground"]])
    group = np.where(_by_arc(place, routes), "arc", names[walls, routes.ground.astype(int)])
    return np.where(routes.target == place.own, np.char.add("own image, ", group), group)


def _is_comparable(place: Place, routes: Routes) -> np.ndarray:
    """Return where both models mean the same reflection: flat walls of one layer."""
    layers = np.ones(len(place.view.world.wall_a) + 1, int)
    for surface in place.surfaces:
        if surface.kind == SurfaceKind.WALL:
            layers[surface.index] = surface.layers
    return ~_by_arc(place, routes) & (layers[routes.wall] == 1) & (layers[routes.wall2] == 1)


def _missing(
    place: Place, indices: np.ndarray, strongest: np.ndarray, trace_again: TraceAgain
) -> tuple[Unmatched, ...]:
    """Return the paths that the foreign tracer has not."""
    routes = place.ours.take(indices)
    by_arc = _by_arc(place, routes)
    reasons = [
        "the flat strips of an arc show no image there"
        if by_arc[row]
        else _why_missing(place, routes.take(np.array([row])), trace_again)
        for row in range(len(routes))
    ]
    return _unmatched(routes, _groups(place, routes), reasons, strongest)


def _unmatched(routes: Routes, group: np.ndarray, reasons: list[str], strongest: np.ndarray) -> tuple[Unmatched, ...]:
    return tuple(map(Unmatched, group.tolist(), reasons, _level_db(routes, strongest).tolist()))


def _why_missing(place: Place, route: Routes, trace_again: TraceAgain) -> str:
    """Return why the foreign tracer has not a path of ours by flat mirrors."""
    vertices = route_vertices(place.view, route)
    if edge_distance_m(place.surfaces, vertices) < ROUNDING_M:
        return EDGE
    blocker = mesh_blocker(place.surfaces, vertices)
    if blocker is not None:
        return f"the mesh of {blocker.name.lower()} is in the way"
    alone = as_routes(trace_again(vertices[0], vertices[-1]), place.surfaces)
    if _holds(alone, route.wall, route.wall2, route.ground):
        return "its table of candidates lost it among all points; traced to this point alone it has it"
    back = as_routes(trace_again(vertices[-1], vertices[0]), place.surfaces)
    if _holds(back, *((route.wall2, route.wall) if route.wall2[0] >= 0 else (route.wall, route.wall2)), route.ground):
        return "its search rays hit no such surfaces; with the ends exchanged it has it"
    return UNEXPLAINED


def _holds(routes: Routes, wall: np.ndarray, wall2: np.ndarray, ground: np.ndarray) -> bool:
    """Return whether some route has these mirrors, [1] each."""
    return bool(((routes.wall == wall) & (routes.wall2 == wall2) & (routes.ground == ground)).any())


def _extra(place: Place, theirs: Routes, indices: np.ndarray, strongest: np.ndarray) -> tuple[Unmatched, ...]:
    """Return the paths that ours has not."""
    routes = theirs.take(indices)
    by_object, by_arc = _meets(place, SurfaceKind.OBJECT)[indices], _by_arc(place, routes)
    owner = np.append(place.view.world.centre_object, -1)
    by_own = meets_own_object(place.foreign, place.surfaces, owner)[indices]
    by_two = (place.foreign.surface[indices] >= 0).sum(axis=1) > 1
    reasons = []
    for row, index in enumerate(indices):
        if by_own[row]:
            reasons.append("the point's own object as a mirror: in ours the point stands for it")
        elif by_object[row]:
            reasons.append("an object's face as a mirror: ours scatter")
        elif by_arc[row]:
            reasons.append("an arc beside another mirror: ours leaves it out" if by_two[row] else "one more strip")
        elif routes.ground[row] and routes.target[row] == place.own:
            beside = "the ground and another surface" if by_two[row] else "the ground straight below"
            reasons.append(f"{beside} as the radar's mirror: ours leaves it out")
        else:
            reasons.append(_why_extra(place, int(index)))
    group = np.where(by_object, "object", _groups(place, routes))
    return _unmatched(routes, group, reasons, strongest)


def _why_extra(place: Place, index: int) -> str:
    """Return why ours has not a path of the foreign tracer by flat mirrors."""
    bounces = place.foreign.vertex_m[index][place.foreign.surface[index] >= 0]
    end = end_points(place.view)[place.foreign.target[index]]
    vertices = np.concatenate([place.view.antenna[None], bounces, end[None]])
    if edge_distance_m(place.surfaces, vertices) < ROUNDING_M:
        return EDGE
    blockers = place.view.blockers
    for kind, name in ((BODY, "object's box"), (WALL, "wall")):
        only = without(blockers, np.flatnonzero(blockers.kind != kind))
        if not segment_occlusion(vertices[:-1], vertices[1:], only).free.all():
            return f"in ours an {name} is in the way" if kind == BODY else f"in ours a {name} is in the way"
    return UNEXPLAINED


def route_vertices(view: Snapshot, route: Routes) -> np.ndarray:
    """Return the vertices [N, 3] of one route by flat mirrors: antenna, bounces where its planes are met, point."""
    position, heading, vertices = view.antenna, route.depart[0], [view.antenna]
    walls = [int(wall) for wall in (route.wall[0], route.wall2[0]) if wall >= 0]
    planes = [(np.append(view.normal[wall], 0.0), float(view.offset[wall])) for wall in walls]
    ground = [(np.array([0.0, 0.0, 1.0]), 0.0)] if route.ground[0] else []
    while planes or ground:
        queues = [queue for queue in (planes, ground) if queue]
        along = [-(queue[0][0] @ position + queue[0][1]) / (queue[0][0] @ heading) for queue in queues]
        ahead = [step if step > SELF_M else np.inf for step in along]
        first = int(np.argmin(ahead))
        normal, _ = queues[first].pop(0)
        position = position + along[first] * heading
        heading = heading - 2.0 * (heading @ normal) * normal
        vertices.append(position)
    return np.array([*vertices, end_points(view)[route.target[0]]])


def mesh_blocker(surfaces: tuple[ExportedSurface, ...], vertices_m: np.ndarray) -> SurfaceKind | None:
    """Return the kind of the first exported surface that cuts a path between its vertices [N, 3]; double precision."""
    for surface in surfaces:
        tree = search_tree(surface.mesh.corners_m)
        for start, end in pairwise(vertices_m):
            length_m = float(np.linalg.norm(end - start))
            ray = tuple((end - start) / length_m)
            if first_hit(*tree, 0, tuple(start), ray, SELF_M)[0] < length_m - SELF_M:
                return surface.kind
    return None


def edge_distance_m(surfaces: tuple[ExportedSurface, ...], vertices_m: np.ndarray) -> float:
    """Return the least distance of a path [N, 3] from an outer edge of any exported surface."""
    edges = np.concatenate([_outline(surface) for surface in surfaces])
    return min(
        float(_segment_distance_m(start, end, edges[:, 0], edges[:, 1]).min()) for start, end in pairwise(vertices_m)
    )


def _outline(surface: ExportedSurface) -> np.ndarray:
    """Return the edges [E, 2, 3] of a mesh at which its normal changes or it ends."""
    faces = surface.mesh.faces
    edges = np.sort(np.stack([faces, np.roll(faces, -1, axis=1)], axis=2).reshape(-1, 2), axis=1)
    normals = np.repeat(surface.mesh.normals, 3, axis=0)
    kept = []
    for edge in np.unique(edges, axis=0):
        beside = normals[(edges == edge).all(axis=1)]
        if len(beside) < 2 or abs(beside[0] @ beside[1]) < 1.0 - 1e-9:
            kept.append(surface.mesh.vertices_m[edge])
    return np.array(kept)


def _segment_distance_m(start: np.ndarray, end: np.ndarray, a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the least distances between one segment and others a -> b [E, 3]."""
    ray, edge, gap = end - start, b - a, start - a
    rr, ee, re = ray @ ray, np.einsum("ei,ei->e", edge, edge), edge @ ray
    rg, eg = gap @ ray, np.einsum("ei,ei->e", edge, gap)
    determinant = rr * ee - re**2
    share = np.where(determinant > 1e-12 * rr * ee, (re * eg - rg * ee) / np.maximum(determinant, 1e-300), 0.0)
    along = np.clip((re * np.clip(share, 0.0, 1.0) + eg) / ee, 0.0, 1.0)
    share = np.clip((re * along - rg) / rr, 0.0, 1.0)
    return np.asarray(np.linalg.norm(gap + share[:, None] * ray - along[:, None] * edge, axis=1))
