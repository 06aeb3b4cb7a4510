"""A launched graph and somebody who listens to it: what it said, which process each node is, when views came."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, NamedTuple

import psutil

from msgs.bus.zmq import ZmqBus
from msgs.files.shipped import CHECKOUT
from msgs.values.diagnostics import LogRecord, NodeState, NodeStatus
from msgs.values.perception import BevFrame

#: Nothing is measured against this: it ends a test that would wait for ever. A fresh checkout's first graph compiles.
PATIENCE_S = 240.0
HEARD = ("perception/hidden_objects", "diagnostics/node", "log")
ROOT = CHECKOUT


def _runs(status: NodeStatus | None) -> bool:
    return status is not None and psutil.pid_exists(status.pid)


class Said(NamedTuple):
    """A line of the graph's log and when it was heard."""

    time_s: float
    node: str
    level: str
    text: str


class LiveGraph:
    """`mirrorwave launch` as a process, with an observer on the graph's bus; `close` stops it in order."""

    def __init__(self, launch: Path, root: Path, *options: str) -> None:
        self.run_dir, self.out = root / "g", root / "out.txt"
        self.environment = {**os.environ, "MIRRORWAVE_RUN_DIR": str(root)}
        self.command = [sys.executable, "-m", "mirrorwave", "launch", str(launch), "--domain", "g"]
        self.command += ["--runs-dir", str(root / "runs"), *options]
        with self.out.open("w") as file:
            self.process = subprocess.Popen(
                self.command, cwd=ROOT, env=self.environment, stdout=file, stderr=subprocess.STDOUT
            )
        self.bus = ZmqBus("observer", self.run_dir)
        for topic in HEARD:
            self.bus.subscribe(topic)
        self.status: dict[str, NodeStatus] = {}
        self.said: list[Said] = []
        self.view: BevFrame | None = None
        self.views = 0
        #: A file system of its own for recordings, where there is one.
        self.disk: Path | None = None

    def listen(self, for_s: float) -> None:
        """Take in what comes within a moment."""
        for received in self.bus.receive(for_s):
            match received.message:
                case NodeStatus() as status:
                    self.status[status.node] = status
                case LogRecord() as record:
                    self.said.append(Said(time.monotonic(), record.node, record.level, record.text))
                case BevFrame() as view:
                    self.view, self.views = view, self.views + 1

    def await_that(self, what: str, is_so: Callable[[], Any]) -> Any:
        """Listen until `is_so` gives something true, which comes back; an assertion that names `what` otherwise."""
        end_s = time.monotonic() + PATIENCE_S
        while not (found := is_so()):
            assert self.process.poll() is None, f"the graph ended while waiting for {what}: {self.out.read_text()}"
            assert time.monotonic() < end_s, f"waited in vain for {what}: {self.said[-20:]}"
            self.listen(0.05)
        return found

    def await_ready(self, nodes: Iterable[str], other_than: dict[str, int] | None = None) -> None:
        """Wait for a living heartbeat of each node, of another process than before where `other_than` tells its pid."""
        before = other_than or {}
        alive = (NodeState.READY, NodeState.DEGRADED)

        def are_ready() -> bool:
            known = [self.status.get(name) for name in nodes]
            return all(one and one.state in alive and one.pid != before.get(one.node) for one in known)

        self.await_that(f"{', '.join(nodes)} to be ready", are_ready)

    def await_views(self, count: int = 2, since_ns: int | None = None) -> float:
        """Wait for views of scans measured from now, or from `since_ns`, on; seconds until the first of them came."""
        since_ns = time.monotonic_ns() if since_ns is None else since_ns
        self.await_that("a new view", lambda: self.view is not None and self.view.stamp_ns > since_ns)
        first_s, seen = 1e-9 * (time.monotonic_ns() - since_ns), self.views
        self.await_that("more views", lambda: self.views >= seen + count - 1)
        return first_s

    def await_text(self, text: str, node: str | None = None, start: int = 0) -> Said:
        """Wait for a line of the log from the `start`-th on that holds `text`, of `node` if one is named."""
        return self.await_that(f"{text!r} in the log", lambda: self.found(text, node, start))  # type: ignore[no-any-return]

    def found(self, text: str, node: str | None = None, start: int = 0) -> Said | None:
        """That line if it has come."""
        lines = (one for one in self.said[start:] if node in (None, one.node))
        return next((one for one in lines if text in one.text), None)

    def pids(self) -> dict[str, int]:
        """Process of each node that was heard, the supervisor's left out."""
        return {name: status.pid for name, status in self.status.items() if name != "supervisor"}

    def lost(self, node: str, topic: str) -> int:
        """Messages of `topic` that a node has counted as lost."""
        return sum(count.lost for count in self.status[node].received if count.topic == topic)

    def rejected(self, node: str, topic: str) -> int:
        """Messages of `topic` that a node has counted as unreadable."""
        found = self.status.get(node)
        return sum(count.rejected for count in found.received if count.topic == topic) if found else 0

    def fault(self, number: signal.Signals, nodes: Iterable[str]) -> dict[str, int]:
        """Send a signal to nodes at once; their pids. One that a busy machine made hang is waited for."""
        names = list(nodes)
        self.await_that("processes of the last heartbeats", lambda: all(map(_runs, map(self.status.get, names))))
        pids = {name: self.status[name].pid for name in names}
        for pid in pids.values():
            os.kill(pid, number)
        return pids

    def close(self) -> int:
        """Stop the graph; its exit code. No process of it is left."""
        try:
            self.process.send_signal(signal.SIGINT)
            return self.process.wait(PATIENCE_S)
        finally:
            self.process.kill()
            self.bus.close()

    def kill(self) -> int:
        """End the supervisor as a crash would; its exit code."""
        try:
            self.process.kill()
            return self.process.wait(PATIENCE_S)
        finally:
            self.bus.close()
