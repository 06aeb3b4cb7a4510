"""The vehicle state that belongs to a stamp."""

from __future__ import annotations

import pytest

from msgs.vehicle import VehicleState
from nodes.state_history import KEPT_STATES, MAX_AGE_NS, StateHistory


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


def test_nothing_known() -> None:
    assert StateHistory().at(0) is None
