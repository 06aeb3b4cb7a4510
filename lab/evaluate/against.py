"""Any list of objects or tracks against a truth: the scores of `eval --objects`, a file a drive."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from lab.evaluate.mot_tables import write_mot_tables
from lab.evaluate.object_lists import ListedScan, ObjectList, read_list, read_truth
from lab.evaluate.place_report import DEFINITIONS, Table, headline, position_errors, standard_scores
from lab.measures.drive_metrics import drive_report
from lab.measures.frame_scores import bootstrap_weights
from lab.measures.object_metrics import ObjectReport, ObjectScores, object_report
from lab.measures.object_rows import ImageTruth, ScanRow, scan_row
from msgs.values.perception import SceneTruth, TruthObject
from msgs.values.wording import counted

#: A list and a truth that share scan ids and differ by more are not of one drive.
MAX_APART_S = 1.0
#: Missed objects that a false report costs.
FALSE_COST = 1.0
_WORDS = ("found", "error", "false", "loss", "MOTA, IDF1, HOTA", "interval")


@dataclass(frozen=True, kw_only=True)
class ListRequest:
    """Request of the options; lists and truths by drive, in the same order."""

    lists: Sequence[Path]
    truths: Sequence[Path]
    draws: int
    seed: int
    out: Path | None


def compared(request: ListRequest) -> dict[str, Any]:
    """Score each list against its truth, a drive each; write what is tracked as MOT text into `out`/mot.

    Raises `ValueError` where a file cannot be read, or a scan of one stands not in the other.
    """
    lists, truths = request.lists, request.truths
    if len(truths) != len(lists):
        raise ValueError(f"--truth-file must be given once for each --against, got {len(truths)} for {len(lists)}")
    rows: list[ScanRow] = []
    tracked = True
    for place, (path, truth_path) in enumerate(zip(lists, truths, strict=True)):
        listed, truth = read_list(path), read_truth(truth_path)
        tracked = tracked and listed.tracked
        rows += list_rows(place, listed, truth, truth_path)
    weights = bootstrap_weights(len(lists), request.draws, request.seed)
    scores = ObjectScores(rows)
    if request.out is not None and tracked:
        write_mot_tables(request.out / "mot", {"reports": rows})
    return {
        "definitions": {word: DEFINITIONS[word] for word in _WORDS},
        "lists": [str(path) for path in lists],
        "truths": [str(path) for path in truths],
        "draws": request.draws,
        "objects": object_report(scores, weights, FALSE_COST),
        "tracks": drive_report(scores, weights) if tracked else None,
    }


def list_rows(
    place: int, listed: ObjectList, truth: ObjectList | Sequence[SceneTruth], truth_path: Path
) -> list[ScanRow]:
    """Return the rows of a drive: each scan of the truth with what was listed for it, by scan id, token or stamp."""
    scenes = _scenes(truth) if isinstance(truth, ObjectList) else {str(scene.scan_id): scene for scene in truth}
    by_stamp = {str(scene.stamp_ns): key for key, scene in scenes.items() if scene.stamp_ns}
    scans: dict[str, ListedScan] = {}
    for scan in listed.scans:
        key = scan.key if scan.key in scenes else by_stamp.get(scan.key, "")
        if key not in scenes:
            raise ValueError(f"{listed.path}: scan {scan.key} must be one of {truth_path}, which has none of this name")
        apart_s = 1e-9 * abs((scan.stamp_ns or 0) - scenes[key].stamp_ns)
        if scan.stamp_ns and scenes[key].stamp_ns and apart_s > MAX_APART_S:
            raise ValueError(
                f"{listed.path}: scan {scan.key}: stamp_ns must be within {MAX_APART_S:g} s of that of {truth_path}, "
                f"got {scan.stamp_ns} and {scenes[key].stamp_ns}"
            )
        scans[key] = scan
    missing = [key for key in scenes if key not in scans]
    if missing and listed.lists_empty_scans:
        raise ValueError(
            f"{listed.path}: must list scan {missing[0]} of {truth_path}, with no objects if it has none; "
            f"{counted(len(missing), 'scan')} missing"
        )
    return [
        _row(place, scene, scans.get(key, ListedScan(key=key)))
        for key, scene in scenes.items()
    ]  # fmt: skip


def _row(place: int, scene: SceneTruth, scan: ListedScan) -> ScanRow:
    images = [
        ImageTruth(direct=not item.hidden, mirrored=item.hidden, snr_db=None, single_snr_db=None)
        for item in scene.objects
    ]
    return scan_row(place, scan.objects, scene, images, scan.tracks)


def _scenes(truth: ObjectList) -> dict[str, SceneTruth]:
    """Return the boxes of a list as truth: all of them are to be found, and their only mark is the centre."""
    nothing = np.zeros((0, 3), np.float32)
    return {
        scan.key: SceneTruth(
            los_points_m=nothing,
            mirrored_points_m=nothing,
            hidden_points_m=nothing,
            stamp_ns=scan.stamp_ns or 0,
            scan_id=number,
            hidden_object=np.zeros(0, np.int32),
            objects=tuple(
                TruthObject(
                    id=item.id, object_class=item.object_class, x_m=item.box_centre_m[0], y_m=item.box_centre_m[1],
                    length_m=item.length_m, width_m=item.width_m, yaw_rad=item.yaw_rad, hidden=True,
                )
                for item in scan.objects
            ),
        )
        for number, scan in enumerate(truth.scans)
    }  # fmt: skip


def tables(results: Mapping[str, Any]) -> Iterator[Table]:
    """All tables of a comparison, for a terminal or a page."""
    name = Path(results["lists"][0]).name
    report: ObjectReport = results["objects"]
    title = f"{counted(len(results['lists']), 'drive')}, {counted(report.scans, 'scan')}"
    yield headline(title, {name: report})
    yield position_errors(title, {name: report})
    if results["tracks"] is not None:
        yield standard_scores(title, {name: results["tracks"]})
