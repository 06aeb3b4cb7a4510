"""Raw samples of a 77 GHz board: counters that wrap, lanes that are missing, transmitters that take turns."""

from __future__ import annotations

import contextlib

import numpy as np
import pytest

from contrib.boards.dca1000_packets import PAYLOAD_BYTES, FrameAssembler, datagram
from tests.stability.catalogue import Errors

FRAME_BYTES = 6144


def wrong_bytes(frames: dict[int, bytes], content: bytes) -> float:
    """Bytes of a recording that are not in their place."""
    expected = np.frombuffer(content, np.uint8).reshape(-1, FRAME_BYTES)
    empty = bytes(FRAME_BYTES)
    parts = [np.frombuffer(frames.get(at, empty), np.uint8) for at in range(len(expected))]
    return float(sum(np.count_nonzero(part != whole) for part, whole in zip(parts, expected, strict=True)))


@pytest.mark.hard("contrib.boards.dca1000_packets", "places taken as the counter has them", 0.0, "bytes",
                  "every datagram arrives")  # fmt: skip
def test_a_byte_counter_of_48_bits_wraps(errors: Errors) -> None:
    """50 days at 65 MB/s, or a card whose counter begins there; datagrams arrive in pairs that are exchanged."""
    content = np.random.default_rng(4).integers(1, 255, 12 * FRAME_BYTES, dtype=np.uint8).tobytes()
    start = (1 << 48) // FRAME_BYTES * FRAME_BYTES - 4 * FRAME_BYTES
    cuts = list(range(0, len(content), PAYLOAD_BYTES))
    assembler = FrameAssembler(FRAME_BYTES)
    assembler._begin((1 << 32) - 3, start)
    ours: dict[int, bytes] = {}
    naive = bytearray(len(content))
    for at in [at ^ 1 if at ^ 1 < len(cuts) else at for at in range(len(cuts))]:
        payload = content[cuts[at] : cuts[at] + PAYLOAD_BYTES]
        packet = datagram((1 << 32) - 3 + at, start + cuts[at], payload)
        for frame in assembler.add(packet, 0):
            ours[frame.number - start // FRAME_BYTES] = frame.codes.tobytes()
        place = int.from_bytes(packet[4:10], "little") - start
        if 0 <= place < len(naive):
            naive[place : place + len(payload)] = payload
    split = {at: bytes(naive[at * FRAME_BYTES : (at + 1) * FRAME_BYTES]) for at in range(12)}
    errors(naive=wrong_bytes(split, content), ours=wrong_bytes(ours, content))


@pytest.mark.parametrize("cut", [*range(1, 12), 700, 1465])
def test_cut_datagrams_lose_themselves_alone(cut: int) -> None:
    """A datagram of which only the first bytes came: refused or taken as short, and no frame has a foreign byte."""
    content = np.random.default_rng(5).integers(1, 255, 3 * FRAME_BYTES, dtype=np.uint8).tobytes()
    sent = [
        datagram(1 + at, place, content[place : place + PAYLOAD_BYTES])
        for at, place in enumerate(range(0, len(content), PAYLOAD_BYTES))
    ]
    sent[4] = sent[4][:cut]
    assembler = FrameAssembler(FRAME_BYTES)
    frames = []
    for each in sent:
        with contextlib.suppress(ValueError):
            frames += assembler.add(each, 0)
    frames += assembler.flush()
    assert [frame.number for frame in frames] == [0, 1, 2]
    for frame in frames:
        whole = np.frombuffer(content, np.uint8)[frame.number * FRAME_BYTES :][:FRAME_BYTES]
        held = np.ones(FRAME_BYTES, bool)
        for start, end in frame.gaps:
            held[start:end] = False
        codes = frame.codes.view(np.uint8)
        assert np.array_equal(codes[held], whole[held])
        assert not codes[~held].any()
    assert sum(frame.missing_bytes for frame in frames) == PAYLOAD_BYTES - (690 if cut == 700 else 0)
