"""Mixed ways: lengths, strengths and directions from the two ways they are made of."""

from __future__ import annotations

import dataclasses
import math

import msgspec
import numpy as np
import pytest

from msgs.values.perception import PathClass
from sim_player.paths.conversion import as_paths
from sim_player.scene.description import Ego, SceneRadar
from sim_player.trace.path_table import Paths
from tests.sim_player.trace.point_scenes import WAVENUMBER, Traced, points_world, traced, unit_weight, wall

NAME = "non_cofocal"

POINT = (6.0, 5.0, 1.0)
WALLS = (wall((12.0, -9.0), (12.0, 9.0)), wall((-9.0, -8.0), (9.0, -8.0)))


def test_direct_and_two_mirrors_mix_in_pairs() -> None:
    """Point (6, 5), walls x = 12 and y = -8: images (18, 5), (6, -21). Lengths L1 + L2; field twice the geometric mean.

    Twice, for either may come first; all factors included; 1e-12.
    """
    found = traced(points_world([POINT], *WALLS), "los_objects", "specular_relay", NAME)
    mixed = found.echoes[NAME]
    images = [(6.0, 5.0), (18.0, 5.0), (6.0, -21.0)]
    lengths = {math.hypot(*a) + math.hypot(*b) for a in images for b in images if a < b}
    np.testing.assert_allclose(sorted(mixed.out_m + mixed.back_m), sorted(lengths), rtol=1e-12)
    whole = {}
    for name in ("los_objects", "specular_relay"):
        echoes = found.echoes[name]
        for out_m, weight, way in zip(echoes.out_m, unit_weight(echoes), echoes.depart, strict=True):
            whole[round(float(out_m), 9)] = (weight, way)
    for row in range(len(mixed)):
        (one, way_out), (two, way_back) = (whole[round(float(m[row]), 9)] for m in (mixed.out_m, mixed.back_m))
        assert abs(unit_weight(mixed)[row]) == pytest.approx(2.0 * math.sqrt(abs(one) * abs(two)), rel=1e-12)
        assert unit_weight(mixed)[row] ** 2 == pytest.approx(4.0 * one * two, rel=1e-12)
        np.testing.assert_allclose(mixed.depart[row], way_out, atol=1e-12)
        np.testing.assert_allclose(mixed.arrive[row], way_back, atol=1e-12)
    assert (mixed.kind == PathClass.MIRRORED).all()


def test_paths_leave_one_way_and_arrive_the_other() -> None:
    """The radar's own angles, turned by 20 deg: departure straight, arrival from the image, or the reverse."""
    ego = Ego(yaw_rate_dps=20.0)
    found = traced(points_world([POINT], WALLS[0], ego=ego), "los_objects", "specular_relay", NAME, time_s=1.0)
    paths = as_paths(found.view, found.echoes[NAME], frozenset({NAME}))
    both = [math.atan2(5.0, 6.0) - math.radians(20.0), math.atan2(5.0, 18.0) - math.radians(20.0)]
    assert sorted([paths.departure_azimuth_rad[0], paths.azimuth_rad[0]]) == pytest.approx(sorted(both), abs=1e-12)


@pytest.mark.parametrize("yaw_dps", [0.0, 40.0])
def test_arrays_apart_measure_the_bistatic_length(yaw_dps: float) -> None:
    """0.8 m apart, transmitter left: |T - p| + |p - R|, direct and to the image; exact for flat mirrors, 1e-12."""
    world = points_world([POINT], WALLS[0], radar=SceneRadar(separation_m=0.8), ego=Ego(yaw_rate_dps=yaw_dps))
    found = traced(world, "los_objects", "specular_relay", time_s=1.0)
    left = 0.4 * np.array([-math.sin(math.radians(yaw_dps)), math.cos(math.radians(yaw_dps))])
    for name, place in (("los_objects", (6.0, 5.0)), ("specular_relay", (18.0, 5.0))):
        lengths = as_paths(found.view, found.echoes[name], frozenset({NAME})).length_m
        together = as_paths(found.view, found.echoes[name], frozenset()).length_m
        expected = np.linalg.norm(np.array(place) - left) + np.linalg.norm(np.array(place) + left)
        np.testing.assert_allclose(lengths, [expected], rtol=1e-12)
        np.testing.assert_allclose(together, [2.0 * math.hypot(*place)], rtol=1e-12)


def apart(separation_m: float, yaw_dps: float = 0.0) -> tuple[Traced, Paths]:
    """The point and one wall, as arrays so far apart have them; radar turned by yaw."""
    world = points_world([POINT], WALLS[0], radar=SceneRadar(separation_m=separation_m), ego=Ego(yaw_rate_dps=yaw_dps))
    found = traced(world, "los_objects", "specular_relay", NAME, time_s=1.0)
    return found, as_paths(found.view, found.echoes[NAME], frozenset({NAME}))


@pytest.mark.parametrize("yaw_dps", [0.0, 40.0])
def test_arrays_apart_tell_the_two_orders(yaw_dps: float) -> None:
    """0.8 m apart: |T - p| + |p' - R| and |T - p'| + |p - R|, each with half of the field of both; exact, 1e-12.

    T left of the radar, R right; p = (6, 5), its image p' = (18, 5).
    """
    found, paths = apart(0.8, yaw_dps)
    left = 0.4 * np.array([-math.sin(math.radians(yaw_dps)), math.cos(math.radians(yaw_dps))])
    point, image = np.array([6.0, 5.0]), np.array([18.0, 5.0])
    orders = [(point - left, image + left), (image - left, point + left)]
    expected = sorted(np.linalg.norm(out) + np.linalg.norm(back) for out, back in orders)
    np.testing.assert_allclose(np.sort(paths.length_m), expected, rtol=1e-12)
    assert np.ptp(paths.length_m) > 0.1
    together = traced(points_world([POINT], WALLS[0]), "los_objects", "specular_relay", NAME)
    np.testing.assert_allclose(found.echoes[NAME].weight, 0.5 * together.echoes[NAME].weight.repeat(2), rtol=1e-12)


def test_arrays_change_places() -> None:
    """Reciprocity: with left and right exchanged (scene and yaw mirrored) the same lengths come, ways exchanged."""
    _, paths = apart(0.8, 25.0)
    other = points_world(
        [(POINT[0], -POINT[1], POINT[2])], WALLS[0], radar=SceneRadar(separation_m=0.8), ego=Ego(yaw_rate_dps=-25.0)
    )
    found = traced(other, "los_objects", "specular_relay", NAME, time_s=1.0)
    mirrored = as_paths(found.view, found.echoes[NAME], frozenset({NAME}))
    np.testing.assert_allclose(mirrored.length_m[::-1], paths.length_m, rtol=1e-12)
    np.testing.assert_allclose(mirrored.azimuth_rad[::-1], -paths.departure_azimuth_rad, atol=1e-12)


@pytest.mark.parametrize("separation_m", [1e-3, 1e-6, 1e-9])
def test_arrays_that_come_together_give_one_echo_of_twice_the_field(separation_m: float) -> None:
    """Sum of both orders against the one echo of arrays in one place: off by k s at most, the phase of the detour."""
    one = traced(points_world([POINT], WALLS[0]), "los_objects", "specular_relay", NAME)
    lone = as_paths(one.view, one.echoes[NAME], frozenset({NAME}))
    _, both = apart(separation_m)
    field = np.sum(both.amplitude * np.exp(-1j * WAVENUMBER * both.length_m))
    wanted = np.sum(lone.amplitude * np.exp(-1j * WAVENUMBER * lone.length_m))
    assert abs(field / wanted - 1.0) <= WAVENUMBER * separation_m + 1e-9


def test_an_array_that_steers_receive_alone_sees_each_order_where_it_arrives() -> None:
    """Sent to all sides, the echo comes in from the point and from its image: two paths at two azimuths."""
    world = points_world([POINT], WALLS[0])
    array = msgspec.structs.replace(world.setup.array, steered_ways=1)
    world = dataclasses.replace(world, setup=msgspec.structs.replace(world.setup, array=array))
    found = traced(world, "los_objects", "specular_relay", NAME)
    paths = as_paths(found.view, found.echoes[NAME], frozenset({NAME}))
    wanted = [math.atan2(5.0, 18.0), math.atan2(5.0, 6.0)]
    np.testing.assert_allclose(np.sort(paths.azimuth_rad), wanted, atol=1e-12)
    np.testing.assert_allclose(paths.length_m, math.hypot(6.0, 5.0) + math.hypot(18.0, 5.0), rtol=1e-12)


def test_two_points_of_one_arc_mix() -> None:
    """A hollow wall shows a point at two places or more: every pair of them is a path of its own."""
    bowl = wall((10.0, -9.5), (10.0, 9.5), curvature_per_m=0.1)
    found = traced(points_world([(12.7, 7.3, 1.0)], bowl), "curved_wall", NAME)
    ways = len(found.routes["curved_wall"])
    assert ways >= 2
    mixed = found.echoes[NAME]
    assert len(mixed) == ways * (ways - 1) // 2
    both = sorted(found.routes["curved_wall"].length_m[:2])
    assert np.isclose(mixed.out_m + mixed.back_m, sum(both), rtol=1e-12).any()


def test_one_way_alone_mixes_with_nothing() -> None:
    """Arrays apart, no wall, no object beyond: the effect is there (lengths) and adds no path."""
    world = points_world([POINT], radar=SceneRadar(separation_m=0.3))
    assert len(traced(world, "los_objects", NAME).echoes[NAME]) == 0
