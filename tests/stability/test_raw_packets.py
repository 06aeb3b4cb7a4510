"""Raw samples of a 77 GHz board: counters that wrap, lanes that are missing, transmitters that take turns."""

from __future__ import annotations

import contextlib

import msgspec
import numpy as np
import pytest

from contrib.boards.dca1000_capture import frame_samples, parse_cfg
from contrib.boards.dca1000_packets import PAYLOAD_BYTES, FrameAssembler, datagram
from contrib.boards.digital_array import DigitalArrayParams, range_doppler, slots_aligned
from tests.contrib.boards.test_import_dca1000 import CFG, LOOPS, SAMPLES, two_lanes
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


@pytest.mark.hard("contrib.boards.dca1000_capture", "stored samples taken for successive ones", 0.5, "range bins",
                  "a maximum on a bin")  # fmt: skip
def test_a_chirp_of_which_two_of_four_lanes_are_stored(errors: Errors) -> None:
    """Samples 0, 1, 4, 5, ... of a tone on bin 19 of 64: taken for successive ones they show it at twice the range."""
    cfg = parse_cfg(CFG, "a.cfg")
    config = msgspec.structs.replace(cfg, sent_lanes=4)
    tone = 1000.0 * np.exp(2j * np.pi * 19 * np.arange(SAMPLES) / SAMPLES)
    stored = np.broadcast_to(tone[np.arange(SAMPLES) % 4 < 2], (LOOPS, 2, 4, SAMPLES // 2))
    samples = frame_samples(np.frombuffer(two_lanes(stored), "<i2"), config)
    found = [int(np.abs(np.fft.fft(each)).argmax()) for each in (stored[0, 0, 0], samples[0, 0])]
    errors(naive=abs(found[0] - 19.0), ours=abs(found[1] - 19.0))


@pytest.mark.hard("contrib.boards.digital_array", "channels added as they were sent", 0.6, "deg",
                  "a step of 256 azimuths, and the loops' ends")  # fmt: skip
def test_transmitters_half_a_turn_apart(errors: Errors) -> None:
    """A car at 5.1 of +-5.2 m/s: its phase turns by 177 deg between the slots of two transmitters."""
    params = DigitalArrayParams()
    at_once = msgspec.structs.replace(params, channel_slot=(0,) * 8, chirp_interval_s=2 * params.chirp_interval_s)
    chirp, channel, sample = np.ogrid[:128, :8, :64]
    time_s = chirp * params.repetition_interval_s + np.array(params.channel_slot)[channel] * params.chirp_interval_s
    turns = 20 * sample / 64 - 2.0 * 5.1 * time_s / params.wavelength_m - 0.5 * channel * np.sin(np.radians(25.0))
    samples = np.exp(2j * np.pi * turns).astype(np.complex64)
    steering_deg = np.linspace(-60.0, 60.0, 1201)
    steering = np.exp(1j * np.pi * np.multiply.outer(np.arange(8), np.sin(np.radians(steering_deg))))
    azimuths = []
    for each in (samples, slots_aligned(samples, params)):
        spectra = range_doppler(each, at_once)[..., 20]
        peak = spectra[np.abs(spectra).sum(axis=1).argmax()]
        azimuths.append(float(steering_deg[np.abs(peak @ steering).argmax()]))
    errors(naive=abs(azimuths[0] - 25.0), ours=abs(azimuths[1] - 25.0))


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


def test_all_lost_and_nothing_at_all() -> None:
    assembler = FrameAssembler(FRAME_BYTES)
    assert assembler.flush() == []
    (frame,) = assembler.add(datagram(1 + 384, 384 * PAYLOAD_BYTES, bytes([1]) * PAYLOAD_BYTES), 0) + assembler.flush()
    assert frame.number == 384 * PAYLOAD_BYTES // FRAME_BYTES
    assert frame.missing_bytes == FRAME_BYTES - PAYLOAD_BYTES
    assert (assembler.counts.lost, assembler.counts.lost_frames) == (384, frame.number)
