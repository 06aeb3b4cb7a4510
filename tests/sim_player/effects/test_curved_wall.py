"""Bent walls as mirrors: the flat limit, focusing, the caustic, and the chord that stands for a skipped arc."""

from __future__ import annotations

import math

import numpy as np
import pytest

from msgs.values.perception import PathClass
from sim_player.effects import curved_wall
from sim_player.effects.curved_wall import absent, arc_routes, as_chords
from sim_player.scene.description import SceneRadar
from sim_player.scene.world import snapshot
from sim_player.trace.snapshot import TraceContext
from tests.models.physics.curved_reference import focusing
from tests.models.physics.surface_integral import wall_field
from tests.sim_player.trace.point_scenes import RADAR, one_way_field, points_world, traced, unit_weight, wall

NAME = "curved_wall"

ENDS = (15.0, -10.0), (15.0, 10.0)
POINT = (5.0, 6.0, 1.0)


def test_nearly_flat_is_flat() -> None:
    """Curvature 1e-5 1/m, sagitta 0.5 mm, just over lambda / 64: one bounce, its field that of a flat wall to 1e-3
    (kappa l / cos), its length to two sagittas. Just under it the wall is flat, and the effect has none of it.
    """
    assert absent(points_world([POINT], wall(*ENDS, curvature_per_m=0.9e-5))) == "every wall is straight"
    bent = traced(points_world([POINT], wall(*ENDS, curvature_per_m=1e-5)), NAME)
    flat = traced(points_world([POINT], wall(*ENDS)), "specular_relay").routes["specular_relay"]
    route = bent.routes[NAME]
    assert len(route) == 1
    assert route.length_m[0] == pytest.approx(flat.length_m[0], abs=1.2e-3)
    np.testing.assert_allclose(route.depart, flat.depart, atol=1e-3)
    factor = route.whole * route.other
    np.testing.assert_allclose(factor, flat.whole, rtol=1e-3)


def test_a_ray_that_climbs_meets_an_arc_at_its_own_slope() -> None:
    """Nearly flat concrete at x = 15, 30 m high; the radar at 1 m, a point at (5, 6, 12).

    Its image is (25, 6, 12): 25 m of the path, sqrt(25^2 + 6^2 + 11^2) = 27.96 m, lie along the wall's normal, so the
    angle of incidence has cosine 25 / 27.96 = 0.8942. In plan it would be 25 / 25.71 = 0.9724, where concrete reflects
    1 dB less. The flat wall's field, and the slab's reflection at the first cosine, to 1e-3 (curvature 1e-5 1/m).
    """
    concrete = {"material": "concrete", "height_m": 30.0}
    world = points_world(
        [(5.0, 6.0, 12.0)], wall(*ENDS, curvature_per_m=1e-5, **concrete), radar=SceneRadar(height_m=1.0)
    )
    (climbing,) = traced(world, NAME).routes[NAME].whole
    level = points_world([(5.0, 6.0, 12.0)], wall(*ENDS, **concrete), radar=SceneRadar(height_m=1.0))
    (flat,) = traced(level, "specular_relay").routes["specular_relay"].whole
    cosines = 25.0 / np.array([math.sqrt(25.0**2 + 6.0**2 + 11.0**2), math.hypot(25.0, 6.0)])
    by_slope, by_plan = level.reflection(np.zeros(2, np.int64), cosines)[0]
    assert climbing == pytest.approx(flat, rel=1e-3)
    assert climbing == pytest.approx(by_slope, rel=1e-3)
    assert abs(by_plan / by_slope) < 0.95


@pytest.mark.parametrize("curvature_per_m", [-0.03, -0.01, 0.01])
def test_field_takes_the_focusing(curvature_per_m: float) -> None:
    """Convex and weakly hollow: field r F e^{-jkL} / L, echo its square; bias of the ray itself under 1 %.

    F = 1 / sqrt(1 - 2 kappa l1 l2 / ((l1 + l2) cos)) at the Fermat point of the arc.
    """
    found = traced(points_world([POINT], wall(*ENDS, curvature_per_m=curvature_per_m)), NAME)
    route = found.routes[NAME]
    at = _point_of(route, curvature_per_m)
    out, on = np.hypot(*at), math.dist(at, POINT[:2])
    # by the law of reflection the ray turns by pi - 2 theta
    cosine = math.sqrt(0.5 * (1.0 - float(route.depart[0, :2] @ route.arrive[0, :2])))
    expected = focusing(np.array(out), np.array(on), np.array(cosine), np.array(curvature_per_m))
    assert abs(route.other[0]) == pytest.approx(abs(complex(expected)), rel=0.01)
    echoes = found.echoes[NAME]
    mirrored = echoes.take(echoes.object_index == 0)
    assert unit_weight(mirrored)[0] == pytest.approx((route.whole * route.other / route.length_m)[0] ** 2, rel=1e-12)


def _point_of(route, curvature_per_m: float) -> np.ndarray:  # type: ignore[no-untyped-def]
    """Where the first leg meets the circle through the wall's ends."""
    reach = math.sqrt(1.0 / curvature_per_m**2 - 100.0)
    centre = np.array([15.0 - math.copysign(reach, curvature_per_m), 0.0])
    way = route.depart[0, :2]
    along = float(way @ centre)
    root = math.sqrt(along**2 - float(centre @ centre) + 1.0 / curvature_per_m**2)
    return np.asarray((along + math.copysign(root, curvature_per_m)) * way)


def test_hollow_wall_through_its_caustic_is_bounded() -> None:
    """Curvature 0.06 1/m: field at most 5 % over the surface integral's strongest, median error 2 % of it.

    Layout: points from x = 4 to 16 through the focus; the reference fades the wall's ends out.
    """
    ends = (20.0, -14.0), (20.0, 14.0)
    points = [(x, 0.7, 1.0) for x in np.linspace(4.0, 16.0, 49).tolist()]
    found = traced(points_world(points, wall(*ends, curvature_per_m=0.06)), NAME).routes[NAME]
    field = np.zeros(len(points), np.complex128)
    np.add.at(field, found.target, one_way_field(found) / found.whole)
    a, b = np.array(ends)
    origin = np.array([0.0, 0.0, 1.0])
    exact = np.array([wall_field(origin, np.array(p), a, b, 0.06, RADAR.wavelength_m, taper_m=4.0) for p in points])
    assert np.abs(field).max() < 1.05 * np.abs(exact).max()
    assert np.median(np.abs(field - exact)) < 0.02 * np.abs(exact).max()


def test_the_radars_own_image_in_an_arc() -> None:
    """Bulging wall, vertex at 10 m, radius 20 m: flash of a flat wall at 10 m times sqrt(R / (R + d))."""
    chord, radius = 12.0, 20.0
    sagitta = radius - math.sqrt(radius**2 - 0.25 * chord**2)
    arc = wall((10.0 + sagitta, -6.0), (10.0 + sagitta, 6.0), curvature_per_m=-1.0 / radius)
    echoes = traced(points_world([(-5.0, -300.0, 1.0)], arc), NAME).echoes[NAME]
    flash = echoes.take(echoes.object_index < 0)
    assert (len(flash), flash.kind[0], flash.order[0]) == (1, PathClass.LOS, 0)
    assert flash.out_m[0] == pytest.approx(10.0, rel=1e-9)
    flat = math.sqrt(1e3 * RADAR.transmit_power_w) * RADAR.wavelength_m / (4.0 * math.pi * 20.0)
    assert abs(flash.weight[0] * flash.whole[0]) == pytest.approx(flat * math.sqrt(radius / (radius + 10.0)), rel=3e-3)


def test_skipped_arcs_mirror_like_their_chords() -> None:
    """`as_chords` gives the flat wall's echo in place of the arc's, not stopped by the arc itself."""
    world = points_world([POINT], wall(*ENDS, curvature_per_m=0.02))
    tracing = TraceContext(snapshot(world))
    echoes = as_chords(tracing)
    flat = traced(points_world([POINT], wall(*ENDS)), "specular_relay").echoes["specular_relay"]
    np.testing.assert_allclose(unit_weight(echoes), unit_weight(flat), rtol=1e-12)
    assert len(tracing.routes["specular_relay"]) == 1


def test_screens_stop_both_legs() -> None:
    for x, y in ((7.0, 1.5), (10.0, 5.0)):
        screen = wall((x, y - 1.5), (x, y + 1.5), role="occluder")
        assert len(traced(points_world([POINT], wall(*ENDS, curvature_per_m=-0.01), screen), NAME).routes[NAME]) == 0


def test_an_arc_is_not_searched_for_its_own_points(monkeypatch: pytest.MonkeyPatch) -> None:
    """Such a search is a hundred times longer. All other routes are the same, and their points are numbered alike."""
    world = points_world([POINT], wall(*ENDS, curvature_per_m=0.02), wall((0.0, -12.0), (12.0, -12.0)))
    view, (specks, point) = snapshot(world, 0.0), world.structure
    of, nobody = world.speck_wall[specks], np.full(len(specks), -1, np.int32)
    every = arc_routes(view, point, nobody)
    searched: list[int] = []
    search = curved_wall.bounces
    monkeypatch.setattr(curved_wall, "bounces", lambda *args: (searched.append(len(args[1])), search(*args))[1])
    asked = arc_routes(view, point, nobody, of)
    assert searched == [np.count_nonzero(of == 1)]
    assert 0 < len(asked) == np.count_nonzero(of[every.target] == 1)
    np.testing.assert_array_equal(asked.rows, every.take(of[every.target] == 1).rows)
