"""A web server on 127.0.0.1 for clients that know its token, in a thread of its own.

A request must name this machine in `Host` and know the token, which is the first part of the path; a subclass adds who
may ask (`refuse_origin`). Nothing that a client does reaches the thread that posts. The number and duration of pending
connections are limited in `connection_limiter.py`.
"""

from __future__ import annotations

import asyncio
import contextlib
import errno
import hmac
import logging
import secrets
import socket
import threading
from collections.abc import Callable, Coroutine, MutableMapping, Sequence
from typing import Any, Protocol

import uvicorn
from starlette.applications import Starlette
from starlette.requests import HTTPConnection
from starlette.responses import PlainTextResponse, Response
from starlette.routing import BaseRoute
from starlette.types import ASGIApp, Receive, Scope, Send
from starlette.websockets import WebSocket, WebSocketDisconnect

from nodes.viewer.connection_limiter import BACKLOG, ConnectionLimiter, PageSocket, PendingConnection
from nodes.viewer.page_token import TokenFile

_LOG = logging.getLogger(__name__)

HOST = "127.0.0.1"
#: Names under which a browser on this machine, or at the end of an SSH tunnel, may reach a loopback address.
_LOOPBACK_NAMES = ("127.0.0.1", "localhost")
STOP_S = 5.0
_GONE, _POLICY_VIOLATION, _INTERNAL_ERROR, _TRY_AGAIN_LATER = 1001, 1008, 1011, 1013


class ProtocolError(Exception):
    """A client broke the protocol."""


class Client(Protocol):
    """One websocket that was let in."""

    #: Set when there is something to send.
    news: asyncio.Event

    async def run(self) -> list[Exception]:
        """Serve until either side ends it; return the reasons, unless the client left."""


class LoopbackServer:
    """Serves the routes of a subclass; a context manager.

    `port` 0 takes a free one; so does a port in use, with a warning. If `token_file` has the token of an earlier
    process and its port is available, both are reused, and clients reconnect. Raises `OSError` if the host has no port.
    """

    #: Name of the thread, and of what may connect.
    name = "server"
    #: No message of a client is longer.
    max_message_bytes = 1024
    #: Sent with every answer.
    headers: Sequence[tuple[str, str]] = ()

    def __init__(self, *, port: int, max_clients: int, token_file: TokenFile | None) -> None:
        kept = token_file.load() if token_file else None
        self._max_clients = max_clients
        self._limiter = ConnectionLimiter()
        self._clients: set[Any] = set()
        self._socket = _listen(kept.port if kept else port)
        self.port: int = self._socket.getsockname()[1]
        #: Whether clients of an earlier process find this one at their address.
        is_back = kept is not None and kept.port == self.port
        self._token = kept.token if kept and is_back else secrets.token_urlsafe(24)
        if token_file:
            token_file.save(self.port, self._token)
        self._loop: asyncio.AbstractEventLoop | None = None
        self._server = uvicorn.Server(self._config())
        self._thread = threading.Thread(target=self._run, name=self.name, daemon=True)

    def routes(self) -> list[BaseRoute]:
        """Return the routes to serve, each below `/{token}`, or without it as `is_public` says."""
        raise NotImplementedError

    def refuse_origin(self, connection: HTTPConnection) -> str:
        """Return why a connection is refused for where it comes from; empty if it is not."""
        raise NotImplementedError

    def is_public(self, connection: HTTPConnection) -> bool:
        """Return whether a request needs no token."""
        return False

    def start(self) -> None:
        """Start the thread, at the end of a subclass's construction."""
        self._thread.start()

    @property
    def alive(self) -> bool:
        """Return whether clients are still served."""
        return self._thread.is_alive()

    @property
    def clients(self) -> int:
        """Number of clients connected at the moment."""
        return len(self._clients)

    def close(self) -> None:
        """Close all clients with a reason and end the thread."""
        self._server.should_exit = True
        self._thread.join(STOP_S)
        self._socket.close()

    def call_soon(self, callback: Callable[..., object], *arguments: Any) -> None:
        """Have the server's thread call something; returns at once, and nothing is called after the end."""
        loop = self._loop
        if loop is not None:
            with contextlib.suppress(RuntimeError):  # the loop has just ended
                loop.call_soon_threadsafe(callback, *arguments)

    def knows_token(self, connection: HTTPConnection) -> bool:
        """Return whether the path of a request begins with the token."""
        # a path need not begin with a slash
        given = connection.scope["path"].partition("/")[2].partition("/")[0]
        return hmac.compare_digest(given.encode(errors="replace"), self._token.encode())

    def refusal(self, connection: HTTPConnection) -> str:
        """Return why a connection is refused; empty if it is not."""
        name, _, port = connection.headers.get("host", "").partition(":")
        if name not in _LOOPBACK_NAMES or not (port or "0").isdecimal():
            return f"this {self.name} is for the machine it runs on"
        if reason := self.refuse_origin(connection):
            return reason
        if self.is_public(connection) or self.knows_token(connection):
            return ""
        return f"open the address that the {self.name} printed: it ends with a token"

    async def serve(self, websocket: WebSocket, client: Client, subprotocol: str | None = None) -> None:
        """Serve one client, from its connection to its end."""
        await websocket.accept(subprotocol)
        if len(self._clients) >= self._max_clients:
            await websocket.close(_TRY_AGAIN_LATER, f"at most {self._max_clients} may look at once")
            return
        self._clients.add(client)
        pending: PendingConnection = websocket.scope["state"]["pending"]
        pending.admit()
        try:
            errors = await client.run()
        finally:
            self._clients.discard(client)
            # before the last message: a client that reads nothing does not read that either
            pending.linger()
        for error in errors:
            await _say_goodbye(websocket, error)

    def __enter__(self) -> Any:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def _config(self) -> uvicorn.Config:
        return uvicorn.Config(
            _Gate(Starlette(routes=self.routes()), self.refusal),
            loop="asyncio",
            http=self._limiter.http,
            ws=PageSocket,
            lifespan="off",
            log_config=None,
            log_level="warning",
            access_log=False,
            server_header=False,
            headers=list(self.headers),
            ws_max_size=self.max_message_bytes,
            # noise does not compress, and a compressor per client would cost more than loopback
            ws_per_message_deflate=False,
            backlog=BACKLOG,
            timeout_graceful_shutdown=1,
        )

    def _run(self) -> None:
        logging.getLogger("asyncio").addFilter(_not_to_gone_clients)

        async def serve() -> None:
            self._loop = asyncio.get_running_loop()
            await self._server.serve(sockets=[self._socket])

        try:
            asyncio.run(serve())
        finally:
            self._loop = None


def _not_to_gone_clients(record: logging.LogRecord) -> bool:
    """Leave out what asyncio logs of writes to a client that has gone, until the next read notices it."""
    return record.msg != "socket.send() raised exception."


async def converse(*halves: Coroutine[Any, Any, None]) -> list[Exception]:
    """Run both halves of a conversation until one ends; return the reasons, unless the client left."""
    tasks = [asyncio.create_task(half) for half in halves]
    try:
        await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
    finally:
        for task in tasks:
            task.cancel()
        ends = await asyncio.gather(*tasks, return_exceptions=True)
    return [end for end in ends if isinstance(end, Exception) and not isinstance(end, WebSocketDisconnect)]


async def _say_goodbye(websocket: WebSocket, error: Exception) -> None:
    """Close a websocket for a reason; faults of the server itself are logged."""
    code = _POLICY_VIOLATION if isinstance(error, ProtocolError) else _GONE
    if not isinstance(error, ProtocolError | TimeoutError):
        code = _INTERNAL_ERROR
        _LOG.error("a client was let go: %s: %s", type(error).__name__, error)
    with contextlib.suppress(WebSocketDisconnect, RuntimeError):
        await websocket.close(code, str(error)[:120])


class _Gate:
    """Refuses clients before any route is matched, each with one line."""

    def __init__(self, app: ASGIApp, refusal: Callable[[HTTPConnection], str]) -> None:
        self._app, self._refusal = app, refusal

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        reason = self._refusal(HTTPConnection(scope))
        if scope["type"] == "websocket":
            await (refuse(WebSocket(scope, receive, send), reason) if reason else self._app(scope, receive, send))
        else:
            app = PlainTextResponse(f"{reason}\n", status_code=403) if reason else self._app
            await app(scope, receive, _closing(send))


async def refuse(websocket: WebSocket, reason: str) -> None:
    """Answer a handshake with 403 and one line."""
    await websocket.send_denial_response(PlainTextResponse(f"{reason}\n", status_code=403))


def _closing(send: Send) -> Send:
    """Return a `send` that closes the connection after one answer: none is kept for later."""

    async def closing(message: MutableMapping[str, Any]) -> None:
        if message["type"] == "http.response.start":
            message = {**message, "headers": [*message["headers"], (b"connection", b"close")]}
        await send(message)

    return closing


async def upgrade_required(request: HTTPConnection) -> Response:
    """Answer a plain request for a websocket."""
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
