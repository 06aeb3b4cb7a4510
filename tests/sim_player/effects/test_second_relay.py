"""Two walls in a row against images worked out by hand and a plain search over all pairs of walls."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.optimize import minimize

from models.physics.curved_mirror import arc_points
from models.physics.fresnel import half_space_reflection
from models.physics.materials import permittivity
from models.physics.mirror import blocked, crossing_parameters, reflect, wall_from_ends
from sim_player.trace.echoes import Echoes
from tests.sim_player.trace.point_scenes import RADAR, points_world, traced, unit_weight, wall

NAME = "second_relay"

CORNER = (wall((10.0, -20.0), (10.0, 10.0)), wall((-20.0, 10.0), (10.0, 10.0)))
HIDDEN = (2.0, -3.0, 1.0)


def metal(cosine: float) -> complex:
    return complex(half_space_reflection(permittivity("metal", RADAR.carrier_hz), np.array(cosine)))


def test_image_of_the_image() -> None:
    """Walls x = 10 and y = 10, radar (0, 0), point (2, -3), all 1 m high: image (18, 23), by y = 10 first; 1e-12.

    The line to the image meets y = 10 at x = 7.8 and, folded back, x = 10 at y = 7.2. Field: both walls' reflection.
    """
    found = traced(points_world([HIDDEN], *CORNER), NAME)
    routes = found.routes[NAME]
    assert (routes.wall.tolist(), routes.wall2.tolist()) == ([1], [0])
    length = math.hypot(18.0, 23.0)
    assert routes.length_m[0] == pytest.approx(length, rel=1e-12)
    np.testing.assert_allclose(routes.depart[0], [18.0 / length, 23.0 / length, 0.0], atol=1e-12)
    np.testing.assert_allclose(routes.arrive[0], [-18.0 / length, -23.0 / length, 0.0], atol=1e-12)
    echo = found.echoes[NAME].take(found.echoes[NAME].object_index == 0)
    field = metal(23.0 / length) * metal(18.0 / length) / length
    np.testing.assert_allclose(unit_weight(echo), [field**2], rtol=1e-12)
    assert echo.order.tolist() == [2]


@pytest.mark.slow
def test_routes_are_those_of_a_plain_search() -> None:
    """40 scenes of 6 random walls and 30 points: the same routes and lengths as by images and line cuts."""
    rng = np.random.default_rng(11)
    total = 0
    for _ in range(40):
        a = rng.uniform(-20.0, 20.0, (6, 2))
        a[np.hypot(*a.T) < 4.0] += 8.0
        turn = rng.uniform(0.0, np.pi, 6)
        b = a + rng.uniform(4.0, 12.0, (6, 1)) * np.column_stack([np.cos(turn), np.sin(turn)])
        try:
            points = [(*place, 1.0) for place in rng.uniform(-20.0, 20.0, (30, 2))]
            world = points_world(points, *(wall(tuple(p), tuple(q)) for p, q in zip(a, b, strict=True)))
        except ValueError:
            continue
        routes = traced(world, NAME).routes[NAME]
        found = {
            key: length
            for *key, length in zip(routes.wall, routes.wall2, routes.target, routes.length_m, strict=True)
            for key in [tuple(int(x) for x in key)]
        }
        expected = _plain_search(a, b, np.array(points)[:, :2])
        assert found.keys() == expected.keys()
        for key, length in expected.items():
            assert found[key] == pytest.approx(length, rel=1e-12)
        total += len(expected)
    assert total > 200


def _plain_search(a: np.ndarray, b: np.ndarray, points: np.ndarray) -> dict[tuple[int, int, int], float]:
    """Every pair of walls in order and every point: images by reflection, cuts by crossing lines, shadows by rays."""
    origin, found = np.zeros(2), {}
    for first in range(len(a)):
        image_1 = reflect(origin, *wall_from_ends(a[first], b[first], origin))
        for second in range(len(a)):
            if second == first:
                continue
            normal, offset = wall_from_ends(a[second], b[second], image_1)
            for target, point in enumerate(points):
                image_2 = reflect(point, normal, offset)
                _, place_2 = crossing_parameters(image_1, image_2[None], a[second][None], b[second][None])
                if not (point @ normal + offset > 0.0 and 0.0 <= place_2[0, 0] <= 1.0):
                    continue
                at_2 = a[second] + place_2[0, 0] * (b[second] - a[second])
                along, place_1 = crossing_parameters(image_1, at_2[None], a[first][None], b[first][None])
                if not (0.0 < along[0, 0] < 1.0 and 0.0 <= place_1[0, 0] <= 1.0):
                    continue
                at_1 = a[first] + place_1[0, 0] * (b[first] - a[first])
                stops = np.array([origin, at_1, at_2, point])
                if not blocked(stops[:-1], stops[1:], a, b).any():
                    found[first, second, target] = float(np.linalg.norm(image_2 - image_1))
    return found


def loops(angle_rad: float, distance_m: float = 12.0, share: float = 0.4) -> Echoes:
    """The radar's own images in a metal corner of an opening angle, seen at a share of it."""
    face, apex = share * angle_rad, np.array([distance_m, 0.0])
    ends = [apex + 40.0 * np.array([-math.cos(turn), math.sin(turn)]) for turn in (face, face - angle_rad)]
    world = points_world([(-5.0, -300.0, 1.0)], *(wall((float(x), float(y)), (distance_m, 0.0)) for x, y in ends))
    echoes = traced(world, NAME).echoes[NAME]
    return echoes.take(
        (echoes.object_index < 0) & (echoes.order == 2) & ((echoes.point == [0.0, 0.0, 1.0]).all(axis=1))
    )


def level(echoes: Echoes, distance_m: float) -> float:
    """Sum of weights over that of the radar's image at a distance, phases of lengths included, metal taken as 1."""
    one = math.sqrt(1e3 * RADAR.transmit_power_w) * RADAR.wavelength_m / (4.0 * math.pi * 2.0 * distance_m)
    phase = np.exp(-2j * np.pi / RADAR.wavelength_m * (echoes.out_m + echoes.back_m))
    return float(abs((echoes.weight * echoes.whole * phase).sum()) / one)


def test_a_right_angle_is_a_dihedral() -> None:
    """90 deg, apex at 12 m, seen off its middle: one image at 12 m, out to the apex and straight back; metal 0.1 %.

    Exact: at 90 deg the corner is one image and nothing else. It takes both ways round, half a wave each.
    """
    echoes = loops(0.5 * math.pi)
    np.testing.assert_allclose(echoes.out_m + echoes.back_m, 24.0, rtol=1e-9)
    np.testing.assert_allclose(echoes.depart, np.tile([1.0, 0.0, 0.0], (2, 1)), atol=1e-6)
    np.testing.assert_allclose(echoes.arrive, echoes.depart, atol=1e-6)
    assert level(echoes, 12.0) == pytest.approx(1.0, abs=2e-3)


def test_corners_flash_on_both_sides_of_the_right_angle() -> None:
    """75 deg: two whole ways round at 2 d sin(75 deg), 7 % of ripple; 105 deg: under -25 dB; no jump at 90 deg."""
    sharp = loops(math.radians(75.0))
    np.testing.assert_allclose(sharp.out_m + sharp.back_m, 24.0 * math.sin(math.radians(75.0)), rtol=1e-9)
    assert level(sharp, 12.0 * math.sin(math.radians(75.0))) == pytest.approx(2.0, rel=0.07)
    assert level(loops(math.radians(105.0)), 12.0) < 10.0 ** (-25.0 / 20.0)
    below, above = (level(loops(0.5 * math.pi + turn), 12.0) for turn in (-1e-4, 1e-4))
    assert below == pytest.approx(above, abs=0.02)


@pytest.mark.parametrize("angle_deg", [98.0, 105.0])
def test_beyond_the_right_angle_the_apex_is_an_edge(angle_deg: float) -> None:
    """Opening a, apex at d = 12 m: each way round is the wave that an edge throws back, out to the apex and home.

    Fresnel's integral far in the dark (Keller): of the way of 2 d a share exp(-j pi / 4) / (pi sqrt(2) v), where
    v = -cos(a) sqrt(8 d / (lambda (1 + sin a))) is 5.6 and 10.4; the next term is 1 / (pi v^2) = 1 % and 0.3 % of it.
    """
    angle_rad = math.radians(angle_deg)
    echoes = loops(angle_rad)
    np.testing.assert_allclose(echoes.out_m + echoes.back_m, 24.0, rtol=1e-9)
    v = -math.cos(angle_rad) * math.sqrt(8.0 * 12.0 / (RADAR.wavelength_m * (1.0 + math.sin(angle_rad))))
    one = math.sqrt(1e3 * RADAR.transmit_power_w) * RADAR.wavelength_m / (4.0 * math.pi * 24.0)
    edge = np.exp(-0.25j * math.pi) / (math.pi * math.sqrt(2.0) * v)
    np.testing.assert_allclose(echoes.weight / one, [edge, edge], rtol=1.2 / (math.pi * v**2))


@pytest.mark.parametrize("turn_deg", [0.0, 45.0, 31.7])
def test_one_way_by_the_apex_of_a_right_angle(turn_deg: float) -> None:
    """Radar and point on a line through the apex: both orders have one image, (2 a - radar), and one way stands for it.

    1 um, 1 nm, nothing to either side of the line; metal, so r1 r2 of the 45 deg on the line. Field to 1e-6.
    """
    turn = math.radians(turn_deg)
    along = np.array([[math.cos(turn), math.sin(turn)], [-math.sin(turn), math.cos(turn)]])
    apex = 10.0 * np.array([math.cos(turn + 0.7), math.sin(turn + 0.7)])
    walls = [wall(tuple(apex), tuple(apex - 18.0 * side)) for side in along]
    for beside_m in (1e-6, 1e-9, 0.0, -1e-9, -1e-6):
        place = 0.6 * apex + beside_m * np.array([-apex[1], apex[0]]) / 10.0
        routes = traced(points_world([(*place, 1.5)], *walls), NAME).routes[NAME]
        assert len(routes) == 1, beside_m
        assert routes.length_m[0] == pytest.approx(math.hypot(14.0, 0.5), rel=1e-9)
        cosines = [abs(float(side[::-1] @ (apex * [1.0, -1.0]))) / 10.0 * 14.0 / routes.length_m[0] for side in along]
        assert routes.whole[0] == pytest.approx(metal(cosines[0]) * metal(cosines[1]), rel=1e-6)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_two_walls_go_over_to_arcs(sign: float) -> None:
    """A wall of 30 m bends from 1e-9 to 5e-3 1/m: the echo by it and a straight wall goes on, in steps under 1 dB.

    And each is right: the length is the shortest (or longest) of a plain search over both walls, to 1e-8 of it; the
    field is the straight walls' times sqrt(det H0 / det H), second derivatives of the length by differences, 1e-3.
    """
    first, second = ((10.0, -20.0), (10.0, 10.0)), ((-20.0, 10.0), (10.0, 10.0))
    levels = []
    for curvature in (0.0, *(sign * 10.0 ** np.linspace(-9.0, -2.3, 28)).tolist()):
        routes = traced(points_world([HIDDEN], wall(*first, curvature_per_m=curvature), wall(*second)), NAME).routes[
            NAME
        ]
        assert routes.wall2.tolist() == [0]
        factor = routes.whole[0] * routes.other[0]
        levels.append(20.0 * math.log10(abs(factor) / routes.length_m[0]))
        if abs(curvature) < 1e-4:
            continue

        def length(s: np.ndarray, k: float = curvature) -> float:
            at_1 = arc_points(np.array(second[0]), np.array(second[1]), 0.0, np.array(s[0] / 30.0))
            at_2 = arc_points(np.array(first[0]), np.array(first[1]), k, np.array(s[1] / 30.0))
            return float(np.hypot(*at_1) + np.hypot(*(at_2 - at_1)) + np.hypot(*(at_2 - HIDDEN[:2])))

        found = minimize(length, [28.0, 27.0], method="Nelder-Mead", options={"xatol": 1e-7, "fatol": 1e-13})
        assert routes.length_m[0] == pytest.approx(found.fun, rel=1e-8)
        bent, flat = (hessian(lambda s, k=k: length(s, k), found.x) for k in (curvature, 0.0))
        if abs(curvature) <= 1e-3:
            # straight walls at the same places: to first order in the turn there
            assert abs(routes.other[0]) == pytest.approx(math.sqrt(np.linalg.det(flat) / np.linalg.det(bent)), rel=0.03)
    assert np.abs(np.diff(levels)).max() < 1.0


def hessian(function, at: np.ndarray, step: float = 1e-3) -> np.ndarray:  # type: ignore[no-untyped-def]
    """Second derivatives of a function of two numbers, by central differences."""
    e = step * np.eye(2)
    return np.array(
        [
            [
                (function(at + a + b) - function(at + a - b) - function(at - a + b) + function(at - a - b))
                / (4.0 * step**2)
                for b in e
            ]
            for a in e
        ]
    )


def test_the_loop_leaves_and_returns_apart() -> None:
    """60 deg corner: the radar's two ways round are each other's reverse."""
    echoes = loops(math.radians(60.0))
    np.testing.assert_allclose(echoes.depart, echoes.arrive[::-1], atol=1e-12)
    np.testing.assert_allclose(echoes.whole[0], echoes.whole[1], rtol=1e-12)


@pytest.mark.parametrize("middle", [(3.9, 5.0), (8.9, 8.6), (6.0, 2.1)])
def test_each_of_three_legs_can_be_hidden(middle: tuple[float, float]) -> None:
    """A screen of 1 m on the way out, between the walls, and on the way in (none reaches another leg)."""
    assert len(traced(points_world([HIDDEN], *CORNER), NAME).routes[NAME]) == 1
    x, y = middle
    screen = wall((x - 0.4, y + 0.3), (x + 0.4, y - 0.3), role="occluder")
    routes = traced(points_world([HIDDEN], *CORNER, screen), NAME).routes[NAME]
    assert not ((routes.wall == 1) & (routes.wall2 == 0)).any()


def test_no_path_where_a_point_is_off_its_wall() -> None:
    """The points at x = 7.83 of y = 10 and y = 7.22 of x = 10: each wall in turn ends before it."""
    for first, second in (((10.0, 7.3), (7.9, 10.0)), ((10.0, 7.1), (7.7, 10.0)), ((10.0, 7.3), (7.7, 10.0))):
        walls = wall((10.0, -20.0), first), wall((-20.0, 10.0), second)
        count = len(traced(points_world([HIDDEN], *walls), NAME).routes[NAME])
        assert count == int(first[1] > 7.22 and second[0] > 7.83)


def test_structure_of_one_wall_in_another() -> None:
    """Wall x = 10 mirrors the structure of y = -6: radar equation at the image's distance, times r^2; rounding."""
    world = points_world([(-5.0, -300.0, 1.0)], wall((10.0, -5.0), (10.0, 5.0)), wall((-8.0, -6.0), (4.0, -6.0)))
    echoes = traced(world, NAME).echoes[NAME]
    echoes = echoes.take((echoes.order == 1) & (echoes.surface == 0))
    specks = np.flatnonzero((world.speck_length_m == 0.0) & (world.speck_wall == 1))
    image = world.speck_m[specks] * [-1.0, 1.0] + [20.0, 0.0]
    distance = np.hypot(*image.T)
    met = np.abs(image[:, 1] * 10.0 / image[:, 0]) <= 5.0
    assert len(echoes) == met.sum() > 2
    np.testing.assert_allclose(echoes.out_m, distance[met], rtol=1e-12)
    r = np.array([metal(x) for x in (image[:, 0] / distance)[met]])
    expected = np.sqrt(world.speck_rcs_m2[specks][met]) * world.speck_phasor[specks][met] * r**2 / distance[met] ** 2
    np.testing.assert_allclose(unit_weight(echoes), expected, rtol=1e-12)
