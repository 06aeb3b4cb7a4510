"""What comes from others is bounded: sizes, what unpacks, names of files, what reaches a terminal."""

from __future__ import annotations

import gzip
import io
import json
import stat
import struct
import tracemalloc
import zlib
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import can
import lz4.frame
import numpy as np
import pytest
import zstandard
from mcap.records import Chunk
from mcap.writer import MCAP0_MAGIC, CompressionType, Writer

from contrib.annotate.clouds import MAX_CLOUD_BYTES, MAX_POINTS, read_cloud
from contrib.annotate.manifest import load_manifest
from contrib.boards import mmwave_studio
from contrib.boards.config_file import read_config
from contrib.imports import detection_tables
from mirrorwave.console import error_line, print_line, print_table
from mirrorwave.diagnose.topic_echo import save_arrays
from models.perception.cards import read_card, read_learned
from models.perception.onnx_session import ArrayCard
from msgs.bus.codec import encode_inline
from msgs.files import array_files, yaml_loader
from msgs.files.array_files import load_arrays
from msgs.files.shipped import CHECKOUT
from msgs.files.unpacking import UnpackedFile
from msgs.recording import mcap as recording
from msgs.recording.mcap import RecordingReader
from msgs.recording.sigmf import SigmfCapture
from msgs.values.radar import RadarBeam
from msgs.values.vehicle import VehicleState
from nodes.can.bus import MAX_DBC_BYTES, load_dbc
from nodes.can.log_file import MAX_LINE, MAX_OBJECT_BYTES, read_log
from sim_player.bodies.meshes import load_mesh
from sim_player.scene.description import MAX_BYTES, load_scene, scene_from_yaml

MIB = 1 << 20


def of_size(path: Path, size: int) -> Path:
    """A file that says it is so large and takes no room."""
    with path.open("wb") as file:
        file.truncate(size)
    return path


@pytest.mark.parametrize(
    ("read", "size"),
    [
        (load_scene, MAX_BYTES + 1),
        (load_manifest, MIB + 1),
        (lambda path: read_config(path, None), MIB + 1),
        (load_dbc, MAX_DBC_BYTES + 1),
        (lambda path: read_cloud(path.rename(path.with_suffix(".ply"))), MAX_CLOUD_BYTES + 1),
    ],
    ids=["scene", "manifest", "dca1000", "dbc", "cloud"],
)
def test_a_file_that_is_too_large_is_refused_before_it_is_parsed(
    tmp_path: Path, read: Callable[[Path], object], size: int
) -> None:
    path = of_size(tmp_path / "large.cfg", size)
    with pytest.raises(ValueError, match=r"large\..*at most \d+ bytes"):
        read(path)


def test_a_learned_file_may_be_as_large_as_the_limit(tmp_path: Path) -> None:
    path = of_size(tmp_path / "large.onnx", 8)
    assert len(read_learned(path, 8)) == 8
    with pytest.raises(ValueError, match=r"large\.onnx must be a file of at most 7 bytes, got 8 bytes"):
        read_learned(path, 7)


@pytest.mark.parametrize("suffix", [".log", ".asc", ".csv", ".trc"])
@pytest.mark.parametrize("is_packed", [False, True], ids=["plain", "packed"])
def test_a_line_without_end_in_a_can_log(tmp_path: Path, suffix: str, is_packed: bool) -> None:
    """64 MiB of one line, 64 KiB of them packed."""
    path = tmp_path / (f"endless{suffix}.gz" if is_packed else f"endless{suffix}")
    with gzip.open(path, "wb", 1) if is_packed else path.open("wb") as file:
        for _ in range(64):
            file.write(b"1" * MIB)
    tracemalloc.start()
    try:
        with pytest.raises(ValueError, match=rf"endless.* a line must be of at most {MAX_LINE} characters"):
            list(read_log(path))
        assert tracemalloc.get_traced_memory()[1] < MIB
    finally:
        tracemalloc.stop()


def blf(path: Path, *containers: bytes, claimed: int | None = None) -> Path:
    """A BLF of packed containers; the object of each says to be `claimed` bytes long where that is given."""
    whole = path.with_name("good.blf")
    can.BLFWriter(whole).stop()
    content = whole.read_bytes()[:144]
    for container in containers:
        packed = struct.pack("<H6xL4x", 2, len(container)) + zlib.compress(container)
        size = 16 + len(packed)
        content += struct.pack("<4sHHLL", b"LOBJ", 16, 1, claimed or size, 10) + packed + b"\0" * (size % 4)
    path.write_bytes(content)
    return path


def test_an_object_of_a_blf_may_not_promise_gigabytes(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=rf"long\.blf.* an object must be of 0 to {MAX_OBJECT_BYTES} bytes, got 429"):
        list(read_log(blf(tmp_path / "long.blf", b"", claimed=2**32 - 1)))


@pytest.mark.parametrize("size", [0, 15])
def test_an_object_of_no_size_does_not_hold_up_a_blf(tmp_path: Path, size: int) -> None:
    """200 bytes gave frames without end."""
    path = blf(tmp_path / "none.blf", struct.pack("<4sHHLL", b"LOBJ", 32, 1, size, 1) + bytes(64))
    with pytest.raises(ValueError, match=r"none\.blf.* an object must be of at least 16 bytes"):
        list(read_log(path))


def test_an_object_without_end_in_containers_of_a_blf(tmp_path: Path) -> None:
    """Each container holds some more of an object that says to be 4 GiB long."""
    head = struct.pack("<4sHHLL", b"LOBJ", 32, 1, 2**32 - 1, 1)
    path = blf(tmp_path / "endless.blf", head, *[bytes(MAX_OBJECT_BYTES // 2)] * 3)
    with pytest.raises(ValueError, match=rf"endless\.blf.* an object must be of at most {MAX_OBJECT_BYTES} bytes"):
        list(read_log(path))


@pytest.mark.parametrize(
    ("suffix", "content"),
    [
        (".ply", b"ply\nformat ascii 1.0\nelement vertex 4000000000\nproperty float x\nend_header\n1\n"),
        (".xyz", b"\n" * (MAX_POINTS + 1)),
    ],
)
def test_a_cloud_may_not_have_any_number_of_points(tmp_path: Path, suffix: str, content: bytes) -> None:
    path = tmp_path / f"crowd{suffix}"
    path.write_bytes(content)
    with pytest.raises(ValueError, match=rf"crowd.*points must be at most {MAX_POINTS}, got \d+"):
        read_cloud(path)


@pytest.mark.parametrize("suffix", [".xyz", ".pcd"])
def test_a_number_without_end_takes_the_time_of_its_digits(tmp_path: Path, suffix: str) -> None:
    """Each digit was tried as the last: an hour."""
    head = "VERSION .7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nWIDTH 1\nHEIGHT 1\nPOINTS 1\nDATA ascii\n1 2 3\n"
    path = tmp_path / f"digits{suffix}"
    path.write_text((head if suffix == ".pcd" else "") + "1" * 500_000 + "x\n")
    with pytest.raises(ValueError, match=r"digits.*must be numbers with blanks between them"):
        read_cloud(path)
    assert not detection_tables._NUMBER.fullmatch("1" * 60_000 + "x")
    for odd in ("--[[\n", 'x = "' + "\\" + '"' * 3):
        assert len(mmwave_studio._TEXT_OR_COMMENT.sub("", odd * 100_000)) <= 5 * 100_000


def test_a_scene_may_not_repeat_itself_by_reference() -> None:
    """Four lines would give 10^5 x 10^5 numbers."""
    with pytest.raises(ValueError, match="aliases are refused"):
        scene_from_yaml("name: x\nsurfaces: [&a {role: relay}, *a]\n")


@pytest.mark.parametrize(
    ("levels", "rule"), [(40, "nested deeper than 32 levels"), (100_000, "exceeded maximum nesting depth")]
)
def test_a_scene_nested_without_end_is_refused(levels: int, rule: str) -> None:
    """The reader of YAML has a limit of its own beyond ours."""
    with pytest.raises(ValueError, match=rule):
        scene_from_yaml("[" * levels + "]" * levels)


@pytest.mark.parametrize("text", ["[" + "1," * 2000 + "1]", "\n" + "- 1\n" * 2000], ids=["flow", "block"])
def test_a_scene_of_too_many_values_is_refused(text: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """As far as it is allowed to be read: a megabyte of these takes a quarter of a minute."""
    monkeypatch.setattr(yaml_loader, "MAX_NODES", 1000)
    with pytest.raises(ValueError, match="more than 1000 keys and values"):
        scene_from_yaml(f"surfaces: {text}")


@pytest.mark.parametrize(
    ("name", "content", "rule"),
    [
        ("zeros.gltf", {"accessors": [{"componentType": 5126, "count": 1 << 28, "type": "VEC3"}]}, "without data"),
        ("copies.gltf", {"nodes": [{"mesh": 0}] * 100_000}, "nodes: at most 1000 are read, got 100000"),
        ("parts.gltf", {"meshes": [{"primitives": [{}] * 100_000}]}, "primitives: at most 1000 are read, got 100000"),
        ("parts.obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\n" + "usemtl a\nf 1 2 3\n" * 2000, "1000 changes of material"),
    ],
    ids=["zeros", "copies", "primitives", "parts"],
)
def test_a_mesh_may_not_promise_more_than_it_holds(tmp_path: Path, name: str, content: Any, rule: str) -> None:
    """Less than 3 MB each: they would take gigabytes or minutes."""
    path = tmp_path / name
    path.write_text(content if isinstance(content, str) else json.dumps({"asset": {"version": "2.0"}, **content}))
    with pytest.raises(ValueError, match=f"{name}: not a readable .*{rule}"):
        load_mesh(path)


def test_a_mesh_takes_its_buffers_from_its_own_folder_only(tmp_path: Path) -> None:
    import trimesh

    parts = trimesh.Scene(trimesh.creation.box((2.0, 2.0, 2.0))).export(file_type="gltf")
    buffers = [name for name in parts if name.endswith(".bin")]
    inner = tmp_path / "inner"
    inner.mkdir()
    for name, data in parts.items():
        (inner / name).write_bytes(data)
    assert len(load_mesh(inner / "model.gltf").faces) == 12
    for name in buffers:
        (inner / name).rename(tmp_path / name)
    (inner / "model.gltf").write_bytes(parts["model.gltf"].replace(b'"gltf_buffer', b'"../gltf_buffer'))
    with pytest.raises(ValueError, match="escapes"):
        load_mesh(inner / "model.gltf")


# recordings


def chunk(compression: str, data: bytes, size: int) -> Chunk:
    return Chunk(
        compression=compression,
        data=data,
        message_start_time=0,
        message_end_time=0,
        uncompressed_crc=0,
        uncompressed_size=size,
    )


PACKERS = {"zstd": zstandard.compress, "lz4": lz4.frame.compress, "": bytes}


@pytest.mark.parametrize("compression", PACKERS)
@pytest.mark.parametrize("says", [1000, 16 * MIB + 1])
def test_a_chunk_of_another_size_than_its_head_promises_is_refused(compression: str, says: int) -> None:
    """16 MiB of zeros in some kilobytes; no more than the head promises is ever unpacked."""
    packed = PACKERS[compression](bytes(16 * MIB))
    tracemalloc.start()
    try:
        with pytest.raises(ValueError, match=f"does not unpack to the {says} bytes"):
            recording._unpacked(chunk(compression, packed, says))
        assert says > MIB or tracemalloc.get_traced_memory()[1] < MIB
    finally:
        tracemalloc.stop()


def test_a_chunk_of_a_million_frames_takes_the_time_of_its_bytes() -> None:
    """Each frame took that of all that follow: an hour."""
    packed = lz4.frame.compress(b"") * 200_000
    assert recording._unpacked(chunk("lz4", packed, 0)) == b""


@pytest.mark.parametrize("compression", PACKERS)
def test_a_chunk_may_be_of_several_frames_and_none_of_them_cut(compression: str) -> None:
    halves = np.random.default_rng(0).bytes(1000), bytes(MIB)
    packed = b"".join(map(PACKERS[compression], halves))
    assert recording._unpacked(chunk(compression, packed, 1000 + MIB)) == b"".join(halves)
    # of what unpacks to the limit neither another frame nor the end of the last may be missed
    eight = PACKERS[compression](bytes(8))
    for data, size in ((packed[:-5], 1000 + MIB), (eight + PACKERS[compression](b"x"), 8), (eight[:-4], 8)):
        with pytest.raises(ValueError, match=r"does not unpack|ends within"):
            recording._unpacked(chunk(compression, data, size))


def test_what_comes_in_small_pieces_spends_no_more_than_it_is() -> None:
    pieces = iter((b"ab", b"c"))
    file = UnpackedFile(SimpleNamespace(read1=lambda size: next(pieces, b"")), io.BytesIO())  # type: ignore[arg-type]
    assert [file.readinto(bytearray(8 * MIB)) for _ in range(3)] == [2, 1, 0]


def _written(path: Path, compression: str, *chunks: bytes) -> Path:
    """A complete recording without a summary, of chunks as they are."""
    size = struct.pack
    parts = []
    for data in chunks:
        packed = PACKERS[compression](data)
        head = size("<QQQII", 0, 0, len(data), 0, len(compression)) + compression.encode() + size("<Q", len(packed))
        parts.append(size("<BQ", 6, len(head) + len(packed)) + head + packed)
    end = size("<BQI", 15, 4, 0) + size("<BQQQI", 2, 20, 0, 0, 0)
    path.write_bytes(MCAP0_MAGIC + b"".join(parts) + end + MCAP0_MAGIC)
    return path


def test_a_recording_may_not_unpack_to_a_thousand_times_its_size(tmp_path: Path) -> None:
    """Three chunks of 200 MiB of zeros, 19 KiB in all; each would do."""
    with pytest.raises(ValueError, match=r"a\.mcap: chunks unpack to 629145600 bytes, at most 536870912 are read"):
        RecordingReader(_written(tmp_path / "a.mcap", "zstd", *[bytes(200 * MIB)] * 3))
    with RecordingReader(_written(tmp_path / "b.mcap", "zstd", bytes(300 * MIB))) as reader:
        assert list(reader.messages()) == []
        assert f"chunk of {300 * MIB} bytes exceeds {256 * MIB}" in str(reader.loss)


def test_a_chunk_of_a_million_empty_messages_is_refused(tmp_path: Path) -> None:
    empty = struct.pack("<BQHIQQ", 5, 22, 1, 0, 0, 0)
    with RecordingReader(_written(tmp_path / "a.mcap", "zstd", empty * 1_000_000)) as reader:
        assert list(reader.messages()) == []
        assert "too many records for its size" in str(reader.loss)


def _of_a_topic(path: Path, topic: str, data: bytes, copies: int = 0) -> Path:
    """A recording of one message, whose chunk an index names `copies` times behind a record that is cut off."""
    lead = bytes([3]) + struct.pack("<QH", 14 + len("x"), 1) + struct.pack("<I", 1) + b"x" + bytes(8)
    lead += struct.pack("<BQHHI", 4, 16 + len(topic) + 7, 1, 1, len(topic)) + topic.encode()
    lead += struct.pack("<I", 7) + b"msgpack" + bytes(4) + struct.pack("<BQHIQQ", 5, 22 + len(data), 1, 0, 1, 1)
    if not copies:
        return _written(path, "zstd", lead + data)
    content = lead + data
    chunk_ = struct.pack("<QQQIIQ", 0, 1, len(content), 0, 0, len(content)) + content
    start = 8 + 9 + len(chunk_) + 20
    entry = struct.pack("<BQQQQQIQIQQ", 8, 64, 0, 1, 8, 9 + len(chunk_), 0, 0, 0, len(content), len(content))
    index = entry * copies + struct.pack("<BQQQ", 2, 20, start, 0)
    path.write_bytes(
        MCAP0_MAGIC + struct.pack("<BQ", 6, len(chunk_)) + chunk_ + b"\xff" * 20 + index
        + struct.pack("<I", zlib.crc32(index)) + MCAP0_MAGIC
    )  # fmt: skip
    return path


def test_a_message_may_not_unpack_to_more_values_than_one_on_the_bus(tmp_path: Path) -> None:
    """16 MiB of empty mappings took 1.2 GB; a beam of 4 MiB is read."""
    bomb = b"\x81\xa5walls\xdd" + struct.pack(">I", 16 * MIB) + b"\x80" * (16 * MIB)
    tracemalloc.start()
    try:
        with RecordingReader(_of_a_topic(tmp_path / "a.mcap", "perception/hidden_objects", bomb)) as reader:
            assert list(reader.messages()) == []
            assert reader.skipped == {"perception/hidden_objects": 1}
        assert tracemalloc.get_traced_memory()[1] < 100 * MIB
    finally:
        tracemalloc.stop()
    samples = np.zeros((1024, 1024, 2), np.int16)
    beam = RadarBeam(
        stamp_ns=0, scan_id=0, beam_index=0, beam_count=1, azimuth_rad=0.0, samples=samples, full_scale_dbm=0.0
    )
    with RecordingReader(_of_a_topic(tmp_path / "b.mcap", "radar/beam", encode_inline(beam))) as reader:
        assert [each.message.samples.shape for each in reader.messages()] == [samples.shape]


def test_an_index_may_not_name_a_chunk_again_and_again(tmp_path: Path) -> None:
    path = _of_a_topic(tmp_path / "a.mcap", "other/topic", bytes(10), copies=1000)
    with RecordingReader(path) as reader:
        assert "all chunks found by the index" in str(reader.loss)
        assert len(list(reader.raw_messages(None, None))) == 1


@pytest.mark.parametrize("compression", list(CompressionType))
def test_honest_chunks_of_every_compression_are_read(tmp_path: Path, compression: CompressionType) -> None:
    path = tmp_path / "foreign.mcap"
    with path.open("wb") as file:
        writer = Writer(file, compression=compression)
        writer.start()
        channel = writer.register_channel("other/topic", "json", writer.register_schema("x", "jsonschema", b"{}"))
        for count in range(3):
            writer.add_message(channel, count, bytes(100), count)
        writer.finish()
    with RecordingReader(path) as reader:
        assert list(reader.messages()) == []
        assert (reader.loss, reader.skipped) == (None, {"other/topic": 3})


# archives


def test_a_card_nested_without_end_is_refused_by_name(tmp_path: Path) -> None:
    (tmp_path / "net.json").write_text('{"name": ' + "[" * 100_000)
    with pytest.raises(ValueError, match=r"net\.json: maximum recursion depth exceeded"):
        read_card(tmp_path / "net.json", ArrayCard)


def test_an_archive_that_unpacks_to_too_much_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    packed = io.BytesIO()
    np.savez_compressed(packed, zeros=np.zeros(MIB, np.uint8))
    packed.seek(0)
    assert load_arrays(packed)["zeros"].nbytes == MIB
    packed.seek(0)
    monkeypatch.setattr(array_files, "FREE_UNPACKED_BYTES", MIB)
    with pytest.raises(ValueError, match="unpacks to"):
        load_arrays(packed)


@pytest.mark.parametrize("name", ["captures", "annotations"])
def test_metadata_may_not_list_more_than_the_data_hold(tmp_path: Path, name: str) -> None:
    """Half a million of them took twenty seconds to be looked at."""
    (tmp_path / "a.sigmf-data").write_bytes(bytes(2048))
    segments: dict[str, list[Any]] = {"captures": [], "annotations": []}
    segments[name] = [{"core:sample_start": 0}] * 10_003
    (tmp_path / "a.sigmf-meta").write_text(json.dumps({"global": {}, **segments}))
    rule = f"{name} must be at most 10002 for 2048 bytes of data, got 10003"
    with pytest.raises(ValueError, match=rule):
        SigmfCapture.open(tmp_path / "a.sigmf-meta")


def test_a_pickle_is_never_loaded() -> None:
    packed = io.BytesIO()
    np.savez(packed, evil=np.array([zlib.compress], dtype=object))
    packed.seek(0)
    with pytest.raises(ValueError, match="allow_pickle=False"):
        load_arrays(packed)["evil"]


# names and terminals


def test_a_publisher_cannot_name_a_file_outside_the_folder(tmp_path: Path) -> None:
    from msgs.values.perception import Peaks

    fields = {name: np.zeros(0, np.float32) for name in Peaks.__struct_fields__ if name != "stamp_ns"}
    message = type("Message", (), {"__struct_fields__": ("body",), "body": {"../../x": np.zeros(2), **fields}})()
    inner = tmp_path / "inner"
    inner.mkdir()
    written = save_arrays(message, inner, "log-../../evil-0")  # type: ignore[arg-type]
    assert {path.parent for path in written} == {inner}
    assert list(tmp_path.iterdir()) == [inner]
    assert save_arrays(VehicleState(stamp_ns=0), inner, "x") == []


def test_no_text_steers_the_terminal(capsys: pytest.CaptureFixture[str]) -> None:
    """ESC ] 0 ; sets a title, 0x9B is another way to begin a command; tabs and umlauts are no harm."""
    evil = "a\x1b]0;title\x07\x9b2J\r\tü"
    print_line(evil)
    print_table(("X",), [(evil,)])
    shown = capsys.readouterr().out + error_line(ValueError(evil))
    assert not set("\x1b\x07\x9b\r") & set(shown)
    assert "ü" in shown


# what is promised


def _limits() -> dict[str, str]:
    """The table of limits in SECURITY.md."""
    text = (CHECKOUT / "SECURITY.md").read_text(encoding="utf-8")
    table = text.split("| input | limit |")[1].split("\n\n")[0]
    rows = (line.strip("| ").split(" | ") for line in table.splitlines()[2:])
    return {row[0].strip("`"): row[1] for row in rows}


def _size(count: int) -> str:
    for shift, unit in ((30, "GiB"), (20, "MiB"), (10, "KiB")):
        if count >= 1 << shift:
            return f"{round(count / (1 << shift))} {unit}"
    return str(count)


def test_the_limits_of_the_page_are_those_of_the_code() -> None:
    from contrib.annotate import clouds as annotate_clouds
    from contrib.boards import config_file
    from contrib.imports import detection_sets, recorded_sensors
    from contrib.ros2 import ros2_link, ros2_topics
    from contrib.two_machines import curve as curve_link
    from contrib.two_machines import exporter as curve_exporter
    from contrib.two_machines import keys as curve_keys
    from contrib.two_machines import peer_messages
    from lab.transients import confocal, scan
    from mirrorwave.diagnose import foreign_topic
    from models.perception import cards, onnx_session
    from msgs.bus import codec
    from msgs.bus import sequencing as tally
    from msgs.bus.topics import TOPICS
    from msgs.files import unpacking
    from msgs.recording import sigmf as sigmf_capture
    from msgs.values import arrays, camera
    from nodes.can import log_file as can_log_file
    from nodes.process import launch_file, logs
    from nodes.viewer import connection_limiter as limiter
    from nodes.viewer import series, server
    from nodes.viewer.server import MAX_CLIENTS
    from sim_player.bodies import meshes
    from sim_player.scene import description as scene

    promised = _limits()
    expected = {name: _size(topic.max_bytes) for name, topic in TOPICS.items()} | {
        "topic of another program (`topic echo`)": _size(foreign_topic._MAX_BYTES),
        "header of a message": _size(codec.MAX_HEADER_BYTES),
        "dimensions of an array": str(arrays.MAX_NDIM),
        "publishers of a topic": str(tally.MAX_PUBLISHERS),
        "message from a peer to the exporting end of a link": _size(curve_link.MAX_UPWARD_BYTES),
        "publishers behind one peer": str(peer_messages.MAX_ORIGINS),
        "publishers whose last message of a latched topic is kept": str(tally.MAX_LATCHED),
        "newest-only messages that wait for a peer of a link": (
            f"{tally.MAX_LATCHED} publishers a topic, {curve_exporter._MAX_JOINED} peers"
        ),
        "connections to a link that have not shown a key": (
            f"{curve_exporter._MAX_STRANGERS}, for {curve_link._HANDSHAKE_MS / 1000:g} s"
        ),
        "pages at the viewer": str(MAX_CLIENTS),
        "connections to the viewer that are no page": f"{limiter.MAX_PENDING}, for {limiter.PENDING_S:g} s",
        "message of a page": f"{_size(server.MAX_CLIENT_MESSAGE_BYTES)}, {server.MAX_CLIENT_MESSAGES_PER_S} a second",
        "message from ROS 2": f"{_size(ros2_link.MAX_INPUT_BYTES)}, {ros2_topics.INPUT_DEPTH} waiting",
        "numbers that a page can plot; samples of each": f"{series.MAX_SERIES}; {series.MAX_SAMPLES}",
        "launch, parameter, profile, CAN or detection mapping or annotation file": (
            f"{_size(launch_file.MAX_BYTES)}, {yaml_loader.MAX_DEPTH} levels, {yaml_loader.MAX_NODES:,} values"
        ),
        "scene": f"{_size(scene.MAX_BYTES)}, {yaml_loader.MAX_DEPTH} levels, {yaml_loader.MAX_NODES:,} values",
        "mesh": f"{_size(meshes.MAX_BYTES)}, {meshes.MAX_FACES:,} faces, {meshes.MAX_PARTS:,} parts",
        "DBC": _size(MAX_DBC_BYTES),
        "line of a table of detections; its columns": (
            f"{_size(detection_tables.MAX_LINE)}; {detection_tables.MAX_COLUMNS}"
        ),
        "line of a CAN log; object of a BLF, compressed; unpacked": (
            f"{_size(can_log_file.MAX_LINE)}; {_size(can_log_file.MAX_OBJECT_BYTES)}; "
            f"{_size(can_log_file.MAX_CONTAINER_BYTES)}"
        ),
        "compressed log, unpacked": (
            f"{_size(unpacking.Budget.FREE_BYTES)} plus {unpacking.Budget.RATIO} times what was read"
        ),
        "point cloud": f"{_size(annotate_clouds.MAX_CLOUD_BYTES)}, {annotate_clouds.MAX_POINTS:,} points",
        "image file; its sides and pixels": (
            f"{_size(recorded_sensors.MAX_IMAGE_FILE_BYTES)}; {camera.MAX_SIDE_PX}, {camera.MAX_PIXELS:,}"
        ),
        "configuration of a DCA1000 capture": _size(config_file.MAX_CONFIG_BYTES),
        "confocal transients, compressed; counts": f"{_size(confocal.MAX_FILE_BYTES)}; {scan.MAX_COUNTS:,}",
        "metadata of a SigMF capture; its captures and annotations": (
            f"{_size(sigmf_capture._MAX_META_BYTES)}; {sigmf_capture._FREE_SEGMENTS:,} plus one for each "
            f"{_size(sigmf_capture._SEGMENT_BYTES).removeprefix('1 ')} of data, whose sizes must be exact"
        ),
        "record of a recording": _size(recording._MAX_RECORD_BYTES),
        "compressed chunk of a recording, unpacked; all its chunks": (
            f"{_size(recording._MAX_UNPACKED_CHUNK_BYTES)}; {_size(recording._FREE_UNPACKED_BYTES)}, "
            f"or {recording._MAX_UNPACKED_RATIO} times the file"
        ),
        "message of a recording; beside its arrays": (
            f"{_size(codec.MAX_INLINE_BYTES)}; {_size(codec.MAX_HEADER_BYTES)}"
        ),
        "card of a network": _size(cards.MAX_CARD_BYTES),
        "network; its memory to load and run once": (
            f"{_size(onnx_session.MAX_MODEL_BYTES)}; {_size(onnx_session.MAX_RUN_BYTES)} beside eight times its file, "
            f"{onnx_session.MAX_RUN_S:g} s of processor time"
        ),
        "table of a drive (HDF5)": (
            f"{_size(detection_sets._MAX_DRIVE_BYTES)}; at most {_size(unpacking.Budget.FREE_BYTES)} plus "
            f"{unpacking.Budget.RATIO} times the file"
        ),
        "archive of arrays, unpacked": (
            f"{_size(array_files.MAX_UNPACKED_BYTES)}; beyond {_size(array_files.FREE_UNPACKED_BYTES)} "
            f"at most {array_files.MAX_UNPACKED_RATIO} times the file"
        ),
        "key file": _size(curve_keys.MAX_BYTES),
        "a node's log file": f"{_size(logs._FILE_BYTES)}, four of them",
    }
    assert promised == expected
    assert logs._FILES_KEPT == 3


def test_the_folder_of_a_run_is_for_its_user_alone(tmp_path: Path) -> None:
    from nodes.process.launch_file import LaunchFile, NodeEntry
    from nodes.process.supervisor import _new_run_folder

    folder = _new_run_folder(tmp_path / "runs", LaunchFile(name="x", nodes={"a": NodeEntry(module="nodes.player")}))
    assert stat.S_IMODE(folder.stat().st_mode) == 0o700
