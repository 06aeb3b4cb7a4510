"""Radial speed of cells: known motion back, its spread against the Cramer-Rao bound, nothing where nothing is heard.

Layout: sums of chirps of one echo in white noise; and whole scans of one far point, as in `test_ra_forming`.
"""

from __future__ import annotations

import numpy as np
import pytest

from models.perception.find.peaks import PeakParams, peaks_at
from models.perception.form.radial_speed import beam_speeds, cell_speeds, unit_std_mps
from msgs.values.perception import PathClass
from msgs.values.radar import NO_RADIAL_SPEED, RadarParams, RangeAzimuthMap
from msgs.values.vehicle import VehicleState
from tests.models.perception.form.test_ra_forming import SETUP, STAMP_NS, _form, _peak, _scan

RADAR = RadarParams()
GROUPS = 8
DURATION_S = RADAR.chirps_per_beam * RADAR.repetition_interval_s
TIME_S = (np.arange(GROUPS) + 0.5) / GROUPS * DURATION_S - 0.5 * DURATION_S
#: Half a bin of a spectrum padded fourfold: as far as the strongest bin can lie from the peak.
HALF_BIN_RAD_PS = 0.5 * 2.0 * np.pi / (4.0 * DURATION_S)


def turn_rad_ps(speed_mps: np.ndarray) -> np.ndarray:
    return np.asarray(4.0 * np.pi / RADAR.wavelength_m * speed_mps)


def test_a_clean_echo_gives_its_speed_from_anywhere_in_the_bin() -> None:
    """-30 to 30 m/s, start up to half a bin off: to 0.02 m/s, of 5.3 m/s a bin (two Newton steps leave 1e-3 of it)."""
    speed_mps = np.linspace(-30.0, 30.0, 121)
    turn = turn_rad_ps(speed_mps)
    series = np.exp(1j * np.multiply.outer(TIME_S, turn)).astype(np.complex64)
    start = turn + np.linspace(-1.0, 1.0, 121) * HALF_BIN_RAD_PS
    np.testing.assert_allclose(beam_speeds(series, start, TIME_S, RADAR.wavelength_m), speed_mps, atol=0.02)


@pytest.mark.parametrize("snr_db", [20.0, 30.0, 40.0])
def test_the_spread_is_that_of_the_bound(snr_db: float) -> None:
    """4,000 echoes: RMSE over the bound of all chirps, 1 +- 0.05 (1 % of chance, 1 % lost between eight sums)."""
    rng = np.random.default_rng(3)
    count = 4000
    speed_mps = rng.uniform(-12.0, 12.0, count)
    turn = turn_rad_ps(speed_mps)
    noise = np.sqrt(GROUPS / 2.0) * (rng.standard_normal((GROUPS, count)) + 1j * rng.standard_normal((GROUPS, count)))
    # the mean of the sums has this SNR
    series = 10.0 ** (snr_db / 20.0) * np.exp(1j * np.multiply.outer(TIME_S, turn)) + noise
    start = turn + rng.uniform(-1.0, 1.0, count) * HALF_BIN_RAD_PS
    error = beam_speeds(series.astype(np.complex64), start, TIME_S, RADAR.wavelength_m) - speed_mps
    bound = unit_std_mps(RADAR.wavelength_m, DURATION_S) / 10.0 ** (snr_db / 20.0)
    assert np.sqrt(np.mean(error**2)) == pytest.approx(bound, rel=0.05)
    assert abs(error.mean()) < 4.0 * bound / np.sqrt(count)


def test_the_unit_is_the_bound_of_the_issue() -> None:
    """0.7 ms at 10 GHz: sqrt(6) / T * lambda / 4 pi is 8.3 m/s at 0 dB, 0.08 at 40 dB, 0.47 at 25 dB."""
    unit = unit_std_mps(0.03, 0.7e-3)
    assert unit / 100.0 == pytest.approx(0.0835, abs=1e-3)
    assert unit / 10.0**1.25 == pytest.approx(0.47, abs=0.01)


def test_cells_weigh_their_beams_by_power_and_are_silent_in_noise() -> None:
    """Two cells near beams 0 and 1, and 1 and 2. Ranges: an echo in beams 0 and 1 (powers 30 and 10, speeds 2 and 4);
    one in beam 2 alone; noise; a beam that said nothing.
    """
    near = np.array([[True, True, False], [False, True, True]])
    power = np.array([[30.0, 0.0, 2.0, 30.0], [10.0, 0.0, 2.0, 0.0], [0.0, 50.0, 2.0, 0.0]])
    speed = np.array([[2.0, 9.0, 1.0, np.nan], [4.0, 9.0, 1.0, 7.0], [9.0, -3.0, 1.0, 7.0]], np.float32)
    cells = cell_speeds(speed, power, 1.0, near)
    none = NO_RADIAL_SPEED
    assert (cells.dtype, cells.shape) == (np.int16, (4, 2))
    assert cells.tolist() == [[250, none], [none, -300], [none] * 2, [none] * 2]


def formed_speed(ra_map: RangeAzimuthMap) -> float:
    return float(ra_map.radial_speed_mps(_peak(ra_map)))


@pytest.mark.parametrize("speed_mps", [-9.0, -0.4, 0.0, 3.0])
def test_a_point_that_closes_in_has_a_negative_radial_speed(speed_mps: float) -> None:
    """16 chirps are 88 us, whose bound at 60 dB is 0.07 m/s: 0.15 m/s."""
    ra_map = _form(_scan(SETUP, (40.0, 12.0), speed_mps=speed_mps, noise_power_mw=1e-8))
    assert formed_speed(ra_map) == pytest.approx(-speed_mps, abs=0.15)


def test_what_stands_has_no_speed_over_ground_however_the_vehicle_drives() -> None:
    """8 m/s past a point at 31 deg: 0 with the vehicle's state, the closing speed 8 cos 31 deg without it."""
    state = VehicleState(stamp_ns=STAMP_NS, speed_mps=8.0)
    beams = _scan(SETUP, (40.0, 24.0), motion=state, noise_power_mw=1e-8)
    assert formed_speed(_form(beams, state=state)) == pytest.approx(0.0, abs=0.2)
    assert formed_speed(_form(beams)) == pytest.approx(-8.0 * np.cos(np.arctan2(24.0, 40.0)), abs=0.3)


def test_peaks_say_how_sure_their_speed_is() -> None:
    ra_map = _form(_scan(SETUP, (40.0, 12.0), noise_power_mw=1e-8))
    cells = np.array([_peak(ra_map), (500, 3)])
    peaks = peaks_at(ra_map, cells, cells.astype(float), np.ones(2), np.zeros(2, np.uint8), PeakParams())
    assert peaks.path_class.tolist() == [PathClass.LOS] * 2
    assert peaks.radial_speed_std_mps is not None
    expected = ra_map.radial_speed_unit_std_mps / 10.0 ** (peaks.snr_db[0] / 20.0)
    assert peaks.radial_speed_std_mps[0] == pytest.approx(expected)
    assert np.isnan(peaks.radial_speed_std_mps[1])


@pytest.mark.parametrize("params", [{"mode": "welch"}, {"slow_time_sums": 2}])
def test_without_slow_time_nothing_is_said(params: dict[str, object]) -> None:
    assert _form(_scan(SETUP, (40.0, 12.0)), **params).radial_speed_cmps is None
