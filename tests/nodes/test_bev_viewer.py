"""The viewer's server: who is let in, newest only, and nothing that a client does reaches the graph."""

from __future__ import annotations

import contextlib
import http.client
import json
import socket
import threading
import time
from collections.abc import Callable, Iterator
from typing import Any

import msgspec
import numpy as np
import pytest
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import ClientConnection, connect

from msgs.bus.local import LocalNetwork
from msgs.values.diagnostics import NodeState
from msgs.values.perception import BevFrame, SceneTruth
from msgs.values.radar import RangeAzimuthGrid, RangeAzimuthMap
from msgs.values.vehicle import VehicleState
from nodes.bev_viewer import BevViewer, Params, create
from nodes.node import InProcessGraph, Node
from nodes.viewer.assembly import Assembly
from nodes.viewer.newest import Board, json_text
from nodes.viewer.server import MAX_CLIENT_MESSAGE_BYTES, MAX_CLIENT_MESSAGES_PER_S, Play, Seek, ViewerServer
from tests.builders import example_map, example_truth, example_view

PATIENCE_S = 60.0


@pytest.fixture
def board() -> Board:
    return Board()


@pytest.fixture
def server(board: Board) -> Iterator[ViewerServer]:
    with ViewerServer(board, title="test", port=0, max_clients=12) as server:
        yield server


def frame(scan_id: int) -> BevFrame:
    return example_view(stamp_ns=scan_id, scan_id=scan_id)


def ra_map(scan_id: int) -> RangeAzimuthMap:
    grid = RangeAzimuthGrid(range_bins=512, azimuth_bins=256)
    return example_map(np.ones(grid.shape, np.complex64), stamp_ns=scan_id, scan_id=scan_id, grid=grid)


def truth(scan_id: int) -> SceneTruth:
    return example_truth(stamp_ns=scan_id, scan_id=scan_id)


def text_post(board: Board, number: int, kind: str = "view") -> None:
    board.post(kind, lambda: (json_text({"type": kind, "scan_id": number}),))


def client(server: ViewerServer, **changes: Any) -> ClientConnection:
    origin = server.url.split("/")[2]
    options = {"origin": f"http://{origin}", "max_size": 1 << 20, "compression": None, "close_timeout": 1, **changes}
    return connect(server.url.replace("http:", "ws:") + "ws", **options)


def update(page: ClientConnection, acknowledge: bool = True) -> tuple[dict[str, Any], list[Any]]:
    """The next update and its messages, JSON decoded."""
    head = json.loads(page.recv(PATIENCE_S))
    assert head["type"] == "update"
    messages = [page.recv(PATIENCE_S) for _ in range(head["messages"])]
    if acknowledge:
        page.send(json.dumps({"type": "ack", "number": head["number"]}))
    return head, [json.loads(message) if isinstance(message, str) else message for message in messages]


def the_end(page: ClientConnection) -> ConnectionClosed:
    """Reads until the server closes the connection; what was on its way may come before."""
    try:
        while True:
            page.recv(PATIENCE_S)
    except ConnectionClosed as closed:
        return closed


def until(condition: Callable[[], bool]) -> None:
    end_s = time.monotonic() + PATIENCE_S
    while not condition():
        assert time.monotonic() < end_s
        time.sleep(0.005)


def get(server: ViewerServer, path: str, **headers: str) -> http.client.HTTPResponse:
    connection = http.client.HTTPConnection("127.0.0.1", server.port, timeout=PATIENCE_S)
    connection.request("GET", path, headers={key.replace("_", "-"): value for key, value in headers.items()})
    response = connection.getresponse()
    response.body = response.read()  # type: ignore[attr-defined]
    connection.close()
    return response


def token_path(server: ViewerServer) -> str:
    return f"/{server.url.split('/')[3]}/"


# who is let in


def test_the_page_needs_nothing_from_outside(server: ViewerServer) -> None:
    for name in ("", "viewer.js", "viewer.css"):
        body = get(server, token_path(server) + name).body.decode()  # type: ignore[attr-defined]
        assert "http:" not in body.replace("http://www.w3.org", "")
        assert "https:" not in body


def test_a_token_is_its_own_and_long() -> None:
    with ViewerServer(Board(), title="a") as one, ViewerServer(Board(), title="b") as other:
        assert one.url.split("/")[3] != other.url.split("/")[3]
        assert len(one.url.split("/")[3]) >= 32


@pytest.mark.parametrize("host", ["localhost", "localhost:8765", "127.0.0.1:9"])
def test_a_tunnel_may_have_another_port(server: ViewerServer, host: str) -> None:
    assert get(server, token_path(server), Host=host).status == 200


@pytest.mark.parametrize("origin", [None, "http://evil.example", "null", "https://127.0.0.1", "http://127.0.0.1:1"])
def test_the_websocket_is_for_this_page_alone(server: ViewerServer, origin: str | None) -> None:
    with pytest.raises(InvalidStatus) as refused:
        client(server, origin=origin)
    assert refused.value.response.status_code == 403


def test_the_websocket_needs_token_and_host(server: ViewerServer) -> None:
    origin = f"http://127.0.0.1:{server.port}"
    with pytest.raises(InvalidStatus):
        connect(f"ws://127.0.0.1:{server.port}/wrong/ws", origin=origin)
    stream = socket.create_connection(("127.0.0.1", server.port))
    with pytest.raises(InvalidStatus):
        connect(f"ws://evil.example{token_path(server)}ws", origin="http://evil.example", sock=stream)


def test_one_page_too_many_is_told_so(board: Board) -> None:
    with ViewerServer(board, title="full", max_clients=1) as server, client(server) as page:
        page.recv(PATIENCE_S)
        with client(server) as other, pytest.raises(ConnectionClosed) as closed:
            other.recv(PATIENCE_S)
        assert closed.value.rcvd is not None
        assert closed.value.rcvd.code == 1013
        until(lambda: server.clients == 1)


# newest only


def test_a_page_is_greeted_and_gets_what_hangs_on_the_board(board: Board, server: ViewerServer) -> None:
    text_post(board, 5)
    with client(server) as page:
        hello = json.loads(page.recv(PATIENCE_S))
        assert (hello["type"], hello["title"], hello["recording"]) == ("hello", "test", False)
        head, messages = update(page)
    assert messages == [{"type": "view", "scan_id": 5}]
    assert head["kinds"]["view"]["version"] == 1
    assert head["kinds"]["view"]["skipped"] == 0


def test_a_slow_page_gets_the_newest_and_the_number_it_missed(board: Board, server: ViewerServer) -> None:
    with client(server) as page:
        page.recv(PATIENCE_S)
        for first in (0, 200):
            text_post(board, first)
            head, _ = update(page, acknowledge=False)
            assert head["kinds"]["view"]["skipped"] == 0
            for number in range(first + 1, first + 100):
                text_post(board, number)
                time.sleep(1e-3)
            page.send(json.dumps({"type": "ack", "number": head["number"]}))
            head, messages = update(page)
            assert messages == [{"type": "view", "scan_id": first + 99}]
            assert head["kinds"]["view"]["skipped"] == 98


def test_what_did_not_change_is_not_sent_again(board: Board, server: ViewerServer) -> None:
    text_post(board, 0, "map")
    with client(server) as page:
        page.recv(PATIENCE_S)
        assert list(update(page)[0]["kinds"]) == ["map"]
        text_post(board, 0, "view")
        assert list(update(page)[0]["kinds"]) == ["view"]


def test_a_post_is_rendered_once_for_all_and_never_for_nobody(board: Board, server: ViewerServer) -> None:
    rendered: list[int] = []

    def render(number: int) -> tuple[str, ...]:
        rendered.append(number)
        return (json_text({"type": "view"}),)

    for number in range(50):
        board.post("view", lambda number=number: render(number))  # type: ignore[misc]
    assert rendered == []
    for _ in range(10):
        with client(server) as page:
            page.recv(PATIENCE_S)
            update(page)
    assert rendered == [49]


def test_a_page_that_never_reads_holds_nobody_up(board: Board, server: ViewerServer) -> None:
    """The dead page is owed one update of 64 KiB a tile; 200 more posts leave no trace of it but that one."""
    assembly = Assembly(board)
    with client(server, max_queue=1) as dead, client(server) as alive:
        alive.recv(PATIENCE_S)
        until(lambda: server.clients == 2)
        for scan in range(200):
            assembly.take(ra_map(scan), scan)
            assembly.take(frame(scan), scan)
        seen = -1
        while seen < 199:
            _, messages = update(alive)
            seen = max([seen, *(one["scan_id"] for one in messages if isinstance(one, dict) and "scan_id" in one)])
        (held,) = [one for one in server._clients if one._number == 1 and not one._acknowledged.is_set()]
        assert len(held._seen) <= 3
        assert dead.protocol.state.name == "OPEN"
    until(lambda: server.clients == 0)


# garbage


GARBAGE = (
    "", "x", "{}", "[]", "null", '{"type": "ack"}', '{"type": "ack", "number": "1"}', '{"type": "ack", "number": 99}',
    '{"type": "ack", "number": 1e400}', '{"type": "nope"}', '{"type": "ack", "number": 1, "more": 1}', "[" * 1000,
    '{"type": "seek", "index": 1}', '{"type": "step", "by": 1}', '{"type": "play", "speed": 1}', b"",
    '{"type": "plot", "ids": [1, 2, 3, 4, 5, 6, 7]}', '{"type": "plot", "ids": ["x"]}', '{"type": "plot"}',
    b"\x00\xff", b"x" * 500, "x" * (MAX_CLIENT_MESSAGE_BYTES + 1), "x" * 200_000,
)  # fmt: skip


def test_garbage_closes_its_sender_alone(board: Board, server: ViewerServer) -> None:
    with client(server) as good:
        good.recv(PATIENCE_S)
        for index, junk in enumerate(GARBAGE):
            text_post(board, index)
            with client(server) as bad:
                bad.recv(PATIENCE_S)
                bad.send(junk)
                end = the_end(bad)
            assert end.rcvd is None or end.rcvd.code in (1008, 1009), junk
            assert update(good)[1] == [{"type": "view", "scan_id": index}]
    until(lambda: server.clients == 0)


def test_bytes_that_are_no_protocol_close_their_connection_alone(board: Board, server: ViewerServer) -> None:
    rng = np.random.default_rng(0)
    for _ in range(20):
        with socket.create_connection(("127.0.0.1", server.port), timeout=PATIENCE_S) as raw:
            raw.sendall(rng.bytes(200) + b"\r\n\r\n")
            assert b"200 OK" not in raw.recv(4096)
    assert get(server, token_path(server)).status == 200


def test_a_flood_is_cut_off(board: Board) -> None:
    taken: list[object] = []
    with ViewerServer(board, title="recording", commands=taken.append) as server, client(server) as page:
        page.recv(PATIENCE_S)
        with contextlib.suppress(ConnectionClosed):
            for _ in range(100 * MAX_CLIENT_MESSAGES_PER_S):
                page.send('{"type": "seek", "index": 1}')
        the_end(page)
        until(lambda: server.clients == 0)
    assert len(taken) < 100 * MAX_CLIENT_MESSAGES_PER_S


def test_commands_reach_who_asked_for_them(board: Board) -> None:
    taken: list[object] = []
    with ViewerServer(board, title="recording", commands=taken.append) as server, client(server) as page:
        assert json.loads(page.recv(PATIENCE_S))["recording"] is True
        page.send('{"type": "seek", "index": 3}')
        page.send('{"type": "play", "speed": 0.5}')
        until(lambda: len(taken) == 2)
    assert taken == [Seek(3), Play(0.5)]


# what comes and goes


def test_nothing_is_left_when_pages_come_and_go(board: Board, server: ViewerServer) -> None:
    def tasks() -> int:
        return len(server._server.server_state.tasks) + len(server._server.server_state.connections)

    for number in range(30):
        text_post(board, number)
        with client(server) as page:
            page.recv(PATIENCE_S)
            if number % 3:
                update(page, acknowledge=number % 3 == 1)
    until(lambda: server.clients == 0 and tasks() == 0)


def test_closing_says_goodbye_and_frees_the_port(board: Board) -> None:
    before = threading.active_count()
    server = ViewerServer(board, title="end")
    with client(server) as page:
        page.recv(PATIENCE_S)
        server.close()
        with pytest.raises(ConnectionClosed):
            page.recv(PATIENCE_S)
    until(lambda: threading.active_count() == before)
    text_post(board, 1)
    with ViewerServer(board, title="again", port=server.port) as again:
        assert again.port == server.port


def test_a_taken_port_gives_way(board: Board) -> None:
    with ViewerServer(board, title="a") as first, ViewerServer(board, title="b", port=first.port) as second:
        assert second.port != first.port
        assert get(second, token_path(second)).status == 200


# the node


class Source(Node):
    """Publishes five scans, the truth after the view."""

    outputs = ("perception/hidden_objects", "sim/truth", "radar/ra_map", "vehicle/state")

    def __init__(self) -> None:
        super().__init__()
        self.scan = 0

    def due_ns(self, now_ns: int) -> int | None:
        return self.scan * 300_000_000 if self.scan < 5 else None

    def step(self, inputs: list[Any], now_ns: int) -> list[Any]:
        scan, self.scan = self.scan, self.scan + 1
        state = VehicleState(stamp_ns=now_ns, speed_mps=float(scan))
        return [
            ("radar/ra_map", ra_map(scan)),
            ("vehicle/state", state),
            ("perception/hidden_objects", msgspec.structs.replace(frame(scan), stamp_ns=now_ns)),
            ("sim/truth", truth(scan)),
        ]


@pytest.fixture
def viewer() -> Iterator[BevViewer]:
    node = create(Params(port=0))
    yield node
    node.close()


def test_the_node_hands_over_view_map_truth_and_table(viewer: BevViewer) -> None:
    graph = InProcessGraph(LocalNetwork(), {"source": Source(), "viewer": viewer})
    graph.run(until_ns=2_000_000_000)
    with client(viewer.server) as page:
        page.recv(PATIENCE_S)
        head, messages = update(page)
    told = {one["type"]: one for one in messages if isinstance(one, dict)}
    assert set(told) == {"view", "map", "nodes", "warnings", "fields"}
    assert (told["view"]["scan_id"], told["map"]["scan_id"]) == (4, 4)
    assert told["view"]["truth"] is not None
    assert told["view"]["vehicle"]["speed_mps"] == 4.0
    assert sum(isinstance(one, bytes) for one in messages) == 2
    # five views, each once more with its truth
    assert told["view"]["number"] == 5
    assert head["kinds"]["view"]["version"] == 10


def test_the_node_says_when_its_page_has_ended(viewer: BevViewer) -> None:
    assert viewer.health()[0] is NodeState.READY
    viewer.server.close()
    assert viewer.health() == (NodeState.DEGRADED, "the page is no longer served")


def test_what_cannot_be_rendered_is_logged_and_lets_its_page_go(
    board: Board, server: ViewerServer, caplog: pytest.LogCaptureFixture
) -> None:
    board.post("view", lambda: (json_text(1 // 0),))
    with client(server) as page:
        assert the_end(page).rcvd is not None
    assert "ZeroDivisionError" in caplog.text
    text_post(board, 1)
    with client(server) as page:
        page.recv(PATIENCE_S)
        assert update(page)[1] == [{"type": "view", "scan_id": 1}]


def test_a_map_waits_for_its_view_but_not_for_ever(board: Board) -> None:
    assembly = Assembly(board)
    assembly.take(ra_map(0), 0)
    assert board.newer({}) == {}
    assembly.take(ra_map(1), 0)
    assert set(board.newer({})) == {"map"}
    seen = {kind: posted.version for kind, posted in board.newer({}).items()}
    assembly.take(frame(1), 0)
    assert set(board.newer(seen)) == {"view", "map", "warnings"}


def test_age_is_only_known_on_one_clock(board: Board) -> None:
    assembly = Assembly(board)
    for now_ns, latency_ms in ((2_500_000, 2.5), (10**18, 1e12), (-1, None)):
        assembly.take(frame(0), now_ns)
        text, _ = board.messages("view", board.newer({})["view"])
        assert json.loads(text)["latency_ms"] == latency_ms


@pytest.mark.parametrize("age_ms", [0.0, 300.0, 43_800.0, 61_000.0, 2e12])
def test_the_age_of_a_picture_is_that_of_its_measurement(board: Board, age_ms: float) -> None:
    """However old it is on arrival, and of a view that is posted again with its truth a minute later."""
    assembly, now_ns = Assembly(board), round(1e6 * age_ms)
    for message, at_ns, later_ms in ((frame(0), now_ns, 0.0), (truth(0), now_ns + 60 * 10**9, 60_000.0)):
        assembly.take(message, at_ns)
        told = json.loads(board.messages("view", board.newer({})["view"])[0])
        assert told["age_ms"] == pytest.approx(age_ms + later_ms)
    # a map waits for its view
    assembly.take(ra_map(1), now_ns)
    assembly.take(frame(1), now_ns + 500_000_000)
    told = json.loads(board.messages("map", board.newer({})["map"])[0])
    assert told["age_ms"] == pytest.approx(age_ms + 500.0)


def test_a_stamp_that_the_clock_has_yet_to_reach_has_no_age(board: Board) -> None:
    Assembly(board).take(msgspec.structs.replace(frame(0), stamp_ns=1), 0)
    assert json.loads(board.messages("view", board.newer({})["view"])[0])["age_ms"] is None


def test_numbers_that_json_lacks_are_null() -> None:
    assert json_text({"a": float("nan"), "b": float("inf")}) == '{"a":null,"b":null}'


@pytest.mark.parametrize(("field", "value"), [("port", -1), ("port", 65536)])
def test_wrong_parameters_are_named(field: str, value: int) -> None:
    with pytest.raises(msgspec.ValidationError, match=field):
        msgspec.convert({field: value}, Params)
    with pytest.raises(msgspec.ValidationError, match="host"):
        msgspec.convert({"host": "0.0.0.0"}, Params)
