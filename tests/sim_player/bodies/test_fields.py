"""Meshes and primitives in scenes: the RCS of their traced echoes over aspects and ranges against results got apart."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from lab.full_wave.shot_rays import mesh_field
from msgs.values.perception import PathClass
from sim_player.bodies.centres import CELL_M, MAX_CENTRES, MAX_SEQUENCES, body_of, joined_bodies
from sim_player.bodies.meshes import Mesh, box, cylinder, mesh_from_arrays, plate, sphere, trihedral
from sim_player.bodies.triangles import cut_triangles, triangle_areas
from sim_player.paths.ray_tracing import trace
from sim_player.paths.truth import visible_paths
from sim_player.scene.description import Scene, SceneObject, SceneRadar, Surface
from sim_player.scene.world import World, prepare, snapshot
from sim_player.trace.echoes import cofocal, echo_amplitude, object_echoes
from sim_player.trace.path_table import Paths
from sim_player.trace.routes import NONE, Routes

WAVELENGTH_M = 299_792_458.0 / 10e9
WAVENUMBER = 2.0 * math.pi / WAVELENGTH_M
HIGH_M = 1.0


def standing(primitive: str, *size_m: float, x_m: float = 30.0, yaw_deg: float = 0.0) -> SceneObject:
    """A primitive straight ahead, its middle as high as the radar."""
    thing = SceneObject(primitive=primitive, size_m=size_m, x_m=x_m, y_m=0.0, yaw_deg=yaw_deg)
    height_m = float(thing.shape.extent_m[2])  # type: ignore[union-attr]
    return SceneObject(
        primitive=primitive, size_m=size_m, x_m=x_m, y_m=0.0, yaw_deg=yaw_deg, z_m=max(HIGH_M - 0.5 * height_m, 0.0)
    )


def rcs_field(world: World, paths: Paths) -> complex:
    """Square root of the RCS of the sum of all paths at the range of the first object, with the phase of its range."""
    own = world.scene.objects[0]
    range_m = math.hypot(own.x_m, own.y_m)
    unit = echo_amplitude(world.radar, np.ones(1), np.array([range_m]))[0]
    phasor = np.exp(-1j * WAVENUMBER * (paths.length_m - 2.0 * range_m))
    return complex((paths.amplitude * phasor).sum() / unit)


def in_scene(target: SceneObject) -> complex:
    world = prepare(Scene(name="t", objects=(target,), radar=SceneRadar(height_m=HIGH_M)))
    return rcs_field(world, trace(world, 0.0, frozenset({"los_objects"})))


def far_away(world: World, directions: np.ndarray) -> np.ndarray:
    """Fields of a world's only object, which stands at (0, 0), towards directions [N, 3] from 1,000 km: plane waves."""
    view = snapshot(world)
    range_m, count = 1e6, len(view.centre)
    unit = echo_amplitude(world.radar, np.ones(1), np.ones(1))[0]
    fields = []
    for towards in directions:
        factors = {"whole": 1.0, "front": 1.0, "rough": 1.0, "foliage": 1.0, "other": 1.0}
        none = {"wall": NONE, "wall2": NONE, "edge": NONE, "ground": False, "needs": 1}
        ways = {"length_m": range_m - view.centre @ towards, "depart": towards, "arrive": -towards}
        routes = Routes.of(count, target=np.arange(count), **ways, **none, **factors)
        echoes = object_echoes(view, routes, cofocal(routes))
        phasor = np.exp(-1j * WAVENUMBER * (echoes.out_m + echoes.back_m - 2.0 * range_m))
        fields.append((echoes.weight * echoes.out_m * echoes.back_m * phasor).sum() / unit)
    return np.array(fields)


def at_origin(mesh: Mesh | None = None, primitive: str = "box", size_m: tuple[float, ...] = (1.0, 1.0, 1.0)) -> World:
    """A world of one body at (0, 0, 0), from a mesh if one is given."""
    thing = SceneObject(primitive=primitive, size_m=size_m, x_m=9.0, y_m=0.0)
    world = prepare(Scene(name="t", objects=(thing,)))
    if mesh is not None:
        body = body_of(mesh, WAVELENGTH_M)
        count = len(body.position_m)
        own = {"centre_m": body.position_m, "centre_normals": np.stack([body.normal, body.normal], axis=1)}
        own |= {"centre_rcs_m2": body.peak_rcs_m2, "centre_phase_rad": np.zeros(count), "centre_floor": np.zeros(count)}
        own |= {"centre_exponent": -1.0 - np.arange(count), "centre_object": np.zeros(count, int)}
        return replace(world, **own, centre_id=np.arange(count), bodies=joined_bodies([body], WAVELENGTH_M))
    return replace(world, centre_m=world.centre_m - [9.0, 0.0, 0.0])


def directions(azimuth_deg: np.ndarray, elevation_deg: float) -> np.ndarray:
    azimuth, elevation = np.radians(azimuth_deg), math.radians(elevation_deg)
    level = math.cos(elevation)
    return np.stack([level * np.cos(azimuth), level * np.sin(azimuth), 0.0 * azimuth + math.sin(elevation)], axis=1)


def db(ratio: np.ndarray | float) -> np.ndarray:
    return 20.0 * np.log10(np.abs(ratio))


@pytest.mark.parametrize(
    ("primitive", "size_m"),
    [("plate", (0.3, 0.3)), ("dihedral", (0.3, 0.3)), ("trihedral", (0.3,)), ("box", (0.5, 0.3, 0.25))],
)
def test_all_aspects_are_those_of_shot_rays(primitive: str, size_m: tuple[float, ...]) -> None:
    """Around at three elevations against `mesh_field`, rays lambda / 8 apart followed by three bounces.

    Within 20 dB of the strongest aspect: 1 dB in what is within 6 dB of it, 2 dB elsewhere (beside a null both are
    small, and the rays misjudge an outline by some of a cell: 3 % of the field of the strongest).
    """
    world = at_origin(primitive=primitive, size_m=size_m)
    mesh = world.scene.objects[0].shape
    assert mesh is not None
    towards = np.concatenate([directions(np.arange(0.3, 360.0, 15.0), up_deg) for up_deg in (0.0, -5.0, 20.0)])
    ours = far_away(world, towards)
    rays = np.array([mesh_field(mesh, one, WAVELENGTH_M) for one in towards])
    level_db, error_db = db(rays) - db(rays).max(), np.abs(db(ours / rays))
    assert error_db[level_db > -6.0].max() < 1.0
    assert error_db[level_db > -20.0].max() < 2.0
    assert np.abs(ours - rays).max() < 0.05 * np.abs(rays).max()


def step() -> Mesh:
    """A closed body of an L-shaped outline: one edge that is hollow."""
    plan = np.array([[0.0, 0.0], [0.6, 0.0], [0.6, 0.3], [0.3, 0.3], [0.3, 0.6], [0.0, 0.6]])
    count = len(plan)
    vertices = np.concatenate([np.column_stack([plan, np.full(count, high_m)]) for high_m in (0.0, 0.4)])
    sides = [(i, (i + 1) % count, count + (i + 1) % count) for i in range(count)]
    sides += [(i, count + (i + 1) % count, count + i) for i in range(count)]
    ends = [(0, 1, 2), (0, 2, 3), (0, 3, 5), (3, 4, 5)]
    faces = sides + [(count + a, count + b, count + c) for a, b, c in ends] + [(c, b, a) for a, b, c in ends]
    return mesh_from_arrays(vertices, np.array(faces), "metal", "step")


def tray() -> Mesh:
    """A box without its lid: eight edges and four corners that are hollow, and walls that hide others."""
    whole = box(0.6, 0.5, 0.3)
    return mesh_from_arrays(whole.vertices_m, whole.faces[whole.normals[:, 2] < 0.5], "metal", "tray")


@pytest.mark.parametrize(
    ("mesh", "up_deg", "rays_per_wave", "most_db"),
    [(step(), 0.0, 8.0, 1.0), (tray(), 40.0, 8.0, 2.0), (trihedral(0.7), 20.0, 8.0, 1.0)],
)
def test_hollow_meshes_are_those_of_shot_rays(mesh: Mesh, up_deg: float, rays_per_wave: float, most_db: float) -> None:
    """Around at an elevation; what is within 20 dB of the strongest, and 0.3 dB in the median.

    Bias: of the tray's bounces by three faces the 64 of right angles and largest faces are kept; a part of a face is
    hidden by pieces of 0.2 m (the step).
    """
    towards = directions(np.arange(0.3, 360.0, 24.0), up_deg)
    ours = far_away(at_origin(mesh), towards)
    spacing_m = WAVELENGTH_M / rays_per_wave
    rays = np.array([mesh_field(mesh, one, WAVELENGTH_M, ray_spacing_m=spacing_m) for one in towards])
    error_db = np.abs(db(ours / rays))[db(rays) > db(rays).max() - 20.0]
    assert error_db.max() < most_db
    assert np.median(error_db) < 0.3


@pytest.mark.parametrize(
    ("primitive", "size_m"), [("plate", (2.0, 2.0)), ("plate", (2.0, 0.3)), ("box", (1.0, 0.6, 0.5))]
)
@pytest.mark.parametrize("range_m", [5.0, 60.0])
def test_near_and_far_are_the_plain_integral(primitive: str, size_m: tuple[float, ...], range_m: float) -> None:
    """Physical optics summed over points half a wavelength apart, each at its own distance and slant, 8 aspects.

    A plate of 2 m is in its near field up to 267 m: head on it is 33 dB weaker at 5 m than from far away. Bias: slant
    and spreading are constant over a triangle of 0.15 m, 4 % of the strongest field at 5 m from 2 m.
    """
    ours, plain = [], []
    for yaw_deg in (0.3, 1.7, 7.7, 19.7, 33.0, 46.0, 71.0, 88.0):
        target = standing(primitive, *size_m, x_m=range_m, yaw_deg=yaw_deg)
        mesh = target.shape
        assert mesh is not None
        pieces, owner = cut_triangles(mesh.corners_m, 0.5 * WAVELENGTH_M)
        both = (1.0,) if mesh.closed else (1.0, -1.0)
        normal = np.concatenate([side * mesh.normals[owner] for side in both])
        position_m = np.tile(pieces.mean(axis=1), (len(both), 1))
        peak_rcs_m2 = np.tile(4.0 * math.pi * (triangle_areas(pieces) / WAVELENGTH_M) ** 2, len(both))
        turned = target.place(normal[:, :2]) - target.place(np.zeros(2))
        at_m = np.column_stack([target.place(position_m[:, :2]), position_m[:, 2]])
        to_radar = np.array([0.0, 0.0, HIGH_M]) - at_m
        distance_m = np.linalg.norm(to_radar, axis=1)
        cosine = np.maximum((np.column_stack([turned, normal[:, 2]]) * to_radar).sum(axis=1) / distance_m, 0.0)
        weight = np.sqrt(peak_rcs_m2) * cosine * (range_m / distance_m) ** 2
        plain.append((weight * np.exp(-2j * WAVENUMBER * (distance_m - range_m))).sum())
        ours.append(in_scene(target))
    fields, expected = np.array(ours), np.array(plain)
    strong = db(expected) > db(expected).max() - 20.0
    assert np.abs(db(fields / expected))[strong].max() < 1.0
    assert np.abs(fields - expected).max() < 0.04 * np.abs(expected).max()


@pytest.mark.parametrize("range_m", [5.0, 60.0])
def test_cylinder_is_the_integral_along_its_line(range_m: float) -> None:
    """Upright cylinder 2 a = 1 m, h = 2 m, the radar at its middle, R' before it, R from its axis; 0.1 dB.

    Around it stationary phase, for a spherical wave: sqrt(4 pi) / lambda (R' / d) sqrt(pi a d / k R)
    e^{-2jkd} / d^2 for each metre, d = sqrt(R'^2 + z^2); along it the sum of 20,001 of these (a Fresnel integral with
    its slant and spreading). Bias: within a piece of `CELL_M` phase is straight, spreading constant.
    """
    radius_m, near_m = 0.5, range_m - 0.5
    along_m = np.linspace(-1.0, 1.0, 20_001)
    distance_m = np.hypot(near_m, along_m)
    slope = near_m / distance_m * np.sqrt(np.pi * radius_m * distance_m / (WAVENUMBER * range_m))
    field = slope * np.exp(-2j * WAVENUMBER * distance_m) / distance_m**2
    expected = math.sqrt(4.0 * math.pi) / WAVELENGTH_M * range_m**2 * np.trapezoid(field, along_m)
    assert abs(db(abs(in_scene(standing("cylinder", 1.0, 2.0, x_m=range_m))) / abs(expected))) < 0.1


@pytest.mark.parametrize(("range_m", "diameter_m"), [(5.0, 2.0), (30.0, 0.3), (30.0, 2.0)])
def test_sphere_is_a_convex_mirror(range_m: float, diameter_m: float) -> None:
    """a / (2 R' (R' + a)) of the field at 1 m, R' to the nearest point, where the echo stands: one path; rounding."""
    target = standing("sphere", diameter_m, x_m=range_m)
    world = prepare(Scene(name="t", objects=(target,), radar=SceneRadar(height_m=HIGH_M)))
    paths = trace(world, 0.0, frozenset({"los_objects"}))
    near_m = range_m - 0.5 * diameter_m
    assert len(paths) == 1
    assert paths.length_m[0] == pytest.approx(2.0 * near_m, rel=1e-9)
    assert paths.point_m[0] == pytest.approx([near_m, 0.0, 0.0], abs=1e-9)
    expected = math.sqrt(math.pi) * 0.5 * diameter_m * range_m / near_m
    assert abs(rcs_field(world, paths)) == pytest.approx(expected, rel=2e-3)


@pytest.mark.parametrize("axis", [0.0, 20.0, -30.0])
def test_corner_sends_back_what_comes_by_a_mirror(axis: float) -> None:
    """A trihedral that looks at a wall, the radar beside it: in its image the closed form, at any turn of the two.

    Triangular trihedral off its axis in plan: within 3 dB at 20 deg, 6 dB at 30 deg, and never more than on its axis.
    """
    corner = SceneObject(primitive="trihedral", size_m=(0.3,), x_m=0.0, y_m=-12.0, yaw_deg=45.0 + axis, z_m=0.88)
    wall = Surface(role="relay", material="metal", polyline_m=((12.0, -20.0), (12.0, 8.0)), height_m=6.0)
    world = prepare(Scene(name="t", objects=(corner,), surfaces=(wall,)))
    paths = trace(world, 0.0, frozenset({"specular_relay"}))
    paths = paths.take(paths.kind == PathClass.MIRRORED)
    assert set(paths.object_index.tolist()) == {0}
    image_m = math.hypot(24.0, 12.0)
    turn = 45.0 + axis - math.degrees(math.atan2(12.0, 24.0))
    unit = echo_amplitude(world.radar, np.ones(1), np.array([image_m]))[0]
    rcs_db = db((paths.amplitude * np.exp(-1j * WAVENUMBER * paths.length_m)).sum() / unit)
    closed_db = 10.0 * math.log10(4.0 * math.pi * 0.3**4 / (3.0 * WAVELENGTH_M**2))
    assert abs(turn) < 50.0
    alone = mesh_field(trihedral(0.3), directions(np.array([turn]), 0.0)[0], WAVELENGTH_M)
    assert float(rcs_db) == pytest.approx(float(db(alone)), abs=0.7)
    assert rcs_db < closed_db + 0.5


@pytest.mark.parametrize("range_m", [5.0, 30.0])
def test_a_trihedral_is_one_point_at_its_apex(range_m: float) -> None:
    world = prepare(Scene(name="t", objects=(standing("trihedral", 0.3, x_m=range_m, yaw_deg=180.0),)))
    paths = trace(world, 0.0, frozenset({"los_objects"}))
    visible = paths.take(visible_paths(world.setup, paths))
    assert len(visible) == 1
    assert visible.point_m[0, 0] == pytest.approx(range_m + 0.3 / math.sqrt(12.0), abs=1e-6)


def test_mixed_ways_are_reciprocal() -> None:
    """Out by one way and back by another is the other order's echo: a trihedral and a wall, the two apart by 37 deg."""
    world = at_origin(primitive="trihedral", size_m=(0.3,))
    view = snapshot(world)
    factors = {"whole": 1.0, "front": 1.0, "rough": 1.0, "foliage": 1.0, "other": 1.0}
    none = {"wall": NONE, "wall2": NONE, "edge": NONE, "ground": False, "needs": 1}
    towards = directions(np.array([-17.0, 20.0]), 3.0)
    ways = {"length_m": np.array([20.0, 31.0]), "depart": towards, "arrive": -towards}
    routes = Routes.of(2, target=0, **ways, **none, **factors)
    there, back = (object_echoes(view, routes, (np.array([i]), np.array([1 - i]))) for i in (0, 1))
    assert abs(there.weight[0]) > 0.0
    assert there.weight[0] == pytest.approx(back.weight[0], rel=1e-12, abs=0.0)


def mended(mesh: Mesh, faces: np.ndarray, vertices_m: np.ndarray | None = None) -> Mesh:
    return mesh_from_arrays(mesh.vertices_m if vertices_m is None else vertices_m, faces, "metal", "mended")


BOX, CORNER = box(0.5, 0.3, 0.25), trihedral(0.3)
QUARTERED = np.concatenate(
    [[(a, (a + b) / 2, (a + c) / 2), ((a + b) / 2, b, (b + c) / 2), ((a + c) / 2, (b + c) / 2, c),
      ((a + b) / 2, (b + c) / 2, (a + c) / 2)] for a, b, c in CORNER.corners_m]
)  # fmt: skip


@pytest.mark.parametrize(
    ("odd", "clean"),
    [
        (mended(BOX, np.concatenate([BOX.faces, BOX.faces])), BOX),
        (mended(BOX, np.concatenate([BOX.faces, BOX.faces[:, ::-1]])), BOX),
        (mended(BOX, BOX.faces[:, ::-1]), BOX),
        (mended(BOX, np.concatenate([BOX.faces, [[0, 1, 1]]])), BOX),
        (mended(plate(0.4, 0.4), np.array([[0, 2, 3], [0, 3, 1], [0, 2, 1], [1, 2, 3]])), plate(0.4, 0.4)),
        (mended(CORNER, np.arange(36).reshape(-1, 3), QUARTERED.reshape(-1, 3)), CORNER),
        (mended(CORNER, np.concatenate([CORNER.faces, CORNER.faces[:, [1, 0, 2]]])), CORNER),
    ],
    ids=["twice", "both sides", "inside out", "degenerate", "other diagonal", "finer", "corner twice"],
)
def test_a_mesh_drawn_otherwise_is_the_same_body(odd: Mesh, clean: Mesh) -> None:
    """The same surface by other triangles, twice, turned over: 1 % of the strongest (pieces differ by rounding)."""
    towards = directions(np.arange(-40.0, 41.0, 16.0), 4.0)
    expected = far_away(at_origin(clean), towards)
    np.testing.assert_allclose(far_away(at_origin(odd), towards), expected, atol=0.01 * np.abs(expected).max())


def test_hidden_parts_send_nothing() -> None:
    """A box in a larger one, and a plate right behind another: as if they were not there; beside it, it is seen."""
    outer, inner = box(2.0, 2.0, 2.0), box(0.5, 0.5, 0.5)
    vertices = np.concatenate([outer.vertices_m, inner.vertices_m + np.array([0.0, 0.0, 0.75])])
    nested = mended(outer, np.concatenate([outer.faces, inner.faces + 8]), vertices)
    assert len(body_of(nested, WAVELENGTH_M).piece_m) == len(body_of(outer, WAVELENGTH_M).piece_m)
    front, rear = plate(0.6, 0.6), plate(0.3, 0.3)

    def pair(*offset_m: float) -> Mesh:
        vertices = np.concatenate([front.vertices_m, rear.vertices_m + np.array(offset_m)])
        return mended(front, np.concatenate([front.faces, rear.faces + 4]), vertices)

    ahead = directions(np.zeros(1), 0.0)
    alone = abs(far_away(at_origin(front), ahead)[0])
    assert abs(far_away(at_origin(pair(-0.5, 0.0, 0.15)), ahead)[0]) == pytest.approx(alone, rel=1e-6)
    assert abs(far_away(at_origin(pair(0.0, 0.6, 0.0)), ahead)[0]) == pytest.approx(alone * 0.45 / 0.36, rel=1e-3)


@pytest.mark.parametrize(
    ("mesh", "primitive", "most"),
    [
        (box(12.0, 2.55, 3.1), None, MAX_CENTRES),
        (sphere(2.0), "sphere", 1),
        (sphere(2.0), None, MAX_CENTRES),
        (cylinder(2.0, 2.0), "cylinder", MAX_CENTRES + math.ceil(2.0 / CELL_M)),
        (trihedral(0.3), "trihedral", 1),
    ],
)
@pytest.mark.parametrize("wavelength_m", [WAVELENGTH_M, WAVELENGTH_M / 7.7])
def test_bodies_are_bounded(mesh: Mesh, primitive: str | None, most: int, wavelength_m: float) -> None:
    """Numbers of centres and of ways by several faces, at 10 and 77 GHz."""
    body = body_of(mesh, wavelength_m, primitive)
    assert 0 < len(body.position_m) <= most
    assert len(body.sequence) <= 2 * MAX_SEQUENCES
    assert body.span[:, 1].sum() == len(body.piece_m)
    assert body.span[:, 3].sum() == len(body.sequence)
