"""Who stands at the viewer's door, and for how long: connections are few and short until a page is let in.

A web server that waits for ever for the end of a request can be shut by a hundred connections that never end theirs,
and one that accepts them all takes the file descriptors that the graph's own sockets need.
"""

from __future__ import annotations

import asyncio
import logging
import time
from typing import NamedTuple

from uvicorn.protocols.http.h11_impl import H11Protocol
from uvicorn.protocols.websockets.websockets_sansio_impl import WebSocketsSansIOProtocol

#: Connections that are no page yet; one more, and the one that has stood there longest has to go.
MAX_VISITORS = 256
#: They come from the kernel in no larger groups, so that the newest is heard before its turn to go has come.
BACKLOG = 128
#: To ask for a file and to take it, or to become a page.
VISIT_S = 20.0
#: A page that was let go has this long to take in why.
LEAVE_S = 2.0
#: Nothing a page has to say comes near this, pings and beginnings of messages included.
MAX_CLIENT_BYTES_PER_S = 1 << 16
#: Nor has any message of a page more than one.
MAX_FRAGMENTS = 1024

#: What strangers send is no news: a flood of it would be a flood of the log.
_STRANGERS_LOG = logging.getLogger(f"{__name__}.strangers")
_STRANGERS_LOG.setLevel(logging.ERROR)


class Door:
    """Connections that are no page yet, in order of arrival; belongs to the server's loop."""

    def __init__(self) -> None:
        self._visitors: dict[asyncio.Transport, asyncio.TimerHandle] = {}

    @property
    def visitors(self) -> int:
        """Connections that are no page."""
        return len(self._visitors)

    @property
    def http(self) -> type[asyncio.Protocol]:
        """What uvicorn is to make of each connection."""
        return type("Visitor", (_Visitor,), {"door": self})

    def enter(self, transport: asyncio.Transport, stay_s: float) -> None:
        """Let a connection be for so long; where there are too many, the oldest has to go."""
        self.leave(transport)
        self._visitors[transport] = asyncio.get_running_loop().call_later(stay_s, self._turn_out, transport)
        if len(self._visitors) > MAX_VISITORS:
            self._turn_out(next(iter(self._visitors)))

    def leave(self, transport: asyncio.Transport) -> None:
        """A connection has gone, or is a page now."""
        timer = self._visitors.pop(transport, None)
        if timer is not None:
            timer.cancel()

    def _turn_out(self, transport: asyncio.Transport) -> None:
        self.leave(transport)
        transport.abort()


class Visit(NamedTuple):
    """One connection at a door; an ASGI scope has it as `state["visit"]`."""

    door: Door
    transport: asyncio.Transport

    def welcome(self) -> None:
        """It is a page: it may stay."""
        self.door.leave(self.transport)

    def see_out(self) -> None:
        """The page has ended: it may take in the last word, and does not keep its socket by not reading it."""
        if self.transport.get_write_buffer_size() or not self.transport.is_closing():
            self.door.enter(self.transport, LEAVE_S)


class _Visitor(H11Protocol):
    """A connection that its door knows of until it has gone, or is a websocket."""

    door: Door

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        self.logger = _STRANGERS_LOG
        self.app_state = {**self.app_state, "visit": Visit(self.door, transport)}
        super().connection_made(transport)
        self.door.enter(transport, VISIT_S)

    def connection_lost(self, exc: Exception | None) -> None:
        self.door.leave(self.transport)
        super().connection_lost(exc)


class PageSocket(WebSocketsSansIOProtocol):
    """A websocket that ends where its client sends more than a page ever would, whatever it is."""

    _second, _bytes = 0, 0

    def data_received(self, data: bytes) -> None:
        """Take in what came, or end it."""
        second = int(time.monotonic())
        self._second, self._bytes = second, len(data) + (self._bytes if second == self._second else 0)
        if self._bytes > MAX_CLIENT_BYTES_PER_S or len(self.frames) > MAX_FRAGMENTS:
            self.transport.abort()
        else:
            super().data_received(data)

    def connection_lost(self, exc: Exception | None) -> None:
        """The door need not look after it any more."""
        self.app_state["visit"].door.leave(self.transport)
        super().connection_lost(exc)
