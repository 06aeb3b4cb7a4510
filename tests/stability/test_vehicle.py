"""Hard cases of CAN: seconds in floating point, clocks that differ, limits in decimals, counters at their wrap."""

from __future__ import annotations

from fractions import Fraction

import can
import cantools
import numpy as np
import pytest

from models.vehicle.can_decoder import AGE_PERIODS, CanDecoder, StampMapper, Verdict
from models.vehicle.can_mapping import CanMapping, MessageRule, QuantityRule
from nodes.can.bus import frame_stamp_ns
from tests.stability.catalogue import Errors


@pytest.mark.hard("nodes.can.bus", "seconds in float32", 120.0 + 128.0, "ns",
                  "half a step of the stamp's double, 240 ns, and one of its product with 1e9, 256 ns")  # fmt: skip
def test_epoch_stamps_keep_a_quarter_of_a_microsecond(errors: Errors) -> None:
    """python-can's stamps are doubles of the epoch: 2^-22 s = 0.24 us apart in 2017..2038; float32 has 128 s."""
    rng = np.random.default_rng(3)
    true_ns = (1_700_000_000 * 10**9 + rng.integers(0, 10**15, 1000)).tolist()
    read_ns = [frame_stamp_ns(can.Message(timestamp=stamp_ns / 1e9)) for stamp_ns in true_ns]
    naive_ns = [float(np.float32(stamp_ns / 1e9)) * 1e9 for stamp_ns in true_ns]
    errors(
        naive=max(abs(a - b) for a, b in zip(naive_ns, true_ns, strict=True)),
        ours=max(abs(a - b) for a, b in zip(read_ns, true_ns, strict=True)),
    )


@pytest.mark.hard("models.vehicle.can_decoder", "difference of seconds since 1970", 0.0, "ns", "integers")
def test_ages_are_exact_at_the_limit(errors: Errors) -> None:
    """Ten periods of 10 ms after an epoch stamp: integers meet the limit to 1 ns, seconds as floats miss it."""
    start_ns = 1_700_000_000_123_456_789
    decoder = decoder_of("1", 0, 100)
    decoder.add(16, bytes(4), start_ns)
    limit_ns = AGE_PERIODS * 10_000_000
    reach_ns = [age_ns for age_ns in range(limit_ns - 300, limit_ns + 300) if decoder.state(start_ns + age_ns).valid]
    naive_ns = [age_ns for age_ns in range(limit_ns - 300, limit_ns + 300)
                if (start_ns + age_ns) * 1e-9 - start_ns * 1e-9 < limit_ns * 1e-9]  # fmt: skip
    errors(naive=abs(max(naive_ns, default=0) - (limit_ns - 1)), ours=abs(max(reach_ns, default=0) - (limit_ns - 1)))


def decoder_of(scale: str, low: float, high: float) -> CanDecoder:
    dbc = f"""VERSION ""
BO_ 16 A: 4 X
 SG_ V : 0|16@1+ ({scale},0) [{low}|{high}] "" X
 SG_ W : 16|16@1- (1,0) [0|0] "" X
"""
    mapping = CanMapping(
        speed=QuantityRule(message="A", signals=("V",), unit="m/s", low=-1e6, high=1e6),
        yaw_rate=QuantityRule(message="A", signals=("W",), unit="rad/s", low=-1e6, high=1e6),
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


@pytest.mark.hard("models.vehicle.can_decoder", "offset of the first frame", 200e-6, "s",
                  "the delay of every other frame, 0.2 ms")  # fmt: skip
def test_a_slow_first_frame_does_not_shift_the_clock(errors: Errors) -> None:
    """The first frame waited 80 ms in a queue: an offset taken from it alone is wrong for good."""
    mapper = StampMapper()
    offset_ns = 1_700_000_000 * 10**9
    stamps_ns = range(0, 3_000_000_000, 10_000_000)
    arrivals_ns = [stamp_ns + (80_000_000 if index == 0 else 200_000) for index, stamp_ns in enumerate(stamps_ns)]
    mapped_ns = [mapper.map(stamp + offset_ns, arrival) for stamp, arrival in zip(stamps_ns, arrivals_ns, strict=True)]
    naive_ns = [stamp_ns + arrivals_ns[0] for stamp_ns in stamps_ns]
    errors(
        naive=max(abs(a - b) for a, b in zip(naive_ns[1:], stamps_ns[1:], strict=True)) / 1e9,
        ours=max(abs(a - b) for a, b in zip(mapped_ns[1:], stamps_ns[1:], strict=True)) / 1e9,
    )


@pytest.mark.parametrize("drift", [-2e-4, 2e-4])
@pytest.mark.hard("models.vehicle.can_decoder", "offset of the first frame", 400e-6, "s",
                  "200 ppm over two windows of 1 s")  # fmt: skip
def test_drifting_clocks_do_not_walk_away(errors: Errors, drift: float) -> None:
    """200 ppm for ten minutes is 120 ms, more than ten periods of 10 ms."""
    mapper = StampMapper()
    naive = ours = 0
    for now_ns in range(0, 600 * 10**9, 20_000_000):
        stamp_ns = round(now_ns * (1.0 + drift))
        naive, ours = max(naive, abs(stamp_ns - now_ns)), max(ours, abs(mapper.map(stamp_ns, now_ns) - now_ns))
    errors(naive=naive / 1e9, ours=ours / 1e9)


def test_a_backlog_keeps_its_distances() -> None:
    """After 0.5 s in which nobody read, 25 frames arrive at once: they must not all look new."""
    mapper = StampMapper()
    for now_ns in range(0, 2_000_000_000, 20_000_000):
        mapper.map(now_ns, now_ns)
    arrival_ns = 2_500_000_000
    mapped_ns = [mapper.map(stamp_ns, arrival_ns) for stamp_ns in range(2_000_000_000, arrival_ns, 20_000_000)]
    assert mapped_ns == list(range(2_000_000_000, arrival_ns, 20_000_000))
