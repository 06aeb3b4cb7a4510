"""A bend beside a mirror: the field of the unfolded way, both ways alike, no jump where an edge cuts a mirrored ray."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
from scipy.special import fresnel

from models.physics.diffraction import wedge_terms_at
from msgs.values.frames import Pose2
from sim_player.effects import edge_diffraction, mirrored_diffraction
from sim_player.effects.edge_diffraction import edges_of
from sim_player.effects.mirrored_diffraction import mirrors_beside
from sim_player.scene.description import Surface
from sim_player.scene.world import RadarState, snapshot
from sim_player.trace.routes import Routes
from sim_player.trace.snapshot import TraceContext
from tests.sim_player.trace.point_scenes import (
    RADAR,
    WAVENUMBER,
    Point,
    Traced,
    one_way_field,
    points_world,
    traced,
    unit_weight,
    wall,
)

NAME = "mirrored_diffraction"
CLEAR = ("los_objects", "specular_relay", "second_relay")

#: Mirror at x = 20, the radar at the origin: images lie at x' = 40 - x.
MIRROR = wall((20.0, -300.0), (20.0, 300.0))
#: Before the mirror the end (10, 3) cuts the way to images below the line y = 0.3 x; behind it the end (12, 12) that to
#: images above the line by its own, (28, 12). So long that their other ends are far off.
BEFORE = wall((10.0, 3.0), (10.0, -950.0))
BEHIND = wall((12.0, 12.0), (12.0, 950.0))


@pytest.fixture(autouse=True)
def every_bend(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(mirrored_diffraction, "LEAST_BEND", 0.0)
    for effect in (mirrored_diffraction, edge_diffraction):
        monkeypatch.setattr(effect, "LEAST_BOTH", 0.0)


def field_at(points: list[Point], *walls: Surface) -> np.ndarray:
    """Sum of one-way fields of mirrored and mirrored, bent ways to each point, over that of the image in free space."""
    found = traced(points_world(points, *walls), "specular_relay", NAME)
    total = np.zeros(len(points), np.complex128)
    for name in ("specular_relay", NAME):
        by_mirror = found.routes[name]
        by_mirror = by_mirror.take(found.view.world.wall_surface[by_mirror.wall] == 0)
        np.add.at(total, by_mirror.target, one_way_field(by_mirror))
    images = np.array(points) * [-1.0, 1.0, 1.0] + [40.0, 0.0, 0.0]
    length_m = np.linalg.norm(images - [0.0, 0.0, 1.0], axis=1)
    return np.asarray(total * length_m * np.exp(1j * WAVENUMBER * length_m))


@pytest.mark.parametrize("material", ["metal", "concrete"])
@pytest.mark.parametrize(("screen", "border"), [(BEFORE, (5.0, 10.5)), (BEHIND, (3.0, 12.0 * 37.0 / 28.0))])
def test_half_the_field_and_no_jump_where_an_edge_cuts_the_mirrored_ray(
    screen: Surface, border: Point, material: str
) -> None:
    """Screen before or behind a mirror at x = 20, target moved along y over the border of the mirrored ray's shadow.

    The border: the line from the radar by the end of the screen (or by its image) to the target's image. Analytic:
    r / 2 there, r the mirror's TE reflection (metal -1). Bias: the screen's reflection terms, 2 %; tolerance 4 %.
    From 3e-5 m on one side to 3e-5 m on the other the sum, the image's phase taken off, moves by less than 1e-3, while
    the mirrored ray appears.
    """
    mirror = wall((20.0, -300.0), (20.0, 300.0), material=material)
    points = [(border[0], border[1] + side * 3e-5, 1.0) for side in (-1.0, 1.0)]
    world = points_world(points, mirror, screen)
    mirrored = traced(world, "specular_relay").routes["specular_relay"]
    assert len(mirrored.take(mirrored.wall == 0)) == 1
    low, high = field_at(points, mirror, screen)
    assert abs(high - low) < 1e-3 * max(abs(low), abs(high))
    slope = math.atan2(border[1], 40.0 - border[0])
    reflected = abs(world.reflection(np.array([0]), np.array([math.cos(slope)]))[0][0])
    assert abs(low) == pytest.approx(0.5 * reflected, rel=0.04)


def test_over_the_border_it_is_a_knife_edge() -> None:
    """The same border, 4 m to either side: Fresnel's integral at v^2 = 4 detour / lambda, over the mirrored ray.

    Bias: the screen's own reflection terms, 2 %, metal's loss 3e-4; tolerance 3 %.
    """
    y = np.linspace(6.5, 14.5, 40)
    field = np.abs(field_at([(5.0, float(at), 1.0) for at in y], MIRROR, BEFORE))
    detour_m = math.hypot(10.0, 3.0) + np.hypot(25.0, y - 3.0) - np.hypot(35.0, y)
    v = np.sign(y - 10.5) * np.sqrt(4.0 / RADAR.wavelength_m * detour_m)
    sine, cosine = fresnel(v)
    knife = np.abs(0.5 * (1.0 + 1j) * ((0.5 + cosine) - 1j * (0.5 + sine)))
    np.testing.assert_allclose(field, knife, atol=0.03)


@pytest.mark.parametrize("z_m", [1.0, 3.2])
def test_unfolded_it_is_a_bend_without_a_mirror(z_m: float) -> None:
    """Metal mirror: the field to the image with the mirror gone, screen before it; by the image of the screen behind.

    Lengths, directions and fields over the mirror's own reflection to 1e-9; also where the target stands higher.
    """
    points = [(5.0, y, z_m) for y in (8.0, 10.0, 13.0)]
    images = [(40.0 - x, y, z) for x, y, z in points]
    for screen, image in ((BEFORE, BEFORE), (BEHIND, wall((28.0, 12.0), (28.0, 950.0)))):
        world = points_world(points, MIRROR, screen)
        folded = traced(world, NAME).routes[NAME]
        plain = traced(points_world(images, image), "edge_diffraction").routes["edge_diffraction"]
        # of one order each: by the screen where it stands
        folded = folded.take(((folded.edge >= 0) == (screen is BEFORE)) & (folded.wall == 0))
        assert len(folded) >= 3
        towards = folded.arrive if screen is BEFORE else folded.depart
        reflected, *_ = world.reflection(folded.wall, np.abs(towards[:, 0]))
        folded = folded.with_columns(whole=folded.whole / reflected)
        for target in range(len(points)):
            mine, theirs = folded.take(folded.target == target), plain.take(plain.target == target)
            close = np.abs(mine.length_m[:, None] - theirs.length_m) < 1e-9
            assert close.any(axis=1).all()
            match = np.argmax(close, axis=1)
            np.testing.assert_allclose(mine.depart, theirs.depart[match], atol=1e-9)
            np.testing.assert_allclose(mine.whole, theirs.whole[match], rtol=1e-9)
            back = mine.arrive * [-1.0, 1.0, 1.0]
            np.testing.assert_allclose(back, theirs.arrive[match], atol=1e-9)


@pytest.mark.parametrize("material", ["metal", "concrete", "glass"])
def test_both_ways_are_alike(material: str) -> None:
    """Radar and target exchanged, 2.2 m apart in height: the other order, the same lengths and fields to 1e-9."""
    more = {"thickness_mm": 6.0} if material == "glass" else {}
    walls = [
        _of_material(surface, material, **more)
        for surface in (MIRROR, BEFORE, wall((2.0, 16.0), (9.0, 16.0), (9.0, 22.0)))
    ]
    ends = (0.0, 0.0, 1.0), (5.0, 9.0, 3.2)
    there, back = (_between(first, second, walls) for first, second in (ends, ends[::-1]))
    assert len(there) == len(back) > 2
    order, reverse = np.argsort(there.length_m), np.argsort(back.length_m)
    np.testing.assert_allclose(there.length_m[order], back.length_m[reverse], rtol=1e-12)
    np.testing.assert_allclose(there.depart[order], -back.arrive[reverse], atol=1e-9)
    np.testing.assert_allclose(there.whole[order], back.whole[reverse], rtol=1e-9)
    np.testing.assert_allclose(there.front[order], back.front[reverse], rtol=1e-9)
    assert sorted(there.edge.tolist()) == sorted((-2 - back.edge).tolist())


def _of_material(surface: Surface, material: str, **more: float) -> Surface:
    return wall(*surface.polyline_m, material=material, **more)


def _between(antenna: Point, target: Point, walls: list[Surface]) -> Routes:
    """Routes from one point to another."""
    world = dataclasses.replace(points_world([target], *walls), radar_height_m=antenna[2])
    view = snapshot(world, 0.0, RadarState(Pose2(antenna[0], antenna[1], 0.0), np.zeros(2)))
    tracing = TraceContext(view)
    mirrored_diffraction.apply(tracing)
    return tracing.routes[NAME]


def test_the_ends_of_the_mirror_itself_are_left_to_edge_diffraction() -> None:
    """One wall has no such route; nor have two in one line, whose ends stand on the mirror's line."""
    assert mirrored_diffraction.absent(points_world([(5.0, 8.0, 1.0)], MIRROR)) is not None
    row = wall((20.0, -30.0), (20.0, 5.0)), wall((20.0, 6.0), (20.0, 30.0))
    assert len(traced(points_world([(5.0, 8.0, 1.0)], *row), NAME).routes[NAME]) == 0


def test_every_leg_must_be_free() -> None:
    """A wall across any of the three legs takes the route by (10, 3) away, a kerb across it does not."""
    point = [(5.0, 10.0, 1.0)]
    crossing = {
        "to the edge": ((5.0, 1.0), (5.0, 2.0)),
        "to the mirror": ((15.0, 4.2), (15.0, 4.9)),
        "to the target": ((14.0, 7.0), (14.0, 8.0)),
    }
    assert _by_the_end(point, MIRROR, BEFORE) == 1
    for leg, (a, b) in crossing.items():
        assert _by_the_end(point, MIRROR, BEFORE, wall(a, b)) == 0, leg
        assert _by_the_end(point, MIRROR, BEFORE, wall(a, b, height_m=0.5)) == 1, leg
    # rays over the edge's top, by more than Fresnel's v = 6
    high, tall = [(5.0, 10.0, 9.0)], wall((20.0, -300.0), (20.0, 300.0), height_m=20.0)
    for height_m, count in ((5.0, 1), (0.1, 0)):
        assert _by_the_end(high, tall, wall((10.0, 3.0), (10.0, -950.0), height_m=height_m)) == count


def _by_the_end(point: list[Point], *walls: Surface) -> int:
    routes = traced(points_world(point, *walls), NAME).routes[NAME]
    length = math.hypot(math.hypot(10.0, 3.0) + math.hypot(25.0, point[0][1] - 3.0), point[0][2] - 1.0)
    return int((np.isclose(routes.length_m, length) & (routes.wall == 0)).sum())


def _summed(found: Traced) -> complex:
    total = 0.0j
    for echoes in (echoes.take(echoes.object_index >= 0) for echoes in found.echoes.values()):
        total += (unit_weight(echoes) * np.exp(-1j * WAVENUMBER * (echoes.out_m + echoes.back_m))).sum()
    return complex(total)


def test_echoes_are_the_square_of_one_way() -> None:
    """All ways squared, (clear + bent + mirrored bent)^2; 1e-9."""
    found = traced(
        points_world([(5.0, 8.0, 1.0)], MIRROR, wall((10.0, 3.0), (10.0, 5.0))),
        *CLEAR,
        "non_cofocal",
        "edge_diffraction",
        NAME,
    )
    fields = {name: one_way_field(found.routes[name]) for name in (*CLEAR, "edge_diffraction", NAME)}
    assert len(fields[NAME]) >= 3
    expected = sum(field.sum() for field in fields.values()) ** 2
    assert _summed(found) == pytest.approx(expected, rel=1e-9)


def test_chains_tell_both_orders_apart() -> None:
    """One edge and one mirror, met in either order on the way to one point: two routes, every echo its own chain."""
    found = traced(points_world([(6.0, 3.0, 1.0)], MIRROR, wall((3.0, 1.0), (3.0, 2.0))), *CLEAR, NAME)
    routes = found.routes[NAME]
    assert (routes.edge >= 0).any()
    assert (routes.edge <= -2).any()
    chains = found.echoes[NAME].chain
    assert len(np.unique(chains)) == len(chains)


@pytest.mark.parametrize("least", [0.01, 0.03, 0.1])
def test_what_is_left_out_is_as_weak_as_it_says(least: float, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of a yard of walls all routes are found whose bend leaves `least` or more, and no other."""
    yard = [wall((x, y), (x + 2.0, y + 1.0), (x + 1.0, y + 3.0)) for x in (4.0, 9.0, 14.0) for y in (-9.0, -3.0, 4.0)]
    points = [(x, y, 0.3 + 0.1 * x) for x in (2.0, 8.0, 16.0) for y in (-6.0, 1.0, 9.0)]
    world = points_world(points, MIRROR, *yard)
    view = snapshot(world)
    ends = view, view.centre, np.zeros(len(points), np.int32)
    every, bends = mirrored_diffraction.mirrored_edge_routes(*ends)
    monkeypatch.setattr(mirrored_diffraction, "LEAST_BEND", least)
    strong, strengths = mirrored_diffraction.mirrored_edge_routes(*ends)
    assert 0 < (bends >= least).sum() < len(bends)
    expected = every.take(bends >= least)
    for name in ("target", "wall", "edge", "length_m", "whole", "depart", "arrive"):
        assert np.array_equal(getattr(strong, name), getattr(expected, name)), name
    assert (strengths >= least).all()
    # and a part of a world keeps the walls of those that begin at an edge, of the walls that it asks for
    first = np.unique(strong.wall[strong.edge >= 0])
    for asked in (world.is_flat, np.arange(len(world.wall_a)) % 2 == 0):
        beside = mirrors_beside(world, edges_of(view), asked, (view.antenna, view.centre, ends[2]), view.blockers)
        assert np.array_equal(np.flatnonzero(beside), first[asked[first]])
    assert len(first) > 2


def test_points_on_walls_and_edges_stay_finite() -> None:
    """Points on the mirror, on the edge, on the screen, in the mirror's line beyond its end, and behind the mirror."""
    on_walls = [(20.0, 5.0, 1.0), (10.0, 3.0, 1.0), (10.0, 1.0, 1.0)]
    points = [*on_walls, (20.0, 400.0, 1.0), (25.0, 5.0, 1.0), (5.0, 8.0, 5.0)]
    routes = traced(points_world(points, MIRROR, BEFORE, BEHIND), NAME).routes[NAME]
    assert len(routes) > 0
    for values in (routes.whole, routes.front, routes.length_m, routes.depart, routes.arrive):
        assert np.isfinite(values).all()
    # what stands on the mirror or behind it is not seen in it from the edge
    assert not np.isin(routes.target[(routes.wall == 0) & (routes.edge >= 0)], [0, 3, 4]).any()


@pytest.mark.parametrize(("to_source", "to_target"), [(0.6, (3.9, 4.2)), (1.2, (1.7, 1.9)), (2.5, (0.3, 0.6))])
@pytest.mark.parametrize("n", [1.5, 2.0])
def test_a_bound_is_over_the_field_of_every_target_and_not_far(
    n: float, to_source: float, to_target: tuple[float, float]
) -> None:
    """Legs of 10 and 7 m: at every turn between the two, all faces perfect, the terms of the wedge add up to less."""
    edge = np.array([0.0, 0.0, 0.0, 1.0, 0.0, 1.0, n, 5.0, 0.0, 1.0])
    bound = edge_diffraction.bend_bound(edge, to_source, to_target, (10.0, 7.0), 1.0, RADAR.wavelength_m)
    turns = np.linspace(*to_target, 31)
    distance_m = np.full(31, 70.0 / 17.0)
    source = np.full(31, to_source)
    terms_of = np.vectorize(wedge_terms_at, otypes=[complex] * 3)
    terms = terms_of(n, source, turns, distance_m, RADAR.wavelength_m, 1.0)
    # of a field over that of a free ray as long as both legs
    field = sum(np.abs(term) for term in terms) * math.sqrt(17.0 / 70.0)
    assert 0.999 * field.max() < bound < 2.5 * field.max()


def test_a_scene_that_is_turned_bends_alike() -> None:
    """Mirror, screen and points turned by 40 deg about the radar: the same lengths and factors of every way."""
    turn = np.radians(40.0)
    matrix = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])

    def ways(matrix: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        def at(x: float, y: float) -> tuple[float, float]:
            moved = matrix @ [x, y]
            return float(moved[0]), float(moved[1])

        mirror = wall(at(20.0, -300.0), at(20.0, 300.0), material="concrete", roughness_mm=2.0)
        screen = wall(at(10.0, 3.0), at(10.0, -950.0))
        points = [(*at(5.0, y), 1.0) for y in (8.0, 10.0, 13.0)]
        routes = traced(points_world(points, mirror, screen), NAME).routes[NAME]
        routes = routes.take(np.argsort(routes.length_m))
        return routes.length_m, routes.whole * routes.rough

    for here, there in zip(ways(np.eye(2)), ways(matrix), strict=True):
        assert len(here) >= 3
        np.testing.assert_allclose(there, here, rtol=1e-6)
