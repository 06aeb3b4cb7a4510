"""Limits of parameters that only a running node would trip over."""

from __future__ import annotations

import math

import pytest

from nodes.process.validation import MAX_CLOCK_OFFSET_S, require_clock_offset


@pytest.mark.parametrize("value_s", [0.0, 1e-3, MAX_CLOCK_OFFSET_S, -MAX_CLOCK_OFFSET_S])
def test_a_clock_may_be_ahead_or_behind(value_s: float) -> None:
    require_clock_offset("offset_s", value_s)


@pytest.mark.parametrize("value_s", [1.001e9, -1.001e9, math.inf, -math.inf, math.nan])
def test_an_offset_that_no_stamp_can_take_is_refused_on_either_side(value_s: float) -> None:
    with pytest.raises(ValueError, match=rf"offset_s must be finite, within 1e\+09 s of zero, got {value_s!r}"):
        require_clock_offset("offset_s", value_s)
