"""Scenes as triangles against their own dimensions."""

from __future__ import annotations

import math

import numpy as np
import pytest

from lab.foreign.export import (
    ARC_ERROR_M,
    STAND_OFF_M,
    ExportedSurface,
    SurfaceKind,
    clear_of_bodies,
    exported_surfaces,
)
from models.physics.materials import permittivity
from sim_player.scene.description import Scene, SceneObject, Surface
from sim_player.scene.world import World, prepare

CONCRETE = Surface(
    role="relay",
    material="concrete",
    polyline_m=((10.0, -5.0), (10.0, 5.0), (4.0, 5.0)),
    height_m=4.0,
    thickness_mm=200,
)
ARC = Surface(role="relay", material="glass", polyline_m=((20.0, -3.0), (20.0, 3.0)), curvature_per_m=0.1)
LAYERED = Surface(role="relay", material="double_glazing", polyline_m=((-10.0, -5.0), (-10.0, 5.0)))
HEDGE = Surface(role="occluder", material="hedge", polyline_m=((-20.0, -5.0), (-20.0, 5.0)))
GROUND = Surface(role="ground", material="asphalt")
CAR = SceneObject(class_="car", x_m=5.0, y_m=-8.0, yaw_deg=30.0, speed_mps=10.0)
PLATE = SceneObject(primitive="plate", size_m=(1.0, 2.0), x_m=5.0, y_m=8.0, z_m=0.5)


def world_of(*surfaces: Surface, objects: tuple[SceneObject, ...] = (CAR, PLATE)) -> World:
    return prepare(Scene(name="export", surfaces=surfaces, objects=objects))


def by_name(world: World, time_s: float = 0.0) -> dict[str, ExportedSurface]:
    return {surface.mesh.name: surface for surface in exported_surfaces(world, time_s)}


def test_a_wall_is_a_rectangle_with_its_slab() -> None:
    exported = by_name(world_of(CONCRETE))
    first, second = exported["wall_0"], exported["wall_1"]
    assert first.mesh.areas_m2.sum() == pytest.approx(10.0 * 4.0, rel=1e-12)
    assert second.mesh.areas_m2.sum() == pytest.approx(6.0 * 4.0, rel=1e-12)
    np.testing.assert_allclose(np.abs(first.mesh.normals @ [1.0, 0.0, 0.0]), 1.0)
    assert (first.kind, second.index, first.mesh.material) == (SurfaceKind.WALL, 1, "concrete")
    assert (first.thickness_m, first.layers) == (0.2, 1)
    assert first.permittivity == permittivity("concrete", 10e9)


def test_an_arc_is_followed_by_strips() -> None:
    """Corners lie on the circle of radius 10 m; no middle of a strip lies deeper than the stated error."""
    arc = by_name(world_of(ARC))["wall_0"]
    assert arc.curved
    plan = arc.mesh.vertices_m[: len(arc.mesh.vertices_m) // 2, :2]
    centre = np.array([20.0 - math.sqrt(100.0 - 9.0), 0.0])
    assert min(plan[:, 0]) == 20.0
    radius = np.linalg.norm(plan - centre, axis=1)
    np.testing.assert_allclose(radius, 10.0, rtol=1e-12)
    depth = 10.0 - np.linalg.norm(0.5 * (plan[1:] + plan[:-1]) - centre, axis=1)
    assert 0.2 * ARC_ERROR_M < depth.max() <= ARC_ERROR_M


def test_a_build_of_layers_says_so_and_foliage_is_left_out() -> None:
    exported = by_name(world_of(LAYERED, HEDGE))
    assert set(exported) == {"wall_0", "object_0", "object_1"}
    assert (exported["wall_0"].mesh.material, exported["wall_0"].thickness_m, exported["wall_0"].layers) == (
        "glass",
        4e-3,
        3,
    )


def test_objects_stand_where_they_are_at_a_time() -> None:
    exported = by_name(world_of(CONCRETE), time_s=0.5)
    car, plate = exported["object_0"], exported["object_1"]
    middle = 0.5 * (car.mesh.vertices_m.min(axis=0) + car.mesh.vertices_m.max(axis=0))
    shift = 5.0 * np.array([math.cos(math.radians(30.0)), math.sin(math.radians(30.0))])
    np.testing.assert_allclose(middle, [*(np.array([5.0, -8.0]) + shift), 0.75], atol=1e-12)
    assert car.mesh.areas_m2.sum() == pytest.approx(2.0 * (4.5 * 1.8 + 4.5 * 1.5 + 1.8 * 1.5), rel=1e-12)
    assert (car.thickness_m, car.kind) == (math.inf, SurfaceKind.OBJECT)
    assert plate.mesh.areas_m2.sum() == pytest.approx(2.0, rel=1e-12)
    np.testing.assert_allclose(plate.mesh.vertices_m[:, 2].min(), 0.5)


def test_the_ground_is_last_and_only_where_there_is_one() -> None:
    assert "ground" not in by_name(world_of(CONCRETE))
    ground = exported_surfaces(world_of(GROUND))[-1]
    assert (ground.kind, ground.index, ground.mesh.material) == (SurfaceKind.GROUND, -1, "asphalt")
    np.testing.assert_allclose(ground.mesh.normals, [[0.0, 0.0, 1.0]] * 2)


def test_centres_are_moved_out_of_their_box() -> None:
    """Every centre of a car's four faces ends `STAND_OFF_M` outside the box, corners on both sides."""
    world = world_of(CONCRETE, objects=(CAR,))
    moved = clear_of_bodies(world).centre_m - world.centre_m
    yaw = math.radians(30.0)
    own = world.centre_m[:, :2] - [5.0, -8.0]
    after = own + moved[:, :2]
    back = np.array([[math.cos(yaw), -math.sin(yaw)], [math.sin(yaw), math.cos(yaw)]])
    outside = np.abs(after @ back) - [2.25, 0.9]
    np.testing.assert_allclose(outside.max(axis=1), STAND_OFF_M, atol=1e-12)
    assert np.abs(moved[:, 2]).max() == 0.0
    assert not world.centre_object.any()
