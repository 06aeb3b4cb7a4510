"""Objects in one flat wall: the image, its field, and who may stand where."""

from __future__ import annotations

import math

import numpy as np
import pytest

from models.physics.fresnel import coherent_power, slab_reflection
from models.physics.materials import permittivity
from tests.sim_player.trace.point_scenes import RADAR, points_world, traced, unit_weight, wall

NAME = "specular_relay"

POINT = (4.0, 6.0, 2.0)


def test_image_by_hand() -> None:
    """Wall x = 12, glass of 6 mm, 0.2 mm rough: image (20, 6, 2); field (r sqrt(rho))^2 / L^2, r of the slab; 1e-12."""
    relay = wall((12.0, -5.0), (12.0, 9.0), material="glass", thickness_mm=6.0, roughness_mm=0.2)
    found = traced(points_world([POINT], relay), NAME)
    length = math.sqrt(437.0)
    cosine = np.array(20.0 / length)
    r = slab_reflection(permittivity("glass", RADAR.carrier_hz), cosine, np.array(6e-3), RADAR.wavelength_m)
    field = complex(r) * math.sqrt(float(coherent_power(0.2e-3, cosine, RADAR.wavelength_m))) / length
    np.testing.assert_allclose(unit_weight(found.echoes[NAME]), [field**2], rtol=1e-12)
    np.testing.assert_allclose(found.routes[NAME].depart, [np.array([20.0, 6.0, 1.0]) / length], atol=1e-12)
    np.testing.assert_allclose(found.routes[NAME].arrive, [np.array([-20.0, 6.0, 1.0]) / length], atol=1e-12)


@pytest.mark.parametrize(("end_m", "seen"), [(3.59, True), (3.61, False)])
def test_the_point_must_lie_on_the_wall(end_m: float, seen: bool) -> None:
    """Specular point (12, 3.6): ends 1 cm either side of it."""
    found = traced(points_world([POINT], wall((12.0, end_m), (12.0, 9.0))), NAME)
    assert len(found.routes[NAME]) == int(seen)


def test_foliage_mirrors_nothing() -> None:
    hedge = wall((12.0, -5.0), (12.0, 9.0), material="vegetation")
    world = points_world([POINT], hedge, wall((-9.0, 20.0), (9.0, 20.0)))
    assert traced(world, NAME).routes[NAME].wall.tolist() == [1]
