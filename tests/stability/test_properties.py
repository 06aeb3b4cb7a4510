"""Properties over the physical ranges: turn, mirror, scale, exchange or permute what goes in, and know what comes out.

Tolerances are roundings: coordinates of at most 200 m have a spacing of 3e-14 m, and each answer takes some tens of
operations on them. Where an answer is a yes or no (does this wall cut that ray), inputs within `CLEAR` of the change
are left out: there, either answer is right to rounding.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache
from typing import Any

import msgspec
import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from lab.evaluate.labelled_beams import LabelledPlace
from lab.measures.point_scores import chamfer, dense_counts, match_points, recovered_counts
from models.perception.find.cfar import CfarParams, cfar_peaks
from models.perception.find.detectors import NetworkDetector
from models.perception.form.coarray import AzimuthInterpolator
from models.perception.form.ra_former import RaFormer
from models.perception.mirrors.lines import fit_line
from models.perception.mirrors.peaks_to_view import FoldedScan, GeometryParams, fold_scan
from models.perception.mirrors.walls import WallParams, find_walls
from models.physics.antenna import setup_weights, two_way_pattern
from models.physics.fresnel import Polarisation, half_space_reflection, slab_reflection, slab_transmission
from models.physics.mirror import crosses, crossing_parameters, reflect, specular_points, wall_from_ends
from msgs.values.frames import Pose2, polar_from_xy
from msgs.values.perception import PathClass, Peaks
from msgs.values.radar import BeamGrid, RadarParams, RadarSetup, RangeAzimuthMap
from sim_player.effects.table import ALL_EFFECTS
from sim_player.generate.places import draw_place
from sim_player.paths.conversion import as_paths
from sim_player.paths.ray_tracing import trace_echoes
from sim_player.scene.description import Scene, SceneObject, Surface
from sim_player.scene.segments import Blockers
from sim_player.scene.world import Snapshot, prepare, snapshot, wall_lines
from sim_player.trace.path_table import Paths
from sim_player.trace.routes import mirror_routes, straight_routes
from tests.builders import beam_of

#: Lengths [m] agree to some hundred spacings of a coordinate.
ROUNDING_M = 1e-11
#: Shares of walls and rays this near an end are left out of yes-or-no questions.
CLEAR = 1e-6
#: Path lengths, directions and relative amplitudes of a scene carried 100 m off its origin: a coordinate rounds to
#: 1.4e-14 m, a direction of a piece of wall or arc of a decimetre to 1e-13, which counts over two bounces and 100 m;
#: fields at arcs and edges feel it ten times more.
LENGTH_M, TURN, AMPLITUDE = 1e-9, 1e-9, 1e-8

quick = settings(derandomize=True, deadline=None, max_examples=100)
slow = settings(derandomize=True, deadline=None, max_examples=30)

# --- what is drawn

metres = st.floats(-100.0, 100.0)
places_m = st.tuples(metres, metres).map(np.array)
angles_rad = st.floats(-math.pi, math.pi)
motions = st.builds(Pose2, metres, metres, angles_rad)
seeds = st.integers(0, 2**32 - 1)
walls_m = st.tuples(places_m, places_m).filter(lambda ends: np.hypot(*(ends[1] - ends[0])) > 0.5)
#: Down to the cosine of the float64 nearest to a right angle, and nought.
cosines = st.one_of(st.just(0.0), st.floats(1e-17, 1.0), st.floats(-17.0, 0.0).map(lambda power: 10.0**power))
wavelengths_m = st.sampled_from([0.0299792458, 0.0038934])
polarisations: st.SearchStrategy[Polarisation] = st.sampled_from(["te", "tm"])
losses = st.one_of(st.just(0.0), st.floats(-12.0, 8.0).map(lambda power: 10.0**power))
passive_media = st.builds(lambda real, loss: complex(real, -loss), st.floats(1.0, 80.0), losses)
thicknesses_m = st.one_of(st.just(0.0), st.floats(-9.0, 2.0).map(lambda power: 10.0**power))


@st.composite
def streets(draw: st.DrawFn) -> Peaks:
    """Peaks of a street as a detector gives them: walls of few returns, a vehicle, images behind the walls."""
    rng = np.random.default_rng(draw(seeds))
    along = np.linspace(0.0, rng.uniform(6.0, 14.0), 8)
    facade = np.stack([np.full(8, rng.uniform(15.0, 30.0)), along - rng.uniform(0.0, 8.0)], axis=1)
    beside = np.stack([along + 5.0, np.full(8, rng.uniform(6.0, 14.0))], axis=1)
    vehicle = rng.uniform([6.0, -14.0], [12.0, -9.0]) + rng.uniform(-1.0, 1.0, (4, 2))
    images = np.concatenate(
        [facade[2:6] + np.array([rng.uniform(2.0, 12.0), 0.0]), beside[2:6] + np.array([0.0, rng.uniform(2.0, 9.0)])]
    )
    points_m = np.concatenate([facade, beside, vehicle, images])
    points_m += rng.normal(0.0, 0.03, points_m.shape)
    return peaks_of(points_m, np.arange(len(points_m)) >= len(points_m) - len(images), rng)


def peaks_of(points_m: np.ndarray, mirrored: np.ndarray, rng: np.random.Generator) -> Peaks:
    range_m, azimuth_rad = polar_from_xy(points_m)
    count = len(points_m)
    return Peaks(
        stamp_ns=0,
        scan_id=0,
        range_m=range_m,
        azimuth_rad=azimuth_rad,
        score=rng.uniform(0.3, 1.0, count),
        path_class=np.where(mirrored, PathClass.MIRRORED, PathClass.LOS).astype(np.uint8),
        covariance=np.tile(np.diag([0.06**2, 0.012**2]), (count, 1, 1)),
        peak_stamp_ns=np.zeros(count, np.int64),
        snr_db=rng.uniform(10.0, 40.0, count),
    )


@lru_cache(maxsize=16)
def drawn_scene(index: int, apart: bool = True) -> Snapshot:
    """A random place with walls, arcs, hedges, ground and objects, its antennas as drawn or in one place, at start."""
    scene = draw_place(23, index, "xband", None).scene
    radar = scene.radar if apart else msgspec.structs.replace(scene.radar, separation_m=0.0)
    return snapshot(prepare(msgspec.structs.replace(scene, radar=radar), 3))


#: Numbers for `drawn_scene`.
scenes = st.integers(0, 11)


@lru_cache(maxsize=1)
def measured() -> tuple[RadarSetup, RangeAzimuthMap]:
    """A map of a random place."""
    place = LabelledPlace(23, 1, "basic")
    former = RaFormer(place.player.setup)
    (ra_map,) = [one for beam in place.beams() for one in former.add(beam)]
    return place.player.setup, ra_map


@lru_cache(maxsize=1)
def network() -> NetworkDetector:
    return NetworkDetector(measured()[0])


# --- how a scene is moved


def moved(
    view: Snapshot, point: Callable[[np.ndarray], np.ndarray], vector: Callable[[np.ndarray], np.ndarray]
) -> Snapshot:
    """The scene with the radar in it, places [..., 2 or 3] and vectors mapped; pose and curvatures are the caller's."""

    def on_plan(change: Callable[[np.ndarray], np.ndarray], values: np.ndarray) -> np.ndarray:
        return np.concatenate([change(values[..., :2]), values[..., 2:]], axis=-1)

    places, ways = (
        ("wall_a", "wall_b", "centre_m", "face_a", "face_b", "speck_m"),
        ("centre_normals", "velocity_mps", "speck_normal"),
    )
    changes = {name: on_plan(point, getattr(view.world, name)) for name in places}
    changes |= {name: on_plan(vector, getattr(view.world, name)) for name in ways}
    world = replace(view.world, **changes)
    antenna = on_plan(point, view.antenna)
    normal, offset = wall_lines(world, antenna[:2])
    return replace(
        view,
        world=world,
        antenna=antenna,
        radar_velocity=vector(view.radar_velocity),
        centre=on_plan(point, view.centre),
        velocity=vector(view.velocity),
        blockers=replace(view.blockers, a=point(view.blockers.a), b=point(view.blockers.b)),
        normal=normal,
        offset=offset,
    )


def carried(view: Snapshot, motion: Pose2) -> Snapshot:
    """The scene and the radar in it, carried and turned together."""
    return replace(moved(view, motion.apply, motion.rotate), pose=motion @ view.pose)


def left_for_right(view: Snapshot) -> Snapshot:
    """The scene as seen in a mirror along the radar's forward axis."""
    other = moved(view, flipped, flipped)
    curvature = -view.world.wall_curvature_per_m
    world = replace(other.world, wall_curvature_per_m=curvature)
    bent: Blockers = replace(other.blockers, curvature_per_m=-view.blockers.curvature_per_m)
    return replace(other, world=world, blockers=bent)


def flipped(values: np.ndarray) -> np.ndarray:
    return np.asarray(values) * [1.0, -1.0]


def paths_of(view: Snapshot, effects: frozenset[str] = ALL_EFFECTS) -> Paths:
    return as_paths(view, trace_echoes(view, effects), effects)


def assert_same_paths(found: Paths, wanted: Paths, sign: float = 1.0) -> None:
    """Same paths; azimuths and places times `sign` in y."""
    assert len(found) == len(wanted) > 0
    for name in ("kind", "order", "needs", "surface", "object_index"):
        np.testing.assert_array_equal(getattr(found, name), getattr(wanted, name))
    np.testing.assert_allclose(found.length_m, wanted.length_m, rtol=0.0, atol=LENGTH_M)
    np.testing.assert_allclose(found.radial_speed_mps, wanted.radial_speed_mps, rtol=0.0, atol=TURN)
    for name in ("azimuth_rad", "departure_azimuth_rad"):
        turn = getattr(found, name) - sign * getattr(wanted, name)
        np.testing.assert_allclose(np.abs(np.exp(1j * turn) - 1.0), 0.0, atol=TURN)
    for name in ("elevation_rad", "departure_elevation_rad"):
        np.testing.assert_allclose(getattr(found, name), getattr(wanted, name), rtol=0.0, atol=TURN)
    np.testing.assert_allclose(found.point_m, wanted.point_m * [1.0, sign, 1.0], rtol=0.0, atol=LENGTH_M)
    np.testing.assert_allclose(found.virtual_m, wanted.virtual_m * [1.0, sign, 1.0], rtol=0.0, atol=100.0 * TURN)
    np.testing.assert_allclose(
        found.amplitude, wanted.amplitude, rtol=AMPLITUDE, atol=1e-12 * abs(wanted.amplitude).max()
    )


# --- the mirror


@pytest.mark.slow
@quick
@given(places_m, places_m, walls_m)
def test_range_of_the_image_is_the_length_of_the_path(origin: np.ndarray, target: np.ndarray, ends: Any) -> None:
    """By Fermat the length does not feel where on the wall rounding puts the bounce; exchanged ends change nothing."""
    there = specular_points(origin, target[None], *ends)[0]
    back = specular_points(target, origin[None], *ends)[0]
    normal, offset_m = wall_from_ends(*ends, origin)
    assume(np.isfinite(there).all())
    image_m = np.hypot(*(reflect(target, normal, offset_m) - origin))
    legs_m = np.hypot(*(there - origin)) + np.hypot(*(target - there))
    assert abs(image_m - legs_m) <= ROUNDING_M
    share = np.linalg.norm(there - ends[0]) / np.linalg.norm(ends[1] - ends[0])
    assume(CLEAR < share < 1.0 - CLEAR)
    # where both graze the wall, the place of the bounce is worth no more than the heights' own rounding
    grazing = min(origin @ normal + offset_m, target @ normal + offset_m)
    np.testing.assert_allclose(back, there, rtol=0.0, atol=ROUNDING_M * max(1.0, 200.0 / grazing))


@pytest.mark.slow
@quick
@given(places_m, places_m, walls_m, motions)
def test_walls_images_and_cuts_turn_with_the_scene(
    origin: np.ndarray, target: np.ndarray, ends: Any, motion: Pose2
) -> None:
    a, b = np.array(ends)
    normal, offset_m = wall_from_ends(a, b, origin)
    assume(abs(origin @ normal + offset_m) > CLEAR)
    there = motion.apply(np.array([origin, target, a, b]))
    moved_normal, moved_offset_m = wall_from_ends(there[2], there[3], there[0])
    np.testing.assert_allclose(moved_normal, motion.rotate(normal), rtol=0.0, atol=1e-12)
    image = reflect(there[1], moved_normal, moved_offset_m)
    # half a metre of wall says its direction to 1e-13 rad, hundreds of metres out
    np.testing.assert_allclose(image, motion.apply(reflect(target, normal, offset_m)), rtol=0.0, atol=1e-9)
    shares = np.array(crossing_parameters(origin, target[None], a[None], b[None]))[:, 0, 0]
    assume(np.isfinite(shares).all() and (np.abs(np.concatenate([shares, shares - 1.0])) > CLEAR).all())
    cut = crosses(origin, target[None], a[None], b[None])
    assert crosses(there[0], there[1:2], there[2:3], there[3:4]) == cut


@quick
@given(places_m, seeds, walls_m, st.floats(0.01, 0.99))
def test_a_wall_split_in_two_shows_and_hides_the_same(origin: np.ndarray, seed: int, ends: Any, share: float) -> None:
    a, b = np.array(ends)
    middle = a + share * (b - a)
    targets = np.random.default_rng(seed).uniform(-100.0, 100.0, (40, 2))
    normal, offset_m = wall_from_ends(a, b, origin)
    assume(abs(origin @ normal + offset_m) > 1e-3)
    whole, first, second = (specular_points(origin, targets, *piece) for piece in ((a, b), (a, middle), (middle, b)))
    off = np.abs(crossing_parameters(origin, reflect(targets, normal, offset_m), a[None], b[None])[1][:, 0] - share)
    clear = off > CLEAR
    assert (np.isfinite(first[clear, 0]) ^ np.isfinite(second[clear, 0]) == np.isfinite(whole[clear, 0])).all()
    both = np.where(np.isfinite(first), first, second)
    np.testing.assert_allclose(both[clear], whole[clear], rtol=0.0, atol=1e-7)
    halves = crosses(origin, targets, np.array([a, middle]), np.array([middle, b])).any(axis=1)
    straight = np.array(crossing_parameters(origin, targets, a[None], b[None]))[..., 0]
    sure = (np.abs(np.concatenate([straight, straight - 1.0])) > CLEAR).all(axis=0)
    np.testing.assert_array_equal(halves[sure], crosses(origin, targets, a[None], b[None])[sure, 0])


# --- waves at walls


@pytest.mark.slow
@settings(quick, max_examples=400)
@given(passive_media, cosines, polarisations)
def test_a_passive_half_space_returns_no_more_than_it_gets(
    medium: complex, cosine: float, polarisation: Polarisation
) -> None:
    reflection = half_space_reflection(medium, cosine, polarisation)
    assert abs(reflection) <= 1.0 + 4.0 * np.finfo(float).eps


@pytest.mark.slow
@settings(quick, max_examples=400)
@given(passive_media, cosines, thicknesses_m, wavelengths_m, polarisations)
def test_a_passive_slab_returns_and_passes_no_more_than_it_gets(
    medium: complex, cosine: float, thickness_m: float, wavelength_m: float, polarisation: Polarisation
) -> None:
    """Sixteen roundings, however near its denominator comes to zero; what loses nothing keeps all."""
    slab = medium, cosine, thickness_m, wavelength_m, polarisation
    left = 1.0 - abs(slab_reflection(*slab)) ** 2 - abs(slab_transmission(*slab)) ** 2
    assert left >= -16.0 * np.finfo(float).eps
    if medium.imag == 0.0:
        assert left <= 16.0 * np.finfo(float).eps


# --- the simulated radar


@pytest.mark.slow
@slow
@given(scenes, motions)
def test_paths_turn_with_the_scene(index: int, motion: Pose2) -> None:
    """Radar and scene carried and turned together: the radar sees what it saw, of every effect."""
    view = drawn_scene(index)
    assert_same_paths(paths_of(carried(view, motion)), paths_of(view))


@pytest.mark.slow
@slow
@given(scenes)
def test_a_scene_left_for_right_gives_paths_left_for_right(index: int) -> None:
    """With both antennas in one place: set apart, they would have to change sides."""
    view = drawn_scene(index, apart=False)
    assert_same_paths(paths_of(left_for_right(view)), paths_of(view), sign=-1.0)


@slow
@given(scenes, seeds)
def test_transmitter_and_receiver_exchanged_give_the_same_path(index: int, seed: int) -> None:
    """From p to q and from q to p, straight and by every wall: same walls, lengths, losses."""
    view, rng = drawn_scene(index), np.random.default_rng(seed)
    here, there = (np.append(rng.uniform([0.0, -15.0], [30.0, 15.0]), rng.uniform(0.3, 2.0)) for _ in "pq")
    owner = np.full(1, -1, np.int32)

    def between(start: np.ndarray, end: np.ndarray) -> list[np.ndarray]:
        normal, offset = wall_lines(view.world, start[:2])
        seen = replace(view, antenna=start, normal=normal, offset=offset)
        routes, legs = straight_routes(seen, end[None])
        mirrored, mirrored_legs = mirror_routes(seen, end[None], view.world.is_flat, owner)
        parts = [(routes, legs), (mirrored, mirrored_legs)]
        return [
            np.concatenate([value(routes, legs) for routes, legs in parts])
            for value in (
                lambda routes, legs: routes.wall,
                lambda routes, legs: legs.free,
                lambda routes, legs: routes.length_m,
                lambda routes, legs: routes.whole * routes.rough * routes.other,
                lambda routes, legs: legs.through * legs.foliage,
            )
        ]

    for forth, back in zip(between(here, there), between(there, here), strict=True):
        np.testing.assert_allclose(back, forth, rtol=1e-9, atol=1e-12)


@quick
@given(st.lists(angles_rad.map(lambda angle: 0.49 * angle), min_size=4, max_size=4), st.floats(0.9, 1.1))
def test_antenna_does_not_care_which_way_the_wave_ran(angles: list[float], ratio: float) -> None:
    setup = RadarSetup()
    columns = setup_weights(setup)
    one, two = np.array([angles[:2]]).T, np.array([angles[2:]]).T
    forth = two_way_pattern(setup, columns, *one, *two, frequency_ratio=ratio)
    back = two_way_pattern(setup, columns, *two, *one, frequency_ratio=ratio)
    # a complex product is not commutative to the last bit
    np.testing.assert_allclose(back, forth, rtol=4.0 * np.finfo(float).eps)


@slow
@given(st.floats(0.05, 0.95), seeds)
def test_a_scene_with_a_split_wall_echoes_the_same(share: float, seed: int) -> None:
    """A joint in the mirror adds no image, takes none away, and blocks no other ray."""
    rng = np.random.default_rng(seed)
    a, b = np.array([18.0, -9.0]) + rng.uniform(-2.0, 2.0, 2), np.array([14.0, 12.0]) + rng.uniform(-2.0, 2.0, 2)
    ends, joint = (tuple(a.tolist()), tuple(b.tolist())), tuple((a + share * (b - a)).tolist())
    whole, split = ends, (ends[0], joint, ends[1])
    names = frozenset({"los_objects", "specular_relay", "rough_wall_loss", "slab_resonance"})
    first, second = (paths_of(snapshot(prepare(corner(line), 1)), names) for line in (whole, split))
    assert (first.kind == PathClass.MIRRORED).any()
    # sorted by length: the halves come one after the other
    first, second = (paths.take(np.argsort(paths.length_m)) for paths in (first, second))
    np.testing.assert_allclose(second.length_m, first.length_m, rtol=0.0, atol=1e-9)
    np.testing.assert_allclose(second.amplitude, first.amplitude, rtol=1e-9)


def corner(polyline_m: tuple[tuple[float, float], ...]) -> Scene:
    facade = Surface(role="relay", material="concrete", polyline_m=polyline_m, thickness_mm=200.0, roughness_mm=0.3)
    lane = Surface(role="occluder", material="concrete", polyline_m=((4.0, -4.0), (9.0, -4.0)), thickness_mm=300.0)
    car = SceneObject(class_="car", x_m=7.0, y_m=-8.0, yaw_deg=75.0)
    return Scene(name="corner", surfaces=(facade, lane), objects=(car,))


# --- the map


def small_setup() -> RadarSetup:
    return RadarSetup(radar=RadarParams(chirps_per_beam=8), beams=BeamGrid(azimuth_deg=(-10.0, 0.0, 10.0)))


@settings(slow, max_examples=10)
@given(st.integers(1, 4), seeds)
def test_map_of_louder_samples_is_louder_by_as_much(gain: int, seed: int) -> None:
    """Codes times a power of two, window, transform, Doppler, co-array: the same bits with another exponent."""
    rng = np.random.default_rng(seed)
    setup = small_setup()
    samples = rng.integers(-1000, 1000, (3, 8, 8192, 2), np.int16)
    quiet, loud = (formed(setup, samples * np.int16(factor)) for factor in (1, 2**gain))
    np.testing.assert_array_equal(loud.values, quiet.values * np.float32(2**gain))
    assert loud.noise_power_mw == quiet.noise_power_mw * 4**gain


def formed(setup: RadarSetup, samples: np.ndarray) -> RangeAzimuthMap:
    """The map of samples [beams, chirps, samples, 2]."""
    former = RaFormer(setup)
    maps: list[RangeAzimuthMap] = []
    for index, one in enumerate(samples):
        maps += former.add(beam_of(setup, index, one))
    return maps[0]


@lru_cache(maxsize=1)
def peaks_measured() -> list[Peaks]:
    """What each detector finds in the measured map."""
    return [detect(measured()[1]) for detect in detectors()]


def detectors() -> list[Callable[[RangeAzimuthMap], Peaks]]:
    return [network().detect, lambda one: cfar_peaks(one, CfarParams())]


@pytest.mark.slow
@settings(slow, max_examples=10)
@given(st.floats(-60.0, 60.0))
def test_gain_of_signal_and_noise_moves_no_peak(gain_db: float) -> None:
    """Levels are over the noise: places and classes stay, whoever detects."""
    _, ra_map = measured()
    gain = 10.0 ** (gain_db / 20.0)
    values = (ra_map.values * np.float32(gain)).astype(np.complex64)
    louder = msgspec.structs.replace(ra_map, values=values, noise_power_mw=ra_map.noise_power_mw * gain**2)
    for detect, before in zip(detectors(), peaks_measured(), strict=True):
        after = detect(louder)
        np.testing.assert_array_equal(after.path_class, before.path_class)
        np.testing.assert_allclose(after.azimuth_rad, before.azimuth_rad, rtol=0.0, atol=1e-6)
        # ranges come from logarithms of float32 powers
        np.testing.assert_allclose(after.range_m, before.range_m, rtol=0.0, atol=1e-4)
        np.testing.assert_allclose(after.score, before.score, rtol=1e-4, atol=1e-4)
        np.testing.assert_allclose(after.snr_db, before.snr_db, rtol=0.0, atol=1e-4)


@slow
@given(seeds, st.complex_numbers(max_magnitude=10.0), st.complex_numbers(max_magnitude=10.0))
def test_co_array_inversion_is_linear(seed: int, one: complex, other: complex) -> None:
    """The map of a sum is the sum of the maps: 25 float32 products each, relative to their largest."""
    interpolator = AzimuthInterpolator(RadarSetup())
    rng = np.random.default_rng(seed)
    first, second = (rng.standard_normal((25, 512, 2)).astype(np.float32).view(np.complex64)[..., 0] for _ in range(2))
    # under noise this loud no range bin counts as incoherent
    maps = [
        interpolator.interpolate(profiles.astype(np.complex64), 1e6)[0]
        for profiles in (first, second, one * first + other * second)
    ]
    summed = one * maps[0] + other * maps[1]
    size = abs(one) * np.abs(maps[0]).max() + abs(other) * np.abs(maps[1]).max()
    assert np.abs(maps[2] - summed).max() <= 25.0 * np.finfo(np.float32).eps * max(size, 1e-30)


# --- the geometry


def assert_same_scan(found: FoldedScan, wanted: FoldedScan, turn: Callable[[np.ndarray], np.ndarray]) -> None:
    """Walls and places `turn`ed, all else alike; positions to the conditioning of a wall fitted to few returns."""
    assert len(found.walls) == len(wanted.walls) > 0
    for mine, other in zip(found.walls, wanted.walls, strict=True):
        np.testing.assert_allclose(mine.normal, turn(np.array(other.normal)), rtol=0.0, atol=1e-9)
        assert abs(mine.offset_m - other.offset_m) <= 1e-9
        # an end is an end, whichever is named first
        ends_m, wanted_m = np.array(mine.ends_m), turn(np.array(other.ends_m))
        np.testing.assert_allclose(
            ends_m[np.lexsort(ends_m.round(6).T)], wanted_m[np.lexsort(wanted_m.round(6).T)], rtol=0.0, atol=1e-8
        )
    assert len(found.recovered) == len(wanted.recovered) > 0
    np.testing.assert_array_equal(found.recovered.wall, wanted.recovered.wall)
    np.testing.assert_array_equal(found.recovered.second, wanted.recovered.second)
    np.testing.assert_allclose(found.recovered.points_m, turn(wanted.recovered.points_m), rtol=0.0, atol=1e-8)
    turned = turn(turn(wanted.recovered.covariance_m2).transpose(0, 2, 1))
    np.testing.assert_allclose(found.recovered.covariance_m2, turned, rtol=0.0, atol=1e-8)


@settings(quick, max_examples=30)
@given(streets(), st.floats(-math.pi, math.pi))
def test_recovered_places_turn_with_the_peaks(peaks: Peaks, turn_rad: float) -> None:
    params = GeometryParams()
    turned = msgspec.structs.replace(peaks, azimuth_rad=np.angle(np.exp(1j * (peaks.azimuth_rad + turn_rad))))
    assert_same_scan(fold_scan(turned, params), fold_scan(peaks, params), Pose2(0.0, 0.0, turn_rad).rotate)


@settings(quick, max_examples=30)
@given(streets())
def test_recovered_places_left_for_right(peaks: Peaks) -> None:
    """And what counts as hidden: boxes of vehicles are tried in directions that are their own mirror image."""
    params = GeometryParams()
    other = msgspec.structs.replace(peaks, azimuth_rad=-peaks.azimuth_rad)
    found, wanted = fold_scan(other, params), fold_scan(peaks, params)
    assert_same_scan(found, wanted, flipped)
    np.testing.assert_array_equal(found.hidden, wanted.hidden)


@settings(quick, max_examples=30)
@given(streets(), seeds)
def test_order_of_the_images_does_not_matter(peaks: Peaks, seed: int) -> None:
    """Mirrored peaks shuffled: the same places in the new order."""
    params = GeometryParams()
    images = np.flatnonzero(peaks.path_class == PathClass.MIRRORED)
    order = np.arange(len(peaks))
    order[images] = np.random.default_rng(seed).permutation(images)
    shuffled = peaks.take(order)
    found, wanted = fold_scan(shuffled, params), fold_scan(peaks, params)
    one, two = (np.argsort(scan.recovered.score) for scan in (found, wanted))
    np.testing.assert_allclose(found.recovered.points_m[one], wanted.recovered.points_m[two], rtol=0.0, atol=1e-12)
    np.testing.assert_array_equal(found.recovered.wall[one], wanted.recovered.wall[two])
    np.testing.assert_array_equal(found.hidden[one], wanted.hidden[two])


@quick
@given(seeds, st.integers(4, 20))
def test_walls_do_not_depend_on_the_order_of_points(seed: int, count: int) -> None:
    """Up to twenty points every pair is a hypothesis: sums in another order, nothing else."""
    rng = np.random.default_rng(seed)
    along = np.sort(rng.uniform(-6.0, 6.0, count))
    points_m = np.stack([20.0 + 0.3 * along, along], axis=1) + rng.normal(0.0, 0.05, (count, 2))
    covariance_m2 = rng.uniform(0.005, 0.05, count)[:, None, None] * np.eye(2)
    order = rng.permutation(count)
    before, after = fit_line(points_m, covariance_m2), fit_line(points_m[order], covariance_m2[order])
    for one, other in zip(before, after, strict=True):
        np.testing.assert_allclose(other, one, rtol=1e-9, atol=1e-9)
    labels, params = np.zeros(count, np.int64), WallParams()
    first, of_first = find_walls(points_m, covariance_m2, labels, params)
    second, of_second = find_walls(points_m[order], covariance_m2[order], labels, params)
    np.testing.assert_array_equal(of_second, of_first[order])
    for wall, other in zip(first, second, strict=True):
        np.testing.assert_allclose((*other.normal, other.offset_m), (*wall.normal, wall.offset_m), rtol=0.0, atol=1e-9)


@quick
@given(seeds, st.integers(1, 25), st.integers(1, 25), motions)
def test_scores_know_no_order_and_no_frame(seed: int, found: int, true: int, motion: Pose2) -> None:
    """Shuffled, carried and turned together: same counts, same distances."""
    rng = np.random.default_rng(seed)
    predicted_m, truth_m = rng.uniform(-10.0, 10.0, (found, 2)), rng.uniform(-10.0, 10.0, (true, 2))
    classes = rng.integers(0, 2, found).astype(np.uint8), rng.integers(0, 2, true).astype(np.uint8)
    one, two = rng.permutation(found), rng.permutation(true)
    there, true_there = motion.apply(predicted_m[one]), motion.apply(truth_m[two])
    assert recovered_counts(there, true_there) == recovered_counts(predicted_m, truth_m)
    assert dense_counts(there, classes[0][one], true_there, classes[1][two]) == dense_counts(
        predicted_m, classes[0], truth_m, classes[1]
    )
    assert len(match_points(there, true_there, 1.0)) == len(match_points(predicted_m, truth_m, 1.0))
    moved_m, still_m = chamfer(there, true_there), chamfer(predicted_m, truth_m)
    assert moved_m.metres == pytest.approx(still_m.metres, abs=ROUNDING_M)
    assert moved_m.square_metres == pytest.approx(still_m.square_metres, rel=1e-9)
