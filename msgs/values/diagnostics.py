"""Health of the graph: heartbeats (topic `diagnostics/node`) and log records (topic `log`)."""

from __future__ import annotations

from enum import StrEnum
from typing import ClassVar

from msgs.values.arrays import Checked, Count, Milliseconds, Seconds, StampNs

#: Durations of a stage that travel with one heartbeat at most.
SAMPLES_LIMIT = 128


class NodeState(StrEnum):
    """Life cycle of a node, as its heartbeat reports it."""

    STARTING = "starting"
    READY = "ready"
    DEGRADED = "degraded"
    STOPPING = "stopping"


class StageTime(Checked, frozen=True, kw_only=True):
    """Duration of one stage over the last heartbeat interval."""

    label: ClassVar[str] = "stage"

    name: str
    count: Count
    last_ms: Milliseconds
    mean_ms: Milliseconds
    max_ms: Milliseconds
    #: Single durations in order, at most `SAMPLES_LIMIT` evenly chosen: quantiles over several heartbeats need them.
    samples_ms: tuple[Milliseconds, ...] = ()


class TopicCount(Checked, frozen=True, kw_only=True):
    """Messages of one topic since the node started."""

    label: ClassVar[str] = "topic_count"

    topic: str
    messages: Count
    bytes: Count
    #: Lost in transit, by gaps in the sequence numbers.
    lost: Count = 0
    #: Arrived but unreadable.
    rejected: Count = 0
    #: Arrived, and skipped because a newer one waited beside it (topics whose receivers want the newest only).
    outdated: Count = 0


class ShedCount(Checked, frozen=True, kw_only=True):
    """Work that a node dropped since it started, so as not to fall behind: kind, reason and count."""

    label: ClassVar[str] = "shed"

    what: str
    reason: str
    count: Count


class NodeStatus(Checked, frozen=True, kw_only=True):
    """Heartbeat of a node."""

    label: ClassVar[str] = "status"

    stamp_ns: StampNs
    node: str
    pid: Count
    state: NodeState
    reason: str = ""
    uptime_s: Seconds = 0.0
    cpu_s: Seconds = 0.0
    resident_bytes: Count = 0
    stages: tuple[StageTime, ...] = ()
    received: tuple[TopicCount, ...] = ()
    published: tuple[TopicCount, ...] = ()
    shed: tuple[ShedCount, ...] = ()


class LogRecord(Checked, frozen=True, kw_only=True):
    """One line of a node's log."""

    label: ClassVar[str] = "log"

    stamp_ns: StampNs
    node: str
    level: str
    text: str
