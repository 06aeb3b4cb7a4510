"""Hard cases of messages: integers that wrap, endless nesting, lying lengths, floats at the edges of their range."""

from __future__ import annotations

import json
import math
import struct
from pathlib import Path

import msgpack
import msgspec
import numpy as np
import pytest

from msgs.bus.codec import CodecError, decode, decode_inline, encode, json_schema, to_builtins
from msgs.bus.interface import Envelope
from msgs.bus.local import LocalNetwork
from msgs.bus.topics import TOPICS
from msgs.recording.mcap import RecordingReader, RecordingWriter, info
from msgs.recording.sigmf import SigmfCapture, write_capture
from msgs.values.diagnostics import LogRecord
from msgs.values.radar import RadarBeam, RadarParams, RadarSetup
from msgs.values.vehicle import VehicleState

ENVELOPE = {"protocol": 1, "publisher": "rogue", "topic": "vehicle/state", "sequence": 0, "sent_ns": 0}


class Sample(msgspec.Struct, frozen=True, eq=False):
    values: np.ndarray


@pytest.mark.parametrize("shape", [[1 << 62, 4], [1 << 32, 1 << 32], [3, 6148914691236517206], [1 << 63, 2]])
def test_shape_whose_product_wraps(shape: list[int]) -> None:
    """In 64 bits each product times 8 bytes is small or zero and would pass for a short buffer; exact integers tell."""
    with np.errstate(over="ignore"):
        naive = int(np.multiply.reduce(np.array(shape, np.uint64)) * np.uint64(8))
    assert naive <= 16, "the naive check would let this through"
    body = {"values": {"dtype": "<f8", "shape": shape, "data": bytes(naive)}}
    with pytest.raises(CodecError, match=r"needs \d+ bytes"):
        decode_inline(Sample, msgpack.packb(body))


@pytest.mark.parametrize("opening", [b"\x91", b"\x81\xa1x", b"\xdd\x00\x00\x00\x01"])
@pytest.mark.parametrize("depth", [900, 5_000, 200_000])
def test_nesting_without_end(opening: bytes, depth: int) -> None:
    bomb = opening * min(depth, (1 << 20) // len(opening) - 100) + b"\xc0"
    header = b"\x82\xa8envelope" + msgpack.packb(ENVELOPE) + b"\xa4body" + b"\x81\xa8stamp_ns" + bomb
    for data in (bomb, header):
        with pytest.raises(CodecError):
            decode([b"radar/beam\0", data])
        with pytest.raises(CodecError):
            decode_inline(VehicleState, data)


@pytest.mark.parametrize(
    "lie",
    [
        b"\xdd\xff\xff\xff\xff",  # array of 2^32 - 1
        b"\xdf\xff\xff\xff\xff",  # map
        b"\xc6\xff\xff\xff\xff",  # binary
        b"\xdb\xff\xff\xff\xff",  # text
        b"\xc9\xff\xff\xff\xff\x01",  # extension
    ],
)
def test_lengths_that_promise_four_gigabytes(lie: bytes) -> None:
    with pytest.raises(CodecError):
        decode([b"vehicle/state\0", lie])
    with pytest.raises(CodecError):
        decode_inline(VehicleState, b"\x81\xa8stamp_ns" + lie)


@pytest.mark.parametrize("stamp_ns", [0, 2**53 + 1, 2**62])
def test_integers_stay_exact_beyond_the_floats(tmp_path: Path, stamp_ns: int) -> None:
    message = LogRecord(stamp_ns=stamp_ns, node="a", level="info", text="")
    envelope = Envelope(publisher="a", topic="log", sequence=2**48, sent_ns=2**63)
    assert decode(encode(envelope, message)) == ("log", message, envelope)
    assert json.loads(json.dumps(to_builtins(message)))["stamp_ns"] == stamp_ns
    with RecordingWriter(tmp_path / "a.mcap", {}) as writer:
        writer.write("log", message, publisher="a", sequence=0, sent_ns=2**64 - 1)
    with RecordingReader(tmp_path / "a.mcap") as reader:
        (recorded,) = reader.messages()
    assert (recorded.message, recorded.log_time_ns) == (message, 2**64 - 1)


def test_summary_of_arrays_at_the_edge() -> None:
    """The magnitude of the largest complex64 exceeds float32, a sum of int8 its type; none finite, no figure."""
    largest = np.float32(np.finfo(np.float32).max)
    summary = to_builtins(Sample(np.array([complex(largest, largest)], np.complex64)))["values"]
    assert summary["max"] == pytest.approx(math.sqrt(2.0) * float(largest), rel=1e-12)
    assert to_builtins(Sample(np.full(1000, 127, np.int8)))["values"]["mean"] == 127.0
    assert "max" not in to_builtins(Sample(np.full(3, np.nan)))["values"]
    assert "max" not in to_builtins(Sample(np.zeros((0, 4))))["values"]
    overflowing = to_builtins(Sample(np.full(4, np.finfo(np.float64).max)))["values"]
    assert overflowing["mean"] is None
    json.dumps(overflowing, allow_nan=False)


def test_poisoned_envelope_does_not_silence_a_publisher() -> None:
    """A forged clock reading from the future would make all true messages look old; it is refused instead."""
    network = LocalNetwork(start_ns=1000)
    victim, receiver = network.bus("victim"), network.bus("receiver")
    receiver.subscribe("vehicle/state")
    forged = Envelope(publisher="victim", topic="vehicle/state", sequence=10**18, sent_ns=10**18)
    network._send(TOPICS["vehicle/state"], forged, encode(forged, VehicleState(stamp_ns=0)))
    victim.publish("vehicle/state", VehicleState(stamp_ns=1))
    network.advance(1)
    assert [message.message for message in receiver.receive(0.0)] == [VehicleState(stamp_ns=1)]
    (count,) = receiver.counts()[0]
    assert (count.rejected, count.lost) == (1, 0)


@pytest.mark.parametrize("length", [0, 1, 1 << 31, 1 << 62, (1 << 64) - 1])
def test_lying_record_lengths_in_a_recording(tmp_path: Path, length: int) -> None:
    """Each record head in turn promises `length` bytes; reading ends, allocates nothing of that size, says so."""
    path = tmp_path / "a.mcap"
    with RecordingWriter(path, {"k": "v"}) as writer:
        for index in range(3):
            sent_ns = index * 2 * 10**9
            writer.write("vehicle/state", VehicleState(stamp_ns=index), publisher="a", sequence=index, sent_ns=sent_ns)
    raw = path.read_bytes()
    offset, offsets = 8, []
    while offset < len(raw) - 8:
        offsets.append(offset)
        offset += 9 + struct.unpack_from("<Q", raw, offset + 1)[0]
    assert len(offsets) > 10
    for at in offsets:
        path.write_bytes(raw[: at + 1] + struct.pack("<Q", length) + raw[at + 9 :])
        found = info(path)
        assert sum(topic.messages for topic in found.topics) <= 3
        assert found.loss is not None or not found.checksums_agree


def test_angles_and_levels_of_a_capture_are_exact(tmp_path: Path) -> None:
    """Decimal text of a float64 is exact when written shortest; a degree turned to radians and back would not be."""
    angles_deg = tuple(float(angle) for angle in np.random.default_rng(0).uniform(-60, 60, 40))
    assert any(math.degrees(math.radians(angle)) != angle for angle in angles_deg), "the naive way loses bits"
    setup = RadarSetup(
        radar=RadarParams(chirps_per_beam=1, samples_per_chirp=2, carrier_hz=1e10 / 3),
        full_scale_dbm=-20.0 / 3,
        beams=msgspec.structs.replace(RadarSetup().beams, azimuth_deg=angles_deg),
    )
    beams = [
        RadarBeam(
            stamp_ns=2**61 + index,
            scan_id=2**62,
            beam_index=index,
            beam_count=40,
            azimuth_rad=math.radians(angle),
            samples=np.array([[[-32768, 32767], [index, 0]]], np.int16),
            full_scale_dbm=setup.full_scale_dbm,
        )
        for index, angle in enumerate(angles_deg)
    ]
    write_capture(tmp_path / "c", setup, beams)
    capture = SigmfCapture.open(tmp_path / "c")
    assert capture.setup.beams.azimuth_deg == angles_deg
    assert capture.setup.radar == setup.radar
    assert capture.setup.full_scale_dbm == setup.full_scale_dbm
    for ours, theirs in zip(beams, capture.beams(), strict=True):
        assert (ours.azimuth_rad, ours.stamp_ns, ours.scan_id) == (theirs.azimuth_rad, theirs.stamp_ns, theirs.scan_id)


def test_schemas_are_the_same_in_every_process() -> None:
    """The permitted dtypes are a set, whose order differs from process to process; a recording's bytes must not."""
    listed = json_schema(Sample)["$defs"]["Sample"]["properties"]["values"]["properties"]["dtype"]["enum"]
    assert listed == sorted(listed)
