"""Listening to the topics of a running graph: messages as they come, rates and losses over a span of time."""

from __future__ import annotations

import itertools
import os
import time
from collections.abc import Iterator
from typing import Any

import numpy as np
import typer

from mirrorwave.diagnose.running_graph import FIND_S, is_running, no_graph, publishes
from mirrorwave.terminal import ends_with_reader
from msgs.bus.interface import Bus, Received
from msgs.bus.topics import topic_facts

#: A listener waits this long for its publishers; they are found well within it.
_FIND_S = 1.0


def listen(domain: str, topics: list[str]) -> Bus:
    """Return a bus that receives topics of a graph; the caller closes it."""
    from msgs.bus.zmq import ZmqBus, run_dir

    if are_foreign(topics, domain):
        from mirrorwave.diagnose.foreign_topic import ForeignBus

        foreign = ForeignBus(run_dir(domain))
        for topic in topics:
            foreign.subscribe(topic)
        return foreign
    for topic in topics:
        topic_facts(topic)
    bus = ZmqBus(f"topic-{os.getpid()}", run_dir(domain))
    for topic in topics:
        bus.subscribe(topic)
    return bus


def are_foreign(topics: list[str], domain: str) -> bool:
    """Return whether all stand in the run directory as topics that the table does not have."""
    from mirrorwave.diagnose.foreign_topic import foreign_publishers
    from msgs.bus.zmq import run_dir

    publishers = foreign_publishers(run_dir(domain))
    return bool(topics) and all(topic.replace("/", ".") in publishers for topic in topics)


def messages(bus: Bus, deadline_s: float | None) -> Iterator[Received]:
    """Yield messages as they come, up to a time of the monotonic clock."""
    while deadline_s is None or time.monotonic() < deadline_s:
        yield from bus.receive(0.1)


def awaited(bus: Bus, domain: str, topic: str, deadline_s: float | None) -> Iterator[Received]:
    """Messages as they come; one who would wait for ever hears of it.

    Raises `ConnectionError` where no time was set and no graph has come within `FIND_S`.
    """
    find_s = time.monotonic() + FIND_S
    first = next(messages(bus, find_s if deadline_s is None else min(deadline_s, find_s)), None)
    if first is not None:
        yield first
    elif deadline_s is None and not is_running(domain):
        raise no_graph(domain)
    elif deadline_s is None and not publishes(domain, topic):
        typer.echo(f"nobody publishes {topic} yet: waiting until Ctrl-C", err=True)
    yield from messages(bus, deadline_s)


def ends_of(topic: str, window_s: float, domain: str) -> dict[str, list[dict[str, Any]]]:
    """Publishers and readers of a topic, as sockets and heartbeats tell."""
    from mirrorwave.commands.graph.nodes import collect_heartbeats, topic_rows
    from msgs.bus.zmq import list_publishers, run_dir

    opened = [node for name, node in list_publishers(run_dir(domain)) if name == topic]
    rows: dict[str, dict[str, dict[str, Any]]] = {"in": {}, "out": {}}
    for name, beats in collect_heartbeats(run_dir(domain), window_s).items():
        for row in topic_rows(beats):
            if row["topic"] == topic:
                rows[row["way"]][name] = {"node": name, **row}
    quiet = dict.fromkeys(("hz", "messages", "bytes", "lost", "rejected", "outdated"))
    silent = {name: {"node": name, **quiet} for name in opened if name not in rows["out"]}
    return {"publishers": [*rows["out"].values(), *silent.values()], "readers": list(rows["in"].values())}


def measure(topics: list[str], duration_s: float, domain: str) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
    """Rates by topic and publisher, volumes by topic, over `duration_s` from the first message on."""
    bus = listen(domain, topics)
    marks: dict[tuple[str, str], list[tuple[int, int]]] = {}
    try:
        # a publisher that is slower than it takes to find it is measured from when it must have been found
        start_s = time.monotonic() + _FIND_S
        with ends_with_reader():
            for received in messages(bus, start_s + duration_s):
                if not marks:
                    start_s = min(start_s, time.monotonic())
                key = (received.topic, received.envelope.publisher)
                marks.setdefault(key, []).append((received.envelope.sequence, received.envelope.sent_ns))
                if time.monotonic() - start_s > duration_s:
                    break
        elapsed_s = min(max(time.monotonic() - start_s, 0.0), duration_s)
        counts = {count.topic: count for count in bus.counts()[0]}
    finally:
        bus.close()
    rates = [_rate_row(topic, node, arrivals) for (topic, node), arrivals in sorted(marks.items())]
    volumes = [
        {
            "topic": name,
            "messages": count.messages,
            "bytes_per_s": count.bytes / elapsed_s,
            "mean_bytes": count.bytes / count.messages if count.messages else None,
            "lost": count.lost,
            "rejected": count.rejected,
        }
        for name, count in counts.items()
    ]
    return rates, volumes


def _rate_row(topic: str, publisher: str, arrivals: list[tuple[int, int]]) -> dict[str, Any]:
    # of this publisher: the bus counts what a topic lost, whoever sent it
    lost = sum(max(after - before - 1, 0) for (before, _), (after, _) in itertools.pairwise(arrivals))
    row: dict[str, Any] = {"topic": topic, "publisher": publisher, "messages": len(arrivals), "lost": lost}
    intervals_ms = 1e-6 * np.diff([sent_ns for _, sent_ns in arrivals])
    elapsed_s = 1e-9 * (arrivals[-1][1] - arrivals[0][1])
    sent = arrivals[-1][0] - arrivals[0][0]
    row["rate_hz"] = sent / elapsed_s if elapsed_s > 0.0 and sent > 0 else None
    row["mean_ms"] = float(intervals_ms.mean()) if len(intervals_ms) else None
    row["std_ms"] = float(intervals_ms.std()) if len(intervals_ms) else None
    row["max_ms"] = float(intervals_ms.max()) if len(intervals_ms) else None
    return row
