"""Two objects in a row against the radar equation taken twice."""

from __future__ import annotations

import math

import numpy as np
import pytest

from msgs.values.perception import PathClass
from tests.sim_player.trace.point_scenes import RADAR, points_world, traced, wall

NAME = "object_interreflection"

ONE, TWO = (10.0, 2.0, 1.0), (13.0, -4.0, 0.5)


def test_bistatic_radar_equation_by_hand() -> None:
    """Power P lambda^2 / ((4 pi)^4 R1^2 d^2 R2^2) for 1 m^2 each; either may come first: four times that; 1e-12."""
    echo = traced(points_world([ONE, TWO]), "los_objects", NAME).echoes[NAME]
    r1, d, r2 = math.hypot(10.0, 2.0), math.sqrt(9.0 + 36.0 + 0.25), math.sqrt(169.0 + 16.0 + 0.25)
    power = 1e3 * RADAR.transmit_power_w * RADAR.wavelength_m**2 / ((4.0 * math.pi) ** 4 * (r1 * d * r2) ** 2)
    assert len(echo) == 1
    # powers of 1e-13 mW: the default absolute tolerance would take any of them for equal
    assert abs(echo.weight[0]) ** 2 == pytest.approx(4.0 * power, rel=1e-12, abs=0.0)
    assert echo.out_m[0] + echo.back_m[0] == pytest.approx(r1 + d + r2, rel=1e-12)
    np.testing.assert_allclose(echo.depart[0], np.array([10.0, 2.0, 0.0]) / r1, atol=1e-12)
    np.testing.assert_allclose(echo.arrive[0], np.array([13.0, -4.0, -0.5]) / r2, atol=1e-12)
    assert echo.kind[0] == PathClass.LOS


def test_order_of_objects_does_not_matter() -> None:
    one, other = (traced(points_world(points), "los_objects", NAME).echoes[NAME] for points in ([ONE, TWO], [TWO, ONE]))
    np.testing.assert_allclose(one.weight, other.weight, rtol=1e-12)
    np.testing.assert_allclose(one.depart, other.arrive, atol=1e-12)


def test_both_in_the_same_mirror() -> None:
    """Wall x = 20: both images light each other through the wall as the objects do; r on each way."""
    found = traced(points_world([ONE, TWO], wall((20.0, -12.0), (20.0, 12.0))), "los_objects", "specular_relay", NAME)
    echoes = found.echoes[NAME]
    mirrored = echoes.take(echoes.surface == 0)
    r1, d, r2 = math.hypot(30.0, 2.0), math.sqrt(9.0 + 36.0 + 0.25), math.sqrt(27.0**2 + 16.0 + 0.25)
    assert len(mirrored) == 1
    assert mirrored.out_m[0] + mirrored.back_m[0] == pytest.approx(r1 + d + r2, rel=1e-12)
    routes = found.routes["specular_relay"]
    np.testing.assert_allclose(mirrored.whole[0], routes.whole.prod(), rtol=1e-12)
    assert mirrored.kind[0] == PathClass.MIRRORED


def test_a_wall_between_them_ends_it() -> None:
    between = wall((11.0, -1.0), (12.5, -1.0), role="occluder")
    found = traced(points_world([ONE, TWO], between), "los_objects", NAME)
    assert len(found.routes["los_objects"]) == 2
    assert len(found.echoes[NAME].take(found.echoes[NAME].surface < 0)) == 0
