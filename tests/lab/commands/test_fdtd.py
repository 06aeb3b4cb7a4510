"""`mirrorwave sim reflectance`: the table's report, rebuilds, refusals."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import typer

from lab.commands.fdtd import reflectance
from lab.full_wave.reflectance import Entry
from mirrorwave.console import error_line, exit_code_of


def run(line: str) -> None:
    app = typer.Typer()
    app.command()(reflectance)
    app(args=line.split(), standalone_mode=False)


@pytest.mark.slow
def test_the_shipped_table_is_compared_with_the_formula(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    run(f"--plot {tmp_path / 'a.png'}")
    out = capsys.readouterr().out
    assert "FDTD minus |r|^2 exp(-g^2), the ray tracer's formula" in out
    assert "brick at 77 GHz: interpolated between 40 and 110 GHz" in out
    rows = [line.split() for line in out.splitlines()]
    assert ["171", "of", "171"] in [row[7:10] for row in rows if row[:4] == ["concrete", "10", "te", "0"]]
    assert (tmp_path / "a.png").stat().st_size > 20_000


def test_the_table_as_json(capsys: pytest.CaptureFixture[str]) -> None:
    run("--json")
    found = json.loads(capsys.readouterr().out)
    assert list(found) == ["card", "comparison", "absent"]
    assert {"wall", "worst_db", "worst_error_db", "within_half_db", "absent"} <= set(found["comparison"][0])
    assert {"wall", "reason"} <= set(found["absent"][0])


def test_a_rebuild_writes_table_and_card(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    entries = [Entry("asphalt", band, "te", 0.0, (0.0, 45.0)) for band in (10e9, 77e9)]
    monkeypatch.setattr("lab.full_wave.reflectance.table_entries", lambda: entries)
    run(f"--rebuild --workers 1 --json --out {tmp_path / 'a.npz'}")
    card = json.loads(capsys.readouterr().out)["card"]
    assert card["command"] == "mirrorwave sim reflectance --rebuild"
    assert [row["name"] for row in card["walls"]] == ["asphalt"]
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.json", "a.npz"]


@pytest.mark.parametrize(
    ("line", "text"),
    [
        ("--out a.json", "--out must be an .npz file, got a.json"),
        ("--out nowhere.npz", "nowhere.json: No such file or directory"),
        ("--rebuild --out nowhere/a.npz", "nowhere/a.npz: its directory does not exist"),
    ],
)
def test_bad_tables_are_one_line_and_code_2(line: str, text: str) -> None:
    with pytest.raises((ValueError, OSError)) as caught:
        run(line)
    assert exit_code_of(caught.value) == 2
    assert text in error_line(caught.value)
