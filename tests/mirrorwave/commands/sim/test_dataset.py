"""`sim dataset` and `sim statistics`: what a script and a person are told."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import get_args

import pytest
import typer

from mirrorwave.commands.sim.dataset import Executor, Places, dataset, parse_effects, parse_slurm, statistics
from sim_player.dataset.shards import Recipe
from sim_player.dataset.writer import write_dataset


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three planned places in two shards."""
    return write_dataset(tmp_path_factory.mktemp("data"), 3, 6, Recipe(scenes_per_shard=2)).parent


def test_dataset_says_what_it_did(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Made, then found again, then made again where it was spoilt; only JSON on stdout."""
    out = tmp_path / "places"

    def said() -> tuple[dict[str, object], str]:
        dataset(out, 2, seed=1, effects="basic", as_json=True)
        captured = capsys.readouterr()
        return json.loads(captured.out), captured.err

    first, _ = said()
    assert (first["scenes"], first["made"], first["kept"], first["rewritten"]) == (2, 2, 0, [])
    assert first["series"]["effects"] == "basic"  # type: ignore[index]
    again, _ = said()
    assert (again["made"], again["kept"]) == (0, 2)
    shard = out / "shard-00000.npz"
    shard.write_bytes(shard.read_bytes()[:999])
    spoilt, errors = said()
    assert (spoilt["made"], spoilt["kept"]) == (2, 0)
    assert [row["shard"] for row in spoilt["rewritten"]] == ["shard-00000.npz"]  # type: ignore[attr-defined]
    assert f"{shard}: made again: cannot be read" in errors
    dataset(out, 2, seed=1, effects="basic")
    assert re.search(r"places: 2 scenes in \d+ s, 0.00 a second, 2 there already\n", capsys.readouterr().out)


def test_options_are_those_of_the_simulator() -> None:
    from sim_player.dataset.executors import EXECUTORS
    from sim_player.dataset.shards import PLACES

    assert get_args(Places) == PLACES
    assert get_args(Executor) == EXECUTORS


def test_texts_of_options() -> None:
    assert parse_effects("auto") == "auto"
    assert parse_effects(None) is None
    assert parse_effects(" squint, adc,squint") == ("adc", "squint")
    assert parse_slurm(["partition=cpu", "timeout_min=30"]) == {"partition": "cpu", "timeout_min": 30}
    with pytest.raises(ValueError, match="--slurm must be KEY=VALUE, got 'partition'"):
        parse_slurm(["partition"])


def test_a_purpose_reaches_the_series(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    app = typer.Typer()
    app.command()(dataset)
    words = ["--out", str(tmp_path / "data"), "--count", "1", "--seed", "3", "--json"]
    app(args=[*words, "--for", "peaks"], standalone_mode=False)
    assert json.loads(capsys.readouterr().out)["series"]["purpose"] == "peaks"
    with pytest.raises(ValueError, match="holds another data set: purpose 'peaks', wanted 'objects'"):
        app(args=words, standalone_mode=False)
    with pytest.raises(ValueError, match="purpose must be samples unless effects are auto, got 'peaks'"):
        app(args=[*words, "--for", "peaks", "--effects", "all"], standalone_mode=False)


def test_drives_are_counted_in_scans(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Two drives of two scans are four scenes; a number of scans beyond the limit leaves no folder behind."""
    dataset(tmp_path / "drives", 2, seed=1, motion=True, scans=2, effects="los_objects,motion", as_json=True)
    found = json.loads(capsys.readouterr().out)
    assert (found["scenes"], found["made"], found["series"]["scans"]) == (4, 4, 2)
    with pytest.raises(ValueError, match="--motion must come with --scans N, the scans of a drive, got none"):
        dataset(tmp_path / "none", 2, motion=True)
    with pytest.raises(ValueError, match=r"scans must be 1\.\.100, got 101"):
        dataset(tmp_path / "long", 2, motion=True, scans=101)
    assert not (tmp_path / "long").exists()


def test_statistics_as_json_and_as_text(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    statistics(folder, as_json=True)
    found = json.loads(capsys.readouterr().out)
    assert found["scenes"] == 3
    assert sum(found["places"].values()) == 3
    statistics(folder)
    text = capsys.readouterr().out
    assert text.startswith("3 scenes, points: ")
    assert "mirrors alone" in text
