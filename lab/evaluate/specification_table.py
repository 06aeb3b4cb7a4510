"""Table 5 of the specification, and its baselines, from shipped weights: its systems and ours on the same raw beams.

Nothing is trained. Places are drawn by a seed, each a sequence of its own. One file a place: a run that was stopped
goes on. A system whose weights are not there keeps its reason.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
import numpy as np
from threadpoolctl import threadpool_limits

from lab.evaluate.cfar_nlos import privileged_peaks
from lab.evaluate.labelled_beams import LabelledPlace
from lab.evaluate.method_runs import answer_of
from lab.measures.frame_scores import FrameScores, bootstrap_weights, estimates, score_frames
from lab.measures.object_metrics import ObjectScores, object_estimates
from lab.measures.object_rows import scan_row
from lab.studies.report import DRAWS, Interval, Provenance, Times, machine, quantiles_ms, versions
from lab.studies.resumable import ResumableRun, charged
from lab.tradeoff.row_runs import FrameResult, PlaceTruth
from mirrorwave.node_chain import SharedParts
from mirrorwave.plots.markdown import table
from mirrorwave.profiles import DEFAULT, read_profile
from models.perception.find.encoding import COMPLEX
from models.perception.find.onnx_model import ModelCard, load_card
from models.perception.form.ra_former import RaFormer
from models.perception.mirrors.peaks_to_view import fold_scan
from models.perception.track.views_over_scans import judged_params
from msgs.files.shipped import WEIGHTS
from msgs.values.perception import BevFrame, Peaks
from msgs.values.radar import PRESETS, RangeAzimuthMap
from msgs.values.wording import counted
from nodes.process.validation import merged
from sim_player.dataset.executors import map_jobs

SPECIFICATION = "specification"
MS_PER_S = 1e3


class Published(NamedTuple):
    """Figures of the published tables; None where they have none."""

    dense_f1: float | None = None
    dense_chamfer_m2: float | None = None
    recovered_f1: float | None = None
    recovered_chamfer_m2: float | None = None


class _System(NamedTuple):
    """A row of the published tables: family of its weights, parameters of its size there in millions."""

    label: str
    family: str
    published: Published
    residual: bool = True
    millions: float | None = None


SWIN = "Swin-UNet"
SYSTEMS = (
    _System("CFAR-NLOS", "", Published(0.23, None, 0.03, 29.7)),
    _System("Further-than-CFAR", "further_than_cfar", Published(0.41, None, 0.16, 13.5)),
    _System("RTN", "radar_tensor_network", Published(0.57, None, 0.20, 14.0)),
    _System("UNet", "unet", Published(0.67, 44.0, 0.27, 11.93)),
    _System(f"{SWIN} without residual", "swin_unet", Published(0.85, 17.3, 0.40, 9.20), False, 41.39),
    _System(f"{SWIN} with residual", "swin_unet", Published(0.85, 17.3, 0.45, 8.16), True, 41.39),
)
#: Measures by column; the published figure of each stands beside it.
COMPARED = {
    "dense F1": "dense_macro_f1",
    "dense CD [m2]": "dense_macro_chamfer_m2",
    "recovered F1": "recovered_1m_f1",
    "recovered CD [m2]": "recovered_chamfer_m2",
}
#: Further columns, without a published figure.
OWN = {
    "dense CD [m]": "dense_macro_chamfer_m",
    "recovered CD [m]": "recovered_chamfer_m",
    "objects found": "object_recall",
    "object F1": "object_f1",
    "false a scan": "false_objects_per_scan",
}
COMMON_REASON = (
    "all rows: places, echoes and truth are those of this simulator, truth thinned to what a map can tell apart; no "
    "frame is skipped, where the released code leaves out those without a mirrored prediction"
)


class Row(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """One system as it runs: parameters of its nodes, and the hash of its network."""

    name: str
    label: str
    params: dict[str, dict[str, Any]]
    sha256: str = ""
    #: It is told the true LOS points.
    privileged: bool = False


class TablePlan(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Plan that fixes the numbers of a run."""

    seed: int
    places: int
    rows: list[Row]
    effects: str = "all"


class RowReport(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """One system: measures with intervals, published figures, and why they differ; or why it could not run."""

    name: str
    failed: str = ""
    measures: dict[str, Interval] = {}
    published: dict[str, float | None] = {}
    #: From the map to the view.
    milliseconds: Times | None = None
    why: str = ""


class TableReport(Provenance, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The whole table."""

    places: int
    rows: list[RowReport]


def table_rows() -> list[Row]:
    """Rows in the order of the table: a row for each shipped size of a network, one that is missing where none is."""
    profile = read_profile(SPECIFICATION)
    plain = merged(profile, {"geometry": {"residual": "none"}})
    rows = []
    for system in SYSTEMS:
        geometry = {"geometry": (profile if system.residual else plain)["geometry"]}
        if not system.family:
            rows.append(
                Row(name=f"{system.label} (given the truth)", label=system.label, params=geometry, privileged=True)
            )
        for path, card in _weights(system.family) if system.family else ():
            network = {"dense_predictor": {**profile["dense_predictor"], "model": path.stem}}
            size = "" if card is None else f", {card.parameters / 1e6:.3g} M {card.precision}"
            rows.append(
                Row(
                    name=f"{system.label}{size}",
                    label=system.label,
                    params=network | geometry,
                    sha256="" if card is None else card.sha256,
                )
            )
    return [*rows, Row(name=DEFAULT, label=DEFAULT, params=read_profile(DEFAULT))]


def _weights(family: str) -> list[tuple[Path, ModelCard | None]]:
    """Shipped networks of a family with their cards, the smallest first; the compact one's name where there is none."""
    shipped: list[tuple[Path, ModelCard | None]] = []
    for path in sorted(WEIGHTS.glob("*.onnx"), key=lambda path: (path.stat().st_size, path.name)):
        # cards of other kinds are none of dense networks
        with suppress(ValueError):
            card = load_card(path)
            shipped += [(path, card)] if card.network == family else []
    return shipped or [(WEIGHTS / f"{family}.compact.onnx", None)]


def run_table(
    plan: TablePlan, out: Path, workers: int = 1, on_place: Callable[[], None] = lambda: None
) -> list[FrameResult]:
    """Measure the places that `out` does not hold yet; the results of all, in order.

    Raises `ValueError` where `out` holds another run.
    """
    run = ResumableRun(
        plan, out, FrameResult, {index: f"places/place-{index:05d}.msgpack" for index in range(plan.places)}
    )
    encoded = msgspec.json.encode(plan)
    for result in map_jobs(measure_place, [(encoded, index) for index in run.missing(on_place)], workers=workers):
        run.keep(result.frame, result)
        on_place()
    return run.results()


class Looked(NamedTuple):
    """What one system makes of a map."""

    row: Row
    peaks: Peaks
    frame: BevFrame
    scores: FrameScores
    times_ms: dict[str, list[float]]


def measure_place(job: tuple[bytes, int]) -> FrameResult:
    """All systems at one place of a plan (its JSON)."""
    plan, index = msgspec.json.decode(job[0], type=TablePlan), job[1]
    place, failed = LabelledPlace(plan.seed, index, plan.effects), dict[str, str]()
    with threadpool_limits(1, "blas"):
        truth = PlaceTruth.of(place)
        looks = list(looks_at(place, formed_map(place), truth, plan.rows, failed))
    return FrameResult(
        frame=index,
        counts={look.row.name: look.scores.counts[0].tolist() for look in looks},
        distances={look.row.name: look.scores.distances[0].tolist() for look in looks},
        objects={look.row.name: scan_row(index, look.frame.objects, truth.scene, truth.images) for look in looks},
        times_ms={look.row.name: look.times_ms for look in looks},
        failed=failed,
    )


def formed_map(place: LabelledPlace) -> RangeAzimuthMap:
    """The map of a place, from its raw beams, as the default profile forms it."""
    former = RaFormer(PRESETS["xband"])
    return next(ra_map for beam in place.beams() for ra_map in former.add(beam))


def looks_at(
    place: LabelledPlace, ra_map: RangeAzimuthMap, truth: PlaceTruth, rows: Iterable[Row], failed: dict[str, str]
) -> Iterator[Looked]:
    """What each system makes of a map; one that cannot run goes into `failed`."""
    detected: dict[bytes, tuple[Peaks, float]] = {}
    for row in rows:
        with charged(failed, row.name):
            parts = _parts(msgspec.json.encode(row.params))
            key = msgspec.json.encode([row.privileged, row.params.get("dense_predictor", {})])
            if key not in detected:
                start_ns = time.perf_counter_ns()
                peaks = _privileged_peaks(place, ra_map) if row.privileged else parts.detector.detect(ra_map)
                detected[key] = peaks, (time.perf_counter_ns() - start_ns) * 1e-6
            peaks, detection_ms = detected[key]
            views = parts.chain().views
            start_ns = time.perf_counter_ns()
            frame = views.view(peaks, ra_map)
            geometry_ms = (time.perf_counter_ns() - start_ns) * 1e-6
            params = judged_params(parts.placing.geometry, parts.predictor)
            scan = fold_scan(peaks, params, parts.residual)
            scores = score_frames([(answer_of(peaks, scan.recovered.points_m, scan.hidden), truth.points)])
            yield Looked(row, peaks, frame, scores, {"detection": [detection_ms], "geometry": [geometry_ms]})


@lru_cache(maxsize=32)
def _parts(params: bytes) -> SharedParts:
    """Parts of a system, loaded once a process."""
    return SharedParts.of(msgspec.json.decode(params), PRESETS["xband"])


def _privileged_peaks(place: LabelledPlace, ra_map: RangeAzimuthMap) -> Peaks:
    labels = place.labels
    return privileged_peaks(ra_map, labels.range_m, labels.azimuth_rad, labels.path_class)


def make_table(plan: TablePlan, results: Sequence[FrameResult], command: str) -> TableReport:
    """The table of a run."""
    weights = bootstrap_weights(len(results), DRAWS, seed=0)
    failed = {name: reason for result in results for name, reason in result.failed.items()}
    rows = [
        RowReport(name=row.name, failed=failed[row.name]) if row.name in failed else _row_report(row, results, weights)
        for row in plan.rows
    ]
    return TableReport(
        command=command, machine=machine(), versions=versions(), seed=plan.seed, places=len(results), rows=rows
    )


def _row_report(row: Row, results: Sequence[FrameResult], weights: np.ndarray) -> RowReport:
    scores = FrameScores(
        np.array([result.counts[row.name] for result in results], np.int64),
        np.array([result.distances[row.name] for result in results], np.float64),
    )
    objects = ObjectScores([result.objects[row.name] for result in results])
    known = estimates(scores, weights) | object_estimates(objects, weights)
    system = next((system for system in SYSTEMS if system.label == row.label), None)
    times_ms = [sum(samples[0] for samples in result.times_ms[row.name].values()) for result in results]
    return RowReport(
        name=row.name,
        measures={name: Interval.of(known[name]) for name in (*COMPARED.values(), *OWN.values())},
        published=dict(zip(COMPARED.values(), system.published if system else Published(), strict=True)),
        milliseconds=quantiles_ms(np.array(times_ms)),
        why=_why(row, system),
    )


def _why(row: Row, system: _System | None) -> str:
    """Why a row differs from the published one, as far as its card tells."""
    if system is None:
        return "not in the specification: pursuit, walls by likelihood, an object network"
    if row.privileged:
        return "ordered statistics on ridges; the published CFAR averages cells, which a wall fills"
    card = load_card(WEIGHTS / f"{row.params['dense_predictor']['model']}.onnx")
    training = card.training.get("config", {}).get("training", {})
    schedule = training.get("schedule", {})
    of_all = f" of {system.millions:g}" if system.millions else ""
    reasons = [f"{card.parameters / 1e6:.3g}{of_all} M parameters", card.precision]
    if "epochs" in schedule:
        reasons.append(f"{schedule['epochs']} epochs of 100, chosen {card.training.get('chosen_epoch', '?')}")
    if "--count" in (command := str(card.data.get("training", ""))):
        reasons.append(f"data of `{command}`")
    if training.get("init", "") == "" and system.family == "swin_unet":
        reasons.append("no ImageNet start")
    if card.encoding.channels != COMPLEX:
        reasons.append(f"input {', '.join(dict.fromkeys(card.encoding.channels))}")
    return "; ".join(reasons)


def columns() -> list[str]:
    """Headings of the table."""
    return ["method", *(f"{name} (published)" for name in COMPARED), *OWN, "map to view [ms]"]


def cells(report: TableReport, intervals: bool = False) -> list[list[str]]:
    """Lines of the table; systems that could not run have none."""
    return [_cells(row, intervals) for row in report.rows if not row.failed]


def _cells(row: RowReport, intervals: bool) -> list[str]:
    compared = [
        f"{_text(row.measures[key], intervals)} ({'-' if row.published[key] is None else f'{row.published[key]:g}'})"
        for key in COMPARED.values()
    ]
    own = [_text(row.measures[key], intervals) for key in OWN.values()]
    p50_ms = None if row.milliseconds is None else row.milliseconds.p50
    return [row.name, *compared, *own, "-" if p50_ms is None else f"{p50_ms:.0f}"]


def _text(interval: Interval, with_ends: bool) -> str:
    if interval.value is None:
        return "-"
    ends = f" [{interval.low:.3g}, {interval.high:.3g}]" if with_ends and interval.low is not None else ""
    return f"{interval.value:.3g}{ends}"


def reasons(report: TableReport) -> list[str]:
    """Lines under the table: why rows differ from the published ones, and which could not run."""
    return [f"{row.name}: {f'not run: {row.failed}' if row.failed else row.why}" for row in report.rows] + [
        COMMON_REASON
    ]


def markdown(report: TableReport) -> str:
    """The table for people."""
    lines = [
        f"# Table 5 on {counted(report.places, 'place')} of seed {report.seed}",
        "",
        f"`{report.command}`; {report.machine}; {report.packages}. 95 % intervals over places; published figures in "
        "parentheses, Chamfer in m2 as the published tables print it.",
        "",
        *table(columns(), cells(report, intervals=True)),
        "",
        *(f"- {line}" for line in reasons(report)),
    ]
    return "\n".join(lines) + "\n"
