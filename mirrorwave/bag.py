"""`mirrorwave bag`: record, inspect, replay, recover, trim and convert recordings."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any

import typer

from mirrorwave import bag_convert
from mirrorwave.bag_convert import Conversion, Format
from mirrorwave.console import (
    DEFAULT_DOMAIN,
    AsJson,
    Domain,
    ExitCode,
    print_json,
    print_line,
    print_table,
    progress_bar,
    require_new_file,
)
from msgs.topics import TOPICS

app = typer.Typer(help="Record, inspect, replay, recover, trim and convert recordings (MCAP).", no_args_is_help=True)

File = Annotated[Path, typer.Argument(metavar="FILE", help="Recording.")]
Out = Annotated[Path, typer.Argument(metavar="OUT", help="New recording.")]
Topics = Annotated[str | None, typer.Option("--topics", metavar="A,B", help="Only these topics, by comma.")]
StartS = Annotated[float, typer.Option("--start", metavar="S", min=0.0, help="Leave out the first S seconds.")]
EndS = Annotated[float | None, typer.Option("--end", metavar="S", min=0.0, help="Stop S seconds from the start.")]

#: What nodes say about themselves; played back, it would be taken for living nodes.
_SELF_TALK = ("diagnostics/node", "log")
_PLAYER = "bag_player"


@app.command()
def record(
    out: Out,
    topics: Topics = None,
    raw: Annotated[bool, typer.Option("--raw", help="Raw beams too (350 MB/s).")] = False,
    duration: Annotated[float | None, typer.Option("--duration", metavar="S", min=0.1, help="Stop after S s.")] = None,
    domain: Domain = DEFAULT_DOMAIN,
) -> None:
    """Record a running graph until Ctrl-C; exit code 3 if messages were lost on the way."""
    from msgs.zmq_bus import ZmqBus, run_dir
    from nodes.node import Heartbeat, Stop, run_loop
    from nodes.recorder import Params, Recorder

    require_new_file(out)
    bus = ZmqBus(f"bag_record-{os.getpid()}", run_dir(domain))
    try:
        recorder = Recorder(Params(path=str(out), topics=_split(topics), raw=raw))
        stop = _stop_by_signal(Stop(), duration)
        run_loop(recorder, bus, stop, Heartbeat(bus, f"bag_record-{os.getpid()}"))
        lost = sum(count.lost + count.rejected for count in bus.counts()[0]) + recorder.missed
    finally:
        bus.close()
    print_line(f"{out}: {recorder.messages} messages, {lost} lost")
    if lost:
        raise typer.Exit(ExitCode.DONE_WITH_LOSS)


@app.command()
def info(file: File, as_json: AsJson = False) -> None:
    """What a recording holds, its checksums verified; exit code 3 if something is missing or damaged."""
    from msgs import recording

    found = recording.info(file)
    if as_json:
        print_json(found)
    else:
        _print_info(found)
    if found.loss:
        raise typer.Exit(ExitCode.DONE_WITH_LOSS)


@app.command()
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
        chosen = _playable(summary, _split(topics))
        bus = _open_player(chosen, domain)
        try:
            played = _Player(reader, bus, chosen, _spans(summary, start, end)).play(rate, loop, _total(summary, chosen))
        finally:
            bus.close()
        print_line(f"{file}: {played} messages played")
        if reader.loss or any(reader.skipped.get(topic) for topic in chosen):
            print_line(f"{file}: {reader.loss or 'unreadable messages were left out'}")
            raise typer.Exit(ExitCode.DONE_WITH_LOSS)


@app.command()
def recover(file: File, out: Out) -> None:
    """Copy all that is readable into a new, complete recording; exit code 3 if something was lost, 1 if all was."""
    from msgs.recording import copy_recording

    require_new_file(out)
    count, loss = copy_recording(file, out)
    _report_copy(out, count, loss)


@app.command()
def trim(
    file: File,
    out: Out,
    start: StartS = 0.0,
    end: EndS = None,
    topics: Topics = None,
    compress: Annotated[bool, typer.Option("--compress", help="Compress with zstd.")] = False,
) -> None:
    """Copy a span of time, or some topics, into a new recording."""
    from msgs import recording

    require_new_file(out)
    start_ns, end_ns = _spans(recording.info(file), start, end)
    count, loss = recording.copy_recording(
        file, out, topics=_split(topics), start_ns=start_ns, end_ns=end_ns, compress=compress
    )
    _report_copy(out, count, loss)


@app.command()
def convert(
    file: File,
    out: Annotated[Path, typer.Argument(metavar="OUT", help="New file (foxglove, sigmf) or folder (ros2, numpy).")],
    to: Annotated[Format | None, typer.Option("--to", help="Format; follows from OUT's suffix if left out.")] = None,
    as_json: AsJson = False,
) -> None:
    """Convert a recording for other tools (docs/convert.md); exit code 3 if something was missing or damaged."""
    require_new_file(out)
    found = bag_convert.convert(file, out, bag_convert.format_of(out, to), progress_bar)
    if as_json:
        print_json(found)
    else:
        _print_conversion(found)
    if found.loss:
        raise typer.Exit(ExitCode.DONE_WITH_LOSS)


def _print_conversion(found: Conversion) -> None:
    print_line(f"{found.out}: {found.format.value}, {sum(found.converted.values())} messages converted")
    parts = (("converted", found.converted), ("not converted", found.not_converted), ("left out", found.left_out))
    rows = [(what, became, count) for became, counts in parts for what, count in counts.items()]
    print_table(("TOPIC", "WHAT BECAME OF IT", "MESSAGES"), rows)
    if found.loss:
        print_line(f"loss: {found.loss}")


def _report_copy(out: Path, count: int, loss: str | None) -> None:
    print_line(f"{out}: {count} messages" + (f"; the source had lost some: {loss}" if loss else ""))
    if loss:
        raise typer.Exit(ExitCode.DONE_WITH_LOSS if count else ExitCode.FAILED)


def _split(topics: str | None) -> tuple[str, ...] | None:
    return None if topics is None else tuple(name.strip() for name in topics.split(",") if name.strip())


def _spans(summary: Any, start_s: float, end_s: float | None) -> tuple[int | None, int | None]:
    """Seconds from the start of a recording as its own times."""
    if end_s is not None and end_s <= start_s:
        raise ValueError(f"--end must be after --start {start_s:g}, got {end_s:g}")
    start_ns = summary.start_ns + int(1e9 * start_s)
    return start_ns, None if end_s is None else summary.start_ns + int(1e9 * end_s)


def _print_info(found: Any) -> None:
    print_line(f"{found.path}: {found.size_bytes / (1 << 20):.1f} MiB, {found.duration_s:.2f} s")
    complete, checksums = "yes" if found.complete else "no", "good" if found.checksums_agree else "bad"
    print_line(f"complete: {complete}, checksums: {checksums}")
    if found.loss:
        print_line(f"loss: {found.loss}")
    columns = ("TOPIC", "TYPE", "MESSAGES", "BYTES", "HZ", "PUBLISHERS")
    rows = [
        (topic.topic, topic.type or None, topic.messages, topic.bytes, topic.rate_hz, ", ".join(topic.publishers))
        for topic in found.topics
    ]
    print_table(columns, rows)


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
        self._stop = _stop_by_signal(Stop(), None)

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


def _stop_by_signal(stop: Any, duration_s: float | None) -> Any:
    """Have SIGINT, SIGTERM and, after `duration_s`, the alarm clock ask for the end."""
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGALRM):
        # at once: publishers go on, so what waits would never end
        signal.signal(number, lambda _number, _frame: stop.request(at_once=True))
    if duration_s is not None:
        signal.setitimer(signal.ITIMER_REAL, duration_s)
    return stop
