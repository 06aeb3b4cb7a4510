"""A hidden plane in patches, fitted to confocal transients: reflectances, gain of each wall point, and the response.

Each wall point has its own gain, the light that reaches and leaves it, so that levels say nothing of the fall-off and
the shape of its histogram says all: near patches against far ones. Reflectances follow by maximum likelihood of Poisson
counts (Richardson and Lucy's multiplicative update), the response by a search over the likelihood that remains.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import msgspec
import numpy as np
from scipy import optimize

from lab.transients.scan import ConfocalTransients
from lab.transients.shape import HiddenShape
from models.physics.photons.flux import counts_between, pulses_of
from msgs.values.lidar import SpadParams
from msgs.values.units import SPEED_OF_LIGHT_MPS

#: Bins summed before they are compared.
BINS_PER_CELL = 4
UPDATES = 40
LEAST_COUNTS = 1e-3
#: Response before and behind a delay that is looked at, in standard deviations and mean delays.
BEFORE_RMS, BEHIND_TAILS = 8.0, 12.0


@dataclass(frozen=True)
class Window:
    """Bins of the hidden object's return, and bins without any return."""

    first: int
    stop: int
    quiet_first: int
    quiet_stop: int

    def __post_init__(self) -> None:
        if not 0 < self.first < self.stop or not 0 <= self.quiet_first < self.quiet_stop:
            raise ValueError(f"window must hold bins in order, got {self!r}")
        if (self.stop - self.first) % BINS_PER_CELL:
            raise ValueError(f"window must hold a multiple of {BINS_PER_CELL} bins, got {self.stop - self.first}")


@dataclass(frozen=True, eq=False)
class Plane:
    """A plane in square patches: depth over the wall = depth_m + slopes . (x, y)."""

    depth_m: float
    slopes: tuple[float, float]
    #: Middles of the patches [Q, 2], and a first guess of their reflectances [Q].
    places_m: np.ndarray
    reflectance: np.ndarray

    def seen_from(self, wall_m: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return distance and the cosines at wall and plane from wall points [P, 2] to all patches, each [P, Q]."""
        depth_m = self.depth_m + self.places_m @ np.array(self.slopes)
        normal = np.array([-self.slopes[0], -self.slopes[1], 1.0]) / np.sqrt(1.0 + np.square(self.slopes).sum())
        across = self.places_m[None] - wall_m[:, None]
        distance_m = np.sqrt(np.square(across).sum(axis=-1) + np.square(depth_m))
        wall_cosine = depth_m / distance_m
        return distance_m, wall_cosine, np.maximum(across @ normal[:2] + depth_m * normal[2], 0.0) / distance_m


def plane_patches(shape: HiddenShape, scan: ConfocalTransients, side: int) -> Plane:
    """Return the plane of a reconstructed surface cut into side x side patches over the scanned square."""
    middle_m = scan.half_width_m * ((np.arange(side) + 0.5) * 2.0 / side - 1.0)
    x_m, y_m = np.meshgrid(middle_m, middle_m, indexing="ij")
    nearest = np.minimum(((np.arange(side) + 0.5) / side * len(scan.counts)).astype(int), len(scan.counts) - 1)
    # an update is a product: what starts at 0 stays there
    first_guess = np.maximum(shape.brightness[np.ix_(nearest, nearest)].ravel(), LEAST_COUNTS)
    return Plane(shape.plane[0], shape.plane[1:], np.stack([x_m.ravel(), y_m.ravel()], axis=1), first_guess)


@dataclass(frozen=True, eq=False)
class Observed:
    """Histograms of P wall points within a window, summed over `BINS_PER_CELL` bins, and what is no hidden return."""

    wall_m: np.ndarray
    counts: np.ndarray
    #: Ambient light and late light of the wall's own return, expected, [P, cells].
    background: np.ndarray

    @classmethod
    def of(cls, scan: ConfocalTransients, window: Window, rows: np.ndarray, columns: np.ndarray) -> Observed:
        """Return the wall points of rows and columns [P]; ValueError for a window beyond the bins."""
        if max(window.stop, window.quiet_stop) > scan.bins:
            raise ValueError(f"window must lie within {scan.bins} bins, got {window!r}")
        histograms = scan.counts[rows, columns].astype(np.float64)
        cells = histograms[:, window.first : window.stop].reshape(len(rows), -1, BINS_PER_CELL).sum(axis=2)
        wall_m = np.stack([scan.wall_m[rows], scan.wall_m[columns]], axis=1)
        return cls(wall_m, cells, _background(histograms, window))


def _background(histograms: np.ndarray, window: Window) -> np.ndarray:
    """Return the mean of quiet bins and an exponential: the two stretches before the window, of all points together."""
    floor = histograms[:, window.quiet_first : window.quiet_stop].mean(axis=1)
    length = min(40, window.first // 2)
    stretches = histograms[:, window.first - 2 * length : window.first].reshape(-1, 2, length).mean(axis=2)
    earlier, later = np.maximum(stretches - floor[:, None], 0.0).T
    decay = later.sum() / earlier.sum() if 0.0 < later.sum() < earlier.sum() else 0.0
    middle_bin = (np.arange((window.stop - window.first) // BINS_PER_CELL) + 0.5) * BINS_PER_CELL + 0.5 * length
    late = np.power(decay, middle_bin / length)
    return np.maximum(BINS_PER_CELL * (floor[:, None] + later[:, None] * late), LEAST_COUNTS)


@dataclass(frozen=True)
class Response:
    """What is fitted: pulse and jitter, rms; tail of late detections; cosine's exponent at the plane; depth."""

    rms_s: float
    tail_share: float
    tail_s: float
    #: Reflected share of light over the angle at the plane: cos^exponent, 1 for the plane's projected area alone.
    entrance_exponent: float
    depth_m: float

    def spad(self, scan: ConfocalTransients) -> SpadParams:
        """Return a detector with this response whose period is the scan's bins, without ambient light."""
        return SpadParams(
            repetition_rate_hz=1.0 / (scan.bins * scan.bin_s),
            measurement_time_s=1e6 * scan.bins * scan.bin_s,
            irf_fwhm_s=self.rms_s * np.sqrt(8.0 * np.log(2.0)),
            jitter_rms_s=0.0,
            tail_share=self.tail_share,
            tail_s=self.tail_s,
            ambient_rate_hz=0.0,
            bins=scan.bins,
            tick_s=0.0,
            arming="gated",
        )


@dataclass(frozen=True, eq=False)
class TargetFit:
    """Reflectance of each patch, gain of each wall point, and expected counts [P, cells]."""

    reflectance: np.ndarray
    gain: np.ndarray
    expected: np.ndarray
    #: Twice the logarithm of the likelihood that is missing to a perfect fit.
    deviance: float


#: Loss [P, Q] of distances, cosines at wall and plane, [P, Q], and the exponent of the plane's cosine.
Loss = Callable[[np.ndarray, np.ndarray, np.ndarray, float], np.ndarray]


def retroreflected_share(
    distance_m: np.ndarray, wall_cosine: np.ndarray, object_cosine: np.ndarray, exponent: float
) -> np.ndarray:
    """Return the loss over distance and angle of a patch that sends light back where it came from: r^-2."""
    return np.asarray(wall_cosine * np.power(object_cosine, exponent) / np.square(distance_m))


def matt_share(
    distance_m: np.ndarray, wall_cosine: np.ndarray, object_cosine: np.ndarray, exponent: float
) -> np.ndarray:
    """Return the same of a matt patch, which has no exponent: the squares of both cosines, r^-4."""
    return np.asarray(np.square(wall_cosine * object_cosine / np.square(distance_m)))


class TargetModel:
    """Expected counts of patches at given weights: delays put on whole bins, and the response of a bin's photons."""

    def __init__(
        self, scan: ConfocalTransients, window: Window, spad: SpadParams, plane: Plane, wall_m: np.ndarray
    ) -> None:
        reach_s = spad.timing_rms_s * BEFORE_RMS
        before = int(np.ceil(reach_s / scan.bin_s))
        behind = int(np.ceil((reach_s + BEHIND_TAILS * spad.tail_s) / scan.bin_s))
        self._first, self._nodes = window.first - behind, window.stop - window.first + behind + before
        self._response = _response(spad, scan.bin_s, before, behind, window.stop - window.first)
        distance_m, *_ = plane.seen_from(wall_m)
        at = 2.0 * distance_m / (SPEED_OF_LIGHT_MPS * scan.bin_s) - self._first
        at = np.clip(at, 0.0, self._nodes - 1.001)
        self._node = np.floor(at).astype(np.int64)
        self._rest = at - self._node
        self._flat = self._node + self._nodes * np.arange(len(wall_m))[:, None]

    def counts(self, photons: np.ndarray) -> np.ndarray:
        """Return the counts [P, cells] of photons [P, Q] on each path."""
        size = self._nodes * len(photons)
        nodes = np.bincount(self._flat.ravel(), (photons * (1.0 - self._rest)).ravel(), size)
        nodes += np.bincount(self._flat.ravel() + 1, (photons * self._rest).ravel(), size + 1)[:size]
        return np.asarray(nodes.reshape(len(photons), -1) @ self._response)

    def transpose(self, cells: np.ndarray) -> np.ndarray:
        """Return for each path the sum of cells [P, cells], weighted by its share in each: [P, Q]."""
        nodes = (cells @ self._response.T).ravel()
        return np.asarray(nodes[self._flat] * (1.0 - self._rest) + nodes[self._flat + 1] * self._rest)


def _response(spad: SpadParams, bin_s: float, before: int, behind: int, bins: int) -> np.ndarray:
    """Return the share of a node's photons in each cell of the window, [nodes, cells]."""
    edges_s = (np.arange(before + behind + 1) + 1) * bin_s
    wide = msgspec.structs.replace(spad, repetition_rate_hz=min(spad.repetition_rate_hz, 0.25 / edges_s[-1]))
    share = counts_between(wide, pulses_of(wide, np.array([(before + 1) * bin_s]), np.ones(1)), edges_s)
    later = np.arange(bins)[None] - np.arange(bins + before + behind)[:, None] + behind + before
    known = (later >= 0) & (later < len(share))
    return np.asarray(
        np.where(known, share[np.clip(later, 0, len(share) - 1)], 0.0)
        .reshape(len(later), -1, BINS_PER_CELL)
        .sum(axis=2)
    )


def fit_reflectance(observed: Observed, model: TargetModel, weights: np.ndarray, first_guess: np.ndarray) -> TargetFit:
    """Return the reflectances [Q] of patches with weights [P, Q] and the gains, after `UPDATES` updates of each."""
    reflectance, gain = first_guess, np.ones(len(weights))
    for _ in range(UPDATES):
        gain = fitted_gain(observed, model.counts(weights * reflectance), gain)
        expected = gain[:, None] * model.counts(weights * reflectance) + observed.background
        wanted = (gain[:, None] * weights * model.transpose(observed.counts / expected)).sum(axis=0)
        given = (gain[:, None] * weights * model.transpose(np.ones_like(expected))).sum(axis=0)
        reflectance = reflectance * np.divide(wanted, given, out=np.zeros_like(wanted), where=given > 0.0)
        reflectance /= max(reflectance.mean(), LEAST_COUNTS)
    shape = model.counts(weights * reflectance)
    gain = fitted_gain(observed, shape, gain)
    expected = gain[:, None] * shape + observed.background
    return TargetFit(reflectance, gain, expected, deviance(observed.counts, expected))


def fitted_gain(observed: Observed, shape: np.ndarray, gain: np.ndarray, updates: int = 3) -> np.ndarray:
    """Return the gain [P] that makes shapes [P, cells] over the background most likely."""
    total = np.maximum(shape.sum(axis=1), LEAST_COUNTS)
    for _ in range(updates):
        gain = gain * (observed.counts / (gain[:, None] * shape + observed.background) * shape).sum(axis=1) / total
    return gain


def deviance(counts: np.ndarray, expected: np.ndarray) -> float:
    """Return 2 sum(n ln(n / m) - n + m) of Poisson counts."""
    ratio = np.divide(counts, expected, out=np.ones_like(expected), where=counts > 0.0)
    return float(2.0 * (counts * np.log(ratio) - counts + expected).sum())


def fit_response(
    scan: ConfocalTransients, window: Window, plane: Plane, observed: Observed, start: Response, evaluations: int = 150
) -> tuple[Response, TargetFit]:
    """Return the response under which the counts are most likely, by Nelder and Mead's search from a start."""
    start_values = [np.log(start.rms_s), np.log(start.tail_s), start.tail_share, start.entrance_exponent, start.depth_m]

    def response(values: np.ndarray) -> Response:
        return Response(
            float(np.exp(values[0])), float(np.clip(values[2], 0.0, 1.0)), float(np.exp(values[1])),
            float(max(values[3], 0.0)), float(values[4]),
        )  # fmt: skip

    def fit(values: np.ndarray) -> TargetFit:
        return fit_at(scan, window, plane, observed, response(values))

    simplex = np.array(start_values) + np.vstack([np.zeros(5), np.diag([0.2, 0.2, -0.1, 0.5, 0.002])])
    best = optimize.minimize(
        lambda values: fit(values).deviance, start_values, method="Nelder-Mead",
        options={"initial_simplex": simplex, "maxfev": evaluations, "xatol": 1e-3, "fatol": 0.5},
    )  # fmt: skip
    return response(best.x), fit(best.x)


def fit_at(
    scan: ConfocalTransients,
    window: Window,
    plane: Plane,
    observed: Observed,
    response: Response,
    loss: Loss = retroreflected_share,
) -> TargetFit:
    """Return the reflectances and gains under a response and a law of loss over distance and angle."""
    moved = replace(plane, depth_m=response.depth_m)
    model = TargetModel(scan, window, response.spad(scan), moved, observed.wall_m)
    weights = loss(*moved.seen_from(observed.wall_m), response.entrance_exponent)
    return fit_reflectance(observed, model, weights / weights.mean(), plane.reflectance)
