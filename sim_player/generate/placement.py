"""Placement of road users at many candidate spots at once: occlusion, mirrors, free room, in plan with chords.

Only straight opaque walls and vehicles hide; every wall blocks a path by a mirror. Final visibility is traced.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from models.physics.curved_mirror import arc_points
from models.physics.mirror import blocked, crosses
from sim_player.scene.description import SceneObject, Surface

#: An arc is this many chords.
CHORDS = 8
#: Materials that hide little: thin glass lets waves through, plants have gaps.
NOT_HIDING = frozenset({"glass", "vegetation"})
NO_MIRROR = frozenset({"vegetation"})
#: Road users keep this far from walls (half a hedge's depth) and from one another.
WALL_CLEARANCE_M, CLEARANCE_M = 0.5, 0.25
ORIGIN = np.zeros(2)


@dataclass(frozen=True)
class Walls:
    """All upright walls of a place as W chords."""

    a: np.ndarray
    b: np.ndarray
    hides: np.ndarray
    mirrors: np.ndarray
    #: Ends of all pieces that road users keep off: with each arc its straight chord, which `check_scene` looks at.
    footing: tuple[np.ndarray, np.ndarray]

    @classmethod
    def of(cls, surfaces: tuple[Surface, ...]) -> Walls:
        """Flatten surfaces; the ground has none."""
        a, b, hides, mirrors = [], [], [], []
        for surface in surfaces:
            points = chords(surface)
            a.append(points[:-1])
            b.append(points[1:])
            straight = surface.curvature_per_m == 0.0
            hides.append(np.full(len(points) - 1, straight and surface.material not in NOT_HIDING))
            mirrors.append(np.full(len(points) - 1, surface.material not in NO_MIRROR))
        bent = [np.array(surface.polyline_m) for surface in surfaces if surface.curvature_per_m]
        footing = (
            np.concatenate([*a, *(points[:-1] for points in bent)]),
            np.concatenate([*b, *(points[1:] for points in bent)]),
        )
        return cls(np.concatenate(a), np.concatenate(b), np.concatenate(hides), np.concatenate(mirrors), footing)


@dataclass(frozen=True)
class Boxes:
    """Objects from above: corners [N, 4, 2], counter-clockwise."""

    corners: np.ndarray

    @classmethod
    def of(cls, objects: tuple[SceneObject, ...]) -> Boxes:
        """Return the boxes of objects."""
        return cls(np.array([scene_object.corners_m() for scene_object in objects]).reshape(-1, 4, 2))

    @classmethod
    def at(cls, spot: np.ndarray, yaw_deg: np.ndarray, length_m: float, width_m: float) -> Boxes:
        """Return the boxes of one size at N spots [N, 2] and headings [N]."""
        along = np.column_stack([np.cos(np.radians(yaw_deg)), np.sin(np.radians(yaw_deg))])
        across = np.column_stack([-along[:, 1], along[:, 0]])
        signs = np.array([[1.0, 1.0], [-1.0, 1.0], [-1.0, -1.0], [1.0, -1.0]])
        half = 0.5 * np.array([length_m, width_m])
        return cls(spot[:, None] + signs[:, :1] * half[0] * along[:, None] + signs[:, 1:] * half[1] * across[:, None])

    @property
    def faces(self) -> tuple[np.ndarray, np.ndarray]:
        """Ends of all faces, [4 N, 2] each."""
        return self.corners.reshape(-1, 2), np.roll(self.corners, -1, axis=1).reshape(-1, 2)

    def contain(self, points: np.ndarray) -> np.ndarray:
        """Return which boxes hold which points [P, 2]; [N, P]."""
        edge = np.roll(self.corners, -1, axis=1) - self.corners  # [N, 4, 2]
        offset = points[None, :, None] - self.corners[:, None]  # [N, P, 4, 2]
        return (edge[:, None, :, 0] * offset[..., 1] - edge[:, None, :, 1] * offset[..., 0] >= 0.0).all(axis=-1)

    def crossed_by(self, a: np.ndarray, b: np.ndarray) -> np.ndarray:
        """Return which boxes have segments a -> b [M, 2] through or in them; [N]."""
        if not len(a) or not len(self.corners):
            return np.zeros(len(self.corners), bool)
        start, end = self.faces
        through = crosses(start, end, a, b).any(axis=1).reshape(-1, 4).any(axis=1)
        return np.asarray(through | self.contain(a).any(axis=1))


@dataclass(frozen=True)
class Images:
    """Mirror images of spots: P pairs of a spot's index and its specular point."""

    spot: np.ndarray
    specular: np.ndarray
    range_m: np.ndarray


def chords(surface: Surface) -> np.ndarray:
    """Return a wall's points, [N, 2], with arcs cut into chords."""
    points = np.array(surface.polyline_m, np.float64).reshape(-1, 2)
    if surface.curvature_per_m == 0.0:
        return points
    share = np.linspace(0.0, 1.0, CHORDS + 1)[1:]
    return np.concatenate(
        [points[:1], *(arc_points(a, b, surface.curvature_per_m, share) for a, b in pairwise(points))]
    )


def hidden(points: np.ndarray, walls: Walls, boxes: Boxes) -> np.ndarray:
    """Return which points [N, 2] the radar cannot see past opaque walls and other road users."""
    start, end = boxes.faces
    a, b = np.concatenate([walls.a[walls.hides], start]), np.concatenate([walls.b[walls.hides], end])
    return blocked(ORIGIN, points, a, b)


def clear(start: np.ndarray, end: np.ndarray, walls: Walls, boxes: Boxes) -> np.ndarray:
    """Return which segments [N] are free."""
    face_a, face_b = boxes.faces
    return ~blocked(start, end, np.concatenate([walls.a, face_a]), np.concatenate([walls.b, face_b]))


def images(spot: np.ndarray, walls: Walls, boxes: Boxes, widest_rad: float, range_m: tuple[float, float]) -> Images:
    """Return the mirror images of spots [N, 2] that the radar sees: both segments free, within its range and angle."""
    a, b = walls.a[walls.mirrors], walls.b[walls.mirrors]
    along = b - a
    along = along / np.hypot(*along.T)[:, None]
    normal = np.column_stack([-along[:, 1], along[:, 0]])
    offset = -(normal * a).sum(axis=1)
    side = np.where(offset < 0.0, -1.0, 1.0)
    normal, offset = side[:, None] * normal, side * offset  # the radar's height over each wall is its offset
    height = spot @ normal.T + offset  # [N, W]
    foot, radar_foot = spot @ along.T - (along * a).sum(axis=1), -(along * a).sum(axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        along_wall = (radar_foot * height + foot * offset) / (height + offset)
        shown = (height > 1e-3) & (offset > 1e-3) & (along_wall >= 0.0) & (along_wall <= np.hypot(*(b - a).T))
    index, wall = np.nonzero(shown)
    image = spot[index] - 2.0 * height[index, wall, None] * normal[wall]
    specular = a[wall] + along_wall[index, wall, None] * along[wall]
    distance = np.hypot(*image.T)
    good = (np.abs(np.arctan2(image[:, 1], image[:, 0])) < widest_rad) & (image[:, 0] > 0.0)
    good &= (distance > range_m[0]) & (distance < range_m[1])
    index, specular, distance = index[good], specular[good], distance[good]
    free = clear(np.broadcast_to(ORIGIN, specular.shape), specular, walls, boxes)
    index, specular, distance = index[free], specular[free], distance[free]
    free = clear(specular, spot[index], walls, boxes)
    return Images(index[free], specular[free], distance[free])


def indoors(points: np.ndarray, rings: tuple[np.ndarray, ...]) -> np.ndarray:
    """Return which points [N, 2] lie within a ring of points (a building, a container), by counting crossings; [N]."""
    inside = np.zeros(len(points), bool)
    far = points + np.array([1e4, 137.0])
    for ring in rings:
        inside |= crosses(points, far, ring, np.roll(ring, -1, axis=0)).sum(axis=1) % 2 == 1
    return inside
