from __future__ import annotations

import numpy as np
import pytest

from models.perception.find.encoding import Encoding, encode_columns, encode_map, sample_columns
from msgs.values.radar import PRESETS, RangeAzimuthGrid, RangeAzimuthMap
from tests.builders import example_map

ENCODING = Encoding()
LEVEL, SHADOW, CONTRAST = range(3)


def ra_map(values: np.ndarray, noise_power_mw: float = 1e-12, grid: RangeAzimuthGrid | None = None) -> RangeAzimuthMap:
    grid = grid or RangeAzimuthGrid()
    return example_map(values, grid=grid, noise_power_mw=noise_power_mw)


def band_limited(rng: np.random.Generator, rows: int = 512) -> np.ndarray:
    """Maps as the array makes them: 15 co-array coefficients a row."""
    sine = np.sin(np.radians(np.linspace(-60, 60, 256)))
    steering = np.exp(1j * np.pi * np.multiply.outer(np.arange(-7, 8), sine))
    return (rng.standard_normal((rows, 15)) + 1j * rng.standard_normal((rows, 15))) @ steering


def test_columns_are_read_at_the_centre_of_the_outputs_they_stand_for() -> None:
    """A ramp over azimuth: column j is the mean of outputs 8j..8j+7, 8j + 3.5, exactly."""
    ramp = np.broadcast_to(np.arange(256.0), (512, 256)).astype(np.complex64)
    np.testing.assert_array_equal(sample_columns(ENCODING, ramp)[0].real, 8 * np.arange(32) + 3.5)


def test_thirty_two_columns_lose_nothing() -> None:
    """Layout: random rows of 15 co-array coefficients. Analytic: 15 unknowns, 32 equations, so the columns determine
    the whole row. Bias: reading at the centre averages two neighbours 0.47 deg apart, a factor cos(n pi d / 2) of at
    most 1.6 % on the highest coefficient. Tolerance: 3 % of the rms.
    """
    rng = np.random.default_rng(1)
    rows = band_limited(rng, 20)
    sine = np.sin(np.radians(np.linspace(-60, 60, 256)))
    steering = np.exp(1j * np.pi * np.multiply.outer(np.arange(-7, 8), sine))
    centres = steering.reshape(15, 32, 8)[:, :, 3:5].mean(axis=-1)
    columns = sample_columns(Encoding(range_bins=20), rows)
    coefficients = np.linalg.lstsq(centres.T, columns.T, rcond=None)[0]
    error = np.abs(coefficients.T @ steering - rows)
    assert np.sqrt(np.mean(error**2)) < 0.03 * np.sqrt(np.mean(np.abs(rows) ** 2))


def test_level_counts_from_the_noise() -> None:
    noise_mw = 1e-11
    values = np.full((512, 256), np.sqrt(noise_mw * 10 ** (30 / 10)))
    encoded = encode_map(ENCODING, ra_map(values, noise_mw))
    np.testing.assert_allclose(encoded[LEVEL], (30 + 5) / 90, atol=1e-5)
    np.testing.assert_allclose(encoded[CONTRAST], 0.0, atol=1e-6)


@pytest.mark.parametrize("gain_db", [-120.0, 60.0])
def test_common_gain_changes_nothing(gain_db: float) -> None:
    """Tolerance: values are complex64, so a scaled one is off by 6e-8, 5e-7 dB."""
    values = 1e-6 * band_limited(np.random.default_rng(2))
    gain = 10 ** (gain_db / 20)
    plain = encode_map(ENCODING, ra_map(values, 1e-13))
    scaled = encode_map(ENCODING, ra_map(gain * values, 1e-13 * gain**2))
    np.testing.assert_allclose(scaled, plain, atol=1e-5)


def test_shadow_is_the_strongest_return_nearer_in_the_same_direction() -> None:
    values = np.zeros((512, 256))
    values[100, 8:16] = 1e-3
    values[200, 8:16] = 1e-5
    encoded = encode_map(ENCODING, ra_map(values))
    assert (encoded[SHADOW, :101] == 0.0).all()
    assert (encoded[SHADOW, 101:, 1] == encoded[LEVEL, 100, 1]).all()
    assert (encoded[SHADOW, :, 2:] == 0.0).all()


def test_mirrored_scene_is_the_mirrored_input() -> None:
    """Left and right exchanged: every channel is exchanged, the azimuth changes its sign."""
    values = band_limited(np.random.default_rng(3))[:320].astype(np.complex64)
    columns = sample_columns(ENCODING, values)
    plain = encode_columns(ENCODING, columns, np.float64(0.1))
    mirrored = encode_columns(ENCODING, sample_columns(ENCODING, values[:, ::-1]), np.float64(0.1))
    sign = np.array([1, 1, 1, 1, -1])[:, None, None]
    np.testing.assert_allclose(mirrored, sign * plain[:, :, ::-1], atol=1e-6)


def test_batches_are_encoded_as_single_maps_are() -> None:
    rng = np.random.default_rng(4)
    columns = np.stack([sample_columns(ENCODING, band_limited(rng)) for _ in range(3)])
    noise = np.array([0.1, 1.0, 10.0])
    batch = encode_columns(ENCODING, columns, noise)
    for i in range(3):
        np.testing.assert_array_equal(batch[i], encode_columns(ENCODING, columns[i], noise[i]))


def test_grid_that_does_not_fit_is_refused() -> None:
    short = RangeAzimuthGrid(range_bins=300)
    with pytest.raises(ValueError, match=r"grid\.range_bins must be at least 320, got 300"):
        encode_map(ENCODING, ra_map(np.ones(short.shape), grid=short))
    odd = RangeAzimuthGrid(azimuth_bins=250)
    with pytest.raises(ValueError, match=r"grid\.azimuth_bins must be a multiple of 64, got 250"):
        encode_map(ENCODING, ra_map(np.ones(odd.shape), grid=odd))


def test_columns_that_miss_the_beams_of_an_array_are_refused() -> None:
    """57 columns half a wavelength apart: 120 deg hold 2.0944 x 56 = 117.3 samples of their power."""
    ENCODING.check_array(PRESETS["xband"], RangeAzimuthGrid())
    Encoding(columns=128).check_array(PRESETS["77ghz"], RangeAzimuthGrid())
    with pytest.raises(ValueError, match=r"encoding\.columns must be at least 118 for an array of 57 .* got 32"):
        ENCODING.check_array(PRESETS["77ghz"], RangeAzimuthGrid())


def test_levels_out_of_order_are_refused() -> None:
    with pytest.raises(ValueError, match=r"level_min_db must be below level_max_db, got 90\.0 and 85\.0"):
        Encoding(level_min_db=90.0)
