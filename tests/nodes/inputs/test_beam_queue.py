"""Which scans are left out where beams pile up: whole ones, the pile alone decides, late beams begin nothing."""

from __future__ import annotations

import msgspec
import pytest

from msgs.bus.interface import Envelope, Received
from nodes.inputs.beam_queue import MAX_SCANS_WAITING, SHED_IN_A_ROW, BeamQueue
from tests.builders import example_beam

BEAMS = 25


def beam(scan: int, index: int, sequence: int | None = None) -> Received:
    number = scan * BEAMS + index
    message = example_beam(stamp_ns=12_000_000 * number, scan_id=scan, beam_index=index, beam_count=BEAMS)
    sequence = number if sequence is None else sequence
    return Received("radar/beam", message, Envelope(publisher="a", topic="radar/beam", sequence=sequence, sent_ns=0))


def filled(*beams: Received, behind: float = 0.5, load: float = 1.0) -> BeamQueue:
    queue = BeamQueue(behind)
    queue.load = load
    for one in beams:
        queue.put(one)
    return queue


def folded(queue: BeamQueue) -> list[tuple[int, int]]:
    """Scan and beam of all that is folded if nothing else comes."""
    taken = [queue.take() for _ in range(len(queue))]
    return [(one.scan_id, one.beam_index) for one in taken]


def test_a_pile_up_to_the_limit_is_folded_and_one_beam_more_is_not() -> None:
    assert len(folded(filled(*[beam(0, index) for index in range(13)]))) == 13
    assert folded(filled(*[beam(0, index) for index in range(14)])) == []


def test_a_scan_that_comes_at_once_is_folded_and_left_out_when_the_next_one_comes() -> None:
    queue = BeamQueue(behind=0.5)
    queue.load, queue.at_once = 0.9, True
    for index in range(BEAMS):
        queue.put(beam(0, index))
    assert (len(queue), queue.shed_scans) == (BEAMS, 0)
    queue.put(beam(1, 0))
    queue.put(beam(1, 1))
    assert (folded(queue), queue.shed_scans, queue.shed_beams) == ([(1, 0), (1, 1)], 1, BEAMS)


@pytest.mark.parametrize(("load", "beams"), [(0.0, 26), (0.5, 26), (0.9, 16), (1.0, 13), (1.2, 8), (2.0, 5), (50.0, 5)])
def test_the_faster_beams_are_folded_the_higher_the_pile_that_is_caught_up_with(load: float, beams: int) -> None:
    """Half a scan late at the end: 1 + 0.5 - load scans at the begin, never above a scan nor below four beams."""
    waiting = [beam(0, index) for index in range(BEAMS)] + [beam(1, 0), beam(1, 1)]
    assert len(filled(*waiting[:beams], load=load)) == beams
    assert filled(*waiting[: beams + 1], load=load).shed_scans == 1


def test_the_newest_scan_is_the_one_begun() -> None:
    whole = [beam(scan, index) for scan in range(3) for index in range(BEAMS)]
    assert folded(filled(*whole, beam(3, 0), beam(3, 1))) == [(3, 0), (3, 1)]


def test_a_scan_once_begun_is_folded_to_its_end() -> None:
    queue = filled(beam(0, 0))
    queue.take()
    for scan, index in [(0, at) for at in range(1, BEAMS)] + [(1, at) for at in range(BEAMS)] + [(2, 0)]:
        queue.put(beam(scan, index))
    assert folded(queue) == [(0, index) for index in range(1, BEAMS)] + [(2, 0)]


def test_beams_of_a_scan_left_out_never_come_back() -> None:
    queue = filled(*[beam(0, index) for index in range(20)])
    assert (len(queue), queue.shed_scans, queue.shed_beams) == (0, 1, 20)
    for index in range(20, BEAMS):
        queue.put(beam(0, index))
    assert (len(queue), queue.shed_scans, queue.shed_beams) == (0, 1, 25)
    queue.put(beam(1, 0))
    queue.put(beam(0, 24))
    assert folded(queue) == [(1, 0)]


def test_the_pile_is_bounded_however_long_a_scan_takes() -> None:
    queue = filled(beam(0, 0))
    queue.take()
    longest = 0
    for number in range(1, 40 * BEAMS):
        queue.put(beam(*divmod(number, BEAMS)))
        longest = max(longest, len(queue))
    assert longest <= BEAMS - 1 + 13
    assert queue.shed_scans == 39


def test_a_graph_that_never_keeps_up_still_says_something() -> None:
    queue = filled()
    begun = []
    for scan in range(3 * (SHED_IN_A_ROW + 1)):
        for index in range(BEAMS):
            queue.put(beam(scan, index))
        begun += sorted({one for one, _ in folded(queue)})
    assert begun == [SHED_IN_A_ROW, 2 * SHED_IN_A_ROW + 1, 3 * SHED_IN_A_ROW + 2]


def test_a_source_that_starts_anew_is_judged_anew() -> None:
    queue = filled(beam(1000, 0), load=3.0)
    queue.take()
    for index in range(6):
        queue.put(beam(0, index, sequence=index))
    assert (len(queue), queue.shed_scans) == (0, 1)


@pytest.mark.parametrize("late_by", [0, 1, 2])
def test_a_late_beam_begins_nothing_and_is_passed_on(late_by: int) -> None:
    queue = filled(beam(5, 0))
    queue.take()
    for one in (beam(5 - late_by, 3), *[beam(5, index) for index in range(1, BEAMS)]):
        queue.put(one)
    assert not queue.ends_scan()
    assert queue.take().scan_id == 5 - late_by
    assert queue.shed_scans == 0


def test_a_gap_tears_the_scans_to_both_sides_and_no_other() -> None:
    whole = [beam(scan, index) for scan in range(5) for index in range(BEAMS)]
    queue = filled(*whole[:40], *whole[60:])
    assert [queue.torn(scan) for scan in range(5)] == [False, True, True, False, False]
    assert not queue.torn(1), "asked once, forgotten"


def test_a_publisher_that_counts_anew_tears_nothing() -> None:
    queue = filled(beam(7, 3), beam(8, 0, sequence=0), beam(8, 1, sequence=1))
    assert not queue.torn(7)
    assert not queue.torn(8)


def test_a_flood_of_beams_of_one_scan_is_bounded() -> None:
    """Beams of the scan under way are never behind, however often they come: eight scans of them wait, not all."""
    queue = filled(beam(0, 0))
    queue.take()
    for _ in range(20 * BEAMS):
        queue.put(beam(0, 1))
    assert len(queue) == MAX_SCANS_WAITING * BEAMS
    assert queue.shed_beams == (20 - MAX_SCANS_WAITING) * BEAMS


def test_gaps_and_publishers_are_not_remembered_for_ever() -> None:
    """Numbers with gaps and no scan that is ever closed, from publishers of ever new names."""
    queue = BeamQueue(behind=0.5)
    for number in range(1000):
        one = beam(number, 0, sequence=2 * number)
        name = f"radar{number // 2}"
        queue.put(one._replace(envelope=msgspec.structs.replace(one.envelope, publisher=name)))
        while queue:
            queue.take()
    assert len(queue._torn) <= 64
    assert len(queue._sequence) <= 64
