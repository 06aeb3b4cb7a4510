"""`mirrorwave param` on a node that runs in a thread: what changes, what is refused, and by which line."""

from __future__ import annotations

import json
import tempfile
import threading
from collections.abc import Iterator
from typing import Any

import msgspec
import pytest

from mirrorwave.cli import main
from mirrorwave.control.node_params import change_params, current_params, parse_changes
from msgs.bus.interface import Outgoing, Received
from msgs.bus.zmq import ZmqBus, run_dir
from nodes.node import Heartbeat, Node, Stop, run_loop
from nodes.process.param_server import ParamServer


class Gain(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    level: float = 1.0
    limit: float = float("inf")

    def __post_init__(self) -> None:
        if not self.level > 0.0:
            raise ValueError(f"gain.level must be above zero, got {self.level!r}")


class Params(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    gain: Gain = Gain()
    name: str = "a"
    fixed: int = 1


class Adjustable(Node):
    """Takes other parameters, but for `fixed`."""

    outputs = ("vehicle/state",)

    def __init__(self) -> None:
        super().__init__()
        self.params = Params()

    def step(self, inputs: list[Received], now_ns: int) -> list[Outgoing]:
        assert not inputs
        return []

    def change_params(self, params: Params) -> None:
        if params.fixed != self.params.fixed:
            raise ValueError("fixed: is fixed")
        self.params = params


@pytest.fixture
def node(monkeypatch: pytest.MonkeyPatch) -> Iterator[Adjustable]:
    with tempfile.TemporaryDirectory(prefix="mw") as folder:
        monkeypatch.setenv("MIRRORWAVE_RUN_DIR", folder)
        hosted, stop, ready = Adjustable(), Stop(), threading.Event()

        def host() -> None:
            bus = ZmqBus("amplifier", run_dir("default"))
            server = ParamServer(bus, "amplifier", hosted.params, hosted.change_params)
            ready.set()
            run_loop(hosted, bus, stop, Heartbeat(bus, "amplifier"), server)
            bus.close()

        thread = threading.Thread(target=host)
        thread.start()
        ready.wait()
        yield hosted
        stop.request(at_once=True)
        thread.join()


def test_what_is_set_is_what_is_read(node: Adjustable, capsys: pytest.CaptureFixture[str]) -> None:
    assert json.loads(current_params("default", "amplifier")["amplifier"].params)["gain"]["level"] == 1.0
    assert main(["param", "set", "amplifier", "gain.level=2.5", "name=b"]) == 0
    assert capsys.readouterr().out == "amplifier: gain.level = 2.5, name = b\n"
    # what is not named stays, an infinite limit too
    assert node.params == Params(gain=Gain(level=2.5), name="b")
    assert main(["param", "get", "amplifier", "gain.level"]) == 0
    assert capsys.readouterr().out == "2.5\n"
    assert main(["param", "list", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["amplifier"]["name"] == "b"


@pytest.mark.parametrize(
    ("changes", "line"),
    [
        (["gain.level=0"], "amplifier refuses: amplifier.gain: gain.level must be above zero, got 0.0"),
        (["gain.level=.nan"], "must be above zero, got nan"),
        (["gain.level=loud"], "amplifier.gain.level: Expected float, got str"),
        (["volume=1"], "unknown field volume; known are gain, name, fixed"),
        (["fixed=2", "name=b"], "amplifier refuses: fixed: is fixed"),
        (["gain"], "'gain' must be KEY=VALUE"),
        (["=1"], "'=1' must be KEY=VALUE"),
        (["name={"], "amplifier: name={: line 1"),
        ([f"name={'x' * 70_000}"], "must have at most 60000 characters"),
    ],
)
def test_what_is_refused_changes_nothing(
    node: Adjustable, capsys: pytest.CaptureFixture[str], changes: list[str], line: str
) -> None:
    assert main(["param", "set", "amplifier", *changes]) == 2
    error = capsys.readouterr().err
    assert line in error
    assert error.count("\n") == 1
    assert node.params == Params()


def test_unknown_nodes_and_parameters_are_named_with_the_known(
    node: Adjustable, capsys: pytest.CaptureFixture[str]
) -> None:
    for words in (["get", "nobody"], ["set", "nobody", "a=1"], ["list", "nobody"]):
        assert main(["param", *words]) == 2
        assert "no node 'nobody' has parameters here; known are amplifier" in capsys.readouterr().err
    assert main(["param", "get", "amplifier", "gain.volume"]) == 2
    assert "unknown parameter 'gain.volume'; known are level, limit" in capsys.readouterr().err


def test_two_that_change_at_once_are_both_answered(node: Adjustable) -> None:
    answers: dict[str, Any] = {}

    def change(level: float) -> None:
        answers[str(level)] = change_params("default", "amplifier", {"gain": {"level": level}})

    threads = [threading.Thread(target=change, args=(level,)) for level in (2.0, 3.0)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert {answer.error for answer in answers.values()} == {""}
    assert node.params.gain.level in (2.0, 3.0)


def test_changes_of_one_mapping_are_merged() -> None:
    assert parse_changes("a", ["x.y=1", "x.z=[1, 2]", "w=null"]) == {"x": {"y": 1, "z": [1, 2]}, "w": None}
