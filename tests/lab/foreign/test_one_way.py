"""Foreign paths in, our paths out: with our own routes written as foreign ones, our own answer comes back."""

from __future__ import annotations

import numpy as np
import pytest

from lab.foreign.export import ExportedSurface, SurfaceKind, clear_of_bodies, exported_surfaces
from lab.foreign.one_way import OneWayPaths, as_routes, foreign_paths, meets_own_object, surface_columns
from lab.foreign.sionna_tracer import trace_to_points
from sim_player.effects.second_relay import two_wall_routes
from sim_player.paths.ray_tracing import trace
from sim_player.scene.description import Scene, SceneObject, Surface
from sim_player.scene.world import Snapshot, prepare, snapshot
from sim_player.signal.levels import kernel_profiles
from sim_player.trace.effect_names import bit
from sim_player.trace.path_table import Paths
from sim_player.trace.routes import Routes, clear_ways
from sim_player.trace.snapshot import TraceContext
from tests.lab.foreign.requirements import require_sionna

SCENE = Scene(
    name="foreign",
    surfaces=(
        Surface(role="relay", material="brick", polyline_m=((12.0, -8.0), (12.0, 9.8)), thickness_mm=300.0),
        Surface(role="relay", material="glass", polyline_m=((14.0, 10.0), (-6.0, 10.0)), thickness_mm=8.0),
        Surface(role="occluder", material="concrete", polyline_m=((2.0, 2.4), (2.0, 3.0)), height_m=6.0),
    ),
    objects=(SceneObject(class_="car", x_m=5.0, y_m=6.5, yaw_deg=20.0),),
)
EFFECTS = frozenset({"los_objects", "los_surfaces", "specular_relay", "second_relay", "non_cofocal", "slab_resonance"})


@pytest.fixture(scope="module")
def view() -> Snapshot:
    return snapshot(prepare(SCENE))


def our_routes(view: Snapshot) -> Routes:
    tracing = TraceContext(view)
    parts = [clear_ways(*ways) for ways in (tracing.straight, tracing.mirrored)]
    return Routes.joined([*parts, two_wall_routes(view, view.centre, tracing.owner)])


def written_as_foreign(routes: Routes, surfaces: tuple[ExportedSurface, ...]) -> OneWayPaths:
    number = {surface.index: row for row, surface in enumerate(surfaces) if surface.kind == SurfaceKind.WALL}
    pieces = np.column_stack([routes.wall, routes.wall2])
    return OneWayPaths(
        target=routes.target,
        length_m=routes.length_m,
        depart=routes.depart,
        arrive=routes.arrive,
        reflection=routes.whole * routes.other,
        surface=np.vectorize(lambda piece: number.get(int(piece), -1), otypes=[np.int32])(pieces),
        vertex_m=np.zeros((len(routes), 2, 3)),
    )


def in_order(paths: Paths) -> Paths:
    return paths.take(np.lexsort([np.abs(paths.amplitude), paths.azimuth_rad, paths.length_m.round(9)]))


def test_our_own_routes_give_our_own_paths(view: Snapshot) -> None:
    """Direct, one wall, two walls, their mixtures, walls in sight: lengths, directions, weights to rounding."""
    surfaces = exported_surfaces(view.world)
    routes = our_routes(view)
    assert set(((routes.wall >= 0).astype(int) + (routes.wall2 >= 0)).tolist()) == {0, 1, 2}
    got = in_order(foreign_paths(view, as_routes(written_as_foreign(routes, surfaces), surfaces), EFFECTS))
    # the radar's own image in two walls is no echo of an object
    ours = trace(view.world, effects=EFFECTS)
    ours = in_order(ours.take((ours.object_index >= 0) | ((ours.needs & bit("second_relay")) == 0)))
    assert len(got) == len(ours) > 100
    np.testing.assert_allclose(got.length_m, ours.length_m, rtol=1e-12)
    np.testing.assert_allclose(got.departure_azimuth_rad, ours.departure_azimuth_rad, atol=1e-12)
    np.testing.assert_allclose(got.amplitude, ours.amplitude, rtol=1e-9)
    assert got.kind.tolist() == ours.kind.tolist()


def test_ground_and_objects_are_marked_and_walls_come_first() -> None:
    """A path by ground then wall has that wall as its first mirror, and the bit that keeps it out of the truth."""
    ground = Surface(role="ground", material="asphalt")
    world = prepare(Scene(name="marks", surfaces=(*SCENE.surfaces, ground), objects=SCENE.objects))
    surfaces = exported_surfaces(world)
    kinds = [surface.kind for surface in surfaces]
    on_ground, on_object = kinds.index(SurfaceKind.GROUND), kinds.index(SurfaceKind.OBJECT)
    paths = OneWayPaths(
        target=np.zeros(3, np.int32),
        length_m=np.full(3, 20.0),
        depart=np.tile([1.0, 0.0, 0.0], (3, 1)),
        arrive=np.tile([1.0, 0.0, 0.0], (3, 1)),
        reflection=np.full(3, 0.5 + 0j),
        surface=np.array([[on_ground, 1], [on_object, -1], [0, 1]], np.int32),
        vertex_m=np.zeros((3, 2, 3)),
    )
    routes = as_routes(paths, surfaces)
    assert routes.wall.tolist() == [1, -1, 0]
    assert routes.wall2.tolist() == [-1, -1, 1]
    assert routes.ground.tolist() == [True, False, False]
    marks = bit("ground_bounce") | bit("object_interreflection")
    assert (routes.needs & marks).tolist() == [bit("ground_bounce"), bit("object_interreflection"), 0]
    assert meets_own_object(paths, surfaces, world.centre_object).tolist() == [False, True, False]
    assert meets_own_object(paths, surfaces, np.full(len(world.centre_m), -1)).tolist() == [False] * 3


def test_beats_of_foreign_paths_are_ours() -> None:
    """Paths by Sionna RT, echoes of the car and range profiles by us, against all ours: 2e-3 relative L2 of a scan.

    Round trips differ by some 1e-5 m, which turns a beat by 2e-3 rad; reflections by up to 0.02 dB (2e-3) at these
    slopes. Paths mirrored by the car are left out: in ours its centres stand for them.
    """
    require_sionna()
    world = clear_of_bodies(prepare(SCENE))
    view, surfaces = snapshot(world), exported_surfaces(world)
    found = trace_to_points(surfaces, view.antenna, view.centre, world.radar.carrier_hz, samples=100_000)
    kind, _ = surface_columns(surfaces)
    found = found.take((kind[found.surface] != SurfaceKind.OBJECT).all(axis=1))
    foreign = foreign_paths(view, as_routes(found, surfaces), EFFECTS)
    foreign, ours = (paths.take(paths.object_index >= 0) for paths in (foreign, trace(world, effects=EFFECTS)))
    assert len(foreign) == len(ours) > 100
    got, expected = (kernel_profiles(SCENE.setup, paths) for paths in (foreign, ours))
    assert np.linalg.norm(got - expected) < 2e-3 * np.linalg.norm(expected)
