"""Sets of random places with every profile on the same beams, as tables object by object."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from lab.evaluate.mot_tables import write_mot_tables
from lab.evaluate.place_runs import ObjectPlan, ObjectSet, PlaceResult, read_sets, run_objects, scenes_sha256
from lab.measures.drive_metrics import DriveReport, drive_report
from lab.measures.frame_scores import Estimate, bootstrap_weights
from lab.measures.object_metrics import (
    CROWDED_M,
    CURVE_FALSE,
    ObjectReport,
    ObjectScores,
    Ratio,
    mean_loss,
    object_report,
)
from lab.measures.object_rows import BANDS, FALSE_M, FOUND_M, NOTHING_M, ScanRow
from lab.measures.tracking_scores import GATE_M, TrackingScores
from lab.tradeoff.rows import profile_setting
from mirrorwave.console import progress_bar
from mirrorwave.plots.markdown import table
from msgs.values.wording import counted
from sim_player.scene.wall_priors import WallKnowledge

#: Title, columns, rows.
Table = tuple[str, Sequence[str], Sequence[Sequence[object]]]
#: Name of the set that options describe.
DRAWN = "drawn"
#: What the words of the tables mean.
DEFINITIONS = {
    "hidden": "out of direct sight, with at least one mirror that shows a part of it; asked in every scan",
    "found": f"a report of its own, one to one, errs by {FOUND_M:g} m at most",
    "error": "from the position of the report to the nearest visible face of the true box or to its centre, whichever "
    "is nearer, the truth moved to the time of the report; `by centre`: to the true centre alone",
    "image": "strongest scattering centre among its images in the map, over the noise of the beam that sees it best",
    "another within 2 m": f"its centre within {CROWDED_M:g} m of that of another object out of sight",
    "at so many false": "reports of the highest scores, so many that this many a scan are false",
    "promised": "the view calls the cell of its centre observable by a mirror, for an object of 10 dBsm",
    "false": f"a report more than {FALSE_M:g} m from every object out of sight",
    "nothing there": f"a report more than {NOTHING_M:g} m from the box of every object, in sight or not",
    "without the gate": "error of every report against the nearest object out of sight, in places that hold one",
    "true": f"share of the reports of a score that found an object; within {FALSE_M:g} m: that are not false",
    "loss": "missed objects + false cost x false reports, a scan",
    "after 1 s in view": "of objects that mirrors have shown for 1 s without a gap, scan by scan, those that a "
    f"confirmed track stands on, one to one, within {FOUND_M:g} m",
    "false track": "one that in most of its scans is false and has nothing there; in plain sight: false, but something "
    "is there",
    "lead": "of objects that come into direct sight, from the first track on them; the most possible: from the first "
    "image of 10 dB or more",
    "MOTA, IDF1, HOTA": "confirmed tracks against the objects to be found, by the distance of centres alone, within "
    f"{GATE_M:g} m; similarity 1 - distance / {GATE_M:g} m; a track on anything else is false",
    "interval": "95 % percentile interval over places drawn with replacement; all profiles share the draws",
}


@dataclass(frozen=True, kw_only=True)
class ObjectRequest:
    """Request of the options."""

    sets: Sequence[str]
    profiles: Sequence[str]
    places: int | None
    moving: bool
    effects: str
    walls: WallKnowledge
    seed: int
    draws: int
    workers: int
    out: Path | None


def measured(request: ObjectRequest) -> dict[str, Any]:
    """Run all places that are not there yet; the whole report."""
    plans, false_cost = _plans(request)
    with ExitStack() as stack:
        out = stack.enter_context(_folder(request.out))
        tick = stack.enter_context(progress_bar("places", sum(plan.set.places for plan in plans.values())))
        runs = {name: run_objects(plan, out / name, request.workers, tick) for name, plan in plans.items()}
        for name, plan in plans.items():
            if plan.set.scans > 1:
                write_mot_tables(out / name / "mot", _rows_by_profile(plan, runs[name]))
    sets = {name: _set_report(plan, runs[name], request, false_cost) for name, plan in plans.items()}
    losses = {
        profile: mean_loss({name: set_report["profiles"][profile] for name, set_report in sets.items()})
        for profile in request.profiles
    }
    return {
        "definitions": DEFINITIONS,
        "draws": request.draws,
        "bootstrap_seed": request.seed,
        "false_cost": false_cost,
        "sets": sets,
        "mean_loss": losses,
    }


def _plans(request: ObjectRequest) -> tuple[dict[str, ObjectPlan], float]:
    """Each set with its profiles, and what a false report costs."""
    committed = read_sets()
    for name in request.sets:
        if name not in committed.sets:
            raise ValueError(f"--set must be one of {', '.join(committed.sets)}, got {name!r}")
    if request.sets and (request.places is not None or request.moving or request.effects != "all"):
        raise ValueError("--set says places, motion and effects itself: leave out --count, --moving and --effects")
    if len(set(request.profiles)) < len(request.profiles) or len(set(request.sets)) < len(request.sets):
        raise ValueError("--profile and --set must each name a thing once")
    sets = {name: committed.sets[name] for name in request.sets}
    if not sets:
        drawn = ObjectSet(
            seed=request.seed, places=request.places or 100, moving=request.moving, effects=request.effects
        )
        sets = {DRAWN: drawn}
    settings = [profile_setting(name) for name in request.profiles]
    plans = {
        name: ObjectPlan(set=object_set, profiles=settings, walls=request.walls) for name, object_set in sets.items()
    }
    return plans, committed.false_cost


@contextmanager
def _folder(out: Path | None) -> Iterator[Path]:
    """The folder asked for, else one that goes when the run ends."""
    if out is not None:
        out.mkdir(parents=True, exist_ok=True)
        yield out
        return
    with TemporaryDirectory(prefix="mirrorwave-") as folder:
        yield Path(folder)


def _rows_by_profile(plan: ObjectPlan, results: list[PlaceResult]) -> dict[str, list[ScanRow]]:
    return {
        profile.value: [row for result in results for row in result.rows[profile.value]] for profile in plan.profiles
    }


def _set_report(
    plan: ObjectPlan, results: list[PlaceResult], request: ObjectRequest, false_cost: float
) -> dict[str, Any]:
    """Measures of all profiles on one set."""
    weights = bootstrap_weights(plan.set.places, request.draws, request.seed)
    of_profiles = {name: ObjectScores(rows) for name, rows in _rows_by_profile(plan, results).items()}
    return {
        "seed": plan.set.seed,
        "places": plan.set.places,
        "moving": plan.set.moving,
        "effects": plan.set.effects,
        "scans": plan.set.scans,
        "shift": plan.set.shift,
        "world": plan.set.world,
        "walls": plan.walls,
        "scenes_sha256": scenes_sha256(results),
        "profiles": {name: object_report(scores, weights, false_cost) for name, scores in of_profiles.items()},
        "tracks": {name: drive_report(scores, weights) for name, scores in of_profiles.items() if plan.set.scans > 1},
    }


def tables(results: Mapping[str, Any]) -> Iterator[Table]:
    """All tables of a report, for a terminal or a page."""
    for name, set_report in results["sets"].items():
        motion = "in motion" if set_report["moving"] or set_report["scans"] > 1 else "at rest"
        motion += f", {set_report['scans']} scans each" if set_report["scans"] > 1 else ""
        motion += f", shifted ({set_report['shift']})" if set_report["shift"] != "none" else ""
        motion += ", traced by a foreign tracer" if set_report["world"] == "foreign" else ""
        motion += f", walls of a map ({set_report['walls']})" if set_report["walls"] != "none" else ""
        reports: dict[str, ObjectReport] = set_report["profiles"]
        title = f"{name}: {counted(set_report['places'], 'place')} {motion}, seed {set_report['seed']}"
        title += f", effects {set_report['effects']}"
        yield headline(f"{title}; scenes {set_report['scenes_sha256'][:16]}...", reports)
        yield _aims(name, reports)
        yield _recalls(f"{name}: found by the SNR of the strongest image", BANDS, reports, "recall_by_band")
        classes = sorted({kind for report in reports.values() for kind in report.recall_by_class})
        yield _recalls(f"{name}: found by class", classes, reports, "recall_by_class")
        yield _classes(name, reports)
        yield position_errors(name, reports)
        yield _scores(name, reports)
        yield _curve(name, reports)
        if set_report["tracks"]:
            yield _tracks(name, set_report["tracks"])
            yield standard_scores(name, set_report["tracks"])
    if len(results["sets"]) > 1:
        rows = [(profile, f"{loss:.3f}") for profile, loss in results["mean_loss"].items()]
        yield f"mean loss over the sets, false cost {results['false_cost']:g}", ("profile", "loss a scan"), rows


HEADINGS = ("profile", "hidden objects found", "vehicles", "by centre", "reports", "false", "nothing there",
            "false a scan", "loss a scan", "AP at 1 m", "AP at 2 m")  # fmt: skip


def headline(title: str, reports: Mapping[str, ObjectReport]) -> Table:
    """Return the figures that come first."""
    return title, HEADINGS, [_headline(profile, report) for profile, report in reports.items()]


def _headline(profile: str, report: ObjectReport) -> tuple[object, ...]:
    return (
        profile,
        str(report.recall),
        _short(report.recall_vehicles),
        _short(report.recall_by_centre),
        report.reports,
        str(report.false),
        _short(report.nothing),
        _rate(report.false_per_scan),
        _rate(report.loss),
        _rate(report.average_precision),
        _rate(report.average_precision_2_m),
    )


def _aims(name: str, reports: Mapping[str, ObjectReport]) -> Table:
    """Return what a driver asks: objects that one mirror shows well, reports of nothing, how sure of it."""
    columns = ("profile", "one mirror, 25 dB on", "15 to 25 dB", "pedestrians, bicycles, 25 dB on",
               "another within 2 m", "vehicles where promised", "nothing there, a scan", "in plain sight, a scan",
               "in the 95 % ellipse", "NEES")  # fmt: skip
    rows = [
        (
            profile,
            str(report.recall_single_25_db),
            _short(report.recall_single_15_db),
            _short(report.recall_vulnerable_25_db),
            _short(report.recall_crowded),
            _short(report.recall_promised),
            _rate(report.nothing_per_scan),
            _rate(report.in_sight_per_scan),
            str(report.inside_ellipse),
            _rate(report.nees),
        )
        for profile, report in reports.items()
    ]
    return f"{name}: shown by one mirror alone; false reports by kind; covariances", columns, rows


def _tracks(name: str, reports: Mapping[str, DriveReport]) -> Table:
    """Return what is said of objects over a drive."""
    columns = ("profile", "after 1 s in view", "by one mirror, 25 dB on", "false tracks a minute",
               "in plain sight, a minute", "id switches an object", "class changes a scan",
               "velocity error, first scan: p50, p90 [m/s]", "after 1 s", "lead of the most possible [s]")  # fmt: skip
    rows = [
        (
            profile,
            str(report.recall_after_1_s),
            str(report.recall_25_db_after_1_s),
            _rate(report.false_tracks_per_minute),
            _rate(report.in_sight_tracks_per_minute),
            _short(report.id_switches),
            _short(report.class_changes),
            _quantile_pair(report.first_velocity_error_mps),
            _quantile_pair(report.later_velocity_error_mps),
            str(report.lead),
        )
        for profile, report in reports.items()
    ]
    return f"{name}: confirmed tracks", columns, rows


def standard_scores(name: str, reports: Mapping[str, DriveReport]) -> Table:
    """Return what other trackers are compared by."""
    columns = ("profile", "MOTA", "IDF1", "HOTA", "DetA", "AssA", "LocA", "GOSPA [m]", "its pairs, missed, false [m2]")
    rows = [
        (
            profile,
            *(_rate(getattr(report.standard, field)) for field in TrackingScores.__struct_fields__),
            _rate(report.gospa_m),
            _parts(report.gospa_pairs_m2, report.gospa_missed_m2, report.gospa_false_m2),
        )
        for profile, report in reports.items()
    ]
    return f"{name}: tracks by standard scores", columns, rows


def _parts(*ratios: Ratio) -> str:
    return ", ".join("-" if ratio.value is None else f"{ratio.value:.2f}" for ratio in ratios)


def _quantile_pair(estimates: Mapping[str, Estimate]) -> str:
    return ", ".join(f"{estimates[name].value:.2f}" for name in ("p50", "p90")) if estimates else "-"


def _short(ratio: Ratio) -> str:
    return "-" if ratio.value is None else f"{ratio.part:g} of {ratio.whole:g} ({ratio.value:.2f})"


def _rate(ratio: Ratio | Estimate) -> str:
    if ratio.value is None or math.isnan(ratio.value):
        return "-"
    return f"{ratio.value:.2f} [{ratio.low:.2f}, {ratio.high:.2f}]"


def _recalls(title: str, groups: Sequence[str], reports: Mapping[str, ObjectReport], name: str) -> Table:
    rows = [
        (profile, *(_short(getattr(report, name)[group]) for group in groups)) for profile, report in reports.items()
    ]
    return title, ("profile", *groups), rows


def _classes(name: str, reports: Mapping[str, ObjectReport]) -> Table:
    """Return the classes that reports say of found objects."""
    kinds = sorted({said for report in reports.values() for row in report.classes.values() for said in row})
    rows = [
        (profile, true, *(row.get(said, 0) for said in kinds))
        for profile, report in reports.items()
        for true, row in report.classes.items()
    ]
    return f"{name}: class of found objects, and how often each is reported", ("profile", "true class", *kinds), rows


def _curve(name: str, reports: Mapping[str, ObjectReport]) -> Table:
    """Return the curve of recall against false reports."""
    rates = [f"{rate:g}" for rate in CURVE_FALSE]
    rows = [(profile, *(report.recall_at_false.get(rate) for rate in rates)) for profile, report in reports.items()]
    return f"{name}: found of one mirror, 25 dB on, at so many false reports a scan", ("profile", *rates), rows


def position_errors(name: str, reports: Mapping[str, ObjectReport]) -> Table:
    """Quantiles of the errors of what was found, and of all reports."""
    kinds = {
        "found, centre": "centre_found_m",
        "found, nearest visible face": "error_found_m",
        "without the gate, centre": "centre_ungated_m",
        "without the gate, nearest visible face": "error_ungated_m",
    }
    rows = [
        (
            profile,
            kind,
            *(f"{estimate.value:.2f} [{estimate.low:.2f}, {estimate.high:.2f}]" for estimate in estimates.values()),
        )
        for profile, report in reports.items()
        for kind, field in kinds.items()
        if (estimates := _estimates(report, field))
    ]
    return f"{name}: position error [m]", ("profile", "of", "p50", "p75", "p90", "p95"), rows


def _estimates(report: ObjectReport, field: str) -> dict[str, Estimate]:
    estimates: dict[str, Estimate] = getattr(report, field)
    return estimates


def _scores(name: str, reports: Mapping[str, ObjectReport]) -> Table:
    """Return the evaluation of the scores as probabilities."""
    rows = [
        (
            *(profile, f"{score_bin.low:g}..{score_bin.high:g}", score_bin.mean_score),
            *(str(score_bin.found), _short(score_bin.near)),
        )
        for profile, report in reports.items()
        for score_bin in report.scores
        if score_bin.found.whole
    ]
    errors = ", ".join(
        f"{profile} {report.calibration_error:.2f}"
        for profile, report in reports.items()
        if report.calibration_error is not None
    )
    columns = ("profile", "score", "mean", "true", "within 2 m")
    return f"{name}: scores and the share that is true; calibration error {errors or '-'}", columns, rows


def page(results: Mapping[str, Any], all_tables: Iterable[Table]) -> str:
    """The tables as Markdown."""
    lines = ["# Hidden objects, object by object", ""]
    lines += [f"- {word}: {meaning}" for word, meaning in results["definitions"].items()]
    for title, columns, rows in all_tables:
        lines += ["", f"## {title}", "", *table(columns, ([_text(cell) for cell in row] for row in rows))]
    return "\n".join(lines) + "\n"


def _text(cell: object) -> str:
    if cell is None:
        return "-"
    return f"{cell:.2f}" if isinstance(cell, float) else str(cell)
