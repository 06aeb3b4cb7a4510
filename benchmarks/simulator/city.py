"""Made cities: buildings on a grid of streets around the radar, as many pieces of wall as asked for.

The places of buildings and what they are made of depend on the seed and on their square of the grid alone: a larger
city holds the smaller ones unchanged, in its middle.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Literal

import numpy as np

from sim_player.scene.description import Scene, SceneObject, Surface, overlap

#: Detached houses: side of a house's square with the street beside it, its own sides, how far it may stand off the
#: middle, which closes streets after a few squares.
SQUARE_M = 24.0
SIDE_M = (9.0, 14.0)
SHIFT_M = 3.0
#: Terraced houses: width and depth of one, how many of them a block has along each side, width of streets, and how
#: far a front may stand back.
HOUSE_M = 12.0
HOUSES = (5, 2)
STREET_M = 12.0
SET_BACK_M = 0.4
WALLS_OF_A_BUILDING = 4
MATERIALS = (("concrete", None, 0.3), ("brick", None, 1.0), ("brick", 240.0, 1.0), ("double_glazing", None, 0.0))
HEIGHT_M = (4.0, 18.0)
#: Road users stand within this distance of the radar.
TRAFFIC_M = 60.0
CLASSES = ("car", "car", "van", "bicycle", "pedestrian")

CityKind = Literal["terraced", "detached"]
_Corners = Callable[[tuple[int, int], np.random.Generator], np.ndarray]
_BOX = np.array([(1.0, 1.0), (-1.0, 1.0), (-1.0, -1.0), (1.0, -1.0)])


def made_city(walls: int, kind: CityKind = "terraced", objects: int = 12, seed: int = 0) -> Scene:
    """Return a city of `walls` pieces of wall, a multiple of four, with road users in the streets around the radar.

    The radar stands at a crossing and looks along a street. Raises ValueError for other numbers.
    """
    if walls < 0 or walls % WALLS_OF_A_BUILDING:
        raise ValueError(f"walls must be a multiple of {WALLS_OF_A_BUILDING} and not negative, got {walls!r}")
    corners = _detached if kind == "detached" else _terraced
    return Scene(
        name=f"made city, {walls} walls of {kind} houses, seed {seed}",
        surfaces=tuple(_building(corners, square, seed) for square in _squares(walls // WALLS_OF_A_BUILDING)),
        objects=tuple(_traffic(objects, SQUARE_M if kind == "detached" else 0.0, seed)),
    )


def _squares(count: int) -> list[tuple[int, int]]:
    """Return the squares of the grid nearest to the radar, which stands at their common corner."""
    half = math.ceil(math.sqrt(count) / 2.0) + 2
    grid = [(i, j) for i in range(-half, half) for j in range(-half, half)]
    return sorted(grid, key=lambda square: (max(abs(square[0] + 0.5), abs(square[1] + 0.5)), square))[:count]


def _building(corners: _Corners, square: tuple[int, int], seed: int) -> Surface:
    """Return the house of a square of the grid, fixed by the seed and the square."""
    rng = np.random.default_rng([seed, square[0] + 10_000, square[1] + 10_000])
    plan = corners(square, rng)
    material, thickness_mm, roughness_mm = MATERIALS[rng.integers(len(MATERIALS))]
    return Surface(
        role="relay",
        material=material,
        polyline_m=tuple((round(float(x), 3), round(float(y), 3)) for x, y in [*plan, plan[0]]),
        height_m=round(float(rng.uniform(*HEIGHT_M)), 1),
        thickness_mm=thickness_mm,
        roughness_mm=roughness_mm,
    )


def _detached(square: tuple[int, int], rng: np.random.Generator) -> np.ndarray:
    """Return the corners [4, 2] of a house that stands alone."""
    middle = np.array(square) + 0.5
    # houses around the first crossing keep clear of it
    shift = rng.uniform(-SHIFT_M, SHIFT_M, 2) * (np.abs(middle).max() > 1.0)
    half, turn = 0.5 * rng.uniform(*SIDE_M, 2), rng.normal(0.0, 0.03)
    rotation = np.array([[math.cos(turn), math.sin(turn)], [-math.sin(turn), math.cos(turn)]])
    return np.asarray(SQUARE_M * middle + shift + (_BOX * half) @ rotation)


def _terraced(square: tuple[int, int], rng: np.random.Generator) -> np.ndarray:
    """Return the corners [4, 2] of a house in a block: it shares walls with its neighbours, its fronts stand back."""
    block, house = np.divmod(square, HOUSES)
    low = HOUSE_M * np.array(square) + STREET_M * (block + 0.5)
    high = low + HOUSE_M
    back_m = rng.uniform(0.0, SET_BACK_M, (2, 2))
    low = low + np.where(house == 0, back_m[0], 0.0)
    high = high - np.where(house == np.array(HOUSES) - 1, back_m[1], 0.0)
    return np.asarray(np.where(_BOX > 0.0, high, low))


def _traffic(count: int, apart_m: float, seed: int) -> list[SceneObject]:
    """Return road users beside the middles of the crossing streets, and of the next ones, which are so far apart."""
    rng = np.random.default_rng([seed, 1])
    users: list[SceneObject] = []
    while len(users) < count:
        along, street = rng.uniform(8.0, TRAFFIC_M) * rng.choice([-1.0, 1.0]), apart_m * rng.integers(-1, 2)
        across = street + rng.uniform(1.2, 1.8) * rng.choice([-1.0, 1.0]) * (1.0 if street == 0.0 else 0.0)
        is_x = bool(rng.integers(2))
        user = SceneObject(
            class_=CLASSES[len(users) % len(CLASSES)],  # type: ignore[arg-type]
            x_m=round(float(along if is_x else across), 2),
            y_m=round(float(across if is_x else along), 2),
            yaw_deg=0.0 if is_x else 90.0,
        )
        if not any(overlap(user, other) for other in users):
            users.append(user)
    return users
