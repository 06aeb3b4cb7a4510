"""Beams that wait to be folded, and the choice of the scans that are not: whole ones, before any work is spent on them.

A scan that has not been begun is left out as soon as more beams have piled up behind its first than can be caught up
with in time; once begun it is folded to its end. What counts is the pile, not the age of its beams: a source that is
late as a whole is taken for what it is. Beams of a player that waits for the graph are all folded.
"""

from __future__ import annotations

from collections import deque

from msgs.bus.interface import Received
from msgs.values.radar import RadarBeam

#: After so many scans left out in a row, while nothing else is to do, one is begun however late: slow beats silent.
SHED_IN_A_ROW = 10
#: This share of a scan may always pile up: beams come in twos and threes where a process waits for its core.
_LEAST_PILE = 0.16
#: So many scans wait at most, also of a player that waits for the graph: more are a flood.
MOST_SCANS_WAITING = 8
#: Torn scans and publishers remembered.
_MOST_KNOWN = 64
#: Numbers that fall by more are a source that started anew; by less, a beam that came late.
_LATE_SCANS = 2


class BeamQueue:
    """Waiting beams in order of arrival: at most those of the scan under way and as many of the next.

    `behind`: how late, in scans, the last beam of a scan may be folded.
    """

    def __init__(self, behind: float) -> None:
        self._behind = behind
        #: Time that folding a beam takes lately, in a beam's shares of the scan period; 1 just keeps the radar's pace.
        self.load = 0.0
        #: All beams of a scan come together: a scan that waits whole is not late, the second one is.
        self.at_once = False
        #: Of the scan under way, and late ones; of scans not begun.
        self._under_way: deque[RadarBeam] = deque()
        self._to_begin: deque[RadarBeam] = deque()
        self._begun: int | None = None
        #: Scans left out since then.
        self._shed: list[int] = []
        self._sequence: dict[str, int] = {}
        self._last: int | None = None
        self._torn: deque[int] = deque(maxlen=_MOST_KNOWN)
        self.shed_scans = 0
        self.shed_beams = 0

    def __len__(self) -> int:
        return len(self._under_way) + len(self._to_begin)

    def put(self, received: Received) -> None:
        """Add a beam; leave scans out where too much has piled up."""
        beam = received.message
        assert isinstance(beam, RadarBeam)
        self._notice_gap(received, beam)
        if beam.scan_id in self._shed or len(self) >= MOST_SCANS_WAITING * beam.beam_count:
            self.shed_beams += 1
        elif self._begins(beam):
            self._to_begin.append(beam)
            while not received.envelope.paced and self._is_behind():
                self._leave_out(self._to_begin[0].scan_id)
        else:
            self._under_way.append(beam)

    def ends_scan(self) -> bool:
        """Return whether the next beam begins another scan than the one under way."""
        return not self._under_way and bool(self._to_begin)

    def take(self) -> RadarBeam:
        """Return the next beam; begins its scan if it is a new one's."""
        if not self._under_way:
            self._begin()
        return self._under_way.popleft()

    def torn(self, scan_id: int) -> bool:
        """Whether beams next to or among those of a scan were lost on the bus; asked once, when the scan is closed."""
        is_torn = scan_id in self._torn
        self._torn = deque((one for one in self._torn if one > scan_id), _MOST_KNOWN)
        return is_torn

    def _begins(self, beam: RadarBeam) -> bool:
        """A newer scan than all before, or one of a source that started anew; beams that come late begin nothing."""
        newest = max(self._shed, default=self._begun)
        return newest is None or beam.scan_id > newest or beam.scan_id < newest - _LATE_SCANS

    def _is_behind(self) -> bool:
        if not self._to_begin or len(self._to_begin) - 1 <= self._pile_limit() * self._to_begin[0].beam_count:
            return False
        return bool(self._under_way) or len(self._shed) < SHED_IN_A_ROW

    def _pile_limit(self) -> float:
        """Return in scans: behind a pile this high a scan's last beam is folded `behind` scans after it came.

        Begun p scans late, with every beam taking `load` intervals, the end comes p + load - 1 late. No more than a
        scan piles up, so that a node that sleeps while its load is low does not wake to work long out of date.
        """
        if self.at_once:
            return 1.0
        return max(_LEAST_PILE, min(1.0 + self._behind - self.load, max(1.0, self._behind)))

    def _leave_out(self, scan_id: int) -> None:
        kept = deque(beam for beam in self._to_begin if beam.scan_id != scan_id)
        self.shed_scans += 1
        self.shed_beams += len(self._to_begin) - len(kept)
        self._to_begin = kept
        self._shed.append(scan_id)

    def _begin(self) -> None:
        self._begun = self._to_begin[0].scan_id
        self._shed.clear()
        while self._to_begin and self._to_begin[0].scan_id == self._begun:
            self._under_way.append(self._to_begin.popleft())

    def _notice_gap(self, received: Received, beam: RadarBeam) -> None:
        """Numbers missing before a beam tear the scans to both sides."""
        envelope = received.envelope
        before = self._sequence.get(envelope.publisher, envelope.sequence)
        self._sequence[envelope.publisher] = envelope.sequence
        if len(self._sequence) > _MOST_KNOWN:
            del self._sequence[next(iter(self._sequence))]
        if envelope.sequence > before + 1:
            self._torn.extend({beam.scan_id, beam.scan_id if self._last is None else self._last})
        self._last = beam.scan_id
