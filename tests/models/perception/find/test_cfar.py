from __future__ import annotations

import math

import msgspec
import numpy as np
import pytest
from scipy.stats import binom

from models.perception.find.cfar import (
    PHOTON_CFAR,
    CfarParams,
    cfar_peaks,
    classify_behind_walls,
    detect,
    ordered_statistic_mask,
)
from models.perception.find.ridges import RidgeParams, side_lobes
from models.perception.form.coarray import AzimuthInterpolator, beam_matrix, coefficient_phases
from msgs.values.perception import PathClass
from msgs.values.radar import RadarSetup, RangeAzimuthGrid, RangeAzimuthMap
from tests.builders import example_map, peaks_at

GRID = RangeAzimuthGrid()


def ra_map(values: np.ndarray, noise_mw: float = 1.0) -> RangeAzimuthMap:
    return example_map(
        values.astype(np.complex64),
        stamp_ns=7,
        scan_id=3,
        azimuth_stamp_ns=np.arange(256, dtype=np.int64),
        noise_power_mw=noise_mw,
    )


def noise(seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return (rng.normal(size=GRID.shape) + 1j * rng.normal(size=GRID.shape)) / math.sqrt(2.0)


def lobe(range_m: float, azimuth_deg: float, snr_db: float) -> np.ndarray:
    """A smooth main lobe, 2 bins and 9 degrees wide, without side lobes."""
    range_part = np.exp(-(((GRID.range_m - range_m) / GRID.range_bin_m / 1.2) ** 2) / 2.0)
    azimuth_part = np.exp(-(((np.degrees(GRID.azimuth_rad) - azimuth_deg) / 5.4) ** 2))
    return 10.0 ** (snr_db / 20.0) * np.outer(range_part, azimuth_part)


@pytest.mark.parametrize("rate", [1e-2, 1e-3])
def test_false_alarm_rate_on_exponential_noise(rate):
    """Independent exponential cells: alarms are binomial up to the correlation that shared training cells bring,
    which widens the spread; the interval is that of 99.99 %, widened by half."""
    power = np.square(np.abs(noise(11)))
    alarms = int(ordered_statistic_mask(power, CfarParams(false_alarm_rate=rate)).sum())
    low, high = binom.interval(0.9999, power.size, rate)
    middle, half = 0.5 * (low + high), 0.75 * (high - low)
    assert middle - half <= alarms <= middle + half


def test_scale_of_the_map_does_not_matter():
    power = np.square(np.abs(noise(2)))
    params = CfarParams(false_alarm_rate=1e-3)
    np.testing.assert_array_equal(
        ordered_statistic_mask(power, params), ordered_statistic_mask(power * 2.0**-40, params)
    )


def echo_map(azimuth_deg: float, mode: str = "coherent") -> RangeAzimuthMap:
    """Return the map of a point echo of 40 dB as the beams of the default radar see it, whatever its azimuth."""
    setup = RadarSetup()
    coefficients = np.exp(-1j * coefficient_phases(setup) * math.sin(math.radians(azimuth_deg)))
    beams = np.zeros((25, 512), np.complex64)
    beams[:, 100] = 100.0 * beam_matrix(setup) @ coefficients
    values, _ = AzimuthInterpolator(setup).interpolate(beams, 1.0)
    return msgspec.structs.replace(ra_map(values + 0.1 * noise(4)), mode=mode)


@pytest.mark.parametrize("azimuth_deg", [55.0, -55.0, 59.0, -59.6, 60.0])
def test_an_echo_up_to_the_border_of_the_map_is_where_it_is(azimuth_deg: float) -> None:
    """Cells are 0.47 degrees wide."""
    peaks = detect(echo_map(azimuth_deg), CfarParams())
    np.testing.assert_allclose(np.degrees(peaks.azimuth_rad), [azimuth_deg], atol=0.3)


@pytest.mark.parametrize("azimuth_deg", [61.0, -61.0, 65.0, 70.0, -75.0, 85.0])
def test_an_echo_from_beyond_the_map_does_not_stand_at_its_border(azimuth_deg: float) -> None:
    """Nor at the other one, where the array's period of 2 in the sine shows it from 70 degrees on."""
    assert len(detect(echo_map(azimuth_deg), CfarParams())) == 0


def test_a_lidar_sees_to_the_border_of_its_map() -> None:
    """Its pixels have no lobes: what rises towards the border is there."""
    peaks = detect(echo_map(65.0, mode="photons"), PHOTON_CFAR)
    assert np.degrees(peaks.azimuth_rad).max() == pytest.approx(60.0)


def test_detects_and_refines_one_target():
    """At 30 dB the bound is below 0.02 m and 0.2 deg; the Gaussian lobe is a parabola in log, noise adds some."""
    peaks = detect(ra_map(noise(5) + lobe(20.03, 11.0, 30.0)), CfarParams())
    assert len(peaks) == 1
    assert peaks.range_m[0] == pytest.approx(20.03, abs=0.06)
    assert math.degrees(peaks.azimuth_rad[0]) == pytest.approx(11.0, abs=1.0)
    assert peaks.snr_db[0] == pytest.approx(30.0, abs=1.5)
    assert (peaks.scan_id, peaks.stamp_ns) == (3, 7)


def test_side_lobes_of_a_stronger_peak():
    cells = np.array([[100, 128], [101, 40], [100, 220], [106, 130], [140, 40]])
    level_db = np.array([60.0, 30.0, 45.0, 25.0, 30.0])
    # 30 dB down at its range; only 15 dB down; 35 dB down near it in its beam; elsewhere
    assert side_lobes(cells, level_db, RidgeParams()).tolist() == [False, True, False, True, False]


def test_classes_come_from_the_walls_in_front():
    wall = np.stack([np.full(15, 20.0), np.linspace(-7.0, 7.0, 15)], axis=1)
    image, beside, nearer = [28.0, 3.0], [28.0, 20.0], [10.0, 1.0]
    peaks = peaks_at(np.vstack([wall, image, beside, nearer]), stds=(0.1, 0.014))
    classified = classify_behind_walls(peaks)
    assert classified.path_class.tolist() == [PathClass.LOS] * 15 + [PathClass.MIRRORED, PathClass.LOS, PathClass.LOS]


def test_empty_map_gives_no_peaks():
    assert len(cfar_peaks(ra_map(np.zeros(GRID.shape)), CfarParams())) == 0


def test_refuses_parameters_that_make_no_sense():
    with pytest.raises(ValueError, match="false_alarm_rate"):
        CfarParams(false_alarm_rate=0.0)
