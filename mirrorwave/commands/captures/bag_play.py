"""`mirrorwave bag play`: a recording into a running graph (docs/guides/recordings.md)."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from mirrorwave.commands.captures.bag_options import EndS, File, StartS, Topics, span_ns, split_topics, stop_by_signal
from mirrorwave.console import DEFAULT_DOMAIN, AsJson, Domain, ExitCode, print_line, print_result
from msgs.bus.topics import ABOUT_NODES, TOPICS
from msgs.values.wording import counted, did_you_mean

if TYPE_CHECKING:
    from mirrorwave.replay.keys import Keyboard
    from mirrorwave.replay.schedule import Position, ReplayParams, Summary
    from msgs.bus.zmq import ZmqBus
    from msgs.recording.mcap import RecordingReader
    from nodes.node import Stop

_PLAYER = "bag_player"


def play(
    file: File,
    rate: Annotated[float, typer.Option("--rate", "-r", help="Speed, at most; 0: as fast as it goes.")] = 1.0,
    realtime: Annotated[bool, typer.Option("--realtime", help="Keep time; lose what the graph cannot take.")] = False,
    loop: Annotated[bool, typer.Option("--loop", "-l", help="Start again at the end, until Ctrl-C.")] = False,
    topics: Topics = None,
    remap: Annotated[
        list[str] | None, typer.Option("--remap", metavar="OLD:=NEW", help="Play a topic as another; repeatable.")
    ] = None,
    start: StartS = 0.0,
    end: EndS = None,
    duration: Annotated[float | None, typer.Option(hidden=True)] = None,
    clock: Annotated[bool, typer.Option("--clock", help="Move stamps onto the clock of now.")] = False,
    start_paused: Annotated[bool, typer.Option("--start-paused", help="Wait for the space key.")] = False,
    domain: Domain = DEFAULT_DOMAIN,
    as_json: AsJson = False,
) -> None:
    """Publish a recording into a graph, holding back where the graph needs longer; exit code 3 if it missed anything.

    What nodes said about themselves (diagnostics/node, log) is left out unless --topics names it, and so is what a
    living node makes itself. In a terminal: space pauses, s steps one scan, left and right seek, up and down change the
    rate, q ends.
    """
    from mirrorwave.diagnose.running_graph import know_topics
    from mirrorwave.replay.keys import Keyboard
    from mirrorwave.replay.listeners import await_nodes
    from mirrorwave.replay.schedule import ReplayParams, first_sensed_ns, require_pace
    from msgs.bus.zmq import ZmqBus, list_publishers, run_dir
    from msgs.recording.mcap import RecordingReader
    from nodes.node import Stop

    require_pace(rate, realtime, clock)
    meeting = run_dir(domain)
    know_topics(domain)
    with RecordingReader(file) as reader, Keyboard() as keyboard, ExitStack() as closing:
        if start_paused and not keyboard.is_there:
            raise ValueError("--start-paused needs a terminal: nobody could press a key")
        renamed = _renamed(reader, remap or [])
        stop = stop_by_signal(Stop(), None)
        bus = ZmqBus(_PLAYER, meeting, paced=not realtime, counted=True)
        closing.callback(bus.close)
        await_nodes(bus, meeting, lambda: stop.requested)
        topics_to_play = _playable(reader, renamed, split_topics(topics), list_publishers(meeting), domain, clock)
        first_ns = first_sensed_ns(reader, topics_to_play, renamed)
        start_ns, end_ns = span_ns(first_ns, reader.span_ns[1], start, end, duration)
        params = ReplayParams(
            topics=topics_to_play, renamed=renamed, rate=rate, keeps_time=realtime, loop=loop, first_ns=first_ns,
            start_ns=start_ns, end_ns=end_ns, on_clock=clock, paused=start_paused,
        )  # fmt: skip
        summary = _played(reader, bus, params, keyboard, meeting, stop)
    print_result(as_json, summary, lambda: _print_summary(summary))
    if not summary.is_whole:
        raise typer.Exit(ExitCode.DONE_WITH_LOSS)


def _renamed(reader: RecordingReader, remap: list[str]) -> dict[str, str]:
    """New names of topics; raises `ValueError` naming a pair that does not fit."""
    types, renamed = reader.types, {}
    for pair in remap:
        old, arrow, new = (part.strip() for part in pair.partition(":="))
        if not (old and arrow and new):
            raise ValueError(f"--remap must be OLD:=NEW, got {pair!r}")
        if old not in types:
            raise ValueError(f"--remap {pair}: {reader.path} holds no topic {old!r}; it holds {', '.join(types)}")
        if new not in TOPICS:
            near = did_you_mean(new, TOPICS)
            raise ValueError(f"--remap {pair}: unknown topic {new!r}; known are {', '.join(sorted(TOPICS))}{near}")
        if types[old] != TOPICS[new].type.__name__:
            wanted = TOPICS[new].type.__name__
            raise ValueError(f"--remap {pair}: {new} carries {wanted}, but {old} {types[old] or 'has no type'}")
        renamed[old] = new
    return renamed


def _playable(
    reader: RecordingReader,
    renamed: dict[str, str],
    wanted: tuple[str, ...] | None,
    publishers: list[tuple[str, str]],
    domain: str,
    sensed_only: bool,
) -> tuple[str, ...]:
    """Topics to play, as the recording names them: the wanted ones, or all that are known and that no node makes.

    Raises `ValueError` where a wanted one is missing, is published already or would come from two topics.
    """
    from msgs.bus.topics import plain_topic
    from nodes.player import PLAYED_TOPICS

    playable = [topic for topic in reader.types if renamed.get(topic, topic) in TOPICS]
    for topic in wanted or ():
        if topic not in playable:
            raise ValueError(
                f"{reader.path}: holds no topic {topic!r} to play; it holds {', '.join(playable) or 'none'}"
            )
    living = {topic for topic, _ in publishers}
    made = {topic for topic in living if plain_topic(topic) not in PLAYED_TOPICS}
    names = {topic: renamed.get(topic, topic) for topic in playable}
    if wanted:
        names = {topic: names[topic] for topic in playable if topic in wanted}
    else:
        names = {topic: name for topic, name in names.items() if name not in ABOUT_NODES and name not in made}
        names = {topic: name for topic, name in names.items() if plain_topic(name) in PLAYED_TOPICS or not sensed_only}
    _require_free(names, publishers, domain)
    if not names:
        raise ValueError(f"{reader.path}: holds nothing to play")
    if sensed_only and (derived := [name for name in names.values() if plain_topic(name) not in PLAYED_TOPICS]):
        raise ValueError(f"--clock moves the stamps of {', '.join(PLAYED_TOPICS)} alone, got {', '.join(derived)}")
    return tuple(names)


def _require_free(names: dict[str, str], publishers: list[tuple[str, str]], domain: str) -> None:
    """Raise `ValueError` where two would publish one topic."""
    double = sorted({name for name in names.values() if list(names.values()).count(name) > 1})
    if double:
        both = ", ".join(topic for topic, name in names.items() if name in double)
        raise ValueError(f"--remap: {both} would all be {', '.join(double)}; choose one with --topics")
    taken = [f"{topic} ({node})" for topic, node in publishers if topic in names.values()]
    if taken:
        raise ValueError(f"domain {domain!r} has living publishers of {', '.join(taken)}; choose --topics or --domain")


def _played(
    reader: RecordingReader, bus: ZmqBus, params: ReplayParams, keyboard: Keyboard, meeting: Path, stop: Stop
) -> Summary:
    """Play once all who listen are connected, with the position shown where stderr is a terminal."""
    from mirrorwave.replay.listeners import ReplayedGraph
    from mirrorwave.replay.schedule import Replay
    from nodes.node import SETTLE_S

    topics = tuple(params.renamed.get(topic, topic) for topic in params.topics)
    graph = ReplayedGraph(bus, meeting, topics, lambda: stop.requested)
    for topic in topics:
        bus.advertise(topic)
    graph.await_subscribers(SETTLE_S)
    end_ns = params.end_ns or reader.span_ns[1]
    with _shown(reader.path.name, 1e-9 * (end_ns - params.start_ns), keyboard.is_there) as show:
        return Replay(reader, bus, graph, params, stop, keyboard, show).run()


def _print_summary(summary: Summary) -> None:
    rate = "" if summary.achieved_rate is None else f", rate {summary.achieved_rate:.2f}"
    print_line(
        f"{summary.path}: {counted(sum(summary.messages.values()), 'message')} played "
        f"in {summary.elapsed_s:.2f} s{rate}"
    )
    if summary.answered_on and summary.unanswered is not None:
        answered = summary.scans - summary.unanswered
        print_line(f"{answered} of {counted(summary.scans, 'scan')} answered on {summary.answered_on}")
    elif not summary.nodes:
        print_line("no node was there to take them")
    for loss in summary.lost:
        print_line(f"lost: {loss.node}: {loss.count} x {loss.what} {loss.reason}")
    if summary.loss:
        print_line(f"{summary.path}: {summary.loss}")


@contextmanager
def _shown(name: str, total_s: float, has_keys: bool) -> Iterator[Callable[[Position], None]]:
    """A line that shows the position on stderr where that is a terminal."""
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn

    from mirrorwave.replay.keys import HELP

    console = Console(stderr=True)
    columns = (TextColumn("{task.description}"), BarColumn(), TextColumn("{task.fields[where]}"))
    with Progress(*columns, console=console, disable=not console.is_terminal) as progress:
        if has_keys and console.is_terminal:
            progress.console.print(HELP, style="dim")
        task = progress.add_task(name, total=total_s, where="")
        yield lambda position: progress.update(task, completed=position.time_s, where=_where(position, total_s))


def _where(position: Position, total_s: float) -> str:
    pace = "as fast as it goes" if position.rate == 0.0 else f"rate {position.rate:g}"
    state = "paused" if position.paused else pace
    return f"{position.time_s:.1f} of {total_s:.1f} s  {state}  {counted(position.messages, 'message')}"
