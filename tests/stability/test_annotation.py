"""Hard cases of annotation: registrations that look good and are not, grazing sight, half a turn."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from benchmarks.perception.annotation import pose_error
from contrib.annotate.clouds import read_cloud
from contrib.annotate.registration import import_open3d, looked_through, planar_cloud, plane_hold
from contrib.annotate.simulated_clouds import LidarParams, Viewpoint, lidar_cloud, rigid
from contrib.annotate.slice_labels import in_sight
from sim_player.scene.description import scene_from_yaml
from tests.stability.catalogue import Errors

CORRIDOR = """
name: corridor
surfaces:
  - {role: relay, material: concrete, polyline_m: [[-300, 5], [300, 5]], height_m: 6}
  - {role: relay, material: concrete, polyline_m: [[-300, -5], [300, -5]], height_m: 6}
"""


@pytest.mark.hard("contrib.annotate.registration.plane_hold", "open3d's information matrix, which knows no normals",
                  0.01, "of a unit slide resisted", "registration.min_hold; the truth is 0")  # fmt: skip
def test_a_corridor_holds_nothing_along_itself(errors: Errors) -> None:
    """Two endless walls and a road: a cloud fits anywhere along them, with full overlap and no residual but noise."""
    cloud = lidar_cloud(
        scene_from_yaml(CORRIDOR), Viewpoint(x_m=0.0, y_m=0.0), LidarParams(channels=48, azimuths=600), 0
    )
    planes = planar_cloud(cloud.points_m, 0.2)
    information = import_open3d().pipelines.registration.get_information_matrix_from_point_clouds(
        planes, planes, 0.4, np.eye(4)
    )
    # of points: a slide along x is resisted by all of them alike
    naive = float(information[3, 3]) / len(planes.points)
    errors(naive=naive, ours=plane_hold(np.asarray(planes.points), np.asarray(planes.normals)).least)


@pytest.mark.hard("benchmarks.perception.annotation.pose_error", "arc cosine of the trace", 1e-12, "rad",
                  "rounding of a rotation's entries")  # fmt: skip
def test_two_poses_that_are_nearly_one(errors: Errors) -> None:
    """A turn of 1e-9 rad: its cosine is 1 in float64."""
    turned = rigid((0.0, 0.0, 0.0), 0.0, 0.0, 1e-9)
    naive = math.acos(min(max(0.5 * (float(np.trace(turned[:3, :3])) - 1.0), -1.0), 1.0))
    errors(naive=abs(naive - 1e-9), ours=abs(pose_error(np.eye(4), turned)[1] - 1e-9))


@pytest.mark.hard("contrib.annotate.slice_labels.in_sight", "own wall in the way like any other", 0.0, "of 400 points",
                  "a straight wall hides nothing of itself")  # fmt: skip
def test_a_wall_seen_edge_on(errors: Errors) -> None:
    """A wall along the line of sight, 0.3 m off it, 60 m long, 2 cm of noise: every other point lies behind its fit."""
    rng = np.random.default_rng(0)
    points_m = np.column_stack([np.linspace(5.0, 60.0, 400), 0.3 + rng.normal(0.0, 0.02, 400)])
    walls_m, edges_m = np.array([[[4.0, 0.3], [61.0, 0.3]]]), np.zeros((0, 2, 2))
    origin_m = np.zeros_like(points_m)
    lost = [
        int(np.count_nonzero(~in_sight(origin_m, points_m, np.full(400, own), walls_m, edges_m))) for own in (-1, 0)
    ]
    errors(naive=lost[0], ours=lost[1])


@pytest.mark.hard("contrib.annotate.registration.Hold.unknown", "axis of the smallest eigenvalue", 0.0,
                  "unknown motions not named", "a plane leaves two slides and a turn")  # fmt: skip
def test_a_flat_cloud(errors: Errors) -> None:
    """A bare yard, level within rounding: three motions are free, and their eigenvectors are any mixture of them."""
    rng = np.random.default_rng(9)
    points_m = np.column_stack([rng.uniform(-30.0, 30.0, (4000, 2)), rng.normal(0.0, 1e-9, 4000)])
    hold = plane_hold(points_m, np.tile([0.0, 0.0, 1.0], (4000, 1)))
    named = {said.split(" (")[0] for said in hold.unknown(0.01)}
    assert named == {"slides along", "turns about"}
    errors(naive=float(3 - len([hold.weakest])), ours=float(3 - len(hold.unknown(0.01))))


@pytest.mark.hard("contrib.annotate.clouds.read_cloud", "zeros taken for points at the sensor", 0.003,
                  "of the points in conflict", "registration.max_conflict")  # fmt: skip
def test_pulses_without_echo(errors: Errors, tmp_path: Path) -> None:
    """Open sky: 7 % of a scanner's pulses come back as (0, 0, 0), and every other viewpoint looked through there."""
    rng = np.random.default_rng(10)
    azimuth = rng.uniform(-np.pi, np.pi, 20_000)
    walls_m = np.column_stack([12.0 * np.cos(azimuth), 12.0 * np.sin(azimuth), rng.uniform(-1.5, 3.0, 20_000)])
    cloud_m = np.concatenate([walls_m, np.zeros((1_500, 3))])
    np.save(tmp_path / "a.npy", cloud_m)
    # the other viewpoint stands 3 m aside
    shift_m, other_m = np.array([3.0, 0.0, 0.0]), walls_m - [3.0, 0.0, 0.0]
    shares = [
        looked_through(points - shift_m, other_m).mean() for points in (cloud_m, read_cloud(tmp_path / "a.npy")[0])
    ]
    errors(naive=float(shares[0]), ours=float(shares[1]))
