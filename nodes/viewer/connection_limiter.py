"""Limit on connections of the viewer: they are few and short-lived until one becomes a page.

A web server that waits for ever for the end of a request can be blocked by a hundred connections that never finish
theirs, and one that accepts them all takes the file descriptors that the graph's own sockets need.
"""

from __future__ import annotations

import asyncio
import logging
import time
from typing import NamedTuple

from uvicorn._types import ASGISendEvent
from uvicorn.protocols.http.h11_impl import H11Protocol
from uvicorn.protocols.websockets.websockets_sansio_impl import WebSocketsSansIOProtocol

#: Maximum connections that are no page yet; with one more, the oldest is closed.
MAX_PENDING = 256
#: The kernel delivers them in no larger groups, so that the newest is read before it would be closed.
BACKLOG = 128
#: Time to request a file and to receive it, or to become a page.
PENDING_S = 20.0
#: Time for a page that was closed to receive the reason.
LINGER_S = 2.0
#: Limit far above any message of a page, pings and beginnings of messages included.
MAX_CLIENT_BYTES_PER_S = 1 << 16
#: Maximum fragments of a message of a page.
MAX_FRAGMENTS = 1024

#: Invalid data from strangers is not logged: a flood of it would flood the log.
_STRANGERS_LOG = logging.getLogger(f"{__name__}.strangers")
_STRANGERS_LOG.setLevel(logging.ERROR)


class ConnectionLimiter:
    """Connections that are no page yet, in order of arrival; belongs to the server's loop."""

    def __init__(self) -> None:
        self._pending: dict[asyncio.Transport, asyncio.TimerHandle] = {}

    @property
    def pending(self) -> int:
        """Number of connections that are no page."""
        return len(self._pending)

    @property
    def http(self) -> type[asyncio.Protocol]:
        """Protocol class that uvicorn makes of each connection."""
        return type("TrackedConnection", (_TrackedConnection,), {"limiter": self})

    def add(self, transport: asyncio.Transport, timeout_s: float) -> None:
        """Admit a connection for a limited time; if there are too many, the oldest is closed."""
        self.discard(transport)
        self._pending[transport] = asyncio.get_running_loop().call_later(timeout_s, self._abort, transport)
        if len(self._pending) > MAX_PENDING:
            self._abort(next(iter(self._pending)))

    def discard(self, transport: asyncio.Transport) -> None:
        """Forget a connection that has closed or became a page."""
        timer = self._pending.pop(transport, None)
        if timer is not None:
            timer.cancel()

    def _abort(self, transport: asyncio.Transport) -> None:
        self.discard(transport)
        transport.abort()


class PendingConnection(NamedTuple):
    """One connection of a limiter; an ASGI scope has it as `state["pending"]`."""

    limiter: ConnectionLimiter
    transport: asyncio.Transport

    def admit(self) -> None:
        """Keep the connection: it became a page."""
        self.limiter.discard(self.transport)

    def linger(self) -> None:
        """Close the connection after a time to receive the last message, even if the page does not read it."""
        if self.transport.get_write_buffer_size() or not self.transport.is_closing():
            self.limiter.add(self.transport, LINGER_S)


class _TrackedConnection(H11Protocol):
    """A connection that its limiter tracks until it has closed, or is a websocket."""

    limiter: ConnectionLimiter

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        self.logger = _STRANGERS_LOG
        self.app_state = {**self.app_state, "pending": PendingConnection(self.limiter, transport)}
        super().connection_made(transport)
        self.limiter.add(transport, PENDING_S)

    def connection_lost(self, exc: Exception | None) -> None:
        self.limiter.discard(self.transport)
        super().connection_lost(exc)


class PageSocket(WebSocketsSansIOProtocol):
    """A websocket that closes when its client sends more than any page would."""

    _second, _bytes = 0, 0

    def data_received(self, data: bytes) -> None:
        """Process the received data, or close the connection."""
        second = int(time.monotonic())
        self._second, self._bytes = second, len(data) + (self._bytes if second == self._second else 0)
        if self._bytes > MAX_CLIENT_BYTES_PER_S or len(self.frames) > MAX_FRAGMENTS:
            self.transport.abort()
        else:
            super().data_received(data)

    async def send(self, message: ASGISendEvent) -> None:
        """Send an event of the application; a refusal with a reason ends the handshake too, which uvicorn misses."""
        await super().send(message)
        if message["type"] == "websocket.http.response.body":
            self.handshake_complete = True

    def connection_lost(self, exc: Exception | None) -> None:
        """Remove the connection from the limiter."""
        self.app_state["pending"].limiter.discard(self.transport)
        super().connection_lost(exc)
