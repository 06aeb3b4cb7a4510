"""What waits for a peer of newest-only topics, and what is sent to it when."""

from __future__ import annotations

from collections import Counter

from contrib.two_machines.curve import ID_BYTES, NEWEST
from contrib.two_machines.newest import NUMBER, NewestOnly
from msgs.bus.codec import Buffer, topic_frame
from msgs.bus.interface import Envelope
from msgs.bus.sequencing import MAX_LATCHED
from msgs.bus.topics import TOPICS

MAP, VIEW = "radar/ra_map", "perception/hidden_objects"
PEERS = [bytes([index]) * ID_BYTES for index in range(3)]


class Line:
    """The queue, and what it has sent: peer, topic, number and text of each message."""

    def __init__(self, max_peers: int = 3) -> None:
        self.sent: list[tuple[bytes, str, int, str]] = []
        self.queue = NewestOnly([TOPICS[MAP], TOPICS[VIEW], TOPICS["vehicle/state"]], self._note, max_peers)

    def _note(self, frames: list[Buffer]) -> None:
        peer_bytes = len(NEWEST) + ID_BYTES
        head = bytes(frames[0])
        assert head.startswith(NEWEST)
        (number,) = NUMBER.unpack(frames[1])
        topic = head[peer_bytes:].rstrip(b"\0").decode()
        self.sent.append((head[len(NEWEST) : peer_bytes], topic, number, bytes(frames[2]).decode()))

    def offer(self, text: str, topic: str = MAP, publisher: str = "former", paced: bool = False) -> None:
        envelope = Envelope(publisher=publisher, topic=topic, sequence=0, sent_ns=0, paced=paced)
        self.queue.offer(envelope, [topic_frame(topic), text.encode()])

    def texts(self, peer: bytes = PEERS[0]) -> list[str]:
        return [text for whose, _, _, text in self.sent if whose == peer]

    def take_last(self, peer: bytes = PEERS[0]) -> None:
        self.queue.acknowledge(peer, max(number for whose, _, number, _ in self.sent if whose == peer))


def subscription(peer: bytes, topic: str = MAP) -> bytes:
    return NEWEST + peer + topic_frame(topic)


def test_each_peer_gets_the_newest_when_it_has_taken_the_last() -> None:
    line = Line()
    for peer in PEERS[:2]:
        line.queue.join(subscription(peer))
    line.offer("a")
    line.take_last(PEERS[1])
    for text in "bcd":
        line.offer(text)
    assert line.texts(PEERS[0]) == ["a"]
    assert line.texts(PEERS[1]) == ["a", "b"]
    line.take_last(PEERS[0])
    line.take_last(PEERS[1])
    assert line.texts(PEERS[0]) == ["a", "d"]
    assert line.texts(PEERS[1]) == ["a", "b", "d"]
    # b and c for the first, c for the second
    assert line.queue.superseded == Counter({MAP: 3})


def test_publishers_and_topics_do_not_wait_for_each_other() -> None:
    line = Line()
    for topic in (MAP, VIEW):
        line.queue.join(subscription(PEERS[0], topic))
    line.offer("front", publisher="front")
    line.offer("rear", publisher="rear")
    line.offer("view", topic=VIEW)
    assert line.texts() == ["front", "rear", "view"]
    assert line.queue.superseded.total() == 0


def test_paced_messages_replace_none() -> None:
    line = Line()
    line.queue.join(subscription(PEERS[0]))
    for text in "abc":
        line.offer(text, paced=True)
    for _ in range(2):
        line.take_last()
    assert line.texts() == ["a", "b", "c"]
    # not even these may wait without bound
    for number in range(10):
        line.offer(str(number), paced=True)
    assert line.queue.superseded[MAP] == 10 - TOPICS[MAP].history_messages


def test_an_acknowledgement_covers_all_before_it_and_nothing_after() -> None:
    line = Line()
    line.queue.join(subscription(PEERS[0]))
    line.offer("a")
    first = line.queue.last_number
    line.take_last()
    line.offer("b")
    line.offer("c")
    line.queue.acknowledge(PEERS[0], first)
    line.queue.acknowledge(PEERS[1], line.queue.last_number)
    assert line.texts() == ["a", "b"]
    line.queue.acknowledge(PEERS[0], line.queue.last_number + 7)
    assert line.texts() == ["a", "b", "c"]


def test_what_was_in_flight_on_a_lost_connection_holds_nothing_up() -> None:
    line = Line()
    line.queue.join(subscription(PEERS[0]))
    line.offer("a")
    # the new connection comes before the old one has gone
    line.queue.join(subscription(PEERS[0]))
    line.queue.part(subscription(PEERS[0]))
    line.offer("b")
    assert line.texts() == ["a", "b"]
    line.queue.part(subscription(PEERS[0]))
    line.offer("c")
    line.take_last()
    assert line.texts() == ["a", "b"]


def test_subscriptions_to_other_topics_and_of_too_many_peers_are_not_served() -> None:
    line = Line(max_peers=1)
    for prefix in (NEWEST, NEWEST + PEERS[0], subscription(PEERS[0], "vehicle/state"), subscription(PEERS[0])[:-1]):
        line.queue.join(prefix)
        line.queue.part(prefix)
    line.queue.join(subscription(PEERS[0], VIEW))
    line.queue.join(subscription(PEERS[1]))
    # two topics are newest-only: a peer more has no place
    line.queue.join(subscription(PEERS[2]))
    line.offer("map")
    line.offer("state", topic="vehicle/state")
    assert [(whose, text) for whose, _, _, text in line.sent] == [(PEERS[1], "map")]


def test_messages_of_many_publishers_are_kept_for_those_that_sent_last() -> None:
    line = Line()
    line.queue.join(subscription(PEERS[0]))
    for number in range(MAX_LATCHED + 1):
        for text in ("in flight", "waiting"):
            line.offer(f"{text} {number}", publisher=f"radar{number}")
    line.sent.clear()
    line.queue.acknowledge(PEERS[0], line.queue.last_number)
    assert line.texts() == [f"waiting {number}" for number in range(1, MAX_LATCHED + 1)]
