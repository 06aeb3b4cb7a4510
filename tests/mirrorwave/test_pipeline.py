"""A recording fed to the nodes gives the bytes of its player among them, whatever it lacks."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Literal

import msgspec
import numpy as np
import pytest

from mirrorwave.offline import launch_for
from mirrorwave.pipeline import Pipeline, played
from models.perception.chain import ScanView
from msgs.bus.interface import Outgoing, Received
from msgs.bus.local import LocalNetwork
from msgs.recording.mcap import RecordingWriter
from msgs.values.perception import BevFrame
from msgs.values.radar import RadarBeam
from msgs.values.vehicle import VehicleState
from nodes.node import InProcessGraph, Node, load_node
from nodes.player import Params, capture_events, scene_events, scene_player, with_walls
from tests.models.perception.target_lists.street import detections, standing_speeds, street_points

DRIVE, SPAD = "launch/drives/side_street.yaml", "launch/scenes/hidden_car_spad.yaml"
CFAR = ["dense_predictor.method=cfar"]


class Sink(Node):
    """Keeps the views."""

    inputs = ("perception/hidden_objects",)

    def __init__(self) -> None:
        super().__init__()
        self.frames: list[BevFrame] = []

    def step(self, inputs: list[Received], now_ns: int) -> list[Outgoing]:
        self.frames += [received.message for received in inputs]
        return []


def by_nodes(capture: Path, overrides: Sequence[str]) -> list[BevFrame]:
    """The views of the graph's nodes, on the bus of one process and a virtual clock."""
    launch = launch_for(capture, "default", list(overrides))
    nodes = {name: load_node(entry.module, entry.params, name) for name, entry in launch.nodes.items()}
    sink = Sink()
    graph = InProcessGraph(LocalNetwork(), {**nodes, "sink": sink})
    graph.run()
    graph.close()
    return sink.frames


def plain(frame: BevFrame) -> bytes:
    """All of a view, arrays included."""
    return msgspec.msgpack.encode(frame, enc_hook=lambda array: array.tobytes())


def recorded_detections(path: Path) -> Path:
    """Four measurements of a street at 10 m/s, the third of another sensor, vehicle states 40 ms late."""
    with RecordingWriter(path, {}) as writer:
        for scan in range(4):
            stamp_ns = scan * 100_000_000
            message = detections(street_points(), seed=scan, stamp_ns=stamp_ns, scan_id=scan)
            speeds = standing_speeds(message, np.array([10.0, 0.0]))
            sensor = "rear" if scan == 2 else "front"
            message = msgspec.structs.replace(message, radial_speed_mps=speeds, sensor=sensor)
            state = VehicleState(stamp_ns=stamp_ns, speed_mps=10.0)
            for topic, item, late_ns in (("radar/detections", message, 0), ("vehicle/state", state, 40_000_000)):
                writer.write(topic, item, publisher="player", sequence=scan, sent_ns=stamp_ns + late_ns)
    return path


def recorded(
    path: Path,
    scene: str,
    scans: int,
    drop: Sequence[tuple[int, int]] = (),
    pause: int | None = None,
    walls: Literal["none", "noisy"] = "none",
) -> Path:
    """A scene's recording without some beams (scan, index), silent for a second before beam `pause` of scan 1.

    Vehicle states come 40 ms late, and a beam of another radar comes between.
    """
    effects = {} if scene == SPAD else {"chirps_per_beam": 4}
    params = Params(scene=scene, walls=walls, **effects)
    player = scene_player(params)
    late_ns = 0
    with RecordingWriter(path, {}) as writer:
        for number, event in enumerate(with_walls(scene_events(player, scans), player, params)):
            topic, message = event.outgoing
            if isinstance(message, RadarBeam):
                if (message.scan_id, message.beam_index) in drop:
                    continue
                late_ns += 1_000_000_000 * ((message.scan_id, message.beam_index) == (1, pause))
                if (message.scan_id, message.beam_index) == (0, 3):
                    foreign = msgspec.structs.replace(message, samples=np.zeros((4, 100, 2), np.int16))
                    writer.write(topic, foreign, publisher="player", sequence=9999, sent_ns=event.offset_ns + late_ns)
            held_ns = 40_000_000 if isinstance(message, VehicleState) else 0
            writer.write(
                topic, message, publisher="player", sequence=number, sent_ns=event.offset_ns + late_ns + held_ns
            )
    return path


@pytest.mark.slow
@pytest.mark.parametrize(
    ("scene", "change"),
    [
        (DRIVE, {"drop": [(0, 24), (1, 0), (2, 24)]}),
        (DRIVE, {"pause": 12}),
        (DRIVE, {"walls": "noisy"}),
        (SPAD, {"walls": "noisy"}),
    ],
    ids=["beams missing", "silent within a scan", "walls known", "lidar with walls known"],
)
def test_what_is_fed_gives_the_bytes_of_the_player(scene: str, change: dict[str, object], tmp_path: Path) -> None:
    capture = recorded(tmp_path / "capture.mcap", scene, 1 if scene == SPAD else 3, **change)  # type: ignore[arg-type]
    pipeline = Pipeline(launch_for(capture, "default", CFAR))
    views = [found for found in played(capture_events(capture), pipeline) if isinstance(found, ScanView)]
    frames = by_nodes(capture, CFAR)
    assert [plain(view.frame) for view in views] == [plain(frame) for frame in frames]
    assert len(frames) == (1 if scene == SPAD else 3)
    if "pause" in change:
        assert set(range(12, 25)) <= set(views[1].ra_map.missing_beams)
    assert "walls" not in change or scene == SPAD or frames[-1].tracks


def test_detections_give_the_bytes_of_the_nodes(tmp_path: Path) -> None:
    """Those of another sensor are left out of both."""
    capture, overrides = recorded_detections(tmp_path / "street.mcap"), ["detection_peaks.sensor.name=front"]
    pipeline = Pipeline(launch_for(capture, "default", overrides))
    views = [view for view in played(capture_events(capture), pipeline) if isinstance(view, ScanView)]
    frames = by_nodes(capture, overrides)
    assert [plain(view.frame) for view in views] == [plain(frame) for frame in frames]
    assert [frame.scan_id for frame in frames] == [0, 1, 3]
    assert all(view.ra_map is None and len(view.frame.objects) == 1 for view in views)
