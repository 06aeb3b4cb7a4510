"""Node `dca1000_radar`: a 77 GHz board with a DCA1000 card as a digital array: every frame is a scan.

The board itself is configured and started by the maker's tools, after this node: it runs by the same configuration,
which `config` names. Zeros stand for datagrams that were lost, loop by loop; frames without a whole loop are left out.
A card that falls silent or does not answer makes the node DEGRADED and is opened again after a growing delay.
"""

from __future__ import annotations

import logging
from collections import deque
from collections.abc import Callable
from typing import ClassVar, Protocol

import msgspec

from contrib.boards import dca1000_socket as dca1000
from contrib.boards.config_file import read_config
from contrib.boards.dca1000_capture import array_params, frame_samples
from contrib.boards.dca1000_packets import FrameAssembler, SampleFrame
from contrib.boards.digital_row import beam_messages, lost_loops, radar_setup, row_beams
from msgs.bus.interface import Outgoing, Received
from msgs.files.shipped import shipped_path
from msgs.values.arrays import require_finite
from msgs.values.diagnostics import NodeState
from msgs.values.units import ns_from_s, s_from_ns
from msgs.values.wording import counted
from nodes.inputs.refusals import Refusals
from nodes.node import Node

_LOG = logging.getLogger(__name__)

RETRY_S, MAX_RETRY_S = 0.5, 10.0
#: Without datagrams for this long, and three frames, the node says so; so much later the card is opened again, before
#: it ends its recording by itself.
SILENT_S, REOPEN_S = 3.0, 20.0
#: Frames that may wait; older ones are left out.
MAX_WAITING = 4
#: Interval between looks for datagrams: an eighth of a frame's period, within these.
LEAST_POLL_NS, GREATEST_POLL_NS = 1_000_000, 5_000_000


class Card(Protocol):
    """Interface of a capture card; `open` raises `ConnectionError` if it is lost."""

    counts: dca1000.LinkCounts

    def open(self) -> None:
        """Find the card and begin a recording; again after a loss."""

    def take(self) -> list[tuple[bytes, int]]:
        """Return datagrams in order of arrival, each with its time of arrival."""

    def reports(self) -> list[str]:
        """Return the words of reports that came unasked."""

    def close(self) -> None:
        """End the recording and close the connection."""


class Params(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Configuration of the board, and the addresses of its card."""

    formerly: ClassVar[dict[str, str]] = {
        "card": "contrib.boards.dca1000_socket",
        "device": "contrib.boards.dca1000_capture",
    }

    #: Chirps: a TI `.cfg` or `.json`, or a `.lua` of mmWave Studio.
    config: str
    #: Receivers run to the right as the radar looks.
    mirrored: bool = False
    #: Power at the antenna of a tone that fills an int16; to be replaced by the value of one's own board.
    full_scale_dbm: float = -20.0
    card: dca1000.Params = dca1000.Params()

    def __post_init__(self) -> None:
        require_finite("dca1000_radar.full_scale_dbm", self.full_scale_dbm)


class Dca1000Radar(Node):
    """radar/setup once, then the beams of each frame as radar/beam."""

    outputs = ("radar/setup", "radar/beam")

    def __init__(self, params: Params, card: Callable[[dca1000.Params, int], Card] | None = None) -> None:
        super().__init__()
        self._config = read_config(shipped_path(params.config), None)
        self._setup = radar_setup(self._config, params.full_scale_dbm, params.mirrored)
        self._array = array_params(self._config, mirrored=params.mirrored)
        self._card = (card or dca1000.Card)(params.card, self._config.lanes)
        self._assembler = FrameAssembler(self._config.frame_bytes)
        self._refusals = Refusals(_LOG, self.shed, "datagram")
        #: Frames to be sent, and the numbers of scans that the recording under way begins with and that was sent last.
        self._frames: deque[SampleFrame] = deque()
        self._first_scan, self._last_scan = 0, -1
        period_ns = ns_from_s(1e-3 * self._config.frame.period_ms)
        self._poll_ns = min(max(period_ns // 8, LEAST_POLL_NS), GREATEST_POLL_NS)
        self._silent_ns = max(ns_from_s(SILENT_S), 3 * period_ns)
        #: When to look for datagrams next, or to open a lost card; None: the set-up has not been sent.
        self._due_ns: int | None = None
        self._heard_ns = 0
        self._is_lost, self._retry_s = False, RETRY_S
        #: Reasons for missing frames and for zeros in the last; empty while all is well.
        self._trouble = self._loss = ""

    def open(self) -> None:
        """Open the card; errors as `Card.open`."""
        self._card.open()

    def due_ns(self, now_ns: int) -> int | None:
        """Return when to look for datagrams next, or to open the card again."""
        return now_ns if self._due_ns is None else self._due_ns

    def pending(self) -> bool:
        """Return whether frames wait."""
        return bool(self._frames)

    def health(self) -> tuple[NodeState, str]:
        """Return DEGRADED while the card is lost or silent, or datagrams are refused or missing."""
        reason = self._trouble or self._refusals.reason or self._loss
        return (NodeState.DEGRADED, reason) if reason else (NodeState.READY, "")

    def close(self) -> None:
        """End the recording."""
        self._card.close()

    def step(self, inputs: list[Received], now_ns: int) -> list[Outgoing]:
        """Return the set-up first; then the beams of one frame, if one is complete."""
        if self._due_ns is None:
            self._due_ns = self._heard_ns = now_ns
            return [Outgoing("radar/setup", msgspec.structs.replace(self._setup, stamp_ns=now_ns))]
        if now_ns >= self._due_ns:
            self._due_ns = now_ns + self._poll_ns
            if self._is_lost:
                self._find(now_ns)
            else:
                self._take(now_ns)
                self._look_after(now_ns)
        return self._beams(self._frames.popleft()) if self._frames else []

    def _take(self, now_ns: int) -> None:
        """Assemble what has come into frames."""
        datagrams = self._card.take()
        if datagrams:
            self._heard_ns, self._trouble = now_ns, ""
        with self.stages("assemble"):
            for content, stamp_ns in datagrams:
                try:
                    self._frames += self._assembler.add(content, stamp_ns)
                    self._refusals.accept()
                except ValueError as error:
                    self._refusals.refuse("datagram", error)
        while len(self._frames) > MAX_WAITING:
            self._frames.popleft()
            self.shed.add("frame", "behind")
        self._count()

    def _count(self) -> None:
        """State the counts of link and assembler as they stand: what comes late is lost no more."""
        counts, link = self._assembler.counts, self._card.counts
        for reason, count in (
            ("lost", counts.lost), ("late", counts.late), ("repeated", counts.repeated), ("foreign", link.foreign),
            ("queue full", link.overrun),
        ):  # fmt: skip
            self.shed.note("datagram", reason, count)
        self.shed.note("frame", "lost", counts.lost_frames)

    def _look_after(self, now_ns: int) -> None:
        """Open the card again where its recording has ended or it is silent."""
        words = self._card.reports()
        if words:
            _LOG.warning("card reports: %s", ", ".join(words))
        silent_ns = now_ns - self._heard_ns
        if ended := dca1000.ENDED.intersection(words):
            self._lose(f"the recording has ended ({', '.join(sorted(ended))}): start the board", now_ns)
        elif silent_ns > ns_from_s(REOPEN_S) + self._silent_ns:
            self._lose("the card is silent", now_ns)
        elif silent_ns > self._silent_ns:
            self._trouble = f"no samples for {s_from_ns(silent_ns):.0f} s: is the board started?"

    def _find(self, now_ns: int) -> None:
        """Begin another recording."""
        try:
            with self.stages("open"):
                self._card.close()
                self._card.open()
        except (ConnectionError, ValueError) as error:
            self._lose(str(error), now_ns)
            return
        self._frames += self._assembler.flush()
        self._is_lost, self._retry_s, self._heard_ns = False, RETRY_S, now_ns
        _LOG.info("recording again")

    def _lose(self, reason: str, now_ns: int) -> None:
        """Report a loss, and open the card again after a growing delay."""
        if not self._is_lost:
            _LOG.warning("%s", reason)
        self._is_lost, self._trouble = True, f"{reason}; next try in {self._retry_s:g} s"
        self._due_ns = now_ns + ns_from_s(self._retry_s)
        self._retry_s = min(2.0 * self._retry_s, MAX_RETRY_S)

    def _beams(self, frame: SampleFrame) -> list[Outgoing]:
        """Return the beams of a frame; none where no loop of it is whole."""
        if self._first_scan + frame.number <= self._last_scan:
            # another recording: its frames count on
            self._first_scan = self._last_scan + 1 - frame.number
        scan = self._last_scan = self._first_scan + frame.number
        lost = lost_loops(frame.gaps, self._config)
        was_whole = not self._loss
        self._loss = (
            f"scan {scan}: {frame.missing_bytes} of {self._config.frame_bytes} bytes are missing, zeros in "
            f"{int(lost.sum())} of {counted(len(lost), 'loop')}"
            if frame.gaps
            else ""
        )
        if lost.all():
            self.shed.add("frame", "no whole loop")
            return []
        if frame.gaps:
            self.shed.add("frame", "filled")
            if was_whole:
                _LOG.info("%s", self._loss)
        with self.stages("beams"):
            beams = row_beams(frame_samples(frame.codes, self._config), self._setup, self._array, lost)
        messages = beam_messages(beams, self._setup, scan, frame.stamp_ns)
        return [Outgoing("radar/beam", message) for message in messages]


def create(params: Params) -> Dca1000Radar:
    """Return the node with its parameters; a card absent now is bad input, one that is lost later is not."""
    node = Dca1000Radar(params)
    try:
        node.open()
    except (ConnectionError, ValueError) as error:
        node.close()
        raise ValueError(str(error)) from None
    return node
