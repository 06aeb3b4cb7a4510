"""Every reader of bytes from outside, what it may answer, and where its inputs come from.

A target passes if its reader gives a value or raises what it documents, in one line; leaves its input as it was; and,
where a writer exists, reads back what was written of the value. Modules are imported when a target runs, so that
coverage sees their branches.
"""

from __future__ import annotations

import contextlib
import hashlib
import itertools
import json
import shutil
import struct
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from fuzz.mutations import Parts


class Box:
    """A folder for the files of one input; `check` tells that none that was put there has changed."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._put: dict[Path, bytes] = {}

    def put(self, name: str, content: bytes) -> Path:
        """A file with this content."""
        path = self.folder / name
        path.parent.mkdir(exist_ok=True)
        path.write_bytes(content)
        self._put[path] = content
        return path

    def new(self, name: str) -> Path:
        """A path at which there is nothing."""
        path = self.folder / name
        if path.is_dir():
            shutil.rmtree(path)
        path.unlink(missing_ok=True)
        return path

    def check(self) -> None:
        """Raise `AssertionError` where a reader changed its input."""
        for path, content in self._put.items():
            assert path.read_bytes() == content, f"{path.name} was changed by its reader"


@dataclass(frozen=True)
class Target:
    """A reader: how it is run on the parts of an input, what kind each part is, what it may raise."""

    run: Callable[[Parts, Box], None]
    kinds: tuple[str, ...]
    refusals: tuple[type[Exception], ...] = (ValueError, OSError)
    #: Packages whose branches count, beside the project's own.
    modules: tuple[str, ...] = ()
    #: Longest input worth trying.
    max_bytes: int = 1 << 14


def execute(target: Target, parts: Parts, folder: Path) -> bool:
    """Run a target on one input; True where a value came, False for a documented refusal, else what was raised."""
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    box = Box(folder)
    try:
        target.run(parts, box)
    except target.refusals as error:
        _require_plain_words(error)
        box.check()
        return False
    box.check()
    return True


def _require_plain_words(error: Exception) -> None:
    from mirrorwave.console import error_line

    line = error_line(error)
    assert line.strip(), f"{type(error).__name__} says nothing"
    assert "Traceback" not in line, line


def part(parts: Parts, at: int) -> bytes:
    """One part, empty where there is none."""
    return parts[at] if at < len(parts) else b""


def number(parts: Parts, at: int, below: int) -> int:
    """The first byte of a part as a choice."""
    return (part(parts, at) or b"\0")[0] % below


def text(parts: Parts, at: int) -> str:
    """A part as text, whatever its bytes."""
    return part(parts, at).decode("utf-8", "replace")


def _wire(parts: Parts, box: Box) -> None:
    from msgs.bus import codec

    found = codec.decode(parts)
    frames = [bytes(frame) for frame in codec.encode(found.envelope, found.message)]
    again = codec.decode(frames)
    assert [bytes(frame) for frame in codec.encode(again.envelope, again.message)] == frames
    json.dumps(codec.to_builtins(found.message), allow_nan=False)


def _inline(parts: Parts, box: Box) -> None:
    from msgs.bus import codec
    from msgs.bus.topics import TOPICS

    kind = list(TOPICS.values())[number(parts, 0, len(TOPICS))].type
    message = codec.decode_inline(kind, part(parts, 1))
    data = codec.encode_inline(message)
    assert codec.encode_inline(codec.decode_inline(kind, data)) == data


def _foreign(parts: Parts, box: Box) -> None:
    from mirrorwave.diagnose.foreign_topic import decode_foreign
    from mirrorwave.diagnose.topic_echo import CsvLines, text_lines
    from msgs.bus.codec import to_builtins

    found = decode_foreign("a", [memoryview(one) for one in parts])
    body = to_builtins(found.message)
    list(text_lines(body))
    list(CsvLines().lines({}, body))


def _recording(parts: Parts, box: Box) -> None:
    from mirrorwave.commands.captures.bag_info import origin_lines
    from msgs.recording.mcap import RecordingReader

    with RecordingReader(box.put("a.mcap", part(parts, 0))) as reader:
        listed = sum(1 for _ in reader.messages()) + sum(reader.skipped.values())
        found = reader.info()
        assert reader.types is not None
        assert reader.span_ns is not None
    # `info` counts in file order, `messages` in order of time: both see every message there is
    assert listed == sum(one.messages for one in found.topics), (listed, found.topics)
    origin_lines(found.metadata)
    json.dumps(_builtins(found), allow_nan=False)


def _builtins(value: Any) -> Any:
    import msgspec

    return msgspec.to_builtins(value)


def _recover(parts: Parts, box: Box) -> None:
    from msgs.recording.mcap import RecordingReader, info
    from msgs.recording.mcap_copy import copy_recording

    source, out = box.put("a.mcap", part(parts, 0)), box.new("out.mcap")
    choice = number(parts, 1, 8)
    start_ns = 50_000_000 if choice & 1 else None
    topics = ("vehicle/state", "radar/setup") if choice & 2 else None
    count, _ = copy_recording(source, out, topics=topics, start_ns=start_ns, compress=bool(choice & 4))
    found = info(out)
    assert (found.complete, found.checksums_agree, found.loss) == (True, True, None), found
    assert sum(one.messages for one in found.topics) == count
    if topics is None and start_ns is None:
        with RecordingReader(source) as before, RecordingReader(out) as after:
            # in order of time; heads of chunks that lie about their span leave the source in disorder
            assert _told(before) == _told(after)


def _told(reader: Any) -> list[tuple[str, int, bytes]]:
    return sorted((channel.topic, raw.log_time, raw.data) for channel, raw in reader.raw_messages(None, None))


def _replay(parts: Parts, box: Box) -> None:
    from mirrorwave.replay.schedule import first_sensed_ns, whole_scans
    from msgs.bus.topics import TOPICS
    from msgs.recording.mcap import RecordingReader
    from nodes.player import capture_events, moved

    path = box.put("a.mcap", part(parts, 0))
    for event in capture_events(path):
        assert event.outgoing.topic in TOPICS
    with RecordingReader(path) as reader:
        topics = tuple(topic for topic in reader.types if topic in TOPICS)
        first_ns = first_sensed_ns(reader, topics, {})
        latched = [topic for topic in topics if TOPICS[topic].latched]
        list(reader.messages(latched, 0, first_ns))
        is_cut, end_ns = bool(number(parts, 1, 2)), None if number(parts, 1, 4) < 2 else first_ns + 400_000_000
        for recorded in whole_scans(reader.messages(topics, first_ns), is_cut, end_ns):
            moved(recorded.message, 1_000_000_000)


def _view(parts: Parts, box: Box) -> None:
    from mirrorwave.replay.playback import Playback
    from msgs.recording.mcap import RecordingReader
    from nodes.viewer.newest import Board
    from nodes.viewer.server import Play, Seek, Step

    with RecordingReader(box.put("a.mcap", part(parts, 0))) as reader:
        board = Board()
        playback = Playback(reader, board)
        for at in range(min(playback.count, 4)):
            playback.show(at)
            for kind, posted in board.newer({}).items():
                board.messages(kind, posted)
        playback.obey([Play(1.0), Seek(1 << 40), Step(-(1 << 40)), Play(-1e308, True)], 0.0)


def _convert(parts: Parts, box: Box) -> None:
    from mirrorwave.console import progress_bar
    from mirrorwave.convert.formats import Format, convert

    target = list(Format)[number(parts, 1, len(Format))]
    out = box.new({"sigmf": "out.sigmf-meta", "foxglove": "out.mcap", "numpy": "out.npz"}.get(target.value, "out"))
    for end in ("out.sigmf-data", "out.background.npy"):
        box.new(end)
    convert(box.put("a.mcap", part(parts, 0)), out, target, progress_bar)


def _sigmf(parts: Parts, box: Box) -> None:
    from mirrorwave.convert.logs import import_sigmf
    from msgs.recording.mcap import info
    from msgs.recording.sigmf import SigmfCapture, write_capture

    stem = box.folder / "c"
    meta = box.put("c.sigmf-meta", part(parts, 0))
    box.put("c.sigmf-data", part(parts, 1))
    if len(parts) > 2:
        box.put("c.background.npy", parts[2])
    capture = SigmfCapture.open(stem)
    beams = list(capture.beams())
    assert len(beams) == len(capture)
    if len(capture) * capture.setup.radar.chirps_per_beam > 1 << 12:
        return
    written, _ = write_capture(box.new("again.sigmf-meta"), capture.setup, beams, overwrite=True)
    again = SigmfCapture.open(written)
    assert _encoded(again.setup) == _encoded(capture.setup)
    assert [_encoded(one) for one in again.beams()] == [_encoded(one) for one in beams]
    found = import_sigmf(meta, box.new("out.mcap"), lambda: None)
    assert found["beams"] == sum(one.messages for one in info(box.folder / "out.mcap").topics if "beam" in one.topic)


def _encoded(message: Any) -> bytes:
    from msgs.bus.codec import encode_inline

    return encode_inline(message)


def _scene(parts: Parts, box: Box) -> None:
    import msgspec

    from sim_player.scene.description import load_scene, scene_from_yaml, scene_to_yaml

    scene = load_scene(box.put("a.yaml", part(parts, 0)))
    assert scene_from_yaml(scene_to_yaml(scene)) == scene
    msgspec.json.encode(scene.setup, enc_hook=str)
    for thing in scene.objects:
        thing.corners_m()


def _plan(parts: Parts, box: Box) -> None:
    from sim_player.planner.plan import plan_world
    from sim_player.scene.description import load_scene
    from sim_player.scene.world import prepare

    scene = load_scene(box.put("a.yaml", part(parts, 0)))
    if len(scene.surfaces) + len(scene.objects) < 8 and scene.radar.preset != "spad":
        plan_world(prepare(scene, 0, scene.setup), scene.setup)


def _map(parts: Parts, box: Box) -> None:
    from sim_player.maps.local_frame import MapPose
    from sim_player.maps.map_scene import map_scene, read_map
    from sim_player.maps.wall_rules import read_rules
    from sim_player.scene.description import scene_from_yaml

    path = box.put(("a.geojson", "a.osm")[number(parts, 0, 2)], part(parts, 1))
    rules = read_rules([str(box.put("rules.yaml", part(parts, 2)))] if part(parts, 2) else [])
    made = map_scene(read_map(path), MapPose(10.0, -30.0, 0.0), 165.0, rules, "a")
    assert scene_from_yaml(made.yaml) == made.scene


def _mesh(parts: Parts, box: Box) -> None:
    import numpy as np

    from sim_player.bodies.meshes import load_mesh

    suffix = (".obj", ".ply", ".stl", ".glb", ".gltf")[number(parts, 0, 5)]
    mesh = load_mesh(box.put(f"a{suffix}", part(parts, 1)), "mm" if number(parts, 0, 32) >= 16 else "m")
    assert np.isfinite(mesh.vertices_m).all()


def _launch(parts: Parts, box: Box) -> None:
    from nodes.process import launch_file

    launch = launch_file.read_launch_file(box.put("a.yaml", part(parts, 0)))
    assert launch_file.launch_from_mapping(launch_file.parse_yaml(launch_file.dump_launch(launch), "a"), "a") == launch
    if part(parts, 1):
        launch = launch_file.with_params(launch, launch_file.read_yaml_mapping(box.put("p.yaml", parts[1])), "p.yaml")
    launch = launch_file.with_overrides(launch, [text(parts, at) for at in range(2, len(parts))])
    launch = launch_file.without_viewers(launch_file.with_origin(launch, "command", box.folder))
    if launch.nodes and launch_file.RECORDER not in launch.nodes:
        launch_file.with_recorder(launch, box.folder / "a.mcap")
    launch_file.start_order(launch), launch_file.stop_order(launch)
    again = launch_file.parse_yaml(launch_file.dump_launch(launch), "a")
    assert launch_file.launch_from_mapping(again, "a") == launch


def _settings(parts: Parts, box: Box) -> None:
    from lab.tradeoff.rows import read_settings

    read_settings(box.put("a.yaml", part(parts, 0)))


def _dbc(parts: Parts, box: Box) -> None:
    from mirrorwave.diagnose.can_signals import SignalReport
    from nodes.can.bus import load_dbc

    report = SignalReport(load_dbc(box.put("a.dbc", part(parts, 0))), 0.1)
    report.read(_frames(part(parts, 1)))
    json.dumps(_plain(report.as_dict()), allow_nan=False)


def _plain(value: Any) -> Any:
    from mirrorwave.console import _plain as plain

    return plain(value)


def _frames(data: bytes) -> Any:
    """CAN frames of 10 bytes and their payload: id, stamp [ms], length, flags."""
    import can

    from nodes.can.bus import LogFrame

    at = 0
    while at + 10 <= len(data):
        arbitration_id, stamp_ms, length, flags = struct.unpack_from("<IIBB", data, at)
        length %= 65
        frame = can.Message(
            arbitration_id=arbitration_id & (0x1FFFFFFF if flags & 1 else 0x7FF),
            is_extended_id=bool(flags & 1),
            is_error_frame=bool(flags & 2),
            is_remote_frame=bool(flags & 4),
            is_fd=bool(flags & 8),
            data=data[at + 10 : at + 10 + length],
        )
        stamp_ns = -1 if flags & 16 else stamp_ms * (1_000_000 if not flags & 32 else 1 << 40)
        yield LogFrame(frame, stamp_ns)
        at += 10 + length


def _can_frames(parts: Parts, box: Box) -> None:
    from mirrorwave.diagnose.can_log import LogReport
    from mirrorwave.diagnose.can_signals import SignalReport
    from msgs.bus import codec
    from msgs.files.shipped import shipped_path
    from nodes.can.bus import load_dbc, load_decoder

    dbc = shipped_path("launch/can/mirrorwave.dbc")
    decoder = load_decoder(dbc, shipped_path("launch/can/mirrorwave.yaml"))
    report = LogReport(decoder, 0.0)
    report.read(_frames(part(parts, 0)))
    json.dumps(_plain(report.as_dict()), allow_nan=False)
    state = decoder.state(1 << 40)
    assert codec.decode_inline(type(state), codec.encode_inline(state)) == state
    signals = SignalReport(load_dbc(dbc), 0.0)
    signals.read(_frames(part(parts, 0)))
    json.dumps(_plain(signals.as_dict()), allow_nan=False)


def _mapping(parts: Parts, box: Box) -> None:
    from mirrorwave.convert.can_log import log_states
    from nodes.can.bus import load_decoder

    dbc, mapping = box.put("a.dbc", part(parts, 1)), box.put("a.yaml", part(parts, 0))
    decoder = load_decoder(dbc, mapping)
    for _ in log_states(decoder, _frames(part(parts, 2))):
        pass


def _detection_table(parts: Parts, box: Box) -> None:
    from contrib.imports.detections import import_detections
    from mirrorwave.console import progress_bar
    from msgs.recording.mcap import RecordingReader

    table, mapping = box.put("a.csv", part(parts, 1)), box.put("a.yaml", part(parts, 0))
    out = box.new("out.mcap")
    found = import_detections(table, out, mapping, None, progress_bar)
    with RecordingReader(out) as reader:
        scans = [item.message for item in reader.messages(("radar/detections",))]
    assert (len(scans), sum(len(one) for one in scans)) == (found["scans"], found["detections"])
    assert all(before.stamp_ns < after.stamp_ns for before, after in itertools.pairwise(scans))


def _target_list(parts: Parts, box: Box) -> None:
    from contrib.boards.target_list import TargetListParams, TargetListReader
    from msgs.files.shipped import shipped_path
    from nodes.can.bus import load_dbc

    kind: Any = ("clusters", "objects")[number(parts, 0, 2)]
    database = load_dbc(shipped_path("launch/can/target_radar.dbc"))
    reader = TargetListReader(database, TargetListParams(kind=kind, sensor_id=number(parts, 0, 8) // 2))
    found = []
    for frame, stamp_ns in _frames(part(parts, 1)):
        if not frame.is_extended_id:
            found += reader.add(frame.arbitration_id, bytes(frame.data), stamp_ns)
        found += reader.tick(stamp_ns)
    found += reader.tick(1 << 60)
    assert [one.scan_id for one in found] == sorted({one.scan_id for one in found})
    assert sum(one.lost for one in found) == reader.lost
    for one in found:
        assert _encoded(type(one)(**{name: getattr(one, name) for name in one.__struct_fields__})) == _encoded(one)


def _can_log(parts: Parts, box: Box) -> None:
    from mirrorwave.convert.logs import CanSource, import_can
    from msgs.files.shipped import shipped_path
    from msgs.recording.mcap import info
    from nodes.can.log_file import read_log

    suffix = text(parts, 0) if text(parts, 0) in (".log", ".asc", ".blf", ".csv", ".trc", ".asc.gz") else ".asc"
    log = box.put(f"a{suffix}", part(parts, 1))
    dbc, mapping = shipped_path("launch/can/mirrorwave.dbc"), shipped_path("launch/can/mirrorwave.yaml")
    out = box.new("out.mcap")
    found = import_can(CanSource(log=log, dbc=dbc, mapping=mapping), out)
    assert found["states"] == sum(one.messages for one in info(out).topics)
    assert not any(frame.stamp_ns is None for frame in itertools.islice(read_log(log), 3))


def _viewer_client(parts: Parts, box: Box) -> None:
    from nodes.viewer.loopback_server import ProtocolError
    from nodes.viewer.newest import Board
    from nodes.viewer.server import Acknowledge, Plot, _Client

    commands: list[Any] = []
    client = _Client(None, Board(), commands.append)  # type: ignore[arg-type]
    for at in range(len(parts)):
        try:
            message = client._understood(text(parts, at))
            client._take(message)
        except ProtocolError as error:
            raise ValueError(error) from None
        assert isinstance(message, Acknowledge | Plot) or commands


def _log_lines(parts: Parts, box: Box) -> None:
    from nodes.process.logs import RECORD_SEPARATOR, LineSplitter, parse_line

    splitter = LineSplitter(limit=256)
    lines = [line for one in parts for line in splitter.feed(one)] + splitter.finish()
    for line in lines:
        assert len(line.encode()) <= 3 * max(256, *map(len, parts)), "a line grows"
        entry = parse_line("node", line)
        json.dumps(entry)
        for key in ("time", "node", "level", "text"):
            assert isinstance(entry.get(key), str), f"{key} of a log entry is {entry.get(key)!r}"
            # a child's output must not move the cursor of the terminal
            assert all(mark.isprintable() or mark in "\t\n" for mark in entry[key]), f"{key}: {entry[key]!r}"
            assert RECORD_SEPARATOR not in entry[key]


def _background(parts: Parts, box: Box) -> None:
    from models.perception.form.background import load_background

    assert load_background(box.put("a.npy", part(parts, 0))).ndim == 2


def _card(parts: Parts, box: Box) -> None:
    from models.perception.cards import read_card
    from models.perception.find.onnx_model import ModelCard
    from models.perception.mirrors.residual_model import ResidualCard

    kind: Any = (ModelCard, ResidualCard)[number(parts, 0, 2)]
    card = read_card(box.put("a.json", part(parts, 1)), kind)
    if isinstance(card, ModelCard):
        assert len(card.answer_shape) == 4


def _onnx(parts: Parts, box: Box) -> None:
    import msgspec

    from models.perception.find.onnx_model import DensePredictor

    model = box.put("a.onnx", part(parts, 1))
    # a checksum that every change breaks would hide all that lies behind it
    try:
        card = msgspec.json.decode(part(parts, 0), type=dict) | {"sha256": hashlib.sha256(part(parts, 1)).hexdigest()}
    except (msgspec.MsgspecError, RecursionError):
        card = {}
    box.put("a.json", msgspec.json.encode(card))
    DensePredictor(model)


def _manifest(parts: Parts, box: Box) -> None:
    from contrib.annotate.manifest import Pose, load_manifest

    found = load_manifest(box.put("a.yaml", part(parts, 0)))
    for cloud in found.clouds:
        if cloud.radar_from_lidar is not None:
            Pose.of(cloud.radar_from_lidar.transform())


def _cloud(parts: Parts, box: Box) -> None:
    from contrib.annotate.clouds import SUFFIXES, read_cloud, read_columns
    from contrib.ros2.point_cloud2 import columns_cloud
    from msgs.values.lidar import LidarPoints

    path = box.put(f"a{SUFFIXES[number(parts, 0, len(SUFFIXES))]}", part(parts, 1))
    with contextlib.suppress(ValueError):
        fields, data = columns_cloud(read_columns(path))
        LidarPoints(stamp_ns=0, fields=fields, data=data).positions_m()
    points_m, _ = read_cloud(path)
    assert points_m.shape[1] == 3


def _image(parts: Parts, box: Box) -> None:
    from contrib.imports.jpeg import jpeg_of_file
    from msgs.values.camera import CameraImage

    image = CameraImage.of(jpeg_of_file(part(parts, 0)), stamp_ns=0)
    assert image.width_px * image.height_px > 0


def _shard(parts: Parts, box: Box) -> None:
    from lab.training.data.frames import DataSet, fixed_splits
    from sim_player.dataset.shards import UNREADABLE, read_shard

    path = box.put("set/shard-00000.npz", part(parts, 0))
    for at, name in enumerate(("series.json", "splits.json", "manifest.jsonl"), start=1):
        if part(parts, at):
            box.put(f"set/{name}", parts[at])
        else:
            box.new(f"set/{name}")
    with contextlib.suppress(UNREADABLE):
        read_shard(path)
    data = DataSet(path.parent)
    assert data.setup is not None
    for index in range(min(len(data), 4)):
        data.scan(index)
    if part(parts, 2):
        fixed_splits(path.parent)
    assert data.grid is not None


def _xradarnlos(parts: Parts, box: Box) -> None:
    from lab.training.data.xradarnlos import import_folder

    box.new("in")
    if number(parts, 0, 2):
        box.put("in/a.npy", part(parts, 1))
        box.put("in/a.npz", part(parts, 2))
    else:
        (box.folder / "in").mkdir(exist_ok=True)
        box.put("in/welch_interpolated_background_subtracted.npz", part(parts, 1))
        for at, name in enumerate(("los", "mirrored_nlos", "nlos"), start=2):
            box.put(f"in/labeled_points/{name}.npy", part(parts, at))
    import_folder(box.folder / "in", box.new("out"), "sim" if number(parts, 0, 2) else "real")


def _dca1000(parts: Parts, box: Box) -> None:
    import numpy as np

    from contrib.boards.config_file import read_config
    from contrib.boards.dca1000_capture import array_params, frame_samples, frames_of, map_grid

    suffix = (".cfg", ".json", ".lua")[number(parts, 0, 3)]
    capture, config = box.put("a.bin", part(parts, 2)), read_config(box.put(f"a{suffix}", part(parts, 1)), None)
    found = frames_of(capture.stat().st_size, config, str(capture))
    assert array_params(config) is not None
    assert map_grid(config).range_bins > 0
    with capture.open("rb") as file:
        for _ in range(min(found.whole, 4)):
            frame_samples(np.fromfile(file, "<i2", config.frame_bytes // 2), config)


def _card_datagrams(parts: Parts, box: Box) -> None:
    from contrib.boards.dca1000_packets import FrameAssembler
    from contrib.boards.dca1000_socket import parse_answer, reports

    assembler = FrameAssembler((64, 6144, 1 << 16)[number(parts, 0, 3)])
    frames = []
    for at in range(1, len(parts)):
        with contextlib.suppress(ValueError):
            frames += assembler.add(part(parts, at), at)
        with contextlib.suppress(ValueError):
            reports(parse_answer(part(parts, at))[1])
    frames += assembler.flush()
    assert all(0 <= frame.missing_bytes <= len(frame.codes) * 2 for frame in frames)
    assert assembler.counts.placed + assembler.counts.refused + assembler.counts.repeated <= max(len(parts) - 1, 0)


def _transients(parts: Parts, box: Box) -> None:
    from lab.transients.confocal import read_confocal

    scan = read_confocal(box.put("a.mat", part(parts, 0)))
    assert scan.range_m.shape == (scan.bins,)
    assert scan.wall_m.shape == (len(scan.counts),)


def _json_files(parts: Parts, box: Box) -> None:
    from lab.tradeoff.latency_budget import _recall
    from lab.tradeoff.row_report import read_report
    from nodes.process.supervisor import LOCK_NAME, read_lock

    content = part(parts, 1)
    match number(parts, 0, 5):
        case 0:
            read_report(box.put("a.json", content))
        case 1:
            _recall(box.put("a.json", content))
        case 3:
            box.put(LOCK_NAME, content)
            read_lock(box.folder)
        case _:
            from mirrorwave.diagnose.doctor_graph import _log_entries

            box.put("log.jsonl", content)
            for entry in _log_entries(box.folder):
                assert all(isinstance(entry[key], str) for key in ("node", "level", "text"))


def _reflectance(parts: Parts, box: Box) -> None:
    from lab.full_wave.reflectance import _read_partial, load_table

    _read_partial(box.put("a.cells.jsonl", part(parts, 2)))
    try:
        card = json.loads(part(parts, 0))
        card["sha256"] = hashlib.sha256(part(parts, 1)).hexdigest()
        box.put("a.json", json.dumps(card).encode())
    except (ValueError, TypeError, RecursionError):
        box.put("a.json", part(parts, 0))
    load_table(box.put("a.npz", part(parts, 1)))


def _keys(parts: Parts, box: Box) -> None:
    from contrib.two_machines.keys import is_loopback, load_allowed, load_own, load_public

    secret, public = box.put("own/a.key_secret", part(parts, 0)), box.put("peers/b.key", part(parts, 1))
    secret.chmod(0o600), public.chmod(0o644)
    is_loopback(text(parts, 2))
    # each is tried, whatever became of the others
    refused = []
    for read in (lambda: load_own(secret), lambda: load_public(public), lambda: load_allowed(public.parent)):
        try:
            read()
        except ValueError as error:
            refused.append(error)
    for error in refused:
        raise error


def _words(parts: Parts, box: Box) -> None:
    """What is typed at the command line: conditions, fields, angles, lists, spans, methods, overrides."""
    import math

    from fuzz.seeds import messages
    from lab.evaluate import methods as evaluate_methods
    from lab.walls import curves as wall_curves
    from mirrorwave.commands import former_options
    from mirrorwave.commands.captures import bag_options
    from mirrorwave.commands.sim import dataset as sim_dataset
    from mirrorwave.diagnose import topic_echo
    from msgs.bus.codec import to_builtins

    word = text(parts, 1)
    match number(parts, 0, 9):
        case 0:
            condition = topic_echo.parse_condition(word)
            for _, message in messages():
                body = to_builtins(message)
                if condition.field.partition(".")[0] in body:
                    assert condition.holds(body) in (True, False)
        case 1:
            for _, message in messages():
                topic_echo.field_of(to_builtins(message), word)
        case 2:
            angles = wall_curves.parse_angles(word)
            assert 0 < len(angles) <= wall_curves.MAX_ANGLES
        case 3:
            bag_options.split_topics(word)
        case 4:
            start, end, duration = (float(one) for one in [*word.split(), "nan", "nan", "nan"][:3])
            first, last = bag_options.span_ns(
                0, 1 << 62, start, *(None if math.isnan(one) else one for one in (end, duration))
            )
            assert last is None or last > first
        case 5:
            evaluate_methods.parse_method(word)
        case 6:
            sim_dataset.parse_effects(word)
        case 7:
            sim_dataset.parse_slurm(word.split("|"))
        case _:
            former_options.present_words(word.split("|"), str)


_CAN = ("can", "cantools", "textparser", "bitstruct")
TARGETS: dict[str, Target] = {
    "wire": Target(_wire, ("bytes", "msgpack", "bytes")),
    "inline": Target(_inline, ("bytes", "msgpack")),
    "foreign": Target(_foreign, ("bytes", "msgpack", "bytes")),
    "recording": Target(_recording, ("mcap",), modules=("mcap",), max_bytes=1 << 16),
    "recover": Target(_recover, ("mcap", "bytes"), modules=("mcap",), max_bytes=1 << 16),
    "replay": Target(_replay, ("mcap", "bytes"), modules=("mcap",), max_bytes=1 << 16),
    "view": Target(_view, ("mcap",), modules=("mcap",), max_bytes=1 << 16),
    "convert": Target(_convert, ("mcap", "bytes"), modules=("mcap", "rosbags"), max_bytes=1 << 16),
    "sigmf": Target(_sigmf, ("json", "bytes", "npy"), modules=("sigmf",)),
    "scene": Target(_scene, ("yaml",), modules=("yaml",)),
    "plan": Target(_plan, ("yaml",)),
    "map": Target(_map, ("bytes", "text", "yaml"), modules=("msgspec", "shapely", "osmium")),
    "mesh": Target(_mesh, ("bytes", "text"), modules=("trimesh",)),
    "launch": Target(_launch, ("yaml", "yaml", "text"), modules=("yaml",)),
    "settings": Target(_settings, ("yaml",), modules=("yaml",)),
    "dbc": Target(_dbc, ("text", "bytes"), modules=_CAN),
    "mapping": Target(_mapping, ("yaml", "text", "bytes")),
    "can_frames": Target(_can_frames, ("bytes",)),
    "target_list": Target(_target_list, ("bytes", "bytes")),
    "detection_table": Target(_detection_table, ("yaml", "text"), modules=("yaml", "msgspec")),
    "can_log": Target(_can_log, ("bytes", "text"), modules=("can",)),
    "viewer_client": Target(_viewer_client, ("json",)),
    "log_lines": Target(_log_lines, ("text",), refusals=()),
    "background": Target(_background, ("npy",)),
    "card": Target(_card, ("bytes", "json")),
    "onnx": Target(_onnx, ("json", "bytes")),
    "manifest": Target(_manifest, ("yaml",), modules=("yaml",)),
    "cloud": Target(_cloud, ("bytes", "text")),
    "image": Target(_image, ("bytes",), modules=("PIL",)),
    "shard": Target(_shard, ("npz", "json")),
    "xradarnlos": Target(_xradarnlos, ("bytes", "npz", "npy")),
    "dca1000": Target(_dca1000, ("bytes", "text", "bytes")),
    "card_datagrams": Target(_card_datagrams, ("bytes",) * 9),
    "transients": Target(_transients, ("bytes",), modules=("scipy.io.matlab",)),
    "json_files": Target(_json_files, ("bytes", "json")),
    "reflectance": Target(_reflectance, ("json", "npz", "json")),
    "keys": Target(_keys, ("text", "text", "text")),
    "words": Target(_words, ("bytes", "text")),
}
