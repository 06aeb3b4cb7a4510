"""Curved walls: an arc replaces the lines that it explains better, by the same likelihood as for lines.

In a line's frame an arc is d = c0 + c1 s + c2 s^2 / 2 to a centimetre for sagittas below 2 m.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from models.compiled import compiled
from models.perception.mirrors.lines import LineFit, claimed, fit_line, residual_gain, variance_across
from models.physics.mirror import wall_from_ends

#: A wall is curved from this curvature over its standard deviation on, and this log likelihood over that of the line.
MIN_SIGMAS = 3.0
MIN_GAIN = 5.0
#: Log likelihood a coefficient is worth: lines have two each, the arc in place of several has three.
PARAMETER_GAIN = 1.5
MIN_POINTS = 6
#: Largest curvature of a facade, and its largest turn from end to end.
MAX_CURVATURE_PER_M = 0.07
MAX_TURN_RAD = 1.4
#: Largest gap to the next return along the arc of one line, and of two.
MAX_GAP_M = 6.5
PAIR_GAP_M = 12.0
#: Most refits: nearly all arcs stay the same after two or three.
ROUNDS = 8


@dataclass(frozen=True)
class _Frame:
    """Coordinates of a line: origin [2], tangent and normal [2]."""

    origin: np.ndarray
    tangent: np.ndarray
    normal: np.ndarray

    @classmethod
    def of(cls, fit: LineFit) -> _Frame:
        return cls(0.5 * (fit.ends_m[0] + fit.ends_m[1]), fit.tangent, fit.normal)

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


def with_arcs(points_m: np.ndarray, covariance_m2: np.ndarray, fits: list[LineFit]) -> list[LineFit]:
    """Return the lines of points [N, 2] with covariances [N, 2, 2], with arcs where these explain them better."""
    result: list[LineFit] = []
    lines = sorted(fits, key=lambda fit: -fit.score)
    while lines:
        free = np.flatnonzero(~claimed(len(points_m), result))
        arc, replaced = _best_arc(points_m, covariance_m2, lines, free)
        result.append(lines[0] if arc is None else arc)
        lines = [fit for fit in lines[1:] if not any(fit is line for line in replaced)]
    return result


def _best_arc(
    points_m: np.ndarray, covariance_m2: np.ndarray, lines: list[LineFit], free: np.ndarray
) -> tuple[LineFit | None, list[LineFit]]:
    """Return the arc through the first line, alone or with another, that explains most beyond what it replaces."""
    best: tuple[float, LineFit | None, list[LineFit]] = (-math.inf, None, [])
    for other in lines:
        pair = other is not lines[0]
        if pair and float(lines[0].normal @ other.normal) < math.cos(MAX_TURN_RAD / 2.0):
            continue
        seeds = np.flatnonzero(claimed(len(points_m), (lines[0], other)))
        frame = _Frame.through(points_m[seeds], covariance_m2[seeds]) if pair else _Frame.of(lines[0])
        arc = _grown(points_m, covariance_m2, frame, seeds, free, pair)
        if arc is None:
            continue
        on_arc = np.zeros(len(points_m), bool)
        on_arc[arc.members] = True
        replaced = [fit for fit in lines if 2 * np.count_nonzero(on_arc[fit.members]) > len(fit.members)]
        rival = sum(fit.score for fit in replaced)
        saving = PARAMETER_GAIN * (2 * len(replaced) - 3) if len(replaced) > 1 else -MIN_GAIN
        gain = float(arc.gain.sum()) - rival + saving
        if len(replaced) >= 1 + pair and gain > max(best[0], 0.0) and any(fit is lines[0] for fit in replaced):
            best = gain, _as_fit(points_m, frame, arc), replaced
    return best[1], best[2]


def _grown(
    points_m: np.ndarray,
    covariance_m2: np.ndarray,
    frame: _Frame,
    members: np.ndarray,
    free: np.ndarray,
    pair: bool,
) -> _Arc | None:
    """Return the arc through members and the free returns that continue it; None where it is not clearly bent."""
    if len(members) < MIN_POINTS:
        return None
    s, d = (points_m - frame.origin) @ frame.tangent, (points_m - frame.origin) @ frame.normal
    axes = np.array([frame.tangent, frame.normal])
    limits = PAIR_GAP_M if pair else MAX_GAP_M, MIN_POINTS, ROUNDS
    coefficients, covariance, gain, members = _grow(s, d, covariance_m2, axes, members, free, *limits)
    if len(members) < MIN_POINTS:
        return None
    arc = _Arc(coefficients, covariance, free[gain > 0.0], gain[gain > 0.0])
    return arc if _is_bent(arc, s, members) else None


@compiled(error_model="numpy")
def _grow(
    s: np.ndarray,
    d: np.ndarray,
    covariance_m2: np.ndarray,
    axes: np.ndarray,
    members: np.ndarray,
    free: np.ndarray,
    max_gap_m: float,
    fewest: int,
    rounds: int,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return an arc refit to what lies on it in one run until that stays: coefficients, covariance, gains, run.

    A run of less than `fewest` ends the search. `axes` are the frame's tangent and normal.
    """
    coefficients, covariance, gain = _fitted(s, d, covariance_m2, axes, members, free)
    for _ in range(rounds - 1):
        run = _unbroken(s, free[gain > 0.0], max_gap_m)
        if np.array_equal(run, members) or len(run) < fewest:
            return coefficients, covariance, gain, run
        members = run
        coefficients, covariance, gain = _fitted(s, d, covariance_m2, axes, members, free)
    return coefficients, covariance, gain, _unbroken(s, free[gain > 0.0], max_gap_m)


@compiled(error_model="numpy")
def _fitted(
    s: np.ndarray, d: np.ndarray, covariance_m2: np.ndarray, axes: np.ndarray, members: np.ndarray, free: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Fit an arc through members by weighted least squares; coefficients, covariance, gain of each free point."""
    coefficients = np.zeros(3)
    inverse: np.ndarray = np.zeros((3, 3))
    for _ in range(2):
        # the weights are those along the normals of the arc before
        information, moment = np.zeros((3, 3)), np.zeros(3)
        for i in members:
            _, variance = _across(s[i], d[i], covariance_m2[i], axes, coefficients)
            powers = (1.0, s[i], 0.5 * s[i] * s[i])
            for j in range(3):
                moment[j] += powers[j] * d[i] / variance
                for k in range(3):
                    information[j, k] += powers[j] * powers[k] / variance
        inverse = np.linalg.pinv(information)
        coefficients = np.array([(inverse[j] * moment).sum() for j in range(3)])
    chi_square = 0.0
    for i in members:
        across, variance = _across(s[i], d[i], covariance_m2[i], axes, coefficients)
        chi_square += across * across / variance
    inflate = max(1.0, chi_square / max(len(members) - 3, 1))
    gain = np.empty(len(free))
    for i in range(len(free)):
        across, variance = _across(s[free[i]], d[free[i]], covariance_m2[free[i]], axes, coefficients)
        gain[i] = residual_gain(across, variance)
    return coefficients, inverse * inflate, gain


@compiled(error_model="numpy")
def _across(
    s: float, d: float, covariance_m2: np.ndarray, axes: np.ndarray, coefficients: np.ndarray
) -> tuple[float, float]:
    """Return the distance of a point from the arc along its local normal and the variance of its error along it."""
    slope = coefficients[1] + coefficients[2] * s
    scale = 1.0 / math.sqrt(1.0 + slope * slope)
    nx, ny = scale * (axes[1, 0] - slope * axes[0, 0]), scale * (axes[1, 1] - slope * axes[0, 1])
    off_m = d - coefficients[0] - coefficients[1] * s - 0.5 * coefficients[2] * s * s
    return off_m * scale, variance_across(covariance_m2, nx, ny)


@compiled
def _unbroken(s: np.ndarray, members: np.ndarray, max_gap_m: float) -> np.ndarray:
    """Return the run of members about the middle of the line, s = 0, that no gap breaks; sorted indices."""
    order = members[np.argsort(s[members], kind="mergesort")]
    start, first, last, nearest = 0, 0, 0, math.inf
    for stop in range(1, len(order) + 1):
        if stop < len(order) and s[order[stop]] - s[order[stop - 1]] <= max_gap_m:
            continue
        distance = max(s[order[start]], -s[order[stop - 1]], 0.0)
        if distance < nearest:
            first, last, nearest = start, stop, distance
        start = stop
    return np.sort(order[first:last])


def _is_bent(arc: _Arc, s: np.ndarray, members: np.ndarray) -> bool:
    """Return whether an arc's curvature stands out of its error and is one that walls have."""
    curvature = abs(float(arc.coefficients[2]))
    return (
        curvature >= MIN_SIGMAS * math.sqrt(float(arc.covariance[2, 2]))
        and curvature <= MAX_CURVATURE_PER_M
        and curvature * float(np.ptp(s[members])) <= MAX_TURN_RAD
    )


def _as_fit(points_m: np.ndarray, frame: _Frame, arc: _Arc) -> LineFit:
    """Return the arc as a wall: its chord, its curvature, and how well its direction and place are known."""
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
