"""Closed-form SNR against the radar equation by hand, first-photon probabilities, and published tables of losses."""

from __future__ import annotations

import math
from collections.abc import Callable

import msgspec
import numpy as np
import pytest
from scipy.special import erfc

from lab.compare.detection_snr import half_range, map_noise_gain, photon_snr, radar_snr, radar_threshold
from models.physics.fresnel import coherent_power
from models.physics.link_budget import spad_threshold
from models.physics.photons.first_photon import first_photon_probability
from models.physics.photons.optics import direct_photons
from msgs.values.lidar import SpadParams
from msgs.values.radar import ArrayParams, BeamGrid, RadarParams, RadarSetup, RangeAzimuthGrid
from msgs.values.units import SPEED_OF_LIGHT_MPS

XBAND = RadarSetup()
AT_77_GHZ = msgspec.structs.replace(XBAND, radar=RadarParams(carrier_hz=77e9))
CELL_M = RangeAzimuthGrid().range_bin_m


def spad_snr(spad: SpadParams, range_m: float, albedo: float, wall_power_per_bounce: float = 1.0) -> np.ndarray:
    """A matt target that fills the beam, seen head-on in a wall's mirror."""
    return photon_snr(spad, range_m, direct_photons(spad, range_m, albedo, 1.0) * wall_power_per_bounce**2)


def db(ratio: np.ndarray) -> np.ndarray:
    return 10.0 * np.log10(ratio)


def test_radar_equation_by_hand() -> None:
    """10 m^2 at 100 m, boresight, in dB(mW): 2.04 + 10 - 30.46 (lambda^2) - 32.98 - 80 + 38.30 (gain) = -93.09.

    Noise -74.21 - 60.21 (2^20 samples) + 1.76 (Hann) - 2.34 (cells of the map) = -135.00. By hand within 0.02 dB.
    """
    assert db(radar_snr(XBAND, 100.0, 10.0)) == pytest.approx(-93.09 + 135.00, abs=0.02)


def test_a_digital_array_of_one_row_by_hand() -> None:
    """57 columns one way, one row: 10 lg 57 + 4 x 2.05 dB field gain, orthogonal beams, noise gain 1; 0.02 dB.

    -93.09 - 38.30 - 17.73 (lambda^2) + 17.56 + 8.20 = -123.36 against -74.21 - 60.21 + 1.76 = -132.66.
    """
    array = ArrayParams(columns=57, rows=1, phase_bits=0, steered_ways=1, digital=True)
    sines = 2.0 / 57.0 * (np.arange(57) - 28)
    beams = BeamGrid(azimuth_deg=tuple(np.degrees(np.arcsin(sines)).tolist()))
    setup = RadarSetup(radar=RadarParams(carrier_hz=77e9), array=array, beams=beams)
    assert map_noise_gain(setup) == pytest.approx(1.0, abs=1e-12)
    assert db(radar_snr(setup, 100.0, 10.0)) == pytest.approx(132.66 - 123.36, abs=0.02)


def test_free_space_gives_10_ghz_its_17_7_db() -> None:
    """The same array in wavelengths: only lambda^2 differs, 20 lg 7.7 = 17.73 dB; exact."""
    assert db(radar_snr(XBAND, 30.0, 1.0) / radar_snr(AT_77_GHZ, 30.0, 1.0)) == pytest.approx(20.0 * math.log10(7.7))


@pytest.mark.parametrize(
    ("setup", "roughness_mm", "table"),
    [
        (XBAND, 0.5, "-0.19 -0.10 -0.02"),
        (XBAND, 1.0, "-0.76 -0.38 -0.09"),
        (XBAND, 5.0, "-19 -9.5 -2.2"),
        (AT_77_GHZ, 0.2, "-1.8 -0.9 -0.2"),
        (AT_77_GHZ, 0.5, "-11.3 -5.7 -1.3"),
        (AT_77_GHZ, 1.0, "-45 -23 -5.3"),
    ],
)
def test_roughness_costs_twice_the_loss_of_a_bounce(setup: RadarSetup, roughness_mm: float, table: str) -> None:
    """Loss per bounce [dB] at 0, 45, 70 deg; tolerance: half of the last digit written."""
    cosine = np.cos(np.radians([0.0, 45.0, 70.0]))
    bounce = coherent_power(1e-3 * roughness_mm, cosine, setup.radar.wavelength_m)
    found = 0.5 * db(radar_snr(setup, 30.0, 1.0, bounce) / radar_snr(setup, 30.0, 1.0))
    for one, written in zip(found, table.split(), strict=True):
        assert one == pytest.approx(float(written), abs=0.5 * 10.0 ** -len(written.partition(".")[2]))


def test_radar_snr_broadcasts_and_falls_with_the_fourth_power() -> None:
    """Ranges by RCS; ratio 16 per doubling, exact; azimuth by the element's pattern twice both ways."""
    snr = radar_snr(XBAND, np.array([10.0, 20.0, 40.0])[:, None], np.array([1.0, 10.0]))
    assert snr.shape == (3, 2)
    assert snr[:-1] / snr[1:] == pytest.approx(np.full((2, 2), 16.0))
    # half-power beamwidth of an element, 80 deg: 3 dB at 40 deg each way of field squared, both ways
    assert db(radar_snr(XBAND, 10.0, 1.0, 1.0, math.radians(40.0)) / snr[0, 0]) == pytest.approx(-6.0, abs=1e-9)


def by_bins(spad: SpadParams, range_m: float, photons: float, earlier: float) -> float:
    """The same figure of 401 bins a cell, the echo in the middle one: what is seen, less what ambient light would leave
    of the pulses that wait at each bin, squared, over the binomial variance."""
    cell_s, delay_s = 2.0 * CELL_M / SPEED_OF_LIGHT_MPS, 2.0 * range_m / SPEED_OF_LIGHT_MPS
    gate_s = spad.period_s / spad.gates
    gate = int(delay_s // gate_s)
    before_s = delay_s - gate * gate_s - 0.5 * cell_s
    ambient = np.array([before_s, *np.full(401, cell_s / 401)]) * spad.ambient_rate_hz
    counts = ambient.copy()
    counts[[0, 201]] += earlier, photons
    pulses = len(range(gate, spad.pulses, spad.gates))
    seen = pulses * first_photon_probability(counts)[0]
    waiting, share = (pulses - np.cumsum(seen)[:-1]), -np.expm1(-ambient[1:])
    return float(np.sum(seen[1:] - waiting * share) ** 2 / np.sum(waiting * share * (1.0 - share)))


@pytest.mark.parametrize(("gates", "repetition_rate_hz"), [(1, 15e6), (7, 1e6)])
@pytest.mark.parametrize("photons", [1e-3, 0.3, 20.0])
def test_spad_snr_is_what_first_photons_make_of_it(gates: int, repetition_rate_hz: float, photons: float) -> None:
    """Gated, any gate, the wall's return before it. The echo's own bin is 1/401 of a cell: 0.3 % of the variance."""
    spad = SpadParams(arming="gated", gates=gates, repetition_rate_hz=repetition_rate_hz)
    for range_m in (3.0, 9.0):
        found = photon_snr(spad, range_m, photons, 0.4)
        assert found == pytest.approx(by_bins(spad, range_m, photons, 0.4), rel=3e-3)


def test_a_mirrors_power_counts_twice() -> None:
    """Weak light: SNR goes with photons squared, so with the fourth power of the wall and of 1 / R; 1e-3 of pile-up."""
    spad = SpadParams(arming="gated", ambient_rate_hz=1e6)
    whole, half = (spad_snr(spad, 5.0, 1e-4, wall) for wall in (1.0, 0.5))
    assert whole / half == pytest.approx(16.0, rel=5e-3)
    waiting = math.exp(1e6 * 2.0 * 4.0 / SPEED_OF_LIGHT_MPS)
    assert whole / spad_snr(spad, 9.0, 1e-4) == pytest.approx((9.0 / 5.0) ** 4 * waiting, rel=5e-3)


def test_limits_of_the_spad() -> None:
    """No light 0; beyond the period 0; no ambient light: counts squared; all light: every pulse that waits."""
    spad = SpadParams(arming="gated")
    assert photon_snr(spad, 5.0, 0.0) == 0.0
    assert photon_snr(spad, 10.1, 1.0) == 0.0
    dark = msgspec.structs.replace(spad, ambient_rate_hz=0.0)
    assert photon_snr(dark, 5.0, np.array([0.0, 1e-9])) == pytest.approx(
        np.array([0.0, 4.5e-4**2]), rel=1e-6, abs=1e-20
    )
    half_s = CELL_M / SPEED_OF_LIGHT_MPS
    before = spad.pulses * math.exp(-3e7 * (2.0 * 5.0 / SPEED_OF_LIGHT_MPS - half_s))
    counts = before * math.exp(-3e7 * half_s)
    assert photon_snr(spad, 5.0, 1e9) == pytest.approx(counts**2 / (before - counts), rel=1e-12)
    # the wall's own return of 3 photons leaves e^-3 of the pulses
    assert photon_snr(spad, 5.0, 1.0, 3.0) / photon_snr(spad, 5.0, 1.0) == pytest.approx(math.exp(-3.0))


def test_the_wall_blinds_its_own_gate_alone() -> None:
    """10 m in four gates of 2.5 m: a wall at 3 m takes first photons at 4 m, none at 6 m."""
    spad = SpadParams(arming="gated", gates=4)
    range_m = np.array([4.0, 6.0])
    found = photon_snr(spad, range_m, 1.0, 4.0, 3.0) / photon_snr(spad, range_m, 1.0)
    assert found == pytest.approx(np.array([math.exp(-4.0), 1.0]))


def test_gates_bring_back_what_a_long_period_loses() -> None:
    """1 MHz: 150 m. Ungated, ambient light takes all but e^-6 of the first photons before 30 m; gates of 1/16, few."""
    slow = {"repetition_rate_hz": 1e6, "arming": "gated"}
    plain, gated = (spad_snr(SpadParams(gates=gates, **slow), 30.0, 0.3) for gates in (1, 16))
    gate_s, delay_s = 1e-6 / 16, 2.0 * 30.0 / SPEED_OF_LIGHT_MPS
    earlier = 3e7 * (delay_s // gate_s) * gate_s
    assert gated / plain == pytest.approx(math.exp(earlier) / 16.0, rel=1e-3)


def test_thresholds_are_the_noise_laws_turned_round() -> None:
    """exp(-T) and erfc(sqrt(T / 2)) / 2 give back the probability; from 1/2 on any excess will do."""
    false_alarm = np.array([1e-12, 1e-6, 0.1])
    assert np.exp(-radar_threshold(false_alarm)) == pytest.approx(false_alarm, rel=1e-12, abs=0.0)
    assert 0.5 * erfc(np.sqrt(0.5 * spad_threshold(false_alarm))) == pytest.approx(false_alarm, rel=1e-10, abs=0.0)
    assert spad_threshold(np.array([0.5, 0.9])).tolist() == [0.0, 0.0]


def test_half_range() -> None:
    """Best 0.8 at 20 m; 0.5 to 0.2 from 30 to 40 m passes 0.4 at 33.33 m; a dip before does not count."""
    range_m, value = np.array([5.0, 10.0, 20.0, 30.0, 40.0]), np.array([0.7, 0.1, 0.8, 0.5, 0.2])
    assert half_range(range_m, value) == pytest.approx(30.0 + 10.0 / 3.0)
    assert half_range(range_m[:4], value[:4]) == np.inf
    assert half_range(range_m, np.zeros(5)) == 0.0
    assert half_range(range_m, np.array([1.0, 0.5, 0.0, 0.0, 0.0])) == 10.0
    assert half_range(np.array([5.0]), np.array([0.3])) == np.inf


@pytest.mark.parametrize(
    ("call", "complaint"),
    [
        (lambda: radar_snr(XBAND, 0.0, 1.0), "range_m must be finite and positive, got 0.0"),
        (lambda: radar_snr(XBAND, np.array([5.0, np.nan]), 1.0), "range_m must be finite and positive"),
        (lambda: radar_snr(XBAND, 5.0, -1.0), "rcs_m2 must be finite and not negative, got -1.0"),
        (lambda: radar_snr(XBAND, 5.0, 1.0, 1.1), "wall_power_per_bounce must lie in 0..1, got 1.1"),
        (lambda: photon_snr(SpadParams(), -5.0, 1.0), "range_m must be finite and positive, got -5.0"),
        (lambda: photon_snr(SpadParams(), 5.0, 1.0, -1.0), "earlier_photons must be finite and not negative"),
        (lambda: photon_snr(SpadParams(), 5.0, 1.0, 1.0, np.inf), "earlier_range_m must be finite and positive"),
        (lambda: photon_snr(SpadParams(), 5.0, np.inf), "photons must be finite and not negative, got inf"),
        (lambda: photon_snr(SpadParams(), 5.0, 1.0, cell_m=0.0), "cell_m must be finite and positive, got 0.0"),
        (lambda: radar_threshold(0.0), r"false_alarm must lie in \(0, 1\), got 0.0"),
        (lambda: spad_threshold(np.nan), r"false_alarm must lie in \(0, 1\), got nan"),
        (lambda: half_range(np.ones(3), np.ones(3)), "range_m must be finite and rise"),
        (lambda: half_range(np.ones(2), np.ones(3)), r"of one shape \[N\], N > 0, got \(2,\) and \(3,\)"),
        (lambda: half_range(np.arange(2.0), np.array([0.1, np.nan])), "value must be finite and not negative"),
    ],
)
def test_complaints(call: Callable[[], object], complaint: str) -> None:
    with pytest.raises(ValueError, match=complaint):
        call()
