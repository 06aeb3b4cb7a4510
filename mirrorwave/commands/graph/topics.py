"""`mirrorwave topic`: look at the topics of a running graph, and publish."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Annotated, Any

import msgspec
import typer

from mirrorwave.commands.graph.topic_pub import pub
from mirrorwave.completion import complete_topics
from mirrorwave.console import DEFAULT_DOMAIN, AsJson, Domain, print_json, print_line, print_rows, print_table
from mirrorwave.diagnose.running_graph import is_running, know_topics, no_graph, silence
from mirrorwave.diagnose.topic_echo import Condition, CsvLines, field_of, parse_condition, save_arrays, text_lines
from mirrorwave.diagnose.topic_rates import are_foreign, awaited, ends_of, listen, measure, messages
from mirrorwave.reference import fields_of
from mirrorwave.terminal import ends_with_reader
from msgs.bus.codec import to_builtins
from msgs.bus.interface import Received
from msgs.bus.topics import TOPICS, topic_facts
from msgs.values.diagnostics import NodeStatus
from msgs.values.lidar import LidarSetup
from msgs.values.radar import RadarSetup
from msgs.values.wording import counted

app = typer.Typer(help="Look at the topics of a running graph, and publish.", no_args_is_help=True)
app.command()(pub)

Topics = Annotated[
    list[str],
    typer.Argument(metavar="TOPIC", help="Topics, as `topic list` names them.", autocompletion=complete_topics),
]
TopicName = Annotated[
    str, typer.Argument(metavar="TOPIC", help="Topic, as `topic list` names it.", autocompletion=complete_topics)
]
WindowS = Annotated[float, typer.Option("--window", "--duration", metavar="S", min=0.1, help="Measure this long.")]


@app.command("list")
def list_topics(domain: Domain = DEFAULT_DOMAIN, as_json: AsJson = False) -> None:
    """All topics with their nominal rate and who publishes them now."""
    from mirrorwave.diagnose.foreign_topic import foreign_publishers
    from msgs.bus.zmq import list_publishers, run_dir

    # first: it makes the topics of a running graph known
    published = list_publishers(run_dir(domain))
    publishers: dict[str, list[str]] = {name: [] for name in TOPICS}
    for topic, node in published:
        publishers[topic].append(node)
    rows: list[dict[str, Any]] = [
        {"topic": name, "type": facts.type.__name__, "rate_hz": facts.rate_hz, "publishers": publishers[name]}
        for name, facts in TOPICS.items()
    ]
    rows += [
        {"topic": name, "type": "foreign", "rate_hz": 0.0, "publishers": nodes}
        for name, nodes in foreign_publishers(run_dir(domain)).items()
    ]
    for line in TOPICS.refused.values():
        typer.echo(f"left out: {line}", err=True)
    if as_json:
        print_json(rows)
        return
    table = [(row["topic"], row["type"], row["rate_hz"] or None, ", ".join(row["publishers"]) or None) for row in rows]
    print_table(("TOPIC", "TYPE", "NOMINAL HZ", "PUBLISHERS"), table, ("NOMINAL HZ",))
    _say_where_no_graph(domain)


@app.command()
def info(topic: TopicName, window: WindowS = 2.0, domain: Domain = DEFAULT_DOMAIN, as_json: AsJson = False) -> None:
    """One topic: type and fields, limits, who publishes and who reads it now, with rates and losses."""
    know_topics(domain)
    facts = topic_facts(topic)
    about = {
        **({"name": topic} | msgspec.structs.asdict(facts) | {"type": facts.type.__name__}),
        "fields": {field.name: field.annotation.replace("\\|", "|") for field in fields_of(facts.type)},
        **ends_of(topic, window, domain),
    }
    if as_json:
        print_json(about)
        return
    ends = [{"": side, **row} for side in ("publishers", "readers") for row in about.pop(side)]
    fields = about.pop("fields")
    print_table(("TOPIC", about.pop("name")), about.items())
    print_table(("FIELD", "TYPE"), fields.items())
    columns = ("", "node", "hz", "messages", "bytes", "lost", "rejected", "outdated")
    print_rows(columns, ends, ("bytes", "messages", "outdated"))
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
    full: Annotated[bool, typer.Option("--full", help="With --json: whole arrays, in base64.")] = False,
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
    if not are_foreign([topic], domain):
        topic_facts(topic)
    show = _Show(topic, field, [parse_condition(text) for text in where or ()], as_json, as_csv, full, npy)
    wanted = 1 if once else count
    bus = listen(domain, [topic])
    deadline_s = None if timeout is None else time.monotonic() + timeout
    shown = 0
    try:
        with ends_with_reader():
            for received in awaited(bus, domain, topic, deadline_s):
                shown += show.message(received)
                if shown == wanted:
                    return
    finally:
        bus.close()
    if timeout is not None and not (shown or show.refused):
        raise silence(domain, [topic], timeout)
    if timeout is not None and (shown == 0 or wanted is not None):
        refused = f", {show.refused} did not pass --where" if show.refused else ""
        raise TimeoutError(f"{topic}: {counted(shown, 'message')} in {timeout:g} s{refused}")


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
        topic_facts = TOPICS.get(topic)
        names = {each.name for each in msgspec.structs.fields(topic_facts.type)} if topic_facts else set()
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
    rates, _ = measure(topics, duration, domain)
    _require_graph_heard(bool(rates), domain)
    if as_json:
        print_json(rates)
    else:
        columns = ("topic", "publisher", "messages", "rate_hz", "mean_ms", "std_ms", "max_ms", "lost")
        print_rows(columns, rates, ("std_ms", "messages", "mean_ms"))
    _require_heard(topics, {row["topic"] for row in rates}, duration, domain)


@app.command()
def bw(topics: Topics, duration: WindowS = 2.0, domain: Domain = DEFAULT_DOMAIN, as_json: AsJson = False) -> None:
    """Bytes per second of each topic, header and arrays together."""
    _, volumes = measure(topics, duration, domain)
    _require_graph_heard(any(row["messages"] for row in volumes), domain)
    if as_json:
        print_json(volumes)
    else:
        columns = ("topic", "messages", "bytes_per_s", "mean_bytes", "lost", "rejected")
        print_rows(columns, volumes, ("mean_bytes", "messages"))
    _require_heard(topics, {row["topic"] for row in volumes if row["messages"]}, duration, domain)


@app.command()
def delay(
    topics: Annotated[
        list[str] | None,
        typer.Argument(metavar="TOPIC", help="All but raw beams and set-ups if none.", autocompletion=complete_topics),
    ] = None,
    duration: WindowS = 2.0,
    domain: Domain = DEFAULT_DOMAIN,
    as_json: AsJson = False,
) -> None:
    """Measure the age of messages: from acquisition to sending, on the bus, and from a scan's last beam to its view."""
    from mirrorwave.diagnose.topic_delay import DelayWatch

    know_topics(domain)
    # raw beams only when asked for: listening to 350 MB/s changes what is measured; what is latched has no delay
    wanted = list(topics or (name for name in TOPICS if name != "radar/beam" and not TOPICS[name].latched))
    bus = listen(domain, list(dict.fromkeys([*wanted, "radar/setup", "lidar/setup", "diagnostics/node"])))
    try:
        watch = DelayWatch(bus.now_ns())
        with ends_with_reader():
            for received in messages(bus, time.monotonic() + duration):
                if isinstance(received.message, RadarSetup | LidarSetup):
                    watch.set_up(received.message)
                if isinstance(received.message, NodeStatus):
                    watch.hear(received.message, bus.now_ns())
                if received.topic in wanted:
                    watch.take(received, bus.now_ns())
    finally:
        bus.close()
    rows = watch.rows()
    _require_graph_heard(bool(rows), domain)
    if as_json:
        print_json(rows)
    elif rows:
        least = ("messages", "p90_ms", "max_ms", "p99_ms")
        print_rows([*rows[0]][:-1], [row for row in rows if row["messages"]], least)
        for row in (row for row in rows if row["remark"]):
            print_line(f"{row['topic']} of {row['publisher']}, {row['delay']}: {row['remark']}")
    if topics or not rows:
        _require_heard(wanted, {row["topic"] for row in rows}, duration, domain)


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
