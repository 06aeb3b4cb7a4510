"""Walls known from elsewhere: what a message holds, and what is refused at the door."""

from __future__ import annotations

from typing import Any

import pytest

from msgs.bus import codec
from msgs.bus.interface import Envelope
from msgs.values.environment import (
    MAX_PRIOR_WALLS,
    MAX_SOURCE_LENGTH,
    MAX_WALL_LENGTH_M,
    PriorWall,
    WallPriors,
)


def wall(**changes: Any) -> PriorWall:
    fields = {"ends_m": ((20.0, -5.0), (20.0, 5.0)), "offset_std_m": 0.1, "angle_std_rad": 0.01, "end_std_m": 0.5}
    return PriorWall(**{**fields, **changes})


def priors(**changes: Any) -> WallPriors:
    return WallPriors(**{"stamp_ns": 5, "source": "map", "walls": (wall(),), **changes})


@pytest.mark.parametrize(
    ("changes", "rule"),
    [
        ({"ends_m": ((20.0, 5.0), (20.0, 5.0))}, "wall length in m must lie in 0.1..2000, got 0.0"),
        ({"ends_m": ((20.0, -2000.0), (20.0, 5.0))}, "wall length in m must lie in 0.1..2000, got 2005.0"),
        ({"offset_std_m": 0.0}, "wall.offset_std_m must lie in 0.0001..100, got 0.0"),
    ],
)
def test_a_wall_that_cannot_be_is_refused(changes: dict[str, Any], rule: str) -> None:
    with pytest.raises(ValueError) as refused:
        wall(**changes)
    assert str(refused.value) == rule


@pytest.mark.parametrize(
    ("changes", "rule"),
    [
        ({"source": ""}, "wall_priors.source must have 1..64 characters, got 0"),
        ({"source": "m" * (MAX_SOURCE_LENGTH + 1)}, "wall_priors.source must have 1..64 characters, got 65"),
        ({"walls": (wall(),) * (MAX_PRIOR_WALLS + 1)}, "wall_priors.walls must be at most 256, got 257"),
    ],
)
def test_a_message_that_cannot_be_is_refused(changes: dict[str, Any], rule: str) -> None:
    with pytest.raises(ValueError) as refused:
        priors(**changes)
    assert str(refused.value) == rule


def test_the_largest_message_fits_the_topic() -> None:
    ends_m = ((-0.1 - MAX_WALL_LENGTH_M / 2, -1234.5678901234567), (MAX_WALL_LENGTH_M / 2 - 0.2, -1234.5678901234567))
    message = priors(walls=(wall(ends_m=ends_m),) * MAX_PRIOR_WALLS, source="m" * MAX_SOURCE_LENGTH)
    envelope = Envelope(publisher="map", topic="environment/walls", sequence=0, sent_ns=0)
    codec.decode(codec.encode(envelope, message))
