"""`mirrorwave sim wall` and `sim reflectance`: figures of the 40 cm wall, the table's report, rebuilds, refusals."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import pytest
import typer

from lab.commands.fdtd import reflectance, wall
from lab.full_wave.experiment import Experiment
from lab.full_wave.reflectance import Entry
from lab.walls import transmission
from mirrorwave.console import error_line, exit_code_of


def run(command: Callable[..., None], line: str) -> None:
    app = typer.Typer()
    app.command()(command)
    app(args=line.split(), standalone_mode=False)


def test_40_cm_of_concrete_let_nothing_through(capsys: pytest.CaptureFixture[str]) -> None:
    """10 GHz, normal incidence: exact -8.10 and -81.35 dB; the column of 40 cells a wavelength within 0.01 dB."""
    run(wall, "--json")
    found = json.loads(capsys.readouterr().out)
    assert found["exact"]["r_db"] == pytest.approx(-8.10, abs=0.005)
    assert found["exact"]["t_db"] == pytest.approx(-81.35, abs=0.005)
    assert found["fdtd"]["r_db"] == pytest.approx(found["exact"]["r_db"], abs=0.01)
    assert found["fdtd"]["t_db"] == pytest.approx(found["exact"]["t_db"], abs=0.01)
    assert "beam" not in found


def test_a_construction_has_its_own_layers(capsys: pytest.CaptureFixture[str]) -> None:
    run(wall, "--material double_glazing --angle-deg 45")
    out = capsys.readouterr().out
    assert out.startswith("double_glazing at 10 GHz, 45 deg, te\n")
    levels = [line.split()[-2:] for line in out.splitlines()[2:]]
    assert [float(level) for level in levels[0]] == pytest.approx([float(level) for level in levels[1]], abs=0.05)


@pytest.mark.slow
def test_a_beam_is_drawn(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    """3 cm of concrete in a small domain: square cells, 10 a wavelength, come within 1 dB in R and 5 % in T (dB)."""
    monkeypatch.setattr(transmission, "layout", lambda layers, frequency_hz: Experiment(0.3, 0.07, 0.06, 0.04))
    run(wall, f"--thickness-mm 30 --json --plot {tmp_path / 'a.png'} --angle-deg 20 --polarisation tm")
    found = json.loads(capsys.readouterr().out)
    assert (tmp_path / "a.png").stat().st_size > 20_000
    assert found["beam"]["r_db"] == pytest.approx(found["exact"]["r_db"], abs=1.0)
    assert found["beam"]["t_db"] == pytest.approx(found["exact"]["t_db"], rel=0.05)
    assert found["beam"]["residue"] < 1e-6


@pytest.mark.parametrize(
    ("line", "text"),
    [
        ("--material cheese", "unknown material 'cheese', known are vacuum"),
        ("--material hedge", "--material must be a wall, vegetation is a volume"),
        ("--thickness-mm 0", "--thickness-mm must be positive, got 0.0"),
        ("--thickness-mm nan", "--thickness-mm must be positive, got nan"),
        ("--material window --thickness-mm 4", "--thickness-mm must not be given for window"),
        ("--frequency-ghz -1", "--frequency-ghz must be finite and positive, got -1.0"),
        ("--material plywood --frequency-ghz 77", "material plywood is known for 1..40 GHz, got 77 GHz"),
        ("--angle-deg 70", "--angle-deg must lie in 0..60, got 70.0"),
        ("--frequency-ghz 77 --thickness-mm 2000 --plot a.png", "--plot takes at most 3000000 cells, got"),
    ],
)
def test_bad_walls_are_one_line_and_code_2(line: str, text: str) -> None:
    with pytest.raises(ValueError) as caught:
        run(wall, line)
    assert exit_code_of(caught.value) == 2
    assert text in error_line(caught.value)


@pytest.mark.slow
def test_the_shipped_table_is_compared_with_the_formula(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    run(reflectance, f"--plot {tmp_path / 'a.png'}")
    out = capsys.readouterr().out
    assert "FDTD minus |r|^2 exp(-g^2), the ray tracer's formula" in out
    assert "brick at 77 GHz: interpolated between 40 and 110 GHz" in out
    rows = [line.split() for line in out.splitlines()]
    assert ["171", "of", "171"] in [row[7:10] for row in rows if row[:4] == ["concrete", "10", "te", "0"]]
    assert (tmp_path / "a.png").stat().st_size > 20_000


def test_the_table_as_json(capsys: pytest.CaptureFixture[str]) -> None:
    run(reflectance, "--json")
    found = json.loads(capsys.readouterr().out)
    assert list(found) == ["card", "comparison", "absent"]
    assert {"wall", "worst_db", "worst_error_db", "within_half_db", "absent"} <= set(found["comparison"][0])
    assert {"wall", "reason"} <= set(found["absent"][0])


def test_a_rebuild_writes_table_and_card(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    entries = [Entry("asphalt", band, "te", 0.0, (0.0, 45.0)) for band in (10e9, 77e9)]
    monkeypatch.setattr("lab.full_wave.reflectance.table_entries", lambda: entries)
    run(reflectance, f"--rebuild --workers 1 --json --out {tmp_path / 'a.npz'}")
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
        run(reflectance, line)
    assert exit_code_of(caught.value) == 2
    assert text in error_line(caught.value)
