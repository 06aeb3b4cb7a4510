"""Hard cases of CAN: seconds in floating point, clocks that differ, limits in decimals, counters at their wrap."""

from __future__ import annotations

import itertools
from fractions import Fraction

import can
import cantools
import numpy as np
import pytest

from models.vehicle.can_state import AGE_PERIODS, CanDecoder, StampMapper, Verdict
from models.vehicle.end_to_end import counter_step
from models.vehicle.mapping import CanMapping, MessageRule, QuantityRule
from nodes.can_link import frame_stamp_ns


def test_epoch_stamps_keep_a_quarter_of_a_microsecond() -> None:
    """python-can's stamps are doubles of the epoch: 2^-22 s = 0.24 us apart in 2017..2038; float32 has 128 s."""
    rng = np.random.default_rng(3)
    true_ns = (1_700_000_000 * 10**9 + rng.integers(0, 10**15, 1000)).tolist()
    read_ns = [frame_stamp_ns(can.Message(timestamp=stamp_ns / 1e9)) for stamp_ns in true_ns]
    worst_ns = max(abs(a - b) for a, b in zip(read_ns, true_ns, strict=True))
    # half a step of the double, and the product with 1e9 is rounded once more to the 256 ns of doubles at 1.7e18
    assert worst_ns <= 120 + 128
    naive_ns = [float(np.float32(stamp_ns / 1e9)) * 1e9 for stamp_ns in true_ns]
    assert max(abs(a - b) for a, b in zip(naive_ns, true_ns, strict=True)) > 1e9


def test_ages_are_exact_at_the_limit() -> None:
    """Ten periods of 10 ms after an epoch stamp: integers meet the limit to 1 ns, seconds as floats miss it."""
    start_ns = 1_700_000_000_123_456_789
    decoder = decoder_of("1", 0, 100)
    decoder.add(16, bytes(4), start_ns)
    limit_ns = AGE_PERIODS * 10_000_000
    assert decoder.state(start_ns + limit_ns - 1).valid
    assert not decoder.state(start_ns + limit_ns).valid
    naive_age_s = (start_ns + limit_ns - 1) * 1e-9 - start_ns * 1e-9
    assert abs(naive_age_s - 0.1) > 1e-9


def decoder_of(scale: str, low: float, high: float) -> CanDecoder:
    dbc = f"""VERSION ""
BO_ 16 A: 4 X
 SG_ V : 0|16@1+ ({scale},0) [{low}|{high}] "" X
 SG_ W : 16|16@1- (1,0) [0|0] "" X
"""
    mapping = CanMapping(
        speed=QuantityRule(message="A", signals=("V",), low=-1e6, high=1e6),
        yaw_rate=QuantityRule(message="A", signals=("W",), low=-1e6, high=1e6),
        messages={"A": MessageRule(period_s=0.01)},
    )
    return CanDecoder(cantools.database.load_string(dbc, "dbc", strict=False), mapping)


@pytest.mark.parametrize("scale", ["0.1", "0.01", "0.07", "0.3", "0.0155168902"])
def test_the_last_value_of_a_range_counts_and_the_next_does_not(scale: str) -> None:
    """Limits are decimals, values raw * scale in binary: the naive comparison refuses some at the limit itself."""
    naive_wrong = 0
    for raw in range(1, 3000, 7):
        limit = float(Fraction(scale) * raw)
        decoder = decoder_of(scale, 0, limit)
        at_limit = decoder.add(16, raw.to_bytes(2, "little") + b"\0\0", 0)
        beyond = decoder.add(16, (raw + 1).to_bytes(2, "little") + b"\0\0", 0)
        assert (at_limit.verdict, beyond.verdict) == (Verdict.COUNTED, Verdict.OUT_OF_RANGE), raw
        naive_wrong += raw * float(scale) > limit
    # a scale that is a little more in binary than in decimals
    if scale in ("0.1", "0.07"):
        assert naive_wrong > 0


def test_counter_steps_at_the_wrap_of_any_modulus() -> None:
    """Every pair of every modulus to 256: the step is the only one in 0..modulus-1 that leads from one to the other."""
    for modulus in (2, 15, 16, 255, 256):
        for last, new in itertools.product(range(modulus), repeat=2):
            step = counter_step(last, new, modulus)
            assert 0 <= step < modulus
            assert (last + step) % modulus == new


def test_a_slow_first_frame_does_not_shift_the_clock() -> None:
    """The first frame waited 80 ms in a queue: an offset taken from it alone is wrong for good, the mapper's is not."""
    mapper = StampMapper()
    offset_ns = 1_700_000_000 * 10**9
    stamps_ns = range(0, 3_000_000_000, 10_000_000)
    arrivals_ns = [stamp_ns + (80_000_000 if index == 0 else 200_000) for index, stamp_ns in enumerate(stamps_ns)]
    mapped_ns = [mapper.map(stamp + offset_ns, arrival) for stamp, arrival in zip(stamps_ns, arrivals_ns, strict=True)]
    naive_ns = [stamp_ns + arrivals_ns[0] for stamp_ns in stamps_ns]
    assert abs(naive_ns[-1] - stamps_ns[-1]) == 80_000_000
    assert max(abs(a - b) for a, b in zip(mapped_ns[1:], stamps_ns[1:], strict=True)) == 200_000


@pytest.mark.parametrize("drift", [-2e-4, 2e-4])
def test_drifting_clocks_do_not_walk_away(drift: float) -> None:
    """200 ppm for ten minutes is 120 ms, more than ten periods of 10 ms; over two windows of 1 s it is 0.4 ms."""
    mapper = StampMapper()
    errors_ns = [
        mapper.map(round(now_ns * (1.0 + drift)), now_ns) - now_ns for now_ns in range(0, 600 * 10**9, 20_000_000)
    ]
    assert max(abs(error) for error in errors_ns) <= 400_000
    assert abs(600e9 * drift) > 100e6


def test_a_backlog_keeps_its_distances() -> None:
    """After 0.5 s in which nobody read, 25 frames arrive at once: they must not all look new."""
    mapper = StampMapper()
    for now_ns in range(0, 2_000_000_000, 20_000_000):
        mapper.map(now_ns, now_ns)
    arrival_ns = 2_500_000_000
    mapped_ns = [mapper.map(stamp_ns, arrival_ns) for stamp_ns in range(2_000_000_000, arrival_ns, 20_000_000)]
    assert mapped_ns == list(range(2_000_000_000, arrival_ns, 20_000_000))
