"""Walls known from elsewhere: what a message holds, and what is refused at the door."""

from __future__ import annotations

import math
from typing import Any

import msgspec
import pytest

from msgs.bus import codec
from msgs.bus.interface import Envelope
from msgs.values.environment import (
    MAX_PRIOR_WALLS,
    MAX_SOURCE_LENGTH,
    MAX_WALL_LENGTH_M,
    MIN_WALL_LENGTH_M,
    PriorWall,
    WallPriors,
)


def wall(**changes: Any) -> PriorWall:
    fields = {"ends_m": ((20.0, -5.0), (20.0, 5.0)), "offset_std_m": 0.1, "angle_std_rad": 0.01, "end_std_m": 0.5}
    return PriorWall(**{**fields, **changes})


def priors(**changes: Any) -> WallPriors:
    return WallPriors(**{"stamp_ns": 5, "source": "map", "walls": (wall(),), **changes})


def test_a_message_comes_back_as_it_was_sent() -> None:
    message = priors(walls=(wall(), wall(ends_m=((0.0, 1.0), (0.0, 1.0 + MIN_WALL_LENGTH_M)))))
    envelope = Envelope(publisher="map", topic="environment/walls", sequence=0, sent_ns=0)
    assert codec.decode(codec.encode(envelope, message)).message == message
    assert codec.decode_inline(WallPriors, codec.encode_inline(message)) == message


@pytest.mark.parametrize(
    ("changes", "rule"),
    [
        ({"ends_m": ((20.0, math.nan), (20.0, 5.0))}, "wall.ends_m must be finite, got nan"),
        ({"ends_m": ((20.0, -math.inf), (20.0, 5.0))}, "wall.ends_m must be finite, got -inf"),
        ({"ends_m": ((1e5, 0.0), (20.0, 5.0))}, "wall.ends_m must lie in -10000..10000, got 100000.0"),
        ({"ends_m": ((20.0, 5.0), (20.0, 5.0))}, "wall length in m must lie in 0.1..2000, got 0.0"),
        ({"ends_m": ((20.0, -2000.0), (20.0, 5.0))}, "wall length in m must lie in 0.1..2000, got 2005.0"),
        ({"offset_std_m": 0.0}, "wall.offset_std_m must lie in 0.0001..100, got 0.0"),
        ({"offset_std_m": math.nan}, "wall.offset_std_m must lie in 0.0001..100, got nan"),
        ({"angle_std_rad": 4.0}, "wall.angle_std_rad must lie in 1e-05..3.14159, got 4.0"),
        ({"end_std_m": -1.0}, "wall.end_std_m must lie in 0.0001..1000, got -1.0"),
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
        ({"stamp_ns": 1 << 63}, f"wall_priors.stamp_ns must be within -2^62..2^62, got {1 << 63}"),
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


def test_a_message_from_the_wire_is_checked_too() -> None:
    """As any program may send it: the same rules in the codec's own error."""
    body = msgspec.to_builtins(priors())
    body["walls"][0]["offset_std_m"] = 0.0
    with pytest.raises(codec.CodecError, match=r"wall.offset_std_m must lie in"):
        codec.decode_inline(WallPriors, msgspec.msgpack.encode(body))
