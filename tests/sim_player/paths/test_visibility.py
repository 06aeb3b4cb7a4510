"""Visibility in the plane against rays that are shot one by one."""

from __future__ import annotations

import numpy as np
import pytest

from sim_player.paths.visibility import PlanWalls, lit_walls, split_walls

OPAQUE, CLEAR = 0.0, 1.0


def plan(*walls: tuple[float, float, float, float]) -> PlanWalls:
    ends = np.array(walls, float)
    return split_walls(ends[:, :2], ends[:, 2:], np.arange(len(ends)))


def is_lit(walls: PlanWalls, source: tuple[float, float], **options: object) -> list[bool]:
    count = int(walls.wall.max()) + 1
    lit = lit_walls(np.array(source), walls, options.pop("passing", np.zeros(count)), **options)  # type: ignore[arg-type]
    return (lit[:, 1] >= lit[:, 0]).tolist()


def shot_rays(source: np.ndarray, a: np.ndarray, b: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the walls that each of many rays meets, nearest first, and where on them, [rays, walls]; NaN: missed."""
    angle = (np.linspace(-np.pi, np.pi, count, endpoint=False) + 1e-4)[:, None]
    ray_x, ray_y, along, offset = np.cos(angle), np.sin(angle), b - a, a - source
    turn = ray_x * along[:, 1] - ray_y * along[:, 0]
    distance = (offset[:, 0] * along[:, 1] - offset[:, 1] * along[:, 0]) / turn
    share = (offset[:, 0] * ray_y - offset[:, 1] * ray_x) / turn
    is_met = (distance > 0.0) & (share > 0.0) & (share < 1.0)
    met = np.argsort(np.where(is_met, distance, np.inf), axis=1)
    return met, np.take_along_axis(np.where(is_met, share, np.nan), met, axis=1)


@pytest.mark.parametrize("seed", range(6))
def test_whatever_a_ray_meets_is_lit_there_and_nothing_else_is_lit_by_much(seed: int) -> None:
    """40 crossing walls, 2,000 rays: each first hit lies in the lit share of its wall, and the lit shares end within a
    degree of a ray that hits there. With walls that pass half, rays end where less than 0.2 is left: the third wall.
    """
    rng = np.random.default_rng(seed)
    a = rng.uniform(-20.0, 20.0, (40, 2))
    b = a + rng.uniform(-6.0, 6.0, (40, 2))
    source, walls = rng.uniform(-5.0, 5.0, 2), split_walls(a, b, np.arange(40))
    met, share = shot_rays(source, a, b, 2000)
    for passing, depth in ((0.0, 1), (0.5, 3)):
        lit = lit_walls(source, walls, np.full(40, passing), 0.2)
        low, high = np.full(40, np.inf), np.full(40, -np.inf)
        np.fmin.at(low, met[:, :depth], share[:, :depth])
        np.fmax.at(high, met[:, :depth], share[:, :depth])
        hit = high >= low
        assert hit.any()
        assert (lit[hit, 0] <= low[hit] + 1e-9).all()
        assert (lit[hit, 1] >= high[hit] - 1e-9).all()
        # a degree seen from the source, along the wall; steeply met walls stretch it
        ends = a + np.clip(lit, 0.0, 1.0)[:, :1] * (b - a), a + np.clip(lit, 0.0, 1.0)[:, 1:] * (b - a)
        for end, outermost in zip(ends, (low, high), strict=True):
            reached = a + np.where(hit, outermost, 0.0)[:, None] * (b - a)
            first, last = (np.arctan2(*(point - source).T[::-1]) for point in (end, reached))
            assert (np.abs(np.remainder(first - last + np.pi, 2.0 * np.pi) - np.pi)[hit] < np.radians(1.0)).all()


def test_a_wall_behind_another_is_dark_and_one_that_looks_past_it_is_lit() -> None:
    walls = plan((5, -2, 5, 2), (8, -1, 8, 1), (8, -9, 8, -4))
    assert is_lit(walls, (0, 0)) == [True, False, True]


def test_a_ray_by_an_end_passes_it() -> None:
    """The wall from (10, 4) to (20, 8) is seen edge-on by the end (5, 2) of the first; the next one touches its
    shadow's border from within.
    """
    walls = plan((5, -2, 5, 2), (10, 4, 20, 8), (10, -3, 10, 4), (12, -1, 12, 1))
    assert is_lit(walls, (0, 0)) == [True, True, True, False]


def test_walls_that_stand_in_one_another_are_lit_together() -> None:
    walls = plan((5, -2, 5, 2), (5, -1, 5, 3), (6, -1, 6, 1))
    assert is_lit(walls, (0, 0)) == [True, True, False]


def test_a_window_lights_what_lies_behind_it_alone() -> None:
    """From (-4, 0) through the line x = 0, |y| <= 1: what stands before it or beside it stays dark."""
    walls = plan((-2, -1, -2, 1), (6, -1, 6, 1), (6, 5, 6, 7))
    window = np.array([0.0, -1.0]), np.array([0.0, 1.0])
    assert is_lit(walls, (-4, 0), window=window) == [False, True, False]
