"""Checksums against published check values, counters, and where a DBC has them."""

from __future__ import annotations

import cantools
import pytest

from models.vehicle.end_to_end import (
    ChecksumRule,
    CounterRule,
    checksum_byte,
    checksum_of,
    counter_modulus,
    counter_step,
    crc8_sae_j1850,
    sum8,
    xor8,
)

DBC = """VERSION ""
BO_ 16 M: 8 X
 SG_ LITTLE : 8|8@1+ (1,0) [0|255] "" X
 SG_ BIG : 23|8@0+ (1,0) [0|255] "" X
 SG_ SHIFTED : 25|8@1+ (1,0) [0|255] "" X
 SG_ COUNTER : 40|4@1+ (1,0) [0|15] "" X
"""
MESSAGE = cantools.database.load_string(DBC, "dbc", strict=False).messages[0]


def test_crc8_check_values() -> None:
    """The catalogue's check value, and the examples of AUTOSAR's CRC specification, table "CRC8 SAE J1850"."""
    assert crc8_sae_j1850(b"123456789") == 0x4B
    assert crc8_sae_j1850(bytes(4)) == 0x59
    assert crc8_sae_j1850(bytes([0xF2, 0x01, 0x83])) == 0x37
    assert crc8_sae_j1850(bytes([0x0F, 0xAA, 0x00, 0x55])) == 0x79
    assert crc8_sae_j1850(bytes([0xFF] * 4)) == 0x74


def test_every_single_bit_error_is_found() -> None:
    """A CRC with more than one term in its polynomial finds every single flipped bit; so do xor8 and sum8."""
    data = bytes(range(17, 24))
    for algorithm in (crc8_sae_j1850, xor8, sum8):
        for bit in range(8 * len(data)):
            flipped = bytearray(data)
            flipped[bit // 8] ^= 1 << bit % 8
            assert algorithm(flipped) != algorithm(data)


def test_crc_finds_swapped_bytes_that_xor_and_sum_miss() -> None:
    assert crc8_sae_j1850(b"\x01\x02") != crc8_sae_j1850(b"\x02\x01")
    assert (xor8(b"\x01\x02"), sum8(b"\x01\x02")) == (xor8(b"\x02\x01"), sum8(b"\x02\x01"))


def test_the_checksums_own_byte_takes_no_part() -> None:
    rule = ChecksumRule(signal="LITTLE", algorithm="sum8")
    assert checksum_of(rule, b"\x01\xee\x02", 1) == 3


def test_data_id_tells_messages_apart() -> None:
    """The same payload under another id has another checksum; the id goes in ahead, low byte first."""
    assert ChecksumRule(signal="LITTLE", data_id=0xFFFF).data_id == 0xFFFF
    rule = ChecksumRule(signal="LITTLE", data_id=0x0123)
    assert checksum_of(rule, b"\xff\x05\x06", 0) == crc8_sae_j1850(b"\x23\x01\x05\x06")
    other = ChecksumRule(signal="LITTLE", data_id=0x0124)
    assert checksum_of(other, b"\xff\x05\x06", 0) != checksum_of(rule, b"\xff\x05\x06", 0)


@pytest.mark.parametrize(("signal", "byte"), [("LITTLE", 1), ("BIG", 2)])
def test_checksum_byte_in_either_byte_order(signal: str, byte: int) -> None:
    assert checksum_byte(MESSAGE, ChecksumRule(signal=signal)) == byte
    assert MESSAGE.decode(bytes(byte) + b"\x5a" + bytes(7 - byte))[signal] == 0x5A


@pytest.mark.parametrize("signal", ["SHIFTED", "COUNTER"])
def test_a_checksum_must_fill_one_byte(signal: str) -> None:
    with pytest.raises(ValueError, match=rf"messages\.M\.checksum\.signal: {signal} must fill one byte"):
        checksum_byte(MESSAGE, ChecksumRule(signal=signal))


@pytest.mark.parametrize(
    ("last", "new", "modulus", "step"),
    [(3, 4, 16, 1), (15, 0, 16, 1), (14, 0, 15, 1), (5, 5, 16, 0), (5, 4, 16, 15)],
)
def test_counters_wrap(last: int, new: int, modulus: int, step: int) -> None:
    assert counter_step(last, new, modulus) == step


def test_counter_modulus() -> None:
    assert counter_modulus(MESSAGE, CounterRule(signal="COUNTER")) == 16
    assert counter_modulus(MESSAGE, CounterRule(signal="COUNTER", modulus=15)) == 15
    with pytest.raises(ValueError, match=r"messages\.M\.counter: needs max_step < modulus <= 16, got 2 and 17"):
        counter_modulus(MESSAGE, CounterRule(signal="COUNTER", modulus=17))
    with pytest.raises(ValueError, match=r"messages\.M\.counter\.signal: message M of the DBC has no signal 'COUNT'"):
        counter_modulus(MESSAGE, CounterRule(signal="COUNT"))


@pytest.mark.parametrize(
    ("build", "rule"),
    [
        (lambda: ChecksumRule(signal="C", data_id=65536), r"data_id must be 0\.\.65535, got 65536"),
        (lambda: CounterRule(signal="C", max_step=0), "max_step must be at least 1, got 0"),
        (lambda: CounterRule(signal="C", modulus=1), "modulus must be at least 2, got 1"),
    ],
)
def test_rules_refuse_what_makes_no_sense(build, rule: str) -> None:
    with pytest.raises(ValueError, match=rule):
        build()
