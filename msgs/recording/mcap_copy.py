"""Recordings of recordings, copied byte for byte: whole ones of damaged ones, spans, topics, several in one."""

from __future__ import annotations

import contextlib
import dataclasses
import heapq
import itertools
from collections import Counter
from collections.abc import Callable, Collection, Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

from mcap.records import Channel, Message

from msgs.bus.topics import TOPICS, plain_topic
from msgs.files.whole_files import require_room
from msgs.recording.mcap import METADATA_NAME, RAW_TOPIC, RecordingReader, new_file, publisher_of
from msgs.recording.mcap_writer import McapFile
from msgs.values.arrays import require_positive

#: Messages of one publisher and topic that a later source is searched for: two recorders of one graph write what was
#: sent within milliseconds in another order.
_MAX_KEPT = 4096


class _Selection(NamedTuple):
    """Part of a recording: topics (None: all), log times with the start and without the end, every so many messages."""

    topics: Collection[str] | None = None
    start_ns: int | None = None
    end_ns: int | None = None
    #: Of each publisher of a topic that is not latched; the first, and then every so many.
    every: int = 1


class Copied(NamedTuple):
    """Account of a copy."""

    messages: int
    #: What the sources had lost, in words.
    loss: str | None
    #: Messages that more than one source held.
    repeated: int = 0


def copy_recording(
    source: Path,
    target: Path,
    *,
    topics: Collection[str] | None = None,
    start_ns: int | None = None,
    end_ns: int | None = None,
    every: int = 1,
    compress: bool = False,
    overwrite: bool = False,
    on_message: Callable[[], None] = lambda: None,
) -> tuple[int, str | None]:
    """Copy a recording, or part of it, into a new and complete file: recover, trim, filter, compress.

    `every`: of each publisher of a topic that is not latched, the first message and then every so many. The last
    message of each latched topic from before `start_ns` comes first, as if it were sent again then. Returns the number
    of messages and what the source had lost; raises `ValueError` for one that is no recording, `OSError` where the
    target exists or has no room.
    """
    require_positive("every", every)
    selection = _Selection(topics, start_ns, end_ns, every)
    copied = _copied([source], Path(target), selection, compress, overwrite, on_message)
    return copied.messages, copied.loss


def merge_recordings(sources: Sequence[Path], target: Path, *, on_message: Callable[[], None] = lambda: None) -> Copied:
    """Copy recordings into one, in order of log time, each message once; errors as `copy_recording`.

    Metadata records are those of the first source that has one of the name; others' carry the name of their file.
    """
    return _copied(sources, Path(target), _Selection(), False, False, on_message)


def _copied(
    sources: Sequence[Path],
    target: Path,
    selection: _Selection,
    compress: bool,
    overwrite: bool,
    on_message: Callable[[], None],
) -> Copied:
    with contextlib.ExitStack() as stack:
        readers = [stack.enter_context(RecordingReader(source)) for source in sources]
        file = stack.enter_context(new_file(target, overwrite))
        if selection.topics is None:
            require_room(target, sum(reader.stored_bytes(selection.start_ns, selection.end_ns) for reader in readers))
        writer = McapFile(file, METADATA_NAME)
        for name, values in _metadata(readers):
            writer.add_metadata(name, values)
        streams = [_Source(reader, writer, compress).messages(selection) for reader in readers]
        repeats = _Repeats()
        for source, channel, raw in heapq.merge(*streams, key=lambda item: item[2].log_time):
            on_message()
            if len(readers) == 1 or repeats.is_new(channel, raw):
                writer.add_message(source.number_of(channel), raw.sequence, raw.log_time, raw.publish_time, raw.data)
        writer.finish()
        losses = [(reader.path, reader.loss) for reader in readers if reader.loss]
    texts = [loss if len(sources) == 1 else f"{path.name}: {loss}" for path, loss in losses]
    return Copied(writer.messages, "; ".join(texts) or None, repeats.count)


def _metadata(readers: Sequence[RecordingReader]) -> Iterator[tuple[str, dict[str, str]]]:
    """Yield the metadata records of several recordings, those of a name that exists already under another."""
    names: set[str] = set()
    for reader in readers:
        for name, values in reader.metadata_records.items():
            yield (name if name not in names else f"{name} ({reader.path.name})"), values
            names.add(name)


class _Source:
    """One recording on its way into another."""

    def __init__(self, reader: RecordingReader, writer: McapFile, compress: bool) -> None:
        self._reader, self._writer, self._compress = reader, writer, compress
        # a damaged file may declare one number twice, and differently
        self._channels: dict[tuple[int, str], int] = {}

    def messages(self, selection: _Selection) -> Iterator[tuple[_Source, Channel, Message]]:
        """Yield the selected messages in order of log time."""
        start_ns, topics = selection.start_ns, selection.topics
        before = [] if start_ns is None else _latched_before(self._reader, start_ns, topics)
        numbers: Counter[int] = Counter()
        for channel, raw in itertools.chain(before, self._reader.raw_messages(start_ns, selection.end_ns, topics)):
            numbers[channel.id] += 1
            if (numbers[channel.id] - 1) % selection.every == 0 or (
                channel.topic in TOPICS and TOPICS[channel.topic].latched
            ):
                yield self, channel, raw

    def number_of(self, channel: Channel) -> int:
        """Return the number that a channel has in the new file."""
        key = channel.id, channel.topic
        if key not in self._channels:
            schema = self._reader.schema_of(channel)
            number = self._writer.add_schema(schema.name, schema.encoding, schema.data) if schema else 0
            compressed = self._compress or plain_topic(channel.topic) != RAW_TOPIC
            self._channels[key] = self._writer.add_channel(
                channel.topic, channel.message_encoding, number, channel.metadata, compressed=compressed
            )
        return self._channels[key]


class _Repeats:
    """Recognises messages that another source has given: the same bytes, number and stamp of the same publisher."""

    def __init__(self) -> None:
        self._recent: dict[tuple[str, str], dict[tuple[int, int, int], None]] = {}
        self.count = 0

    def is_new(self, channel: Channel, raw: Message) -> bool:
        """Note a message; return False for one that was noted before, and count it."""
        recent = self._recent.setdefault((channel.topic, publisher_of(channel)), {})
        key = raw.sequence, raw.publish_time, hash(raw.data)
        if key in recent:
            self.count += 1
            return False
        recent[key] = None
        if len(recent) > _MAX_KEPT:
            del recent[next(iter(recent))]
        return True


def _latched_before(
    reader: RecordingReader, start_ns: int, topics: Collection[str] | None
) -> list[tuple[Channel, Message]]:
    held = (topic for topic in reader.types if topic in TOPICS and (topics is None or topic in topics))
    latched = [topic for topic in held if TOPICS[topic].latched]
    last = {channel.id: (channel, raw) for channel, raw in reader.raw_messages(None, start_ns, latched)}
    return [(channel, dataclasses.replace(raw, log_time=start_ns)) for channel, raw in last.values()]
