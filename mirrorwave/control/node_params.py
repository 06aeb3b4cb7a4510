"""Parameters of the nodes of a running graph, read and changed over its bus."""

from __future__ import annotations

import json
import os
import threading
import time
from collections.abc import Iterable, Mapping
from typing import Any

from mirrorwave.diagnose.running_graph import launch_of_graph, require_graph
from msgs.bus.zmq import ZmqBus, list_publishers, run_dir
from msgs.values.node_params import NodeParams, ParamRequest
from msgs.values.wording import did_you_mean
from nodes.node import node_module
from nodes.process.launch_file import SUPERVISOR, parse_yaml
from nodes.process.param_server import REQUESTS, VALUES
from nodes.process.validation import convert_at, merged

#: A node answers within a step; one that loads a network for it takes half a second.
ANSWER_S = 10.0
#: The supervisor answers when a node that it restarts is ready: a stop of some seconds, a start, and again if it fails.
RESTART_S = 90.0
#: A request is repeated until it is answered: the node may not have met its sender yet.
_REPEAT_S = 0.5
#: Nodes are found within this; each says its parameters at once.
_FIND_S = 1.0


def current_params(domain: str, wanted: str | None = None) -> dict[str, NodeParams]:
    """Return what each node of a graph last said of its parameters, by name; with `wanted` as soon as that one has.

    Raises `ConnectionError` where no graph runs, `ValueError` naming the known nodes where `wanted` is none of them,
    `TimeoutError` where it is silent.
    """
    require_graph(domain)
    if wanted is not None:
        _require_known(domain, wanted)
    bus = ZmqBus(_own_name(), run_dir(domain))
    values: dict[str, NodeParams] = {}
    try:
        bus.subscribe(VALUES)
        end_s = time.monotonic() + _FIND_S
        while time.monotonic() < end_s and wanted not in values:
            for received in bus.receive(0.05):
                if isinstance(received.message, NodeParams):
                    values[received.message.node] = received.message
    finally:
        bus.close()
    if wanted is not None and wanted not in values:
        raise TimeoutError(f"{wanted} does not say its parameters in {_FIND_S:g} s")
    return dict(sorted(values.items()))


def _own_name() -> str:
    """Return a name on the bus that no other thread or process has."""
    return f"param-{os.getpid()}-{threading.get_native_id()}"


def _require_known(domain: str, node: str) -> None:
    known = [name for topic, name in list_publishers(run_dir(domain)) if topic == VALUES]
    if node not in known:
        near = did_you_mean(node, known)
        raise ValueError(f"no node {node!r} has parameters here; known are {', '.join(known) or 'none'}{near}")


def parse_changes(node: str, assignments: Iterable[str]) -> dict[str, Any]:
    """Return `key=value` texts (dotted keys, YAML values) as one mapping; `ValueError` names the text that is none."""
    changes: dict[str, Any] = {}
    for assignment in assignments:
        path, equals, text = assignment.partition("=")
        keys = path.strip().split(".")
        if not (equals and all(keys)):
            raise ValueError(f"{node}: {assignment!r} must be KEY=VALUE")
        value = parse_yaml(text, f"{node}: {assignment}")
        for key in reversed(keys):
            value = {key: value}
        changes = merged(changes, value)
    return changes


def change_params(domain: str, node: str, changes: Mapping[str, Any], answer_s: float = ANSWER_S) -> NodeParams:
    """Ask a node to change parameters; return its answer, which says why if it refused.

    Raises `ConnectionError` where no graph runs, `ValueError` naming the known nodes for one that is none of them,
    `TimeoutError` where the node does not answer.
    """
    require_graph(domain)
    _require_known(domain, node)
    bus = ZmqBus(_own_name(), run_dir(domain))
    request = f"{os.getpid()}-{time.monotonic_ns()}"
    try:
        bus.subscribe(VALUES)
        bus.advertise(REQUESTS)
        end_s = time.monotonic() + answer_s
        while time.monotonic() < end_s:
            wish = ParamRequest(stamp_ns=bus.now_ns(), request=request, node=node, changes=json.dumps(dict(changes)))
            bus.publish(REQUESTS, wish)
            answer = _answer(bus, node, request, min(time.monotonic() + _REPEAT_S, end_s))
            if answer is not None:
                return answer
    finally:
        bus.close()
    raise TimeoutError(f"{node} does not answer in {answer_s:g} s: `mirrorwave doctor` says what it does")


def restart_node(domain: str, node: str, changes: Mapping[str, Any]) -> NodeParams:
    """Have the supervisor restart a node with `changes` merged over the parameters it was started with.

    Changes that the node's type of parameters refuses are refused before anything is stopped; the answer says why where
    the node could not start with them and was started as it was. Raises as `change_params` does, `ValueError` naming
    the field for changes refused.
    """
    launch = launch_of_graph(run_dir(domain))
    entry = launch.nodes.get(node) if launch is not None else None
    if entry is not None and changes:
        convert_at(merged(entry.params, changes), node_module(entry.module, node).Params, f"{node}.params")
    return change_params(domain, SUPERVISOR, {node: changes}, RESTART_S)


def _answer(bus: ZmqBus, node: str, request: str, until_s: float) -> NodeParams | None:
    while (remaining_s := until_s - time.monotonic()) > 0.0:
        for received in bus.receive(remaining_s):
            message = received.message
            if isinstance(message, NodeParams) and (message.node, message.request) == (node, request):
                return message
    return None
