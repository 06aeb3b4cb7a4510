"""Co-array interpolation against the exact patterns of the steered array.

Layout: 25 beams of the 8-column array, -60..60 deg, 6-bit phases; point targets in the far field, on the horizon.
A target of amplitude a at azimuth A must leave a D(sin az - sin A) in the map, D the two-way pattern of an ideal
array (D(0) = 8, power normalised): what an ideal beam steered to az would have measured.
"""

from __future__ import annotations

import numpy as np
import pytest

from models.perception.form import coarray
from models.perception.form.coarray import AzimuthInterpolator, beam_matrix, ideal_beams
from models.physics.antenna import element_field, row_field, setup_weights, steering_weights, two_way_pattern
from msgs.values.radar import ArrayParams, BeamGrid, RadarSetup, RangeAzimuthGrid

SETUP = RadarSetup()
GRID = RangeAzimuthGrid()
BEAM_INTERVAL_S = 0.012


def _recorded_beams(setup: RadarSetup, azimuth_rad: np.ndarray, weights: np.ndarray | None = None) -> np.ndarray:
    """Recorded (conjugate) pattern of each beam without element and row gains; complex64 [beams, targets]."""
    level = np.zeros_like(azimuth_rad)
    pattern = two_way_pattern(setup, setup_weights(setup) if weights is None else weights, azimuth_rad, level)
    gain = element_field(setup.element, azimuth_rad, level) * row_field(setup.array, setup.radar.wavelength_m, level)
    return (pattern.conj() / gain**2).astype(np.complex64)


def _ideal_map(setup: RadarSetup, grid: RangeAzimuthGrid, azimuth_rad: np.ndarray) -> np.ndarray:
    """Pattern of ideal beams steered to each azimuth of the grid; float64 [targets, azimuth]."""
    array = ArrayParams(columns=setup.array.columns, column_spacing_m=setup.array.column_spacing_m, phase_bits=0)
    ideal = RadarSetup(array=array, beams=setup.beams)
    weights = steering_weights(array, setup.radar.wavelength_m, grid.azimuth_rad)
    return _recorded_beams(ideal, azimuth_rad, weights).T


def _noise(shape: tuple[int, ...], seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return ((rng.normal(size=shape) + 1j * rng.normal(size=shape)) / np.sqrt(2.0)).astype(np.complex64)


def test_beam_matrix_is_the_recorded_two_way_pattern() -> None:
    azimuth_rad = np.radians([-47.0, 0.0, 13.3, 58.0])
    position = np.arange(15) - 7
    coefficients = np.exp(-1j * np.pi * np.multiply.outer(position, np.sin(azimuth_rad)))
    np.testing.assert_allclose(beam_matrix(SETUP) @ coefficients, _recorded_beams(SETUP, azimuth_rad), atol=2e-6)


def test_ideal_beam_at_the_target_measures_the_column_count() -> None:
    azimuth_rad = np.radians([-50.0, 0.0, 31.0])
    coefficients = np.exp(-1j * np.pi * np.multiply.outer(np.arange(15) - 7, np.sin(azimuth_rad)))
    np.testing.assert_allclose(np.diag(ideal_beams(SETUP, azimuth_rad) @ coefficients), 8.0, rtol=1e-12)


def test_static_point_against_the_exact_pattern() -> None:
    """Known bias: the ridge of 1e-7 (7e-7 of the peak) and float32. Tolerance: 1e-4 of the peak inside +-50 deg."""
    azimuth_rad = np.radians(np.linspace(-50.0, 50.0, 101))
    values, incoherent = AzimuthInterpolator(SETUP, GRID).interpolate(_recorded_beams(SETUP, azimuth_rad), 0.0)
    inside = np.abs(np.degrees(GRID.azimuth_rad)) <= 50.0
    error = np.abs(values - _ideal_map(SETUP, GRID, azimuth_rad))[:, inside]
    assert error.max() <= 1e-4 * 8.0
    assert not incoherent.any()


@pytest.mark.parametrize(
    "setup",
    [
        RadarSetup(array=ArrayParams(columns=4, phase_bits=3)),
        RadarSetup(array=ArrayParams(phase_bits=0)),
        RadarSetup(beams=BeamGrid(azimuth_deg=tuple(range(60, -61, -5)))),
        RadarSetup(beams=BeamGrid(azimuth_deg=(*np.linspace(-60, 60, 31), 0.0, 0.0))),
    ],
    ids=["4 columns, 3 bits", "ideal phases", "right to left", "31 beams and two repeated"],
)
def test_other_arrays_and_orders(setup: RadarSetup) -> None:
    azimuth_rad = np.radians([-41.0, 3.0, 27.5])
    values, incoherent = AzimuthInterpolator(setup, GRID).interpolate(_recorded_beams(setup, azimuth_rad), 0.0)
    np.testing.assert_allclose(values, _ideal_map(setup, GRID, azimuth_rad), atol=1e-4 * setup.array.columns)
    assert not incoherent.any()


@pytest.mark.parametrize("azimuth_deg", [range(-60, 61, 5), range(60, -61, -5)], ids=["to the left", "to the right"])
def test_beams_of_a_turning_radar_are_steered_back(azimuth_deg: range) -> None:
    """Each beam looked 0.15 deg further left than the one before: as at 12 deg/s, 3.6 deg over the scan.

    The beams are those of a point that seems to drift the other way, and stay coherent. Known bias: they lie 3 % closer
    or wider in the world than the array's pattern is known for, 0.3 deg at 45 deg. Tolerance: that.
    """
    setup = RadarSetup(beams=BeamGrid(azimuth_deg=tuple(azimuth_deg)))
    point_rad = np.radians([-45.0, 0.0, 45.0])
    turned_rad = np.radians(0.15) * np.arange(25)
    each = [_recorded_beams(setup, point_rad - turned)[beam] for beam, turned in enumerate(turned_rad)]
    looks = np.repeat((setup.beams.azimuth_rad + turned_rad)[:, None], 3, axis=1)
    values, incoherent = AzimuthInterpolator(setup, GRID).interpolate(np.array(each), 0.0, (), looks)
    assert not incoherent.any()
    found_rad = GRID.azimuth_rad[np.abs(values).argmax(axis=1)]
    assert np.abs(np.degrees(found_rad - point_rad)).max() <= 0.3 + 0.25


def test_noise_gain_is_the_measured_one() -> None:
    """White noise of unit power on every beam; 2000 bins x 256 azimuths of ~13 independent: 1 % is 1.6 sigma."""
    interpolator = AzimuthInterpolator(SETUP, GRID)
    values, incoherent = interpolator.interpolate(_noise((25, 2000), seed=3), 1.0)
    assert np.mean(np.abs(values) ** 2) == pytest.approx(interpolator.noise_gain(), rel=0.03)
    assert interpolator.noise_gain() == pytest.approx(0.583, abs=0.002)
    assert incoherent.mean() <= 2e-3


@pytest.mark.parametrize("missing", [(12,), (0, 1, 2), (11, 12, 13), tuple(range(1, 25, 2)), tuple(range(1, 25))])
def test_missing_beams_never_amplify_noise_without_bound(missing: tuple[int, ...]) -> None:
    """Unregularised, three missing neighbours would raise noise by 19 to 25 dB at the gap."""
    interpolator = AzimuthInterpolator(SETUP, GRID)
    profiles = _noise((25, 400), seed=5)
    profiles[list(missing)] = np.nan
    values, _ = interpolator.interpolate(profiles, 1.0, missing)
    assert np.isfinite(values).all()
    assert np.mean(np.abs(values) ** 2, axis=0).max() <= 2.5 * 1.35


def test_one_missing_beam_hardly_matters() -> None:
    azimuth_rad = np.radians([2.0])
    values, _ = AzimuthInterpolator(SETUP, GRID).interpolate(_recorded_beams(SETUP, azimuth_rad), 1e-9, (12,))
    np.testing.assert_allclose(values, _ideal_map(SETUP, GRID, azimuth_rad), atol=0.03 * 8.0)


def test_moving_target_turns_to_magnitudes_and_keeps_place_and_level() -> None:
    """0.6 m/s turns the phase by half a circle from beam to beam: coherent interpolation would lose 16 dB and 10 deg.

    Magnitudes bear the 6-bit rounding unmodelled: level within 0.3 dB, place within half a degree.
    """
    azimuth_rad = np.radians(np.linspace(-45.0, 45.0, 19))
    turn_rad = 4.0 * np.pi / SETUP.radar.wavelength_m * 0.6 * BEAM_INTERVAL_S * np.arange(25)
    profiles = _recorded_beams(SETUP, azimuth_rad) * np.exp(1j * turn_rad)[:, None].astype(np.complex64)
    profiles += 0.08 * _noise(profiles.shape, seed=11)
    values, incoherent = AzimuthInterpolator(SETUP, GRID).interpolate(profiles, 0.08**2)
    assert incoherent.all()
    assert (values.imag == 0.0).all()
    assert (values.real >= 0.0).all()
    peak = np.argmax(values.real, axis=1)
    assert np.abs(np.degrees(GRID.azimuth_rad[peak] - azimuth_rad)).max() <= 0.5
    assert np.abs(20.0 * np.log10(values.real.max(axis=1) / 8.0)).max() <= 0.3


@pytest.mark.parametrize("snr_db", [0.0, 10.0, 20.0, 40.0, 60.0])
def test_static_scenes_stay_coherent(snr_db: float) -> None:
    """False alarms of two static targets a bin: 1e-4 by design; 2000 bins allow 4 (Poisson of 0.2: 1 in 10^5)."""
    rng = np.random.default_rng(17)
    azimuth_rad = np.radians(rng.uniform(-60.0, 60.0, (2, 2000)))
    phase = np.exp(2j * np.pi * rng.uniform(size=(2, 2000))).astype(np.complex64)
    profiles = sum(_recorded_beams(SETUP, azimuth_rad[i]) * phase[i] for i in range(2)) / 8.0
    profiles = (profiles * 10.0 ** (snr_db / 20.0)).astype(np.complex64) + _noise(profiles.shape, seed=19)
    _, incoherent = AzimuthInterpolator(SETUP, GRID).interpolate(profiles, 1.0)
    assert incoherent.sum() <= 4


def test_detection_of_movers() -> None:
    """Share of movers found at 20 dB over beam noise, over 0.3 .. 1 m/s; 1.249 m/s turns whole circles: harmless."""
    rng = np.random.default_rng(23)
    azimuth_rad = np.radians(rng.uniform(-50.0, 50.0, 1000))
    interpolator = AzimuthInterpolator(SETUP, GRID)
    found = {}
    for speed_mps in (0.3, 0.6, 1.0, SETUP.radar.wavelength_m / 2.0 / BEAM_INTERVAL_S):
        turn_rad = 4.0 * np.pi / SETUP.radar.wavelength_m * speed_mps * BEAM_INTERVAL_S * np.arange(25)
        profiles = _recorded_beams(SETUP, azimuth_rad) / 8.0 * np.exp(1j * turn_rad)[:, None] * 10.0
        profiles = profiles.astype(np.complex64) + _noise(profiles.shape, seed=29)
        found[round(speed_mps, 2)] = interpolator.interpolate(profiles, 1.0)[1].mean()
    assert found[0.3] >= 0.97
    assert found[0.6] == 1.0
    assert found[1.0] >= 0.9
    assert found[1.25] <= 0.01


def test_errors_of_the_array_model_are_no_movement(monkeypatch: pytest.MonkeyPatch) -> None:
    """A radar that rounds phases about the array's centre leaves -30 dB at worst, under the limit of -25 dB."""
    step_rad = np.pi * np.multiply.outer(np.sin(SETUP.beams.azimuth_rad), np.arange(8) - 3.5)
    least_rad = 2.0 * np.pi / 64
    foreign = np.exp(-1j * least_rad * np.round(step_rad / least_rad))
    profiles = _recorded_beams(SETUP, np.radians(np.linspace(-55.0, 55.0, 111)), foreign)
    noise_mw = 8.0**2 * 1e-6
    assert not AzimuthInterpolator(SETUP, GRID).interpolate(profiles, noise_mw)[1].any()
    exact = RadarSetup(array=ArrayParams(phase_bits=0))
    assert not AzimuthInterpolator(exact, GRID).interpolate(profiles, noise_mw)[1].any()
    monkeypatch.setattr(coarray, "MODEL_ERROR", 1e-6)
    assert AzimuthInterpolator(exact, GRID).interpolate(profiles, noise_mw)[1].all()


def test_paths_that_return_by_another_azimuth_are_no_movement() -> None:
    """Rounded phases leave up to 2.2 % of the energy of such a path outside of the co-array; exact ones nothing."""
    rng = np.random.default_rng(5)
    leave, come_back = rng.uniform(-0.95, 0.95, (2, 200))
    one_way = [
        np.exp(-1j * np.pi * np.outer(np.sin(angle), np.arange(8))) @ setup_weights(SETUP).conj().T
        for angle in (leave, come_back)
    ]
    profiles = (one_way[0] * one_way[1]).T.astype(np.complex64)
    beams = beam_matrix(SETUP)
    left = profiles - beams @ np.linalg.pinv(beams) @ profiles
    share = np.sum(np.abs(left) ** 2, axis=0) / np.sum(np.abs(profiles) ** 2, axis=0)
    assert 0.01 < share.max() < 0.022
    assert not AzimuthInterpolator(SETUP, GRID).interpolate(profiles, 0.0)[1].any()


def test_looks_of_a_displaced_radar_move_the_magnitudes() -> None:
    """Every beam is seen 2 deg further left: so is the target."""
    interpolator = AzimuthInterpolator(SETUP, GRID)
    magnitudes = np.abs(_recorded_beams(SETUP, np.radians([20.0])))
    looks = np.radians(2.0) + np.repeat(SETUP.beams.azimuth_rad[:, None], 1, axis=1)
    values = interpolator.interpolate_magnitude(magnitudes, (), looks)
    assert np.degrees(GRID.azimuth_rad[values[0].argmax()]) == pytest.approx(22.0, abs=0.5)
    assert values.max() == pytest.approx(8.0, rel=0.02)


def test_wrong_profiles_are_refused() -> None:
    with pytest.raises(ValueError, match=r"profiles must have shape 25x\?, got \(24, 512\)"):
        AzimuthInterpolator(SETUP, GRID).interpolate(np.zeros((24, 512), np.complex64), 1.0)


def test_what_no_beam_saw_stays_dark() -> None:
    """Only beams at -60..-15 deg came: nothing is invented beyond 7.5 deg from the last; a single gap is filled."""
    setup = RadarSetup()
    interpolator = AzimuthInterpolator(setup)
    profiles = np.ones((25, 4), np.complex64)
    azimuth_deg = np.degrees(interpolator.grid.azimuth_rad)
    values, _ = interpolator.interpolate(profiles, 1e-12, missing=tuple(range(10, 25)))
    assert not values[:, azimuth_deg > -7.5 + 0.01].any()
    assert values[:, azimuth_deg < -20.0].any()
    magnitudes = interpolator.interpolate_magnitude(np.abs(profiles), missing=tuple(range(10, 25)))
    assert not magnitudes[:, azimuth_deg > -7.5 + 0.01].any()
    filled, _ = interpolator.interpolate(profiles, 1e-12, missing=(12,))
    assert np.abs(filled).min(axis=0)[np.abs(azimuth_deg) < 5.0].min() > 0.0


def test_matrices_are_kept_of_so_many_sets_of_missing_beams_only() -> None:
    """There are 2^25 sets; a radar that loses beams by chance must not fill the memory with them."""
    interpolator = AzimuthInterpolator(RadarSetup(beams=BeamGrid(azimuth_deg=tuple(range(-35, 36, 10)))))
    first = interpolator.noise_gain((0,))
    for bits in range(1, 128):
        interpolator.noise_gain(tuple(beam for beam in range(7) if bits >> beam & 1))
    assert len(interpolator._inverses) <= 64
    assert interpolator.noise_gain((0,)) == first
