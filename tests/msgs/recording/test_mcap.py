"""Recordings: round trip, order, other readers, damage, foreign topics, refusals, full disks."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
import tracemalloc
from io import BytesIO
from pathlib import Path

import jsonschema
import msgpack
import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.records import Message
from mcap.stream_reader import CRCValidationError, StreamReader
from mcap.writer import CompressionType, IndexType, Writer

from msgs.bus.codec import encode_inline
from msgs.bus.topics import TOPICS
from msgs.recording import mcap as recording
from msgs.recording import mcap_writer as mcap_file
from msgs.recording.mcap import RAW_TOPIC, Encoded, Losses, Recorded, RecordingReader, RecordingWriter, TopicLoss, info
from msgs.recording.mcap_copy import copy_recording
from msgs.values.diagnostics import LogRecord
from msgs.values.radar import RadarBeam, RadarSetup
from msgs.values.vehicle import VehicleState
from tests.builders import example_beam
from tests.msgs.bus.test_codec import CASES

METADATA = {"scene": "corner", "config": "{}"}


def state(stamp_ns: int) -> VehicleState:
    return VehicleState(stamp_ns=stamp_ns, speed_mps=0.5 * stamp_ns)


def beam(index: int) -> RadarBeam:
    samples = np.random.default_rng(index).integers(-99, 99, (2, 64, 2), dtype=np.int16)
    return example_beam(stamp_ns=index, beam_index=index, beam_count=100, samples=samples)


def record(path: Path, count: int = 6, step_ns: int = 10) -> Path:
    """`count` beams of "radar" and states of "car", taking turns."""
    with RecordingWriter(path, METADATA) as writer:
        for index in range(count):
            writer.write("radar/beam", beam(index), publisher="radar", sequence=index, sent_ns=step_ns * index)
            writer.write("vehicle/state", state(index), publisher="car", sequence=index, sent_ns=step_ns * index + 5)
    return path


def read(path: Path) -> tuple[list[Recorded], str | None]:
    with RecordingReader(path) as reader:
        return list(reader.messages()), reader.loss


def keys(messages: list[Recorded]) -> list[tuple[str, int, int]]:
    return [(message.topic, message.sequence, message.log_time_ns) for message in messages]


def test_round_trip(tmp_path: Path) -> None:
    messages, loss = read(record(tmp_path / "a.mcap"))
    assert loss is None
    assert keys(messages)[:3] == [("radar/beam", 0, 0), ("vehicle/state", 0, 5), ("radar/beam", 1, 10)]
    assert [message.publisher for message in messages[:2]] == ["radar", "car"]
    for message in messages:
        if isinstance(message.message, RadarBeam):
            expected = beam(message.sequence)
            assert message.message.samples.tobytes() == expected.samples.tobytes()
            assert message.message.stamp_ns == expected.stamp_ns
        else:
            assert message.message == state(message.sequence)


def test_info(tmp_path: Path) -> None:
    found = info(record(tmp_path / "a.mcap", count=11))
    assert (found.complete, found.checksums_agree, found.loss) == (True, True, None)
    assert found.metadata == METADATA
    assert found.start_ns == 0
    assert found.duration_s == pytest.approx(105e-9)
    radar, car = found.topics
    assert (radar.topic, radar.type, radar.publishers, radar.messages) == ("radar/beam", "RadarBeam", ("radar",), 11)
    assert radar.rate_hz == pytest.approx(1e8)
    assert (car.topic, car.known) == ("vehicle/state", True)
    assert radar.bytes > 11 * beam(0).samples.nbytes


def test_any_mcap_and_msgpack_library_reads_it(tmp_path: Path) -> None:
    """Every topic as the reference readers and plain msgpack show it: schema, times, both checksums, plain and zstd."""
    path = tmp_path / "a.mcap"
    with RecordingWriter(path, METADATA) as writer:
        for sent_ns, (topic, message) in enumerate(CASES):
            writer.write(topic, message, publisher="x", sequence=sent_ns, sent_ns=sent_ns)
    with path.open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        rows = list(reader.iter_messages())
        summary = reader.get_summary()
        by_record = list(StreamReader(BytesIO(path.read_bytes()), validate_crcs=True).records)
    assert summary is not None
    assert summary.statistics is not None
    assert summary.statistics.message_count == len(rows) == len(CASES)
    assert sum(isinstance(record, Message) for record in by_record) == len(CASES)
    assert {channel.topic for _, channel, _ in rows} == TOPICS.keys()
    for schema, channel, message in rows:
        assert schema is not None
        assert (channel.message_encoding, schema.encoding) == ("msgpack", "jsonschema")
        assert schema.name == TOPICS[channel.topic].type.__name__
        body = msgpack.unpackb(message.data)
        jsonschema.validate(json.loads(json.dumps(body, default=lambda data: data.hex())), json.loads(schema.data))
        assert message.publish_time == max(0, body["stamp_ns"])
    for index in summary.chunk_indexes:
        topics = {summary.channels[number].topic for number in index.message_index_offsets}
        assert index.compression == ("" if topics == {RAW_TOPIC} else "zstd")


def test_a_changed_byte_of_data_or_index_fails_the_checksums_of_other_readers(tmp_path: Path) -> None:
    raw = record(tmp_path / "a.mcap", count=2).read_bytes()
    at = raw.index(beam(1).samples.tobytes())
    damaged = raw[:at] + bytes([raw[at] ^ 1]) + raw[at + 1 :]
    with pytest.raises(CRCValidationError):
        list(make_reader(BytesIO(damaged), validate_crcs=True).iter_messages())
    with pytest.raises(CRCValidationError):
        list(StreamReader(BytesIO(damaged), emit_chunks=True, validate_crcs=True).records)


def test_each_chunk_can_be_read_alone(tmp_path: Path) -> None:
    """Whatever chunk is damaged, a file without its index loses that one only: each declares its own channels."""
    path = record(tmp_path / "a.mcap", count=4, step_ns=2_000_000_000)
    with RecordingReader(path) as reader:
        chunks = reader._walk.chunks
    raw = bytearray(path.read_bytes()[: chunks[-1].offset + 100])
    raw[chunks[0].offset + 200] ^= 1
    path.write_bytes(raw)
    messages, loss = read(path)
    assert loss is not None
    assert {message.topic for message in messages} == {"radar/beam", "vehicle/state"}
    assert len(messages) >= 8 - 2 * 2


def test_a_chunk_behind_damage_is_found_by_the_index(tmp_path: Path) -> None:
    path = record(tmp_path / "a.mcap", count=4, step_ns=2_000_000_000)
    with RecordingReader(path) as reader:
        offset = reader._walk.chunks[1].offset
    raw = bytearray(path.read_bytes())
    # the length of a record: what follows cannot be walked to
    raw[offset + 3] ^= 0xFF
    path.write_bytes(raw)
    messages, loss = read(path)
    assert len(messages) >= 6
    assert loss is not None
    assert "all chunks found by the index" in loss


def test_losses_are_told(tmp_path: Path) -> None:
    losses = Losses(topics=(TopicLoss(topic="log", lost=2, rejected=1, missed=4),), ended="the disk is full")
    with RecordingWriter(tmp_path / "a.mcap", METADATA) as writer:
        writer.write(
            "log", LogRecord(stamp_ns=1, node="a", level="info", text=""), publisher="a", sequence=0, sent_ns=0
        )
        writer.write_losses(losses)
    found = info(tmp_path / "a.mcap")
    assert (found.losses, found.metadata, found.loss) == (losses, METADATA, None)
    assert losses.total == 6, "what is rejected leaves a gap, too"
    copy_recording(tmp_path / "a.mcap", tmp_path / "b.mcap")
    assert info(tmp_path / "b.mcap").losses == losses
    assert info(record(tmp_path / "c.mcap")).losses is None


def test_a_disk_without_room_leaves_a_file_up_to_its_last_whole_chunk(tmp_path: Path) -> None:
    """A limit on the file's size stops the third chunk in its middle; the index still finds room."""
    path = tmp_path / "a.mcap"
    said = subprocess.run(
        [sys.executable, "-B", "-c", FULL_CHILD, str(path)], capture_output=True, text=True, check=True
    )
    assert said.stdout.split() == ["File", "too", "large", "2", "messages"]
    assert path.stat().st_size <= 400_000
    messages, loss = read(path)
    assert loss is None
    assert [message.sequence for message in messages] == [0, 1]
    assert info(path).checksums_agree


FULL_CHILD = """
import resource, sys
from pathlib import Path
import numpy as np
from msgs.values.radar import RadarBeam
from msgs.recording.mcap import RecordingWriter
resource.setrlimit(resource.RLIMIT_FSIZE, (400_000, 400_000))
writer = RecordingWriter(Path(sys.argv[1]), {})
try:
    for n in range(4):
        samples = np.zeros((1, 40_000, 2), np.int16)
        beam = RadarBeam(stamp_ns=n, scan_id=0, beam_index=n, beam_count=9, azimuth_rad=0.0, samples=samples,
                         full_scale_dbm=0.0)
        writer.write("radar/beam", beam, publisher="a", sequence=n, sent_ns=0)
        writer.flush()
except OSError as error:
    print(error.strerror)
writer.close()
print(writer.written()["radar/beam"], "messages")
"""


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs /dev/full")
def test_a_full_disk_from_the_first_byte_is_an_error_that_says_so() -> None:
    with pytest.raises(OSError, match="No space left on device"):
        RecordingWriter(Path("/dev/full"), {}, overwrite=True)


def test_topics_and_times_filter(tmp_path: Path) -> None:
    with RecordingReader(record(tmp_path / "a.mcap")) as reader:
        states = list(reader.messages(topics=["vehicle/state"], start_ns=15, end_ns=45))
        assert keys(states) == [("vehicle/state", 1, 15), ("vehicle/state", 2, 25), ("vehicle/state", 3, 35)]
        # the same reader again, from the beginning
        assert len(list(reader.messages())) == 12


def test_log_time_order_across_chunks(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    times = [5_000_000_000, 1, 9_000_000_000, 3_000_000_000, 3_000_000_000, 2]
    with RecordingWriter(path, {}) as writer:
        for sequence, sent_ns in enumerate(times):
            writer.write("vehicle/state", state(0), publisher="car", sequence=sequence, sent_ns=sent_ns)
    messages, _ = read(path)
    assert [message.log_time_ns for message in messages] == sorted(times)
    assert [message.sequence for message in messages] == [1, 5, 3, 4, 0, 2], "equal times in order of writing"


@pytest.mark.parametrize("back_ns", [0, 500])
def test_a_clock_that_was_set_back_while_recording_is_said(
    back_ns: int, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """Of one publisher: what several send may be written in another order than it was sent."""
    path = tmp_path / "a.mcap"
    with RecordingWriter(path, {}) as writer:
        for index in range(10):
            sent_ns = 1000 + 100 * index - back_ns * (index >= 6)
            writer.write("vehicle/state", state(index), publisher="car", sequence=index, sent_ns=sent_ns)
            writer.write("vehicle/state", state(index), publisher="other", sequence=index, sent_ns=sent_ns - 150)
    with RecordingReader(path) as reader:
        assert len(list(reader.messages())) == len(list(reader.messages())) == 20
    said = f"{path}: the clock was set back while vehicle/state was recorded"
    assert caplog.text.count(said) == (1 if back_ns else 0)


def test_equal_times_keep_the_order_of_writing(tmp_path: Path) -> None:
    """Also between raw beams and all else, which stand in chunks of their own; other readers agree."""
    path = tmp_path / "a.mcap"
    order = []
    with RecordingWriter(path, {}) as writer:
        for number, topic in enumerate("cbbcbccbcb" * 3):
            name, message = ("vehicle/state", state(0)) if topic == "c" else ("radar/beam", beam(number))
            writer.write(name, message, publisher="x", sequence=number, sent_ns=7 * (number // 5))
            order.append(number)
    messages, _ = read(path)
    assert [message.sequence for message in messages] == order
    with path.open("rb") as file:
        assert [message.sequence for _, _, message in make_reader(file).iter_messages()] == order
    copy_recording(path, tmp_path / "b.mcap")
    assert [message.sequence for message in read(tmp_path / "b.mcap")[0]] == order


def test_same_messages_same_bytes(tmp_path: Path) -> None:
    assert record(tmp_path / "a.mcap").read_bytes() == record(tmp_path / "b.mcap").read_bytes()


def test_flipped_bytes_never_give_a_changed_message_silently(tmp_path: Path) -> None:
    whole = record(tmp_path / "whole.mcap", count=5, step_ns=2_000_000_000)
    raw = bytearray(whole.read_bytes())
    everything = [(m[0], *m[2:], m.message.stamp_ns) for m in read(whole)[0]]  # type: ignore[attr-defined]
    damaged = tmp_path / "damaged.mcap"
    noticed = 0
    positions = np.random.default_rng(2).integers(8, len(raw) - 8, 150)
    for at in positions:
        raw[at] ^= 0x10
        damaged.write_bytes(raw)
        raw[at] ^= 0x10
        messages, _ = read(damaged)
        assert {(m[0], *m[2:], m.message.stamp_ns) for m in messages} <= set(everything)  # type: ignore[attr-defined]
        found = info(damaged)
        noticed += not (found.checksums_agree and found.complete)
    assert noticed == len(positions)


def test_damaged_chunk_is_left_out_and_the_rest_read(tmp_path: Path) -> None:
    path = record(tmp_path / "a.mcap", count=5, step_ns=2_000_000_000)
    with RecordingReader(path) as reader:
        offset = reader._walk.chunks[2].offset
    raw = bytearray(path.read_bytes())
    raw[offset + 200] ^= 1
    path.write_bytes(raw)
    messages, loss = read(path)
    assert 7 <= len(messages) < 10
    assert loss is not None
    assert f"1 damaged chunk, the first at byte {offset}" in loss
    assert info(path).checksums_agree is False


@pytest.mark.parametrize(("damaged", "reads_it"), [(2, False), (5, True), (8, False)])
def test_damage_outside_a_span_of_time_is_not_met(tmp_path: Path, damaged: int, reads_it: bool) -> None:
    """A state every 2 s, each in a chunk of its own after the second; of 8..14 s no chunk before or after is read."""
    path = tmp_path / "a.mcap"
    with RecordingWriter(path, {}) as writer:
        for index in range(10):
            sent_ns = 2_000_000_000 * index
            writer.write("vehicle/state", state(index), publisher="car", sequence=index, sent_ns=sent_ns)
    with RecordingReader(path) as reader:
        (offset,) = [at for at, start_ns, *_ in reader._walk.chunks if start_ns == 2_000_000_000 * damaged]
    raw = bytearray(path.read_bytes())
    raw[offset + 70] ^= 1
    path.write_bytes(raw)
    with RecordingReader(path) as reader:
        messages = list(reader.messages(start_ns=8_000_000_000, end_ns=14_000_000_000))
        assert [message.sequence for message in messages] == ([4, 6] if reads_it else [4, 5, 6])
        assert (reader.loss is not None) is reads_it


CHILD = """
import sys, time
from pathlib import Path
from msgs.recording.mcap import RecordingWriter
from msgs.values.vehicle import VehicleState
writer = RecordingWriter(Path(sys.argv[1]), {"run": "7"})
for index in range(10_000):
    writer.write("vehicle/state", VehicleState(stamp_ns=index), publisher="car", sequence=index, sent_ns=index * 10**8)
    time.sleep(0.002)
"""


@pytest.mark.parametrize("tail", ["a recording", "zeros"])
def test_a_file_that_goes_on_after_its_end_says_what_is_not_read(tmp_path: Path, tail: str) -> None:
    """As `cat a.mcap b.mcap` makes it: the first is read, the rest is named, and counts as loss."""
    path = record(tmp_path / "a.mcap")
    whole = path.read_bytes()
    path.write_bytes(whole + (whole if tail == "a recording" else bytes(4096)))
    with RecordingReader(path) as reader:
        found = reader.info()
    rest = f"another recording, {len(whole)} bytes" if tail == "a recording" else "what is no part of it, 4096 bytes"
    assert found.loss == f"ends at byte {len(whole)} and is read so far; {rest}, follows and is not"
    assert (found.complete, found.checksums_agree) == (False, True)


def test_killed_recorder_leaves_a_readable_file(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    child = subprocess.Popen([sys.executable, "-c", CHILD, str(path)])
    deadline = time.monotonic() + 120.0
    while not path.exists() or path.stat().st_size < 4000:
        assert time.monotonic() < deadline
        time.sleep(0.01)
    os.kill(child.pid, signal.SIGKILL)
    child.wait()
    messages, loss = read(path)
    assert len(messages) >= 10
    assert [message.sequence for message in messages] == list(range(len(messages)))
    assert loss is not None
    assert "cut off" in loss
    with RecordingReader(path) as reader:
        assert reader.metadata == {"run": "7"}


def test_existing_file_is_kept_unless_asked(tmp_path: Path) -> None:
    path = record(tmp_path / "a.mcap")
    with pytest.raises(FileExistsError, match=r"a\.mcap: exists already"):
        RecordingWriter(path, {})
    RecordingWriter(path, {}, overwrite=True).close()
    assert read(path) == ([], None)


def test_writer_refuses(tmp_path: Path) -> None:
    with RecordingWriter(tmp_path / "a.mcap", {}) as writer:
        with pytest.raises(ValueError, match="radar/beam carries RadarBeam, got VehicleState"):
            writer.write("radar/beam", state(0), publisher="a", sequence=0, sent_ns=0)
        with pytest.raises(ValueError, match="unknown topic"):
            writer.write("nothing", state(0), publisher="a", sequence=0, sent_ns=0)
        with pytest.raises(ValueError, match="sent_ns must be"):
            writer.write("vehicle/state", state(0), publisher="a", sequence=0, sent_ns=-1)
    writer.close()


@pytest.mark.parametrize(
    ("content", "rule"),
    [(b"", "is empty"), (b"\x89MCAP", "is not an MCAP recording"), (b"garbage " * 99, "is not an MCAP recording")],
)
def test_no_recording_at_all(tmp_path: Path, content: bytes, rule: str) -> None:
    path = tmp_path / "a.mcap"
    path.write_bytes(content)
    with pytest.raises(ValueError, match=rf"a\.mcap: {rule}") as refused:
        RecordingReader(path)
    assert "\n" not in str(refused.value)
    with pytest.raises(ValueError, match=r"a\.sigmf-meta: is a SigMF capture, must be an MCAP recording"):
        RecordingReader(path.rename(tmp_path / "a.sigmf-meta"))


def test_no_file_and_no_regular_file(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="no such file"):
        RecordingReader(tmp_path / "none.mcap")
    with pytest.raises(ValueError, match="is a directory"):
        RecordingReader(tmp_path)
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(ValueError, match="is not a regular file"):
        RecordingReader(tmp_path / "pipe")


def foreign(path: Path, *, chunked: bool) -> Path:
    """Another program's file: a topic unknown here, one of ours with unreadable bytes, one in another encoding."""
    with path.open("wb") as file:
        writer = Writer(file, use_chunking=chunked, compression=CompressionType.ZSTD)
        writer.start()
        schema = writer.register_schema("Imu", "jsonschema", b"{}")
        imu = writer.register_channel("imu", "json", schema)
        bad = writer.register_channel("vehicle/state", "msgpack", 0)
        other = writer.register_channel("log", "cdr", 0)
        for time_ns in range(3):
            writer.add_message(imu, time_ns, b"{}", time_ns, time_ns)
        writer.add_message(bad, 3, msgpack.packb({"stamp_ns": "late"}), 3)
        writer.add_message(bad, 4, msgpack.packb({"stamp_ns": 4}), 4)
        writer.add_message(other, 5, b"\x00", 5)
        writer.finish()
    return path


@pytest.mark.parametrize("chunked", [True, False])
def test_foreign_topics_are_listed_and_skipped(tmp_path: Path, chunked: bool) -> None:
    path = foreign(tmp_path / "a.mcap", chunked=chunked)
    with RecordingReader(path) as reader:
        (message,) = reader.messages()
        assert message.message == VehicleState(stamp_ns=4)
        assert reader.skipped == {"imu": 3, "vehicle/state": 1, "log": 1}
        assert reader.loss is None
    topics = {topic.topic: (topic.messages, topic.known, topic.type) for topic in info(path).topics}
    assert topics == {"imu": (3, False, "Imu"), "log": (1, True, ""), "vehicle/state": (2, True, "")}


@pytest.mark.parametrize("index_types", [IndexType.NONE, IndexType.CHUNK, IndexType.MESSAGE, IndexType.ALL])
@pytest.mark.parametrize("chunked", [True, False])
@pytest.mark.parametrize("repeats", [True, False], ids=["repeated", "declared once"])
def test_every_optional_part_of_the_summary_may_be_absent(
    tmp_path: Path, index_types: IndexType, chunked: bool, repeats: bool
) -> None:
    """What is recorded is found by its topic, whatever index the writer left out."""
    path, target = tmp_path / "a.mcap", tmp_path / "b.mcap"
    with path.open("wb") as file:
        options = dict.fromkeys(("repeat_channels", "repeat_schemas", "use_statistics", "use_summary_offsets"), repeats)
        writer = Writer(file, chunk_size=300, index_types=index_types, use_chunking=chunked, **options)
        writer.start()
        schema = writer.register_schema("VehicleState", "jsonschema", b"{}")
        channels = [writer.register_channel(topic, "msgpack", schema) for topic in ("vehicle/state", "other")]
        for index in range(10):
            writer.add_message(channels[index % 2], index, encode_inline(state(index)), index, index)
        writer.finish()
    with RecordingReader(path) as reader:
        assert reader.types == {"vehicle/state": "VehicleState", "other": "VehicleState"}
        assert [message.sequence for message in reader.messages(["vehicle/state"])] == [0, 2, 4, 6, 8]
        assert (reader.complete, reader.loss) == (True, None)
    assert copy_recording(path, target, topics=["other"]) == (5, None)


def test_copy_recovers_a_cut_file_and_keeps_unknown_topics(tmp_path: Path) -> None:
    whole = record(tmp_path / "whole.mcap", count=5, step_ns=2_000_000_000)
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(whole.read_bytes()[:-3000])
    count, loss = copy_recording(cut, tmp_path / "recovered.mcap")
    assert loss is not None
    recovered = info(tmp_path / "recovered.mcap")
    assert (recovered.complete, recovered.checksums_agree, recovered.metadata) == (True, True, METADATA)
    assert keys(read(tmp_path / "recovered.mcap")[0]) == keys(read(cut)[0])
    assert len(read(cut)[0]) == count
    copy_recording(foreign(tmp_path / "f.mcap", chunked=True), tmp_path / "g.mcap")
    assert [topic.topic for topic in info(tmp_path / "g.mcap").topics] == ["imu", "log", "vehicle/state"]


def test_copy_trims_and_compresses(tmp_path: Path) -> None:
    path = record(tmp_path / "a.mcap", count=50)
    count, loss = copy_recording(
        path, tmp_path / "b.mcap", topics=["vehicle/state"], start_ns=100, end_ns=300, compress=True
    )
    assert (count, loss) == (20, None)
    assert keys(read(tmp_path / "b.mcap")[0]) == [("vehicle/state", n, 10 * n + 5) for n in range(10, 30)]


def test_log_text_of_any_kind(tmp_path: Path) -> None:
    record_in = LogRecord(stamp_ns=5, node="a", level="info", text="Mauer \u00e4 \U0001f697 \0")
    with RecordingWriter(tmp_path / "a.mcap", {}) as writer:
        writer.write("log", record_in, publisher="a", sequence=(1 << 32) + 3, sent_ns=0)
    ((message,), _) = read(tmp_path / "a.mcap")
    assert message.message == record_in
    assert message.sequence == 3, "the file keeps 32 bits"


def test_a_long_recording_takes_little_memory(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Each beam is a chunk, 300 000 of them an hour: what is kept of one is its record of about 100 bytes."""
    monkeypatch.setattr(mcap_file, "CHUNK_BYTES", 0)
    with RecordingWriter(tmp_path / "a.mcap", METADATA) as writer:

        def write(first: int, count: int) -> None:
            for index in range(first, first + count):
                writer.write_encoded(Encoded("radar/beam", "radar", index, index, index, b"x"))

        write(0, 100)
        tracemalloc.start()
        write(100, 2000)
        grown_bytes, _ = tracemalloc.get_traced_memory()
        tracemalloc.stop()
    # a growing array holds up to an eighth more than it needs, and the counts themselves take a little
    assert grown_bytes < 2000 * 200
    with (tmp_path / "a.mcap").open("rb") as file:
        found = make_reader(file).get_summary()
    assert found is not None
    assert found.statistics is not None
    assert (found.statistics.chunk_count, len(found.chunk_indexes)) == (2100, 2100)
    assert (found.statistics.message_start_time, found.statistics.message_end_time) == (0, 2099)


def test_beams_are_not_read_for_other_topics(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """With an index; without one every chunk has to be looked into."""
    path = record(tmp_path / "a.mcap", count=100, step_ns=10**8)
    read_bytes: list[int] = []
    read_chunk = recording._read_chunk
    monkeypatch.setattr(
        recording, "_read_chunk", lambda file, chunk: read_bytes.append(chunk.offset) or read_chunk(file, chunk)
    )
    counts = []
    for content in (path.read_bytes(), path.read_bytes()[:-10]):
        path.write_bytes(content)
        read_bytes.clear()
        with RecordingReader(path) as reader:
            assert len(list(reader.messages(["vehicle/state"]))) == 100
        counts.append(len(read_bytes))
    assert 2 * counts[0] == counts[1]


def test_a_trimmed_recording_keeps_what_was_said_once(tmp_path: Path) -> None:
    """The set-up from before the cut, as if sent again at its start; not where its topic is left out."""
    path, cut = tmp_path / "a.mcap", tmp_path / "b.mcap"
    with RecordingWriter(path, METADATA) as writer:
        for index in range(2):
            setup = RadarSetup(stamp_ns=index)
            writer.write("radar/setup", setup, publisher="radar", sequence=index, sent_ns=index)
        for index in range(10):
            writer.write("vehicle/state", state(index), publisher="car", sequence=index, sent_ns=1000 + index)
    assert copy_recording(path, cut, start_ns=1005) == (6, None)
    messages, _ = read(cut)
    assert keys(messages)[:2] == [("radar/setup", 1, 1005), ("vehicle/state", 5, 1005)]
    assert copy_recording(path, cut, start_ns=1005, topics=["vehicle/state"], overwrite=True) == (5, None)
    assert copy_recording(path, cut, start_ns=0, overwrite=True) == (12, None)


def test_bytes_of_a_span_are_those_of_its_chunks(tmp_path: Path) -> None:
    """Three chunks at 0, 10 and 20 ns: each span holds those it touches, its end not included; all are in the file."""
    path = tmp_path / "a.mcap"
    with RecordingWriter(path, METADATA) as writer:
        for index in range(3):
            writer.write("vehicle/state", state(index), publisher="car", sequence=index, sent_ns=10 * index)
            writer.flush()
        before, growth = writer.size_bytes, writer.growth_bytes()
    # no more than was said, and that is no more than the tail that every file may have
    assert before < path.stat().st_size <= before + growth < before + (1 << 16) + 8192
    with RecordingReader(path) as reader:
        assert reader.span_ns == (0, 20)
        single = [reader.stored_bytes(10 * index, 10 * index + 1) for index in range(3)]
        assert reader.stored_bytes() == sum(single) < path.stat().st_size
        assert min(single) > 50
        assert (reader.stored_bytes(0, 10), reader.stored_bytes(1, 11)) == (single[0], single[1])
        assert (reader.stored_bytes(20), reader.stored_bytes(21)) == (single[2], 0)
