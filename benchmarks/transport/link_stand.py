"""A link to be attacked: an exporting and an importing node as real processes, a proxy between them, a good stream."""

from __future__ import annotations

import contextlib
import json
import os
import re
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import psutil
import zmq

from benchmarks.transport.net import HOST, Proxy
from benchmarks.transport.raw_peers import INJECTED, TOPIC, injected
from contrib.two_machines import keys as curve_keys
from msgs.bus.codec import encode, topic_frame
from msgs.bus.interface import Envelope, Received
from msgs.bus.topics import TOPICS
from msgs.bus.zmq import ZmqBus
from msgs.files.shipped import CHECKOUT
from msgs.values.diagnostics import LogRecord, NodeStatus
from msgs.values.vehicle import VehicleState

ROOT = CHECKOUT
PATIENCE_S = 60.0
PERIOD_S = 0.02
PEER, PLAYER = "sensor", "player"
SIDES = ("sensor", "compute")
_DIAGNOSTICS = "diagnostics/node"
#: An exporter has counted who did not get through the handshake.
STRANGER_S = 3.0
_NUMBER = re.compile(r"\d+")


class Keys(NamedTuple):
    """A key pair of CURVE."""

    public: bytes
    secret: bytes

    @classmethod
    def fresh(cls) -> Keys:
        return cls(*zmq.curve_keypair())

    @classmethod
    def of(cls, path: Path) -> Keys:
        pair = curve_keys.load_own(path)
        return cls(pair.public, pair.secret)

    def serve(self, victim: zmq.Socket[bytes]) -> None:
        """Make a socket a CURVE server of this key; who connects is not looked at."""
        victim.curve_server = True
        victim.curve_secretkey = self.secret

    def connect(self, peer: zmq.Socket[bytes], own: Keys) -> None:
        """Make a socket a client of the server that has this key."""
        peer.curve_serverkey = self.public
        peer.curve_publickey, peer.curve_secretkey = own


class Side:
    """One host: its run directory, its link node, and an observer of what comes and what is said."""

    def __init__(
        self,
        name: str,
        folder: Path,
        params: dict[str, object],
        inside: Callable[[list[str]], list[str]] = lambda command: command,
    ) -> None:
        self.run_dir = folder / name
        self.bus = ZmqBus("observer", self.run_dir)
        for topic in (_DIAGNOSTICS, "log"):
            self.bus.subscribe(topic)
        command = [sys.executable, "-P", "-m", "nodes.node", "contrib.two_machines.link", "--name", f"link_{name}"]
        command += ["--run-dir", str(self.run_dir), "--params", json.dumps(params), "--die-with", str(os.getpid())]
        self._said_to = (folder / f"{name}.log").open("w+")
        environment = {**os.environ, "PYTHONPATH": str(ROOT), "OPENBLAS_NUM_THREADS": "1"}
        self._process = subprocess.Popen(inside(command), env=environment, stderr=self._said_to)
        #: Of a command that `inside` did not put another process around.
        self.process = psutil.Process(self._process.pid)
        self.status: NodeStatus | None = None
        self.said: list[str] = []
        self.counted_before: Counter[str] = Counter()

    @property
    def is_running(self) -> bool:
        return self._process.poll() is None

    def last_words(self) -> str:
        """Exit code of a process that has ended, and the end of what it wrote."""
        self._said_to.seek(0)
        return f"exit code {self._process.poll()}: {self._said_to.read()[-2000:]}"

    def counted(self) -> Counter[str]:
        """What the last heartbeat counts."""
        return Counter({f"{item.what} {item.reason}": item.count for item in (self.status.shed if self.status else ())})

    def receive(self, timeout_s: float) -> list[Received]:
        received = self.bus.receive(timeout_s)
        for item in received:
            # heartbeats and lines of the other host come under the peer's name
            if isinstance(item.message, NodeStatus) and item.message.pid == self.process.pid:
                self.status = item.message
            elif isinstance(item.message, LogRecord) and item.message.node.startswith("link"):
                self.said.append(item.message.text)
        return received

    def close(self) -> None:
        self._process.send_signal(signal.SIGINT)
        try:
            self._process.wait(10.0)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        self._said_to.close()
        self.bus.close()


class Stand:
    """The good peer imports `TOPIC` through `proxy`; what arrives there is judged.

    `open_files`: descriptors that the exporting process may have.
    """

    def __init__(self, open_files: int = 1024) -> None:
        self._open_files = open_files
        self.sides: dict[str, Side] = {}
        #: Messages that arrived though nobody of the exporting host sent them, that came changed, and that came again.
        self.injected = self.altered = self.stale = 0
        self._count = self._newest = 0
        self._next_s = 0.0

    def __enter__(self) -> Stand:
        with contextlib.ExitStack() as stack:
            self._folder = folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="mw")))
            self._make_keys(folder)
            self.port = free_port()
            self.proxy = Proxy(self.port)
            stack.callback(self.proxy.close)
            for victim, name, params in (
                ("export", "a", self._export_params()),
                ("import", "b", self._import_params()),
            ):
                self.sides[victim] = Side(name, folder, params)
                stack.callback(self.sides[victim].close)
            # long before the node has come so far that it asks
            self.sides["export"].process.rlimit(psutil.RLIMIT_NOFILE, (self._open_files, self._open_files))
            self._player = ZmqBus(PLAYER, self.sides["export"].run_dir)
            stack.callback(self._player.close)
            self.sides["import"].bus.subscribe(TOPIC)
            if not self.serves():
                raise TimeoutError(f"the link does not work: {[side.said for side in self.sides.values()]}")
            self._stack = stack.pop_all()
        return self

    def __exit__(self, *details: object) -> None:
        ended = {name: side.last_words() for name, side in self.sides.items() if not side.is_running}
        self._stack.close()
        if ended:
            raise RuntimeError(f"no attack may end a link: {ended}")

    def _make_keys(self, folder: Path) -> None:
        """Keys of both ends and of two more peers that are on the list."""
        made = {name: curve_keys.generate(name, folder / name) for name in (PEER, "compute", "evil", "greedy")}
        self.server, self.good, self.evil, self.greedy = (Keys.of(secret) for _, secret in made.values())
        (folder / "allowed").mkdir(mode=0o700)
        for name in ("compute", "evil", "greedy"):
            (folder / "allowed" / f"{name}.key").write_bytes(made[name][0].read_bytes())

    def _export_params(self) -> dict[str, object]:
        own = {"key": str(self._folder / PEER / f"{PEER}.key_secret"), "allowed": str(self._folder / "allowed")}
        return {**own, "bind": f"tcp://{HOST}:{self.port}", "export": [TOPIC]}

    def _import_params(self) -> dict[str, object]:
        key = str(self._folder / PEER / f"{PEER}.key")
        peer = {"address": f"tcp://{HOST}:{self.proxy.port}", "key": key, "topics": [TOPIC]}
        return {"key": str(self._folder / "compute" / "compute.key_secret"), "connect": {PEER: peer}}

    def turn(self, duration_s: float) -> None:
        """Let the good stream go on for so long; at least one look at what came."""
        end_s = time.monotonic() + duration_s
        while True:
            self._publish_if_due()
            for side in self.sides.values():
                for received in side.receive(0.002):
                    if side is self.sides["import"] and received.topic == TOPIC:
                        self._judge(received)
            if time.monotonic() >= end_s:
                return

    def wait(self, done: Callable[[], bool], otherwise: str) -> None:
        """Let the good stream go on until `done`; `TimeoutError` with `otherwise` if that does not come."""
        end_s = time.monotonic() + PATIENCE_S
        while not done():
            if time.monotonic() > end_s:
                raise TimeoutError(otherwise)
            self.turn(0.0)

    def serves(self) -> bool:
        """Whether both processes run, and messages published from now on arrive."""
        start = self._count
        with contextlib.suppress(TimeoutError):
            self.wait(lambda: self._newest > start + 3, "the good peer is not served")
        return self._newest > start + 3 and all(side.is_running for side in self.sides.values())

    def note(self) -> None:
        """Begin to note what the link says and counts."""
        for side in self.sides.values():
            side.said.clear()
            side.counted_before = side.counted()

    def said(self, victim: str) -> str:
        """What the link of a side counted and said since; of texts that differ in numbers alone the last."""
        side = self.sides[victim]
        # strangers are counted when their time is up
        self.turn(STRANGER_S if victim == "export" else 0.0)
        newer_ns = time.monotonic_ns()
        self.wait(lambda: side.status is not None and side.status.stamp_ns > newer_ns, f"{victim}: no heartbeat")
        grown = side.counted() - side.counted_before
        by_form = {_NUMBER.sub("n", text): text for text in side.said}
        return "; ".join([*(f"{count} {what}" for what, count in grown.items()), *by_form.values()])

    def resident(self, victim: str) -> int:
        """Memory of a side's link in bytes."""
        return self.sides[victim].process.memory_info().rss

    def descriptors(self, victim: str) -> int:
        """Open file descriptors of a side's link."""
        return self.sides[victim].process.num_fds()

    def lies(self, tries: int) -> dict[str, list[list[bytes]]]:
        """What somebody with the exporter's secret key may say that must not be believed."""
        now_ns = time.monotonic_ns()
        name = topic_frame(TOPIC)
        log = Envelope(publisher=PLAYER, topic="log", sequence=0, sent_ns=now_ns)
        text = LogRecord(stamp_ns=now_ns, node=PLAYER, level="error", text=INJECTED)
        garbage = [[name], [name, b""], [name, b"\x91" * 500], [name, b"\xc1" * 64], [b"", b""], [name + b"x", b""]]
        return {
            "topics that are not imported": [[bytes(part) for part in encode(log, text)]] * tries,
            "malformed bodies": garbage * tries,
            "a message over the limit": [[name, bytes(TOPICS[TOPIC].max_bytes + 1)]] * tries,
            "a publisher with a dot in its name": [injected("compute.geometry", 0, now_ns)] * tries,
            "sequence 2^60": [injected(PLAYER, 1 << 60, now_ns)] * tries,
            "sent in the future": [injected(PLAYER, 1, now_ns + 10**15)] * tries,
        }

    def _publish_if_due(self) -> None:
        if time.monotonic() < self._next_s:
            return
        self._next_s = time.monotonic() + PERIOD_S
        self._count += 1
        now_ns = self._player.now_ns()
        state = VehicleState(stamp_ns=now_ns, age_s=float(self._count), reason=str(self._count))
        self._player.publish(TOPIC, state)

    def _judge(self, received: Received) -> None:
        state = received.message
        assert isinstance(state, VehicleState)
        if state.reason == INJECTED:
            self.injected += 1
        elif state.reason != f"{state.age_s:.0f}" or not 1 <= state.age_s <= self._count:
            self.altered += 1
        elif state.age_s <= self._newest:
            self.stale += 1
        else:
            self._newest = int(state.age_s)


def free_port() -> int:
    """A port of this machine that nobody uses now."""
    with socket.create_server((HOST, 0)) as server:
        return int(server.getsockname()[1])


def make_keys(folder: Path) -> None:
    """Keys of both hosts, each on the other's list."""
    for side, other in (SIDES, SIDES[::-1]):
        public, _ = curve_keys.generate(side, folder / side)
        allowed = folder / f"of_{other}"
        allowed.mkdir(mode=0o700)
        shutil.copy(public, allowed)
