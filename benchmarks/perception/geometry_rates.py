"""What the observability mask and the objects' scores are worth: rates of detection, and calibration of the scores.

Mask: each vehicle (car, van, truck, bus: the RCS the mask speaks of or more) that is out of sight, by what the mask
says of the cell it stands in, and the share of them found as an object within 2 m. Scores: the share of objects that
are true against their mean score, before and after the table fitted on the validation scenes.
Usage: python -m benchmarks.perception.geometry_rates DATA [--count N] [--thresholds 13 20 ...] [--peaks truth|detected]
[--json]
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import yaml

from benchmarks.perception.geometry_switches import DEFAULT, hidden_places, machine, true_peaks
from models.perception.detection.detectors import NetworkDetector
from models.perception.detection.onnx_model import DEFAULT_MODEL
from models.perception.detection.score_calibration import calibrated
from models.perception.geometry.stage import GeometryParams, recover_bev
from models.training.calibration import calibration_error, fit_table
from models.training.data.frames import DataSet, Frame, fixed_splits
from msgs.values.perception import BevFrame, Peaks, Visibility
from msgs.values.radar import RadarSetup

GATE_M = 2.0
LARGE = ("car", "van", "truck", "bus")


def views(frames: list[tuple[Frame, Peaks]], params: GeometryParams) -> list[tuple[Frame, BevFrame]]:
    """What the geometry stage makes of each frame."""
    return [(frame, recover_bev(peaks, params)) for frame, peaks in frames]


def mask_rates(seen: list[tuple[Frame, BevFrame]]) -> dict[str, list[int]]:
    """Hidden vehicles by what the mask says of their cell: [found, all]."""
    rates = {kind.name.lower(): [0, 0] for kind in Visibility}
    for frame, bev in seen:
        found = np.array([(one.x_m, one.y_m) for one in bev.objects]).reshape(-1, 2)
        classes = [one["class"] for one in yaml.safe_load(frame.scene_yaml)["objects"]]
        for index, places in zip(frame.hidden, hidden_places(frame), strict=True):
            row, column = _cell(bev, places[0])
            inside = 0 <= row < bev.grid.rows and 0 <= column < bev.grid.columns
            if not inside or classes[index] not in LARGE:
                continue
            tally = rates[Visibility(int(bev.visibility[row, column])).name.lower()]
            tally[0] += _near(found, places)
            tally[1] += 1
    return rates


def _cell(bev: BevFrame, place_m: np.ndarray) -> tuple[int, int]:
    grid = bev.grid
    at = (place_m - [grid.x_min_m, grid.y_min_m]) // grid.cell_m
    return int(at[1]), int(at[0])


def _near(found: np.ndarray, places: np.ndarray) -> bool:
    return bool((np.linalg.norm(found[:, None] - places, axis=-1) <= GATE_M).any())


def outcomes(seen: list[tuple[Frame, BevFrame]]) -> tuple[np.ndarray, np.ndarray]:
    """Score [N] of every object, and whether it lies within the gate of a hidden one [N]."""
    score, is_true = [], []
    for frame, bev in seen:
        hidden = hidden_places(frame)
        for one in bev.objects:
            at = np.array([[one.x_m, one.y_m]])
            score.append(one.score)
            is_true.append(any(_near(at, places) for places in hidden))
    return np.array(score), np.array(is_true, bool)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("data", type=Path)
    parser.add_argument("--count", type=int, default=0, help="first so many scenes of each split; 0: all")
    parser.add_argument("--thresholds", type=float, nargs="*", default=[DEFAULT.visibility.threshold_db])
    parser.add_argument("--peaks", choices=("truth", "detected"), default="detected")
    parser.add_argument("--model", type=Path, default=DEFAULT_MODEL)
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    data, splits = DataSet(arguments.data), fixed_splits(arguments.data)
    detector = NetworkDetector(RadarSetup(), arguments.model)
    result: dict[str, Any] = {
        "machine": machine(),
        "command": "python -m benchmarks.perception.geometry_rates " + " ".join(sys.argv[1:]),
        "mask": {},
    }
    known = {}
    for split in ("train", "validation", "test"):
        selected = splits.of(split)[: arguments.count or (324 if split == "train" else None)]
        frames = []
        for frame in data.frames(selected):
            noise_mw = data.scan(frame.index).noise_power_mw
            frames.append(
                (frame, true_peaks(frame, noise_mw) if arguments.peaks == "truth" else detector.detect(frame.ra_map))
            )
        if split != "validation":
            for threshold_db in arguments.thresholds:
                visibility = msgspec.structs.replace(DEFAULT.visibility, threshold_db=threshold_db)
                seen = views(frames, msgspec.structs.replace(DEFAULT, visibility=visibility))
                result["mask"][f"{split} {threshold_db:g} dB"] = mask_rates(seen)
        if split != "train":
            raw = msgspec.structs.replace(DEFAULT.objects, score_table=())
            known[split] = outcomes(views(frames, msgspec.structs.replace(DEFAULT, objects=raw)))
    # joint scores crowd below 1: knots that rounding puts there are left to the last one
    table = tuple(knot for knot in fit_table(*known["validation"]) if knot[0] < 1.0 or knot[1] == 1.0)
    score, is_true = known["test"]
    result["score_table"] = table
    result["calibration_error"] = {
        "objects": len(score),
        "before": calibration_error(score, is_true),
        "after": calibration_error(calibrated(table, score), is_true),
    }
    print(json.dumps(result) if arguments.json else "\n".join(f"{name}: {value}" for name, value in result.items()))


if __name__ == "__main__":
    main()
