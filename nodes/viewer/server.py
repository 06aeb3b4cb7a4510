"""The viewer's server: one page and one websocket on 127.0.0.1, in a thread of its own.

A client must know the token (it is part of the address), name this host in `Host`, and, for the websocket, come from
this very page (`Origin`). A page that lost its server makes the answering one first prove that it knows the token too
(`/proof/<nonce>`): in the meantime another program may have taken the port. A client gets an update, acknowledges
it, and only then gets the next, made of whatever is newest then: between server and client there is never more than
one update, and a slow client misses some. Nothing a client does reaches the thread that posts. The number and
duration of pending connections are limited in `connection_limiter.py`.
"""

from __future__ import annotations

import asyncio
import hashlib
import hmac
import re
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Annotated

import msgspec
from starlette.requests import HTTPConnection
from starlette.responses import FileResponse, PlainTextResponse, Response
from starlette.routing import BaseRoute, Route, WebSocketRoute
from starlette.websockets import WebSocket

from nodes.viewer.loopback_server import HOST, LoopbackServer, ProtocolError, converse, upgrade_required
from nodes.viewer.newest import SERIES, Board, Posted, WireMessage, json_text
from nodes.viewer.page_token import TokenFile
from nodes.viewer.view_model import COLOURS

_STATIC = Path(__file__).parent / "static"
_PAGE_FILES = {
    "": "index.html",
    "viewer.js": "viewer.js",
    "plots.js": "plots.js",
    "viewer.css": "viewer.css",
    "uplot.js": "uplot/uPlot.iife.min.js",
    "uplot.css": "uplot/uPlot.min.css",
}
_PROOF_PATH = re.compile(r"/proof/[0-9a-f]{32}")
_HEADERS = [
    (
        "Content-Security-Policy",
        "default-src 'none'; script-src 'self'; style-src 'self'; connect-src 'self'; img-src 'self' data:; "
        "base-uri 'none'; form-action 'none'; frame-ancestors 'none'; "
        "require-trusted-types-for 'script'; trusted-types 'none'",
    ),
    ("X-Content-Type-Options", "nosniff"),
    ("Referrer-Policy", "no-referrer"),
    ("X-Frame-Options", "DENY"),
    ("Cross-Origin-Opener-Policy", "same-origin"),
    ("Cross-Origin-Resource-Policy", "same-origin"),
    ("Cache-Control", "no-store"),
]
#: No message of a page is longer.
MAX_CLIENT_MESSAGE_BYTES = 1024
MAX_CLIENT_MESSAGES_PER_S = 200
#: Series that a page plots at most.
MAX_PLOTS = 6
#: A client that has not acknowledged an update by then counts as gone.
ACKNOWLEDGE_S = 20.0


class Acknowledge(msgspec.Struct, frozen=True, tag="ack", tag_field="type", forbid_unknown_fields=True):
    """A client has shown update `number`."""

    number: int


class Play(msgspec.Struct, frozen=True, tag="play", tag_field="type", forbid_unknown_fields=True):
    """Play a recording from its position; speed 1 is real time, 0 pauses it. `loop`: at its end, from the start."""

    speed: float
    loop: bool = False


class Seek(msgspec.Struct, frozen=True, tag="seek", tag_field="type", forbid_unknown_fields=True):
    """Show scan `index` of a recording, counted from 0."""

    index: int


class Step(msgspec.Struct, frozen=True, tag="step", tag_field="type", forbid_unknown_fields=True):
    """Show the scan `by` further on in a recording, back if negative."""

    by: int


class Plot(msgspec.Struct, frozen=True, tag="plot", tag_field="type", forbid_unknown_fields=True):
    """Send the samples of these series from now on, live or of a recording; of none where empty."""

    ids: Annotated[tuple[int, ...], msgspec.Meta(max_length=MAX_PLOTS)]


Command = Play | Seek | Step
_FROM_CLIENT = msgspec.json.Decoder(Acknowledge | Plot | Play | Seek | Step)

#: Pages that may look at once.
MAX_CLIENTS = 16


class ViewerServer(LoopbackServer):
    """Serves a board to browsers. `commands` receives a page's commands for a recording."""

    name = "viewer"
    max_message_bytes = MAX_CLIENT_MESSAGE_BYTES
    headers = _HEADERS

    def __init__(
        self,
        board: Board,
        *,
        title: str,
        port: int = 0,
        max_clients: int = MAX_CLIENTS,
        commands: Callable[[Command], None] | None = None,
        token_file: TokenFile | None = None,
    ) -> None:
        self._board, self._commands = board, commands
        self._hello = {"protocol": 1, "title": title, "recording": commands is not None, "colours": COLOURS}
        super().__init__(port=port, max_clients=max_clients, token_file=token_file)
        self.start()
        board.on_post = self._wake

    @property
    def url(self) -> str:
        """Address of the page, token included."""
        return f"http://{HOST}:{self.port}/{self._token}/"

    def routes(self) -> list[BaseRoute]:
        """Return the page's files, its websocket and the proof of the token."""
        return [
            Route("/proof/{nonce}", self._prove),
            Route("/{token}/ws", upgrade_required),
            WebSocketRoute("/{token}/ws", self._serve),
            Route("/{token}/{file:path}", _page),
        ]

    def refuse_origin(self, connection: HTTPConnection) -> str:
        """Refuse what another page asks for: the page's own websocket and files are for itself alone."""
        host, origins = connection.headers.get("host", ""), connection.headers.getlist("origin")
        # a browser sends it with every websocket
        claimed_origins = origins or [""] * (connection.scope["type"] == "websocket")
        if any(origin != f"http://{host}" for origin in claimed_origins):
            return "this comes from another page"
        return "" if _is_of_this_page(connection.headers) else "this was asked for by another page"

    def is_public(self, connection: HTTPConnection) -> bool:
        """Return whether the proof of the token is asked for."""
        return connection.scope["type"] == "http" and bool(_PROOF_PATH.fullmatch(connection.scope["path"]))

    def _wake(self) -> None:
        """Notify the clients of a post; called from the posting thread, never waits."""
        if self._clients:
            self.call_soon(self._wake_clients)

    def _wake_clients(self) -> None:
        for client in self._clients:
            client.news.set()

    async def _prove(self, request: HTTPConnection) -> Response:
        """Prove that this server knows the token, without revealing it."""
        nonce: str = request.path_params["nonce"]
        return PlainTextResponse(hmac.new(self._token.encode(), nonce.encode(), hashlib.sha256).hexdigest())

    async def _serve(self, websocket: WebSocket) -> None:
        """Serve one page, from its connection to its end."""
        await self.serve(websocket, _Client(websocket, self._board, self._commands, self._hello))


class _Client:
    """One websocket: sends an update, waits until it is acknowledged, sends the newest."""

    def __init__(
        self,
        websocket: WebSocket,
        board: Board,
        commands: Callable[[Command], None] | None,
        hello: Mapping[str, object] = MappingProxyType({}),
    ) -> None:
        self._websocket, self._board, self._commands, self._hello = websocket, board, commands, hello
        self.news = asyncio.Event()
        self._acknowledged = asyncio.Event()
        self._acknowledged.set()
        self._number = 0
        self._seen: dict[str, int] = {}
        self._plotted: tuple[int, ...] = ()
        self._second, self._heard = 0, 0

    async def run(self) -> list[Exception]:
        """Serve until either side ends it; return the reasons, unless the client left."""
        return await converse(self._send(), self._listen())

    async def _send(self) -> None:
        await self._websocket.send_text(json_text({"type": "hello", "now_ms": _ms(time.monotonic_ns()), **self._hello}))
        while True:
            self.news.clear()
            newer = self._board.newer(self._seen)
            if not self._plotted:
                newer.pop(SERIES, None)
            if newer:
                async with asyncio.timeout(ACKNOWLEDGE_S):
                    await self._send_update(newer)
                    await self._acknowledged.wait()
            else:
                await self.news.wait()

    async def _send_update(self, newer: dict[str, Posted]) -> None:
        self._number += 1
        self._acknowledged.clear()
        messages = [message for kind, posted in newer.items() for message in self._messages(kind, posted)]
        await self._websocket.send_text(json_text(self._announcement(newer, len(messages))))
        for message in messages:
            if isinstance(message, str):
                await self._websocket.send_text(message)
            else:
                await self._websocket.send_bytes(message)
        self._seen.update({kind: posted.version for kind, posted in newer.items()})

    def _messages(self, kind: str, posted: Posted) -> tuple[WireMessage, ...]:
        if kind == SERIES:
            return (json_text(self._board.series.series_json(self._plotted)),)
        return self._board.messages(kind, posted)

    def _announcement(self, newer: dict[str, Posted], messages: int) -> dict[str, object]:
        """Return the head of an update: its number of messages, this clock, each kind's version, skipped posts, age."""
        now_ns = time.monotonic_ns()
        kinds = {
            kind: {
                "version": posted.version,
                "skipped": posted.version - self._seen[kind] - 1 if kind in self._seen else 0,
                "held_ms": _ms(now_ns - posted.at_ns),
            }
            for kind, posted in newer.items()
        }
        head = {"type": "update", "number": self._number, "messages": messages}
        return {**head, "now_ms": _ms(now_ns), "kinds": kinds}

    async def _listen(self) -> None:
        while True:
            message = await self._websocket.receive()
            if message["type"] == "websocket.disconnect":
                return
            self._take(self._understood(message.get("text")))

    def _understood(self, text: str | None) -> Acknowledge | Plot | Command:
        second = int(time.monotonic())
        self._second, self._heard = second, (self._heard + 1 if second == self._second else 1)
        if self._heard > MAX_CLIENT_MESSAGES_PER_S:
            raise ProtocolError(f"more than {MAX_CLIENT_MESSAGES_PER_S} messages a second")
        try:
            return _FROM_CLIENT.decode(text or "")
        except (msgspec.MsgspecError, UnicodeError, RecursionError):
            raise ProtocolError("not a message of this protocol") from None

    def _take(self, message: Acknowledge | Plot | Command) -> None:
        if isinstance(message, Plot):
            self._plotted = message.ids
            # what was sent before is sent anew, with the series of now
            self._seen.pop(SERIES, None)
            self.news.set()
        elif not isinstance(message, Acknowledge):
            if self._commands is None:
                raise ProtocolError("a live graph takes no commands")
            self._commands(message)
        elif message.number != self._number or self._acknowledged.is_set():
            raise ProtocolError("acknowledges what was not sent")
        else:
            self._acknowledged.set()


def _ms(time_ns: int) -> float:
    return round(1e-6 * time_ns, 1)


def _is_of_this_page(headers: Mapping[str, str]) -> bool:
    """Return whether a browser's request, if it says so, is by this page, or by a person who opens it."""
    is_opened = headers.get("sec-fetch-mode") == "navigate" and headers.get("sec-fetch-dest") == "document"
    return is_opened or headers.get("sec-fetch-site", "none") in ("none", "same-origin")


async def _page(request: HTTPConnection) -> Response:
    name = _PAGE_FILES.get(request.path_params["file"])
    return PlainTextResponse("no such page\n", status_code=404) if name is None else FileResponse(_STATIC / name)
