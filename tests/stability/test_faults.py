"""Hard cases of a graph in trouble: clocks of hosts that ask each other, silence of processes that could not speak."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from fractions import Fraction

import numpy as np
import pytest

from contrib.two_machines.peer_clock import MAX_DRIFT, ClockSample, PeerClock, shift_stamps
from msgs.values.units import ns_from_s
from tests.fuzz.cases import peaks
from tests.stability.catalogue import Errors

#: A host's clock after 20 years of seconds, and what another one is ahead of it.
UP_NS, AHEAD_NS = 630_720_000_123_456_789, 1_131_719_876_543_211_235
SECOND_NS = ns_from_s(1.0)
AGAINST_THE_MEAN = pytest.mark.hard(
    "contrib.two_machines.peer_clock.PeerClock",
    "mean of the last 64 answers",
    2 * (0.5e-3 + 1.0 * MAX_DRIFT),
    "s",
    "half a round trip of 1 ms and a second's drift, once for the answer and once for the offset in use",
)


def answers(
    out_ns: Iterator[int], back_ns: Iterator[int], count: int, *, drift: float = 0.0, ahead_ns: int = AHEAD_NS
) -> tuple[list[ClockSample], int]:
    """A question a second of so many, its ways there and back taking so long, and how far the peer is ahead at the end.

    The peer's clock runs fast by `drift`.
    """
    samples = []
    for index, there_ns, home_ns in zip(range(count), out_ns, back_ns, strict=False):
        asked_ns = UP_NS + index * SECOND_NS
        gained_ns = round(drift * (index * SECOND_NS + there_ns))
        samples.append(ClockSample(asked_ns, asked_ns + there_ns + ahead_ns + gained_ns, asked_ns + there_ns + home_ns))
    return samples, ahead_ns + round(drift * (samples[-1].answered_ns - UP_NS))


def heard(samples: list[ClockSample]) -> PeerClock:
    clock = PeerClock()
    for sample in samples:
        clock.add(sample)
    return clock


@pytest.mark.hard("contrib.two_machines.peer_clock.ClockSample", "mean of the two times in float64", 0.5, "ns",
                  "half of an odd sum is rounded down")  # fmt: skip
def test_clock_of_a_host_that_is_up_for_decades(errors: Errors) -> None:
    """Stamps of 6e17 ns: doubles stand 128 ns apart there, and a radar's samples 10 ns."""
    naive = ours = 0.0
    for round_trip_ns in range(100_001, 100_257):
        sample = ClockSample(UP_NS, UP_NS + AHEAD_NS + 50_000, UP_NS + round_trip_ns)
        exact = sample.peer_ns - Fraction(sample.asked_ns + sample.answered_ns, 2)
        naive = max(naive, float(abs(Fraction(sample.peer_ns - (UP_NS + float(sample.answered_ns)) / 2) - exact)))
        ours = max(ours, float(abs(sample.offset_ns - exact)))
    errors(naive=naive, ours=ours)


@pytest.mark.hard("contrib.two_machines.peer_clock.PeerClock", "the answer of the shortest round trip ever",
                  2 * (2e-3 + 1.0 * MAX_DRIFT), "s",
                  "half a round trip of 4 ms and a second's drift, once for the answer and once for the offset in "
                  "use")  # fmt: skip
def test_lucky_answer_of_an_hour_ago(errors: Errors) -> None:
    """A clock 100 ppm fast: an answer of 20 us is worth the most for seconds, and 0.36 s wrong an hour later."""
    lucky_ns, usual_ns = 10_000, 2_000_000
    ways_ns = [lucky_ns, *itertools.repeat(usual_ns, 3599)]
    samples, ahead_ns = answers(iter(ways_ns), iter(ways_ns), 3600, drift=100e-6)
    shortest = min(samples, key=lambda sample: sample.round_trip_ns)
    errors(
        naive=1e-9 * abs(shortest.offset_ns - ahead_ns),
        ours=1e-9 * abs(heard(samples).offset_ns - ahead_ns),
    )


@AGAINST_THE_MEAN
def test_one_way_full_of_maps(errors: Errors) -> None:
    """Nine of ten answers wait 0.4 s behind maps on the way back, and on that way alone: their middle is no middle."""
    back_ns = (500_000 if index % 10 == 9 else 400_000_000 for index in range(640))
    samples, ahead_ns = answers(itertools.repeat(500_000), back_ns, 640)
    errors(
        naive=1e-9 * abs(sum(sample.offset_ns for sample in samples[-64:]) // 64 - ahead_ns),
        ours=1e-9 * abs(heard(samples).offset_ns - ahead_ns),
    )


@pytest.mark.hard("contrib.two_machines.peer_clock.shift_stamps", "seconds in float64", 0.0, "ns", "whole numbers")
def test_stamps_of_peaks_on_another_host(errors: Errors) -> None:
    """A stamp for each peak, 1.8e18 ns on the peer's clock: moved as seconds they land 256 ns beside."""
    sent = peaks(0, UP_NS + AHEAD_NS)
    moved = shift_stamps(sent, -AHEAD_NS)
    exact = [int(one) - AHEAD_NS for one in sent.peak_stamp_ns]
    naive_ns = np.rint(1e9 * (1e-9 * sent.peak_stamp_ns - 1e-9 * AHEAD_NS))
    errors(
        naive=max(abs(int(one) - right) for one, right in zip(naive_ns, exact, strict=True)),
        ours=max(abs(int(one) - right) for one, right in zip(moved.peak_stamp_ns, exact, strict=True)),
    )
