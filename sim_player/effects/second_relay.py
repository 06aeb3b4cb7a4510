"""Two walls in a row: corners send an object's image on, split a wide beam, and return the radar itself.

Routes antenna -> first wall -> second wall -> centre, straight pieces of wall, by the image method taken twice; the
radar's own image in a corner (both ways round); and the structure of one wall seen in another. Third order is left out.
"""

from __future__ import annotations

import numpy as np

from models.physics.mirror import reflect
from sim_player.echoes import Echoes, cofocal, echo_amplitude, join_echoes, object_echoes, surface_echoes
from sim_player.effects.los_surfaces import flash_weight
from sim_player.effect_names import bit
from sim_player.effects.tracing import Tracing
from sim_player.legs import in_series, passage
from sim_player.routes import Routes, dot, join_routes, make_routes, mirror_routes, no_routes, norm, plane_bounces
from sim_player.world import Snapshot, World

NAME = "second_relay"
ABOUT = "objects, the radar and walls seen by way of two walls"


def absent(world: World) -> str | None:
    """It takes two walls."""
    count = int((world.is_mirror & ~world.is_curved).sum())
    return None if count >= 2 else f"{count} straight wall{'' if count == 1 else 's'}: none faces another"


def apply(tracing: Tracing) -> Echoes:
    """Objects in two walls, the radar in corners, structure in another wall."""
    view = tracing.view
    tracing.routes[NAME] = two_wall_routes(view, view.centre, tracing.owner)
    objects = object_echoes(view, tracing.routes[NAME], cofocal(tracing.routes[NAME]))
    return join_echoes([objects, _corner_flashes(view), _mirrored_structure(view)])


def two_wall_routes(view: Snapshot, point_m: np.ndarray, owner: np.ndarray) -> Routes:
    """Free routes by two straight walls to points [N, 3]."""
    parts = [_by_first(view, wall, point_m, owner) for wall in np.flatnonzero(_mirrors(view.world))]
    return join_routes(parts) if parts else no_routes()


def _by_first(view: Snapshot, first: int, point_m: np.ndarray, owner: np.ndarray) -> Routes:
    """Routes whose first wall is given: one bounce seen from the antenna's image in it."""
    world = view.world
    normal, offset = view.normal[first], float(view.offset[first])
    image = reflect(view.antenna, normal, offset)
    others = _mirrors(world)
    others[first] = False
    found = plane_bounces(view, image, point_m, others)
    # the leg from the image must leave through the first wall, towards the antenna's side
    height = dot(found.specular[:, :2], normal) + offset
    reach = float(view.origin @ normal + offset)
    share = reach / np.where(height > 1e-9, height + reach, np.inf)
    through = image + share[:, None] * (found.specular - image)
    along = world.wall_b[first] - world.wall_a[first]
    place = (through[:, :2] - world.wall_a[first]) @ along / (along @ along)
    good = (height > 1e-9) & (place >= 0.0) & (place <= 1.0) & (through[:, 2] < world.wall_height_m[first])
    index = np.flatnonzero(good)
    return _routes(
        view,
        first,
        through[index],
        found.specular[index],
        found.wall[index],
        found.target[index],
        point_m,
        owner,
        norm(found.image[index] - image),
    )


def _routes(
    view: Snapshot,
    first: int,
    at_first: np.ndarray,
    at_second: np.ndarray,
    second: np.ndarray,
    target: np.ndarray,
    point_m: np.ndarray,
    owner: np.ndarray,
    length_m: np.ndarray,
) -> Routes:
    """Routes through known points of both walls, as far as their three legs are free."""
    world, end = view.world, point_m[target]
    legs = in_series(
        passage(view.antenna, at_first, view.blockers),
        passage(at_first, at_second, view.blockers),
        passage(at_second, end, view.blockers, owner[target]),
    )
    depart = (at_first - view.antenna) / norm(at_first - view.antenna)[:, None]
    middle = reflect(depart, view.normal[first], 0.0)
    one = world.reflection(np.full(len(second), first), np.abs(depart[:, :2] @ view.normal[first]))
    two = world.reflection(second, np.abs(dot(middle[:, :2], view.normal[second])))
    routes = make_routes(
        target,
        length_m,
        depart,
        reflect(middle, view.normal[second], 0.0),
        legs,
        bit("specular_relay") | bit(NAME),
        wall=np.full(len(second), first),
        wall2=second,
        whole=one[0] * two[0],
        front=one[1] * two[1],
        rough=one[2] * two[2],
    )
    return routes.take(legs.free)


def _corner_flashes(view: Snapshot) -> Echoes:
    """The radar's own image in two walls: out by one, back by the other, both ways round."""
    routes = two_wall_routes(view, view.antenna[None], np.array([-1], np.int32))
    point = np.broadcast_to(view.antenna, (len(routes), 3)).copy()
    echoes = surface_echoes(view, routes, flash_weight(view, routes.length_m), point, routes.wall, NO_NEED)
    values = {name: getattr(echoes, name) for name in Echoes.__dataclass_fields__}
    # the loop is one round trip, its two bounces are met once
    return Echoes(
        **{
            **values,
            "whole": routes.whole,
            "front": routes.front,
            "rough": routes.rough,
            "foliage": routes.foliage,
            "arrive": -routes.arrive,
            "out_m": 0.5 * routes.length_m,
            "back_m": 0.5 * routes.length_m,
            "rate_mps": 0.5 * (echoes.rate_mps + dot(routes.arrive[:, :2], view.radar_velocity)),
        }
    )


def _mirrored_structure(view: Snapshot) -> Echoes:
    """Small scatterers of one wall seen in another."""
    world = view.world
    which = np.flatnonzero((world.speck_length_m == 0.0) & (world.wall_height_m[world.speck_wall] > view.antenna[2]))
    point = np.column_stack([world.speck_m[which], np.full(len(which), view.antenna[2])])
    routes, legs = mirror_routes(view, point, _mirrors(world), np.full(len(which), -1, np.int32))
    routes = routes.take(legs.free & (world.speck_wall[which[routes.target]] != routes.wall))
    speck = which[routes.target]
    weight = echo_amplitude(world.radar, world.speck_rcs_m2[speck], routes.length_m) * world.speck_phasor[speck]
    return surface_echoes(view, routes, weight, point[routes.target], routes.wall, bit(NAME) | bit("los_surfaces"))


def _mirrors(world: World) -> np.ndarray:
    """Straight walls."""
    return world.is_mirror & ~world.is_curved


NO_NEED = bit(NAME)
