"""Outbound vertices of paths: where a ray leaves, bounces and ends."""

from __future__ import annotations

import math

import numpy as np

from msgs.values.perception import PathClass
from sim_player.paths.ray_tracing import trace
from sim_player.paths.vertices import outbound_vertices
from sim_player.scene.description import Scene, SceneObject, Surface
from sim_player.scene.world import prepare


def test_a_ray_bounces_on_the_wall_by_the_law_of_reflection() -> None:
    """Layout: metal wall at an angle, a car. Analytic: the bounce lies on the wall, angles are equal, and the segments
    add up to half the echo's length. Tolerance 1e-9 m: rounding.
    """
    a, b = (16.0, -9.0), (23.0, 12.0)
    world = prepare(
        Scene(
            name="t",
            surfaces=(Surface(role="relay", material="metal", polyline_m=(a, b), height_m=5.0),),
            objects=(SceneObject(class_="car", x_m=6.0, y_m=9.0, yaw_deg=40.0),),
        )
    )
    paths = trace(world)
    paths = paths.take((paths.kind == PathClass.MIRRORED) & (paths.order == 1))
    assert len(paths) > 10
    vertices = np.array(outbound_vertices(world, paths))
    assert vertices.shape[1:] == (3, 3)
    normal = np.array([b[1] - a[1], a[0] - b[0]]) / math.dist(a, b)
    np.testing.assert_allclose(vertices[:, 0], 0.0, atol=1e-9)
    np.testing.assert_allclose((vertices[:, 1, :2] - a) @ normal, 0.0, atol=1e-9)
    segments = np.diff(vertices, axis=1)
    segment_m = np.linalg.norm(segments, axis=2)
    np.testing.assert_allclose(segment_m.sum(axis=1), 0.5 * paths.length_m, atol=1e-9)
    cosine = segments[:, :, :2] @ normal / segment_m
    np.testing.assert_allclose(cosine[:, 0], -cosine[:, 1], atol=1e-9)
