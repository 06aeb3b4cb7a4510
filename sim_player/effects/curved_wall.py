"""Curved walls as mirrors of objects and the radar: every Fermat point of an arc, focusing, the caustic's field."""

from __future__ import annotations

import numpy as np

from models.physics.curved_mirror import bounces
from sim_player.effects.los_surfaces import flash_weight
from sim_player.scene.bounce import all_below_top
from sim_player.scene.segments import free_segments
from sim_player.scene.world import Snapshot, World
from sim_player.trace.echoes import Echoes, cofocal, object_echoes, surface_echoes
from sim_player.trace.effect_names import bit
from sim_player.trace.routes import Routes, clear_ways, dot, make_routes, mirror_routes
from sim_player.trace.snapshot import TraceContext


def absent(world: World) -> str | None:
    """Only bent walls."""
    return None if world.is_curved.any() else "every wall is straight"


def apply(tracing: TraceContext) -> Echoes:
    """Centres and the radar itself in all arcs."""
    view = tracing.view
    routes = arc_routes(view, view.centre, tracing.owner)
    tracing.routes["curved_wall"] = routes
    return Echoes.joined([object_echoes(view, routes, cofocal(routes)), _flashes(view)])


def as_chords(tracing: TraceContext) -> Echoes:
    """Return the view where the effect is skipped: every arc as its chord's mirror, which the arc does not stop."""
    view = tracing.view
    parts = []
    for wall in np.flatnonzero(view.world.is_curved):
        only = np.arange(len(view.world.wall_a)) == wall
        routes, occlusion = mirror_routes(view, view.centre, only, tracing.owner, ignore_wall=int(wall))
        parts.append(clear_ways(routes, occlusion))
    routes = Routes.joined(parts)
    tracing.routes["specular_relay"] = Routes.joined([tracing.clear_routes("specular_relay"), routes])
    return object_echoes(view, routes, cofocal(routes))


def arc_routes(view: Snapshot, point_m: np.ndarray, owner: np.ndarray, own_wall: np.ndarray | int = -1) -> Routes:
    """Free routes by any arc to points [N, 3]; by none to points of its own, `own_wall` [N]."""
    parts = []
    for wall in np.flatnonzero(view.world.is_curved):
        # next to its target a search goes down to its finest step
        asked = np.flatnonzero(np.broadcast_to(own_wall != wall, len(point_m)))
        routes = _by_arc(view, int(wall), point_m[asked], owner[asked])
        parts.append(routes.with_columns(target=asked[routes.target]))
    return Routes.joined(parts)


def _by_arc(view: Snapshot, wall: int, point_m: np.ndarray, owner: np.ndarray) -> Routes:
    """Free routes by one arc."""
    world = view.world
    arc_bounces = bounces(
        view.antenna,
        point_m,
        world.wall_a[wall],
        world.wall_b[wall],
        float(world.wall_curvature_per_m[wall]),
        world.radar.wavelength_m,
    )
    end = point_m[arc_bounces.target]
    share = arc_bounces.out_m / (arc_bounces.out_m + arc_bounces.on_m)
    height = view.antenna[2] + share * (end[:, 2] - view.antenna[2])
    point = np.column_stack([arc_bounces.point_m, height])
    occlusion = free_segments((view.antenna, point, end), view.blockers, owner[arc_bounces.target])
    cosine = arc_bounces.cos_incidence * (arc_bounces.out_m + arc_bounces.on_m) / arc_bounces.length_m
    whole, front, rough = world.reflection(np.full(len(arc_bounces), wall), np.abs(cosine))
    depart, out_m = _direction(point - view.antenna), share * arc_bounces.length_m
    over = all_below_top(
        world.radar.wavelength_m,
        world.wall_height_m[wall] - height,
        out_m,
        arc_bounces.length_m - out_m,
        depart[:, 2],
    )
    routes = make_routes(
        arc_bounces.target,
        arc_bounces.length_m,
        depart,
        _direction(end - point),
        occlusion,
        bit("specular_relay") | bit("curved_wall"),
        wall=np.full(len(arc_bounces), wall),
        other=arc_bounces.gain * over,
        whole=whole,
        front=front,
        rough=rough,
    )
    there = np.flatnonzero(over != 0.0)
    return clear_ways(routes.take(there), occlusion.take(there))


def _flashes(view: Snapshot) -> Echoes:
    """The radar's own images in all arcs: one bounce on a round trip."""
    routes = arc_routes(view, view.antenna[None], np.array([-1], np.int32))
    point = view.antenna + routes.depart * 0.5 * routes.length_m[:, None]
    echoes = surface_echoes(view, routes, flash_weight(view, routes.length_m), point, routes.wall, bit("los_surfaces"))
    half, towards = 0.5 * routes.length_m, -routes.arrive
    return echoes.with_columns(
        weight=flash_weight(view, routes.length_m) * routes.other,
        whole=routes.whole,
        front=routes.front,
        rough=routes.rough,
        foliage=routes.foliage,
        out_m=half,
        back_m=half,
        arrive=towards,
        rate_mps=-0.5 * dot(routes.depart[:, :2] + towards[:, :2], view.radar_velocity),
        # as a straight wall's: no mirror of anything else
        kind=np.uint8(0),
        order=np.uint8(0),
    )


def _direction(ray: np.ndarray) -> np.ndarray:
    return np.asarray(ray / np.linalg.norm(ray, axis=1, keepdims=True))
