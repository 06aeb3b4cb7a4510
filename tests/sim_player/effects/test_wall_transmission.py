"""Ways through walls against slabs of glass and concrete."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest

from models.physics.fresnel import slab_transmission
from models.physics.materials import permittivity
from sim_player.effects.table import PATHS
from sim_player.scene.description import Scene, SceneObject
from sim_player.scene.world import prepare
from tests.sim_player.trace.point_scenes import RADAR, points_world, traced, unit_weight, wall

NAME = "wall_transmission"

BEHIND = (12.0, 3.0, 1.0)


def pane(material: str, thickness_mm: float, x: float = 6.0):  # type: ignore[no-untyped-def]
    return wall((x, -9.0), (x, 9.0), material=material, thickness_mm=thickness_mm)


def crossing(material: str, thickness_m: float, cosine: float) -> complex:
    """Slab against the air it stands for: t e^{+jkd cos}."""
    through = slab_transmission(
        permittivity(material, RADAR.carrier_hz), np.array(cosine), np.array(thickness_m), RADAR.wavelength_m
    )
    return complex(through * np.exp(2j * math.pi / RADAR.wavelength_m * thickness_m * cosine))


def test_glass_weakens_and_delays_there_and_back() -> None:
    """6 mm glass at x = 6, point (12, 3): straight echo times (t e^{jkd cos})^2; the table holds it to 5e-6."""
    cosine = 12.0 / math.hypot(12.0, 3.0)
    echo = traced(points_world([BEHIND], pane("glass", 6.0)), NAME).echoes[NAME]
    clear = traced(points_world([BEHIND]), "los_objects").echoes["los_objects"]
    ratio = unit_weight(echo) / unit_weight(clear)
    np.testing.assert_allclose(ratio, crossing("glass", 6e-3, cosine) ** 2, rtol=5e-6)
    np.testing.assert_allclose(echo.out_m, clear.out_m, rtol=1e-12)
    assert np.angle(ratio[0]) != pytest.approx(0.0, abs=0.1)


def test_two_panes_multiply() -> None:
    cosine = 12.0 / math.hypot(12.0, 3.0)
    echo = traced(points_world([BEHIND], pane("glass", 6.0), pane("glass", 4.0, 9.0)), NAME).echoes[NAME]
    clear = traced(points_world([BEHIND]), "los_objects").echoes["los_objects"]
    factor = crossing("glass", 6e-3, cosine) * crossing("glass", 4e-3, cosine)
    direct = echo.take(echo.order == 0)
    np.testing.assert_allclose(unit_weight(direct) / unit_weight(clear), factor**2, rtol=1e-5)


def test_thick_concrete_is_opaque() -> None:
    """10 GHz, square on, one way by the exact slab: 20 cm -41 dB, twice that there and back; 40 cm -81 dB, left out."""
    echo, none = (
        traced(points_world([(12.0, 0.0, 1.0)], pane("concrete", thick_mm)), NAME).echoes[NAME]
        for thick_mm in (200.0, 400.0)
    )
    clear = traced(points_world([(12.0, 0.0, 1.0)]), "los_objects").echoes["los_objects"]
    assert 20.0 * math.log10(abs(unit_weight(echo)[0] / unit_weight(clear)[0])) == pytest.approx(-82.0, abs=1.5)
    assert len(none) == 0


def test_mirrored_through_a_pane() -> None:
    """Point (4, 6) in the metal wall x = 16, glass x = 10 between: met on both legs, four times in all."""
    glass = wall((10.0, -9.0), (10.0, 9.0), material="glass", thickness_mm=6.0, role="occluder")
    point, relay = [(4.0, 6.0, 1.0)], wall((16.0, -9.0), (16.0, 9.0))
    clear = traced(points_world(point, relay), "specular_relay").echoes["specular_relay"]
    echoes = traced(points_world(point, relay, glass), NAME).echoes[NAME]
    echo = echoes.take(echoes.surface == 0)
    factor = crossing("glass", 6e-3, 28.0 / math.hypot(28.0, 6.0))
    np.testing.assert_allclose(unit_weight(echo) / unit_weight(clear), factor**4, rtol=2e-5)


def test_bodies_let_nothing_through() -> None:
    """A bus between the pane and the point: no way; beside it: seen through the pane."""
    bus = SceneObject(class_="bus", x_m=9.0, y_m=0.0, yaw_deg=90.0)
    scene = Scene(name="t", surfaces=(pane("glass", 6.0),), objects=(bus,))
    world = prepare(scene)
    count = 2
    points = dataclasses.replace(
        world,
        centre_m=np.array([[14.0, 0.0, 1.0], [14.0, 13.0, 1.0]]),
        centre_normals=np.tile([[-1.0, 0.0, 0.0]], (count, 2, 1)),
        centre_rcs_m2=np.ones(count),
        centre_phase_rad=np.zeros(count),
        centre_exponent=np.zeros(count),
        centre_floor=np.zeros(count),
        centre_object=np.zeros(count, int),
    )
    echoes = traced(points, NAME).echoes[NAME]
    assert echoes.point[:, 1].tolist() == [13.0]


def test_clear_ways_are_not_counted_again() -> None:
    """What nothing stands in belongs to other effects; a wall without a back lets nothing through."""
    clear = traced(points_world([BEHIND], pane("glass", 6.0, 20.0)), "los_objects", "specular_relay", NAME)
    assert len(clear.echoes["los_objects"]) == len(clear.echoes["specular_relay"]) == 1
    assert len(clear.echoes[NAME]) == 0
    endless = points_world([BEHIND], wall((6.0, -9.0), (6.0, 9.0), material="brick"))
    assert PATHS[NAME].absent(endless) == "every wall is too thick to have a back"
