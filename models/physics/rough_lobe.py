"""Diffuse lobe of a rough wall: what roughness takes from the mirror, over directions.

Heights are Gaussian, of rms s and correlation exp(-x^2 / l^2). Kirchhoff's integral is an expectation over orders m,
Poisson of mean g^2 = (k s (cos_i + cos_s))^2: K(i, s) = k^2 l^2 G^2 E[exp(-(k l |u_i + u_s|)^2 / 4m) / m; m > 0], G =
(1 + v_i . v_s) / (cos_i + cos_s), v unit vectors to source and observer, u their parts along the wall (Beckmann and
Spizzichino, The Scattering of Electromagnetic Waves from Rough Surfaces, 1963). Scaled by a factor of each direction,
n(i) n(s) K(i, s), it radiates just what `coherent_power` takes from the mirror and is reciprocal. No shadowing, no
change of polarisation.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np

from models.compiled import compiled

#: Orders of scattering that stand for all, and how many standard deviations of the Poisson law they span.
ORDERS, SPAN = 65, 7.0
#: Past the mean, orders of a smaller share (of the first one's) than this are left out.
NEGLIGIBLE = 1e-15
#: Cosines at which the normalisation is tabled, polar and azimuthal nodes of its integrals, and rounds to find it.
TABLE_COSINES, POLAR_NODES, AZIMUTH_NODES, ROUNDS = 24, 32, 12, 60
#: Rms slope at most: beyond it Kirchhoff's facets would shade each other, and the lobe is that of this slope.
MAX_SLOPE = 1.0
#: Least cosine: at grazing nothing is taken from the mirror and nothing is scattered.
LEAST_COSINE = 1e-3
#: Below this the mean of a Gaussian over a span is its value in the middle.
NARROW = 1e-4


@dataclass(frozen=True)
class RoughLobe:
    """Lobe of a wall of an rms height and a correlation length at a wavelength; ValueError unless all are positive."""

    roughness_m: float
    correlation_m: float
    wavelength_m: float

    def __post_init__(self) -> None:
        for name in ("roughness_m", "correlation_m", "wavelength_m"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value > 0.0):
                raise ValueError(f"{name} must be finite and positive, got {value!r}")

    @property
    def effective_correlation_m(self) -> float:
        """The correlation length, or the least whose slopes are not too steep."""
        return max(self.correlation_m, math.sqrt(2.0) * self.roughness_m / MAX_SLOPE)

    def backscatter(self, cosine: np.ndarray, elevation_rad: np.ndarray | float = 0.0) -> np.ndarray:
        """Return the radar cross section per area of a perfect reflector back to the radar, [N].

        `cosine` of incidence in the radar's plane; the mean over +-`elevation_rad`. Lambert: 4 (1 - exp(-g^2)) cos^2.
        """
        cosine = np.clip(np.asarray(cosine, np.float64), LEAST_COSINE, 1.0)
        sine = np.sqrt(1.0 - cosine**2)
        elevation_sine = np.sin(np.broadcast_to(np.asarray(elevation_rad, np.float64), cosine.shape)) * cosine
        factor = self._normalisation_at(cosine)
        return factor**2 * self._kernel(cosine, cosine, 2.0 * sine, 2.0 * elevation_sine)

    def bistatic(self, cos_in: np.ndarray, cos_out: np.ndarray, along: np.ndarray) -> np.ndarray:
        """Return the cross section per area for two directions; `along` is |u_i + u_s|, 0 to the mirror's side."""
        cos_in, cos_out = (np.clip(np.asarray(c, np.float64), LEAST_COSINE, 1.0) for c in (cos_in, cos_out))
        factor = self._normalisation_at(cos_in) * self._normalisation_at(cos_out)
        return factor * self._kernel(cos_in, cos_out, np.asarray(along, np.float64), 0.0)

    def _kernel(
        self, cos_in: np.ndarray, cos_out: np.ndarray, along: np.ndarray, across: np.ndarray | float
    ) -> np.ndarray:
        """Return K; of `across`, the other component of u_i + u_s, the mean over 0..`across`."""
        wave = 2.0 * math.pi / self.wavelength_m
        size = wave * self.roughness_m, wave * self.effective_correlation_m
        given = np.broadcast_arrays(cos_in, cos_out, along, across)
        flat = [np.ascontiguousarray(values, np.float64).ravel() for values in given]
        return np.asarray(_kernels(*flat, size)).reshape(given[0].shape)

    def _normalisation_at(self, cosine: np.ndarray) -> np.ndarray:
        nodes, values = self._normalisation
        return np.interp(cosine, nodes, values)

    @cached_property
    def _normalisation(self) -> tuple[np.ndarray, np.ndarray]:
        """Return cosines, and the factor n at each: a positive symmetric kernel scaled to given sums."""
        nodes = np.linspace(0.0, 1.0, TABLE_COSINES)
        cosine = np.maximum(nodes, LEAST_COSINE)
        target = cosine * -np.expm1(-np.square(4.0 * math.pi * self.roughness_m * cosine / self.wavelength_m))
        cos_out, along, weight = self._directions(cosine)
        power = weight * self._kernel(np.broadcast_to(cosine[:, None], cos_out.shape), cos_out, along, 0.0)
        # what leaves to the table's own cosines: its line between them is linear in the values
        between = np.minimum(cos_out * (TABLE_COSINES - 1), TABLE_COSINES - 1.0)
        lower = np.minimum(between.astype(int), TABLE_COSINES - 2)
        share = between - lower
        row = TABLE_COSINES * np.arange(TABLE_COSINES)[:, None]
        count = TABLE_COSINES**2
        to = np.bincount((row + lower).ravel(), (power * (1.0 - share)).ravel(), count)
        to += np.bincount((row + lower + 1).ravel(), (power * share).ravel(), count)
        to = to.reshape(TABLE_COSINES, TABLE_COSINES)
        values = np.ones(len(nodes))
        for _ in range(ROUNDS):
            values *= np.sqrt(target / np.maximum(values * (to @ values), 1e-300))
        return nodes, values

    def _directions(self, cosine: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return cosines out, |u_i + u_s| and weights of a quadrature about the mirror for each incidence, [I, D]."""
        wave = 2.0 * math.pi / self.wavelength_m
        orders = 1.0 + np.square(2.0 * wave * self.roughness_m)
        lobe_rad = min(2.0 * math.sqrt(orders) / (wave * self.effective_correlation_m), 1.0)
        step, share = np.polynomial.legendre.leggauss(POLAR_NODES)
        reach = math.asinh(math.pi / lobe_rad)
        polar = lobe_rad * np.sinh(0.5 * (step + 1.0) * reach)
        share = 0.5 * share * reach * np.sqrt(polar**2 + lobe_rad**2)
        azimuth = math.pi * (np.arange(AZIMUTH_NODES) + 0.5) / AZIMUTH_NODES
        turn = np.full(AZIMUTH_NODES, 2.0 * math.pi / AZIMUTH_NODES / (4.0 * math.pi))
        share = share * np.sin(polar)
        polar, azimuth = (grid.ravel() for grid in np.meshgrid(polar, azimuth, indexing="ij"))
        weight = (share[:, None] * turn).ravel()
        sine = np.sqrt(1.0 - cosine**2)[:, None]
        # the mirror direction is (-sine, 0, cosine); tilt by `polar` towards `azimuth`
        tilt = np.sin(polar) * np.cos(azimuth)
        cos_out = cosine[:, None] * np.cos(polar) + sine * tilt
        along_x = sine - sine * np.cos(polar) + cosine[:, None] * tilt
        along_y = np.sin(polar) * np.sin(azimuth)
        is_out = cos_out > 0.0
        return np.maximum(cos_out, 1e-9), np.hypot(along_x, along_y), weight * is_out


@lru_cache(maxsize=256)
def rough_lobe(roughness_m: float, correlation_m: float, wavelength_m: float) -> RoughLobe:
    """Return the lobe of a wall in space; those of walls seen before keep their normalisation."""
    return RoughLobe(roughness_m, correlation_m, wavelength_m)


@compiled(error_model="numpy")
def _kernels(cos_in, cos_out, along, across, size):  # type: ignore[no-untyped-def]
    """Return K of each direction, [N]; `size`: k s and k l."""
    height, width = size
    values = np.empty(len(cos_in))
    for n in range(len(cos_in)):
        both = cos_in[n] + cos_out[n]
        # |v_i + v_s|^2 = 2 + 2 v_i . v_s
        facet = 0.5 * (both * both + along[n] * along[n]) / both
        depth = height * height * both * both
        values[n] = facet * facet * mean_over_orders(depth, width, along[n], across[n])
    return values


@compiled(error_model="numpy")
def mean_over_orders(depth, width, along, across):  # type: ignore[no-untyped-def]
    """Return E[width^2 exp(-(width along)^2 / 4m) / m; m > 0], m Poisson of mean `depth`; the mean over 0..`across`."""
    depth = max(depth, 1e-300)
    half = SPAN * math.sqrt(depth) + 0.5 * ORDERS - SPAN * 2.0
    low = max(math.floor(depth - half), 1.0)
    step = max((depth + half - low) / (ORDERS - 1), 1.0)
    middle = max(low, depth)
    most = middle * math.log(depth) - math.lgamma(middle + 1.0)
    total, mean, share, order = 0.0, 0.0, 1.0, low
    for _ in range(ORDERS):
        if step > 1.0:
            share = math.exp(order * math.log(depth) - math.lgamma(order + 1.0) - most)
        scale = 0.5 * width / math.sqrt(order)
        gain = width * width / order
        beside = scale * across
        spread = 0.5 * math.sqrt(math.pi) * math.erf(beside) / beside if beside > NARROW else 1.0
        total += share
        mean += share * gain * spread * math.exp(-((scale * along) ** 2))
        if order > depth and share < NEGLIGIBLE * total:
            break
        order += step
        share *= depth / order
    return -math.expm1(-depth) * mean / total
