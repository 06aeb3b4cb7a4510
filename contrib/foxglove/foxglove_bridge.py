"""Node for Foxglove: the scene, grids, map, peaks, transforms, log and numbers of the graph, live.

The server runs in a thread of its own; a step encodes what somebody subscribes to, and nothing else. It is reached from
this machine alone, with the token of the address that the node logs, by pages of `allowed_origins` and by programs.
"""

from __future__ import annotations

import logging
import re
from pathlib import Path
from typing import ClassVar

import msgspec

from contrib.foxglove.foxglove_messages import TOPICS, FoxgloveStream
from contrib.foxglove.foxglove_server import FoxgloveServer
from msgs.bus.interface import Outgoing, Received
from msgs.bus.topics import TOPICS as ALL_TOPICS
from msgs.values.diagnostics import NodeState
from nodes.node import Node
from nodes.viewer.page_token import TokenFile

_LOG = logging.getLogger(__name__)
#: No path, and neither "*" nor "null": the origin of any page, or of any page in a frame without one.
_ORIGIN = re.compile(r"[a-z][a-z0-9+.-]*://[^/\s*]*")


#: Name that the connection has in Foxglove.
TITLE = "mirrorwave"


class Params(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Address, and pages that may connect; the host is always 127.0.0.1 (elsewhere: `ssh -L 8766:127.0.0.1:8766`)."""

    formerly: ClassVar[dict[str, str]] = {"": __name__, "max_clients": "contrib.foxglove.foxglove_server"}

    #: 0, or a port in use: a free one. Not that of the viewer, 8765.
    port: int = 8766
    #: Pages that may connect, as `scheme://host:port`: Foxglove in the browser, and applications that load their page
    #: from a file, as desktop applications do. A program that names no page needs the token alone.
    allowed_origins: tuple[str, ...] = ("https://app.foxglove.dev", "file://")
    #: Keeps the token while the node is restarted, so that clients reconnect; a launch fills it in.
    token_file: str | None = None

    def __post_init__(self) -> None:
        if not 0 <= self.port <= 65535:
            raise ValueError(f"port must be 0..65535, got {self.port!r}")
        for origin in self.allowed_origins:
            if not _ORIGIN.fullmatch(origin):
                raise ValueError(f"allowed_origins must be scheme://host:port each, without a path, got {origin!r}")


class FoxgloveBridge(Node):
    """Sends `TOPICS`, and those of other people, to the clients that subscribe to what they become."""

    inputs: tuple[str, ...] = TOPICS
    #: On busy cores it gets a tenth of the time of another process.
    nice = 10

    def __init__(self, params: Params) -> None:
        super().__init__()
        self.inputs = (*TOPICS, *ALL_TOPICS.own())
        self._stream = FoxgloveStream()
        self.server = FoxgloveServer(
            title=TITLE,
            port=params.port,
            allowed_origins=params.allowed_origins,
            token_file=None if params.token_file is None else TokenFile(Path(params.token_file)),
        )
        # the address grants access: it is for this user's terminal and log file alone
        _LOG.info("open %s in Foxglove", self.server.url, extra={"in_public": f"Foxglove at port {self.server.port}"})

    def step(self, inputs: list[Received], now_ns: int) -> list[Outgoing]:
        """Send what the received messages become."""
        for received in inputs:
            for draft in self._stream.drafts_of(received.topic, received.message, now_ns):
                if draft.topic in self.server.wanted:
                    with self.stages("encode"):
                        payload = msgspec.json.encode(draft.build())
                    if not self.server.send(draft.topic, now_ns, payload):
                        self.shed.add("message", "server busy")
        return []

    def health(self) -> tuple[NodeState, str]:
        """Return DEGRADED once clients are no longer served."""
        return (NodeState.READY, "") if self.server.alive else (NodeState.DEGRADED, "Foxglove is no longer served")

    def close(self) -> None:
        """Stop the server."""
        self.server.close()


def create(params: Params) -> FoxgloveBridge:
    """Return the node with its server running; raises `OSError` if no port is available."""
    return FoxgloveBridge(params)
