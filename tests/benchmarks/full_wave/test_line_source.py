"""The line source on the grid against closed forms: threads in free space, planes of metal and concrete."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.special import hankel2

from benchmarks.full_wave.line_source import (
    CONDUCTOR_PERMITTIVITY,
    PULSE_SHARE,
    LineGrid,
    empty_echo,
    line_source_echo,
    thread_amplitude,
)
from lab.full_wave.grid import Drive, Media, YeeGrid
from models.physics.fresnel import half_space_reflection
from models.physics.materials import permittivity

FREQUENCY_HZ = 10e9
CELL_M = 1.5e-3
SWEEP_HZ = np.linspace(9.65e9, 10.35e9, 5)
STEPS = 1100
#: 0.63 m forward, 0.36 m to both sides, absorbers within.
GRID = LineGrid((-0.09, -0.36), (481, 481), CELL_M, FREQUENCY_HZ)


def scattered(media: np.ndarray) -> np.ndarray:
    """Field of a scene at the source per unit of H0, without the source's own."""
    empty = empty_echo(GRID, STEPS)
    return line_source_echo(GRID, media, (0.0, 0.0), STEPS).spectrum(SWEEP_HZ) - empty.spectrum(SWEEP_HZ)


@pytest.mark.parametrize(
    ("point_m", "eps"),
    [((0.24, 0.24), CONDUCTOR_PERMITTIVITY), ((0.36, -0.15), 3.0)],
)
def test_echo_of_a_thread_is_two_hankel_functions(point_m: tuple[float, float], eps: complex) -> None:
    """Layout: line source, one node of metal or dielectric 0.34 to 0.39 m away. Analytic: F H0(k r)^2.

    Bias: wave number and line source are the grid's, so dispersion is none; far field of the lattice, float32:
    0.03 dB, 0.3 deg. Tolerance 0.05 dB, 0.5 deg. Without the source's gain on the lattice it is 0.14 to 0.28 dB.
    """
    media = np.ones(GRID.cells, np.complex64)
    media[GRID.node(point_m)] = eps
    range_m = math.hypot(*point_m)
    direction = np.array([point_m]) / range_m
    k, gain = (kind(SWEEP_HZ, direction)[:, 0] for kind in (GRID.wave_number, GRID.source_gain))
    expected = thread_amplitude(empty_echo(GRID, STEPS), SWEEP_HZ, eps) * np.square(gain * hankel2(0, k * range_m))
    ratio = scattered(media) / expected
    assert np.abs(20.0 * np.log10(np.abs(ratio))).max() < 0.05
    assert np.abs(np.degrees(np.angle(ratio))).max() < 0.5


def test_echo_of_a_plane_is_its_image_source() -> None:
    """Layout: metal plane at 0.3 m that goes into the absorbers. Analytic: -H0(2 k d), the image source.

    Bias: the plane's ends lie in the absorbers, which send back little. Tolerance 0.1 dB, 1 deg.
    """
    media = np.ones(GRID.cells, np.complex64)
    media[GRID.node((0.3, 0.0))[0] :] = CONDUCTOR_PERMITTIVITY
    forward = np.array([[1.0, 0.0]])
    k, gain = (kind(SWEEP_HZ, forward)[:, 0] for kind in (GRID.wave_number, GRID.source_gain))
    ratio = scattered(media) / (-gain * hankel2(0, 0.6 * k))
    assert np.abs(20.0 * np.log10(np.abs(ratio))).max() < 0.1
    assert np.abs(np.degrees(np.angle(ratio))).max() < 1.0


def test_face_of_cells_reflects_as_its_material() -> None:
    """Layout: concrete half-space at 0.3 m that goes into the absorbers. Analytic: r H0(2 k d), Fresnel's r.

    Bias: second order away from normal incidence, 0.04 dB; a spherical front meets the face at all angles, 1 / k d.
    Tolerance 0.1 dB at the carrier. Cells of the material's own permittivity are off by 0.56 dB.
    """
    concrete = complex(permittivity("concrete", FREQUENCY_HZ))
    share = np.clip(np.arange(GRID.cells[0]) - GRID.node((0.3, 0.0))[0] + 0.5, 0.0, 1.0)[:, None]
    forward = np.array([[1.0, 0.0]])
    k, gain = (kind(SWEEP_HZ, forward)[:, 0] for kind in (GRID.wave_number, GRID.source_gain))
    expected = half_space_reflection(concrete, 1.0) * gain * hankel2(0, 0.6 * k)
    for eps, error_db, tolerance_db in ((GRID.permittivity(concrete), 0.0, 0.1), (concrete, -0.56, 0.1)):
        media = np.broadcast_to(1.0 + (eps - 1.0) * share, GRID.cells)
        ratio = scattered(media) / expected
        assert 20.0 * np.log10(np.abs(ratio[2])) == pytest.approx(error_db, abs=tolerance_db)


def test_a_face_anywhere_in_a_cell_reflects_as_its_material_on_average() -> None:
    """Layout: the same half-space, its face at four places of a cell. Analytic: the mean of r H0(2 k d) over them.

    Bias: four places for all of them. Tolerance 0.1 dB; with cells for a face on nodes it is 0.4 dB.
    """
    concrete = complex(permittivity("concrete", FREQUENCY_HZ))
    at, forward = GRID.node((0.3, 0.0))[0], np.array([[1.0, 0.0]])
    k, gain = (kind(SWEEP_HZ, forward)[:, 0] for kind in (GRID.wave_number, GRID.source_gain))
    found, expected = np.zeros(len(SWEEP_HZ), complex), np.zeros(len(SWEEP_HZ), complex)
    eps = GRID.permittivity(concrete, on_nodes=False)
    for place in (-0.375, -0.125, 0.125, 0.375):
        share = np.clip(np.arange(GRID.cells[0]) - at - place + 0.5, 0.0, 1.0)[:, None]
        found += scattered(np.broadcast_to(1.0 + (eps - 1.0) * share, GRID.cells))
        expected += half_space_reflection(concrete, 1.0) * gain * hankel2(0, (0.6 + 2.0 * place * CELL_M) * k)
    assert 20.0 * np.log10(np.abs(found[2] / expected[2])) == pytest.approx(0.0, abs=0.1)


def test_wave_number_solves_the_dispersion_relation() -> None:
    """Analytic: sin^2(w dt / 2) = S^2 (sin^2(kx h / 2) + sin^2(ky h / 2)); at 20 cells k is 0.21 % up along an axis."""
    turn = np.linspace(0.0, 0.5 * np.pi, 7)
    direction = np.column_stack([np.cos(turn), np.sin(turn)])
    k = GRID.wave_number(SWEEP_HZ, direction)
    left = np.sin(np.pi * SWEEP_HZ * GRID.step_s) ** 2
    right = 0.7**2 * (np.sin(0.5 * CELL_M * k[..., None] * direction) ** 2).sum(axis=-1)
    np.testing.assert_allclose(right, np.broadcast_to(left[:, None], right.shape), rtol=1e-9)
    free = 2.0 * np.pi * FREQUENCY_HZ / 299_792_458.0
    assert k[2, 0] / free - 1.0 == pytest.approx(0.0021, abs=1e-4)


def test_rows_out_of_step_are_the_whole_grid() -> None:
    """Layout: half a metal plane. Analytic: none; the same grid stepped whole, step by step, with a source on one node.

    Tolerance 1e-6 of the field: rounding, and forerunners of the numerical light cone. The echo is 1e-3 of it.
    """
    media = np.ones(GRID.cells, np.complex64)
    row, column = GRID.node((0.3, 0.0))
    media[row:, column:] = CONDUCTOR_PERMITTIVITY
    echo = line_source_echo(GRID, media, (0.0, 0.0), STEPS)
    row, column = GRID.node((0.0, 0.0))
    profile = np.zeros(GRID.cells[0], np.complex128)
    profile[row] = 1.0
    drive = Drive(column, profile, 1.0 / (PULSE_SHARE * GRID.params.phase_per_step))
    whole = YeeGrid(GRID.params, Media(out=media))
    spectrum = np.zeros((1, GRID.cells[0]), np.complex128)
    whole.run(drive, (column,), STEPS, spectrum)
    turn = np.exp(-1j * GRID.params.phase_per_step * (np.arange(STEPS) + 1.0))
    assert abs(turn @ echo.field - spectrum[0, row]) < 1e-6 * np.abs(spectrum).max()
    late = echo.time_s > 1.5e-9
    assert np.abs(echo.field[late]).max() > 1e-3 * np.abs(echo.field).max()


def test_a_source_off_the_nodes_is_refused() -> None:
    with pytest.raises(ValueError, match="must be a node of the grid between its absorbers, off by 0"):
        GRID.node((0.0005, 0.0))
