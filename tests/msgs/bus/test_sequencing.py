"""Counts of a connection under publishers that nobody expected."""

from __future__ import annotations

import tracemalloc

import msgspec
import pytest

from msgs.bus.codec import encode
from msgs.bus.interface import Envelope, Received
from msgs.bus.sequencing import MAX_PUBLISHERS, Tally, latch
from msgs.values.diagnostics import LogRecord
from tests.msgs.bus.test_codec import CASES

TOPIC = "log"
#: Its receivers want the newest message only.
ANSWER = "perception/hidden_objects"
S = 1_000_000_000
RECORD = LogRecord(stamp_ns=0, node="x", level="info", text="")


def heard(tally: Tally, publisher: str, now_ns: int, sequence: int = 0) -> bool:
    envelope = Envelope(publisher=publisher, topic=TOPIC, sequence=sequence, sent_ns=now_ns)
    return tally.accept(TOPIC, encode(envelope, RECORD), now_ns) is not None


def listening() -> Tally:
    tally = Tally("listener")
    tally.expect(TOPIC)
    return tally


def rejected(tally: Tally) -> int:
    return tally.counts()[0][0].rejected


def test_names_without_end_take_no_memory_and_turn_nobody_out() -> None:
    """Who spoke before the flood is heard in it and after it; each name too many is counted as rejected."""
    tally = listening()
    assert heard(tally, "honest", 0)
    tracemalloc.start()
    try:
        for number in range(5000):
            heard(tally, f"invented{number}", number)
            if number == MAX_PUBLISHERS:
                before = tracemalloc.get_traced_memory()[0]
        grown = tracemalloc.get_traced_memory()[0] - before
    finally:
        tracemalloc.stop()
    assert rejected(tally) == 5001 - MAX_PUBLISHERS
    assert grown < 20_000
    assert heard(tally, "honest", 6000, 1)
    # a gap is still counted
    assert heard(tally, "honest", 6001, 4)
    assert tally.counts()[0][0].lost == 2


def test_who_has_been_silent_makes_room() -> None:
    """Publishers come and go over days: the one that was silent longest is forgotten, the others are known still."""
    tally = listening()
    for number in range(MAX_PUBLISHERS):
        heard(tally, f"n{number}", number)
    heard(tally, "n0", MAX_PUBLISHERS, 1)
    assert not heard(tally, "late", 5 * S)
    assert heard(tally, "late", 11 * S)
    assert not heard(tally, "n2", 2)  # an old message again: it was seen
    assert rejected(tally) == 1
    assert heard(tally, "n1", 11 * S + 1)  # forgotten, so it begins anew, in the place of n2
    assert tally.counts()[0][0].lost == 0


def test_a_name_longer_than_any_node_has_is_refused() -> None:
    tally = listening()
    assert heard(tally, "n" * 64, 0)
    assert not heard(tally, "n" * 65, 0)
    assert rejected(tally) == 1


def test_losses_that_somebody_makes_up_are_numbers_that_can_travel() -> None:
    """Jumps back and forth over the largest gap would leave 64 bits, and no heartbeat that says so could be encoded."""
    tally = listening()
    for number in range(200):
        assert heard(tally, "liar", number, sequence=(number % 2) << 48)
    assert tally.counts()[0][0].lost == 2**53


def test_who_is_to_be_forgotten_begins_anew() -> None:
    tally = listening()
    for name in ("a", "b"):
        heard(tally, name, 0, 5)
    tally.forget(TOPIC, "a")
    assert [heard(tally, name, 0, 3) for name in ("a", "b")] == [True, False]
    tally.forget_all()
    assert [heard(tally, name, 0, 1) for name in ("a", "b")] == [True, True]
    assert tally.counts()[0][0].lost == 0


def test_latched_messages_are_kept_in_order_of_the_last_word_and_not_without_end() -> None:
    kept: dict[str, list] = {}
    for number in range(40):
        latch(kept, f"n{number}", [b"old"])
    latch(kept, "n10", [b"new"])
    assert list(kept) == [f"n{number}" for number in range(8, 40) if number != 10] + ["n10"]
    assert kept["n10"] == [b"new"]


def test_only_who_counts_all_messages_gets_outdated_ones() -> None:
    """Three views wait at once: a display wants the last one, a player that waits for each answer wants every one."""
    waiting = [
        Received(ANSWER, dict(CASES)[ANSWER], Envelope(publisher="n", topic=ANSWER, sequence=number, sent_ns=number))
        for number in range(3)
    ]
    for keeps_all, kept in ((False, [2]), (True, [0, 1, 2])):
        tally = Tally("listener", keeps_all=keeps_all)
        tally.expect(ANSWER)
        assert [one.envelope.sequence for one in tally.without_outdated(waiting)] == kept
        assert tally.counts()[0][0].outdated == 3 - len(kept)


@pytest.mark.parametrize(
    ("said", "taken", "lost"),
    [
        # numbers and times of sending
        ([(0, 10), (1, 20), (2, 30)], [0, 1, 2], 0),
        ([(0, 10), (4, 20)], [0, 4], 3),
        # repeated or older ones come to nothing; the same number sent later is a restart's
        ([(3, 10), (3, 10), (2, 9), (4, 20)], [3, 4], 0),
        ([(7, 10), (0, 20), (2, 30)], [7, 0, 2], 1),
        # who joins late has lost nothing before
        ([(9, 10)], [9], 0),
    ],
)
def test_messages_come_once_in_order_and_every_gap_is_counted(
    said: list[tuple[int, int]], taken: list[int], lost: int
) -> None:
    tally = Tally("here")
    tally.expect(TOPIC)
    came = [
        tally.admit(Received(TOPIC, RECORD, Envelope(publisher="a", topic=TOPIC, sequence=number, sent_ns=at)), 5, 99)
        for number, at in said
    ]
    assert [one.envelope.sequence for one in came if one is not None] == taken
    (count,) = tally.counts()[0]
    assert (count.messages, count.bytes, count.lost) == (len(taken), 5 * len(taken), lost)


def test_what_follows_from_paced_messages_is_paced_for_ten_seconds() -> None:
    """A player that ended without notice does not make all later messages of a graph wait."""
    tally = Tally("here")
    tally.expect(TOPIC)

    def paced(at_s: float) -> bool:
        return tally.pack(TOPIC, RECORD, round(at_s * 1e9))[0].paced

    assert not paced(0.0)
    envelope = Envelope(publisher="a", topic=TOPIC, sequence=0, sent_ns=10**9, paced=True)
    tally.admit(Received(TOPIC, RECORD, envelope), 5, 10**9)
    assert [paced(at_s) for at_s in (1.0, 11.0, 11.1)] == [True, True, False]
    tally.admit(Received(TOPIC, RECORD, msgspec.structs.replace(envelope, sequence=1, paced=False)), 5, 10**9)
    assert not paced(1.0)
    assert Tally("player", paced=True).pack(TOPIC, RECORD, 0)[0].paced
