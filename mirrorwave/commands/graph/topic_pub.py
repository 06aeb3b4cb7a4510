"""`mirrorwave topic pub`: messages of a person's own into a running graph."""

from __future__ import annotations

import os
import time
from pathlib import Path
from typing import Annotated, Any

import typer

from mirrorwave.completion import complete_topics
from mirrorwave.console import DEFAULT_DOMAIN, Domain, ExitCode, print_line
from mirrorwave.diagnose.running_graph import know_topics, require_graph
from msgs.bus.topics import topic_facts
from msgs.values.wording import counted

#: Readers search for a new publisher several times in this.
_FIND_S = 2.0
#: The bus drops messages in transit when it is closed.
_FLUSH_S = 0.1


def pub(
    topic: Annotated[
        str, typer.Argument(metavar="TOPIC", help="Topic, as `topic list` names it.", autocompletion=complete_topics)
    ],
    value: Annotated[
        str | None, typer.Argument(metavar="VALUE", help="Fields as YAML, e.g. '{speed_mps: 3}'; the rest: defaults.")
    ] = None,
    file: Annotated[
        Path | None, typer.Option("--file", metavar="FILE", help="The same from a YAML or JSON file.")
    ] = None,
    rate: Annotated[float, typer.Option("--rate", metavar="HZ", min=0.01, max=1000.0, help="Messages a second.")] = 1.0,
    count: Annotated[int, typer.Option("--count", min=1, help="Stop after this many messages.")] = 1,
    domain: Domain = DEFAULT_DOMAIN,
) -> None:
    """Publish messages of your own; a stamp that is not given is the time of each. Exit code 3 if nobody listens."""
    from mirrorwave.control.topic_message import message_of
    from msgs.bus.zmq import ZmqBus, list_publishers, run_dir

    know_topics(domain)
    facts = topic_facts(topic)
    fields = _fields(value, file)
    # refused before anything is opened
    message_of(topic, fields, time.monotonic_ns())
    require_graph(domain)
    bus = ZmqBus(f"topic_pub-{os.getpid()}", run_dir(domain), counted=True)
    try:
        bus.advertise(facts.name)
        readers = _await_readers(bus, topic)
        start_s = time.monotonic()
        for number in range(count):
            bus.receive(max(0.0, start_s + number / rate - time.monotonic()))
            bus.publish(topic, message_of(topic, fields, bus.now_ns()))
        time.sleep(_FLUSH_S)
        readers = max(readers, bus.subscribers(topic))
    finally:
        bus.close()
    print_line(f"{topic}: {counted(count, 'message')} to {counted(readers, 'reader')}")
    rivals = [node for name, node in list_publishers(run_dir(domain)) if name == topic]
    if readers and rivals and not facts.shared:
        print_line(
            f"{topic}: {', '.join(rivals)} publishes it too; a node takes one publisher, those of the graph first"
        )
    if not readers:
        raise typer.Exit(ExitCode.DONE_WITH_LOSS)


def _fields(value: str | None, file: Path | None) -> dict[str, Any]:
    from nodes.process.launch_file import parse_yaml, read_yaml_mapping

    if (value is None) == (file is None):
        raise ValueError("topic pub takes VALUE or --file, one of them")
    if file is not None:
        return read_yaml_mapping(file)
    fields = parse_yaml(value or "", "VALUE")
    if not isinstance(fields, dict):
        raise ValueError(f"VALUE must be a mapping of fields, as '{{speed_mps: 3}}', got {value!r}")
    return fields


def _await_readers(bus: Any, topic: str) -> int:
    """Return the number of readers, waiting for the first; a reader looks for new publishers from time to time."""
    end_s = time.monotonic() + _FIND_S
    while not (readers := bus.subscribers(topic)) and time.monotonic() < end_s:
        bus.receive(0.05)
    return int(readers)
