"""Hidden objects beside the truth, scan by scan and in sum."""

from __future__ import annotations

import math
from typing import Any

import msgspec

from mirrorwave.console import print_line, print_table
from models.scores.object_matching import ObjectMatch, match_objects
from msgs.values.perception import BevFrame, HiddenObject, SceneTruth, TruthObject

#: A hidden object is found when its visible face or centre is met within this.
GATE_M = 1.0
#: What the errors are, wherever they are printed.
ERROR = (
    "error: from the centre of the report to the centre of the true box, and to the nearest visible face of the true "
    "box (or to its centre where that is nearer)"
)
#: Scans for which truth is kept while their view is still on its way.
KEPT_SCANS = 64


class Score(msgspec.Struct, frozen=True, kw_only=True):
    """Sum over scans; the counts against truth are None where no truth was given.

    `mean_error_m` and `worst_error_m` are to the nearest visible face of the true box or to its centre, whichever is
    nearer.
    """

    scans: int
    objects: int
    matched: int | None = None
    missed: int | None = None
    unmatched: int | None = None
    mean_error_m: float | None = None
    worst_error_m: float | None = None
    #: Of the same pairs, to the centre of the true box alone.
    mean_centre_error_m: float | None = None


class Scoreboard:
    """Pairs each view with its scan's truth, in whatever order they come."""

    def __init__(self) -> None:
        self._truths: dict[int, SceneTruth] = {}
        self._frames: dict[int, BevFrame] = {}
        self._last: tuple[BevFrame, SceneTruth | None] | None = None
        self._matches: list[ObjectMatch] = []
        self._scans = self._objects = 0

    def add_truth(self, truth: SceneTruth) -> None:
        """Add the truth of a scan."""
        _keep(self._truths, truth.scan_id, truth)
        if truth.scan_id in self._frames:
            self._pair(self._frames.pop(truth.scan_id), truth)

    def add_frame(self, frame: BevFrame) -> None:
        """Add the view of a scan."""
        self._scans += 1
        self._objects += len(frame.objects)
        if self._last is None or self._last[1] is None:
            self._last = (frame, None)
        if frame.scan_id in self._truths:
            self._pair(frame, self._truths[frame.scan_id])
        else:
            _keep(self._frames, frame.scan_id, frame)

    def truth_of(self, scan_id: int) -> SceneTruth | None:
        """Truth of a recent scan, None where it did not come."""
        return self._truths.get(scan_id)

    def summary(self) -> Score:
        """The sum so far."""
        if not self._matches:
            return Score(scans=self._scans, objects=self._objects)
        errors_m = [error_m for match in self._matches for _, _, error_m in match.matched]
        centre_m = [distance_m for match in self._matches for distance_m in match.centre_m]
        return Score(
            scans=self._scans,
            objects=self._objects,
            matched=len(errors_m),
            missed=sum(len(match.missed_truths) for match in self._matches),
            unmatched=sum(len(match.unmatched_objects) for match in self._matches),
            mean_error_m=sum(errors_m) / len(errors_m) if errors_m else None,
            worst_error_m=max(errors_m, default=None),
            mean_centre_error_m=sum(centre_m) / len(centre_m) if centre_m else None,
        )

    def print_table(self) -> None:
        """Objects of the last scan, the last one with truth if there is any, then the sum over all scans."""
        if self._last is not None:
            frame, truth = self._last
            columns = ("hidden object", "x [m]", "y [m]", "std [m]", "score", "truth", "true x [m]", "true y [m]",
                       "error: centre [m]", "error: nearest visible face [m]")  # fmt: skip
            print_table(columns, _rows(frame, truth), ("std [m]", "score"))
        score = self.summary()
        names = ("scans", "objects", "matched", "missed", "unmatched", "mean error: centre [m]",
                 "mean error: nearest visible face [m]", "worst error: nearest visible face [m]")  # fmt: skip
        errors = (score.mean_centre_error_m, score.mean_error_m, score.worst_error_m)
        print_table(names, [(score.scans, score.objects, score.matched, score.missed, score.unmatched, *errors)])
        if score.matched is not None:
            print_line(ERROR)

    def _pair(self, frame: BevFrame, truth: SceneTruth) -> None:
        self._matches.append(match_objects(frame.objects, truth, GATE_M))
        self._last = (frame, truth)


def _keep(store: dict[int, Any], key: int, value: Any) -> None:
    store[key] = value
    while len(store) > KEPT_SCANS:
        del store[next(iter(store))]


def _rows(frame: BevFrame, truth: SceneTruth | None) -> list[tuple[object, ...]]:
    """Found objects with the truth they match, then truths that were missed."""
    reported = {item.id: item for item in frame.objects}
    if truth is None:
        return [(*_report_cells(item), *[None] * 5) for item in frame.objects]
    real = {item.id: item for item in truth.objects}
    match = match_objects(frame.objects, truth, GATE_M)
    pairs = zip(match.matched, match.centre_m, strict=True)
    rows = [(*_report_cells(reported[i]), *_truth_cells(real[j]), to_m, error_m) for (i, j, error_m), to_m in pairs]
    rows += [(*_report_cells(reported[i]), "nothing there", *[None] * 4) for i in match.unmatched_objects]
    return rows + [("missed", *[None] * 4, *_truth_cells(real[j]), None, None) for j in match.missed_truths]


def _report_cells(hidden: HiddenObject) -> tuple[object, ...]:
    std_m = math.sqrt(0.5 * (hidden.cov_m2[0][0] + hidden.cov_m2[1][1]))
    return f"{hidden.object_class or 'object'} {hidden.id}", *hidden.box_centre_m, std_m, hidden.score


def _truth_cells(true_object: TruthObject) -> tuple[object, ...]:
    return true_object.object_class, true_object.x_m, true_object.y_m
