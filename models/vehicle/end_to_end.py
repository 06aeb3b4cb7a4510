"""End-to-end protection of a CAN message: its checksum and its rolling counter."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import TYPE_CHECKING, Literal

import msgspec

if TYPE_CHECKING:
    from cantools.database.can import Message, Signal

#: x^8 + x^4 + x^3 + x^2 + 1, the polynomial of CRC-8 SAE J1850.
_J1850_POLYNOMIAL = 0x1D

Algorithm = Literal["crc8_sae_j1850", "xor8", "sum8"]


class ChecksumRule(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Position and algorithm of a message's checksum."""

    #: A signal of eight bits that fills one byte.
    signal: str
    algorithm: Algorithm = "crc8_sae_j1850"
    #: Known to sender and receiver only: precedes the payload, low byte first.
    data_id: int | None = None

    def __post_init__(self) -> None:
        if self.data_id is not None and not 0 <= self.data_id <= 0xFFFF:
            raise ValueError(f"data_id must be 0..65535, got {self.data_id!r}")


class CounterRule(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Position and maximum step of a message's rolling counter."""

    signal: str
    #: Largest step from one message to the next; 2 tolerates one lost message.
    max_step: int = 2
    #: The counter runs from 0 to `modulus` - 1; None: all values of its bits.
    modulus: int | None = None

    def __post_init__(self) -> None:
        if self.max_step < 1:
            raise ValueError(f"max_step must be at least 1, got {self.max_step!r}")
        if self.modulus is not None and self.modulus < 2:
            raise ValueError(f"modulus must be at least 2, got {self.modulus!r}")


def crc8_sae_j1850(data: Iterable[int]) -> int:
    """Return the CRC-8 SAE J1850: polynomial 0x1D, start and final XOR 0xFF; "123456789" gives 0x4B."""
    crc = 0xFF
    for byte in data:
        crc = _J1850_TABLE[crc ^ byte]
    return crc ^ 0xFF


def xor8(data: Iterable[int]) -> int:
    """Return the exclusive or of all bytes."""
    result = 0
    for byte in data:
        result ^= byte
    return result


def sum8(data: Iterable[int]) -> int:
    """Return the sum of all bytes modulo 256."""
    return sum(data) & 0xFF


def checksum_of(rule: ChecksumRule, data: bytes, position: int) -> int:
    """Return the checksum of a payload without the byte at `position`, which holds the checksum itself."""
    prefix = b"" if rule.data_id is None else rule.data_id.to_bytes(2, "little")
    return _ALGORITHMS[rule.algorithm](prefix + data[:position] + data[position + 1 :])


def checksum_byte(message: Message, rule: ChecksumRule) -> int:
    """Return the index of the checksum byte in the payload; `ValueError` if the DBC has none there."""
    field = f"messages.{message.name}.checksum.signal"
    signal = signal_of(message, rule.signal, field)
    first_bit = 0 if signal.byte_order == "little_endian" else 7
    if signal.length != 8 or signal.start % 8 != first_bit:
        raise ValueError(f"{field}: {rule.signal} must fill one byte")
    if signal.start // 8 >= message.length:
        raise ValueError(f"{field}: {rule.signal} must lie within the message's {message.length} bytes")
    return signal.start // 8


def counter_modulus(message: Message, rule: CounterRule) -> int:
    """Return the number of values of the counter; `ValueError` if the DBC's bits cannot hold them."""
    field = f"messages.{message.name}.counter"
    bits = signal_of(message, rule.signal, f"{field}.signal").length
    modulus = 1 << bits if rule.modulus is None else rule.modulus
    if not rule.max_step < modulus <= 1 << bits:
        raise ValueError(f"{field}: needs max_step < modulus <= {1 << bits}, got {rule.max_step} and {modulus}")
    return modulus


def signal_of(message: Message, name: str, field: str) -> Signal:
    """Return a signal of a message by name; `ValueError` naming the mapping's `field` if there is none."""
    for signal in message.signals:
        if signal.name == name:
            return signal
    raise ValueError(f"{field}: message {message.name} of the DBC has no signal {name!r}")


def counter_step(last: int, new: int, modulus: int) -> int:
    """Return the step of a rolling counter, 0..modulus-1; 0 is a counter that did not move."""
    return (new - last) % modulus


def _table_entry(byte: int) -> int:
    for _ in range(8):
        byte = (byte << 1) ^ (_J1850_POLYNOMIAL if byte & 0x80 else 0)
        byte &= 0xFF
    return byte


_J1850_TABLE = tuple(_table_entry(byte) for byte in range(256))
_ALGORITHMS: dict[str, Callable[[Iterable[int]], int]] = {
    "crc8_sae_j1850": crc8_sae_j1850,
    "xor8": xor8,
    "sum8": sum8,
}
