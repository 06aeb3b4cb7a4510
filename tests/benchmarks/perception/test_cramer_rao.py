"""Bounds against closed forms and against a Fisher matrix built sample by sample."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.perception.cramer_rao import azimuth_response, periodogram_range_loss, raw_bound, windowed_bound
from models.physics.waveform import window_noise_gain
from msgs.values.radar import BeamGrid, RadarParams, RadarSetup

SETUP = RadarSetup()
BEAM_NOISE_MW = 1e-3


def one(azimuth_deg: float = 10.0, bins: np.ndarray | None = None) -> np.ndarray:
    """Standard deviations (range [bins], azimuth [rad]) of one unit echo at bin 100.3; of windowed bins where given."""
    echo = (SETUP, np.array([100.3]), np.radians([azimuth_deg]), np.ones(1), BEAM_NOISE_MW)
    covariance = raw_bound(*echo)[0] if bins is None else windowed_bound(*echo, bins)[0]
    return np.sqrt(np.diag(covariance)) / (SETUP.radar.range_bin_m, 1.0)


def test_range_of_one_tone_is_the_textbook_bound() -> None:
    """Rife and Boorstyn: var q = 6 N^2 / (4 pi^2 (N^2 - 1)) over the SNR of all beams in an unwindowed bin."""
    energy = np.sum(np.abs(azimuth_response(SETUP, np.radians([10.0]))) ** 2)
    samples = SETUP.radar.samples_per_chirp
    snr = energy / (BEAM_NOISE_MW / window_noise_gain("hann"))
    expected = np.sqrt(6.0 * samples**2 / (4.0 * np.pi**2 * (samples**2 - 1) * snr))
    assert one()[0] == pytest.approx(expected, rel=1e-6)


def test_raw_bound_of_two_echoes_equals_the_one_written_out() -> None:
    """A small radar (64 samples, 8 beams), two echoes: the Jacobian of all samples by differences, inverted."""
    setup = RadarSetup(radar=RadarParams(samples_per_chirp=64), beams=BeamGrid(azimuth_deg=tuple(range(-35, 36, 10))))
    place = np.array([10.2, 12.9, 0.1, 0.3])
    amplitude = np.array([1.0, 0.5 + 0.4j])

    def samples(unknown: np.ndarray) -> np.ndarray:
        a, q, azimuth = unknown[:2] + 1j * unknown[2:4], unknown[4:6], unknown[6:]
        tones = np.exp(2j * np.pi * np.multiply.outer(q, np.arange(64)) / 64) / np.sqrt(64)
        return np.einsum("p,pn,pb->nb", a, tones, azimuth_response(setup, azimuth)).ravel()

    at = np.concatenate([amplitude.real, amplitude.imag, place])
    jacobian = np.stack([(samples(at + h) - samples(at - h)) / 2e-6 for h in 1e-6 * np.eye(8)], axis=1)
    information = 2.0 * np.real(jacobian.conj().T @ jacobian) / (BEAM_NOISE_MW / 1.5)
    expected = np.linalg.inv(information)[4:, 4:]
    found = raw_bound(setup, place[:2], place[2:], amplitude, BEAM_NOISE_MW)
    metres = setup.radar.range_bin_m
    for p in range(2):
        own = expected[np.ix_([p, 2 + p], [p, 2 + p])] * np.outer([metres, 1.0], [metres, 1.0])
        np.testing.assert_allclose(found[p], own, rtol=1e-5, atol=1e-12)


def test_many_windowed_bins_come_to_the_raw_bound_and_fewer_bins_know_less() -> None:
    """Whitened Hann bins: 401 of them within 1 % of the raw range bound; azimuth needs no bins but the echo's own."""
    raw = one()
    spread = {bins: one(bins=100 + np.arange(bins) - bins // 2) / raw for bins in (3, 5, 9, 401)}
    assert spread[3][0] > spread[5][0] > spread[9][0] > spread[401][0] >= 1.0
    assert spread[401][0] == pytest.approx(1.0, abs=0.01)
    assert spread[5][0] == pytest.approx(1.40, abs=0.05)
    assert spread[5][1] == pytest.approx(1.1, abs=0.1)


def test_periodogram_of_a_hann_window() -> None:
    """Continuous limit: sqrt((1/8 - 15/(16 pi^2)) / 12) / (1/12 - 1/(2 pi^2)); without a window nothing is lost."""
    cosine = [(-1.0) ** m / (2.0 * np.pi**2 * m**2) for m in (1, 2)]
    squared = 1.5 / 12.0 + 2.0 * cosine[0] + 0.5 * cosine[1]
    expected = np.sqrt(squared / 12.0) / (1.0 / 12.0 + cosine[0])
    assert periodogram_range_loss("hann") == pytest.approx(expected, rel=1e-5)
    assert periodogram_range_loss("none") == pytest.approx(1.0)


def test_azimuth_bound_widens_with_the_cosine_and_falls_with_the_square_root_of_snr() -> None:
    """At 50 deg the aperture shows by cos(50 deg); the sampling of beams adds a few percent."""
    assert one(50.0)[1] / one(0.0)[1] == pytest.approx(1.0 / np.cos(np.radians(50.0)), rel=0.1)
    strong = raw_bound(SETUP, np.array([100.0]), np.zeros(1), np.full(1, 10.0), BEAM_NOISE_MW)[0]
    weak = raw_bound(SETUP, np.array([100.0]), np.zeros(1), np.ones(1), BEAM_NOISE_MW)[0]
    np.testing.assert_allclose(weak, 100.0 * strong, rtol=1e-9, atol=1e-20)


def test_a_second_echo_costs_more_the_nearer_it_is() -> None:
    amplitude, at = np.array([1.0, 1.0j]), np.full(2, 100.0)
    far, near = (
        np.sqrt(raw_bound(SETUP, at, np.radians([0.0, apart]), amplitude, BEAM_NOISE_MW)[0, 1, 1])
        for apart in (30.0, 4.0)
    )
    alone = one(0.0)[1]
    assert far == pytest.approx(alone, rel=0.1)
    assert near > 2.0 * alone


def test_noise_must_be_positive() -> None:
    with pytest.raises(ValueError, match=r"noise_power_mw must be .*got 0"):
        raw_bound(SETUP, np.array([100.0]), np.zeros(1), np.ones(1), 0.0)
