"""Which profile a latency budget picks, and what is remembered of the machine."""

from __future__ import annotations

from pathlib import Path

import msgspec
import pytest
import typer
from typer.testing import CliRunner

from mirrorwave.commands.graph.launch import launch
from mirrorwave.profiles import profile_names
from mirrorwave.studies.report import Interval, Times
from mirrorwave.studies.tradeoff import latency_budget
from mirrorwave.studies.tradeoff.latency_budget import Timed, measure, pick, reason, timed_profiles
from mirrorwave.studies.tradeoff.report import Report, Row
from mirrorwave.studies.tradeoff.settings import Setting, profiles
from models.training.files import json_lines

app = typer.Typer()
app.command()(launch)
TIMED = [
    Timed(profile="slow", recovered_f1_1m=0.7, expected_ms=120.0),
    Timed(profile="middle", recovered_f1_1m=0.6, expected_ms=60.0),
    Timed(profile="quick", recovered_f1_1m=0.4, expected_ms=30.0),
]


def test_the_most_accurate_that_fits_is_taken_and_says_why() -> None:
    assert [pick(budget_ms, TIMED).profile for budget_ms in (500.0, 119.0, 60.0, 30.0)] == [
        "slow", "middle", "middle", "quick",
    ]  # fmt: skip
    assert reason(80.0, TIMED[1], TIMED) == (
        "profile middle: expected 60 of 80 ms from the last beam, recovered F1 0.600; slow would need 120 ms"
    )
    assert reason(500.0, TIMED[0], TIMED).endswith("none is more accurate")


def test_the_faster_of_equals_is_taken() -> None:
    twin = msgspec.structs.replace(TIMED[0], profile="twin", expected_ms=90.0)
    assert pick(200.0, [TIMED[0], twin]).profile == "twin"


def test_where_none_fits_the_nearest_is_named() -> None:
    with pytest.raises(ValueError, match=r"no profile fits 20 ms on this machine; the nearest is quick, .* 30 ms"):
        pick(20.0, TIMED)


@pytest.mark.parametrize("budget", ["0", "-5", "nan", "inf"])
def test_budgets_that_are_none_are_refused_before_anything_is_measured(
    budget: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(latency_budget, "timed_profiles", lambda remeasure: pytest.fail("measured"))
    with pytest.raises(ValueError, match="--latency-budget-ms must be positive and finite"):
        CliRunner().invoke(
            app, ["launch/corner.yaml", "--latency-budget-ms", budget], catch_exceptions=False, standalone_mode=False
        )


def test_budget_and_profile_exclude_each_other() -> None:
    with pytest.raises(ValueError, match="must not be given together"):
        CliRunner().invoke(
            app, ["launch/corner.yaml", "--profile", "cfar", "--latency-budget-ms", "50"], catch_exceptions=False
        )


@pytest.fixture
def committed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A committed run that knows the default and the CFAR profile; an empty memory."""
    rows = [
        Row(
            name=row.name,
            switch=row.switch,
            value=row.value,
            params=row.params,
            accuracy={"recovered_f1_1m": Interval(value=0.5, low=0.4, high=0.6)},
            end_to_end_ms=Times(p50=50.0, p90=None, p99=None),
        )
        for row in profiles()
        if row.name in ("default", "cfar")
    ]
    report = Report(command="", machine="", versions={}, seed=0, frames=1, repeats=1, deadline_ms=300.0, rows=rows)
    (tmp_path / "tradeoff.json").write_bytes(json_lines(report))
    monkeypatch.setattr(latency_budget, "COMMITTED", tmp_path / "tradeoff.json")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    return tmp_path / "tradeoff.json"


def test_times_are_remembered_until_something_changes(committed: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    calls = []

    def measured(rows: dict[str, tuple[Setting, float]], tick: object) -> list[Timed]:
        calls.append(list(rows))
        return TIMED

    monkeypatch.setattr(latency_budget, "measure", measured)
    assert timed_profiles() == TIMED
    assert timed_profiles() == TIMED
    assert calls == [["default", "cfar"]]
    timed_profiles(remeasure=True)
    latency_budget.cache_path().write_text("{broken")
    timed_profiles()
    monkeypatch.setattr(latency_budget, "machine", lambda: "another one")
    timed_profiles()
    assert len(calls) == 4


def test_a_profile_with_other_parameters_than_were_measured_is_no_candidate(committed: Path) -> None:
    text = committed.read_bytes().replace(b'"method": "cfar"', b'"method": "network"')
    committed.write_bytes(text)
    assert list(latency_budget._known()) == ["default"]
    committed.write_bytes(committed.read_bytes().replace(b'"switch": "profile"', b'"switch": "else"'))
    with pytest.raises(ValueError, match="must hold a profile with the parameters of launch/profiles"):
        timed_profiles()


@pytest.mark.slow
def test_a_profile_is_timed_on_real_beams(monkeypatch: pytest.MonkeyPatch) -> None:
    """One place, once: a latency comes out, and a profile that cannot run is left out."""
    monkeypatch.setattr(latency_budget, "PLACES", 1)
    monkeypatch.setattr(latency_budget, "REPEATS", 1)
    broken = Setting(switch="profile", value="broken", params={"dense_predictor": {"model": "nowhere.onnx"}})
    timed = measure({"default": (profiles()[0], 0.5), "broken": (broken, 0.9)})
    assert [one.profile for one in timed] == ["default"]
    assert timed[0].expected_ms > 0.0


def test_profiles_are_listed_with_the_default_first() -> None:
    names = profile_names()
    assert names[0] == "default"
    assert "cfar" in names
