"""`mirrorwave launch`: a graph of processes from a launch file."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import typer

from mirrorwave.console import DEFAULT_DOMAIN, Domain, require_new_file

_COLOURS = ("cyan", "green", "magenta", "blue", "bright_cyan", "bright_green", "bright_magenta", "bright_blue")
_LEVEL_STYLES = {"warning": "yellow", "error": "bold red", "critical": "bold red"}


def launch(
    file: Annotated[Path, typer.Argument(help="Launch file (YAML).")],
    param: Annotated[
        list[str] | None, typer.Option("--param", "-p", metavar="NODE.KEY=VALUE", help="Override; may be repeated.")
    ] = None,
    params_file: Annotated[Path | None, typer.Option(help="YAML mapping of node to parameters.")] = None,
    duration: Annotated[
        float | None, typer.Option("--duration", metavar="S", help="Stop S seconds after all nodes are ready.")
    ] = None,
    record: Annotated[Path | None, typer.Option("--record", metavar="OUT", help="Record to this MCAP file.")] = None,
    raw: Annotated[bool, typer.Option("--raw", help="Record raw beams too (350 MB/s).")] = False,
    headless: Annotated[bool, typer.Option("--headless", help="Leave out viewers.")] = False,
    runs_dir: Annotated[Path, typer.Option(help="Where each run gets a folder for its log.")] = Path("runs"),
    domain: Domain = DEFAULT_DOMAIN,
) -> None:
    """Run the graph of a launch file until it ends or Ctrl-C."""
    from nodes.launch_file import read_launch_file, read_yaml_mapping, with_overrides, with_params

    graph = read_launch_file(file)
    if params_file is not None:
        graph = with_params(graph, read_yaml_mapping(params_file), str(params_file))
    graph = with_overrides(graph, param or ())
    raise typer.Exit(run_graph(graph, domain, duration, record, raw=raw, headless=headless, runs_dir=runs_dir))


def run_graph(
    graph: Any,
    domain: str = DEFAULT_DOMAIN,
    duration_s: float | None = None,
    record: Path | None = None,
    *,
    raw: bool = False,
    headless: bool = False,
    runs_dir: Path = Path("runs"),
) -> int:
    """Supervise a `LaunchFile`, one coloured log on the terminal; returns the graph's exit code."""
    from msgs.zmq_bus import run_dir
    from nodes.launch_file import with_recorder, without_viewers
    from nodes.supervisor import Supervisor

    if headless:
        graph = without_viewers(graph)
    if record is not None:
        require_new_file(record)
        graph = with_recorder(graph, record.absolute(), raw)
    printer = log_printer(list(graph.nodes))
    return Supervisor(graph, run_dir(domain), runs_dir=runs_dir, duration_s=duration_s, on_log=printer).run()


def log_printer(nodes: list[str]) -> Callable[[dict[str, Any]], None]:
    """A sink for log entries: `[node] text` in the node's colour, warnings and errors in theirs."""
    from rich.console import Console
    from rich.text import Text

    console = Console(highlight=False)
    styles = {name: _COLOURS[index % len(_COLOURS)] for index, name in enumerate(nodes)}

    def show(entry: dict[str, Any]) -> None:
        name = str(entry.get("node", ""))
        level_style = _LEVEL_STYLES.get(entry["level"], "")
        line = Text.assemble((f"[{name}] ", styles.get(name, "bold")), (entry["text"], level_style))
        console.print(line, soft_wrap=True)
        sys.stdout.flush()

    return show
