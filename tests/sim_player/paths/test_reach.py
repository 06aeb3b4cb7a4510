"""The part of a world that echoes reach: its paths are those of the whole world."""

from __future__ import annotations

import math
from dataclasses import replace

import msgspec
import numpy as np
import pytest

from benchmarks.simulator.city import CityKind, made_city
from msgs.values.frames import Pose2
from sim_player.effects.table import ALL_EFFECTS
from sim_player.generate.places import random_place
from sim_player.paths import reach
from sim_player.paths.conversion import as_paths
from sim_player.paths.path_tracks import PathTrack
from sim_player.paths.ray_tracing import trace, trace_echoes
from sim_player.paths.reach import reach_m, reachable_snapshot
from sim_player.paths.truth import best_power_mw
from sim_player.scene.description import Scene, SceneObject, Surface
from sim_player.scene.world import RadarState, World, prepare, scene_radar, snapshot
from sim_player.trace.effect_names import bit
from tests.sim_player.planner.law import change_db
from tests.sim_player.scene.same_paths import assert_same_paths, of_part, of_whole


@pytest.mark.slow
@pytest.mark.parametrize("index", range(3))
def test_drawn_places_keep_all_paths(index: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Arcs, hedges, low walls, glass and grounds are among them; the radar stands where the scene says, then beside."""
    monkeypatch.setattr(reach, "WHOLE_WALLS", 0)
    world = prepare(random_place(3, index), index)
    beside = RadarState(Pose2(1.0 - 0.2 * index, 0.1 * index, 0.05 * index), np.array([3.0, 0.5]))
    for time_s, radar in ((0.3, scene_radar(world.scene, 0.3)), (0.0, beside)):
        assert_same_paths(of_part(world, time_s, radar), of_whole(world, time_s, radar))


@pytest.mark.slow
@pytest.mark.parametrize(("kind", "seed"), [("terraced", 0), ("detached", 1)])
def test_cities_keep_all_paths_and_trace_less(kind: CityKind, seed: int) -> None:
    world = prepare(made_city(200, kind, seed=seed), seed)
    for x_m in (0.0, 31.7):
        radar = RadarState(Pose2(x_m, 0.4, 0.1), np.array([5.0, 0.0]))
        part = reachable_snapshot(world, 0.0, radar)
        # walls that may mirror what bends at an edge in sight are kept, hidden ones too
        assert len(part.world.wall_a) < 0.95 * len(world.wall_a)
        assert len(part.world.speck_m) < 0.6 * len(world.speck_m)
        assert_same_paths(trace_echoes(part, ALL_EFFECTS), of_whole(world, 0.0, radar))


def test_a_city_four_times_as_large_has_the_same_paths() -> None:
    """Of the detached houses' city what lies beyond the reach of 164 m adds nothing, neither paths nor walls, but
    for a flash. The walls' own scatterers are drawn for all walls of a scene together: their phases are other ones.
    """
    echoes, walls = [], []
    for count in (1200, 4800):
        view = reachable_snapshot(prepare(made_city(count, "detached", objects=4)))
        found = trace_echoes(view, ALL_EFFECTS)
        echoes.append(found.take(found.out_m + found.back_m <= 2.0 * reach_m(view.world.setup)))
        walls.append(np.setdiff1d(view.world.wall_id, view.distant))
        beyond = found.take(found.out_m + found.back_m > 2.0 * reach_m(view.world.setup))
        assert np.isin(beyond.surface, view.distant).all()
        assert len(view.blockers.a) < 1200
    assert np.array_equal(walls[0], walls[1])
    assert np.array_equal(echoes[0].chain, echoes[1].chain)
    assert np.array_equal(echoes[0].out_m, echoes[1].out_m)


def test_a_small_world_is_traced_whole() -> None:
    world = prepare(random_place(3, 0), 0)
    whole, view = snapshot(world, 0.2), reachable_snapshot(world, 0.2)
    assert view.world is world
    assert math.isinf(view.world.reach_m)
    assert np.array_equal(view.blockers.a, whole.blockers.a)
    assert np.array_equal(view.lit, np.tile([0.0, 1.0], (len(world.wall_a), 1)))


def test_what_walls_hide_stays_under_the_noise(monkeypatch: pytest.MonkeyPatch) -> None:
    """A car in a metal wall behind rows of brick walls, 0.24 m each: all paths stay, by its image through 4 rows too.
    Through 40 rows, under -60 dB, nothing is left of it in the whole world either.
    """
    monkeypatch.setattr(reach, "WHOLE_WALLS", 0)
    mirror = Surface(role="relay", material="metal", polyline_m=((5.0, 18.0), (40.0, 18.0)))
    car = SceneObject(class_="car", x_m=20.0, y_m=0.5)

    def through(rows: int) -> int:
        walls = tuple(
            Surface(
                role="occluder",
                material="brick",
                polyline_m=((x_m, -40.0), (x_m, 17.9)),
                thickness_mm=240.0,
                height_m=30.0,
            )
            for x_m in np.linspace(3.0, 9.0, rows).tolist()
        )
        world = prepare(Scene(name="rows", surfaces=(*walls, mirror), objects=(car,)))
        radar = scene_radar(world.scene, 0.0)
        part, whole = of_part(world, 0.0, radar), of_whole(world, 0.0, radar)
        assert_same_paths(part, whole)
        assert len(part) == len(whole)
        return int((whole.needs & np.uint32(bit("wall_transmission")) > 0).sum())

    assert through(4) > 0
    assert through(40) == 0


def test_paths_keep_their_numbers_while_the_radar_goes_from_square_to_square() -> None:
    """Between two instants half a second apart the radar drives 5 m into the next square: paths are carried on, not
    faded out and in. Of the echoes of walls at least half stay.
    """
    scene = made_city(600, "terraced", objects=3)
    world = prepare(msgspec.structs.replace(scene, ego=msgspec.structs.replace(scene.ego, speed_mps=1.0)))
    border_s = reach.SQUARE_M - 0.1
    before, after = trace(world, border_s), trace(world, border_s + 0.2)
    shared = np.intersect1d(before.chain, after.chain)
    assert len(shared) > 0.9 * len(before)
    track = PathTrack(lambda time_s: trace(world, time_s), 0.2)
    there = track.at(border_s)
    assert len(there) < 1.2 * len(before)


def test_an_object_beyond_reach_is_left_out_and_the_others_keep_their_numbers() -> None:
    scene = made_city(400, "detached", objects=6)
    far = SceneObject(class_="car", x_m=-900.0, y_m=0.0, speed_mps=10.0)
    world = prepare(msgspec.structs.replace(scene, objects=(far, *scene.objects)))
    view = reachable_snapshot(world)
    assert view.world.object_id.tolist() == [1, 2, 3, 4, 5, 6]
    assert 0 not in trace_echoes(view, ALL_EFFECTS).object_index
    # 80 s later it has come within reach
    assert 0 in reachable_snapshot(world, 80.0).world.object_id
    assert 0 in trace_echoes(reachable_snapshot(world, 85.0), ALL_EFFECTS).object_index


def test_a_part_holds_no_more_than_its_world() -> None:
    world = prepare(made_city(400, "detached"))
    view = reachable_snapshot(world)
    part = view.world
    assert np.array_equal(part.wall_a, world.wall_a[part.wall_id])
    assert np.array_equal(part.speck_m, world.speck_m[part.speck_id])
    assert np.array_equal(part.wall_id[part.speck_wall], world.speck_wall[part.speck_id])
    assert np.array_equal(part.centre_m, world.centre_m[part.centre_id])


@pytest.mark.parametrize(("kind", "yaw_rad"), [("terraced", 0.0), ("detached", 0.7), ("detached", -2.5)])
def test_what_lies_behind_the_antenna_has_no_power_and_all_else_stays(kind: CityKind, yaw_rad: float) -> None:
    """Of the paths ahead none is missing and none is another; those left out have no power in any beam."""
    world = prepare(made_city(200, kind))
    radar = RadarState(Pose2(0.3, -0.4, yaw_rad), np.array([5.0, 0.0]))
    whole, view = (reachable_snapshot(world, 0.0, radar, ahead_only) for ahead_only in (False, True))
    every, ahead = trace_echoes(whole, ALL_EFFECTS), trace_echoes(view, ALL_EFFECTS)
    kept = np.isin(every.chain, ahead.chain)
    assert_same_paths(ahead, every.take(kept))
    assert len(ahead) == kept.sum()
    paths = as_paths(whole, every, ALL_EFFECTS)
    assert (best_power_mw(world.setup, paths.take(~kept)) == 0.0).all()
    assert (best_power_mw(world.setup, paths.take(kept)) > 0.0).all()
    assert len(view.world.speck_m) < 0.8 * len(whole.world.speck_m)
    assert 0.1 < kept.mean() < 0.8


def test_of_a_small_world_nothing_is_left_out_behind() -> None:
    world = prepare(random_place(3, 0), 0)
    every, ahead = (trace_echoes(reachable_snapshot(world, ahead_only=flag), ALL_EFFECTS) for flag in (False, True))
    assert np.array_equal(every.rows, ahead.rows)


def test_pairs_of_walls_that_do_not_see_each_other_have_no_paths() -> None:
    """By what is seen in each mirror, or by all pairs of walls: the same echoes to the bit."""
    view = reachable_snapshot(prepare(made_city(200, "detached")))
    assert view.seen_pairs is not None
    assert len(view.seen_pairs.first) < 0.2 * len(view.world.wall_a) ** 2
    every = trace_echoes(replace(view, seen_pairs=None), ALL_EFFECTS)
    assert np.array_equal(trace_echoes(view, ALL_EFFECTS).rows, every.rows)


def test_a_wall_that_only_an_arc_shows_is_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    """A bulging mirror shows three pieces of structure of a screen, and three of the wall that it hides."""
    monkeypatch.setattr(reach, "WHOLE_WALLS", 0)
    arc, screen, hidden = (
        Surface(role="relay", material="metal", polyline_m=ends, height_m=10.0)
        for ends in (((18.0, -6.0), (18.0, 6.0)), ((4.0, 2.0), (4.0, 12.0)), ((9.0, 7.0), (13.0, 9.0)))
    )
    arc = msgspec.structs.replace(arc, curvature_per_m=-0.05)
    world = prepare(Scene(name="arc", surfaces=(arc, screen, hidden)))
    part = of_part(world, 0.0, scene_radar(world.scene, 0.0))
    assert np.count_nonzero(part.needs & np.uint32(bit("second_relay"))) == 6
    assert_same_paths(part, of_whole(world, 0.0, scene_radar(world.scene, 0.0)))


def far_wall(x_m: float, material: str = "metal", between_m: float = 0.0) -> World:
    """One wall square on, far away, and 66 behind the radar that it does not see; perhaps one that stands between."""
    behind = tuple(
        Surface(role="relay", material="brick", polyline_m=((-20.0 - index, 9.0), (-20.0 - index, 30.0)))
        for index in range(66)
    )
    far = Surface(role="relay", material=material, polyline_m=((x_m, -20.0), (x_m, 20.0)), height_m=10.0)
    screen = Surface(role="relay", material="metal", polyline_m=((between_m, -1.0), (between_m, 1.0)), height_m=20.0)
    return prepare(Scene(name="far", surfaces=(far, screen, *behind) if between_m else (far, *behind)))


@pytest.mark.parametrize(("x_m", "material"), [(170.0, "metal"), (300.0, "metal"), (170.0, "concrete")])
def test_a_flash_that_leaks_from_beyond_reach_is_kept(x_m: float, material: str) -> None:
    """Where chirps overlap, a wall's flash is in all range bins. Without it some cell of the map changes by more than
    the planner's budget of -20 dB; with it the wall's structure beyond reach is left, under -40 dB.
    """
    world = far_wall(x_m, material)
    whole, part = snapshot(world), reachable_snapshot(world, ahead_only=True)
    assert part.distant.tolist() == [0]
    every, kept = trace_echoes(whole, ALL_EFFECTS), trace_echoes(part, ALL_EFFECTS)
    beyond = kept.take(kept.out_m > reach_m(world.setup))
    # foot and both ends
    assert beyond.surface.tolist() == [0, 0, 0]
    assert np.array_equal(beyond.rows, every.take(np.isin(every.chain, beyond.chain)).rows)
    assert change_db(world, (whole, every), (part, kept)) < -40.0
    near = kept.take(kept.out_m <= reach_m(world.setup))
    assert change_db(world, (whole, every), (part, near)) > -10.0


@pytest.mark.parametrize("between_m", [30.0, 190.0])
def test_a_flash_that_something_hides_is_not_there(between_m: float) -> None:
    """A screen near by, or another far wall, which flashes in its place."""
    world = far_wall(200.0, between_m=between_m)
    part = reachable_snapshot(world)
    assert part.distant.tolist() == ([] if between_m < 100.0 else [1])
    echoes = trace_echoes(part, ALL_EFFECTS)
    # foot and both ends of each
    assert (echoes.out_m > reach_m(world.setup)).sum() == 3 * len(part.distant)


def test_a_flash_behind_the_antenna_or_later_than_a_chirp_is_left_out() -> None:
    assert reachable_snapshot(far_wall(-200.0)).distant.tolist() == [0]
    assert len(reachable_snapshot(far_wall(-200.0), ahead_only=True).distant) == 0
    assert reachable_snapshot(far_wall(800.0)).distant.tolist() == [0]
    assert len(reachable_snapshot(far_wall(820.0)).distant) == 0


def test_a_wall_that_flashes_from_afar_mirrors_nothing_else() -> None:
    """A car before a metal wall at 170 m: its images there are beyond reach, and so is what the wall's ends bend."""
    world = far_wall(170.0)
    scene = msgspec.structs.replace(world.scene, objects=(SceneObject(class_="car", x_m=40.0, y_m=3.0),))
    view = reachable_snapshot(prepare(scene))
    echoes = trace_echoes(view, ALL_EFFECTS)
    assert (echoes.surface == 0).sum() == 3
    assert not (view.world.speck_wall == view.world.wall_id.tolist().index(0)).any()
