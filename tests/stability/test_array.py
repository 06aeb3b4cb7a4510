"""Hard cases of the array: ill-conditioned beam sets, gaps, dead and repeated beams."""

from __future__ import annotations

from collections.abc import Callable

import mpmath
import numpy as np
import pytest

from benchmarks.perception.cramer_rao import _TANGENTS, azimuth_response, windowed_bound
from models.perception.form.coarray import MODEL_ERROR, AzimuthInterpolator, beam_matrix, ideal_beams
from models.perception.mirrors.observability import VisibilityParams, observability
from models.physics.antenna import coupling_matrix, one_way_pattern, setup_weights, two_way_pattern
from models.physics.waveform import tone_profile, window_covariance
from msgs.values.perception import BevGrid, Visibility, Wall
from msgs.values.radar import ArrayParams, BeamGrid, RadarSetup, RangeAzimuthGrid
from tests.stability.catalogue import Errors

GRID = RangeAzimuthGrid()
#: Bins of the range profiles that bounds are asked for, about bin 100.
BINS = np.arange(97, 104)
NOISE_MW = 1e-12


def _coefficients(azimuth_deg: float) -> np.ndarray:
    return np.exp(-1j * np.pi * (np.arange(15) - 7) * np.sin(np.radians(azimuth_deg)))


def _profiles(setup: RadarSetup, azimuth_deg: float) -> np.ndarray:
    return (beam_matrix(setup) @ _coefficients(azimuth_deg)).astype(np.complex64)[:, None]


def _least_squares_gain(setup: RadarSetup, missing: tuple[int, ...] = ()) -> float:
    """Noise power of the worst cell over a beam's, in dB, by least squares (of least norm under 15 beams)."""
    present = [beam for beam in range(len(setup.beams)) if beam not in missing]
    beams = beam_matrix(setup)[present]
    adjoint = beams.conj().T
    try:
        if len(beams) < beams.shape[1]:
            inverse = adjoint @ np.linalg.inv(beams @ adjoint)
        else:
            inverse = np.linalg.inv(adjoint @ beams) @ adjoint
    except np.linalg.LinAlgError:
        return np.inf
    return float(10.0 * np.log10(np.sum(np.abs(ideal_beams(setup, GRID.azimuth_rad) @ inverse) ** 2, axis=1).max()))


def _noise_gain(setup: RadarSetup, missing: tuple[int, ...] = ()) -> float:
    """The same by the interpolator: what it makes of each beam alone."""
    alone = np.eye(len(setup.beams), dtype=np.complex64)
    values, _ = AzimuthInterpolator(setup, GRID).interpolate(alone, np.inf, missing)
    return float(10.0 * np.log10(np.sum(np.abs(values) ** 2, axis=0).max()))


@pytest.mark.hard("models.perception.form.coarray", "least squares on the beams that came", 4.0, "dB",
                  "ridge: no cell above 2.5 times a beam's noise")  # fmt: skip
def test_a_gap_of_three_beams(errors: Errors) -> None:
    """Beams 11 to 13 missing: exact without noise, but in the gap noise shouts. Worst cell over a beam's noise."""
    missing = (11, 12, 13)
    errors(naive=_least_squares_gain(RadarSetup(), missing), ours=_noise_gain(RadarSetup(), missing))


@pytest.mark.hard("models.perception.form.coarray", "least squares", 4.0, "dB",
                  "ridge: no cell above 2.5 times a beam's noise")  # fmt: skip
@pytest.mark.parametrize(
    "azimuth_deg",
    [(0.0, 0.0, 0.0), (-1.0, -0.5, 0.0, 0.5, 1.0), tuple(np.linspace(80.0, 89.9, 25))],
    ids=["thrice the same", "five in one beam width", "all at endfire"],
)
def test_beams_that_repeat_one_another(azimuth_deg: tuple[float, ...], errors: Errors) -> None:
    """Rows all but equal: their differences are noise, and least squares lives on them. Worst cell over a beam's."""
    setup = RadarSetup(beams=BeamGrid(azimuth_deg=azimuth_deg))
    errors(naive=_least_squares_gain(setup), ours=_noise_gain(setup))


@pytest.mark.parametrize(
    "azimuth_deg",
    [(0.0,), (0.0, 0.0, 0.0), (-1.0, -0.5, 0.0, 0.5, 1.0), tuple(np.linspace(-89.0, 89.0, 25)), (10.0,) * 25],
    ids=["one beam", "thrice the same", "all in one beam width", "to the horizon", "25 times the same"],
)
def test_beam_sets_that_cannot_be_inverted(azimuth_deg: tuple[float, ...]) -> None:
    setup = RadarSetup(beams=BeamGrid(azimuth_deg=azimuth_deg))
    interpolator = AzimuthInterpolator(setup, GRID)
    values, _ = interpolator.interpolate(_profiles(setup, 0.0), 1e-6)
    magnitudes = interpolator.interpolate_magnitude(np.abs(_profiles(setup, 0.0)))
    assert np.isfinite(values).all()
    assert np.isfinite(magnitudes).all()
    # an ideal beam measures 8: nothing invented far beyond it
    assert np.abs(values).max() <= 8.0 * 1.6
    assert interpolator.noise_gain() <= 2.5


def test_no_beam_at_all_is_an_empty_map() -> None:
    values, incoherent = AzimuthInterpolator(RadarSetup(), GRID).interpolate(
        np.zeros((25, 4), np.complex64), 1.0, tuple(range(25))
    )
    assert not values.any()
    assert not incoherent.any()


def test_a_dead_beam_does_not_reach_far() -> None:
    """Beam 12 delivers zeros: the fit sees it, turns to magnitudes, and a target 30 deg away keeps place and level."""
    setup = RadarSetup()
    profiles = _profiles(setup, 20.0) + _profiles(setup, -30.0)
    profiles[16] = 0.0
    values, incoherent = AzimuthInterpolator(setup, GRID).interpolate(profiles, 1e-6)
    assert incoherent.all()
    left = np.abs(values[0]) * (GRID.azimuth_rad < np.radians(-20.0))
    assert np.degrees(GRID.azimuth_rad[left.argmax()]) == pytest.approx(-30.0, abs=1.0)
    assert left.max() == pytest.approx(8.0, rel=0.1)


@pytest.mark.hard("models.perception.form.coarray", "exact phases assumed", 2e-5, "",
                  "ridge of 1e-7 over least singular values squared of 6e-3")  # fmt: skip
@pytest.mark.parametrize("bits", [2, 6])
def test_quantised_phases(bits: int, errors: Errors) -> None:
    """Beams of phases rounded to so many bits are no ideal beams; relative error of the map of one target."""
    setup = RadarSetup(array=ArrayParams(phase_bits=bits))
    exact = ideal_beams(setup, GRID.azimuth_rad) @ _coefficients(12.0)
    profiles = _profiles(setup, 12.0)

    def error(assumed: RadarSetup) -> float:
        values, _ = AzimuthInterpolator(assumed, GRID).interpolate(profiles, np.inf)
        return float(np.linalg.norm(values[0] - exact) / np.linalg.norm(exact))

    errors(naive=error(RadarSetup(array=ArrayParams(phase_bits=0))), ours=error(setup))


@pytest.mark.hard("models.perception.form.coarray", "energies summed in float32", 0.0, "of movers",
                  "float64 holds 1e-46: every mover without noise is found")  # fmt: skip
def test_movers_in_tiny_units(errors: Errors) -> None:
    """Amplitudes of 1e-23: |y|^2 is below the least float32, no residual exceeds anything. Share not found."""
    setup = RadarSetup()
    interpolator = AzimuthInterpolator(setup, GRID)
    turns = np.multiply.outer(np.arange(25), np.linspace(0.1, 0.5, 9))
    profiles = (1e-23 * _profiles(setup, 10.0) * np.exp(2j * np.pi * turns)).astype(np.complex64)
    _, incoherent = interpolator.interpolate(profiles, 0.0)
    beams = beam_matrix(setup)
    left = (profiles - beams @ np.linalg.pinv(beams) @ profiles).astype(np.complex64)
    energy, whole = (np.sum(part.real**2 + part.imag**2, axis=0) for part in (left, profiles))
    naive = energy > MODEL_ERROR * whole
    assert energy.dtype == np.float32
    errors(naive=1.0 - naive.mean(), ours=1.0 - incoherent.mean())


@pytest.mark.parametrize("scale", [1e-18, 1e-9, 1.0, 1e9, 1e15])
def test_levels_from_attowatts_to_absurd_scale_exactly(scale: float) -> None:
    """Float32 holds |y|^2 down to 1e-38: energies are summed in float64, so tiny scenes are judged like large ones."""
    setup = RadarSetup()
    interpolator = AzimuthInterpolator(setup, GRID)
    moving = _profiles(setup, 10.0) * np.exp(1j * 3.0 * np.arange(25))[:, None].astype(np.complex64)
    for profiles, expected in ((_profiles(setup, 10.0), False), (moving, True)):
        values, incoherent = interpolator.interpolate((scale * profiles).astype(np.complex64), 1e-6 * scale**2)
        reference, _ = interpolator.interpolate(profiles, 1e-6)
        assert incoherent.all() == expected
        np.testing.assert_allclose(values, scale * reference, atol=1e-5 * scale * 8.0, rtol=1e-5)


def test_quantised_to_one_bit_still_inverts() -> None:
    """One-bit phases are beams unlike any ideal one; knowing them is enough inside the scan."""
    setup = RadarSetup(array=ArrayParams(phase_bits=1))
    values, incoherent = AzimuthInterpolator(setup, GRID).interpolate(_profiles(setup, 12.0), 0.0)
    naive = np.argmax(np.abs(_profiles(setup, 12.0)[:, 0]))
    assert not incoherent.any()
    assert np.degrees(GRID.azimuth_rad[np.abs(values[0]).argmax()]) == pytest.approx(12.0, abs=0.5)
    assert abs(setup.beams.azimuth_deg[naive] - 12.0) >= 2.0


@pytest.mark.parametrize("ratio", [1e-3, 0.5, 2.0, 20.0])
def test_patterns_far_from_the_carrier_stay_bounded(ratio: float) -> None:
    """Grating lobes or none: no direction takes more than all columns and rows in phase."""
    setup = RadarSetup()
    azimuth_rad = np.radians(np.linspace(-180.0, 180.0, 721))
    pattern = two_way_pattern(setup, setup_weights(setup), azimuth_rad, np.full(721, 0.2), frequency_ratio=ratio)
    assert np.isfinite(pattern).all()
    assert np.abs(pattern).max() <= 32.0 * 10.0 ** (2 * 4.1 / 20.0) * (1.0 + 1e-12)


def test_total_coupling_leaves_one_pattern() -> None:
    """0 dB: every column is fed the sum of all; every beam is broadside's, scaled by its own sum; nothing blows up."""
    setup = RadarSetup()
    azimuth_rad = np.radians(np.linspace(-80.0, 80.0, 33))
    weights = setup_weights(setup)
    one_way = one_way_pattern(setup, weights, azimuth_rad, np.zeros(33), coupling=coupling_matrix(8, 0.0))
    ahead = one_way_pattern(setup, np.ones((1, 8)), azimuth_rad, np.zeros(33))
    np.testing.assert_allclose(one_way, weights.sum(axis=1)[:, None] * ahead, atol=1e-9)


def _parts(
    response: Callable[[np.ndarray], np.ndarray], at: np.ndarray, step: float = 1e-4
) -> tuple[np.ndarray, np.ndarray]:
    """Value and central difference of a response, [P, ...] each, with the step of the bounds."""
    before, here, after = (response(at + k * step) for k in (-1, 0, 1))
    return here, (after - before) / (2.0 * step)


def _tangent_parts(azimuth_rad: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Range and azimuth parts of echoes on bin 100, as `windowed_bound` takes them."""
    setup, at = RadarSetup(), np.full(len(azimuth_rad), 100.0)
    white = np.linalg.inv(np.linalg.cholesky(window_covariance("hann", len(BINS))))
    tones = _parts(lambda q: tone_profile(setup.radar.samples_per_chirp, q, len(BINS), "hann", int(BINS[0])), at)
    return np.stack(tones) @ white.T, np.stack(_parts(lambda a: azimuth_response(setup, a), azimuth_rad))


def _exact_azimuth_variance(range_parts: np.ndarray, azimuth_parts: np.ndarray, amplitude: np.ndarray) -> np.ndarray:
    """Azimuth variances [P] from the same parts, their information made and inverted with 60 digits."""
    count = len(amplitude)
    with mpmath.workdps(60):
        exact = [[mpmath.matrix(one.tolist()) for one in parts] for parts in (range_parts, azimuth_parts)]
        gram = [
            [[left.apply(mpmath.conj) * right.T for right in parts] for left in parts] for parts in exact
        ]  # fmt: skip
        tangents = [
            (q, a, mpmath.mpmathify(f if q == a == 0 else complex(amplitude[p])), p)
            for q, a, f in ((0, 0, 1.0), (0, 0, 1j), (1, 0, 1.0), (0, 1, 1.0))
            for p in range(count)
        ]
        information = mpmath.matrix(4 * count, 4 * count)
        for row, (q, a, left, i) in enumerate(tangents):
            for column, (p, b, right, j) in enumerate(tangents):
                product = mpmath.conj(left) * right * gram[0][q][p][i, j] * gram[1][a][b][i, j]
                information[row, column] = 2 * mpmath.re(product)
        covariance = information**-1
        return np.array([float(covariance[3 * count + p, 3 * count + p]) for p in range(count)])


def fisher_information(range_parts: np.ndarray, azimuth_parts: np.ndarray, amplitude: np.ndarray) -> np.ndarray:
    """Return the information [4P, 4P] at unit noise, ordered Re a, Im a, range, azimuth of all P echoes each.

    Parts are value and slope, complex [2, P, rows] and [2, P, beams].
    """
    in_range = np.einsum("kim,ljm->klij", range_parts.conj(), range_parts)
    in_azimuth = np.einsum("kim,ljm->klij", azimuth_parts.conj(), azimuth_parts)
    factor = [np.full(len(amplitude), f) if k < 2 else amplitude for k, (_, _, f) in enumerate(_TANGENTS)]
    blocks = [
        [
            2.0 * np.real(np.multiply.outer(left.conj(), right) * in_range[q, p] * in_azimuth[a, b])
            for (p, b, _), right in zip(_TANGENTS, factor, strict=True)
        ]
        for (q, a, _), left in zip(_TANGENTS, factor, strict=True)
    ]
    return np.block(blocks)


@pytest.mark.hard("benchmarks.perception.cramer_rao", "inverse of the information matrix", 1e-7, "",
                  "2^-52 times condition 1.8e8 of the matrix' root, twice for a variance")  # fmt: skip
def test_two_echoes_a_thousandth_of_a_degree_apart(errors: Errors) -> None:
    """The variance of their azimuths is huge, and comes out negative where squares are inverted. Relative error."""
    azimuth_rad, amplitude = np.radians([0.0, 1e-3]), np.array([1e-5, 1e-5j])
    parts = _tangent_parts(azimuth_rad)
    scaled = amplitude / np.sqrt(NOISE_MW)
    exact = _exact_azimuth_variance(*parts, scaled)
    naive = np.linalg.inv(fisher_information(*parts, scaled)).diagonal()[-2:]
    ours = windowed_bound(RadarSetup(), np.full(2, 100.0), azimuth_rad, amplitude, NOISE_MW, BINS)[:, 1, 1]
    errors(naive=np.abs(naive / exact - 1.0).max(), ours=np.abs(ours / exact - 1.0).max())


@pytest.mark.hard("benchmarks.perception.cramer_rao", "beam width over sqrt(2 SNR)", 1e-6, "",
                  "central difference: rounding 1e-16 over h cos = 6e-8")  # fmt: skip
def test_a_bound_that_grows_towards_endfire(errors: Errors) -> None:
    """89.999 deg: sines no longer tell angles apart, an error 57,000 times the sine's. Relative error of sigma."""
    setup, azimuth_rad, amplitude = RadarSetup(), np.radians([89.999]), np.array([1e-5])
    range_parts, azimuth_parts = _tangent_parts(azimuth_rad)
    # in the sine instead of the angle all is plain: slope with respect to it, in closed form
    position = np.arange(15) - 7
    phases = np.exp(-1j * np.pi * position * np.sin(azimuth_rad))
    slope = (beam_matrix(setup) / 8.0) @ (-1j * np.pi * position * phases)
    in_sine = np.stack([azimuth_parts[0], slope[None]])
    information = fisher_information(range_parts, in_sine, amplitude / np.sqrt(NOISE_MW))
    with mpmath.workdps(30):
        cosine = float(mpmath.cos(mpmath.mpf(azimuth_rad[0])))
    exact = np.sqrt(np.linalg.inv(information)[3, 3]) / cosine
    snr = np.sum(np.abs(azimuth_parts[0]) ** 2) * amplitude[0] ** 2 / NOISE_MW
    naive = np.radians(12.7) / np.sqrt(2.0 * snr)
    ours = np.sqrt(windowed_bound(setup, np.array([100.0]), azimuth_rad, amplitude, NOISE_MW, BINS)[0, 1, 1])
    errors(naive=abs(naive / exact - 1.0), ours=abs(ours / exact - 1.0))


def test_what_no_sample_tells_has_no_finite_bound() -> None:
    """At endfire itself, and without an echo: infinite, not an exception, and no burden to the echo beside."""
    setup = RadarSetup()
    alone = windowed_bound(setup, np.array([100.0]), np.array([0.1]), np.array([1e-5]), NOISE_MW, BINS)
    for azimuth_rad, amplitude in ((0.5 * np.pi, 1e-5), (0.3, 0.0)):
        both = np.array([0.1, azimuth_rad]), np.array([1e-5, amplitude])
        bound = windowed_bound(setup, np.array([100.0, 120.0]), *both, NOISE_MW, BINS)
        assert np.isinf(bound[1, 1, 1])
        assert (np.diagonal(bound[0]) >= np.diagonal(alone[0]) * (1.0 - 1e-9)).all()
    # one beam and three bins know less than two echoes ask for
    single = RadarSetup(beams=BeamGrid(azimuth_deg=(0.0,)))
    bound = windowed_bound(single, np.full(2, 100.0), np.array([0.0, 0.1]), np.ones(2), 1.0, BINS[2:5])
    assert (bound[:, 1, 1] > 1e20).all()


@pytest.mark.hard("models.perception.mirrors.observability", "both cross products on the wedge's side", 0.0,
                  "of the cells in sight", "a wall seen edge-on hides nothing")  # fmt: skip
def test_radar_on_the_line_of_a_wall(errors: Errors) -> None:
    """The wedge behind the wall has no width and no side: 0 >= 0 lets every cell pass. Share of cells lost."""
    grid, params = BevGrid(), VisibilityParams()
    a, b = (5.0, 0.0), (20.0, 0.0)
    wall = Wall(normal=(0.0, 1.0), offset_m=0.0, ends_m=(a, b), inliers=9)
    free, masked = (observability(walls, 110.0, grid, params) == Visibility.DIRECT for walls in ([], [wall]))
    x, y = np.moveaxis(grid.cell_centres_m().reshape(*free.shape, 2), -1, 0)
    turn = np.sign(a[0] * b[1] - a[1] * b[0])
    behind = (y < 0.0) & (turn * (a[0] * y - a[1] * x) >= 0.0) & (turn * (x * b[1] - y * b[0]) >= 0.0)
    errors(naive=(free & behind).sum() / free.sum(), ours=(free & ~masked).sum() / free.sum())
