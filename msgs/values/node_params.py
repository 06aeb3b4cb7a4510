"""Parameters of running nodes, and wishes to change them."""

from __future__ import annotations

from typing import ClassVar

from msgs.values.arrays import Checked, StampNs

#: Longest text of parameters or changes, in characters.
MAX_PARAMS_CHARACTERS = 60_000


class ParamRequest(Checked, frozen=True, kw_only=True):
    """Request to change parameters of a node while it runs (topic `param/request`)."""

    label: ClassVar[str] = "param_request"

    stamp_ns: StampNs
    #: Names the request in its answer; one that is repeated is answered again and changes nothing.
    request: str
    node: str
    #: JSON object of parameters, merged over those in use, mapping by mapping.
    changes: str

    def __post_init__(self) -> None:
        super().__post_init__()
        _require_text("param_request.changes", self.changes)


class NodeParams(Checked, frozen=True, kw_only=True):
    """Parameters of a node (topic `param/values`): when it starts, and in answer to each request."""

    label: ClassVar[str] = "node_params"

    stamp_ns: StampNs
    node: str
    #: All parameters in use, as a JSON object.
    params: str
    #: The request that this answers; empty when the node starts.
    request: str = ""
    #: Reason for which it was refused; nothing has changed then.
    error: str = ""

    def __post_init__(self) -> None:
        super().__post_init__()
        _require_text("node_params.params", self.params)


def _require_text(name: str, text: str) -> None:
    if len(text) > MAX_PARAMS_CHARACTERS:
        raise ValueError(f"{name} must have at most {MAX_PARAMS_CHARACTERS} characters, got {len(text)}")
