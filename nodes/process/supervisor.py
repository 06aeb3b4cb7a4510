"""Starts the processes of a graph, watches them, restarts what fails, and leaves nothing behind.

One thread, one loop: receive heartbeats, read output, reap, restart, stop. Nodes get ready side by side; one begins
when all of its `after` are ready. Children also ask the kernel to die with this process, so that not even SIGKILL
leaves an orphan.
"""

from __future__ import annotations

import contextlib
import fcntl
import json
import math
import os
import signal
import time
from collections import deque
from collections.abc import Callable, Collection, Iterator
from enum import StrEnum
from pathlib import Path
from typing import Any, TextIO

import msgspec

from msgs.bus.interface import Received
from msgs.files.open_files import require_open_files
from msgs.files.whole_files import no_link
from msgs.values.diagnostics import LogRecord, NodeState, NodeStatus
from msgs.values.node_params import ParamRequest
from msgs.values.wording import counted
from nodes.node import EXIT_BAD_INPUT, EXIT_DONE, EXIT_FAILED, Heartbeat, one_line, stopping_signals
from nodes.process.child import PATIENCE_S, Child
from nodes.process.fork_server import ForkServer
from nodes.process.launch_file import (
    RECORDER_MODULE,
    SUPERVISOR,
    LaunchFile,
    NodeEntry,
    RestartPolicy,
    dump_launch,
    processes,
    stop_order,
)
from nodes.process.liveness import LATE_S, Doing, Silence, sample
from nodes.process.logs import BUS_TEXT_LIMIT, JsonLog, parse_line, utc_now
from nodes.process.restarts import Restart, RestartServer

#: Interval between reads of the nodes' output; a crash wakes the supervisor at once.
POLL_S = 0.05
#: A node silent for this long is reported, with its activity.
SILENT_S = 0.9
#: Minimum interval between such reports of a node.
_SILENCE_INTERVAL_S = 10.0
#: Maximum time for a stopped, blocked or endlessly stepping node to answer its waiting inputs, and then to close its
#: files.
_STUCK_PATIENCE_S, _STUCK_LAST_S = 0.5, 1.5
#: Maximum time for a recorder to write its data: a snapshot takes seconds.
_RECORDER_LAST_S = 10.0
#: Maximum time for a node that is asked to stop at the end of a stream to answer its waiting inputs.
DRAIN_S = 5.0
LOCK_NAME = "supervisor.lock"

LogSink = Callable[[dict[str, Any]], None]


class Phase(StrEnum):
    """State of a node in the graph."""

    WAITING = "waiting"
    STARTING = "starting"
    READY = "ready"
    ENDED = "ended"
    FAILED = "failed"


class _Watched:
    """A process of the graph, of one node or of several: its entry, its child if it has one, its history."""

    def __init__(self, entry: NodeEntry, members: Collection[str] = ("",)) -> None:
        self.entry = entry
        #: Nodes that it hosts, and which of them are ready.
        self.members, self.ready = frozenset(members), set[str]()
        self.phase = Phase.WAITING
        self.child: Child | None = None
        self.was_ready = False
        #: WAITING nodes start no earlier.
        self.start_at_s = 0.0
        self.started_s = 0.0
        self._heard_s: dict[str, float] = {}
        #: Its silence since its heartbeat is late; None while it is not.
        self.silence: Silence | None = None
        #: When the log last reported its silence; whether it reported the present one.
        self.silence_said_s, self.is_said = -math.inf, False
        self.restarts: deque[float] = deque()
        #: Last error it reported itself, and the reason for which the supervisor killed it.
        self.reason = self.killed_for = ""
        #: Whether it has said what it ends of: what members of its group say after that is no reason.
        self.has_failed = False

    def recent_restarts(self, now_s: float) -> int:
        while self.restarts and self.restarts[0] <= now_s - self.entry.restart.window_s:
            self.restarts.popleft()
        return len(self.restarts)

    def start(self, name: str, run_dir: Path, now_s: float, server: ForkServer | None) -> None:
        self.phase, self.started_s = Phase.STARTING, now_s
        self.reason, self.killed_for, self.has_failed = "", "", False
        self.ready.clear()
        self.heard(now_s)
        self.child = Child(name, self.entry, run_dir, server)

    def report(self, reason: str, is_last: bool = False) -> None:
        """Take in an error of its own; after one of which it ends none counts any more."""
        if reason and not self.has_failed:
            self.reason, self.has_failed = reason, is_last

    def kill(self) -> None:
        if self.child is not None:
            self.child.kill()

    @property
    def heard_s(self) -> float:
        """When all its nodes had been heard of."""
        return min(self._heard_s.values(), default=0.0)

    def heard(self, now_s: float, member: str | None = None) -> None:
        """Note that a node of it was heard of, or all were."""
        before_s = self.heard_s
        self._heard_s |= dict.fromkeys(self.members if member is None else (member,), now_s)
        if self.heard_s > before_s or len(self.members) == 1:
            self.silence, self.is_said = None, False

    def is_silent(self, now_s: float) -> bool:
        """Return whether it, once ready, has been silent for so long that this is to be reported."""
        is_known = self.silence is not None and self.silence.doing is not None
        return is_known and self.phase is Phase.READY and now_s - self.heard_s >= SILENT_S

    def look(self, now_s: float) -> str:
        """Sample its process if its heartbeat is late; return why it counts as hanging, empty if it does not."""
        if self.child is None or now_s - self.heard_s < LATE_S:
            return ""
        self.silence = self.silence or Silence()
        self.silence.add(sample(self.child.pid))
        if self.phase is Phase.READY:
            return self.silence.overdue(self.entry.hang_timeout_s)
        reason = self.silence.overdue(self.entry.start_timeout_s, is_starting=True)
        return f"not ready, {reason}" if reason else ""

    def stop(self, now_s: float, patience_s: float, by_hand: bool) -> None:
        if self.child is None:
            return
        self.look(now_s)
        if self._is_stuck(by_hand):
            self.child.stop(now_s, min(patience_s, _STUCK_PATIENCE_S), _STUCK_LAST_S)
        else:
            self.child.stop(now_s, patience_s, _RECORDER_LAST_S if self.records else PATIENCE_S)

    def _is_stuck(self, by_hand: bool) -> bool:
        """Return whether it will hardly answer its inputs; for a stop by hand a long step counts too."""
        if self.silence is None:
            return False
        is_busy = self.silence.doing is Doing.BUSY and self.silence.answerable_s >= SILENT_S
        stands = self.silence.doing in (Doing.BLOCKED, Doing.STOPPED)
        return stands or (by_hand and is_busy and not self.records)

    @property
    def records(self) -> bool:
        return self.entry.module == RECORDER_MODULE

    @property
    def has_been_ready(self) -> bool:
        """Return whether nodes that come after it need not wait for it."""
        return self.was_ready or self.phase is Phase.ENDED

    def why(self, code: int) -> str:
        """Return why it ended, as far as known; a process killed by a foreign signal could not report it."""
        return self.killed_for or (self.reason if code >= 0 else "")


class Supervisor:
    """Runs one graph from start to end: `Supervisor(launch, run_dir).run()`.

    `on_log` gets every entry of the log (time, node, level, text); the same entries go to `log.jsonl` in the run
    folder `runs_dir/<name>-<n>`, beside the resolved `launch.yaml`. `duration_s` counts from all nodes ready. One that
    `holds` goes on when a node that ends the graph has come to its end, for those who look at its last view.
    """

    def __init__(
        self,
        launch: LaunchFile,
        run_dir: Path,
        *,
        runs_dir: Path = Path("runs"),
        duration_s: float | None = None,
        on_log: LogSink | None = None,
        server: ForkServer | None = None,
        holds: bool = False,
    ) -> None:
        if duration_s is not None and not duration_s > 0.0:
            raise ValueError(f"duration_s must be above zero, got {duration_s!r}")
        self._launch, self._run_dir, self._duration_s, self._on_log = launch, run_dir, duration_s, on_log
        self._holds = holds
        self._homes = {name: entry.process or name for name, entry in launch.nodes.items()}
        self._nodes = {
            process: _Watched(entry, [name for name, home in self._homes.items() if home == process])
            for process, entry in processes(launch).items()
        }
        self._runs_dir = runs_dir
        #: Forks the nodes of a graph of several processes; one that was started before is closed with the graph too.
        self._server = server
        self._serves = False
        self._exit_code = EXIT_DONE
        self._stop_requests = 0
        self._asked_for_patience = False
        #: Nodes still to be stopped one after the other; None while the graph runs.
        self._stopping: list[list[str]] | None = None
        self._stop_at_s: float | None = None

    def request_stop(self) -> None:
        """Ask the graph to end, from a signal handler or a callback; a second request gets a line, a third kills."""
        self._stop_requests += 1

    def run(self) -> int:
        """Run the graph to its end; exit code 0 done, 1 a node failed for good, 2 a node refused its parameters.

        Raises `OSError` if the graph's directory is in use by another graph or not writable, or if too few files may be
        open, `ValueError` if the directory is not ours alone. Call it from the thread that lives longest: the kernel
        kills the nodes when the thread that started them ends.
        """
        from msgs.bus.declared import write_declared
        from msgs.bus.zmq import ZmqBus, make_run_dir

        require_open_files()
        with contextlib.ExitStack() as stack:
            self._have_server(stack)
            make_run_dir(self._run_dir)
            run_folder = stack.enter_context(self._locked())
            self._log = JsonLog(run_folder / "log.jsonl")
            stack.callback(self._log.close)
            origin = f"launch file of graph {self._launch.name}"
            write_declared(self._run_dir, self._launch.topics, origin, self._launch.sensors)
            stack.callback(write_declared, self._run_dir, {}, "")
            self._bus = ZmqBus(SUPERVISOR, self._run_dir)
            stack.callback(self._bus.close)
            self._heartbeat = Heartbeat(self._bus, SUPERVISOR)
            self._bus.subscribe("diagnostics/node")
            self._restarts = RestartServer(self._bus)
            if self._server is not None:
                self._bus.watch(self._server.fileno())
            stack.callback(self._close_all)
            stack.enter_context(self._signals())
            self._say("info", f"graph {self._launch.name}: {counted(len(self._homes), 'node')}, log in {run_folder}")
            self._loop()
        return self._exit_code

    def _have_server(self, stack: contextlib.ExitStack) -> None:
        if len(self._nodes) > 1:
            self._server = self._server or ForkServer()
            stack.callback(self._server.close)
        elif self._server is not None:
            # one process has nothing to share
            self._server.close()
            self._server = None

    def _loop(self) -> None:
        while not self._all_gone():
            messages = self._bus.receive(POLL_S)
            now_s = time.monotonic()
            self._look_at_server()
            self._hear(messages, now_s)
            for name, node in self._nodes.items():
                if node.child is not None:
                    self._pass_on(name, node.child.read_lines())
            self._reap(now_s)
            self._look_at_silent(now_s)
            self._check_end(now_s)
            self._start_or_stop(now_s)
            self._report()

    def _look_at_server(self) -> None:
        server = self._server
        if server is None:
            return
        server.look()
        if not server.is_starting and not self._serves:
            self._serves = True
            self._bus.unwatch(server.fileno())
        if server.failure:
            self._say("warning", f"nodes are started without the fork server from now on: {server.failure}")
            self._server = None

    # messages of the nodes

    def _hear(self, messages: list[Received], now_s: float) -> None:
        for received in messages:
            status = received.message
            if isinstance(status, ParamRequest):
                self._begin_restart(status)
                continue
            assert isinstance(status, NodeStatus)
            node = self._nodes.get(self._homes.get(status.node, ""))
            # a heartbeat in transit when its process died does not concern the next process
            if node is None or node.child is None or node.child.pid != status.pid:
                continue
            if node.is_said:
                self._say("info", f"{status.node} answers again after {now_s - node.heard_s:.1f} s")
            node.heard(now_s, status.node)
            node.report(status.reason)

    def _pass_on(self, name: str, lines: list[str]) -> None:
        for line in lines:
            node = self._nodes[name]
            entry = parse_line(name, line, node.members)
            if entry.get("level") in ("error", "critical"):
                node.report(entry["text"], is_last=entry["level"] == "critical")
            if entry.get("state") == NodeState.READY:
                node.ready.add(entry["node"])
                if node.ready == node.members:
                    self._mark_ready(name, node, time.monotonic())
            else:
                self._write(entry)

    def _mark_ready(self, name: str, node: _Watched, now_s: float) -> None:
        assert node.child is not None
        node.phase, node.was_ready = Phase.READY, True
        node.heard(now_s)
        self._say("info", f"{name} ready after {now_s - node.started_s:.2f} s, pid {node.child.pid}")
        restart = self._restart_of(name)
        if restart is not None and restart.has_ended:
            self._restarts.end()

    # restarts on request

    def _begin_restart(self, request: ParamRequest) -> None:
        restart = self._restarts.begin(request, self._launch.nodes)
        if restart is None:
            return
        if self._stopping is not None:
            self._restarts.end("the graph is stopping")
            return
        self._say("info", f"{restart.node} is restarted: asked to")
        if self._nodes[self._homes[restart.node]].child is None:
            self._start_again(restart)

    def _restart_of(self, process: str) -> Restart | None:
        """Return the restart that is under way if it is of a node of this process."""
        restart = self._restarts.current
        return restart if restart is not None and self._homes[restart.node] == process else None

    def _start_again(self, restart: Restart) -> None:
        restart.has_ended = True
        process = self._homes[restart.node]
        nodes = {**self._launch.nodes, restart.node: restart.entry}
        self._launch = msgspec.structs.replace(self._launch, nodes=nodes)
        node = self._nodes[process]
        node.entry, node.phase, node.start_at_s = processes(self._launch)[process], Phase.WAITING, 0.0

    def _is_of_restart(self, name: str, node: _Watched, code: int) -> bool:
        """Take care of the end of a process that a restart on request brought about; return whether it did."""
        restart = self._restart_of(name)
        if restart is None:
            return False
        if restart.has_ended:
            reason = node.why(code) or _how(code)
            if restart.entry == restart.before:
                self._restarts.end(reason)
                return False
            self._say("warning", f"{name} is started as it was, as it {_how(code)} with its new parameters: {reason}")
            restart.entry, restart.error = restart.before, reason
        self._start_again(restart)
        return True

    # restarts and failures

    def _reap(self, now_s: float) -> None:
        for name, node in self._nodes.items():
            code = node.child.exit_code() if node.child else None
            if node.child is not None and code is not None:
                self._let_go(name, node)
                self._after_exit(name, node, code, now_s)

    def _let_go(self, name: str, node: _Watched) -> None:
        """Close an ended node's process, or kill it."""
        if node.child is not None:
            self._bus.unwatch(node.child.ended)
            self._pass_on(name, node.child.close())
            node.child, node.silence, node.is_said = None, None, False

    def _after_exit(self, name: str, node: _Watched, code: int, now_s: float) -> None:
        restart = node.entry.restart
        again = restart.policy is RestartPolicy.ALWAYS or (code != 0 and restart.policy is RestartPolicy.ON_FAILURE)
        if self._stopping is not None:
            self._after_stop(name, node, code)
        elif self._is_of_restart(name, node, code):
            return
        elif not again or code == EXIT_BAD_INPUT:
            self._end_node(name, node, code)
        elif node.recent_restarts(now_s) >= restart.max_restarts:
            self._say(
                "error", f"{name} {_how(code)}; {counted(restart.max_restarts, 'restart')} in {restart.window_s:g} s"
            )
            self._fail(name, node, code)
        else:
            delay_s = restart.backoff_s(len(node.restarts))
            node.restarts.append(now_s)
            node.phase, node.start_at_s = Phase.WAITING, now_s + delay_s
            self._say("warning", f"{name} {_how(code)}{_because(node.why(code))}; restart in {delay_s:g} s")

    def _after_stop(self, name: str, node: _Watched, code: int) -> None:
        if code > 0:
            self._fail(name, node, code)
            return
        if code == -signal.SIGKILL and node.phase is Phase.READY:
            self._say("warning", f"{name} did not stop when asked and was killed")
        node.phase = Phase.ENDED

    def _end_node(self, name: str, node: _Watched, code: int) -> None:
        if code != 0:
            self._fail(name, node, code)
            return
        node.phase = Phase.ENDED
        self._say("info", f"{name} has ended")
        if not node.entry.ends_graph:
            return
        if self._holds:
            again = f"`mirrorwave node restart {name}` in another terminal plays it again"
            self._say("info", f"{name} has come to its end; the page keeps the last view until Ctrl-C; {again}")
        else:
            self._stop_in_order(f"{name} has come to its end")

    def _fail(self, name: str, node: _Watched, code: int) -> None:
        node.phase = Phase.FAILED
        self._exit_code = EXIT_BAD_INPUT if code == EXIT_BAD_INPUT else self._exit_code or EXIT_FAILED
        node.reason = node.why(code) or _how(code)
        self._say("error", f"{name} FAILED{_because(node.reason)}")
        if self._stopping is None and (not node.was_ready or node.entry.ends_graph):
            self._stop_in_order(f"{name} is needed")

    def _look_at_silent(self, now_s: float) -> None:
        for name, node in self._nodes.items() if self._stopping is None else ():
            reason = node.look(now_s)
            if reason:
                self._say("error", f"{name} hangs: {reason}")
                node.kill()
                # a process that waits for a disk takes long to end
                node.heard(now_s)
                node.killed_for = reason
            elif node.is_silent(now_s) and now_s - node.silence_said_s >= _SILENCE_INTERVAL_S:
                node.silence_said_s, node.is_said = now_s, True
                self._say("warning", _silence(name, node, now_s))

    # start and end of the graph

    def _start_or_stop(self, now_s: float) -> None:
        restart = self._restarts.current
        if self._stopping is not None:
            self._restarts.end("the graph is stopping")
            self._stop_next(now_s)
            return
        if restart is not None and not restart.has_ended:
            self._stop(self._nodes[self._homes[restart.node]], now_s, PATIENCE_S, by_hand=True)
        if self._server is not None and self._server.is_starting:
            return
        for name, node in self._nodes.items():
            if node.phase is Phase.WAITING and node.start_at_s <= now_s and self._may_start(node):
                self._start(name, node, now_s)
            if node.child is not None and self._may_begin(node):
                node.child.begin()

    def _start(self, name: str, node: _Watched, now_s: float) -> None:
        try:
            node.start(name, self._run_dir, now_s, self._server)
        except OSError as error:
            # no memory, no file descriptor or no process is left: that may be transient, as a crash may
            node.reason = f"cannot be started: {one_line(error)}"
            self._after_exit(name, node, EXIT_FAILED, now_s)
            return
        assert node.child is not None
        self._bus.watch(node.child.ended)

    def _may_start(self, node: _Watched) -> bool:
        """Return whether a node may get ready: a recorder records the others from their first word on."""
        return all(other.has_been_ready for other in self._before(node) if other.records)

    def _may_begin(self, node: _Watched) -> bool:
        return all(other.has_been_ready for other in self._before(node))

    def _before(self, node: _Watched) -> list[_Watched]:
        return [self._nodes[other] for other in node.entry.after]

    def _check_end(self, now_s: float) -> None:
        if self._stop_requests > 2:
            for node in self._nodes.values():
                node.kill()
        elif self._stop_requests > 1 and not self._asked_for_patience:
            self._asked_for_patience = True
            is_recording = any(node.records and node.child for node in self._nodes.values())
            what = "the recording" if is_recording else "the graph"
            self._say("warning", f"closing {what}; press Ctrl-C once more to end at once")
        if self._stopping is not None:
            return
        if self._stop_requests:
            self._say("info", "stopping: asked to")
            self._stopping = [list(self._nodes)]
        elif self._one_shots_ended():
            self._stop_in_order("all nodes that run once have ended")
        elif self._duration_over(now_s):
            self._stop_in_order(f"{self._duration_s:g} s are over")

    def _one_shots_ended(self) -> bool:
        once = [node for node in self._nodes.values() if node.entry.restart.policy is RestartPolicy.NEVER]
        return bool(once) and all(node.phase is Phase.ENDED for node in once)

    def _duration_over(self, now_s: float) -> bool:
        if self._duration_s is None:
            return False
        if self._stop_at_s is None and all(node.was_ready for node in self._nodes.values()):
            self._stop_at_s = now_s + self._duration_s
        return self._stop_at_s is not None and now_s >= self._stop_at_s

    def _stop_in_order(self, reason: str) -> None:
        """Stop one after the other, sources first, so that each can answer its waiting inputs."""
        self._say("info", f"stopping: {reason}")
        self._stopping = [[name] for name in stop_order(self._launch)]

    def _stop_next(self, now_s: float) -> None:
        assert self._stopping is not None
        while self._stopping and not any(self._nodes[name].child for name in self._stopping[0]):
            self._stopping.pop(0)
        if self._stop_requests and len(self._stopping) > 1:
            self._stopping = [[name for group in self._stopping for name in group]]
        patience_s = PATIENCE_S if self._stop_requests else DRAIN_S
        for node in (self._nodes[name] for name in (self._stopping[0] if self._stopping else ())):
            self._stop(node, now_s, patience_s, by_hand=self._stop_requests > 0)

    @staticmethod
    def _stop(node: _Watched, now_s: float, patience_s: float, by_hand: bool) -> None:
        if node.phase is Phase.READY:
            node.stop(now_s, patience_s, by_hand)
        else:
            # it has no data yet, and no handler for a gentler signal
            node.kill()

    def _all_gone(self) -> bool:
        waiting = self._stopping is None and any(node.phase is Phase.WAITING for node in self._nodes.values())
        return not waiting and not any(node.child for node in self._nodes.values())

    def _close_all(self) -> None:
        for name, node in self._nodes.items():
            self._let_go(name, node)

    # messages of the supervisor

    def _report(self) -> None:
        if self._heartbeat.remaining_s() <= 0.0:
            self._hold_again()
            now_s = time.monotonic()
            ended = [(name, node) for name, node in self._nodes.items() if node.phase is Phase.FAILED]
            failed = [f"{name} FAILED{_because(node.reason)}" for name, node in ended]
            failed += [_silence(name, node, now_s) for name, node in self._nodes.items() if node.is_silent(now_s)]
            if self._log.lost:
                failed.append(counted(self._log.lost, "line of the log is lost", "lines of the log are lost"))
            is_up = all(node.was_ready or node.phase in (Phase.ENDED, Phase.FAILED) for node in self._nodes.values())
            state = NodeState.READY if is_up else NodeState.STARTING
            self._heartbeat.beat(NodeState.DEGRADED if failed else state, "; ".join(failed))

    def _say(self, level: str, text: str) -> None:
        self._write({"time": utc_now(), "node": SUPERVISOR, "level": level, "text": text})
        record = LogRecord(stamp_ns=self._bus.now_ns(), node=SUPERVISOR, level=level, text=text[:BUS_TEXT_LIMIT])
        self._bus.publish("log", record)

    def _write(self, entry: dict[str, Any]) -> None:
        self._log.write(entry)
        if self._on_log is not None:
            try:
                self._on_log(entry)
            except OSError:
                # the terminal is closed; the graph continues, its log is in the file
                self._on_log = None

    # resources

    @contextlib.contextmanager
    def _locked(self) -> Iterator[Path]:
        """Hold the graph's directory; yields the run folder, whose name and the pid are in the lock."""
        self._lock = _locked_file(self._run_dir)
        try:
            run_folder = _new_run_folder(self._runs_dir, self._launch)
            pid = os.getpid()
            self._owner = {
                "pid": pid,
                "started": _started(pid),
                "run": str(run_folder.resolve()),
                "nodes": list(self._homes),
            }
            self._tell_owner()
            yield run_folder
            self._lock.truncate(0)
        finally:
            self._lock.close()

    def _tell_owner(self) -> None:
        self._lock.truncate(0)
        self._lock.write(json.dumps(self._owner))
        self._lock.flush()

    def _hold_again(self) -> None:
        """Lock the directory again if it was deleted: a second graph could enter, and clients would find no graph."""
        if (self._run_dir / LOCK_NAME).exists():
            return
        # if the directory is missing the bus will create it soon
        with contextlib.suppress(OSError):
            lock = _locked_file(self._run_dir)
            self._lock.close()
            self._lock = lock
            self._tell_owner()

    @contextlib.contextmanager
    def _signals(self) -> Iterator[None]:
        def request(number: int, frame: object) -> None:
            # shell and kernel both report that the terminal is closed: no user is there to request haste
            if number != signal.SIGHUP or not self._stop_requests:
                self.request_stop()

        numbers = stopping_signals(signal.SIGINT, signal.SIGTERM)
        previous = [signal.signal(number, request) for number in numbers]
        try:
            yield
        finally:
            for number, handler in zip(numbers, previous, strict=True):
                signal.signal(number, handler)


def _locked_file(run_dir: Path) -> TextIO:
    """Return the lock of a graph's directory, held while it is open.

    Raises `OSError` if another graph holds it, `ValueError` if it is a symbolic link.
    """
    file = open(run_dir / LOCK_NAME, "a+", opener=no_link)  # noqa: SIM115
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        file.close()
        pid = read_lock(run_dir).get("pid", "unknown")
        raise OSError(f"{run_dir}: a graph runs here already, pid {pid}") from None
    return file


def read_lock(run_dir: Path) -> dict[str, Any]:
    """Return pid, run folder and nodes of the graph that runs in `run_dir`; empty if none does."""
    try:
        with open(run_dir / LOCK_NAME, opener=no_link) as file:
            owner = json.loads(file.read(1 << 16) or "{}")
    except (FileNotFoundError, ValueError, RecursionError):
        return {}
    if not isinstance(owner, dict):
        return {}
    started = _started(owner.get("pid"))
    # the number of an ended process may have been reused
    return owner if started is not None and owner.get("started", started) == started else {}


def _started(pid: object) -> int | None:
    """Return the start of a process, in clock ticks since boot (proc_pid_stat(5), field 22); None if it has ended."""
    try:
        return int(Path(f"/proc/{int(str(pid))}/stat").read_text().rpartition(")")[2].split()[19])
    except (OSError, ValueError, IndexError):
        return None


def _new_run_folder(runs_dir: Path, launch: LaunchFile) -> Path:
    runs_dir.mkdir(parents=True, exist_ok=True)
    number = 1
    while True:
        folder = runs_dir / f"{launch.name}-{number}"
        try:
            # its log holds the viewer's token
            folder.mkdir(mode=0o700)
        except FileExistsError:
            number += 1
            continue
        (folder / "launch.yaml").write_text(dump_launch(launch), encoding="utf-8")
        return folder


def _silence(name: str, node: _Watched, now_s: float) -> str:
    doing = node.silence.doing if node.silence else None
    return f"{name} has not answered for {now_s - node.heard_s:.1f} s, it {doing or 'is silent'}"


def _how(code: int) -> str:
    return f"was ended by {signal.Signals(-code).name}" if code < 0 else f"exited with code {code}"


def _because(reason: str) -> str:
    return f": {' '.join(reason.split())}" if reason else ""
