"""Bent ways in scenes: joined to direct, mirrored and transmitted fields; edges and the walls that form them."""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from scipy.special import fresnel

from sim_player.effects import edge_diffraction
from sim_player.effects.edge_diffraction import edge_routes, edges_of, open_edges
from sim_player.effects.table import PATHS
from sim_player.scene.description import Ego
from sim_player.scene.segments import crossing_factor
from sim_player.scene.world import World, snapshot
from sim_player.trace.snapshot import TraceContext
from tests.sim_player.trace.point_scenes import (
    RADAR,
    WAVENUMBER,
    Point,
    one_way_field,
    points_world,
    traced,
    unit_weight,
    wall,
)

NAME = "edge_diffraction"

#: So long that its other end is far off.
SCREEN = wall((10.0, 0.0), (10.0, -950.0))


@pytest.fixture(autouse=True)
def every_bend(monkeypatch: pytest.MonkeyPatch) -> None:
    for least in ("LEAST_BEND", "LEAST_BENT", "LEAST_BOTH"):
        monkeypatch.setattr(edge_diffraction, least, 0.0)


def field_at(points: list[Point], *walls, also: tuple[str, ...] = ()) -> np.ndarray:  # type: ignore[no-untyped-def]
    """Sum of one-way fields of all clear and bent ways to each point, times the straight distance."""
    found = traced(points_world(points, *walls), "los_objects", "specular_relay", NAME, *also)
    total = np.zeros(len(points), np.complex128)
    for name in ("los_objects", "specular_relay", NAME):
        np.add.at(total, found.routes[name].target, one_way_field(found.routes[name]))
    return total * np.linalg.norm(np.array(points) - [0.0, 0.0, 1.0], axis=1)


def test_half_the_field_at_the_shadow_border() -> None:
    """Metal screen with its end straight ahead, 10 m + 10 m: -6 dB one way on the border; lit ripple to +1.4 dB; dark.

    Knife edge: |field| from Fresnel's integral, v^2 = 4 detour / lambda. Bias: the screen's own reflection terms, which
    the knife has none of, 2 % of the field at these angles; tolerance 2.5 %.
    """
    y = np.concatenate([np.linspace(-3.0, 3.0, 36), [1e-9, 1e-4, -1e-4]])
    # the border's own side is dark: the wall's end hides it
    field = np.abs(field_at([(20.0, float(v), 1.0) for v in y], SCREEN))
    detour_m = 10.0 + np.hypot(10.0, y) - np.hypot(20.0, y)
    v = np.sign(y) * np.sqrt(4.0 / RADAR.wavelength_m * detour_m)
    sine, cosine = fresnel(v)
    knife = np.abs(0.5 * (1.0 + 1j) * ((0.5 + cosine) - 1j * (0.5 + sine)))
    np.testing.assert_allclose(field, knife, atol=0.025)
    np.testing.assert_allclose(20.0 * np.log10(field[-3:]), -6.02, atol=0.2)


@pytest.mark.parametrize("material", ["metal", "glass", "concrete"])
def test_no_jump_at_any_border(material: str) -> None:
    """Direct, mirrored and bent together over both borders of a wall's end, 4 mm panes too: steps of 1e-5 m, < 1e-3.

    Glass lets a third through: behind it the transmitted way stands in the shadow, and the edge mends what is missing.
    """
    more = {"thickness_mm": 4.0} if material == "glass" else {}
    pane = wall((10.0, 0.0), (10.0, -40.0), material=material, **more)
    for border in ((20.0, 0.0), (6.0, 0.0)):
        points = [(border[0], border[1] + side * 1e-5, 1.0) for side in (-1.0, 1.0)]
        shifted = [(x, y, z) for x, y, z in points]
        world = points_world(shifted, pane)
        found = traced(world, "los_objects", "specular_relay", NAME)
        behind, legs = found.straight
        total = np.zeros(2, np.complex128)
        for routes, factor in (
            (behind, legs.through),
            (found.routes["specular_relay"], 1.0),
            (found.routes[NAME], 1.0),
        ):
            np.add.at(total, routes.target, one_way_field(routes) * factor)
        assert abs(total[1] - total[0]) < 1e-3 * abs(total).max(), border


def test_oblique_reflection_border() -> None:
    """Wall seen at 45 deg, 20 cm up, its specular point led over the end by 2e-6 m: no jump over 1e-3."""
    relay = wall((-30.0, 10.0), (10.0, 10.0), material="concrete")
    # the image of the radar is at (0, 20): the border runs from it through (10, 10)
    ends = [(14.0 + side * 1e-6, 6.0, 1.4) for side in (-1.0, 1.0)]
    found = field_at(ends, relay)
    assert abs(found[1] - found[0]) < 1e-3 * abs(found).max()


def test_house_corner_is_a_wedge_of_three_quarters() -> None:
    """Corner pointing at the radar: n = 3/2, one edge; both shadow borders without a jump; deep shadow falls off."""
    house = wall((10.0, 12.0), (10.0, 0.0), (24.0, 0.0))
    world = points_world([(12.0, -2.0, 1.0)], house)
    edges = edges_of(snapshot(world))
    corner = np.flatnonzero((edges.point == [10.0, 0.0]).all(axis=1))
    assert edges.n[corner].tolist() == pytest.approx([1.5])
    assert len(edges) == 3
    tall = wall((10.0, 60.0), (10.0, 2.0), (60.0, 2.0))
    slope = 2.0 / 10.0
    border = [(20.0, 20.0 * slope * (1.0 + side * 1e-6), 1.0) for side in (-1.0, 1.0)]
    lit, dark = field_at([(x, y, z) for x, y, z in border], tall)
    # the far side of the corner hides everything above the ray: no bent way through the wall
    assert abs(dark) < abs(lit) + 1e-3


def test_shadow_of_a_house_corner() -> None:
    """Radar beside a house, points behind its corner: half the field at the border, less behind; none inside."""
    house = wall((10.0, 2.0), (10.0, 950.0)), wall((10.0, 2.0), (-950.0, 2.0))
    turn = np.radians(np.array([-20.0, -1e-6, 1e-6, 5.0, 20.0, 60.0])) + math.atan2(2.0, 10.0)
    points = [(10.0 + 8.0 * math.cos(a), 2.0 + 8.0 * math.sin(a), 1.0) for a in turn]
    found = traced(points_world(points, *house), "los_objects", "specular_relay", NAME)
    corner = found.routes[NAME]
    assert np.unique(corner.target).tolist() == [0, 1, 2, 3, 4, 5]
    field = np.abs(field_at(points, *house))
    np.testing.assert_allclose(field[1:3], 0.5, atol=0.03)
    assert (np.diff(field[2:]) < 0.0).all()
    inside = traced(points_world([(5.0, 4.0, 1.0)], *house), NAME).routes[NAME]
    assert (inside.length_m > 900.0).all()


def test_joined_panes_have_no_edge_between_them() -> None:
    """Three surfaces in one plane: two edges, their ends; and the same bent echoes as one wall of the same build."""
    ends = [(10.0, -6.0), (10.0, -1.0), (10.0, 1.0), (10.0, 6.0)]
    one = points_world([(20.0, 7.0, 1.0)], wall(ends[0], ends[3]))
    three = points_world([(20.0, 7.0, 1.0)], *(wall(a, b) for a, b in pairwise(ends)))
    assert len(edges_of(snapshot(three))) == 2
    single, joined = (traced(world, NAME).routes[NAME] for world in (one, three))
    np.testing.assert_allclose(np.sort_complex(joined.whole), np.sort_complex(single.whole), rtol=1e-12)


def test_corner_of_two_surfaces_is_one_edge() -> None:
    """The same house as one polyline and as two surfaces: the same edges, the same fields."""
    a, b, c = (10.0, 12.0), (10.0, 2.0), (-9.0, 2.0)
    point = [(16.0, 5.0, 1.0)]
    split, whole = (
        traced(points_world(point, *walls), NAME).routes[NAME] for walls in ((wall(a, b), wall(b, c)), (wall(a, b, c),))
    )
    np.testing.assert_allclose(np.sort_complex(split.whole), np.sort_complex(whole.whole), rtol=1e-9)
    assert len(split) == len(whole) >= 1


def test_the_walls_of_an_edge_do_not_hide_it_but_others_do() -> None:
    """Legs end at the edge, where its walls are; a wall across the way in or on stops them, a low one does not."""
    point = [(20.0, -3.0, 1.0)]
    assert _near(points_world(point, SCREEN)) == 1
    for across in (wall((5.0, -1.0), (5.0, 1.0)), wall((15.0, -2.5), (15.0, -0.5))):
        assert _near(points_world(point, SCREEN, across)) == 0
    kerb = wall((5.0, -1.0), (5.0, 1.0), height_m=0.5)
    assert _near(points_world(point, SCREEN, kerb)) == 1
    # a corner that opens to the radar is none, nor one over whose top the ray passes by more than Fresnel's v = 6
    assert len(edges_of(snapshot(points_world(point, wall((12.0, -5.0), (12.0, 5.0), (2.0, 5.0)))))) == 2
    low = points_world([(20.0, -3.0, 7.0)], wall((10.0, 0.0), (10.0, -40.0), height_m=0.9))
    assert _near(low) == 0


def _near(world: World) -> int:
    """How many routes go by the end at (10, 0)."""
    bent = traced(world, NAME).routes[NAME]
    length_m = math.hypot(10.0 + math.hypot(10.0, 3.0), world.centre_m[0, 2] - 1.0)
    return int(np.isclose(bent.length_m, length_m).sum())


def test_the_rays_meet_the_edge_by_kellers_cone() -> None:
    """Point 3 m above the radar: unfolded around the edge the way is straight, sqrt((s + t)^2 + dz^2)."""
    bent = traced(points_world([(20.0, -3.0, 4.0)], SCREEN), NAME).routes[NAME]
    plan = 10.0 + math.hypot(10.0, 3.0)
    assert bent.length_m[0] == pytest.approx(math.hypot(plan, 3.0), rel=1e-12)
    assert bent.depart[0, 2] == pytest.approx(bent.arrive[0, 2], rel=1e-12)


def test_echoes_bend_once_or_twice() -> None:
    """Lit point, one end in reach: direct^2 + 2 direct bent + bent^2, one way squared; 1e-9 (phases)."""
    found = traced(
        points_world([(20.0, 1.0, 1.0)], wall((10.0, 0.0), (10.0, -4.0)), wall((5.0, -1.0), (5.0, -5.0))),
        "los_objects",
        NAME,
    )
    edges = edges_of(found.view)
    assert np.unique(found.routes[NAME].edge).size == len(found.routes[NAME]) <= len(edges)
    total, field = 0.0j, one_way_field(found.routes["los_objects"]).sum()
    for echoes in found.echoes.values():
        total += (unit_weight(echoes) * np.exp(-1j * WAVENUMBER * (echoes.out_m + echoes.back_m))).sum()
    bent = one_way_field(found.routes[NAME])
    assert total == pytest.approx((field + bent.sum()) ** 2, rel=1e-9)


def test_an_arcs_end_faces_along_its_tangent() -> None:
    """Bent wall, half turn 0.3 rad: its end's face leaves the chord by 0.3 rad, to the side of the bulge."""
    chord = 20.0
    arc = wall((10.0, 0.0), (10.0, -chord), curvature_per_m=2.0 * math.sin(0.3) / chord)
    tracing = TraceContext(snapshot(points_world([(20.0, 3.0, 1.0)], arc)))
    edges = edges_of(tracing.view)
    start = np.flatnonzero(edges.point[:, 1] == 0.0)[0]
    # centre to the left of the way down, at greater x: the wall bulges to smaller x, its start leans there
    assert edges.face_rad[start] == pytest.approx(-0.5 * math.pi - 0.3)


def test_bent_ways_mix_with_all_clear_ways() -> None:
    """Point in a corner of two walls, which have ends: out by an edge, back straight, by one mirror or by two.

    Analytic: one way squared, (clear + bent)^2. Tolerance 1e-9 (phases). Seen
    in the full-wave solution of the scene `hidden` of benchmarks.full_wave.
    """
    corner = wall((6.0, -4.0), (6.0, 5.0)), wall((6.0, 5.0), (-3.0, 5.0))
    clear = ("los_objects", "specular_relay", "second_relay")
    found = traced(points_world([(3.0, 1.4, 1.0)], *corner), *clear, "non_cofocal", NAME)
    total = 0.0j
    for echoes in (echoes.take(echoes.object_index >= 0) for echoes in found.echoes.values()):
        total += (unit_weight(echoes) * np.exp(-1j * WAVENUMBER * (echoes.out_m + echoes.back_m))).sum()
    fields = {name: one_way_field(found.routes[name]) for name in (*clear, NAME)}
    assert all(map(len, fields.values()))
    field, bent = sum(fields[name].sum() for name in clear), fields[NAME]
    assert total == pytest.approx((field + bent.sum()) ** 2, rel=1e-9)


def test_an_edge_keeps_its_name_while_others_come_into_sight() -> None:
    """A sheet hides the first end of the far wall at the start and no more 4 m on: three edges, then four.

    The point's echoes by the other three are the same chains at both times.
    """
    far, sheet = wall((15.0, 8.0), (15.0, -10.0)), wall((5.0, 2.0), (5.0, 3.0))
    world = points_world([(11.0, -4.0, 1.0)], far, sheet, ego=Ego(speed_mps=4.0))
    then, now = (traced(world, "los_objects", NAME, time_s=time_s) for time_s in (0.0, 1.0))
    hidden, ends = 0, [1, 2, 3]
    assert sorted(then.routes[NAME].edge.tolist()) == ends
    assert sorted(now.routes[NAME].edge.tolist()) == [hidden, *ends]
    assert set(then.echoes[NAME].chain.tolist()) < set(now.echoes[NAME].chain.tolist())


def test_edges_are_found_once_in_a_world() -> None:
    world = points_world([(11.0, -4.0, 1.0)], wall((15.0, 8.0), (15.0, -10.0)))
    assert open_edges(world) is open_edges(world)
    # a part of it has its own
    part = replace(world, wall_a=world.wall_a + 1.0)
    np.testing.assert_allclose(open_edges(part).point[0], open_edges(world).point[0] + 1.0)


def test_a_wall_hides_as_many_points_at_once_as_one_by_one() -> None:
    """Drawn walls and objects, each of 20 points: an object asked as a whole has the routes of each of its points.

    As points of one single object, which no wall can hide as a whole here, they are asked one by one.
    """
    rng = np.random.default_rng(5)
    middle_m = rng.uniform([3.0, -20.0], [40.0, 20.0], (12, 2))
    point_m = np.repeat(middle_m, 20, axis=0) + rng.uniform(-1.0, 1.0, (240, 2))
    point_m = np.column_stack([point_m, rng.uniform(0.2, 1.5, 240)])
    ends_m = rng.uniform([4.0, -20.0], [40.0, 20.0], (12, 2))
    walls = [wall(tuple(end), tuple(end + rng.uniform(-8.0, 8.0, 2))) for end in ends_m]
    view = snapshot(points_world([(3.0, 0.0, 1.0)], *walls))
    whole = edge_routes(view, point_m, np.repeat(np.arange(12, dtype=np.int32), 20))
    single = edge_routes(view, point_m, np.full(240, -1, np.int32))
    assert 50 < len(whole) < 240 * 20
    np.testing.assert_array_equal(whole.rows, single.rows)


def aperture_field(target: tuple[float, float], openings: list[tuple[float, float, complex]]) -> complex:
    """Field behind the plane x = 5 over that of free space: Kirchhoff's integral, heights by stationary phase.

    `openings`: from, to, and what is let through there; everything else is open. The source is the origin.
    """
    y = np.linspace(-25.0, 25.0, 200_001)
    there, on = np.hypot(5.0, y), np.hypot(target[0] - 5.0, target[1] - y)
    obliquity = 0.5 * (5.0 / there + (target[0] - 5.0) / on) / np.sqrt(there * on * (there + on))
    # ends far off, faded out
    window = np.clip((25.0 - np.abs(y)) / 10.0, 0.0, 1.0) ** 2
    wave = obliquity * window * np.exp(-1j * WAVENUMBER * (there + on))
    passed = np.ones(len(y), np.complex128)
    for low, high, through in openings:
        passed[(y > low) & (y < high)] = through
    return complex((passed * wave).sum() / wave.sum())


@pytest.mark.parametrize(
    ("material", "thickness_mm"),
    [("metal", None), ("glass", 4.0), ("glass", 6.0), ("glass", 10.0), ("wood", 20.0), ("plasterboard", 12.5)],
)
@pytest.mark.parametrize("beside", [None, "concrete"])
def test_echoes_behind_a_pane_are_those_of_its_aperture(
    material: str, thickness_mm: float | None, beside: str | None
) -> None:
    """Pane from y = 0 on, open or concrete of 200 mm below: points 1 m to 1 um on either side of the border behind it.

    Analytic: the square of Kirchhoff's one-way field, T of the slab at the border's ray. Bias: the edge's reflection
    terms and the angle that T is taken at; 0.06 of free space. Over the border itself it moves by less than 1e-3.
    """
    more = {} if thickness_mm is None else {"thickness_mm": thickness_mm}
    walls = [wall((5.0, 0.0), (5.0, 60.0), material=material, **more)]
    if beside is not None:
        walls.append(wall((5.0, 0.0), (5.0, -60.0), material=beside, thickness_mm=200.0))
    places = [-1.0, -0.3, -1e-6, 1e-6, 0.3, 1.0]
    world = points_world([(10.0, y, 1.0) for y in places], *walls)
    through = [complex(crossing_factor(world.transmission, world.wall_build[w], 1.0)) for w in range(len(walls))]
    openings = [(low, high, t) for (low, high), t in zip([(0.0, 25.0), (-25.0, 0.0)], through, strict=False)]
    opaque = PATHS["wall_transmission"].absent(world) is not None
    found = traced(world, *("los_objects", NAME) if opaque else ("los_objects", "wall_transmission", NAME))
    total = np.zeros(len(places), np.complex128)
    for echoes in found.echoes.values():
        phase = np.exp(-1j * WAVENUMBER * (echoes.out_m + echoes.back_m))
        np.add.at(total, echoes.object_index, unit_weight(echoes) * phase)
    away = np.array([math.hypot(10.0, y) for y in places])
    total *= away**2 * np.exp(2j * WAVENUMBER * away)
    expected = np.array([aperture_field((10.0, y), openings) ** 2 for y in places])
    np.testing.assert_allclose(total, expected, atol=0.06)
    assert abs(total[3] - total[2]) < 1e-3


@pytest.mark.parametrize("height_m", [0.4, 0.7, 1.0, 1.3])
def test_an_edge_ends_at_its_top(height_m: float) -> None:
    """Metal screen of some height with an end: behind it and beside, over it and under, a quarter plane is dark.

    Analytic, Fresnel: 1 - Q_y Q_z, the shares of the wave behind each of both edges. Bias: the screen's reflection
    terms, and what is left out below -40 dB; 0.03.
    """
    points = [(20.0, y, 1.0) for y in (-1.0, -0.2, -1e-6, 1e-6, 0.2, 1.0)]
    low = wall((10.0, 0.0), (10.0, -950.0), height_m=height_m)
    field = field_at(points, low)

    def passed(clearance_m: np.ndarray) -> np.ndarray:
        sine, cosine = fresnel(clearance_m * math.sqrt(2.0 * 20.0 / (100.0 * RADAR.wavelength_m)))
        return np.asarray(0.5 * (1.0 + 1j) * ((0.5 + cosine) - 1j * (0.5 + sine)))

    beside = passed(np.array([0.5 * y for _, y, _ in points]))
    expected = 1.0 - (1.0 - beside) * (1.0 - passed(np.array(1.0 - height_m)))
    away = np.array([math.hypot(20.0, y) for _, y, _ in points])
    np.testing.assert_allclose(field * np.exp(1j * WAVENUMBER * away), expected, atol=0.03)
