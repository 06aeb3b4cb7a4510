"""Open-field background: leakage, noise and a mover of known size, chirp by chirp."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from contrib.calibrate.background import background_of, background_quality, mean_chirp
from models.perception.form.background import load_background
from msgs.values.radar import BeamGrid, RadarParams, RadarSetup
from tests.builders import example_beam

SAMPLES, SCANS, NOISE_CODES, LEAKAGE_CODES = 256, 32, 10.0, 500.0
SETUP = RadarSetup(
    radar=RadarParams(chirps_per_beam=1, samples_per_chirp=SAMPLES), beams=BeamGrid(azimuth_deg=(-5.0, 0.0, 5.0))
)


def static() -> np.ndarray:
    """Leakage in bin 1, another amplitude in each beam, complex [beams, samples]."""
    tone = np.exp(2j * np.pi * np.arange(SAMPLES) / SAMPLES)
    return LEAKAGE_CODES * np.array([1.0, 0.8j, -0.6])[:, None] * tone


def chirps(scans: int = SCANS, mover: float = 0.0, seed: int = 0) -> np.ndarray:
    """Mean chirps [scans, beams, samples]; the mover is in bin 20 of every fourth scan, at any phase."""
    rng = np.random.default_rng(seed)
    noise = rng.standard_normal((2, scans, 3, SAMPLES)) * NOISE_CODES / np.sqrt(2.0)
    values = static() + noise[0] + 1j * noise[1]
    tone = mover * np.exp(2j * np.pi * 20 * np.arange(SAMPLES) / SAMPLES)
    values[::4] += np.exp(2j * np.pi * rng.random((len(values[::4]), 1, 1))) * tone
    return values.astype(np.complex64)


def test_noise_falls_by_10_log_n() -> None:
    """Noise of the mean of N scans is that of one less 10 log N; 768 bins: 0.3 dB. Rejection costs 0.1 dB."""
    values = chirps()
    background, _ = background_of(values)
    left_db = 20.0 * np.log10(np.sqrt(np.mean(np.abs(background - static()) ** 2)) / NOISE_CODES)
    assert left_db == pytest.approx(-10.0 * np.log10(SCANS), abs=0.3)
    quality = background_quality(values, SETUP, 0.0)
    for count, noise_dbm in quality.noise_by_scans_dbm:
        assert noise_dbm == pytest.approx(quality.scan_noise_dbm - 10.0 * np.log10(count), abs=0.4)
    expected_dbm = -20.0 - 20.0 * np.log10(32768.0 / NOISE_CODES) - 10.0 * np.log10(SAMPLES)
    assert quality.scan_noise_dbm == pytest.approx(expected_dbm, abs=0.3)


def test_leakage_is_found_and_goes() -> None:
    """Strongest static bin at its power; what is left is the noise of two halves, 4 / N of a scan's."""
    quality = background_quality(chirps(), SETUP, 0.0)
    assert quality.leakage_dbm == pytest.approx(-20.0 + 20.0 * np.log10(LEAKAGE_CODES / 32768.0), abs=0.1)
    assert quality.leakage_range_m == pytest.approx(SETUP.radar.range_bin_m)
    assert quality.left_dbm == pytest.approx(quality.scan_noise_dbm - 10.0 * np.log10(SCANS / 4), abs=6.0)
    assert quality.removed_db > 50.0


def test_a_mover_is_left_out() -> None:
    """40 dB over the noise of its bin in a quarter of the scans: the mean keeps 28 dB of it, ours under 3 dB."""
    values = chirps(mover=60.0)
    background, share = background_of(values)
    spectrum = np.fft.fft(background - static(), axis=1)[:, 20] / SAMPLES
    noise = NOISE_CODES / np.sqrt(SAMPLES * SCANS)
    assert np.abs(spectrum).max() < 3.0 * noise
    assert share == pytest.approx(0.25 / SAMPLES, rel=0.2)


def test_too_few_scans_are_refused() -> None:
    with pytest.raises(ValueError, match="at least 4 scans, got 3"):
        background_of(chirps(scans=3))


@pytest.mark.parametrize("level", [0.0, 3.0])
def test_scans_that_repeat_one_another_are_refused(level: float) -> None:
    """A receiver that is off, or one scan copied: no noise to tell what is static from."""
    values = np.full((6, 3, SAMPLES), level, np.complex64)
    with pytest.raises(ValueError, match="scans that differ by noise"):
        background_quality(values, SETUP, 0.0)


def test_mean_chirp_is_the_mean() -> None:
    codes = np.random.default_rng(1).integers(-999, 999, (5, 16, 2), dtype=np.int16)
    beam = example_beam(beam_count=1, samples=codes, full_scale_dbm=-20.0)
    expected = codes.astype(float).mean(axis=0)
    np.testing.assert_allclose(mean_chirp(beam), expected[:, 0] + 1j * expected[:, 1], rtol=1e-6)


@pytest.mark.parametrize(
    ("content", "rule"),
    [
        (b"", "cannot be read as .npy"),
        (b"\x93NUMPY\x01\x00", "cannot be read as .npy"),
        (np.zeros((2, 4), np.float32), "complex64"),
        (np.zeros(4, np.complex64), "complex64"),
        (np.full((2, 4), np.nan, np.complex64), "finite"),
    ],
)
def test_files_that_are_no_background_are_refused(tmp_path: Path, content: bytes | np.ndarray, rule: str) -> None:
    path = tmp_path / "background.npy"
    if isinstance(content, bytes):
        path.write_bytes(content)
    else:
        np.save(path, content)
    with pytest.raises(ValueError, match=f"background.npy: .*{rule}"):
        load_background(path)


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"none\.npy: no such background"):
        load_background(tmp_path / "none.npy")
