"""Captures are looked for in one way, and where they are, CI skips none of their tests."""

from __future__ import annotations

import os
import subprocess
from pathlib import Path

import pytest

from msgs.files.shipped import CHECKOUT
from tests import captures

ROOT = CHECKOUT


def test_the_nearest_folder_is_taken(tmp_path: Path) -> None:
    checkout = tmp_path / "builds" / "1" / "main"
    checkout.mkdir(parents=True)
    for folder in (tmp_path, checkout.parent, checkout):
        (folder / "shared" / "data").mkdir(parents=True)
        assert captures.found(checkout) == folder / "shared" / "data"


def test_only_an_unnamed_folder_may_lack_a_capture(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(captures, "DATA", tmp_path)
    here, absent = tmp_path / "here", tmp_path / "some" / "absent.log"
    here.touch()
    for named, is_skipped in ((None, True), (str(tmp_path), False)):
        monkeypatch.setattr(captures, "_NAMED", named)
        assert not captures.needs(here).args[0]
        assert captures.needs(absent).args[0] is is_skipped
        assert captures.needs(absent).kwargs["reason"] == "some/absent.log is absent"


def test_nothing_else_looks_for_captures() -> None:
    own = {Path(__file__), ROOT / "tests" / "captures.py"}
    others = [path for path in (ROOT / "tests").rglob("*.py") if path not in own]
    found = [path for path in others if "MIRRORWAVE_DATA" in (text := path.read_text()) or '"shared" /' in text]
    assert len(others) > 100
    assert found == []


@pytest.mark.parametrize("are_there", [True, False])
def test_ci_names_the_folder_beside_its_clone(are_there: bool, tmp_path: Path) -> None:
    """Run with programs that do nothing; `make` tells what it is given."""
    script = tmp_path / "main" / ".ci" / "run"
    script.parent.mkdir(parents=True)
    script.write_text((ROOT / ".ci" / "run").read_text())
    programs = tmp_path / "bin"
    programs.mkdir()
    for name in ("make", "chromium"):
        (programs / name).write_text('#!/bin/sh\necho "$@: ${MIRRORWAVE_DATA-none}"\n')
        (programs / name).chmod(0o755)
    if are_there:
        (tmp_path / "shared" / "data").mkdir(parents=True)
    environment = {**os.environ, "PATH": f"{programs}:{os.environ['PATH']}"}
    environment.pop("MIRRORWAVE_DATA", None)
    done = subprocess.run(["bash", script], env=environment, cwd="/", capture_output=True, text=True, check=True)
    assert f"test: {tmp_path / 'shared' / 'data' if are_there else 'none'}\n" in done.stdout
    assert ("will be skipped by name" in done.stdout) is not are_there
