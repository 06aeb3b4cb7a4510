"""Shared work of all recorders around their files: names, metadata, latched messages, losses, free disk space."""

from __future__ import annotations

import errno
import math
import os
import re
from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from datetime import UTC, datetime
from pathlib import Path

import msgspec

from msgs.bus.interface import Received
from msgs.bus.topics import topic_facts
from msgs.recording.mcap import Encoded, Losses, TopicLoss, encoded
from msgs.values.diagnostics import TopicCount
from nodes.process.machine import machine_facts

_BYTES_PER_MB = 1_000_000


class LatchedMessages:
    """The last message of each latched topic and publisher: a file that begins later needs it too."""

    def __init__(self) -> None:
        self._last: dict[tuple[str, str], Encoded] = {}

    def note(self, message: Encoded) -> None:
        """Keep `message` if its topic is latched."""
        if topic_facts(message.topic).latched:
            self._last[message.topic, message.publisher] = message

    def before(self, messages: Iterable[Encoded], start_ns: int) -> list[Encoded]:
        """Return the latched messages that are not among `messages`, as if sent again at `start_ns`."""
        there = {id(message) for message in messages}
        return [message._replace(sent_ns=start_ns) for message in self._last.values() if id(message) not in there]


def as_recorded(received: Received) -> Encoded:
    """Return a message that came in as it stands in a recording."""
    envelope = received.envelope
    return encoded(
        received.topic,
        received.message,
        publisher=envelope.publisher,
        sequence=envelope.sequence,
        sent_ns=envelope.sent_ns,
    )


def free_path(path: Path) -> Path:
    """`path`, or where it exists, as after a restart, the first free of name-2, name-3, ..."""
    candidate, number = path, 1
    while candidate.exists():
        number += 1
        candidate = path.with_name(f"{path.stem}-{number}{path.suffix}")
    return candidate


def numbered_path(path: Path, number: int) -> Path:
    """File `number` of a recording in several: name-00001.mcap, ..., so that names sort by time."""
    return path.with_name(f"{path.stem}-{number:05d}{path.suffix}")


def numbered_files(path: Path) -> dict[int, Path]:
    """Files of a recording in several that exist, by their numbers, the lowest first."""
    pattern = re.compile(re.escape(path.stem) + r"-(\d{5,})" + re.escape(path.suffix))
    names = os.listdir(path.parent) if path.parent.is_dir() else []
    files = {int(match[1]): path.with_name(name) for name in names if (match := pattern.fullmatch(name))}
    return dict(sorted(files.items()))


def recorded_files(path: Path) -> list[Path]:
    """Return the files that recorders of `path` have made: the file itself, those of restarts beside it, its parts."""
    pattern = re.compile(re.escape(path.stem) + r"-([1-9]\d{0,3})" + re.escape(path.suffix))
    names = os.listdir(path.parent) if path.parent.is_dir() else []
    restarts = sorted((int(match[1]), name) for name in names if (match := pattern.fullmatch(name)))
    first = [path] if path.exists() else []
    return [*first, *(path.with_name(name) for _, name in restarts), *numbered_files(path).values()]


def next_number(path: Path) -> int:
    """Number behind the highest that exists."""
    return max(numbered_files(path), default=0) + 1


def about_this_run(metadata: Mapping[str, str]) -> dict[str, str]:
    """`metadata` and the machine, as JSON, and the time of day."""
    return {
        **metadata,
        "machine": msgspec.json.encode(machine_facts()).decode(),
        "started_utc": datetime.now(UTC).isoformat(timespec="milliseconds"),
    }


def losses_between(
    before: Iterable[TopicCount],
    after: Iterable[TopicCount],
    missed: Counter[str] | None = None,
    ended: str | None = None,
) -> Losses:
    """Return the losses of the bus between two of its counts and, per topic, those of the recorder itself."""
    first = {count.topic: count for count in before}
    last = {count.topic: count for count in after}
    missed = missed or Counter()
    losses = (_loss(topic, first.get(topic), last.get(topic), missed[topic]) for topic in sorted({*last, *missed}))
    return Losses(topics=tuple(loss for loss in losses if loss.total), ended=ended or None)


def _loss(topic: str, first: TopicCount | None, last: TopicCount | None, missed: int) -> TopicLoss:
    first = first or TopicCount(topic=topic, messages=0, bytes=0)
    last = last or first
    return TopicLoss(
        topic=topic,
        lost=last.lost - first.lost,
        rejected=last.rejected - first.rejected,
        outdated=last.outdated - first.outdated,
        missed=missed,
    )


def _mb(size: int, rounded: Callable[[float], int]) -> str:
    """Return megabytes with a decimal, if not whole."""
    return f"{rounded(10 * size / _BYTES_PER_MB) / 10:.1f}".removesuffix(".0")


def require_kept_free(path: Path, kept_bytes: int, growth_bytes: int, free: int) -> None:
    """Raise `OSError` where fewer than `kept_bytes` of the `free` ones would be left once a file has grown."""
    if free - growth_bytes < kept_bytes:
        # rounded apart: what is free is less than the sum as printed, too
        needed = f"{_mb(growth_bytes, math.ceil)} MB are needed to finish the file"
        reason = f"{_mb(free, math.floor)} MB free, {needed} and {_mb(kept_bytes, math.ceil)} MB are to stay free"
        raise OSError(errno.ENOSPC, reason, str(path))
