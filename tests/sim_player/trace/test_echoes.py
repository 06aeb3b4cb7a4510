"""Echoes: the radar equation, which routes are joined, and the compiled sums against the plain formulas."""

from __future__ import annotations

import math

import numpy as np
import pytest

from msgs.values.radar import RadarParams
from sim_player.generate.places import random_place
from sim_player.scene.road_users import seen_rcs_m2
from sim_player.scene.world import prepare, snapshot
from sim_player.trace.echoes import echo_amplitude, object_echoes, same_target
from sim_player.trace.routes import Routes
from sim_player.trace.snapshot import TraceContext

RADAR = RadarParams()


@pytest.mark.parametrize("range_m", [5.0, 10.0, 20.0, 50.0, 100.0])
def test_radar_equation(range_m: float) -> None:
    """1 m^2 without antenna: P lambda^2 / ((4 pi)^3 R^4), in mW; tolerance: rounding."""
    power_mw = 1.6 * RADAR.wavelength_m**2 / ((4.0 * math.pi) ** 3 * range_m**4)
    assert echo_amplitude(RADAR, np.array([1.0]), np.array([range_m]))[0] ** 2 == pytest.approx(
        power_mw, rel=1e-12, abs=0.0
    )


def test_every_route_out_meets_every_route_back_of_its_target() -> None:
    """Targets reached by several routes, by one and by none, in no order: all pairs of one target, each once."""
    out, back = np.array([7, 2, 7, 5, 0]), np.array([2, 7, 4, 7, 2, 7])
    pairs = sorted(zip(*(indices.tolist() for indices in same_target(out, back)), strict=True))
    assert pairs == [(0, 1), (0, 3), (0, 5), (1, 0), (1, 4), (2, 1), (2, 3), (2, 5)]
    assert all(len(indices) == 0 for indices in same_target(out, np.array([], np.int64)))


def plain_chain(out: Routes, back: Routes, needs: int) -> np.ndarray:
    """The hash of an echo's scatterer, routes and effects, column by column."""
    chain = np.full(len(out), needs, np.uint64)
    for routes in (out, back):
        for part in (routes.target, routes.wall, routes.wall2, routes.edge, routes.ground, routes.needs):
            chain = (chain + (part.astype(np.int64) + 2).astype(np.uint64)) * np.uint64(6364136223846793005)
    return chain


def test_echoes_of_centres_are_the_radar_equation() -> None:
    """Straight and mirrored routes of a drawn place in all mixtures, array by array in NumPy: rounding."""
    view = snapshot(prepare(random_place(17, 3), 3), 0.2)
    world, tracing = view.world, TraceContext(view)
    routes = Routes.joined([tracing.straight[0], tracing.mirrored[0]])
    pairs = same_target(routes.target, routes.target)
    echoes = object_echoes(view, routes, pairs, 5)
    assert world.orders_alike
    assert len(echoes) > 100
    out, back = routes.take(pairs[0]), routes.take(pairs[1])
    centre = out.target
    lobe = world.centre_rcs_m2, world.centre_normals, world.centre_exponent, world.centre_floor
    peak, normals, exponent, floor = (values[centre] for values in lobe)
    rcs = np.sqrt(np.prod([seen_rcs_m2(peak, normals, exponent, -way.arrive, floor) for way in (out, back)], axis=0))
    kept = np.flatnonzero(rcs > 0.0)
    out, back, centre = out.take(kept), back.take(kept), centre[kept]
    weight = echo_amplitude(world.radar, rcs[kept], np.ones(len(kept))) * np.exp(1j * world.centre_phase_rad[centre])
    weight *= np.where(pairs[0] == pairs[1], 1.0, 2.0)[kept] / (out.length_m * back.length_m)
    np.testing.assert_allclose(echoes.weight, weight, rtol=1e-12)
    np.testing.assert_allclose(echoes.whole * echoes.rough, out.whole * back.whole * out.rough * back.rough, rtol=1e-12)
    np.testing.assert_array_equal(echoes.chain, plain_chain(out, back, 5))
    velocity = np.column_stack([view.velocity[centre], np.zeros(len(centre))])
    rates = [np.sum(way.arrive * velocity, axis=1) - way.depart[:, :2] @ view.radar_velocity for way in (out, back)]
    np.testing.assert_allclose(echoes.rate_mps, 0.5 * (rates[0] + rates[1]), atol=1e-12)
    np.testing.assert_array_equal(echoes.order, np.maximum(out.wall >= 0, back.wall >= 0))
    np.testing.assert_array_equal(echoes.surface, np.where(out.wall >= 0, out.wall, back.wall))
