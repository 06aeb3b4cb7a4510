"""`mirrorwave process`: a capture through the whole chain, in this process, as fast as the machine allows."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from mirrorwave.commands.captures.view import DEFAULT_PORT, NoBrowser, Port, Sample
from mirrorwave.completion import Overrides, Profile
from mirrorwave.console import AsJson, ExitCode, file_or_sample, print_json, print_line, progress_bar
from msgs.values.wording import counted

if TYPE_CHECKING:
    from mirrorwave.offline import Results


def process(
    capture: Annotated[
        Path | None,
        typer.Argument(metavar="RECORDING", help="SigMF capture or MCAP recording with raw beams or detections."),
    ] = None,
    sample: Sample = False,
    out: Annotated[
        Path | None, typer.Option(help="Folder for objects.jsonl, tracks.jsonl, timing.jsonl and bev.png.")
    ] = None,
    profile: Profile = "default",
    param: Overrides = None,
    view: Annotated[
        bool, typer.Option("--view", help="Write view.mcap too and show it in the browser; Ctrl-C ends it.")
    ] = False,
    port: Port = DEFAULT_PORT,
    no_browser: NoBrowser = False,
    as_json: AsJson = False,
) -> None:
    """Hidden objects of a capture, scan by scan, beside the truth where the capture holds it."""
    from mirrorwave.offline import RECORDING, run_capture

    if view and as_json:
        raise ValueError("--json and --view exclude each other: the page's address would follow the JSON")
    path = file_or_sample(capture, sample, "RECORDING")
    out = Path("out") / path.name.split(".")[0] if out is None else out
    with progress_bar("scans") as advance:
        results = run_capture(path, out, profile, param, advance, records=view)
    _report(results, path, out, as_json)
    if view:
        from mirrorwave.replay.page import serve_recording

        serve_recording(out / RECORDING, port, not no_browser, print_line, title=path.name)
    if results.scans_with_loss or results.capture_loss:
        raise typer.Exit(ExitCode.DONE_WITH_LOSS)


def _report(results: Results, capture: Path, out: Path, as_json: bool) -> None:
    """Print what came out, and what the capture lacks."""
    board = results.scoreboard
    if as_json:
        loss = {"scans_with_loss": results.scans_with_loss, "capture_loss": results.capture_loss}
        print_json({"out": str(out), **loss, "score": board.summary()})
        return
    board.print_table()
    print_line(f"wrote objects.jsonl, tracks.jsonl, timing.jsonl and bev.png into {out}")
    if results.scans_with_loss:
        scans = counted(results.scans, "scan")
        print_line(f"beams or detections are missing or silent in {results.scans_with_loss} of {scans}")
    if results.capture_loss:
        print_line(f"{capture}: {results.capture_loss}")
