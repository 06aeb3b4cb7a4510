"""The simulator's trade-off on two places and coarse cells: errors, resumption, failed rows, what it says."""

from __future__ import annotations

from pathlib import Path

import msgspec
import pytest

from lab.studies.report import write_report
from lab.tradeoff import simulator as tradeoff_simulator
from lab.tradeoff import simulator_cases as tradeoff_simulator_cases
from lab.tradeoff.simulator import (
    CaseResult,
    SimulatorPlan,
    SimulatorReport,
    SimulatorRow,
    make_simulator_report,
    run_simulator_plan,
    simulator_markdown,
    simulator_plan,
)
from lab.tradeoff.simulator_cases import GROUPS, SAME_DB
from lab.tradeoff.simulator_figures import draw_simulator
from sim_player.scene.description import Scene, scene_from_yaml

PLAN = SimulatorPlan(
    seed=3,
    repeats=1,
    literal_beams=1,
    cases={"effect budget": 2, "all but": 1, "rays": 2, "fdtd": 2},
    settings={
        "effect budget": ["basic", -20.0, -50.0, 0.0, "all"],
        "all but": ["all", "element_pattern", "no such effect"],
        "rays": [2.0, 32.0],
        "fdtd": [5.0, 10.0, 20.0],
    },
)
#: One short wall and a car that stands behind a corner: few paths.
SMALL = """
name: small
surfaces:
  - {role: relay, material: concrete, polyline_m: [[14, -2], [14, 1]], roughness_mm: 1}
objects:
  - {class: pedestrian, x_m: 9, y_m: 3}
"""


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, SimulatorReport]:
    out = tmp_path_factory.mktemp("simulator")
    with pytest.MonkeyPatch.context() as patch:
        # times do not count here
        patch.setattr(tradeoff_simulator, "warm_up", lambda plan, group: None)
        return out, make_simulator_report(PLAN, run_simulator_plan(PLAN, out), "here")


def rows_of(report: SimulatorReport, group: str) -> dict[str, SimulatorRow]:
    return {row.name: row for row in report.rows if row.group == group}


@pytest.mark.slow
def test_a_budget_is_kept_and_all_effects_are_all(made: tuple[Path, SimulatorReport]) -> None:
    rows = rows_of(made[1], "effect budget")
    assert list(rows) == ["basic", "-20 dB", "-50 dB", "0 dB", "all"]
    assert SAME_DB < rows["-20 dB"].errors["worst_cell_db"].worst <= -20.0
    assert SAME_DB < rows["-50 dB"].errors["worst_cell_db"].worst <= -50.0
    assert rows["basic"].errors["worst_cell_db"].median > -20.0
    assert rows["all"].errors["worst_cell_db"].worst == SAME_DB
    one = rows["-20 dB"].errors
    assert one["median_cell_db"].worst < one["worst_cell_db"].median <= one["worst_cell_db"].worst
    assert set(rows["-20 dB"].times_ms) == {"wall", "cpu", "paths", "signal", "beats"}


def test_a_left_out_effect_is_missed(made: tuple[Path, SimulatorReport]) -> None:
    rows = rows_of(made[1], "all but")
    assert rows["all"].errors["worst_cell_db"].worst == SAME_DB
    assert rows["element_pattern"].errors["worst_cell_db"].worst > 0.0


def test_finer_is_nearer(made: tuple[Path, SimulatorReport]) -> None:
    rays = [row.errors["field"].median for row in rows_of(made[1], "rays").values()]
    assert rays[0] > rays[1] > 0.0
    cells = [row.errors["r"].worst for row in rows_of(made[1], "fdtd").values()]
    # second order; at 5 cells the pulse itself is coarse
    assert cells[0] > 4.0 * cells[1]
    assert cells[1] / cells[2] == pytest.approx(4.0, rel=0.2)


def test_failed_rows_stay_in_their_place_with_the_reason(made: tuple[Path, SimulatorReport]) -> None:
    report = made[1]
    failed = rows_of(report, "effect budget")["0 dB"]
    assert failed.failed is not None
    assert "budget_db must be finite and negative" in failed.failed
    assert not failed.errors
    assert not failed.times_ms
    unknown = rows_of(report, "all but")["no such effect"]
    assert unknown.failed is not None
    assert "unknown no such effect" in unknown.failed
    page = simulator_markdown(report)
    assert "| 0 dB | failed: " in page
    assert page.index("| -20 dB |") < page.index("| 0 dB |") < page.index("| all |")
    assert failed not in report.of("effect budget")


@pytest.mark.slow
def test_same_accuracy_twice(
    made: tuple[Path, SimulatorReport], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Whatever else runs, warm or cold, and however often; another seed gives other places."""
    monkeypatch.setattr(tradeoff_simulator, "warm_up", lambda plan, group: None)
    part = msgspec.structs.replace(
        PLAN,
        repeats=2,
        cases={"effect budget": 1, "all but": 1, "rays": 1, "fdtd": 1},
        settings={"effect budget": [-20.0, "all"], "all but": ["element_pattern"], "rays": [2.0], "fdtd": [5.0]},
    )
    again = {(one.group, one.index): one for one in run_simulator_plan(part, tmp_path)}
    first = {(one.group, one.index): one for one in run_simulator_plan(PLAN, made[0])}
    for key, one in again.items():
        assert one.errors == {name: first[key].errors[name] for name in one.errors}
        assert one.failed == {}
        assert one.times_ms != first[key].times_ms
    other = msgspec.structs.replace(part, seed=4, repeats=1, cases={"effect budget": 1})
    assert run_simulator_plan(other, tmp_path / "other")[0].errors != first["effect budget", 0].errors


@pytest.mark.parametrize(
    ("load_before", "cpu_ms", "busy"),
    [
        (0.0, 10.0, ""),
        # field solver on two cores
        (0.0, 20.0, ""),
        (0.0, 6.0, "it waited for a core 20 % of the time (limit 10 %)"),
        (0.9, 10.0, "0.90 processes wanted each core before it began (limit 0.5)"),
    ],
)
def test_times_of_a_busy_machine_do_not_count(load_before: float, cpu_ms: float, busy: str) -> None:
    """One of two timings of 10 ms each had `cpu_ms` of a core, the other all."""
    names = [tradeoff_simulator.setting_name("fdtd", value) for value in PLAN.settings_of("fdtd")]
    result = CaseResult(
        group="fdtd",
        index=0,
        case="wall",
        errors={name: {"r": 0.0} for name in names},
        times_ms={name: {"wall": [10.0, 10.0], "cpu": [10.0, cpu_ms]} for name in names},
        failed={},
        load_before=load_before,
    )
    plan = msgspec.structs.replace(PLAN, cases={"fdtd": 1})
    report = make_simulator_report(plan, [result], "here")
    assert report.busy == busy
    assert ("The times do not count" in simulator_markdown(report)) == bool(busy)


def test_quick_and_full_run_every_group() -> None:
    quick, full = simulator_plan(False, 11), simulator_plan(True, 11)
    assert list(quick.cases) == list(full.cases) == list(GROUPS)
    assert len(full.jobs) > 2 * len(quick.jobs)


def small_place(seed: int, index: int) -> Scene:
    return scene_from_yaml(SMALL)


@pytest.mark.slow
def test_levels_agree_and_the_literal_one_runs_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tradeoff_simulator_cases, "random_place", small_place)
    plan = SimulatorPlan(seed=3, repeats=2, literal_beams=1, cases={"signal level": 1})
    results = run_simulator_plan(plan, tmp_path)
    rows = {row.name: row for row in make_simulator_report(plan, results, "here").rows}
    assert rows["literal"].errors["worst_cell_db"].worst == SAME_DB
    assert SAME_DB < rows["kernel float64"].errors["worst_cell_db"].worst < -120.0
    assert SAME_DB < rows["beat"].errors["worst_cell_db"].worst < -120.0
    double = rows["kernel float64"].errors["worst_cell_db"].worst
    assert double < rows["kernel float32"].errors["worst_cell_db"].worst < -50.0
    samples = {name: len(times["wall"]) for name, times in results[0].times_ms.items()}
    assert samples == {"kernel float32": 2, "kernel float64": 2, "beat": 2, "literal": 1}


@pytest.mark.slow
def test_report_reads_back_and_draws_the_same_bytes(made: tuple[Path, SimulatorReport], tmp_path: Path) -> None:
    """A group that is not there, or of which nothing is sound, leaves its panel empty."""
    report = made[1]
    write_report(tmp_path, "tradeoff-simulator", report, simulator_markdown(report))
    read = msgspec.json.decode((tmp_path / "tradeoff-simulator.json").read_bytes(), type=SimulatorReport)
    assert read == report
    assert (tmp_path / "tradeoff-simulator.md").read_text() == simulator_markdown(report)
    draw_simulator(report, tmp_path / "one.png")
    draw_simulator(read, tmp_path / "two.png")
    assert (tmp_path / "one.png").read_bytes() == (tmp_path / "two.png").read_bytes()
    rows = [SimulatorRow(group=row.group, name=row.name, value=row.value, failed="never ran") for row in report.rows]
    draw_simulator(msgspec.structs.replace(report, rows=rows), tmp_path / "empty.png")
    assert (tmp_path / "empty.png").read_bytes() != (tmp_path / "one.png").read_bytes()
