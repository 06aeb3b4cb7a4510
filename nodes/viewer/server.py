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
import contextlib
import errno
import hashlib
import hmac
import logging
import re
import secrets
import socket
import threading
import time
from collections.abc import Callable, Mapping, MutableMapping
from pathlib import Path
from typing import Annotated, Any

import msgspec
import uvicorn
from starlette.applications import Starlette
from starlette.requests import HTTPConnection
from starlette.responses import FileResponse, PlainTextResponse, Response
from starlette.routing import Route, WebSocketRoute
from starlette.types import ASGIApp, Receive, Scope, Send
from starlette.websockets import WebSocket, WebSocketDisconnect

from nodes.viewer.connection_limiter import BACKLOG, ConnectionLimiter, PageSocket, PendingConnection
from nodes.viewer.newest import SERIES, Board, Posted, WireMessage, json_text
from nodes.viewer.page_token import TokenFile
from nodes.viewer.view_model import COLOURS

_LOG = logging.getLogger(__name__)

HOST = "127.0.0.1"
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
#: Names under which a browser on this machine, or at the end of an SSH tunnel, may reach a loopback address.
_LOOPBACK_NAMES = ("127.0.0.1", "localhost")
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
STOP_S = 5.0
_GONE, _POLICY_VIOLATION, _INTERNAL_ERROR, _TRY_AGAIN_LATER = 1001, 1008, 1011, 1013


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


class ViewerServer:
    """Serves a board to browsers; a context manager. `commands` receives a page's commands for a recording.

    `port` 0 takes a free one; so does a port in use, with a warning. If `token_file` has the token of an earlier
    process and its port is available, both are reused, and open pages reconnect. Raises `OSError` if
    the host has no port.
    """

    def __init__(
        self,
        board: Board,
        *,
        title: str,
        port: int = 0,
        max_clients: int = 16,
        commands: Callable[[Command], None] | None = None,
        token_file: TokenFile | None = None,
    ) -> None:
        self._board, self._commands, self._max_clients = board, commands, max_clients
        self._hello = json_text(
            {"type": "hello", "protocol": 1, "title": title, "recording": commands is not None, "colours": COLOURS}
        )
        kept = token_file.load() if token_file else None
        self._limiter = ConnectionLimiter()
        self._clients: set[_Client] = set()
        self._socket = _listen(kept.port if kept else port)
        self.port: int = self._socket.getsockname()[1]
        #: Whether pages of an earlier process find this one at their address.
        self.is_back = kept is not None and kept.port == self.port
        self._token = kept.token if kept and self.is_back else secrets.token_urlsafe(24)
        if token_file:
            token_file.save(self.port, self._token)
        self._loop: asyncio.AbstractEventLoop | None = None
        self._server = uvicorn.Server(self._config())
        self._thread = threading.Thread(target=self._run, name="viewer", daemon=True)
        self._thread.start()
        board.on_post = self._wake

    @property
    def url(self) -> str:
        """Address of the page, token included."""
        return f"http://{HOST}:{self.port}/{self._token}/"

    @property
    def alive(self) -> bool:
        """Return whether pages are still served."""
        return self._thread.is_alive()

    @property
    def clients(self) -> int:
        """Number of pages open at the moment."""
        return len(self._clients)

    def close(self) -> None:
        """Close all clients with a reason and end the thread."""
        self._server.should_exit = True
        self._thread.join(STOP_S)
        self._socket.close()

    def __enter__(self) -> ViewerServer:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def _config(self) -> uvicorn.Config:
        routes = [
            Route("/proof/{nonce}", self._prove),
            Route("/{token}/ws", _upgrade_required),
            WebSocketRoute("/{token}/ws", self._serve),
            Route("/{token}/{file:path}", _page),
        ]
        return uvicorn.Config(
            _Gate(Starlette(routes=routes), self._token),
            loop="asyncio",
            http=self._limiter.http,
            ws=PageSocket,
            lifespan="off",
            log_config=None,
            log_level="warning",
            access_log=False,
            server_header=False,
            headers=_HEADERS,
            ws_max_size=MAX_CLIENT_MESSAGE_BYTES,
            # noise does not compress, and a compressor per client would cost more than loopback
            ws_per_message_deflate=False,
            backlog=BACKLOG,
            timeout_graceful_shutdown=1,
        )

    def _run(self) -> None:
        async def serve() -> None:
            self._loop = asyncio.get_running_loop()
            await self._server.serve(sockets=[self._socket])

        try:
            asyncio.run(serve())
        finally:
            self._loop = None

    def _wake(self) -> None:
        """Notify the clients of a post; called from the posting thread, never waits."""
        loop = self._loop
        if self._clients and loop is not None:
            with contextlib.suppress(RuntimeError):  # the loop has just ended
                loop.call_soon_threadsafe(self._wake_clients)

    def _wake_clients(self) -> None:
        for client in self._clients:
            client.news.set()

    async def _prove(self, request: HTTPConnection) -> Response:
        """Prove that this server knows the token, without revealing it."""
        nonce: str = request.path_params["nonce"]
        return PlainTextResponse(hmac.new(self._token.encode(), nonce.encode(), hashlib.sha256).hexdigest())

    async def _serve(self, websocket: WebSocket) -> None:
        """Serve one client, from its connection to its end."""
        await websocket.accept()
        if len(self._clients) >= self._max_clients:
            await websocket.close(_TRY_AGAIN_LATER, f"at most {self._max_clients} pages may look at once")
            return
        client = _Client(websocket, self._board, self._commands)
        self._clients.add(client)
        pending: PendingConnection = websocket.scope["state"]["pending"]
        pending.admit()
        try:
            errors = await client.run(self._hello)
        finally:
            self._clients.discard(client)
            # before the last message: a client that reads nothing does not read that either
            pending.linger()
        for error in errors:
            await client.say_goodbye(error)


class _Client:
    """One websocket: sends an update, waits until it is acknowledged, sends the newest."""

    def __init__(self, websocket: WebSocket, board: Board, commands: Callable[[Command], None] | None) -> None:
        self._websocket, self._board, self._commands = websocket, board, commands
        self.news = asyncio.Event()
        self._acknowledged = asyncio.Event()
        self._acknowledged.set()
        self._number = 0
        self._seen: dict[str, int] = {}
        self._plotted: tuple[int, ...] = ()
        self._second, self._heard = 0, 0

    async def run(self, hello: str) -> list[Exception]:
        """Serve until either side ends it; return the reasons, unless the client left."""
        tasks = [asyncio.create_task(self._send(hello)), asyncio.create_task(self._listen())]
        try:
            await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
        finally:
            for task in tasks:
                task.cancel()
            ends = await asyncio.gather(*tasks, return_exceptions=True)
        return [end for end in ends if isinstance(end, Exception) and not isinstance(end, WebSocketDisconnect)]

    async def say_goodbye(self, error: Exception) -> None:
        """Close the websocket for a reason; faults of the server itself are logged."""
        code = _POLICY_VIOLATION if isinstance(error, _ProtocolError) else _GONE
        if not isinstance(error, _ProtocolError | TimeoutError):
            code = _INTERNAL_ERROR
            _LOG.error("a page was let go: %s: %s", type(error).__name__, error)
        with contextlib.suppress(WebSocketDisconnect, RuntimeError):
            await self._websocket.close(code, str(error)[:120])

    async def _send(self, hello: str) -> None:
        await self._websocket.send_text(hello)
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
        """Return the head of an update: its number of messages, and each kind's version, skipped posts and age."""
        now_ns = time.monotonic_ns()
        kinds = {
            kind: {
                "version": posted.version,
                "skipped": posted.version - self._seen[kind] - 1 if kind in self._seen else 0,
                "held_ms": round(1e-6 * (now_ns - posted.at_ns), 1),
            }
            for kind, posted in newer.items()
        }
        return {"type": "update", "number": self._number, "messages": messages, "kinds": kinds}

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
            raise _ProtocolError(f"more than {MAX_CLIENT_MESSAGES_PER_S} messages a second")
        try:
            return _FROM_CLIENT.decode(text or "")
        except (msgspec.MsgspecError, UnicodeError, RecursionError):
            raise _ProtocolError("not a message of this protocol") from None

    def _take(self, message: Acknowledge | Plot | Command) -> None:
        if isinstance(message, Plot):
            self._plotted = message.ids
            # what was sent before is sent anew, with the series of now
            self._seen.pop(SERIES, None)
            self.news.set()
        elif not isinstance(message, Acknowledge):
            if self._commands is None:
                raise _ProtocolError("a live graph takes no commands")
            self._commands(message)
        elif message.number != self._number or self._acknowledged.is_set():
            raise _ProtocolError("acknowledges what was not sent")
        else:
            self._acknowledged.set()


class _ProtocolError(Exception):
    """A client broke the protocol."""


class _Gate:
    """Refuses clients without the token or from elsewhere, before any route is matched."""

    def __init__(self, app: ASGIApp, token: str) -> None:
        self._app, self._token = app, token.encode()

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        reason = self._refusal(HTTPConnection(scope))
        if scope["type"] == "websocket":
            await (
                WebSocket(scope, receive, send).close(_POLICY_VIOLATION, reason)
                if reason
                else self._app(scope, receive, send)
            )
        else:
            app = PlainTextResponse(f"{reason}\n", status_code=403) if reason else self._app
            await app(scope, receive, _closing(send))

    def _refusal(self, connection: HTTPConnection) -> str:
        """Return why this connection is refused; empty if it is not."""
        host, origins = connection.headers.get("host", ""), connection.headers.getlist("origin")
        name, _, port = host.partition(":")
        if name not in _LOOPBACK_NAMES or not (port or "0").isdecimal():
            return "this page is for the machine it runs on"
        # a browser sends it with every websocket
        claimed_origins = origins or [""] * (connection.scope["type"] == "websocket")
        if any(origin != f"http://{host}" for origin in claimed_origins):
            return "this comes from another page"
        if not _is_of_this_page(connection.headers):
            return "this was asked for by another page"
        if connection.scope["type"] == "http" and _PROOF_PATH.fullmatch(connection.scope["path"]):
            return ""
        # a path need not begin with a slash
        given = connection.scope["path"].partition("/")[2].partition("/")[0]
        if not hmac.compare_digest(given.encode(errors="replace"), self._token):
            return "open the address that the viewer printed: it ends with a token"
        return ""


def _is_of_this_page(headers: Mapping[str, str]) -> bool:
    """Return whether a browser's request, if it says so, is by this page, or by a person who opens it."""
    is_opened = headers.get("sec-fetch-mode") == "navigate" and headers.get("sec-fetch-dest") == "document"
    return is_opened or headers.get("sec-fetch-site", "none") in ("none", "same-origin")


def _closing(send: Send) -> Send:
    """Return a `send` that closes the connection after one answer: none is kept for later."""

    async def closing(message: MutableMapping[str, Any]) -> None:
        if message["type"] == "http.response.start":
            message = {**message, "headers": [*message["headers"], (b"connection", b"close")]}
        await send(message)

    return closing


async def _page(request: HTTPConnection) -> Response:
    name = _PAGE_FILES.get(request.path_params["file"])
    return PlainTextResponse("no such page\n", status_code=404) if name is None else FileResponse(_STATIC / name)


async def _upgrade_required(request: HTTPConnection) -> Response:
    return PlainTextResponse("a websocket is served here\n", status_code=426)


def _listen(port: int) -> socket.socket:
    """Return a listening socket on the loopback address, at `port` or, if that is in use, a free one."""
    listener = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
    listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        listener.bind((HOST, port))
    except OSError as error:
        if error.errno != errno.EADDRINUSE or port == 0:
            listener.close()
            raise
        _LOG.warning("port %d is taken; using a free one", port)
        listener.bind((HOST, 0))
    listener.listen(BACKLOG)
    return listener
