"""Random places from a seed (section 2.1.2): streets, parking lots, residential blocks, mixed intersections.

A plan of the place, walls, parked vehicles, hidden road users with a mirror image, others, faults and weather.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import get_args

import numpy as np
from msgspec.structs import replace

from models.physics.plane import segment_distance_m
from sim_player.generate.layouts import Block, Layout, PlaceKind, draw_layout
from sim_player.generate.placement import CLEARANCE_M, ORIGIN, WALL_CLEARANCE_M, Boxes, Walls, hidden, images, indoors
from sim_player.generate.wall_kinds import CORRELATION_MM, FINISHES, Preset, RelayKind, build, known, surface
from sim_player.scene.description import (
    OBJECT_KINDS,
    PRESETS,
    Ego,
    Scene,
    SceneObject,
    SceneRadar,
    Surface,
    Weather,
    check_scene,
)
from sim_player.scene.front_end import FrontEnd, Spur

#: Required range and azimuth of images of hidden objects.
IMAGE_RANGE_M, IMAGE_AZIMUTH_RAD = (5.0, 60.0), math.radians(55.0)
#: Probability of each class in the open: cars are most common, as on real streets.
CLASS_SHARE = {"car": 0.35, "van": 0.15, "truck": 0.12, "bus": 0.08, "bicycle": 0.14, "pedestrian": 0.16}
#: Probability of each class to be tried first in hiding: long vehicles fit more rarely.
HIDING_SHARE = {"car": 0.28, "van": 0.17, "truck": 0.22, "bus": 0.17, "bicycle": 0.08, "pedestrian": 0.08}
PLACE_KINDS: tuple[PlaceKind, ...] = get_args(PlaceKind)
#: Share of places that are given no hidden object.
EMPTY_SHARE = 0.12
#: Share, among places with two hidden objects or more, where the second image is to lie beside the first.
OVERLAP_SHARE, OVERLAP_M = 0.4, 1.5
GROUND_SHARE, FAULTY_SHARE, RAIN_SHARE, SEPARATED_SHARE = 0.8, 0.3, 0.25, 0.3
#: Each fault of a faulty front end is there with this probability.
FAULT_SHARE = 0.6
#: Plans drawn until something hides.
ATTEMPTS = 4
CANDIDATES = 160
#: Sets of candidates tried for a class that is wanted.
CLASS_ATTEMPTS = 4
#: Largest number of candidates that are tested in full after the quick tests.
SHORTLIST = 24
#: Least distance of the radar from every wall, and from the circle around every road user.
WALL_ROOM_M, RADAR_ROOM_M = 1.0, 2.0
#: The place is turned under the radar by this much, rms.
TURN_RAD = math.radians(4.0)
#: Grounds by how often, with rms roughness in mm.
GROUNDS: dict[str, tuple[float, tuple[float, float]]] = {
    "asphalt": (0.6, (0.3, 1.5)),
    "concrete": (0.3, (0.2, 1.0)),
    "medium_dry_ground": (0.1, (1.0, 3.0)),
}
#: Largest speed by class, m/s.
MAX_SPEED_MPS = {"car": 15.0, "van": 15.0, "truck": 15.0, "bus": 15.0, "bicycle": 7.0, "pedestrian": 2.0}


#: A wall's kind (None: a building's plain sides) and its surfaces.
Built = tuple[RelayKind | None, tuple[Surface, ...]]


@dataclass(frozen=True)
class Place:
    """A scene with the parts it was made from."""

    scene: Scene
    kind: PlaceKind
    #: Kinds of wall in the order they were built.
    relays: tuple[RelayKind, ...]
    #: Indices of the objects placed out of sight, and whether two of them were placed for images that overlap.
    hidden: tuple[int, ...]
    overlapping: bool
    #: The first so many objects are parked.
    parked: int


def random_place(
    seed: int,
    index: int = 0,
    preset: Preset = "xband",
    kind: PlaceKind | None = None,
    motion: bool = False,
) -> Scene:
    """Return scene `index` of series `seed`, a place of a kind (None: any), at rest unless `motion`; `check_scene`
    passes.

    A 77 GHz scene has only materials known there. ValueError for a negative seed or index, unknown preset or kind.
    """
    return draw_place(seed, index, preset, kind, motion).scene


def draw_place(
    seed: int,
    index: int = 0,
    preset: Preset = "xband",
    kind: PlaceKind | None = None,
    motion: bool = False,
    class_mix: Mapping[str, float] | None = None,
) -> Place:
    """Return `random_place` with the parts of the scene; `class_mix`: share of each class, None: what fits first."""
    for name, number in (("seed", seed), ("index", index)):
        if number < 0:
            raise ValueError(f"{name} must not be negative, got {number!r}")
    if preset not in PRESETS:
        raise ValueError(f"preset must be one of {', '.join(PRESETS)}, got {preset!r}")
    if kind is not None and kind not in PLACE_KINDS:
        raise ValueError(f"kind must be one of {', '.join(PLACE_KINDS)}, got {kind!r}")
    rng = np.random.default_rng([seed, index])
    drawn: PlaceKind = PLACE_KINDS[rng.integers(len(PLACE_KINDS))]
    kind = drawn if kind is None else kind
    hidden_count = 0 if rng.random() < EMPTY_SHARE else int(rng.integers(1, 4))
    overlap = hidden_count > 1 and bool(rng.random() < OVERLAP_SHARE)
    for _ in range(ATTEMPTS):
        crowd = _walls_and_parked(rng, kind, preset)
        _hide(rng, crowd, hidden_count, overlap, class_mix)
        if crowd.hidden or not hidden_count:
            break
    for _ in range(int(rng.integers(0, 4))):
        crowd.add(rng, False, classes=_classes(rng, class_mix))
    scene = Scene(
        name=f"{kind}_{seed}_{index}",
        radar=SceneRadar(
            preset=preset,
            height_m=float(rng.uniform(0.5, 1.5)),
            separation_m=float(rng.uniform(0.0, 0.3)) if rng.random() < SEPARATED_SHARE else 0.0,
            front_end=_faulty(rng) if rng.random() < FAULTY_SHARE else FrontEnd(),
        ),
        surfaces=(*crowd.surfaces, *draw_ground(rng, preset)),
        objects=_moving(rng, crowd) if motion else tuple(crowd.objects),
        ego=(
            Ego(speed_mps=float(rng.uniform(0.0, 15.0)), yaw_rate_dps=float(rng.uniform(-10.0, 10.0)))
            if motion
            else Ego()
        ),
        weather=Weather(
            rain_mm_per_h=float(rng.uniform(0.0, 30.0)) if rng.random() < RAIN_SHARE else 0.0,
            temperature_c=float(rng.uniform(-5.0, 30.0)),
        ),
    )
    check_scene(scene)
    return Place(scene, kind, crowd.relays, tuple(crowd.hidden), crowd.overlapping, crowd.parked)


@dataclass(frozen=True)
class _Turn:
    """Transform from the plan to the radar's frame: turned, then left and right exchanged."""

    angle_rad: float
    flip: bool

    def points(self, points: np.ndarray) -> np.ndarray:
        """Return the points [N, 2]."""
        c, s = math.cos(self.angle_rad), math.sin(self.angle_rad)
        return points @ np.array([[c, s], [-s, c]]) * np.array([1.0, -1.0 if self.flip else 1.0])

    def heading_deg(self, heading_deg: np.ndarray) -> np.ndarray:
        """Return the headings [N]."""
        turned = heading_deg + math.degrees(self.angle_rad)
        return -turned if self.flip else turned

    def surface(self, piece: Surface) -> Surface:
        """Return a wall."""
        return replace(
            piece,
            polyline_m=tuple((x, y) for x, y in self.points(np.array(piece.polyline_m)).tolist()),
            curvature_per_m=-piece.curvature_per_m if self.flip else piece.curvature_per_m,
        )


@dataclass
class _Crowd:
    """Walls, and the road users placed among them so far."""

    surfaces: tuple[Surface, ...]
    relays: tuple[RelayKind, ...]
    layout: Layout
    turn: _Turn
    walls: Walls
    #: Outlines of buildings and containers.
    rings: tuple[np.ndarray, ...]
    objects: list[SceneObject] = field(default_factory=list)
    hidden: list[int] = field(default_factory=list)
    parked: int = 0
    overlapping: bool = False
    #: Ranges of the images of hidden objects, and the segments [L, 2] of the paths that show them.
    image_m: list[float] = field(default_factory=list)
    segment_a: np.ndarray = field(default_factory=lambda: np.zeros((0, 2)))
    segment_b: np.ndarray = field(default_factory=lambda: np.zeros((0, 2)))

    def add(
        self,
        rng: np.random.Generator,
        hide: bool,
        beside_m: float | None = None,
        classes: tuple[str, ...] | None = None,
    ) -> bool:
        """Add a road user out of sight or in the open, the first of some classes that fits; False where none fits."""
        spot, heading = _candidates(rng, self.layout, self.turn, CANDIDATES)
        boxes = Boxes.of(tuple(self.objects))
        keep = ~indoors(spot, self.rings) & (np.hypot(*spot.T) > IMAGE_RANGE_M[0])
        keep[keep] = hidden(spot[keep], self.walls, boxes) == hide
        spot, heading = spot[keep], heading[keep]
        if hide:
            shown = images(spot, self.walls, boxes, IMAGE_AZIMUTH_RAD, IMAGE_RANGE_M)
            near = np.full(len(shown.spot), beside_m is None) | (np.abs(shown.range_m - (beside_m or 0.0)) < OVERLAP_M)
            fits = np.unique(shown.spot[near])
        else:
            fits = np.flatnonzero(np.abs(np.arctan2(spot[:, 1], spot[:, 0])) < IMAGE_AZIMUTH_RAD)
        share = HIDING_SHARE if hide else CLASS_SHARE
        for name in classes or rng.choice(list(share), len(share), replace=False, p=list(share.values())):
            # along the traffic, either way; random for pedestrians and in yards
            along = heading + rng.choice([0.0, 180.0], len(heading)) + rng.normal(0.0, 6.0, len(heading))
            yaw_deg = np.where(np.isnan(heading) | (name == "pedestrian"), rng.uniform(0.0, 360.0, len(heading)), along)
            for index in fits[self._stand(str(name), spot[fits], yaw_deg[fits], boxes, hide)][:1]:
                if hide:
                    is_shown = (shown.spot == index) & near
                    specular = shown.specular[is_shown]
                    self.hidden.append(len(self.objects))
                    self.image_m.append(float(shown.range_m[is_shown].min()))
                    to_spot = np.broadcast_to(spot[index], specular.shape)
                    self.segment_a = np.concatenate([self.segment_a, np.zeros_like(specular), specular])
                    self.segment_b = np.concatenate([self.segment_b, specular, to_spot])
                self.objects.append(_road_user(str(name), spot[index], yaw_deg[index]))
                return True
        return False

    def park(self, rng: np.random.Generator) -> None:
        """Park vehicles in some of the bays."""
        low, high = self.layout.parked
        count = int(rng.integers(low, high + 1))
        for index in rng.permutation(len(self.layout.bays)):
            if len(self.objects) == count:
                break
            bay = self.layout.bays[index]
            name = str(rng.choice(["car", "van", "truck"] if bay.large else ["car", "car", "van"]))
            spot = self.turn.points(np.array([[bay.x_m, bay.y_m]]) + rng.normal(0.0, 0.1, (1, 2)))
            yaw_deg = self.turn.heading_deg(
                np.array([bay.heading_deg + rng.choice([0.0, 180.0]) + rng.normal(0.0, 2.0)])
            )
            if not indoors(spot, self.rings)[0] and self._stand(name, spot, yaw_deg, Boxes.of(tuple(self.objects)))[0]:
                self.objects.append(_road_user(name, spot[0], yaw_deg[0]))
        self.parked = len(self.objects)

    def _stand(self, name: str, spot: np.ndarray, yaw_deg: np.ndarray, boxes: Boxes, hide: bool = False) -> np.ndarray:
        """Return which spots [N] leave room to walls, road users, the radar, and to the paths that show hidden ones."""
        size = OBJECT_KINDS[name]
        fits = np.hypot(*spot.T) > 0.5 * math.hypot(size.length_m, size.width_m) + RADAR_ROOM_M
        fits[np.flatnonzero(fits)[SHORTLIST:]] = False
        spot, yaw_deg = spot[fits], yaw_deg[fits]

        def grown(by_m: float) -> Boxes:
            return Boxes.at(spot, yaw_deg, size.length_m + 2.0 * by_m, size.width_m + 2.0 * by_m)

        own = grown(0.0)
        good = ~grown(WALL_CLEARANCE_M).crossed_by(*self.walls.footing)
        good &= ~grown(CLEARANCE_M).crossed_by(*boxes.faces) & ~boxes.contain(spot).any(axis=0)
        good &= ~own.crossed_by(self.segment_a, self.segment_b)
        if hide:
            # points all around the boxes, [N, 16, 2]
            edges = np.roll(own.corners, -1, axis=1) - own.corners
            steps = np.array([0.0, 0.25, 0.5, 0.75])[:, None] * edges[:, :, None]
            outline = (own.corners[:, :, None] + steps).reshape(len(own.corners), 16, 2)
            good[good] = hidden(outline[good].reshape(-1, 2), self.walls, boxes).reshape(-1, outline.shape[1]).all(1)
        fits[fits] = good
        return fits


def _walls_and_parked(rng: np.random.Generator, kind: PlaceKind, preset: Preset) -> _Crowd:
    """Return a place with parked vehicles alone; drawn again until the radar has room."""
    while True:
        layout = draw_layout(rng, kind)
        turn = _Turn(float(rng.normal(0.0, TURN_RAD)), bool(rng.random() < 0.5))
        built: list[Built] = [build(rng, line, preset) for line in layout.lines]
        for block in layout.blocks:
            built += _block(rng, block, preset)
        surfaces = tuple(turn.surface(piece) for _, pieces in built for piece in pieces)
        walls = Walls.of(surfaces)
        rings = (
            *(turn.points(np.array([side.start for side in block.sides().values()])) for block in layout.blocks),
            *(np.array(wall.polyline_m) for wall in surfaces if wall.polyline_m[0] == wall.polyline_m[-1]),
        )
        far = segment_distance_m(ORIGIN[None], walls.a, walls.b).min() > WALL_ROOM_M
        if far and not indoors(ORIGIN[None], rings)[0]:
            crowd = _Crowd(surfaces, tuple(kind for kind, _ in built if kind is not None), layout, turn, walls, rings)
            crowd.park(rng)
            return crowd


def _block(rng: np.random.Generator, block: Block, preset: Preset) -> list[Built]:
    """Return a building: its fronts, and one plain wall around the rest."""
    sides = block.sides()
    built: list[Built] = [build(rng, sides[side], preset) for side in block.fronts]
    order = "wnes" * 2
    first = next(i for i in range(4) if order[i] in block.fronts and order[i + 1] not in block.fronts) + 1
    plain = [sides[side] for side in order[first : first + 4 - len(block.fronts)]]
    names = [name for name in ("concrete", "rendered", "brick") if known(FINISHES[name].material, preset)]
    finish = FINISHES[names[rng.integers(len(names))]]
    outline = (plain[0].start, *(side.end for side in plain))
    return [*built, (None, (surface(rng, finish, outline, float(rng.uniform(*block.height_m)), role="occluder"),))]


def _hide(
    rng: np.random.Generator, crowd: _Crowd, count: int, overlap: bool, class_mix: Mapping[str, float] | None
) -> None:
    """Add road users out of sight, the second beside the first one's image if overlap is requested."""
    for _ in range(count):
        beside = crowd.image_m[0] if overlap and len(crowd.image_m) == 1 else None
        classes = _classes(rng, class_mix)
        if crowd.add(rng, True, beside, classes):
            crowd.overlapping |= beside is not None
        elif beside is not None or classes:
            # a class that is wanted gets more places to be tried
            any(crowd.add(rng, True, None, classes) for _ in range(CLASS_ATTEMPTS if classes else 1))


def _classes(rng: np.random.Generator, class_mix: Mapping[str, float] | None) -> tuple[str, ...] | None:
    """Return the class of the next road user under a mix; None, and nothing drawn, without one."""
    return None if class_mix is None else (str(rng.choice(list(class_mix), p=list(class_mix.values()))),)


def _candidates(rng: np.random.Generator, layout: Layout, turn: _Turn, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the spots [count, 2] all over the zones, and the heading of traffic there (NaN: any)."""
    zone = rng.integers(len(layout.zones), size=count)
    share = rng.random((count, 2))
    low = np.array([(z.x_m[0], z.y_m[0]) for z in layout.zones])
    size = np.array([(z.x_m[1] - z.x_m[0], z.y_m[1] - z.y_m[0]) for z in layout.zones])
    angle = np.radians([z.turn_deg for z in layout.zones])[zone]
    inner = share * size[zone]
    c, s = np.cos(angle), np.sin(angle)
    spot = low[zone] + np.column_stack([c * inner[:, 0] - s * inner[:, 1], s * inner[:, 0] + c * inner[:, 1]])
    heading = np.array([math.nan if z.heading_deg is None else z.heading_deg for z in layout.zones])[zone]
    return turn.points(spot), turn.heading_deg(heading)


def _road_user(name: str, spot: np.ndarray, yaw_deg: float) -> SceneObject:
    """Return an object at rest."""
    return SceneObject(
        class_=name,  # type: ignore[arg-type]
        x_m=float(spot[0]),
        y_m=float(spot[1]),
        yaw_deg=math.remainder(float(yaw_deg), 360.0),
    )


def draw_ground(rng: np.random.Generator, preset: Preset) -> tuple[Surface, ...]:
    """Return the ground of most places."""
    if rng.random() >= GROUND_SHARE:
        return ()
    names = [name for name in GROUNDS if known(name, preset)]
    share = np.array([GROUNDS[name][0] for name in names])
    name = str(rng.choice(names, p=share / share.sum()))
    return (
        Surface(
            role="ground",
            material=name,
            roughness_mm=float(rng.uniform(*GROUNDS[name][1])),
            correlation_mm=float(rng.uniform(*CORRELATION_MM)),
        ),
    )


def _faulty(rng: np.random.Generator) -> FrontEnd:
    """Return a front end with some typical faults."""
    coupled, skewed, flickers, leaks, spurs = rng.random(5) < FAULT_SHARE
    return FrontEnd(
        coupling_db=float(rng.uniform(-30.0, -18.0)) if coupled else None,
        coupling_phase_deg=float(rng.uniform(-180.0, 180.0)) if coupled else 0.0,
        iq_gain_db=float(rng.uniform(0.0, 0.5)) if skewed else 0.0,
        iq_phase_deg=float(rng.uniform(0.0, 3.0)) if skewed else 0.0,
        flicker_corner_hz=float(rng.uniform(0.0, 50e3)) if flickers else 0.0,
        leakage_dbm=float(rng.uniform(-60.0, -35.0)) if leaks else None,
        adc_bits=int(rng.choice([12, 14, 16])),
        spurs=tuple(
            Spur(frequency_hz=float(rng.uniform(1e6, 90e6)), power_dbm=float(rng.uniform(-120.0, -95.0)))
            for _ in range(int(rng.integers(1, 3)) if spurs else 0)
        ),
    )


def _moving(rng: np.random.Generator, crowd: _Crowd) -> tuple[SceneObject, ...]:
    """Return all but the parked set in motion."""
    return tuple(
        road_user
        if index < crowd.parked
        else replace(road_user, speed_mps=float(rng.uniform(0.0, MAX_SPEED_MPS[str(road_user.class_)])))
        for index, road_user in enumerate(crowd.objects)
    )
