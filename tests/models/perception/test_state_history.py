"""The vehicle state that belongs to a stamp."""

from __future__ import annotations

import pytest

from models.perception.state_history import KEPT_NS, KEPT_STATES, MAX_AGE_NS, StateHistory
from msgs.values.vehicle import VehicleState


def history(*stamps_ns: int) -> StateHistory:
    states = StateHistory()
    for stamp_ns in stamps_ns:
        states.add(VehicleState(stamp_ns=stamp_ns))
    return states


@pytest.mark.parametrize(
    ("asked_ns", "expected_ns"), [(25, 20), (20, 20), (9, None), (30 + MAX_AGE_NS, 30), (31 + MAX_AGE_NS, None)]
)
def test_the_newest_that_is_not_younger_and_not_too_old(asked_ns: int, expected_ns: int | None) -> None:
    state = history(10, 20, 30).at(asked_ns)
    assert (state.stamp_ns if state else None) == expected_ns


def test_memory_is_bounded() -> None:
    states = history(*range(KEPT_STATES + 10))
    assert states.at(9) is None
    assert states.at(10) is not None


def test_a_scan_of_a_lidar_finds_the_state_of_its_start() -> None:
    """256 azimuths of 30 ms with the defaults, beside a bus that speaks at 50 and at 200 Hz."""
    for period_ns in (20_000_000, 5_000_000):
        states = history(*range(0, 10_000_000_000, period_ns))
        found = states.at(2_000_000_000)
        assert found is not None
        assert found.stamp_ns == 2_000_000_000


def test_what_was_held_up_is_not_the_newest() -> None:
    state = history(10, 30, 20).at(40)
    assert state is not None
    assert state.stamp_ns == 30


def test_a_source_that_starts_anew_is_heard_at_once_and_one_that_repeats_itself_takes_no_room() -> None:
    """A recording played in a loop, long and short."""
    states = history(0, KEPT_NS, 2 * KEPT_NS, 5)
    assert states.at(2 * KEPT_NS) is None
    assert states.at(5) is not None
    states = history(*[10, 20] * KEPT_STATES)
    states.add(VehicleState(stamp_ns=20, speed_mps=3.0))
    assert states.at(10) is not None
    newest = states.at(20)
    assert newest is not None
    assert newest.speed_mps == 3.0


def test_nothing_known() -> None:
    assert StateHistory().at(0) is None
