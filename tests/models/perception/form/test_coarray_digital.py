"""Beams of a digital array to azimuths: the 57-column array of the 77 GHz preset against its analytic array factor.

Layout: 57 orthogonal one-way beams of half-wavelength columns, sines 2 / 57 apart; point targets in the far field, on
the horizon. A target at azimuth A must leave D(sin az - sin A) in the map, D(u) = sin(57 pi u / 2) / sin(pi u / 2) /
sqrt(57), whether it stands on a beam or between two.
"""

from __future__ import annotations

import msgspec
import numpy as np
import pytest

from models.perception.form.coarray import AzimuthInterpolator, beam_matrix, coefficient_phases
from models.perception.form.ra_former import RaFormer
from models.perception.form.ra_forming import FormingParams
from models.physics.antenna import setup_weights
from msgs.values.radar import PRESETS, ArrayParams, RangeAzimuthGrid

SETUP = PRESETS["77ghz"]
COLUMNS = SETUP.array.columns
GRID = RangeAzimuthGrid()


def beams_of(azimuth_rad: np.ndarray) -> np.ndarray:
    """Recorded (conjugate) beams of unit echoes; complex64 [beams, targets]."""
    columns = np.exp(-1j * np.multiply.outer(coefficient_phases(SETUP), np.sin(azimuth_rad)))
    return (beam_matrix(SETUP) @ columns).astype(np.complex64)


def array_factor(u: np.ndarray) -> np.ndarray:
    """D(u); its limit sqrt(57) at 0."""
    below = np.sin(0.5 * np.pi * u)
    at_peak = np.abs(below) < 1e-12
    return np.where(at_peak, COLUMNS, np.sin(0.5 * np.pi * COLUMNS * u) / np.where(at_peak, 1.0, below)) / COLUMNS**0.5


def test_beams_are_orthogonal_and_of_one_time() -> None:
    """W W^H = 57 I, so that white noise of the columns is independent in the beams; exact to rounding."""
    weights = setup_weights(SETUP)
    np.testing.assert_allclose(weights @ weights.conj().T, COLUMNS * np.eye(COLUMNS), atol=1e-11)
    assert SETUP.beam_interval_ns == 0
    assert SETUP.beam_share_ns == pytest.approx(0.3e9 / 57, abs=1)


def test_a_target_anywhere_leaves_the_ideal_pattern() -> None:
    """Targets on azimuths of the grid, on and between beams. Bias: the ridge of 1e-7; tolerance 1e-5 of the peak."""
    azimuth_rad = GRID.azimuth_rad[5:250:7]
    values, incoherent = AzimuthInterpolator(SETUP, GRID).interpolate(beams_of(azimuth_rad), 0.0)
    expected = array_factor(np.sin(GRID.azimuth_rad) - np.sin(azimuth_rad)[:, None])
    np.testing.assert_allclose(values, expected, atol=1e-5 * COLUMNS**0.5)
    np.testing.assert_allclose(np.abs(values).max(axis=1), COLUMNS**0.5, rtol=1e-5)
    assert not incoherent.any()


def test_half_power_width() -> None:
    """0.886 lambda / (57 d) = 1.781 deg at boresight, where the array factor is a sinc to 0.03 %; tolerance 0.2 %."""
    fine = RangeAzimuthGrid(range_bin_m=GRID.range_bin_m, azimuth_bins=4001, azimuth_limit_deg=4.0)
    values, _ = AzimuthInterpolator(SETUP, fine).interpolate(beams_of(np.zeros(1)), 0.0)
    over_half = np.degrees(fine.azimuth_rad[np.abs(values[0]) ** 2 >= 0.5 * COLUMNS])
    assert np.ptp(over_half) == pytest.approx(np.degrees(0.886 * 2.0 / COLUMNS), rel=2e-3)


def test_noise_is_that_of_a_beam_everywhere() -> None:
    """A unitary change of basis: noise gain 1 less the ridge. Of 512 noise draws an azimuth's mean power is 1 to 4.4 %
    rms; tolerance five of those."""
    rng = np.random.default_rng(0)
    noise = (rng.standard_normal((COLUMNS, 512)) + 1j * rng.standard_normal((COLUMNS, 512))) / 2**0.5
    inversion = AzimuthInterpolator(SETUP, GRID)
    values, _ = inversion.interpolate(noise.astype(np.complex64), 1.0)
    assert inversion.noise_gain() == pytest.approx(1.0, abs=1e-6)
    assert np.abs(np.mean(np.abs(values) ** 2, axis=0) - 1.0).max() < 0.22


def test_where_a_beam_is_missing_nothing_is_claimed() -> None:
    """Its own direction is in no other beam: cells nearer to it than to others (share 1 - |D|^2 / 57 under a half) are
    empty, all others keep what the present beams hold, and noise does not grow."""
    inversion = AzimuthInterpolator(SETUP, GRID)
    values, _ = inversion.interpolate(beams_of(GRID.azimuth_rad), 0.0, (40,))
    share = np.abs(np.diag(values)) / COLUMNS**0.5
    lost = array_factor(np.sin(GRID.azimuth_rad) - np.sin(SETUP.beams.azimuth_rad[40])) ** 2 / COLUMNS
    kept = lost < 0.5 - 1e-4
    np.testing.assert_allclose(share[kept], 1.0 - lost[kept], atol=1e-4)
    assert 3 <= np.count_nonzero(share == 0.0) == np.count_nonzero(lost > 0.5) <= 6
    assert inversion.noise_gain((40,)) < 1.0


def test_beams_of_a_digital_array_are_not_left_out() -> None:
    with pytest.raises(ValueError, match=r"forming\.beam_step must be 1 for a digital array: .* got 2"):
        RaFormer(SETUP, FormingParams(beam_step=2))


@pytest.mark.parametrize("change", [{"steered_ways": 2}, {"phase_bits": 6}])
def test_a_digital_array_has_no_phase_shifters(change: dict[str, int]) -> None:
    with pytest.raises(ValueError, match=r"array\.digital needs array\.steered_ways 1 and array\.phase_bits 0"):
        ArrayParams(**(msgspec.structs.asdict(SETUP.array) | change))
