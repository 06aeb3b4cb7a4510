"""`mirrorwave topic`: look at the topics of a running graph."""

from __future__ import annotations

import os
import time
from collections.abc import Iterator
from typing import Annotated, Any

import numpy as np
import typer

from mirrorwave.console import DEFAULT_DOMAIN, AsJson, Domain, ExitCode, print_json, print_line, print_table
from msgs.bus import Bus, Received
from msgs.codec import to_builtins
from msgs.topics import TOPICS, topic_facts

app = typer.Typer(help="Look at the topics of a running graph.", no_args_is_help=True)

Topics = Annotated[list[str], typer.Argument(metavar="TOPIC...", help="Topics, as `topic list` names them.")]
WindowS = Annotated[float, typer.Option("--duration", metavar="S", min=0.1, help="Measure this long.")]
#: A listener waits this long for its publishers; they are found well within it.
_FIND_S = 1.0
#: Longer lists are cut on the terminal; --json keeps them whole.
_SHOWN_ITEMS = 8


@app.command("list")
def list_topics(domain: Domain = DEFAULT_DOMAIN, as_json: AsJson = False) -> None:
    """All topics with their nominal rate and who publishes them now."""
    from msgs.zmq_bus import list_publishers, run_dir

    publishers: dict[str, list[str]] = {name: [] for name in TOPICS}
    for topic, node in list_publishers(run_dir(domain)):
        publishers[topic].append(node)
    rows = [
        {"topic": name, "type": facts.type.__name__, "rate_hz": facts.rate_hz, "publishers": publishers[name]}
        for name, facts in TOPICS.items()
    ]
    if as_json:
        print_json(rows)
        return
    table = [
        (name, facts.type.__name__, facts.rate_hz or None, ", ".join(publishers[name]) or None)
        for name, facts in TOPICS.items()
    ]
    print_table(("TOPIC", "TYPE", "NOMINAL HZ", "PUBLISHERS"), table)


@app.command()
def echo(
    topic: Annotated[str, typer.Argument(help="Topic to listen to.")],
    count: Annotated[int | None, typer.Option("--count", min=1, help="Stop after this many messages.")] = None,
    once: Annotated[bool, typer.Option("--once", help="Stop after one message.")] = False,
    timeout: Annotated[float | None, typer.Option("--timeout", metavar="S", help="Give up after S seconds.")] = None,
    domain: Domain = DEFAULT_DOMAIN,
    as_json: AsJson = False,
) -> None:
    """Print messages as they come; arrays are summarised (dtype, shape, range)."""
    wanted = 1 if once else count
    bus = _listen(domain, [topic])
    deadline_s = None if timeout is None else time.monotonic() + timeout
    seen = 0
    try:
        for received in _messages(bus, deadline_s):
            _print_message(received, as_json)
            seen += 1
            if seen == wanted:
                return
    finally:
        bus.close()
    if seen == 0 or wanted is not None:
        raise TimeoutError(f"{topic}: {seen} messages in {timeout:g} s")


@app.command()
def hz(topics: Topics, duration: WindowS = 2.0, domain: Domain = DEFAULT_DOMAIN, as_json: AsJson = False) -> None:
    """Rate of each publisher, from sequence numbers and sending times: messages lost on the way count too."""
    rates, _ = _measure(topics, duration, domain)
    if as_json:
        print_json(rates)
    else:
        columns = ("topic", "publisher", "messages", "rate_hz", "mean_ms", "std_ms", "max_ms", "lost")
        print_table([name.upper() for name in columns], [[row[name] for name in columns] for row in rates])
    _require_heard(topics, {row["topic"] for row in rates}, duration)


@app.command()
def bw(topics: Topics, duration: WindowS = 2.0, domain: Domain = DEFAULT_DOMAIN, as_json: AsJson = False) -> None:
    """Bytes per second of each topic, header and arrays together."""
    _, volumes = _measure(topics, duration, domain)
    if as_json:
        print_json(volumes)
    else:
        columns = ("topic", "messages", "bytes_per_s", "mean_bytes", "lost", "rejected")
        print_table([name.upper() for name in columns], [[row[name] for name in columns] for row in volumes])
    _require_heard(topics, {row["topic"] for row in volumes if row["messages"]}, duration)


def _listen(domain: str, topics: list[str]) -> Bus:
    from msgs.zmq_bus import ZmqBus, run_dir

    for topic in topics:
        topic_facts(topic)
    bus = ZmqBus(f"topic-{os.getpid()}", run_dir(domain))
    for topic in topics:
        bus.subscribe(topic)
    return bus


def _messages(bus: Bus, deadline_s: float | None) -> Iterator[Received]:
    while deadline_s is None or time.monotonic() < deadline_s:
        yield from bus.receive(0.1)


def _print_message(received: Received, as_json: bool) -> None:
    envelope = received.envelope
    head = {"publisher": envelope.publisher, "sequence": envelope.sequence, "sent_ns": envelope.sent_ns}
    body = to_builtins(received.message)
    if as_json:
        print_json({"topic": received.topic, **head, "message": body})
        return
    print_line(f"--- {received.topic} from {envelope.publisher}, sequence {envelope.sequence}")
    for line in _lines(body, ""):
        print_line(line)


def _lines(value: dict[str, Any], indent: str) -> Iterator[str]:
    for name, item in value.items():
        if isinstance(item, dict) and "dtype" not in item:
            yield f"{indent}{name}:"
            yield from _lines(item, indent + "  ")
        elif isinstance(item, list) and item and isinstance(item[0], dict):
            yield f"{indent}{name}: {len(item)} items"
            for entry in item[:_SHOWN_ITEMS]:
                yield from _lines(entry, indent + "  - ")
        else:
            yield f"{indent}{name}: {_short(item)}"


def _short(item: Any) -> str:
    if isinstance(item, dict):
        return ", ".join(f"{name} {value}" for name, value in item.items())
    if isinstance(item, list) and len(item) > _SHOWN_ITEMS:
        return f"[{', '.join(map(str, item[:_SHOWN_ITEMS]))}, ... {len(item)} in all]"
    return str(item)


def _measure(topics: list[str], duration_s: float, domain: str) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
    """Rates by topic and publisher, volumes by topic, over `duration_s` from the first message on."""
    bus = _listen(domain, topics)
    marks: dict[tuple[str, str], list[tuple[int, int]]] = {}
    try:
        start_s = time.monotonic()
        deadline_s = start_s + _FIND_S + duration_s
        for received in _messages(bus, deadline_s):
            key = (received.topic, received.envelope.publisher)
            marks.setdefault(key, []).append((received.envelope.sequence, received.envelope.sent_ns))
            if len(marks) == 1 and len(marks[key]) == 1:
                start_s = time.monotonic()
            if time.monotonic() - start_s > duration_s and start_s < deadline_s - duration_s:
                break
        elapsed_s = min(time.monotonic() - start_s, duration_s)
        counts = {count.topic: count for count in bus.counts()[0]}
    finally:
        bus.close()
    lost = {name: count.lost for name, count in counts.items()}
    rates = [_rate_row(topic, node, seen, lost[topic]) for (topic, node), seen in sorted(marks.items())]
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


def _rate_row(topic: str, publisher: str, seen: list[tuple[int, int]], lost: int) -> dict[str, Any]:
    row: dict[str, Any] = {"topic": topic, "publisher": publisher, "messages": len(seen), "lost": lost}
    intervals_ms = 1e-6 * np.diff([sent_ns for _, sent_ns in seen])
    elapsed_s = 1e-9 * (seen[-1][1] - seen[0][1])
    sent = seen[-1][0] - seen[0][0]
    row["rate_hz"] = sent / elapsed_s if elapsed_s > 0.0 and sent > 0 else None
    row["mean_ms"] = float(intervals_ms.mean()) if len(intervals_ms) else None
    row["std_ms"] = float(intervals_ms.std()) if len(intervals_ms) else None
    row["max_ms"] = float(intervals_ms.max()) if len(intervals_ms) else None
    return row


def _require_heard(topics: list[str], heard: set[str], duration_s: float) -> None:
    silent = [topic for topic in topics if topic not in heard]
    if silent:
        print_line(f"nothing came on {', '.join(silent)} in {duration_s:g} s")
        raise typer.Exit(ExitCode.FAILED)
