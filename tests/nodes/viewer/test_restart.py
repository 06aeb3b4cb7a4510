"""The open page and the end of its node: it comes back by itself, says meanwhile that its picture is old, and tells
nobody else its token."""

from __future__ import annotations

import contextlib
import hashlib
import hmac
import http.client
import http.server
import json
import os
import re
import signal
import stat
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from nodes.process.launch_file import launch_from_mapping, with_origin, without_metadata
from nodes.process.supervisor import Supervisor
from nodes.viewer import page_token as kept_token
from nodes.viewer.newest import Board
from nodes.viewer.page_token import TokenFile
from nodes.viewer.server import ViewerServer
from tests.nodes.viewer.conftest import until

PATIENCE_S = 60.0
OWNER = {"pid": os.getpid(), "started": 7, "run": "/runs/toy-1"}


@pytest.fixture
def page(browser: Any) -> Iterator[Any]:
    page = browser.new_page(viewport={"width": 1440, "height": 900})
    yield page
    page.close()


class Graph:
    """A supervised graph of a source of views and the viewer, in a thread of this process."""

    def __init__(self, folder: Path, port: int = 0) -> None:
        self.folder = folder
        self.lines: list[str] = []
        entries = {
            "bev_viewer": {"module": "nodes.bev_viewer", "params": {"port": port}},
            "source": {"module": "tests.nodes.viewer.toy_source", "after": ["bev_viewer"]},
        }
        run_dir = folder / "run"
        launch = with_origin(launch_from_mapping({"name": "toy", "nodes": entries}, "toy.yaml"), "test", run_dir)
        log = self._log
        self._supervisor = Supervisor(launch, run_dir, runs_dir=folder / "runs", on_log=log)
        self._thread = threading.Thread(target=self._run)

    def _log(self, entry: dict[str, Any]) -> None:
        self.lines.append(entry["text"])

    def _run(self) -> None:
        # handlers of signals belong to the main thread
        self._supervisor._signals = contextlib.nullcontext  # type: ignore[method-assign, assignment]
        self._supervisor.run()

    def __enter__(self) -> Graph:
        self._thread.start()
        return self

    def __exit__(self, *error: object) -> None:
        self._supervisor.request_stop()
        self._thread.join()

    def await_match(self, pattern: str, count: int = 1) -> str:
        end_s = time.monotonic() + PATIENCE_S
        while len(found := [match[1] for line in self.lines if (match := re.search(pattern, line))]) < count:
            assert time.monotonic() < end_s, f"{pattern} was not said {count} times: {self.lines}"
            time.sleep(0.02)
        return found[count - 1]

    def address(self, count: int = 1) -> str:
        return self.await_match(r"open (http://\S+)", count)

    def kill_viewer(self, count: int = 1) -> None:
        os.kill(int(self.await_match(r"bev_viewer ready .* pid (\d+)", count)), signal.SIGKILL)


@pytest.fixture
def folder() -> Iterator[Path]:
    # short, because a socket's path has room for some hundred bytes
    with tempfile.TemporaryDirectory(prefix="mw") as name:
        yield Path(name)


@pytest.mark.graph
def test_the_open_page_comes_back_when_its_node_was_killed(folder: Path, page: Any) -> None:
    """Twice: fresh views without a hand moved, and in between the page says that its picture is old, and how old."""
    with Graph(folder) as graph:
        page.goto(graph.address())
        until(page, "mirrorwave.state.view")
        assert not page.locator("#old-picture").is_visible()
        for times in (1, 2):
            graph.kill_viewer(times)
            until(page, "mirrorwave.state.connection === 'lost'")
            until(page, "!document.getElementById('old-picture').hidden")
            said = page.locator("#old-picture").inner_text()
            assert re.fullmatch(r"Old picture, \d+\.\d s ago: no connection: has the graph ended\?", said), said
            shown = page.evaluate("mirrorwave.state.view.scan_id")
            until(page, f"mirrorwave.state.connection === 'live' && mirrorwave.state.view.scan_id > {shown} + 5")
            until(page, "document.getElementById('old-picture').hidden")
            assert graph.address(times + 1) == graph.address()
    until(page, "!document.getElementById('old-picture').hidden")


@pytest.mark.graph
def test_the_page_of_an_earlier_graph_says_that_it_is_one(folder: Path, page: Any) -> None:
    with Graph(folder) as graph:
        page.goto(graph.address())
        until(page, "mirrorwave.state.view")
    port = int(graph.address().split(":")[2].split("/")[0])
    with Graph(folder, port) as later:
        assert later.address().split("/")[2] == graph.address().split("/")[2]
        assert later.address() != graph.address()
        until(page, "mirrorwave.state.connection === 'other'")
        said = page.locator("#old-picture").inner_text()
        assert said.startswith("Old picture, ")
        assert said.endswith("another graph runs here: open the address it printed")


@pytest.mark.graph
def test_another_program_at_the_port_is_not_told_the_token(page: Any) -> None:
    """All that comes to a program of somebody else that took the port: proofs asked for, and never the token."""
    board = Board()
    server = ViewerServer(board, title="gone")
    page.goto(server.url)
    until(page, "mirrorwave.state.connection === 'live'")
    token = server.url.split("/")[3]
    server.close()
    asked: list[str] = []

    class Stranger(http.server.BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            asked.append(f"{self.requestline} {self.headers}")
            self.send_response(200)
            self.end_headers()
            self.wfile.write(b"0" * 64)

        def log_message(self, *words: object) -> None:
            pass

    with http.server.ThreadingHTTPServer(("127.0.0.1", server.port), Stranger) as stranger:
        thread = threading.Thread(target=stranger.serve_forever)
        thread.start()
        until(page, "mirrorwave.state.connection === 'other'")
        end_s = time.monotonic() + PATIENCE_S
        while len(asked) < 2:
            assert time.monotonic() < end_s
            page.wait_for_timeout(20)
        stranger.shutdown()
        thread.join()
    assert all("/proof/" in one for one in asked)
    assert not any(token in one for one in asked)


@pytest.fixture
def token_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[[], TokenFile]:
    monkeypatch.setattr(kept_token, "read_lock", lambda run_dir: OWNER)
    return lambda: TokenFile(tmp_path / "bev_viewer.token")


def served(token_file: TokenFile, port: int = 0) -> tuple[str, int]:
    with ViewerServer(Board(), title="test", port=port, token_file=token_file) as server:
        return server.url.split("/")[3], server.port


def test_a_restarted_server_has_its_token_and_port_again(tmp_path: Path, token_file: Callable[[], TokenFile]) -> None:
    first = served(token_file())
    assert served(token_file()) == first
    assert stat.S_IMODE((tmp_path / "bev_viewer.token").stat().st_mode) == 0o600
    assert [path.name for path in tmp_path.iterdir()] == ["bev_viewer.token"]


def test_the_token_is_not_used_at_another_port(token_file: Callable[[], TokenFile]) -> None:
    """Who has the port by now may have been told the token by somebody who opened the address again."""
    first = served(token_file())
    with ViewerServer(Board(), title="other", port=first[1]) as other:
        again = served(token_file())
    assert other.port == first[1]
    assert again[0] != first[0]
    assert again[1] != first[1]


@pytest.mark.parametrize("owner", [{**OWNER, "started": 8}, {**OWNER, "pid": 1}, {**OWNER, "run": "/runs/toy-2"}, {}])
def test_another_graph_draws_another_token(
    owner: dict[str, Any], token_file: Callable[[], TokenFile], monkeypatch: pytest.MonkeyPatch
) -> None:
    first = served(token_file())
    monkeypatch.setattr(kept_token, "read_lock", lambda run_dir: owner)
    assert served(token_file(), first[1])[0] != first[0]


def _group_may_read(path: Path) -> None:
    path.chmod(0o640)


def _is_a_link(path: Path) -> None:
    path.rename(path.with_suffix(".true"))
    path.symlink_to(path.with_suffix(".true"))


def _is_a_pipe(path: Path) -> None:
    path.unlink()
    os.mkfifo(path, 0o600)


def _is_short(path: Path) -> None:
    path.write_text(json.dumps({**json.loads(path.read_text()), "token": "x"}))


def _is_no_json(path: Path) -> None:
    path.write_bytes(b"\xff" * 5000)


@pytest.mark.parametrize("spoil", [_group_may_read, _is_a_link, _is_a_pipe, _is_short, _is_no_json])
def test_a_token_file_that_others_may_know_is_not_used(
    tmp_path: Path, token_file: Callable[[], TokenFile], spoil: Callable[[Path], None], caplog: pytest.LogCaptureFixture
) -> None:
    first, port = served(token_file())
    spoil(tmp_path / "bev_viewer.token")
    again = served(token_file(), port)
    assert again[0] != first
    assert first not in caplog.text
    assert served(token_file()) == again


def test_a_proof_is_for_pages_of_this_machine_and_tells_nothing_else() -> None:
    nonce = "0123456789abcdef" * 2
    with ViewerServer(Board(), title="test") as server:
        token, here = server.url.split("/")[3], f"127.0.0.1:{server.port}"

        def asked(path: str, **headers: str) -> tuple[int, str]:
            connection = http.client.HTTPConnection(here, timeout=PATIENCE_S)
            connection.request("GET", path, headers={key.replace("_", "-"): value for key, value in headers.items()})
            answer = connection.getresponse()
            return answer.status, answer.read().decode()

        proof = hmac.new(token.encode(), nonce.encode(), hashlib.sha256).hexdigest()
        assert asked(f"/proof/{nonce}") == (200, proof)
        assert asked(f"/proof/{nonce}", Sec_Fetch_Site="same-origin", Origin=f"http://{here}") == (200, proof)
        for path in ("/proof", "/proof/", f"/proof/{nonce}0", f"/proof/{nonce}/viewer.js", "/proof/viewer.js"):
            status, said = asked(path)
            assert (status, token in said) == (403, False), path
        for headers in ({"Host": "evil.example"}, {"Origin": "http://evil.example"}, {"Sec_Fetch_Site": "cross-site"}):
            assert asked(f"/proof/{nonce}", **headers)[0] == 403, headers


def test_a_launch_names_the_file_and_a_recording_does_not() -> None:
    nodes = {"eyes": {"module": "nodes.bev_viewer", "params": {"token_file": "/else/where", "port": 1}}}
    launch = launch_from_mapping({"name": "toy", "nodes": nodes}, "toy.yaml")
    told = with_origin(launch, "test", Path("/run/of"))
    assert told.nodes["eyes"].params == {"token_file": "/run/of/eyes.token", "port": 1}
    assert without_metadata(told).nodes["eyes"].params == {"port": 1}
