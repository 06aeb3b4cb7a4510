"""Messages of a peer as those of this host, at a clock that is set by hand."""

from __future__ import annotations

from contrib.two_machines.peer_clock import ClockSample, PeerClock
from contrib.two_machines.peer_messages import MAX_ORIGINS, PeerMessages
from msgs.bus.codec import encode
from msgs.bus.interface import Envelope
from msgs.values.vehicle import VehicleState

TOPIC = "vehicle/state"
S = 1_000_000_000
AHEAD_NS = 1000 * S


def clock() -> PeerClock:
    known = PeerClock()
    known.add(ClockSample(0, AHEAD_NS, 2))
    return known


def taken(messages: PeerMessages, origin: str, now_ns: int, sequence: int = 0) -> str:
    """Name under which a message comes that its origin sent just now; empty where it does not."""
    envelope = Envelope(publisher=origin, topic=TOPIC, sequence=sequence, sent_ns=now_ns + AHEAD_NS)
    came = messages.take(TOPIC, encode(envelope, VehicleState(stamp_ns=envelope.sent_ns)), clock(), now_ns)
    return came.envelope.publisher if came else ""


def test_nodes_of_a_peer_come_and_go_over_days() -> None:
    """As many as may speak at once are heard, one more is refused; once they are silent others have their places."""
    messages = PeerMessages("sensor", [TOPIC])
    for number in range(MAX_ORIGINS):
        assert taken(messages, f"n{number}", S) == f"sensor.n{number}"
    assert not taken(messages, "more", 2 * S)
    assert messages.rejected == 1
    for day in range(1, 100):
        assert taken(messages, f"of_day_{day}", 86_400 * S * day) == f"sensor.of_day_{day}"
    assert messages.rejected == 1
    assert messages.lost() == {TOPIC: 0}


def test_names_that_no_node_can_have_take_no_place() -> None:
    messages = PeerMessages("sensor", [TOPIC])
    for number in range(3 * MAX_ORIGINS):
        assert not taken(messages, f"far.n{number}", S)
    assert messages.rejected == 3 * MAX_ORIGINS
    assert taken(messages, "n", S) == "sensor.n"
    assert not taken(messages, "n" * (65 - len("sensor.")), S)


def test_after_a_restart_of_its_clock_what_it_says_is_new() -> None:
    messages = PeerMessages("sensor", [TOPIC])
    assert taken(messages, "n", 9 * S, 7)
    assert not taken(messages, "n", 5 * S, 3)
    messages.forget()
    assert taken(messages, "n", 5 * S, 3)
    assert messages.lost() == {TOPIC: 0}
