"""What is timed of a row: the work on the last beam alone counts, that on the others is done while it is measured."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest

from lab.tradeoff import row_runs as runner
from lab.tradeoff.row_runs import BEFORE, Measuring, _Pass
from msgs.values.radar import RadarBeam, RadarSetup
from tests.builders import example_beam
from tests.fuzz.cases import ra_map

MS = 1_000_000


def beam(index: int) -> RadarBeam:
    return example_beam(stamp_ns=index, beam_index=index, beam_count=5)


class _Former:
    """Takes 2^index milliseconds for each beam; the last one gives the map."""

    def __init__(self, beam_step: int) -> None:
        self.folder = SimpleNamespace(setup=RadarSetup(), params=SimpleNamespace(beam_step=beam_step))
        self.now_ns = 0

    def add(self, one: RadarBeam) -> list[Any]:
        self.now_ns += MS << one.beam_index
        return [ra_map(one.scan_id, 10)] if one.beam_index == 4 else []


@pytest.mark.parametrize(("beam_step", "before_ms", "forming_ms"), [(1, 15.0, 16.0), (3, 7.0, 24.0)])
def test_the_last_beam_that_is_looked_at_ends_what_is_done_earlier(
    beam_step: int, before_ms: float, forming_ms: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Five beams of 1, 2, 4, 8 and 16 ms: 15 ms before the last one; of every third, beam 3 is the last."""
    former, measuring = _Former(beam_step), object.__new__(Measuring)
    monkeypatch.setattr(runner.time, "perf_counter_ns", lambda: former.now_ns)
    measuring._stages, measuring._scan_id = SimpleNamespace(former={"key": former}), 0  # type: ignore[assignment]
    measuring._hop = lambda topic, message: 0.0
    pass_ = _Pass()
    measuring._form(pass_, "key", [beam(index) for index in range(5)])
    assert pass_._times_ms[BEFORE, "key"] == [before_ms]
    assert pass_._times_ms["forming", "key"] == [forming_ms]
    assert pass_.maps["key"].scan_id == 0
