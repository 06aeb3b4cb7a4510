"""Parameters of a recorder, which both of its modes read."""

from __future__ import annotations

import logging
from typing import ClassVar

import msgspec

from msgs.bus.topics import TOPICS, plain_topic, topic_facts
from msgs.recording.mcap import RAW_TOPIC

_LOG = logging.getLogger(__name__)

#: Seconds and bytes are fewer: what is larger would be no time and no size any more.
_MAX = 1e18


class RecordingParams(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Place and content of a recording; at most one of splitting and snapshots."""

    formerly: ClassVar[dict[str, str]] = {"snapshot_bytes": "nodes.recording.snapshot_recorder"}

    path: str
    #: None: all topics but raw beams.
    topics: tuple[str, ...] | None = None
    #: Raw beams too.
    raw: bool = False
    #: Written into the recording's metadata.
    metadata: dict[str, str] = {}
    #: A new file before one grows larger, and when one has lasted so long; path is then name-00001.mcap, ...
    split_bytes: int | None = None
    split_s: float | None = None
    #: The oldest file of this run is deleted when there are more.
    max_parts: int | None = None
    #: Hold the last seconds in memory, in at most 1 GiB, and write them when SIGUSR1 comes.
    snapshot_s: float | None = None
    #: The recording ends in good order before the disk has less room than this.
    min_free_bytes: int = 100_000_000
    #: Where `mirrorwave bag snapshot` finds the recorder; a launch fills it in.
    run_dir: str | None = None

    def __post_init__(self) -> None:
        if not self.path:
            raise ValueError("path must name a file")
        for topic in self.topics or ():
            topic_facts(topic)
        for name in ("split_bytes", "split_s", "max_parts", "snapshot_s"):
            value = getattr(self, name)
            if value is not None and not 0 < value < _MAX:
                raise ValueError(f"{name} must be above zero and below {_MAX:g}, got {value!r}")
        if self.min_free_bytes < 0:
            raise ValueError(f"min_free_bytes must not be negative, got {self.min_free_bytes!r}")
        if self.max_parts is not None and not self.splits:
            raise ValueError(f"max_parts needs split_bytes or split_s, got {self.max_parts!r} without")
        if self.snapshot_s is not None and self.splits:
            raise ValueError("snapshot_s must not stand beside split_bytes or split_s: each snapshot is a file already")

    @property
    def splits(self) -> bool:
        """True if the recording is split into several files."""
        return self.split_bytes is not None or self.split_s is not None

    def selected_topics(self) -> tuple[str, ...]:
        """Topics to record, in the order of the topic table; the log says which declaration is left out."""
        raw = {topic for topic in TOPICS if plain_topic(topic) == RAW_TOPIC}
        wanted = set(TOPICS) - raw if self.topics is None else set(self.topics)
        for line in TOPICS.refused.values() if self.topics is None else ():
            _LOG.warning("not recorded: %s", line)
        return tuple(topic for topic in TOPICS if topic in wanted or (self.raw and topic in raw))
