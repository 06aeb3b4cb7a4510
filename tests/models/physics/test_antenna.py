"""Patterns against theory; the co-array against the pattern it must reproduce."""

from __future__ import annotations

import numpy as np
import pytest

from models.physics.antenna import (
    coarray_weights,
    column_response,
    coupling_matrix,
    element_field,
    one_way_pattern,
    row_field,
    setup_weights,
    steering_weights,
    two_way_pattern,
)
from msgs.values.radar import ArrayParams, ElementPattern, RadarSetup

WAVELENGTH_M = 0.03
HORIZON = np.zeros(1)


def test_element_pattern() -> None:
    """Section 2.1.1: 4.1 dBi peak, -3 dB at +-40 deg azimuth and +-30 deg elevation, floor -25 dB, nothing backward."""
    element = ElementPattern()
    azimuth_rad = np.radians([0.0, 40.0, 0.0, 89.0, 120.0])
    elevation_rad = np.radians([0.0, 0.0, 30.0, 60.0, 0.0])
    field = element_field(element, azimuth_rad, elevation_rad)
    gain_db = 20.0 * np.log10(field[:4])
    assert gain_db == pytest.approx([4.1, 1.1, 1.1, 4.1 - 25.0], abs=1e-9)
    assert field[4] == 0.0


def test_boresight_gain_is_all_elements_twice() -> None:
    """(32 elements x 4.1 dBi) squared = 38.3 dB; exact."""
    setup = RadarSetup()
    pattern = two_way_pattern(setup, setup_weights(setup), HORIZON, HORIZON)
    assert 10 * np.log10(np.abs(pattern[12, 0]) ** 2) == pytest.approx(2 * (10 * np.log10(32) + 4.1), abs=1e-9)


def test_one_way_beam_width() -> None:
    """0.886 lambda / (N d) = 12.7 deg for 8 columns; the array factor's half-power width within 1 %."""
    array = ArrayParams(phase_bits=0)
    weights = steering_weights(array, WAVELENGTH_M, HORIZON)
    azimuth_rad = np.radians(np.linspace(-15, 15, 30001))
    power = np.abs(weights @ column_response(array, WAVELENGTH_M, azimuth_rad, np.zeros(30001)).T)[0] ** 2
    inside = azimuth_rad[power >= power.max() / 2]
    assert np.degrees(np.ptp(inside)) == pytest.approx(12.7, rel=0.015)


@pytest.mark.parametrize("centred", [False, True])
def test_six_bit_phases(centred: bool) -> None:
    """Phases on multiples of 5.625 deg relative to column 0, never more than 2.8 deg from the ideal ones; counted from
    the middle, beams to left and right are mirrored.
    """
    steer_rad = np.radians(np.arange(-60, 61, 5.0))
    ideal = steering_weights(ArrayParams(phase_bits=0), WAVELENGTH_M, steer_rad)
    quantised = steering_weights(ArrayParams(phase_bits=6, phases_from_centre=centred), WAVELENGTH_M, steer_rad)
    assert np.array_equal(quantised[::-1], quantised[:, ::-1]) == centred
    relative_deg = np.degrees(np.angle(quantised / quantised[:, :1]))
    np.testing.assert_allclose(relative_deg / 5.625, np.round(relative_deg / 5.625), atol=1e-6)
    assert np.degrees(np.abs(np.angle(quantised / ideal))).max() <= 5.625 / 2 + 1e-9


def test_steering_points_where_it_says() -> None:
    """Ideal weights put the one-way peak on the steering azimuth, both signs: columns stand towards +y (left)."""
    array = ArrayParams(phase_bits=0)
    steer_rad = np.radians([-50.0, -20.0, 35.0])
    azimuth_rad = np.radians(np.linspace(-60, 60, 2401))
    response = column_response(array, WAVELENGTH_M, azimuth_rad, np.zeros(2401))
    peak_rad = azimuth_rad[np.abs(steering_weights(array, WAVELENGTH_M, steer_rad) @ response.T).argmax(axis=1)]
    np.testing.assert_allclose(peak_rad, steer_rad, atol=np.radians(0.051))
    # a target on the left is nearer to the last column: its physical phase there leads
    assert np.angle(column_response(array, WAVELENGTH_M, np.array([0.1]), HORIZON))[0, -1] > 0.0


def test_rows_gather_power() -> None:
    assert row_field(ArrayParams(), WAVELENGTH_M, HORIZON)[0] == pytest.approx(2.0)


def test_two_way_pattern_lives_on_the_coarray() -> None:
    """(w.a)^2 = sum_m (w*w)_m exp(j k d (m - 7) sin az): 15 coefficients say it all; exact."""
    setup = RadarSetup(element=ElementPattern(azimuth_hpbw_deg=1e9, elevation_hpbw_deg=1e9, peak_gain_dbi=0.0))
    weights = setup_weights(setup)
    azimuth_rad = np.radians(np.linspace(-60, 60, 97))
    pattern = two_way_pattern(setup, weights, azimuth_rad, np.zeros(97))
    virtual = np.exp(1j * np.pi * np.multiply.outer(np.sin(azimuth_rad), np.arange(15) - 7))
    np.testing.assert_allclose(pattern, coarray_weights(weights) @ virtual.T * setup.array.rows / 8, atol=1e-9)


def test_squint_points_the_beam_elsewhere() -> None:
    """At f phase shifters point to sin(a) = sin(60) f_c / f: 56.8 and 63.8 deg at +-3.5 %; peak to 0.1 deg.

    Columns and rows both stretch: at 10 deg elevation two rows' worth of phase grows with f as well.
    """
    array = ArrayParams(phase_bits=0)
    weights = steering_weights(array, WAVELENGTH_M, np.radians([60.0]))
    azimuth_rad = np.radians(np.linspace(50.0, 70.0, 2001))
    for ratio, expected_deg in ((1.035, 56.80), (1.0, 60.0), (0.965, 63.82)):
        response = column_response(array, WAVELENGTH_M, azimuth_rad, np.zeros(2001), ratio)
        peak = np.abs(weights @ response.T)[0].argmax()
        assert np.degrees(azimuth_rad[peak]) == pytest.approx(expected_deg, abs=0.1)
    up_rad = np.radians([10.0])
    phases = np.pi * 1.035 * np.sin(up_rad) * np.array([-1.5, -0.5, 0.5, 1.5])
    assert row_field(array, WAVELENGTH_M, up_rad, 1.035)[0] == pytest.approx(np.cos(phases).sum() / 2.0, rel=1e-12)


def test_a_ratio_for_every_direction() -> None:
    """One call with ratios per direction equals one call per ratio."""
    setup = RadarSetup()
    azimuth_rad, ratios = np.radians([-40.0, 3.0, 57.0]), np.array([0.965, 1.0, 1.02])
    together = one_way_pattern(setup, setup_weights(setup), azimuth_rad, np.full(3, 0.1), ratios)
    for index, ratio in enumerate(ratios):
        alone = one_way_pattern(setup, setup_weights(setup), azimuth_rad[index : index + 1], np.full(1, 0.1), ratio)
        np.testing.assert_allclose(together[:, index], alone[:, 0], rtol=1e-12, atol=1e-12)


def test_two_ways_take_two_patterns() -> None:
    """Out at one direction, back at another: the product of both one-way patterns; the same ones: its square."""
    setup = RadarSetup()
    weights = setup_weights(setup)
    back, out = (np.radians([20.0, -30.0]), np.radians([2.0, 0.0])), (np.radians([-25.0, 10.0]), np.radians([0.0, 5.0]))
    product = one_way_pattern(setup, weights, *back) * one_way_pattern(setup, weights, *out)
    np.testing.assert_allclose(two_way_pattern(setup, weights, *back, *out), product, rtol=1e-12)
    swapped = two_way_pattern(setup, weights, *out, *back)
    np.testing.assert_allclose(swapped, product, rtol=1e-12)
    square = one_way_pattern(setup, weights, *back) ** 2
    np.testing.assert_array_equal(two_way_pattern(setup, weights, *back), square)
    np.testing.assert_allclose(two_way_pattern(setup, weights, *back, *back), square, rtol=1e-12)


def test_coupling_spreads_each_column_over_its_neighbours() -> None:
    """-20 dB at 90 deg: 0.1j to the next column, -0.01 to the one after; symmetric.

    Closed form for two columns at broadside: both are fed 1 + c, so the one-way field grows by 1 + c; out of phase
    (steered to 90 deg) it shrinks to 1 - c.
    """
    matrix = coupling_matrix(4, -20.0, np.pi / 2)
    np.testing.assert_allclose(matrix[0], [1.0, 0.1j, -0.01, -0.001j], atol=1e-12)
    np.testing.assert_array_equal(matrix, matrix.T)
    setup = RadarSetup(array=ArrayParams(columns=2, rows=1, phase_bits=0))
    pair = coupling_matrix(2, -20.0, np.pi / 2)
    ahead = np.zeros(1)
    for weights, factor in ((np.ones((1, 2)), 1.0 + 0.1j), (np.array([[1.0, -1.0]]), 1.0 - 0.1j)):
        azimuth_rad = ahead if weights[0, 1] > 0 else np.array([1.5])
        plain = one_way_pattern(setup, weights, azimuth_rad, ahead)
        coupled = one_way_pattern(setup, weights, azimuth_rad, ahead, coupling=pair)
        np.testing.assert_allclose(coupled, factor * plain, rtol=1e-12)
