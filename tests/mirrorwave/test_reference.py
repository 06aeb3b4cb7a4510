"""The reference pages say what the code says."""

from __future__ import annotations

import msgspec
import pytest

from mirrorwave.reference import fields_of, main, node_modules, pages
from msgs.files.shipped import CHECKOUT
from msgs.values.perception import Track
from nodes.process.launch_file import read_launch_file
from nodes.recording.params import RecordingParams

ROOT = CHECKOUT


@pytest.mark.slow
@pytest.mark.parametrize("name", ["messages.md", "parameters.md", "commands.md"])
def test_committed_pages_are_up_to_date(name: str) -> None:
    """If this fails: make reference."""
    assert (ROOT / "docs" / "reference" / name).read_text(encoding="utf-8") == pages()[name]


def test_fields_have_the_words_of_their_source() -> None:
    fields = {one.name: one for one in fields_of(Track)}
    assert list(fields) == [one.name for one in msgspec.structs.fields(Track)]
    assert fields["id"].default == "required"
    assert fields["time_to_appear_s"].annotation == r"float \| None"
    assert "direct sight" in fields["time_to_appear_s"].comment
    assert {one.name for one in fields_of(RecordingParams)} >= {"path", "topics", "raw"}


def test_every_node_of_the_launch_files_is_there() -> None:
    launched = {
        entry.module
        for path in (ROOT / "launch").glob("*.yaml")
        if path.stem != "tradeoff"
        for entry in read_launch_file(path).nodes.values()
    }
    assert launched <= set(node_modules())


def test_a_folder_must_be_named(capsys: pytest.CaptureFixture[str]) -> None:
    assert main([]) == 2
    assert "usage" in capsys.readouterr().err
