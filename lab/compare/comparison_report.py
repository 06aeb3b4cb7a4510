"""Report of a comparison: each sensor over each sweep beside its closed form, where it ends, why; JSON and Markdown."""

from __future__ import annotations

import math
from collections.abc import Sequence

import msgspec
import numpy as np

from lab.compare.detection_snr import half_range, radar_threshold
from lab.compare.sensors import FALSE_ALARM, SENSORS, Equal, Sensor, SpadSensor
from lab.compare.sweeps import SWEEPS, Plan, SceneResult, Seen, Value
from lab.measures.frame_scores import INTERVAL, bootstrap_weights
from lab.studies.report import DRAWS, Interval, Provenance, machine, versions
from mirrorwave.plots.markdown import table
from models.physics.fresnel import coherent_power
from models.physics.link_budget import spad_threshold
from msgs.values.units import db_from_ratio
from msgs.values.wording import counted

#: Measures of a row over which a sensor's reach is asked for.
MEASURES = {"f1_1m": "F1 within 1 m", "f1_2m": "F1 within 2 m", "found": "objects found"}
#: Reach of a sensor is compared with that of the first of these that ran.
REFERENCE = ("xband", "77ghz")
#: Sweeps of range, and the one of roughness.
RANGE_SWEEPS, ROUGHNESS = ("range", "range_glass", "range_metal"), "roughness"
#: Two levels agree with their closed form where noise adds little: this far over the threshold.
CLEAR_DB = 6.0


class Row(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """One sensor at one value of a sweep, over all viewpoints; where none could be looked at, the reason alone."""

    sweep: str
    value: Value
    sensor: str
    #: Viewpoints that were looked at, and why the first of the others was not.
    scans: int
    failed: str | None = None
    f1_1m: Interval | None = None
    f1_2m: Interval | None = None
    #: Share of hidden objects with a recovered point within 2 m of their box.
    found: Interval | None = None
    #: A scan: recovered points with no truth within 2 m, and groups of points near no object.
    false_points: float | None = None
    false_objects: float | None = None
    #: Medians over viewpoints: strongest cell at the images over the mean noise, and its closed form.
    snr_db: float | None = None
    predicted_snr_db: float | None = None
    #: What roughness took off that level against a smooth wall (same viewpoints), and (1/rho)^2 of Eq. (15) where the
    #: points shown meet the wall nearest to grazing, and farthest from it.
    loss_db: float | None = None
    least_loss_db: float | None = None
    most_loss_db: float | None = None
    seconds: float | None = None


class Reach(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Value at which one sensor's measure last falls below half of its best over a sweep."""

    sweep: str
    sensor: str
    measure: str
    best: float
    #: Interpolated; 0 where the best is chance: 0 lies in its interval. Where the measure holds to the sweep's last
    #: value that value, and `at_least` is true.
    half: float
    at_least: bool
    #: The values between which it was interpolated; None where it was not.
    between: tuple[float, float] | None = None
    #: The reach of the sensor that `reference` names over this one; None where either has none.
    reference: str | None = None
    ratio: float | None = None
    ratio_at_least: bool = False


class Report(Provenance, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A run: what it was made with, rows and reaches."""

    viewpoints: int
    equal: Equal
    sensors: dict[str, str]
    #: Of one scan.
    energy_j: dict[str, float]
    #: Level of a cell, over the mean noise, that noise alone passes with `FALSE_ALARM`.
    threshold_db: dict[str, float]
    rows: list[Row]
    reaches: list[Reach]

    def of(self, sweep: str, sensor: str | None = None) -> list[Row]:
        """Rows of a sweep that hold numbers, in order; of one sensor where it is named."""
        mine = (row for row in self.rows if row.sweep == sweep and row.scans)
        return [row for row in mine if sensor is None or row.sensor == sensor]


def make_report(plan: Plan, results: Sequence[SceneResult], command: str) -> Report:
    """All rows of a run."""
    rows = [
        _row(plan, results, sweep, index, sensor)
        for sweep, values in plan.values.items()
        for index in range(len(values))
        for sensor in plan.sensors
    ]
    return Report(
        command=command,
        machine=machine(),
        versions=versions(),
        seed=plan.seed,
        viewpoints=plan.viewpoints,
        equal=plan.equal,
        sensors={name: SENSORS[name].title for name in plan.sensors},
        energy_j={name: SENSORS[name].energy_j(plan.equal) for name in plan.sensors},
        threshold_db={name: threshold_db(SENSORS[name]) for name in plan.sensors},
        rows=rows,
        reaches=_reaches(plan, rows),
    )


def threshold_db(sensor: Sensor) -> float:
    """Return the power that a cell must exceed to count, dB over the mean noise."""
    law = spad_threshold if isinstance(sensor, SpadSensor) else radar_threshold
    return db_from_ratio(float(law(FALSE_ALARM)))


def _row(plan: Plan, results: Sequence[SceneResult], sweep: str, index: int, sensor: str) -> Row:
    """All viewpoints of one value."""
    value = plan.values[sweep][index]
    mine = [item for item in results if (item.sweep, item.index) == (sweep, index)]
    looks = [item.seen[sensor] for item in mine]
    reason = next((item.failed for item in looks if item.failed is not None), None)
    scores = [item.score for item in looks if item.score is not None]
    row = Row(sweep=sweep, value=value, sensor=sensor, scans=len(scores), failed=reason)
    if not scores:
        return row
    loss = _loss(plan, results, mine, sensor) if sweep == ROUGHNESS else (None, None, None)
    return msgspec.structs.replace(
        row,
        f1_1m=_f1([item.within_1m for item in scores]),
        f1_2m=_f1([item.within_2m for item in scores]),
        found=_share([item.found for item in scores], [item.hidden for item in scores]),
        false_points=float(np.mean([item.within_2m[1] for item in scores])),
        false_objects=float(np.mean([item.false_objects for item in scores])),
        snr_db=_median([item.snr_db for item in scores]),
        predicted_snr_db=_median([item.predicted_snr_db for item in looks]),
        loss_db=loss[0],
        least_loss_db=loss[1],
        most_loss_db=loss[2],
        seconds=_median([item.seconds for item in looks]),
    )


def _median(values: Sequence[float | None]) -> float | None:
    present = [value for value in values if value is not None]
    return float(np.median(present)) if present else None


def _f1(counts: Sequence[tuple[int, int, int]]) -> Interval:
    """F1 of counts summed over scans, with its interval over draws of the scans; one where there was nothing at all."""
    true, false, missed = np.array(counts, np.float64).T
    return _ratio(2.0 * true, 2.0 * true + false + missed, empty=1.0)


def _share(part: Sequence[int], whole: Sequence[int]) -> Interval:
    """A share of sums over scans; none where there is nothing to share."""
    return _ratio(np.array(part, np.float64), np.array(whole, np.float64), empty=math.nan)


def _ratio(above: np.ndarray, below: np.ndarray, empty: float) -> Interval:
    weights = np.concatenate([np.ones((1, len(above))), bootstrap_weights(len(above), DRAWS, seed=0)])
    total = weights @ below
    values = np.divide(weights @ above, total, out=np.full(len(total), empty), where=total > 0.0)
    if not math.isfinite(values[0]):
        return Interval(value=None, low=None, high=None)
    if len(above) == 1:
        # one viewpoint does not say how viewpoints differ
        return Interval(value=float(values[0]), low=None, high=None)
    low, high = np.nanpercentile(values[1:], INTERVAL)
    return Interval(value=float(values[0]), low=float(low), high=float(high))


def _loss(
    plan: Plan, results: Sequence[SceneResult], mine: Sequence[SceneResult], sensor: str
) -> tuple[float | None, float | None, float | None]:
    """Medians over viewpoints of what roughness took [dB]: against the smooth wall; least and most by Eq. (15)."""
    values = plan.values[ROUGHNESS]
    smooth = {
        result.viewpoint: _level(result.seen[sensor])
        for result in results
        if result.sweep == ROUGHNESS and values[result.index] == 0.0
    }
    measured, lower, upper = [], [], []
    for result in mine:
        before_db, after_db = smooth.get(result.viewpoint), _level(result.seen[sensor])
        if before_db is not None and after_db is not None:
            measured.append(before_db - after_db)
        if result.cos_incidence is not None:
            roughness_m = 1e-3 * float(values[result.index])
            lower.append(roughness_loss_db(SENSORS[sensor], roughness_m, result.cos_incidence[0]))
            upper.append(roughness_loss_db(SENSORS[sensor], roughness_m, result.cos_incidence[1]))
    return _median(measured), _median(lower), _median(upper)


def _level(look: Seen) -> float | None:
    return None if look.score is None else look.score.snr_db


def roughness_loss_db(sensor: Sensor, roughness_m: float, cos_incidence: float) -> float:
    """exp(-(4 pi s cos / lambda)^2) at each of two bounces, in the level of a map: for photons that is squared."""
    share = float(coherent_power(np.array(roughness_m), np.array(cos_incidence), sensor.wavelength_m))
    bounces = 4.0 if isinstance(sensor, SpadSensor) else 2.0
    return -bounces * db_from_ratio(max(share, 1e-300))


def _reaches(plan: Plan, rows: Sequence[Row]) -> list[Reach]:
    """Half ranges of all sensors over the sweeps of numbers that a sensor loses with, and ratios to the reference's."""
    reaches = []
    for sweep in (*RANGE_SWEEPS, ROUGHNESS):
        for measure in MEASURES if sweep in plan.values else ():
            mine = [_reach(rows, sweep, sensor, measure) for sensor in plan.sensors]
            by_sensor = {reach.sensor: reach for reach in mine if reach is not None}
            reference = next((by_sensor[name] for name in REFERENCE if name in by_sensor), None)
            reaches += [_against(reach, reference) for reach in by_sensor.values()]
    return reaches


def _reach(rows: Sequence[Row], sweep: str, sensor: str, measure: str) -> Reach | None:
    points: list[tuple[float, Interval]] = []
    for row in rows:
        interval = getattr(row, measure) if (row.sweep, row.sensor) == (sweep, sensor) else None
        if interval is not None and interval.value is not None:
            points.append((float(row.value), interval))
    if len(points) < 2:
        return None
    points.sort(key=lambda point: point[0])
    at, value = np.array([position for position, _ in points]), np.array([interval.value for _, interval in points])
    best = int(value.argmax())
    half = half_range(at, value) if points[best][1].low != 0.0 else 0.0
    after = int(np.searchsorted(at, half)) if 0.0 < half < at[-1] else 0
    return Reach(
        sweep=sweep,
        sensor=sensor,
        measure=measure,
        best=float(value[best]),
        half=float(min(half, at[-1])),
        at_least=math.isinf(half),
        between=(float(at[after - 1]), float(at[after])) if after else None,
    )


def _against(reach: Reach, reference: Reach | None) -> Reach:
    if reference is None or reference is reach or not reference.half or not reach.half or reach.at_least:
        return reach
    ratio = reference.half / reach.half
    return msgspec.structs.replace(reach, reference=reference.sensor, ratio=ratio, ratio_at_least=reference.at_least)


def clear(report: Report, row: Row) -> bool:
    """Return whether a level stands so far over its threshold that noise adds little to it."""
    return row.snr_db is not None and row.snr_db >= report.threshold_db[row.sensor] + CLEAR_DB


COLUMNS = (
    "sensor", "F1 1 m", "F1 2 m", "found", "false points", "false objects", "SNR [dB]", "closed form",
    "loss [dB]", "closed form", "time [s]",
)  # fmt: skip


#: What a narrow terminal leaves out, the first of them first.
LEAST = ("time [s]", "closed form", "loss [dB]", "false objects", "SNR [dB]", "F1 2 m", "found", "false points")


def cells(row: Row) -> list[str]:
    """A row as its value and `COLUMNS`."""
    if not row.scans:
        return [str(row.value), row.sensor, "failed", *[""] * (len(COLUMNS) - 2)]
    return [
        f"{row.value:g}" if isinstance(row.value, float) else row.value,
        row.sensor if row.failed is None else f"{row.sensor} ({counted(row.scans, 'scan')})",
        *(_with_interval(interval) for interval in (row.f1_1m, row.f1_2m, row.found)),
        *(_one_digit(value) for value in (row.false_points, row.false_objects, row.snr_db, row.predicted_snr_db)),
        _one_digit(row.loss_db),
        _span(row.least_loss_db, row.most_loss_db),
        "-" if row.seconds is None else f"{row.seconds:.2f}",
    ]


def _one_digit(value: float | None) -> str:
    """A number for people; a level no receiver knows is not spelled out."""
    return "-" if value is None else "below -100" if value < -100.0 else f"{value + 0.0:.1f}".replace("-0.0", "0.0")


def _span(min_db: float | None, max_db: float | None) -> str:
    """A closed form's band; a loss that no sensor could measure is not spelled out."""
    if min_db is None or max_db is None:
        return "-"
    return "over 200" if min_db > 200.0 else f"{min_db:.1f} to {max_db:.1f}"


def _with_interval(interval: Interval | None) -> str:
    if interval is None or interval.value is None:
        return "-"
    if interval.low is None or interval.high is None:
        return f"{interval.value:.2f}"
    return f"{interval.value:.2f} [{interval.low:.2f}, {interval.high:.2f}]"


ABOUT = (
    "Every sensor looks at the same scenes from the same viewpoints and sends 1.6 mW. Each map lies on the same grid "
    "and goes through the same detector (false alarms of noise alone: {false_alarm:g} a cell), the same known walls "
    "and folding; the truth is what the mirror shows of the hidden object, whatever the sensor's power. F1: points "
    "recovered within 1 m or 2 m of truth points, all viewpoints together, with the 95 % interval over draws of "
    "viewpoints; the smaller gate asks for a place, the larger for the object's side. Found: objects with a recovered "
    "point within 2 m of their box. False points lie 2 m or more from any truth point; false objects are groups of "
    "points within 2 m of each other and of no object. SNR: strongest cell at the images over the map's mean noise, "
    "median; of photon counts the squared excess over ambient light in standard deviations, -30 dB where there is none "
    "(beyond the period). Its closed form takes the object for one point of its class's mean echo. Time: from the "
    "scene to the map, one process."
)
EQUAL_ABOUT = {
    "power": "Equal power: each sensor measures for its own time",
    "energy": "Equal energy: each sensor may send as much in a scan as X-band does",
}


def markdown(report: Report) -> str:
    """The report as a page: how it was made, what it says, then a table a sweep."""
    energies = ", ".join(f"{report.sensors[name]} {1e3 * value:.3g} mJ" for name, value in report.energy_j.items())
    lines = [
        f"`{report.command}`; viewpoints of a value: {report.viewpoints}, series {report.seed}; {report.machine}; "
        f"{report.packages}.",
        "",
        ABOUT.format(false_alarm=FALSE_ALARM),
        "",
        f"{EQUAL_ABOUT[report.equal]}; energy of a scan: {energies}.",
    ]
    lines += _reach_table(report)
    for sweep in dict.fromkeys(row.sweep for row in report.rows):
        rows = [row for row in report.rows if row.sweep == sweep]
        lines += ["", f"## {SWEEPS[sweep].title}", "", *table(("value", *COLUMNS), map(cells, rows))]
    return "\n".join(lines) + "\n"


def _reach_table(report: Report) -> list[str]:
    """Half ranges by measure, with ratios."""
    if not report.reaches:
        return []
    rows = []
    for reach in report.reaches:
        half = f"> {reach.half:g}" if reach.at_least else f"{reach.half:.3g}" if reach.half else "none"
        between = "-" if reach.between is None else f"{reach.between[0]:g} and {reach.between[1]:g}"
        ratio = "-"
        if reach.ratio is not None and reach.reference is not None:
            ratio = f"{report.sensors[reach.reference]} {'> ' if reach.ratio_at_least else ''}{reach.ratio:.3g} x"
        words = (SWEEPS[reach.sweep].title, report.sensors[reach.sensor], MEASURES[reach.measure])
        rows.append((*words, f"{reach.best:.2f}", half, between, ratio))
    columns = ("sweep", "sensor", "measure", "best", "half at", "between", "against it")
    return ["", "## Where each falls below half of its best", "", *table(columns, rows)]
