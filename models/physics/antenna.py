"""Antenna: element pattern, steering weights as the phase shifters set them, two-way patterns, the co-array.

Columns stand along +y (left), rows along +z. A target at azimuth a, elevation e gives column n the physical phase
+k y_n sin(a) cos(e) (e^{+j w t}); steering to a_s sets exp(-j Q(k n d sin a_s)), Q rounding to the phase shifter's
steps. Positions are centred, so an ideal array has a real pattern.
"""

from __future__ import annotations

import numpy as np

from msgs.values.radar import ArrayParams, ElementPattern, RadarSetup


def element_field(element: ElementPattern, azimuth_rad: np.ndarray, elevation_rad: np.ndarray) -> np.ndarray:
    """Return the field pattern (root of the gain) of one element; zero in the backward hemisphere (section 2.1.1)."""
    azimuth_deg, elevation_deg = np.degrees(azimuth_rad), np.degrees(elevation_rad)
    level_db = -12.0 * (
        (azimuth_deg / element.azimuth_hpbw_deg) ** 2 + (elevation_deg / element.elevation_hpbw_deg) ** 2
    )
    gain_db = element.peak_gain_dbi + np.maximum(level_db, element.sidelobe_floor_db)
    return np.where(np.abs(azimuth_deg) < 90.0, 10.0 ** (gain_db / 20.0), 0.0)


def steering_weights(array: ArrayParams, wavelength_m: float, steer_azimuth_rad: np.ndarray) -> np.ndarray:
    """Return column weights of unit modulus, phases rounded to `phase_bits`; complex128 [beams, columns].

    A phase common to all columns of a beam is free, so the specification leaves open where rounding counts from.
    """
    step = 2.0 * np.pi / wavelength_m * array.column_spacing(wavelength_m)
    centre = (array.columns - 1) / 2.0
    first = -centre if array.phases_from_centre else 0.0
    phase_rad = step * np.multiply.outer(np.sin(steer_azimuth_rad), first + np.arange(array.columns))
    if array.phase_bits:
        least_rad = 2.0 * np.pi / 2**array.phase_bits
        phase_rad = least_rad * np.round(phase_rad / least_rad)
    # the common phase puts the reference at the array's centre
    common_rad = step * np.sin(steer_azimuth_rad)[..., None] * (first + centre)
    return np.exp(-1j * (phase_rad - common_rad))


def column_response(
    array: ArrayParams,
    wavelength_m: float,
    azimuth_rad: np.ndarray,
    elevation_rad: np.ndarray,
    frequency_ratio: float | np.ndarray = 1.0,
) -> np.ndarray:
    """Return phase of each column for plane waves, at f / f_c = `frequency_ratio`; complex128 [directions, columns]."""
    step = 2.0 * np.pi / wavelength_m * array.column_spacing(wavelength_m)
    position = np.arange(array.columns) - (array.columns - 1) / 2.0
    sine = frequency_ratio * (np.sin(azimuth_rad) * np.cos(elevation_rad))
    return np.exp(1j * step * np.multiply.outer(sine, position))


def row_field(
    array: ArrayParams, wavelength_m: float, elevation_rad: np.ndarray, frequency_ratio: float | np.ndarray = 1.0
) -> np.ndarray:
    """Return the field factor of the rows, steered to the horizon, power normalised; float64 [directions]."""
    step = 2.0 * np.pi / wavelength_m * array.row_spacing(wavelength_m)
    position = np.arange(array.rows) - (array.rows - 1) / 2.0
    phases = step * np.multiply.outer(frequency_ratio * np.sin(elevation_rad), position)
    return np.cos(phases).sum(axis=-1) / np.sqrt(array.rows)


def coupling_matrix(columns: int, coupling_db: float, coupling_phase_rad: float = 0.0) -> np.ndarray:
    """Return the mutual coupling (10^(dB/20) e^{j phase})^|m - n| of columns m and n; complex128 [columns, columns]."""
    per_column = 10.0 ** (coupling_db / 20.0) * np.exp(1j * coupling_phase_rad)
    index = np.arange(columns)
    return per_column ** np.abs(index[:, None] - index)


def one_way_pattern(
    setup: RadarSetup,
    weights: np.ndarray,
    azimuth_rad: np.ndarray,
    elevation_rad: np.ndarray,
    frequency_ratio: float | np.ndarray = 1.0,
    coupling: np.ndarray | None = None,
) -> np.ndarray:
    """Return the one-way field pattern of the whole array, element gain included; complex128 [beams, directions].

    At f = `frequency_ratio` f_c the physical phases scale, the phase shifters' do not: the beam squints to sin(a) =
    sin(a_s) / ratio. `coupling` [columns, columns] mixes the weights.
    """
    radar, array = setup.radar, setup.array
    response = column_response(array, radar.wavelength_m, azimuth_rad, elevation_rad, frequency_ratio)
    excitation = weights if coupling is None else weights @ coupling
    pattern = excitation @ response.T / np.sqrt(array.columns)
    directional = element_field(setup.element, azimuth_rad, elevation_rad) * row_field(
        array, radar.wavelength_m, elevation_rad, frequency_ratio
    )
    return pattern * directional


def two_way_pattern(
    setup: RadarSetup,
    weights: np.ndarray,
    azimuth_rad: np.ndarray,
    elevation_rad: np.ndarray,
    departure_azimuth_rad: np.ndarray | None = None,
    departure_elevation_rad: np.ndarray | None = None,
    frequency_ratio: float | np.ndarray = 1.0,
    coupling: np.ndarray | None = None,
) -> np.ndarray:
    """Return the physical B_t B_r of Eq. (1) with element gain, power normalised; complex128 [beams, directions].

    `weights` [beams, columns] steer both ways, or receive alone where `steered_ways` is 1: one element then transmits.
    Directions of departure are those of arrival unless given.
    """
    receive = one_way_pattern(setup, weights, azimuth_rad, elevation_rad, frequency_ratio, coupling)
    unsteered = setup.array.steered_ways == 1
    if not unsteered and departure_azimuth_rad is None and departure_elevation_rad is None:
        return receive**2
    azimuth_out = azimuth_rad if departure_azimuth_rad is None else departure_azimuth_rad
    elevation_out = elevation_rad if departure_elevation_rad is None else departure_elevation_rad
    if unsteered:
        return receive * element_field(setup.element, azimuth_out, elevation_out)
    return receive * one_way_pattern(setup, weights, azimuth_out, elevation_out, frequency_ratio, coupling)


def setup_weights(setup: RadarSetup) -> np.ndarray:
    """Return the steering weights of a set-up: its own if given, else computed; complex128 [beams, columns]."""
    if setup.steering_weights is not None:
        return setup.steering_weights.astype(np.complex128)
    return steering_weights(setup.array, setup.radar.wavelength_m, setup.beams.azimuth_rad)


def coarray_weights(weights: np.ndarray) -> np.ndarray:
    """Return two-way weights on the 2N-1 virtual columns: each beam's weights self-convolved; [beams, 2N-1]."""
    return np.stack([np.convolve(row, row) for row in weights])
