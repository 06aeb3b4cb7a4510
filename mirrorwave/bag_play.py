"""`mirrorwave bag play`: a recording into a running graph."""

from __future__ import annotations

import time
from collections.abc import Iterator
from typing import Annotated, Any

import typer

from mirrorwave.bag_options import EndS, File, StartS, Topics, span_ns, split_topics, stop_by_signal
from mirrorwave.console import DEFAULT_DOMAIN, Domain, ExitCode, print_line
from msgs.topics import TOPICS

#: What nodes say about themselves; played back, it would be taken for living nodes.
_SELF_TALK = ("diagnostics/node", "log")
_PLAYER = "bag_player"


def play(
    file: File,
    rate: Annotated[float, typer.Option("--rate", "-r", help="Speed against the recording.")] = 1.0,
    loop: Annotated[bool, typer.Option("--loop", "-l", help="Start again at the end, until Ctrl-C.")] = False,
    topics: Topics = None,
    start: StartS = 0.0,
    end: EndS = None,
    domain: Domain = DEFAULT_DOMAIN,
) -> None:
    """Publish a recording into a graph, under its own topics and in its own time.

    What nodes said about themselves (diagnostics/node, log) is left out unless --topics names it.
    """
    from msgs.recording import RecordingReader

    if not 0.0 < rate <= 1000.0:
        raise ValueError(f"--rate must be above 0 and at most 1000, got {rate:g}")
    with RecordingReader(file) as reader:
        summary = reader.info()
        chosen = _playable(summary, split_topics(topics))
        bus = _open_player(chosen, domain)
        try:
            played = _Player(reader, bus, chosen, span_ns(summary, start, end)).play(
                rate, loop, _total(summary, chosen)
            )
        finally:
            bus.close()
        print_line(f"{file}: {played} messages played")
        if reader.loss or any(reader.skipped.get(topic) for topic in chosen):
            print_line(f"{file}: {reader.loss or 'unreadable messages were left out'}")
            raise typer.Exit(ExitCode.DONE_WITH_LOSS)


def _playable(summary: Any, wanted: tuple[str, ...] | None) -> tuple[str, ...]:
    """Topics to play: the wanted ones, each of which the recording must hold, or all that this program knows."""
    known = [topic.topic for topic in summary.topics if topic.known]
    for topic in wanted or ():
        if topic not in known:
            raise ValueError(f"{summary.path}: holds no topic {topic!r} to play; it holds {', '.join(known)}")
    chosen = tuple(topic for topic in known if topic in wanted) if wanted else ()
    chosen = chosen or tuple(topic for topic in known if topic not in _SELF_TALK)
    if not chosen:
        raise ValueError(f"{summary.path}: holds nothing to play")
    return chosen


def _open_player(topics: tuple[str, ...], domain: str) -> Any:
    """A bus that publishes `topics`; refused where a living node publishes one of them already."""
    from msgs.zmq_bus import ZmqBus, list_publishers, run_dir
    from nodes.node import SETTLE_S

    taken = [f"{topic} ({node})" for topic, node in list_publishers(run_dir(domain)) if topic in topics]
    if taken:
        raise ValueError(f"domain {domain!r} has living publishers of {', '.join(taken)}; choose --topics or --domain")
    bus = ZmqBus(_PLAYER, run_dir(domain))
    for topic in topics:
        bus.advertise(topic)
    time.sleep(SETTLE_S)
    return bus


def _total(summary: Any, topics: tuple[str, ...]) -> int:
    return sum(topic.messages for topic in summary.topics if topic.topic in topics)


class _Player:
    """Publishes some topics and some span of a recording on a bus."""

    def __init__(self, reader: Any, bus: Any, topics: tuple[str, ...], span: tuple[int | None, int | None]) -> None:
        from nodes.node import Stop

        self._reader, self._bus, self._topics, self._span = reader, bus, topics, span
        self._stop = stop_by_signal(Stop(), None)

    def play(self, rate: float, loop: bool, total: int) -> int:
        """Play once, or until asked to stop; returns the number of messages."""
        from nodes.node import FLUSH_S

        self._publish_latched()
        played = 0
        with _progress() as progress:
            task = progress.add_task(self._reader.path.name, total=total)
            again = True
            while again and not self._stop.requested:
                progress.reset(task)
                for recorded in self._paced(rate):
                    self._bus.publish(recorded.topic, recorded.message)
                    progress.advance(task)
                    played += 1
                again = loop and played > 0
        self._bus.receive(FLUSH_S)
        return played

    def _publish_latched(self) -> None:
        """Whoever starts in the middle still needs what was said once, before."""
        latched = [topic for topic in self._topics if TOPICS[topic].latched]
        last = {recorded.topic: recorded for recorded in self._reader.messages(latched, None, self._span[0])}
        for recorded in last.values():
            self._bus.publish(recorded.topic, recorded.message)

    def _paced(self, rate: float) -> Iterator[Any]:
        """Hand each message out when its time has come; the bus is served meanwhile, for those who join late."""
        first_ns: int | None = None
        start_ns = self._bus.now_ns()
        for recorded in self._reader.messages(self._topics, *self._span):
            first_ns = recorded.log_time_ns if first_ns is None else first_ns
            due_ns = start_ns + int((recorded.log_time_ns - first_ns) / rate)
            while not self._stop.requested and (wait_ns := due_ns - self._bus.now_ns()) > 0:
                self._bus.receive(min(1e-9 * wait_ns, 0.1))
            if self._stop.requested:
                return
            yield recorded


def _progress() -> Any:
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

    console = Console(stderr=True)
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    return Progress(*columns, console=console, disable=not console.is_terminal)
