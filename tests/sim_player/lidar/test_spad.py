"""A single-photon LiDAR in scenes: where paths lie, what they bring, what is left out, and histograms of them."""

from __future__ import annotations

import math

import msgspec
import numpy as np
import pytest

from models.physics.photons.optics import OBJECT_ALBEDO, OPTICAL, fresnel_power, matt_albedo, photons_per_pulse
from msgs.values.lidar import LidarSetup, SpadParams
from msgs.values.perception import PathClass
from msgs.values.radar import RangeAzimuthGrid
from msgs.values.units import SPEED_OF_LIGHT_MPS
from sim_player.bodies.triangles import cut_triangles
from sim_player.lidar.optical_surfaces import _cut
from sim_player.lidar.spad import LightRoute, OpticalPaths, optical_paths, plan_optics, spad_histograms
from sim_player.paths.ray_tracing import trace
from sim_player.scene.description import Scene, SceneObject, SceneRadar, Surface
from sim_player.scene.world import prepare
from tests.sim_player.lidar.references import expected_histograms, label_paths

#: Azimuths -60, 0, 60 deg: the middle one looks straight ahead.
AHEAD = RangeAzimuthGrid(azimuth_bins=3)
#: Gated, unambiguous to 59.96 m, no ambient light.
DARK = SpadParams(repetition_rate_hz=2.5e6, arming="gated", ambient_rate_hz=0.0, jitter_rms_s=0.0, tick_s=0.0)
#: Nothing is left out.
SURE = 0.0


def lidar(spad: SpadParams = DARK, grid: RangeAzimuthGrid = AHEAD) -> LidarSetup:
    return LidarSetup(spad=spad, grid=grid)


def place(*surfaces: Surface, objects: tuple[SceneObject, ...] = (), **more: object) -> Scene:
    return Scene(name="test", radar=SceneRadar(preset="spad"), surfaces=surfaces, objects=objects, **more)  # type: ignore[arg-type]


def wall(*ends: tuple[float, float], material: str = "glass", role: str = "relay", **more: float) -> Surface:
    return Surface(role=role, material=material, polyline_m=ends, **more)  # type: ignore[arg-type]


def plate(x_m: float, y_m: float, size_m: float = 0.2, yaw_deg: float = 0.0, z_m: float = 0.9) -> SceneObject:
    """One small facet, its face along its own x."""
    return SceneObject(
        primitive="plate", size_m=(size_m, size_m), material="plasterboard", x_m=x_m, y_m=y_m, yaw_deg=yaw_deg, z_m=z_m
    )


def found(scene: Scene, setup: LidarSetup, budget: float = SURE, route: LightRoute | None = None) -> OpticalPaths:
    paths = optical_paths(prepare(scene), setup, 0.0, budget)
    return paths if route is None else paths.take(paths.route == route)


@pytest.mark.parametrize("range_m", [3.0, 10.25, 47.0])
def test_transient_of_one_facet_at_the_exact_bin(range_m: float) -> None:
    """A plate straight ahead, pulse 200 ps in bins of 0.78 ns: most of its light lies in the bin of 2 r / c."""
    setup = lidar()
    paths = found(place(objects=(plate(range_m, 0.0),)), setup)
    assert paths.azimuth_index.tolist() == [1]
    assert paths.range_m[0] == pytest.approx(range_m, abs=1e-9)
    assert paths.kind[0] == PathClass.LOS
    assert paths.object_index[0] == 0
    mean = expected_histograms(setup, paths)
    assert np.unravel_index(mean.argmax(), mean.shape) == (1, int(2.0 * range_m / SPEED_OF_LIGHT_MPS / DARK.bin_s))
    assert mean[[0, 2]].sum() == 0.0


def test_direct_return_by_hand() -> None:
    """Plasterboard plates at 4 m and 8 m head-on, and a car's front: albedo (a / r)^2 of what was sent, so r^-2."""
    near, far = (found(place(objects=(plate(range_m, 0.0),)), lidar()) for range_m in (4.0, 8.0))
    sent = photons_per_pulse(DARK)
    white = matt_albedo(OPTICAL["plasterboard"])
    assert far.photons[0] == pytest.approx(sent * white * (5e-3 / 8.0) ** 2, rel=1e-6)
    assert near.photons[0] / far.photons[0] == pytest.approx(4.0, rel=2e-6)
    car = found(place(objects=(SceneObject(class_="car", x_m=10.0, y_m=0.0),)), lidar())
    assert car.range_m[0] == pytest.approx(7.75)
    assert car.photons[0] == pytest.approx(sent * OBJECT_ALBEDO["car"] * (5e-3 / 7.75) ** 2, rel=1e-6)


def slanted(roughness_mm: float = 0.0, material: str = "glass") -> Scene:
    """A wall across the ray at 45 deg, 6 m ahead, turns it to the left onto a plate 5 m on that faces it."""
    return place(
        wall((4.0, -2.0), (8.0, 2.0), material=material, roughness_mm=roughness_mm),
        objects=(plate(6.0, 5.0, yaw_deg=-90.0),),
    )


def test_mirror_path_ends_at_the_image() -> None:
    """The image of (6, 5) in x - y = 6 is (11, 0): 11 m, and R_s^2 of the direct return from there."""
    path = found(slanted(), lidar(), route=LightRoute.MIRROR)
    assert path.range_m[0] == pytest.approx(11.0, abs=1e-9)
    assert path.kind[0] == PathClass.MIRRORED
    assert path.object_index[0] == 0
    mirror = float(fresnel_power(1.51, math.sqrt(0.5)))
    white = matt_albedo(OPTICAL["plasterboard"])
    assert path.photons[0] == pytest.approx(photons_per_pulse(DARK) * mirror**2 * white * (5e-3 / 11.0) ** 2, rel=1e-6)


@pytest.mark.parametrize(
    ("blocker", "mirrored"),
    [
        (plate(3.0, 0.0), []),
        (plate(6.0, 2.5, yaw_deg=-90.0), [(1, 8.5)]),
        (plate(6.0, 7.0, yaw_deg=-90.0), [(0, 11.0)]),
        (plate(9.0, 0.0), [(0, 11.0)]),
        # its lower edge over the level rays
        (plate(6.0, 2.5, yaw_deg=-90.0, z_m=1.05), [(0, 11.0)]),
    ],
)
def test_what_stands_on_a_leg_takes_the_mirrored_light(blocker: SceneObject, mirrored: list[tuple[int, float]]) -> None:
    """Before the wall, between wall and plate, behind the plate, behind the wall, above: object and range seen."""
    scene = slanted()
    paths = found(msgspec.structs.replace(scene, objects=(*scene.objects, blocker)), lidar(), route=LightRoute.MIRROR)
    assert [(thing, pytest.approx(range_m)) for thing, range_m in mirrored] == list(
        zip(paths.object_index.tolist(), paths.range_m.tolist(), strict=True)
    )


def test_rough_wall_has_no_mirror_and_more_scattered_light() -> None:
    """0.1 mm at 850 nm: the mirror is gone, its light is in the diffuse return and in the confocal one."""
    smooth, rough = (found(slanted(roughness_mm), lidar()) for roughness_mm in (0.0, 0.1))
    assert set(smooth.route.tolist()) == {LightRoute.DIRECT, LightRoute.MIRROR, LightRoute.DIFFUSE}
    assert set(rough.route.tolist()) == {LightRoute.DIRECT, LightRoute.DIFFUSE}
    face = float(fresnel_power(1.51, math.sqrt(0.5)))
    inside = (1.0 - face) * OPTICAL["glass"].albedo
    assert rough.photons[0] / smooth.photons[0] == pytest.approx((inside + face) / inside, rel=1e-9)
    light = [one.photons[one.route == LightRoute.DIFFUSE].sum() for one in (smooth, rough)]
    assert light[1] / light[0] == pytest.approx(((inside + face) / inside) ** 2, rel=1e-9)


def test_foliage_scatters_and_mirrors_nothing() -> None:
    paths = found(slanted(material="hedge"), lidar())
    assert set(paths.route.tolist()) == {LightRoute.DIRECT, LightRoute.DIFFUSE}
    expected = photons_per_pulse(DARK) * 0.5 * math.sqrt(0.5) * (5e-3 / 6.0) ** 2
    assert paths.photons[0] == pytest.approx(expected, rel=1e-6)


@pytest.mark.parametrize("leg_m", [3.0, 6.0])
def test_confocal_return_by_hand(leg_m: float) -> None:
    """A matt wall (gypsum, rough) at 45 deg, 6 m ahead; `leg_m` to the left a plate of 0.04 m^2 that faces the spot.

    rho_w and rho_o: all the face reflects, and what comes out. E = E_p eta (rho_w / pi cos 45 dA / L^2)
    (rho_o / pi A_fp cos 45 / L^2) (rho_w cos 45 (a / r)^2), A_fp = pi (6 m 1 mrad)^2 / cos 45. The plate is one facet
    of two triangles 0.1 m from its middle: 1e-3.
    """
    scene = place(
        wall((4.0, -2.0), (8.0, 2.0), material="plasterboard", roughness_mm=0.1),
        objects=(plate(6.0, leg_m, yaw_deg=-90.0),),
    )
    paths = found(scene, lidar(), route=LightRoute.DIFFUSE)
    slant, albedo = math.sqrt(0.5), OPTICAL["plasterboard"].albedo
    face = float(fresnel_power(1.52, slant))
    relay, white = face + (1.0 - face) * albedo, matt_albedo(OPTICAL["plasterboard"])
    spot = math.pi * (6.0 * 1e-3) ** 2 / slant
    out = relay / math.pi * slant * 0.04 / leg_m**2
    back = white / math.pi * spot * slant / leg_m**2
    by_hand = photons_per_pulse(DARK) * out * back * relay * slant * (5e-3 / 6.0) ** 2
    assert paths.photons.sum() == pytest.approx(by_hand, rel=4e-3)
    np.testing.assert_allclose(paths.range_m, 6.0 + leg_m, atol=2e-3)
    assert np.all(paths.kind == PathClass.MIRRORED)


def test_confocal_return_of_a_car_is_blocked_by_walls_and_by_itself() -> None:
    """A car to the left of the spot returns from its near side alone; behind another wall nothing is left."""
    relay, car = wall((10.0, -3.0), (10.0, 12.0), material="plasterboard"), SceneObject(class_="car", x_m=5.0, y_m=6.0)
    between = wall((1.0, 3.0), (9.9, 3.0), material="concrete", role="occluder")
    seen = found(place(relay, objects=(car,)), lidar(), route=LightRoute.DIFFUSE)
    # from (10, 0, 1) the nearest patch centre is 6.1 m off, the last ones in sight lie by the far end
    assert 10.0 + math.hypot(2.75, 5.1) - 0.2 < seen.range_m.min() < 10.0 + math.hypot(2.75, 5.1) + 0.2
    assert seen.range_m.max() < 10.0 + math.hypot(7.25, 5.1) + 0.2
    assert len(found(place(relay, between, objects=(car,)), lidar(), route=LightRoute.DIFFUSE)) == 0


def test_curved_mirror_spreads_light() -> None:
    """Off a convex wall of radius 20 m met head-on at 10 m, the image of a wall 10.2 m behind: width 10 + 10.2 (1 + 1).

    r / width = 20.2 / 30.4 of what a flat wall gives. An arc of radius 20 m bends 0.2 mm over the ray's own width.
    """
    behind = wall((-0.2, -40.0), (-0.2, 40.0), material="plasterboard", roughness_mm=0.1)
    flat, bent = (
        found(
            place(wall((10.0 + sag, -4.0), (10.0 + sag, 4.0), curvature_per_m=curvature), behind),
            lidar(),
            route=LightRoute.MIRROR,
        )
        for sag, curvature in ((0.0, 0.0), (20.0 - math.sqrt(20.0**2 - 16.0), -0.05))
    )
    assert bent.range_m[0] == pytest.approx(flat.range_m[0], abs=1e-9) == pytest.approx(20.2)
    assert bent.photons[0] / flat.photons[0] == pytest.approx(20.2 / 30.4, rel=1e-6)


def test_paths_beyond_the_window_are_discarded() -> None:
    """Table 2 sees 9.99 m: a plate at 12 m is not there."""
    setup = lidar(SpadParams(arming="gated", ambient_rate_hz=0.0))
    assert [len(found(place(objects=(plate(x_m, 0.0),)), setup)) for x_m in (9.9, 12.0)] == [1, 0]


def test_objects_and_vehicle_move() -> None:
    """A car that drives away at 4 m/s and a vehicle that follows at 1 m/s: 3 m farther after a second."""
    car = SceneObject(class_="car", x_m=10.0, y_m=0.0, speed_mps=4.0)
    world = prepare(msgspec.convert({**msgspec.to_builtins(place(objects=(car,))), "ego": {"speed_mps": 1.0}}, Scene))
    ranges = [optical_paths(world, lidar(), time_s).range_m[0] for time_s in (0.0, 1.0)]
    assert ranges == pytest.approx([7.75, 10.75])
    with pytest.raises(ValueError, match="time_s must be finite, got nan"):
        optical_paths(world, lidar(), math.nan)


def test_azimuths_alone_are_the_same_as_in_the_whole() -> None:
    grid = RangeAzimuthGrid(azimuth_bins=41)
    world = prepare(slanted())
    whole = optical_paths(world, lidar(grid=grid), 0.0, SURE)
    parts = [optical_paths(world, lidar(grid=grid), 0.0, SURE, np.arange(start, start + 1)) for start in range(41)]
    joined = OpticalPaths.joined(parts)
    order = [np.lexsort((one.range_m, one.route, one.azimuth_index)) for one in (whole, joined)]
    np.testing.assert_array_equal(whole.azimuth_index[order[0]], joined.azimuth_index[order[1]])
    np.testing.assert_allclose(whole.photons[order[0]], joined.photons[order[1]], rtol=1e-12)


def test_what_is_skipped_is_under_its_bound_and_the_budget() -> None:
    """Bounds hold what is there. Of smooth glass confocal light is under the budget, of rough gypsum the mirror."""
    for scene, used in ((slanted(), {"mirror"}), (slanted(0.1, "plasterboard"), {"diffuse"})):
        world, setup = prepare(scene), lidar(msgspec.structs.replace(DARK, measurement_time_s=0.03))
        plans = {plan.name: plan for plan in plan_optics(world, setup)}
        every = optical_paths(world, setup, 0.0, SURE)
        for name, way in (("mirror", LightRoute.MIRROR), ("diffuse", LightRoute.DIFFUSE)):
            there = setup.spad.pulses * every.photons[every.route == way].sum()
            assert there <= plans[name].bound
            assert plans[name].used == (name in used) == (plans[name].bound > 1e-3)
        kept = optical_paths(world, setup)
        ways = {LightRoute.MIRROR: "mirror", LightRoute.DIFFUSE: "diffuse"}
        assert {ways[way] for way in kept.route.tolist() if way != LightRoute.DIRECT} == used
        assert not plans["carry_over"].used
    free = {plan.name: plan for plan in plan_optics(world, lidar(SpadParams()))}
    assert free["carry_over"].used


def test_ambient_light_is_counted_once() -> None:
    """One ambient of 3e5 counts / s x 0.01 s, though two plates stand there: 3000 an azimuth without pile-up.

    Less the share e^-m of the 0.12 that a period holds.
    """
    spad = msgspec.structs.replace(DARK, ambient_rate_hz=3e5, measurement_time_s=0.01)
    two, zero = np.array([1, 1]), np.zeros(2, np.uint8)
    weak = OpticalPaths(two, np.array([5.0, 7.0]), np.full(2, 1e-9), zero, zero, np.zeros(2, np.int32))
    once = 25_000 * -math.expm1(-3e5 * spad.period_s)
    np.testing.assert_allclose(expected_histograms(lidar(spad), weak).sum(axis=1), once, rtol=1e-6)
    drawn = spad_histograms(lidar(spad), weak, [1]).sum(axis=1)
    assert np.abs(drawn - once).max() < 5.0 * math.sqrt(once)


def test_same_seed_same_bytes_whatever_else_is_counted() -> None:
    spad = SpadParams(measurement_time_s=2e-4, arming="gated")
    setup = lidar(spad)
    paths = found(place(wall((8.0, -20.0), (8.0, 20.0), material="concrete")), setup)
    one = spad_histograms(setup, paths, [3, 0])
    assert one.dtype == np.uint32
    assert one.shape == (3, 512)
    assert one.sum(axis=1).max() <= spad.pulses
    np.testing.assert_array_equal(one, spad_histograms(setup, paths, [3, 0]))
    alone = spad_histograms(setup, paths.take(paths.azimuth_index == 1), [3, 0])
    np.testing.assert_array_equal(one[1], alone[1])
    assert not np.array_equal(one, spad_histograms(setup, paths, [3, 1]))


def test_labels_make_the_same_mirror_path() -> None:
    """The image of a car by the radar's labels lies where the rays see it; its factor is R_s^2 at about 45 deg."""
    scene = place(wall((3.0, -5.0), (11.0, 3.0)), objects=(SceneObject(class_="car", x_m=6.0, y_m=12.0, yaw_deg=-90),))
    world, setup = prepare(scene), lidar(grid=RangeAzimuthGrid(azimuth_bins=256))
    paths = label_paths(world, setup, trace(world))
    images = paths.take(paths.kind == PathClass.MIRRORED)
    assert len(images)
    assert set(images.object_index.tolist()) == {0}
    rays = optical_paths(world, setup)
    rays = rays.take((rays.route == LightRoute.MIRROR) & (rays.object_index == 0))
    assert rays.range_m.min() - 0.3 < images.range_m.min()
    assert images.range_m.max() < rays.range_m.max() + 5.0
    mirror = images.photons / (photons_per_pulse(DARK) * OBJECT_ALBEDO["car"] * (5e-3 / images.range_m) ** 2)
    least, most = (float(fresnel_power(1.51, math.cos(math.radians(angle)))) ** 2 for angle in (35.0, 55.0))
    assert np.all((mirror > least) & (mirror < most))
    direct = paths.take(paths.kind == PathClass.LOS)
    assert -1 in direct.object_index
    assert np.all(direct.route == LightRoute.DIRECT)


def test_cut_and_split_of_meshes() -> None:
    """A prism cut at half height gives its mid-section; splitting keeps the area and leaves no edge over 0.25 m."""
    triangle = np.array([[[0.0, 0.0, 0.0], [2.0, 0.0, 0.0], [0.0, 0.0, 2.0]]])
    a, b, level = _cut(triangle, 1.0)
    assert sorted([a[0].tolist(), b[0].tolist()]) == [[0.0, 0.0], [1.0, 0.0]]
    assert level.tolist() == [1.0]
    assert len(_cut(triangle, 2.5)[0]) == 0
    small, _ = cut_triangles(triangle, 0.25)
    edges = np.linalg.norm(np.roll(small, -1, axis=1) - small, axis=2)
    assert edges.max() <= 0.25
    area = 0.5 * np.linalg.norm(np.cross(small[:, 1] - small[:, 0], small[:, 2] - small[:, 0]), axis=1)
    assert area.sum() == pytest.approx(2.0, rel=1e-12)


@pytest.mark.parametrize("index", [-1, 3])
def test_paths_off_the_grid_are_refused(index: int) -> None:
    one = np.array([0], np.uint8)
    paths = OpticalPaths(np.array([index]), np.ones(1), np.ones(1), one, one, np.zeros(1, np.int32))
    with pytest.raises(ValueError, match=r"azimuth_index must lie in 0\.\.2"):
        spad_histograms(lidar(), paths, [0])
