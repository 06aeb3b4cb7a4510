"""Random street scenes from a seed: relay walls, corners, hidden and open road users, empty places.

Roughness is drawn where the choice of wavelength matters (0.1-2 mm rms), thickness by material. An object meant to
hide is placed where its centre is out of sight and seen in a wall; the final visibility is traced, not assumed.
"""

from __future__ import annotations

import math

import numpy as np

from models.physics.mirror import blocked, reflect, specular_points, wall_from_ends
from sim_player.scene.description import Point, Scene, SceneObject, Surface, check_scene, wall_inside

#: Thickness in mm that walls of a material are drawn from.
THICKNESS_MM: dict[str, tuple[float, float]] = {
    "concrete": (150.0, 400.0),
    "brick": (115.0, 365.0),
    "glass": (4.0, 12.0),
    "metal": (1.0, 3.0),
    "wood": (18.0, 60.0),
}
ROUGHNESS_MM = (0.1, 2.0)
#: Share of scenes without a hidden object by design (in about as many more, none can be hidden).
EMPTY_SHARE = 0.15
#: Required range and azimuth of images of hidden objects.
IMAGE_RANGE_M, IMAGE_AZIMUTH_RAD = (5.0, 60.0), math.radians(55.0)
#: Largest number of candidate positions drawn for one object.
CANDIDATES = 256
#: Probability of each class: cars are most common, as on real streets.
CLASS_SHARE: dict[str, float] = {
    "car": 0.35,
    "van": 0.15,
    "truck": 0.12,
    "bus": 0.08,
    "bicycle": 0.14,
    "pedestrian": 0.16,
}
ORIGIN = np.zeros(2)


def random_street(seed: int, index: int = 0) -> Scene:
    """Return the scene number `index` of the series `seed`: any of four layouts, either side; always passes
    `check_scene`.
    """
    rng = np.random.default_rng([seed, index])
    layout = (_across, _oblique, _parallel, _bend)[rng.integers(4)]
    surfaces = _flipped(layout(rng), flip=bool(rng.random() < 0.5))
    hidden_count = 0 if rng.random() < EMPTY_SHARE else int(rng.integers(1, 4))
    objects: tuple[SceneObject, ...] = ()
    for hidden in [True] * hidden_count + [False] * int(rng.integers(0, 4)):
        road_user = _place(rng, surfaces, objects, hidden)
        objects += () if road_user is None else (road_user,)
    scene = Scene(name=f"street_{seed}_{index}", surfaces=surfaces, objects=objects)
    check_scene(scene)
    return scene


def _wall(rng: np.random.Generator, role: str, polyline: list[Point]) -> Surface:
    """Return a wall of random material along a polyline."""
    material = str(rng.choice(list(THICKNESS_MM)))
    roughness_mm = math.exp(rng.uniform(math.log(ROUGHNESS_MM[0]), math.log(ROUGHNESS_MM[1])))
    return Surface(
        role="relay" if role == "relay" else "occluder",
        material=material,
        polyline_m=tuple(polyline),
        height_m=float(rng.uniform(2.5, 10.0)),
        thickness_mm=float(rng.uniform(*THICKNESS_MM[material])),
        roughness_mm=float(roughness_mm),
    )


def _corner(rng: np.random.Generator, wall_x_m: float) -> Surface:
    """Return a building on the left whose corner hides the side street."""
    x, y = rng.uniform(0.25, 0.5) * wall_x_m, rng.uniform(2.5, 5.5)
    return _wall(rng, "occluder", [(0.5, y), (x, y), (x, y + rng.uniform(12.0, 25.0))])


def _across(rng: np.random.Generator) -> tuple[Surface, ...]:
    """Return the T-junction: a facade across the end of the street."""
    x, lean = rng.uniform(12.0, 35.0), math.tan(rng.uniform(-0.12, 0.12))
    low, high = -rng.uniform(4.0, 15.0), rng.uniform(6.0, 22.0)
    relay = _wall(rng, "relay", [(x + lean * low, low), (x + lean * high, high)])
    return relay, _corner(rng, x)


def _oblique(rng: np.random.Generator) -> tuple[Surface, ...]:
    """Return a free-standing wall turned towards the hidden side."""
    distance, bearing = rng.uniform(10.0, 28.0), rng.uniform(-0.35, 0.25)
    turn, half = rng.uniform(-0.65, -0.15), 0.5 * rng.uniform(8.0, 20.0)
    middle = distance * np.array([math.cos(bearing), math.sin(bearing)])
    along = np.array([-math.sin(turn), math.cos(turn)])
    a, b = middle - half * along, middle + half * along
    relay = _wall(rng, "relay", [(float(a[0]), float(a[1])), (float(b[0]), float(b[1]))])
    return relay, _corner(rng, distance)


def _parallel(rng: np.random.Generator) -> tuple[Surface, ...]:
    """Return a street wall along the right side, and something big ahead."""
    y, lean = -rng.uniform(3.0, 9.0), math.tan(rng.uniform(-0.08, 0.08))
    start, end = rng.uniform(3.0, 8.0), rng.uniform(25.0, 60.0)
    relay = _wall(rng, "relay", [(start, y + lean * start), (end, y + lean * end)])
    x, low = rng.uniform(6.0, 14.0), rng.uniform(0.5, 0.9) * -1.2
    screen = _wall(rng, "occluder", [(x, low), (x, low + rng.uniform(3.0, 8.0))])
    return relay, screen


def _bend(rng: np.random.Generator) -> tuple[Surface, ...]:
    """Return a bend to the left: the far wall turns with the street."""
    x, y = rng.uniform(10.0, 24.0), -rng.uniform(4.0, 10.0)
    turn, length = rng.uniform(0.7, 1.3), rng.uniform(10.0, 24.0)
    far = (x + length * math.cos(turn), y + length * math.sin(turn))
    side = _wall(rng, "relay", [(rng.uniform(2.0, 5.0), y), (x, y)])
    return side, _wall(rng, "relay", [(x, y), far]), _corner(rng, x)


def _flipped(surfaces: tuple[Surface, ...], flip: bool) -> tuple[Surface, ...]:
    """Return the same street with plain floats, left and right exchanged if `flip`."""
    sign = -1.0 if flip else 1.0
    return tuple(
        Surface(
            role=surface.role,
            material=surface.material,
            polyline_m=tuple((float(x), sign * float(y)) for x, y in surface.polyline_m),
            height_m=surface.height_m,
            thickness_mm=surface.thickness_mm,
            roughness_mm=surface.roughness_mm,
            # the first series keeps the signals that it was drawn with
            diffuse_lobe="lambert",
        )
        for surface in surfaces
    )


def _place(
    rng: np.random.Generator, surfaces: tuple[Surface, ...], objects: tuple[SceneObject, ...], hidden: bool
) -> SceneObject | None:
    """Return a random road user at the first candidate position that fits; None where none does."""
    name = str(rng.choice(list(CLASS_SHARE), p=list(CLASS_SHARE.values())))
    spot = np.column_stack([rng.uniform(4.0, 50.0, CANDIDATES), rng.uniform(-35.0, 35.0, CANDIDATES)])
    yaw_deg = rng.choice([0.0, 90.0, 180.0, 270.0], CANDIDATES) + rng.normal(0.0, 12.0, CANDIDATES)
    fits = _in_mirror(spot, surfaces) if hidden else _in_open(spot, surfaces)
    for index in np.flatnonzero(fits):
        road_user = SceneObject(
            class_=name,  # type: ignore[arg-type]
            x_m=float(spot[index, 0]),
            y_m=float(spot[index, 1]),
            yaw_deg=float(yaw_deg[index]),
        )
        if _stands_well(road_user, surfaces, objects, hidden):
            return road_user
    return None


def _stands_well(
    road_user: SceneObject, surfaces: tuple[Surface, ...], objects: tuple[SceneObject, ...], hidden: bool
) -> bool:
    """Return whether a road user is clear of radar, walls and others and, if hidden, out of sight as a whole."""
    return (
        math.hypot(road_user.x_m, road_user.y_m) > road_user.kind.length_m
        and all(_apart(road_user, other) for other in objects)
        and wall_inside(road_user, surfaces) is None
        and (not hidden or bool(blocked(ORIGIN, road_user.corners_m(), *_pieces(surfaces)).all()))
    )


def _pieces(surfaces: tuple[Surface, ...]) -> tuple[np.ndarray, np.ndarray]:
    """Return the ends of all straight pieces of wall, [W, 2] each."""
    return (
        np.array([point for surface in surfaces for point in surface.polyline_m[:-1]]),
        np.array([point for surface in surfaces for point in surface.polyline_m[1:]]),
    )


def _in_open(spot: np.ndarray, surfaces: tuple[Surface, ...]) -> np.ndarray:
    """Return whether spots are in direct sight within the radar's field of view."""
    ahead = np.abs(np.arctan2(spot[:, 1], spot[:, 0])) < IMAGE_AZIMUTH_RAD
    return ahead & (np.hypot(*spot.T) > IMAGE_RANGE_M[0]) & ~blocked(ORIGIN, spot, *_pieces(surfaces))


def _in_mirror(spot: np.ndarray, surfaces: tuple[Surface, ...]) -> np.ndarray:
    """Return whether spots are out of direct sight and shown by a wall at a range and azimuth that the radar covers."""
    a, b = _pieces(surfaces)
    shown = np.zeros(len(spot), bool)
    for start, end in zip(a, b, strict=True):
        specular = specular_points(ORIGIN, spot, start, end)
        image = reflect(spot, *wall_from_ends(start, end, ORIGIN))
        distance = np.hypot(*image.T)
        good = ~np.isnan(specular[:, 0]) & (np.abs(np.arctan2(image[:, 1], image[:, 0])) < IMAGE_AZIMUTH_RAD)
        good &= (distance > IMAGE_RANGE_M[0]) & (distance < IMAGE_RANGE_M[1])
        good[good] = ~blocked(ORIGIN, specular[good], a, b)
        good[good] = ~blocked(specular[good], spot[good], a, b)
        shown |= good
    return shown & blocked(ORIGIN, spot, a, b)


def _apart(first: SceneObject, second: SceneObject) -> bool:
    """Return whether the circles around two objects stay apart."""
    reach = 0.5 * sum(math.hypot(road_user.kind.length_m, road_user.kind.width_m) for road_user in (first, second))
    return math.hypot(first.x_m - second.x_m, first.y_m - second.y_m) > reach
