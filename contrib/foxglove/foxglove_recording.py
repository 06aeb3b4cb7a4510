"""Recordings as MCAP with Foxglove's message types in JSON: the live bridge's channels, with an index."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgspec
from mcap.well_known import MessageEncoding, SchemaEncoding
from mcap.writer import CompressionType, Writer

from contrib.foxglove import foxglove_messages
from contrib.foxglove.foxglove_messages import Draft, FoxgloveStream
from contrib.foxglove.foxglove_schemas import channels
from msgs.bus.topics import TOPICS
from msgs.recording.mcap import Recorded, RecordingReader
from nodes.recording.shapes import Account, counted


def topics() -> tuple[str, ...]:
    """Return the topics that have a place in this format."""
    return (*foxglove_messages.TOPICS, *TOPICS.own())


def write(
    reader: RecordingReader, out: Path, topics: tuple[str, ...], account: Account, advance: Callable[[], None]
) -> None:
    """Write the topics as an MCAP file of JSON messages; log times stay, publish times are the messages' stamps."""
    with out.open("xb") as file:
        sink, stream = _Sink(file), FoxgloveStream()
        for recorded in counted(reader, topics, account, advance):
            drafts = stream.drafts_of(recorded.topic, recorded.message, recorded.log_time_ns)
            if not drafts:
                account.leave_out(recorded.topic, "says only how long a scan lasts")
            for draft in drafts:
                sink.put(draft, recorded)
        sink.finish()


class _Sink:
    """Writes Foxglove's messages."""

    def __init__(self, file: Any) -> None:
        self._writer = Writer(file, compression=CompressionType.ZSTD)
        self._writer.start(profile="", library="mirrorwave")
        self._offered = channels()
        self._channels: dict[str, int] = {}
        self._schemas: dict[bytes, int] = {}

    def put(self, draft: Draft, recorded: Recorded) -> None:
        """Write one message, at the time of the recorded one."""
        self._writer.add_message(
            self._channel(draft.topic),
            log_time=recorded.log_time_ns,
            publish_time=max(getattr(recorded.message, "stamp_ns", 0), 0),
            sequence=recorded.sequence,
            data=msgspec.json.encode(draft.build()),
        )

    def finish(self) -> None:
        """Write the index."""
        self._writer.finish()

    def _channel(self, topic: str) -> int:
        if topic not in self._channels:
            schema = self._schema(self._offered[topic])
            self._channels[topic] = self._writer.register_channel(topic, MessageEncoding.JSON, schema)
        return self._channels[topic]

    def _schema(self, schema: dict[str, Any]) -> int:
        text = msgspec.json.encode(schema)
        if text not in self._schemas:
            self._schemas[text] = self._writer.register_schema(schema["title"], SchemaEncoding.JSONSchema, text)
        return self._schemas[text]
