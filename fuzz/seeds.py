"""Valid inputs to begin with, made by the project's own writers: small, seeded, nothing measured."""

from __future__ import annotations

import hashlib
import io
import math
import struct
import tempfile
from collections.abc import Callable, Iterator
from functools import lru_cache
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from fuzz.mutations import Parts
from msgs.bus import codec
from msgs.bus.interface import Envelope
from msgs.recording.mcap import Losses, RecordingWriter, TopicLoss
from msgs.recording.sigmf import write_capture
from msgs.values.camera import CameraImage
from msgs.values.detections import RadarDetections
from msgs.values.diagnostics import LogRecord, NodeState, NodeStatus, ShedCount, StageTime, TopicCount
from msgs.values.environment import GnssPose, PriorWall, WallPriors
from msgs.values.lidar import LidarSetup, PhotonHistograms
from msgs.values.node_params import NodeParams, ParamRequest
from msgs.values.perception import (
    BevFrame,
    BevGrid,
    HiddenObject,
    HiddenPoint,
    Peaks,
    RadialSpeed,
    SceneTruth,
    Track,
    TruthObject,
    TruthSurface,
    Wall,
)
from msgs.values.radar import BeamGrid, RadarBeam, RadarParams, RadarSetup, RangeAzimuthGrid, RangeAzimuthMap
from msgs.values.vehicle import VehicleState
from tests.side_sensors import cloud, jpeg

ROOT = Path(__file__).resolve().parents[1]
GRID = RangeAzimuthGrid(range_bins=4, azimuth_bins=4)
SETUP = RadarSetup(
    radar=RadarParams(chirps_per_beam=1, samples_per_chirp=4, scan_period_s=0.2),
    beams=BeamGrid(azimuth_deg=(-20.0, 0.0, 20.0)),
    full_scale_dbm=-21.7,
)
FULL_SETUP = msgspec.structs.replace(
    SETUP,
    beat_sign=-1,
    steering_weights=np.exp(1j * np.arange(24.0).reshape(3, 8)).astype(np.complex64),
    background=np.arange(12.0).reshape(3, 4).astype(np.complex64),
)
_COVARIANCE = ((1.0, 0.0), (0.0, 2.0))


def beams(count: int) -> Iterator[RadarBeam]:
    """Beams of `SETUP`, three a scan."""
    for at in range(count):
        yield RadarBeam(
            stamp_ns=1000 + 70_000_000 * at,
            scan_id=at // 3,
            beam_index=at % 3,
            beam_count=3,
            azimuth_rad=math.radians(SETUP.beams.azimuth_deg[at % 3]),
            samples=np.arange(8, dtype=np.int16).reshape(1, 4, 2),
            full_scale_dbm=SETUP.full_scale_dbm,
        )


def _peaks(scan_id: int) -> Peaks:
    column = np.array([0.25, 0.5])
    return Peaks(
        stamp_ns=1000, scan_id=scan_id, range_m=column, azimuth_rad=column, score=column, snr_db=column,
        path_class=np.array([0, 1], np.uint8), covariance=np.zeros((2, 2, 2)), peak_stamp_ns=np.arange(2),
        missing_beams=(2,), faults=("interference",), radial_speed_mps=np.array([np.nan, -2.0]),
        radial_speed_std_mps=np.array([np.nan, 0.5]),
    )  # fmt: skip


def _map(scan_id: int) -> RangeAzimuthMap:
    return RangeAzimuthMap(
        stamp_ns=1000, scan_id=scan_id, grid=GRID, values=np.full(GRID.shape, 1j, np.complex64), noise_power_mw=1e-9,
        azimuth_stamp_ns=np.arange(4, dtype=np.int64), incoherent=np.array([True, False] * 2), missing_beams=(1,),
        radial_speed_cmps=np.full(GRID.shape, -200, np.int16), radial_speed_unit_std_mps=8.0,
    )  # fmt: skip


def _view(scan_id: int) -> BevFrame:
    return BevFrame(
        stamp_ns=1000,
        scan_id=scan_id,
        walls=(Wall(normal=(-1.0, 0.0), offset_m=9.0, ends_m=((9.0, -1.0), (9.0, 1.0)), inliers=4),),
        points=(HiddenPoint(x_m=1.0, y_m=2.0, score=0.5, image_x_m=3.0, image_y_m=4.0, wall=0),),
        objects=(
            HiddenObject(
                id=1, x_m=1.0, y_m=2.0, length_m=4.0, width_m=2.0, yaw_rad=0.1, score=0.9, cov_m2=_COVARIANCE,
                object_class="car", radial_speed=RadialSpeed(azimuth_rad=0.3, speed_mps=-2.0, std_mps=0.5),
            ),
        ),
        tracks=(
            Track(
                id=1, x_m=1.0, y_m=2.0, velocity_x_mps=0.0, velocity_y_mps=1.0, age_s=1.0, cov_m2=_COVARIANCE,
                time_to_appear_s=2.0, velocity_cov_m2ps2=_COVARIANCE, existence=0.9,
                object_class="car",
            ),
        ),
        los_points_m=np.ones((2, 2), np.float32),
        grid=BevGrid(rows=2, columns=3),
        visibility=np.array([[0, 1, 2], [2, 1, 0]], np.uint8),
        ego=VehicleState(stamp_ns=3, speed_mps=4.5),
        flags=("incoherent",),
    )  # fmt: skip


def _detections(scan_id: int) -> RadarDetections:
    column = np.array([1.0, np.nan])
    return RadarDetections(
        stamp_ns=1000, scan_id=scan_id, sensor="front", range_m=np.array([5.0, 9.0]), azimuth_rad=np.array([0.1, -0.2]),
        covariance=np.stack([0.01 * np.eye(2)] * 2), elevation_rad=column, elevation_std_rad=column,
        radial_speed_mps=column, radial_speed_std_mps=column, over_ground=True, rcs_dbsm=column, snr_db=column, lost=1,
    )  # fmt: skip


#: On the shipped map of an invented street.
GNSS = GnssPose(
    stamp_ns=3, latitude_deg=10.0, longitude_deg=-30.0, heading_deg=5.0, position_std_m=1.0, heading_std_deg=0.5
)


def _walls() -> WallPriors:
    wall = PriorWall(ends_m=((20.0, -5.0), (20.0, 5.0)), offset_std_m=0.1, angle_std_rad=0.01, end_std_m=0.5)
    return WallPriors(stamp_ns=1000, source="map", walls=(wall, wall))


def _truth(scan_id: int) -> SceneTruth:
    return SceneTruth(
        stamp_ns=1000,
        scan_id=scan_id,
        los_points_m=np.zeros((2, 3), np.float32),
        mirrored_points_m=np.ones((1, 3), np.float32),
        hidden_points_m=np.ones((1, 3), np.float32),
        hidden_object=np.array([-1], np.int32),
        objects=(TruthObject(id=1, object_class="car", x_m=1.0, y_m=2.0, length_m=4.0, width_m=2.0, yaw_rad=0.0),),
        surfaces=(TruthSurface(role="relay", material="glass", polyline_m=((1.0, 2.0), (3.0, 4.0))),),
    )


def messages(scan_id: int = 0) -> list[tuple[str, msgspec.Struct]]:
    """At least one message of every topic, its optional fields filled."""
    status = NodeStatus(
        stamp_ns=1, node="a", pid=3, state=NodeState.READY, cpu_s=1.0, uptime_s=2.0, resident_bytes=9,
        stages=(StageTime(name="fold", count=3, last_ms=1.0, mean_ms=1.0, max_ms=2.0, samples_ms=(1.0, 2.0)),),
        received=(TopicCount(topic="radar/beam", messages=1, bytes=2, lost=1),),
        published=(TopicCount(topic="log", messages=1, bytes=2),),
        shed=(ShedCount(what="map", reason="late", count=2),),
    )  # fmt: skip
    histograms = PhotonHistograms(
        stamp_ns=1, scan_id=scan_id, counts=np.arange(8, dtype=np.uint32).reshape(4, 2), azimuth_stamp_ns=np.arange(4)
    )
    return [
        ("radar/setup", FULL_SETUP),
        ("radar/setup", SETUP),
        ("lidar/setup", LidarSetup(grid=GRID, scan_period_s=1.0)),
        ("vehicle/state", VehicleState(stamp_ns=3, speed_mps=4.5, valid=False, reason="stale")),
        *(("radar/beam", beam) for beam in beams(3)),
        ("lidar/histograms", histograms),
        ("lidar/points", cloud(scan_id=scan_id)),
        ("camera/image", CameraImage.of(jpeg(), stamp_ns=1, image_id=scan_id, sensor="front")),
        ("radar/detections", _detections(scan_id)),
        ("radar/ra_map", _map(scan_id)),
        ("perception/peaks", _peaks(scan_id)),
        ("perception/hidden_objects", _view(scan_id)),
        ("vehicle/gnss", GNSS),
        ("environment/walls", _walls()),
        ("sim/truth", _truth(scan_id)),
        ("diagnostics/node", status),
        ("log", LogRecord(stamp_ns=1, node="a", level="info", text="wall found: 12 m")),
        ("param/request", ParamRequest(stamp_ns=1, request="1", node="a", changes='{"threads": 2}')),
        ("param/values", NodeParams(stamp_ns=2, node="a", params='{"threads": 2}', request="1")),
    ]


def wire() -> list[list[bytes]]:
    """Every message as frames."""
    return [
        [bytes(frame) for frame in codec.encode(Envelope(publisher="n", topic=topic, sequence=1, sent_ns=7), message)]
        for topic, message in messages()
    ]


@lru_cache
def recordings() -> list[bytes]:
    """A recording of every topic over two scans; one of a single topic; one that was cut off."""
    every = [(topic, message) for scan in (0, 1) for topic, message in messages(scan)]
    one = [("vehicle/state", VehicleState(stamp_ns=at, speed_mps=1.0)) for at in range(3)]
    view = [(topic, message) for topic, message in every if topic in ("perception/hidden_objects", "radar/setup")]
    made = [_recording(every), _recording(one), _recording(view)]
    return [*made, made[1][: len(made[1]) // 2], _foreign_recording()]


def _recording(every: list[tuple[str, msgspec.Struct]]) -> bytes:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "seed.mcap"
        with RecordingWriter(path, {"started_utc": "2026-01-01", "launch": "name: a", "machine": "{}"}) as writer:
            for at, (topic, message) in enumerate(every):
                writer.write(topic, message, publisher="n", sequence=at, sent_ns=50_000_000 * at)
            writer.write_losses(Losses(topics=(TopicLoss(topic="radar/beam", lost=2),), ended="disk full"))
        return path.read_bytes()


def _foreign_recording() -> bytes:
    """As another program writes one: channels declared once, an attachment, messages outside chunks."""
    from mcap.writer import CompressionType, Writer

    out = io.BytesIO()
    writer = Writer(out, compression=CompressionType.LZ4, use_chunking=True, chunk_size=64)
    writer.start("x", "other")
    schema = writer.register_schema("VehicleState", "jsonschema", b"{}")
    channel = writer.register_channel("vehicle/state", "msgpack", schema)
    other = writer.register_channel("imu", "json", 0)
    state = codec.encode_inline(VehicleState(stamp_ns=1, speed_mps=2.0))
    for at in range(4):
        writer.add_message(channel, at, state, at, at)
        writer.add_message(other, at, b"{}", at, at)
    writer.add_attachment(1, 1, "a", "text/plain", b"x")
    writer.add_metadata("mirrorwave", {"a": "b"})
    writer.finish()
    return out.getvalue()


@lru_cache
def sigmf() -> list[list[bytes]]:
    """Metadata, data and background of captures, plain and with all optional keys."""
    found = []
    for setup, count in ((SETUP, 6), (FULL_SETUP, 3), (SETUP, 2)):
        with tempfile.TemporaryDirectory() as folder:
            meta, data = write_capture(Path(folder) / "c", setup, beams(count))
            # a checksum that every change breaks would hide all that lies behind it
            fields = msgspec.json.decode(meta.read_bytes())
            del fields["global"]["core:sha512"]
            background = Path(folder) / "c.background.npy"
            parts = [msgspec.json.encode(fields), data.read_bytes()]
            found.append([*parts, background.read_bytes()] if background.exists() else parts)
    return found


def files(pattern: str) -> list[bytes]:
    """Files that come with the code, by a pattern from the checkout."""
    return [path.read_bytes() for path in sorted(ROOT.glob(pattern))]


def npz(**arrays: Any) -> bytes:
    """An archive of arrays."""
    out = io.BytesIO()
    np.savez(out, **arrays)
    return out.getvalue()


def npy(array: np.ndarray, order: str = "C") -> bytes:
    """One array."""
    out = io.BytesIO()
    np.save(out, np.asarray(array, order=order))  # type: ignore[call-overload]
    return out.getvalue()


def shard() -> bytes:
    """A data set's shard of two scenes with three points."""
    return npz(
        values=np.ones((2, 4, 4), np.complex64),
        noise_power_mw=np.array([1e-9, 2e-9]),
        offset=np.array([0, 1, 3]),
        range_m=np.array([1.0, 2.0, 3.0], np.float32),
        azimuth_rad=np.zeros(3, np.float32),
        path_class=np.array([0, 1, 1], np.uint8),
        hidden_xy_m=np.ones((3, 2), np.float32),
        facts=np.array([b'{"place": "street", "objects": ["car"]}', b"{}"]),
        scene_yaml=np.array(["name: a", "name: b"]),
        sequence=np.array(["a", "b"]),
        places_m=np.ones((2, 2), np.float32),
        place_offset=np.array([0, 1, 2]),
    )


@lru_cache
def network() -> list[bytes]:
    """A card and the smallest ONNX file that it can describe; the card's checksum is put right by the target."""
    import onnx
    from onnx import TensorProto, helper, numpy_helper

    weights = numpy_helper.from_array(np.full((2, 7, 1, 1), 0.1, np.float32), "w")
    graph = helper.make_graph(
        [helper.make_node("Conv", ["map", "w"], ["seen"]), helper.make_node("Sigmoid", ["seen"], ["heat"])],
        "g",
        [helper.make_tensor_value_info("map", TensorProto.FLOAT, (1, 7, 8, 16))],
        [helper.make_tensor_value_info("heat", TensorProto.FLOAT, (1, 2, 8, 16))],
        [weights],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)
    onnx.checker.check_model(model)
    content = model.SerializeToString()
    card = msgspec.json.decode((ROOT / "models/weights/compact_unet.int8.json").read_bytes())
    card |= {
        "sha256": hashlib.sha256(content).hexdigest(),
        "encoding": card["encoding"] | {"range_bins": 8, "columns": 16},
        "grid": {"range_bin_m": 0.2, "range_bins": 8, "azimuth_bins": 16, "azimuth_limit_deg": 60.0},
        "input_shape": [1, 7, 8, 16],
        "output_shape": [1, 2, 8, 16],
        "scores": card["scores"][:1],
        "calibration": [[0.0, 0.0], [0.5, 0.5], [1.0, 1.0]],
        "training": {"command": "mirrorwave train"},
        "data": {"training": "none"},
    }
    return [msgspec.json.encode(card), content]


def transients(packed: bool) -> bytes:
    """A confocal scan of 2 x 2 wall points and 16 bins as a MATLAB file."""
    from scipy.io import savemat

    file = io.BytesIO()
    counts = np.arange(64, dtype=np.uint16).reshape(2, 2, 16)
    savemat(file, {"rect_data": counts, "width": 0.2}, do_compression=packed)
    # the header's time of writing
    return b"MATLAB 5.0 MAT-file".ljust(116) + file.getvalue()[116:]


CFG = b"""% Platform:xWR16xx
sensorStop
channelCfg 15 3 0
adcCfg 2 1
adcbufCfg -1 0 0 1 1
profileCfg 0 77.0 30 6 62 0 0 60 1 4 2500 0 0 30
chirpCfg 0 0 0 0 0 0 0 1
chirpCfg 1 1 0 0 0 0 0 2
frameCfg 0 1 2 2 40 1 0
lvdsStreamCfg -1 0 1 0
sensorStart
"""
LUA = b"""-- as CFG
SAMPLES = 2 * 2
ar1.SelectChipVersion("XWR1642")
ar1.ChanNAdcConfig(1, 1, 0, 1, 1, 1, 1, 2, 1, 0)
ar1.LVDSLaneConfig(0, 1, 1, 1, 1, 1, 0, 0)
ar1.ProfileConfig(0, 77, 30, 6, 62, 0, 0, 0, 0, 0, 0, 60, 1, SAMPLES, 2500, 0, 0, 30)
ar1.ChirpConfig(0, 0, 0, 0, 0, 0, 0, 1, 0, 0)
ar1.ChirpConfig(1, 1, 0, 0, 0, 0, 0, 0, 1, 0)
ar1.FrameConfig(0, 1, 2, 2, 40, 0, 0, 1)
ar1.CaptureCardConfig_Mode(1, 2, 1, 2, 3, 30)
"""
CFG_JSON = b"""{"device": "xwr14xx", "channelCfg": {"rx_mask": 15, "tx_mask": 5}, "adcCfg": {"adc_bits": 2,
"output_format": 1}, "profileCfg": {"profile_id": 0, "start_frequency_ghz": 77.0, "idle_time_us": 30,
"adc_start_time_us": 6, "ramp_end_time_us": 62, "tx_backoff": 0, "tx_phase_shifter": 0, "slope_mhz_per_us": 60,
"tx_start_time_us": 1, "adc_samples": 4, "sample_rate_ksps": 2500, "hpf_corner_1": 0, "hpf_corner_2": 0,
"rx_gain_db": 30}, "chirpCfg": [{"start_index": 0, "end_index": 0, "profile_id": 0, "tx_mask": 1},
{"start_index": 1, "end_index": 1, "profile_id": 0, "tx_mask": 4}], "frameCfg": {"chirp_start_index": 0,
"chirp_end_index": 1, "loops": 2, "frames": 2, "period_ms": 40}}"""

SCENE = b"""name: every
radar: {preset: xband, height_m: 0.8, noise_figure_db: 9.0, front_end: {adc_bits: 12}}
surfaces:
  - {role: relay, material: glass, polyline_m: [[12.0, -3.0], [12.0, 3.0], [10.0, 6.0]], thickness_mm: 8.0}
  - {role: occluder, material: concrete, polyline_m: [[4.0, 1.0], [8.0, 1.5]], roughness_mm: 1.0, curvature_per_m: 0.01}
  - {role: ground, material: concrete}
objects:
  - {class: car, x_m: 6.0, y_m: 6.0, yaw_deg: 90.0, speed_mps: 3.0}
  - {primitive: box, size_m: [1.0, 1.0, 1.0], material: metal, x_m: 3.0, y_m: -4.0, z_m: 0.2}
ego: {speed_mps: 2.0, yaw_rate_dps: 1.0}
weather: {rain_mm_per_h: 5.0}
"""
MANIFEST = b"""name: yard
radar_height_m: 1.2
clouds:
  - {file: a.ply, radar_from_lidar: {x_m: 1.0, yaw_deg: 3.0}, calibrated: true}
  - {file: b.ply, unit: mm}
radar: drive.sigmf-meta
slice: {}
seed: 3
"""
SETTINGS = b"""rows:
  - {switch: beams, value: half, params: {ra_former: {beams: 13}}}
  - {switch: refine, value: none, params: {dense_predictor: {refine: none}}}
"""
OBJ = b"v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 2 3 4\nf 1 4 3\n"
PLY_MESH = (
    b"ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\n"
    b"element face 1\nproperty list uchar int vertex_indices\nend_header\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n"
)
STL_TEXT = (
    b"solid a\nfacet normal 0 0 1\nouter loop\nvertex 0 0 0\nvertex 1 0 0\nvertex 0 1 0\nendloop\nendfacet\n"
    b"endsolid a\n"
)
GLTF = b'{"asset": {"version": "2.0"}, "meshes": [], "nodes": [], "scenes": [{"nodes": []}], "scene": 0}'
STL_BINARY = bytes(80) + struct.pack("<I12fH", 1, 0, 0, 1, 0, 0, 0, 1, 0, 0, 0, 1, 0, 0)
PLY_CLOUD = (
    b"ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\nend_header\n"
    b"0 0 0\n5 5 1\n1 2 3\n"
)
PLY_BINARY = PLY_CLOUD[: PLY_CLOUD.index(b"0 0 0")].replace(b"ascii", b"binary_little_endian") + struct.pack(
    "<9f", 0, 0, 0, 5, 5, 1, 1, 2, 3
)
PCD = (
    b"# .PCD v0.7\nVERSION 0.7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\nWIDTH 3\nHEIGHT 1\n"
    b"VIEWPOINT 0 0 0 1 0 0 0\nPOINTS 3\nDATA ascii\n0 0 0\n5 5 1\n1 2 3\n"
)
#: A zero, three repetitions of it, 32 bytes as they are.
PCD_PACKED = PCD.partition(b"ascii")[0] + b"binary_compressed\n" + struct.pack(
    "<2I5s8f", 37, 36, b"\0\0\x20\0\x1f", 5, 1, 0, 5, 2, 0, 1, 3
)  # fmt: skip


def can_frames(count: int = 6) -> bytes:
    """Frames of the car of launch/can as 18 bytes each: id, stamp [ms], length, flags, data."""
    from models.vehicle.end_to_end import ChecksumRule, checksum_of

    out = b""
    for at in range(count):
        for number, name in ((256, "SPEED_CHECKSUM"), (257, "MOTION_CHECKSUM")):
            payload = bytes([0, at % 16, 16, 39, 0, 1, 0, 0])
            rule = ChecksumRule(signal=name, algorithm="crc8_sae_j1850", data_id=number)
            payload = bytes([checksum_of(rule, payload, 0)]) + payload[1:]
            out += struct.pack("<IIBB", number, 20 * at, 8, 0) + payload
    return out


def target_lists() -> list[list[bytes]]:
    """Two measurements of three targets on CAN, as `can_frames`: clusters of sensor 0, objects of sensor 1."""
    clusters = [(0x701, 8, bytes([at, 81, 66, 50, 123, 33, 129, 153])) for at in range(3)]
    clusters += [(0x702, 5, bytes([at, 136, 34, 19, 3])) for at in range(3)]
    objects = [(0x61B, 8, bytes([at, 81, 66, 50, 123, 33, 129, 153])) for at in range(3)]
    objects += [(0x61C, 7, bytes([at, 136, 34, 16, 34, 64, 232])) for at in range(3)]
    found = []
    for choice, status, frames in ((0, (0x600, 5), clusters), (3, (0x61A, 4), objects)):
        out = b""
        for at in range(2):
            first = bytes([2, 1, 0, at, 16]) if choice == 0 else bytes([3, 0, at, 16])
            for number, length, data in [(*status, first), *frames]:
                out += struct.pack("<IIBB", number, 59 * at, length, 0) + data
        found.append([bytes([choice]), out])
    return found


DETECTION_TABLE = (
    b"stamp_s,range_m,azimuth_deg,radial_speed_mps,rcs_dbsm\n1.25,10.0,30,-2,5\n1.25,20,-30,,5\n# a\n1.5,nan,0,0,0\n"
)
DETECTION_MAPPING = b"""x: {column: 2}
y: {column: 3, unit: cm, negated: true}
x_std: {value: 0.1}
y_std: {column: 1, unit: mm}
stamp: {column: 0, unit: ms}
scan: {column: 1}
table: {delimiter: ";", header: false, skip_lines: 1, comment: ""}
"""


def detection_tables() -> list[list[bytes]]:
    """A table with a head under the mapping that is shipped, and one without."""
    return [
        [(ROOT / "launch/detections/table.yaml").read_bytes(), DETECTION_TABLE],
        [DETECTION_MAPPING, b"made\n1;7;1;0\n2;7;2;0\n3;8;0;-3\n"],
    ]


def can_logs() -> list[list[bytes]]:
    """The same frames as each kind of log, its suffix first."""
    import can

    found = []
    for suffix in (".log", ".asc", ".blf", ".csv", ".trc"):
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / f"a{suffix}"
            with can.Logger(path) as logger:
                frames = can_frames()
                for at in range(0, len(frames), 18):
                    number, stamp_ms, length, _ = struct.unpack_from("<IIBB", frames, at)
                    logger(
                        can.Message(
                            timestamp=1.0 + 1e-3 * stamp_ms,
                            arbitration_id=number,
                            data=frames[at + 10 : at + 10 + length],
                            is_extended_id=False,
                            channel=0,
                        )
                    )
            found.append([suffix.encode(), path.read_bytes()])
    return found


#: A house as a way and one with a courtyard as a relation, around (10 N, 30 W).
OSM = b"""<?xml version="1.0"?>
<osm version="0.6">
 <node id="1" lat="10.0001" lon="-30.0001"/><node id="2" lat="10.0001" lon="-29.9999"/>
 <node id="3" lat="10.0003" lon="-29.9999"/><node id="4" lat="10.0003" lon="-30.0001"/>
 <node id="5" lat="10.0005" lon="-30.0001"/><node id="6" lat="10.0005" lon="-29.9999"/>
 <node id="7" lat="10.0009" lon="-29.9999"/><node id="8" lat="10.0009" lon="-30.0001"/>
 <node id="9" lat="10.0006" lon="-30.00005"/><node id="10" lat="10.0006" lon="-29.99995"/>
 <node id="11" lat="10.0008" lon="-29.99995"/>
 <way id="1"><nd ref="1"/><nd ref="2"/><nd ref="3"/><nd ref="4"/><nd ref="1"/><tag k="building" v="house"/></way>
 <way id="2"><nd ref="5"/><nd ref="6"/><nd ref="7"/></way>
 <way id="3"><nd ref="7"/><nd ref="8"/><nd ref="5"/></way>
 <way id="4"><nd ref="9"/><nd ref="10"/><nd ref="11"/><nd ref="9"/></way>
 <relation id="1"><member type="way" ref="2" role="outer"/><member type="way" ref="3" role="outer"/>
  <member type="way" ref="4" role="inner"/><tag k="type" v="multipolygon"/><tag k="building" v="yes"/></relation>
</osm>
"""
WALL_RULES = b"- {key: building, value: house, material: wood, thickness_mm: 20, roughness_mm: 0.5}\n"


def _inline() -> list[Parts]:
    from msgs.bus.topics import TOPICS

    order = list(TOPICS)
    return [[bytes([order.index(topic)]), codec.encode_inline(message)] for topic, message in messages()]


def _launches() -> list[Parts]:
    found = [[one] for one in files("launch/*.yaml") if b"nodes:" in one and len(one) < 4000]
    params = b"player: {rate: 2.0}\n"
    extra = [
        [one[0], params if b"player:" in one[0] else b"", b"player.scans=3", b"player.a.b=[1, x]"] for one in found
    ]
    return found + extra


def _backgrounds() -> list[Parts]:
    background = np.ones((3, 4), np.complex64)
    return [[npy(background)], [npy(background, "F")], [npz(a=background)]]


def _cards() -> list[Parts]:
    model = network()[0]
    residual = {
        "name": "r", "sha256": "0", "parameters": 1, "frame": "wall", "neighbours": 4, "source": "truth", "seed": 1,
        "geometry": "ours", "command": "x", "data": {"a": 1}, "metrics": {"f1": 0.5}, "training": {"epochs": [1]},
    }  # fmt: skip
    return [[b"\0", model], [b"\1", msgspec.json.encode(residual)]]


def _images() -> list[Parts]:
    from PIL import Image

    pixels = Image.new("RGB", (6, 4), (200, 10, 10))
    made: list[Parts] = [[jpeg()]]
    for kind in ("PNG", "BMP", "TIFF", "PPM", "WEBP"):
        out = io.BytesIO()
        pixels.save(out, kind)
        made.append([out.getvalue()])
    return made


def _published() -> list[Parts]:
    one, two = np.array([[0.5], [10.0], [0.0]]), np.array([[1.0, 10.0]])
    sim = [npy(np.ones((512, 256), np.complex64)[:1].repeat(512, 0) * 0), npz(L=one, G=one, T=one)]
    real = [npz(Pxx=np.zeros((4, 4), np.int8)), *[npy(two)] * 3]
    return [[b"\1", npy(np.zeros((4, 4), np.complex64)), sim[1]], [b"\0", *real]]


def _datagrams() -> list[Parts]:
    from contrib.boards.dca1000_packets import PAYLOAD_BYTES, datagram

    payload = bytes(range(1, 183)) * 8
    sent = [datagram(1 + at, at * PAYLOAD_BYTES, payload) for at in range(8)]
    wrapped = [datagram((1 << 32) - 2 + at, (1 << 48) - 128 + at * 64, payload[:64]) for at in range(4)]
    report = bytes.fromhex("5aa50a000001aaee")
    return [[b"\1", *sent], [b"\0", sent[0], sent[2], sent[1], sent[1], report], [b"\2", *wrapped]]


def _documents() -> list[Parts]:
    report = (ROOT / "docs/results/tradeoff.json").read_bytes()
    return [
        [b"\0", report if len(report) < 1 << 15 else b"{}"],
        [b"\1", b'{"key": "a", "times_ms": {}}'],
        [b"\3", b'{"pid": 1, "run": "runs/a", "nodes": ["a"]}'],
        [b"\4", b'{"time": "t", "node": "n", "level": "info", "text": "a"}\nx\n'],
    ]


def _tables() -> list[Parts]:
    from lab.full_wave.reflectance import ReflectanceTable

    card = b'{"sha256": "", "bands_ghz": [10.0], "walls": [{"name": "concrete"}]}'
    return [[card, npz(**{name: np.zeros((1, 1)) for name in ReflectanceTable.ARRAYS}), b'{"entry": {}}\n']]


def _keys() -> list[Parts]:
    # a pair made once for nothing else
    public = b'curve\n    public-key = "Yne@$w-vo<fVvi]a<NY6T1ed:M$fCG*[IaLV{hID"\n'
    secret = public + b'    secret-key = "D:)Q[IlAW!ahhC2ac:9*A}h:p?([4%wOTJ%JR%cs"\n'
    return [[secret, public, b"tcp://127.0.0.1:5555"], [secret, public, b"tcp://[::1]:*"]]


def _words() -> list[Parts]:
    words = (
        (0, "speed_mps>5"), (0, "valid==false"), (0, 'reason=="stale"'), (1, "walls.0.normal.1"), (1, "los_points_m"),
        (2, "0:85:5"), (3, "radar/beam,log"), (4, "1 2"), (4, "0.5 nan 3"), (5, "cfar,threshold=0.5,refine"),
        (5, "a=x.onnx,recovery.gate_m=[1,2],geometry=ours"), (6, "auto"), (6, "relay,noise"), (7, "mem_gb=4|x='a'"),
        (8, "a=b|c=d"),
    )  # fmt: skip
    return [[bytes([kind]), word.encode()] for kind, word in words]


def _each(*names: str) -> list[Parts]:
    """Return constants of this module, or files of the checkout where a name has a slash, one part each."""
    found = [files(name) if "/" in name else [globals()[name]] for name in names]
    return [[one] for group in found for one in group if len(one) < 1 << 14]


def _recordings() -> list[Parts]:
    return [[one, bytes([choice])] for one in recordings() for choice in (0, 1, 2, 3)]


def _maps() -> list[Parts]:
    (example,) = files("launch/maps/*.geojson")
    return [[b"\0", example, b""], [b"\0", example, WALL_RULES], [b"\1", OSM, b""]]


def _mappings() -> list[Parts]:
    dbc = (ROOT / "launch/can/mirrorwave.dbc").read_bytes()
    return [[one, dbc, can_frames()] for one in files("launch/can/mirrorwave.yaml")]


def _log_lines() -> list[Parts]:
    record = b'\x1e{"time": "t", "node": "n", "level": "info", "text": "a", "state": "ready"}\n'
    return [[b"plain text\n", record], [record[:20], record[20:]], [b"a\r\nb\x1b[2J\xff\n" + b"x" * 600]]


def _clouds() -> list[Parts]:
    return [
        [b"\0", PLY_CLOUD], [b"\0", PLY_BINARY], [b"\1", PCD], [b"\1", PCD_PACKED], [b"\2", b"0 0 0\n5 5 1\n1 2 3\n"],
        [b"\3", npy(np.arange(12.0).reshape(4, 3))],
    ]  # fmt: skip


def _meshes() -> list[Parts]:
    return [
        [b"\0", OBJ], [b"\1", PLY_MESH], [b"\2", STL_TEXT], [b"\2", STL_BINARY],
        [b"\4", GLTF], *([b"\3", one] for one in files("tests/data/meshes/*.glb") if len(one) < 1 << 13),
    ]  # fmt: skip


def _shards() -> list[Parts]:
    series = b'{"preset": "xband", "grid": {"range_bin_m": 0.2, "range_bins": 4, "azimuth_bins": 4}}'
    splits = b'{"seed": 0, "train": [0], "validation": [1], "test": [], "test_sha256": ""}'
    return [[shard()], [shard(), series], [shard(), series, splits]]


_CLIENT = (
    [b'{"type": "ack", "number": 0}'],
    [b'{"type": "play", "speed": 1.0, "loop": true}', b'{"type": "seek", "index": 3}'],
    [b'{"type": "step", "by": -1}'],
    [b'{"type": "plot", "ids": [1, 2]}', b'{"type": "plot", "ids": []}'],
)
#: What makes the valid inputs of each target.
SEEDS: dict[str, Callable[[], list[Parts]]] = {
    **dict.fromkeys(("wire", "foreign"), wire),
    **dict.fromkeys(("recording", "recover", "replay", "view", "convert"), _recordings),
    **dict.fromkeys(("scene", "plan"), lambda: _each("SCENE", "launch/scenes/*.yaml")),
    "inline": _inline,
    "sigmf": sigmf,
    "map": _maps,
    "mesh": _meshes,
    "launch": _launches,
    "settings": lambda: _each("SETTINGS"),
    "dbc": lambda: [[one, can_frames()] for one in files("launch/can/*.dbc")],
    "mapping": _mappings,
    "can_frames": lambda: [[can_frames()], [can_frames(40)]],
    "target_list": target_lists,
    "detection_table": detection_tables,
    "can_log": can_logs,
    "viewer_client": lambda: [*_CLIENT],
    "log_lines": _log_lines,
    "background": _backgrounds,
    "card": _cards,
    "onnx": lambda: [network()],
    "manifest": lambda: _each("MANIFEST"),
    "cloud": _clouds,
    "image": _images,
    "shard": _shards,
    "xradarnlos": _published,
    "dca1000": lambda: [[bytes([at]), text, bytes(range(256)) * 2] for at, text in enumerate((CFG, CFG_JSON, LUA))],
    "card_datagrams": _datagrams,
    "transients": lambda: [[transients(packed)] for packed in (False, True)],
    "json_files": _documents,
    "reflectance": _tables,
    "keys": _keys,
    "words": _words,
}
