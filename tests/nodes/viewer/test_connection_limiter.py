"""The viewer's door: what strangers, hostile pages and dead sockets get, and what they cannot take from the others."""

from __future__ import annotations

import contextlib
import json
import logging
import os
import socket
import struct
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from nodes.bev_viewer import Params, create
from nodes.process.logs import BusLogHandler, install_handlers
from nodes.viewer import connection_limiter
from nodes.viewer import server as server_module
from nodes.viewer.newest import Board, json_text
from nodes.viewer.server import ViewerServer

PATIENCE_S = 60.0
TEXT, PING, CONTINUED, CLOSE = 1, 9, 0, 8

HEADERS = {
    "content-security-policy": "default-src 'none'; script-src 'self'; style-src 'self'; connect-src 'self'; "
    "img-src 'self' data:; base-uri 'none'; form-action 'none'; frame-ancestors 'none'; "
    "require-trusted-types-for 'script'; trusted-types 'none'",
    "x-content-type-options": "nosniff",
    "referrer-policy": "no-referrer",
    "x-frame-options": "DENY",
    "cross-origin-opener-policy": "same-origin",
    "cross-origin-resource-policy": "same-origin",
    "cache-control": "no-store",
    "connection": "close",
}


@pytest.fixture
def server() -> Iterator[ViewerServer]:
    with ViewerServer(Board(), title="test", port=0) as server:
        yield server


def token(server: ViewerServer) -> str:
    return server.url.split("/")[3]


def knock(server: ViewerServer, data: str = "") -> socket.socket:
    opened = socket.create_connection(("127.0.0.1", server.port), timeout=PATIENCE_S)
    opened.sendall(data.encode("latin-1"))
    return opened


def answer(server: ViewerServer, target: str, method: str = "GET", more: str = "", host: str | None = None) -> str:
    """Head and body of the answer to a request as it stands."""
    host = f"Host: {host or f'127.0.0.1:{server.port}'}\r\n"
    with knock(server, f"{method} {target.replace('TOKEN', token(server))} HTTP/1.1\r\n{host}{more}\r\n") as opened:
        return read_all(opened).decode("latin-1")


def read_all(opened: socket.socket) -> bytes:
    got = b""
    with contextlib.suppress(ConnectionResetError):
        while part := opened.recv(1 << 16):
            got += part
    return got


def status(text: str) -> int:
    return int(text.split()[1])


def until(condition: Callable[[], bool]) -> None:
    end_s = time.monotonic() + PATIENCE_S
    while not condition():
        assert time.monotonic() < end_s
        time.sleep(0.005)


def page(server: ViewerServer, more: str = "", buffer_bytes: int | None = None) -> socket.socket:
    """A websocket by hand: what a well-behaved library would never send can be sent."""
    opened = socket.socket()
    if buffer_bytes is not None:
        opened.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, buffer_bytes)
    opened.settimeout(PATIENCE_S)
    opened.connect(("127.0.0.1", server.port))
    host = f"127.0.0.1:{server.port}"
    opened.sendall(
        f"GET /{token(server)}/ws HTTP/1.1\r\nHost: {host}\r\nOrigin: http://{host}\r\nConnection: Upgrade\r\n"
        "Upgrade: websocket\r\nSec-WebSocket-Version: 13\r\nSec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\n"
        f"{more}\r\n".encode()
    )
    return opened


def has_ended(opened: socket.socket, more: bytes = b"") -> bool:
    """Whether the server has ended a connection, as one who sends `more` on it finds out."""
    opened.settimeout(0.01)
    try:
        opened.sendall(more)
        while opened.recv(1 << 16):
            pass
    except TimeoutError:
        return False
    except ConnectionError:
        pass
    return True


def answers(opened: socket.socket) -> bool:
    """Whether a page is served still: its ping comes back."""
    opened.sendall(ws_frame(PING, b"still here"))
    return says(opened, b"still here")


def says(opened: socket.socket, wanted: bytes) -> bool:
    got = b""
    while wanted not in got and (part := opened.recv(1 << 16)):
        got += part
    return wanted in got


def ws_frame(opcode: int, data: bytes, final: bool = True, reserved: int = 0) -> bytes:
    size = bytes([0x80 | len(data)]) if len(data) < 126 else b"\xfe" + struct.pack(">H", len(data))
    return bytes([final << 7 | reserved << 4 | opcode]) + size + b"\0\0\0\0" + data


def close_code(opened: socket.socket) -> int:
    """Of the close frame that the server sends; 0 where it only ends the connection."""
    with opened:
        got = b""
        with contextlib.suppress(ConnectionResetError):
            while b"\x88" not in got and (part := opened.recv(1 << 16)):
                got += part
        _, mark, rest = got.partition(b"\x88")
        return struct.unpack(">H", rest[1:3])[0] if mark else 0


# who is let in


@pytest.mark.parametrize("target", ["/TOKEN/", "/TOKEN/x", "/", "/TOKEN/ws"])
def test_every_answer_has_every_header(server: ViewerServer, target: str) -> None:
    head = answer(server, target).partition("\r\n\r\n")[0].lower().split("\r\n")[1:]
    said = dict(line.split(": ", 1) for line in head)
    assert {name: said[name] for name in HEADERS} == {name: value.lower() for name, value in HEADERS.items()}
    assert len(head) == len(said)
    assert not {"server", "set-cookie", "access-control-allow-origin"} & set(said)


REFUSED = (
    "*", "foo", "TOKEN/", "//TOKEN/", "http://127.0.0.1/TOKEN/", "http://evil/TOKEN/", "/?token=TOKEN", "/TOKENx/",
    "/%00/", "/%ff%fe/", "/..%2fTOKEN/", "\\TOKEN\\", "/TOKEN%00/", "/", "//", "/wrong/viewer.js", "/x" * 100,
)  # fmt: skip


@pytest.mark.parametrize("method", ["GET", "OPTIONS", "CONNECT"])
def test_only_the_path_brings_the_token(server: ViewerServer, method: str, caplog: pytest.LogCaptureFixture) -> None:
    for target in REFUSED:
        said = answer(server, target, method)
        assert status(said) == 403, target
        assert token(server) not in said
    assert status(answer(server, f"/{token(server)[:-1]}/", method)) == 403
    assert caplog.text == ""


@pytest.mark.parametrize(
    "target",
    [
        "/TOKEN/../../etc/passwd", "/TOKEN/%2e%2e/server.py", "/TOKEN/..\\server.py", "/TOKEN/%00", "/TOKEN",
        "/TOKEN/index.html", "/TOKEN/viewer.js/", "/TOKEN/static/viewer.js",
    ],
)  # fmt: skip
def test_nothing_but_the_page_is_found(server: ViewerServer, target: str) -> None:
    assert status(answer(server, target)) in (307, 404)


@pytest.mark.parametrize("method", ["POST", "PUT", "DELETE", "PATCH", "OPTIONS", "TRACE"])
def test_a_page_is_only_read(server: ViewerServer, method: str) -> None:
    assert status(answer(server, "/TOKEN/", method, "Content-Length: 0\r\n")) == 405


@pytest.mark.parametrize(
    "host",
    [
        "evil.example:8765", "127.0.0.1.nip.io", "LOCALHOST", "localhost.", "127.1", "0x7f.1", "[::1]:1",
        "127.0.0.1:1:1", "localhost,x",
    ],
)  # fmt: skip
def test_hosts_that_only_look_like_this_one_are_refused(server: ViewerServer, host: str) -> None:
    assert status(answer(server, "/TOKEN/", host=host)) == 403


SMUGGLED = (
    "Host: evil.example\r\n", "Content-Length: 4\r\nContent-Length: 5\r\n", "X : 1\r\n", "Transfer-Encoding: x\r\n",
)  # fmt: skip


def test_what_can_be_read_in_two_ways_is_refused(server: ViewerServer, caplog: pytest.LogCaptureFixture) -> None:
    for more in SMUGGLED:
        assert status(answer(server, "/TOKEN/", "POST", more)) in (400, 501), more
    # a flood of such is no flood of the log
    assert caplog.text == ""


def test_one_answer_a_connection(server: ViewerServer) -> None:
    request = f"GET /{token(server)}/ HTTP/1.1\r\nHost: localhost\r\n\r\n"
    with knock(server, 3 * request) as opened:
        assert read_all(opened).count(b"HTTP/1.1") == 1


@pytest.mark.parametrize(
    ("said", "code"),
    [
        ("site: cross-site|mode: no-cors|dest: script", 403),
        ("site: same-site|mode: cors|dest: empty", 403),
        ("site: cross-site|mode: navigate|dest: iframe", 403),
        ("site: cross-site|mode: navigate|dest: document", 200),
        ("site: none|mode: navigate|dest: document", 200),
        ("site: same-origin|mode: no-cors|dest: script", 200),
    ],
)
def test_another_page_may_link_here_and_no_more(server: ViewerServer, said: str, code: int) -> None:
    more = "".join(f"Sec-Fetch-{one[0].upper()}{one[1:]}\r\n" for one in said.split("|"))
    assert status(answer(server, "/TOKEN/viewer.js", more=more)) == code


def test_a_second_origin_does_not_pass_behind_the_first(server: ViewerServer) -> None:
    more = f"Origin: http://127.0.0.1:{server.port}\r\n"
    assert status(answer(server, "/TOKEN/", more=more)) == 200
    for origin in ("http://evil.example", "null"):
        assert status(answer(server, "/TOKEN/", more=f"Origin: {origin}\r\n")) == 403
        assert status(answer(server, "/TOKEN/", more=f"{more}Origin: {origin}\r\n")) == 403


# strangers


def test_strangers_that_never_end_their_requests_shut_nobody_out(
    server: ViewerServer, monkeypatch: pytest.MonkeyPatch
) -> None:
    """More than may stand there, each with half a request: the oldest had to go."""
    monkeypatch.setattr(connection_limiter, "MAX_PENDING", 100)
    strangers = [knock(server, "GET / HTTP/1.1\r\nX: ") for _ in range(120)]
    try:
        until(lambda: has_ended(strangers[19]))
        assert [has_ended(stranger) for stranger in strangers[:21]] == [True] * 20 + [False]
        assert server._limiter.pending == 100
        assert status(answer(server, "/TOKEN/")) == 200
        until(lambda: len(server._server.server_state.connections) <= 100)
    finally:
        for stranger in strangers:
            stranger.close()
    until(lambda: server._limiter.pending == 0)


def test_a_stranger_does_not_stay(monkeypatch: pytest.MonkeyPatch) -> None:
    """Nor one that sends a byte now and then: time counts from its arrival. A page is no stranger: it stays."""
    with ViewerServer(Board(), title="test") as server, page(server) as one:
        # no clock runs for it any more, however long its handshake took
        until(lambda: server.clients == 1 and server._limiter.pending == 0)
        monkeypatch.setattr(connection_limiter, "PENDING_S", 0.2)
        with knock(server, "GET / HTTP/1.1\r\nX: ") as slow:
            until(lambda: has_ended(slow, b"x"))
        assert answers(one)


# pages


def test_dead_pages_keep_neither_their_places_nor_their_sockets(monkeypatch: pytest.MonkeyPatch) -> None:
    """More is owed to each than its socket holds, and none ever reads: the next page finds room all the same."""
    board = Board()
    with ViewerServer(board, title="test", max_clients=4) as server, contextlib.ExitStack() as stack:
        for _ in range(4):
            stack.enter_context(page(server, buffer_bytes=4096))
        until(lambda: server.clients == 4)
        monkeypatch.setattr(server_module, "ACKNOWLEDGE_S", 0.1)
        monkeypatch.setattr(connection_limiter, "LINGER_S", 0.1)
        board.post("view", lambda: (json_text({"type": "view"}), bytes(4_000_000)))
        until(lambda: server.clients == 0 and not server._server.server_state.connections)
        with page(server) as alive:
            assert says(alive, b'"hello"')


def test_a_page_that_is_let_go_and_stays_has_a_limited_time(server: ViewerServer) -> None:
    """All that it is owed is sent, and it never answers the farewell."""
    with page(server) as opened:
        until(lambda: server.clients == 1 and server._limiter.pending == 0)
        opened.sendall(ws_frame(TEXT, b'{"type":"ack","number":0}'))
        until(lambda: server._limiter.pending == 1)
        assert server.clients == 0


BROKEN = (
    (ws_frame(TEXT, b"\xff\xfe"), 1007), (ws_frame(TEXT, b"{}", reserved=4), 1002), (b"\x81\x02{}", 1002),
    (ws_frame(TEXT, b"a", final=False) + ws_frame(TEXT, b"b"), 1002), (ws_frame(PING, bytes(126)), 1002),
    (ws_frame(3, b""), 1002), (ws_frame(CLOSE, b"\x03\xed"), 1002), (ws_frame(TEXT, bytes(1025)), 1009),
    (ws_frame(TEXT, bytes(1000), final=False) + ws_frame(CONTINUED, bytes(1000)), 1009),
    (ws_frame(TEXT, b'{"type":"ack","number":0}'), 1008), (ws_frame(2, b"\x00"), 1008),
    (ws_frame(TEXT, b'{"type":"seek","index":1}'), 1008),
)  # fmt: skip


def test_broken_frames_have_their_close_codes(server: ViewerServer) -> None:
    for data, code in BROKEN:
        opened = page(server)
        assert b"101" in opened.recv(1 << 16)
        opened.sendall(data)
        assert close_code(opened) == code, data[:40]
    until(lambda: server.clients == 0)


@pytest.mark.parametrize(
    "flood", [ws_frame(PING, bytes(125)), ws_frame(CONTINUED, b"", final=False)], ids=["pings", "fragments"]
)
def test_a_flood_of_what_is_no_message_is_cut_off(server: ViewerServer, flood: bytes) -> None:
    """Answers to pings that nobody reads, and messages that never end, would fill the memory."""
    with page(server) as opened, page(server) as other:
        until(lambda: server.clients == 2)
        opened.sendall(ws_frame(TEXT, b"", final=False))
        until(lambda: has_ended(opened, 2000 * flood))
        until(lambda: server.clients == 1)
        assert answers(other)


def test_a_message_has_an_end(server: ViewerServer) -> None:
    """Fragments of nothing, however few a second."""
    with page(server) as opened:
        opened.sendall(ws_frame(TEXT, b"", final=False))
        for _ in range(3):
            opened.sendall(500 * ws_frame(CONTINUED, b"", final=False))
        until(lambda: has_ended(opened, ws_frame(CONTINUED, b"", final=False)))


def test_compression_is_not_agreed_to(server: ViewerServer) -> None:
    with page(server, "Sec-WebSocket-Extensions: permessage-deflate\r\n") as opened:
        assert b"permessage-deflate" not in opened.recv(1 << 16).lower()


def test_what_comes_and_goes_leaves_nothing(server: ViewerServer) -> None:
    """Good, bad and vanished, strangers and pages: file descriptors, threads and tasks are as before."""

    def held() -> tuple[int, int, int, int]:
        state = server._server.server_state
        return len(os.listdir("/proc/self/fd")), len(state.connections), len(state.tasks), server._limiter.pending

    def come_and_go(number: int) -> None:
        kind = number % 4
        if kind == 0:
            answer(server, "/wrong/")
        elif kind == 1:
            knock(server, "GET /half HT").close()
        else:
            opened = page(server)
            if kind == 3:  # vanishes: a reset, no goodbye
                opened.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
            opened.recv(1)
            opened.close()

    answer(server, "/TOKEN/")  # the threads that read files are started
    until(lambda: held()[1:] == (0, 0, 0))
    before = held()
    for number in range(100):
        come_and_go(number)
    until(lambda: held() == before)


# the token


def test_the_address_is_not_for_all(caplog: pytest.LogCaptureFixture) -> None:
    """Not on the bus, where recordings and other machines take it in; not among the arguments of the process."""
    on_bus = BusLogHandler("bev_viewer")
    remove = install_handlers([on_bus])
    try:
        node = create(Params(port=0))
    finally:
        remove()
    try:
        given = token(node.server)
        assert f"open {node.server.url}" in caplog.messages
        said = on_bus.drain()
        assert any(f"page at port {node.server.port}" in one.text for one in said)
        assert all(given not in one.text for one in said)
        assert given.encode() not in Path("/proc/self/cmdline").read_bytes()
        assert all(given not in thread.name for thread in threading.enumerate())
    finally:
        node.close()


def test_what_goes_wrong_inside_does_not_tell_the_token(server: ViewerServer, caplog: pytest.LogCaptureFixture) -> None:
    """Not even at the level at which the web server tells each request."""
    with caplog.at_level(logging.INFO):
        answer(server, "/TOKEN/")
        with page(server) as opened:
            opened.recv(1 << 16)
            opened.sendall(ws_frame(TEXT, json.dumps({"type": "x"}).encode()))
            opened.recv(1 << 16)
    assert token(server) not in caplog.text


def test_a_page_that_is_closed_is_no_warning(server: ViewerServer, caplog: pytest.LogCaptureFixture) -> None:
    """asyncio's own words for a write after its client has gone; what else it says stays."""
    for said in ("socket.send() raised exception.", "another"):
        logging.getLogger("asyncio").warning(said)
    assert caplog.messages == ["another"]
