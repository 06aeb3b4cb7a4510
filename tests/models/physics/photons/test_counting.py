"""Photon counting: expected and drawn, against a literal reference and against closed forms.

Layouts are one period of Table 2 (15 MHz, 66.7 ns, 512 bins of 130.2 ps, ticks of 55 ps) with a few paths given by
delay and photons a pulse; measurements are short. Statistics are held by p-values of fixed seeds, which have to be
uniform (Kolmogorov-Smirnov, p > 0.01); the same test has to throw out the next best wrong law.
"""

from __future__ import annotations

import math
from fractions import Fraction

import msgspec
import numpy as np
import pytest
from scipy.stats import chi2, kstest

from models.physics.photons import counting
from models.physics.photons.counting import comb, draw_histogram, exact_draw, expected_histogram
from msgs.values.lidar import SpadParams
from tests.models.physics.photons.histograms import bins_of_ticks

SPAD = SpadParams()
#: A near path that dims what follows, a weak one, and one so late that its dead time reaches the next period.
DELAY_S, PHOTONS = np.array([20e-9, 48e-9, 64.8e-9]), np.array([0.6, 0.05, 0.8])
TICK, PERIOD = Fraction(55, 10**12), Fraction(1, 15 * 10**6)


def measured(pulses: int, **changes) -> SpadParams:
    """Table 2 with so many pulses."""
    return msgspec.structs.replace(SPAD, measurement_time_s=pulses / SPAD.repetition_rate_hz, **changes)


def literal_histogram(spad: SpadParams, rng: np.random.Generator) -> np.ndarray:
    """Section 2.2 word by word: all photons of Eqs. (11) and (12), sorted, dead time, first of period, ticks, bins."""
    total_s = spad.pulses * spad.period_s
    signal = [
        np.repeat(np.arange(spad.pulses), rng.poisson(photons, spad.pulses)) * spad.period_s + delay_s
        for delay_s, photons in zip(DELAY_S, PHOTONS, strict=True)
    ]
    signal_s = np.concatenate(signal)
    signal_s = signal_s + rng.normal(0.0, spad.timing_rms_s, len(signal_s))
    ambient_s = rng.uniform(0.0, total_s, rng.poisson(spad.ambient_rate_hz * total_s))
    kept: dict[int, float] = {}
    armed_s = 0.0
    for time_s in np.sort(np.concatenate([signal_s % total_s, ambient_s])).tolist():
        period = int(time_s // spad.period_s)
        if spad.arming == "gated":
            gate = period * spad.gates // spad.pulses  # shares are equal in the layouts below
            if not gate <= (time_s - period * spad.period_s) / spad.period_s * spad.gates < gate + 1:
                continue
        elif time_s < armed_s:
            continue
        kept.setdefault(period, time_s)
        armed_s = time_s + spad.dead_time_s
    periods, times_s = np.array(list(kept), np.int64), np.array(list(kept.values()))
    start_s = 0.0 if spad.tick_from == "run" else periods * spad.period_s
    ticks = np.floor((times_s - start_s) / spad.tick_s).astype(np.int64)
    return np.bincount(bins_of_ticks(ticks, PERIOD / TICK / spad.bins, spad.bins), minlength=spad.bins)


def p_value(counts: np.ndarray, expected: np.ndarray, periods: int) -> float:
    """Chi-square of counts and of periods without a photon; neighbouring bins are put together to expect 8 or more."""
    expected, counts = np.append(expected, periods - expected.sum()), np.append(counts, periods - counts.sum())
    group = np.minimum(np.cumsum(expected) // 8.0, expected.sum() // 8.0 - 1.0).astype(int)
    wanted, seen = np.bincount(group, expected), np.bincount(group, counts)
    wanted, seen = wanted[wanted > 0.0], seen[wanted > 0.0]
    return float(chi2.sf(np.sum((seen - wanted) ** 2 / wanted), len(wanted) - 1))


def uniformity(histograms: list[np.ndarray], expected: np.ndarray, periods: int) -> float:
    """p-value of the p-values of fixed seeds."""
    return float(kstest([p_value(one, expected, periods) for one in histograms], "uniform").pvalue)


@pytest.mark.parametrize("tick_from", ["pulse", "run"])
@pytest.mark.parametrize("arming", ["gated", "free"])
def test_draws_follow_the_expected_counts(arming: str, tick_from: str) -> None:
    """20,000 pulses; other ticks, or the other arming's law, are thrown out."""
    spad = measured(20_000, arming=arming, tick_from=tick_from)
    expected = expected_histogram(spad, DELAY_S, PHOTONS)

    histograms = [draw_histogram(spad, DELAY_S, PHOTONS, np.random.default_rng(seed)) for seed in range(20)]
    assert uniformity(histograms, expected, spad.pulses) > 0.01
    for wrong in ({"arming": {"free": "gated"}.get(arming, "free")}, {"tick_s": 0.0}):
        law = expected_histogram(msgspec.structs.replace(spad, **wrong), DELAY_S, PHOTONS)
        # ticks of a run are nearly as good as none: their phases average
        if wrong != {"tick_s": 0.0} or tick_from == "pulse":
            assert uniformity(histograms, law, spad.pulses) < 1e-6


@pytest.mark.parametrize(
    ("pulses", "changes"),
    [
        (1500, {"tick_from": "run"}),
        (1500, {"arming": "gated", "tick_from": "run"}),
        (1500, {"arming": "gated", "gates": 3}),
        (1500, {"dead_time_s": 30e-9, "ambient_rate_hz": 2e8}),
        (3000, {"dead_time_s": 90e-9, "tick_from": "run"}),
        (6000, {"dead_time_s": 2.013e-7}),
    ],
)
def test_the_literal_reference_has_the_same_law(pulses: int, changes: dict) -> None:
    """Every photon drawn, most thrown away: p-values against the expected counts."""
    spad = measured(pulses, **changes)
    expected = expected_histogram(spad, DELAY_S, PHOTONS)
    literal = [literal_histogram(spad, np.random.default_rng(seed)) for seed in range(12)]
    assert uniformity(literal, expected, spad.pulses) > 0.01


def test_little_light_is_poisson() -> None:
    """1e-4 photons a pulse and 1e3 /s ambient: counts are pulses times flux, less 2e-4 at most for pile-up."""
    spad = msgspec.structs.replace(SPAD, ambient_rate_hz=1e3)
    expected = expected_histogram(spad, DELAY_S, np.full(3, 1e-4))
    table = np.array([[3e-4 + 1e3 * spad.period_s]]) * spad.pulses
    assert expected.sum() == pytest.approx(table.item(), rel=2.5e-4)
    dark = np.r_[10:140]
    widths_s = np.diff(comb(spad).edges_s[0])[dark]
    np.testing.assert_allclose(expected[dark], spad.pulses * 1e3 * widths_s, rtol=2.0 * 3.7e-4)
    drawn = [draw_histogram(spad, DELAY_S, np.full(3, 1e-4), np.random.default_rng(seed)).sum() for seed in range(100)]
    assert np.mean(drawn) == pytest.approx(expected.sum(), abs=4.0 * math.sqrt(expected.sum() / 100))
    assert np.var(drawn) == pytest.approx(expected.sum(), rel=4.0 * math.sqrt(2.0 / 100))


@pytest.mark.parametrize("dead_time_s", [4e-9, 66e-9, 1.5e-7])
def test_constant_light_has_a_closed_form(dead_time_s: float) -> None:
    """Ambient 3e7 /s alone, always on: armed with a = 1 / (1 + flux tau), and first photons come at flux a until tau
    (what decays is replaced), then at flux a e^{-flux (t - tau)}; evenly where tau exceeds the period. Error: grid.
    """
    spads = [measured(pulses, dead_time_s=dead_time_s, tick_s=0.0) for pulses in (600, 1600)]
    lasting = np.subtract(*[expected_histogram(spad, [], []) for spad in spads[::-1]]) / 1000
    flux_hz, edges_s = SPAD.ambient_rate_hz, np.arange(513) * SPAD.bin_s
    late_s = np.maximum(edges_s - dead_time_s, 0.0)
    until = flux_hz * np.minimum(edges_s, dead_time_s) - np.expm1(-flux_hz * late_s)
    np.testing.assert_allclose(lasting, np.diff(until) / (1.0 + flux_hz * dead_time_s), rtol=1e-6)


@pytest.mark.parametrize("dead_time_s", [4e-9, 30e-9])
def test_half_the_cells_four_times_the_error(dead_time_s: float, monkeypatch: pytest.MonkeyPatch) -> None:
    """A bright pulse just before the period's end: against 64 cells a standard deviation, errors of 8 and 16."""
    spad = msgspec.structs.replace(SPAD, dead_time_s=dead_time_s)
    paths = (np.array([1e-9, 65e-9]), np.array([0.5, 3.0]))
    found = {}
    for cells in (8, 16, 64):
        monkeypatch.setattr(counting, "CELLS_PER_RMS", cells)
        found[cells] = expected_histogram(spad, *paths)
    coarse, fine = (np.abs(found[cells] - found[64]).max() for cells in (8, 16))
    assert coarse / fine > 3.0
    # of 450,000: what counting itself leaves uncertain is more
    assert (np.abs(found[16] - found[64]) < 0.02 * np.sqrt(found[64]) + 1e-6).all()


def test_a_point_falls_into_its_bin() -> None:
    """A pulse of a femtosecond and no ambient: every count in the bin of floor(delay / tick), edges too."""
    spad = measured(50, arming="gated", irf_fwhm_s=1e-15, jitter_rms_s=0.0, ambient_rate_hz=0.0)
    ticks = np.random.default_rng(0).integers(0, 1211, 20)
    for delay_s, tick in [*zip((ticks + 0.01) * 55e-12, ticks, strict=True), (264 * 55e-12 * 0.999, 263)]:
        counts = draw_histogram(spad, [delay_s], [60.0], np.random.default_rng(1))
        assert np.flatnonzero(counts).tolist() == [int(bins_of_ticks(tick, PERIOD / TICK / 512, 512))]
        assert counts.sum() == 50
        np.testing.assert_allclose(expected_histogram(spad, [delay_s], [60.0]), counts, atol=1e-9)


def test_a_point_falls_into_its_bins_when_ticks_run_on() -> None:
    """Ticks from the start of the run and four gates: the third gate's 9 or so pulses, each with its own phase."""
    spad = measured(
        35, arming="gated", gates=4, tick_from="run", irf_fwhm_s=1e-15, jitter_rms_s=0.0, ambient_rate_hz=0.0
    )
    delay = Fraction(40_013, 10**12)
    ticks = np.array([math.floor((period * PERIOD + delay) / TICK) for period in range(18, 27)])
    wanted = np.bincount(bins_of_ticks(ticks, PERIOD / TICK / 512, 512), minlength=512)
    assert np.count_nonzero(wanted) == 2
    paths = ([float(delay) + 3.0 * spad.period_s], [60.0])
    np.testing.assert_array_equal(draw_histogram(spad, *paths, np.random.default_rng(0)), wanted)
    np.testing.assert_allclose(expected_histogram(spad, *paths), wanted, atol=1e-9)


def test_ticks_of_a_run_come_round_after_33_periods() -> None:
    """66.67 ns / 55 ps = 40000 / 33; a tick that began in the last period puts its photons there, -1, -2/3, -1/3 ns
    with ticks of 1 ns.
    """
    bins = comb(msgspec.structs.replace(SPAD, tick_from="run"))
    assert bins.edges_s.shape == (33, 512)
    assert (np.diff(bins.edges_s) > 0.0).all()
    np.testing.assert_allclose(np.sort(bins.edges_s[:, 0]), np.arange(33) / 33 * 55e-12, rtol=1e-12, atol=0.0)
    assert (bins.first_bin == 511).all()
    coarse = comb(msgspec.structs.replace(SPAD, tick_from="run", tick_s=1e-9))
    assert coarse.first_bin.tolist() == [504, 506, 509]


def test_a_pulse_on_a_bin_edge_is_halved() -> None:
    """Nothing else about: the bin before and the bin behind tick 625, an edge too, get the same to pile-up."""
    spad = msgspec.structs.replace(SPAD, arming="gated", ambient_rate_hz=0.0)
    expected = expected_histogram(spad, [625 * 55e-12], [1e-6])
    assert expected[:264].sum() == pytest.approx(expected[264:].sum(), rel=2e-6)
    assert expected.sum() == pytest.approx(0.45, rel=1e-6)


def test_gates_share_the_pulses() -> None:
    """Seven pulses, three gates, light everywhere: 3, 2, 2 counts; a wall in the first gate blinds no other."""
    spad = measured(7, arming="gated", gates=3, tick_s=0.0, bins=3, ambient_rate_hz=1e13)
    np.testing.assert_allclose(expected_histogram(spad, [1e-9], [1e6]), [3.0, 2.0, 2.0])
    assert draw_histogram(spad, [1e-9], [1e6], np.random.default_rng(0)).tolist() == [3, 2, 2]


@pytest.mark.parametrize("arming", ["gated", "free"])
@pytest.mark.parametrize(
    ("changes", "photons"),
    [
        ({"ambient_rate_hz": 0.0}, 0.0),
        ({"ambient_rate_hz": 1e-300}, 0.0),
        ({"ambient_rate_hz": 0.0}, 1e-300),
        ({"ambient_rate_hz": 1e12}, 1e6),
        ({"ambient_rate_hz": 0.0}, 1e15),
        ({"dead_time_s": 0.0}, 1.0),
        ({"dead_time_s": 1e-16}, 1.0),
        ({"dead_time_s": 1.0 / 15e6}, 1.0),
        ({"dead_time_s": 1e-3}, 1.0),
        ({"dead_time_s": 1e6}, 1.0),
        ({"measurement_time_s": 1.0 / 15e6}, 1.0),
        ({"irf_fwhm_s": 1e-3}, 1.0),
        ({"irf_fwhm_s": 60e-9}, 1.0),
        ({"bins": 1, "tick_s": 1.0 / 15e6}, 1.0),
    ],
)
def test_any_detector_and_any_light_give_counts(arming: str, changes: dict, photons: float) -> None:
    """Whole counts, none more than pulses, near what is expected: five standard deviations and one count."""
    spad = msgspec.structs.replace(measured(500, arming=arming), **changes)
    paths = ([20e-9, 0.0, 3.0 / 15e6], [photons] * 3)
    expected = expected_histogram(spad, *paths)
    assert (expected >= 0.0).all()
    assert expected.sum() <= spad.pulses * (1.0 + 1e-9)
    counts = draw_histogram(spad, *paths, np.random.default_rng(0))
    assert counts.dtype == np.int64
    assert counts.sum() == pytest.approx(expected.sum(), abs=5.0 * math.sqrt(expected.sum()) + 1.0)


def test_the_first_period_begins_armed() -> None:
    """One pulse, always on, dead for an hour: the law of a gated one; of two pulses the second waits for the first."""
    one, two = (measured(pulses, dead_time_s=3600.0) for pulses in (1, 2))
    gated = expected_histogram(msgspec.structs.replace(one, arming="gated"), DELAY_S, PHOTONS)
    np.testing.assert_allclose(expected_histogram(one, DELAY_S, PHOTONS), gated, rtol=1e-9)
    missed = 1.0 - gated.sum()
    np.testing.assert_allclose(expected_histogram(two, DELAY_S, PHOTONS), gated * (1.0 + missed), rtol=1e-9)


def test_which_draws_are_exact() -> None:
    """Gated, without dead time, one pulse. Else the sum varies less in truth: 100 ns leave it 0.04 of the variance."""
    assert exact_draw(msgspec.structs.replace(SPAD, arming="gated"))
    assert exact_draw(msgspec.structs.replace(SPAD, dead_time_s=0.0))
    assert exact_draw(measured(1))
    assert not exact_draw(SPAD)
    spad = measured(1000, dead_time_s=100e-9)
    totals = [literal_histogram(spad, np.random.default_rng(seed)).sum() for seed in range(100)]
    share = expected_histogram(spad, DELAY_S, PHOTONS).sum() / 1000
    assert np.var(totals) < 0.2 * 1000 * share * (1.0 - share)


def test_same_seed_same_photons() -> None:
    first, second = (draw_histogram(measured(500), DELAY_S, PHOTONS, np.random.default_rng(3)) for _ in range(2))
    np.testing.assert_array_equal(first, second)


@pytest.mark.parametrize(
    ("changes", "delay_s", "photons", "rule"),
    [
        ({}, [-1e-9], [1.0], "delay_s must be finite and not negative, got -1e-09"),
        ({}, [np.nan], [1.0], "delay_s must be finite and not negative, got nan"),
        ({}, [1e-9], [-2.0], "photons must be finite and not negative, got -2.0"),
        ({}, [1e-9], [np.inf], "photons must be finite and not negative, got inf"),
        ({}, [1e-9], [1e300], r"photons must not exceed 1e\+100 a pulse, got 1e\+300"),
        ({}, [1e-9, 2e-9], [1.0], r"must both have shape \[paths\], got \(2,\) and \(1,\)"),
        ({"tick_from": "run", "tick_s": 54.7e-12}, [], [], "spad.tick_s must come round .* choose spad.tick_from"),
    ],
)
def test_what_is_no_light_is_refused(changes: dict, delay_s: list, photons: list, rule: str) -> None:
    spad, rng = msgspec.structs.replace(SPAD, repetition_rate_hz=14.99e6, **changes), np.random.default_rng(0)
    for call in (expected_histogram, draw_histogram):
        with pytest.raises(ValueError, match=rule):
            call(spad, delay_s, photons, *([] if call is expected_histogram else [rng]))


def test_a_period_of_too_many_cells_is_refused() -> None:
    spad = msgspec.structs.replace(SPAD, irf_fwhm_s=1e-15, jitter_rms_s=0.0)
    with pytest.raises(ValueError, match=r"spad.irf_fwhm_s must be wider, 1e-15 s takes \d+ cells"):
        expected_histogram(spad, [1e-9], [1.0])


@pytest.mark.parametrize(
    ("changes", "rule"),
    [
        ({"arming": "gated", "gates": 16384, "bins": 16384}, "spad.bins must not exceed 256 with 1 phases .*got 16384"),
        ({"tick_from": "run", "tick_s": 54.7e-12, "measurement_time_s": 2.7e-4, "bins": 16384}, "with [0-9]+ phases"),
    ],
)
def test_what_takes_no_end_is_refused(changes: dict, rule: str) -> None:
    with pytest.raises(ValueError, match=rule):
        draw_histogram(msgspec.structs.replace(SPAD, **changes), DELAY_S, PHOTONS, np.random.default_rng(0))


def test_a_dead_time_below_any_bin_counts_as_none() -> None:
    """0.1 ps, and 1e15 photons a second: not 67 million detections a period but the first of each."""
    spad = measured(500, dead_time_s=1e-13, ambient_rate_hz=1e15)
    assert exact_draw(spad)
    assert draw_histogram(spad, DELAY_S, PHOTONS, np.random.default_rng(0))[0] == 500
