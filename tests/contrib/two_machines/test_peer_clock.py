"""A peer's clock, measured over ways of unequal length, and stamps moved into ours."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import msgspec
import numpy as np
import pytest

from contrib.two_machines.peer_clock import ClockSample, PeerClock, shift_stamps
from msgs.bus.topics import TOPICS
from msgs.values.vehicle import VehicleState
from tests.msgs.bus.test_codec import EXAMPLES

S, MS = 1_000_000_000, 1_000_000


def ask(now_ns: int, offset_ns: int, there_ns: int, back_ns: int) -> ClockSample:
    """A question at `now_ns` to a clock that is `offset_ns` ahead."""
    return ClockSample(now_ns, now_ns + there_ns + offset_ns, now_ns + there_ns + back_ns)


@pytest.mark.parametrize("offset_ns", [10**15, -(10**15), 3 * S, -7])
def test_offset_is_within_half_the_round_trip_whatever_way_is_the_longer(offset_ns: int) -> None:
    for there_ns, back_ns in ((0, 4 * MS), (4 * MS, 0), (2 * MS, 2 * MS), (0, 0)):
        clock = PeerClock()
        assert clock.error_ns(0) is None
        assert not clock.add(ask(5 * S, offset_ns, there_ns, back_ns))
        error_ns = clock.error_ns(5 * S + there_ns + back_ns)
        assert error_ns is not None
        assert abs(clock.offset_ns - offset_ns) <= error_ns <= there_ns + back_ns + 2


def test_the_shortest_round_trip_counts() -> None:
    clock = PeerClock()
    delays = [(9 * MS, MS), (MS, 20 * MS), (10_000, 20_000), (30 * MS, 0)]
    for index, (there_ns, back_ns) in enumerate(delays):
        clock.add(ask(index * MS, 10**15, there_ns, back_ns))
    assert abs(clock.offset_ns - 10**15) <= 15_001


def test_clocks_that_agree_are_left_alone() -> None:
    """One host has one clock: no answer, however lopsided its ways, moves a stamp by a nanosecond."""
    clock = PeerClock()
    random = np.random.default_rng(1)
    for index in range(200):
        there_ns, back_ns = (int(each) for each in random.integers(0, 5 * MS, 2))
        clock.add(ask(index * S, 0, there_ns, back_ns))
        assert clock.offset_ns == 0


@pytest.mark.parametrize("drift", [50e-6, -50e-6])
def test_a_clock_that_drifts_is_followed_inside_the_stated_error(drift: float) -> None:
    clock = PeerClock()
    random = np.random.default_rng(2)
    for index in range(600):
        now_ns = index * S // 2
        there_ns, back_ns = (int(each) for each in random.integers(0, 2 * MS, 2))
        assert not clock.add(ask(now_ns, 10**15 + round(drift * now_ns), there_ns, back_ns))
        at_ns = now_ns + there_ns + back_ns
        error_ns = clock.error_ns(at_ns)
        assert error_ns is not None
        assert abs(clock.offset_ns - (10**15 + drift * at_ns)) <= error_ns + 1 + abs(drift) * 4 * MS
        # after 300 s the clocks are 15 ms further apart
        assert error_ns < 3 * MS


def test_a_clock_that_starts_again_is_noticed_and_taken_over_at_once() -> None:
    clock = PeerClock()
    assert not clock.add(ask(S, 10**15, MS, MS))
    assert clock.add(ask(2 * S, -5 * S, 0, 30 * MS))
    assert abs(clock.offset_ns + 5 * S) <= 15 * MS + 1
    assert not clock.add(ask(3 * S, -5 * S, MS, MS))


def test_stamps_are_moved_wherever_they_stand_and_zero_stays() -> None:
    by_ns = -(10**15)
    ra_map = msgspec.structs.replace(
        EXAMPLES["radar/ra_map"][0], stamp_ns=10**15 + 5, azimuth_stamp_ns=10**15 + np.array([0, 7, 8, -(10**15)])
    )
    moved: Any = shift_stamps(ra_map, by_ns)
    assert moved.stamp_ns == 5
    assert moved.azimuth_stamp_ns.dtype == np.int64
    assert moved.azimuth_stamp_ns.tolist() == [0, 7, 8, 0]
    assert moved.values is ra_map.values


def test_stamps_of_nested_values_are_moved_too() -> None:
    view: Any = EXAMPLES["perception/hidden_objects"][0]
    known = msgspec.structs.replace(view.objects[0], stamp_ns=10)
    ego = VehicleState(stamp_ns=20)
    view = msgspec.structs.replace(view, stamp_ns=30, objects=(known, view.objects[0]), ego=ego)
    moved: Any = shift_stamps(view, 7)
    assert [moved.stamp_ns, moved.ego.stamp_ns, *(one.stamp_ns for one in moved.objects)] == [37, 27, 17, 0]
    assert moved.points is view.points
    assert shift_stamps(view, 0) is view


def test_every_field_that_is_a_time_of_a_clock_is_known() -> None:
    """`shifted` goes by names: another name for a stamp would pass it unmoved."""
    names = {
        field.encode_name
        for topic in TOPICS.values()
        for field in _fields(msgspec.inspect.type_info(topic.type))
        if field.encode_name.endswith("_ns")
    }
    assert names == {"stamp_ns", "azimuth_stamp_ns", "peak_stamp_ns", "settled_stamp_ns"}


def _fields(of: Any) -> Iterator[Any]:
    """Fields of a type and of all types inside it."""
    for field in getattr(of, "fields", ()):
        yield field
        yield from _fields(field.type)
    for inner in (*getattr(of, "types", ()), *getattr(of, "item_types", ()), getattr(of, "item_type", None)):
        if inner is not None:
            yield from _fields(inner)
