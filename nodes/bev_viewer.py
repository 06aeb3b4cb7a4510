"""Node `bev_viewer`: shows the newest view of the graph in a browser on this machine.

The server runs in a thread of its own; a step only passes the newest messages on, and nothing is rendered without a
reader. A slow page misses scans; the graph never waits for it. Pictures are the first work to be shed: the process has
a lower priority than the others, and while views are late most pictures of maps are left out.
"""

from __future__ import annotations

import logging
from pathlib import Path
from typing import ClassVar

import msgspec

from msgs.bus.interface import Outgoing, Received
from msgs.values.diagnostics import NodeState
from nodes.node import Node
from nodes.viewer.assembly import TOPICS_SHOWN, Assembly
from nodes.viewer.newest import Board
from nodes.viewer.page_token import TokenFile
from nodes.viewer.server import ViewerServer

_LOG = logging.getLogger(__name__)


class Params(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Address of the page; the host is always 127.0.0.1 (from elsewhere: `ssh -L 8765:127.0.0.1:8765`)."""

    formerly: ClassVar[dict[str, str]] = {"open_browser": "nodes.bev_viewer", "max_clients": "nodes.viewer.server"}

    #: 0, or a port in use: a free one.
    port: int = 8765
    title: str = "graph"
    #: Keeps the page's token while the node is restarted, so that open pages reconnect; a launch fills it in.
    token_file: str | None = None

    def __post_init__(self) -> None:
        if not 0 <= self.port <= 65535:
            raise ValueError(f"port must be 0..65535, got {self.port!r}")


class BevViewer(Node):
    """Passes the newest of `TOPICS_SHOWN` to the open pages."""

    inputs = TOPICS_SHOWN
    #: On busy cores it gets a tenth of the time of another process; on idle ones all it asks for.
    nice = 10

    def __init__(self, params: Params) -> None:
        super().__init__()
        board = Board()
        self._assembly = Assembly(board, sheds_maps=True)
        self.server = ViewerServer(
            board,
            title=params.title,
            port=params.port,
            token_file=None if params.token_file is None else TokenFile(Path(params.token_file)),
        )
        # the address grants access: it is for this user's terminal and log file alone
        _LOG.info("open %s", self.server.url, extra={"in_public": f"page at port {self.server.port}"})

    def due_ns(self, now_ns: int) -> int | None:
        """Return the time of the next node table: twice a second even without messages, so that silence shows."""
        return self._assembly.table_due_ns(now_ns)

    def step(self, inputs: list[Received], now_ns: int) -> list[Outgoing]:
        """Pass the received messages on."""
        maps_shed = self._assembly.maps_shed
        for received in inputs:
            self._assembly.take(received.message, now_ns)
        if self._assembly.maps_shed > maps_shed:
            self.shed.add("picture", "views late", self._assembly.maps_shed - maps_shed)
        if now_ns >= self._assembly.table_due_ns(now_ns):
            self._assembly.post_table(now_ns)
        return []

    def health(self) -> tuple[NodeState, str]:
        """Return DEGRADED once pages are no longer served."""
        return (NodeState.READY, "") if self.server.alive else (NodeState.DEGRADED, "the page is no longer served")

    def close(self) -> None:
        """Stop the server."""
        self.server.close()


def create(params: Params) -> BevViewer:
    """Return the node with its page being served; raises `OSError` if no port is available."""
    return BevViewer(params)
