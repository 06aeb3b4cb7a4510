"""Verb groups of other installed packages: entry points of the group `mirrorwave.verbs`."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from mirrorwave import cli
from msgs.files.plugins import VERBS
from tests.plugins import write_package

THEIRS = """
import typer

app = typer.Typer(help="Their verbs.", no_args_is_help=True)

@app.command()
def greet(name: str) -> None:
    "Greet."
    typer.echo(f"hello {name}")

@app.command()
def leave() -> None:
    "Leave."
"""


@pytest.fixture
def theirs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    write_package(tmp_path, "theirs", VERBS, {"their_verbs": "their_verbs"}, their_verbs=THEIRS)
    write_package(tmp_path, "torn", VERBS, {"torn_verbs": "torn_verbs"}, torn_verbs="import no_such_library")
    monkeypatch.syspath_prepend(tmp_path)
    cli.command_line.cache_clear()
    yield
    cli.command_line.cache_clear()


@pytest.mark.usefixtures("theirs")
def test_a_package_brings_verbs(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["their_verbs", "greet", "Ada"]) == 0
    assert capsys.readouterr().out == "hello Ada\n"


@pytest.mark.usefixtures("theirs")
def test_the_help_lists_them_and_leaves_out_what_is_broken(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["--help"]) == 0
    text = capsys.readouterr().out
    assert "Of other packages" in text
    assert "their_verbs" in text
    assert "torn_verbs" not in text


@pytest.mark.usefixtures("theirs")
def test_a_broken_one_says_what_it_lacks(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["torn_verbs"]) == 2
    assert "torn_verbs of torn 1.2: torn_verbs needs no_such_library" in capsys.readouterr().err
