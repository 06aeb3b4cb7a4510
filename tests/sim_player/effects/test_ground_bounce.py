"""The ground under echoes: the two-ray model, the wall between, what a low wall hides."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest

from models.physics.materials import permittivity
from sim_player.scene.description import Surface
from tests.sim_player.trace.point_scenes import RADAR, WAVENUMBER, points_world, traced, unit_weight, wall

NAME = "ground_bounce"

GROUND = Surface(role="ground", material="asphalt")


def gamma(grazing_rad: np.ndarray) -> np.ndarray:
    """Textbook reflection of an upright field at the ground, by grazing angle."""
    eps = complex(permittivity("asphalt", RADAR.carrier_hz))
    root = np.sqrt(eps - np.cos(grazing_rad) ** 2 + 0j)
    return (eps * np.sin(grazing_rad) - root) / (eps * np.sin(grazing_rad) + root)


def total(found, target: int | None = None) -> complex:  # type: ignore[no-untyped-def]
    """Sum of all echoes with the phases of their lengths."""
    result = 0.0j
    for echoes in found.echoes.values():
        one = echoes if target is None else echoes.take(echoes.object_index == target)
        result += (unit_weight(one) * np.exp(-1j * WAVENUMBER * (one.out_m + one.back_m))).sum()
    return result


def test_two_ray_interference_over_range() -> None:
    """Radar 1 m, point 0.7 m, 4..100 m: [e^{-jkd}/d + G e^{-jkr}/r]^2, G of the grazing angle; phases round to 1e-9."""
    x = np.linspace(4.0, 100.0, 97)
    world = points_world([(float(v), 0.0, 0.7) for v in x], GROUND)
    found = traced(world, "los_objects", NAME)
    direct, bounced = np.hypot(x, 0.3), np.hypot(x, 1.7)
    field = np.exp(-1j * WAVENUMBER * direct) / direct
    field = field + gamma(np.arctan2(1.7, x)) * np.exp(-1j * WAVENUMBER * bounced) / bounced
    seen = np.array([total(found, index) for index in range(len(x))])
    np.testing.assert_allclose(seen, field**2, atol=1e-9 * np.abs(field**2).max())
    # nulls and maxima are there: the two-way gain runs from under -20 dB to nearly +12 dB
    gain_db = 10.0 * np.log10(np.abs(seen) * direct**2)
    assert gain_db.min() < -10.0
    assert gain_db.max() > 4.0


def test_grazing_ground_turns_the_upright_field_over() -> None:
    """At 0.1 deg of grazing the reflection is -1 within 1 %, at 60 deg the upright field of a good mirror is +1."""
    world = points_world([(1000.0, 0.0, 0.7)], GROUND)
    route = traced(world, "los_objects", NAME).routes[NAME]
    assert route.whole[0] == pytest.approx(-1.0, abs=0.012)
    steel = points_world([(1.0, 0.0, 0.75)], Surface(role="ground", material="metal"))
    assert traced(steel, NAME).routes[NAME].whole[0] == pytest.approx(1.0, abs=2e-3)


@pytest.mark.parametrize(("z", "early"), [(0.2, False), (3.0, True)])
def test_with_a_mirror_between(z: float, early: bool) -> None:
    """Wall x = 12, point (4, 6, z): image (20, 6, -z), whichever of wall and ground comes first; exact.

    One way by the ground and one without, and both: [clear + ground]^2 of the mirrored ways; rounding of phases.
    """
    found = traced(
        points_world([(4.0, 6.0, z)], wall((12.0, -5.0), (12.0, 8.0), height_m=9.0), GROUND), "specular_relay", NAME
    )
    routes = found.routes[NAME]
    route = routes.take(routes.wall == 0)
    length = math.sqrt(20.0**2 + 6.0**2 + (1.0 + z) ** 2)
    assert route.length_m[0] == pytest.approx(length, rel=1e-12)
    np.testing.assert_allclose(route.depart[0], np.array([20.0, 6.0, -1.0 - z]) / length, atol=1e-12)
    np.testing.assert_allclose(route.arrive[0], np.array([-20.0, 6.0, 1.0 + z]) / length, atol=1e-12)
    assert (1.0 / (1.0 + z) < 12.0 / 20.0) == early
    clear = found.routes["specular_relay"]
    field = sum((one.whole / one.length_m * np.exp(-1j * WAVENUMBER * one.length_m)).sum() for one in (clear, route))
    by_wall = 0.0j
    for echoes in found.echoes.values():
        one = echoes.take(echoes.surface == 0)
        by_wall += (unit_weight(one) * np.exp(-1j * WAVENUMBER * (one.out_m + one.back_m))).sum()
    assert by_wall == pytest.approx(field**2, rel=1e-9)


def test_a_kerb_hides_the_bounce_and_not_the_sight() -> None:
    """A wall of 4 m just before the place of the bounce, 10 m high and 40 m away; direct sight passes 6 m over it.

    On the way to the bounce Fresnel's argument is -6 and less, of the direct ray 6 and more.
    """
    point = [(40.0, 0.0, 10.0)]
    for x, hidden in ((20.2, True), (2.0, False)):
        kerb = wall((x, -1.0), (x, 1.0), height_m=4.0)
        world = dataclasses.replace(points_world(point, kerb, GROUND), radar_height_m=10.0)
        found = traced(world, "los_objects", NAME)
        assert len(found.routes["los_objects"]) == 1
        assert (found.routes[NAME].wall < 0).sum() == (0 if hidden else 1)


def test_rough_ground_reflects_less() -> None:
    """1 mm rms: field times exp(-1/2 (4 pi s cos / lambda)^2)."""
    ground = Surface(role="ground", material="asphalt", roughness_mm=1.0)
    route = traced(points_world([(3.0, 0.0, 1.0)], ground), NAME).routes[NAME]
    cosine = 2.0 / math.hypot(3.0, 2.0)
    assert route.rough[0] == pytest.approx(math.exp(-0.5 * (4.0 * math.pi * 1e-3 * cosine / RADAR.wavelength_m) ** 2))


def test_rough_ground_reflects_less_beside_a_mirror_too() -> None:
    """5 mm rms under the image (20, 6, -1): 0.980 of the field is left at a cosine of 2 / sqrt(440)."""
    ground = Surface(role="ground", material="asphalt", roughness_mm=5.0)
    world = points_world([(4.0, 6.0, 1.0)], wall((12.0, -5.0), (12.0, 8.0), height_m=9.0), ground)
    routes = traced(world, NAME).routes[NAME]
    cosine = 2.0 / math.sqrt(20.0**2 + 6.0**2 + 2.0**2)
    left = math.exp(-0.5 * (4.0 * math.pi * 5e-3 * cosine / RADAR.wavelength_m) ** 2)
    assert left == pytest.approx(0.980, abs=1e-3)
    np.testing.assert_allclose(routes.rough[routes.wall == 0], left)


def test_a_mirror_across_the_other_axis_turns_the_way_on_there() -> None:
    """Wall y = 12, point (6, 4, 2): image (6, 20, -2), met by way of the wall at a cosine of 20 over the length."""
    across = wall((-5.0, 12.0), (9.0, 12.0), height_m=9.0, roughness_mm=4.0)
    routes = traced(points_world([(6.0, 4.0, 2.0)], across, GROUND), NAME).routes[NAME]
    route = routes.take(routes.wall == 0)
    length = math.sqrt(6.0**2 + 20.0**2 + 3.0**2)
    np.testing.assert_allclose(route.depart[0], np.array([6.0, 20.0, -3.0]) / length, atol=1e-12)
    np.testing.assert_allclose(route.arrive[0], np.array([6.0, -20.0, 3.0]) / length, atol=1e-12)
    left = math.exp(-0.5 * (4.0 * math.pi * 4e-3 * (20.0 / length) / RADAR.wavelength_m) ** 2)
    assert route.rough[0] == pytest.approx(left)
