"""Processes of a training run."""

from __future__ import annotations

import subprocess
import sys

_LEAVING = """
import atexit, os, sys
from models.training.ranks import leave

atexit.register(os.abort)
sys.stdout.write("said")
leave()
"""


def test_a_process_that_leaves_has_said_all_and_does_not_wait_for_its_interpreter_to_end() -> None:
    done = subprocess.run([sys.executable, "-c", _LEAVING], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout) == (0, "said"), done.stderr
