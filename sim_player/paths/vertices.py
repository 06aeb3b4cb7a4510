"""Outbound vertices of a path, to draw or to check: antenna, bounces at walls, scatterer."""

from __future__ import annotations

import numpy as np

from models.physics.curved_mirror import arc_normals, arc_points
from models.physics.mirror import crossing_parameters
from sim_player.scene.world import World, radar_pose
from sim_player.trace.path_table import Paths

#: Number of chords of an arc in the ray search.
ARC_STEPS = 256
CLEARANCE_M = 1e-6


def outbound_vertices(world: World, paths: Paths) -> list[np.ndarray]:
    """Return the outbound vertices [N, 3] of every path (antenna, bounces, scatterer) in the radar's frame at start.

    Bends at edges and bounces on the ground are drawn straight.
    """
    a, b, normal = _pieces(world)
    back = radar_pose(world.scene, 0.0).inverse()
    a, b, normal = back.apply(a), back.apply(b), back.rotate(normal)
    return [_outbound_vertices(paths, index, a, b, normal) for index in range(len(paths))]


def _outbound_vertices(paths: Paths, index: int, a: np.ndarray, b: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """Return the outbound vertices of one path."""
    azimuth, elevation = paths.departure_azimuth_rad[index], paths.departure_elevation_rad[index]
    slope = np.tan(elevation)
    heading = np.array([np.cos(azimuth), np.sin(azimuth)])
    position, travelled_m, points = np.zeros(2), 0.0, [np.zeros(3)]
    end, outbound, least = paths.point_m[index], [np.zeros(3)], np.inf
    for bounce in range(int(paths.order[index]) + 1):
        # a non-reciprocal path may have fewer bounces out than back: the heading closest to the scatterer decides
        miss = _miss(position, heading, end[:2])
        if miss < least - 1e-6:
            outbound, least = list(points), miss
        along, wall = _next_wall(position, heading, a, b)
        if wall < 0 or bounce == paths.order[index]:
            break
        position, travelled_m = position + along * heading, travelled_m + along
        points.append(np.array([*position, travelled_m * slope]))
        heading = heading - 2.0 * (heading @ normal[wall]) * normal[wall]
    return np.array([*outbound, end])


def _miss(position: np.ndarray, heading: np.ndarray, target: np.ndarray) -> float:
    """Return the angle between a heading and the direction to a target."""
    to_target = target - position
    return float(abs(np.arctan2(heading[0] * to_target[1] - heading[1] * to_target[0], heading @ to_target)))


def _next_wall(position: np.ndarray, heading: np.ndarray, a: np.ndarray, b: np.ndarray) -> tuple[float, int]:
    """Return the distance to the first piece of wall ahead and its index; (inf, -1) for none."""
    if not len(a):
        return np.inf, -1
    along_ray, along_wall = crossing_parameters(position, (position + heading)[None], a, b)
    ahead = (along_ray[0] > CLEARANCE_M) & (along_wall[0] >= 0.0) & (along_wall[0] <= 1.0)
    distance = np.where(ahead, along_ray[0], np.inf)
    nearest = int(np.argmin(distance))
    return float(distance[nearest]), nearest if np.isfinite(distance[nearest]) else -1


def _pieces(world: World) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the ends [M, 2] and unit normals of all walls, arcs cut into short chords with the arc's own normals."""
    ends_a, ends_b, normals = [np.zeros((0, 2))], [np.zeros((0, 2))], [np.zeros((0, 2))]
    for wall in np.flatnonzero(world.is_mirror):
        start, end, curvature = world.wall_a[wall], world.wall_b[wall], float(world.wall_curvature_per_m[wall])
        share = np.linspace(0.0, 1.0, (ARC_STEPS if world.is_curved[wall] else 1) + 1)
        points = arc_points(start, end, curvature, share)
        ends_a.append(points[:-1])
        ends_b.append(points[1:])
        normals.append(arc_normals(start, end, curvature, 0.5 * (share[:-1] + share[1:])))
    return np.concatenate(ends_a), np.concatenate(ends_b), np.concatenate(normals)
