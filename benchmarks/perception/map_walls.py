"""Walls of a map placed by GNSS: what the radar ahead sees of hidden objects with them, by the error of the position.

    python -m benchmarks.perception.map_walls DIR

DIR holds the drives that `benchmarks.perception.two_radars --play DIR` has recorded. The map is that of the scene with
the errors of a poor one (0.2 m, 0.5 deg, a fifth of the walls missing); a position error of its standard deviation is
drawn for each drive, along each axis, with 0.5 deg of heading, and stated.
"""

from __future__ import annotations

import argparse
import json
import math
from collections.abc import Iterator
from pathlib import Path

import msgspec
import numpy as np

from benchmarks.perception.two_radars import FRONT_MAP, FRONT_SETUP, RADARS, Sink
from lab.measures.object_metrics import ObjectScores, object_report
from lab.measures.object_rows import ImageTruth, ScanRow, is_false, scan_row
from mirrorwave.profiles import with_profile
from models.perception.track.view_fusion import RadarView, in_vehicle
from msgs.bus.local import LocalNetwork
from msgs.bus.topics import plain_topic
from msgs.files.shipped import LAUNCH
from msgs.recording.mcap import RecordingReader
from msgs.values.environment import WallPriors
from msgs.values.frames import Pose2
from msgs.values.perception import Peaks, SceneTruth
from msgs.values.units import s_from_ns
from nodes.node import InProcessGraph, load_node
from nodes.process.launch_file import read_launch_file
from sim_player.scene.description import Scene, load_scene
from sim_player.scene.wall_priors import EXACT, POOR, scene_walls
from sim_player.scene.world import vehicle_pose

HEADING_STD_RAD = math.radians(0.5)
TOPICS = (FRONT_SETUP, FRONT_MAP, "perception/front/peaks", "vehicle/state")
#: Name, whether there is a map, whether it is exact, error of the position [m].
CASES = (
    ("no map", False, False, 0.0),
    ("exact map and position", True, True, 0.0),
    ("poor map, position exact", True, False, 0.0),
    ("poor map, position 1 m", True, False, 1.0),
    ("poor map, position 3 m", True, False, 3.0),
)


def walls_at(scene: Scene, stamp_ns: int, place: int, exact: bool, std_m: float) -> WallPriors:
    """Return the walls that a map gives about the vehicle at a time, displaced as one by the error of its position."""
    errors = None if exact else POOR
    rng = np.random.default_rng([6, place])
    (x_m, y_m), turn = rng.standard_normal(2), rng.standard_normal()
    heading_rad = HEADING_STD_RAD if std_m else 0.0
    believed = vehicle_pose(scene, s_from_ns(stamp_ns)) @ Pose2(
        std_m * float(x_m), std_m * float(y_m), heading_rad * float(turn)
    )
    walls = scene_walls(scene, believed, stamp_ns, place, errors)
    stated = EXACT if errors is None else errors
    return msgspec.structs.replace(
        walls,
        walls=tuple(
            msgspec.structs.replace(
                wall,
                offset_std_m=math.hypot(stated.offset_std_m, std_m),
                angle_std_rad=math.hypot(stated.angle_std_rad, heading_rad),
                end_std_m=math.hypot(stated.end_std_m, std_m),
            )
            for wall in walls.walls
        ),
    )


def rows(folder: Path, has_map: bool, exact: bool, std_m: float) -> Iterator[ScanRow]:
    """Yield the rows of all drives with a map."""
    entry = with_profile(read_launch_file(LAUNCH / "process.yaml"), "default").nodes["geometry"]
    for place, path in enumerate(sorted(folder.glob("*.mcap"))):
        if not path.with_suffix(".json").exists():
            continue
        scene = msgspec.structs.replace(load_scene(path.with_suffix(".yaml")), radars={})
        network, sink = LocalNetwork(lossless=True), Sink()
        graph = InProcessGraph(network, {"geometry": load_node(entry.module, entry.params), "sink": sink})
        bus = network.bus("player")
        with RecordingReader(path) as reader:
            truths: list[SceneTruth] = [item.message for item in reader.messages(("sim/truth",))]  # type: ignore[misc]
            for recorded in reader.messages(TOPICS):
                message = recorded.message
                network.advance(max(0, recorded.log_time_ns - network.now_ns))
                if has_map and isinstance(message, Peaks):
                    bus.publish("environment/walls", walls_at(scene, message.stamp_ns, place, exact, std_m))
                bus.publish(plain_topic(recorded.topic), message)
                graph.run(until_ns=network.now_ns)
            graph.run()
        mounted = RADARS["front"].vehicle_from_radar
        frames = {
            frame.stamp_ns: in_vehicle(RadarView(frame, mounted), frame.stamp_ns, None, lambda at_ns: None).frame
            for frame in sink.frames
        }
        for truth, image in zip(truths, json.loads(path.with_suffix(".json").read_text()), strict=True):
            frame = frames.get(truth.stamp_ns)
            objects = () if frame is None else frame.objects
            yield scan_row(place, objects, truth, msgspec.convert(image, list[ImageTruth]))


def main() -> None:
    """Print a line a case."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    folder = parser.parse_args().folder
    for name, has_map, exact, std_m in CASES:
        scans = list(rows(folder, has_map, exact, std_m))
        scores = ObjectScores(scans)
        count = len(scores.places)
        weights = np.random.default_rng(0).multinomial(count, np.full(count, 1.0 / count), 1000)
        report = object_report(scores, weights, 1.0)
        false_a_scan = sum(is_false(item) for row in scans for item in row.reports) / len(scans)
        print(
            f"{name:28} recall {report.recall}  reports {report.reports}  false a scan {false_a_scan:.2f}", flush=True
        )


if __name__ == "__main__":
    main()
