"""Attacks on the bus and on the link."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

import pytest

from benchmarks.transport import attacks_hangup, attacks_ipc, attacks_link
from benchmarks.transport.link_stand import Stand
from benchmarks.transport.raw_peers import scripts
from msgs.bus.zmq import make_run_dir

TRIES = 1
#: What the exporting process may open, half of it for strangers: as many more may come before a link on a busy machine
#: has its turn.
OPEN_FILES = 256
#: A user that is nobody here.
STRANGER = 54_321


def test_the_injector_is_sharp() -> None:
    """Into and out of sockets without keys it gets every time: what it is refused below is the link's doing."""
    assert attacks_link.injected_by_v1(TRIES) == TRIES
    assert attacks_link.heard_by_v1(TRIES) == TRIES


@pytest.mark.slow
@pytest.mark.skipif(os.geteuid() != 0, reason="needs root, to become another user")
def test_another_user_is_kept_out_of_the_bus() -> None:
    rows = list(attacks_ipc.rows(TRIES))
    assert [row for row in rows if row.is_defeat] == []
    assert all(row.tried >= TRIES for row in rows)
    assert [row.attack for row in rows if row.by_design and row.accepted == row.tried] == [
        "same user: well-made message (trust boundary)"
    ]


@pytest.mark.graph
def test_peers_that_leave_at_once_end_no_process() -> None:
    """A publisher of a latched topic once died of the first: it changed an option of a connection that was closing."""
    rows = list(attacks_hangup.rows(60, seed=0))
    assert [(row.attack, row.said) for row in rows if row.said != "goes on" or not row.serves] == []
    assert sum(row.tried for row in rows) == 7 * 60 + 5 * 6


def test_a_meeting_place_of_another_user_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Root gives it away; anybody else, who cannot, becomes another."""
    make_run_dir(tmp_path / "graph")
    owner = os.geteuid()
    if owner == 0:
        os.chown(tmp_path / "graph", STRANGER, -1)
    else:
        monkeypatch.setattr(os, "geteuid", lambda: owner + 1)
    with pytest.raises(ValueError, match="must belong to who runs the graph or to root"):
        make_run_dir(tmp_path / "graph")


@pytest.mark.skipif(os.geteuid() != 0, reason="only root has what is root's")
def test_a_meeting_place_of_root_serves_everybody(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    make_run_dir(tmp_path / "graph")
    monkeypatch.setattr(os, "geteuid", lambda: STRANGER)
    make_run_dir(tmp_path / "graph")
    # but a place that is not theirs either is refused to them
    os.chown(tmp_path / "graph", STRANGER + 1, -1)
    with pytest.raises(ValueError, match=f"is user {STRANGER + 1}'s"):
        make_run_dir(tmp_path / "graph")


@pytest.fixture(scope="module")
def stand() -> Iterator[Stand]:
    with Stand(open_files=OPEN_FILES) as stand:
        yield stand


@pytest.mark.graph
def test_no_plain_peer_gets_in(stand: Stand) -> None:
    """Each protocol without keys, and each kind of nonsense, once."""
    tried = dict(scripts(seed=0))
    count, got_in, closed = attacks_link.call_all(stand, list(tried.values()))
    assert (count, got_in, closed) == (len(tried), 0, f"closed {len(tried)}")
    assert count == 15
    assert stand.serves()


@pytest.mark.graph
def test_peers_that_leave_at_once_end_no_link(stand: Stand) -> None:
    assert attacks_link.leave_raw(stand, 100)[:2] == (100, 0)
    attacks_link.leave(stand, 5, seed=0)
    attacks_link.cut_early(stand, 5, seed=0)
    assert stand.serves()


@pytest.mark.graph
def test_silent_connections_do_not_take_all_descriptors(stand: Stand) -> None:
    """Twice as many as it may open; it once ended with its next heartbeat, which could open nothing more."""
    stand.note()
    tried, stayed, said = attacks_link.half_open(stand, 2 * OPEN_FILES)
    assert (tried, stayed) == (2 * OPEN_FILES, 0), f"{said}; {[stand.said(side) for side in stand.sides]}"
    assert stand.serves()


@pytest.mark.graph
def test_a_flipped_bit_is_never_a_message(stand: Stand) -> None:
    """It once ended the importing process: libzmq's heartbeats fail on a connection that its monitor has stopped."""
    flipped, altered, _ = attacks_link.flip(stand, 1, 0)
    assert flipped >= 1
    assert altered == 0
    assert stand.serves()


@pytest.mark.graph
def test_a_listed_peer_that_subscribes_without_end_is_shut_out(stand: Stand) -> None:
    """libzmq keeps every subscription: a hundred thousand of this length made the exporting node grow by 260 MiB."""
    stand.note()
    sent, grew, said = attacks_link.upward(stand, (b"\x01%050d" % index for index in range(2000)), stand.greedy)
    assert (sent, grew) == (2000, 0), said
    assert "greedy subscribes without end: shut out until this node starts again" in stand.sides["export"].said
    _, got_in, said = attacks_link.strangers(stand, lambda peer: stand.server.connect(peer, stand.greedy), 1)
    assert (got_in, said) == (0, "refused by the list")
    assert stand.serves()


@pytest.mark.graph
def test_the_true_key_speaks_in_its_own_names_only(stand: Stand) -> None:
    messages = [message for lies in stand.lies(1).values() for message in lies]
    # what is over the limit ends the connection
    tried, believed, _ = attacks_link.lie(stand, sorted(messages, key=lambda frames: sum(map(len, frames))))
    assert (tried, believed) == (11, 0)
    assert stand.serves()
