"""Hard places for the part of a large scene that is traced: what it leaves out must be nothing.

Each has more walls than are traced whole here; its paths are held against those of the whole scene.
"""

from __future__ import annotations

import math

import numpy as np
import pytest

from msgs.values.frames import Pose2
from sim_player.effects.table import ALL_EFFECTS
from sim_player.paths import reach
from sim_player.paths.ray_tracing import trace_echoes
from sim_player.paths.reach import reachable_snapshot
from sim_player.planner.plan import clean_profiles, plan_world
from sim_player.planner.purposes import Purpose
from sim_player.scene.description import Scene, SceneObject, Surface
from sim_player.scene.world import RadarState, World, prepare
from tests.sim_player.scene.same_paths import assert_same_paths, of_part, of_whole

COUNT = 24
CAR = SceneObject(class_="car", x_m=5.0, y_m=3.0)
AT_ORIGIN = RadarState(Pose2(0.0, 0.0, 0.0), np.array([3.0, 0.0]))


@pytest.fixture(autouse=True)
def _in_part(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(reach, "WHOLE_WALLS", 0)


def wall(start: tuple[float, float], end: tuple[float, float], **more: object) -> Surface:
    settings = {"material": "concrete", "height_m": 6.0, "roughness_mm": 0.5, **more}
    return Surface(role="relay", polyline_m=(start, end), **settings)  # type: ignore[arg-type]


def spot(count: int) -> list[Surface]:
    """Short walls that cross each other in a square of 3 m."""
    rng = np.random.default_rng(0)
    middle, half = np.array([25.0, 4.0]) + rng.uniform(-1.5, 1.5, (count, 2)), rng.normal(0.0, 0.15, (count, 2))
    ends = np.concatenate([middle - half, middle + half], axis=1).tolist()
    return [wall((ax, ay), (bx, by)) for ax, ay, bx, by in ends]


def fan() -> list[Surface]:
    """Walls that point at the radar: seen edge-on, all of them."""
    turns = np.linspace(-math.pi, math.pi, COUNT, endpoint=False).tolist()
    return [wall((10.0 * math.cos(a), 10.0 * math.sin(a)), (20.0 * math.cos(a), 20.0 * math.sin(a))) for a in turns]


MIRROR = wall((5.0, 9.0), (40.0, 9.0))
CASES = {
    "100 walls in one spot": spot(100),
    "walls that point at the radar": [*fan(), MIRROR],
    "the same wall over and over": [*[wall((20.0, -4.0), (20.0, 4.0)) for _ in range(COUNT)], MIRROR],
    "walls one behind the other": [
        *[wall((20.0 + 0.01 * n, -4.0 - 0.002 * n), (20.0 + 0.01 * n, 4.0 + 0.002 * n)) for n in range(COUNT)],
        MIRROR,
    ],
    "panes one behind the other": [
        *[wall((20.0 + n, -4.0), (20.0 + n, 4.0), material="glass", thickness_mm=6.0) for n in range(COUNT)],
        MIRROR,
    ],
    "walls of a millimetre": [
        *[wall((20.0, -6.0 + 0.1 * n), (20.0, -6.0 + 0.1 * n + 1e-3)) for n in range(COUNT)],
        MIRROR,
    ],
    "walls in one line": [*[wall((20.0, -9.0 + 0.25 * n), (20.0, -8.75 + 0.25 * n)) for n in range(COUNT)], MIRROR],
    "a star of walls": [
        *[wall((20.0, 4.0), (20.0 + 2.0 * math.cos(n), 4.0 + 2.0 * math.sin(n))) for n in range(COUNT)],
        MIRROR,
    ],
    "arcs in one another": [
        *[wall((20.0 + 0.1 * n, -4.0), (20.0 + 0.1 * n, 4.0), curvature_per_m=0.05) for n in range(COUNT)],
        MIRROR,
    ],
}
#: The radar in the middle of the mirror's line, at its end, beside it, on a wall of the fan.
PLACES = {"ahead": AT_ORIGIN} | {
    name: RadarState(Pose2(x_m, y_m, yaw_rad), np.zeros(2))
    for name, (x_m, y_m, yaw_rad) in {
        "on a wall": (22.0, 9.0, -1.0),
        "on a wall's end": (5.0, 9.0, 0.0),
        "along a wall": (-3.0, 9.0, 0.0),
        "a hair off a wall": (22.0, 9.0 - 1e-7, 2.0),
    }.items()
}


def world_of(walls: list[Surface]) -> World:
    return prepare(Scene(name="hard", surfaces=tuple(walls), objects=(CAR,)))


@pytest.mark.slow
@pytest.mark.parametrize("name", CASES)
def test_the_part_has_all_paths(name: str) -> None:
    world = world_of(CASES[name])
    assert_same_paths(of_part(world, 0.0, AT_ORIGIN), of_whole(world, 0.0, AT_ORIGIN))


@pytest.mark.slow
@pytest.mark.parametrize("place", PLACES)
def test_the_part_has_all_paths_from_anywhere(place: str) -> None:
    """A radar that stands on a wall sees along it, and nothing is left out on either side."""
    world = world_of(CASES["walls in one line"])
    assert_same_paths(of_part(world, 0.0, PLACES[place]), of_whole(world, 0.0, PLACES[place]))


def test_nothing_ahead_is_nothing() -> None:
    """All walls and the car behind the antenna: no wall, no path, no warning, and a plan of nothing."""
    walls = [wall((-20.0 - n, -4.0), (-20.0 - n, 4.0)) for n in range(COUNT)]
    world = prepare(Scene(name="hard", surfaces=tuple(walls), objects=(SceneObject(class_="car", x_m=-9.0, y_m=0.0),)))
    view = reachable_snapshot(world, ahead_only=True)
    assert len(view.world.wall_a) == 0
    assert len(trace_echoes(view, ALL_EFFECTS)) == 0
    plan = plan_world(world, world.setup, purpose=Purpose.PEAKS)
    assert np.abs(clean_profiles(plan, world.setup)).max() == 0.0


@pytest.mark.slow
def test_two_thousand_walls_in_one_spot() -> None:
    """They cross each other many times over: some hundred are seen or mirror bends, and paths stay finite."""
    view = reachable_snapshot(world_of(spot(2_000)), ahead_only=True)
    assert 50 < len(view.world.wall_a) < 500
    echoes = trace_echoes(view, ALL_EFFECTS)
    assert len(echoes) > 100
    assert np.isfinite(echoes.weight).all()
