"""One process of the graph from its parent's side: started, read, asked to stop, and never left behind."""

from __future__ import annotations

import json
import os
import signal
from pathlib import Path

from nodes.process.fork_server import ForkServer, environment, spawn
from nodes.process.launch_file import GROUP_MODULE, NodeEntry
from nodes.process.logs import LineSplitter

_READ_BYTES = 1 << 16
#: Maximum reads of one pipe in a turn, so that a node that floods its output cannot delay the others.
_READS_PER_TURN = 16
#: Time for a process to end after SIGINT, and again after SIGTERM.
PATIENCE_S = 2.0


class Child:
    """The process of a node; its own process group, one pipe for all its output.

    It gets ready but begins only when told to. `server`: forks it, where it can; otherwise it is started by itself.
    """

    def __init__(self, name: str, entry: NodeEntry, run_dir: Path, server: ForkServer | None = None) -> None:
        self._splitter = LineSplitter()
        #: When SIGINT, and when SIGTERM, was sent.
        self._asked_s: float | None = None
        self._terminated_s: float | None = None
        self._code: int | None = None
        given, begin = os.pipe()
        pipe, output = os.pipe()
        os.set_blocking(pipe, False)
        #: Ends of its standard input, until it may begin, and of its output, until all has been read.
        self._begin: int | None = begin
        self._pipe: int | None = pipe
        words = _command(name, entry, run_dir)
        try:
            pid = server.fork(words, given, output) if server is not None and not entry.env else None
            #: Process id, also of its process group.
            self.pid = spawn(words, environment(entry.env), given, output) if pid is None else pid
        except OSError:
            self._close_pipes()
            raise
        finally:
            os.close(given)
            os.close(output)
        try:
            #: A file descriptor that can be read once the process has ended.
            self.ended = os.pidfd_open(self.pid)
        except OSError:
            self.kill()
            self._reap()
            self._close_pipes()
            raise

    def begin(self) -> None:
        """Let it begin as soon as it is ready to."""
        if self._begin is not None:
            os.close(self._begin)
            self._begin = None

    def exit_code(self) -> int | None:
        """Return None while it runs; then its exit code, negative for a signal. Its own children are killed."""
        if self._code is None and os.waitid(os.P_PID, self.pid, os.WEXITED | os.WNOHANG | os.WNOWAIT):
            # before the process is reaped its group's number cannot have been reused
            self._signal(signal.SIGKILL)
            self._reap()
        return self._code

    def read_lines(self) -> list[str]:
        """Return the whole lines it has written since the last call; never waits."""
        assert self._pipe is not None
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
            self._reap()
        if self._pipe is None:
            return []
        lines = self.read_lines() + self._splitter.finish()
        self._close_pipes()
        os.close(self.ended)
        return lines

    def _close_pipes(self) -> None:
        self.begin()
        if self._pipe is not None:
            os.close(self._pipe)
            self._pipe = None

    def _reap(self) -> None:
        self._code = os.waitstatus_to_exitcode(os.waitpid(self.pid, 0)[1])

    def _signal(self, number: signal.Signals) -> None:
        if self._code is None:
            os.killpg(self.pid, number)


def _command(name: str, entry: NodeEntry, run_dir: Path) -> list[str]:
    """Return the module that the interpreter runs as a program, and its arguments."""
    params = json.dumps(entry.params)
    common = ["--run-dir", str(run_dir), "--die-with", str(os.getpid()), "--wait"]
    if entry.module == GROUP_MODULE:
        return [GROUP_MODULE, params, *common]
    sensor = ["--sensor", entry.sensor] if entry.sensor else []
    return ["nodes.node", entry.module, "--name", name, "--params", params, *sensor, "--json-log", *common]
