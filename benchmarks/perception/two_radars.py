"""Radars at the left and right front corner of a car against one that looks ahead, on drawn drives to a T-junction.

    python -m benchmarks.perception.two_radars --play DIR --drives 12 --seed 482
    python -m benchmarks.perception.two_radars --score DIR

The first command records what each of three radars sees on its own, the second joins views and scores them: one radar
ahead, two at the corners, and two of which the left one is silent from the middle of the drive on. Asked for is what a
mirror shows to any of the three and none has in direct sight.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterator, Sequence
from pathlib import Path

import msgspec
import numpy as np

from lab.measures.object_metrics import ObjectScores, object_report
from lab.measures.object_rows import FALSE_M, ImageTruth, ReportRow, ScanRow, is_false, scan_row
from mirrorwave.pipeline import Pipeline, for_sensors
from mirrorwave.profiles import with_profile
from models.perception.track.odometry import MAX_GAP_S
from msgs.bus.interface import Outgoing, Received
from msgs.bus.local import LocalNetwork
from msgs.bus.topics import sensor_topic
from msgs.files.shipped import LAUNCH
from msgs.recording.mcap import RecordingReader, RecordingWriter
from msgs.values.frames import Mounting
from msgs.values.perception import BevFrame, SceneTruth
from msgs.values.units import ns_from_s, s_from_ns
from nodes.node import InProcessGraph, Node
from nodes.player import scene_events
from nodes.process.launch_file import read_launch_file
from nodes.view_fusion import Params, create
from sim_player.paths.truth import object_images
from sim_player.rig import RadarRig
from sim_player.scene.description import Ego, Scene, SceneObject, check_scene, load_scene, scene_to_yaml

SCANS = 6
#: Heading of the corner radars.
YAW_DEG = 35.0
RADARS = {
    "front": Mounting(),
    "left": Mounting(y_m=0.8, yaw_deg=YAW_DEG),
    "right": Mounting(y_m=-0.8, yaw_deg=-YAW_DEG),
}
#: Kept of the radar ahead, to see its scans again with walls from a map (`map_walls`).
FRONT_SETUP, FRONT_MAP = "radar/front/setup", "radar/front/ra_map"
TOPICS = ("perception/peaks", "perception/hidden_objects")


def play(out: Path, drives: int, seed: int) -> None:
    """Record views, peaks, vehicle states and truth of drawn drives to a junction, a file each."""
    out.mkdir(parents=True, exist_ok=True)
    for index in range(drives):
        scene = drawn_junction(np.random.default_rng([seed, index]), index)
        check_scene(scene)
        play_drive(RadarRig(scene, seed=index, effects="basic"), out / f"{index:04d}")
        print(f"drive {index}", flush=True)


def drawn_junction(rng: np.random.Generator, index: int) -> Scene:
    """Return the shipped T-junction with walls, speeds and hidden vehicles of its own on either side."""
    scene = load_scene(LAUNCH / "scenes" / "two_front_corners.yaml")
    across_m, ahead_m = rng.uniform(24.0, 32.0), rng.uniform(11.0, 15.0)
    sides = [(1.0, rng.uniform(4.0, 6.0)), (-1.0, rng.uniform(4.0, 6.0))]
    tilt_m = rng.uniform(-1.5, 1.5)
    facade = msgspec.structs.replace(
        scene.surfaces[0], polyline_m=((across_m - tilt_m, -18.0), (across_m + tilt_m, 18.0))
    )
    houses = [
        msgspec.structs.replace(
            scene.surfaces[1], polyline_m=((5.0, side * y_m), (ahead_m, side * y_m), (ahead_m, side * 24.0))
        )
        for side, y_m in sides
    ]
    objects = [
        SceneObject(
            class_=("car", "van", "truck")[int(rng.integers(3))],
            x_m=float(rng.uniform(ahead_m + 3.0, across_m - 5.0)),
            y_m=float(side * rng.uniform(12.0, 20.0)),
            yaw_deg=-90.0 * side,
            speed_mps=float(rng.uniform(0.0, 4.0)),
        )
        for side, _ in sides
        if rng.random() < 0.85
    ]
    return msgspec.structs.replace(
        scene,
        name=f"junction_{index}",
        radars=RADARS,
        surfaces=(facade, *houses),
        objects=tuple(objects),
        ego=Ego(speed_mps=float(rng.uniform(0.0, 3.0))),
    )


def play_drive(rig: RadarRig, path: Path) -> None:
    """Record one drive as `path`.mcap, and what mirrors show of its objects as `path`.json."""
    launch = with_profile(for_sensors(read_launch_file(LAUNCH / "process.yaml"), tuple(RADARS)), "default")
    pipeline = Pipeline(launch)
    heard = [sensor_topic(topic, radar) for topic in TOPICS for radar in RADARS]
    listener = pipeline.listener([*heard, FRONT_MAP])
    images = []
    with RecordingWriter(path.with_suffix(".mcap"), {"scene": rig.scene.name}) as writer:
        for event in scene_events(rig, SCANS):
            topic, message = event.outgoing
            if isinstance(message, SceneTruth):
                images.append(images_of(rig, message))
                writer.write(topic, message, publisher="player", sent_ns=event.offset_ns)
                continue
            pipeline.feed(message, event.offset_ns, topic)
            if topic in ("vehicle/state", FRONT_SETUP):
                writer.write(topic, message, publisher="player", sent_ns=event.offset_ns)
            for received in listener.receive(0.0):
                writer.write(received.topic, received.message, publisher="graph", sent_ns=event.offset_ns)
    path.with_suffix(".yaml").write_text(scene_to_yaml(rig.scene))
    path.with_suffix(".json").write_text(json.dumps(images))


def images_of(rig: RadarRig, truth: SceneTruth) -> list[dict[str, object]]:
    """Return what any of the radars sees of each object, as `ImageTruth`."""
    time_s = s_from_ns(truth.stamp_ns - rig.stamp_ns(0))
    each = [object_images(player.setup, player.paths(time_s), len(truth.objects)) for player in rig.players.values()]
    direct = np.any([item.direct for item in each], axis=0)
    mirrored = np.any([item.mirrored for item in each], axis=0)
    snr, single = (np.max([getattr(item, name) for item in each], axis=0) for name in ("snr_db", "single_snr_db"))
    return [
        {
            "direct": bool(direct[at]),
            "mirrored": bool(mirrored[at]),
            "snr_db": float(snr[at]) if np.isfinite(snr[at]) else None,
            "single_snr_db": float(single[at]) if np.isfinite(single[at]) else None,
        }
        for at in range(len(truth.objects))
    ]


class Sink(Node):
    """Keeps the joined views."""

    inputs = ("perception/hidden_objects",)
    wants_all = True

    def __init__(self) -> None:
        super().__init__()
        self.frames: list[BevFrame] = []

    def step(self, inputs: list[Received], now_ns: int) -> list[Outgoing]:
        """Keep them."""
        self.frames += [item.message for item in inputs if isinstance(item.message, BevFrame)]
        return []


def joined(path: Path, radars: Sequence[str], silent: str = "", from_ns: int = 0) -> list[BevFrame]:
    """Return the views of some radars of a drive; those of `silent` end at a stamp."""
    network, sink = LocalNetwork(lossless=True), Sink()
    graph = InProcessGraph(network, {"view_fusion": create(Params(radars=tuple(radars))), "sink": sink})
    bus = network.bus("player")
    topics = [sensor_topic(topic, radar) for topic in TOPICS for radar in radars]
    with RecordingReader(path) as reader:
        for recorded in reader.messages((*topics, "vehicle/state")):
            if silent and f"/{silent}/" in recorded.topic and recorded.message.stamp_ns >= from_ns:  # type: ignore[attr-defined]
                continue
            graph.run(until_ns=recorded.log_time_ns - 1)
            network.advance(max(0, recorded.log_time_ns - network.now_ns))
            bus.publish(recorded.topic, recorded.message)
            graph.run(until_ns=network.now_ns)
        graph.run(until_ns=network.now_ns + ns_from_s(MAX_GAP_S))
    return sink.frames


def rows(folder: Path, radars: Sequence[str], silent: str = "", last_half: bool = False) -> Iterator[ScanRow]:
    """Yield the rows of all drives."""
    for place, path in enumerate(sorted(folder.glob("*.mcap"))):
        if not path.with_suffix(".json").exists():
            # it is being played
            continue
        with RecordingReader(path) as reader:
            truths: list[SceneTruth] = [item.message for item in reader.messages(("sim/truth",))]  # type: ignore[misc]
        images = json.loads(path.with_suffix(".json").read_text())
        middle_ns = truths[len(truths) // 2].stamp_ns
        frames = {frame.stamp_ns: frame for frame in joined(path, radars, silent, middle_ns)}
        for truth, image in zip(truths, images, strict=True):
            frame = frames.get(truth.stamp_ns)
            objects, tracks = ((), ()) if frame is None else (frame.objects, frame.tracks)
            if last_half and truth.stamp_ns < middle_ns:
                continue
            yield scan_row(place, objects, truth, msgspec.convert(image, list[ImageTruth]), tracks)


def score(folder: Path) -> None:
    """Print recall, false reports and tracks of each set of radars."""
    every = ("left", "right")
    for name, radars, silent, last_half in (
        ("front alone", ("front",), "", False),
        ("left alone", ("left",), "", False),
        ("right alone", ("right",), "", False),
        ("left and right", every, "", False),
        ("front, second half", ("front",), "", True),
        ("left and right, second half", every, "", True),
        ("the same, left silent from the middle on", every, "left", True),
        ("all three", tuple(RADARS), "", False),
    ):
        scans = list(rows(folder, radars, silent, last_half))
        scores = ObjectScores(scans)
        weights = np.random.default_rng(0).multinomial(
            len(scores.places), np.full(len(scores.places), 1.0 / len(scores.places)), 1000
        )
        report = object_report(scores, weights, 1.0)
        double = sum(is_double(item) for row in scans for item in row.reports)
        false_a_scan = sum(is_false(item) for row in scans for item in row.reports) / len(scans)
        tracked = [item.track_id is not None for row in scans for item in row.hidden if item.image.mirrored]
        false_tracks = sum(is_false(item) for row in scans for item in row.tracks) / len(scans)
        print(
            f"{name:42} recall {report.recall}  false a scan {false_a_scan:.2f}  reports {report.reports}  "
            f"twice {double}  tracked {np.mean(tracked):.2f}  false tracks a scan {false_tracks:.2f}"
        )


def is_double(report: ReportRow) -> bool:
    """Return whether a report lies at a hidden object that another report has found, or is nearer to."""
    return not report.found and report.error_m is not None and report.error_m < FALSE_M


def main() -> None:
    """Play or score."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--play", type=Path)
    parser.add_argument("--score", type=Path)
    parser.add_argument("--drives", type=int, default=12)
    parser.add_argument("--seed", type=int, default=482)
    arguments = parser.parse_args()
    if arguments.play is not None:
        play(arguments.play, arguments.drives, arguments.seed)
    if arguments.score is not None:
        score(arguments.score)


if __name__ == "__main__":
    main()
