"""Walls drawn in one place count once: the last one drawn stands there."""

from __future__ import annotations

import logging

import numpy as np
import pytest

from sim_player.scene.description import Scene, Surface
from sim_player.scene.world import World, prepare

Point = tuple[float, float]
METAL, DOOR = "metal", "wood"


def drawn(a: Point, b: Point, material: str = METAL, height_m: float = 8.0, **more: float) -> Surface:
    thickness = {} if material == METAL else {"thickness_mm": 40.0}
    return Surface(role="relay", material=material, polyline_m=(a, b), height_m=height_m, **thickness, **more)


def along(first: float, last: float, *build: str | float, x_m: float = 10.0, **more: float) -> Surface:
    """A wall along x = 10 m."""
    return drawn((x_m, first), (x_m, last), *build, **more)  # type: ignore[arg-type]


def standing(world: World) -> list[tuple[int, float, float, float]]:
    """Surface, low and high y and height of all pieces, in order of place."""
    low, high = np.sort(np.column_stack([world.wall_a[:, 1], world.wall_b[:, 1]]), axis=1).T
    rows = zip(world.wall_surface.tolist(), low.tolist(), high.tolist(), world.wall_height_m.tolist(), strict=True)
    return sorted(((s, round(a, 6), round(b, 6), h) for s, a, b, h in rows), key=lambda row: row[1])


WALL, HEDGE = along(-5.0, 5.0), along(-5.0, 5.0, "vegetation")
WHOLE = [(0, -5.0, 5.0, 8.0), (1, -5.0, 5.0, 8.0)]
#: What is drawn beside `WALL`, and what stands then.
CASES: dict[str, tuple[list[Surface], list[tuple[int, float, float, float]]]] = {
    "twice": ([WALL, WALL], WHOLE[1:]),
    "three times": ([WALL, WALL, WALL], [(2, -5.0, 5.0, 8.0)]),
    "reversed": ([WALL, along(5.0, -5.0)], WHOLE[1:]),
    "a door": ([WALL, along(-1.0, 3.0, DOOR)], [(0, -5.0, -1.0, 8.0), (1, -1.0, 3.0, 8.0), (0, 3.0, 5.0, 8.0)]),
    "a door drawn first": ([along(-1.0, 3.0, DOOR), WALL], WHOLE[1:]),
    "beyond its end": ([WALL, along(2.0, 9.0, DOOR)], [(0, -5.0, 2.0, 8.0), (1, 2.0, 9.0, 8.0)]),
    "a low door": (
        [WALL, along(-1.0, 3.0, DOOR, 2.1)],
        [(0, -5.0, -1.0, 8.0), (1, -1.0, 3.0, 8.0), (0, 3.0, 5.0, 8.0)],
    ),
    "a kerb": ([WALL, along(-1.0, 3.0, DOOR, 0.2)], WHOLE[:1]),
    "a tall door on a low wall": (
        [along(-5.0, 5.0, METAL, 2.0), along(-1.0, 9.0, DOOR)],
        [(0, -5.0, -1.0, 2.0), (1, -1.0, 9.0, 8.0)],
    ),
    "a low wall over a tall one": (
        [along(-1.0, 2.0), along(-5.0, 5.0, DOOR, 2.0)],
        [(1, -5.0, -1.0, 2.0), (1, -1.0, 2.0, 8.0), (1, 2.0, 5.0, 2.0)],
    ),
    "half a millimetre off": ([WALL, along(-5.0, 5.0, x_m=10.0005)], WHOLE[1:]),
    "two faces of a thick wall": ([WALL, along(-5.0, 5.0, x_m=10.1)], WHOLE),
    "end to end": ([WALL, along(5.0, 9.0)], [(0, -5.0, 5.0, 8.0), (1, 5.0, 9.0, 8.0)]),
    "an arc twice": ([along(*ends, curvature_per_m=0.01 * ends[1]) for ends in ((-5.0, 5.0), (5.0, -5.0))], WHOLE[1:]),
    "two arcs that bend apart": ([along(-5.0, 5.0, curvature_per_m=bend) for bend in (0.05, -0.05)], WHOLE),
    "a hedge before it": ([WALL, HEDGE], WHOLE),
    "a hedge twice": ([HEDGE, HEDGE], WHOLE[1:]),
}

#: Of which nothing is left out.
APART = {"two faces of a thick wall", "end to end", "two arcs that bend apart", "a hedge before it"}


@pytest.mark.parametrize("name", CASES)
def test_the_last_one_drawn_stands(name: str, caplog: pytest.LogCaptureFixture) -> None:
    """Which surface stands from where to where along x = 10, and how high; said in one line a pair where one goes."""
    surfaces, expected = CASES[name]
    with caplog.at_level(logging.WARNING):
        world = prepare(Scene(name=name, surfaces=tuple(surfaces)))
    assert standing(world) == expected
    assert bool(world.left_out) == bool(caplog.records) == (name not in APART)
    for line in world.left_out:
        assert line.startswith("surfaces[")


def test_a_quarter_of_an_arc_is_cut_out_of_it() -> None:
    """An arc of 10 m radius, and another one on the same circle from 20 to 50 deg of its 0 to 60 deg."""

    def on_circle(*turns_deg: float) -> Surface:
        a, b = ((10.0 + 10.0 * np.cos(np.radians(turn)), 10.0 * np.sin(np.radians(turn))) for turn in turns_deg)
        return drawn((float(a[0]), float(a[1])), (float(b[0]), float(b[1])), curvature_per_m=0.1)

    world = prepare(Scene(name="arcs", surfaces=(on_circle(0.0, 60.0), on_circle(20.0, 50.0))))
    turns = np.degrees([np.arctan2(end[:, 1], end[:, 0] - 10.0) for end in (world.wall_a, world.wall_b)]).T
    np.testing.assert_allclose(turns, [[0.0, 20.0], [50.0, 60.0], [20.0, 50.0]], atol=1e-6)
    assert world.wall_surface.tolist() == [0, 0, 1]
    np.testing.assert_allclose(world.wall_curvature_per_m, 0.1)
