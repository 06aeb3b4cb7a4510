"""From a run to its report: measures with intervals, differences; as JSON and as Markdown."""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from lab.evaluate.method_runs import MethodRun, Run
from lab.measures.frame_scores import (
    CAP_M,
    COUNTED,
    MEASURED,
    Estimate,
    FrameScores,
    bootstrap_weights,
    differences,
    estimates,
)
from mirrorwave.plots.markdown import table
from msgs.files.whole_files import write_whole
from msgs.values.wording import counted

#: Measures of the table: heading and name.
HEADLINES = (
    ("dense Macro-F1", "dense_macro_f1"),
    ("dense CD [m]", "dense_macro_chamfer_m"),
    ("dense CD [m^2]", "dense_macro_chamfer_m2"),
    ("recovered F1 1 m", "recovered_1m_f1"),
    ("F1 2 m", "recovered_2m_f1"),
    ("F1 1 m one-to-one", "recovered_1m_one_to_one_f1"),
    ("recovered CD [m]", "recovered_chamfer_m"),
    ("CD [m^2]", "recovered_chamfer_m2"),
    (f"CD {CAP_M:g} m cap [m]", "recovered_chamfer_capped_m"),
    ("infinite share", "recovered_infinite_share"),
    ("hidden F1 1 m", "hidden_1m_f1"),
)
#: Truth points that a map can tell apart: the name of the truth in a report.
TRUTH = "thinned"
#: What the words of the report mean.
DEFINITIONS = {
    "dense": "peaks against truth points of their class, Hungarian one-to-one within 2 m, counts summed over frames; "
    "macro is the mean of LOS and mirrored",
    "recovered": "places against the true places of all images, of objects in plain sight and of two mirrors too; "
    "released definition, not one-to-one: a truth with a place nearer than the gate is found, a place with no truth "
    "that near is false; counts summed over frames",
    "hidden": "places that the back end holds for hidden (the published one rejects none) against the true places of "
    "those objects alone that only mirrors show",
    "milliseconds": "detection: map to peaks; geometry: peaks to places, without objects and visibility mask",
    "one_to_one": "the same gate, each truth found once and each place finding one",
    "chamfer": "mean(place -> truth) + mean(truth -> place) of a frame, mean over the frames where both sides hold "
    "points; m unsquared, m2 of squared distances",
    "infinite_share": "share of frames with one side empty, where the released Chamfer distance is infinite",
    "nothing_share": "share of frames with both sides empty",
    "chamfer_capped": f"over all frames, distances cut at {CAP_M:g} m; one side empty costs the most there is, the cap "
    "each way; both empty costs nothing",
    "interval": "95 % percentile interval over frames drawn with replacement; all methods share the draws",
}


@dataclass(frozen=True, kw_only=True)
class Context:
    """Context of a report beside its numbers."""

    data: str
    split: str
    test_sha256: str
    seed: int
    draws: int
    threads: int
    reference: str


def make_report(run: Run, context: Context) -> dict[str, Any]:
    """All that was found, in plain values."""
    weights = bootstrap_weights(len(run.indices), context.draws, context.seed)
    scores = {method_run.method.name: run.scores(method_run) for method_run in run.runs}
    against = scores[context.reference]
    return {
        **{name: getattr(context, name) for name in Context.__dataclass_fields__},
        "frames": len(run.indices),
        "cpu_count": os.cpu_count(),
        "definitions": DEFINITIONS,
        "methods": [_method(method_run, scores[method_run.method.name], weights) for method_run in run.runs],
        "differences": {
            name: {key: _triple(value) for key, value in differences(own, against, weights).items()}
            for name, own in scores.items()
            if name != context.reference
        },
        "per_frame": _per_frame(run, scores),
    }


def _method(method_run: MethodRun, scores: FrameScores, weights: np.ndarray) -> dict[str, Any]:
    """One method's part of the report."""
    method = method_run.method
    times_ms = np.array(method_run.milliseconds)
    return {
        "name": method.name,
        "spec": method.text,
        "threshold": method.threshold,
        "parameters": method.parameters,
        "privileged": method.privileged,
        "milliseconds": {
            stage: {"median": float(np.median(column)), "p90": float(np.percentile(column, 90.0))}
            for stage, column in zip(("detect", "geometry"), times_ms.T, strict=True)
        },
        "measures": {TRUTH: {name: _triple(value) for name, value in estimates(scores, weights).items()}},
    }


def _triple(value: Estimate) -> list[float]:
    return [value.value, value.low, value.high]


def _per_frame(run: Run, scores: dict[str, FrameScores]) -> dict[str, Any]:
    """Rows from which every table can be made again; a distance is "inf" with one side empty, null with both."""
    return {
        "counted": COUNTED,
        "measured": MEASURED,
        "index": run.indices,
        "milliseconds": {item.method.name: item.milliseconds for item in run.runs},
        "methods": {
            name: {TRUTH: {"counts": own.counts.tolist(), "distances": _spelled(own.distances)}}
            for name, own in scores.items()
        },
    }


def _spelled(distances: np.ndarray) -> list[Any]:
    rows: list[Any] = distances.tolist()
    return [[["inf" if math.isinf(x) else x for x in of] for of in row] for row in rows]


def headline_rows(report: dict[str, Any]) -> list[list[object]]:
    """Lines of the table, a method each."""
    rows: list[list[object]] = []
    for method in report["methods"]:
        cells = [interval_text(method["measures"][TRUTH][name]) for _, name in HEADLINES]
        times = method["milliseconds"]
        spent = [f"{times[stage]['median']:.3g} ({times[stage]['p90']:.3g})" for stage in ("detect", "geometry")]
        name = method["name"] + (" (given the truth)" if method["privileged"] else "")
        rows.append([name, *cells, method["parameters"], *spent])
    return rows


def headline_columns() -> list[str]:
    """Headings of the table."""
    return ["method", *(heading for heading, _ in HEADLINES), "parameters", "detect ms (p90)", "geometry ms (p90)"]


def interval_text(triple: Sequence[float]) -> str:
    """A value with its interval; "-" where it has none."""
    return "-" if math.isnan(triple[0]) else f"{triple[0]:.3g} [{triple[1]:.3g}, {triple[2]:.3g}]"


def write_report(report: dict[str, Any], out: Path) -> None:
    """results.json and results.md in a folder."""
    write_whole(out / "results.json", msgspec.json.encode(report))
    write_whole(out / "results.md", markdown(report).encode())


def markdown(report: dict[str, Any]) -> str:
    """The report for people."""
    lines = [
        f"# {counted(report['frames'], 'frame')}, split {report['split']} of {report['data']}",
        "",
        f"Test set {report['test_sha256']}; {report['draws']} bootstrap draws, seed {report['seed']}; "
        f"{counted(report['threads'], 'thread')} a network on {counted(report['cpu_count'], 'core')}; "
        "times are medians (90th percentile) "
        "of the same run, methods interleaved frame by frame.",
        "",
        f"## Against {TRUTH} truth",
        "",
        *table(headline_columns(), headline_rows(report)),
        "",
        "## Methods",
        "",
    ]
    lines += table(
        ["method", "asked for", "threshold"], [[m["name"], f"`{m['spec']}`", m["threshold"]] for m in report["methods"]]
    )
    lines += [
        *_difference_lines(report),
        "",
        "## What the words mean",
        "",
    ]
    lines += [f"- {name}: {meaning}." for name, meaning in report["definitions"].items()]
    return "\n".join(lines) + "\n"


def _difference_lines(report: dict[str, Any]) -> list[str]:
    if not report["differences"]:
        return []
    rows = [
        [name, *(interval_text(difference[key]) for _, key in HEADLINES)]
        for name, difference in report["differences"].items()
    ]
    columns = ["method", *(heading for heading, _ in HEADLINES)]
    return ["", f"## Minus {report['reference']}, paired draws", "", *table(columns, rows)]
