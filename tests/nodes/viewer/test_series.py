"""Series of numbers over time: bounded, interrupted where a field is missing, thinned without losing extremes."""

from __future__ import annotations

import math

import numpy as np
import pytest

from nodes.viewer.newest import SERIES, Board
from nodes.viewer.series import LEAST_GAP_NS, MAX_FIELDS, MAX_SAMPLES, MAX_SENT, MAX_SERIES, SeriesStore, thinned

PERIOD_NS = 300_000_000


def number_of(store: SeriesStore, group: str, field: str) -> int:
    return next(row[0] for row in store.fields_json()["fields"] if row[1:] == [group, field])


def samples(store: SeriesStore, group: str, field: str) -> tuple[list[float], list[float]]:
    (series,) = store.series_json([number_of(store, group, field)])["series"]
    return series["t"], series["v"]


def test_live_times_count_back_from_now() -> None:
    store = SeriesStore()
    for scan in range(3):
        store.take("views", [("latency_ms", 10.0 * scan)], 7 * 10**9 + scan * PERIOD_NS)
    assert samples(store, "views", "latency_ms") == ([-0.6, -0.3, 0.0], [0.0, 10.0, 20.0])
    # nothing more comes: what was measured grows old
    store.advance(7 * 10**9 + 2 * PERIOD_NS + 5 * 10**9)
    assert samples(store, "views", "latency_ms") == ([-5.6, -5.3, -5.0], [0.0, 10.0, 20.0])


def test_times_of_a_recording_count_from_its_first_scan() -> None:
    store = SeriesStore(keeps_all=True)
    for scan in range(3):
        store.take("views", [("count", 1.0)], scan * PERIOD_NS)
    store.set_zero(PERIOD_NS)
    assert samples(store, "views", "count")[0] == [-0.3, 0.0, 0.3]


def test_a_field_that_vanishes_ends_its_line_once_and_may_begin_again() -> None:
    store = SeriesStore()
    for scan, has_track in enumerate((True, False, False, True)):
        store.take("views", [("count", 1.0), *([("tracks.3.x_m", 5.0)] if has_track else [])], scan * PERIOD_NS)
    times, values = samples(store, "views", "tracks.3.x_m")
    assert times == [-0.9, -0.6, 0.0]
    assert values[0] == values[2] == 5.0
    assert math.isnan(values[1])
    assert samples(store, "views", "count")[1] == [1.0] * 4


def test_samples_that_come_too_fast_or_from_the_past_are_not_due() -> None:
    store = SeriesStore()
    assert store.is_due("vehicle/state", 10**9)
    store.take("vehicle/state", [("speed_mps", 1.0)], 10**9)
    assert not store.is_due("vehicle/state", 10**9 + LEAST_GAP_NS - 1)
    assert store.is_due("vehicle/state", 10**9 + LEAST_GAP_NS)
    assert not store.is_due("vehicle/state", 0)
    assert store.is_due("views", 0)


@pytest.mark.parametrize("keeps_all", [False, True])
def test_a_long_run_is_bounded(keeps_all: bool) -> None:
    """Live the newest samples stay, of a recording the whole span."""
    store, count = SeriesStore(keeps_all), 20_000
    for scan in range(count):
        store.take("views", [("latency_ms", 99.0 if scan == 4321 else float(scan % 7))], scan * PERIOD_NS)
    series = store._groups["views"]["latency_ms"]
    assert len(series.values) == len(series.times_s) <= MAX_SAMPLES
    times, values = samples(store, "views", "latency_ms")
    assert len(times) == len(values) <= MAX_SENT
    assert times == sorted(times)
    assert times[-1] == 0.0
    span_s = 0.3 * (count - 1)
    assert (times[0] == pytest.approx(-span_s, abs=3.0)) == keeps_all
    assert (99.0 in values) == keeps_all


def test_a_hundred_thousand_fields_are_cut() -> None:
    store = SeriesStore()
    for scan in range(3):
        store.take("views", ((f"field{index}", float(index)) for index in range(100_000)), scan * PERIOD_NS)
    assert len(store.fields_json()["fields"]) == MAX_FIELDS


def test_silent_series_make_room_for_new_ones_and_living_ones_stay() -> None:
    """A new group every second, of nodes that a peer makes up: two lines that go on stay, memory does not grow."""
    store = SeriesStore()
    for second in range(200):
        store.take("views", [("latency_ms", 1.0)], second * 10**9)
        store.take(f"node {second}", [(f"f{index}", 1.0) for index in range(20)], second * 10**9)
    names = {(group, field) for _, group, field in store.fields_json()["fields"]}
    assert len(names) <= MAX_SERIES
    assert ("views", "latency_ms") in names
    assert ("node 199", "f0") in names
    assert ("node 0", "f0") not in names
    assert len(store._groups) == len(store._taken_ns) <= MAX_SERIES // 20 + 2
    assert store.series_json([1, 10**30, -1])["series"][0]["id"] == 1


def test_no_room_is_made_at_the_cost_of_what_lives() -> None:
    store = SeriesStore()
    for group in range(4):
        store.take(f"g{group}", [(f"f{index}", 1.0) for index in range(MAX_FIELDS)], 0)
    rows = store.fields_json()["fields"]
    assert len(rows) == MAX_SERIES
    assert {group for _, group, _ in rows} == {"g0", "g1"}


@pytest.mark.parametrize("seed", range(5))
def test_thinning_halves_and_keeps_extremes(seed: int) -> None:
    rng = np.random.default_rng(seed)
    times_s, values = np.arange(1003.0), rng.standard_normal(1003)
    thin_s, thin = thinned(times_s, values)
    assert len(thin) <= 504
    assert (thin.min(), thin.max()) == (values.min(), values.max())
    assert np.array_equal(values[thin_s.astype(int)], thin)
    assert (np.diff(thin_s) > 0).all()


@pytest.mark.parametrize("gaps", [[0], [0, 2], [0, 1, 2, 3]])
def test_thinning_of_gaps_ends(gaps: list[int]) -> None:
    """Alternating gaps must not keep a series at its length for ever."""
    values = np.ones(1000)
    for gap in gaps:
        values[gap::4] = np.nan
    _, thin = thinned(np.arange(1000.0), values)
    assert len(thin) == 500
    assert np.isnan(thin).any()
    assert np.isfinite(thin).any() == (len(gaps) < 4)


def test_equal_samples_keep_their_ends() -> None:
    thin_s, _ = thinned(np.arange(8.0), np.ones(8))
    assert thin_s.tolist() == [0.0, 3.0, 4.0, 7.0]


def test_the_board_tells_of_new_samples_and_of_new_fields_only() -> None:
    board = Board()
    board.post_series()
    assert board.newer({}) == {}
    board.series.take("views", [("count", 1.0)], 0)
    board.post_series()
    assert set(board.newer({})) == {"fields", SERIES}
    board.series.take("views", [("count", 2.0)], PERIOD_NS)
    board.post_series()
    board.post_series()
    assert {kind: posted.version for kind, posted in board.newer({}).items()} == {"fields": 1, SERIES: 2}
