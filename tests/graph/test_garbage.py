"""Garbage on every topic of the running graph: counted as rejected, nothing ends, views go on."""

from __future__ import annotations

import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import zmq

from msgs.diagnostics import NodeStatus
from msgs.perception import BevFrame
from msgs.topics import TOPICS
from msgs.zmq_bus import ZmqBus, socket_path

DOMAIN = "garbage"
PATIENCE_S = 60.0
#: Of the messages of `garbage`, before one that is over the limit cuts the sender off for good.
FEWEST = 4
#: Topics that nodes of the spine subscribe to, and a node that does.
SUBSCRIBED = {
    "radar/beam": "ra_former",
    "vehicle/state": "ra_former",
    "radar/setup": "ra_former",
    "radar/ra_map": "dense_predictor",
    "perception/peaks": "geometry",
}


@pytest.fixture
def graph(monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """The corner graph at the real rate with short beams; yields its run dir."""
    with tempfile.TemporaryDirectory(prefix="mw") as root:
        monkeypatch.setenv("MIRRORWAVE_RUN_DIR", root)
        command = [sys.executable, "-m", "mirrorwave", "launch", "launch/corner.yaml", "--domain", DOMAIN]
        command += ["--runs-dir", f"{root}/runs", "-p", "player.chirps_per_beam=4"]
        process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        try:
            yield Path(root) / DOMAIN
        finally:
            process.send_signal(signal.SIGINT)
            assert process.wait(PATIENCE_S) == 0


def garbage(topic: str, rng: np.random.Generator) -> list[list[bytes]]:
    """Random, truncated, oversize and nested messages under the right topic, and none at all."""
    name = topic.encode() + b"\0"
    return [
        [name],
        [name, b""],
        [name, rng.bytes(300)],
        [name, b"\x82\xa8envelope"],
        [name, b"\x91" * 5000],
        [name, rng.bytes(100), rng.bytes(1000), b""],
        [name, rng.bytes(TOPICS[topic].max_bytes + 1)],
        [name[:-1] + b"x\0", rng.bytes(50)],
    ]


def listen(bus: ZmqBus, status: dict[str, NodeStatus], done) -> int:  # type: ignore[no-untyped-def]
    """Take in heartbeats and views until `done()`; number of views."""
    views, end_s = 0, time.monotonic() + PATIENCE_S
    while not done() and time.monotonic() < end_s:
        for received in bus.receive(0.1):
            if isinstance(received.message, NodeStatus):
                status[received.message.node] = received.message
            views += isinstance(received.message, BevFrame)
    return views


def rejected(status: dict[str, NodeStatus], topic: str) -> int:
    node = status.get(SUBSCRIBED[topic])
    return sum(count.rejected for count in node.received if count.topic == topic) if node else 0


@pytest.mark.graph
def test_garbage_on_every_topic_is_counted_and_survived(graph: Path) -> None:
    bus, context, status = ZmqBus("observer", graph), zmq.Context(), {}
    for topic in ("perception/hidden_objects", "diagnostics/node"):
        bus.subscribe(topic)
    try:
        nodes = {"player", "ra_former", "dense_predictor", "geometry"}
        listen(bus, status, lambda: nodes <= {name for name, node in status.items() if node.state == "ready"})
        pids = {name: status[name].pid for name in nodes}
        evil = {topic: context.socket(zmq.PUB) for topic in SUBSCRIBED}
        for topic, publisher in evil.items():
            publisher.setsockopt(zmq.LINGER, 0)
            publisher.bind(f"ipc://{socket_path(graph, topic, 'evil')}")
        rng = np.random.default_rng(0)
        start_s = time.monotonic()

        def everybody_refused_some() -> bool:
            if time.monotonic() - start_s > 1.0:
                for topic, publisher in evil.items():
                    for frames in garbage(topic, rng):
                        publisher.send_multipart(frames)
            return all(rejected(status, topic) >= FEWEST for topic in SUBSCRIBED)

        listen(bus, status, everybody_refused_some)
        assert all(rejected(status, topic) >= FEWEST for topic in SUBSCRIBED), {
            t: rejected(status, t) for t in SUBSCRIBED
        }
        seen = 0
        end_s = time.monotonic() + 2.0
        seen = listen(bus, status, lambda: time.monotonic() > end_s)
        assert seen >= 3
        assert {name: status[name].pid for name in nodes} == pids
    finally:
        context.destroy(linger=0)
        bus.close()
