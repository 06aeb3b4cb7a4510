"""Arrays that steer receive alone: the interpolation lives on the N columns themselves, exact for a point target.

Layout: 25 beams of 8 columns, -60..60 deg, 7-bit phases, one fixed transmitter; point targets in the far field on the
horizon. A target of amplitude a at azimuth A must leave a D(sin az - sin A), D the one-way pattern of an ideal array
(D(0) = sqrt(8), power normalised).
"""

from __future__ import annotations

import msgspec
import numpy as np
import pytest

from benchmarks.perception.cramer_rao import azimuth_response
from models.perception.form.coarray import AzimuthInterpolator, beam_matrix, ideal_beams, peak_field
from models.perception.form.ra_forming import BeamFolder, FormingParams
from models.physics.antenna import element_field, one_way_pattern, row_field, setup_weights, two_way_pattern
from msgs.values.radar import ArrayParams, RadarParams, RadarSetup, RangeAzimuthGrid

SETUP = RadarSetup(array=ArrayParams(rows=1, phase_bits=7, steered_ways=1))
GRID = RangeAzimuthGrid()
AZIMUTH_RAD = np.radians(np.linspace(-50.0, 50.0, 101))


def recorded_beams(setup: RadarSetup, azimuth_rad: np.ndarray) -> np.ndarray:
    """Recorded (conjugate) pattern of each beam without element gains; complex64 [beams, targets]."""
    level = np.zeros_like(azimuth_rad)
    pattern = two_way_pattern(setup, setup_weights(setup), azimuth_rad, level)
    gain = element_field(setup.element, azimuth_rad, level) ** 2
    rows = row_field(setup.array, setup.radar.wavelength_m, level)
    return (pattern.conj() / (gain * rows)).astype(np.complex64)


def columns_of(azimuth_rad: np.ndarray) -> np.ndarray:
    """Unit echoes on the columns, complex128 [8, targets]."""
    return np.exp(-1j * np.pi * np.multiply.outer(np.arange(8) - 3.5, np.sin(azimuth_rad)))


def ideal_map(azimuth_rad: np.ndarray) -> np.ndarray:
    """Ideal one-way beams at each azimuth of the grid; [targets, azimuth]."""
    return np.asarray(columns_of(azimuth_rad).T @ columns_of(GRID.azimuth_rad).conj() / np.sqrt(8.0))


def test_beam_matrix_is_the_recorded_one_way_pattern() -> None:
    assert beam_matrix(SETUP).shape == (25, 8)
    expected = recorded_beams(SETUP, AZIMUTH_RAD)
    np.testing.assert_allclose(beam_matrix(SETUP) @ columns_of(AZIMUTH_RAD), expected, atol=2e-6)


def test_an_ideal_beam_at_the_target_holds_the_peak() -> None:
    at_target = np.diag(ideal_beams(SETUP, AZIMUTH_RAD) @ columns_of(AZIMUTH_RAD))
    np.testing.assert_allclose(at_target, np.sqrt(8.0), rtol=1e-12)
    assert peak_field(SETUP) == pytest.approx(np.sqrt(8.0))


def test_two_points_at_one_range_add_up_exactly() -> None:
    beams = recorded_beams(SETUP, np.radians([-12.0, 21.0])) @ np.array([[1.0], [0.3j]], np.complex64)
    values, _ = AzimuthInterpolator(SETUP, GRID).interpolate(beams, 0.0)
    expected = np.array([1.0, 0.3j]) @ ideal_map(np.radians([-12.0, 21.0]))
    assert np.abs(values[0] - expected).max() < 1e-5 * np.sqrt(8.0)


def test_beams_that_looked_elsewhere_are_steered_back() -> None:
    """All beams looked 2 deg to the left of their steering: the map is that of steering 2 deg to the right."""
    beams, turned_rad = recorded_beams(SETUP, AZIMUTH_RAD), np.radians(2.0)
    looks = np.repeat(SETUP.beams.azimuth_rad[:, None] + turned_rad, beams.shape[1], axis=1)
    values, incoherent = AzimuthInterpolator(SETUP, GRID).interpolate(beams, 0.0, (), looks)
    assert not incoherent.any()
    expected = columns_of(AZIMUTH_RAD).T @ columns_of(GRID.azimuth_rad - turned_rad).conj() / np.sqrt(8.0)
    assert np.abs(values - expected).max() < 1e-5 * np.sqrt(8.0)


def test_fewer_coefficients_leave_less_noise() -> None:
    """8 unknowns in 25 beams keep about 8/25 of a beam's noise in a cell; taken for a two-way array, twice that."""
    taken_for_two_way = msgspec.structs.replace(SETUP, array=msgspec.structs.replace(SETUP.array, steered_ways=2))
    assert AzimuthInterpolator(SETUP, GRID).noise_gain() == pytest.approx(8 / 25, abs=0.02)
    assert AzimuthInterpolator(taken_for_two_way, GRID).noise_gain() > 0.55


def test_incoherent_beams_are_interpolated_in_power() -> None:
    """Every beam with a phase of its own. Known bias: rounding of the 7-bit phases. Tolerance: 2 % of the peak."""
    turns = np.exp(2j * np.pi * np.random.default_rng(0).uniform(size=(25, 1))).astype(np.complex64)
    beams = recorded_beams(SETUP, AZIMUTH_RAD) * turns
    values, incoherent = AzimuthInterpolator(SETUP, GRID).interpolate(beams, 1e-9)
    assert incoherent.all()
    # over squares, not over magnitudes: the root is steep at the nulls
    error = np.abs(values.real**2 - np.abs(ideal_map(AZIMUTH_RAD)) ** 2).max()
    assert error < 0.02 * 8.0
    # the peak: 101 targets a degree apart, cells of 0.47 degree
    found = GRID.azimuth_at(values.real.argmax(axis=1))
    assert np.abs(found - AZIMUTH_RAD).max() < np.radians(1.0)


def test_the_response_of_the_bound_is_the_beam_matrix() -> None:
    expected = (beam_matrix(SETUP) @ columns_of(AZIMUTH_RAD)).T / peak_field(SETUP)
    np.testing.assert_allclose(azimuth_response(SETUP, AZIMUTH_RAD), expected, atol=1e-12)


def test_the_way_out_has_the_pattern_of_one_element() -> None:
    """Arrival at 20 deg, departure at -40 deg: the beams weigh the arrival, one element the departure."""
    arrival, departure, level = np.radians([20.0]), np.radians([-40.0]), np.zeros(1)
    weights = setup_weights(SETUP)
    pattern = two_way_pattern(SETUP, weights, arrival, level, departure, level)
    out = element_field(SETUP.element, departure, level)
    expected = one_way_pattern(SETUP, weights, arrival, level) * out
    np.testing.assert_allclose(pattern, expected, rtol=1e-12)


def test_rests_between_chirps_stretch_slow_time() -> None:
    """Two chirps of 5.5 us that start 20 us apart: the groups of the folder lie 20 us apart."""
    radar = RadarParams(chirps_per_beam=2, chirp_interval_s=20e-6)
    folder = BeamFolder(RadarSetup(radar=radar), FormingParams(), RangeAzimuthGrid())
    assert radar.beam_duration_s == pytest.approx(40e-6)
    np.testing.assert_allclose(np.diff(folder.group_time_s), 20e-6)


def test_wrong_values_are_refused() -> None:
    with pytest.raises(ValueError, match=r"array\.steered_ways must be 1 or 2, got 3"):
        ArrayParams(steered_ways=3)
    with pytest.raises(ValueError, match=r"radar\.chirp_interval_s must be finite and no shorter"):
        RadarParams(chirp_interval_s=1e-6)
    with pytest.raises(ValueError, match=r"radar\.chirp_interval_s must be finite and no shorter"):
        RadarParams(chirp_interval_s=float("nan"))
