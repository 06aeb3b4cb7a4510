"""Tools of the attacks: peers on plain sockets, a proxy, namespaces joined by a wire.

The peers speak ZMTP by hand (rfc.zeromq.org 13, 15, 23, 37), so that they can also speak it wrongly. `Wire` is a cable
between two network namespaces: each frame passes through this process, which can look at it or lose it.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
import select
import socket
import struct
import subprocess
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

HOST = "127.0.0.1"
MORE, LONG, COMMAND = 1, 2, 4
#: First ten bytes of every peer since ZMTP 2.0; one of ZMTP 1.0 sends its identity instead.
SIGNATURE = b"\xff" + bytes(7) + b"\x01\x7f"
_READ_BYTES = 1 << 16
_TURN_S = 0.05


class Row(NamedTuple):
    """What became of one attack."""

    #: Whom it was for: the bus of one host, the side of a link that exports, or the one that imports.
    victim: str
    attack: str
    tried: int
    accepted: int
    #: What the victim did or said, in short.
    said: str
    #: Whether its good peer is served afterwards.
    serves: bool
    #: It succeeds, and is meant to: a control that shows that the tool is sharp, or the border of trust.
    by_design: bool = False

    @property
    def is_defeat(self) -> bool:
        return not self.serves or (self.accepted > 0 and not self.by_design)


# ---------------------------------------------------------------------------------------------------- ZMTP by hand


def frames_v1(message: Sequence[bytes]) -> bytes:
    """A message in the framing of ZMTP 1.0: length with flags, flags, body."""
    wire = b""
    for index, body in enumerate(message):
        size = len(body) + 1
        length = bytes([size]) if size < 255 else b"\xff" + struct.pack(">Q", size)
        wire += length + bytes([index < len(message) - 1]) + body
    return wire


def frame(body: bytes, flags: int = 0) -> bytes:
    """One frame of ZMTP 2.0 and later: flags, length, body."""
    if len(body) > 255:
        return bytes([flags | LONG]) + struct.pack(">Q", len(body)) + body
    return bytes([flags, len(body)]) + body


def frames(message: Sequence[bytes]) -> bytes:
    """A message in the framing of ZMTP 2.0 and later."""
    return b"".join(frame(body, MORE if index < len(message) - 1 else 0) for index, body in enumerate(message))


def command(name: str, body: bytes = b"") -> bytes:
    """A command frame of ZMTP 3."""
    return frame(bytes([len(name)]) + name.encode() + body, COMMAND)


def greeting(mechanism: str, minor: int = 0, as_server: bool = False) -> bytes:
    """The 64 bytes that open a connection of ZMTP 3."""
    return SIGNATURE + bytes([3, minor]) + mechanism.encode().ljust(20, b"\0") + bytes([as_server]) + bytes(31)


def ready(socket_type: str) -> bytes:
    """The command that ends the handshake of the mechanism NULL."""
    return command("READY", _property("Socket-Type", socket_type.encode()) + _property("Identity", b""))


def _property(name: str, value: bytes) -> bytes:
    return bytes([len(name)]) + name.encode() + struct.pack(">I", len(value)) + value


# ------------------------------------------------------------------------------------------------------- plain peers


class Talk:
    """One connection of a plain peer; a connection that the other side has closed swallows what is said."""

    def __init__(self, connection: socket.socket) -> None:
        self._socket = connection
        #: All that came so far.
        self.heard = b""
        self.is_closed = False

    def say(self, data: bytes) -> None:
        try:
            self._socket.settimeout(1.0)
            self._socket.sendall(data)
        except OSError:
            self.is_closed = True

    def listen(self, duration_s: float, until_bytes: int | None = None) -> bytes:
        """Take in what comes for so long, or until that much is there or the other side has closed."""
        end_s = time.monotonic() + duration_s
        while not self.is_closed and (left_s := end_s - time.monotonic()) > 0.0:
            if until_bytes is not None and len(self.heard) >= until_bytes:
                break
            self._socket.settimeout(left_s)
            try:
                data = self._socket.recv(_READ_BYTES)
            except TimeoutError:
                break
            except OSError:
                data = b""
            self.heard += data
            self.is_closed = not data
        return self.heard

    def reset(self) -> None:
        """Leave without a goodbye: what waits on either side is thrown away."""
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
        self._socket.close()
        self.is_closed = True

    def close(self) -> None:
        self._socket.close()


#: What a plain peer does on a connection; it serves as client and as server.
Script = Callable[[Talk], None]


@contextlib.contextmanager
def call(port: int, host: str = HOST) -> Iterator[Talk]:
    """Connect a plain peer."""
    talk = Talk(socket.create_connection((host, port), timeout=5.0))
    try:
        yield talk
    finally:
        talk.close()


@contextlib.contextmanager
def _listener(serve: Callable[[socket.socket], None]) -> Iterator[int]:
    """Accept connections on a free port, each served by a thread of its own."""
    stop = threading.Event()
    with socket.create_server((HOST, 0), backlog=128) as server:
        server.settimeout(_TURN_S)

        def accept() -> None:
            while not stop.is_set():
                with contextlib.suppress(TimeoutError):
                    threading.Thread(target=serve, args=(server.accept()[0],), daemon=True).start()

        thread = threading.Thread(target=accept, daemon=True)
        thread.start()
        try:
            yield server.getsockname()[1]
        finally:
            stop.set()
            thread.join()


# -------------------------------------------------------------------------------------------------------------- proxy


class Proxy:
    """A man in the middle: relays TCP to `upstream`, can alter, redirect and cut."""

    def __init__(self, upstream: int) -> None:
        self.upstream = upstream
        #: Connections that it has relayed.
        self.passages = 0
        #: Changes what passes: (data, is it from the server, bytes of that direction before it) -> data.
        self.alter: Callable[[bytes, bool, int], bytes] = lambda data, from_server, before: data
        self._pairs: set[tuple[socket.socket, socket.socket]] = set()
        self._stack = contextlib.ExitStack()
        self.port = self._stack.enter_context(_listener(self._serve))

    def redirect(self, upstream: int) -> None:
        """Cut what is there; who connects again comes out at `upstream`."""
        self.upstream = upstream
        self.cut()

    def cut(self) -> None:
        """Close all connections."""
        for pair in list(self._pairs):
            for end in pair:
                with contextlib.suppress(OSError):
                    end.shutdown(socket.SHUT_RDWR)

    def close(self) -> None:
        self.cut()
        self._stack.close()

    def _serve(self, client: socket.socket) -> None:
        try:
            server = socket.create_connection((HOST, self.upstream), timeout=5.0)
        except OSError:
            client.close()
            return
        pair = (client, server)
        self._pairs.add(pair)
        self.passages += 1
        try:
            self._relay(client, server)
        finally:
            self._pairs.discard(pair)
            client.close()
            server.close()

    def _relay(self, client: socket.socket, server: socket.socket) -> None:
        seen = {client: 0, server: 0}
        with contextlib.suppress(OSError):
            while True:
                for source in select.select([client, server], [], [])[0]:
                    data = source.recv(_READ_BYTES)
                    if not data:
                        return
                    from_server = source is server
                    (client if from_server else server).sendall(self.alter(data, from_server, seen[source]))
                    seen[source] += len(data)


# ------------------------------------------------------------------------------------------------ namespaces and wire


_TUNSETIFF, _IFF_TAP, _IFF_NO_PI = 0x400454CA, 0x0002, 0x1000
_TUN = "/dev/net/tun"


def why_no_namespaces() -> str:
    """Why network namespaces cannot be made here, in one line; empty if they can."""
    if os.geteuid() != 0:
        return "network namespaces need root"
    if not os.path.exists(_TUN):
        return f"network namespaces are joined through {_TUN}, which is missing"
    name = f"mwtry{os.getpid()}"
    try:
        _ip("netns", "add", name)
        _ip("netns", "delete", name)
    except FileNotFoundError:
        return "network namespaces need the command ip (iproute2)"
    except OSError as error:
        return str(error)
    return ""


def _ip(*words: str) -> None:
    try:
        subprocess.run(["ip", *words], check=True, capture_output=True, text=True)
    except subprocess.CalledProcessError as error:
        raise OSError(f"ip {' '.join(words)}: {' '.join(error.stderr.split())}") from None


@dataclass(frozen=True)
class Host:
    """One end of the wire: a network namespace with one address."""

    namespace: str
    interface: str
    address: str

    def inside(self, command: Sequence[str]) -> list[str]:
        """`command` so that it runs on this host."""
        return ["ip", "netns", "exec", self.namespace, *command]


class Wire:
    """Two hosts and the cable between them; frames pass unless `is_dead`.

    Use as a context: the namespaces are taken away at its end, however it comes. Raises `OSError` where they cannot be
    made (`why_no_namespaces`).
    """

    def __init__(self, name: str) -> None:
        # several may run at a time; names of interfaces have at most 15 characters
        name = f"{name}{os.getpid() % 1_000_000}"
        self.hosts = (Host(f"{name}a", f"{name}a0", "10.77.0.1"), Host(f"{name}b", f"{name}b0", "10.77.0.2"))
        self.is_dead = False
        #: Frames that were sent in each direction.
        self.frames = [0, 0]
        #: Words to look for in what passes, and how often each was seen.
        self.seen: dict[bytes, int] = {}
        self._stack = contextlib.ExitStack()
        self._stop = threading.Event()

    def __enter__(self) -> Wire:
        if reason := why_no_namespaces():
            raise OSError(reason)
        with contextlib.ExitStack() as stack:
            taps = [self._attach(stack, host) for host in self.hosts]
            thread = threading.Thread(target=self._relay, args=(taps,), daemon=True)
            thread.start()
            stack.callback(thread.join)
            stack.callback(self._stop.set)
            self._stack = stack.pop_all()
        return self

    def __exit__(self, *details: object) -> None:
        self._stack.close()

    def _attach(self, stack: contextlib.ExitStack, host: Host) -> int:
        """Make a host; the frames it sends are read from the file descriptor that comes back."""
        _ip("netns", "add", host.namespace)
        stack.callback(_ip, "netns", "delete", host.namespace)
        tap = os.open(_TUN, os.O_RDWR | os.O_NONBLOCK)
        stack.callback(os.close, tap)
        fcntl.ioctl(tap, _TUNSETIFF, struct.pack("16sH22x", host.interface.encode(), _IFF_TAP | _IFF_NO_PI))
        _ip("link", "set", host.interface, "netns", host.namespace)
        _ip("-n", host.namespace, "address", "add", f"{host.address}/24", "dev", host.interface)
        for interface in ("lo", host.interface):
            _ip("-n", host.namespace, "link", "set", interface, "up")
        return tap

    def _relay(self, taps: list[int]) -> None:
        while not self._stop.is_set():
            for tap in select.select(taps, [], [], _TURN_S)[0]:
                end = taps.index(tap)
                for data in _read_all(tap):
                    self.frames[end] += 1
                    for word in self.seen:
                        self.seen[word] += word in data
                    if not self.is_dead:
                        # an interface that is down, or full: the frame is lost, as on any cable
                        with contextlib.suppress(OSError):
                            os.write(taps[1 - end], data)


def _read_all(tap: int) -> Iterator[bytes]:
    """Frames that wait in a tap."""
    with contextlib.suppress(OSError):
        while True:
            yield os.read(tap, _READ_BYTES)
