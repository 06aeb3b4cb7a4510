"""Each switch of the geometry stage alone, turned against the default: what it earns on the test scenes.

Rows are scored on one set of frames: recovered F1 within 1 m and 2 m and Chamfer distance of the points against the
true places of all mirrored labels, hidden vehicles found within 2 m, objects that are nothing, time a frame. `truth`
feeds labels as peaks with the polar errors of good ones (0.06 m, 0.7 degrees), so that geometry is judged apart from
detection; `detected` feeds a detector's.
`--confidence` adds a row with a fitted model (`mirrorwave train confidence`).
Usage: python -m benchmarks.perception.geometry_switches DATA [--split test] [--count N] [--model FILE] [--refine WAY]
    [--confidence FILE] [--json]
"""

from __future__ import annotations

import argparse
import json
import math
import os
import platform
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import yaml

from models.evaluation.metrics import Counts, chamfer, recovered_counts
from models.perception.detection.detectors import NetworkDetector, Refine
from models.perception.detection.onnx_model import DEFAULT_MODEL, load_card
from models.perception.detection.peaks import PeakParams, polar_covariance
from models.perception.geometry.confidence import PositionConfidence, load_confidence
from models.perception.geometry.objects import form_objects
from models.perception.geometry.observability import sensitivity_db
from models.perception.geometry.published import PublishedParams, recover_published
from models.perception.geometry.stage import GeometryParams, fold_scan
from models.training.data.frames import DataSet, Frame, FrameLabels, fixed_splits
from msgs.values.perception import PathClass, Peaks
from msgs.values.radar import RadarSetup, RangeAzimuthGrid
from sim_player.dataset.labelled_scan import Labels

RANGE_STD_M, AZIMUTH_STD_DEG = 0.06, 0.7
DEFAULT = GeometryParams()


def switched(part: str, **changes: Any) -> GeometryParams:
    """The default with some parameters of one of its parts changed."""
    return msgspec.structs.replace(DEFAULT, **{part: msgspec.structs.replace(getattr(DEFAULT, part), **changes)})


SWITCHES: dict[str, GeometryParams] = {
    "default": DEFAULT,
    "wall errors euclidean": switched("walls", error_model="euclidean"),
    "association buddy": switched("recovery", association="buddy"),
    "no second order": switched("recovery", second_order=False),
    "no arcs": switched("walls", curved=False),
    "no corners": switched("walls", corner_reach_m=0.0),
    "no openings": switched("walls", open_gap_m=0.0),
    "walls not joined": switched("walls", joined=False),
    "keep places on walls": switched("recovery", reject_on_wall=False),
    "keep places at returns": switched("recovery", reject_at_return=False),
    "keep places on vehicles": switched("recovery", reject_on_vehicle=False),
    "keep all places": switched("recovery", reject_on_wall=False, reject_at_return=False, reject_on_vehicle=False),
}


#: The published back end, which forms no objects.
PUBLISHED = "published"
#: The default with a fitted model.
CONFIDENT = "confidence"


class Row(msgspec.Struct, kw_only=True):
    """One setting on one kind of peaks, over all frames."""

    peaks: str
    setting: str
    f1_1m: float
    precision_1m: float
    recall_1m: float
    f1_2m: float
    #: Mean over the frames where both sides have points; the others are counted.
    chamfer_m: float
    one_sided: int
    hidden: int
    found: int
    ghosts: int
    ms: float


def true_peaks(frame: Frame, noise_power_mw: float) -> Peaks:
    """Labels of a frame as peaks, with errors drawn from its number."""
    return labelled_peaks(frame.labels, noise_power_mw, np.random.default_rng([5, frame.index]), frame.index)


def labelled_peaks(
    labels: FrameLabels | Labels, noise_power_mw: float, rng: np.random.Generator, scan_id: int = 0
) -> Peaks:
    """Labels as peaks with polar errors."""
    count = len(labels.range_m)
    snr_db = 10.0 * np.log10(np.maximum(labels.power_mw.astype(np.float64) / noise_power_mw, 1e-3))
    errors = rng.standard_normal((2, count)) * [[RANGE_STD_M], [math.radians(AZIMUTH_STD_DEG)]]
    return Peaks(
        stamp_ns=0,
        scan_id=scan_id,
        range_m=np.maximum(labels.range_m + errors[0], 0.0).astype(np.float64),
        azimuth_rad=(labels.azimuth_rad + errors[1]).astype(np.float64),
        score=np.full(count, 0.9),
        path_class=labels.path_class.astype(np.uint8),
        covariance=polar_covariance(snr_db, np.zeros(count, bool), RangeAzimuthGrid().range_bin_m, PeakParams()),
        peak_stamp_ns=np.zeros(count, np.int64),
        snr_db=snr_db,
        sensitivity_db=sensitivity_db(RadarSetup()),
    )


def hidden_places(frame: Frame) -> list[np.ndarray]:
    """For each object seen in mirrors alone its centre and the true places of its labels, [1 + N, 2]."""
    if not frame.scene_yaml:
        return []
    objects = yaml.safe_load(frame.scene_yaml)["objects"]
    labels = frame.labels
    return [
        np.vstack(
            [
                [objects[index]["x_m"], objects[index]["y_m"]],
                labels.hidden_xy_m[(labels.object_index == index) & (labels.path_class == PathClass.MIRRORED)],
            ]
        )
        for index in frame.hidden
    ]


def places(setting: str, peaks: Peaks, confidence: PositionConfidence | None = None) -> tuple[np.ndarray, np.ndarray]:
    """All folded places and the centres of the hidden objects formed from them, [N, 2] each."""
    if setting == PUBLISHED:
        return recover_published(peaks, PublishedParams()).points_m, np.zeros((0, 2))
    params = SWITCHES.get(setting, DEFAULT)
    scan = fold_scan(peaks, params, confidence=confidence if setting == CONFIDENT else None)
    objects = form_objects(scan.recovered.take(scan.hidden), scan.walls, params.objects)
    return scan.recovered.points_m, np.array([(one.x_m, one.y_m) for one in objects]).reshape(-1, 2)


def object_counts(found: np.ndarray, hidden: list[np.ndarray], gate_m: float = 2.0) -> Counts:
    """Found objects against hidden ones, one to one, each pair as far apart as its nearest label or centre."""
    distance = np.array([[np.linalg.norm(one - at, axis=1).min() for at in hidden] for one in found])
    free = set(range(len(hidden)))
    matched = 0
    for row, column in sorted(np.ndindex(*distance.shape), key=lambda pair: distance[pair]) if distance.size else ():
        if distance[row, column] <= gate_m and column in free and not np.isnan(distance[row]).any():
            free.remove(column)
            distance[row] = np.nan
            matched += 1
    return Counts(matched, len(found) - matched, len(hidden) - matched)


def score(
    setting: str, kind: str, frames: list[Frame], peaks: list[Peaks], confidence: PositionConfidence | None = None
) -> Row:
    """One setting over all frames."""
    near, wide, objects = Counts(), Counts(), Counts()
    chamfers, seconds = [], 0.0
    for frame, found in zip(frames, peaks, strict=True):
        start = time.perf_counter()
        points, hidden = places(setting, found, confidence)
        seconds += time.perf_counter() - start
        truth = frame.labels.hidden_xy_m[frame.labels.path_class == PathClass.MIRRORED].astype(np.float64)
        near, wide = near + recovered_counts(points, truth, 1.0), wide + recovered_counts(points, truth, 2.0)
        chamfers.append(chamfer(points, truth).metres)
        objects = objects + object_counts(hidden, hidden_places(frame))
    finite = np.isfinite(chamfers)
    return Row(
        peaks=kind,
        setting=setting,
        f1_1m=near.f1,
        precision_1m=near.precision,
        recall_1m=near.recall,
        f1_2m=wide.f1,
        chamfer_m=float(np.mean(np.array(chamfers)[finite])) if finite.any() else math.inf,
        one_sided=int(np.count_nonzero(~finite)),
        hidden=objects.true_positives + objects.false_negatives,
        found=objects.true_positives,
        ghosts=objects.false_positives,
        ms=1e3 * seconds / max(len(frames), 1),
    )


def rows(
    frames: list[Frame],
    detector: NetworkDetector,
    noise_mw: list[float],
    confidence: PositionConfidence | None = None,
) -> Iterator[Row]:
    """All settings on both kinds of peaks; a fitted model on detected ones, which it was fitted to."""
    kinds = {
        "truth": [true_peaks(frame, noise) for frame, noise in zip(frames, noise_mw, strict=True)],
        "detected": [detector.detect(frame.ra_map) for frame in frames],
    }
    for kind, peaks in kinds.items():
        confident = [CONFIDENT] if confidence is not None and kind == "detected" else []
        for setting in (*SWITCHES, *confident, PUBLISHED):
            yield score(setting, kind, frames, peaks, confidence)


def machine() -> str:
    return f"{platform.machine()}, {os.cpu_count()} cores, {platform.platform()}"


def line(row: Row) -> str:
    return (
        f"{row.peaks:9s} {row.setting:24s} F1 1 m {row.f1_1m:.3f} (P {row.precision_1m:.3f} R {row.recall_1m:.3f})  "
        f"2 m {row.f1_2m:.3f}  Chamfer {row.chamfer_m:5.2f} m ({row.one_sided} one-sided)  "
        f"objects {row.found}/{row.hidden}, {row.ghosts} ghosts  {row.ms:.1f} ms"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("data", type=Path)
    parser.add_argument("--split", default="test")
    parser.add_argument("--count", type=int, default=0, help="first so many scenes of the split; 0: all")
    parser.add_argument("--model", type=Path, default=DEFAULT_MODEL)
    parser.add_argument("--refine", choices=tuple(Refine), default=Refine.PURSUIT)
    parser.add_argument("--confidence", type=Path)
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    data = DataSet(arguments.data)
    selected = np.arange(len(data)) if arguments.split == "all" else fixed_splits(arguments.data).of(arguments.split)
    selected = selected[: arguments.count or None]
    frames = list(data.frames(selected))
    threshold = load_card(arguments.model).threshold_for(arguments.refine)
    detector = NetworkDetector(
        RadarSetup(), arguments.model, params=PeakParams(threshold=threshold), refine=arguments.refine
    )
    confidence = None if arguments.confidence is None else load_confidence(arguments.confidence)
    noise_mw = [data.scan(int(index)).noise_power_mw for index in selected]
    table = []
    for row in rows(frames, detector, noise_mw, confidence):
        table.append(msgspec.to_builtins(row))
        if not arguments.json:
            print(line(row), flush=True)
    command = "python -m benchmarks.perception.geometry_switches " + " ".join(sys.argv[1:])
    about = {"machine": machine(), "command": command, "scenes": len(frames)}
    print(json.dumps({**about, "rows": table}) if arguments.json else f"{command}\n{machine()}, {len(frames)} scenes")


if __name__ == "__main__":
    main()
