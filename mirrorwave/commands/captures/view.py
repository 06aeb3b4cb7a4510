"""`mirrorwave view`: a recording in the viewer's page, with a timeline."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from mirrorwave.console import file_or_sample, print_line, progress_bar

Sample = Annotated[
    bool, typer.Option("--sample", help="Take the drive past two hidden cars that ships (no RECORDING).")
]
Port = Annotated[int, typer.Option(min=0, max=65535, help="Port of the page; 0 takes a free one.")]
NoBrowser = Annotated[bool, typer.Option("--no-browser", help="Only print the address.")]
DEFAULT_PORT = 8765


def view(
    recording: Annotated[
        Path | None, typer.Argument(metavar="RECORDING", help="MCAP recording of a graph, or of process --view.")
    ] = None,
    sample: Sample = False,
    port: Port = DEFAULT_PORT,
    no_browser: NoBrowser = False,
) -> None:
    """Look at a recording in the browser: seek, step, play at any speed; Ctrl-C ends it."""
    from mirrorwave.replay.page import serve_recording

    path = file_or_sample(recording, sample, "RECORDING")
    if not sample:
        serve_recording(path, port, not no_browser, print_line)
        return
    from tempfile import TemporaryDirectory

    from mirrorwave.offline import RECORDING, run_capture

    with TemporaryDirectory(prefix="mirrorwave-") as folder:
        print_line(f"{path}: processing the sample")
        with progress_bar("scans") as advance:
            run_capture(path, Path(folder), on_scan=advance, records=True)
        serve_recording(Path(folder) / RECORDING, port, not no_browser, print_line, title="sample")
