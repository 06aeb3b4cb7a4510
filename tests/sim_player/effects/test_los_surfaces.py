"""Flashes and structure of walls in direct sight."""

from __future__ import annotations

import cmath
import math
from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from scipy.special import fresnel

from models.physics.curved_mirror import arc_normals, arc_points
from models.physics.fresnel import coherent_power, slab_reflection
from models.physics.materials import permittivity
from sim_player.effects.los_surfaces import flash_weight
from sim_player.paths.conversion import weights
from sim_player.scene.description import Ego, Surface
from sim_player.scene.world import World, snapshot
from sim_player.trace.echoes import Echoes
from tests.sim_player.trace.point_scenes import RADAR, WAVENUMBER, points_world, traced, unit_weight, wall

NAME = "los_surfaces"

FAR = [(-5.0, -300.0, 1.0)]


@pytest.mark.parametrize("effects", [{"slab_resonance", "rough_wall_loss"}, {"slab_resonance"}, set()])
def test_flash_is_one_bounce_on_a_round_trip(effects: set[str]) -> None:
    """P (lambda / (4 pi 2 d))^2 |r|^2 rho, complex r once, at 2 d; each factor only with its effect; 1e-12."""
    world = points_world(FAR, wall((9.0, -3.0), (9.0, 3.0), material="glass", thickness_mm=6.0, roughness_mm=0.4))
    echoes = traced(world, NAME).echoes[NAME]
    flash = echoes.take(np.arange(len(echoes)) == np.argmax(np.abs(echoes.weight)))
    eps = permittivity("glass", RADAR.carrier_hz)
    thickness = 6e-3 if "slab_resonance" in effects else math.inf
    r = slab_reflection(eps, np.array(1.0), np.array(thickness), RADAR.wavelength_m)
    left = math.sqrt(float(coherent_power(0.4e-3, np.array(1.0), RADAR.wavelength_m)))
    one = math.sqrt(1e3 * RADAR.transmit_power_w) * RADAR.wavelength_m / (4.0 * math.pi * 18.0)
    expected = one * complex(r) * (left if "rough_wall_loss" in effects else 1.0)
    assert weights(flash, world, frozenset(effects))[0] == pytest.approx(expected, rel=1e-12)
    assert flash.out_m[0] + flash.back_m[0] == pytest.approx(18.0)


def test_structure_follows_the_radar_equation() -> None:
    world = points_world(FAR, wall((9.0, 2.0), (9.0, 30.0)))
    echoes, specks = traced(world, NAME).echoes[NAME], world.speck_length_m == 0.0
    # behind the ends' own echoes
    echoes = echoes.take(np.arange(len(echoes)) >= len(echoes) - specks.sum())
    distance = np.hypot(*world.speck_m[specks].T)
    expected = np.sqrt(world.speck_rcs_m2[specks]) * world.speck_phasor[specks] / distance**2
    np.testing.assert_allclose(unit_weight(echoes), expected, rtol=1e-12)


def test_hidden_walls_do_not_flash() -> None:
    world = points_world(FAR, wall((9.0, -30.0), (9.0, 30.0)), wall((4.0, -3.0), (4.0, 3.0), role="occluder"))
    echoes = traced(world, NAME).echoes[NAME]
    assert not (np.isclose(echoes.point[:, 0], 9.0) & np.isclose(echoes.point[:, 1], 0.0)).any()


def test_flash_follows_a_turning_driving_radar() -> None:
    """Radar at (2, 0) after 1 s: 7 m left, straight ahead of the wall, closing at 2 m/s."""
    world = points_world(FAR, wall((9.0, -3.0), (9.0, 3.0)), ego=Ego(speed_mps=2.0))
    echoes = traced(world, NAME, time_s=1.0).echoes[NAME]
    flash = np.argmax(np.abs(echoes.weight))
    assert echoes.out_m[flash] == pytest.approx(7.0)
    assert echoes.rate_mps[flash] == pytest.approx(-2.0)


CONCRETE = {"material": "concrete", "thickness_mm": 300.0}


def bare_world(*surfaces: Surface) -> World:
    """Walls without structure."""
    world = points_world(FAR, *surfaces)
    kept = {name: getattr(world, name)[world.speck_length_m > 0.0] for name in vars(world) if name.startswith("speck_")}
    return replace(world, **kept)


def flash_of(*surfaces: Surface) -> complex:
    """Field of flash and ends of the wall 20 m away over that of a perfect mirror, phases included; no structure."""
    world = points_world(FAR, *surfaces)
    walls = {
        name: getattr(world, name)[world.speck_length_m > 0.0] for name in vars(world) if name.startswith("speck_")
    }
    found = traced(replace(world, **walls), NAME)
    echoes = found.echoes[NAME].take(found.echoes[NAME].out_m > 18.5)
    field = weights(echoes, world, frozenset({"slab_resonance"})) * np.exp(
        -1j * WAVENUMBER * (echoes.out_m + echoes.back_m)
    )
    one = flash_weight(found.view, np.array([40.0])) * cmath.exp(-40j * WAVENUMBER)
    return complex(field.sum() / one[0])


def line_integral(*points: tuple[float, float], distance_m: float = 20.0) -> complex:
    """Kirchhoff's integral over a polyline, heights by stationary phase, over that of an endless wall.

    sqrt(k / 2 pi) e^{j pi/4} cos / sqrt(2 s) / s e^{-2jks} ds; an endless wall gives e^{-2jkd} / 2d. Beyond 30 m from
    the foot it fades.
    """
    total = 0.0j
    for a, b in pairwise(np.array(points, np.float64)):
        share = np.linspace(0.0, 1.0, int(np.hypot(*(b - a)) / 1e-3) + 1)
        x, y = (a[:, None] + (b - a)[:, None] * share).reshape(2, -1)
        s, normal = np.hypot(x, y), np.array([b[1] - a[1], a[0] - b[0]]) / np.hypot(*(b - a))
        fade = np.cos(0.5 * np.pi * np.clip((np.abs(y) - 30.0) / 30.0, 0.0, 1.0)) ** 2
        each = fade * (normal[0] * x + normal[1] * y) / s**2 / np.sqrt(2.0 * s)
        phase = np.exp(-2j * WAVENUMBER * (s - distance_m))
        total += np.trapezoid(each * phase, share) * np.hypot(*(b - a))
    return complex(total * cmath.sqrt(1j * WAVENUMBER / (2.0 * np.pi)) * 2.0 * distance_m)


def db(ratio: complex) -> float:
    return 20.0 * math.log10(abs(ratio))


FREE = flash_of(wall((20.0, -60.0), (20.0, 60.0), **CONCRETE))


@pytest.mark.parametrize("end_m", np.arange(-10, 10) / 10.0)
def test_a_flash_ends_as_the_integral_over_the_wall(end_m: float) -> None:
    """The wall begins where its coordinate along itself is `end_m`; foot at 0. Known bias: a sheet's edge sends back
    (cos - 1) / cos, Kirchhoff's tan: 0.4 dB at 1 m. Within 0.45 dB, 20 dB under a free flash.
    """
    ours = flash_of(wall((20.0, float(end_m)), (20.0, 60.0), **CONCRETE)) / FREE
    assert db(ours / line_integral((20.0, float(end_m)), (20.0, 60.0))) == pytest.approx(0.0, abs=0.45)
    for shift in (1e-9, -1e-9, 1e-6):
        moved = flash_of(wall((20.0, float(end_m) + shift), (20.0, 60.0), **CONCRETE)) / FREE
        assert abs(moved - ours) < 1e-4


@pytest.mark.parametrize("turn_deg", [0.0, 17.0, 90.0, -133.0])
def test_a_joint_of_one_facade_is_no_end(turn_deg: float) -> None:
    """One facade drawn in one, two and three pieces, with a joint at the foot and near it, in any direction: 1e-4."""
    cosine, sine = math.cos(math.radians(turn_deg)), math.sin(math.radians(turn_deg))

    def drawn(*points: tuple[float, float]) -> complex:
        return flash_of(wall(*((cosine * x - sine * y, sine * x + cosine * y) for x, y in points), **CONCRETE))

    whole = drawn((20.0, -9.0), (20.0, 12.0))
    for joints in ((0.0,), (0.1,), (-0.4, 0.3)):
        assert abs(drawn((20.0, -9.0), *((20.0, at) for at in joints), (20.0, 12.0)) / whole - 1.0) < 1e-4


@pytest.mark.parametrize("bend_m", [1e-9, 1e-6, 1e-3, 0.03, 0.3, 1.0])
def test_a_bend_grows_from_nothing(bend_m: float) -> None:
    """Two pieces of 30 m that meet at the foot, bent to either side by a nanometre to 1 m: Kirchhoff's integral over
    both, within 0.1 dB, 0.3 dB where the bend throws 12 dB less back.
    """
    for middle_m in (20.0 + bend_m, 20.0 - bend_m):
        points = (20.0, -30.0), (middle_m, 0.0), (20.0, 30.0)
        expected = line_integral((20.0, -30.0), (middle_m, 0.0), (20.0, 30.0))
        assert abs(db(flash_of(wall(*points, **CONCRETE)) / FREE / expected)) < (0.1 if bend_m < 1.0 else 0.3)


def test_a_joint_of_two_materials_sends_back_their_difference() -> None:
    """Concrete up to the joint and metal from there on: each its own Fresnel integral; 0.3 dB at any joint within 1 m.

    At the foot itself: the mean of both fields, 0.5 %.
    """
    metal = flash_of(wall((20.0, -60.0), (20.0, 60.0)))
    for joint_m in (-0.9, -0.3, -0.1, 0.0, 0.2, 0.6):
        row = wall((20.0, -60.0), (20.0, joint_m), **CONCRETE), wall((20.0, joint_m), (20.0, 60.0))
        expected = FREE * line_integral((20.0, -60.0), (20.0, joint_m)) + metal * line_integral(
            (20.0, joint_m), (20.0, 60.0)
        )
        assert abs(db(flash_of(*row) / expected)) < 0.3
    row = wall((20.0, -60.0), (20.0, 0.0), **CONCRETE), wall((20.0, 0.0), (20.0, 60.0))
    assert abs(flash_of(*row) / (0.5 * (FREE + metal)) - 1.0) < 5e-3


@pytest.mark.parametrize("border_m", [-0.6, -0.3, -0.1, 0.0, 0.1, 0.2, 0.5])
@pytest.mark.parametrize("joint_m", [None, 0.15])
def test_a_shadow_cuts_the_integral_and_not_the_flash(border_m: float, joint_m: float | None) -> None:
    """A screen half-way hides the wall from `border_m` on: Kirchhoff's integral over what is left of it, 0.2 dB, drawn
    in one piece or two, one of them hidden or cut; a micrometre of the screen changes 1e-4.
    """
    points = ((20.0, -60.0), (20.0, 60.0)) if joint_m is None else ((20.0, -60.0), (20.0, joint_m), (20.0, 60.0))
    screens = [wall((10.0, 0.5 * border_m + shift), (10.0, 9.0)) for shift in (0.0, 1e-6, -1e-6)]
    ours = [flash_of(wall(*points, **CONCRETE), screen) / FREE for screen in screens]
    assert abs(db(ours[0] / line_integral((20.0, -60.0), (20.0, border_m)))) < 0.2
    assert np.abs(np.array(ours) - ours[0]).max() < 1e-4


def test_an_end_against_another_wall_or_in_a_corner_is_none() -> None:
    """A wall across the end of another one, which touches it to a tenth of a millimetre: nothing comes from there."""
    for gap_m in (0.0, 1e-4, -1e-4):
        world = points_world(FAR, wall((12.0, -9.0), (12.0, 9.0)), wall((12.0 - gap_m, 3.0), (4.0, 3.0)))
        echoes = traced(world, NAME).echoes[NAME]
        near = np.hypot(echoes.point[:, 0] - 12.0, echoes.point[:, 1] - 3.0) < 0.01
        assert not near.any()
    corner = points_world(FAR, wall((12.0, -9.0), (12.0, 5.0), (-9.0, 5.0)))
    point = traced(corner, NAME).echoes[NAME].point
    assert not (np.hypot(point[:, 0] - 12.0, point[:, 1] - 5.0) < 0.01).any()


@pytest.mark.parametrize("curvature_per_m", [1e-8, 0.01, 0.03, -0.1, 0.1, 0.2])
def test_the_flash_of_an_arc_ends_as_its_integral(curvature_per_m: float) -> None:
    """Arcs upright at (20, 0), hollow and bulging, before and beyond their focus: Kirchhoff's integral from the end on,
    0.3 dB down to -13 dB, 1 dB below. The far end, which fades in the integral, is left out of the echoes.
    """
    for begin_m in (-0.6, -0.3, -0.1, 0.0, 0.1, 0.3, 0.6):
        turns = curvature_per_m * (begin_m + np.array([0.0, 4.0]))
        x, y = 20.0 - (1.0 - np.cos(turns)) / curvature_per_m, np.sin(turns) / curvature_per_m
        a, b = ((float(x[end]), float(y[end])) for end in range(2))
        arc = wall(a, b, curvature_per_m=curvature_per_m)
        world = bare_world(arc)
        names = (NAME, "curved_wall") if world.is_curved.any() else (NAME,)
        field = 0.0j
        for echoes in traced(world, *names).echoes.values():
            near = np.hypot(*(echoes.point[:, :2] - b).T) > 1.0
            field += _field(world, echoes.take(near & (echoes.object_index < 0)))
        share = np.linspace(0.0, 1.0, 8001)
        place, normal = (of(np.array(a), np.array(b), curvature_per_m, share) for of in (arc_points, arc_normals))
        s = np.hypot(*place.T)
        each = np.abs(np.sum(place * normal, axis=1)) / s**2 / np.sqrt(2.0 * s) * np.exp(-2j * WAVENUMBER * s)
        fade = np.cos(0.5 * np.pi * np.clip((share - 0.6) / 0.4, 0.0, 1.0)) ** 2
        whole = np.trapezoid(each * fade, share) * 4.0 * cmath.sqrt(1j * WAVENUMBER / (2.0 * np.pi))
        flash = flash_weight(snapshot(world), np.array([40.0]))[0] * 40.0
        error_db, level_db = db(field / (flash * whole)), db(40.0 * whole)
        assert abs(error_db) < (0.3 if level_db > -13.0 else 1.0), (begin_m, level_db)


def _field(world: World, echoes: Echoes) -> complex:
    """Sum of some echoes' fields."""
    phase = np.exp(-1j * WAVENUMBER * (echoes.out_m + echoes.back_m))
    return complex((weights(echoes, world, frozenset({"slab_resonance"})) * phase).sum())


def fresnel_share(clearance_m: float, before_m: float, behind_m: float) -> complex:
    """Share of a wave that passes an edge, 1/2 + (1 + j)/2 (C - jS), by scipy."""
    v = clearance_m * math.sqrt(2.0 / RADAR.wavelength_m * (1.0 / before_m + 1.0 / behind_m))
    s, c = fresnel(v)
    return complex(0.5 + 0.5 * (1.0 + 1.0j) * (c - 1.0j * s))


POINT = (4.0, 6.0, 2.0)
#: Effect, scene by the height of its mirror, height at which the ray meets that, and the ray before and behind.
TOPS: dict[str, tuple[Callable[[float], list[Surface]], float, float, float]] = {
    "specular_relay": (
        lambda height_m: [wall((12.0, -5.0), (12.0, 9.0), height_m=height_m)],
        1.6,
        0.6 * math.sqrt(437.0),
        0.4 * math.sqrt(437.0),
    ),
    # met in its middle, 100 - sqrt(100^2 - 7^2) m behind its chord; the radar and the point both 4 m beside that
    "curved_wall": (
        lambda height_m: [wall((12.0, -3.0), (12.0, 11.0), height_m=height_m, curvature_per_m=0.01)],
        1.5,
        0.5 * math.sqrt((224.0 - 2.0 * math.sqrt(9951.0)) ** 2 + 65.0),
        0.5 * math.sqrt((224.0 - 2.0 * math.sqrt(9951.0)) ** 2 + 65.0),
    ),
    "ground_bounce": (
        lambda height_m: [
            wall((12.0, -5.0), (12.0, 9.0), height_m=height_m),
            Surface(role="ground", material="asphalt"),
        ],
        0.8,
        0.6 * math.sqrt(445.0),
        0.4 * math.sqrt(445.0),
    ),
}


@pytest.mark.parametrize("name", [*TOPS, NAME])
@pytest.mark.parametrize("clearance_m", [-0.5, -0.1, 0.0, 0.05, 0.3, 20.0])
def test_a_mirror_ends_at_its_top_as_a_wave_does(name: str, clearance_m: float) -> None:
    """Fresnel's integral over the heights, by scipy, times the ray under a wall without end; 1/2 at the top, 1e-3."""
    if name == NAME:
        high, low = (flash_of(wall((20.0, -9.0), (20.0, 9.0), height_m=1.0 + over)) for over in (99.0, clearance_m))
        share, expected = low / high, fresnel_share(clearance_m, 20.0, 20.0)
    else:
        scene, at_m, before_m, behind_m = TOPS[name]
        other = []
        for over in (99.0, clearance_m):
            world = points_world([(0.0, 8.0, 2.0) if name == "curved_wall" else POINT], *scene(at_m + over))
            routes = traced(world, name).routes[name]
            other.append(complex(routes.other[routes.wall == 0][0]))
        rise_m = 3.0 if name == "ground_bounce" else 1.0
        upright = math.sqrt(1.0 - (rise_m / (before_m + behind_m)) ** 2)
        share, expected = other[1] / other[0], fresnel_share(clearance_m * upright, before_m, behind_m)
    assert share == pytest.approx(1.0 if clearance_m > 9.0 else expected, abs=1e-3)
