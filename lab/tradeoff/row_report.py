"""Report of a trade-off: each row's accuracy beside its time, with intervals; JSON and Markdown."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from lab.measures.frame_scores import Estimate, FrameScores, bootstrap_weights, differences, estimates
from lab.measures.object_metrics import ObjectScores, object_differences, object_estimates
from lab.studies.report import (
    DRAWS,
    Interval,
    Provenance,
    Times,
    busy_lines,
    busy_reason,
    finite,
    machine,
    quantiles_ms,
    versions,
)
from lab.tradeoff.row_runs import BEFORE, PARTS, FrameResult, Plan
from lab.tradeoff.rows import PROFILE, Setting
from mirrorwave.plots.markdown import table
from models.perception.cards import learned_path
from msgs.values.radar import RadarSetup
from msgs.values.units import s_from_ns
from msgs.values.wording import counted
from nodes.dense_predictor import model_path

#: A scan comes so often: a view that takes longer after the last beam is late.
DEADLINE_MS = 300.0
#: Measures of `lab.measures.frame_scores` by the names of the report.
PLACES = {
    "dense_macro_f1": "dense_macro_f1",
    "recovered_f1_1m": "recovered_1m_f1",
    "recovered_chamfer_m": "recovered_chamfer_m",
    "hidden_f1_1m": "hidden_1m_f1",
}
NAN = float("nan")


class Row(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """One setting: what it costs and what it buys. A row that failed says why and holds no numbers."""

    name: str
    switch: str
    value: str
    params: dict[str, dict[str, Any]]
    #: Profile that it is laid over and compared with.
    over: str
    failed: str | None = None
    #: Measures, and the differences to the row of `over` on the same draws.
    accuracy: dict[str, Interval] = {}
    against_over: dict[str, Interval] = {}
    #: Of each part of the latency and of their sum, from the arrival of the last beam to that of the view.
    stages_ms: dict[str, Times] = {}
    end_to_end_ms: Times | None = None
    #: 95 % interval of the median over bootstrap draws of the frames.
    median_ms: Interval | None = None
    #: Work on all beams but the last relative to the time in which they are measured; above 1 the former falls behind.
    forming_load: float | None = None
    #: Share of views later than the deadline.
    deadline_misses: float | None = None
    peak_memory_mib: float | None = None
    size_bytes: int | None = None
    #: No other row is as fast and more accurate (median latency, F1 of objects).
    pareto: bool = False


class Report(Provenance, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A run: what it was made with, then its rows."""

    frames: int
    repeats: int
    deadline_ms: float
    rows: list[Row]
    #: Why the times do not count: the machine was busy. Empty where they do.
    busy: str = ""


def make_report(plan: Plan, results: Sequence[FrameResult], memory_mib: dict[str, float], command: str) -> Report:
    """All rows of a run; `memory_mib` may lack rows."""
    weights = bootstrap_weights(len(results), DRAWS, seed=0)
    failed = {name: reason for result in results for name, reason in result.failed.items()}
    scores = {row.name: _Scores.of(results, row.name) for row in plan.rows if row.name not in failed}
    rows = []
    for row in plan.rows:
        if row.name in failed:
            rows.append(Row(**_named(row), failed=failed[row.name]))
        else:
            rows.append(_row(row, scores, results, weights, memory_mib.get(row.name, NAN)))
    return Report(
        command=command,
        machine=machine(),
        versions=versions(),
        seed=plan.seed,
        frames=len(results),
        repeats=plan.repeats,
        deadline_ms=DEADLINE_MS,
        rows=with_front(rows),
        busy=busy_reason(
            max((result.load_before for result in results), default=0.0),
            float(np.mean([result.waited for result in results])) if results else 0.0,
        ),
    )


@dataclass(frozen=True)
class _Scores:
    """Scores of one row: of places and of objects."""

    places: FrameScores
    objects: ObjectScores

    @classmethod
    def of(cls, results: Sequence[FrameResult], name: str) -> _Scores:
        """Collect those of all frames, in order."""
        counts = np.array([result.counts[name] for result in results], np.int64)
        distances = np.array([result.distances[name] for result in results], np.float64)
        return cls(FrameScores(counts, distances), ObjectScores([result.objects[name] for result in results]))

    def estimates(self, weights: np.ndarray) -> dict[str, Interval]:
        """Return all measures of the report with their intervals."""
        return _intervals(object_estimates(self.objects, weights), estimates(self.places, weights))

    def against(self, other: _Scores, weights: np.ndarray) -> dict[str, Interval]:
        """Return the differences of all measures to those of another row."""
        return _intervals(
            object_differences(self.objects, other.objects, weights), differences(self.places, other.places, weights)
        )


def _intervals(objects: dict[str, Estimate], places: dict[str, Estimate]) -> dict[str, Interval]:
    # those of objects have their own names already
    reported = objects | {name: places[key] for name, key in PLACES.items()}
    return {name: Interval.of(estimate) for name, estimate in reported.items()}


def _named(row: Setting) -> dict[str, Any]:
    return {"name": row.name, "switch": row.switch, "value": row.value, "params": row.params, "over": row.over}


def _row(
    row: Setting, scores: Mapping[str, _Scores], results: Sequence[FrameResult], weights: np.ndarray, memory_mib: float
) -> Row:
    times_ms = latency_ms([result.times_ms[row.name] for result in results])
    total_ms = np.sum([times_ms[part] for part in PARTS], axis=0)
    own, base = scores[row.name], scores.get(row.over)
    return Row(
        **_named(row),
        accuracy=own.estimates(weights),
        against_over={} if base is None else own.against(base, weights),
        stages_ms={part: quantiles_ms(times_ms[part]) for part in (*PARTS, BEFORE)},
        end_to_end_ms=quantiles_ms(total_ms),
        median_ms=_median(total_ms, weights),
        forming_load=float(np.median(times_ms[BEFORE])) / measuring_ms(),
        deadline_misses=float(np.mean(total_ms > DEADLINE_MS)),
        peak_memory_mib=finite(memory_mib),
        size_bytes=_size_bytes(row),
    )


def latency_ms(frames: Sequence[dict[str, list[float]]]) -> dict[str, np.ndarray]:
    """Samples of each part [frames, repeats]; what the former has not folded when the last beam comes, it does then."""
    times_ms = {part: np.array([frame[part] for frame in frames]) for part in (*PARTS, BEFORE)}
    return times_ms | {"forming": times_ms["forming"] + np.maximum(times_ms[BEFORE] - measuring_ms(), 0.0)}


def measuring_ms() -> float:
    """Return the time that measuring all beams but the last takes."""
    setup = RadarSetup()
    return 1e3 * s_from_ns((len(setup.beams) - 1) * setup.beam_interval_ns)


def _median(samples_ms: np.ndarray, weights: np.ndarray) -> Interval:
    """The median of the frames' medians [frames, repeats], with its interval under draws of the frames."""
    of_frame_ms = np.median(samples_ms, axis=1)
    order = np.argsort(of_frame_ms)
    share = np.cumsum(weights[:, order], axis=1) / weights.sum(axis=1, keepdims=True)
    drawn_ms = of_frame_ms[order][np.argmax(share >= 0.5, axis=1)]
    low_ms, high_ms = np.percentile(drawn_ms, (2.5, 97.5))
    return Interval(value=float(np.median(of_frame_ms)), low=float(low_ms), high=float(high_ms))


def _size_bytes(row: Setting) -> int:
    """Files that a row's stages read."""
    dense, geometry = row.of("dense_predictor"), row.of("geometry")
    files = [None if dense.get("method") == "cfar" else model_path(dense.get("model"))]
    files += [None if (residual := geometry.get("residual", "none")) == "none" else Path(residual)]
    files += [None if (judge := geometry.get("object_network", "none")) == "none" else learned_path(judge)]
    return sum(path.stat().st_size for path in files if path is not None)


def with_front(rows: list[Row]) -> list[Row]:
    """Rows with those marked that none beats in both time and accuracy."""
    points = [point_of(row) for row in rows]
    return [
        msgspec.structs.replace(row, pareto=point is not None and not any(_beats(other, point) for other in points))
        for row, point in zip(rows, points, strict=True)
    ]


def point_of(row: Row) -> tuple[float, float] | None:
    """Median latency in ms and F1 of objects; None for a row without."""
    if row.end_to_end_ms is None or row.end_to_end_ms.p50 is None:
        return None
    accuracy = row.accuracy["object_f1"].value
    return None if accuracy is None else (row.end_to_end_ms.p50, accuracy)


def _beats(other: tuple[float, float] | None, point: tuple[float, float]) -> bool:
    if other is None:
        return False
    return other[0] <= point[0] and other[1] >= point[1] and other != point


COLUMNS = (
    "row", "object F1", "against", "25 dB", "false a scan", "loss a scan", "recovered F1 1 m", "dense F1",
    "p50 [ms]", "p90", "p99", "forming", "detection", "geometry", "transport", "load", "late", "memory [MiB]",
    "size [KiB]", "front",
)  # fmt: skip


#: What a narrow terminal leaves out, the first of them first.
LEAST = (
    "size [KiB]", "transport", "load", "geometry", "detection", "forming", "dense F1", "recovered F1 1 m", "25 dB",
    "memory [MiB]", "p99", "false a scan", "loss a scan", "against", "p90",
)  # fmt: skip


def cells(row: Row) -> list[str]:
    """A row as `COLUMNS`."""
    if row.failed is not None or row.end_to_end_ms is None:
        return [row.name, f"failed: {row.failed}", *[""] * (len(COLUMNS) - 2)]
    accuracy, total = row.accuracy, row.end_to_end_ms
    against = row.against_over.get("object_f1")
    parts = [_number(row.stages_ms[part].p50, 1) for part in ("forming", "detection", "geometry", "transport")]
    return [
        row.name,
        _with_interval(accuracy["object_f1"]),
        "" if against is None or row.switch == PROFILE else f"`{row.over}` {_signed(against)}",
        *(
            _number(accuracy[name].value, 2)
            for name in ("object_recall_25_db", "false_objects_per_scan", "object_loss_per_scan")
        ),
        *(_number(accuracy[name].value, 3) for name in ("recovered_f1_1m", "dense_macro_f1")),
        *(_number(value, 1) for value in (total.p50, total.p90, total.p99)),
        *parts,
        _number(row.forming_load, 2),
        _number(row.deadline_misses, 3),
        _number(row.peak_memory_mib, 0),
        _number((row.size_bytes or 0) / 1024.0, 0),
        "yes" if row.pareto else "",
    ]


def _number(value: float | None, digits: int) -> str:
    return "-" if value is None else f"{value:.{digits}f}"


def _with_interval(interval: Interval) -> str:
    return f"{_number(interval.value, 3)} [{_number(interval.low, 3)}, {_number(interval.high, 3)}]"


def _signed(interval: Interval) -> str:
    if interval.value is None or interval.low is None or interval.high is None:
        return "-"
    return f"{interval.value:+.3f} [{interval.low:+.3f}, {interval.high:+.3f}]"


def markdown(report: Report) -> str:
    """The report as a page: how it was made, then all rows, fastest first, failed ones last."""
    ordered = sorted(report.rows, key=lambda row: point_of(row) or (math.inf, 0.0))
    lines = [
        f"`{report.command}`: {counted(report.frames, 'place')} of series {report.seed}, "
        f"each timed {counted(report.repeats, 'time')}; "
        f"{report.machine}; {report.packages}.",
        *busy_lines(report.busy),
        "",
        *table(COLUMNS, map(cells, ordered)),
    ]
    return "\n".join(lines) + "\n"


def read_report(path: Path) -> Report:
    """A report from its JSON; raises `ValueError` naming the file."""
    try:
        return msgspec.json.decode(path.read_bytes(), type=Report)
    except (OSError, msgspec.DecodeError, UnicodeError, RecursionError) as error:
        raise ValueError(f"{path}: {error}") from None
