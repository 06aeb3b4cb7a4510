"""What plain peers say to a link that only talks CURVE: the old protocols, the open mechanisms, and no protocol at all.

Every script does what would be enough on an open socket: it subscribes to all topics and sends `MESSAGE` again and
again. Each serves in both roles, as client of who binds and as server of who connects.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np

from benchmarks.transport.net import (
    COMMAND,
    LONG,
    SIGNATURE,
    Script,
    Talk,
    command,
    frame,
    frames,
    frames_v1,
    greeting,
    ready,
)
from msgs.bus.codec import encode
from msgs.bus.interface import Envelope
from msgs.values.vehicle import VehicleState

#: The mark of what must never arrive.
INJECTED = "injected"
TOPIC = "vehicle/state"
#: How long a script hears and repeats itself.
STAY_S = 0.25
_REPEATS = 5
_GREETING_BYTES = 64


def injected(publisher: str = "intruder", sequence: int = 0, sent_ns: int = 1, stamp_ns: int = 1) -> list[bytes]:
    """Frames of a well-made message that says that it was injected."""
    envelope = Envelope(publisher=publisher, topic=TOPIC, sequence=sequence, sent_ns=sent_ns)
    return [bytes(part) for part in encode(envelope, VehicleState(stamp_ns=stamp_ns, speed_mps=66.6, reason=INJECTED))]


MESSAGE = injected()


def _stay(talk: Talk, data: bytes, stay_s: float = STAY_S) -> None:
    for _ in range(_REPEATS):
        talk.say(data)
        talk.listen(stay_s / _REPEATS)


def v1(talk: Talk) -> None:
    """ZMTP 1.0: an empty identity instead of a greeting, then messages."""
    talk.say(frames_v1([b""]) + frames_v1([b"\x01"]))
    talk.listen(0.02)
    _stay(talk, frames_v1(MESSAGE))


def v2(talk: Talk) -> None:
    """ZMTP 2.0: a greeting with a socket type (publishers say XPUB, 9), then messages."""
    talk.say(SIGNATURE + bytes([1, 9]) + frame(b"") + frame(b"\x01"))
    talk.listen(0.02)
    _stay(talk, frames(MESSAGE))


def _null(socket_type: str, minor: int = 0) -> Script:
    def script(talk: Talk) -> None:
        talk.say(greeting("NULL", minor))
        talk.listen(0.05, until_bytes=_GREETING_BYTES)
        subscribe = command("SUBSCRIBE") if minor else frame(b"\x01")
        talk.say(ready(socket_type) + (subscribe if socket_type == "SUB" else b""))
        talk.listen(0.02)
        _stay(talk, frames(MESSAGE))

    return script


def plain(talk: Talk) -> None:
    """PLAIN with a user and a password, as client."""
    talk.say(greeting("PLAIN"))
    talk.listen(0.05, until_bytes=_GREETING_BYTES)
    talk.say(command("HELLO", b"\x04root\x04root"))
    talk.listen(0.05)
    talk.say(command("INITIATE", ready("SUB")[8:]) + frame(b"\x01"))
    _stay(talk, frames(MESSAGE))


def _curve(talk: Talk, as_server: bool = False) -> None:
    talk.say(greeting("CURVE", as_server=as_server))
    talk.listen(0.05, until_bytes=_GREETING_BYTES)


def curve_skipped(talk: Talk) -> None:
    """The greeting of CURVE, and messages as if the handshake were over."""
    _curve(talk)
    talk.say(ready("SUB") + frame(b"\x01"))
    _stay(talk, frames(MESSAGE))


def curve_claims_server(talk: Talk) -> None:
    """The greeting of a CURVE server, whoever the other side is, and its READY."""
    _curve(talk, as_server=True)
    talk.say(command("WELCOME", bytes(160)) + command("READY", bytes(30)))
    _stay(talk, frames(MESSAGE))


def _curve_hello(body: Callable[[np.random.Generator], bytes], rng: np.random.Generator) -> Script:
    def script(talk: Talk) -> None:
        _curve(talk)
        talk.say(command("HELLO", body(rng)))
        talk.listen(0.05)
        talk.say(command("INITIATE", rng.bytes(257 + int(rng.integers(0, 200)))))
        _stay(talk, command("MESSAGE", rng.bytes(8 + 16 + 40)))

    return script


def _hello(rng: np.random.Generator) -> bytes:
    """The right size, version and padding; key, nonce and box are noise."""
    return bytes([1, 0]) + bytes(72) + rng.bytes(32 + 8 + 80)


def _huge(prefix: bytes) -> Script:
    """Frames that announce 2^63-1 bytes, and start to send them."""

    def script(talk: Talk) -> None:
        talk.say(prefix + b"\x7f" + b"\xff" * 7)
        _stay(talk, bytes(1 << 16))

    return script


def _noise(rng: np.random.Generator, prefix: bytes = b"") -> Script:
    return lambda talk: _stay(talk, prefix + rng.bytes(2000))


def _version_9(talk: Talk) -> None:
    talk.say(SIGNATURE + bytes([9, 0]) + greeting("CURVE")[12:])
    talk.listen(0.05)
    talk.say(ready("SUB") + frame(b"\x01"))
    _stay(talk, frames(MESSAGE))


def _unknown_mechanism(talk: Talk) -> None:
    talk.say(greeting("NONE"))
    talk.listen(0.05)
    talk.say(ready("SUB") + frame(b"\x01"))
    _stay(talk, frames(MESSAGE))


def scripts(seed: int) -> Iterator[tuple[str, Script]]:
    """All scripts by name."""
    rng = np.random.default_rng(seed)
    curve = greeting("CURVE")
    yield "ZMTP 1.0, frames without handshake", v1
    yield "ZMTP 2.0 greeting", v2
    yield "ZMTP 3.0 NULL", _null("SUB")
    yield "ZMTP 3.1 NULL", _null("SUB", minor=1)
    yield "ZMTP 3.0 PLAIN", plain
    yield "unknown mechanism", _unknown_mechanism
    yield "ZMTP version 9", _version_9
    yield "CURVE greeting, handshake skipped", curve_skipped
    yield "CURVE greeting of the other role", curve_claims_server
    yield "CURVE hello of noise", _curve_hello(_hello, rng)
    yield "CURVE hello of a wrong size", _curve_hello(lambda rng: rng.bytes(int(rng.integers(0, 400))), rng)
    yield "frame of 2^63 bytes, ZMTP 1.0", _huge(frames_v1([b""]) + b"\xff")
    yield "command of 2^63 bytes in CURVE", _huge(curve + bytes([COMMAND | LONG]))
    yield "noise instead of a greeting", _noise(rng)
    yield "noise behind a CURVE greeting", _noise(rng, curve)
