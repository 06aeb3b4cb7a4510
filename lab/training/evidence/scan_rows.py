"""Rows of scans for the scores of objects: what is reported beside what the labels tell of the truth."""

from __future__ import annotations

import numpy as np

from lab.measures.object_rows import ScanRow, scan_row
from lab.training.data.stored_truth import ScanTruth, image_truths, scan_truth
from models.perception.see.detections import Detections, hidden_objects


def add_rows(rows: dict[float, list[ScanRow]], likely: Detections, stamp_ns: np.ndarray, stored: ScanTruth) -> None:
    """Append a scan to the rows of each threshold: what is `likely`, measured at the times [N], beside its truth."""
    stamp_ns = np.rint(stamp_ns).astype(np.int64)
    truth, images = scan_truth(len(rows[min(rows)]), stored), image_truths(stored)
    for threshold, scored in rows.items():
        reached = likely.score >= threshold
        reports = hidden_objects(likely.take(reached), stamp_ns[reached])
        scored.append(scan_row(truth.scan_id, reports, truth, images))
