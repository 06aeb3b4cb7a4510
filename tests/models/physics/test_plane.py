"""Distances in the plane, by hand."""

from __future__ import annotations

import numpy as np

from models.physics.plane import segment_distance_m


def test_distance_is_to_the_foot_within_the_segment_else_to_the_nearer_end() -> None:
    """From (0, 0) to (4, 0): above it, before its begin and past its end; and a segment that is a point."""
    a, b = np.array([[0.0, 0.0], [1.0, 1.0]]), np.array([[4.0, 0.0], [1.0, 1.0]])
    points_m = np.array([[1.0, 3.0], [-3.0, 4.0], [7.0, -4.0]])
    wanted = [[3.0, 2.0], [5.0, 5.0], [5.0, np.hypot(6.0, 5.0)]]
    np.testing.assert_allclose(segment_distance_m(points_m, a, b), wanted)
