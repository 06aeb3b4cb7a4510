"""Steps of a stream's clock: times that run on, what is said, and what is no step."""

from __future__ import annotations

import itertools
import logging
from collections.abc import Iterator

import pytest

from msgs.recording.clock_steps import Bridged, amount

S = 1_000_000_000
MS = 1_000_000
#: Of this century.
TODAY_NS = 1_700_000_000 * S


def times_of(stamps_ns: list[int | None], late_ns: int = 0) -> list[int]:
    return [time_ns for _, time_ns in Bridged(stamps_ns, lambda stamp_ns: stamp_ns, "the clock", late_ns=late_ns)]


def steady(count: int, period_ns: int = 20 * MS, start_ns: int = TODAY_NS) -> list[int]:
    return [start_ns + at * period_ns for at in range(count)]


def test_a_steady_stream_keeps_its_stamps(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO)
    stamps_ns = [*steady(5), *steady(5, 7 * MS, TODAY_NS + 90 * MS), TODAY_NS + 1_090 * MS]
    assert times_of(stamps_ns) == stamps_ns
    assert times_of([]) == []
    assert times_of([5]) == [5]
    assert caplog.text == ""


@pytest.mark.parametrize("period_ns", [10 * MS, 300 * MS, 8 * S, 90 * S], ids=["10 ms", "0.3 s", "8 s", "90 s"])
@pytest.mark.parametrize(
    "step_s", [-1e9, -3600.0, -100.0, 3600.0, 1e5, 1e9], ids=["-32 years", "-1 h", "-100 s", "1 h", "1 day", "32 years"]
)
@pytest.mark.parametrize("at", [1, 2, 11, 19], ids=["second", "third", "middle", "last"])
def test_a_lasting_step_is_one_interval(step_s: float, period_ns: int, at: int) -> None:
    """Wherever the clock is set, and however far, replay goes on in the stream's pace."""
    stamps_ns = steady(20, period_ns)
    stepped_ns = [*stamps_ns[:at], *(stamp + int(step_s * S) for stamp in stamps_ns[at:])]
    # of two messages an hour apart, and of the last one of a slow stream, nobody can tell what is usual
    known = [*stamps_ns[1:at], *stamps_ns[at + 1 :]]
    if known and abs(step_s) * S > 20 * period_ns:
        assert times_of(stepped_ns) == stamps_ns


def test_steps_back_by_little_are_steps_unless_items_may_be_late() -> None:
    stamps_ns = steady(20)
    stepped_ns = [*stamps_ns[:10], *(stamp - 300 * MS for stamp in stamps_ns[10:])]
    assert times_of(stepped_ns) == stamps_ns
    assert times_of(stepped_ns, late_ns=S) == stepped_ns


def test_a_clock_that_is_set_twice_and_back() -> None:
    stamps_ns = steady(60)
    by_s = [0] * 20 + [10**9] * 20 + [-7] * 20
    assert times_of([stamp + by * S for stamp, by in zip(stamps_ns, by_s, strict=True)]) == stamps_ns


@pytest.mark.parametrize("away_s", [-1e9, -6.0, 0.5, 6.0, 600.0, 1e9])
@pytest.mark.parametrize("count", [1, 2, 5])
@pytest.mark.parametrize("late_ns", [0, S])
def test_stamps_that_are_off_lie_between_their_neighbours(away_s: float, count: int, late_ns: int) -> None:
    """And nothing after them moves."""
    stamps_ns = steady(30)
    off_ns = [stamp + int(away_s * S) * (10 <= at < 10 + count) for at, stamp in enumerate(stamps_ns)]
    assert times_of(off_ns, late_ns) == stamps_ns


def test_a_clock_that_was_off_for_seconds_leaves_no_gap() -> None:
    stamps_ns = steady(200)
    off_ns = [stamp + 3600 * S * (50 <= at < 150) for at, stamp in enumerate(stamps_ns)]
    bridged = Bridged(off_ns, lambda stamp_ns: stamp_ns, "the clock", look_ahead=128)
    assert [time_ns for _, time_ns in bridged] == stamps_ns
    assert (bridged.steps, bridged.off, bridged.gaps) == (0, 100, 0)


def test_two_clocks_in_turn_do_not_stretch_time() -> None:
    """Frames of a second interface whose clock is 6 s ahead."""
    stamps_ns = steady(39)
    assert times_of([stamp + 6 * S * (at % 2) for at, stamp in enumerate(stamps_ns)]) == stamps_ns


@pytest.mark.parametrize("gap_s", [2, 6, 59])
def test_a_silence_is_time_that_passed_and_is_said(gap_s: int, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO)
    stamps_ns = [*steady(10), *steady(10, start_ns=TODAY_NS + gap_s * S)]
    assert times_of(stamps_ns) == stamps_ns
    assert f"the clock has a gap of {gap_s - 0.2:.1f} s, or was set ahead, after 10 messages" in caplog.text


@pytest.mark.parametrize(
    ("period_ns", "gap_s", "level"), [(MS, 2, "WARNING"), (300 * MS, 8, "INFO"), (S, 12, "WARNING")]
)
def test_a_gap_is_a_warning_in_a_dense_stream_or_where_it_is_long(
    period_ns: int, gap_s: int, level: str, caplog: pytest.LogCaptureFixture
) -> None:
    """A bus of a frame a millisecond may have been silent for two seconds, or its logger's clock was set."""
    caplog.set_level(logging.INFO)
    times_of([*steady(10, period_ns), *steady(10, period_ns, TODAY_NS + 9 * period_ns + gap_s * S)])
    assert [record.levelname for record in caplog.records] == [level]


def test_items_without_a_stamp_have_the_time_before() -> None:
    assert times_of([None, 5, None, 7, None]) == [0, 5, 5, 7, 7]


def test_what_happened_is_said_where_it_did_and_how_often(caplog: pytest.LogCaptureFixture) -> None:
    stamps_ns = steady(30)
    times_of([stamp + TODAY_NS * (at >= 3) for at, stamp in enumerate(steady(30, start_ns=0))])
    times_of([stamp - 6 * S * (at == 12) for at, stamp in enumerate(stamps_ns)])
    assert [record.message for record in caplog.records] == [
        "the clock was set by +1700000000 s (53.9 years) after 3 messages; it is played on without that",
        "the clock was off by -6.0 s for 1 message after 12 messages; it is played on with their neighbours",
    ]
    caplog.clear()
    stream = Bridged(itertools.chain.from_iterable([steady(10)] * 20), lambda stamp_ns: stamp_ns, "the clock")
    assert len(list(stream)) == 200
    assert (stream.steps, stream.off, stream.gaps) == (19, 0, 0)
    assert len(caplog.records) == 6
    assert caplog.messages[-1] == "the clock was set, off or silent 14 more times"


def test_an_error_comes_after_all_that_was_read_before_it() -> None:
    def broken() -> Iterator[int]:
        yield from [0, 1, 100 * S, 100 * S + 1]
        raise ValueError("line 5")

    stream = Bridged(broken(), lambda stamp_ns: stamp_ns, "the clock")
    assert [next(stream)[0] for _ in range(4)] == [0, 1, 100 * S, 100 * S + 1]
    with pytest.raises(ValueError, match="line 5"):
        next(stream)
    assert list(stream) == []


@pytest.mark.parametrize(
    ("step_s", "text"),
    [(6.02, "+6.0 s"), (-0.012, "-0.012 s"), (-99.98, "-100 s"), (1e9, "+1000000000 s (31.7 years)")],
)
def test_amounts(step_s: float, text: str) -> None:
    assert amount(round(step_s * S)) == text
