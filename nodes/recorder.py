"""The node `recorder`: writes what it hears into an MCAP recording."""

from __future__ import annotations

import logging
from pathlib import Path

import msgspec

from msgs.bus import Outgoing, Received
from msgs.diagnostics import NodeState
from msgs.recording import RecordingWriter
from msgs.topics import TOPICS, topic_facts
from nodes.node import Node

_LOG = logging.getLogger(__name__)

#: 350 MB/s: recorded only when asked for.
RAW_TOPIC = "radar/beam"


class Params(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Where to record to and what."""

    path: str
    #: None: all topics but raw beams.
    topics: tuple[str, ...] | None = None
    #: Raw beams too.
    raw: bool = False
    #: Written into the recording's metadata.
    metadata: dict[str, str] = {}

    def __post_init__(self) -> None:
        if not self.path:
            raise ValueError("path must name a file")
        for topic in self.topics or ():
            topic_facts(topic)

    def chosen_topics(self) -> tuple[str, ...]:
        """Topics to record, in the order of the topic table."""
        wanted = set(TOPICS) - {RAW_TOPIC} if self.topics is None else set(self.topics)
        return tuple(topic for topic in TOPICS if topic in wanted or (self.raw and topic == RAW_TOPIC))


class Recorder(Node):
    """Appends every message to one recording.

    A disk that refuses ends the recording, not the graph: the node stays, DEGRADED, says why and counts what it missed.
    """

    def __init__(self, params: Params) -> None:
        super().__init__()
        self.inputs = params.chosen_topics()
        self.path = free_path(Path(params.path))
        self.messages = self.missed = 0
        self._refused = ""
        self._writer = RecordingWriter(self.path, params.metadata)

    def step(self, inputs: list[Received], now_ns: int) -> list[Outgoing]:
        """Write all messages that came in."""
        with self.stages("write"):
            for received in inputs:
                self._write(received)
        return []

    def health(self) -> tuple[NodeState, str]:
        """DEGRADED once the disk has refused."""
        if not self._refused:
            return NodeState.READY, ""
        return NodeState.DEGRADED, f"{self._refused}; {self.missed} messages missed"

    def close(self) -> None:
        """Write the index and close the file."""
        try:
            self._writer.close()
        except OSError as error:
            self._refuse(error)
        missed = f", {self.missed} missed" if self.missed else ""
        _LOG.info("%s: %d messages recorded%s", self.path, self.messages, missed)

    def _write(self, received: Received) -> None:
        if self._refused:
            self.missed += 1
            return
        envelope = received.envelope
        try:
            self._writer.write(
                received.topic,
                received.message,
                publisher=envelope.publisher,
                sequence=envelope.sequence,
                sent_ns=envelope.sent_ns,
            )
            self.messages += 1
        except OSError as error:
            self.missed += 1
            self._refuse(error)

    def _refuse(self, error: OSError) -> None:
        if not self._refused:
            self._refused = f"{self.path}: recording ended: {error.strerror or error}"
            _LOG.error("%s", self._refused)


def free_path(path: Path) -> Path:
    """`path`, or where it exists, as after a restart, the first free of name-2, name-3, ..."""
    candidate, number = path, 1
    while candidate.exists():
        number += 1
        candidate = path.with_name(f"{path.stem}-{number}{path.suffix}")
    return candidate


def create(params: Params) -> Recorder:
    """The node; raises `OSError` where the file cannot be created."""
    return Recorder(params)
