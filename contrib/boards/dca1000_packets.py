"""Datagrams of a DCA1000 card as frames: what is lost is filled with zeros and counted, what is late finds its place.

In raw mode each datagram is a sequence number (4 bytes, from 1), the count of sample bytes sent before it (6 bytes) and
at most 1456 bytes of samples, all little-endian; the last of a recording may be shorter. The byte count places samples
exactly, whatever was lost before; the sequence number says how many datagrams were lost. Both wrap.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from msgs.values.arrays import require_positive

HEADER_BYTES, PAYLOAD_BYTES = 10, 1456
DATAGRAM_BYTES = HEADER_BYTES + PAYLOAD_BYTES
_HEADER = struct.Struct("<IIH")
_SEQUENCES, _POSITIONS = 1 << 32, 1 << 48
#: A datagram may be overtaken by so many others; frames wait for it that long.
WINDOW = 64
#: A recording that leaves out more, 1.5 GB, is not this one.
MAX_LOST = 1 << 20


class Datagram(NamedTuple):
    """A datagram of the card: its number, the place of its first byte in the recording, and its samples."""

    sequence: int
    position: int
    payload: bytes | memoryview


class SampleFrame(NamedTuple):
    """A frame of a recording: its number from the recording's start, arrival of its first datagram, and its codes."""

    number: int
    stamp_ns: int
    #: int16 [frame_bytes / 2], zero where bytes are missing.
    codes: np.ndarray
    #: First byte and end of each stretch that is missing.
    gaps: tuple[tuple[int, int], ...]

    @property
    def missing_bytes(self) -> int:
        """Bytes that zeros stand for."""
        return sum(end - start for start, end in self.gaps)


@dataclass
class PacketCounts:
    """Datagrams of all recordings so far, by what became of them."""

    placed: int = 0
    #: Never came, or came too late.
    lost: int = 0
    #: After the frames that wanted them; counted as lost too.
    late: int = 0
    repeated: int = 0
    #: Not of this mode.
    refused: int = 0
    #: Frames with zeros in place of what is missing, and those without any datagram.
    filled_frames: int = 0
    lost_frames: int = 0


def parse_datagram(content: bytes | memoryview) -> Datagram:
    """Return a datagram by its parts. Raises `ValueError` for a length that none of the raw mode has."""
    length = len(content)
    if not HEADER_BYTES < length <= DATAGRAM_BYTES or length % 2:
        raise ValueError(
            f"datagram must have {HEADER_BYTES + 2}..{DATAGRAM_BYTES} bytes, an even number (raw mode), got {length}"
        )
    sequence, low, high = _HEADER.unpack_from(content)
    return Datagram(sequence, low | high << 32, content[HEADER_BYTES:])


def datagram(sequence: int, position: int, payload: bytes) -> bytes:
    """Return the bytes of a datagram."""
    place = position % _POSITIONS
    return _HEADER.pack(sequence % _SEQUENCES, place & 0xFFFFFFFF, place >> 32) + payload


@dataclass
class _OpenFrame:
    codes: bytearray
    stamp_ns: int
    #: Ends of what has come, by their starts.
    parts: dict[int, int] = field(default_factory=dict)
    held: int = 0

    def gaps(self) -> tuple[tuple[int, int], ...]:
        starts, ends = (0, *self.parts.values()), (*self.parts, len(self.codes))
        pairs = zip(sorted(starts), sorted(ends), strict=True)
        return tuple((start, end) for start, end in pairs if start < end)


class FrameAssembler:
    """Frames of one card, of `frame_bytes` each, in order; `counts` goes on over its recordings.

    A frame is complete with its last byte, or is given up once a datagram has come that is `WINDOW` datagrams past its
    end. A recording that begins anew (number 1, no bytes before) starts at frame 0 again.
    """

    def __init__(self, frame_bytes: int) -> None:
        require_positive("frame_bytes", frame_bytes)
        self.counts = PacketCounts()
        self._frame_bytes = frame_bytes
        self._begin()

    def _begin(self, sequence: int = 1, position: int = 0) -> None:
        """Expect a recording whose first datagram has this number and place."""
        self._open: dict[int, _OpenFrame] = {}
        self._next_frame = position // self._frame_bytes
        #: Number and place of the newest datagram, and its end.
        self._sequence, self._position, self._end = sequence - 1, position - PAYLOAD_BYTES, position

    def add(self, content: bytes | memoryview, stamp_ns: int) -> list[SampleFrame]:
        """Take in a datagram that came at `stamp_ns`; return the frames that it completes or gives up, in order.

        Raises `ValueError` for one of another mode, which changes nothing but its count.
        """
        try:
            packet = parse_datagram(content)
            frames = self.flush() if self._is_restart(packet) else []
            ahead, position = self._unwrapped(packet)
        except ValueError:
            self.counts.refused += 1
            raise
        if ahead > 0:
            # all that the newest datagram leaves out is lost until it comes
            self.counts.lost += ahead
            self._sequence, self._position = packet.sequence, position
            self._end = position + len(packet.payload)
        self._place(position, packet.payload, stamp_ns)
        return frames + self._completed(self._end - WINDOW * PAYLOAD_BYTES)

    def flush(self) -> list[SampleFrame]:
        """Return what is held of frames under way, their rest missing; the recording is over."""
        frames = self._completed(self._end + self._frame_bytes) if self._open else []
        self._begin()
        return frames

    def _is_restart(self, packet: Datagram) -> bool:
        far = self._end > WINDOW * PAYLOAD_BYTES
        return far and (packet.sequence, packet.position) == (1, 0)

    def _unwrapped(self, packet: Datagram) -> tuple[int, int]:
        """Return by how many numbers a datagram is ahead of the newest, and its place in the whole recording.

        Raises `ValueError` where number and place contradict each other.
        """
        ahead = _signed(packet.sequence - self._sequence, _SEQUENCES)
        position = self._position + _signed(packet.position - self._position, _POSITIONS)
        reach = self._position + ahead * PAYLOAD_BYTES
        # between two numbers lie as many datagrams, each as long as any or shorter
        is_newest = 0 < ahead <= MAX_LOST and self._end <= position <= reach
        is_older = ahead < 0 and reach <= position <= self._position - len(packet.payload)
        is_same = ahead == 0 and position == self._position
        if not (is_newest or is_older or is_same) or position % 2 or position < 0:
            raise ValueError(
                f"datagram {packet.sequence} must hold bytes that lie {ahead} datagrams (at most {MAX_LOST}) from byte "
                f"{self._position % _POSITIONS}, got byte {packet.position}"
            )
        return ahead, position

    def _place(self, position: int, payload: bytes | memoryview, stamp_ns: int) -> None:
        """Copy samples into the frames that they belong to."""
        was_new = was_known = False
        at = 0
        while at < len(payload):
            index, start = divmod(position + at, self._frame_bytes)
            end = min(start + len(payload) - at, self._frame_bytes)
            if index >= self._next_frame:
                frame = self._open.get(index)
                if frame is None:
                    frame = self._open[index] = _OpenFrame(bytearray(self._frame_bytes), stamp_ns)
                if start in frame.parts:
                    was_known = True
                else:
                    frame.codes[start:end] = payload[at : at + end - start]
                    frame.parts[start] = end
                    frame.held += end - start
                    was_new = True
            at += end - start
        if was_new:
            self.counts.placed += 1
            self.counts.lost -= 1
        elif was_known:
            self.counts.repeated += 1
        else:
            self.counts.late += 1

    def _completed(self, given_up: int) -> list[SampleFrame]:
        """Return frames from the next on that are whole, or end before the byte `given_up`."""
        frames = []
        while self._open:
            first = min(self._open)
            frame, end = self._open[first], (first + 1) * self._frame_bytes
            is_next = first == self._next_frame or first * self._frame_bytes <= given_up
            if not (is_next and frame.held >= self._frame_bytes) and end > given_up:
                break
            self.counts.lost_frames += first - self._next_frame
            self._next_frame = first + 1
            del self._open[first]
            frames.append(self._frame(first, frame))
        return frames

    def _frame(self, index: int, frame: _OpenFrame) -> SampleFrame:
        gaps = frame.gaps()
        self.counts.filled_frames += bool(gaps)
        return SampleFrame(index, frame.stamp_ns, np.frombuffer(frame.codes, "<i2"), gaps)


def _signed(difference: int, modulus: int) -> int:
    """Return a difference of counters that wrap, of the smallest magnitude."""
    return (difference + modulus // 2) % modulus - modulus // 2
