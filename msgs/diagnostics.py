"""Health of the graph: heartbeats (topic `diagnostics/node`) and log records (topic `log`)."""

from __future__ import annotations

from enum import StrEnum

import msgspec


class NodeState(StrEnum):
    """Life of a node, as its heartbeat says it."""

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


class TopicCount(msgspec.Struct, frozen=True, kw_only=True):
    """Messages of one topic since the node started."""

    topic: str
    messages: int
    bytes: int
    #: Lost on the way, by gaps in the sequence numbers.
    lost: int = 0
    #: Arrived but unreadable.
    rejected: int = 0


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


class LogRecord(msgspec.Struct, frozen=True, kw_only=True):
    """One line of a node's log."""

    stamp_ns: int
    node: str
    level: str
    text: str
