"""Water on the radome, the effect of the example: its physics, and its place in the scene with the mesh."""

from __future__ import annotations

import cmath
import math
import runpy

import pytest

from msgs.files.shipped import CHECKOUT
from sim_player.scene.description import load_scene
from sim_player.scene.world import prepare

EXAMPLES = CHECKOUT / "examples"
EFFECT = runpy.run_path(str(EXAMPLES / "my_effect" / "wet_radome.py"))
CARRIER_HZ = 10e9


def test_the_film_is_as_thick_as_what_flows_off() -> None:
    """A film of thickness t flows down a wall by rho g t^3 / (3 mu) for each metre of width; over the rim of the
    hemisphere that is the rain on half its radius.
    """
    thickness_m = EFFECT["film_thickness_m"](10.0)
    flow_m2_s = 998.0 * 9.81 * thickness_m**3 / (3.0 * 1.0e-3)
    assert flow_m2_s == pytest.approx(0.5 * EFFECT["RADIUS_M"] * 10.0e-3 / 3600.0, rel=1e-9, abs=0.0)


def test_a_thin_film_passes_what_a_sheet_of_current_leaves() -> None:
    """A film much thinner than the wave in water is a sheet: t = 1 / (1 + j k d (eps - 1) / 2); 1 without rain."""
    thickness_m = EFFECT["film_thickness_m"](0.01)
    water = 5.3 + (80.2 - 5.3) / (1.0 + 2j * math.pi * CARRIER_HZ * 9.4e-12)
    sheet = 1.0 / (1.0 + 1j * math.pi * CARRIER_HZ / 299_792_458.0 * thickness_m * (water - 1.0))
    # phase of the air that the film takes the place of
    air = cmath.exp(-2j * math.pi * CARRIER_HZ / 299_792_458.0 * thickness_m)
    passed = EFFECT["film_transmission"](0.01, CARRIER_HZ)
    assert abs(passed) == pytest.approx(abs(sheet), abs=1e-3)
    assert min(abs(passed - sheet), abs(passed - sheet * air)) < 5e-3
    assert EFFECT["film_transmission"](0.0, CARRIER_HZ) == pytest.approx(1.0, abs=1e-12)
    losses = [abs(EFFECT["film_transmission"](rain, CARRIER_HZ)) for rain in (0.1, 1.0, 10.0, 100.0)]
    assert losses == sorted(losses, reverse=True)


def test_the_scene_has_its_mesh_out_of_sight_and_rain() -> None:
    world = prepare(load_scene(EXAMPLES / "my_scene" / "rainy_yard.yaml"), 0)
    assert EFFECT["absent"](world) is None
    factor = EFFECT["factor"](None, world, True)
    assert factor == EFFECT["film_transmission"](10.0, world.radar.carrier_hz) ** 2
    assert EFFECT["factor"](None, world, False) == 1.0
    (tank,) = world.scene.objects
    assert tank.object_class == "tank"
    assert (tank.kind.length_m, tank.kind.width_m) == pytest.approx((2.4, 2.4))
