"""The fit of a hidden plane against histograms of known response, written out with scipy's modified Gaussian."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import exponnorm, norm

from benchmarks.simulator.photon_target import (
    BINS_PER_CELL,
    Observed,
    Plane,
    Response,
    Window,
    fit_at,
    fit_response,
    matt_share,
    plane_patches,
)
from lab.transients.scan import ConfocalTransients
from lab.transients.shape import HiddenShape
from msgs.values.units import SPEED_OF_LIGHT_MPS

TRUE = Response(rms_s=40e-12, tail_share=0.4, tail_s=250e-12, entrance_exponent=1.0, depth_m=0.40)
BIN_S, POINTS, SIDE = 8e-12, 6, 8
WINDOW = Window(300, 700, 780, 1000)
FLOOR = 0.5


def scan_and_plane(seed: int = 0, photons: float = 4000.0) -> tuple[ConfocalTransients, Plane]:
    """Six by six wall points of 0.6 x 0.6 m, a tilted plane of 8 x 8 patches at 0.4 m, every other of them white."""
    empty = ConfocalTransients(np.zeros((POINTS, POINTS, 1000), np.uint32), 0.3, BIN_S)
    shape = HiddenShape(np.ones((POINTS, POINTS)), np.ones((POINTS, POINTS)), np.ones(1, bool), (0.40, 0.05, -0.1))
    plane = plane_patches(shape, empty, SIDE)
    reflectance = np.indices((SIDE, SIDE)).sum(axis=0).ravel() % 2
    edges_s = np.arange(empty.bins + 1) * BIN_S
    expected = np.full(empty.counts.shape, FLOOR)
    for row, column in np.ndindex(POINTS, POINTS):
        depth_m = 0.40 + plane.places_m @ np.array(plane.slopes)
        across_m = plane.places_m - np.array([empty.wall_m[row], empty.wall_m[column]])
        range_m = np.sqrt(np.square(across_m).sum(axis=1) + np.square(depth_m))
        facing = (depth_m + across_m @ np.array([-0.05, 0.1])) / np.sqrt(1.0 + 0.05**2 + 0.1**2) / range_m
        level = reflectance * facing * depth_m / range_m**3
        delay_s = (2.0 * range_m / SPEED_OF_LIGHT_MPS)[:, None]
        until = 0.6 * norm.cdf(edges_s, delay_s, TRUE.rms_s) + 0.4 * exponnorm.cdf(
            edges_s, TRUE.tail_s / TRUE.rms_s, delay_s, TRUE.rms_s
        )
        expected[row, column] += photons * (1.0 + row) / POINTS * (level / level.sum()) @ np.diff(until, axis=1)
    counts = np.random.default_rng(seed).poisson(expected).astype(np.uint32)
    return replace(empty, counts=counts), plane


def observed(scan: ConfocalTransients) -> Observed:
    rows, columns = (one.ravel() for one in np.indices((POINTS, POINTS)))
    return Observed.of(scan, WINDOW, rows, columns)


def test_the_true_response_fits_to_the_last_photon_and_others_do_not() -> None:
    """Deviance a cell about 1 of Poisson counts (less few of 64 + 36 unknowns in 3600); other laws cost hundreds."""
    scan, plane = scan_and_plane()
    seen = observed(scan)
    true = fit_at(scan, WINDOW, plane, seen, TRUE)
    assert 0.9 < true.deviance / seen.counts.size < 1.15
    assert true.expected.sum() == pytest.approx(seen.counts.sum(), rel=1e-3)
    for wrong in (
        fit_at(scan, WINDOW, plane, seen, replace(TRUE, tail_share=0.0)),
        fit_at(scan, WINDOW, plane, seen, replace(TRUE, depth_m=0.41)),
        fit_at(scan, WINDOW, plane, seen, TRUE, matt_share),
    ):
        assert wrong.deviance > true.deviance + 100.0


def test_reflectances_and_gains_come_back() -> None:
    """Chequers 7.5 cm wide: white ones brighter than black ones; gains rise with the rows as the photons do, in 5 %."""
    scan, plane = scan_and_plane()
    fit = fit_at(scan, WINDOW, plane, observed(scan), TRUE)
    is_white = np.indices((SIDE, SIDE)).sum(axis=0).ravel() % 2 == 1
    assert fit.reflectance[is_white].mean() > 4.0 * fit.reflectance[~is_white].mean()
    photons = (fit.expected - FLOOR * BINS_PER_CELL).sum(axis=1).reshape(POINTS, POINTS).mean(axis=1)
    assert photons / photons[-1] == pytest.approx((1.0 + np.arange(POINTS)) / POINTS, rel=0.05)


@pytest.mark.slow
def test_the_search_finds_the_response() -> None:
    """From a start that is off by a third: jitter within 15 %, share within 0.08, tail within 20 %, depth in 2 mm.

    Known bias: reflectances of 40 updates are still a little smooth, which the response makes up for by a smaller tail.
    """
    scan, plane = scan_and_plane()
    start = Response(rms_s=55e-12, tail_share=0.25, tail_s=180e-12, entrance_exponent=2.0, depth_m=0.404)
    found, fit = fit_response(scan, WINDOW, plane, observed(scan), start, 200)
    assert found.rms_s == pytest.approx(TRUE.rms_s, rel=0.15)
    assert found.tail_share == pytest.approx(TRUE.tail_share, abs=0.08)
    assert found.tail_s == pytest.approx(TRUE.tail_s, rel=0.2)
    assert found.entrance_exponent == pytest.approx(1.0, abs=0.8)
    assert found.depth_m == pytest.approx(TRUE.depth_m, abs=0.002)
    assert fit.deviance / fit.expected.size < 1.2


def test_late_light_of_the_wall_is_background() -> None:
    """An exponential of 0.4 ns and a floor, no hidden light: background within 3 sd of the counts, cell by cell."""
    time_s = (np.arange(1000) + 0.5) * BIN_S
    counts = np.random.default_rng(1).poisson(
        np.broadcast_to(1e4 * np.exp(-time_s / 0.4e-9) + FLOOR, (POINTS, POINTS, 1000))
    )
    seen = observed(ConfocalTransients(counts.astype(np.uint32), 0.3, BIN_S))
    total, wanted = seen.counts.sum(axis=0), seen.background.sum(axis=0)
    assert np.mean(np.square(total - wanted) / wanted) < 1.5


@pytest.mark.parametrize(
    ("window", "message"),
    [
        ((0, 400, 500, 600), "window must hold bins in order"),
        ((400, 400, 500, 600), "window must hold bins in order"),
        ((300, 401, 500, 600), "window must hold a multiple of 4 bins, got 101"),
        ((300, 400, 600, 600), "window must hold bins in order"),
    ],
)
def test_windows_that_are_none(window: tuple[int, int, int, int], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        Window(*window)


def test_a_window_beyond_the_bins() -> None:
    scan, _ = scan_and_plane()
    with pytest.raises(ValueError, match="window must lie within 1000 bins"):
        Observed.of(scan, Window(300, 700, 900, 1001), np.zeros(1, int), np.zeros(1, int))
