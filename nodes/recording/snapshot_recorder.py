"""The recorder's other mode: the last seconds in memory, written to a file of their own at each trigger."""

from __future__ import annotations

import logging
import signal
import threading
from collections import deque
from pathlib import Path

from msgs.bus.interface import Outgoing, Received
from msgs.files.whole_files import free_bytes
from msgs.recording.mcap import Encoded, Losses, whole_recording
from msgs.values.diagnostics import NodeState, TopicCount
from msgs.values.units import s_from_ns
from nodes.node import Node
from nodes.recording.files import (
    LatchedMessages,
    about_this_run,
    as_recorded,
    losses_between,
    next_number,
    numbered_path,
    require_kept_free,
)
from nodes.recording.params import RecordingParams
from nodes.recording.snapshot_trigger import Snapshot, TriggerFile

_LOG = logging.getLogger(__name__)

#: What a message weighs in memory beside its bytes, about.
_OVERHEAD_BYTES = 300
_COUNTS_INTERVAL_NS = 1_000_000_000


class Ring:
    """The messages of the last `span_ns`, in at most `limit_bytes`, the oldest given up first."""

    def __init__(self, span_ns: int, limit_bytes: int) -> None:
        self.bytes = 0
        self._span_ns, self._limit_bytes = span_ns, limit_bytes
        self._messages: deque[Encoded] = deque()

    def append(self, message: Encoded) -> None:
        """Take a message in."""
        self._messages.append(message)
        self.bytes += _weight(message)
        self.trim(message.sent_ns)
        while self.bytes > self._limit_bytes:
            self._drop()

    def trim(self, now_ns: int) -> None:
        """Let go of what is older than the span."""
        while self._messages and self._messages[0].sent_ns < now_ns - self._span_ns:
            self._drop()

    def messages(self) -> list[Encoded]:
        """Return the messages in memory, in order of arrival."""
        return list(self._messages)

    def _drop(self) -> None:
        self.bytes -= _weight(self._messages.popleft())


def _weight(message: Encoded) -> int:
    return len(message.data) + _OVERHEAD_BYTES


#: Most bytes that are held: what a vehicle's computer has to spare.
SNAPSHOT_BYTES = 1 << 30


class SnapshotRecorder(Node):
    """Holds the last seconds and writes them, while it goes on listening, when triggered.

    The trigger is SIGUSR1 once `listen` was called, `mirrorwave bag snapshot` (which sends it), or `trigger()`.
    """

    wants_all = True
    takes_all_publishers = True

    def __init__(self, params: RecordingParams, limit_bytes: int = SNAPSHOT_BYTES) -> None:
        super().__init__()
        assert params.snapshot_s is not None
        self.inputs = params.selected_topics()
        #: Snapshots written so far.
        self.paths: list[Path] = []
        #: Messages in them, and messages that never came.
        self.messages = self.lost = 0
        #: Why the last snapshot could not be written.
        self.refused = ""
        self._params = params
        self._ring = Ring(round(1e9 * params.snapshot_s), limit_bytes)
        self._latched = LatchedMessages()
        self._counts: deque[tuple[int, tuple[TopicCount, ...]]] = deque()
        self._triggered = False
        self._writing: threading.Thread | None = None
        self._door: TriggerFile | None = None

    def listen(self) -> None:
        """Obey SIGUSR1, and let `mirrorwave bag snapshot` find this process; for the main thread of one."""
        signal.signal(signal.SIGUSR1, lambda number, frame: self.trigger())
        if self._params.run_dir is not None:
            self._door = TriggerFile(Path(self._params.run_dir))

    def trigger(self) -> None:
        """Ask for a snapshot: what the ring holds at the next step."""
        self._triggered = True

    def pending(self) -> bool:
        """True while a snapshot is asked for and none is being written."""
        return self._triggered and (self._writing is None or not self._writing.is_alive())

    def step(self, inputs: list[Received], now_ns: int) -> list[Outgoing]:
        """Take in what came; start to write if that was asked for."""
        with self.stages("keep"):
            for received in inputs:
                message = as_recorded(received)
                self._latched.note(message)
                self._ring.append(message)
            # keep the bus's counts of about the ring's first moment: their growth since is what a snapshot lacks
            if not self._counts or now_ns - self._counts[-1][0] >= _COUNTS_INTERVAL_NS:
                self._counts.append((now_ns, self.counts()))
            kept_ns = round(1e9 * (self._params.snapshot_s or 0.0))
            while len(self._counts) > 1 and self._counts[1][0] <= now_ns - kept_ns:
                self._counts.popleft()
        if self.pending():
            self._start_writing(now_ns)
        return []

    def health(self) -> tuple[NodeState, str]:
        """DEGRADED while the last snapshot could not be written."""
        return (NodeState.DEGRADED, self.refused) if self.refused else (NodeState.READY, "")

    def close(self) -> None:
        """Wait for the snapshot that is being written; one that was only asked for is dropped."""
        if self._writing is not None:
            self._writing.join()
        if self._door is not None:
            self._door.close()
        _LOG.info("%s: %d snapshots, %d messages", self._params.path, len(self.paths), self.messages)

    def _start_writing(self, now_ns: int) -> None:
        self._triggered = False
        self._ring.trim(now_ns)
        messages = self._ring.messages()
        start_ns = min((message.sent_ns for message in messages), default=now_ns)
        latched = self._latched.before(messages, start_ns)
        losses = losses_between(self._counts[0][1], self.counts())
        if self._door is not None:
            self._door.say_busy()
        self._writing = threading.Thread(target=self._write, args=(latched + messages, losses))
        self._writing.start()

    def _write(self, messages: list[Encoded], losses: Losses) -> None:
        """Write a snapshot and answer, whatever becomes of it; in a thread of its own."""
        path = numbered_path(Path(self._params.path), next_number(Path(self._params.path)))
        size = sum(len(message.data) for message in messages)
        try:
            require_kept_free(path, self._params.min_free_bytes, size, free_bytes(path.absolute().parent))
            with whole_recording(path, about_this_run(self._params.metadata)) as writer:
                for message in messages:
                    writer.write_encoded(message)
                writer.write_losses(losses)
            self._note_written(path, messages, losses)
        except OSError as error:
            self.refused = f"{path}: snapshot not written: {error.strerror or error}"
            _LOG.error("%s", self.refused)
            self._answer(Snapshot(path=str(path), error=self.refused))

    def _note_written(self, path: Path, messages: list[Encoded], losses: Losses) -> None:
        self.refused = ""
        self.paths.append(path)
        self.messages += len(messages)
        self.lost += losses.total
        times = [message.sent_ns for message in messages] or [0]
        span_s = s_from_ns(max(times) - min(times))
        _LOG.info("%s: %d messages, the last %.1f s", path, len(messages), span_s)
        self._answer(Snapshot(path=str(path.absolute()), messages=len(messages), span_s=span_s, lost=losses.total))

    def _answer(self, snapshot: Snapshot) -> None:
        if self._door is not None:
            self._door.answer(snapshot)
