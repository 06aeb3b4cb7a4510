"""Datagrams to frames: any order, losses and repeats counted exactly, counters that wrap, foreign datagrams refused."""

from __future__ import annotations

import numpy as np
import pytest

from contrib.boards.dca1000_packets import (
    DATAGRAM_BYTES,
    MAX_LOST,
    PAYLOAD_BYTES,
    WINDOW,
    FrameAssembler,
    PacketCounts,
    SampleFrame,
    datagram,
    parse_datagram,
)

#: No whole number of datagrams, so that they reach over the ends of frames.
FRAME_BYTES = 6144


def recording(frames: int, seed: int = 1) -> bytes:
    """Random codes without a zero: what is zero in the answer was filled in."""
    codes = np.random.default_rng(seed).integers(1, 1 << 15, frames * FRAME_BYTES // 2)
    return bytes(codes.astype("<i2").tobytes())


def datagrams(content: bytes, first: int = 1, start: int = 0) -> list[bytes]:
    """The card's datagrams of a recording whose counters stand at `first` and `start`."""
    cuts = range(0, len(content), PAYLOAD_BYTES)
    return [datagram(first + at, start + cut, content[cut : cut + PAYLOAD_BYTES]) for at, cut in enumerate(cuts)]


def assembled(assembler: FrameAssembler, contents: list[bytes]) -> list[SampleFrame]:
    """Frames of datagrams that come a microsecond after each other, with the rest that is held."""
    frames = [frame for at, content in enumerate(contents) for frame in assembler.add(content, 1000 * at)]
    return frames + assembler.flush()


def test_all_in_order() -> None:
    content = recording(20)
    assembler = FrameAssembler(FRAME_BYTES)
    frames = assembled(assembler, datagrams(content))
    assert [frame.number for frame in frames] == list(range(20))
    assert b"".join(frame.codes.tobytes() for frame in frames) == content
    assert all(frame.gaps == () for frame in frames)
    # the datagram with a frame's first byte: 6144 n // 1456
    assert [frame.stamp_ns for frame in frames[:4]] == [0, 4000, 8000, 12000]
    assert assembler.counts == PacketCounts(placed=85)


def test_frames_come_with_their_last_byte() -> None:
    """Not a datagram later: no frame waits for the window where nothing is missing."""
    assembler = FrameAssembler(FRAME_BYTES)
    counts = [len(assembler.add(content, 0)) for content in datagrams(recording(3))]
    assert counts == [0, 0, 0, 0, 1, 0, 0, 0, 1, 0, 0, 0, 1]


@pytest.mark.parametrize("seed", range(5))
def test_loss_reordering_and_repeats_are_counted_exactly(seed: int) -> None:
    """Losses of 3 %, repeats of 2 %, and every datagram overtaken by up to half the window, drawn by seed."""
    rng = np.random.default_rng(seed)
    content = recording(300, seed)
    sent = datagrams(content)
    lost = rng.random(len(sent)) < 0.03
    repeated = ~lost & (rng.random(len(sent)) < 0.02)
    kept = [at for at in range(len(sent)) for _ in range(int(not lost[at]) + int(repeated[at]))]
    order = np.argsort(np.array(kept) + rng.uniform(0.0, 0.5 * WINDOW, len(kept)), kind="stable")
    assembler = FrameAssembler(FRAME_BYTES)
    frames = assembled(assembler, [sent[kept[at]] for at in order])
    counts = assembler.counts
    last = max(kept)
    assert counts.placed == int((~lost).sum())
    assert counts.lost == int(lost[:last].sum())
    # those of a frame that is out already count as late
    assert counts.repeated + counts.late == int(repeated.sum())
    expected = np.frombuffer(content, "<u1").copy()
    for at in np.flatnonzero(lost):
        expected[at * PAYLOAD_BYTES : (at + 1) * PAYLOAD_BYTES] = 0
    by_frame = expected.reshape(300, FRAME_BYTES)
    for frame in frames:
        assert frame.codes.tobytes() == by_frame[frame.number].tobytes()
        assert frame.missing_bytes == int((by_frame[frame.number].view("<i2") == 0).sum()) * 2
    assert counts.filled_frames == sum(frame.missing_bytes > 0 for frame in frames)
    assert len(frames) + counts.lost_frames == 300


def test_gaps_name_their_bytes() -> None:
    sent = datagrams(recording(2))
    assembler = FrameAssembler(FRAME_BYTES)
    first, second = assembled(assembler, [sent[0], sent[2], *sent[5:]])
    assert first.gaps == ((1456, 2912), (4368, 6144))
    assert second.gaps == ((0, 7280 - 6144),)
    assert (assembler.counts.lost, assembler.counts.filled_frames) == (3, 2)


def test_counters_wrap() -> None:
    """Both counters pass their ends within a recording: 2^32 datagrams and 2^48 bytes."""
    content = recording(30)
    start = (1 << 48) // FRAME_BYTES * FRAME_BYTES - 3 * FRAME_BYTES
    assembler = FrameAssembler(FRAME_BYTES)
    assembler._begin((1 << 32) - 5, start)
    sent = datagrams(content, (1 << 32) - 5, start)
    assert parse_datagram(sent[5]).sequence == 0
    frames = assembled(assembler, sent[:40] + sent[41:])
    assert assembler.counts.lost == 1
    assert [frame.number - frames[0].number for frame in frames] == list(range(30))
    assert b"".join(frame.codes.tobytes() for frame in frames[:9]) == content[: 9 * FRAME_BYTES]


def test_whole_frames_that_never_came() -> None:
    sent = datagrams(recording(100))
    assembler = FrameAssembler(FRAME_BYTES)
    frames = assembled(assembler, sent[:5] + sent[300:])
    numbers = [frame.number for frame in frames]
    assert numbers == [0, 1, *range(71, 100)]
    assert assembler.counts.lost_frames == 69
    assert assembler.counts.lost == 295


def test_a_recording_that_begins_anew() -> None:
    content = recording(30)
    assembler = FrameAssembler(FRAME_BYTES)
    frames = assembled(assembler, datagrams(content)[:-1] + datagrams(content))
    assert [frame.number for frame in frames] == [*range(30), *range(30)]
    assert frames[29].missing_bytes == 30 * FRAME_BYTES % PAYLOAD_BYTES
    assert b"".join(frame.codes.tobytes() for frame in frames[30:]) == content
    assert assembler.counts.lost == 0


def test_what_comes_after_its_frame_is_late() -> None:
    sent = datagrams(recording(40))
    assembler = FrameAssembler(FRAME_BYTES)
    frames = assembled(assembler, [sent[0], *sent[2:], sent[1]])
    assert frames[0].gaps == ((1456, 2912),)
    assert (assembler.counts.late, assembler.counts.lost) == (1, 1)


def test_a_short_datagram_on_the_way_does_not_end_the_recording() -> None:
    """As a card sends that flushes what it holds: the next begins where it ended, or where a full one would have."""
    content = recording(4)
    sent = datagrams(content)
    for short in (datagram(6, 5 * PAYLOAD_BYTES, content[5 * PAYLOAD_BYTES :][:100]),):
        assembler = FrameAssembler(FRAME_BYTES)
        frames = assembled(assembler, [*sent[:5], short, *sent[6:]])
        assert [frame.missing_bytes for frame in frames] == [0, PAYLOAD_BYTES - 100, 0, 0]
    rest = content[5 * PAYLOAD_BYTES + 100 :]
    after = datagrams(rest, 7, 5 * PAYLOAD_BYTES + 100)
    assembler = FrameAssembler(FRAME_BYTES)
    frames = assembled(assembler, [*sent[:5], short, *after])
    assert b"".join(frame.codes.tobytes() for frame in frames) == content
    assert assembler.counts.lost == 0


def test_small_frames_share_a_datagram() -> None:
    content = recording(1)
    assembler = FrameAssembler(128)
    frames = assembled(assembler, datagrams(content))
    assert b"".join(frame.codes.tobytes() for frame in frames) == content
    assert len(frames) == 48
    assert assembler.counts.placed == 5


@pytest.mark.parametrize("length", [0, 4, 10, 11, 13, DATAGRAM_BYTES + 2, 1 << 16])
def test_datagrams_of_another_mode_are_refused(length: int) -> None:
    assembler = FrameAssembler(FRAME_BYTES)
    with pytest.raises(ValueError, match=rf"datagram must have 12\.\.1466 bytes, an even .* got {length}$"):
        assembler.add(bytes(length), 0)
    assert assembler.counts == PacketCounts(refused=1)


@pytest.mark.parametrize(
    ("sequence", "position"),
    [(1, 2), (2, 0), (2, 2914), (3, 1 << 40), (0, 1456), (MAX_LOST + 2, 1456 * (MAX_LOST + 1)), (3, 1457)],
)
def test_counters_that_contradict_each_other_are_refused(sequence: int, position: int) -> None:
    """And nothing of the recording is lost by them."""
    content = recording(4)
    sent = datagrams(content)
    assembler = FrameAssembler(FRAME_BYTES)
    frames = assembler.add(sent[0], 0)
    with pytest.raises(ValueError, match=f"datagram {sequence} must hold bytes that lie"):
        assembler.add(datagram(sequence, position, bytes(PAYLOAD_BYTES)), 0)
    frames += assembled(assembler, sent[1:])
    assert b"".join(frame.codes.tobytes() for frame in frames) == content
    assert (assembler.counts.refused, assembler.counts.lost) == (1, 0)


def test_overlapping_datagrams_do_not_pass_for_a_whole_frame() -> None:
    """A frame says what is missing though its parts together are longer than it is."""
    assembler = FrameAssembler(4 * PAYLOAD_BYTES)
    part = bytes([1]) * PAYLOAD_BYTES
    frames = [
        frame
        for sequence, position in ((1, 0), (3, 1458), (5, 2916))
        for frame in assembler.add(datagram(sequence, position, part), 0)
    ]
    (frame,) = frames + assembler.flush()
    assert frame.gaps == ((1456, 1458), (2914, 2916), (4372, 5824))
