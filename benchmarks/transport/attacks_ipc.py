"""Attacks on the bus of one host: another user at the graph's directory, and a rogue of the same user inside it.

Another user must be kept out by the file system. Who has our user id is inside the trust boundary: what is malformed
is counted and refused, a name in use is refused, a well-made message of its own is taken.
"""

from __future__ import annotations

import contextlib
import os
import socket
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import zmq

from benchmarks.transport.net import Row
from benchmarks.transport.raw_peers import INJECTED, TOPIC, injected
from msgs.bus.zmq import ZmqBus, socket_path
from msgs.values.vehicle import VehicleState

#: The intruder, and a user who is neither it nor root.
NOBODY, SOMEBODY = 65534, 12345
PATIENCE_S = 20.0
_NOT_ROOT = "not tried: needs root"


def rows(tries: int) -> Iterator[Row]:
    """All attacks on the bus of one host."""
    with Bus() as bus:
        for name, attempt in _intrusions(bus.run_dir).items():
            yield _row(f"another user: {name}", bus, _as_user_row(NOBODY, attempt, tries))
        for name, trap, victim in _TRAPS:
            yield _row(f"another user, first at the meeting place: {name}", bus, _trap_row(trap, victim, tries))
        yield _row("same user: publisher of garbage", bus, _garbage(bus, tries))
        yield _row("same user: a node's name taken twice", bus, _same_name(bus, tries))
        yield _row("same user: well-made message (trust boundary)", bus, _rogue(bus, tries), by_design=True)


class Bus:
    """A publisher and a subscriber in a directory of their own."""

    def __enter__(self) -> Bus:
        self._stack = contextlib.ExitStack()
        # as the default place: a folder of ours below one that everybody may write to
        self.run_dir = Path(self._stack.enter_context(tempfile.TemporaryDirectory(prefix="mw"))) / "graph"
        self._publisher = ZmqBus("player", self.run_dir)
        self._stack.callback(self._publisher.close)
        self.subscriber = ZmqBus("geometry", self.run_dir)
        self._stack.callback(self.subscriber.close)
        self._publisher.advertise(TOPIC)
        self.subscriber.subscribe(TOPIC)
        #: Messages that came, by publisher.
        self.heard: dict[str, int] = {}
        self.run_dir.parent.chmod(0o755)
        assert self.serves()
        return self

    def __exit__(self, *details: object) -> None:
        self._stack.close()

    def rejected(self) -> int:
        return self.subscriber.counts()[0][0].rejected

    def listen(self, until: Callable[[], bool]) -> bool:
        """Publish and receive until something holds, or patience ends."""
        end_s = time.monotonic() + PATIENCE_S
        while not (held := until()) and time.monotonic() < end_s:
            self._publisher.publish(TOPIC, VehicleState(stamp_ns=self._publisher.now_ns(), speed_mps=1.0))
            for received in self.subscriber.receive(0.02):
                name = received.envelope.publisher
                self.heard[name] = self.heard.get(name, 0) + 1
        return held

    def serves(self) -> bool:
        """Whether messages published from now on arrive."""
        known = self.heard.get("player", 0)
        return self.listen(lambda: self.heard.get("player", 0) >= known + 3)


def _row(name: str, bus: Bus, outcome: tuple[int, int, str], by_design: bool = False) -> Row:
    tried, accepted, said = outcome
    return Row("bus", name, tried, accepted, said, bus.serves(), by_design)


def _intrusions(run_dir: Path) -> dict[str, Callable[[], object]]:
    path = socket_path(run_dir, TOPIC, "player")
    return {
        "lists the directory": lambda: os.listdir(run_dir),
        "connects to a socket in it": lambda: _connect(path),
        "binds a socket in it": lambda: _bind(socket_path(run_dir, TOPIC, "intruder")),
        "deletes a socket": path.unlink,
        "replaces a socket": lambda: os.rename(_scratch_file(), path),
        "opens the directory for all": lambda: run_dir.chmod(0o777),
        "moves the directory away": lambda: run_dir.rename(run_dir.with_name("elsewhere")),
    }


def _connect(path: Path) -> None:
    with socket.socket(socket.AF_UNIX) as intruder:
        intruder.connect(str(path))


def _bind(path: Path) -> None:
    with socket.socket(socket.AF_UNIX) as intruder:
        intruder.bind(str(path))


def _scratch_file() -> str:
    descriptor, path = tempfile.mkstemp()
    os.close(descriptor)
    return path


def as_user(uid: int, action: Callable[[], object]) -> str:
    """Do something as another user, in a process of its own; empty if it worked, else what stopped it."""
    read, write = os.pipe()
    if (pid := os.fork()) == 0:
        said = "died"
        try:
            os.setgroups([])
            os.setgid(uid)
            os.setuid(uid)
            action()
            said = ""
        except BaseException as error:  # noqa: BLE001 - whatever it is, the other process is told
            said = f"{type(error).__name__}: {error}"
        finally:
            os.write(write, said.encode()[:4000])
            os._exit(0)
    os.close(write)
    with open(read, "rb") as pipe:
        said = pipe.read().decode()
    os.waitpid(pid, 0)
    return said


def _as_user_row(uid: int, attempt: Callable[[], object], tries: int) -> tuple[int, int, str]:
    if os.geteuid() != 0:
        return 0, 0, _NOT_ROOT
    answers = [as_user(uid, attempt) for _ in range(tries)]
    return tries, answers.count(""), answers[0].split(":")[0] or "let it"


def _own_folder(place: Path) -> None:
    place.mkdir()
    place.chmod(0o777)


def _own_graph(place: Path) -> None:
    _own_folder(place)
    _own_folder(place / "graph")


def _link_folder(place: Path) -> None:
    target = place.with_name("theirs")
    _own_folder(target)
    place.symlink_to(target)


#: What is made before the graph starts, and for which user's graph.
_TRAPS = (
    ("its parent", _own_folder, SOMEBODY),
    ("a link as its parent", _link_folder, SOMEBODY),
    ("itself, for a graph of root", _own_graph, 0),
)


def _trap_row(trap: Callable[[Path], None], victim: int, tries: int) -> tuple[int, int, str]:
    """The intruder makes the folder of a run directory first; whoever then meets there is in its hands."""
    if os.geteuid() != 0:
        return 0, 0, _NOT_ROOT
    answers = []
    for _ in range(tries):
        with tempfile.TemporaryDirectory(prefix="mw") as root:
            # like /tmp: everybody may write, nobody may rename what is another's
            os.chmod(root, 0o1777)
            place = Path(root) / "mirrorwave"
            assert as_user(NOBODY, lambda place=place: trap(place)) == ""
            said = as_user(victim, lambda place=place: ZmqBus("player", place / "graph").close())
            answers.append(said.rpartition(": ")[2])
    return tries, answers.count(""), answers[0] or "took its place there"


def _garbage(bus: Bus, tries: int) -> tuple[int, int, str]:
    before, name = bus.rejected(), TOPIC.encode() + b"\0"
    with _publisher(bus.run_dir, "rogue") as publisher:
        garbage = [[name], [name, b""], [name, b"\x91" * 500], [name, b"\xc1" * 64], [name[:-1] + b"\0", *[b""] * 9]]
        sent = garbage * tries
        assert bus.listen(lambda: bool(publisher.poll(0)))
        for message in sent:
            publisher.send_multipart(message)
        counted = bus.listen(lambda: bus.rejected() - before >= len(sent))
    assert counted
    return len(sent), bus.heard.get("rogue", 0), f"{bus.rejected() - before} counted as rejected"


def _same_name(bus: Bus, tries: int) -> tuple[int, int, str]:
    refused = []
    for _ in range(tries):
        twin = ZmqBus("player", bus.run_dir)
        try:
            twin.advertise(TOPIC)
        except ValueError as error:
            refused.append(str(error).partition(": ")[2])
        finally:
            twin.close()
    return tries, tries - len(refused), f"refused: {refused[0]}" if refused else "let it"


def _rogue(bus: Bus, tries: int) -> tuple[int, int, str]:
    with _publisher(bus.run_dir, INJECTED) as publisher:
        assert bus.listen(lambda: bool(publisher.poll(0)))
        for sequence in range(tries):
            sent_ns = time.monotonic_ns()
            publisher.send_multipart(injected(INJECTED, sequence, sent_ns, sent_ns))
        bus.listen(lambda: bus.heard.get(INJECTED, 0) >= tries)
    return tries, bus.heard.get(INJECTED, 0), "taken under its own name"


@contextlib.contextmanager
def _publisher(run_dir: Path, name: str) -> Iterator[zmq.Socket[bytes]]:
    """A socket in the directory that can be read as soon as a bus has subscribed to it."""
    context = zmq.Context()
    publisher = context.socket(zmq.XPUB)
    publisher.bind(f"ipc://{socket_path(run_dir, TOPIC, name)}")
    try:
        yield publisher
    finally:
        context.destroy(linger=0)
