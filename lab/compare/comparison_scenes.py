"""Corners for comparing sensors: one wall that mirrors, one that hides, one road user out of sight.

Seen from above, in the frame of the relay wall (u along it, n towards the radar, the specular point P at the origin):

    radar at (-r1 sin, r1 cos), object at (r2 sin, r2 cos), the hiding wall on the line u = 0 between them.

Both segments end at P, so the direct line crosses u = 0 farther from the wall than the path by the mirror does: the
hiding wall begins between the two. R = r1 + r2 is the range at which the image appears. Everything is drawn from
(seed, viewpoint) alone, so that the settings of a sweep differ in the swept parameter alone.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import msgspec
import numpy as np

from models.physics.mirror import reflect, wall_from_ends
from msgs.values.frames import polar_from_xy
from msgs.values.lidar import SpadParams
from msgs.values.perception import PathClass
from msgs.values.radar import RangeAzimuthGrid
from sim_player.generate.places import PlaceKind, draw_place
from sim_player.paths.ray_tracing import trace
from sim_player.paths.truth import labelled
from sim_player.scene.description import ObjectClass, Point, Scene, SceneObject, SceneRadar, Surface, check_scene
from sim_player.scene.world import prepare


@dataclass(frozen=True)
class WallKind:
    """A relay wall as built: material, thickness, rms roughness."""

    material: str
    thickness_mm: float
    roughness_mm: float


#: Roughness in the bands of `models.physics.materials.TYPICAL_ROUGHNESS_MM`; wood as planed. Float glass is glass whose
#: own surface counts, a nanometre, and not the dust and frames that the band of glass allows for: it mirrors light too.
WALLS: dict[str, WallKind] = {
    "metal": WallKind("metal", 2.0, 0.02),
    "polished_metal": WallKind("metal", 2.0, 1e-6),
    "float_glass": WallKind("glass", 6.0, 1e-6),
    "glass": WallKind("glass", 6.0, 0.02),
    "concrete": WallKind("concrete", 200.0, 0.3),
    "brick": WallKind("brick", 240.0, 0.9),
    "plasterboard": WallKind("plasterboard", 12.5, 0.1),
    "wood": WallKind("wood", 20.0, 0.1),
}
#: Variation of poses: azimuth of the specular point, heading against the wall, position.
AZIMUTH_DEG, YAW_DEG, SHIFT_M = 12.0, 10.0, 0.3
#: Share of the range that lies before the wall, and the height of both walls.
WALL_SHARE, HEIGHT_M = 0.4, 3.0
#: The relay wall reaches this far beyond the outermost specular point, and by this share of the image's range.
REACH_M, REACH_SHARE = 3.0, 0.03
#: Room between the object and both walls, and between the hiding wall and each of the two paths beside it.
CLEARANCE_M, PATH_CLEARANCE_M = 0.3, 0.03
#: The hiding wall reaches so far beyond the outermost direct line.
HIDING_REACH_M = 2.0
ATTEMPTS = 200
#: Truth points of an object lie at least this far apart.
TRUTH_SPACING_M = 0.5


class Corner(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """One setting: range of the image, incidence and material of the wall, hidden object."""

    #: R = r1 + r2.
    range_m: float = 8.0
    #: Against the wall's normal.
    incidence_deg: float = 45.0
    #: A name in `WALLS`.
    wall: str = "concrete"
    #: None: that of the wall.
    roughness_mm: float | None = None
    object_class: ObjectClass = "car"

    def __post_init__(self) -> None:
        for name, low, high in (("range_m", 3.0, 1000.0), ("incidence_deg", 5.0, 80.0)):
            if not low <= getattr(self, name) <= high:
                raise ValueError(f"corner.{name} must lie in {low:g}..{high:g}, got {getattr(self, name)!r}")
        if self.roughness_mm is not None and not 0.0 <= self.roughness_mm <= 1e3:
            raise ValueError(f"corner.roughness_mm must lie in 0..1000, got {self.roughness_mm!r}")
        if self.wall not in WALLS:
            raise ValueError(f"corner.wall must be one of {', '.join(WALLS)}, got {self.wall!r}")


def corner_scene(corner: Corner, seed: int = 0, viewpoint: int = 0) -> Scene:
    """Return the scene of a setting at X-band, from one viewpoint of a seeded series; always passes `check_scene`.

    Surfaces: relay wall, hiding wall; one object. ValueError for a negative seed or viewpoint, and where the object
    finds no room beside the walls or cannot be hidden (too large for its range or too steep an incidence).
    """
    for name, number in (("seed", seed), ("viewpoint", viewpoint)):
        if number < 0:
            raise ValueError(f"{name} must not be negative, got {number!r}")
    rng = np.random.default_rng([seed, viewpoint])
    for _ in range(ATTEMPTS):
        scene = _drawn(corner, rng, f"corner_{seed}_{viewpoint}")
        if scene is not None:
            check_scene(scene)
            return scene
    raise ValueError(
        f"corner.range_m must leave room to hide a {corner.object_class} at {corner.incidence_deg:g} deg, "
        f"got {corner.range_m!r}"
    )


def _drawn(corner: Corner, rng: np.random.Generator, name: str) -> Scene | None:
    """Return one attempt; the same numbers are drawn whatever the setting."""
    azimuth_rad, yaw_rad = np.radians(rng.uniform(-1.0, 1.0, 2) * [AZIMUTH_DEG, YAW_DEG]).tolist()
    shift_m, flip = rng.uniform(-SHIFT_M, SHIFT_M, 2), float(rng.choice([-1.0, 1.0]))
    theta, near_m = math.radians(corner.incidence_deg), WALL_SHARE * corner.range_m
    away = np.array([math.sin(theta), math.cos(theta)])
    radar = near_m * away * [-1.0, 1.0]
    at_origin = SceneObject(class_=corner.object_class, x_m=0.0, y_m=0.0, yaw_deg=math.degrees(yaw_rad))
    centre = (corner.range_m - near_m) * away + shift_m
    box = at_origin.corners_m() + centre
    span = _hiding_span(radar, box)
    if span is None:
        return None
    specular = radar[0] + (box[:, 0] - radar[0]) * radar[1] / (radar[1] + box[:, 1])
    reach_m = REACH_M + REACH_SHARE * corner.range_m
    frame = _Frame(near_m, azimuth_rad, theta, flip)
    ends = [[specular.min() - reach_m, 0.0], [specular.max() + reach_m, 0.0]]
    relay = _wall(corner.wall, frame.points(ends))
    if corner.roughness_mm is not None:
        relay = msgspec.structs.replace(relay, roughness_mm=corner.roughness_mm)
    hiding = _wall("concrete", frame.points([[0.0, span[0]], [0.0, span[1]]]))
    hiding = msgspec.structs.replace(hiding, role="occluder")
    x_m, y_m = frame.points([centre])[0]
    hidden_object = msgspec.structs.replace(
        at_origin, x_m=x_m, y_m=y_m, yaw_deg=math.degrees(frame.heading_rad(yaw_rad))
    )
    return Scene(name=name, surfaces=(relay, hiding), objects=(hidden_object,))


def _wall(name: str, polyline_m: tuple[Point, ...]) -> Surface:
    """Return a wall of `WALLS`."""
    kind = WALLS[name]
    return Surface(
        role="relay",
        material=kind.material,
        polyline_m=polyline_m,
        height_m=HEIGHT_M,
        thickness_mm=kind.thickness_mm,
        roughness_mm=kind.roughness_mm,
    )


def _hiding_span(radar: np.ndarray, box: np.ndarray) -> tuple[float, float] | None:
    """Return the span on u = 0 of a wall that hides a box [4, 2]; None where none hides all of it."""
    if box.min() < CLEARANCE_M:
        return None
    share = -radar[0] / (box[:, 0] - radar[0])
    direct = radar[1] + share * (box[:, 1] - radar[1])
    by_mirror = np.abs(radar[1] - share * (box[:, 1] + radar[1]))
    low, high = by_mirror.max() + PATH_CLEARANCE_M, direct.min() - PATH_CLEARANCE_M
    return (0.5 * (low + high), float(direct.max()) + HIDING_REACH_M) if low < high else None


@dataclass(frozen=True)
class _Frame:
    """Transform from the relay wall's frame to the radar's: u and n as directions, P as origin."""

    near_m: float
    azimuth_rad: float
    theta: float
    flip: float

    @property
    def along_rad(self) -> float:
        """Direction of u: the ray meets the wall at 90 deg less the incidence."""
        return self.azimuth_rad + self.flip * (0.5 * math.pi - self.theta)

    def heading_rad(self, angle_rad: float) -> float:
        """Return a heading against u as one against x."""
        return math.remainder(self.along_rad + self.flip * angle_rad, 2.0 * math.pi)

    def points(self, points: np.ndarray | list[list[float]] | list[np.ndarray]) -> tuple[Point, ...]:
        """Return the points [N, 2]."""
        u = np.array([math.cos(self.along_rad), math.sin(self.along_rad)])
        n = self.flip * np.array([-u[1], u[0]])
        origin = self.near_m * np.array([math.cos(self.azimuth_rad), math.sin(self.azimuth_rad)])
        in_radar_frame = origin + np.asarray(points, np.float64) @ np.stack([u, n])
        return tuple((x, y) for x, y in in_radar_frame.tolist())


def comparison_place(seed: int, index: int, kind: PlaceKind) -> Scene:
    """Return a random place of a kind whose materials are known at both bands, with the X-band radar in it.

    ValueError as `draw_place`.
    """
    return with_sensor(draw_place(seed, index, "77ghz", kind).scene, "xband")


def with_sensor(scene: Scene, preset: str, spad: SpadParams | None = None) -> Scene:
    """Return the same place with another sensor, without faults, at the same position.

    ValueError where the sensor or a material at its carrier is unknown.
    """
    radar = msgspec.convert({"preset": preset, "height_m": scene.radar.height_m}, SceneRadar)
    radar = msgspec.structs.replace(radar, spad=spad or SpadParams())
    swapped = msgspec.structs.replace(scene, radar=radar)
    check_scene(swapped)
    return swapped


@dataclass(frozen=True)
class MirrorPath:
    """Path to an object's centre by one wall: both segments, angle of incidence at the wall, azimuth at the sensor."""

    to_wall_m: float
    beyond_m: float
    cos_incidence: float
    azimuth_rad: float

    @property
    def range_m(self) -> float:
        """Range of the image."""
        return self.to_wall_m + self.beyond_m


def mirror_path(scene: Scene) -> MirrorPath:
    """Return the path from the sensor to the first object by the line of the first wall, which is straight."""
    a, b = np.array(scene.surfaces[0].polyline_m[0]), np.array(scene.surfaces[0].polyline_m[-1])
    normal, offset_m = wall_from_ends(a, b, np.zeros(2))
    position = np.array([scene.objects[0].x_m, scene.objects[0].y_m])
    image = reflect(position, normal, offset_m)
    range_m = math.hypot(*image)
    share = offset_m / (offset_m + float(normal @ position + offset_m))
    return MirrorPath(
        to_wall_m=share * range_m,
        beyond_m=(1.0 - share) * range_m,
        cos_incidence=float(-normal @ image / range_m),
        azimuth_rad=math.atan2(image[1], image[0]),
    )


@dataclass(frozen=True)
class ShownPoints:
    """Points of a scene's objects that mirrors show, for any sensor: true positions and images [N, 2], object of
    each.
    """

    position_m: np.ndarray
    image_m: np.ndarray
    object_index: np.ndarray
    #: Objects seen in a mirror and not directly.
    hidden: frozenset[int]

    def __len__(self) -> int:
        return len(self.position_m)


def shown_points(scene: Scene, seed: int = 0) -> ShownPoints:
    """Return the points on the sides of objects that one mirror shows within the default grid.

    By geometry alone, without power: scattering centres of the objects, thinned to `TRUTH_SPACING_M` in order; the same
    for every sensor.
    """
    grid = RangeAzimuthGrid()
    paths = trace(prepare(with_sensor(scene, "xband"), seed))
    paths = paths.take(labelled(paths) & (paths.object_index >= 0))
    direct = frozenset(paths.object_index[paths.kind == PathClass.LOS].tolist())
    range_m, azimuth_rad = polar_from_xy(paths.virtual_m[:, :2])
    inside = (range_m <= grid.range_m[-1]) & (np.abs(azimuth_rad) <= math.radians(grid.azimuth_limit_deg))
    mirrored = paths.take((paths.kind == PathClass.MIRRORED) & inside)
    kept = _apart(mirrored.point_m[:, :2], mirrored.object_index)
    return ShownPoints(
        position_m=mirrored.point_m[kept, :2],
        image_m=mirrored.virtual_m[kept, :2],
        object_index=mirrored.object_index[kept],
        hidden=frozenset(mirrored.object_index.tolist()) - direct,
    )


def incidences(scene: Scene, shown: ShownPoints) -> tuple[float, float]:
    """Return the least and largest cosine of incidence at the line of the first, straight wall, over what it shows."""
    a, b = np.array(scene.surfaces[0].polyline_m[0]), np.array(scene.surfaces[0].polyline_m[-1])
    normal, _ = wall_from_ends(a, b, np.zeros(2))
    cosine = -(shown.image_m @ normal) / np.linalg.norm(shown.image_m, axis=1)
    return float(cosine.min()), float(cosine.max())


def _apart(points_m: np.ndarray, object_index: np.ndarray) -> np.ndarray:
    """Thin points greedily: indices of points at least `TRUTH_SPACING_M` from all kept ones of their object."""
    kept: list[int] = []
    for index, point_m in enumerate(points_m):
        own = [earlier for earlier in kept if object_index[earlier] == object_index[index]]
        if not own or np.linalg.norm(points_m[own] - point_m, axis=1).min() >= TRUTH_SPACING_M:
            kept.append(index)
    return np.array(kept, np.int64)
