"""Walls from direct returns: line RANSAC in each cluster, refit by weighted total least squares, cut at gaps.

`polar`: each point brings its covariance. `euclidean`, the published form: within `inlier_m` all count alike. A line's
score is sum of log(p(residual | wall) / p(scattered)): points of wide errors score little, so that clutter along the
line of sight does not become a wall.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Literal

import msgspec
import numpy as np

from models.perception.mirrors.arcs import with_arcs
from models.perception.mirrors.clustering import NOISE
from models.perception.mirrors.lines import INLIER_SIGMAS, Line, LineFit, claimed
from models.perception.mirrors.wall_search import Limits, Segment, best_segment, left_over, next_on_line, supported
from msgs.values.arrays import require_positive
from msgs.values.perception import Wall

#: Candidate pieces for each wall that may be kept, the best first: all pairs of them are compared.
_MAX_CANDIDATES = 4
#: A wall is split at a gap this wide through which so many returns of another wall are visible: one may be an outlier.
OPEN_GAP_M = 2.0
SEEN_THROUGH_POINTS = 2


class WallParams(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Parameters of the wall fit.

    A mirror has `min_inliers` over `min_length_m`, an angle known to `max_angle_std_rad` and `min_offset_m` from the
    radar.
    """

    error_model: Literal["polar", "euclidean"] = "polar"
    rounds: int = 200
    inlier_m: float = 0.3
    #: Unevenness of real walls, added to each point's own error.
    flatness_m: float = 0.08
    min_inliers: int = 4
    min_length_m: float = 2.5
    max_gap_m: float = 6.5
    #: A wall that reflects at few spots, too far apart for one cluster, needs a higher score over scattered points.
    sparse_gap_m: float = 12.0
    sparse_min_score: float = 15.0
    max_angle_std_rad: float = math.radians(6.0)
    min_offset_m: float = 0.5
    #: Log likelihood ratio against scattered points.
    min_score: float = 9.0
    max_walls: int = 12
    #: Lines of different clusters join, grow and hide each other; without it they stay as RANSAC leaves them.
    joined: bool = True
    #: A wall extends to the end of another that lies on its line, at most this far, unless returns are visible through
    #: it there; 0: never.
    corner_reach_m: float = 10.0
    #: Walls wholly behind another one stay: that they are seen says that it has a gap.
    behind_walls: bool = False
    #: Walls that an arc explains better than lines are arcs.
    curved: bool = True
    seed: int = 0

    def __post_init__(self) -> None:
        for name in ("rounds", "inlier_m", "flatness_m", "max_gap_m", "max_angle_std_rad", "max_walls"):
            require_positive(f"walls.{name}", getattr(self, name))
        if self.min_inliers < 2:
            raise ValueError(f"walls.min_inliers must be at least 2, got {self.min_inliers!r}")


def find_walls(
    points_m: np.ndarray, covariance_m2: np.ndarray, labels: np.ndarray, params: WallParams
) -> tuple[list[Wall], np.ndarray]:
    """Return the walls of clustered points [N, 2] with covariances, and each point's wall (-1: none), int64 [N].

    By support (most inliers, then nearest), seeded by `params.seed`.
    """
    points_m = np.array(points_m, np.float64)
    covariance_m2 = _error_model(covariance_m2, params)
    rng = np.random.default_rng(params.seed)
    fits: list[LineFit] = []
    for label in range(int(labels.max(initial=NOISE)) + 1):
        fits += _walls_of_cluster(points_m, covariance_m2, np.flatnonzero(labels == label), params, rng)
    if params.joined:
        fits = _join_clusters(points_m, covariance_m2, fits, params, rng)
    fits = fits[: params.max_walls]
    wall_of_point = np.full(len(points_m), -1, np.int64)
    for index, fit in reversed(list(enumerate(fits))):
        wall_of_point[fit.members] = index
    return [fit.as_wall() for fit in fits], wall_of_point


def _join_clusters(
    points_m: np.ndarray, covariance_m2: np.ndarray, fits: list[LineFit], params: WallParams, rng: np.random.Generator
) -> list[LineFit]:
    """Join walls over clusters, add sparse ones and arcs, and split them where the radar sees through; best first."""
    if len(fits) > _MAX_CANDIDATES * params.max_walls:
        fits = sorted(fits, key=lambda fit: -fit.score)[: _MAX_CANDIDATES * params.max_walls]
    fits = _merge_duplicates(points_m, covariance_m2, fits, params)
    sparse = msgspec.structs.replace(params, max_gap_m=params.sparse_gap_m, min_score=params.sparse_min_score)
    free = np.flatnonzero(~claimed(len(points_m), fits))
    fits += _walls_of_cluster(points_m, covariance_m2, free, sparse, rng)
    free = np.flatnonzero(~claimed(len(points_m), fits))
    fits = [_extended(points_m, covariance_m2, fit, free, params) for fit in fits]
    if params.curved:
        fits = with_arcs(points_m, covariance_m2, fits)
    fits = [part for fit in fits for part in _opened(points_m, covariance_m2, fit, fits, params)]
    if params.corner_reach_m > 0.0:
        fits = [_to_corner(points_m, fit, fits, params) for fit in fits]
    fits.sort(key=lambda fit: (-len(fit.members), fit.offset_m))
    return fits if params.behind_walls else _drop_walls_behind_walls(fits)


def _error_model(covariance_m2: np.ndarray, params: WallParams) -> np.ndarray:
    """Return the covariances [N, 2, 2] that decide who is an inlier."""
    eye = np.eye(2)
    if params.error_model == "euclidean":
        return np.tile((params.inlier_m / INLIER_SIGMAS) ** 2 * eye, (len(covariance_m2), 1, 1))
    return np.asarray(covariance_m2, np.float64) + params.flatness_m**2 * eye


def _walls_of_cluster(
    points_m: np.ndarray, covariance_m2: np.ndarray, members: np.ndarray, params: WallParams, rng: np.random.Generator
) -> list[LineFit]:
    """Fit walls by sequential RANSAC: the best, then the best among the remaining points, while supported."""
    fits: list[LineFit] = []
    limits = _limits(params)
    while len(members) >= params.min_inliers:
        points, covariance = points_m[members], covariance_m2[members]
        segment, run = best_segment(points, covariance, _pairs(len(members), params.rounds, rng), limits)
        if not segment.is_mirror:
            break
        fits.append(_as_fit(segment, members[run]))
        members = members[left_over(points, covariance, segment, run)]
    return fits


def _pairs(count: int, rounds: int, rng: np.random.Generator) -> np.ndarray:
    """Return the numbers of the point pairs that define the hypotheses: all pairs where there are at most `rounds`."""
    pairs = count * (count - 1) // 2
    return np.arange(pairs) if pairs <= rounds else np.sort(rng.choice(pairs, rounds, replace=False))


def _limits(params: WallParams) -> Limits:
    """Return the limits of the search, each of the type for which it is compiled."""
    return Limits(
        int(params.min_inliers),
        float(params.max_gap_m),
        float(params.min_length_m),
        float(params.max_angle_std_rad),
        float(params.min_offset_m),
        float(params.min_score),
    )


def _as_fit(segment: Segment, members: np.ndarray) -> LineFit:
    """Return a segment with its points."""
    line = segment.line
    return LineFit(
        normal=np.array([line.nx, line.ny]),
        offset_m=line.offset_m,
        members=members,
        score=segment.score,
        ends_m=np.array([[segment.ax, segment.ay], [segment.bx, segment.by]]),
        angle_std_rad=line.angle_std_rad,
        offset_std_m=line.offset_std_m,
    )


def _as_segment(fit: LineFit) -> Segment:
    """Return a fit as a segment for the search."""
    line = Line(float(fit.normal[0]), float(fit.normal[1]), fit.offset_m, fit.angle_std_rad, fit.offset_std_m)
    (ax, ay), (bx, by) = fit.ends_m.tolist()
    return Segment(line, fit.score, ax, ay, bx, by, True)


def _supported(points_m: np.ndarray, covariance_m2: np.ndarray, run: np.ndarray, params: WallParams) -> LineFit | None:
    """Return the line through one run of points, None unless it can act as a mirror (see `WallParams`)."""
    if len(run) < params.min_inliers:
        return None
    segment = supported(points_m[run], covariance_m2[run], _limits(params))
    return _as_fit(segment, run) if segment.is_mirror else None


def _merge_duplicates(
    points_m: np.ndarray, covariance_m2: np.ndarray, fits: list[LineFit], params: WallParams
) -> list[LineFit]:
    """Join segments of one line that a gap between clusters, or a split within one, kept apart."""
    fits = sorted(fits, key=lambda fit: -fit.score)
    merged = True
    while merged:
        merged = False
        for i in range(len(fits)):
            for j in range(i + 1, len(fits)):
                joint = _joined(points_m, covariance_m2, fits[i], fits[j], params)
                if joint is not None:
                    fits = [fit for k, fit in enumerate(fits) if k not in (i, j)] + [joint]
                    fits.sort(key=lambda fit: -fit.score)
                    merged = True
                    break
            if merged:
                break
    return fits


def _joined(
    points_m: np.ndarray, covariance_m2: np.ndarray, first: LineFit, second: LineFit, params: WallParams
) -> LineFit | None:
    """Return one wall in place of two, None for different ones: the joint line must keep 90 % of their score."""
    if abs(float(first.normal @ second.normal)) < math.cos(math.radians(30.0)):
        return None
    members = np.flatnonzero(claimed(len(points_m), (first, second)))
    joint = _supported(points_m, covariance_m2, members, params)
    if joint is None or joint.score < 0.9 * (first.score + second.score):
        return None
    reach = np.sort(points_m[joint.members] @ np.array([-joint.normal[1], joint.normal[0]]))
    return joint if np.diff(reach).max(initial=0.0) <= params.max_gap_m else None


def _extended(
    points_m: np.ndarray, covariance_m2: np.ndarray, fit: LineFit, free: np.ndarray, params: WallParams
) -> LineFit:
    """Return the wall with the free points that continue it within errors, nearest first, of any cluster.

    A smooth wall reflects at few spots, often further apart than a cluster reaches.
    """
    limits = _limits(params)
    while len(free):
        nearest = next_on_line(points_m[free], covariance_m2[free], _as_segment(fit), limits)
        if nearest < 0:
            break
        longer = _supported(points_m, covariance_m2, np.append(fit.members, free[nearest]), params)
        if longer is not None and longer.score >= fit.score:
            fit = longer
        free = np.delete(free, nearest)
    return fit


def _opened(
    points_m: np.ndarray, covariance_m2: np.ndarray, fit: LineFit, fits: list[LineFit], params: WallParams
) -> list[LineFit]:
    """Split a straight wall at the gaps through which another wall is visible; parts without support are none."""
    if fit.curvature_per_m != 0.0:
        return [fit]
    reach = np.sort(points_m[fit.members] @ fit.tangent)
    wide = np.flatnonzero(np.diff(reach) >= OPEN_GAP_M)
    if len(wide) == 0:
        return [fit]
    through = np.zeros(len(wide), int)
    for other in fits:
        if other is not fit:
            foot = _passed_at(fit, points_m[other.members])[:, None]
            through = np.maximum(through, ((foot > reach[wide]) & (foot < reach[wide + 1])).sum(axis=0))
    cuts = 0.5 * (reach[wide] + reach[wide + 1])[through >= SEEN_THROUGH_POINTS]
    if len(cuts) == 0:
        return [fit]
    part_of = np.searchsorted(cuts, points_m[fit.members] @ fit.tangent)
    runs = [fit.members[part_of == part] for part in range(len(cuts) + 1)]
    parts = [_supported(points_m, covariance_m2, run, params) for run in runs]
    return [part for part in parts if part is not None]


def _to_corner(points_m: np.ndarray, fit: LineFit, fits: list[LineFit], params: WallParams) -> LineFit:
    """Extend the wall to the corner that it forms with another: objects before a corner hide the walls' returns."""
    if fit.curvature_per_m != 0.0 or len(fits) < 2:
        return fit
    low, high = np.sort(fit.ends_m @ fit.tangent).tolist()
    passed: np.ndarray | None = None
    for other in fits:
        # walls along one another make no corner
        if other is fit or abs(float(fit.normal @ other.normal)) > 0.5:
            continue
        on_line = np.abs(other.ends_m @ fit.normal + fit.offset_m) <= 1.0
        for at in (other.ends_m[on_line] @ fit.tangent).tolist():
            if not 0.0 < max(low - at, at - high) <= params.corner_reach_m:
                continue
            passed = _passed_at(fit, points_m) if passed is None else passed
            between = (passed > min(at, high)) & (passed < max(at, low)) & ((passed < low) | (passed > high))
            if between.sum() < SEEN_THROUGH_POINTS:
                low, high = min(low, at), max(high, at)
    ends_m = np.array([low, high])[:, None] * fit.tangent - fit.offset_m * fit.normal
    return replace(fit, ends_m=ends_m)


def _passed_at(fit: LineFit, points_m: np.ndarray) -> np.ndarray:
    """Return where rays to the points [N, 2] that lie a metre or more behind a wall cross its line, along it; [M]."""
    depth_m = -(points_m @ fit.normal + fit.offset_m)
    points_m, depth_m = points_m[depth_m > 1.0], depth_m[depth_m > 1.0]
    # the height over the line falls from offset_m at the radar to -depth_m
    return np.asarray((points_m * (fit.offset_m / (fit.offset_m + depth_m))[:, None]) @ fit.tangent)


def _drop_walls_behind_walls(fits: list[LineFit]) -> list[LineFit]:
    """Keep walls in order, without those wholly behind a kept one: they are no mirrors for the radar."""
    kept: list[LineFit] = []
    for fit in fits:
        samples = np.stack([fit.ends_m[0], fit.ends_m.mean(axis=0), fit.ends_m[1]])
        if not any(_hides(nearer, samples) for nearer in kept):
            kept.append(fit)
    return kept


def _hides(wall: LineFit, points_m: np.ndarray) -> bool:
    """Return whether all rays from the radar to points [N, 2] cross the wall and pass it by more than its error."""
    depth_m = -(points_m @ wall.normal + wall.offset_m)
    if not (depth_m > 1.0).all():
        return False
    # where the ray meets the wall's line: the height over the line falls from offset_m at the radar to -depth_m
    foot = points_m * (wall.offset_m / (wall.offset_m + depth_m))[:, None]
    tangent = np.array([-wall.normal[1], wall.normal[0]])
    low, high = np.sort(wall.ends_m @ tangent)
    reach = foot @ tangent
    return bool(((reach >= low) & (reach <= high)).all())
