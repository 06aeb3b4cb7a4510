"""Which profile a latency budget picks, and what is remembered of the machine."""

from __future__ import annotations

import os
import threading
from pathlib import Path

import pytest
import typer
from typer.testing import CliRunner

from lab.tradeoff import latency_budget
from lab.tradeoff.latency_budget import ProfileLoss, ProfileLosses, Trial, pick, reason, run_live
from lab.tradeoff.rows import profile_setting, profiles
from mirrorwave import console
from mirrorwave.commands.graph.launch import launch
from mirrorwave.profiles import profile_names
from msgs.files.checksums import json_lines

app = typer.Typer()
app.command()(launch)

#: Milliseconds from the last beam that each profile needs here; None: it does not keep up.
NEEDED_MS: dict[str, float | None] = {"accurate": 120.0, "default": 60.0, "cfar": None}
LOSSES = {"accurate": 1.0, "default": 1.1, "cfar": 4.4}


class Machine:
    """Profiles of known loss, an empty memory, and trials that take no time."""

    def __init__(self, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        self.committed = folder / "profiles.json"
        self.write(LOSSES)
        self.needed_ms = dict(NEEDED_MS)
        #: Profiles in the order in which they were tried.
        self.tried: list[str] = []
        monkeypatch.setattr(latency_budget, "COMMITTED", self.committed)
        #: Cores that others use during a trial.
        self.others_cores = 0.0
        monkeypatch.setattr(latency_budget, "run_live", self._run_live)
        monkeypatch.setattr(os, "getloadavg", lambda: (0.0, 0.0, 0.0))
        monkeypatch.setattr(os, "cpu_count", lambda: 4)
        monkeypatch.setenv("XDG_CACHE_HOME", str(folder / "cache"))

    def write(self, losses: dict[str, float]) -> None:
        rows = [
            ProfileLoss(profile=name, params=profile_setting(name).params, loss=loss) for name, loss in losses.items()
        ]
        self.committed.write_bytes(json_lines(ProfileLosses(command="", rows=rows)))

    def _run_live(self, profile: str, scans: int) -> Trial:
        self.tried.append(profile)
        needed_ms = self.needed_ms[profile]
        views = [1.0] * 3 if needed_ms is None else [needed_ms / latency_budget.MARGIN] * scans
        return Trial(latencies_ms=views, others_cores=self.others_cores)


@pytest.fixture
def computer(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Machine:
    return Machine(tmp_path, monkeypatch)


def test_the_most_accurate_that_fits_is_taken_and_says_why(computer: Machine) -> None:
    picked = {budget_ms: pick(budget_ms)[-1].profile for budget_ms in (500.0, 119.0, 60.0)}
    assert picked == {500.0: "accurate", 119.0: "default", 60.0: "default"}
    kept = f"trials of an idle machine are kept in {latency_budget.cache_path()}, --remeasure repeats them"
    assert reason(80.0, pick(80.0)) == (
        f"profile default: expected 60 of 80 ms from the last beam, loss 1.10; accurate would need 120 ms; {kept}"
    )
    assert f"none is more accurate; {kept}" in reason(500.0, pick(500.0))


def test_one_that_does_not_keep_up_fits_no_budget(computer: Machine) -> None:
    computer.needed_ms |= {"accurate": None, "default": None, "cfar": 30.0}
    tried = pick(1e6)
    assert [row.profile for row in tried] == ["accurate", "default", "cfar"]
    assert "accurate would leave out scans (3 of 20 views came), default would leave out" in reason(1e6, tried)


def test_where_none_fits_all_that_was_measured_is_listed(computer: Machine) -> None:
    with pytest.raises(ValueError) as refused:
        pick(20.0)
    assert str(refused.value) == (
        "--latency-budget-ms: no profile fits 20 ms on this machine; accurate would need 120 ms, "
        "default would need 60 ms, cfar would leave out scans (3 of 20 views came)"
    )


def test_a_refusal_is_tried_again_and_never_remembered(computer: Machine) -> None:
    """Of a machine that was slow for an hour: the next call measures all that it would refuse, once."""
    computer.needed_ms = dict.fromkeys(NEEDED_MS)
    for _ in range(2):
        computer.tried = []
        with pytest.raises(ValueError, match="no profile fits 5000 ms"):
            pick(5000.0)
        assert computer.tried == list(LOSSES)
    computer.needed_ms, computer.tried = dict(NEEDED_MS), []
    assert pick(5000.0)[-1].profile == "accurate"
    assert pick(5000.0)[-1].profile == "accurate"
    assert computer.tried == ["accurate"]


@pytest.mark.parametrize("load", [0.0, 3.0])
def test_trials_of_a_busy_machine_are_not_kept(computer: Machine, monkeypatch: pytest.MonkeyPatch, load: float) -> None:
    """Told by the CPU seconds that others used meanwhile (0.9 of 4 cores), or by the load before (3 on 4 cores)."""
    computer.others_cores = 0.0 if load else 0.9
    monkeypatch.setattr(os, "getloadavg", lambda: (load, 0.0, 0.0))
    computer.needed_ms["accurate"] = None
    lines: list[str] = []
    assert pick(80.0, note=lines.append)[-1].profile == "default"
    assert [line.partition(":")[0] for line in lines] == [
        "trying profile accurate on this machine",
        "profile accurate is not remembered, the machine is busy",
        "trying profile default on this machine",
        "profile default is not remembered, the machine is busy",
    ]
    with pytest.raises(ValueError, match="; the machine is busy: "):
        pick(20.0)
    computer.others_cores, computer.needed_ms = 0.0, dict(NEEDED_MS)
    monkeypatch.setattr(os, "getloadavg", lambda: (0.0, 0.0, 0.0))
    assert pick(500.0)[-1].profile == "accurate"


@pytest.mark.parametrize("budget", ["0", "-5", "nan", "inf"])
def test_budgets_that_are_none_are_refused_before_anything_is_measured(budget: str, computer: Machine) -> None:
    with pytest.raises(ValueError, match="--latency-budget-ms must be positive and finite"):
        CliRunner().invoke(
            app, ["launch/corner.yaml", "--latency-budget-ms", budget], catch_exceptions=False, standalone_mode=False
        )
    assert computer.tried == []


def test_a_long_trial_is_not_silent(monkeypatch: pytest.MonkeyPatch) -> None:
    lines, said = [], threading.Event()
    monkeypatch.setattr(console, "BEAT_S", 0.01)
    monkeypatch.setattr(console, "_heartbeat", lambda line: (lines.append(line), said.set()))

    def tried(*words: object) -> list[object]:
        assert said.wait(60.0)
        raise ValueError("no profile fits")

    monkeypatch.setattr(latency_budget, "pick", tried)
    with pytest.raises(ValueError, match="no profile fits"):
        CliRunner().invoke(app, ["launch/corner.yaml", "--latency-budget-ms", "5"], catch_exceptions=False)
    assert lines[0].startswith("trying profiles: 0 s")


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
    changed = text.replace(b'"object_threshold": 0.', b'"object_threshold": 0.1')
    assert changed != text
    computer.committed.write_bytes(changed)
    assert [row.profile for row in latency_budget._known()] == ["cfar"]
    computer.write({})
    with pytest.raises(ValueError, match="must hold a profile with the parameters of launch/profiles"):
        pick(500.0)


def test_every_profile_has_a_committed_loss_for_its_present_parameters() -> None:
    """One whose parameters change would never be picked again: measure it (benchmarks.accuracy.profile_losses).

    The published system is none that a budget should pick.
    """
    known = [row.params for row in latency_budget._known()]
    assert [setting.name for setting in profiles() if setting.params not in known] in ([], ["specification"])


@pytest.mark.graph
def test_a_profile_is_tried_live(monkeypatch: pytest.MonkeyPatch) -> None:
    """Latencies come out, and the graph's own work is none of others; a profile that cannot run gives none."""
    monkeypatch.setattr(latency_budget, "SETTLING_SCANS", 2)
    trial = run_live("default", 5)
    assert trial.latencies_ms
    assert min(trial.latencies_ms) > 0.0
    assert 0.0 <= trial.others_cores <= (os.cpu_count() or 1)
    assert run_live("nowhere", 5).latencies_ms == []


def test_profiles_are_listed_with_the_default_first() -> None:
    names = profile_names()
    assert names[0] == "default"
    assert "cfar" in names
