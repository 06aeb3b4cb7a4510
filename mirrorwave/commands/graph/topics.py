"""`mirrorwave topic`: look at the topics of a running graph."""

from __future__ import annotations

import itertools
import os
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any

import msgspec
import numpy as np
import typer

from mirrorwave.completion import complete_topics
from mirrorwave.console import DEFAULT_DOMAIN, AsJson, Domain, print_json, print_line, print_table
from mirrorwave.diagnose.running_graph import FIND_S, is_running, no_graph, publishes, silence
from mirrorwave.diagnose.topic_echo import Condition, CsvLines, field_of, parse_condition, save_arrays, text_lines
from mirrorwave.terminal import ends_with_reader
from msgs.bus.codec import to_builtins
from msgs.bus.interface import Bus, Received
from msgs.bus.topics import TOPICS, topic_facts
from msgs.values.lidar import LidarSetup
from msgs.values.radar import RadarSetup
from msgs.values.wording import counted

app = typer.Typer(help="Look at the topics of a running graph.", no_args_is_help=True)

Topics = Annotated[
    list[str],
    typer.Argument(metavar="TOPIC...", help="Topics, as `topic list` names them.", autocompletion=complete_topics),
]
TopicName = Annotated[
    str, typer.Argument(metavar="TOPIC", help="Topic, as `topic list` names it.", autocompletion=complete_topics)
]
WindowS = Annotated[float, typer.Option("--duration", metavar="S", min=0.1, help="Measure this long.")]
#: A listener waits this long for its publishers; they are found well within it.
_FIND_S = 1.0


@app.command("list")
def list_topics(domain: Domain = DEFAULT_DOMAIN, as_json: AsJson = False) -> None:
    """All topics with their nominal rate and who publishes them now."""
    from mirrorwave.diagnose.foreign_topic import foreign_publishers
    from msgs.bus.zmq import list_publishers, run_dir

    publishers: dict[str, list[str]] = {name: [] for name in TOPICS}
    for topic, node in list_publishers(run_dir(domain)):
        publishers[topic].append(node)
    rows: list[dict[str, Any]] = [
        {"topic": name, "type": facts.type.__name__, "rate_hz": facts.rate_hz, "publishers": publishers[name]}
        for name, facts in TOPICS.items()
    ]
    rows += [
        {"topic": name, "type": "foreign", "rate_hz": 0.0, "publishers": nodes}
        for name, nodes in foreign_publishers(run_dir(domain)).items()
    ]
    if as_json:
        print_json(rows)
        return
    table = [(row["topic"], row["type"], row["rate_hz"] or None, ", ".join(row["publishers"]) or None) for row in rows]
    print_table(("TOPIC", "TYPE", "NOMINAL HZ", "PUBLISHERS"), table)
    _say_where_no_graph(domain)


@app.command()
def info(topic: TopicName, window: WindowS = 2.0, domain: Domain = DEFAULT_DOMAIN, as_json: AsJson = False) -> None:
    """One topic: type and fields, limits, who publishes and who reads it now, with rates and losses."""
    facts = topic_facts(topic)
    found = {
        **{name: value for name, value in msgspec.structs.asdict(facts).items() if name != "type"},
        "type": facts.type.__name__,
        "fields": {field.name: _type_name(field.type) for field in msgspec.structs.fields(facts.type)},
        **_ends(topic, window, domain),
    }
    if as_json:
        print_json(found)
        return
    ends = [(way, row) for way in ("publishers", "readers") for row in found.pop(way)]
    fields = found.pop("fields")
    for name, value in found.items():
        print_line(f"{name}: {value}")
    print_table(("FIELD", "TYPE"), fields.items())
    columns = ("node", "hz", "messages", "bytes", "lost", "rejected", "outdated")
    print_table(
        ("", *(name.upper() for name in columns)), [(way, *(row[name] for name in columns)) for way, row in ends]
    )
    _say_where_no_graph(domain)


@app.command()
def echo(
    topic: TopicName,
    field: Annotated[
        str | None, typer.Option("--field", metavar="A.B", help="Only this part; numbers count items, from 0.")
    ] = None,
    where: Annotated[
        list[str] | None,
        typer.Option("--where", metavar="TEST", help="Only messages that pass, as `speed_mps>5`; may be repeated."),
    ] = None,
    count: Annotated[int | None, typer.Option("--count", min=1, help="Stop after this many messages.")] = None,
    once: Annotated[bool, typer.Option("--once", help="Stop after one message.")] = False,
    timeout: Annotated[float | None, typer.Option("--timeout", metavar="S", help="Give up after S seconds.")] = None,
    as_csv: Annotated[bool, typer.Option("--csv", help="A line a message under one header line.")] = False,
    full: Annotated[
        bool, typer.Option("--full", help="With --json: arrays whole (base64) and not summarised.")
    ] = False,
    npy: Annotated[Path | None, typer.Option("--npy", metavar="DIR", help="Write arrays to DIR as .npy files.")] = None,
    domain: Domain = DEFAULT_DOMAIN,
    as_json: AsJson = False,
) -> None:
    """Print messages as they come, JSON one a line; arrays are summarised (dtype, shape, range)."""
    if full and not as_json:
        raise ValueError("--full must stand with --json: whole arrays are for programs")
    if as_csv and as_json:
        raise ValueError("--csv and --json must not be given together")
    if npy is not None and not npy.is_dir():
        raise NotADirectoryError(20, "must be a folder", str(npy))
    if not _are_foreign([topic], domain):
        topic_facts(topic)
    show = _Show(topic, field, [parse_condition(text) for text in where or ()], as_json, as_csv, full, npy)
    wanted = 1 if once else count
    bus = _listen(domain, [topic])
    deadline_s = None if timeout is None else time.monotonic() + timeout
    seen = 0
    try:
        with ends_with_reader():
            for received in _awaited(bus, domain, topic, deadline_s):
                seen += show.message(received)
                if seen == wanted:
                    return
    finally:
        bus.close()
    if timeout is not None and not (seen or show.refused):
        raise silence(domain, [topic], timeout)
    if timeout is not None and (seen == 0 or wanted is not None):
        refused = f", {show.refused} did not pass --where" if show.refused else ""
        raise TimeoutError(f"{topic}: {counted(seen, 'message')} in {timeout:g} s{refused}")


class _Show:
    """Prints messages the way `echo` was asked to."""

    def __init__(
        self,
        topic: str,
        field: str | None,
        conditions: list[Condition],
        as_json: bool,
        as_csv: bool,
        full: bool,
        npy: Path | None,
    ) -> None:
        known = TOPICS.get(topic)
        names = {each.name for each in msgspec.structs.fields(known.type)} if known else set()
        for path in (*(each.field for each in conditions), *([] if field is None else [field])):
            # of a foreign type nothing is known before its first message
            if names and path.partition(".")[0] not in names:
                raise ValueError(f"{path}: {topic} has no such field; its fields are {', '.join(sorted(names))}")
        self._field, self._conditions, self._npy = field, conditions, npy
        self._as_json, self._full = as_json, full
        self._csv = CsvLines() if as_csv else None
        #: Messages that did not pass.
        self.refused = 0

    def message(self, received: Received) -> bool:
        """Print a message; False where it does not pass."""
        envelope = received.envelope
        body = to_builtins(received.message, "full" if self._full else "summary")
        body = body if received.topic in TOPICS else body["body"]
        if not all(condition.holds(body) for condition in self._conditions):
            self.refused += 1
            return False
        part = body if self._field is None else field_of(body, self._field)
        head = {"publisher": envelope.publisher, "sequence": envelope.sequence, "sent_ns": envelope.sent_ns}
        if self._npy is not None:
            stem = f"{received.topic.replace('/', '.')}-{envelope.publisher}-{envelope.sequence}"
            head["arrays"] = [str(path) for path in save_arrays(received.message, self._npy, stem)]
        if self._as_json:
            # base64 as JSON has it: bytes do not survive any other way
            whole = {"topic": received.topic, **head, "message" if self._field is None else self._field: part}
            print_json(msgspec.json.decode(msgspec.json.encode(whole)) if self._full else whole)
        elif self._csv is not None:
            for line in self._csv.lines(head, part):
                print_line(line)
        else:
            self._print(received, head, part)
        return True

    def _print(self, received: Received, head: dict[str, Any], part: Any) -> None:
        if self._field is None:
            print_line(f"--- {received.topic} from {head['publisher']}, sequence {head['sequence']}")
        for line in [*text_lines(part), *(f"written: {path}" for path in head.get("arrays", ()))]:
            print_line(line)


@app.command()
def hz(topics: Topics, duration: WindowS = 2.0, domain: Domain = DEFAULT_DOMAIN, as_json: AsJson = False) -> None:
    """Rate of each publisher, from sequence numbers and sending times: messages lost on the way count too."""
    rates, _ = _measure(topics, duration, domain)
    _require_graph_heard(bool(rates), domain)
    if as_json:
        print_json(rates)
    else:
        columns = ("topic", "publisher", "messages", "rate_hz", "mean_ms", "std_ms", "max_ms", "lost")
        print_table([name.upper() for name in columns], [[row[name] for name in columns] for row in rates])
    _require_heard(topics, {row["topic"] for row in rates}, duration, domain)


@app.command()
def bw(topics: Topics, duration: WindowS = 2.0, domain: Domain = DEFAULT_DOMAIN, as_json: AsJson = False) -> None:
    """Bytes per second of each topic, header and arrays together."""
    _, volumes = _measure(topics, duration, domain)
    _require_graph_heard(any(row["messages"] for row in volumes), domain)
    if as_json:
        print_json(volumes)
    else:
        columns = ("topic", "messages", "bytes_per_s", "mean_bytes", "lost", "rejected")
        print_table([name.upper() for name in columns], [[row[name] for name in columns] for row in volumes])
    _require_heard(topics, {row["topic"] for row in volumes if row["messages"]}, duration, domain)


@app.command()
def delay(
    topics: Annotated[
        list[str] | None,
        typer.Argument(metavar="[TOPIC]...", help="All but raw beams if none.", autocompletion=complete_topics),
    ] = None,
    duration: WindowS = 2.0,
    domain: Domain = DEFAULT_DOMAIN,
    as_json: AsJson = False,
) -> None:
    """How old messages are: from acquisition to sending, on the way, and from a scan's last beam to its view."""
    from mirrorwave.diagnose.topic_delay import DelayWatch

    # raw beams only when asked for: listening to 350 MB/s changes what is measured
    wanted = list(topics or (name for name in TOPICS if name != "radar/beam"))
    bus = _listen(domain, list(dict.fromkeys([*wanted, "radar/setup", "lidar/setup"])))
    try:
        watch = DelayWatch(bus.now_ns())
        with ends_with_reader():
            for received in _messages(bus, time.monotonic() + duration):
                if isinstance(received.message, RadarSetup | LidarSetup):
                    watch.set_up(received.message)
                if received.topic in wanted:
                    watch.take(received, bus.now_ns())
    finally:
        bus.close()
    rows = watch.rows()
    _require_graph_heard(bool(rows), domain)
    if as_json:
        print_json(rows)
    elif rows:
        print_table([name.upper() for name in rows[0]], [[value or None for value in row.values()] for row in rows])
    if topics or not rows:
        _require_heard(wanted, {row["topic"] for row in rows}, duration, domain)


def _listen(domain: str, topics: list[str]) -> Bus:
    from msgs.bus.zmq import ZmqBus, run_dir

    if _are_foreign(topics, domain):
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


def _are_foreign(topics: list[str], domain: str) -> bool:
    """Whether all stand in the run directory as topics that the table does not have."""
    from mirrorwave.diagnose.foreign_topic import foreign_publishers
    from msgs.bus.zmq import run_dir

    found = foreign_publishers(run_dir(domain))
    return bool(topics) and all(topic.replace("/", ".") in found for topic in topics)


def _messages(bus: Bus, deadline_s: float | None) -> Iterator[Received]:
    while deadline_s is None or time.monotonic() < deadline_s:
        yield from bus.receive(0.1)


def _awaited(bus: Bus, domain: str, topic: str, deadline_s: float | None) -> Iterator[Received]:
    """Messages as they come; one who would wait for ever hears of it.

    Raises `ConnectionError` where no time was set and no graph has come within `FIND_S`.
    """
    first = next(_messages(bus, _earlier(deadline_s, time.monotonic() + FIND_S)), None)
    if first is not None:
        yield first
    elif deadline_s is None and not is_running(domain):
        raise no_graph(domain)
    elif deadline_s is None and not publishes(domain, topic):
        typer.echo(f"nobody publishes {topic} yet: waiting until Ctrl-C", err=True)
    yield from _messages(bus, deadline_s)


def _earlier(deadline_s: float | None, other_s: float) -> float:
    return other_s if deadline_s is None else min(deadline_s, other_s)


def _ends(topic: str, window_s: float, domain: str) -> dict[str, list[dict[str, Any]]]:
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


def _type_name(kind: Any) -> str:
    if isinstance(kind, type):
        return kind.__name__
    return str(kind).replace("msgs.values.perception.", "").replace("msgs.values.", "")


def _measure(topics: list[str], duration_s: float, domain: str) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
    """Rates by topic and publisher, volumes by topic, over `duration_s` from the first message on."""
    bus = _listen(domain, topics)
    marks: dict[tuple[str, str], list[tuple[int, int]]] = {}
    try:
        # a publisher that is slower than it takes to find it is measured from when it must have been found
        start_s = time.monotonic() + _FIND_S
        with ends_with_reader():
            for received in _messages(bus, start_s + duration_s):
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
    rates = [_rate_row(topic, node, seen) for (topic, node), seen in sorted(marks.items())]
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


def _rate_row(topic: str, publisher: str, seen: list[tuple[int, int]]) -> dict[str, Any]:
    # of this publisher: the bus counts what a topic lost, whoever sent it
    lost = sum(max(after - before - 1, 0) for (before, _), (after, _) in itertools.pairwise(seen))
    row: dict[str, Any] = {"topic": topic, "publisher": publisher, "messages": len(seen), "lost": lost}
    intervals_ms = 1e-6 * np.diff([sent_ns for _, sent_ns in seen])
    elapsed_s = 1e-9 * (seen[-1][1] - seen[0][1])
    sent = seen[-1][0] - seen[0][0]
    row["rate_hz"] = sent / elapsed_s if elapsed_s > 0.0 and sent > 0 else None
    row["mean_ms"] = float(intervals_ms.mean()) if len(intervals_ms) else None
    row["std_ms"] = float(intervals_ms.std()) if len(intervals_ms) else None
    row["max_ms"] = float(intervals_ms.max()) if len(intervals_ms) else None
    return row


def _require_heard(topics: list[str], heard: set[str], duration_s: float, domain: str) -> None:
    """Raise `OSError` naming the topics on which nothing came."""
    silent = [topic for topic in topics if topic not in heard]
    if silent:
        raise silence(domain, silent, duration_s)


def _require_graph_heard(heard: bool, domain: str) -> None:
    """Raise `ConnectionError`, before an empty table is shown, where no graph runs."""
    if not heard and not is_running(domain):
        raise no_graph(domain)


def _say_where_no_graph(domain: str) -> None:
    if not is_running(domain):
        print_line(str(no_graph(domain)))
