"""Which profile a latency budget picks, and what is remembered of the machine."""

from __future__ import annotations

import os
from pathlib import Path

import pytest
import typer
from typer.testing import CliRunner

from mirrorwave.commands.graph.launch import launch
from mirrorwave.profiles import profile_names
from mirrorwave.studies.tradeoff import latency_budget
from mirrorwave.studies.tradeoff.latency_budget import ProfileLoss, ProfileLosses, measure, pick, reason
from mirrorwave.studies.tradeoff.settings import profile_setting, profiles
from models.training.files import json_lines

app = typer.Typer()
app.command()(launch)

#: Milliseconds from the last beam that each profile needs here; None: it does not keep up.
NEEDED_MS: dict[str, float | None] = {"accurate": 120.0, "default": 60.0, "fast": 30.0, "cfar": None}
LOSSES = {"accurate": 1.0, "default": 1.1, "fast": 1.7, "cfar": 4.4}


class Machine:
    """Profiles of known loss, an empty memory, and trials that take no time."""

    def __init__(self, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        self.committed = folder / "profiles.json"
        self.write(LOSSES)
        self.needed_ms = dict(NEEDED_MS)
        #: Profiles in the order in which they were tried.
        self.tried: list[str] = []
        monkeypatch.setattr(latency_budget, "COMMITTED", self.committed)
        monkeypatch.setattr(latency_budget, "measure", self._measure)
        monkeypatch.setenv("XDG_CACHE_HOME", str(folder / "cache"))

    def write(self, losses: dict[str, float]) -> None:
        rows = [
            ProfileLoss(profile=name, params=profile_setting(name).params, loss=loss) for name, loss in losses.items()
        ]
        self.committed.write_bytes(json_lines(ProfileLosses(command="", rows=rows)))

    def _measure(self, profile: str) -> float | None:
        self.tried.append(profile)
        return self.needed_ms[profile]


@pytest.fixture
def computer(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Machine:
    return Machine(tmp_path, monkeypatch)


def test_the_most_accurate_that_fits_is_taken_and_says_why(computer: Machine) -> None:
    picked = {budget_ms: pick(budget_ms)[-1].profile for budget_ms in (500.0, 119.0, 60.0, 30.0)}
    assert picked == {500.0: "accurate", 119.0: "default", 60.0: "default", 30.0: "fast"}
    assert reason(80.0, pick(80.0)) == (
        "profile default: expected 60 of 80 ms from the last beam, loss 1.10; accurate would need 120 ms"
    )
    assert reason(500.0, pick(500.0)).endswith("none is more accurate")


def test_one_that_does_not_keep_up_fits_no_budget(computer: Machine) -> None:
    computer.needed_ms |= {"accurate": None, "default": None}
    tried = pick(1e6)
    assert [row.profile for row in tried] == ["accurate", "default", "fast"]
    assert reason(1e6, tried).endswith("accurate would leave out scans, default would leave out scans")


def test_where_none_fits_the_nearest_is_named(computer: Machine) -> None:
    with pytest.raises(ValueError, match=r"no profile fits 20 ms on this machine; the nearest is fast, .* 30 ms"):
        pick(20.0)
    computer.needed_ms = dict.fromkeys(NEEDED_MS)
    with pytest.raises(ValueError, match="no profile fits 300 ms on this machine; all of them leave out scans"):
        pick(300.0, remeasure=True)


@pytest.mark.parametrize("budget", ["0", "-5", "nan", "inf"])
def test_budgets_that_are_none_are_refused_before_anything_is_measured(budget: str, computer: Machine) -> None:
    with pytest.raises(ValueError, match="--latency-budget-ms must be positive and finite"):
        CliRunner().invoke(
            app, ["launch/corner.yaml", "--latency-budget-ms", budget], catch_exceptions=False, standalone_mode=False
        )
    assert computer.tried == []


def test_budget_and_profile_exclude_each_other() -> None:
    with pytest.raises(ValueError, match="must not be given together"):
        CliRunner().invoke(
            app, ["launch/corner.yaml", "--profile", "cfar", "--latency-budget-ms", "50"], catch_exceptions=False
        )


def test_no_profile_is_tried_that_need_not_be_and_none_twice(computer: Machine) -> None:
    lines: list[str] = []
    pick(500.0, note=lines.append)
    assert lines == ["trying profile accurate on this machine"]
    pick(80.0)
    pick(80.0)
    assert computer.tried == ["accurate", "default"]
    pick(80.0, remeasure=True)
    assert computer.tried == ["accurate", "default"] * 2


def test_times_are_forgotten_when_something_changes(computer: Machine, monkeypatch: pytest.MonkeyPatch) -> None:
    pick(500.0)
    changes: list[tuple[object, str, object]] = [
        (latency_budget, "machine", lambda: "another one"),
        (latency_budget, "quota_cores", lambda: 0.25),
        (os, "sched_getaffinity", lambda pid: {0}),
    ]
    for count, change in enumerate(changes, start=2):
        monkeypatch.setattr(*change)
        pick(500.0)
        pick(500.0)
        assert len(computer.tried) == count
    latency_budget.cache_path().write_text("{broken")
    pick(500.0)
    assert len(computer.tried) == 5
    computer.write(LOSSES | {"accurate": 1.01})
    pick(500.0)
    assert len(computer.tried) == 6


def test_a_profile_with_other_parameters_than_were_measured_is_no_candidate(computer: Machine) -> None:
    text = computer.committed.read_bytes()
    changed = text.replace(b'"model": "compact_unet.int8"', b'"model": "compact_unet"')
    assert changed != text
    computer.committed.write_bytes(changed)
    assert [row.profile for row in latency_budget._known()] == ["accurate", "fast", "cfar"]
    computer.write({})
    with pytest.raises(ValueError, match="must hold a profile with the parameters of launch/profiles"):
        pick(500.0)


def test_every_profile_has_a_committed_loss_for_its_present_parameters() -> None:
    """One whose parameters change would never be picked again: measure it (benchmarks.accuracy.profile_losses)."""
    known = [row.params for row in latency_budget._known()]
    assert [setting.name for setting in profiles() if setting.params not in known] == []


@pytest.mark.graph
def test_a_profile_is_tried_live(monkeypatch: pytest.MonkeyPatch) -> None:
    """A latency comes out; a profile that cannot run, or is so slow that scans lack their views, does not keep up."""
    monkeypatch.setattr(latency_budget, "SETTLING_SCANS", 2)
    monkeypatch.setattr(latency_budget, "SCANS", 5)
    monkeypatch.setattr(latency_budget, "MISSING_SCANS", 4)
    expected_ms = measure("default")
    assert expected_ms is not None
    assert expected_ms > 0.0
    monkeypatch.setattr(latency_budget, "MISSING_SCANS", -10)
    assert measure("default") is None
    assert measure("nowhere") is None


def test_profiles_are_listed_with_the_default_first() -> None:
    names = profile_names()
    assert names[0] == "default"
    assert "cfar" in names
