"""Damaged recordings: cut at every byte, cut and flipped at random places; what recovery keeps and what it says."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest

from msgs.recording.mcap import RecordingReader, RecordingWriter
from msgs.recording.mcap_copy import copy_recording
from msgs.values.diagnostics import LogRecord
from msgs.values.vehicle import VehicleState
from tests.builders import example_beam

TURN_NS = 500_000_000
#: Takes a recovered file where its bytes are looked at elsewhere.
NOWHERE = Path(os.devnull)
Key = tuple[str, int, int, int]


def write(path: Path, turns: int, samples: int, topics: int = 3) -> Path:
    """A beam (plain chunks), a state and a text (compressed chunks) every half second, a chunk of each a second."""
    rng = np.random.default_rng(7)
    with RecordingWriter(path, {"launch": "name: x"}) as writer:
        for turn in range(turns):
            noise = rng.integers(-99, 99, (2, samples, 2), dtype=np.int16)
            beam = example_beam(stamp_ns=turn, samples=noise)
            text = LogRecord(stamp_ns=turn, node="a", level="info", text=rng.bytes(samples // 4).hex())
            state = VehicleState(stamp_ns=turn, speed_mps=0.5 * turn)
            said = [("radar/beam", beam), ("vehicle/state", state), ("log", text)]
            for at, (topic, message) in enumerate(said[:topics]):
                writer.write(topic, message, publisher="a", sequence=turn, sent_ns=turn * TURN_NS + at)
    return path


def contents(path: Path) -> tuple[list[Key], bool]:
    """What is in a recording, each message by its bytes, and whether it is whole."""
    with RecordingReader(path) as reader:
        found = [
            (channel.topic, raw.sequence, raw.log_time, hash(raw.data))
            for channel, raw in reader.raw_messages(None, None)
        ]
        return found, reader.complete and reader.loss is None


def chunk_sizes(path: Path) -> list[int]:
    """Messages of each chunk."""
    with RecordingReader(path) as reader:
        return [len(list(reader._chunk_messages([chunk]))) for chunk in reader._walk.chunks]


def chunk_ends(path: Path) -> list[int]:
    """Where each chunk ends."""
    with RecordingReader(path) as reader:
        ends = []
        for chunk in reader._walk.chunks:
            reader._file.seek(chunk.offset + 1)
            ends.append(chunk.offset + 9 + int.from_bytes(reader._file.read(8), "little"))
        return ends


@pytest.fixture(scope="module")
def large(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """About 1.4 MB in some 12 chunks of either kind."""
    return write(tmp_path_factory.mktemp("large") / "large.mcap", 24, 6_000)


def check_cut(cut: Path, size: int, whole: Path, out: Path) -> None:
    """Everything in chunks before `size` is recovered, nothing else, and the loss is told."""
    expected, _ = contents(whole)
    count, loss = copy_recording(cut, out, overwrite=True)
    kept, is_whole = contents(out)
    assert is_whole
    assert set(kept) <= set(expected)
    intact = sum(n for n, end in zip(chunk_sizes(whole), chunk_ends(whole), strict=True) if end <= size)
    assert count == len(kept) == intact
    # the last 8 bytes only repeat the magic
    assert (loss is None) == (size >= whole.stat().st_size - 8)


@pytest.mark.slow
def test_a_small_recording_cut_at_every_byte(tmp_path: Path) -> None:
    """About the ends of chunks, of other bytes at every fourth. No cut raises; each costs the chunk it goes through and
    those behind it; the rest is copied, exactly.
    """
    whole = write(tmp_path / "whole.mcap", 4, 2, topics=2)
    size = whole.stat().st_size
    sizes, ends = chunk_sizes(whole), chunk_ends(whole)
    assert len(ends) >= 4
    cut, out = tmp_path / "cut.mcap", tmp_path / "out.mcap"
    cut.write_bytes(whole.read_bytes())
    near = {byte for end in (*ends, size) for byte in range(end - 40, end + 40)}
    for at in reversed(range(8, size)):
        if at % 4 and at not in near:
            continue
        os.truncate(cut, at)
        count, loss = copy_recording(cut, NOWHERE, overwrite=True)
        assert count == sum(n for n, end in zip(sizes, ends, strict=True) if end <= at), at
        assert (loss is None) == (at >= size - 8), f"{at} of {size} bytes: {loss}"
        if at in ends or at + 1 in ends:
            check_cut(cut, at, whole, out)
    for at in range(8):
        os.truncate(cut, at)
        with pytest.raises(ValueError, match=r"cut\.mcap: is "):
            copy_recording(cut, out, overwrite=True)


@pytest.mark.slow
def test_a_large_recording_with_flipped_bytes(large: Path, tmp_path: Path) -> None:
    """One byte wrong, wherever: at most one chunk is lost, no message is changed, and what is lost is told."""
    raw = bytearray(large.read_bytes())
    expected, largest = set(contents(large)[0]), max(chunk_sizes(large))
    damaged, out = tmp_path / "damaged.mcap", tmp_path / "out.mcap"
    rng = np.random.default_rng(12)
    for at, change in zip(rng.integers(8, len(raw), 100), rng.integers(1, 256, 100), strict=True):
        raw[at] ^= change
        damaged.unlink(missing_ok=True)
        damaged.write_bytes(raw)
        raw[at] ^= change
        out.unlink(missing_ok=True)
        count, loss = copy_recording(damaged, out)
        kept, is_whole = contents(out)
        assert is_whole
        assert set(kept) <= expected
        assert count == len(kept) >= len(expected) - largest, f"byte {at}: {loss}"
        assert count == len(expected) or loss is not None, f"byte {at}"


@pytest.mark.slow
def test_damage_to_the_frame_of_a_chunk_costs_that_chunk_alone(large: Path, tmp_path: Path) -> None:
    """Each byte of a record's head and a chunk's own fields: lengths that lie, times that jump, types that are none."""
    raw = bytearray(large.read_bytes())
    expected, largest = set(contents(large)[0]), max(chunk_sizes(large))
    with RecordingReader(large) as reader:
        offset = reader._walk.chunks[5].offset
    damaged, out = tmp_path / "damaged.mcap", tmp_path / "out.mcap"
    for at in range(offset, offset + 49):
        for change in (0x01, 0xFF):
            raw[at] ^= change
            damaged.unlink(missing_ok=True)
            damaged.write_bytes(raw)
            raw[at] ^= change
            out.unlink(missing_ok=True)
            count, loss = copy_recording(damaged, out)
            kept, is_whole = contents(out)
            assert is_whole
            assert set(kept) <= expected
            assert count >= len(expected) - largest, f"byte {at - offset} of the chunk: {loss}"
            assert count == len(expected) or loss is not None
