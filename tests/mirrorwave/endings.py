"""Whether a process has come so far that it hears a signal."""

from __future__ import annotations

import signal
import subprocess
from pathlib import Path


def hears_endings(process: subprocess.Popen[str]) -> bool:
    """Whether a verb has its handlers: SIGHUP, the last to get one, would end an interpreter that has just begun."""
    status = Path(f"/proc/{process.pid}/status").read_text()
    caught = next(line.split()[1] for line in status.splitlines() if line.startswith("SigCgt:"))
    return bool(int(caught, 16) >> (signal.SIGHUP - 1) & 1)
