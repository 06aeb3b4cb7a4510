"""Walls as a stage of their own: to how many hidden objects they lead, and how many of them do not exist.

    python -m benchmarks.perception.wall_coverage DIR [--map none|poor|exact] [--limit N] [--json]

DIR is a data set of `sim dataset` with truth. A wall leads to an object where an image by one mirror, at most 10 dB
under the object's strongest, folds about it to within 1 m of its true place, and meets it at most 8 m beyond its ends.
Counted are objects out of sight whose strongest such image has 25 dB, by the scan of a drive they are in. A wall is
false where its middle lies over 1 m from every true wall and body, or is turned by over 10 deg against the nearest
true wall and no body is within 1 m.
"""

from __future__ import annotations

import argparse
import json
import math
import time
from collections.abc import Iterator
from functools import partial
from itertools import groupby
from pathlib import Path
from typing import NamedTuple

import numpy as np

from lab.training.data.frames import DataSet, Frame
from models.perception.find.detectors import NetworkDetector
from models.perception.mirrors.mirror_table import WallArrays, mirrors_met, wall_arrays
from models.perception.mirrors.peaks_to_view import GeometryParams, WallPrior, direct_structure, joined_by_priors
from models.perception.see.evidence_predictor import EvidencePredictor
from models.perception.see.field_predictor import FieldPredictor
from models.perception.see.scan_evidence import ScanEvidence, scan_evidence
from models.perception.see.wall_memory import RadarPose, WallMemory
from models.perception.track.views_over_scans import judged_params
from models.perception.track.wall_priors import WallPriorStore
from models.physics.mirror import reflect
from models.physics.plane import segment_distance_m
from msgs.values.environment import WallPriors
from msgs.values.frames import Pose2, xy_from_polar
from msgs.values.perception import PathClass

STRONG_DB, NEAR_STRONGEST_DB = 25.0, 10.0
NEAR_M, BEYOND_ENDS_M, ALIGNED_RAD = 1.0, 8.0, math.radians(10.0)


class WalledScan(NamedTuple):
    """Walls of a scan, for each strong hidden object whether one leads to it, how many are false, the time."""

    scan: int
    walls: int
    led: list[bool]
    false: int
    ms: float


class WallFinder:
    """The walls that the default networks find in scans of one data set, of a drive in order."""

    def __init__(self, data: DataSet, map_name: str) -> None:
        predictor = EvidencePredictor()
        self._detector, self._fields = NetworkDetector(data.setup), FieldPredictor(predictor.fields_path)
        self._encoding = predictor.card.encoding
        self._geometry = judged_params(GeometryParams(), predictor)
        self._memory, self._map = WallMemory(), map_name

    def start(self) -> None:
        """Forget all scans."""
        self._memory = WallMemory()

    def find(self, frame: Frame) -> tuple[ScanEvidence, float]:
        """Return the walls of a scan, and the milliseconds from its peaks to them and to what they show."""
        peaks = self._detector.detect(frame.ra_map)
        started = time.perf_counter()
        self._memory.move(RadarPose(0, frame.pose) if frame.sequence and frame.pose else None)
        returns, fitted = direct_structure(peaks, self._geometry)
        with_priors = partial(joined_by_priors, peaks, returns, self._prior(frame)) if self._map != "none" else None
        answer = self._fields.answer(frame.ra_map)
        found = scan_evidence(self._encoding, frame.ra_map, answer, fitted, self._memory.earlier(), with_priors)
        self._memory.add(found.elements)
        return found, 1e3 * (time.perf_counter() - started)

    def _prior(self, frame: Frame) -> WallPrior:
        store = WallPriorStore()
        walls = frame.walls if self._map == "exact" else frame.map_walls
        store.add(WallPriors(stamp_ns=0, source="map", walls=walls))
        return partial(store.fused, store.at(0, lambda _: None, Pose2()))


def leads(walls: WallArrays, image_m: np.ndarray, true_m: np.ndarray) -> bool:
    """Return whether a wall folds one of the images [N, 2] to its true place [N, 2]."""
    for wall in range(len(walls)):
        normal, offset_m = mirrors_met(image_m, np.full(len(image_m), wall), walls)
        folded_m = reflect(image_m, normal, offset_m)
        share = offset_m / np.maximum(-np.sum(image_m * normal, axis=1), 1e-6)
        direction = (walls.b[wall] - walls.a[wall]) / walls.length_m[wall]
        along_m = (share[:, None] * image_m - walls.a[wall]) @ direction
        met = (along_m > -BEYOND_ENDS_M) & (along_m < walls.length_m[wall] + BEYOND_ENDS_M)
        if (met & (np.linalg.norm(folded_m - true_m, axis=1) < NEAR_M)).any():
            return True
    return False


def strong_images(frame: Frame) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Yield images and true places [N, 2] of each object out of sight that one mirror shows at `STRONG_DB`."""
    labels = frame.labels
    snr_db = 10.0 * np.log10(np.maximum(labels.power_mw / frame.noise_power_mw, 1e-30))
    image_m = xy_from_polar(labels.range_m.astype(float), labels.azimuth_rad.astype(float))
    mirrored = (labels.path_class == PathClass.MIRRORED) & (labels.order == 1)
    for number, item in enumerate(frame.truth or ()):
        own = mirrored & (labels.object_index == number)
        if item.hidden and own.any() and snr_db[own].max() >= STRONG_DB:
            own &= snr_db >= snr_db[own].max() - NEAR_STRONGEST_DB
            yield image_m[own], labels.hidden_xy_m[own].astype(float)


def is_false(walls: WallArrays, wall: int, frame: Frame) -> bool:
    """Return whether no true wall of that direction and no body stands where a wall of the list is."""
    middle_m, chord = 0.5 * (walls.a[wall] + walls.b[wall]), walls.b[wall] - walls.a[wall]
    for item in frame.truth or ():
        cos, sin = math.cos(item.yaw_rad), math.sin(item.yaw_rad)
        x_m, y_m = middle_m - (item.x_m, item.y_m)
        beyond_m = np.abs([cos * x_m + sin * y_m, cos * y_m - sin * x_m]) - (item.length_m / 2.0, item.width_m / 2.0)
        if np.hypot(*np.maximum(beyond_m, 0.0)) < NEAR_M:
            return False
    for true in frame.walls:
        a, b = np.array(true.ends_m)
        across = abs(chord[0] * (b - a)[1] - chord[1] * (b - a)[0]) / (np.hypot(*chord) * np.hypot(*(b - a)))
        if segment_distance_m(middle_m[None], a[None], b[None]).item() < NEAR_M and across < math.sin(ALIGNED_RAD):
            return False
    return True


def measured(data: DataSet, map_name: str, limit: int) -> Iterator[WalledScan]:
    """Yield the scans of a data set with their walls."""
    finder = WallFinder(data, map_name)
    frames = data.frames(range(min(limit, len(data))))
    if not data.frame(0).walls:
        raise ValueError(f"{data.directory} must tell the walls of its scenes (`sim dataset --truth`)")
    for _, drive in groupby(frames, lambda frame: frame.sequence or str(frame.index)):
        finder.start()
        for scan, frame in enumerate(drive):
            found, ms = finder.find(frame)
            arrays = wall_arrays(found.walls)
            led = [leads(arrays, *images) for images in strong_images(frame)]
            yield WalledScan(scan, len(arrays), led, sum(is_false(arrays, w, frame) for w in range(len(arrays))), ms)


def summary(scans: list[WalledScan]) -> dict[str, float]:
    """Return counts and shares over some scans."""
    led = [one for scan in scans for one in scan.led]
    return {
        "scans": len(scans),
        "objects": len(led),
        "led": round(float(np.mean(led)) if led else math.nan, 4),
        "walls_a_scan": round(float(np.mean([scan.walls for scan in scans])), 2),
        "false_a_scan": round(float(np.mean([scan.false for scan in scans])), 2),
        "median_ms": round(float(np.median([scan.ms for scan in scans])), 1),
    }


def main() -> None:
    """Print a line for all scans, and for those of a drive from the fifth on."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path)
    parser.add_argument("--map", choices=("none", "poor", "exact"), default="none")
    parser.add_argument("--limit", type=int, default=1 << 30, help="the first N scans")
    parser.add_argument("--json", action="store_true")
    way = parser.parse_args()
    scans = list(measured(DataSet(way.data), way.map, way.limit))
    parts = {"all": scans, "first of a drive": [scan for scan in scans if scan.scan == 0],
             "from the fifth on": [scan for scan in scans if scan.scan >= 4]}  # fmt: skip
    results = {name: summary(part) for name, part in parts.items() if part}
    if way.json:
        print(json.dumps({"data": way.data.name, "map": way.map, **results}))
        return
    for name, row in results.items():
        print(f"{name}: " + ", ".join(f"{key} {value}" for key, value in row.items()), flush=True)


if __name__ == "__main__":
    main()
