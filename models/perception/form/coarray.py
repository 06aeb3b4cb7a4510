"""Interpolation from a few steered beams to many azimuths through the co-array.

Two-way beams of N columns live in 2N - 1 coefficients: y_k = sum_m conj(W_km) x_m, W the two-way weights, x_m =
sum_targets a exp(-j k d (m - N + 1) sin(azimuth)) in the recorded (conjugate) convention. While the scene stays
coherent over the scan they follow by least squares with the weights as really set, and ideal beams can be steered
anywhere: a target's cell holds the amplitude an ideal beam steered at it would have measured. Where coherence fails
(beams lie 12 ms apart, a mover turns the phase), magnitudes take over: the two-way pattern of an ideal centred array is
real, not negative, and spanned by the same coefficients over its steering sine.

An array that steers receive alone carries N coefficients and interpolates powers instead of magnitudes: its one-way
pattern changes sign. A digital array has as many orthogonal beams as columns, all of one time: the inversion is exact,
with no residual to test coherence, and an echo between two beams keeps only what the better one holds (down to -3.9 dB)
where magnitudes are asked for.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from models.compiled import compiled
from models.physics.antenna import coarray_weights, setup_weights
from msgs.values.arrays import require_array
from msgs.values.radar import RadarSetup, RangeAzimuthGrid

#: Ridges, relative to the largest singular value squared, from exact to safe; a complete scan takes the first.
_RIDGES = (1e-7, 1e-6, 1e-5, 1e-4, 1e-3, 1e-2, 1e-1)
#: Largest noise power of an interpolated cell relative to a beam's: it bounds the noise in gaps left by missing beams.
_NOISE_GAIN_LIMIT = 2.5
#: Ridge for range bins with beam azimuths of their own, which cannot be tuned one by one.
_MOVING_RIDGE = 1e-3
#: Number of sets of missing beams whose matrices are cached: there are as many sets as subsets of the beams.
_MAX_INVERSES = 64
#: Largest number of beams times coefficients of magnitudes, which each range bin solves separately on a moving vehicle.
#: The 77 GHz radar has 6,441; at the limit a scan takes a second.
MAX_TERMS = 1 << 14
#: Largest condition of the beams at which coefficients tell of the array. An array of half a wavelength has 12 to 18
#: where beams span 114 degrees or more; over 60 degrees it has 530, and coefficients 30 dB more noise than a beam.
_MAX_CONDITION = 30.0
#: Beams that looked no further from their steering angle than this count as looking there: an eighth of a cell.
_STILL_RAD = 1e-3


#: Probability that noise alone exceeds the first limit.
NOISE_FALSE_ALARM = 1e-4
#: Residual energy over beam energy that errors of the array model (a foreign rounding of phases) may reach.
MODEL_ERROR = 3e-3
#: Azimuths of departure and return that are tried, over the map's, and the margin for those between.
TRIED_AZIMUTHS, BETWEEN_TRIED = 61, 1.1
#: Coarser phases, or gaps of missing beams, leave more: a limit above this would take movers for such paths.
MAX_MODEL_ERROR = 0.05
#: A beam covers this many beam spacings to either side: one missing beam leaves no gap, three in a row do.
SEEN_SPACINGS = 1.5
#: A digital array, whose beams have no such overlap, covers azimuths where its beams hold this share of an echo's
#: field.
SEEN_SHARE = 0.5


@dataclass(frozen=True)
class _Inverse:
    """Precomputed products for one set of beams; `beams` rows each."""

    #: Beams to azimuths, complex64 [beams, azimuth], and to the coefficients between, complex64 [beams, 2N-1].
    coherent: np.ndarray
    coefficients: np.ndarray
    #: Beams to the residual of the fit, complex64 [beams, beams].
    residual: np.ndarray
    #: Complex degrees of freedom of the residual.
    freedom: float
    #: Largest share of a path's energy that may be left over although nothing moves.
    model_error: float
    #: Magnitudes of beams to azimuths, float32 [beams, azimuth].
    magnitude: np.ndarray
    #: Mean noise power of a cell relative to a beam's.
    noise_gain: float
    #: Share of an echo's field that the coherent fit gives in its own cell; float64 [azimuth].
    share: np.ndarray


def require_formable(setup: RadarSetup) -> None:
    """Raise `ValueError` for a set-up that cannot tell directions apart, or whose maps would take too long to form."""
    if setup.array.columns < 2:
        raise ValueError(f"array.columns must be at least 2 to tell directions apart, got {setup.array.columns}")
    if len(set(setup.beams.azimuth_deg)) < 2:
        raise ValueError(
            f"beams.azimuth_deg must name at least 2 directions to tell echoes apart, got {setup.beams.azimuth_deg}"
        )
    beams, coefficients = len(setup.beams), 2 * setup.array.columns - 1
    if beams * coefficients > MAX_TERMS:
        raise ValueError(
            f"setup must have at most {MAX_TERMS} beams times (2 columns - 1), "
            f"got {beams} beams and {setup.array.columns} columns"
        )


def peak_field(setup: RadarSetup) -> float:
    """Return the field of an ideal beam steered at a unit echo, power normalised: N, or sqrt(N) one way."""
    return float(setup.array.columns) ** (0.5 * setup.array.steered_ways)


def coefficient_phases(setup: RadarSetup) -> np.ndarray:
    """Return the phase k d p of each co-array coefficient per unit of sin(azimuth), float64 [2N-1], or [N] one way."""
    columns, wavelength_m = setup.array.columns, setup.radar.wavelength_m
    reach = 0.5 * setup.array.steered_ways * (columns - 1)
    step_rad = 2.0 * np.pi / wavelength_m * setup.array.column_spacing(wavelength_m)
    return step_rad * np.arange(-reach, reach + 0.5)


def beam_matrix(setup: RadarSetup) -> np.ndarray:
    """Return the matrix from coefficients to beams, weights as set; complex128 [beams, 2N-1], or [beams, N] one way."""
    weights = setup_weights(setup)
    if setup.array.steered_ways == 2:
        weights = coarray_weights(weights)
    return weights.conj() / peak_field(setup)


def ideal_beams(setup: RadarSetup, azimuth_rad: np.ndarray) -> np.ndarray:
    """Return the matrix from coefficients to ideal beams at azimuths [...], complex128 [..., 2N-1] or [..., N]."""
    if setup.array.steered_ways == 2:
        return _ideal_two_way(setup, azimuth_rad)
    steering = np.exp(1j * np.multiply.outer(np.sin(azimuth_rad), coefficient_phases(setup)))
    return steering / peak_field(setup)


def two_azimuth_beams(setup: RadarSetup, azimuth_rad: np.ndarray) -> np.ndarray:
    """Return the beams' fields of paths that leave by one azimuth and return by another, complex128 [beams, pairs].

    A wall between makes such paths, of which the co-array knows the sum of both sines alone: with phases that are
    rounded it errs by up to 2 % of their energy. An array that steers one way has none: each azimuth by itself.
    """
    columns, wavelength_m = setup.array.columns, setup.radar.wavelength_m
    step_rad = 2.0 * np.pi / wavelength_m * setup.array.column_spacing(wavelength_m)
    one_way = (setup_weights(setup) @ np.exp(1j * step_rad * np.outer(np.arange(columns), np.sin(azimuth_rad)))).conj()
    if setup.array.steered_ways == 1:
        return one_way
    leave, come_back = np.triu_indices(len(azimuth_rad))
    return np.asarray(one_way[:, leave] * one_way[:, come_back])


def _ideal_two_way(setup: RadarSetup, azimuth_rad: np.ndarray) -> np.ndarray:
    """Return the ideal two-way beams, which are the squares of one-way ones as well; complex128 [..., 2N-1]."""
    columns = setup.array.columns
    wavelength_m = setup.radar.wavelength_m
    step_rad = 2.0 * np.pi / wavelength_m * setup.array.column_spacing(wavelength_m)
    position = np.arange(2 * columns - 1) - (columns - 1)
    taper = (columns - np.abs(position)) / columns
    return taper * np.exp(1j * step_rad * np.multiply.outer(np.sin(azimuth_rad), position))


class AzimuthInterpolator:
    """Interpolates range profiles of a set-up's beams to the azimuths of a grid, by matrices for each missing set."""

    def __init__(
        self,
        setup: RadarSetup,
        grid: RangeAzimuthGrid | None = None,
    ) -> None:
        self.setup = setup
        self.grid = grid or setup.map_grid
        self._beam_matrix = beam_matrix(setup)
        self._magnitude_matrix = _ideal_two_way(setup, setup.beams.azimuth_rad)
        self._magnitude_steering = _ideal_two_way(setup, self.grid.azimuth_rad)
        self._steering = ideal_beams(setup, self.grid.azimuth_rad)
        first_rad, last_rad = self.grid.azimuth_rad[[0, -1]]
        self._two_azimuths = two_azimuth_beams(setup, np.linspace(first_rad, last_rad, TRIED_AZIMUTHS))
        self._inverses: dict[tuple[int, ...], _Inverse] = {}

    @property
    def coherent_matrix(self) -> np.ndarray:
        """Matrix from the profiles of all beams to the azimuths of a coherent scene, complex [beams, azimuths]."""
        return self._inverse(()).coherent

    @property
    def model_error(self) -> float:
        """Largest share of the energy of a scan's beams that may fit no coherent scene although nothing moves."""
        return self._inverse(()).model_error

    @cached_property
    def coefficient_matrix(self) -> np.ndarray | None:
        """Profiles of all beams to co-array coefficients, complex64 [beams, 2N-1]; None where beams are too few, or too
        much alike to tell them from noise.
        """
        beams, coefficients = self._beam_matrix.shape
        if beams <= coefficients or np.linalg.cond(self._beam_matrix) > _MAX_CONDITION:
            return None
        return np.linalg.pinv(self._beam_matrix).T.astype(np.complex64)

    def interpolate(
        self,
        profiles: np.ndarray,
        noise_power_mw: float,
        missing: tuple[int, ...] = (),
        look_azimuth_rad: np.ndarray | None = None,
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the complex64 [range, azimuth] of profiles [beams, range], and where magnitudes alone hold, bool
        [range].

        `noise_power_mw` is a beam's per bin; rows of `missing` beams are unused. `look_azimuth_rad` [beams, range] is
        where each beam looked, seen from the map's pose, if not at its steering angle.
        """
        require_array("profiles", profiles, "<c8", (len(self.setup.beams), None))
        inverse = self._inverse(missing)
        present = self._present(missing)
        # [range, beams]
        beams = np.ascontiguousarray(profiles[present].T)
        incoherent = self._incoherent(beams, inverse, noise_power_mw)
        looks = None if look_azimuth_rad is None else look_azimuth_rad[present]
        steered_rad = None if looks is None else self._steered_at(looks, present)
        if steered_rad is None:
            values = beams @ inverse.coherent
        else:
            values = self._steered(beams @ inverse.coefficients, steered_rad)
        if incoherent.any():
            looks = None if looks is None else looks[:, incoherent]
            values[incoherent] = self._magnitudes(np.abs(beams[incoherent]), inverse, looks)
        values[:, self._unseen(missing)] = 0.0
        return values, incoherent

    def interpolate_magnitude(
        self, magnitudes: np.ndarray, missing: tuple[int, ...] = (), look_azimuth_rad: np.ndarray | None = None
    ) -> np.ndarray:
        """Return magnitudes float32 [range, azimuth] of beam magnitudes float32 [beams, range]; arguments as above."""
        present = self._present(missing)
        looks = None if look_azimuth_rad is None else look_azimuth_rad[present]
        values = self._magnitudes(np.ascontiguousarray(magnitudes[present].T), self._inverse(missing), looks)
        values[:, self._unseen(missing)] = 0.0
        return values

    def warm(self) -> None:
        """Compute the matrices of whole scans and compile the kernels of moving ones: the first must not wait."""
        azimuth_rad = self.grid.azimuth_rad[None]
        self._steered(np.zeros((1, self._beam_matrix.shape[1]), np.complex64), azimuth_rad)
        self._inverse(())

    def noise_gain(self, missing: tuple[int, ...] = ()) -> float:
        """Return the mean noise power of a coherent cell relative to a beam's (0.58 with all of the default beams)."""
        return self._inverse(missing).noise_gain

    def _unseen(self, missing: tuple[int, ...]) -> np.ndarray:
        """Return the azimuths [azimuth] that only missing beams cover: the fit has no data there; bool."""
        if self.setup.array.digital:
            return (self._inverse(()).share >= SEEN_SHARE) & (self._inverse(missing).share < SEEN_SHARE)
        reach_rad = SEEN_SPACINGS * np.median(np.diff(np.sort(self.setup.beams.azimuth_rad), prepend=-np.pi))
        distance_rad = np.abs(self.grid.azimuth_rad[:, None] - self.setup.beams.azimuth_rad)
        covered, nominal = (distance_rad[:, beams] <= reach_rad for beams in (self._present(missing), slice(None)))
        return nominal.any(axis=1) & ~covered.any(axis=1)

    def _present(self, missing: tuple[int, ...]) -> list[int]:
        return [beam for beam in range(len(self.setup.beams)) if beam not in missing]

    def _inverse(self, missing: tuple[int, ...]) -> _Inverse:
        if missing not in self._inverses:
            if len(self._inverses) >= _MAX_INVERSES:
                del self._inverses[next(iter(self._inverses))]
            present = self._present(missing)
            self._inverses[missing] = _invert(
                (self._beam_matrix[present], self._steering),
                (self._magnitude_matrix[present], self._magnitude_steering),
                self._two_azimuths[present],
            )
        return self._inverses[missing]

    def _incoherent(self, beams: np.ndarray, inverse: _Inverse, noise_power_mw: float) -> np.ndarray:
        """Return the bins [range] whose residual neither noise nor model errors explain; none without freedom.

        Movers of 0.3 m/s are found in 5 % at 10 dB over a beam's noise, 59 % at 15 dB, all at 20 dB.
        """
        # imported here: a detector uses arrays, but forms no maps
        from scipy.special import gammainccinv

        if inverse.freedom < 1.0:
            return np.zeros(len(beams), np.bool_)
        left_over = _energy(beams @ inverse.residual)
        noise_limit = noise_power_mw * gammainccinv(inverse.freedom, NOISE_FALSE_ALARM)
        return (left_over > noise_limit) & (left_over > inverse.model_error * _energy(beams))

    def _steered_at(self, looks: np.ndarray, present: list[int]) -> np.ndarray | None:
        """Return where a beam that looked at each azimuth of the map was steered, [range, azimuth], from the looks of
        the present beams [beams, range]; None where they looked where they were steered."""
        beam_rad, grid_rad = self.setup.beams.azimuth_rad[present], self.grid.azimuth_rad
        off_rad = (looks - beam_rad[:, None]).T
        if np.abs(off_rad).max(initial=0.0) <= _STILL_RAD:
            return None
        order = np.argsort(beam_rad, kind="stable")
        between = np.stack([np.interp(grid_rad, beam_rad[order], unit) for unit in np.eye(len(order))])
        off_rad = off_rad[:, order] @ between
        # one Newton step of steered + off(steered) = azimuth: exact while off is linear, as under a steady turn
        slope = np.gradient(off_rad, grid_rad, axis=1)
        return np.asarray(grid_rad - off_rad / np.clip(1.0 + slope, 0.5, 2.0))

    def _steered(self, coefficients: np.ndarray, azimuth_rad: np.ndarray) -> np.ndarray:
        """Return ideal beams complex64 of coefficients [range, 2N-1], each range at own azimuths [range, azimuth]."""
        first, second = coefficient_phases(self.setup)[:2].tolist()
        sine = np.sin(azimuth_rad.astype(np.float32))
        terms = (coefficients * ideal_beams(self.setup, np.zeros(()))).astype(np.complex64)
        return np.asarray(_polynomials(terms, _unit_phasors((second - first) * sine), _unit_phasors(first * sine)))

    def _magnitudes(self, magnitudes: np.ndarray, inverse: _Inverse, looks: np.ndarray | None) -> np.ndarray:
        """Return the least squares on magnitudes [range, beams], on their squares one way, not below zero."""
        one_way = self.setup.array.steered_ways == 1
        spanned = magnitudes**2 if one_way else magnitudes
        if looks is None:
            values = spanned @ inverse.magnitude
        else:
            values = _solve_each(_ideal_two_way(self.setup, looks.T), spanned) @ self._magnitude_steering.T
        values = np.maximum(values.real, 0.0)
        return (np.sqrt(values) if one_way else values).astype(np.float32)


def _invert(
    fields: tuple[np.ndarray, np.ndarray], magnitudes: tuple[np.ndarray, np.ndarray], two_azimuths: np.ndarray
) -> _Inverse:
    """Return both inverses from the beams [beams, coefficients] and the steering [azimuth, coefficients] of each."""
    beams, steering = fields
    coherent, back = _ridge_inverse(*fields)
    residual = np.eye(len(beams)) - beams @ back
    magnitude, _ = _ridge_inverse(*magnitudes)
    return _Inverse(
        coherent=coherent.T.astype(np.complex64),
        coefficients=back.T.astype(np.complex64),
        residual=residual.T.astype(np.complex64),
        freedom=float(np.sum(np.abs(residual) ** 2)),
        model_error=_model_error(two_azimuths, residual),
        magnitude=magnitude.T.real.astype(np.float32),
        noise_gain=float(np.sum(np.abs(coherent) ** 2) / len(coherent)),
        share=_share(coherent @ beams, steering),
    )


def _model_error(two_azimuths: np.ndarray, residual: np.ndarray) -> float:
    """Return the largest share of the energy of paths [beams, pairs] that a fit leaves over, within limits."""
    if not len(residual):
        return MODEL_ERROR
    # beams that look nowhere receive no path
    left_over = _energy((residual @ two_azimuths).T) / np.maximum(_energy(two_azimuths.T), np.finfo(np.float64).tiny)
    return float(np.clip(BETWEEN_TRIED * left_over.max(), MODEL_ERROR, MAX_MODEL_ERROR))


def _share(achieved: np.ndarray, steering: np.ndarray) -> np.ndarray:
    """Return how much of the wanted steering [azimuth, coefficients] the one arrived at holds, [azimuth]."""
    return np.abs(np.sum(achieved * steering.conj(), axis=1)) / np.sum(np.abs(steering) ** 2, axis=1)


def _ridge_inverse(beams: np.ndarray, steering: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return beams to azimuths [azimuth, beams] and to coefficients [2N-1, beams], at the least ridge noise allows."""
    largest = np.linalg.norm(beams, 2) ** 2 if len(beams) else 1.0
    gram = beams.conj().T @ beams
    for ridge in _RIDGES:
        back = np.linalg.solve(gram + ridge * largest * np.eye(len(gram)), beams.conj().T)
        forward = steering @ back
        if np.sum(np.abs(forward) ** 2, axis=1).max() <= _NOISE_GAIN_LIMIT:
            break
    return forward, back


def _solve_each(beams: np.ndarray, magnitudes: np.ndarray) -> np.ndarray:
    """Return the coefficients [range, 2N-1] of magnitudes by matrices of their own, both [range, beams, ...].

    B' (B B' + r)^-1 = (B' B + r)^-1 B': the smaller of the two is solved.
    """
    adjoint = beams.conj().transpose(0, 2, 1)
    few_beams = beams.shape[1] < beams.shape[2]
    gram = beams @ adjoint if few_beams else adjoint @ beams
    # the trace bounds the largest eigenvalue and costs nothing
    scale = np.trace(gram, axis1=1, axis2=2).real[:, None, None] / beams.shape[2]
    ridged = gram + _MOVING_RIDGE * scale * np.eye(gram.shape[1])
    if few_beams:
        return (adjoint @ np.linalg.solve(ridged, magnitudes[..., None]))[..., 0]
    return np.linalg.solve(ridged, adjoint @ magnitudes[..., None])[..., 0]


def _unit_phasors(phase_rad: np.ndarray) -> np.ndarray:
    """Return exp(j phase), complex64, of float32 phases: faster by its parts."""
    phasors = np.empty(phase_rad.shape, np.complex64)
    np.cos(phase_rad, out=phasors.real)
    np.sin(phase_rad, out=phasors.imag)
    return phasors


@compiled
def _polynomials(terms: np.ndarray, turn: np.ndarray, start: np.ndarray) -> np.ndarray:
    """Return polynomials with coefficients `terms` [range, T] at `turn`, times `start`, by Horner; complex64."""
    values = np.empty(turn.shape, np.complex64)
    last = terms.shape[1] - 1
    for row in range(len(terms)):
        of_row, turn_of_row = values[row], turn[row]
        of_row[:] = terms[row, last]
        for term in range(last - 1, -1, -1):
            coefficient = terms[row, term]
            for column in range(len(of_row)):
                of_row[column] = of_row[column] * turn_of_row[column] + coefficient
        for column in range(len(of_row)):
            of_row[column] *= start[row, column]
    return values


def _energy(rows: np.ndarray) -> np.ndarray:
    """Return the sum of |value|^2 of each row, float64."""
    return np.einsum("rb,rb->r", rows.real, rows.real, dtype=np.float64) + np.einsum(
        "rb,rb->r", rows.imag, rows.imag, dtype=np.float64
    )
