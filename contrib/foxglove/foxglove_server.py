"""Foxglove's WebSocket protocol, served to who knows the token and comes from an allowed page.

Of the protocol it speaks what a viewer needs: server information, channels, subscriptions, messages and status lines
(subprotocols `foxglove.sdk.v1` and `foxglove.websocket.v1`, which are alike in these). It takes no data, parameters or
calls: a client can change nothing. A client that reads slowly loses its oldest messages and is told how many; one that
reads nothing is let go. The graph never waits.
"""

from __future__ import annotations

import asyncio
import logging
import secrets
import struct
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import msgspec
from starlette.requests import HTTPConnection
from starlette.routing import BaseRoute, Route, WebSocketRoute
from starlette.websockets import WebSocket

from contrib.foxglove.foxglove_schemas import channels
from msgs.values.wording import counted
from nodes.viewer.loopback_server import HOST, LoopbackServer, ProtocolError, converse, refuse, upgrade_required
from nodes.viewer.page_token import TokenFile

_LOG = logging.getLogger(__name__)

SUBPROTOCOLS = ("foxglove.sdk.v1", "foxglove.websocket.v1")
#: Messages that wait for one client; the oldest are dropped.
MAX_QUEUE_BYTES = 32 << 20
#: Messages on their way to the server's thread; more are not taken.
MAX_HANDED = 1024
MAX_CLIENT_MESSAGE_BYTES = 8192
MAX_CLIENT_MESSAGES_PER_S = 200
#: A client that takes nothing for so long counts as gone.
SEND_S = 20.0
#: Origins named in the log, so that a user finds the one to allow; a page with the token could otherwise fill it.
_MAX_LOGGED_ORIGINS = 8
#: Opcode, subscription, time of arrival [ns].
_MESSAGE_DATA = struct.Struct("<BIQ")
_MESSAGE_OPCODE = 1
_WARNING = 1


class _Head(msgspec.Struct, frozen=True):
    op: str


class _Subscription(msgspec.Struct, frozen=True):
    id: int
    channelId: int  # noqa: N815


class _Subscribe(msgspec.Struct, frozen=True):
    subscriptions: list[_Subscription]


class _Unsubscribe(msgspec.Struct, frozen=True):
    subscriptionIds: list[int]  # noqa: N815


class FoxgloveServer(LoopbackServer):
    """Serves messages of `foxglove_schemas.channels`.

    Clients without an `Origin` are programs, which the token alone lets in.
    """

    name = "bridge"
    max_message_bytes = MAX_CLIENT_MESSAGE_BYTES

    def __init__(
        self,
        *,
        title: str,
        port: int = 0,
        max_clients: int = 4,
        allowed_origins: Sequence[str] = (),
        token_file: TokenFile | None = None,
    ) -> None:
        self._allowed_origins = frozenset(allowed_origins)
        self._logged_origins: set[str] = set()
        offered = channels()
        self._numbers = {topic: number for number, topic in enumerate(offered, 1)}
        self._greetings = _server_info(title), _advertisement(offered, self._numbers)
        self._handed: deque[tuple[int, int, bytes]] = deque()
        #: Topics that a client subscribes to at the moment.
        self.wanted: frozenset[str] = frozenset()
        super().__init__(port=port, max_clients=max_clients, token_file=token_file)
        self.start()

    @property
    def url(self) -> str:
        """Address to connect to, token included."""
        return f"ws://{HOST}:{self.port}/{self._token}"

    def send(self, topic: str, at_ns: int, payload: bytes) -> bool:
        """Send a message to all who subscribe to its topic; returns at once, False if it was not taken."""
        if len(self._handed) >= MAX_HANDED:
            return False
        self._handed.append((self._numbers[topic], at_ns, payload))
        self.call_soon(self._distribute)
        return True

    def routes(self) -> list[BaseRoute]:
        """Return the websocket, with and without a slash at its end."""
        paths = ("/{token}", "/{token}/")
        plain = [Route("/{token}", upgrade_required), Route("/{token}/{rest:path}", upgrade_required)]
        return [*plain, *(WebSocketRoute(path, self._serve) for path in paths)]

    def refuse_origin(self, connection: HTTPConnection) -> str:
        """Refuse pages that are not allowed; a browser names the page with every websocket."""
        foreign = set(connection.headers.getlist("origin")) - self._allowed_origins
        if not foreign:
            return ""
        if self.knows_token(connection):
            self._log_origin(min(foreign))
        return "this page is not among the bridge's allowed_origins"

    async def _serve(self, websocket: WebSocket) -> None:
        offered = websocket.scope["subprotocols"]
        subprotocol = next((each for each in offered if each in SUBPROTOCOLS), None)
        if subprotocol is None:
            await refuse(websocket, f"a client must offer the subprotocol {' or '.join(SUBPROTOCOLS)}")
            return
        await self.serve(
            websocket, _Client(websocket, self._greetings, len(self._numbers), self._note_wanted), subprotocol
        )

    def _note_wanted(self) -> None:
        numbers = {number for client in self._clients for number in client.subscriptions}
        self.wanted = frozenset(topic for topic, number in self._numbers.items() if number in numbers)

    def _distribute(self) -> None:
        while self._handed:
            message = self._handed.popleft()
            for client in self._clients:
                client.offer(*message)

    def _log_origin(self, origin: str) -> None:
        if origin not in self._logged_origins and len(self._logged_origins) < _MAX_LOGGED_ORIGINS:
            self._logged_origins.add(origin)
            _LOG.warning("refused a page of origin %r; allowed_origins names %s", origin[:200], self._allowed())

    def _allowed(self) -> str:
        return ", ".join(sorted(self._allowed_origins)) or "none"


class _Client:
    """One websocket: what it subscribes to, and what waits for it."""

    def __init__(
        self, websocket: WebSocket, greetings: Sequence[str], last_channel: int, on_change: Callable[[], None]
    ) -> None:
        self._websocket, self._greetings, self._on_change = websocket, greetings, on_change
        self._last_channel = last_channel
        self.news = asyncio.Event()
        #: Its number of each channel that it subscribes to.
        self.subscriptions: dict[int, int] = {}
        self._queue: deque[str | bytes] = deque()
        self._queued_bytes = self._dropped = 0
        self._second, self._heard = 0, 0

    async def run(self) -> list[Exception]:
        """Serve until either side ends it; return the reasons, unless the client left."""
        try:
            return await converse(self._send(), self._listen())
        finally:
            self.subscriptions.clear()
            self._on_change()

    def offer(self, channel: int, at_ns: int, payload: bytes) -> None:
        """Queue a message if the client subscribes to its channel."""
        subscription = self.subscriptions.get(channel)
        if subscription is not None:
            self._put(_MESSAGE_DATA.pack(_MESSAGE_OPCODE, subscription, max(at_ns, 0)) + payload)

    def _put(self, message: str | bytes) -> None:
        self._queue.append(message)
        self._queued_bytes += len(message)
        while self._queued_bytes > MAX_QUEUE_BYTES:
            self._queued_bytes -= len(self._queue.popleft())
            self._dropped += 1
        self.news.set()

    async def _send(self) -> None:
        for greeting in self._greetings:
            await self._websocket.send_text(greeting)
        while True:
            self.news.clear()
            while self._queue:
                await self._send_next()
            await self.news.wait()

    async def _send_next(self) -> None:
        message = self._queue.popleft()
        self._queued_bytes -= len(message)
        is_text = isinstance(message, str)
        try:
            async with asyncio.timeout(SEND_S):
                await self._websocket.send({"type": "websocket.send", "text" if is_text else "bytes": message})
        except TimeoutError:
            raise ProtocolError(f"took nothing for {SEND_S:g} s") from None
        if self._dropped:
            dropped, self._dropped = self._dropped, 0
            self._put(_status(f"{counted(dropped, 'message')} dropped: this client reads too slowly"))

    async def _listen(self) -> None:
        while True:
            message = await self._websocket.receive()
            if message["type"] == "websocket.disconnect":
                return
            self.take(message.get("text"))

    def take(self, text: str | None) -> None:
        """Process a message; raises `ProtocolError` if it is none of the protocol, or one too many."""
        second = int(time.monotonic())
        self._second, self._heard = second, (self._heard + 1 if second == self._second else 1)
        if self._heard > MAX_CLIENT_MESSAGES_PER_S:
            raise ProtocolError(f"more than {MAX_CLIENT_MESSAGES_PER_S} messages a second")
        if text is None:
            raise ProtocolError("takes no data from its clients")
        try:
            self._obey(msgspec.json.decode(text, type=_Head).op, text)
        except (msgspec.MsgspecError, UnicodeError, RecursionError):
            raise ProtocolError("not a message of this protocol") from None

    def _obey(self, op: str, text: str) -> None:
        if op == "subscribe":
            for wanted in msgspec.json.decode(text, type=_Subscribe).subscriptions:
                if not 0 <= wanted.id < 1 << 32:
                    raise ProtocolError("the number of a subscription must be 0..4294967295")
                if not 1 <= wanted.channelId <= self._last_channel:
                    self._put(_status(f"no channel {wanted.channelId}"))
                elif wanted.id in self.subscriptions.values() or wanted.channelId in self.subscriptions:
                    self._put(_status(f"subscription {wanted.id} to channel {wanted.channelId}: already subscribed"))
                else:
                    self.subscriptions[wanted.channelId] = wanted.id
        elif op == "unsubscribe":
            ended = set(msgspec.json.decode(text, type=_Unsubscribe).subscriptionIds)
            self.subscriptions = {channel: own for channel, own in self.subscriptions.items() if own not in ended}
        else:
            self._put(_status(f"{op[:40]!r} is not served here"))
        self._on_change()


def _server_info(title: str) -> str:
    info = {
        "op": "serverInfo",
        "name": title,
        "capabilities": [],
        "supportedEncodings": [],
        "metadata": {},
        "sessionId": secrets.token_hex(8),
    }
    return msgspec.json.encode(info).decode()


def _advertisement(offered: Mapping[str, Mapping[str, Any]], numbers: Mapping[str, int]) -> str:
    channels = [
        {
            "id": numbers[topic],
            "topic": topic,
            "encoding": "json",
            "schemaName": schema["title"],
            "schemaEncoding": "jsonschema",
            "schema": msgspec.json.encode(schema).decode(),
        }
        for topic, schema in offered.items()
    ]
    return msgspec.json.encode({"op": "advertise", "channels": channels}).decode()


def _status(message: str) -> str:
    return msgspec.json.encode({"op": "status", "level": _WARNING, "message": message}).decode()
