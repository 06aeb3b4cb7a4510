"""Random places: legal, varied, repeatable, and what is placed out of sight is out of sight."""

from __future__ import annotations

import math
from collections import Counter
from itertools import pairwise

import msgspec
import numpy as np
import pytest

from msgs.values.perception import PathClass
from sim_player.generate import wall_kinds as relays
from sim_player.generate.layouts import draw_layout
from sim_player.generate.placement import Boxes, Walls, chords, hidden, images, indoors
from sim_player.generate.places import (
    CLASS_SHARE,
    GROUND_SHARE,
    MAX_SPEED_MPS,
    PLACE_KINDS,
    Place,
    _faulty,
    draw_place,
    random_place,
)
from sim_player.generate.wall_kinds import FINISHES, Line, build, kinds_at
from sim_player.paths.ray_tracing import trace
from sim_player.paths.truth import hidden_objects, labelled
from sim_player.scene.description import OBJECT_KINDS, Scene, Surface, check_scene, scene_from_yaml, scene_to_yaml
from sim_player.scene.front_end import FrontEnd
from sim_player.scene.road_users import scattering_centres, seen_rcs_m2
from sim_player.scene.world import prepare

COUNT = 200
FIRST = (12.0, -3.0)
#: All that shows objects directly or by one mirror.
OBJECT_EFFECTS = frozenset({"los_objects", "specular_relay", "curved_wall"})


@pytest.fixture(scope="module")
def places() -> list[Place]:
    return [draw_place(5, index) for index in range(COUNT)]


@pytest.fixture(scope="module")
def seen(places: list[Place]) -> list[tuple[frozenset[int], frozenset[int]]]:
    """Objects seen directly, and objects seen in mirrors only, of each place."""
    found = []
    for place in places:
        paths = trace(prepare(place.scene), 0.0, OBJECT_EFFECTS)
        direct = paths.object_index[labelled(paths) & (paths.kind == PathClass.LOS)]
        found.append((frozenset(direct.tolist()), hidden_objects(paths)))
    return found


@pytest.mark.slow
def test_places_are_legal_and_survive_yaml(places: list[Place]) -> None:
    for index, place in enumerate(places):  # `prepare` checks them all again in `seen`
        assert msgspec.json.decode(msgspec.json.encode(place.scene), type=Scene) == place.scene
        assert place.scene.name == f"{place.kind}_5_{index}"
        assert not place.scene.moves
    for place in places[:10]:
        check_scene(place.scene)
        assert scene_from_yaml(scene_to_yaml(place.scene)) == place.scene


def test_places_repeat_whatever_was_drawn_before(places: list[Place]) -> None:
    for index in (17, 3, 150):
        assert msgspec.json.encode(random_place(5, index)) == msgspec.json.encode(places[index].scene)
    assert len({msgspec.json.encode(place.scene) for place in places}) == COUNT
    assert random_place(6, 3) != places[3].scene


def test_kinds_relays_classes_and_grounds_all_occur(places: list[Place]) -> None:
    """200 places, 4 kinds evenly (50 +- 6 each, 4 sigma 24); ground in 80 % (160 +- 5.7, 4 sigma 23)."""
    kinds = Counter(place.kind for place in places)
    assert set(kinds) == set(PLACE_KINDS)
    assert all(26 <= count <= 74 for count in kinds.values())
    assert {relay for place in places for relay in place.relays} == set(kinds_at("xband"))
    hiding = {place.scene.objects[index].class_ for place in places for index in place.hidden}
    assert hiding == set(CLASS_SHARE)
    grounds = [surface for place in places for surface in place.scene.surfaces if surface.role == "ground"]
    assert abs(len(grounds) - GROUND_SHARE * COUNT) < 23
    assert len({surface.material for surface in grounds}) > 1


def test_walls_stand_in_their_bands(places: list[Place]) -> None:
    """Roughness and thickness within the bands of the material's finishes; arcs turn by less than 1.5 rad."""
    walls = [wall for place in places for wall in place.scene.surfaces if wall.role != "ground"]
    for wall in walls:
        bands = [finish for finish in FINISHES.values() if finish.material == wall.material]
        assert any(
            low <= wall.roughness_mm <= high * (1 + 1e-12) and thin <= (wall.thickness_mm or 0.0) <= thick
            for (low, high), (thin, thick) in ((finish.roughness_mm, finish.thickness_mm) for finish in bands)
        )
        assert 5.0 <= wall.correlation_mm <= 100.0 * (1 + 1e-12)
        chord = max(math.dist(a, b) for a, b in pairwise(wall.polyline_m))
        assert abs(wall.curvature_per_m) * chord < 1.5
        assert abs(wall.curvature_per_m) <= 0.06
    bent = [wall.curvature_per_m for wall in walls if wall.curvature_per_m]
    assert min(bent) < -0.005
    assert max(bent) > 0.005


@pytest.mark.slow
def test_what_is_placed_out_of_sight_is(places: list[Place], seen: list[tuple[frozenset[int], frozenset[int]]]) -> None:
    """Traced: no direct path to any of them, and a mirror shows nearly all.

    Measured over seeds 1, 2, 5, 9 (200 places each): 0 of 1328 seen directly, 1325 seen in a mirror. Placing sees arcs
    as chords and objects as their centres, so a few have no image in the end.
    """
    placed = [(index, place, thing) for index, place in enumerate(places) for thing in place.hidden]
    assert len(placed) > 250
    assert not [place.scene.name for index, place, thing in placed if thing in seen[index][0]]
    assert np.mean([thing in seen[index][1] for index, _, thing in placed]) > 0.97


def test_few_places_hide_nothing(places: list[Place], seen: list[tuple[frozenset[int], frozenset[int]]]) -> None:
    """12 % are drawn empty, and almost all others hide something; 12 % + 3 sigma = 19 %.

    Measured over seeds 1, 2, 5, 9 (200 places each): 9.5, 9, 9 and 10.5 % hide nothing.
    """
    nothing = [not mirrored for _, mirrored in seen]
    assert 0.03 < np.mean(nothing) < 0.19
    # of those that were to hide something
    meant = [empty for empty, place in zip(nothing, places, strict=True) if place.hidden]
    assert np.mean(meant) < 0.03
    assert sum(len(mirrored) > 1 for _, mirrored in seen) > 0.3 * COUNT
    assert sum(bool(direct - {-1}) for direct, _ in seen) > 0.7 * COUNT


def test_overlapping_images_lie_within_two_metres(places: list[Place]) -> None:
    """Places that say so: two hidden objects with images in some wall at ranges less than 2 m apart."""
    overlapping = [place for place in places if place.overlapping]
    assert len(overlapping) > 0.1 * COUNT
    for place in overlapping:
        first, second = (_image_ranges(place, index) for index in place.hidden[:2])
        assert np.abs(first[:, None] - second).min() < 2.0


def _image_ranges(place: Place, index: int) -> np.ndarray:
    """Ranges of an object's centre in all mirrors, nothing in the way but walls."""
    walls = Walls.of(tuple(wall for wall in place.scene.surfaces if wall.role != "ground"))
    thing = place.scene.objects[index]
    spot = np.array([[thing.x_m, thing.y_m]])
    return images(spot, walls, Boxes.of(()), math.radians(56.0), (1.0, 70.0)).range_m


def test_objects_stand_apart(places: list[Place]) -> None:
    for place in places:
        boxes = Boxes.of(place.scene.objects)
        for index in range(len(boxes.corners)):
            own = Boxes(boxes.corners[index : index + 1])
            others = Boxes(np.delete(boxes.corners, index, axis=0))
            assert not own.crossed_by(*others.faces).any()
            if index in place.hidden:
                assert not indoors(own.corners.mean(axis=1), _rings(place.scene)).any()


def _rings(scene: Scene) -> tuple[np.ndarray, ...]:
    return tuple(
        np.array(wall.polyline_m)
        for wall in scene.surfaces
        if wall.polyline_m and wall.polyline_m[0] == wall.polyline_m[-1]
    )


def test_parking_lots_hold_parked_vehicles() -> None:
    """3-10 in bays, heading across the rows to within a few degrees (rows turn with the place: 4 deg rms)."""
    for index in range(20):
        place = draw_place(8, index, kind="parking_lot")
        assert place.kind == "parking_lot"
        vehicles = [thing for thing in place.scene.objects if thing.class_ in ("car", "van")]
        across = [thing for thing in vehicles if abs(abs(math.cos(math.radians(thing.yaw_deg)))) < 0.4]
        assert len(across) >= 3


def test_radars_and_weather_vary(places: list[Place]) -> None:
    """Shares of 30, 25 and 30 % among 200 places, to within 4 sigma = 13 %."""
    radars = [place.scene.radar for place in places]
    clean = FrontEnd()
    assert 0.17 < np.mean([radar.front_end != clean for radar in radars]) < 0.43
    assert 0.17 < np.mean([radar.separation_m > 0.0 for radar in radars]) < 0.43
    assert 0.12 < np.mean([place.scene.weather.rain_mm_per_h > 0.0 for place in places]) < 0.38
    assert all(0.5 <= radar.height_m <= 1.5 and radar.separation_m <= 0.3 for radar in radars)


def test_front_ends_have_each_fault_alike_and_one_spur_or_two() -> None:
    """Shares of 0.6 among 1000, to within 3 sigma = 0.05; of those with spurs half have two."""
    ends = [_faulty(np.random.default_rng(seed)) for seed in range(1000)]
    has = [(end.coupling_db, end.iq_gain_db, end.flicker_corner_hz, end.leakage_dbm, end.spurs) for end in ends]
    assert [np.mean([bool(fault) for fault in faults]) for faults in zip(*has, strict=True)] == pytest.approx(
        [0.6] * 5, abs=0.05
    )
    assert np.bincount([len(end.spurs) for end in ends]) / 1000 == pytest.approx([0.4, 0.3, 0.3], abs=0.05)
    assert all(-120.0 <= spur.power_dbm <= -95.0 and 1e6 <= spur.frequency_hz <= 90e6 for e in ends for spur in e.spurs)
    assert all(end.coupling_db is None or -30.0 <= end.coupling_db <= -18.0 for end in ends)


def test_a_bent_road_runs_a_metre_beside_its_wall() -> None:
    """It begins there where its wall does, on its left, and turns with it."""
    streets = [draw_layout(np.random.default_rng(seed), "street") for seed in range(60)]
    bends = [(street.lines[-1], zone) for street in streets for zone in street.zones if zone.turn_deg]
    assert len(bends) > 10
    for wall, zone in bends:
        turn = math.radians(zone.turn_deg)
        along, left = np.array([math.cos(turn), math.sin(turn)]), np.array([-math.sin(turn), math.cos(turn)])
        foot = np.array([zone.x_m[0], zone.y_m[0]]) - np.array(wall.start)
        assert (foot @ along, foot @ left) == pytest.approx((0.0, 1.0), abs=1e-9)
        assert (np.array(wall.end) - np.array(wall.start)) @ left == pytest.approx(0.0, abs=1e-9)


def test_77ghz_places_have_only_materials_measured_there() -> None:
    """Brick at 77 GHz is interpolated: scenes may name it, drawn places keep to what was measured."""
    scenes = [random_place(5, index, preset="77ghz") for index in range(25)]
    for scene in scenes:
        check_scene(scene)
        assert scene.radar.preset == "77ghz"
    materials = {surface.material for scene in scenes for surface in scene.surfaces}
    assert "brick" not in materials
    assert {"concrete", "glass", "metal"} <= materials


def test_motion_only_if_asked() -> None:
    scenes = [random_place(5, index, motion=True) for index in range(30)]
    assert all(scene.ego.speed_mps > 0.0 for scene in scenes)
    speeds = [(thing.class_, thing.speed_mps) for scene in scenes for thing in scene.objects]
    assert any(speed > 5.0 for _, speed in speeds)
    assert all(0.0 <= speed <= MAX_SPEED_MPS[name] for name, speed in speeds)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"seed": -1}, "seed must not be negative"),
        ({"seed": 1, "index": -2}, "index must not be negative"),
        ({"seed": 1, "preset": "spad"}, "preset must be one of xband, 77ghz"),
        ({"seed": 1, "kind": "desert"}, "kind must be one of street, "),
    ],
)
def test_bad_arguments_are_refused(arguments: dict[str, object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        random_place(**arguments)  # type: ignore[arg-type]


@pytest.mark.parametrize("kind", list(relays._BUILDERS))
def test_each_kind_of_wall_stands_on_its_line(kind: relays.RelayKind, monkeypatch: pytest.MonkeyPatch) -> None:
    """A line 16 m long: pieces in it, in front of it (a corner's wing) or behind it (containers)."""
    monkeypatch.setattr(relays, "known", lambda material, preset: True)
    line = Line(FIRST, (12.0, 13.0), (kind,), wing_m=5.0)
    for seed in range(5):
        name, pieces = build(np.random.default_rng(seed), line, "xband")
        points = np.concatenate([piece.polyline_m for piece in pieces])
        assert name == kind
        assert points[:, 1].min() >= -3.0 - 1e-9
        assert points[:, 1].max() <= 13.0 + 1e-9
        behind, before = points[:, 0].max() - 12.0, 12.0 - points[:, 0].min()
        assert behind == pytest.approx(2.44 if kind == "container" else 0.0, abs=1e-9)
        assert before <= (5.0 if kind == "corner" else 0.0) + 1e-9


def test_a_facade_is_one_plane_without_gaps() -> None:
    line = Line(FIRST, (12.0, 13.0), ("facade",))
    _, pieces = build(np.random.default_rng(0), line, "xband")
    assert {piece.material for piece in pieces[1::2]} == {"glass"}
    assert pieces[0].polyline_m[0] == pytest.approx(FIRST)
    for one, other in pairwise(pieces):
        assert one.polyline_m[-1] == pytest.approx(other.polyline_m[0], abs=1e-12)
    assert pieces[-1].polyline_m[-1] == pytest.approx((12.0, 13.0))


def test_containers_have_their_size() -> None:
    line = Line(FIRST, (12.0, 13.0), ("container",))
    for seed in range(8):
        _, pieces = build(np.random.default_rng(seed), line, "xband")
        for piece in pieces:
            sides = [math.dist(a, b) for a, b in pairwise(piece.polyline_m)]
            assert sides[0] == pytest.approx(sides[2])
            assert min(abs(sides[0] - length) for length in (6.06, 12.19)) < 1e-9
            assert sides[1] == pytest.approx(2.44)
            assert piece.height_m == 2.59


def test_arcs_have_their_curvature() -> None:
    """Chords' ends at 1 / curvature from a centre on the left of the way for positive curvature."""
    for curvature, centre in ((0.05, (10.0, math.sqrt(300.0))), (-0.05, (10.0, -math.sqrt(300.0)))):
        arc = chords(
            Surface(role="relay", material="metal", polyline_m=((0.0, 0.0), (20.0, 0.0)), curvature_per_m=curvature)
        )
        np.testing.assert_allclose(np.hypot(*(arc - np.array(centre)).T), 20.0, rtol=1e-12)
        np.testing.assert_allclose(arc[[0, -1]], [[0.0, 0.0], [20.0, 0.0]], atol=1e-12)


def test_glass_and_arcs_hide_nothing_but_vehicles_do() -> None:
    far = np.array([[20.0, 0.0]])
    nothing = Boxes.of(())

    def wall(material: str, curvature: float = 0.0) -> Walls:
        return Walls.of(
            (Surface(role="relay", material=material, polyline_m=((9.0, -5.0), (9.0, 5.0)), curvature_per_m=curvature),)
        )

    assert hidden(far, wall("concrete"), nothing)[0]
    assert not hidden(far, wall("glass"), nothing)[0]
    assert not hidden(far, wall("metal", 0.01), nothing)[0]
    truck = Boxes.at(np.array([[12.0, 0.0]]), np.array([90.0]), 8.0, 2.5)
    assert hidden(far, wall("glass"), truck)[0]


@pytest.mark.parametrize(
    ("name", "low_dbsm", "high_dbsm"),
    [
        ("car", 11.25, 11.25),
        ("pedestrian", -1.37, -1.37),
        ("van", 11.25, 20.0),
        ("truck", 20.0, 30.0),
        ("bus", 20.0, 30.0),
        ("bicycle", -3.0, 3.0),
    ],
)
def test_mean_rcs_is_the_published_one(name: str, low_dbsm: float, high_dbsm: float) -> None:
    """Car and pedestrian: 3GPP TR 38.901 clause 7.9.2; the others: the range commonly quoted, a van between
    car and truck.

    Mean over 1,440 level aspects other than those that the model is normalised on, 8 seeds; tolerance 0.1 dB.
    """
    for seed in range(8):
        level_dbsm = 10.0 * np.log10(_level_rcs_m2(name, seed, np.arange(0.1, 360.0, 0.25)).mean())
        assert low_dbsm - 0.1 < level_dbsm < high_dbsm + 0.1
        assert level_dbsm == pytest.approx(OBJECT_KINDS[name].mean_rcs_dbsm, abs=0.1)


def test_car_flashes_broadside_most() -> None:
    """Lobes of the box model, level, mean over +-5 deg and 40 seeds, against 3GPP's 20.75 / 15.52 / 14.56 dBsm.

    Known bias: side 13.6, front and rear 11.4 dBsm (200 seeds), 7, 4 and 3 dB below the published peaks: the model's
    corners and wheels have no lobe, and its mean over all aspects is held. Tolerance 0.7 dB (40 seeds: 0.2 dB rms).
    """
    around = np.array([-5.0, -3.0, -1.0, 1.0, 3.0, 5.0])
    for aspect_deg, level_dbsm in ((0.0, 11.4), (90.0, 13.6), (180.0, 11.4)):
        mean_m2 = np.mean([_level_rcs_m2("car", seed, aspect_deg + around) for seed in range(40)])
        assert 10.0 * np.log10(mean_m2) == pytest.approx(level_dbsm, abs=0.7)


def _level_rcs_m2(name: str, seed: int, aspect_deg: np.ndarray) -> np.ndarray:
    """Incoherent sum of an object's centres towards level directions, [aspects]."""
    centres = scattering_centres(name, seed, 0)
    direction = np.zeros((len(aspect_deg), 1, centres.normals.shape[-1]))
    direction[:, 0, 0], direction[:, 0, 1] = np.cos(np.radians(aspect_deg)), np.sin(np.radians(aspect_deg))
    seen = seen_rcs_m2(centres.peak_rcs_m2, centres.normals, centres.lobe_exponent, direction)
    return np.asarray(seen.sum(axis=1))
