"""One process of the graph from its parent's side: started, read, asked to stop, and never left behind."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from pathlib import Path

from msgs.files.shipped import CHECKOUT
from nodes.process.launch_file import GROUP_MODULE, NodeEntry
from nodes.process.logs import LineSplitter

#: Root of the checkout: children import nodes from here, wherever the graph was started.
_READ_BYTES = 1 << 16
#: Maximum reads of one pipe in a turn, so that a node that floods its output cannot delay the others.
_READS_PER_TURN = 16
#: Time for a process to end after SIGINT, and again after SIGTERM.
PATIENCE_S = 2.0

#: A node is one of several processes on few cores: BLAS threads that spin while they wait took a whole core from the
#: others (RA former 1.1 against 0.2 cores), and malloc returned each 4 MiB beam to the system only to ask again.
NODE_ENVIRONMENT = {
    "OPENBLAS_NUM_THREADS": "1",
    "OMP_NUM_THREADS": "1",
    "MALLOC_MMAP_THRESHOLD_": str(64 << 20),
    "MALLOC_TRIM_THRESHOLD_": str(256 << 20),
}


class Child:
    """The process of a node; its own process group, one pipe for all its output."""

    def __init__(self, name: str, entry: NodeEntry, run_dir: Path) -> None:
        self._splitter = LineSplitter()
        #: When SIGINT, and when SIGTERM, was sent.
        self._asked_s: float | None = None
        self._terminated_s: float | None = None
        self._process = subprocess.Popen(
            _command(name, entry, run_dir),
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            env=_environment(entry),
            process_group=0,
        )
        assert self._process.stdout is not None
        self._pipe = self._process.stdout.fileno()
        os.set_blocking(self._pipe, False)
        try:
            #: A file descriptor that can be read once the process has ended.
            self.ended = os.pidfd_open(self.pid)
        except OSError:
            self.kill()
            self._process.wait()
            self._process.stdout.close()
            raise

    @property
    def pid(self) -> int:
        """Process id, also of its process group."""
        return self._process.pid

    def exit_code(self) -> int | None:
        """Return None while it runs; then its exit code, negative for a signal. Its own children are killed."""
        if self._process.returncode is None and os.waitid(os.P_PID, self.pid, os.WEXITED | os.WNOHANG | os.WNOWAIT):
            # before the process is reaped its group's number cannot have been reused
            self._signal(signal.SIGKILL)
            self._process.wait()
        return self._process.returncode

    def read_lines(self) -> list[str]:
        """Return the whole lines it has written since the last call; never waits."""
        lines: list[str] = []
        for _ in range(_READS_PER_TURN):
            try:
                data = os.read(self._pipe, _READ_BYTES)
            except BlockingIOError:
                break
            if not data:
                break
            lines += self._splitter.feed(data)
        return lines

    def stop(self, now_s: float, patience_s: float = PATIENCE_S, last_s: float = PATIENCE_S) -> None:
        """Ask it to end: SIGINT, `patience_s` later SIGTERM, `last_s` later SIGKILL; to be called again until it has.

        Both may change with its known state. A stopped process is resumed, so that it handles the signal.
        """
        if self._asked_s is None:
            self._asked_s = now_s
            self._signal(signal.SIGINT)
            self._signal(signal.SIGCONT)
        elif self._terminated_s is None and now_s - self._asked_s >= patience_s:
            self._terminated_s = now_s
            self._signal(signal.SIGTERM)
        elif self._terminated_s is not None and now_s - self._terminated_s >= last_s:
            self.kill()

    def kill(self) -> None:
        """Kill it now."""
        self._signal(signal.SIGKILL)

    def close(self) -> list[str]:
        """Kill it if it runs, wait for it, close its descriptors; return its remaining output."""
        if self.exit_code() is None:
            self.kill()
            self._process.wait()
        assert self._process.stdout is not None
        if self._process.stdout.closed:
            return []
        lines = self.read_lines() + self._splitter.finish()
        self._process.stdout.close()
        os.close(self.ended)
        return lines

    def _signal(self, number: signal.Signals) -> None:
        if self._process.returncode is None:
            os.killpg(self.pid, number)


def _command(name: str, entry: NodeEntry, run_dir: Path) -> list[str]:
    # -P: a file of the working directory must not replace a module
    python, params = [sys.executable, "-P", "-m"], json.dumps(entry.params)
    common = ["--run-dir", str(run_dir), "--die-with", str(os.getpid())]
    if entry.module == GROUP_MODULE:
        return [*python, GROUP_MODULE, params, *common]
    return [*python, "nodes.node", entry.module, "--name", name, "--params", params, "--json-log", *common]


def _environment(entry: NodeEntry) -> dict[str, str]:
    paths = [str(CHECKOUT), *filter(None, [os.environ.get("PYTHONPATH")])]
    own = {"PYTHONUNBUFFERED": "1", "PYTHONPATH": os.pathsep.join(paths)}
    return {**os.environ, **NODE_ENVIRONMENT, **own, **entry.env}
