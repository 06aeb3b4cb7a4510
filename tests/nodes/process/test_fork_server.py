"""The server that forks nodes: they are its parent's children, with their own command line, output and end."""

from __future__ import annotations

import os
import select
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator

import psutil
import pytest

from nodes.process import fork_server
from nodes.process.fork_server import ForkServer

pytestmark = pytest.mark.graph

#: Nothing is measured against this: it ends a test that would wait for ever.
PATIENCE_S = 120.0
_TOY = ["tests.nodes.process.forked", "one", '{"a": [1, 2]}', "--wait"]


@pytest.fixture
def server() -> Iterator[ForkServer]:
    server = ForkServer()
    try:
        yield server
    finally:
        server.close()


def _await(server: ForkServer) -> None:
    end_s = time.monotonic() + PATIENCE_S
    while server.is_starting and time.monotonic() < end_s:
        select.select([server], [], [], 1.0)
        server.look()


def _fork(server: ForkServer, words: list[str]) -> tuple[int, int, int]:
    """Fork a process; its pid, the end of its standard input to close, the end of its output to read."""
    given, begin = os.pipe()
    said, output = os.pipe()
    pid = server.fork(words, given, output)
    os.close(given)
    os.close(output)
    assert pid is not None
    return pid, begin, said


def _code(pid: int) -> int:
    return os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])


def test_a_forked_process_is_as_one_that_was_started(server: ForkServer) -> None:
    _await(server)
    assert server.failure == ""
    pid, begin, said = _fork(server, _TOY)
    with open(said, "rb") as output:
        assert output.readline() == b"one of 4 words\n"
        process = psutil.Process(pid)
        assert [word for word in process.cmdline() if word] == [sys.executable, "-P", "-m", *_TOY]
        assert (process.ppid(), os.getpgid(pid)) == (os.getpid(), pid)
        assert process.environ()["OPENBLAS_NUM_THREADS"] == "1"
        os.close(begin)
        # by its standard error, which is the same
        assert output.read() == b"begins\n"
    assert _code(pid) == 7


def test_each_has_its_own_libraries_from_one_start(server: ForkServer) -> None:
    _await(server)
    found = [_fork(server, _TOY) for _ in range(2)]
    for pid, begin, said in found:
        shared = psutil.Process(pid).memory_full_info()
        # most of its memory is that of the server and of the other
        assert shared.pss < 0.6 * shared.rss
        os.kill(pid, signal.SIGKILL)
        assert _code(pid) == -signal.SIGKILL
        os.close(begin)
        os.close(said)


def test_without_a_server_nothing_is_forked(server: ForkServer) -> None:
    assert server.fork(_TOY, 0, 1) is None
    _await(server)
    os.kill(server._pid or 0, signal.SIGSTOP)
    # a killed one is noticed with the next request, which is then answered otherwise
    os.kill(server._pid or 0, signal.SIGKILL)
    assert server.fork(_TOY, 0, 1) is None
    assert server.failure != ""
    assert server.fork(_TOY, 0, 1) is None


def test_a_library_with_threads_of_its_own_is_refused(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(fork_server, "load_libraries", lambda: None)
    monkeypatch.setattr("nodes.node.die_with_parent", lambda _: None)
    monkeypatch.setattr(fork_server, "threads", lambda: 2)
    assert fork_server.main(["--die-with", str(os.getppid())]) == 1
    assert "got 2" in capsys.readouterr().err


def test_it_ends_without_a_word_where_its_parent_has_closed_the_channel() -> None:
    """As where a command is interrupted while the server that it started early is still loading."""
    channel, other = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    channel.close()
    command = [sys.executable, "-m", "nodes.process.fork_server", "--die-with", str(os.getpid())]
    with other:
        done = subprocess.run(command, stdin=other, capture_output=True, text=True, timeout=PATIENCE_S, check=False)
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")
