"""`mirrorwave process`: a capture through the whole chain, in this process, as fast as the machine allows."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from mirrorwave.completion import complete_profiles
from mirrorwave.console import AsJson, ExitCode, compile_line, print_json, print_line, scan_counter
from msgs.values.wording import counted


def process(
    capture: Annotated[Path, typer.Argument(help="SigMF capture or MCAP recording with raw beams or detections.")],
    out: Annotated[
        Path | None, typer.Option(help="Folder for objects.jsonl, tracks.jsonl, timing.jsonl and bev.png.")
    ] = None,
    profile: Annotated[
        str, typer.Option(help="Named parameters: fast, balanced, ...", autocompletion=complete_profiles)
    ] = "default",
    param: Annotated[
        list[str] | None, typer.Option("--param", "-p", metavar="NODE.KEY=VALUE", help="Override; may be repeated.")
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Hidden objects of a capture, scan by scan, beside the truth where the capture holds it."""
    from mirrorwave.offline import run_capture

    out = Path("out") / capture.name.split(".")[0] if out is None else out
    with compile_line(), scan_counter() as advance:
        results = run_capture(capture, out, profile, param, advance)
    board = results.scoreboard
    if as_json:
        loss = {"scans_with_loss": results.scans_with_loss, "capture_loss": results.capture_loss}
        print_json({"out": str(out), **loss, "score": board.summary()})
    else:
        board.print_table()
        print_line(f"wrote objects.jsonl, tracks.jsonl, timing.jsonl and bev.png into {out}")
        if results.scans_with_loss:
            scans = counted(results.scans, "scan")
            print_line(f"beams or detections are missing or silent in {results.scans_with_loss} of {scans}")
        if results.capture_loss:
            print_line(f"{capture}: {results.capture_loss}")
    if results.scans_with_loss or results.capture_loss:
        raise typer.Exit(ExitCode.DONE_WITH_LOSS)
