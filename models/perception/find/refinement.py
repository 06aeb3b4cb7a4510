"""Sub-cell refinement: maximum-likelihood positions of point echoes on the complex map, all echoes of a map at once.

A coherent map is a linear image of the beams, so its columns hold as many white coefficients as the co-array has
(15 of 256 with the default array). Each echo is a tone in range times a known vector over these coefficients; each is
fitted on a patch of a few range bins, with the noise correlation of the window, after the contribution of all other
echoes is subtracted. Gauss-Newton moves an echo together with its next neighbours; errors come from the Fisher
information, widened where the fit of points leaves more than noise.

Bins whose beams did not fit one coherent scene hold magnitudes: echoes there are left as they are.
"""

from __future__ import annotations

from dataclasses import dataclass

import msgspec
import numpy as np

from models.perception.form.coarray import AzimuthInterpolator, beam_matrix, coefficient_phases, peak_field
from models.physics.waveform import WINDOW_TAPS, window_covariance
from msgs.values.arrays import require_positive
from msgs.values.perception import Peaks
from msgs.values.radar import RadarSetup, RangeAzimuthGrid, RangeAzimuthMap

#: Singular values of the map's columns below this share of the largest carry rounding alone.
_RANK_TOLERANCE = 1e-3
#: Noise is taken to be no less than this share of an echo's power: rounding of complex64.
_LEAST_NOISE = 1e-10
#: Complex tangents of an echo: amplitude (real and imaginary part share one), range, azimuth; and their factors.
_BASIS = np.array([0, 0, 1, 2])
_FACTOR = np.array([1.0, 1.0j, 1.0, 1.0])
_POSITION = slice(2, 4)
#: Resolution cell (range bins, azimuth cells) that neighbours are counted in.
_LOBE = np.array([2.0, 12.0])
#: Information about the logarithm of an amplitude before anything was measured.
_FREE = 1e-4


class RefinementParams(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Patch, steps and limits of the refinement, and the errors that no amount of signal takes away."""

    #: Range bins of a patch: with 5 range is 1.3 to 1.5 times as wide as the bound of the raw samples, with 3 1.5 to
    #: 1.9 times.
    patch_bins: int = 5
    iterations: int = 6
    #: Echoes that move together with each one.
    neighbours: int = 3
    #: Number of strongest echoes that are refined: the time grows with its square and third power.
    most_echoes: int = 256
    #: Echoes further apart in range are not coupled.
    coupling_bins: float = 12.0
    #: Where the truth lies about the start, standard deviation in range bins and azimuth cells.
    prior_bins: float = 0.5
    prior_cells: float = 4.0
    #: An echo that ends further than this many of those from its start stays where it was.
    most_priors: float = 2.0
    #: A patch is of another array where more than this share of its energy lies outside the array's coefficients.
    foreign_share: float = 0.01
    #: A patch with this many times the noise left over holds more than points.
    point_misfit: float = 3.0
    #: Standard deviations added to the bound: the depth of an echo within its object, and the cost of errors of the
    #: array (0.4 dB
    #: and 0.05 rad a column) in azimuth.
    range_std_floor_m: float = 0.03
    azimuth_std_floor_deg: float = 0.2

    def __post_init__(self) -> None:
        for name in (
            "iterations",
            "most_echoes",
            "coupling_bins",
            "prior_bins",
            "prior_cells",
            "most_priors",
            "foreign_share",
        ):
            require_positive(f"refinement.{name}", getattr(self, name))
        for name in ("neighbours", "range_std_floor_m", "azimuth_std_floor_deg"):
            if not getattr(self, name) >= 0.0:
                raise ValueError(f"refinement.{name} must not be negative, got {getattr(self, name)!r}")
        if self.patch_bins < 3 or self.patch_bins % 2 == 0:
            raise ValueError(f"refinement.patch_bins must be odd and at least 3, got {self.patch_bins!r}")


@dataclass(frozen=True)
class RefinedEchoes:
    """Echoes in the order they were given, N of them; those that could not be refined are where they were."""

    #: Fractional positions (range bin, azimuth bin), [N, 2].
    fractional: np.ndarray
    #: Amplitude that an ideal beam steered at the echo would measure, complex128 [N], sqrt(mW).
    amplitude: np.ndarray
    #: Polar covariance (range [m], azimuth [rad]), [N, 2, 2].
    covariance: np.ndarray
    #: Energy left over in the patch relative to noise, [N]: 1 for a point in noise.
    misfit: np.ndarray
    #: bool [N]: refined by likelihood.
    refined: np.ndarray


class EchoRefiner:
    """Refines echoes on maps of one set-up; `window` is the one the range profiles were made with."""

    def __init__(self, setup: RadarSetup, params: RefinementParams | None = None, window: str = "hann") -> None:
        if window not in WINDOW_TAPS:
            raise ValueError(f"window must be one of {sorted(WINDOW_TAPS)}, got {window!r}")
        self.setup, self.params, self.window = setup, params or RefinementParams(), window
        covariance = window_covariance(window, self.params.patch_bins)
        self._whiten = np.linalg.inv(np.linalg.cholesky(covariance))
        self._bases: dict[tuple[RangeAzimuthGrid, tuple[int, ...]], _Basis] = {}

    def refine(self, ra_map: RangeAzimuthMap, fractional: np.ndarray) -> RefinedEchoes:
        """Return the likeliest positions of the echoes that start at fractional bins [N, 2] (range, azimuth).

        Echoes on bins of magnitudes alone, and all echoes of a map that this set-up cannot have made (other range
        bins, columns that no beams explain), stay as they are.
        """
        start = np.asarray(fractional, np.float64)
        result = _unrefined(start)
        grid = ra_map.grid
        same_bins = abs(grid.range_bin_m / self.setup.radar.range_bin_m - 1.0) <= 1e-6
        if len(start) == 0 or not same_bins or grid.range_bins < self.params.patch_bins or ra_map.incoherent.all():
            return result
        basis = self._basis(grid, tuple(sorted(ra_map.missing_beams + ra_map.unused_beams)))
        first = self._first_bins(start, grid.range_bins)
        patch = first[:, None] + np.arange(self.params.patch_bins)
        coefficients, own_share = basis.coefficients(ra_map.values, patch)
        usable = ~ra_map.incoherent[patch].any(axis=1) & (own_share >= 1.0 - self.params.foreign_share)
        energy = np.where(usable, np.sum(np.abs(coefficients) ** 2, axis=(1, 2)), -1.0)
        usable[np.argsort(-energy, kind="stable")[self.params.most_echoes :]] = False
        if usable.any():
            data = self._whiten @ coefficients[usable]
            fit = _Fit(self, basis, ra_map, first[usable], data, start[usable])
            _put(result, np.flatnonzero(usable), fit, fit.run(), grid)
        return result

    def range_response(self, offset_bins: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the white response [..., patch] of a tone `offset_bins` [...] from a patch's first bin, and its
        derivative.
        """
        taps = WINDOW_TAPS[self.window]
        reach, bins = len(taps) // 2, self.params.patch_bins
        x = offset_bins[..., None] - np.arange(-reach, bins + reach)
        turn = np.exp(1j * np.pi * (1.0 - 1.0 / self.setup.radar.samples_per_chirp) * x)
        sinc, slope = np.sinc(x), _sinc_slope(x)
        tone, change = turn * sinc, turn * (slope + 1j * np.pi * sinc)
        both = [sum(tap * part[..., i : i + bins] for i, tap in enumerate(taps)) for part in (tone, change)]
        return both[0] @ self._whiten.T, both[1] @ self._whiten.T

    def _first_bins(self, start: np.ndarray, range_bins: int) -> np.ndarray:
        """Return the first range bin of each patch, patches kept within the map."""
        bins = self.params.patch_bins
        return np.clip(np.rint(start[:, 0]).astype(np.int64) - bins // 2, 0, range_bins - bins)

    def _basis(self, grid: RangeAzimuthGrid, missing: tuple[int, ...]) -> _Basis:
        if (grid, missing) not in self._bases:
            self._bases[grid, missing] = _Basis(self.setup, grid, missing)
        return self._bases[grid, missing]


class _Basis:
    """White coefficients of a map's rows: an orthogonal basis of what beams can make of a row."""

    def __init__(self, setup: RadarSetup, grid: RangeAzimuthGrid, missing: tuple[int, ...]) -> None:
        interpolator = AzimuthInterpolator(setup, grid)
        # each beam alone, under noise that lets nothing look incoherent: the matrix from beams to columns
        alone = np.eye(len(setup.beams), dtype=np.complex64)
        rows, _ = interpolator.interpolate(alone, np.inf, missing)
        columns, size, beams = np.linalg.svd(rows.T.astype(np.complex128), full_matrices=False)
        rank = int(np.sum(size > _RANK_TOLERANCE * size[0]))
        self.noise_gain = interpolator.noise_gain(missing)
        self._setup = setup
        self._columns = columns[:, :rank].conj().astype(np.complex64)
        self._size = size[:rank]
        self._from_coarray = beams[:rank] @ beam_matrix(setup) / peak_field(setup)

    def coefficients(self, values: np.ndarray, patch: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the coefficients [N, patch, rank] of the rows [N, patch], their noise a beam's; share of energy
        they hold [N].
        """
        rows, index = np.unique(patch, return_inverse=True)
        inside = values[rows] @ self._columns
        whole, held = (np.sum(np.abs(part) ** 2, axis=1)[index.reshape(patch.shape)] for part in (values[rows], inside))
        share = held.sum(axis=1) / np.maximum(whole.sum(axis=1), np.finfo(np.float32).tiny)
        return (inside / self._size)[index.reshape(patch.shape)].astype(np.complex128), share

    def response(self, azimuth_rad: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the coefficients [N, rank] of unit echoes at azimuths [N], and their derivatives."""
        position = coefficient_phases(self._setup)
        echo = np.exp(-1j * np.multiply.outer(np.sin(azimuth_rad), position))
        change = -1j * np.multiply.outer(np.cos(azimuth_rad), position) * echo
        return echo @ self._from_coarray.T, change @ self._from_coarray.T


class _Fit:
    """Gauss-Newton on the usable echoes of one map.

    An echo moves together with its next neighbours, as far as they show in its own patch, and what all others leave
    there is taken off: small systems, one an echo, symmetric and positive whatever the map holds.
    """

    def __init__(
        self,
        refiner: EchoRefiner,
        basis: _Basis,
        ra_map: RangeAzimuthMap,
        first: np.ndarray,
        data: np.ndarray,
        start: np.ndarray,
    ) -> None:
        self._refiner, self._basis, self.params = refiner, basis, refiner.params
        self._grid, self._first, self._data, self._start = ra_map.grid, first, data, start
        self.position = start.copy()
        largest = np.max(np.abs(data) ** 2, initial=0.0)
        self._noise_mw = max(ra_map.noise_power_mw / basis.noise_gain, _LEAST_NOISE * largest, 1e-300)
        self.prior = np.array([self.params.prior_bins, self.params.prior_cells])
        self.amplitude = np.zeros(len(start), np.complex128)
        self.misfit = np.ones(len(start))
        apart = np.abs(start[:, None] - start)
        lobes = (apart / _LOBE).max(axis=-1)
        np.fill_diagonal(lobes, -1.0)
        self._near = apart[..., 0] <= self.params.coupling_bins
        #: Each echo itself, then its next neighbours, [N, K]; those whose tone does not reach the patch count nothing.
        self._group = np.argsort(lobes, axis=1, kind="stable")[:, : self.params.neighbours + 1]
        self._felt = np.take_along_axis(apart[..., 0], self._group, axis=1) <= self.params.patch_bins

    def run(self) -> np.ndarray:
        """Run all steps and return the covariance [N, 2, 2] of (range bin, azimuth bin) at the end."""
        limit = np.array(self._grid.shape) - 1.0
        for _ in range(self.params.iterations):
            information, gradient = self._linearise()
            step = np.linalg.solve(information, gradient[..., None])[:, _POSITION, 0]
            self.position = np.clip(self.position + np.clip(step, -self.prior, self.prior), 0.0, limit)
        information, _ = self._linearise()
        return np.linalg.inv(information)[:, 2:4, 2:4]

    def _linearise(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the information [N, 4K, 4K] and gradient [N, 4K] of every group in its first echo's patch."""
        tone, change = self._range_responses()
        azimuth, turning = self._basis.response(self._grid.azimuth_at(self.position[:, 1]))
        self._solve_amplitudes(tone, azimuth)
        left = self._data - np.moveaxis(tone, 1, 2) @ (self.amplitude[:, None] * azimuth)
        self._rate(left)
        group, own = self._group, np.arange(len(left))[:, None]
        # by tangent (amplitude, range, azimuth), scaled by the echo: [N, K, 3, patch] and [N, K, 3, rank]
        scaled = (self._felt * self.amplitude[group])[..., None]
        tone, change = tone[own, group] * scaled, change[own, group] * scaled
        along = np.stack([tone, change, tone], axis=2)
        across = np.stack([azimuth, azimuth, turning * self._grid.azimuth_step_rad], axis=1)[group]
        return self._normal_equations(along, across, left)

    def _normal_equations(
        self, along: np.ndarray, across: np.ndarray, left: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        count, echoes = along.shape[:2]
        factor, basis = np.tile(_FACTOR, echoes), (3 * np.arange(echoes)[:, None] + _BASIS).ravel()
        along, across = along.reshape(count, 3 * echoes, -1), across.reshape(count, 3 * echoes, -1)
        gram = (along.conj() @ np.swapaxes(along, 1, 2)) * (across.conj() @ np.swapaxes(across, 1, 2))
        information = np.real(np.multiply.outer(factor.conj(), factor) * gram[:, basis[:, None], basis])
        slope = np.sum((along.conj() @ left) * across.conj(), axis=-1)[:, basis]
        scale = 2.0 / (self._noise_mw * self.misfit)
        information, gradient = information * scale[:, None, None], np.real(factor.conj() * slope) * scale[:, None]
        # amplitudes are all but free; where an echo vanishes they would have no information at all
        prior = np.tile(np.concatenate([[_FREE, _FREE], self.prior**-2.0]), echoes)
        information[:, np.arange(len(prior)), np.arange(len(prior))] += prior
        pull = np.zeros((count, echoes, 4))
        pull[..., 2:] = ((self.position - self._start) / self.prior**2)[self._group]
        return information, gradient - pull.reshape(count, -1)

    def _range_responses(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the tone and slope of echo j in the patch of echo i, [i, j, patch]; zero where they are far apart."""
        i, j = np.nonzero(self._near)
        responses = np.zeros((2, *self._near.shape, self.params.patch_bins), np.complex128)
        responses[:, i, j] = self._refiner.range_response(self.position[j, 0] - self._first[i])
        return responses[0], responses[1]

    def _solve_amplitudes(self, tone: np.ndarray, azimuth: np.ndarray) -> None:
        """Solve for all amplitudes together by least squares, each in its own patch."""
        own = np.arange(len(tone))
        own_tone = tone[own, own].conj()
        matrix = np.einsum("im,ijm->ij", own_tone, tone) * (azimuth.conj() @ azimuth.T)
        # two echoes at one position share its amplitude; one that no beam sees has none
        matrix[own, own] += 1e-6 * np.abs(matrix[own, own]).max()
        matched = np.einsum("im,imc->ic", own_tone, self._data)
        self.amplitude = np.linalg.solve(matrix, np.sum(matched * azimuth.conj(), axis=1))

    def _rate(self, left: np.ndarray) -> None:
        """Set the misfit: the residual energy of each patch over noise, at least 1."""
        freedom = max(left[0].size - 2, 1)
        energy = np.sum(np.abs(left) ** 2, axis=(1, 2))
        self.misfit = np.maximum(energy / (freedom * self._noise_mw), 1.0)


def refined_peaks(peaks: Peaks, ra_map: RangeAzimuthMap, refiner: EchoRefiner) -> Peaks:
    """Return the peaks at their likeliest positions; the rest of the message stays.

    A peak that fits a point brings the covariance of its fit. One that does not stands for many scatterers in a cell,
    whose spread the peak's own error model knows better than a bound on points.
    """
    grid = ra_map.grid
    start = np.stack([grid.range_index(peaks.range_m), grid.azimuth_index(peaks.azimuth_rad)], axis=1)
    echoes = refiner.refine(ra_map, start)
    moved, point = echoes.refined, echoes.refined & (echoes.misfit <= refiner.params.point_misfit)
    return msgspec.structs.replace(
        peaks,
        range_m=np.where(moved, grid.range_at(echoes.fractional[:, 0]), peaks.range_m),
        azimuth_rad=np.where(moved, grid.azimuth_at(echoes.fractional[:, 1]), peaks.azimuth_rad),
        covariance=np.where(point[:, None, None], echoes.covariance, peaks.covariance),
    )


def _sinc_slope(x: np.ndarray) -> np.ndarray:
    """Return the derivative of sin(pi x) / (pi x); 0 at 0."""
    away = np.where(np.abs(x) < 1e-4, 1.0, x)
    # near 0 the quotient loses its digits: -pi^2 x / 3 there
    return np.where(np.abs(x) < 1e-4, -(np.pi**2) * x / 3.0, (np.cos(np.pi * x) - np.sinc(x)) / away)


def _unrefined(start: np.ndarray) -> RefinedEchoes:
    count = len(start)
    return RefinedEchoes(
        fractional=start.copy(),
        amplitude=np.zeros(count, np.complex128),
        covariance=np.zeros((count, 2, 2)),
        misfit=np.ones(count),
        refined=np.zeros(count, bool),
    )


def _put(result: RefinedEchoes, usable: np.ndarray, fit: _Fit, covariance: np.ndarray, grid: RangeAzimuthGrid) -> None:
    """Write the echoes that stayed near their start into the result."""
    params = fit.params
    is_near = (np.abs(fit.position - result.fractional[usable]) <= params.most_priors * fit.prior).all(axis=1)
    kept = usable[is_near]
    unit = np.array([grid.range_bin_m, grid.azimuth_step_rad])
    floor = np.array([params.range_std_floor_m, np.radians(params.azimuth_std_floor_deg)])
    result.fractional[kept] = fit.position[is_near]
    result.amplitude[kept] = fit.amplitude[is_near]
    result.misfit[kept] = fit.misfit[is_near]
    result.covariance[kept] = covariance[is_near] * np.multiply.outer(unit, unit) + np.diag(floor**2)
    result.refined[kept] = True
