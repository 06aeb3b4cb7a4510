"""The fork server that starts before the command line is read."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from mirrorwave import early_start
from nodes.process import fork_server, kernel_cache


class Server:
    """Stands for a fork server."""


@pytest.fixture(autouse=True)
def servers(monkeypatch: pytest.MonkeyPatch) -> Iterator[list[Server]]:
    made: list[Server] = []

    def make() -> Server:
        made.append(Server())
        return made[-1]

    monkeypatch.setattr(fork_server, "ForkServer", make)
    monkeypatch.setattr(kernel_cache, "use_fallback", lambda: None)
    yield made
    early_start.take()


@pytest.mark.parametrize("words", [["launch", "launch/corner.yaml"], ["demo"]])
def test_a_graph_has_its_server_early_and_once(servers: list[Server], words: list[str]) -> None:
    early_start.begin(words)
    assert [early_start.take()] == servers
    assert early_start.take() is None


@pytest.mark.parametrize("words", [[], ["sim", "run"], ["launch", "--help"], ["--version"], ["process", "launch"]])
def test_nothing_else_starts_one(servers: list[Server], words: list[str]) -> None:
    early_start.begin(words)
    assert servers == []
    assert early_start.take() is None


def test_what_a_shell_completes_starts_none(servers: list[Server], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("_MIRRORWAVE_COMPLETE", "complete_bash")
    early_start.begin(["launch"])
    assert servers == []


@pytest.mark.parametrize("error", [OSError("no process is left"), ValueError("kernels: the folder is another's")])
def test_what_fails_early_is_left_to_the_verb(error: Exception, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail() -> None:
        raise error

    monkeypatch.setattr(kernel_cache, "use_fallback", fail)
    early_start.begin(["launch", "launch/corner.yaml"])
    assert early_start.take() is None
