"""Processes of a training run."""

from __future__ import annotations

import subprocess
import sys

import pytest

from lab.training.ranks import lone_device

_LEAVING = """
import atexit, os, sys
from lab.training.ranks import leave

atexit.register(os.abort)
sys.stdout.write("said")
leave()
"""


def test_a_process_that_leaves_has_said_all_and_does_not_wait_for_its_interpreter_to_end() -> None:
    done = subprocess.run([sys.executable, "-c", _LEAVING], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout) == (0, "said"), done.stderr


def test_a_training_that_no_ranks_share_is_refused_to_several(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each of them would write the run folder."""
    monkeypatch.setenv("WORLD_SIZE", "1")
    assert lone_device().type in ("cpu", "cuda")
    monkeypatch.setenv("WORLD_SIZE", "2")
    with pytest.raises(ValueError, match="WORLD_SIZE must be 1 for a training of one process, got 2"):
        lone_device()
