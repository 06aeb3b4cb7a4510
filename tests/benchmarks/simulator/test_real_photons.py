"""The comparison of real photons with simulated ones, on a scan whose model is known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.simulator.photon_target import fit_at, retroreflected_share
from benchmarks.simulator.real_photons import Fitted, Scene, compare, statistics
from tests.benchmarks.simulator.test_photon_target import TRUE, WINDOW, observed, scan_and_plane


def test_statistics_by_hand() -> None:
    counts, expected = np.array([6.0, 2.0, 4.0]), np.array([4.0, 4.0, 4.0])
    chi_square, ks = statistics(counts, expected)
    assert chi_square == pytest.approx((4.0 / 4.0 + 4.0 / 4.0) / 3.0)
    assert ks == pytest.approx(6.0 / 12.0 - 4.0 / 12.0)


def test_a_known_model_is_as_near_as_its_null_and_a_wrong_one_is_not() -> None:
    """One wall point, 100 cells: chi-square 1 within 4 sd (0.14 each); without the tail well beyond that."""
    scan, plane = scan_and_plane(photons=20_000.0)
    seen = observed(scan)
    wrong = replace(TRUE, tail_share=0.0)
    models = {
        name: Fitted(response, retroreflected_share, fit_at(scan, WINDOW, plane, seen, response))
        for name, response in (("wrong", wrong), ("true", TRUE))
    }
    table, _ = compare(scan, Scene("none.mat", WINDOW, 8, TRUE), plane, models, seed=0)
    assert table["true"]["chi_square"]["median"] == pytest.approx(1.0, abs=0.57)
    assert table["null"]["chi_square"]["median"] == pytest.approx(1.0, abs=0.57)
    assert table["wrong"]["chi_square"]["median"] > 1.6
