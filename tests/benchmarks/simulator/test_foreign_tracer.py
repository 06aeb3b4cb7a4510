"""The short form of `benchmarks.simulator.foreign_tracer` (docs/results/foreign-tracer.md); how it finds reasons."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.simulator.foreign_tracer import AMPLITUDE_AIM_DB, LENGTH_AIM_M, compare_scene, main, page
from benchmarks.simulator.path_comparison import (
    EDGE,
    UNEXPLAINED,
    Comparison,
    Place,
    compare,
    edge_distance_m,
    join_comparisons,
    mesh_blocker,
    our_routes,
    route_vertices,
)
from lab.foreign.export import SurfaceKind, clear_of_bodies, exported_surfaces
from lab.foreign.one_way import OneWayPaths
from sim_player.generate.places import random_place
from sim_player.scene.description import Scene, SceneObject, Surface
from sim_player.scene.world import prepare, snapshot
from tests.lab.foreign.requirements import require_sionna

SCENE = Scene(
    name="reasons",
    surfaces=(
        Surface(role="relay", material="brick", polyline_m=((12.0, -8.0), (12.0, 9.8)), thickness_mm=300.0),
        Surface(role="relay", material="glass", polyline_m=((14.0, 10.0), (-6.0, 10.0)), thickness_mm=8.0),
        Surface(role="ground", material="asphalt"),
    ),
    objects=(SceneObject(class_="pedestrian", x_m=6.0, y_m=4.0),),
)


@pytest.fixture(scope="module")
def place() -> Place:
    """Our own routes and the same paths in the foreign form."""
    world = clear_of_bodies(prepare(SCENE))
    view, surfaces = snapshot(world), exported_surfaces(world)
    ours = our_routes(view)
    return Place(view, surfaces, ours, as_foreign(view, ours))


def as_foreign(view, routes) -> OneWayPaths:  # type: ignore[no-untyped-def]
    surface, vertex_m = np.full((len(routes), 2), -1, np.int32), np.zeros((len(routes), 2, 3))
    ground = len(view.world.wall_a) + 1
    for row in range(len(routes)):
        bounces = route_vertices(view, routes.take(np.array([row])))[1:-1]
        vertex_m[row, : len(bounces)] = bounces
        walls = [int(wall) for wall in (routes.wall[row], routes.wall2[row]) if wall >= 0]
        surface[row, : len(bounces)] = [ground if abs(bounce[2]) < 1e-9 else walls.pop(0) for bounce in bounces]
    return OneWayPaths(routes.target, routes.length_m, routes.depart, routes.arrive, routes.whole, surface, vertex_m)


def no_second_look(source_m: np.ndarray, point_m: np.ndarray) -> OneWayPaths:
    none = np.zeros((0, 3))
    return OneWayPaths(
        np.zeros(0, np.int32), np.zeros(0), none, none, np.zeros(0, complex), np.zeros((0, 2), int), np.zeros((0, 2, 3))
    )


def test_the_same_paths_have_no_differences(place: Place) -> None:
    same = compare(place, no_second_look)
    assert len(same.group) == len(place.ours)
    assert {"direct", "one wall", "two walls", "ground", "wall and ground", "own image, one wall"} <= set(same.group)
    assert (same.missing, same.extra) == ((), ())
    assert max(np.abs(column).max() for column in (same.length_m, same.depart_rad, same.amplitude_db)) < 1e-12


def test_a_path_that_only_ours_has_is_missing(place: Place) -> None:
    """Found for itself alone, or from its other end, else unexplained: nothing hides it and no edge is near."""
    index = int(np.flatnonzero((place.ours.wall2 >= 0) & (place.ours.target < place.own))[0])
    fewer = replace(place, foreign=place.foreign.take(np.arange(len(place.ours)) != index))
    lost = compare(fewer, no_second_look).missing
    assert [(path.group, path.reason) for path in lost] == [("two walls", UNEXPLAINED)]
    alone = replace(place.foreign.take(np.array([index])), target=np.zeros(1, np.int32))
    back = replace(alone, surface=alone.surface[:, ::-1])
    assert "point alone" in compare(fewer, lambda source_m, point_m: alone).missing[0].reason
    assert "ends exchanged" in compare(fewer, lambda source_m, point_m: back).missing[0].reason


def test_a_path_that_only_the_foreign_tracer_has_is_extra(place: Place) -> None:
    """By an object's face; free but unknown to ours; the level of a copy is that of the path beside it."""
    in_sight = np.isin(place.ours.target, place.ours.target[(place.ours.wall < 0) & ~place.ours.ground])
    single = (place.ours.wall >= 0) & (place.ours.wall2 < 0) & ~place.ours.ground
    index = int(np.flatnonzero(in_sight & single)[0])
    by_object = replace(
        place.foreign, surface=np.where(np.arange(len(place.ours))[:, None] == index, [2, -1], place.foreign.surface)
    )
    twice = np.append(np.arange(len(place.ours)), index)
    result = compare(replace(place, foreign=by_object), no_second_look)
    assert [path.group for path in result.extra] == ["object"]
    assert "own object" in result.extra[0].reason
    result = compare(replace(place, foreign=place.foreign.take(twice)), no_second_look)
    assert [(path.group, path.reason) for path in result.extra] == [("one wall", UNEXPLAINED)]
    assert -40.0 < result.extra[0].level_db < 0.0


def test_a_blocker_and_an_edge_are_found(place: Place) -> None:
    """Through the box, over it, and past the end of the first wall at (12, 9.8) by half a millimetre."""
    low, high = np.array([[0.0, 4.0, 1.0], [11.0, 4.0, 1.0]]), np.array([[0.0, 4.0, 2.0], [11.0, 4.0, 2.0]])
    assert mesh_blocker(place.surfaces, low) == SurfaceKind.OBJECT
    assert mesh_blocker(place.surfaces, high) is None
    assert mesh_blocker(place.surfaces, low + np.array([0.0, 3.0, 0.0])) is None
    past = np.array([[11.0, 9.8005, 1.0], [13.0, 9.8005, 1.0]])
    assert edge_distance_m(place.surfaces, past) == pytest.approx(5e-4, rel=1e-9)
    assert edge_distance_m(place.surfaces, high) == pytest.approx(0.25, rel=1e-9)


def test_a_page_says_what_was_counted(place: Place, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("benchmarks.simulator.foreign_tracer.foreign_versions", dict)
    index = int(np.flatnonzero(place.ours.target == place.own)[0])
    fewer = replace(place, foreign=place.foreign.take(np.arange(len(place.ours)) != index))
    text = page(compare(fewer, no_second_look), "command", 1, 5)
    assert f"| all | {len(place.ours) - 1} | 1 | 0 |" in text
    assert "Paths without a reason: 1." in text


def test_without_the_foreign_tracer_it_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(__import__("sys").modules, "drjit", None)
    monkeypatch.setattr("sys.argv", ["foreign_tracer", "--places", "1"])
    with pytest.raises(SystemExit, match="foreign_tracer: the foreign tracer needs the module drjit"):
        main()


@pytest.mark.slow
def test_two_places_agree() -> None:
    """Places 1 and 8 of seed 21: every common path within the aims, every other one with a reason.

    No path is missing but where rounding decides, or the foreign tracer's table of candidates lost it.
    """
    require_sionna()
    parts = [compare_scene(random_place(21, index), samples=100_000) for index in (1, 8)]
    result: Comparison = join_comparisons(parts)
    assert {"direct", "one wall", "two walls", "ground", "wall and ground"} <= set(result.group)
    assert np.abs(result.length_m).max() < LENGTH_AIM_M
    assert max(result.depart_rad.max(), result.arrive_rad.max()) < 1e-4
    assert np.nanmax(np.abs(result.amplitude_db)) < AMPLITUDE_AIM_DB
    assert UNEXPLAINED not in {path.reason for path in (*result.missing, *result.extra)}
    assert all(path.reason == EDGE or "table of candidates" in path.reason for path in result.missing)
    assert len(result.missing) < 0.01 * len(result.group)
