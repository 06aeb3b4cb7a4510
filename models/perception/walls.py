"""Walls from direct returns: line RANSAC in each cluster, refit by weighted total least squares, cut at gaps.

Two error models share one code. `polar`: each point brings its covariance (range is some 20 times sharper than
cross-range), so a point far along the beam may stand metres off a wall seen edge-on and centimetres off a wall faced.
`euclidean`, the published form: every point within `inlier_m` of the line counts alike.

A line's score is its log likelihood over that of scattered points: sum of log(p(residual | wall) / p(scattered)).
A line that only gathers points because their errors are wide earns little, which is what keeps clutter from becoming
walls along the line of sight.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Literal

import msgspec
import numpy as np

from models.perception.arcs import ArcParams, with_arcs
from models.perception.clustering import NOISE
from models.perception.lines import INLIER_SIGMAS, LineFit, fit_line, line_gain
from msgs.arrays import require_positive
from msgs.perception import Wall

#: Hypotheses that are refit and compared in each round of the search.
FINALISTS = 4
#: Log likelihood a point must add to continue a wall.
MIN_EXTENSION_GAIN = 1.0


class WallParams(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """How walls are found. What acts as a mirror: at least `min_inliers` points over `min_length_m`, on a line known to
    `max_angle_std_rad`, that stands `min_offset_m` or more off the radar and outscores scattered points."""

    error_model: Literal["polar", "euclidean"] = "polar"
    rounds: int = 200
    inlier_m: float = 0.3
    #: Unevenness of real walls, added to each point's own error.
    flatness_m: float = 0.08
    min_inliers: int = 4
    min_length_m: float = 2.5
    max_gap_m: float = 6.5
    #: A wall that answers at few spots, too far apart for one cluster, must outscore scattered points by more.
    sparse_gap_m: float = 12.0
    sparse_min_score: float = 15.0
    max_angle_std_rad: float = math.radians(6.0)
    min_offset_m: float = 0.5
    #: Log likelihood ratio against scattered points.
    min_score: float = 9.0
    max_walls: int = 12
    #: Lines of different clusters join, grow and hide each other; without it they stay as RANSAC leaves them.
    joined: bool = True
    #: A wall is cut at a gap this wide through which so many returns of another wall are seen; 0: never.
    open_gap_m: float = 2.0
    seen_through_points: int = 2
    #: A wall reaches on to the end of another that lies on its line, this far off at most, unless something is seen
    #: through it there; 0: never.
    corner_reach_m: float = 10.0
    #: Walls that an arc explains better than lines are arcs.
    curved: bool = True
    arcs: ArcParams = ArcParams()
    seed: int = 0

    def __post_init__(self) -> None:
        for name in ("rounds", "inlier_m", "flatness_m", "max_gap_m", "max_angle_std_rad", "max_walls"):
            require_positive(f"walls.{name}", getattr(self, name))
        if self.min_inliers < 2:
            raise ValueError(f"walls.min_inliers must be at least 2, got {self.min_inliers!r}")


def find_walls(
    points_m: np.ndarray, covariance_m2: np.ndarray, labels: np.ndarray, params: WallParams
) -> tuple[list[Wall], np.ndarray]:
    """Walls of clustered points [N, 2] with covariances [N, 2, 2], and the wall of each point (-1: none), int64 [N].

    Walls come sorted by support (most inliers, then nearest). Deterministic: the generator is seeded by `params.seed`.
    """
    points_m = np.asarray(points_m, np.float64)
    covariance_m2 = _error_model(covariance_m2, params)
    rng = np.random.default_rng(params.seed)
    fits: list[LineFit] = []
    for label in range(int(labels.max(initial=NOISE)) + 1):
        fits += _walls_of_cluster(points_m, covariance_m2, np.flatnonzero(labels == label), params, rng)
    if params.joined:
        fits = _one_building(points_m, covariance_m2, fits, params, rng)
    fits = fits[: params.max_walls]
    wall_of_point = np.full(len(points_m), -1, np.int64)
    for index, fit in reversed(list(enumerate(fits))):
        wall_of_point[fit.members] = index
    return [fit.as_wall() for fit in fits], wall_of_point


def _one_building(
    points_m: np.ndarray, covariance_m2: np.ndarray, fits: list[LineFit], params: WallParams, rng: np.random.Generator
) -> list[LineFit]:
    """Walls joined over clusters, with sparse ones and arcs, opened where the radar sees through; best first."""
    fits = _merge_duplicates(points_m, covariance_m2, fits, params)
    sparse = msgspec.structs.replace(params, max_gap_m=params.sparse_gap_m, min_score=params.sparse_min_score)
    fits += _walls_of_cluster(points_m, covariance_m2, _unclaimed(len(points_m), fits), sparse, rng)
    fits = [_extended(points_m, covariance_m2, fit, _unclaimed(len(points_m), fits), params) for fit in fits]
    if params.curved:
        fits = with_arcs(points_m, covariance_m2, fits, params.arcs)
    if params.open_gap_m > 0.0:
        fits = [part for fit in fits for part in _opened(points_m, covariance_m2, fit, fits, params)]
    if params.corner_reach_m > 0.0:
        fits = [_to_corner(points_m, fit, fits, params) for fit in fits]
    fits.sort(key=lambda fit: (-len(fit.members), fit.offset_m))
    return _drop_walls_behind_walls(fits)


def _error_model(covariance_m2: np.ndarray, params: WallParams) -> np.ndarray:
    """Covariances [N, 2, 2] that decide who is an inlier."""
    eye = np.eye(2)
    if params.error_model == "euclidean":
        return np.broadcast_to((params.inlier_m / INLIER_SIGMAS) ** 2 * eye, np.shape(covariance_m2))
    return np.asarray(covariance_m2, np.float64) + params.flatness_m**2 * eye


def _walls_of_cluster(
    points_m: np.ndarray, covariance_m2: np.ndarray, members: np.ndarray, params: WallParams, rng: np.random.Generator
) -> list[LineFit]:
    """Sequential RANSAC: the best wall, then the best among the points it leaves, until none has support."""
    found: list[LineFit] = []
    while len(members) >= params.min_inliers:
        fit = _best_wall(points_m, covariance_m2, members, params, rng)
        if fit is None:
            break
        found.append(fit)
        members = np.setdiff1d(members, _claimed(points_m, covariance_m2, members, fit), assume_unique=True)
    return found


def _best_wall(
    points_m: np.ndarray, covariance_m2: np.ndarray, members: np.ndarray, params: WallParams, rng: np.random.Generator
) -> LineFit | None:
    """The highest-scoring segment among the finalists of one RANSAC, None where no segment acts as a mirror."""
    normals, offsets = _hypotheses(points_m[members], params.rounds, rng)
    gain = line_gain(points_m[members], covariance_m2[members], normals, offsets)  # [H, N]
    best: LineFit | None = None
    for chosen in _finalists(gain):
        inliers = members[gain[chosen] > 0.0]
        for fit in _segments(points_m, covariance_m2, members, inliers, params):
            if best is None or fit.score > best.score:
                best = fit
    return best


def _finalists(gain: np.ndarray) -> list[int]:
    """Hypotheses of highest total gain [H, N] that differ in their inliers."""
    chosen: list[int] = []
    seen: set[bytes] = set()
    for index in np.argsort(-gain.sum(axis=1), kind="stable"):
        signature = (gain[index] > 0.0).tobytes()
        if signature not in seen:
            seen.add(signature)
            chosen.append(int(index))
        if len(chosen) == FINALISTS:
            break
    return chosen


def _hypotheses(points_m: np.ndarray, rounds: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Lines through two points each: unit normals [H, 2] and offsets [H]; all pairs where they are no more."""
    count = len(points_m)
    first, second = np.triu_indices(count, k=1)
    if len(first) > rounds:
        keep = np.sort(rng.choice(len(first), rounds, replace=False))
        first, second = first[keep], second[keep]
    along = points_m[second] - points_m[first]
    length_m = np.hypot(along[:, 0], along[:, 1])
    apart = length_m > 1e-6
    along, first, length_m = along[apart], first[apart], length_m[apart]
    normals = np.stack([-along[:, 1], along[:, 0]], axis=1) / length_m[:, None]
    return normals, -np.einsum("hi,hi->h", normals, points_m[first])


def _segments(
    points_m: np.ndarray, covariance_m2: np.ndarray, members: np.ndarray, inliers: np.ndarray, params: WallParams
) -> list[LineFit]:
    """Walls on one hypothesis: refit twice (inliers follow the line), cut at gaps, kept if supported."""
    for _ in range(2):
        if len(inliers) < params.min_inliers:
            return []
        normal, offset_m, _, _ = fit_line(points_m[inliers], covariance_m2[inliers])
        gain = line_gain(points_m[members], covariance_m2[members], normal[None], np.array([offset_m]))[0]
        inliers = members[gain > 0.0]
    along = points_m[inliers] @ np.array([-normal[1], normal[0]])
    order = np.argsort(along, kind="stable")
    cuts = np.flatnonzero(np.diff(along[order]) > params.max_gap_m) + 1
    runs = [np.sort(run) for run in np.split(inliers[order], cuts)]
    fits = [_supported(points_m, covariance_m2, run, params) for run in runs]
    return [fit for fit in fits if fit is not None]


def _supported(points_m: np.ndarray, covariance_m2: np.ndarray, run: np.ndarray, params: WallParams) -> LineFit | None:
    """The line through one run of points, None unless it can act as a mirror (see `WallParams`)."""
    if len(run) < params.min_inliers:
        return None
    points, covariance = points_m[run], covariance_m2[run]
    normal, offset_m, angle_std, offset_std = fit_line(points, covariance)
    tangent = np.array([-normal[1], normal[0]])
    reach = points @ tangent
    ends_m = np.array([reach.min(), reach.max()])[:, None] * tangent - offset_m * normal
    gain = line_gain(points, covariance, normal[None], np.array([offset_m]))[0]
    fit = LineFit(normal, offset_m, run, float(gain.sum()), ends_m, angle_std, offset_std)
    acts = (
        np.count_nonzero(gain) >= params.min_inliers
        and fit.length_m >= params.min_length_m
        and angle_std <= params.max_angle_std_rad
        and offset_m >= params.min_offset_m
        and fit.score >= params.min_score
    )
    return fit if acts else None


def _claimed(points_m: np.ndarray, covariance_m2: np.ndarray, members: np.ndarray, fit: LineFit) -> np.ndarray:
    """Points a wall takes with it: its own, and those within its ends that are as near as errors allow."""
    gain = line_gain(points_m[members], covariance_m2[members], fit.normal[None], np.array([fit.offset_m]))[0]
    tangent = np.array([-fit.normal[1], fit.normal[0]])
    low, high = np.sort(fit.ends_m @ tangent)
    reach = points_m[members] @ tangent
    near = (gain > 0.0) & (reach >= low) & (reach <= high)
    return np.union1d(members[near], fit.members)


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
    points_m: np.ndarray, covariance_m2: np.ndarray, one: LineFit, other: LineFit, params: WallParams
) -> LineFit | None:
    """One wall in place of two, None where the two are not one: the joint line must keep 90 % of their score."""
    if abs(float(one.normal @ other.normal)) < math.cos(math.radians(30.0)):
        return None
    joint = _supported(points_m, covariance_m2, np.union1d(one.members, other.members), params)
    if joint is None or joint.score < 0.9 * (one.score + other.score):
        return None
    reach = np.sort(points_m[joint.members] @ np.array([-joint.normal[1], joint.normal[0]]))
    return joint if np.diff(reach).max(initial=0.0) <= params.max_gap_m else None


def _unclaimed(count: int, fits: list[LineFit]) -> np.ndarray:
    """Points on no wall."""
    members = [fit.members for fit in fits]
    return np.setdiff1d(np.arange(count), np.concatenate(members)) if members else np.arange(count)


def _extended(
    points_m: np.ndarray, covariance_m2: np.ndarray, fit: LineFit, free: np.ndarray, params: WallParams
) -> LineFit:
    """The wall with the free points that continue it, nearest first, whatever cluster they are in.

    A smooth wall answers at few spots (the foot of the perpendicular above all), often further apart than a cluster
    reaches. A point must lie on the line within its own error and that of the line so far out.
    """
    while len(free):
        tangent = np.array([-fit.normal[1], fit.normal[0]])
        low, high = np.sort(fit.ends_m @ tangent)
        reach = points_m[free] @ tangent
        gap_m = np.maximum(np.maximum(low - reach, reach - high), 0.0)
        line_variance = fit.offset_std_m**2 + ((reach - 0.5 * (low + high)) * fit.angle_std_rad) ** 2
        widened = covariance_m2[free] + line_variance[:, None, None] * np.eye(2)
        gain = line_gain(points_m[free], widened, fit.normal[None], np.array([fit.offset_m]))[0]
        candidates = np.flatnonzero((gain > MIN_EXTENSION_GAIN) & (gap_m <= params.max_gap_m))
        if len(candidates) == 0:
            break
        taken = candidates[gap_m[candidates].argmin()]
        longer = _supported(points_m, covariance_m2, np.append(fit.members, free[taken]), params)
        if longer is not None and longer.score >= fit.score:
            fit = longer
        free = np.delete(free, taken)
    return fit


def _opened(
    points_m: np.ndarray, covariance_m2: np.ndarray, fit: LineFit, fits: list[LineFit], params: WallParams
) -> list[LineFit]:
    """The parts of a wall between the gaps through which another wall is seen: what is seen behind proves an opening.

    Arcs, which their own returns bend, stay whole; a part that cannot stand on its own is no wall.
    """
    if fit.curvature_per_m != 0.0:
        return [fit]
    reach = np.sort(points_m[fit.members] @ fit.tangent)
    wide = np.flatnonzero(np.diff(reach) >= params.open_gap_m)
    through = np.zeros(len(wide), int)
    for other in fits:
        if other is not fit:
            foot = _passed_at(fit, points_m[other.members])[:, None]
            through = np.maximum(through, ((foot > reach[wide]) & (foot < reach[wide + 1])).sum(axis=0))
    cuts = 0.5 * (reach[wide] + reach[wide + 1])[through >= params.seen_through_points]
    if len(cuts) == 0:
        return [fit]
    part_of = np.searchsorted(cuts, points_m[fit.members] @ fit.tangent)
    runs = [fit.members[part_of == part] for part in range(len(cuts) + 1)]
    parts = [_supported(points_m, covariance_m2, run, params) for run in runs]
    return [part for part in parts if part is not None]


def _to_corner(points_m: np.ndarray, fit: LineFit, fits: list[LineFit], params: WallParams) -> LineFit:
    """The wall drawn on to the corner it makes with another: what stands before a corner hides the walls' returns."""
    if fit.curvature_per_m != 0.0 or len(fits) < 2:
        return fit
    low, high = np.sort(fit.ends_m @ fit.tangent)
    seen = _passed_at(fit, points_m)
    for other in fits:
        # walls along one another make no corner
        if other is fit or abs(float(fit.normal @ other.normal)) > 0.5:
            continue
        for end in other.ends_m[np.abs(other.ends_m @ fit.normal + fit.offset_m) <= 1.0]:
            at = float(end @ fit.tangent)
            between = (seen > min(at, high)) & (seen < max(at, low)) & ((seen < low) | (seen > high))
            if max(low - at, at - high) <= params.corner_reach_m and between.sum() < params.seen_through_points:
                low, high = min(low, at), max(high, at)
    ends_m = np.array([low, high])[:, None] * fit.tangent - fit.offset_m * fit.normal
    return replace(fit, ends_m=ends_m)


def _passed_at(fit: LineFit, points_m: np.ndarray) -> np.ndarray:
    """Where along a wall's line the rays pass to those of the points [N, 2] that lie a metre or more behind it; [M]."""
    depth_m = -(points_m @ fit.normal + fit.offset_m)
    points_m, depth_m = points_m[depth_m > 1.0], depth_m[depth_m > 1.0]
    # the height over the line falls from offset_m at the radar to -depth_m
    return np.asarray((points_m * (fit.offset_m / (fit.offset_m + depth_m))[:, None]) @ fit.tangent)


def _drop_walls_behind_walls(fits: list[LineFit]) -> list[LineFit]:
    """Keep walls in order, without those that stand wholly behind a kept one: the radar sees no mirror there."""
    kept: list[LineFit] = []
    for fit in fits:
        samples = np.stack([fit.ends_m[0], fit.ends_m.mean(axis=0), fit.ends_m[1]])
        if not any(_hides(nearer, samples) for nearer in kept):
            kept.append(fit)
    return kept


def _hides(wall: LineFit, points_m: np.ndarray) -> bool:
    """All rays from the radar to the points [N, 2] pass through the wall on their way, by more than its own error."""
    depth_m = -(points_m @ wall.normal + wall.offset_m)
    if not (depth_m > 1.0).all():
        return False
    # where the ray meets the wall's line: the height over the line falls from offset_m at the radar to -depth_m
    foot = points_m * (wall.offset_m / (wall.offset_m + depth_m))[:, None]
    tangent = np.array([-wall.normal[1], wall.normal[0]])
    low, high = np.sort(wall.ends_m @ tangent)
    reach = foot @ tangent
    return bool(((reach >= low) & (reach <= high)).all())


__all__ = ["LineFit", "WallParams", "find_walls", "fit_line", "line_gain"]
