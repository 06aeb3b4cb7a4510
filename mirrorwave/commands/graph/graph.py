"""`mirrorwave graph`: who publishes and who reads which topic, of a running graph or a launch file."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from mirrorwave.completion import complete_launch_files
from mirrorwave.console import DEFAULT_DOMAIN, AsJson, Domain, print_json, print_line, require_new_file


def graph(
    file: Annotated[
        Path | None,
        typer.Argument(
            metavar="LAUNCH_FILE",
            help="Launch file; without one, the running graph.",
            autocompletion=complete_launch_files,
        ),
    ] = None,
    dot: Annotated[Path | None, typer.Option(metavar="FILE", help="Write it for Graphviz (dot -Tsvg FILE).")] = None,
    window: Annotated[float, typer.Option(metavar="S", min=0.6, help="Listen this long for rates.")] = 2.2,
    domain: Domain = DEFAULT_DOMAIN,
    as_json: AsJson = False,
) -> None:
    """Nodes and topics of a running graph, with rates and losses, or of a launch file."""
    from mirrorwave.diagnose.graph_picture import dot_text, launch_picture, running_picture, text_lines

    if dot is not None:
        require_new_file(dot)
    picture = running_picture(domain, window) if file is None else launch_picture(file)
    if dot is not None:
        dot.write_text(dot_text(picture), encoding="utf-8")
    if as_json:
        print_json(picture.as_dict())
    elif dot is None:
        for line in text_lines(picture):
            print_line(line)
