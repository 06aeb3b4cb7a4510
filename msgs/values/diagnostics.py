"""Health of the graph: heartbeats (topic `diagnostics/node`) and log records (topic `log`)."""

from __future__ import annotations

from enum import StrEnum

import msgspec

#: Durations of a stage that travel with one heartbeat at most.
SAMPLES_LIMIT = 128


class NodeState(StrEnum):
    """Life cycle of a node, as its heartbeat reports it."""

    STARTING = "starting"
    READY = "ready"
    DEGRADED = "degraded"
    STOPPING = "stopping"


class StageTime(msgspec.Struct, frozen=True, kw_only=True):
    """Duration of one stage over the last heartbeat interval."""

    name: str
    count: int
    last_ms: float
    mean_ms: float
    max_ms: float
    #: Single durations in order, at most `SAMPLES_LIMIT` evenly chosen: quantiles over several heartbeats need them.
    samples_ms: tuple[float, ...] = ()


class TopicCount(msgspec.Struct, frozen=True, kw_only=True):
    """Messages of one topic since the node started."""

    topic: str
    messages: int
    bytes: int
    #: Lost in transit, by gaps in the sequence numbers.
    lost: int = 0
    #: Arrived but unreadable.
    rejected: int = 0
    #: Arrived, and skipped because a newer one waited beside it (topics whose receivers want the newest only).
    outdated: int = 0


class ShedCount(msgspec.Struct, frozen=True, kw_only=True):
    """Work that a node dropped since it started, so as not to fall behind: kind, reason and count."""

    what: str
    reason: str
    count: int


class NodeStatus(msgspec.Struct, frozen=True, kw_only=True):
    """Heartbeat of a node."""

    stamp_ns: int
    node: str
    pid: int
    state: NodeState
    reason: str = ""
    uptime_s: float = 0.0
    cpu_s: float = 0.0
    resident_bytes: int = 0
    stages: tuple[StageTime, ...] = ()
    received: tuple[TopicCount, ...] = ()
    published: tuple[TopicCount, ...] = ()
    shed: tuple[ShedCount, ...] = ()


class LogRecord(msgspec.Struct, frozen=True, kw_only=True):
    """One line of a node's log."""

    stamp_ns: int
    node: str
    level: str
    text: str
