"""The contract of a node and the one loop that drives it: receive, step, publish, heartbeat, log, stop.

A node's module holds `Params` (its parameters, a frozen msgspec Struct that forbids unknown fields) and
`create(params) -> Node`. This file hosts one of them as a process (`python -m nodes.node MODULE ...`) or several of
them in one process on a virtual clock (`InProcessGraph`); the node sees no difference.
"""

from __future__ import annotations

import argparse
import contextlib
import ctypes
import gc
import json
import logging
import os
import re
import select
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any

if __name__ == "__main__":
    # asked to end while the rest is being loaded: no work has begun that would have to be ended
    for _number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        if signal.getsignal(_number) is not signal.SIG_IGN:
            signal.signal(_number, lambda _number, _frame: os._exit(0))

import msgspec
import psutil

from msgs.bus.interface import Bus, Forwarded, GraphBus, Outgoing, Received, WaitingBus
from msgs.bus.topics import TOPICS, plain_topic, sensor_topic, topic_facts
from msgs.files.open_files import open_files_line, require_open_files
from msgs.files.plugins import MODULE_NAME, NODES, import_named, plugins
from msgs.values.arrays import require_sensor_name
from msgs.values.diagnostics import SAMPLES_LIMIT, NodeState, NodeStatus, ShedCount, StageTime, TopicCount
from nodes.inputs.publishers import BoundInputs
from nodes.process.interpreter import start_again_if_compiled
from nodes.process.logs import BusLogHandler, SeparatedJsonFormatter, install_handlers
from nodes.process.memory import FreeHeap, release_unused
from nodes.process.param_server import ParamServer
from nodes.process.validation import convert_at

if TYPE_CHECKING:
    from msgs.bus.local import LocalNetwork
    from msgs.bus.zmq import ZmqBus

_LOG = logging.getLogger(__name__)

NODE_NAME = re.compile(r"[a-z0-9_]+")
HEARTBEAT_S = 1.0 / topic_facts("diagnostics/node").rate_hz
#: Longest sleep of the loop: a signal that arrives just before it is noticed this much later.
TURN_S = 0.1
#: A node that was asked to stop has drained its inputs when nothing came for this long.
DRAINED_S = 0.15
#: With a running foreign publisher the queue would never drain; this is enough for a queue of beams.
DRAIN_LIMIT_S = 2.0
#: Subscribers search for new publishers at least once in this; messages of an earlier source would be lost.
SETTLE_S = 0.15
#: A node that has run so long has made what it keeps, and loaded the kernels that it needs.
SETTLED_S = 5.0
#: The bus drops messages in transit when it is closed; the last answers of a node get this long.
FLUSH_S = 0.1
_REASON_LIMIT = 500
_PR_SET_PDEATHSIG = 1

EXIT_DONE, EXIT_FAILED, EXIT_BAD_INPUT = 0, 1, 2


class StageClock:
    """Durations of a node's named stages: `with node.stages("fold"): ...`."""

    def __init__(self) -> None:
        self._durations_ms: dict[str, list[float]] = {}

    @contextlib.contextmanager
    def __call__(self, name: str) -> Iterator[None]:
        """Measure the body, also if it raises."""
        start_ns = time.perf_counter_ns()
        try:
            yield
        finally:
            self.add(name, time.perf_counter_ns() - start_ns)

    def add(self, name: str, duration_ns: int) -> None:
        """Note a duration that was measured elsewhere."""
        self._durations_ms.setdefault(name, []).append(1e-6 * duration_ns)

    def drain(self) -> tuple[StageTime, ...]:
        """Return stages since the last call, in the order in which they first ran."""
        durations_ms, self._durations_ms = self._durations_ms, {}
        return tuple(_stage_time(name, ms) for name, ms in durations_ms.items())


def _stage_time(name: str, durations_ms: list[float]) -> StageTime:
    count = len(durations_ms)
    return StageTime(
        name=name,
        count=count,
        last_ms=durations_ms[-1],
        mean_ms=sum(durations_ms) / count,
        max_ms=max(durations_ms),
        samples_ms=tuple(durations_ms[:: -(-count // SAMPLES_LIMIT)]),
    )


class ShedTally:
    """Count of work that a node shed so as not to fall behind: `node.shed.add("scan", "behind")`."""

    def __init__(self) -> None:
        self._counts: dict[tuple[str, str], int] = {}
        #: Why input was refused last; empty once input was accepted again.
        self.refusal = ""

    def add(self, kind: str, reason: str, count: int = 1) -> None:
        """Count work that was shed."""
        self._counts[kind, reason] = self._counts.get((kind, reason), 0) + count

    def note(self, kind: str, reason: str, count: int) -> None:
        """Take over a count that is kept elsewhere, once there is one."""
        if count or (kind, reason) in self._counts:
            self._counts[kind, reason] = count

    def counts(self) -> tuple[ShedCount, ...]:
        """Return counts since the node started, in the order in which each first occurred."""
        return tuple(ShedCount(what=kind, reason=reason, count=count) for (kind, reason), count in self._counts.items())


class Node:
    """Base of all nodes: unpacks messages, makes one call into the algorithm, packs the answer.

    `inputs` are subscribed before the first step and `outputs` is all it may publish; an instance may set its own.
    """

    inputs: tuple[str, ...] = ()
    outputs: tuple[str, ...] = ()
    #: Its inputs arrive complete, also on topics whose receivers otherwise want the newest message only.
    wants_all: bool = False
    #: It takes the messages of all publishers of a topic, not those of one (`nodes.inputs.publishers`).
    takes_all_publishers: bool = False
    #: Number of publishers that it may send for on one topic.
    max_origins: int = 1
    #: Priority of the node's process on busy cores: Unix niceness, 0..19.
    nice: int = 0
    #: Name of the sensor that it works for where a graph has several: its topics are that sensor's on the bus.
    sensor: str = ""

    def __init__(self) -> None:
        self.stages = StageClock()
        self.shed = ShedTally()
        #: The bus's counts of each input so far; empty before the node is on a bus.
        self.counts: Callable[[], tuple[TopicCount, ...]] = tuple
        #: Since when subscribers can find its outputs, on `time.monotonic()`; None: since it is ready.
        self.open_since_s: float | None = None
        #: What `load_node` made it with; None of a node made by hand.
        self.made_with: msgspec.Struct | None = None

    @property
    def bus_inputs(self) -> tuple[str, ...]:
        """The topics that it takes, as they are called on the bus."""
        return tuple(sensor_topic(topic, self.sensor) for topic in self.inputs)

    @property
    def bus_outputs(self) -> tuple[str, ...]:
        """The topics that it publishes, as they are called on the bus."""
        return tuple(sensor_topic(topic, self.sensor) for topic in self.outputs)

    def step(self, inputs: list[Received], now_ns: int) -> Sequence[Outgoing | Forwarded]:
        """Answer the inputs, in order of arrival; empty when the node is called because it was due."""
        raise TypeError(f"{type(self).__name__} must define step(inputs, now_ns)")

    def due_ns(self, now_ns: int) -> int | None:
        """Return bus time at which `step` is to be called even without input; None: never."""
        return None

    def watched(self) -> tuple[Any, ...]:
        """Return own sockets and file descriptors that end a wait for input; `pending` says that they can be read."""
        return ()

    def pending(self) -> bool:
        """Return true while the last step left work undone that needs no further input: the next step comes at once."""
        return False

    def finished(self) -> bool:
        """Return true when the node will never publish again: its process then ends with exit code 0."""
        return False

    def health(self) -> tuple[NodeState, str]:
        """Return the state for the next heartbeat, and the reason if it is not READY."""
        return NodeState.READY, ""

    def change_params(self, params: Any) -> None:
        """Take over other parameters, called between two steps; all or nothing.

        Raises `ValueError` for what cannot be changed while the node runs, which is everything unless a node says
        otherwise, and what its module's `create` raises for parameters that do not fit.
        """
        raise ValueError(f"{type(self).__name__} takes other parameters only when it starts")

    def close(self) -> None:
        """Close files and devices; called once, also after a step that raised."""


class Stop:
    """A request to end, raised by signal handlers and read by the loop."""

    def __init__(self) -> None:
        #: End once all waiting input has been answered.
        self.requested = False
        #: End before the next step.
        self.at_once = False

    def request(self, at_once: bool = False) -> None:
        """Ask to end; a second request, or `at_once`, does not wait for what is queued."""
        self.at_once = self.at_once or at_once or self.requested
        self.requested = True


def load_node(module_name: str, params: Mapping[str, Any], name: str | None = None, sensor: str = "") -> Node:
    """Import a node's module and create the node with `params`, for the `sensor` of a name where there are several.

    Raises `ValueError` naming the node's field as `node_module` does, for wrong parameters and for a `create` that
    makes something else.
    """
    name = name or module_name.rpartition(".")[2]
    module = node_module(module_name, name)
    checked = convert_at(dict(params), module.Params, f"{name}.params")
    with _compile_notice():
        node = module.create(checked)
    if not isinstance(node, Node):
        raise ValueError(f"{name}.module: create(params) of {module.__name__} must return a Node, got {node!r}")
    _require_known(node, name)
    if sensor:
        require_sensor_name(sensor)
    node.made_with, node.sensor = checked, sensor
    return node


def _require_known(node: Node, name: str) -> None:
    """Raise `ValueError` naming the node for a topic that it reads or publishes and that nobody declares."""
    for side in ("inputs", "outputs"):
        for topic in getattr(node, side):
            try:
                topic_facts(topic)
            except ValueError as error:
                raise ValueError(f"{name}.{side}: {error}") from None


def node_module(module_name: str, name: str) -> ModuleType:
    """Import the module of the node `name`: a dotted name, or the name under which an installed package brings it.

    Raises `ValueError` naming the node's field for a module that cannot be imported or is no node.
    """
    if not MODULE_NAME.fullmatch(module_name):
        raise ValueError(f"{name}.module must be a dotted module name, got {module_name!r}")
    try:
        # every shipped module has a dot: only other people's are looked up
        plugin = None if "." in module_name else plugins(NODES).plugin(module_name)
        module = import_named(module_name) if plugin is None else plugin.load()
    except ValueError as error:
        raise ValueError(f"{name}.module: {error}") from None
    if not (hasattr(module, "Params") and hasattr(module, "create")):
        raise ValueError(f"{name}.module: {module.__name__} is no node, it must define Params and create(params)")
    if not (isinstance(module.Params, type) and issubclass(module.Params, msgspec.Struct)):
        raise ValueError(f"{name}.module: Params of {module.__name__} must be a msgspec Struct, got {module.Params!r}")
    return module


def _compile_notice() -> contextlib.AbstractContextManager[None]:
    """Log that kernels are compiled, in nodes that have any."""
    if "numba" not in sys.modules:
        return contextlib.nullcontext()
    from nodes.process.compiling import compile_notice

    return compile_notice(_LOG.info)


class Heartbeat:
    """Publishes on `diagnostics/node` that the loop runs, and passes log records on to the topic `log`.

    `cpu_s`: clock of the processor time that the node has taken, read where the loop runs.
    """

    def __init__(
        self, bus: Bus, name: str, log: BusLogHandler | None = None, cpu_s: Callable[[], float] = time.process_time
    ) -> None:
        self._bus, self._name, self._log, self._cpu_s = bus, name, log, cpu_s
        self._started_s = self._last_s = time.monotonic()
        self._process = psutil.Process()

    def beat(
        self, state: NodeState, reason: str = "", stages: tuple[StageTime, ...] = (), shed: tuple[ShedCount, ...] = ()
    ) -> None:
        """Publish a heartbeat and all waiting log records."""
        self._last_s = time.monotonic()
        received, published = self._bus.counts()
        status = NodeStatus(
            stamp_ns=self._bus.now_ns(),
            node=self._name,
            pid=self._process.pid,
            state=state,
            reason=reason[:_REASON_LIMIT],
            uptime_s=self._last_s - self._started_s,
            cpu_s=self._cpu_s(),
            resident_bytes=self._process.memory_info().rss,
            stages=stages,
            received=received,
            published=published,
            shed=shed,
        )
        self._bus.publish("diagnostics/node", status)
        self._publish_log()

    def beat_if_due(self, node: Node, inputs: BoundInputs) -> bool:
        """Publish the heartbeat of a running node, at most once per `HEARTBEAT_S`; return whether it did."""
        is_due = self.remaining_s() <= 0.0
        if is_due:
            health = inputs.health(*node.health(), self._bus.now_ns())
            self.beat(*health, stages=node.stages.drain(), shed=node.shed.counts())
        else:
            self._publish_log()
        return is_due

    def remaining_s(self) -> float:
        """Return time until the next heartbeat is due."""
        return self._last_s + HEARTBEAT_S - time.monotonic()

    def _publish_log(self) -> None:
        for record in self._log.drain() if self._log else ():
            self._bus.publish("log", record)


def run_loop(node: Node, bus: WaitingBus, stop: Stop, heartbeat: Heartbeat, params: ParamServer | None = None) -> None:
    """Drive one node until it is finished or `stop` asks for the end; exceptions of a step are passed on.

    Heartbeats are sent between the steps: a step that hangs stops them. `params` answers requests between them too.
    """
    receive = bus.receive if params is None else params.receive
    inputs = bound_inputs(node, bus)
    for topic in node.bus_inputs:
        bus.subscribe(topic)
    for source in node.watched():
        bus.watch(source)
    node.counts = lambda: bus.counts()[0]
    reason = ""
    try:
        # through the pipe, because the bus may need a moment to find the supervisor; the heartbeat prompts it
        _LOG.info("ready", extra={"state": NodeState.READY})
        heartbeat.beat(*node.health())
        if node.outputs and not node.inputs:
            open_s = 0.0 if node.open_since_s is None else time.monotonic() - node.open_since_s
            bus.receive(max(0.0, SETTLE_S - open_s))
        settled_s, heap = time.monotonic() + SETTLED_S, None
        while not (stop.requested or node.finished()):
            received = receive(min(_wait_s(node, bus), max(heartbeat.remaining_s(), 0.0)))
            _turn(node, bus, inputs.take(received, bus.now_ns()))
            if heartbeat.beat_if_due(node, inputs) and time.monotonic() > settled_s:
                heap = _keep_small(heap)
        _drain(node, bus, stop, heartbeat, inputs)
    except Exception as error:
        reason = one_line(error)
        raise
    finally:
        try:
            node.close()
        finally:
            heartbeat.beat(NodeState.STOPPING, reason, node.stages.drain(), node.shed.counts())


def _keep_small(heap: FreeHeap | None) -> FreeHeap:
    """Give back memory that is not used any more: what the start needed at first, then free heap that has grown."""
    if heap is None:
        release_unused()
        return FreeHeap()
    heap.give_back()
    return heap


def bound_inputs(node: Node, bus: GraphBus) -> BoundInputs:
    """Return the inputs of a node, bound to one publisher each unless it takes all."""
    topics = () if node.takes_all_publishers else node.bus_inputs
    return BoundInputs(bus, topics, lambda topic: node.shed.add(f"{topic} message", "of another publisher"))


def _drain(node: Node, bus: Bus, stop: Stop, heartbeat: Heartbeat, bound: BoundInputs) -> None:
    """Answer waiting inputs, until none come, the time is up or the node is to end at once."""
    end_s = time.monotonic() + DRAIN_LIMIT_S
    while not (stop.at_once or node.finished()) and time.monotonic() < end_s:
        inputs = bound.take(bus.receive(0.0 if node.pending() else DRAINED_S), bus.now_ns())
        if not (inputs or node.pending()):
            return
        _step(node, bus, inputs, bus.now_ns())
        heartbeat.beat_if_due(node, bound)


def one_line(error: BaseException) -> str:
    """Return an exception as `ValueError: rule`, on one line."""
    return open_files_line(error) or " ".join(f"{type(error).__name__}: {error}".split())


def _wait_s(node: Node, bus: Bus) -> float:
    if node.pending():
        return 0.0
    now_ns = bus.now_ns()
    due_ns = node.due_ns(now_ns)
    return TURN_S if due_ns is None else min(TURN_S, max(0.0, 1e-9 * (due_ns - now_ns)))


def _turn(node: Node, bus: Bus, inputs: list[Received]) -> bool:
    """Step if there is input or if the node is due; return true if it stepped."""
    now_ns = bus.now_ns()
    due_ns = node.due_ns(now_ns)
    if not (inputs or node.pending()) and (due_ns is None or due_ns > now_ns):
        return False
    _step(node, bus, inputs, now_ns)
    return True


def _step(node: Node, bus: Bus, inputs: list[Received], now_ns: int) -> None:
    if node.sensor:
        inputs = [item._replace(topic=plain_topic(item.topic)) for item in inputs]
    for outgoing in node.step(inputs, now_ns):
        if outgoing[0] not in node.outputs:
            raise ValueError(
                f"{type(node).__name__} published {outgoing[0]!r}; its outputs are {', '.join(node.outputs)}"
            )
        if isinstance(outgoing, Forwarded):
            bus.forward(outgoing)
        else:
            topic, message = outgoing
            bus.publish(sensor_topic(topic, node.sensor), message)


class InProcessGraph:
    """Several nodes on one in-process network: same nodes, same bytes, no processes, a virtual clock.

    Nodes are stepped in the order of `nodes`, each answering all its waiting inputs, until no node has any
    work; then the clock jumps to the next time at which a node is due. `network` and nodes belong to the graph.
    """

    def __init__(self, network: LocalNetwork, nodes: Mapping[str, Node]) -> None:
        self._network = network
        self._nodes = dict(nodes)
        self._buses: dict[str, GraphBus] = {name: network.bus(name) for name in self._nodes}
        for name, node in self._nodes.items():
            for topic in node.bus_inputs:
                self._buses[name].subscribe(topic)
        self._inputs = {name: bound_inputs(node, self._buses[name]) for name, node in self._nodes.items()}

    def run(self, until_ns: int | None = None) -> None:
        """Step until no node is due any more, or up to the virtual time `until_ns`."""
        while True:
            while self._round():
                pass
            due_ns = self._next_due_ns()
            if due_ns is None or (until_ns is not None and due_ns > until_ns):
                return
            self._network.advance(due_ns - self._network.now_ns)

    def health(self, name: str) -> tuple[NodeState, str]:
        """Return the health that a node's next heartbeat would tell."""
        return self._inputs[name].health(*self._nodes[name].health(), self._network.now_ns)

    def close(self) -> None:
        """Close all nodes and their buses."""
        for name, node in self._nodes.items():
            node.close()
            self._buses[name].close()

    def _round(self) -> bool:
        stepped = [self._step(name, node) for name, node in self._live()]
        return any(stepped)

    def _step(self, name: str, node: Node) -> bool:
        bus = self._buses[name]
        return _turn(node, bus, self._inputs[name].take(bus.receive(0.0), bus.now_ns()))

    def _live(self) -> list[tuple[str, Node]]:
        return [(name, node) for name, node in self._nodes.items() if not node.finished()]

    def _next_due_ns(self) -> int | None:
        due_ns = [node.due_ns(self._buses[name].now_ns()) for name, node in self._live()]
        return min((at_ns for at_ns in due_ns if at_ns is not None), default=None)


def die_with_parent(parent_pid: int) -> None:
    """Have the kernel kill this process when its parent ends, for any reason; Linux only.

    Raises `ProcessLookupError` if the parent ended before the kernel could be asked.
    """
    libc = ctypes.CDLL(None, use_errno=True)
    if libc.prctl(_PR_SET_PDEATHSIG, signal.SIGKILL, 0, 0, 0) != 0:
        raise OSError(ctypes.get_errno(), "the kernel refused PR_SET_PDEATHSIG")
    if os.getppid() != parent_pid:
        raise ProcessLookupError(f"parent process {parent_pid} has gone")


def stopping_signals(*numbers: signal.Signals) -> tuple[signal.Signals, ...]:
    """Return `numbers`, and SIGHUP, the end of the terminal, unless the process is to outlive it, as under `nohup`."""
    is_ignored = signal.getsignal(signal.SIGHUP) is signal.SIG_IGN
    return numbers if is_ignored else (*numbers, signal.SIGHUP)


def stop_by_signal() -> Stop:
    """Return what SIGINT, SIGTERM and the end of the terminal ask to end from now on."""
    stop = Stop()
    for number in stopping_signals(signal.SIGINT):
        signal.signal(number, lambda number, frame: stop.request())
    signal.signal(signal.SIGTERM, lambda number, frame: stop.request(at_once=True))
    return stop


def main(argv: list[str] | None = None) -> int:
    """Host one node as a process; return the exit code: 0 ended, 1 failed, 2 wrong module or parameters."""
    arguments = _arguments(argv)
    if arguments.die_with is not None:
        die_with_parent(arguments.die_with)
    stop = stop_by_signal()
    stream = logging.StreamHandler(sys.stderr)
    if arguments.json_log:
        stream.setFormatter(SeparatedJsonFormatter(arguments.name))
    log = BusLogHandler(arguments.name)
    install_handlers([stream, log])
    words = ["nodes.node", *(sys.argv[1:] if argv is None else argv)]
    return run_process(lambda: _host(arguments, stop, log, words))


def run_process(host: Callable[[], int]) -> int:
    """Run the work of a node's process: its files are its user's alone, and each failure is one line and a code."""
    os.umask(0o077)
    threading.excepthook = lambda failed: _LOG.critical("%s", one_line(failed.exc_value or failed.exc_type()))
    try:
        require_open_files()
        return host()
    except Exception as error:  # noqa: BLE001 - the border of the process
        # where the machine is at a limit the line says all
        _LOG.critical("%s", one_line(error), exc_info=None if open_files_line(error) else error)
        return EXIT_FAILED


def _host(arguments: argparse.Namespace, stop: Stop, log: BusLogHandler, words: Sequence[str]) -> int:
    from msgs.bus.zmq import ZmqBus

    bus = ZmqBus(arguments.name, arguments.run_dir)
    try:
        heartbeat = Heartbeat(bus, arguments.name, log)
        params = json.loads(arguments.params)
        node = open_node(arguments.module, params, arguments.name, bus, heartbeat, arguments.sensor)
        if isinstance(node, int):
            return node
        if not stop.requested:
            start_again_if_compiled(words, bus.close)
        if arguments.wait:
            wait_to_begin([heartbeat], stop)
        _lower_priority(node.nice)
        run_loop(node, bus, stop, heartbeat, param_server(node, bus, arguments.name))
        if not stop.at_once:
            time.sleep(FLUSH_S)
    finally:
        bus.close()
    return EXIT_DONE


def open_node(
    module: str, params: Mapping[str, Any], name: str, bus: ZmqBus, heartbeat: Heartbeat, sensor: str = ""
) -> Node | int:
    """Make a node and open the topics that it publishes; return the exit code of its process where it cannot be."""
    if not _has_its_name(heartbeat):
        return EXIT_FAILED
    start_ns = time.perf_counter_ns()
    # now, so that subscribers find them while the node is made
    early = tuple(sensor_topic(topic, sensor) for topic in _outputs_of(module) if topic in TOPICS)
    for topic in early:
        bus.advertise(topic)
    open_since_s = time.monotonic()
    node = _load_or_say_why(module, params, name, heartbeat, sensor)
    if node is None:
        return EXIT_BAD_INPUT
    node.stages.add("make", time.perf_counter_ns() - start_ns)
    node.open_since_s = open_since_s if set(node.bus_outputs) <= set(early) else time.monotonic()
    for topic in node.bus_outputs:
        bus.advertise(topic, node.max_origins)
    if node.wants_all:
        bus.want_all()
    return node


def _outputs_of(module_name: str) -> tuple[str, ...]:
    """Return what the only source of a module publishes, whatever its parameters; nothing where that is not known."""
    if "." not in module_name:
        # other people's, found by the name of a plugin
        return ()
    try:
        module = import_named(module_name)
    except ValueError:
        # loading the node says why
        return ()
    nodes = [item for item in vars(module).values() if isinstance(item, type) and issubclass(item, Node)]
    own = [node for node in nodes if node.__module__ == module_name]
    return own[0].outputs if len(own) == 1 and not own[0].inputs else ()


def wait_to_begin(heartbeats: Sequence[Heartbeat], stop: Stop) -> None:
    """Return once the standard input ends, or `stop` asks for the end; say meanwhile that this process lives."""
    while not stop.requested:
        ready, _, _ = select.select([0], [], [], max(0.0, min(item.remaining_s() for item in heartbeats)))
        if ready and not os.read(0, 1 << 12):
            return
        for heartbeat in heartbeats:
            heartbeat.beat(NodeState.STARTING)


def param_server(node: Node, bus: WaitingBus, name: str) -> ParamServer | None:
    """Return what answers requests to change the parameters of a node that `load_node` made."""
    return None if node.made_with is None else ParamServer(bus, name, node.made_with, node.change_params)


def _has_its_name(heartbeat: Heartbeat) -> bool:
    """Return whether no other process has the node's name, as the first heartbeat shows; logs the one that does."""
    try:
        heartbeat.beat(NodeState.STARTING)
    except ValueError as error:
        _LOG.critical("%s", error)
        return False
    return True


def _lower_priority(nice: int) -> None:
    """Lower the priority of this process: of each thread, as Linux keeps it, and of later ones."""
    for thread in psutil.Process().threads() if nice else ():
        os.setpriority(os.PRIO_PROCESS, thread.id, min(19, os.getpriority(os.PRIO_PROCESS, thread.id) + nice))


def _load_or_say_why(
    module: str, params: Mapping[str, Any], name: str, heartbeat: Heartbeat, sensor: str
) -> Node | None:
    try:
        return load_node(module, params, name, sensor)
    except (ValueError, FileNotFoundError, msgspec.MsgspecError) as error:
        reason = " ".join(str(error).split())
        _LOG.critical("%s", reason)
        heartbeat.beat(NodeState.STOPPING, reason)
        return None
    finally:
        # imported modules stay: nothing of them is collected
        gc.freeze()


def _arguments(argv: list[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="python -m nodes.node", description="Host one node as a process.")
    parser.add_argument("module", help="module that defines Params and create(params)")
    parser.add_argument("--name", required=True, help="the node's name in the graph")
    parser.add_argument("--run-dir", required=True, type=Path, help="directory of the graph's sockets")
    parser.add_argument("--params", default="{}", help="parameters as JSON")
    parser.add_argument("--sensor", default="", help="name of its sensor, where there are several")
    parser.add_argument("--json-log", action="store_true", help="log JSON records, for the supervisor")
    parser.add_argument("--die-with", type=int, metavar="PID", help="end with this parent process")
    parser.add_argument("--wait", action="store_true", help="get ready, and begin when the standard input ends")
    return parser.parse_args(argv)


if __name__ == "__main__":
    # nodes import `nodes.node`: host them with that module, or isinstance would see two classes of the same name
    from nodes import node as hosted

    sys.exit(hosted.main())
