"""`mirrorwave bag`: record, inspect, replay, recover, trim and convert recordings."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Annotated, Any

import typer

from mirrorwave import bag_convert
from mirrorwave.bag_convert import Conversion, Format
from mirrorwave.bag_options import EndS, File, Out, StartS, Topics, span_ns, split_topics, stop_by_signal
from mirrorwave.bag_play import play
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

app = typer.Typer(help="Record, inspect, replay, recover, trim and convert recordings (MCAP).", no_args_is_help=True)
app.command()(play)


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
        recorder = Recorder(Params(path=str(out), topics=split_topics(topics), raw=raw))
        stop = stop_by_signal(Stop(), duration)
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
    start_ns, end_ns = span_ns(recording.info(file), start, end)
    count, loss = recording.copy_recording(
        file, out, topics=split_topics(topics), start_ns=start_ns, end_ns=end_ns, compress=compress
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
