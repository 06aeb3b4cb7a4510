"""Walls of a scene as a map has them: exact ones where they stand, noisy ones with the errors that they state."""

from __future__ import annotations

import math

import numpy as np
import pytest

from msgs.values.environment import MAX_PRIOR_WALLS, WallPriors
from msgs.values.frames import Pose2
from sim_player.scene.description import Scene, Surface
from sim_player.scene.wall_priors import SAGITTA_M, MapErrors, scene_walls

WALL = {"role": "relay", "material": "concrete"}


def scene(*polylines: tuple[tuple[float, float], ...], **surface: object) -> Scene:
    surfaces = tuple(Surface(polyline_m=line, **WALL, **surface) for line in polylines)  # type: ignore[arg-type]
    return Scene(name="walls", surfaces=(*surfaces, Surface(role="ground", material="asphalt")))


def ends_of(walls: WallPriors) -> np.ndarray:
    return np.array([wall.ends_m for wall in walls.walls])


def test_exact_walls_stand_where_they_are() -> None:
    """Each piece of a polyline is one, the ground none."""
    walls = scene_walls(scene(((20.0, -5.0), (20.0, 5.0), (30.0, 5.0))), Pose2(), 7, seed=0)
    assert walls.stamp_ns == 7
    assert ends_of(walls).tolist() == [[[20.0, -5.0], [20.0, 5.0]], [[20.0, 5.0], [30.0, 5.0]]]


def test_walls_are_in_the_frame_of_the_vehicle() -> None:
    """10 m on and turned left by a right angle: what was ahead is on the right."""
    (wall,) = scene_walls(scene(((20.0, -5.0), (20.0, 5.0))), Pose2(10.0, 0.0, math.pi / 2), 0, seed=0).walls
    np.testing.assert_allclose(wall.ends_m, [(-5.0, -10.0), (5.0, -10.0)], atol=1e-12)


def test_noisy_walls_err_as_they_state() -> None:
    """2,000 walls of 10 m: standard deviations across, of directions and of ends within 10 %, a fifth missing (3 %)."""
    errors = MapErrors()
    across, turn, reach, missing = [], [], [], 0
    for seed in range(2000):
        walls = scene_walls(scene(((20.0, -5.0), (20.0, 5.0))), Pose2(), 0, seed, errors).walls
        missing += not walls
        for wall in walls:
            assert wall.offset_std_m == errors.offset_std_m
            (ax, ay), (bx, by) = wall.ends_m
            angle_rad = math.atan2(ax - bx, by - ay)
            turn.append(angle_rad)
            # the offset is that at the true middle, where the line crosses y = 0
            across.append(ax - ay * (bx - ax) / (by - ay) - 20.0)
            reach += [by - 5.0, ay + 5.0]
    assert np.std(across) == pytest.approx(errors.offset_std_m, rel=0.1)
    assert np.std(turn) == pytest.approx(errors.angle_std_rad, rel=0.1)
    assert np.std(reach) == pytest.approx(errors.end_std_m, rel=0.1)
    assert missing / 2000 == pytest.approx(errors.missing_share, abs=0.03)


def test_errors_belong_to_the_map_and_not_to_the_scan() -> None:
    """Seen from elsewhere the same wrong wall stands at the same place; another seed is another map."""
    street, pose = scene(((20.0, -5.0), (20.0, 5.0))), Pose2(3.0, -1.0, 0.4)
    here, there = (scene_walls(street, at, 0, 3, MapErrors(missing_share=0.0)) for at in (Pose2(), pose))
    np.testing.assert_allclose(pose.apply(ends_of(there)), ends_of(here), atol=1e-9)
    assert scene_walls(street, pose, 0, 3, MapErrors(missing_share=0.0)) == there
    assert ends_of(scene_walls(street, pose, 0, 4, MapErrors(missing_share=0.0))).tolist() != ends_of(there).tolist()


@pytest.mark.parametrize("curvature_per_m", [0.04, -0.04])
def test_chords_stand_for_an_arc(curvature_per_m: float) -> None:
    """Their ends lie on the circle, whose centre is left of the polyline where the curvature is positive, and no
    chord's middle is further than `SAGITTA_M` from it."""
    arc = scene(((20.0, -8.0), (20.0, 8.0)), curvature_per_m=curvature_per_m)
    ends_m = ends_of(scene_walls(arc, Pose2(), 0, seed=0))
    radius_m = 1.0 / abs(curvature_per_m)
    centre_m = np.array([20.0 - math.copysign(math.sqrt(radius_m**2 - 64.0), curvature_per_m), 0.0])
    np.testing.assert_allclose(np.linalg.norm(ends_m - centre_m, axis=-1), radius_m, rtol=1e-12)
    off_m = radius_m - np.linalg.norm(ends_m.mean(axis=1) - centre_m, axis=-1)
    assert 0.0 < off_m.max() <= SAGITTA_M * 1.01
    assert {(20.0, -8.0), (20.0, 8.0)} <= {tuple(np.round(end, 9)) for end in ends_m.reshape(-1, 2).tolist()}


def test_of_too_many_walls_the_nearest_are_sent() -> None:
    posts = scene(*(((float(x), 10.0), (float(x), 11.0)) for x in range(MAX_PRIOR_WALLS + 44)))
    ends_m = ends_of(scene_walls(posts, Pose2(), 0, seed=0))
    assert ends_m[..., 0].max() == MAX_PRIOR_WALLS - 1
