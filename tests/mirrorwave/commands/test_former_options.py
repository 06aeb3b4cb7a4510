"""Spellings of earlier versions: still accepted, one line where a constant took their place."""

from __future__ import annotations

from pathlib import Path

import pytest
import typer

from mirrorwave.cli import command_line, main
from mirrorwave.commands.former_options import _CONSTANTS, _RENAMED, _VERBS, present_words


@pytest.mark.parametrize(
    ("words", "today", "said"),
    [
        ("eval --places 5 --objects", "eval --count 5 --objects", ""),
        ("tradeoff --frames=3", "tradeoff --count 3", ""),
        ("can monitor -i virtual --bitrate 500000", "can monitor -i virtual --option bitrate=500000", ""),
        ("bag trim a b --start 1", "bag filter a b --start 1", ""),
        ("export run --split all --out x", "export run --out x", "--split of `export` is a constant: the test scenes"),
        ("node kill a --signal=STOP", "node kill a", "--signal of `node kill` is a constant: KILL"),
        ("train dense --data d --split x", "train dense --data d --split x", ""),
        ("sim run a --out b", "sim run a --out b", ""),
        ("compare --jobs", "compare --workers", ""),
        ("", "", ""),
    ],
)
def test_former_words_become_those_of_today(words: str, today: str, said: str) -> None:
    lines: list[str] = []
    assert present_words(words.split(), lines.append) == today.split()
    assert [line[: len(said)] for line in lines] == ([said] if said else [])


def test_a_constant_is_said_and_the_verb_goes_on(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["export", str(tmp_path / "none"), "--test", "d", "--out", str(tmp_path / "a.onnx")]) == 2
    said = capsys.readouterr().err.splitlines()
    assert said[0] == "mirrorwave: --test of `export` is a constant: the test scenes of the run's data"
    assert "must exist" in said[1]


def test_no_former_option_is_one_of_today() -> None:
    """Every verb of the tables exists, has what renamed options became, and has no option of a former name."""
    line = typer.main.get_command(command_line())
    for verb in {*_RENAMED, *_CONSTANTS, *_VERBS.values()}:
        command = line
        for word in verb.split():
            command = command.commands[word]  # type: ignore[attr-defined]
        options = {name for param in command.params for name in param.opts}
        renamed = _RENAMED.get(verb, {})
        assert not options & {*renamed, *_CONSTANTS.get(verb, ())}
        assert {name.partition("=")[0] for name in renamed.values()} <= options
