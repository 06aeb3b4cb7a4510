"""One-way routes between the antenna and points of the scene: the geometry of every echo.

A route leaves the antenna in some direction, meets walls, ground or an edge, and arrives at its target; by reciprocity
it is also the return route. Field of a route: product of its factors / length. The factors that effects exchange are
kept apart, so that an echo's weight can be computed with and without them ("geometry first, fields second").
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from models.physics.mirror import reflect
from msgs.values.array_table import ArrayTable
from sim_player.effects.names import bit
from sim_player.scene.world import Snapshot
from sim_player.trace.segments import Occlusion, in_series, segment_occlusion, without

#: Least length of a route: spherical spreading does not hold nearer than this.
NEAREST_M = 0.1
#: Rounding of the share of a wall that is in direct sight.
LIT_MARGIN = 1e-7
NONE = -1


@dataclass(frozen=True)
class Routes(ArrayTable):
    """N one-way routes, in the scene's frame (heights over the ground)."""

    #: Index of the target it arrives at, int32.
    target: np.ndarray
    length_m: np.ndarray
    #: Unit vectors of travel at the antenna and at the target, [N, 3].
    depart: np.ndarray
    arrive: np.ndarray
    #: First and second mirror from the antenna, -1 for none; int32.
    wall: np.ndarray
    wall2: np.ndarray
    #: Edge that bends it, -1 for none; int32.
    edge: np.ndarray
    #: Met the ground.
    ground: np.ndarray
    #: Field factors: all bounces at walls as built and at their front faces alone, roughness, foliage, all else.
    whole: np.ndarray
    front: np.ndarray
    rough: np.ndarray
    foliage: np.ndarray
    other: np.ndarray
    #: Bits of all effects that it needs, uint32.
    needs: np.ndarray

    def __len__(self) -> int:
        return len(self.length_m)


def join_routes(parts: list[Routes]) -> Routes:
    """Return all routes of several sets, in order."""
    return Routes.joined(parts)


def make_routes(
    target: np.ndarray,
    length_m: np.ndarray,
    depart: np.ndarray,
    arrive: np.ndarray,
    occlusion: Occlusion,
    needs: int,
    *,
    wall: np.ndarray | int = NONE,
    wall2: np.ndarray | int = NONE,
    edge: np.ndarray | int = NONE,
    ground: bool = False,
    whole: np.ndarray | complex = 1.0,
    front: np.ndarray | complex = 1.0,
    rough: np.ndarray | float = 1.0,
    other: np.ndarray | complex = 1.0,
) -> Routes:
    """Return the routes from their geometry and the occlusion of their segments; factors not given are one."""
    count = len(target)

    def spread(value: object, dtype: type) -> np.ndarray:
        filled: np.ndarray = np.empty(count, dtype)
        filled[:] = value
        return filled

    return Routes(
        target=np.asarray(target, np.int32),
        length_m=np.maximum(length_m, NEAREST_M),
        depart=depart,
        arrive=arrive,
        wall=spread(wall, np.int32),
        wall2=spread(wall2, np.int32),
        edge=spread(edge, np.int32),
        ground=spread(ground, np.bool_),
        whole=spread(whole, np.complex128),
        front=spread(front, np.complex128),
        rough=spread(rough, np.float64),
        foliage=occlusion.foliage,
        other=spread(other, np.complex128),
        needs=spread(needs, np.uint32),
    )


def no_routes() -> Routes:
    """Return no routes."""
    none, vectors = np.zeros(0), np.zeros((0, 3))
    return make_routes(np.zeros(0, int), none, vectors, vectors, Occlusion(none > 0.0, none + 0j, none), 0)


def straight_routes(view: Snapshot, point_m: np.ndarray, owner: np.ndarray | int = -1) -> tuple[Routes, Occlusion]:
    """Return the straight routes from the antenna to points [N, 3], blocked ones too, and their occlusion."""
    occlusion = segment_occlusion(view.antenna, point_m, view.blockers, owner)
    ray = point_m - view.antenna
    length = norm(ray)
    direction = ray / np.maximum(length, 1e-9)[:, None]
    routes = make_routes(np.arange(len(point_m)), length, direction, direction, occlusion, 0)
    return routes, occlusion


@dataclass(frozen=True)
class Bounces(ArrayTable):
    """M candidate bounces at straight walls between a source and targets: by the law of reflection, inside the ends."""

    wall: np.ndarray
    target: np.ndarray
    #: Specular points [M, 3] and images of the targets [M, 3].
    specular: np.ndarray
    image: np.ndarray
    normal: np.ndarray


def plane_bounces(view: Snapshot, source: np.ndarray, point_m: np.ndarray, mirrors: np.ndarray) -> Bounces:
    """Return all (piece of wall, point) pairs where the piece mirrors the point to a source [3], without occlusion.

    The specular point comes from the heights over the wall of both ends: exact, and no line intersection is needed.
    `mirrors` [W]: the pieces to test.
    """
    world = view.world
    walls = np.flatnonzero(mirrors)
    normal, offset = view.normal[walls], view.offset[walls]
    height = normal @ point_m[:, :2].T + offset[:, None]  # [W, N]
    source_height = (normal @ source[:2] + offset)[:, None]
    along = world.wall_b[walls] - world.wall_a[walls]
    squared = dot(along, along)[:, None]
    start = dot(along, world.wall_a[walls])[:, None]
    target_share = (along @ point_m[:, :2].T - start) / squared
    source_share = (along @ source[:2])[:, None] / squared - start / squared
    same_side = (height * source_height > 0.0) & (np.abs(height) > 1e-9) & (np.abs(source_height) > 1e-9)
    total = np.where(same_side, height + source_height, 1.0)
    # similar triangles: the feet of both, weighted by the other's height
    share = (source_share * height + target_share * source_height) / total
    low, high = np.clip(view.lit[walls] + [-LIT_MARGIN, LIT_MARGIN], 0.0, 1.0).T[:, :, None]
    index, target = np.nonzero(same_side & (share >= low) & (share <= high))
    wall = walls[index]
    image = reflect(point_m[target], view.normal[wall], view.offset[wall])
    reach = np.abs(source_height[index, 0])
    portion = reach / (reach + np.abs(height[index, target]))
    specular = source + portion[:, None] * (image - source)
    below_top = specular[:, 2] < world.wall_height_m[wall]
    bounces = Bounces(wall, target, specular, image, view.normal[wall])
    return bounces.take(below_top)


def mirror_routes(
    view: Snapshot, point_m: np.ndarray, mirrors: np.ndarray, owner: np.ndarray, ignore_wall: int | None = None
) -> tuple[Routes, Occlusion]:
    """Return the routes by one straight mirror to points [N, 3], blocked ones too, and their occlusion.

    `ignore_wall` is a piece of wall that blocks no segment.
    """
    bounces = plane_bounces(view, view.antenna, point_m, mirrors)
    target_m = point_m[bounces.target]
    blockers = view.blockers if ignore_wall is None else without(view.blockers, ignore_wall)
    occlusion = in_series(
        segment_occlusion(view.antenna, bounces.specular, blockers),
        segment_occlusion(bounces.specular, target_m, blockers, owner[bounces.target]),
    )
    ray = bounces.image - view.antenna
    length = norm(ray)
    direction = ray / np.maximum(length, 1e-9)[:, None]
    arrive = reflect(direction, bounces.normal, 0.0)
    whole, front, rough = view.world.reflection(bounces.wall, np.abs(dot(direction[:, :2], bounces.normal)))
    routes = make_routes(
        bounces.target,
        length,
        direction,
        arrive,
        occlusion,
        bit("specular_relay"),
        wall=bounces.wall,
        whole=whole,
        front=front,
        rough=rough,
    )
    return routes, occlusion


def norm(vectors: np.ndarray) -> np.ndarray:
    """Return the lengths of vectors [..., D]."""
    return np.sqrt(dot(vectors, vectors))


def dot(left: np.ndarray, right: np.ndarray) -> np.ndarray:
    """Return the scalar products over the last axis."""
    return np.einsum("...i,...i->...", left, right)


def unit(vectors: np.ndarray) -> np.ndarray:
    """Return the vectors of length one; zero vectors stay."""
    return vectors / np.maximum(norm(vectors), 1e-9)[..., None]
