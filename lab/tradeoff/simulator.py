"""Cost of accuracy in the simulator: signal level, effects, rays and cells against the most complete answer.

A group is one such choice; its settings are tried on the same cases (random places, bodies, walls), in a drawn order
that changes from round to round, so that drift of the machine hits all alike. One file a case: a run that was stopped
goes on. A setting that fails anywhere keeps its row, with the reason.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from threadpoolctl import threadpool_limits

from lab.full_wave.smooth import SMOOTH_WALLS
from lab.studies.report import (
    Provenance,
    Times,
    busy_lines,
    busy_reason,
    load_per_core,
    machine,
    quantiles_ms,
    versions,
)
from lab.studies.resumable import ResumableRun, charged
from lab.tradeoff.simulator_cases import BODIES, GROUPS, SAME_DB, Case, Clock, Value, setting_name
from mirrorwave.plots.markdown import table
from msgs.values.wording import counted


class SimulatorPlan(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Plan that fixes the accuracy of a run: the cases of a seeded series in each group, how often each is timed."""

    seed: int
    repeats: int
    #: Beams of a scan that the literal level runs.
    literal_beams: int
    #: Cases of each group, and its settings where they are not the group's own.
    cases: dict[str, int]
    settings: dict[str, list[Value]] = {}

    @property
    def jobs(self) -> list[tuple[str, int]]:
        """Every case of every group, in order."""
        return [(name, index) for name, count in self.cases.items() for index in range(count)]

    def settings_of(self, group: str) -> list[Value]:
        """Return the settings to try."""
        return self.settings.get(group) or list(GROUPS[group].settings)


def simulator_plan(full: bool, seed: int) -> SimulatorPlan:
    """Places for a coffee, or for the record; `len(plan.jobs)` is how often `run_simulator` ticks."""
    levels, places = (8, 30) if full else (2, 3)
    cases = {"signal level": levels, "rays": len(BODIES), "fdtd": len(SMOOTH_WALLS)}
    cases |= dict.fromkeys(("effect budget", "all but"), places)
    ordered = {name: cases[name] for name in GROUPS}
    return SimulatorPlan(seed=seed, repeats=2, literal_beams=3 if full else 1, cases=ordered)


class CaseResult(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """One case: of each setting its errors by measure, and milliseconds by part and repetition."""

    group: str
    index: int
    case: str
    errors: dict[str, dict[str, float]]
    times_ms: dict[str, dict[str, list[float]]]
    #: Settings that failed, and why in one line.
    failed: dict[str, str]
    #: `load_per_core` before the run.
    load_before: float = 0.0


@dataclass
class _Tries:
    """The settings of one group on one case."""

    group: str
    case: Case
    values: list[Value]
    answers: dict[Value, Any] = field(default_factory=dict)
    times_ms: dict[str, dict[str, list[float]]] = field(default_factory=dict)
    failed: dict[str, str] = field(default_factory=dict)

    def repeat(self, rng: np.random.Generator) -> None:
        """Every setting once, in a drawn order, but those that are dear and known."""
        for value in (self.values[position] for position in rng.permutation(len(self.values))):
            name = setting_name(self.group, value)
            if name in self.failed or (value in self.case.once and value in self.answers):
                continue
            with charged(self.failed, name):
                clock = Clock()
                self.answers[value] = self.case.answer(value, clock)
                own = self.times_ms.setdefault(name, {})
                for part, milliseconds in clock.ms.items():
                    own.setdefault(part, []).append(milliseconds)

    def result(self, index: int) -> CaseResult:
        """Errors against the most complete answer; without it all have failed."""
        errors: dict[str, dict[str, float]] = {}
        with charged(self.failed, *(setting_name(self.group, value) for value in self.values)):
            truth = self.case.truth(self.answers)
            for value, answer in self.answers.items():
                name = setting_name(self.group, value)
                with charged(self.failed, name):
                    errors[name] = self.case.errors(answer, truth)
        return CaseResult(
            group=self.group,
            index=index,
            case=self.case.name,
            errors=errors,
            times_ms=self.times_ms,
            failed=self.failed,
        )


def measure(plan: SimulatorPlan, group: str, index: int) -> CaseResult:
    """All settings of a group on one case."""
    tries = _Tries(group, GROUPS[group].case(plan.seed, index, plan.literal_beams), plan.settings_of(group))
    rng = np.random.default_rng([plan.seed, index, 1])
    with threadpool_limits(1, "blas"):
        for _ in range(plan.repeats):
            tries.repeat(rng)
        return tries.result(index)


def warm_up(plan: SimulatorPlan, group: str) -> None:
    """The first call of anything compiles, allocates, fills tables; the dear ones have nothing to warm."""
    case = GROUPS[group].case(plan.seed, 0, plan.literal_beams)
    values = [value for value in plan.settings_of(group) if value not in case.once]
    with threadpool_limits(1, "blas"):
        _Tries(group, case, values).repeat(np.random.default_rng(0))


def run_simulator_plan(plan: SimulatorPlan, out: Path, tick: Callable[[], None] = lambda: None) -> list[CaseResult]:
    """Measure what is not there yet; the results of all cases, in order.

    Raises `ValueError` where `out` holds another run.
    """
    files = {(group, index): f"{group.replace(' ', '-')}-{index:05d}.msgpack" for group, index in plan.jobs}
    run = ResumableRun(plan, out / "simulator", CaseResult, files)
    warm: set[str] = set()
    load_before = load_per_core()
    for group, index in run.missing(tick):
        if group not in warm:
            warm_up(plan, group)
            warm.add(group)
        run.keep((group, index), msgspec.structs.replace(measure(plan, group, index), load_before=load_before))
        tick()
    return run.results()


# --- report


class Spread(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """An error over the cases of a group."""

    median: float
    worst: float


class SimulatorRow(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """One setting: what it costs and how far it is off. A row that failed says why and holds no numbers."""

    group: str
    name: str
    value: Value
    failed: str | None = None
    #: By measure: `worst_cell_db`, `median_cell_db`; `field`; `r`.
    errors: dict[str, Spread] = {}
    #: Of `wall` and `cpu`, then wall time of each part; quantiles over cases and repetitions.
    times_ms: dict[str, Times] = {}


class SimulatorGroup(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """One choice: what its rows are measured by and against, and on what."""

    name: str
    about: str
    cases: list[str]


class SimulatorReport(Provenance, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A run: what it was made with, then its groups and rows."""

    repeats: int
    groups: list[SimulatorGroup]
    rows: list[SimulatorRow]
    #: Why the times do not count: the machine was busy. Empty where they do.
    busy: str = ""

    def of(self, group: str) -> list[SimulatorRow]:
        """Rows of a group that did not fail, in order."""
        return [row for row in self.rows if row.group == group and row.failed is None]


def run_simulator(
    out: Path, full: bool = False, seed: int = 11, tick: Callable[[], None] = lambda: None
) -> SimulatorReport:
    """The whole run, or what is left of it in `out`; `tick` is called after each job of `simulator_plan`."""
    plan = simulator_plan(full, seed)
    results = run_simulator_plan(plan, out, tick)
    return make_simulator_report(
        plan, results, f"mirrorwave tradeoff --simulator {'--full' if full else '--quick'} --seed {seed}"
    )


def make_simulator_report(plan: SimulatorPlan, results: Sequence[CaseResult], command: str) -> SimulatorReport:
    """All rows of a run."""
    groups, rows = [], []
    for group in plan.cases:
        mine = [result for result in results if result.group == group]
        groups.append(SimulatorGroup(name=group, about=GROUPS[group].about, cases=[answered.case for answered in mine]))
        rows += [_row(group, value, mine) for value in plan.settings_of(group)]
    return SimulatorReport(
        command=command,
        machine=machine(),
        versions=versions(),
        seed=plan.seed,
        repeats=plan.repeats,
        groups=groups,
        rows=rows,
        busy=busy_reason(max((result.load_before for result in results), default=0.0), _waited(results)),
    )


def _waited(results: Sequence[CaseResult]) -> float:
    """Return the share of the timed parts in which they had no core; parts that ran on several had all they wanted."""
    each = [times for result in results for times in result.times_ms.values()]
    wall_ms = np.array([ms for times in each for ms in times["wall"]])
    cpu_ms = np.array([ms for times in each for ms in times["cpu"]])
    return float(np.maximum(wall_ms - cpu_ms, 0.0).sum() / max(wall_ms.sum(), 1e-9))


def _row(group: str, value: Value, results: Sequence[CaseResult]) -> SimulatorRow:
    name = setting_name(group, value)
    reason = next((result.failed[name] for result in results if name in result.failed), None)
    if reason is not None:
        return SimulatorRow(group=group, name=name, value=value, failed=reason)
    errors = [result.errors[name] for result in results]
    times_ms = [result.times_ms[name] for result in results]
    return SimulatorRow(
        group=group,
        name=name,
        value=value,
        errors={measure: _spread([values[measure] for values in errors]) for measure in errors[0]},
        times_ms={
            part: quantiles_ms(np.array([ms for values in times_ms for ms in values[part]])) for part in times_ms[0]
        },
    )


def _spread(values: list[float]) -> Spread:
    return Spread(median=float(np.median(values)), worst=max(values))


ERROR_NAMES = {"worst_cell_db": "worst cell [dB]", "median_cell_db": "median cell [dB]", "field": "field", "r": "r"}


def simulator_markdown(report: SimulatorReport) -> str:
    """The report as a page: how it was made, then a table a group, failed rows in their place."""
    lines = [f"`{report.command}`: each timed {counted(report.repeats, 'time')}; {report.machine}; {report.packages}."]
    lines += busy_lines(report.busy)
    for group in report.groups:
        rows = [row for row in report.rows if row.group == group.name]
        sound = report.of(group.name)
        errors = list(sound[0].errors) if sound else []
        parts = [part for part in (sound[0].times_ms if sound else {}) if part not in ("wall", "cpu")]
        columns = [group.name, *(f"{ERROR_NAMES[name]}: median, worst case" for name in errors)]
        columns += ["wall p50 [ms]", "p90", "p99", "CPU p50", *(f"{part} p50" for part in parts)]
        lines += ["", f"## {group.name}", "", f"{group.about} {counted(len(group.cases), 'case')}.", ""]
        lines += table(columns, (_cells(row, errors, parts, len(columns)) for row in rows))
    return "\n".join(lines) + "\n"


def _cells(row: SimulatorRow, errors: list[str], parts: list[str], count: int) -> list[str]:
    """One row of its group's table."""
    if row.failed is not None:
        return [row.name, f"failed: {row.failed}", *[""] * (count - 2)]
    wall = row.times_ms["wall"]
    times_ms = [wall.p50, wall.p90, wall.p99, row.times_ms["cpu"].p50, *(row.times_ms[part].p50 for part in parts)]
    times = ["-" if time_ms is None else f"{time_ms:.4g}" for time_ms in times_ms]
    return [row.name, *(_error(name, row.errors[name]) for name in errors), *times]


def _error(name: str, spread: Spread) -> str:
    """Median and worst over the cases."""
    if not name.endswith("_db"):
        return f"{spread.median:.1e}, {spread.worst:.1e}"
    return ", ".join("same" if value <= SAME_DB else f"{value:.1f}" for value in (spread.median, spread.worst))
