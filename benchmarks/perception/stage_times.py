"""Processor time of one view by stage, in ms: detection of peaks, then geometry with the object network, and tracking.

Scans are the corner of the launch files and drawn places, at rest and with all effects, formed as on the vehicle. Each
is viewed some times in a row and counts with the median of all views but the first, processor time of one thread. A
stage that lies within another one counts in both.
Usage: OPENBLAS_NUM_THREADS=1 python -m benchmarks.perception.stage_times [--count N] [--seed S] [--rounds R]
       [--profile default] [--json]
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from types import ModuleType
from typing import Any
from unittest.mock import patch

import msgspec
import numpy as np

from benchmarks.perception.geometry_switches import machine
from mirrorwave.node_chain import stage_params
from mirrorwave.profiles import read_profile
from models.perception.detection import onnx_model, peaks, stage
from models.perception.detection.stage import DetectionStage
from models.perception.forming.coarray import AzimuthInterpolator
from models.perception.forming.ra_forming import ScanProfiles, form_map
from models.perception.geometry import confidence
from models.perception.geometry import stage as geometry_stage
from models.perception.objects import encoding, predictor
from models.perception.tracking.stage import ViewStage
from msgs.bus.codec import encode
from msgs.bus.interface import Envelope
from msgs.files.shipped import CHECKOUT
from msgs.values.radar import RadarSetup, RangeAzimuthMap
from nodes import dense_predictor, geometry
from sim_player.dataset.labelled_scan import labelled_scan
from sim_player.generate.places import random_place
from sim_player.scene.description import Scene, load_scene

CORNER = CHECKOUT / "launch" / "scenes" / "corner.yaml"
SCAN_NS, BEAM_NS = 300_000_000, 12_000_000
#: Scans of different places lie so far apart that no track outlives a place.
APART_NS = 100_000_000_000
#: What is timed beside the whole: the name in its module, or its class, and the name of the stage.
PARTS: tuple[tuple[ModuleType | type, str, str], ...] = (
    (stage, "require_sound", "map checked"),
    (onnx_model, "encode_map", "map encoded"),
    (onnx_model.DensePredictor, "infer", "dense network"),
    (peaks, "pursued_points", "pursuit"),
    (peaks, "peaks_at", "peaks refined"),
    (geometry_stage, "dbscan", "clusters"),
    (geometry_stage, "find_walls", "walls"),
    (geometry_stage, "recover", "images folded"),
    (confidence.PositionConfidence, "probable", "images' confidence"),
    (geometry_stage, "hidden_mask", "images explained"),
    (geometry_stage, "observability", "mask"),
    (predictor, "encode_objects", "objects: input"),
    (encoding, "encode_map", "objects: map encoded"),
    (encoding, "drawn_peaks", "objects: peaks drawn"),
    (encoding, "cell_hypotheses", "objects: hypotheses"),
    (predictor.ObjectPredictor, "_infer", "objects: network"),
    (predictor, "detections", "objects: answers"),
)


def maps(seed: int, count: int) -> list[RangeAzimuthMap]:
    """Return the maps of the corner and of `count` drawn places."""
    interpolator = AzimuthInterpolator(RadarSetup())
    return [_map(scene, seed, index, interpolator) for index, scene in enumerate(_scenes(seed, count))]


def _scenes(seed: int, count: int) -> Iterator[Scene]:
    yield load_scene(CORNER)
    for index in range(count):
        yield random_place(seed, index)


def _map(scene: Scene, seed: int, index: int, interpolator: AzimuthInterpolator) -> RangeAzimuthMap:
    scan = labelled_scan(scene, seed, "all")
    stamp_ns = APART_NS * (index + 1)
    return form_map(
        ScanProfiles(
            stamp_ns=stamp_ns,
            scan_id=index,
            profiles=scan.profiles,
            noise_power_mw=scan.noise_power_mw,
            beam_stamp_ns=stamp_ns + BEAM_NS * np.arange(len(scan.profiles)),
        ),
        interpolator,
    )


class Stopwatch:
    """Processor milliseconds of stages since the last `taken`."""

    def __init__(self) -> None:
        self._ms: defaultdict[str, float] = defaultdict(float)

    @contextmanager
    def __call__(self, name: str) -> Iterator[None]:
        start_ns = time.thread_time_ns()
        yield
        self._ms[name] += 1e-6 * (time.thread_time_ns() - start_ns)

    def around(self, name: str, call: Callable[..., Any]) -> Callable[..., Any]:
        """Return a call that is timed."""

        def timed(*arguments: Any, **named: Any) -> Any:
            with self(name):
                return call(*arguments, **named)

        return timed

    def taken(self) -> dict[str, float]:
        """Return the times so far and start again."""
        ms, self._ms = dict(self._ms), defaultdict(float)
        return ms


def measure(scans: list[RangeAzimuthMap], rounds: int, profile: str) -> dict[str, np.ndarray]:
    """Return the milliseconds of each stage [scans], the median of the rounds after a first one."""
    params = read_profile(profile)
    watch = Stopwatch()
    detection = dense_predictor.detection_stage(
        stage_params("dense_predictor", params.get("dense_predictor", {})), watch
    )
    viewer = geometry.view_stage(stage_params("geometry", params.get("geometry", {})), watch)
    with ExitStack() as stack:
        for holder, attribute, name in PARTS:
            stack.enter_context(patch.object(holder, attribute, watch.around(name, getattr(holder, attribute))))
        times = [[_viewed(scan, index, detection, viewer, watch) for index in range(rounds + 1)] for scan in scans]
    names = {name: None for views in times for view in views[1:] for name in view}
    return {name: np.median([[view.get(name, 0.0) for view in views[1:]] for views in times], axis=1) for name in names}


def _viewed(
    ra_map: RangeAzimuthMap, earlier: int, detection: DetectionStage, viewer: ViewStage, watch: Stopwatch
) -> dict[str, float]:
    """Return the times of one view, after so many earlier ones of its place."""
    later_ns = SCAN_NS * earlier
    ra_map = msgspec.structs.replace(
        ra_map,
        stamp_ns=ra_map.stamp_ns + later_ns,
        azimuth_stamp_ns=ra_map.azimuth_stamp_ns + later_ns,
        settled_stamp_ns=None,
    )
    detected = detection.detect(ra_map)
    view = viewer.view(detected, ra_map)
    for name, message in (("perception/peaks", detected), ("perception/hidden_objects", view)):
        envelope = Envelope(publisher="benchmark", topic=name, sequence=0, sent_ns=0)
        with watch(f"encoded: {name}"):
            encode(envelope, message)
    return watch.taken()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=20)
    parser.add_argument("--seed", type=int, default=7)
    parser.add_argument("--rounds", type=int, default=9)
    parser.add_argument("--profile", default="default")
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    times = measure(maps(arguments.seed, arguments.count), arguments.rounds, arguments.profile)
    rows = [
        {"stage": name, "mean_ms": float(ms.mean()), "p50_ms": float(np.median(ms)), "max_ms": float(ms.max())}
        for name, ms in times.items()
    ]
    command = " ".join(["python -m benchmarks.perception.stage_times", *sys.argv[1:]])
    if arguments.json:
        print(json.dumps({"machine": machine(), "command": command, "rows": rows}))
        return
    print(f"{machine()}\n{command}\n\n| stage | mean [ms] | p50 [ms] | max [ms] |\n|{' --- |' * 4}")
    for row in rows:
        print(f"| {row['stage']} | {row['mean_ms']:.2f} | {row['p50_ms']:.2f} | {row['max_ms']:.2f} |")


if __name__ == "__main__":
    main()
