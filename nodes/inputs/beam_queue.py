"""Beams that wait to be folded, and the choice of scans to drop: whole ones, before any work is spent on them.

A scan that has not been begun is dropped as soon as more beams are queued behind its first than can be processed
in time; once begun it is folded to its end. The queue depth decides, not the age of its beams: a source that is
late as a whole is accepted. Beams of a player that waits for the graph are all folded.
"""

from __future__ import annotations

from collections import deque

from msgs.bus.interface import Received
from msgs.values.radar import RadarBeam

#: After so many dropped scans in a row, an idle node begins one however late it is: slow is better than silent.
SHED_IN_A_ROW = 10
#: This share of a scan may always be queued: beams come in twos and threes where a process waits for its core.
_LEAST_PILE = 0.16
#: Maximum waiting scans, also of a player that waits for the graph: more are a flood.
MAX_SCANS_WAITING = 8
#: Maximum number of remembered torn scans and publishers.
_MAX_TRACKED = 64
#: Numbers that fall by more indicate a restarted source; by less, a late beam.
_LATE_SCANS = 2


class BeamQueue:
    """Waiting beams in order of arrival: at most those of the current scan and as many of the next.

    `behind`: maximum delay, in scans, at which the last beam of a scan may be folded.
    """

    def __init__(self, behind: float) -> None:
        self.behind = behind
        #: Recent time to fold a beam, in a beam's shares of the scan period; 1 just keeps the radar's pace.
        self.load = 0.0
        #: All beams of a scan arrive together: a scan that waits whole is not late, the second one is.
        self.at_once = False
        #: Beams of the current scan, and late ones; of scans not begun.
        self._current: deque[RadarBeam] = deque()
        self._to_begin: deque[RadarBeam] = deque()
        self._begun: int | None = None
        #: Scans dropped since then.
        self._shed: list[int] = []
        self._sequence: dict[str, int] = {}
        self._last: int | None = None
        self._torn: deque[int] = deque(maxlen=_MAX_TRACKED)
        self.shed_scans = 0
        self.shed_beams = 0

    def __len__(self) -> int:
        return len(self._current) + len(self._to_begin)

    def put(self, received: Received) -> None:
        """Add a beam; drop scans if too many beams are queued."""
        beam = received.message
        assert isinstance(beam, RadarBeam)
        self._notice_gap(received, beam)
        if beam.scan_id in self._shed or len(self) >= MAX_SCANS_WAITING * beam.beam_count:
            self.shed_beams += 1
        elif self._begins(beam):
            self._to_begin.append(beam)
            while not received.envelope.paced and self._is_behind():
                self._leave_out(self._to_begin[0].scan_id)
        else:
            self._current.append(beam)

    def ends_scan(self) -> bool:
        """Return whether the next beam belongs to another scan than the current one."""
        return not self._current and bool(self._to_begin)

    def take(self) -> RadarBeam:
        """Return the next beam; begins its scan if it is a new one's."""
        if not self._current:
            self._begun = self._to_begin[0].scan_id
            self._shed.clear()
            while self._to_begin and self._to_begin[0].scan_id == self._begun:
                self._current.append(self._to_begin.popleft())
        return self._current.popleft()

    def torn(self, scan_id: int) -> bool:
        """Return whether beams next to or of a scan were lost on the bus; call it once, when the scan is closed."""
        is_torn = scan_id in self._torn
        self._torn = deque((torn_id for torn_id in self._torn if torn_id > scan_id), _MAX_TRACKED)
        return is_torn

    def _begins(self, beam: RadarBeam) -> bool:
        """Return whether a beam begins a scan newer than all before, or of a restarted source; late beams do not."""
        newest = max(self._shed, default=self._begun)
        return newest is None or beam.scan_id > newest or beam.scan_id < newest - _LATE_SCANS

    def _is_behind(self) -> bool:
        if not self._to_begin or len(self._to_begin) - 1 <= self._pile_limit() * self._to_begin[0].beam_count:
            return False
        return bool(self._current) or len(self._shed) < SHED_IN_A_ROW

    def _pile_limit(self) -> float:
        """Return the queue depth in scans up to which a scan's last beam is folded `behind` scans after it came.

        Begun p scans late, with every beam taking `load` intervals, the end is p + load - 1 late. No more than a
        scan is queued, so that a node that sleeps while its load is low does not wake to process outdated beams.
        """
        if self.at_once:
            return 1.0
        return max(_LEAST_PILE, min(1.0 + self.behind - self.load, max(1.0, self.behind)))

    def _leave_out(self, scan_id: int) -> None:
        kept = deque(beam for beam in self._to_begin if beam.scan_id != scan_id)
        self.shed_scans += 1
        self.shed_beams += len(self._to_begin) - len(kept)
        self._to_begin = kept
        self._shed.append(scan_id)

    def _notice_gap(self, received: Received, beam: RadarBeam) -> None:
        """Mark the scans on both sides of a gap in the numbers as torn."""
        envelope = received.envelope
        before = self._sequence.get(envelope.publisher, envelope.sequence)
        self._sequence[envelope.publisher] = envelope.sequence
        if len(self._sequence) > _MAX_TRACKED:
            del self._sequence[next(iter(self._sequence))]
        if envelope.sequence > before + 1:
            self._torn.extend({beam.scan_id, beam.scan_id if self._last is None else self._last})
        self._last = beam.scan_id
