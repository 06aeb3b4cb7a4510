"""Periods of messages: the mapping's in seconds, else the DBC's in milliseconds."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest

from models.vehicle.can_mapping import LONGEST_PERIOD_S, MessageRule, period_ns


def message(cycle_time: Any) -> Any:
    return SimpleNamespace(name="Speed", cycle_time=cycle_time)


def test_the_mappings_period_counts_before_the_dbcs() -> None:
    assert period_ns(message(20), MessageRule()) == 20_000_000
    assert period_ns(message(20), MessageRule(period_s=0.05)) == 50_000_000
    assert period_ns(message(1e3 * LONGEST_PERIOD_S), MessageRule()) == 86_400 * 10**9


@pytest.mark.parametrize("cycle_time", [0, -1, 1e3 * LONGEST_PERIOD_S + 1, None, "20"])
def test_a_dbc_without_a_cycle_time_is_named(cycle_time: Any) -> None:
    with pytest.raises(ValueError, match=r"messages\.Speed\.period_s: must be given"):
        period_ns(message(cycle_time), MessageRule())
