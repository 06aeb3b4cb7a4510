"""A trigger of a snapshot gets the answer to its own question, and none other."""

from __future__ import annotations

import os
import signal
from collections.abc import Iterator
from pathlib import Path

import pytest

from nodes.recording import snapshot_trigger
from nodes.recording.snapshot_trigger import Snapshot, TriggerFile, ask, find_recorders


@pytest.fixture
def recorder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[TriggerFile]:
    """A recorder that hears a signal at once and has written its snapshot when whoever asked looks again."""
    file, answers = TriggerFile(tmp_path / "run"), iter(range(1, 10))
    monkeypatch.setattr(snapshot_trigger.os, "kill", lambda pid, number: _hear(file, pid, number))
    monkeypatch.setattr(snapshot_trigger.time, "sleep", lambda _: file.answer(Snapshot(messages=next(answers))))
    yield file
    file.close()


def _hear(file: TriggerFile, pid: int, number: int) -> None:
    assert (pid, number) == (os.getpid(), signal.SIGUSR1)
    file.say_busy()


@pytest.mark.usefixtures("recorder")
def test_who_asks_waits_until_the_snapshot_is_written(tmp_path: Path) -> None:
    (path,) = find_recorders(tmp_path / "run")
    assert [ask(path, 60.0).messages for _ in range(2)] == [1, 2]


def test_a_snapshot_that_somebody_else_asked_for_is_no_answer(recorder: TriggerFile, tmp_path: Path) -> None:
    recorder.say_busy()
    (path,) = find_recorders(tmp_path / "run")
    assert ask(path, 60.0).messages == 2


def test_a_recorder_that_has_ended_is_not_waited_for(recorder: TriggerFile, tmp_path: Path) -> None:
    (path,) = find_recorders(tmp_path / "run")
    recorder.close()
    assert find_recorders(tmp_path / "run") == []
    with pytest.raises(ChildProcessError, match="its recorder has ended"):
        ask(path, 60.0)
