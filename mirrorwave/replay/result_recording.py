"""Results of a processed capture as a recording: what a live graph would have sent, raw data aside."""

from __future__ import annotations

from collections.abc import Iterator

import msgspec

from models.perception.chain import ScanView
from msgs.bus.topics import RAW_TOPICS, plain_topic
from msgs.recording.mcap import RecordingWriter
from nodes.player import SETUP_TOPICS, Event


class ResultRecording:
    """Writes what was sensed, raw data aside, and the views, each at the time of the message that completed it.

    Times are those of the capture: the first message was sent at its stamp. A computer that needs no time is assumed.
    """

    def __init__(self, writer: RecordingWriter) -> None:
        self._writer = writer
        self._start_ns: int | None = None
        self._now_ns = 0

    def passed(self, events: Iterator[Event]) -> Iterator[Event]:
        """Yield the events of a capture; write those that a page shows."""
        for event in events:
            topic, message = event.outgoing
            if self._start_ns is None and plain_topic(topic) not in SETUP_TOPICS:
                self._start_ns = max(0, message.stamp_ns - event.offset_ns)  # type: ignore[attr-defined]
            self._now_ns = (self._start_ns or 0) + event.offset_ns
            # these are too large to be recorded twice
            if plain_topic(topic) not in RAW_TOPICS:
                self._write(topic, message)
            yield event

    def add_view(self, view: ScanView) -> None:
        """Write map, peaks and view of a scan."""
        if view.ra_map is not None:
            self._write("radar/ra_map", view.ra_map)
        if view.peaks is not None:
            self._write("perception/peaks", view.peaks)
        self._write("perception/hidden_objects", view.frame)

    def _write(self, topic: str, message: msgspec.Struct) -> None:
        self._writer.write(topic, message, publisher="process", sent_ns=max(0, self._now_ns))
