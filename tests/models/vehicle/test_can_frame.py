"""Whether frames count: length, checksum, counter; the same account for the vehicle state and for any DBC."""

from __future__ import annotations

from pathlib import Path

import cantools
import pytest

from models.vehicle.can_frame import FrameCheck, Verdict, _padded_length
from models.vehicle.can_mapping import MessageRule
from models.vehicle.end_to_end import ChecksumRule, CounterRule, checksum_byte, checksum_of
from nodes.can.bus import load_dbc, load_mapping

DBC, MAPPING = Path("launch/can/mirrorwave.dbc"), Path("launch/can/mirrorwave.yaml")


@pytest.fixture
def check() -> FrameCheck:
    return FrameCheck(load_dbc(DBC).get_message_by_name("MW_SPEED"), load_mapping(MAPPING).messages["MW_SPEED"])


def frame(counter: int, speed_mps: float = 5.0) -> bytes:
    message = load_dbc(DBC).get_message_by_name("MW_SPEED")
    rule = load_mapping(MAPPING).messages["MW_SPEED"]
    assert isinstance(rule.checksum, ChecksumRule)
    assert isinstance(rule.counter, CounterRule)
    values = {signal.name: 0 for signal in message.signals} | {"SPEED": speed_mps, rule.counter.signal: counter}
    data = bytearray(message.encode(values))
    position = checksum_byte(message, rule.checksum)
    data[position] = checksum_of(rule.checksum, bytes(data), position)
    return bytes(data)


def test_frames_in_order_count(check: FrameCheck) -> None:
    verdicts = [check.check(frame(counter)).verdict for counter in (3, 4, 6)]
    assert verdicts == [Verdict.FIRST, Verdict.COUNTED, Verdict.COUNTED]


def test_what_does_not_count_says_why(check: FrameCheck) -> None:
    check.check(frame(1))
    assert check.check(frame(1)) == (Verdict.WRONG_COUNTER, "counter stands at 1", check.check(frame(1)).values)
    assert check.check(frame(7)).why == "counter jumped from 1 to 7"
    assert check.check(frame(8)[:5])[:2] == (Verdict.WRONG_LENGTH, "wrong length: 5 bytes, expected 8")
    damaged = bytearray(frame(8))
    damaged[0] ^= 1
    verdict, why, values = check.check(bytes(damaged))
    assert (verdict, values) == (Verdict.WRONG_CHECKSUM, None)
    assert why.startswith("wrong checksum: 0x")


def test_after_a_silence_the_counter_starts_anew(check: FrameCheck) -> None:
    check.check(frame(1))
    assert check.check(frame(9), silent=True).verdict is Verdict.FIRST
    assert check.check(frame(10)).verdict is Verdict.COUNTED
    check.forget()
    assert check.check(frame(3)).verdict is Verdict.FIRST


def test_without_rules_every_frame_of_the_right_length_counts() -> None:
    check = FrameCheck(load_dbc(DBC).get_message_by_name("MW_SPEED"), MessageRule())
    assert [check.check(bytes(8)).verdict for _ in range(3)] == [Verdict.COUNTED] * 3


def test_a_page_that_the_dbc_lacks_takes_no_plain_signal_away() -> None:
    """Neither one of the selector nor one of a selector on a page; the signals of a known page are read beside it."""
    dbc = """VERSION ""
BO_ 16 A: 8 X
 SG_ M M : 0|8@1+ (1,0) [0|255] "" X
 SG_ N m1M : 8|8@1+ (1,0) [0|255] "" X
 SG_ W m1 : 16|16@1- (0.01,0) [-300|300] "" X
 SG_ U m3 : 32|16@1- (0.01,0) [-300|300] "" X
 SG_ V : 48|16@1+ (0.01,0) [0|655.35] "" X
SG_MUL_VAL_ 16 N M 1-1;
SG_MUL_VAL_ 16 W M 1-1;
SG_MUL_VAL_ 16 U N 3-3;
"""
    check = FrameCheck(cantools.database.load_string(dbc, "dbc").messages[0], MessageRule())
    pages = {0x0D: {"M": 13, "V": 2.5}, 0x0301: {"M": 1, "N": 3, "W": 0.0, "U": 0.0, "V": 2.5}}
    pages[0x0901] = {"M": 1, "N": 9, "W": 0.0, "V": 2.5}
    for page, values in pages.items():
        assert check.check(page.to_bytes(2, "little") + bytes(4) + b"\xfa\x00").values == values


@pytest.mark.parametrize(
    ("length", "padded"),
    [(8, 8), (9, 12), (13, 16), (17, 20), (21, 24), (24, 24), (25, 32), (33, 48), (49, 64), (64, 64)],
)
def test_frames_are_padded_to_the_next_length_of_can_fd(length: int, padded: int) -> None:
    """ISO 11898-1: 12, 16, 20, 24, 32, 48 and 64 bytes beyond 8."""
    assert _padded_length(length) == padded
