"""Host several nodes in one process, a thread each: one set of libraries, messages handed over as they are.

The group falls and ends as one: a node that fails takes the others down, and the supervisor starts all of them again.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import logging
import os
import sys
import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import msgspec

from msgs.bus.exchange import Exchange
from msgs.bus.zmq import ZmqBus
from nodes.node import (
    DRAIN_LIMIT_S,
    EXIT_DONE,
    EXIT_FAILED,
    FLUSH_S,
    Heartbeat,
    Node,
    Stop,
    die_with_parent,
    one_line,
    open_node,
    param_server,
    run_loop,
    run_process,
    stop_by_signal,
    wait_to_begin,
)
from nodes.process.interpreter import start_again_if_compiled
from nodes.process.logs import BusLogHandler, SeparatedJsonFormatter, install_handlers, of_thread

_LOG = logging.getLogger(__name__)

#: Maximum time that the other nodes get once one has failed or ended: to answer their inputs and close their files.
_LAST_S = DRAIN_LIMIT_S + 1.0
_LOOK_S = 0.1


class Member(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A node of a group, as its launch file has it."""

    module: str
    params: dict[str, Any] = {}
    sensor: str = ""


class _Hosted(NamedTuple):
    name: str
    node: Node
    bus: ZmqBus
    heartbeat: Heartbeat


class Group:
    """Nodes that are driven by a thread each until one of them ends or `stop` asks for it.

    `waits`: they begin when the standard input ends; `words`: the module that hosts them, and its arguments.
    """

    def __init__(
        self, members: Mapping[str, Member], run_dir: Path, stop: Stop, words: Sequence[str], waits: bool = False
    ) -> None:
        self._members, self._run_dir, self._stop, self._words, self._waits = members, run_dir, stop, words, waits
        self._exchange = Exchange(members)
        self._failed = threading.Event()

    def run(self) -> int:
        """Host all; return the exit code of the process: that of the first node that cannot be made or fails."""
        hosted: list[_Hosted] = []
        with contextlib.ExitStack() as stack:
            for name, member in self._members.items():
                opened = self._open(name, member, stack)
                if isinstance(opened, int):
                    return opened
                hosted.append(opened)
            if not self._stop.requested:
                start_again_if_compiled(self._words, stack.close)
            if self._waits:
                wait_to_begin([item.heartbeat for item in hosted], self._stop)
            # daemons: one that hangs must not keep a process that has failed
            threads = [
                threading.Thread(target=self._drive, args=(node,), name=node.name, daemon=True) for node in hosted
            ]
            for thread in threads:
                thread.start()
            while all(thread.is_alive() for thread in threads):
                # not longer, since only between the waits of this thread signals are handled
                threads[0].join(_LOOK_S)
            if not self._stop.requested or self._failed.is_set():
                self._stop.request(at_once=self._failed.is_set())
            self._leave_hanging(threads)
            if not self._stop.at_once:
                time.sleep(FLUSH_S)
        return EXIT_FAILED if self._failed.is_set() else EXIT_DONE

    @staticmethod
    def _leave_hanging(threads: list[threading.Thread]) -> None:
        """Wait for all threads; end the process where some have not ended in time."""
        end_s = time.monotonic() + _LAST_S
        while any(thread.is_alive() for thread in threads) and time.monotonic() < end_s:
            time.sleep(_LOOK_S)
        hanging = [thread.name for thread in threads if thread.is_alive()]
        if hanging:
            _LOG.critical("%s did not end with the others", ", ".join(hanging))
            os._exit(EXIT_FAILED)

    def _open(self, name: str, member: Member, stack: contextlib.ExitStack) -> _Hosted | int:
        log = BusLogHandler(name)
        log.addFilter(of_thread(name))
        logging.getLogger().addHandler(log)
        with _named(name):
            bus = ZmqBus(name, self._run_dir, exchange=self._exchange)
            stack.callback(bus.close)
            heartbeat = Heartbeat(bus, name, log, time.thread_time)
            node = open_node(member.module, member.params, name, bus, heartbeat, member.sensor)
        return node if isinstance(node, int) else _Hosted(name, node, bus, heartbeat)

    def _drive(self, hosted: _Hosted) -> None:
        name, node, bus, heartbeat = hosted
        try:
            if node.nice:
                os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), node.nice)
            run_loop(node, bus, self._stop, heartbeat, param_server(node, bus, name))
        except Exception as error:  # noqa: BLE001 - the border of the thread: each failure leaves as a line and a code
            _LOG.critical("%s", one_line(error), exc_info=error)
            self._failed.set()


@contextlib.contextmanager
def _named(name: str) -> Iterator[None]:
    """Log in the name of a node while it is made."""
    thread = threading.current_thread()
    thread.name, before = name, thread.name
    try:
        yield
    finally:
        thread.name = before


class _ThreadFormatter(SeparatedJsonFormatter):
    """Records in the name of the node whose thread wrote them."""

    def format(self, record: logging.LogRecord) -> str:
        self._node = record.threadName or self._node
        return super().format(record)


def main(argv: list[str] | None = None) -> int:
    """Host a group as a process; return the exit code: 0 ended, 1 failed, 2 wrong module or parameters."""
    parser = argparse.ArgumentParser(prog="python -m nodes.process.group", description="Host nodes as one process.")
    parser.add_argument("nodes", help="modules and parameters of the nodes by name, as JSON")
    parser.add_argument("--run-dir", required=True, type=Path, help="directory of the graph's sockets")
    parser.add_argument("--die-with", required=True, type=int, metavar="PID", help="end with this parent process")
    parser.add_argument("--wait", action="store_true", help="get ready, and begin when the standard input ends")
    arguments = parser.parse_args(argv)
    die_with_parent(arguments.die_with)
    stop = stop_by_signal()
    stream = logging.StreamHandler(sys.stderr)
    stream.setFormatter(_ThreadFormatter("group"))
    install_handlers([stream])
    members = msgspec.convert(json.loads(arguments.nodes), dict[str, Member])
    words = ["nodes.process.group", *(sys.argv[1:] if argv is None else argv)]
    return run_process(Group(members, arguments.run_dir, stop, words, arguments.wait).run)


if __name__ == "__main__":
    sys.exit(main())
