"""Latency from the last beam, deadlines missed by late views and by scans without view, stage figures."""

from __future__ import annotations

import msgspec
import pytest

from msgs.values.diagnostics import SAMPLES_LIMIT, NodeState, NodeStatus, StageTime
from msgs.values.perception import BevFrame
from msgs.values.radar import BeamGrid, RadarSetup
from nodes.inputs.view_latency import NewObjects, ViewWatch, last_beam_ns, on_one_clock, stage_figures, views_text
from nodes.node import StageClock
from tests.builders import example_object, example_status
from tests.fuzz.cases import view

MS = 1_000_000
HIDDEN = example_object(id=1, x_m=3.0, y_m=1.0, score=0.5)
PERIOD_NS = 300 * MS
#: 24 intervals of 12 ms and 128 chirps of 5.461 us.
LAST_BEAM_NS = 288 * MS + 699_008


def watch_of(latencies_ms: dict[int, float], window_s: float = 10.0) -> tuple[ViewWatch, int]:
    """Views of scans by number, each so long after its last beam; and the arrival of the last."""
    watch, now_ns = ViewWatch(0, window_s), 0
    for scan, late_ms in latencies_ms.items():
        stamp_ns = scan * PERIOD_NS
        now_ns = stamp_ns + LAST_BEAM_NS + round(late_ms * MS)
        watch.add(scan, stamp_ns, now_ns)
    return watch, now_ns


def test_the_last_beam_ends_after_24_intervals_and_its_time_on_air() -> None:
    assert last_beam_ns() == pytest.approx(LAST_BEAM_NS, abs=2_000)
    one = RadarSetup(beams=BeamGrid(azimuth_deg=(0.0,)))
    assert last_beam_ns(one) == pytest.approx(699_008, abs=2_000)


def test_views_in_time_miss_nothing() -> None:
    watch, now_ns = watch_of({scan: 40.0 + scan for scan in range(21)})
    views = watch.figures(now_ns)
    assert (views.misses, views.misses_total, views.overdue) == (0, 0, 0)
    assert views.age_ms == pytest.approx(60.0, abs=0.01)
    assert views.latency_p50_ms == pytest.approx(50.0, abs=0.01)
    assert views.latency_max_ms == pytest.approx(60.0, abs=0.01)
    assert views.rate_hz == pytest.approx(21 / (1e-9 * now_ns))


def test_the_deadline_itself_is_in_time_and_a_millisecond_more_is_not() -> None:
    watch, now_ns = watch_of({0: 299.9, 1: 300.1, 2: 299.9})
    assert (watch.figures(now_ns).late, watch.figures(now_ns).late_total) == (1, 1)


def test_a_scan_without_view_is_a_missed_deadline() -> None:
    watch, now_ns = watch_of({0: 50.0, 1: 50.0, 5: 350.0, 6: 50.0})
    views = watch.figures(now_ns)
    assert (views.absent, views.late, views.misses, views.misses_total) == (3, 1, 4, 4)
    assert "missed 4x" in views_text(views)
    assert "1 late, 3 without view" in views_text(views)


def test_now_is_the_window_and_in_all_is_all() -> None:
    latencies_ms = {scan: 400.0 if scan < 5 else 50.0 for scan in range(50)}
    watch, now_ns = watch_of(latencies_ms, window_s=3.0)
    views = watch.figures(now_ns)
    assert (views.misses, views.misses_total) == (0, 5)
    assert (views.views, views.views_total) == (11, 50)


def test_silence_ages_the_view_and_deadlines_run_up() -> None:
    watch, now_ns = watch_of({0: 50.0})
    for silent_ms, overdue in ((500, 0), (560, 1), (860, 2), (3260, 10)):
        views = watch.figures(now_ns + silent_ms * MS)
        assert views.overdue == overdue
        assert views.age_ms == pytest.approx(50.0 + silent_ms, abs=0.01)


def test_a_source_that_starts_anew_misses_nothing() -> None:
    watch, _ = watch_of({100: 50.0})
    watch.add(0, 120 * PERIOD_NS, 120 * PERIOD_NS + LAST_BEAM_NS)
    # numbers that leap without time having passed are another source too
    watch.add(900, 121 * PERIOD_NS, 121 * PERIOD_NS + LAST_BEAM_NS)
    assert watch.figures(122 * PERIOD_NS).absent_total == 0


def test_a_stamp_of_another_clock_has_no_age() -> None:
    watch = ViewWatch(0)
    watch.add(0, 10**18, 1_000)
    views = watch.figures(2_000)
    assert (views.age_ms, views.latency_p50_ms, views.late_total, views.overdue) == (None, None, 0, 0)
    assert "unknown" in views_text(views)
    assert not on_one_clock(10**18, 0)


@pytest.mark.parametrize("late_s", [59, 61, 222, 86_400])
def test_a_view_is_late_however_old_it_is(late_s: int) -> None:
    """Whoever falls behind without bound is not in time after a minute."""
    watch, now_ns = watch_of(dict.fromkeys(range(34), 1000.0 * late_s), window_s=10.0)
    views = watch.figures(now_ns)
    assert (views.late, views.late_total) == (34, 34)
    assert views.age_ms == pytest.approx(1e3 * late_s)
    assert views.overdue == round((late_s - 0.3) / 0.3 - 0.5)


def test_what_was_measured_before_the_graph_ran_is_of_a_capture() -> None:
    """A watch that joins late learns from a heartbeat that the graph has run for 300 s, on whatever clock that is."""
    joined_ns = 10_000 * 1_000 * MS
    for age_s, is_known in ((0.4, True), (250.0, True), (301.0, False), (9_000.0, False)):
        watch = ViewWatch(joined_ns)
        watch.hear(example_status(stamp_ns=5, node="player", uptime_s=300.0), joined_ns)
        watch.hear(NodeStatus(stamp_ns=5, node="restarted", pid=2, state=NodeState.READY, uptime_s=1.0), joined_ns)
        watch.add(0, joined_ns - round(1e3 * age_s) * MS, joined_ns)
        assert (watch.figures(joined_ns).age_ms is not None) is is_known, age_s


def test_nothing_seen_is_said_so() -> None:
    assert views_text(ViewWatch(0).figures(1)) == "no view yet"


def test_stages_are_pooled_over_heartbeats_by_their_counts() -> None:
    beats = [
        StageTime(name="fold", count=3, last_ms=1.0, mean_ms=2.0, max_ms=3.0, samples_ms=(2.0, 3.0, 1.0)),
        StageTime(name="last", count=1, last_ms=9.0, mean_ms=9.0, max_ms=9.0),
        StageTime(name="fold", count=1, last_ms=10.0, mean_ms=10.0, max_ms=10.0, samples_ms=(10.0,)),
    ]
    fold, last = stage_figures(beats)
    assert (fold.name, fold.count, fold.mean_ms, fold.p50_ms, fold.max_ms) == ("fold", 4, 4.0, 2.5, 10.0)
    assert fold.p99_ms == pytest.approx(9.79)
    assert (last.name, last.p50_ms, last.p99_ms) == ("last", None, None), "a node of an older version sends no samples"


def test_samples_of_a_heartbeat_are_bounded_and_mean_and_worst_are_of_all() -> None:
    clock = StageClock()
    for _ in range(3 * SAMPLES_LIMIT + 1):
        with clock("fold"):
            pass
    (stage,) = clock.drain()
    assert stage.count == 3 * SAMPLES_LIMIT + 1
    assert SAMPLES_LIMIT / 2 < len(stage.samples_ms) <= SAMPLES_LIMIT
    assert stage.max_ms >= max(stage.samples_ms)


def rolled(settled_ns: int, *stamps_ns: int) -> BevFrame:
    """A view of rolling scans with objects measured at the stamps."""
    objects = tuple(msgspec.structs.replace(HIDDEN, stamp_ns=stamp_ns) for stamp_ns in stamps_ns)
    return msgspec.structs.replace(view(1, 10), objects=objects, settled_stamp_ns=settled_ns)


def test_an_object_at_the_settled_stamp_is_new_once() -> None:
    """Beams up to 100 ns are settled by the first view; by the next those after them, up to 200 ns."""
    new = NewObjects()
    assert len(new.of(rolled(100, 40))) == 1
    assert [item.stamp_ns for item in new.of(rolled(200, 99, 100, 101, 200, 201))] == [101, 200]
    assert [item.stamp_ns for item in new.of(rolled(300, 200, 201))] == [201]
