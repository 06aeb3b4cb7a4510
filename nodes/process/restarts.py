"""Restarts of single nodes on request; a node that does not start with its new parameters gets its old ones back."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

import msgspec

from msgs.bus.zmq import ZmqBus
from msgs.values.node_params import NodeParams, ParamRequest
from msgs.values.wording import did_you_mean
from nodes.process.launch_file import SUPERVISOR, NodeEntry
from nodes.process.param_server import REQUESTS, VALUES, params_text, parse_mapping
from nodes.process.validation import merged


class Restart(msgspec.Struct, kw_only=True):
    """The restart of a node that is under way: what it ran with, what it is to run with."""

    request: str
    node: str
    before: NodeEntry
    entry: NodeEntry
    #: Whether the process of before has ended.
    has_ended: bool = False
    #: Why it could not be started with `entry`, which is that of before then.
    error: str = ""


class RestartServer:
    """Takes requests to the supervisor, `{node: parameters to merge over its own}`, one at a time, and answers them."""

    def __init__(self, bus: ZmqBus) -> None:
        self._bus = bus
        self._answer: NodeParams | None = None
        self.current: Restart | None = None
        bus.subscribe(REQUESTS)
        bus.advertise(VALUES)

    def begin(self, request: ParamRequest, entries: Mapping[str, NodeEntry]) -> Restart | None:
        """Return the restart that a request begins; None if it is not for the supervisor, repeated or refused."""
        if request.node != SUPERVISOR or (self.current is not None and self.current.request == request.request):
            return None
        if self._answer is not None and self._answer.request == request.request:
            self._bus.publish(VALUES, self._answer)
            return None
        try:
            if self.current is not None:
                raise ValueError(f"{self.current.node} is being restarted; ask again when it is ready")
            self.current = _restart(request, entries)
        except ValueError as error:
            self._say(request.request, {}, str(error))
            return None
        return self.current

    def end(self, error: str = "") -> None:
        """Answer the restart that is under way, if one is."""
        if self.current is not None:
            self._say(self.current.request, {self.current.node: self.current.entry.params}, self.current.error or error)
            self.current = None

    def _say(self, request: str, params: Mapping[str, Any], error: str) -> None:
        text = params_text(params)
        self._answer = NodeParams(
            stamp_ns=self._bus.now_ns(), node=SUPERVISOR, params=text, request=request, error=error
        )
        self._bus.publish(VALUES, self._answer)


def _restart(request: ParamRequest, entries: Mapping[str, NodeEntry]) -> Restart:
    changes = parse_mapping(request.changes)
    if len(changes) != 1:
        raise ValueError(f"changes must name one node to restart, got {', '.join(changes) or 'none'}")
    ((node, params),) = changes.items()
    if node not in entries:
        raise ValueError(f"unknown node {node!r}; known are {', '.join(entries)}{did_you_mean(node, entries)}")
    if not isinstance(params, dict):
        raise ValueError(f"{node}: expected a mapping of parameters, got {json.dumps(params)[:50]}")
    before = entries[node]
    entry = msgspec.structs.replace(before, params=merged(before.params, params))
    return Restart(request=request.request, node=node, before=before, entry=entry)
