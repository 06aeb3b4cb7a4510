"""Photon maps: counts are conserved, ambient light alone is one standard deviation, walls and gates change neither."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.stats import poisson

from models.perception.find.cfar import PHOTON_CFAR
from models.perception.find.detectors import PhotonDetector
from models.perception.form.photon_map import photon_map, project_counts
from models.perception.mirrors.observability import VisibilityParams, observability
from models.physics.photons.counting import draw_histogram
from msgs.values.lidar import LidarSetup, PhotonHistograms, SpadParams
from msgs.values.perception import BevGrid, Visibility
from msgs.values.radar import RangeAzimuthGrid, RangeAzimuthMap
from msgs.values.units import SPEED_OF_LIGHT_MPS
from tests.builders import example_map

GATED = SpadParams(arming="gated")
AZIMUTHS = 64


def setup(spad: SpadParams, range_bin_m: float = RangeAzimuthGrid().range_bin_m) -> LidarSetup:
    return LidarSetup(spad=spad, grid=RangeAzimuthGrid(azimuth_bins=AZIMUTHS, range_bin_m=range_bin_m))


def mapped(lidar: LidarSetup, counts: np.ndarray) -> RangeAzimuthMap:
    stamps = np.zeros(len(counts), np.int64)
    return photon_map(
        lidar, PhotonHistograms(stamp_ns=0, scan_id=0, counts=counts.astype("<u4"), azimuth_stamp_ns=stamps)
    )


def ticks_as_bins(spad: SpadParams, ticks: np.ndarray) -> np.ndarray:
    """Histogram of events that fall into whole ticks [ticks]."""
    bins = np.floor(np.arange(len(ticks)) * spad.tick_s / spad.bin_s + 1e-9).astype(int)
    return np.bincount(np.minimum(bins, spad.bins - 1), weights=ticks, minlength=spad.bins).astype(np.int64)


def armed_anew(spad: SpadParams, rng: np.random.Generator, wall: tuple[float, float] | None = None) -> np.ndarray:
    """Counts [azimuth, bins] of a gated detector; `wall`: its delay [s] and photons a pulse."""
    delay_s, photons = np.array([wall]).T if wall else np.zeros((2, 0))
    return np.array([draw_histogram(spad, delay_s, photons, rng) for _ in range(AZIMUTHS)])


def free_running(spad: SpadParams, rng: np.random.Generator) -> np.ndarray:
    """First ambient photons of each period [azimuth, bins] of a detector that is dead after every one: renewals."""
    counts = []
    for _ in range(AZIMUTHS):
        gaps_s = rng.exponential(1.0 / spad.ambient_rate_hz, int(1.2 * spad.ambient_rate_hz * spad.measurement_time_s))
        time_s = np.cumsum(gaps_s + spad.dead_time_s)
        period = np.floor(time_s / spad.period_s).astype(np.int64)
        _, first = np.unique(period[period < spad.pulses], return_index=True)
        ticks = ((time_s - period * spad.period_s)[first] / spad.tick_s).astype(np.int64)
        counts.append(ticks_as_bins(spad, np.bincount(ticks)))
    return np.array(counts)


@pytest.mark.parametrize("range_bin_m", [0.005, 0.0195, 0.214, 3.0])
def test_projection_conserves_counts(range_bin_m: float) -> None:
    """Cells finer than bins, about as fine, and coarser: nothing is lost of what lies in the grid's range."""
    counts = np.random.default_rng(0).integers(0, 1000, (AZIMUTHS, GATED.bins))
    lidar = setup(GATED, range_bin_m)
    projected = project_counts(counts, GATED, lidar.grid)
    edge_m = (lidar.grid.range_bins - 0.5) * range_bin_m
    inside = np.clip(edge_m / (GATED.unambiguous_range_m / GATED.bins) - np.arange(GATED.bins), 0.0, 1.0)
    np.testing.assert_allclose(projected.sum(axis=0), counts @ inside, rtol=1e-12)


def test_a_bin_lies_where_its_light_comes_from() -> None:
    """Bin j covers R = c t / 2 from j to j + 1 bins: its middle of mass over range cells, to half a cell."""
    lidar = setup(GATED)
    counts = np.zeros((AZIMUTHS, GATED.bins))
    counts[:, 300] = 1.0
    projected = project_counts(counts, GATED, lidar.grid)[:, 0]
    range_m = 0.5 * SPEED_OF_LIGHT_MPS * 300.5 * GATED.bin_s
    assert abs(projected @ lidar.grid.range_m - range_m) <= 0.5 * lidar.grid.range_bin_m


@pytest.mark.slow
@pytest.mark.parametrize("way", ["gated", "free", "gates", "gates, ticks of the run"])
def test_ambient_light_alone_is_one_standard_deviation(way: str) -> None:
    """Table 2: 2 ambient photons a period, pile-up e^-2 at its end. Mean |value|^2 is 1 within four of its errors.

    Ticks of a run put the first 27 ps of a gate, on average, into the bin before it.
    """
    rng = np.random.default_rng(1)
    spad = GATED
    if way.startswith("gates"):
        spad = SpadParams(
            arming="gated", gates=3, repetition_rate_hz=5e6, tick_from="pulse" if way == "gates" else "run"
        )
    if way == "free":
        spad = SpadParams(measurement_time_s=0.01)
    ra_map = mapped(setup(spad), free_running(spad, rng) if way == "free" else armed_anew(spad, rng))
    reached = ra_map.grid.range_m < spad.unambiguous_range_m + 0.5 * ra_map.grid.range_bin_m
    values = ra_map.values.real[reached]
    assert (ra_map.values[~reached] == 0.0).all()
    error = math.sqrt(2.0 / values.size)
    assert abs(np.mean(values**2) - 1.0) <= 4.0 * error
    # the first cells are where the dead time of the period before reaches, and no cell is off as a whole
    assert np.abs(values.mean(axis=1)).max() <= 4.5 / math.sqrt(AZIMUTHS)
    assert ra_map.noise_power_mw == 1.0
    assert ra_map.mode == "photons"
    assert ra_map.saturated_share == 0.0


def test_neither_a_wall_nor_a_wrong_rate_moves_the_rest() -> None:
    """A wall of 1 photon a pulse takes 63 % of those that wait; the set-up says a third of the light."""
    true = SpadParams(arming="gated", ambient_rate_hz=9e6)
    counts = armed_anew(true, np.random.default_rng(2), wall=(2.0 * 5.0 / SPEED_OF_LIGHT_MPS, 1.0))
    ra_map = mapped(setup(SpadParams(arming="gated", ambient_rate_hz=3e6)), counts)
    values = ra_map.values.real[:46]
    wall = np.abs(ra_map.grid.range_m[:46] - 5.0) < 0.3
    assert values[wall].max(axis=0).min() > 500.0
    quiet = values[~wall]
    assert abs(np.mean(quiet**2) - 1.0) <= 4.0 * math.sqrt(2.0 / quiet.size)
    assert abs(quiet.mean()) <= 4.0 / math.sqrt(quiet.size)


def test_an_echo_stands_out_by_its_photons_over_the_root_of_the_light() -> None:
    """1e-3 photons a pulse at 3 m: excess W s (1 - l) over sqrt(W l (1 - l)), W = N e^-0.6 waiting."""
    spad = GATED
    delay_s = 2.0 * 3.0 / SPEED_OF_LIGHT_MPS
    ra_map = mapped(setup(spad), armed_anew(spad, np.random.default_rng(3), wall=(delay_s, 1e-3)))
    cell = round(3.0 / ra_map.grid.range_bin_m)
    left, right = 2.0 / SPEED_OF_LIGHT_MPS * ra_map.grid.range_bin_m * (cell + np.array([-0.5, 0.5]))
    light = spad.ambient_rate_hz * (right - left)
    waiting = spad.pulses * math.exp(-spad.ambient_rate_hz * left)
    wanted = waiting * 1e-3 / math.sqrt(waiting * light)
    # light within the cell takes 2 % of those that wait, and the mean over azimuths errs by 1 / 8
    assert ra_map.values.real[cell].mean() == pytest.approx(wanted, rel=0.03, abs=0.5)


def test_cells_that_nobody_was_left_to_see_are_nothing_and_said() -> None:
    counts = np.zeros((AZIMUTHS, GATED.bins), np.int64)
    counts[:, 256] = GATED.pulses
    ra_map = mapped(setup(GATED), counts)
    assert (ra_map.values[24:] == 0.0).all()
    assert (ra_map.values.real[23] == GATED.pulses).all()
    assert ra_map.saturated_share == pytest.approx(24 / 48)


def test_without_any_light_one_photon_is_one_deviation() -> None:
    """Nothing to divide by: a dark detector, a blind azimuth."""
    dark = SpadParams(arming="gated", ambient_rate_hz=0.0)
    counts = np.zeros((AZIMUTHS, dark.bins), np.int64)
    counts[3, 100] = 7
    values = mapped(setup(dark), counts).values
    assert np.isfinite(values).all()
    assert values[:, 3].sum() == pytest.approx(7.0, rel=1e-6)
    assert (values[:, 4] == 0.0).all()


@pytest.mark.parametrize(
    ("counts", "words"),
    [
        (np.zeros((AZIMUTHS, 511)), r"shape \(64, 512\) as lidar/setup says, got \(64, 511\)"),
        (np.zeros((63, 512)), r"got \(63, 512\)"),
        (np.full((AZIMUTHS, 512), 1000), "at most 450000 pulses an azimuth, got 512000"),
    ],
)
def test_histograms_of_another_sensor_are_refused_in_a_line(counts: np.ndarray, words: str) -> None:
    with pytest.raises(ValueError, match=words) as caught:
        mapped(setup(GATED), counts)
    assert "\n" not in str(caught.value)


def test_the_detector_takes_an_excess_and_no_lack_and_claims_to_see_nothing() -> None:
    grid = RangeAzimuthGrid(azimuth_bins=AZIMUTHS)
    values = np.zeros(grid.shape, np.complex64)
    values[40, 20], values[40, 50] = 10.0, -10.0
    ra_map = example_map(values, grid=grid, mode="photons")
    peaks = PhotonDetector().detect(ra_map)
    assert peaks.range_m == pytest.approx([40 * grid.range_bin_m])
    assert peaks.snr_db == pytest.approx([20.0])
    assert (observability([], peaks.sensitivity_db, BevGrid(), VisibilityParams()) == Visibility.UNKNOWN).all()


def test_few_counts_raise_no_more_alarms_than_said() -> None:
    """The largest chance of a cell over the threshold, whatever its expected count: Poisson, as the comment says."""
    expected = np.geomspace(1e-3, 1e5, 4000)
    sigmas = 10.0 ** (PHOTON_CFAR.ridges.min_snr_db / 20.0)
    least = np.ceil(expected + sigmas * np.maximum(np.sqrt(expected), 1.0))
    assert poisson.sf(least - 1.0, expected).max() < 4e-5
