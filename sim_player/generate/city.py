"""Made cities: buildings on a grid of streets around the radar, as many pieces of wall as asked for.

The places of buildings and what they are made of depend on the seed and on their square of the grid alone: a larger
city holds the smaller ones unchanged, in its middle.
"""

from __future__ import annotations

import math

import numpy as np

from sim_player.scene.description import Scene, SceneObject, SceneRadar, Surface

#: Side of a building with the street beside it, and the buildings' own sides.
SQUARE_M = 24.0
SIDE_M = (9.0, 14.0)
#: A building's centre is moved by so much at most, which closes streets after a few squares.
SHIFT_M = 3.0
WALLS_OF_A_BUILDING = 4
MATERIALS = (("concrete", None, 0.3), ("brick", None, 1.0), ("brick", 240.0, 1.0), ("double_glazing", None, 0.0))
HEIGHT_M = (4.0, 18.0)
#: Road users stand within this distance of the radar.
TRAFFIC_M = 60.0
CLASSES = ("car", "car", "van", "bicycle", "pedestrian")


def made_city(walls: int, objects: int = 12, seed: int = 0, preset: str = "xband") -> Scene:
    """Return a city of `walls` pieces of wall, a multiple of four, with road users in the streets around the radar.

    The radar stands at a crossing and looks along a street. Raises ValueError for other numbers.
    """
    if walls < 0 or walls % WALLS_OF_A_BUILDING:
        raise ValueError(f"walls must be a multiple of {WALLS_OF_A_BUILDING} and not negative, got {walls!r}")
    return Scene(
        name=f"made city of {walls} walls, seed {seed}",
        radar=SceneRadar(preset=preset),  # type: ignore[arg-type]
        surfaces=tuple(_building(*square, seed) for square in _squares(walls // WALLS_OF_A_BUILDING)),
        objects=tuple(_traffic(objects, seed)),
    )


def _squares(count: int) -> list[tuple[int, int]]:
    """Return the squares of the grid nearest to the radar, which stands at their common corner."""
    half = math.ceil(math.sqrt(count) / 2.0) + 2
    grid = [(i, j) for i in range(-half, half) for j in range(-half, half)]
    return sorted(grid, key=lambda square: (max(abs(square[0] + 0.5), abs(square[1] + 0.5)), square))[:count]


def _building(i: int, j: int, seed: int) -> Surface:
    rng = np.random.default_rng([seed, i + 10_000, j + 10_000])
    # blocks around the first crossing keep clear of it
    near = max(abs(i + 0.5), abs(j + 0.5)) < 1.0
    shift = rng.uniform(-SHIFT_M, SHIFT_M, 2) * (0.0 if near else 1.0)
    x, y = SQUARE_M * (i + 0.5) + shift[0], SQUARE_M * (j + 0.5) + shift[1]
    half_x, half_y = 0.5 * rng.uniform(*SIDE_M, 2)
    turn = rng.normal(0.0, 0.03)
    c, s = math.cos(turn), math.sin(turn)
    corners = [(half_x, half_y), (-half_x, half_y), (-half_x, -half_y), (half_x, -half_y), (half_x, half_y)]
    material, thickness_mm, roughness_mm = MATERIALS[rng.integers(len(MATERIALS))]
    return Surface(
        role="relay",
        material=material,
        polyline_m=tuple((round(float(x + c * u - s * v), 3), round(float(y + s * u + c * v), 3)) for u, v in corners),
        height_m=round(float(rng.uniform(*HEIGHT_M)), 1),
        thickness_mm=thickness_mm,
        roughness_mm=roughness_mm,
    )


def _traffic(count: int, seed: int) -> list[SceneObject]:
    """Return road users on both sides of the streets' middles, which no building reaches."""
    rng, placed = np.random.default_rng([seed, 1]), []
    for index in range(count):
        along, street = rng.uniform(8.0, TRAFFIC_M) * rng.choice([-1.0, 1.0]), SQUARE_M * rng.integers(-1, 2)
        across = street + rng.uniform(1.2, 1.8) * rng.choice([-1.0, 1.0]) * (1.0 if street == 0.0 else 0.0)
        is_x = bool(rng.integers(2))
        placed.append(
            SceneObject(
                class_=CLASSES[index % len(CLASSES)],  # type: ignore[arg-type]
                x_m=round(float(along if is_x else across), 2),
                y_m=round(float(across if is_x else along), 2),
                yaw_deg=0.0 if is_x else 90.0,
            )
        )
    return placed
