"""Parameters of running nodes, and wishes to change them."""

from __future__ import annotations

import msgspec

from msgs.values.arrays import require_stamps

#: Longest text of parameters or changes, in characters.
MAX_PARAMS_CHARACTERS = 60_000


class ParamRequest(msgspec.Struct, frozen=True, kw_only=True):
    """Request to change parameters of a node while it runs (topic `param/request`)."""

    stamp_ns: int
    #: Names the request in its answer; one that is repeated is answered again and changes nothing.
    request: str
    node: str
    #: JSON object of parameters, merged over those in use, mapping by mapping.
    changes: str

    def __post_init__(self) -> None:
        require_stamps("param_request.stamp_ns", self.stamp_ns)
        _require_text("param_request.changes", self.changes)


class NodeParams(msgspec.Struct, frozen=True, kw_only=True):
    """Parameters of a node (topic `param/values`): when it starts, and in answer to each request."""

    stamp_ns: int
    node: str
    #: All parameters in use, as a JSON object.
    params: str
    #: The request that this answers; empty when the node starts.
    request: str = ""
    #: Reason for which it was refused; nothing has changed then.
    error: str = ""

    def __post_init__(self) -> None:
        require_stamps("node_params.stamp_ns", self.stamp_ns)
        _require_text("node_params.params", self.params)


def _require_text(name: str, text: str) -> None:
    if len(text) > MAX_PARAMS_CHARACTERS:
        raise ValueError(f"{name} must have at most {MAX_PARAMS_CHARACTERS} characters, got {len(text)}")
