"""`mirrorwave launch`: a graph of processes from a launch file."""

from __future__ import annotations

import os
import queue
import sys
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import typer

from mirrorwave import early_start
from mirrorwave.commands.captures.bag_options import Raw, command_line, recorder_params, require_new_recording
from mirrorwave.completion import Overrides, complete_launch_files, complete_profiles
from mirrorwave.console import DEFAULT_DOMAIN, Domain, ExitCode, print_line, printable, progress_bar
from mirrorwave.exit_signals import stopped_by_signal
from msgs.values.wording import counted

_COLOURS = ("cyan", "green", "magenta", "blue", "bright_cyan", "bright_green", "bright_magenta", "bright_blue")
_LEVEL_STYLES = {"warning": "yellow", "error": "bold red", "critical": "bold red"}


def launch(
    file: Annotated[
        Path, typer.Argument(metavar="LAUNCH_FILE", help="Launch file (YAML).", autocompletion=complete_launch_files)
    ],
    param: Overrides = None,
    params_file: Annotated[Path | None, typer.Option(help="YAML mapping of node to parameters.")] = None,
    profile: Annotated[
        str | None,
        typer.Option(
            metavar="NAME|FILE", help="Parameters: default, accurate, ..., or a file.", autocompletion=complete_profiles
        ),
    ] = None,
    latency_budget_ms: Annotated[
        float | None,
        typer.Option(metavar="N", help="The most accurate profile whose views come N ms after the last beam."),
    ] = None,
    remeasure: Annotated[
        bool, typer.Option("--remeasure", "--measure", help="Time the profiles again, whatever is remembered.")
    ] = False,
    duration: Annotated[
        float | None, typer.Option("--duration", metavar="S", help="Stop S seconds after all nodes are ready.")
    ] = None,
    record: Annotated[
        Path | None, typer.Option(metavar="OUT", help="Record to this MCAP file, with the options of `bag record`.")
    ] = None,
    raw: Raw = False,
    split_size: Annotated[float | None, typer.Option(hidden=True)] = None,
    split_duration: Annotated[float | None, typer.Option(hidden=True)] = None,
    max_parts: Annotated[int | None, typer.Option(hidden=True)] = None,
    snapshot: Annotated[float | None, typer.Option(hidden=True)] = None,
    min_free: Annotated[float | None, typer.Option(hidden=True)] = None,
    headless: Annotated[bool, typer.Option("--headless", help="Leave out viewers.")] = False,
    group: Annotated[
        list[str] | None,
        typer.Option("--group", metavar="PROCESS=NODE,NODE", help="Host these nodes in one process, a thread each."),
    ] = None,
    runs_dir: Annotated[Path, typer.Option(hidden=True)] = Path("runs"),
    domain: Domain = DEFAULT_DOMAIN,
) -> None:
    """Run the graph of a launch file until it ends or Ctrl-C; exit code 3 if its recording lacks messages.

    At a terminal, a graph with a page keeps its last view until Ctrl-C, unless --duration or --record is given.
    """
    from mirrorwave.control.launch_params import require_params
    from mirrorwave.profiles import nodes_of_file, over_default, with_profile
    from nodes.process.launch_file import read_launch_file, read_yaml_mapping, with_overrides, with_params, with_process

    graph = read_launch_file(file)
    if profile is not None and latency_budget_ms is not None:
        raise ValueError("--profile and --latency-budget-ms must not be given together: a budget picks the profile")
    if latency_budget_ms is not None:
        # the profile that a budget picks here; says which and why
        from lab.tradeoff.latency_budget import pick, reason

        with progress_bar("trying profiles") as progress:
            timed = pick(latency_budget_ms, remeasure, progress.print)
        print_line(reason(latency_budget_ms, timed))
        profile = timed[-1].profile
    graph = over_default(graph) if profile is None else with_profile(graph, profile)
    if params_file is not None:
        graph = with_params(graph, read_yaml_mapping(params_file), str(params_file))
    graph = with_overrides(graph, param or ())
    server = early_start.take()
    in_profile = [] if profile is None else nodes_of_file(profile)
    in_file = [] if params_file is None else [(name, str(params_file)) for name in read_yaml_mapping(params_file)]
    overrides = [(override.partition(".")[0].strip(), f"-p {override}") for override in param or ()]
    require_params(graph, [*in_profile, *in_file, *overrides], server, str(file))
    for nodes in group or ():
        graph = with_process(graph, nodes)
    options = recorder_params(split_size, split_duration, max_parts, snapshot, min_free)
    if record is None and (raw or options):
        raise ValueError("--raw and the options of recording need --record OUT")
    options |= {"raw": True} if raw else {}
    raise typer.Exit(
        run_graph(graph, domain, duration, record, options, headless=headless, runs_dir=runs_dir, server=server)
    )


def run_graph(
    graph: Any,
    domain: str = DEFAULT_DOMAIN,
    duration_s: float | None = None,
    record: Path | None = None,
    options: dict[str, Any] | None = None,
    *,
    headless: bool = False,
    runs_dir: Path = Path("runs"),
    server: Any = None,
) -> int:
    """Supervise a `LaunchFile`, one coloured log on the terminal; returns the graph's exit code.

    `record` names a recording of it all, `options` the recorder's parameters; where it lacks messages the code is 3.
    `server`: the fork server that was started early, which it closes.
    """
    from msgs.bus.zmq import run_dir
    from nodes.process.launch_file import with_origin, with_recorder, without_viewers
    from nodes.process.supervisor import Supervisor

    if headless:
        graph = without_viewers(graph)
    if record is not None:
        record = record.absolute()
        require_new_recording(record, options or {})
        graph = with_recorder(graph, record, options)
    graph = with_origin(graph, command_line(), run_dir(domain))
    earlier = [] if record is None else _recorded_files(record)
    with LogPrinter(log_lines(list(graph.nodes))) as printer:
        supervisor = Supervisor(
            graph, run_dir(domain), runs_dir=runs_dir, duration_s=duration_s, on_log=printer, server=server,
            holds=duration_s is None and record is None and _is_watched(graph),
        )  # fmt: skip
        with stopped_by_signal(supervisor.request_stop):
            code = supervisor.run()
            if record is not None and code == ExitCode.DONE:
                code = code_of_recordings([path for path in _recorded_files(record) if path not in earlier])
    return code


def _is_watched(graph: Any) -> bool:
    """Return whether somebody at a terminal may look at a page of the graph, and can end it by Ctrl-C."""
    try:
        at_terminal = sys.stdout.isatty() and os.tcgetpgrp(sys.stdout.fileno()) == os.getpgrp()
    except (OSError, ValueError):
        return False
    return at_terminal and any(entry.viewer for entry in graph.nodes.values())


def _recorded_files(record: Path) -> list[Path]:
    # here: a graph that records nothing starts earlier and smaller without it
    from nodes.recording.files import recorded_files

    return recorded_files(record)


def code_of_recordings(files: list[Path]) -> int:
    """3 where one of the recordings lacks messages or ended too early, each said in a line, else 0."""
    from msgs.recording.mcap import Losses, RecordingReader

    code = ExitCode.DONE
    for path in files:
        with RecordingReader(path) as reader:
            losses = reader.losses or Losses()
            if reader.loss or losses.ended or losses.total:
                missing = counted(losses.total, "message is missing", "messages are missing")
                said = reader.loss or losses.ended or missing
                # a recorder names its file itself
                print_line(said if said.startswith(f"{path}: ") else f"{path}: {said}")
                code = ExitCode.DONE_WITH_LOSS
    return code


class LogPrinter:
    """Shows log entries from a thread of its own: a terminal that is held (Ctrl-S, a pager) holds no graph up.

    What comes while `most` entries wait is left out and counted in a line; the log file has it all. At its end it waits
    until all has been shown.
    """

    def __init__(self, show: Callable[[dict[str, Any]], None], max_lines: int = 1000) -> None:
        self._show = show
        self._entries: queue.Queue[dict[str, Any] | None] = queue.Queue(max_lines)
        self._left_out = 0
        self._thread = threading.Thread(target=self._run, name="log", daemon=True)
        self._thread.start()

    def __call__(self, entry: dict[str, Any]) -> None:
        """Have `entry` shown; never waits."""
        try:
            if self._left_out:
                text = f"{counted(self._left_out, 'line')} left out: the terminal did not take them"
                self._entries.put_nowait({"node": "launch", "level": "warning", "text": text})
                self._left_out = 0
            self._entries.put_nowait(entry)
        except queue.Full:
            self._left_out += 1

    def __enter__(self) -> LogPrinter:
        return self

    def __exit__(self, *error: object) -> None:
        self._entries.put(None)
        self._thread.join()

    def _run(self) -> None:
        # the terminal may have gone: its lines are taken all the same
        is_there = True
        while (entry := self._entries.get()) is not None:
            try:
                if is_there:
                    self._show(entry)
            except OSError:
                is_there = False


def log_lines(nodes: list[str]) -> Callable[[dict[str, Any]], None]:
    """A printer of log entries: `[node] text` in the node's colour, warnings and errors in theirs."""
    from rich.console import Console
    from rich.text import Text

    class Terminal(Console):
        def on_broken_pipe(self) -> None:
            """The graph goes on without its terminal, where rich would end the process."""
            with open(os.devnull, "wb") as nowhere:
                os.dup2(nowhere.fileno(), sys.stdout.fileno())

    console = Terminal(highlight=False)
    styles = {name: _COLOURS[index % len(_COLOURS)] for index, name in enumerate(nodes)}

    def show(entry: dict[str, Any]) -> None:
        name = str(entry.get("node", ""))
        level_style = _LEVEL_STYLES.get(entry["level"], "")
        line = Text.assemble((f"[{name}] ", styles.get(name, "bold")), (printable(entry["text"]), level_style))
        console.print(line, soft_wrap=True)
        sys.stdout.flush()

    return show
