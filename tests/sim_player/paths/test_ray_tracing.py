"""Paths against the radar equation, the image method and shadows worked out by hand."""

from __future__ import annotations

import math

import msgspec
import numpy as np
import pytest
from scipy.spatial import cKDTree

from models.physics.attenuation import gas_db_per_m, rain_db_per_m, vegetation_db
from models.physics.fresnel import coherent_power, half_space_reflection, slab_reflection, stack_reflection
from models.physics.materials import permittivity
from models.physics.mirror import reflect, specular_points
from msgs.values.perception import PathClass
from msgs.values.radar import RadarParams, RadarSetup
from sim_player.effects.table import ALL_EFFECTS
from sim_player.paths.conversion import weights
from sim_player.paths.ray_tracing import trace, trace_each
from sim_player.scene.description import Ego, Scene, SceneObject, SceneRadar, Surface, Weather
from sim_player.scene.world import prepare, snapshot
from sim_player.trace.echoes import Echoes, echo_amplitude
from sim_player.trace.effect_names import PATH_EFFECTS, bit
from sim_player.trace.path_table import Paths

RADAR = RadarParams()


def wall(*ends: tuple[float, float], material: str = "metal", role: str = "relay", **more: float) -> Surface:
    return Surface(role=role, material=material, polyline_m=ends, height_m=more.pop("height_m", 5.0), **more)


def car(x_m: float, y_m: float, **more: float) -> SceneObject:
    return SceneObject(class_="car", x_m=x_m, y_m=y_m, **more)


def paths_of(*parts: Surface | SceneObject, time_s: float = 0.0, seed: int = 0, ego: Ego | None = None) -> Paths:
    scene = Scene(
        name="test",
        surfaces=tuple(part for part in parts if isinstance(part, Surface)),
        objects=tuple(part for part in parts if isinstance(part, SceneObject)),
        ego=Ego() if ego is None else ego,
    )
    return trace(prepare(scene, seed), time_s)


def mirrored(paths: Paths) -> Paths:
    return paths.take(paths.kind == PathClass.MIRRORED)


def objects_seen(paths: Paths) -> set[int]:
    return set(paths.object_index[(paths.kind == PathClass.LOS) & (paths.object_index >= 0)].tolist())


@pytest.mark.parametrize("range_m", [10.0, 20.0, 50.0, 100.0])
def test_a_cars_echo_follows_its_seen_rcs(range_m: float) -> None:
    """Head-on car: the sum of path powers is the radar equation for the front's RCS, mean over seeds within 1 dB.

    The front lies within half a metre of range_m - 2.25: bias below 0.1 dB at 10 m and beyond.
    """
    level = []
    for seed in range(30):
        world = prepare(Scene(name="t", objects=(car(range_m + 2.25, 0.0, yaw_deg=180.0),)), seed)
        paths = trace(world)
        rcs = (np.abs(paths.amplitude) ** 2 * (0.5 * paths.length_m) ** 4).sum()
        level.append(rcs * (4.0 * math.pi) ** 3 / (1.6 * RADAR.wavelength_m**2))
        assert 0.5 * paths.length_m.min() == pytest.approx(range_m, abs=0.06)
    # the faces' lobes put the front near the mean over all aspects
    assert 10.0 * math.log10(np.mean(level)) == pytest.approx(11.25, abs=3.0)


@pytest.mark.parametrize("distance_m", [5.0, 20.0, 60.0])
def test_flash_of_a_metal_wall_is_the_image_of_the_radar(distance_m: float) -> None:
    """Layout: metal wall across at d. Analytic: P (lambda / (4 pi 2d))^2 |r|^2 at range d; |r| = 1 - 2.4e-4."""
    paths = paths_of(wall((distance_m, -5.0), (distance_m, 5.0)))
    flash = paths.take(np.abs(paths.amplitude) == np.abs(paths.amplitude).max())
    power_mw = 1.6 * (RADAR.wavelength_m / (4.0 * math.pi * 2.0 * distance_m)) ** 2
    assert np.abs(flash.amplitude[0]) ** 2 == pytest.approx(power_mw, rel=1e-3, abs=0.0)
    assert flash.length_m[0] == pytest.approx(2.0 * distance_m)
    assert flash.azimuth_rad[0] == pytest.approx(0.0)
    # the image of an ideal mirror is the radar, phase turned: r = -1
    assert flash.amplitude[0].real < 0.0


def test_flash_needs_the_foot_on_the_wall() -> None:
    across = paths_of(wall((10.0, 1.0), (10.0, 9.0)))
    power_mw = 1.6 * (RADAR.wavelength_m / (4.0 * math.pi * 20.0)) ** 2
    assert np.abs(across.amplitude).max() ** 2 < 0.1 * power_mw


def test_mirrored_paths_obey_the_law_of_reflection() -> None:
    """Layout: wall at an angle, a car; every path's specular point mirrors the angle, its length is the image's.

    Tolerance 1e-12 relative: the image method is exact up to rounding.
    """
    a, b = (16.0, -9.0), (23.0, 12.0)
    found = mirrored(paths_of(wall(a, b), car(6.0, 9.0, yaw_deg=40.0)))
    assert len(found) > 10
    point = specular_points(np.zeros(2), found.point_m[:, :2], np.array(a), np.array(b))
    assert not np.isnan(point).any()
    normal = np.array([b[1] - a[1], a[0] - b[0]]) / math.dist(a, b)
    incoming = point / np.linalg.norm(point, axis=1, keepdims=True)
    leaving = found.point_m[:, :2] - point
    legs = np.linalg.norm(point, axis=1) + np.linalg.norm(leaving, axis=1)
    leaving /= np.linalg.norm(leaving, axis=1, keepdims=True)
    np.testing.assert_allclose(incoming @ normal, -(leaving @ normal), atol=1e-12)
    height = found.point_m[:, 2]
    np.testing.assert_allclose(0.5 * found.length_m, np.hypot(legs, height), rtol=1e-12)
    np.testing.assert_allclose(found.azimuth_rad, np.arctan2(point[:, 1], point[:, 0]), atol=1e-12)
    np.testing.assert_allclose(0.5 * found.length_m, np.linalg.norm(found.virtual_m, axis=1), rtol=1e-12)


def test_mirrored_field_takes_reflection_twice() -> None:
    """Same geometry in metal and in rough concrete: amplitudes differ by (r sqrt(rho))^2, Eq. (3) with field gains."""
    ends, thing = ((20.0, -9.0), (20.0, 12.0)), car(8.0, 8.0, yaw_deg=90.0)
    metal = mirrored(paths_of(wall(*ends), thing))
    concrete = mirrored(paths_of(wall(*ends, material="concrete", roughness_mm=1.5), thing))
    cosine = metal.virtual_m[:, 0] / np.linalg.norm(metal.virtual_m, axis=1)
    field = [
        half_space_reflection(permittivity(name, 10e9), cosine)
        * np.sqrt(coherent_power(1e-3 * roughness, cosine, RADAR.wavelength_m))
        for name, roughness in (("metal", 0.0), ("concrete", 1.5))
    ]
    np.testing.assert_allclose(concrete.amplitude / metal.amplitude, (field[1] / field[0]) ** 2, rtol=1e-12)


def test_mirrored_power_spreads_over_the_virtual_range() -> None:
    """Eq. (5): the car seen in a metal wall is as bright as its image in free space.

    Layout: wall at x = 20, car at (5, 6); free space: the mirror-symmetric car at (35, 6). Only the sides swap, so
    the specular seeds are matched by comparing RCS-free products: |W| L'^2 / L_image^2 per centre.
    """
    found = mirrored(paths_of(wall((20.0, -9.0), (20.0, 12.0)), car(5.0, 6.0)))
    world = prepare(Scene(name="t", objects=(car(5.0, 6.0),)), 0)
    image = reflect(world.centre_m, np.array([-1.0, 0.0]), 20.0)
    distance = np.linalg.norm(image - np.array([0.0, 0.0, 1.0]), axis=1)
    for path_length, amplitude in zip(0.5 * found.length_m, np.abs(found.amplitude), strict=True):
        nearest = np.argmin(np.abs(distance - path_length))
        assert path_length == pytest.approx(distance[nearest], rel=1e-12)
        most = echo_amplitude(RADAR, world.centre_rcs_m2[nearest], path_length)
        assert amplitude <= most * (1.0 + 1e-12)


def test_shadows_of_walls_and_cars() -> None:
    screen = wall((8.0, -3.0), (8.0, 3.0), role="occluder")
    assert objects_seen(paths_of(screen, car(15.0, 0.0))) == set()
    assert objects_seen(paths_of(screen, car(15.0, 9.0))) == {0}
    bus = SceneObject(class_="bus", x_m=9.0, y_m=0.0, yaw_deg=90.0)
    assert objects_seen(paths_of(bus, car(20.0, 0.0))) == {0}
    # the car is behind the wall that should mirror it
    assert len(mirrored(paths_of(wall((10.0, -9.0), (10.0, 9.0)), car(15.0, 0.0)))) == 0


def test_both_legs_of_a_mirror_path_must_be_free() -> None:
    """Screens on the way out and on the way on (they may mirror the car themselves: only the relay's paths count)."""
    relay, thing = wall((20.0, -9.0), (20.0, 12.0)), car(6.0, 9.0, yaw_deg=90.0)
    first_leg = wall((12.0, 1.5), (12.0, 5.5), role="occluder")
    second_leg = wall((12.0, 4.8), (12.0, 11.5), role="occluder")
    count = [
        (mirrored(paths_of(relay, *screens, thing)).surface == 0).sum() for screens in ((), (first_leg,), (second_leg,))
    ]
    assert count[0] > 10
    assert count[1:] == [0, 0]


def test_rays_pass_over_low_walls() -> None:
    """A kerb of 0.2 m hides nothing; neither does it mirror a radar at 1 m close by."""
    kerb = wall((2.0, -0.3), (2.0, 0.3), height_m=0.2)
    paths = paths_of(kerb, car(15.0, 0.0))
    assert objects_seen(paths) == {0}
    assert (paths.surface == -1).all()


def test_mirror_windows_end_where_the_wall_ends() -> None:
    """A car is split by the window's edge: centres with the specular point beyond the end are missing, others not."""
    relay = wall((20.0, -9.0), (20.0, 4.0))
    thing = car(6.0, 7.0, yaw_deg=90.0)
    whole = mirrored(paths_of(wall((20.0, -9.0), (20.0, 12.0)), thing))
    part = mirrored(paths_of(relay, thing))
    at_wall = 20.0 * whole.virtual_m[:, 1] / whole.virtual_m[:, 0]
    assert 0 < len(part) < len(whole)
    assert len(part) == (at_wall <= 4.0).sum()


@pytest.mark.parametrize("ego_mps", [0.0, 8.0])
def test_radial_speed_is_the_rate_of_the_length(ego_mps: float) -> None:
    """Central difference over 2 ms against the stated rate; its error is j dt^2 / 6, jerk j ~ v^3 / R^2 < 200 m/s^3."""
    scene = Scene(
        name="t",
        surfaces=(wall((20.0, -9.0), (21.0, 12.0)),),
        objects=(car(8.0, 9.0, yaw_deg=-80.0, speed_mps=15.0), car(14.0, -4.0, yaw_deg=20.0, speed_mps=5.0)),
        ego=Ego(speed_mps=ego_mps, yaw_rate_dps=10.0),
    )
    world = prepare(scene)
    before, now, after = (trace(world, 0.05 + shift_s) for shift_s in (-1e-3, 0.0, 1e-3))
    assert len(before) == len(now) == len(after)
    rate = 0.5 * (after.length_m - before.length_m) / 2e-3
    np.testing.assert_allclose(now.radial_speed_mps, rate, atol=4e-5)
    assert np.abs(now.radial_speed_mps).max() > 4.0


def test_points_follow_the_radars_own_frame() -> None:
    """After driving 8 m the wall at 20 m is 12 m ahead."""
    paths = paths_of(wall((20.0, -5.0), (20.0, 5.0)), time_s=1.0, ego=Ego(speed_mps=8.0))
    np.testing.assert_allclose(paths.point_m[:, 0], 12.0, atol=1e-12)
    turned = paths_of(wall((20.0, -5.0), (20.0, 5.0)), time_s=1.0, ego=Ego(yaw_rate_dps=10.0))
    flash = np.argmax(np.abs(turned.amplitude))
    assert turned.azimuth_rad[flash] == pytest.approx(-math.radians(10.0))


def test_rough_walls_are_seen_obliquely_and_smooth_ones_less() -> None:
    """Diffuse power off the perpendicular grows with the energy roughness takes from the mirror."""
    power = []
    for roughness_mm in (0.1, 0.5, 2.0):
        paths = paths_of(wall((4.0, -6.0), (40.0, -6.0), material="concrete", roughness_mm=roughness_mm))
        oblique = (np.degrees(paths.azimuth_rad) > -40.0) & (paths.length_m > 0)
        power.append(np.median(np.abs(paths.amplitude[oblique]) ** 2))
    assert power[0] < power[1] < power[2]


def test_phases_are_the_scenes_own() -> None:
    """Same seed: same paths, at any time a scene at rest; another seed draws other phases."""
    parts = wall((20.0, -5.0), (20.0, 5.0)), car(8.0, 8.0)
    one, later, other = paths_of(*parts), paths_of(*parts, time_s=7.0), paths_of(*parts, seed=1)
    np.testing.assert_array_equal(one.amplitude, later.amplitude)
    assert not np.array_equal(one.amplitude[:20], other.amplitude[:20])


def test_empty_view_has_no_paths() -> None:
    paths = paths_of(wall((1.2, 1.0), (1.6, 1.0), height_m=0.2))
    assert len(paths) == 0
    assert paths.point_m.shape == (0, 3)


def test_setup_may_be_replaced() -> None:
    """Four times the transmit power doubles every amplitude."""
    scene = Scene(name="t", objects=(car(10.0, 0.0),))
    louder = RadarSetup(radar=msgspec.structs.replace(RADAR, transmit_power_w=6.4e-3))
    np.testing.assert_allclose(trace(prepare(scene, 0, louder)).amplitude, 2.0 * trace(prepare(scene, 0)).amplitude)


def test_driving_through_everything_stays_finite() -> None:
    """Ego runs along a car's side over its centres, through a wall, and along another's line: finite, no warning."""
    scene = Scene(
        name="t",
        surfaces=(wall((8.0, 0.0), (16.0, 0.0)), wall((10.0, -4.0), (10.0, -0.5)), wall((18.0, -2.0), (18.0, 2.0))),
        objects=(car(5.0, 0.9),),
        ego=Ego(speed_mps=1.0),
    )
    world = prepare(scene)
    at_centre = [float(x) for x, y, _ in world.centre_m if abs(y) < 1e-9]
    assert len(at_centre) > 10
    for time_s in [*at_centre, 7.9, 8.0, 10.0, 12.0, 18.0, 20.0]:
        paths = trace(world, time_s)
        for field in ("length_m", "radial_speed_mps", "azimuth_rad", "elevation_rad", "amplitude", "virtual_m"):
            assert np.isfinite(getattr(paths, field)).all(), (time_s, field)


def test_negative_seeds_are_refused() -> None:
    with pytest.raises(ValueError, match="seed must not be negative, got -1"):
        prepare(Scene(name="t", objects=(car(10.0, 0.0),)), seed=-1)


def test_77_ghz_scene_uses_its_own_aperture() -> None:
    scene = Scene(name="t", radar=SceneRadar(preset="77ghz"), surfaces=(wall((10.0, -4.0), (10.0, 4.0)),))
    assert scene.setup.array.columns == 57
    flash = np.abs(trace(prepare(scene)).amplitude).max()
    assert flash == pytest.approx(math.sqrt(1.6) * scene.setup.radar.wavelength_m / (4.0 * math.pi * 20.0), rel=2e-3)


def everything(ego: Ego) -> Scene:
    """Corner, bulging wall, pane, screen, hedge, ground and two cars: every path effect has something to do."""
    return Scene(
        name="t",
        surfaces=(
            wall((26.0, -14.0), (26.0, 13.0), (-6.0, 13.0), material="concrete", roughness_mm=0.8, thickness_mm=200.0),
            wall((-4.0, -16.0), (22.0, -16.0), material="brick", curvature_per_m=-0.01),
            wall((9.0, 3.0), (9.0, 4.5), material="glass", thickness_mm=6.0, role="occluder"),
            wall((7.0, -7.0), (7.0, -3.5), role="occluder"),
            wall((14.0, 2.0), (14.0, 6.0), material="vegetation", thickness_mm=600.0),
            Surface(role="ground", material="asphalt"),
        ),
        objects=(car(15.0, 8.0, yaw_deg=-80.0, speed_mps=12.0), car(13.0, -7.0, yaw_deg=30.0, speed_mps=6.0)),
        ego=ego,
    )


def nearest(now: Echoes, then: Echoes) -> np.ndarray:
    """Which echo of another instant each echo is (-1: none): same thing and wall, nearly the same lengths and ways."""

    def place(echoes: Echoes) -> np.ndarray:
        labels = [echoes.object_index, echoes.surface, echoes.order]
        lengths = [echoes.out_m, echoes.back_m]
        return np.column_stack([100.0 * np.stack(labels, axis=1), *lengths, echoes.depart, echoes.arrive, echoes.point])

    distance, index = cKDTree(place(then)).query(place(now))
    return np.where(distance < 0.02, index, -1)


@pytest.mark.parametrize(("speed_mps", "yaw_rate_dps"), [(0.0, 0.0), (9.0, 25.0)])
def test_radial_speed_of_every_effect_is_the_rate_of_the_length(speed_mps: float, yaw_rate_dps: float) -> None:
    """All effects: central difference over 4e-5 s; a jerk of 3000 m/s^3 adds 2e-7, rounding 1e-9; tolerance 2e-6.

    Each effect is checked by itself; paths that begin or end within the step (one, or 3 %) have no partner.
    """
    world = prepare(everything(Ego(speed_mps=speed_mps, yaw_rate_dps=yaw_rate_dps)))
    steps = [trace_each(snapshot(world, 0.05 + shift_s), ALL_EFFECTS) for shift_s in (-2e-5, 0.0, 2e-5)]
    assert set(steps[1]) == set(PATH_EFFECTS)
    for name in PATH_EFFECTS:
        before, now, after = (step[name] for step in steps)
        assert len(now) > 0, name
        early, late = nearest(now, before), nearest(now, after)
        known = np.flatnonzero((early >= 0) & (late >= 0))
        assert len(now) - len(known) <= max(1, 0.03 * len(now)), name
        now, before, after = now.take(known), before.take(early[known]), after.take(late[known])
        rate = 0.5 * (after.out_m + after.back_m - before.out_m - before.back_m) / 4e-5
        np.testing.assert_allclose(now.rate_mps, rate, atol=2e-6, err_msg=name)


def test_paths_say_which_effects_they_need() -> None:
    """Every echo of an effect carries that effect's bit, or that of the effect it takes its way from."""
    for name, echoes in trace_each(snapshot(prepare(everything(Ego()))), ALL_EFFECTS).items():
        assert ((echoes.needs & bit(name)) != 0).all(), name


def test_weights_of_foliage_and_air() -> None:
    """Straight paths of 15 m through a hedge: its loss over the slant depth; gas and rain over both ways.

    Field 10^(-dB/20): foliage met twice; closed forms of `models.physics.attenuation`; table steps of 1e-3: rel 1e-4.
    """
    scene = Scene(
        name="t",
        surfaces=(wall((6.0, -9.0), (6.0, 9.0), material="vegetation", thickness_mm=800.0),),
        objects=(car(15.0, 4.0),),
        weather=Weather(rain_mm_per_h=25.0),
    )
    world = prepare(scene)
    view = snapshot(world)
    echoes = trace_each(view, frozenset({"los_objects"}))["los_objects"]
    bare = weights(echoes, world, frozenset())
    thinned = weights(echoes, world, frozenset({"vegetation"}))
    cosine = echoes.depart[:, 0]
    depth_m = 0.8 / cosine
    loss_db = vegetation_db(RADAR.carrier_hz, depth_m)
    np.testing.assert_allclose(np.abs(thinned / bare), 10.0 ** (-2.0 * loss_db / 20.0), rtol=1e-4)
    airy = weights(echoes, world, frozenset({"atmosphere"}))
    # 25 mm/h at 10 GHz, vertical polarisation: 0.01129 * 25^1.2156 dB/km by P.838-3, Table 5; gases are 0.014 dB/km
    assert rain_db_per_m(RADAR.carrier_hz, 25.0) == pytest.approx(0.565e-3, rel=1e-3)
    per_m = gas_db_per_m(RADAR.carrier_hz, 15.0, 1013.25, 7.5) + 1e-3 * 0.01129 * 25.0**1.2156
    np.testing.assert_allclose(np.abs(airy / bare), 10.0 ** (-per_m * 2.0 * echoes.out_m / 20.0), rtol=1e-6)


def test_planned_weights_switch_rough_and_slab() -> None:
    """Mirrored by a rough pane: whole slab or front face by slab_resonance, sqrt(rho) per bounce by rough_wall_loss."""
    relay = wall((20.0, -9.0), (20.0, 12.0), material="glass", thickness_mm=6.0, roughness_mm=0.8)
    world = prepare(Scene(name="t", surfaces=(relay,), objects=(car(8.0, 8.0, yaw_deg=90.0),)))
    echoes = trace_each(snapshot(world), frozenset({"specular_relay"}))["specular_relay"]
    cosine = echoes.depart[:, 0]
    eps = permittivity("glass", RADAR.carrier_hz)
    front = half_space_reflection(eps, cosine)
    slab = slab_reflection(eps, cosine, np.array(6e-3), RADAR.wavelength_m)
    plain = weights(echoes, world, frozenset())
    np.testing.assert_allclose(weights(echoes, world, frozenset({"slab_resonance"})) / plain, (slab / front) ** 2)
    rho = coherent_power(0.8e-3, cosine, RADAR.wavelength_m)
    np.testing.assert_allclose(weights(echoes, world, frozenset({"rough_wall_loss"})) / plain, rho)


def test_builds_of_several_layers_reflect_as_stacks() -> None:
    """Double glazing among single panes: each piece by its own build, `stack_reflection`; rounding."""
    walls = [
        wall((20.0, -9.0), (20.0, 12.0), material="glass", thickness_mm=4.0),
        wall((22.0, -9.0), (22.0, 12.0), material="double_glazing"),
        wall((24.0, -9.0), (24.0, 12.0), material="concrete"),
    ]
    world = prepare(Scene(name="t", surfaces=tuple(walls)))
    cosine = np.linspace(0.05, 1.0, 30)
    which = np.arange(30) % 3
    whole, front, _ = world.reflection(which, cosine)
    for index in range(3):
        layers = world.stacks[world.wall_stack[index]]
        here = which == index
        expected = stack_reflection([e for e, _ in layers], [d for _, d in layers], cosine[here], RADAR.wavelength_m)
        np.testing.assert_allclose(whole[here], expected, rtol=1e-12)
        np.testing.assert_allclose(front[here], half_space_reflection(layers[0][0], cosine[here]), rtol=1e-12)
