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
from dataclasses import dataclass
from typing import Literal

import msgspec
import numpy as np

from models.perception.clustering import NOISE
from msgs.arrays import require_positive
from msgs.perception import Wall

#: An inlier's residual stays within this many standard deviations.
INLIER_SIGMAS = 3.0
#: Density of scattered points about a line: one in this many metres across it.
SCATTER_WIDTH_M = 8.0
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
    seed: int = 0

    def __post_init__(self) -> None:
        for name in ("rounds", "inlier_m", "flatness_m", "max_gap_m", "max_angle_std_rad", "max_walls"):
            require_positive(f"walls.{name}", getattr(self, name))
        if self.min_inliers < 2:
            raise ValueError(f"walls.min_inliers must be at least 2, got {self.min_inliers!r}")


@dataclass(frozen=True)
class LineFit:
    """A fitted line n.x + offset = 0 with n towards the radar, the points it stands on and its uncertainty."""

    normal: np.ndarray
    offset_m: float
    members: np.ndarray
    score: float
    ends_m: np.ndarray
    angle_std_rad: float
    offset_std_m: float

    @property
    def length_m(self) -> float:
        """Extent of the supporting points along the line."""
        return float(np.hypot(*(self.ends_m[1] - self.ends_m[0])))

    def as_wall(self) -> Wall:
        """The value that travels."""
        (ax, ay), (bx, by) = self.ends_m.tolist()
        return Wall(
            normal=(float(self.normal[0]), float(self.normal[1])),
            offset_m=self.offset_m,
            ends_m=((ax, ay), (bx, by)),
            inliers=len(self.members),
            angle_std_rad=self.angle_std_rad,
            offset_std_m=self.offset_std_m,
        )


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
    fits = _merge_duplicates(points_m, covariance_m2, fits, params)
    sparse = msgspec.structs.replace(params, max_gap_m=params.sparse_gap_m, min_score=params.sparse_min_score)
    fits += _walls_of_cluster(points_m, covariance_m2, _unclaimed(len(points_m), fits), sparse, rng)
    fits = [_extended(points_m, covariance_m2, fit, _unclaimed(len(points_m), fits), params) for fit in fits]
    fits.sort(key=lambda fit: (-len(fit.members), fit.offset_m))
    fits = _drop_walls_behind_walls(fits)[: params.max_walls]
    wall_of_point = np.full(len(points_m), -1, np.int64)
    for index, fit in reversed(list(enumerate(fits))):
        wall_of_point[fit.members] = index
    return [fit.as_wall() for fit in fits], wall_of_point


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


def line_gain(
    points_m: np.ndarray, covariance_m2: np.ndarray, normals: np.ndarray, offsets_m: np.ndarray
) -> np.ndarray:
    """What each point [N] adds to each line's [H] score, zero for outliers; float64 [H, N].

    log(scatter width / (sqrt(2 pi) sigma)) - d^2 / (2 sigma^2) with sigma^2 = n' C n, the error across the line.
    """
    residual = normals @ points_m.T + offsets_m[:, None]
    # n' C n written out: the three products of the normal against the three entries of each covariance
    squares = np.stack([normals[:, 0] ** 2, 2.0 * normals[:, 0] * normals[:, 1], normals[:, 1] ** 2], axis=1)
    entries = np.stack([covariance_m2[:, 0, 0], covariance_m2[:, 0, 1], covariance_m2[:, 1, 1]])
    variance = squares @ entries
    normed = residual**2 / variance
    gain = np.log(SCATTER_WIDTH_M / math.sqrt(2.0 * math.pi)) - 0.5 * np.log(variance) - 0.5 * normed
    return np.where(normed <= INLIER_SIGMAS**2, np.maximum(gain, 0.0), 0.0)


def fit_line(
    points_m: np.ndarray, covariance_m2: np.ndarray, rounds: int = 3
) -> tuple[np.ndarray, float, float, float]:
    """Weighted total least squares: normal [2], offset [m], angle and offset standard deviation at the middle.

    Weights are the inverse variances across the line, so they follow the line: iterated. The uncertainty is that of
    the weights, inflated where the residuals are larger than they promise. Needs two distinct points.
    """
    xx, xy, yy = covariance_m2[:, 0, 0], covariance_m2[:, 0, 1], covariance_m2[:, 1, 1]
    weights = 1.0 / (xx + yy)
    for _ in range(rounds):
        centre = weights @ points_m / weights.sum()
        dx, dy = (points_m - centre).T
        # principal axis of the weighted scatter, in closed form
        angle_rad = 0.5 * math.atan2(2.0 * weights @ (dx * dy), weights @ (dx * dx - dy * dy))
        normal = np.array([-math.sin(angle_rad), math.cos(angle_rad)])
        weights = 1.0 / (normal[0] ** 2 * xx + 2.0 * normal[0] * normal[1] * xy + normal[1] ** 2 * yy)
    offset_m = -float(normal @ centre)
    if offset_m < 0.0:  # the radar, at the origin, stands on the side the normal points to
        normal, offset_m = -normal, -offset_m
    along = (points_m - centre) @ np.array([-normal[1], normal[0]])
    chi_square = float(weights @ (points_m @ normal + offset_m) ** 2)
    inflate = max(1.0, chi_square / max(len(points_m) - 2, 1))
    angle_variance = inflate / max(float(weights @ along**2), 1e-12)
    middle = 0.5 * (along.min() + along.max())
    offset_variance = inflate / float(weights.sum()) + middle**2 * angle_variance
    return normal, offset_m, math.sqrt(angle_variance), math.sqrt(offset_variance)


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
