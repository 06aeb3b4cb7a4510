"""Parameters of a running node: published when it starts, changed between two of its steps."""

from __future__ import annotations

import json
import logging
from typing import TYPE_CHECKING, Any

import msgspec

from msgs.bus.interface import Received, WaitingBus
from msgs.files.former_fields import without_former
from msgs.values.node_params import NodeParams, ParamRequest
from nodes.process.validation import convert_at, merged

if TYPE_CHECKING:
    from collections.abc import Callable

_LOG = logging.getLogger(__name__)

REQUESTS, VALUES = "param/request", "param/values"
_REASON_LIMIT = 2000


class ParamServer:
    """Answers requests for one node, in the loop that drives it.

    `params`: those it was made with. `change` takes over others, or raises `ValueError` or `OSError` and leaves all as
    it is.
    """

    def __init__(
        self, bus: WaitingBus, name: str, params: msgspec.Struct, change: Callable[[msgspec.Struct], None]
    ) -> None:
        self._bus, self._name, self._params, self._change = bus, name, params, change
        self._answer = self._values()
        bus.subscribe(REQUESTS)
        bus.publish(VALUES, self._answer)

    def receive(self, timeout_s: float) -> list[Received]:
        """Return the messages that are for the node itself, as the bus does; requests among them are answered."""
        received = self._bus.receive(timeout_s)
        requests = [item.message for item in received if isinstance(item.message, ParamRequest)]
        for request in requests:
            if request.node == self._name:
                self._serve(request)
        return [item for item in received if item.topic != REQUESTS] if requests else received

    def _serve(self, request: ParamRequest) -> None:
        if request.request != self._answer.request:
            error = self._changed(request)
            self._answer = self._values(request.request, error)
        self._bus.publish(VALUES, self._answer)

    def _changed(self, request: ParamRequest) -> str:
        """Change parameters; return why not, empty if they were."""
        try:
            changes = parse_mapping(request.changes)
            for field in without_former(changes, type(self._params))[1]:
                raise ValueError(str(field))
            wanted = convert_at(merged(_builtins(self._params), changes), type(self._params), self._name)
            if wanted == self._params:
                return ""
            self._change(wanted)
        except (ValueError, OSError, msgspec.MsgspecError) as error:
            reason = " ".join(str(error).split())[:_REASON_LIMIT]
            _LOG.warning("parameters stay as they are: %s", reason)
            return reason
        self._params = wanted
        _LOG.info("parameters changed: %s", request.changes[:_REASON_LIMIT])
        return ""

    def _values(self, request: str = "", error: str = "") -> NodeParams:
        text = params_text(self._params)
        return NodeParams(stamp_ns=self._bus.now_ns(), node=self._name, params=text, request=request, error=error)


def params_text(params: Any) -> str:
    """Return parameters as JSON; bytes of a path that are no UTF-8 stay what they are."""
    try:
        return msgspec.json.encode(params, enc_hook=str).decode()
    except UnicodeEncodeError:
        return json.dumps(msgspec.to_builtins(params, enc_hook=str))


def _builtins(params: msgspec.Struct) -> dict[str, Any]:
    values: dict[str, Any] = msgspec.to_builtins(params, enc_hook=str)
    return values


def parse_mapping(text: str) -> dict[str, Any]:
    """Return the changes of a request; raises `ValueError` if they are no JSON object."""
    try:
        changes = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise ValueError(f"changes must be a JSON object: {error}") from None
    if not isinstance(changes, dict):
        raise ValueError(f"changes must be a JSON object, got {type(changes).__name__}")
    return changes
