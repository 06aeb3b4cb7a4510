"""`mirrorwave tradeoff` on a few places: rows, times, resumption, what it says."""

from __future__ import annotations

import json
import re
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import msgspec
import numpy as np
import psutil
import pytest
import typer
from typer.testing import CliRunner

from lab.commands.tradeoff import tradeoff
from lab.evaluate.place_runs import ObjectPlan, ObjectSet, run_objects
from lab.measures.object_metrics import ObjectScores, object_measures
from lab.studies.report import Interval, Times, busy_reason
from lab.tradeoff import row_runs as runner
from lab.tradeoff.row_report import (
    Report,
    Row,
    latency_ms,
    make_report,
    markdown,
    measuring_ms,
    read_report,
    with_front,
)
from lab.tradeoff.row_runs import BEFORE, PARTS, FrameResult, Plan, peak_memory_mib, run_plan
from lab.tradeoff.rows import DEFAULT_SETTINGS, Setting, profile_setting, read_settings
from mirrorwave.node_chain import STAGE_PARAMS
from models.perception.cards import WEIGHTS
from models.perception.find.cfar import CfarParams, cfar_peaks
from msgs.files.shipped import CHECKOUT
from msgs.values.perception import Peaks
from msgs.values.radar import RangeAzimuthMap
from nodes.process.validation import convert_at

app = typer.Typer()
app.command()(tradeoff)


def size(name: str) -> int:
    return (WEIGHTS / name).stat().st_size


def run(out: Path, *options: str) -> Report:
    words = ["--out", str(out), "--count", "2", "--seed", "12", "--no-memory", "--json", *options]
    result = CliRunner().invoke(app, words, catch_exceptions=False)
    assert result.exit_code == 0, result.output
    return msgspec.json.decode(result.stdout, type=Report)


#: Rows over two profiles, one of each; that of `accurate` is of a network that is not there.
MADE = ("--row", "beams", "--row", "network: UNet")


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Path, Report]]:
    out = tmp_path_factory.mktemp("tradeoff")
    settings = out / "rows.yaml"
    absent = "{switch: network, value: UNet, over: accurate, params: {dense_predictor: {model: none/here/unet.onnx}}}"
    one = re.sub(r".*value: (13|9) of 25.*\n", "", DEFAULT_SETTINGS.read_text())
    settings.write_text(f"{one}\n  - {absent}\n")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("lab.tradeoff.rows.DEFAULT_SETTINGS", settings)
        yield out, run(out, *MADE)


def test_every_committed_row_sets_what_its_nodes_know() -> None:
    rows = read_settings()
    assert rows[0].name == "default"
    assert len({row.switch for row in rows}) >= 12
    assert len(rows) >= 36
    for row in rows:
        for stage, params in row.params.items():
            convert_at(params, STAGE_PARAMS[stage], f"{row.name}: {stage}")


@pytest.mark.slow
def test_rows_keep_their_order_and_a_failed_one_its_reason(made: tuple[Path, Report]) -> None:
    """Fewer beams fold in less time; a network that is not there leaves a row without numbers."""
    out, report = made
    rows = {row.name: row for row in report.rows}
    assert list(rows) == ["default", "accurate", "beams: 7 of 25", "network: UNet"]
    failed = rows["network: UNet"]
    assert failed.failed is not None
    assert "none/here/unet.json" in failed.failed
    assert failed.end_to_end_ms is None
    assert not failed.pareto
    default = rows["default"]
    assert default.against_over["object_f1"] == Interval(value=0.0, low=0.0, high=0.0)
    for row, precision in ((default, ".int8"), (rows["accurate"], "")):
        assert row.size_bytes == sum(map(size, (f"compact_unet{precision}.onnx", f"evidence_unet{precision}.onnx")))
    assert rows["beams: 7 of 25"].accuracy["dense_macro_f1"] != default.accuracy["dense_macro_f1"]
    assert default.end_to_end_ms is not None
    assert default.end_to_end_ms.p99 is None, "two samples have no 99th percentile"
    assert read_report(out / "tradeoff.json") == report
    page = (out / "tradeoff.md").read_text()
    assert "| network: UNet | failed: " in page
    assert "--row beams --row 'network: UNet'" in page
    assert (out / "front.png").stat().st_size > 5000


@pytest.mark.slow
def test_memory_of_a_row_is_its_own_and_not_that_of_who_asks() -> None:
    """256 MiB that the asking process comes to hold change nothing; more than an interpreter alone has, in MiB."""
    row = read_settings()[0]
    before_mib = peak_memory_mib([row])[row.name]
    ballast = np.ones(2**28, np.uint8)
    assert peak_memory_mib([row])[row.name] == pytest.approx(before_mib, abs=100.0)
    del ballast
    peak = "import re; print(re.search(r'VmHWM:\\s*(\\d+)', open('/proc/self/status').read())[1])"
    said = subprocess.run([sys.executable, "-c", peak], capture_output=True, text=True, check=True).stdout
    assert int(said) / 1024.0 < before_mib < psutil.virtual_memory().total / 2**20


@pytest.mark.slow
def test_objects_are_those_of_the_evaluation(made: tuple[Path, Report], tmp_path: Path) -> None:
    """The rows of `mirrorwave eval --objects` on the same places, beam by beam through whole chains.

    Known bias: there the vehicle says that it stands, which rounds a map otherwise (4e-7 of its peak); in places of
    seed 11 a wall more is found so.
    """
    plan = ObjectPlan(set=ObjectSet(seed=12, places=2), profiles=[profile_setting("default")])
    scores = ObjectScores([place.rows["default"][0] for place in run_objects(plan, tmp_path)])
    assert scores.asked
    wanted = {name: value[0] for name, value in object_measures(scores).items()}
    default = made[1].rows[0]
    assert {name: default.accuracy[name].value for name in wanted} == wanted


def test_wrong_rows_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"--row must be one of .*, got 'nothing'"):
        run(tmp_path, "--row", "nothing")
    path = tmp_path / "rows.yaml"
    path.write_text("rows: [{switch: a, value: b}, {switch: a, value: b}]")
    with pytest.raises(ValueError, match=r"rows\.yaml: rows must differ in name, got 'a: b' twice"):
        read_settings(path)
    path.write_text("rows: [{switch: a, value: b, params: {viewer: {}}}]")
    with pytest.raises(ValueError, match=r"rows\.yaml.*params must be of ra_former, dense_predictor, geometry"):
        read_settings(path)
    path.write_text("rows: [{switch: a, value: b, over: nothing}]")
    with pytest.raises(ValueError, match=r"rows\.yaml: a: b: over must be one of default, .*, got 'nothing'"):
        read_settings(path)
    path.write_text("rows: [{switch: a}]")
    with pytest.raises(ValueError, match=r"rows\.yaml.*missing required field value"):
        read_settings(path)


@pytest.mark.slow
def test_a_row_that_fails_on_the_way_takes_none_with_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A detector that raises on its second map: its row is failed, with the reason, and the default is not."""
    seen = 0

    def fails(ra_map: RangeAzimuthMap, params: CfarParams) -> Peaks:
        nonlocal seen
        seen += 1
        if seen > 1:
            raise RuntimeError("broken\nin two lines")
        return cfar_peaks(ra_map, params)

    rows = [Setting(switch="profile", value="default"), Setting(switch="a", value="b", params={"geometry": {}})]
    rows[1].params["dense_predictor"] = {"method": "cfar"}
    monkeypatch.setattr("models.perception.find.detectors.cfar_peaks", fails)
    results = run_plan(Plan(rows=rows, frames=1, repeats=1), tmp_path)
    assert list(results[0].times_ms) == ["default"]
    assert results[0].failed == {"a: b": "broken in two lines"}


def test_what_the_former_has_not_folded_counts_when_the_last_beam_comes() -> None:
    part = {name: [1.0] for name in PARTS}
    late = latency_ms([part | {BEFORE: [measuring_ms() + 5.0]}, part | {BEFORE: [measuring_ms() - 5.0]}])
    np.testing.assert_allclose(late["forming"], [[6.0], [1.0]])
    assert measuring_ms() == pytest.approx(288.0)


def row(name: str, latency_ms: float, accuracy: float) -> Row:
    return Row(
        name=name,
        switch="a",
        value=name,
        params={},
        over="default",
        accuracy={"object_f1": Interval(value=accuracy, low=None, high=None)},
        end_to_end_ms=Times(p50=latency_ms, p90=None, p99=None),
    )


def test_the_front_is_what_none_beats_in_both() -> None:
    rows = with_front(
        [row("a", 10.0, 0.5), row("b", 20.0, 0.7), row("c", 20.0, 0.6), row("d", 30.0, 0.7), row("e", 9.0, 0.1)]
    )
    assert [one.name for one in rows if one.pareto] == ["a", "b", "e"]


def test_times_of_a_busy_machine_do_not_count() -> None:
    """A load before the run, or sections that were timed while other programs had the core: here a sleep."""
    assert busy_reason(0.1, 0.05) == ""
    assert busy_reason(0.8) == "0.80 processes wanted each core before it began (limit 0.5)"
    assert busy_reason(0.1, 0.25) == "it waited for a core 25 % of the time (limit 10 %)"
    timing = runner._Pass()
    with timing.timed("forming", "a"):
        time.sleep(0.02)
    assert timing.waited > 0.5
    result = FrameResult(
        frame=0, counts={}, distances={}, objects={}, times_ms={}, failed={"a: 1": "x"}, waited=timing.waited
    )
    row = Setting(switch="a", value="1")
    report = make_report(Plan(rows=[row], frames=1, repeats=1), [result], {}, "mirrorwave tradeoff")
    assert report.busy.startswith("it waited for a core ")
    assert f"**The times do not count**: the machine was busy. {report.busy}." in markdown(report)


def test_the_documented_schema_is_that_of_the_report() -> None:
    """`msgspec.json.schema(Report)` writes it."""
    documented = json.loads((CHECKOUT / "docs" / "results" / "tradeoff.schema.json").read_text())
    assert documented == msgspec.json.schema(Report)


def test_json_is_strict(made: tuple[Path, Report]) -> None:
    text = (made[0] / "tradeoff.json").read_text()
    json.loads(text, parse_constant=pytest.fail)
