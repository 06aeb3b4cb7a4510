"""The node `recorder`: writes what it hears into MCAP recordings, one, several in turn, or one per trigger."""

from __future__ import annotations

import logging
from collections import Counter
from pathlib import Path

import msgspec

from msgs.bus.interface import Outgoing, Received
from msgs.files.whole_files import free_bytes
from msgs.recording.mcap import Encoded, Losses, RecordingWriter, TopicLoss
from msgs.values.diagnostics import NodeState
from msgs.values.units import s_from_ns
from msgs.values.wording import counted
from nodes.node import Node
from nodes.recording.files import (
    LatchedMessages,
    about_this_run,
    as_recorded,
    free_path,
    losses_between,
    next_number,
    numbered_path,
    require_kept_free,
)
from nodes.recording.params import RecordingParams
from nodes.recording.snapshot_recorder import SnapshotRecorder

_LOG = logging.getLogger(__name__)

#: The disk is called short when it is full in less than this at the rate so far.
_SHORT_S = 60.0
#: The rate is known after this.
_RATE_KNOWN_S = 5.0


class Params(RecordingParams, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Place and content of a recording; at most one of splitting and snapshots."""


class Recorder(Node):
    """Appends every message to a recording, part after part where it is to be split.

    A disk that refuses, or would be left with too little room, ends the recording, not the graph: the node stays,
    DEGRADED, says why and counts what it missed, unless it `ends_when_refused`. Raises `OSError` where the first file
    cannot be created.
    """

    wants_all = True
    takes_all_publishers = True

    def __init__(self, params: Params, *, ends_when_refused: bool = False) -> None:
        super().__init__()
        self.inputs = params.selected_topics()
        self.paths: list[Path] = []
        #: Messages written, repeated ones included, and messages that came and could not be.
        self.messages = self.missed = 0
        #: What the last file says of what is missing, and messages by topic that came since it was finished.
        self._said = Losses()
        self._missed_since: Counter[str] = Counter()
        #: Messages that never came, over all files.
        self.lost = 0
        #: Why the recording has ended before it was asked to.
        self.refused = ""
        self._params, self._ends = params, ends_when_refused
        self._folder = Path(params.path).absolute().parent
        self._latched = LatchedMessages()
        self._started_ns: int | None = None
        self._recorded_bytes = 0
        self._warned = False
        self._open()

    def step(self, inputs: list[Received], now_ns: int) -> list[Outgoing]:
        """Write all messages that came in."""
        with self.stages("write"):
            self._watch_disk(now_ns)
            for received in inputs:
                self._take(received)
        return []

    def finished(self) -> bool:
        """True once the disk has refused, if that is to end the node."""
        return self._ends and bool(self.refused)

    def health(self) -> tuple[NodeState, str]:
        """DEGRADED once the disk has refused."""
        if not self.refused:
            return NodeState.READY, ""
        return NodeState.DEGRADED, f"{self.refused}; {counted(self.missed, 'message')} missed"

    def close(self) -> None:
        """Write what is missing and the index, close the file; one that ended before says what came since."""
        if not self.refused:
            self._finish_file()
        elif self._missed_since:
            try:
                self._writer.write_losses(_with_missed(self._said, self._missed_since, self.refused))
            except OSError as error:
                _LOG.error("%s: does not say what it missed since: %s", self.paths[-1], error.strerror)
        self._writer.close()
        missed = f", {self.missed} missed" if self.missed else ""
        files = f" in {len(self.paths)} files" if len(self.paths) > 1 else ""
        _LOG.info("%s: %s recorded%s%s", self.paths[-1], counted(self.messages, "message"), files, missed)

    def _open(self) -> None:
        """Begin a file; the counts of what was handed to it and lost before begin anew."""
        path = Path(self._params.path)
        metadata = about_this_run(self._params.metadata)
        if self._params.splits:
            number = next_number(path)
            path, metadata = numbered_path(path, number), metadata | {"part": str(number)}
        else:
            path = free_path(path)
        self._writer = RecordingWriter(path, metadata)
        self.paths.append(path)
        self._handed: Counter[str] = Counter()
        self._counts = self.counts()
        self._part_start_ns: int | None = None

    def _take(self, received: Received) -> None:
        if self.refused:
            self._miss(received.topic)
            return
        message = as_recorded(received)
        self._latched.note(message)
        if self._is_full(message):
            self._next_part(message)
        self._keep_free(len(message.data))
        if self.refused:
            self._miss(received.topic)
        else:
            self._put(message)

    def _miss(self, topic: str) -> None:
        self.missed += 1
        self._missed_since[topic] += 1

    def _put(self, message: Encoded) -> None:
        self._part_start_ns = message.sent_ns if self._part_start_ns is None else self._part_start_ns
        # first, so that what the disk refuses counts as handed over and not written
        self._handed[message.topic] += 1
        self._recorded_bytes += len(message.data)
        try:
            self._writer.write_encoded(message)
        except OSError as error:
            self._refuse(error)

    def _is_full(self, message: Encoded) -> bool:
        """Return whether `message` belongs in the next file."""
        if self._part_start_ns is None:
            return False
        split_bytes, split_s = self._params.split_bytes, self._params.split_s
        too_large = split_bytes is not None and self._writer.size_bytes + len(message.data) > split_bytes
        return too_large or (split_s is not None and message.sent_ns - self._part_start_ns >= round(1e9 * split_s))

    def _next_part(self, first: Encoded) -> None:
        """Close the file and begin one with all that `first`, the next message, may need to be understood."""
        self._finish_file()
        finished = self._writer
        try:
            if not self.refused:
                self._open()
                finished.close()
        except OSError as error:
            self._say_refused(error)
        for message in self._latched.before([first], first.sent_ns):
            if not self.refused:
                self._put(message)
        if self._params.max_parts is not None and len(self.paths) > self._params.max_parts:
            self.paths.pop(0).unlink(missing_ok=True)

    def _finish_file(self) -> None:
        """Write what waits, then what is missing, then the index, as far as there is room."""
        for step in (self._writer.flush, self._say_losses, self._writer.finish):
            try:
                step()
            except OSError as error:
                self._say_refused(error)
        written = Counter(self._writer.written())
        self.messages += written.total()
        self.missed += (self._handed - written).total()

    def _say_losses(self) -> None:
        missed = self._handed - Counter(self._writer.written())
        self._said = losses_between(self._counts, self.counts(), missed, self.refused)
        self.lost += self._said.total - missed.total()
        self._writer.write_losses(self._said)

    def _refuse(self, error: OSError) -> None:
        """End the recording; the file is closed as well as the disk allows."""
        if not self.refused:
            self._say_refused(error)
            self._finish_file()

    def _say_refused(self, error: OSError) -> None:
        if not self.refused:
            self.refused = f"{self.paths[-1]}: recording ended: {error.strerror or error}"
            _LOG.error("%s", self.refused)

    def _watch_disk(self, now_ns: int) -> None:
        """End in good order before the disk is full; warn once when that is near."""
        if self.refused:
            return
        free = self._keep_free(0)
        if free is None:
            return
        self._started_ns = now_ns if self._started_ns is None else self._started_ns
        elapsed_s = s_from_ns(now_ns - self._started_ns)
        left = free - self._params.min_free_bytes - self._writer.growth_bytes()
        if not self._warned and elapsed_s > _RATE_KNOWN_S and left < _SHORT_S * self._recorded_bytes / elapsed_s:
            self._warned = True
            _LOG.warning("%s: the disk has room for less than %g s more", self.paths[-1], _SHORT_S)

    def _keep_free(self, more: int) -> int | None:
        """Room on the disk; ends the recording, None, before `more` bytes and the file's end would leave too little."""
        if self.refused:
            return None
        try:
            free = free_bytes(self._folder)
            require_kept_free(self.paths[-1], self._params.min_free_bytes, self._writer.growth_bytes(more), free)
        except OSError as error:
            self._refuse(error)
            return None
        return free


def _with_missed(losses: Losses, missed: Counter[str], ended: str) -> Losses:
    """`losses` and messages by topic that came after the recording had ended."""
    by_topic = {topic.topic: topic for topic in losses.topics}
    topics = (
        msgspec.structs.replace(topic_loss, missed=topic_loss.missed + missed[name])
        for name in sorted({*by_topic, *missed})
        if (topic_loss := by_topic.get(name, TopicLoss(topic=name)))
    )
    return Losses(topics=tuple(topics), ended=ended)


def create(params: Params) -> Recorder | SnapshotRecorder:
    """The node; raises `OSError` where the file cannot be created."""
    if params.snapshot_s is None:
        return Recorder(params)
    recorder = SnapshotRecorder(params)
    recorder.listen()
    return recorder
