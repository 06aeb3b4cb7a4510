"""Registration on clouds of a known street: the true pose comes back, and what cannot be registered is refused."""

from __future__ import annotations

import builtins
import math
from typing import Any

import numpy as np
import pytest

from benchmarks.perception.annotation import pose_error
from contrib.annotate.registration import (
    PosedCloud,
    RegistrationParams,
    import_open3d,
    looked_through,
    moved,
    plane_hold,
    register,
    rounded_pose,
)
from contrib.annotate.simulated_clouds import LidarParams, Viewpoint, lidar_cloud, rigid
from sim_player.scene.description import Scene, scene_from_yaml

PARAMS = RegistrationParams()
LIDAR = LidarParams(channels=48, azimuths=600)
CROSSING = """
name: crossing
surfaces:
  - {role: relay, material: concrete, polyline_m: [[22.0, -10.0], [22.0, 16.0]], height_m: 8.0}
  - {role: occluder, material: brick, polyline_m: [[1.0, 3.5], [8.0, 3.5], [8.0, 20.0]], height_m: 6.0}
objects:
  - {class: car, x_m: 14.0, y_m: 9.3, yaw_deg: -70.0}
"""
CORRIDOR = """
name: corridor
surfaces:
  - {role: relay, material: concrete, polyline_m: [[-300, 5], [300, 5]], height_m: 6}
  - {role: relay, material: concrete, polyline_m: [[-300, -5], [300, -5]], height_m: 6}
"""


def two_clouds(scene: Scene, other: Viewpoint) -> tuple[PosedCloud, np.ndarray, np.ndarray]:
    """The radar's own cloud in its place; another viewpoint's points and true pose."""
    first = lidar_cloud(scene, Viewpoint(x_m=0.0, y_m=0.0), LIDAR, 0)
    second = lidar_cloud(scene, other, LIDAR, 1)
    return PosedCloud(first.points_m, first.radar_from_lidar), second.points_m, second.radar_from_lidar


@pytest.mark.slow
@pytest.mark.parametrize("known", [True, False])
def test_pose_comes_back(known: bool) -> None:
    """Layout: a crossing seen from (0, 0) and (9, -3), 2 cm of range noise; first pose off by 0.5 m and 4 degrees, or
    none at all. Tolerance 2 cm and 0.15 degrees: voxels of 0.2 m over some thousand planes."""
    placed, points_m, truth = two_clouds(scene_from_yaml(CROSSING), Viewpoint(x_m=9.0, y_m=-3.0, yaw_deg=30.0))
    first = truth @ rigid((0.4, -0.3, 0.1), 0.0, 0.0, math.radians(4.0)) if known else None
    found = register(points_m, [placed], first, seed=0)
    away_m, turned_rad = pose_error(truth, found.target_from_source)
    assert found.fault(PARAMS) is None
    assert away_m <= 0.02
    assert math.degrees(turned_rad) <= 0.15
    assert found.start == ("given" if known else "global")


@pytest.mark.slow
def test_same_input_gives_the_same_bytes() -> None:
    placed, points_m, truth = two_clouds(scene_from_yaml(CROSSING), Viewpoint(x_m=9.0, y_m=-3.0))
    poses = {register(points_m, [placed], truth, seed=0).target_from_source.tobytes() for _ in range(2)}
    assert len(poses) == 1


@pytest.mark.slow
def test_a_corridor_is_refused_for_it_slides() -> None:
    """Two endless walls: partners for nearly all points, a residual of the noise, and yet the pose may lie anywhere
    along x. The refusal names the direction."""
    placed, points_m, truth = two_clouds(scene_from_yaml(CORRIDOR), Viewpoint(x_m=4.0, y_m=1.0))
    found = register(points_m, [placed], truth)
    assert found.fitness > 0.8
    assert found.rmse_m < 0.03
    assert "slides along (1.00" in (found.fault(PARAMS) or "")


@pytest.mark.slow
def test_clouds_of_different_places_are_refused() -> None:
    placed, _, _ = two_clouds(scene_from_yaml(CROSSING), Viewpoint(x_m=0.0, y_m=0.0))
    elsewhere = lidar_cloud(scene_from_yaml(CORRIDOR), Viewpoint(x_m=0.0, y_m=0.0), LIDAR, 3)
    found = register(elsewhere.points_m, [placed], np.eye(4))
    assert found.fault(PARAMS) is not None


def test_a_pose_that_stands_in_another_view_is_in_conflict() -> None:
    """A wall 10 m away seen from the origin: a point at 5 m was looked through, one at 9.8 m or behind was not, and
    where nothing was seen nothing is said."""
    y, z = np.meshgrid(np.linspace(-8.0, 8.0, 300), np.linspace(-3.0, 3.0, 100))
    wall = np.stack([np.full(y.size, 10.0), y.ravel(), z.ravel()], axis=1)
    points = np.array([[5.0, 0.0, 0.0], [9.8, 0.0, 0.0], [14.0, 0.0, 0.0], [-5.0, 0.0, 0.0]])
    assert looked_through(points, wall).tolist() == [True, False, False, False]


def test_hold_of_three_planes_is_known() -> None:
    """Analytic: equal numbers of points on planes across x, y and z, all at their common centre, resist each slide with
    the mean of n n' = 1/3; at the centre no turn is resisted."""
    normals = np.tile(np.eye(3), (40, 1))
    hold = plane_hold(np.zeros((120, 3)), normals)
    assert hold.eigenvalues == pytest.approx([0.0, 0.0, 0.0, 1 / 3, 1 / 3, 1 / 3], abs=1e-12)
    assert hold.weakest.startswith("turns about")


def box_faces(faces: str, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Points [N, 3] with normals on faces of a room 6 m x 10 m x 3 m: "x", "y", "z" one each, "X", "Y" both."""
    rng = np.random.default_rng(seed)
    half_m = np.array([3.0, 5.0, 1.5])
    points, normals = [], []
    for face in faces:
        axis = "xyz".index(face.lower())
        for side in (1.0, -1.0) if face.isupper() else (-1.0,):
            place = rng.uniform(-half_m, half_m, (4000, 3))
            place[:, axis] = side * half_m[axis]
            points.append(place)
            normals.append(np.tile(np.eye(3)[axis], (4000, 1)))
    return np.concatenate(points), np.concatenate(normals)


@pytest.mark.parametrize(
    ("faces", "unknown"),
    [
        ("z", ("slides", "slides", "turns about (0.00, 0.00, 1.00)")),
        ("Xz", ("slides along (0.00, 1.00, 0.00)",)),
        ("XYz", ()),
    ],
)
def test_unknown_motions_of_plane_corridor_and_room(faces: str, unknown: tuple[str, ...]) -> None:
    """Analytic: a plane leaves two slides in it and the turn about its normal, a corridor its length, a room nothing.
    The free motions of a plane are parted into pure slides, which are level, and a pure turn."""
    free = plane_hold(*box_faces(faces)).unknown(PARAMS.min_hold)
    assert len(free) == len(unknown)
    for said, rule in zip(free, unknown, strict=True):
        assert said.startswith(rule)
    assert all("0.00)" in said for said in free if said.startswith("slides"))


@pytest.mark.slow
@pytest.mark.parametrize(("faces", "said"), [("z", "3 of 6 motions are unknown"), ("Xz", "1 of 6"), ("XYz", None)])
def test_clouds_that_leave_motions_unknown_are_refused(faces: str, said: str | None) -> None:
    """The same rooms as clouds of 1 cm of noise from two places 0.4 m apart: three unknown, one unknown, placed. In the
    room tolerance 2 cm and 0.2 deg."""
    truth = rigid((0.4, 0.1, 0.0), 0.0, 0.0, 0.05)
    target_m = box_faces(faces, 1)[0] + np.random.default_rng(2).normal(0.0, 0.01, (len(box_faces(faces)[0]), 3))
    source_m = moved(np.linalg.inv(truth), box_faces(faces, 3)[0])
    found = register(source_m, [PosedCloud(target_m, np.eye(4))], np.eye(4))
    if said is not None:
        assert said in (found.fault(PARAMS) or "")
        return
    assert found.fault(PARAMS) is None
    away_m, turned_rad = pose_error(truth, found.target_from_source)
    assert away_m <= 0.02
    assert math.degrees(turned_rad) <= 0.2


def test_clouds_without_overlap_are_refused() -> None:
    room_m = box_faces("XYz")[0]
    found = register(room_m, [PosedCloud(room_m, np.eye(4))], rigid((60.0, 0.0, 0.0), 0.0, 0.0, 0.0))
    assert "overlap must be at least 0.3 (registration.min_fitness), got 0.000" in (found.fault(PARAMS) or "")


@pytest.mark.parametrize("bad", [np.zeros((0, 2)), np.full((100, 3), np.nan), np.full((100, 3), np.inf)])
def test_arrays_that_are_no_points_are_refused(bad: np.ndarray) -> None:
    room_m = box_faces("XYz")[0]
    with pytest.raises(ValueError, match="source must be finite points of shape"):
        register(bad, [PosedCloud(room_m, np.eye(4))], np.eye(4))
    with pytest.raises(ValueError, match="target must be finite points of shape"):
        register(room_m, [PosedCloud(bad, np.eye(4))], np.eye(4))


def test_rounding_keeps_a_pose_rigid() -> None:
    pose = rigid((1.23456789, -2.0, 0.5), 0.1, -0.2, 2.5)
    kept = rounded_pose(pose)
    assert kept[:3, :3] @ kept[:3, :3].T == pytest.approx(np.eye(3), abs=1e-14)
    away_m, turned_rad = pose_error(pose, kept)
    assert away_m < 1e-6
    assert turned_rad < 2e-6


def test_a_pose_error_is_the_turn_and_the_way() -> None:
    """A turn of 90 degrees and a step of 5 m, and half a turn, whose sine is zero."""
    assert pose_error(np.eye(4), rigid((3.0, 4.0, 0.0), 0.0, 0.0, math.pi / 2)) == pytest.approx((5.0, math.pi / 2))
    assert pose_error(np.eye(4), rigid((0.0, 0.0, 0.0), 0.0, 0.0, math.pi))[1] == pytest.approx(math.pi)
    assert moved(rigid((1.0, 0.0, 0.0), 0.0, 0.0, math.pi / 2), np.array([[1.0, 0.0, 0.0]])) == pytest.approx(
        np.array([[1.0, 1.0, 0.0]])
    )


def test_too_few_points_are_refused() -> None:
    placed = PosedCloud(np.random.default_rng(0).normal(size=(30, 3)), np.eye(4))
    with pytest.raises(ValueError, match="at least 50 points on planes, got 30"):
        register(placed.points_m * 10.0, [placed], np.eye(4))


@pytest.mark.parametrize(
    ("error", "said"),
    [
        (ModuleNotFoundError("No module named 'open3d'"), "pip install open3d-cpu"),
        (OSError("libGL.so.1: cannot open shared object file"), "libGL.so.1.*apt-get install libgl1"),
    ],
)
def test_a_missing_library_is_named(monkeypatch: pytest.MonkeyPatch, error: Exception, said: str) -> None:
    real = builtins.__import__

    def refusing(name: str, *rest: Any, **named: Any) -> Any:
        if name == "open3d":
            raise error
        return real(name, *rest, **named)

    monkeypatch.setattr(builtins, "__import__", refusing)
    with pytest.raises(ImportError, match=said):
        import_open3d()
