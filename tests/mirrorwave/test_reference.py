"""The reference pages say what the code says."""

from __future__ import annotations

import re
from pathlib import Path

import msgspec
import pytest

from mirrorwave.reference import fields_of, main, node_modules, pages
from msgs.bus.topics import SHIPPED
from msgs.files.shipped import CHECKOUT
from msgs.values.perception import Track
from nodes.process.launch_file import read_launch_file
from nodes.recording.params import RecordingParams

ROOT = CHECKOUT


@pytest.mark.slow
def test_pages_name_every_topic_node_and_verb(tmp_path: Path) -> None:
    assert main([str(tmp_path)]) == 0
    written = {path.name: path.read_text(encoding="utf-8") for path in tmp_path.iterdir()}
    assert written == pages()
    assert set(SHIPPED) <= set(re.findall(r"^\| `([^`]+)`", written["messages.md"], re.MULTILINE))
    assert re.findall(r"^## ([\w.]+)$", written["parameters.md"], re.MULTILINE) == node_modules()
    assert {"mirrorwave launch", "mirrorwave sim run"} <= set(
        re.findall(r"`(mirrorwave[\w -]+)`", written["commands.md"])
    )


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
    assert main([]) == main(["--help"]) == 2
    assert "usage" in capsys.readouterr().err
