"""Every node of the graph, ready to be fuzzed: how it is made, what good peers say to it, what it may remember.

Nodes with a device or a socket have a stand-in at their outermost edge: a CAN bus, libiio, the page's server.
"""

from __future__ import annotations

import functools
import hashlib
import random
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple
from unittest import mock

import can
import msgspec
import numpy as np
from onnx import TensorProto, helper, numpy_helper, save

from contrib.boards import dca1000_radar, detections_radar, phaser_radar
from contrib.boards import dca1000_socket as dca1000
from contrib.boards.dca1000_packets import datagram
from contrib.boards.target_list import TargetListReader
from contrib.imports import recorded_sensors
from contrib.ros2 import ros2_bridge as ros2
from contrib.ros2.ros2_types import type_store
from contrib.two_machines import link
from fuzz.seeds import CFG, GNSS
from models.perception.find.encoding import Encoding
from models.perception.find.onnx_model import ClassScores, ModelCard, ScoresAt, card_path
from models.perception.track.scan_state import MemoryParams
from models.vehicle.can_decoder import CanDecoder
from models.vehicle.hidden_object_list import HiddenObjectList
from msgs.bus.topics import TOPICS
from msgs.files.shipped import shipped_path
from msgs.recording.mcap import RecordingWriter
from msgs.values.camera import CameraImage
from msgs.values.detections import RadarDetections
from msgs.values.diagnostics import LogRecord, NodeStatus, ShedCount, StageTime, TopicCount
from msgs.values.environment import PriorWall, WallPriors
from msgs.values.frames import xy_from_polar
from msgs.values.lidar import LidarSetup, PhotonHistograms, SpadParams
from msgs.values.perception import (
    BevFrame,
    BevGrid,
    HiddenPoint,
    Peaks,
    SceneTruth,
    TruthObject,
    TruthSurface,
    Wall,
)
from msgs.values.radar import (
    ArrayParams,
    BeamGrid,
    RadarBeam,
    RadarParams,
    RadarSetup,
    RangeAzimuthGrid,
    RangeAzimuthMap,
)
from msgs.values.vehicle import VehicleState
from nodes import (
    bev_viewer,
    can_out,
    car_sim,
    dense_predictor,
    detection_peaks,
    geometry,
    lidar_former,
    map_walls,
    player,
    ra_former,
    recorder,
    vehicle_can,
    view_fusion,
)
from nodes.can.bus import CanLink, load_dbc, load_mapping
from nodes.node import Node
from nodes.recording import snapshot_recorder
from nodes.recording.files import as_recorded
from sim_player.car import SimulatedCar
from tests.builders import beam_of, example_map, example_object, example_status, example_track
from tests.fuzz.strategies import Said, Step
from tests.side_sensors import cloud, jpeg

PERIOD_NS = 300_000_000
STREET = "launch/maps/invented_street.geojson"
GRID = RangeAzimuthGrid(range_bins=48, azimuth_bins=64)
DBC, MAPPING = shipped_path("launch/can/mirrorwave.dbc"), shipped_path("launch/can/mirrorwave.yaml")
OUT_DBC = shipped_path("launch/can/mirrorwave_out.dbc")


class Case(NamedTuple):
    """One node: `make(folder, seed, script)` makes it, `seed` for the whims of its stand-in."""

    make: Callable[[Path, int, Sequence[Step]], Node]
    #: What good peers say, in order; scans of it are told again to see that a node has recovered.
    natural: Sequence[Said] = ()
    #: The module with its Params, and parameters that make a node.
    module: str = ""
    good: Callable[[Path], dict[str, Any]] = lambda folder: {}
    #: What good peers say from a scan and a stamp on, of nodes that answer: a used node's last answer to it must be
    #: that of a fresh one but for what it `remembered`.
    talk: Callable[[int, int], list[Said]] | None = None
    remembered: tuple[str, ...] = ()


SETUP = RadarSetup(
    radar=RadarParams(chirps_per_beam=2, samples_per_chirp=512),
    array=ArrayParams(columns=3),
    beams=BeamGrid(azimuth_deg=(-40.0, -20.0, 0.0, 20.0, 40.0)),
)
DIGITAL = RadarSetup(
    radar=RadarParams(chirps_per_beam=1, samples_per_chirp=1024, carrier_hz=77e9),
    array=ArrayParams(columns=3, rows=1, phase_bits=0, steered_ways=1, digital=True),
    beams=BeamGrid(azimuth_deg=(-30.0, 0.0, 30.0)),
    beat_sign=-1,
)


def beam(setup: RadarSetup, scan_id: int, index: int, stamp_ns: int) -> RadarBeam:
    """A tone in noise, the same in every scan."""
    radar, rng = setup.radar, np.random.default_rng(index)
    turns = np.arange(radar.samples_per_chirp) * 40.0 / radar.samples_per_chirp
    tone = 800.0 * np.exp(2j * np.pi * turns)
    noise = rng.normal(scale=20.0, size=(radar.chirps_per_beam, *tone.shape, 2))
    codes = np.stack([tone.real, tone.imag], axis=-1) + noise
    return beam_of(
        setup, index, codes.astype(np.int16), stamp_ns=stamp_ns + index * setup.beam_interval_ns, scan_id=scan_id
    )


def state(stamp_ns: int, scan_id: int = 0) -> VehicleState:
    return VehicleState(stamp_ns=stamp_ns, speed_mps=5.0, yaw_rate_rps=0.1, steering_rad=0.05)


def radar_scan(scan_id: int, stamp_ns: int, setup: RadarSetup = SETUP) -> list[Said]:
    beams = [Said("radar/beam", beam(setup, scan_id, index, stamp_ns)) for index in range(len(setup.beams))]
    return [Said("vehicle/state", state(stamp_ns)), *beams]


def radar_talk(scan_id: int = 0, stamp_ns: int = 0) -> list[Said]:
    """A set-up and two scans."""
    scans = [radar_scan(scan_id + i, stamp_ns + i * PERIOD_NS) for i in range(2)]
    return [Said("radar/setup", SETUP), *scans[0], *scans[1]]


def ra_map(scan_id: int, stamp_ns: int, mode: str = "coherent") -> RangeAzimuthMap:
    rng = np.random.default_rng(3)
    values = rng.standard_normal(GRID.shape) + 1j * rng.standard_normal(GRID.shape)
    values[20, 30] += 40.0
    values[31, 40] -= 30.0
    return example_map(
        values.astype(np.complex64),
        stamp_ns=stamp_ns,
        scan_id=scan_id,
        grid=GRID,
        azimuth_stamp_ns=stamp_ns + np.arange(GRID.azimuth_bins, dtype=np.int64) * 10**6,
        mode=mode,
        missing_beams=(1,),
    )


def map_talk(scan_id: int = 0, stamp_ns: int = 0) -> list[Said]:
    photons = ra_map(scan_id + 1, stamp_ns + PERIOD_NS, "photons")
    return [
        Said("radar/setup", SETUP),
        Said("radar/ra_map", ra_map(scan_id, stamp_ns)),
        Said("radar/ra_map", photons),
        Said("radar/ra_map", ra_map(scan_id + 2, stamp_ns + 2 * PERIOD_NS)),
    ]


def detections(scan_id: int, stamp_ns: int) -> RadarDetections:
    """A facade, and what lies behind it, without covariances."""
    facade = np.stack([np.linspace(5.0, 40.0, 60), np.full(60, -12.0)], axis=1)
    points_m = np.concatenate([facade, facade[20:30] - [0.0, 9.0]])
    count = len(points_m)
    return RadarDetections(
        stamp_ns=stamp_ns,
        scan_id=scan_id,
        range_m=np.hypot(points_m[:, 0], points_m[:, 1]),
        azimuth_rad=np.arctan2(points_m[:, 1], points_m[:, 0]),
        covariance=np.zeros((count, 2, 2)),
        radial_speed_mps=np.full(count, -5.0),
        snr_db=np.full(count, 20.0),
    )


def detections_talk(scan_id: int = 0, stamp_ns: int = 0) -> list[Said]:
    out: list[Said] = []
    for scan in range(3):
        at_ns = stamp_ns + scan * PERIOD_NS
        out += [Said("vehicle/state", state(at_ns)), Said("radar/detections", detections(scan_id + scan, at_ns))]
    return out


SPAD = LidarSetup(
    spad=SpadParams(bins=32, measurement_time_s=1e-4),
    grid=RangeAzimuthGrid(range_bins=24, azimuth_bins=4, range_bin_m=0.3),
)


def lidar_talk(scan_id: int = 0, stamp_ns: int = 0) -> list[Said]:
    counts = np.random.default_rng(5).integers(0, 20, (4, 32), dtype=np.uint32)
    counts[:, 12] += 200
    histograms = PhotonHistograms(
        stamp_ns=stamp_ns,
        scan_id=scan_id,
        counts=counts.astype("<u4"),
        azimuth_stamp_ns=stamp_ns + np.arange(4, dtype=np.int64) * 10**5,
    )
    return [Said("lidar/setup", SPAD), Said("lidar/histograms", histograms)]


def peaks(scan_id: int, stamp_ns: int) -> Peaks:
    """A facade ahead, a vehicle before it and images behind it, as a radar sees them."""
    facade = [(20.0, y) for y in np.linspace(-10.0, 10.0, 9)]
    points_m = np.array([*facade, (12.0, -12.0), (12.0, -11.0), (27.0, -9.0), (27.0, -7.0), (28.0, -8.0)])
    count = len(points_m)
    return Peaks(
        stamp_ns=stamp_ns,
        scan_id=scan_id,
        range_m=np.hypot(*points_m.T),
        azimuth_rad=np.arctan2(points_m[:, 1], points_m[:, 0]),
        score=np.full(count, 0.8),
        path_class=(np.arange(count) >= count - 3).astype(np.uint8),
        covariance=np.tile(np.diag([0.0036, 0.0004]), (count, 1, 1)),
        peak_stamp_ns=stamp_ns + np.arange(count, dtype=np.int64) * 10**6,
        snr_db=np.full(count, 25.0),
        sensitivity_db=90.0,
        faults=("spurs",),
    )


def no_peaks(scan_id: int, stamp_ns: int) -> Peaks:
    one = peaks(scan_id, stamp_ns)
    columns = ("range_m", "azimuth_rad", "score", "path_class", "covariance", "peak_stamp_ns", "snr_db")
    return msgspec.structs.replace(one, **{name: getattr(one, name)[:0] for name in columns})


def walls(stamp_ns: int) -> WallPriors:
    """Walls of a map: on the facade, and beside it."""
    stds = {"offset_std_m": 0.1, "angle_std_rad": 0.01, "end_std_m": 0.5}
    ends = (((20.1, -12.0), (20.1, 14.0)), ((5.0, 15.0), (25.0, 15.0)))
    return WallPriors(stamp_ns=stamp_ns, source="map", walls=tuple(PriorWall(ends_m=two, **stds) for two in ends))


def gnss_talk(scan_id: int = 0, stamp_ns: int = 0) -> list[Said]:
    poses = (msgspec.structs.replace(GNSS, stamp_ns=stamp_ns + at * PERIOD_NS) for at in range(3))
    return [Said("vehicle/gnss", pose) for pose in poses]


def peaks_talk(scan_id: int = 0, stamp_ns: int = 0) -> list[Said]:
    out: list[Said] = []
    for scan in range(4):
        at_ns = stamp_ns + scan * PERIOD_NS
        out += [Said("vehicle/state", state(at_ns + ms * 10**6)) for ms in (0, 100, 200)]
        out.append(Said("environment/walls", walls(at_ns)))
        out.append(Said("perception/peaks", peaks(scan_id + scan, at_ns)))
    return [*out, Said("perception/peaks", no_peaks(scan_id + 4, stamp_ns + 4 * PERIOD_NS))]


def view(scan_id: int, stamp_ns: int) -> BevFrame:
    covariance = ((1.0, 0.1), (0.1, 2.0))
    grid = BevGrid(rows=6, columns=5)
    return BevFrame(
        stamp_ns=stamp_ns,
        scan_id=scan_id,
        walls=(Wall(normal=(-1.0, 0.0), offset_m=20.0, ends_m=((20.0, -10.0), (20.0, 10.0)), inliers=9),),
        points=(HiddenPoint(x_m=13.0, y_m=-9.0, score=0.5, image_x_m=27.0, image_y_m=-9.0, wall=0),),
        objects=tuple(
            example_object(
                id=number, x_m=13.0 + number, y_m=-9.0, yaw_rad=0.1, cov_m2=covariance, stamp_ns=stamp_ns, points=3
            )
            for number in (1, 2)
        ),
        tracks=(
            example_track(
                x_m=13.0,
                y_m=-9.0,
                velocity_y_mps=5.0,
                cov_m2=covariance,
                time_to_appear_s=1.5,
                velocity_cov_m2ps2=covariance,
                existence=0.9,
                object_class="car",
            ),
        ),
        los_points_m=xy_from_polar(np.array([20.0, 21.0]), np.array([0.0, 0.1])).astype(np.float32),
        grid=grid,
        visibility=np.full((6, 5), 2, np.uint8),
        ego=state(stamp_ns),
        flags=("incoherent",),
    )


def truth(scan_id: int, stamp_ns: int) -> SceneTruth:
    return SceneTruth(
        stamp_ns=stamp_ns,
        scan_id=scan_id,
        los_points_m=np.zeros((2, 3), np.float32),
        mirrored_points_m=np.ones((1, 3), np.float32),
        hidden_points_m=np.ones((1, 3), np.float32),
        hidden_object=np.zeros(1, np.int32),
        objects=(TruthObject(id=1, object_class="car", x_m=13.0, y_m=-9.0, length_m=4.0, width_m=2.0, yaw_rad=0.0),),
        surfaces=(TruthSurface(role="relay", material="brick", polyline_m=((20.0, -10.0), (20.0, 10.0))),),
    )


def status(stamp_ns: int) -> NodeStatus:
    count = TopicCount(topic="radar/beam", messages=25, bytes=10**6, lost=1)
    return example_status(
        stamp_ns=stamp_ns,
        node="ra_former",
        pid=7,
        uptime_s=1e-9 * stamp_ns,
        stages=(StageTime(name="beam", count=2, last_ms=1.0, mean_ms=1.0, max_ms=2.0, samples_ms=(1.0, 2.0)),),
        received=(count,),
        published=(msgspec.structs.replace(count, topic="radar/ra_map"),),
        shed=(ShedCount(what="scan", reason="behind", count=1),),
    )


def all_talk(scan_id: int = 0, stamp_ns: int = 0) -> list[Said]:
    """A message or more of every topic."""
    out = [Said("lidar/setup", SPAD), *radar_talk(scan_id, stamp_ns), *lidar_talk(scan_id, stamp_ns)]
    for scan in range(scan_id, scan_id + 2):
        at_ns = stamp_ns + scan * PERIOD_NS
        out += [
            Said("radar/ra_map", ra_map(scan, at_ns)),
            Said("perception/peaks", peaks(scan, at_ns)),
            Said("perception/hidden_objects", view(scan, at_ns)),
            Said("environment/walls", walls(at_ns)),
            *gnss_talk(scan, at_ns)[:1],
            Said("sim/truth", truth(scan, at_ns)),
            Said("lidar/points", cloud(stamp_ns=at_ns, scan_id=scan)),
            Said("camera/image", CameraImage.of(jpeg(), stamp_ns=at_ns, image_id=scan)),
            Said("diagnostics/node", status(at_ns)),
            Said("log", LogRecord(stamp_ns=at_ns, node="ra_former", level="INFO", text="ready")),
        ]
    return out


def said_on(topics: Sequence[str], talk: Sequence[Said]) -> list[Said]:
    return [said for said in talk if said.topic in topics]


# CAN

FAULTS: tuple[Exception, ...] = (
    can.CanOperationError("interface is down", error_code=100),
    can.CanError("frame cannot be read"),
    OSError(5, "no device"),
    ValueError("no frame"),
)


class WhimsicalBus:
    """A CAN bus that gives any frame a bus can carry, and fails now and then."""

    def __init__(self, seed: int) -> None:
        self._random = random.Random(seed)
        self._car = SimulatedCar(*databases()[:2])

    @property
    def state(self) -> can.BusState:
        return self._random.choice((can.BusState.ACTIVE, can.BusState.ACTIVE, can.BusState.ERROR))

    def recv(self, timeout: float) -> can.Message | None:
        whim = self._random
        if whim.random() < 0.5:
            return None
        if whim.random() < 0.1:
            raise whim.choice(FAULTS)
        if whim.random() < 0.5:
            frames = self._car.frames(state(self._car.due_ns()))
            if frames:
                stamp_s = whim.choice((0.0, 1e-9 * self._car.due_ns()))
                one = frames[0]
                return can.Message(
                    timestamp=stamp_s, arbitration_id=one.arbitration_id, data=one.data, is_extended_id=False
                )
        return can.Message(
            timestamp=whim.choice((0.0, 1.5, -3.0, 1e9, 1e18, 1e300, float("nan"), float("inf"))),
            arbitration_id=whim.choice((0x100, 0x101, 0, 0x7FF, 0x600, 0x701, 0x702)),
            data=whim.randbytes(whim.choice((0, 1, 5, 7, 8))),
            is_extended_id=whim.random() < 0.2,
            is_error_frame=whim.random() < 0.1,
            is_remote_frame=whim.random() < 0.1,
        )

    def send(self, frame: can.Message) -> None:
        if self._random.random() < 0.2:
            raise self._random.choice(FAULTS)

    def shutdown(self) -> None:
        if self._random.random() < 0.2:
            raise OSError(9, "closed already")


def whimsical_link(seed: int) -> CanLink:
    whim = random.Random(seed)

    def opened(params: Any) -> Any:
        if whim.random() < 0.3:
            raise whim.choice(FAULTS)
        return WhimsicalBus(seed + whim.randrange(99))

    return CanLink(can_out.Params(interface="virtual", channel="stub"), opened)


def make_vehicle_can(folder: Path, seed: int, script: Sequence[Step]) -> Node:
    source: vehicle_can.FrameSource = vehicle_can.LiveSource(whimsical_link(seed))
    if seed % 3 == 0:
        source = vehicle_can.LogSource(log_frames(seed), 10.0 ** random.Random(seed).uniform(-6.0, 6.0))
    return vehicle_can.VehicleCanNode(decoder(), source, random.Random(seed).choice((0.0, -1.0, 1e6)))


def make_detections_radar(folder: Path, seed: int, script: Sequence[Step]) -> Node:
    params = detections_radar.Params(interface="virtual", clock_offset_s=random.Random(seed).choice((0.0, -1.0, 1e6)))
    reader = TargetListReader(load_dbc(shipped_path(params.dbc)), params.radar)
    return detections_radar.DetectionsRadarNode(reader, vehicle_can.LiveSource(whimsical_link(seed)), params)


def log_frames(seed: int) -> Any:
    """Frames of a log, whose stamps are whatever it says, until it cannot be read on."""
    bus = WhimsicalBus(seed)
    yield vehicle_can.LogFrame(can.Message(timestamp=5.0), 5 * 10**9)
    for _ in range(seed % 7 + 3):
        try:
            frame = bus.recv(0.0)
        except (can.CanError, OSError) as error:
            raise ValueError(f"log: cannot be read on: {error}") from None
        except ValueError:
            continue
        if frame is not None:
            yield vehicle_can.LogFrame(frame, vehicle_can.frame_stamp_ns(frame))


@functools.cache
def databases() -> tuple[Any, Any, Any]:
    return load_dbc(DBC), load_mapping(MAPPING), load_dbc(OUT_DBC)


def decoder() -> Any:
    return CanDecoder(*databases()[:2])


def make_can_out(folder: Path, seed: int, script: Sequence[Step]) -> Node:
    encoder = HiddenObjectList(databases()[2])
    return can_out.CanOut(can_out.Outlet(whimsical_link(seed)), encoder, 10**9, by_arrival=seed % 2 == 0)


def make_car_sim(folder: Path, seed: int, script: Sequence[Step]) -> Node:
    return car_sim.CarSim(whimsical_link(seed), SimulatedCar(*databases()[:2]), state(0))


# sensors


class WhimsicalDevice:
    """A radar that is lost now and then, and gives bursts that are none."""

    setup = SETUP

    def __init__(self, seed: int) -> None:
        self._random = random.Random(seed)

    def _touch(self) -> None:
        if self._random.random() < 0.1:
            raise ConnectionError("cn0566: no longer answers")

    def open(self) -> None:
        self._touch()

    def steer(self, beam_index: int) -> None:
        self._touch()

    def burst(self) -> np.ndarray:
        self._touch()
        if self._random.random() < 0.1:
            raise ValueError("a burst of 3 samples")
        return np.full((2, 512, 2), self._random.choice((-32768, 0, 32767)), np.int16)

    def close(self) -> None:
        """Nothing to let go of."""


class WhimsicalCard:
    """A capture card that is lost now and then, and whose datagrams are lost, foreign or of another recording."""

    def __init__(self, seed: int) -> None:
        self._random = random.Random(seed)
        self._at = 0
        self.counts = dca1000.LinkCounts()

    def open(self) -> None:
        if self._random.random() < 0.3:
            raise self._random.choice([ConnectionError("dca1000: gone"), ValueError("dca1000: refuses")])
        self._at = 0

    def take(self) -> list[tuple[bytes, int]]:
        return [(self._datagram(), 1000) for _ in range(self._random.randrange(4))]

    def _datagram(self) -> bytes:
        self._at += self._random.choice((1, 1, 1, 1, 1, 1, 2, 9, -3))
        if self._random.random() < 0.1:
            return self._random.randbytes(self._random.randrange(40))
        return datagram(1 + self._at, 64 * self._at, self._random.randbytes(64))

    def reports(self) -> list[str]:
        return self._random.choice(([], [], [], ["lane buffer full"], ["recording completed"]))

    def close(self) -> None:
        """Nothing to let go of."""


def card_params(folder: Path) -> dict[str, Any]:
    """Parameters that name a configuration."""
    (folder / "chirps.cfg").write_bytes(CFG)
    return {"config": str(folder / "chirps.cfg")}


def make_dca1000_radar(folder: Path, seed: int, script: Sequence[Step]) -> Node:
    params = dca1000_radar.Params(**card_params(folder))
    return dca1000_radar.Dca1000Radar(params, lambda _, lanes: WhimsicalCard(seed))


def make_radar_driver(folder: Path, seed: int, script: Sequence[Step]) -> Node:
    scans = (None, 1, 3)[seed % 3]
    return phaser_radar.RadarDriver(WhimsicalDevice(seed), phaser_radar.Params(scans=scans))


def make_player(folder: Path, seed: int, script: Sequence[Step]) -> Node:
    """Plays a recording of what the peers said; one that holds nothing is refused, a good one is played then."""
    path = write_recording(folder, [one for step in script for one in step.inputs] or None)
    try:
        return player.create(player.Params(capture=str(path), rate=(1.0, 1e-3, 1e6)[seed % 3]))
    except ValueError as error:
        if "holds none of" not in str(error):
            raise
        return player.create(player.Params(capture=str(write_recording(folder, None))))


def write_recording(folder: Path, messages: Sequence[Any] | None) -> Path:
    path = folder / f"capture{len(list(folder.iterdir()))}.mcap"
    with RecordingWriter(path, {}) as writer:
        if messages is None:
            for said in all_talk():
                writer.write(said.topic, said.message, publisher="p", sequence=0, sent_ns=10**9)
        for received in messages or ():
            writer.write_encoded(as_recorded(received))
    return path


# everything else


@functools.cache
def tiny_network() -> Path:
    """A network of one matrix product, 48x64 cells, and its card."""
    rng = np.random.default_rng(1)
    constants = [
        numpy_helper.from_array(rng.standard_normal((2, 5, 1, 1)).astype(np.float32), "mix"),
        numpy_helper.from_array(rng.standard_normal((16, 64)).astype(np.float32), "spread"),
    ]
    nodes = [
        helper.make_node("Conv", ["map", "mix"], ["mixed"]),
        helper.make_node("MatMul", ["mixed", "spread"], ["logits"]),
        helper.make_node("Sigmoid", ["logits"], ["scores"]),
    ]
    ends = [
        [helper.make_tensor_value_info(name, TensorProto.FLOAT, shape)]
        for name, shape in (("map", (1, 5, 32, 16)), ("scores", (1, 2, 32, 64)))
    ]
    graph = helper.make_graph(nodes, "tiny", *ends, constants)
    path = Path(tempfile.mkdtemp(prefix="mw")) / "tiny.onnx"
    save(helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8), path)
    best = ClassScores(precision=1.0, recall=1.0, f1=1.0)
    card = ModelCard(
        name="tiny",
        sha256=hashlib.sha256(path.read_bytes()).hexdigest(),
        parameters=1,
        encoding=Encoding(range_bins=32, columns=16),
        grid=GRID,
        input_shape=(1, 5, 32, 16),
        output_shape=(1, 2, 32, 64),
        threshold=0.6,
        scores=(ScoresAt(threshold=0.6, macro_f1=1.0, los=best, mirrored=best),),
        data={},
        training={},
    )
    card_path(path).write_bytes(msgspec.json.encode(card))
    return path


def make_network(folder: Path, seed: int, script: Sequence[Step]) -> Node:
    refine: Any = ("pursuit", "none")[seed % 2]
    return dense_predictor.create(
        dense_predictor.Params(model=str(tiny_network()), refine=refine, flip_test=seed % 8 > 3)
    )


def make_cfar(folder: Path, seed: int, script: Sequence[Step]) -> Node:
    return dense_predictor.create(dense_predictor.Params(method="cfar"))


def make_ra_former(folder: Path, seed: int, script: Sequence[Step]) -> Node:
    mode = ("coherent", "coherent", "magnitude", "welch")[seed % 4]
    return ra_former.create(ra_former.Params(mode=mode))


def make_lidar_former(folder: Path, seed: int, script: Sequence[Step]) -> Node:
    return lidar_former.create(lidar_former.Params())


def rig(folder: Path) -> Path:
    """A directory with two clouds and three images, one of each no such thing."""
    for name, data in (("0.bin", bytes(160)), ("1.bin", b"x"), ("0.jpg", jpeg()), ("1.jpg", b"x"), ("2.jpg", jpeg())):
        (folder / name).write_bytes(data)
    return folder


def make_recorded_sensors(folder: Path, seed: int, script: Sequence[Step]) -> Node:
    rate_hz = (0.5, 10.0, 1e3, 1e6)[seed % 4]
    params = recorded_sensors.Params(sources=(str(rig(folder)),), file_rate_hz=rate_hz, loop=seed % 8 > 3)
    return recorded_sensors.create(params)


def make_detection_peaks(folder: Path, seed: int, script: Sequence[Step]) -> Node:
    return detection_peaks.create(detection_peaks.Params())


def make_map_walls(folder: Path, seed: int, script: Sequence[Step]) -> Node:
    return map_walls.create(map_walls.Params(map=STREET))


def make_geometry(folder: Path, seed: int, script: Sequence[Step]) -> Node:
    grid = geometry.Grid(rows=12, columns=10, cell_m=4.0)
    memory = MemoryParams(tracking=seed % 2 == 1)
    return geometry.create(geometry.Params(grid=grid, memory=memory))


def make_view_fusion(folder: Path, seed: int, script: Sequence[Step]) -> Node:
    memory = MemoryParams(tracking=seed % 2 == 1)
    return view_fusion.create(view_fusion.Params(radars=("left", "right"), memory=memory))


def views_talk(scan_id: int = 0, stamp_ns: int = 0) -> list[Said]:
    """Two radars, the left one of which is silent in the end."""
    out: list[Said] = []
    for scan in range(4):
        at_ns = stamp_ns + scan * PERIOD_NS
        out.append(Said("vehicle/state", state(at_ns)))
        for radar in ("left", "right") if scan < 3 else ("right",):
            out.append(Said(f"perception/{radar}/peaks", peaks(scan_id + scan, at_ns)))
            out.append(Said(f"perception/{radar}/hidden_objects", view(scan_id + scan, at_ns)))
    return out


class PageStandIn:
    """In the place of the page's server: renders whatever hangs on the board, as a reader would."""

    alive, port = True, 8765
    url = "http://127.0.0.1:0"

    def __init__(self, board: Any, **options: Any) -> None:
        self._board, self._seen = board, dict[str, int]()
        self.rendered: dict[str, tuple[str | bytes, ...]] = {}
        board.on_post = self.look

    def look(self) -> None:
        for kind, post in self._board.newer(self._seen).items():
            self._seen[kind] = post.version
            self.rendered[kind] = self._board.messages(kind, post)
            for text in self.rendered[kind]:
                assert isinstance(text, bytes) or msgspec.json.decode(text)["type"]

    def close(self) -> None:
        """No thread to end."""


def make_viewer(folder: Path, seed: int, script: Sequence[Step]) -> Node:
    with mock.patch.object(bev_viewer, "ViewerServer", PageStandIn):
        return bev_viewer.create(bev_viewer.Params())


def make_recorder(folder: Path, seed: int, script: Sequence[Step]) -> Node:
    split_bytes, max_parts = (None, None) if seed % 2 else (20_000, 3)
    return recorder.create(
        recorder.Params(path=str(folder / "out.mcap"), raw=True, split_bytes=split_bytes, max_parts=max_parts)
    )


def make_snapshots(folder: Path, seed: int, script: Sequence[Step]) -> Node:
    limit = (1 << 20, 5000, 1)[seed % 3]
    node = snapshot_recorder.SnapshotRecorder(
        recorder.Params(path=str(folder / "shot.mcap"), raw=True, snapshot_s=1.0), limit
    )
    if seed % 2:
        node.trigger()
    return node


def make_ros2(folder: Path, seed: int, script: Sequence[Step]) -> Node:
    """The bridge on a link without a network, which gives it bytes of any kind."""
    stamps: Any = ("acquisition", "arrival")[seed % 2]
    heard = {"detections": ros2.DetectionParams(), "odometry": ros2.OdometryParams()} if seed % 4 > 1 else {}
    params = ros2.Params(stamps=stamps, **heard)  # type: ignore[arg-type]
    return ros2.Ros2Bridge(params, WhimsicalRos2Link(seed), type_store())  # type: ignore[arg-type]


class WhimsicalRos2Link:
    """A link whose readers take nothing now and then, and whose publishers send anything."""

    descriptor = -1

    def __init__(self, seed: int) -> None:
        self._random = random.Random(seed)

    def writer(self, topic: Any) -> Any:
        whim = self._random
        return mock.Mock(topic=topic, is_wanted=True, write=lambda cdr: whim.random() < 0.9, mismatch=lambda: "")

    def reader(self, topic: Any) -> Any:
        whim = self._random
        take: Callable[[], list[bytes]] = lambda: [whim.randbytes(whim.randrange(200))] * whim.randrange(3)  # noqa: E731
        return mock.Mock(take=take, mismatch=lambda: whim.choice(("", "durability")))

    def clear(self) -> None:
        """Nothing to clear."""

    def close(self) -> None:
        """No domain to leave."""


LINK = {"bind": "tcp://127.0.0.1:*", "export": tuple(TOPICS), "insecure": True}


def make_link(folder: Path, seed: int, script: Sequence[Step]) -> Node:
    """A link that exports all topics on this machine, and every other time imports from a peer that is not there."""
    peers = {"peer": link.Peer(address="tcp://127.0.0.1:9", topics=("radar/beam",))} if seed % 2 else {}
    return link.create(link.Params(**LINK, connect=peers))  # type: ignore[arg-type]


CASES: dict[str, Case] = {
    "player": Case(
        make_player, all_talk(), "nodes.player", lambda folder: {"capture": str(write_recording(folder, None))}
    ),
    "dca1000_radar": Case(make_dca1000_radar, (), "contrib.boards.dca1000_radar", card_params),
    "radar_driver": Case(make_radar_driver, (), "contrib.boards.phaser_radar"),
    "ra_former": Case(
        make_ra_former,
        [*radar_talk(), Said("radar/setup", DIGITAL), *radar_scan(9, 10**10, DIGITAL)],
        "nodes.ra_former",
        talk=radar_talk,
    ),
    "lidar_former": Case(make_lidar_former, lidar_talk(), "nodes.lidar_former", talk=lidar_talk),
    "detection_peaks": Case(make_detection_peaks, detections_talk(), "nodes.detection_peaks", talk=detections_talk),
    "dense_predictor": Case(
        make_network, map_talk(), "nodes.dense_predictor", lambda folder: {"model": str(tiny_network())}, map_talk
    ),
    "dense_predictor (cfar)": Case(
        make_cfar, map_talk(), "nodes.dense_predictor", lambda folder: {"method": "cfar"}, map_talk
    ),
    "geometry": Case(make_geometry, peaks_talk(), "nodes.geometry", talk=peaks_talk, remembered=("tracks",)),
    "map_walls": Case(make_map_walls, gnss_talk(), "nodes.map_walls", lambda folder: {"map": STREET}, gnss_talk),
    "view_fusion": Case(
        make_view_fusion, views_talk(), "nodes.view_fusion", lambda folder: {"radars": ["left", "right"]}, views_talk
    ),
    "recorded_sensors": Case(
        make_recorded_sensors, (), "contrib.imports.recorded_sensors", lambda folder: {"sources": [str(rig(folder))]}
    ),
    "detections_radar": Case(
        make_detections_radar, (), "contrib.boards.detections_radar", lambda folder: {"interface": "virtual"}
    ),
    "vehicle_can": Case(make_vehicle_can, (), "nodes.vehicle_can", lambda folder: {"interface": "virtual"}),
    "link": Case(make_link, all_talk(), "contrib.two_machines.link", lambda folder: dict(LINK)),
    "can_out": Case(
        make_can_out,
        [Said("perception/hidden_objects", view(i, i * PERIOD_NS)) for i in range(3)],
        "nodes.can_out",
        lambda folder: {"interface": "virtual"},
    ),
    "car_sim": Case(make_car_sim, (), "nodes.car_sim", lambda folder: {"interface": "virtual"}),
    "ros2": Case(make_ros2, all_talk(), "contrib.ros2.ros2_bridge"),
    "bev_viewer": Case(make_viewer, all_talk(), "nodes.bev_viewer"),
    "recorder": Case(make_recorder, all_talk(), "nodes.recorder", lambda folder: {"path": str(folder / "out.mcap")}),
    "snapshot_recorder": Case(
        make_snapshots,
        all_talk(),
        "nodes.recorder",
        lambda folder: {"path": str(folder / "out.mcap"), "snapshot_s": 1.0},
    ),
}
