"""Paths between traced instants: against tracing at the time itself, and what comes and goes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from sim_player.effects.table import ALL_EFFECTS
from sim_player.paths.path_tracks import LONGEST_MOVE_M, PathTrack, Span, tracing_step_s
from sim_player.paths.ray_tracing import trace
from sim_player.scene.description import Ego
from sim_player.scene.world import World
from sim_player.trace.path_table import Paths
from tests.sim_player.trace.point_scenes import points_world, wall

STEP_S = 0.03
USED = frozenset({"los_objects", "specular_relay", "non_cofocal"})


def driving(speed_mps: float = 8.0) -> World:
    """A point that comes the other way beside a wall; the radar drives and turns."""
    return points_world(
        [(14.0, 2.0, 1.0)],
        wall((-5.0, -6.0), (60.0, -6.0)),
        motion=[(7.0, 180.0)],
        ego=Ego(speed_mps=speed_mps, yaw_rate_dps=10.0),
    )


def by_chain(paths: Paths) -> Paths:
    return paths.take(np.argsort(paths.chain))


@pytest.mark.parametrize("time_s", [0.031, 0.044, 0.045, 0.0599])
def test_what_stays_is_where_tracing_finds_it(time_s: float) -> None:
    """Closing at 15 m/s at 12 m: the cubic is off by at most L'''' h^4 / 384 with L'''' near 2 v^4 / R^3 = 58 m/s^4,
    1.3e-7 m; angles and points by a straight line, v^2 h^2 / (8 R^2) = 1.8e-4 rad and 2e-3 m.
    """
    world = driving()
    got = by_chain(PathTrack(lambda at_s: trace(world, at_s, USED), STEP_S).at(time_s))
    wanted = by_chain(trace(world, time_s, USED))
    np.testing.assert_array_equal(got.chain, wanted.chain)
    assert len(got) == 3
    np.testing.assert_allclose(got.length_m, wanted.length_m, rtol=0.0, atol=1.3e-7)
    np.testing.assert_allclose(got.radial_speed_mps, wanted.radial_speed_mps, rtol=0.0, atol=1e-4)
    np.testing.assert_allclose(got.azimuth_rad, wanted.azimuth_rad, rtol=0.0, atol=1.8e-4)
    np.testing.assert_allclose(got.point_m, wanted.point_m, rtol=0.0, atol=2e-3)
    np.testing.assert_allclose(np.abs(got.amplitude), np.abs(wanted.amplitude), rtol=2e-3)


def test_instants_are_those_that_were_traced() -> None:
    world = driving()
    got, wanted = PathTrack(lambda at_s: trace(world, at_s, USED), STEP_S).at(STEP_S), trace(world, STEP_S, USED)
    np.testing.assert_allclose(by_chain(got).length_m, by_chain(wanted).length_m, rtol=0.0, atol=1e-12)
    np.testing.assert_allclose(by_chain(got).amplitude, by_chain(wanted).amplitude, rtol=1e-12)


def test_what_comes_and_goes_is_faded_over_the_step() -> None:
    """An echo that only the first instant has, one that only the second has: shares 3/4 and 1/4 a quarter in."""
    world = driving()
    whole = trace(world, 0.0, USED)
    parts = {0: whole.take(np.array([0, 1])), 1: trace(world, STEP_S, USED).take(np.array([0, 2]))}
    got = PathTrack(lambda at_s: parts[round(at_s / STEP_S)], STEP_S).at(0.25 * STEP_S)
    amplitude = dict(zip(got.chain.tolist(), got.amplitude, strict=True))
    gone, come = parts[0].take(np.array([1])), parts[1].take(np.array([1]))
    assert len(got) == 3
    assert amplitude[int(gone.chain[0])] == pytest.approx(0.75 * gone.amplitude[0], rel=1e-12)
    assert amplitude[int(come.chain[0])] == pytest.approx(0.25 * come.amplitude[0], rel=1e-12)


def test_another_echo_of_the_same_number_is_not_taken_for_it() -> None:
    """Ends that no rate connects (here 3 m apart) are two echoes that come and go."""
    world = driving()
    first = trace(world, 0.0, USED)
    jumped = replace(first, length_m=first.length_m + 3.0)
    got = PathTrack(lambda at_s: first if at_s == 0.0 else jumped, STEP_S).at(0.5 * STEP_S)
    assert len(got) == 2 * len(first)
    assert np.abs(got.amplitude).sum() == pytest.approx(np.abs(first.amplitude).sum(), rel=1e-9)


def test_the_order_of_asking_changes_nothing() -> None:
    world = driving()
    times_s = [0.2, 0.01, 0.21, 0.02, 0.2]
    forth = PathTrack(lambda at_s: trace(world, at_s, ALL_EFFECTS), STEP_S)
    alone = [PathTrack(lambda at_s: trace(world, at_s, ALL_EFFECTS), STEP_S).at(time_s) for time_s in times_s]
    for time_s, wanted in zip(times_s, alone, strict=True):
        got = forth.at(time_s)
        assert got.length_m.tobytes() == wanted.length_m.tobytes()
        assert got.amplitude.tobytes() == wanted.amplitude.tobytes()


def test_numbers_of_echoes_are_their_own() -> None:
    """All effects of a scene with two points and two walls: no two echoes share a number."""
    world = points_world(
        [(14.0, 2.0, 1.0), (9.0, -1.0, 1.0)], wall((-5.0, -6.0), (60.0, -6.0)), wall((30.0, -9.0), (30.0, 9.0))
    )
    chain = trace(world, 0.0, ALL_EFFECTS).chain
    assert len(np.unique(chain)) == len(chain) > 10


def test_instants_lie_as_close_as_the_scene_is_fast() -> None:
    """8 m/s against 7: 0.3 m take 20 ms; at rest the longest step."""
    assert tracing_step_s(driving(), 8.0, 0.3) == pytest.approx(LONGEST_MOVE_M / 15.0)
    assert tracing_step_s(points_world([(9.0, 0.0, 1.0)]), 0.0, 0.3) == 0.3
    with pytest.raises(ValueError, match=r"step_s must be positive, got 0\.0"):
        PathTrack(lambda at_s: trace(driving(), at_s), 0.0)


def coming_and_going() -> Span:
    """A span in which one echo stays, one goes and one comes."""
    first, last = (trace(driving(), at_s, USED) for at_s in (0.0, STEP_S))
    return Span(first.take(np.array([0, 1])), last.take(np.array([0, 2])), STEP_S)


def test_what_goes_is_nothing_at_the_end_and_what_comes_at_the_start() -> None:
    """Each where its rate carries it."""
    span = coming_and_going()
    first, last = span.at(0.0), span.at(STEP_S)
    np.testing.assert_array_equal(first.chain, last.chain)
    assert ((first.amplitude == 0.0) == [False, False, True]).all()
    assert ((last.amplitude == 0.0) == [False, True, False]).all()
    carried_m = 2.0 * STEP_S * first.radial_speed_mps[1:]
    np.testing.assert_allclose(last.length_m[1:], first.length_m[1:] + carried_m, rtol=1e-12)


@pytest.mark.parametrize(
    ("first", "last"),
    [
        ([7, 3, 2**64 - 1, 5], [5, 2**64 - 1, 4]),
        # equal numbers: the first of them goes on, the others go or come
        ([9, 4, 9, 4], [4, 4, 9]),
        ([1, 2], [8, 9]),
        ([], [3]),
        ([3], []),
    ],
)
def test_paths_of_a_span_are_paired_by_their_numbers(first: list[int], last: list[int]) -> None:
    """Against sets: what both instants have, in order of the numbers, then what goes and what comes, in their own."""
    one = trace(driving(), 0.0, USED).take(np.array([0]))
    ends = [
        replace(one.take(np.zeros(len(numbers), int)), chain=np.array(numbers, np.uint64)) for numbers in (first, last)
    ]
    # lengths tell the rows of one number apart, within the jump that is allowed
    start, stop = (replace(end, length_m=end.length_m + 1e-6 * np.arange(len(end))) for end in ends)
    got = Span(start, stop, 1e-9).at(0.0)
    both, here, there = np.intersect1d(start.chain, stop.chain, return_indices=True)
    goes = np.setdiff1d(np.arange(len(first)), here)
    comes = np.setdiff1d(np.arange(len(last)), there)
    np.testing.assert_array_equal(got.chain, np.concatenate([both, start.chain[goes], stop.chain[comes]]))
    wanted_m = np.concatenate([start.length_m[here], start.length_m[goes], stop.length_m[comes]])
    np.testing.assert_allclose(got.length_m, wanted_m, rtol=0.0, atol=2e-7)
