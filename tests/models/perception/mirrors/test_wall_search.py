from __future__ import annotations

import math

import numpy as np
import pytest

from models.perception.mirrors.lines import fit_line
from models.perception.mirrors.wall_search import FINALISTS, Limits, best_segment, left_over, next_on_line, supported
from tests.models.perception.mirrors.test_lines import line_gain

LIMITS = Limits(4, 6.5, 2.5, math.radians(6.0), 0.5, 9.0)


def scene(seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Two walls, of which one has a gap, among scattered points."""
    rng = np.random.default_rng(seed)
    across = np.stack([np.full(8, 20.0), np.array([-9.0, -8.0, -6.5, -5.0, 4.0, 5.0, 6.0, 7.5])], axis=1)
    beside = np.stack([np.linspace(4.0, 12.0, 7), np.full(7, 6.0)], axis=1)
    points = np.concatenate([across, beside, rng.uniform([2.0, -15.0], [30.0, 15.0], (12, 2))])
    return points + rng.normal(0.0, 0.05, points.shape), np.tile(0.1**2 * np.eye(2), (len(points), 1, 1))


def by_arrays(points: np.ndarray, covariance: np.ndarray, first: np.ndarray, second: np.ndarray) -> list[float]:
    """Scores of all segments that act as mirrors on the finalists of a search, each found by whole arrays."""
    along = points[second] - points[first]
    normals = np.stack([-along[:, 1], along[:, 0]], axis=1) / np.linalg.norm(along, axis=1, keepdims=True)
    gain = line_gain(points, covariance, normals, -np.sum(normals * points[first], axis=1))
    finalists: dict[bytes, np.ndarray] = {}
    for row in gain[np.argsort(-gain.sum(axis=1), kind="stable")]:
        if len(finalists) < FINALISTS:
            finalists.setdefault((row > 0.0).tobytes(), np.flatnonzero(row > 0.0))
    scores = []
    for inliers in finalists.values():
        for _ in range(2):
            if len(inliers) < LIMITS.min_inliers:
                break
            normal, offset_m, _, _ = fit_line(points[inliers], covariance[inliers])
            inliers = np.flatnonzero(line_gain(points, covariance, normal[None], np.array([offset_m]))[0] > 0.0)
        reach = points[inliers] @ [-normal[1], normal[0]]
        order = np.argsort(reach, kind="stable")
        for run in np.split(inliers[order], np.flatnonzero(np.diff(reach[order]) > LIMITS.max_gap_m) + 1):
            scores += [score_of(points[np.sort(run)], covariance[np.sort(run)])] if len(run) >= 4 else []
    return [score for score in scores if score >= LIMITS.min_score]


def score_of(points: np.ndarray, covariance: np.ndarray) -> float:
    """Score of the line through points, of nothing unless it acts as a mirror."""
    normal, offset_m, angle_std_rad, _ = fit_line(points, covariance)
    gain = line_gain(points, covariance, normal[None], np.array([offset_m]))[0]
    long = np.ptp(points @ [-normal[1], normal[0]]) >= LIMITS.min_length_m
    sure = angle_std_rad <= LIMITS.max_angle_std_rad and offset_m >= LIMITS.min_offset_m
    return float(gain.sum()) if np.count_nonzero(gain) >= LIMITS.min_inliers and long and sure else -math.inf


@pytest.mark.parametrize("seed", range(12))
def test_search_finds_the_best_segment_of_its_finalists(seed: int) -> None:
    points, covariance = scene(seed)
    first, second = np.triu_indices(len(points), k=1)
    selected = np.sort(np.random.default_rng(seed).choice(len(first), 120, replace=False))
    segment, run = best_segment(points, covariance, selected, LIMITS)
    scores = by_arrays(points, covariance, first[selected], second[selected])
    assert segment.is_mirror == bool(scores)
    assert segment.score == pytest.approx(max(scores), rel=1e-9)
    assert segment == supported(points[run], covariance[run], LIMITS)


def test_walls_are_found_one_after_the_other() -> None:
    """All pairs: first the seven points side by side, then four of the wall that a gap of 9 m cuts; no more walls."""
    points, covariance = scene(3)
    left, runs = np.arange(15), []
    while len(left) >= 2:
        segment, run = best_segment(points[left], covariance[left], np.arange(len(left) * (len(left) - 1) // 2), LIMITS)
        if not segment.is_mirror:
            break
        runs.append(sorted(left[run].tolist()))
        left = left[left_over(points[left], covariance[left], segment, run)]
    assert sorted(runs) == [[0, 1, 2, 3], [4, 5, 6, 7], list(range(8, 15))]


def test_nothing_is_found_where_nothing_can_be() -> None:
    points, covariance = np.ones((6, 2)), np.tile(0.01 * np.eye(2), (6, 1, 1))
    segment, run = best_segment(points, covariance, np.arange(15), LIMITS)  # all points coincide: no hypothesis
    assert (segment.is_mirror, len(run)) == (False, 0)


@pytest.mark.parametrize(
    ("name", "value"),
    [("min_length_m", 9.0), ("min_inliers", 8), ("max_angle_std_rad", 1e-6), ("min_offset_m", 7.0), ("min_score", 1e3)],
)
def test_each_limit_denies_a_mirror(name: str, value: float) -> None:
    points, covariance = scene(0)
    points, covariance = points[8:15], covariance[8:15]
    assert supported(points, covariance, LIMITS).is_mirror
    assert not supported(points, covariance, LIMITS._replace(**{name: value})).is_mirror


def test_next_on_line_is_the_nearest_that_lies_on_it() -> None:
    points, covariance = scene(0)
    wall = supported(points[8:15], covariance[8:15], LIMITS)
    near, far, beside, beyond = (15.0, 6.0), (17.0, 6.1), (14.0, 8.0), (25.0, 6.0)
    errors = np.tile(0.1**2 * np.eye(2), (4, 1, 1))
    assert next_on_line(np.array([far, beside, near, beyond]), errors, wall, LIMITS) == 2
    assert next_on_line(np.array([far, beside, beyond, beyond]), errors, wall, LIMITS) == 0
    assert next_on_line(np.array([beside, beside, beyond, beyond]), errors, wall, LIMITS) == -1
