"""Verbs in processes of their own: a folder in which a graph of one node may run, and whether a signal is heard."""

from __future__ import annotations

import signal
import subprocess
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

TICKING = """
name: ticking
nodes:
  tick:
    module: tests.graph.toy_nodes
    params: {kind: tick, period_s: 0.01}
"""


def hears_endings(process: subprocess.Popen[str]) -> bool:
    """Whether a verb has its handlers: SIGHUP, the last to get one, would end an interpreter that has just begun."""
    status = Path(f"/proc/{process.pid}/status").read_text()
    caught = next(line.split()[1] for line in status.splitlines() if line.startswith("SigCgt:"))
    return bool(int(caught, 16) >> (signal.SIGHUP - 1) & 1)


@contextmanager
def made_box(monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A folder with the launch file t.yaml, whose graph meets in its folder t; its name is short enough for sockets."""
    with tempfile.TemporaryDirectory(prefix="mw-") as name:
        monkeypatch.setenv("MIRRORWAVE_RUN_DIR", name)
        monkeypatch.setenv("MIRRORWAVE_DOMAIN", "t")
        (Path(name) / "t.yaml").write_text(TICKING)
        yield Path(name)
