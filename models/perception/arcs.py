"""Curved walls: an arc in place of the lines that it explains better, by the likelihood that lines are held to.

In the frame of a line (s along it, d across it towards the radar) an arc is d = c0 + c1 s + c2 s^2 / 2 to within a
centimetre for the bends that walls have (sagitta below 2 m). It starts from the returns of one line and takes in what
lies on it at either end, whatever lines claimed that.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import msgspec
import numpy as np

from models.perception.lines import LineFit, fit_line, residual_gain
from models.physics.mirror import wall_from_ends
from msgs.arrays import require_positive


class ArcParams(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """When a wall counts as curved."""

    #: Curvature over its own standard deviation, and log likelihood over that of the lines it replaces.
    min_sigmas: float = 3.0
    min_gain: float = 5.0
    #: Log likelihood a parameter is worth: lines have two each, the arc in place of several has three.
    parameter_gain: float = 1.5
    min_points: int = 6
    #: Most curvature, and the most the wall turns from end to end.
    max_curvature_per_m: float = 0.07
    max_turn_rad: float = 1.4
    #: Along the arc the next return is at most this far off.
    max_gap_m: float = 6.5
    pair_gap_m: float = 12.0
    rounds: int = 8

    def __post_init__(self) -> None:
        for name in ("min_points", "max_curvature_per_m", "max_turn_rad", "max_gap_m", "rounds"):
            require_positive(f"arcs.{name}", getattr(self, name))


@dataclass(frozen=True)
class _Frame:
    """Coordinates of a line: origin [2], tangent and normal [2]."""

    origin: np.ndarray
    tangent: np.ndarray
    normal: np.ndarray

    @classmethod
    def of(cls, fit: LineFit) -> _Frame:
        return cls(fit.ends_m.mean(axis=0), np.array([-fit.normal[1], fit.normal[0]]), fit.normal)

    @classmethod
    def through(cls, points_m: np.ndarray, covariance_m2: np.ndarray) -> _Frame:
        normal, _, _, _ = fit_line(points_m, covariance_m2)
        return cls(points_m.mean(axis=0), np.array([-normal[1], normal[0]]), normal)

    def point(self, s: float, d: float) -> np.ndarray:
        return self.origin + s * self.tangent + d * self.normal


@dataclass(frozen=True)
class _Arc:
    """Coefficients [3] of an arc with their covariance [3, 3], the points on it and what each adds to its score."""

    coefficients: np.ndarray
    covariance: np.ndarray
    members: np.ndarray
    gain: np.ndarray


def with_arcs(points_m: np.ndarray, covariance_m2: np.ndarray, fits: list[LineFit], params: ArcParams) -> list[LineFit]:
    """Lines of points [N, 2] with covariances [N, 2, 2], those that an arc explains better replaced by it."""
    found: list[LineFit] = []
    lines = sorted(fits, key=lambda fit: -fit.score)
    while lines:
        taken = np.concatenate([np.zeros(0, int), *[fit.members for fit in found]])
        free = np.setdiff1d(np.arange(len(points_m)), taken)
        arc, eaten = _best_arc(points_m, covariance_m2, lines, free, params)
        found.append(lines[0] if arc is None else arc)
        lines = [fit for fit in lines[1:] if not any(fit is one for one in eaten)]
    return found


def _best_arc(
    points_m: np.ndarray, covariance_m2: np.ndarray, lines: list[LineFit], free: np.ndarray, params: ArcParams
) -> tuple[LineFit | None, list[LineFit]]:
    """The arc through the first line, alone or with another, that explains most beyond what it replaces."""
    best: tuple[float, LineFit | None, list[LineFit]] = (-math.inf, None, [])
    for other in lines:
        seeds = np.union1d(lines[0].members, other.members)
        frame = _Frame.of(lines[0]) if other is lines[0] else _Frame.through(points_m[seeds], covariance_m2[seeds])
        pair = other is not lines[0]
        if pair and float(lines[0].normal @ other.normal) < math.cos(params.max_turn_rad / 2.0):
            continue
        gap_m = params.pair_gap_m if pair else params.max_gap_m
        arc = _grown(points_m, covariance_m2, frame, seeds, free, msgspec.structs.replace(params, max_gap_m=gap_m))
        if arc is None:
            continue
        eaten = [fit for fit in lines if np.isin(fit.members, arc.members).mean() > 0.5]
        rival = sum(fit.score for fit in eaten)
        spared = params.parameter_gain * (2 * len(eaten) - 3) if len(eaten) > 1 else -params.min_gain
        gain = float(arc.gain.sum()) - rival + spared
        if len(eaten) >= 1 + pair and gain > max(best[0], 0.0) and any(fit is lines[0] for fit in eaten):
            best = gain, _as_fit(points_m, frame, arc), eaten
    return best[1], best[2]


def _grown(
    points_m: np.ndarray,
    covariance_m2: np.ndarray,
    frame: _Frame,
    members: np.ndarray,
    free: np.ndarray,
    params: ArcParams,
) -> _Arc | None:
    """The arc through members and the free returns that continue it; None where it is not clearly bent."""
    s, d = (points_m - frame.origin) @ frame.tangent, (points_m - frame.origin) @ frame.normal
    arc = None
    for _ in range(params.rounds):
        if len(members) < max(params.min_points, 4):
            return None
        arc = _fitted(s, d, covariance_m2, frame, members, free)
        run = _unbroken(s, arc.members, params.max_gap_m)
        if np.array_equal(run, members):
            break
        members = run
    return arc if arc is not None and _is_bent(arc, s, members, params) else None


def _fitted(
    s: np.ndarray, d: np.ndarray, covariance_m2: np.ndarray, frame: _Frame, members: np.ndarray, free: np.ndarray
) -> _Arc:
    """Weighted least squares of an arc through members, and the free points that lie on it."""
    coefficients = np.zeros(3)
    for _ in range(2):
        across, variance = _across(s, d, covariance_m2, frame, coefficients)
        weight = 1.0 / variance[members]
        powers = np.stack([np.ones(len(members)), s[members], 0.5 * s[members] ** 2], axis=1)
        inverse = np.linalg.pinv(powers.T @ (weight[:, None] * powers))
        coefficients = inverse @ (powers.T @ (weight * d[members]))
    across, variance = _across(s, d, covariance_m2, frame, coefficients)
    chi_square = float(np.sum(across[members] ** 2 / variance[members]))
    inflate = max(1.0, chi_square / max(len(members) - 3, 1))
    gain = residual_gain(across[free], variance[free])
    return _Arc(coefficients, inverse * inflate, free[gain > 0.0], gain[gain > 0.0])


def _across(
    s: np.ndarray, d: np.ndarray, covariance_m2: np.ndarray, frame: _Frame, coefficients: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Distance of points from the arc along its local normal [N] and the variance of their errors along it [N]."""
    slope = coefficients[1] + coefficients[2] * s
    scale = 1.0 / np.sqrt(1.0 + slope**2)
    normal = scale[:, None] * (frame.normal - slope[:, None] * frame.tangent)
    variance = np.einsum("ni,nij,nj->n", normal, covariance_m2, normal)
    return (d - coefficients[0] - coefficients[1] * s - 0.5 * coefficients[2] * s**2) * scale, variance


def _unbroken(s: np.ndarray, members: np.ndarray, max_gap_m: float) -> np.ndarray:
    """The run of members about the middle of the line, s = 0, that no gap breaks; sorted indices."""
    order = members[np.argsort(s[members], kind="stable")]
    cuts = np.flatnonzero(np.diff(s[order]) > max_gap_m) + 1
    runs = [run for run in np.split(order, cuts) if len(run)]
    if not runs:
        return members
    distances = [max(float(s[run[0]]), -float(s[run[-1]]), 0.0) for run in runs]
    return np.sort(runs[int(np.argmin(distances))])


def _is_bent(arc: _Arc, s: np.ndarray, members: np.ndarray, params: ArcParams) -> bool:
    """Whether an arc's curvature stands out of its error and is one that walls have."""
    curvature = abs(float(arc.coefficients[2]))
    return (
        curvature >= params.min_sigmas * math.sqrt(float(arc.covariance[2, 2]))
        and curvature <= params.max_curvature_per_m
        and curvature * float(np.ptp(s[members])) <= params.max_turn_rad
        and len(members) >= params.min_points
    )


def _as_fit(points_m: np.ndarray, frame: _Frame, arc: _Arc) -> LineFit:
    """The arc as a wall: its chord, its curvature, and how well its direction and place are known."""
    reach = (points_m[arc.members] - frame.origin) @ frame.tangent
    low, high = float(reach.min()), float(reach.max())
    c0, c1, c2 = arc.coefficients
    ends_m = np.stack([frame.point(s, c0 + c1 * s + 0.5 * c2 * s**2) for s in (low, high)])
    normal, offset_m = wall_from_ends(ends_m[0], ends_m[1], np.zeros(2))
    middle = 0.5 * (low + high)
    at, along = np.array([1.0, middle, 0.5 * middle**2]), np.array([0.0, 1.0, 0.25 * (high - low)])
    slope = c1 + c2 * middle
    return LineFit(
        normal=normal,
        offset_m=offset_m,
        members=np.sort(arc.members),
        score=float(arc.gain.sum()),
        ends_m=ends_m,
        angle_std_rad=math.sqrt(float(along @ arc.covariance @ along)),
        offset_std_m=math.sqrt(float(at @ arc.covariance @ at)),
        curvature_per_m=float(np.sign(normal @ frame.normal) * c2 / (1.0 + slope**2) ** 1.5),
    )
