"""`mirrorwave bag`: record, inspect, replay, recover and convert recordings."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Annotated

import typer

from mirrorwave.commands.captures.bag_copy import filter_topics, merge, report_copy
from mirrorwave.commands.captures.bag_info import print_info
from mirrorwave.commands.captures.bag_options import (
    File,
    MaxParts,
    MinFree,
    Out,
    Raw,
    SnapshotS,
    SplitDuration,
    SplitSize,
    Topics,
    command_line,
    recorder_params,
    require_new_recording,
    require_seconds,
    split_topics,
    stop_by_signal,
)
from mirrorwave.commands.captures.bag_play import play
from mirrorwave.console import (
    DEFAULT_DOMAIN,
    AsJson,
    Domain,
    ExitCode,
    print_json,
    print_line,
    print_result,
    print_table,
    progress_bar,
    require_new_file,
)
from mirrorwave.convert import formats as bag_convert
from mirrorwave.convert.formats import Conversion, Format
from mirrorwave.diagnose.running_graph import is_running, know_topics, no_graph, require_graph
from msgs.values.wording import counted

app = typer.Typer(
    help="Record, inspect, replay, recover, filter, merge and convert recordings (MCAP).", no_args_is_help=True
)
app.command()(play)
app.command("filter")(filter_topics)
app.command()(merge)
#: How long a recorder may take to write its snapshot.
_SNAPSHOT_S = 60.0


@app.command()
def record(
    out: Out,
    topics: Topics = None,
    raw: Raw = False,
    duration: Annotated[float | None, typer.Option("--duration", metavar="S", min=0.1, help="Stop after S s.")] = None,
    split_size: SplitSize = None,
    split_duration: SplitDuration = None,
    max_parts: MaxParts = None,
    snapshot: SnapshotS = None,
    min_free: MinFree = None,
    domain: Domain = DEFAULT_DOMAIN,
) -> None:
    """Record a running graph until Ctrl-C (docs/guides/recordings.md); exit code 3 if messages are missing."""
    from msgs.bus.zmq import ZmqBus, run_dir
    from nodes.node import Heartbeat, Stop, run_loop
    from nodes.recorder import Params

    options = recorder_params(split_size, split_duration, max_parts, snapshot, min_free)
    meeting_place = run_dir(domain)
    know_topics(domain)
    params = Params(
        path=str(out),
        topics=split_topics(topics),
        raw=raw,
        metadata={"command": command_line(), **_launch_of(meeting_place)},
        run_dir=str(meeting_place),
        **options,
    )
    require_new_recording(out, options)
    require_seconds("--duration", duration)
    # a recorder alone would record its own heartbeats
    require_graph(domain)
    name = f"bag_record-{os.getpid()}"
    bus = ZmqBus(name, meeting_place)
    try:
        bus.want_all()
        # the node; on its own it has nothing to stay for once the disk has refused
        from nodes.recorder import Recorder, create

        recorder = create(params) if params.snapshot_s is not None else Recorder(params, ends_when_refused=True)
        run_loop(recorder, bus, stop_by_signal(Stop(), duration), Heartbeat(bus, name))
    finally:
        bus.close()
    missing = recorder.lost + getattr(recorder, "missed", 0)
    for path in recorder.paths:
        print_line(str(path))
    print_line(f"{counted(recorder.messages, 'message')}, {missing} missing")
    if recorder.refused:
        print_line(recorder.refused)
    if missing or recorder.refused:
        raise typer.Exit(ExitCode.DONE_WITH_LOSS)


def _launch_of(run_dir: Path) -> dict[str, str]:
    """The launch file of the graph that runs in a directory, as it was resolved; nothing where there is none."""
    from mirrorwave.diagnose.running_graph import launch_of_graph
    from nodes.process.launch_file import dump_launch, without_metadata

    launch = launch_of_graph(run_dir)
    return {} if launch is None else {"launch": dump_launch(without_metadata(launch))}


@app.command()
def snapshot(as_json: AsJson = False, domain: Domain = DEFAULT_DOMAIN) -> None:
    """Have each recorder that was started with --snapshot write what it holds; done when it is written."""
    from msgs.bus.zmq import run_dir
    from nodes.recording.snapshot_trigger import ask, find_recorders

    recorders = find_recorders(run_dir(domain))
    if not recorders and not is_running(domain):
        raise no_graph(domain)
    if not recorders:
        raise ValueError(f"domain {domain!r}: no recorder with --snapshot runs here")
    answers = [ask(path, _SNAPSHOT_S) for path in recorders]
    if as_json:
        print_json(answers)
    else:
        for answer in answers:
            held = f"{counted(answer.messages, 'message')}, the last {answer.span_s:.1f} s"
            print_line(answer.error or f"{answer.path}: {held}")
    if any(answer.error for answer in answers):
        raise typer.Exit(ExitCode.FAILED)
    if any(answer.lost for answer in answers):
        raise typer.Exit(ExitCode.DONE_WITH_LOSS)


@app.command()
def info(
    file: File,
    as_json: AsJson = False,
    config: Annotated[bool, typer.Option("--config", help="Print the launch file of the recorded graph.")] = False,
) -> None:
    """Show the content of a recording, its checksums verified; exit code 3 if something is missing or damaged."""
    from msgs.recording import mcap as recording

    with progress_bar(f"reading {file.name}"):
        contents = recording.info(file)
    if config:
        if "launch" not in contents.metadata:
            raise ValueError(f"{file}: holds no launch file: recorded without a graph of `mirrorwave launch`")
        print_line(contents.metadata["launch"].rstrip())
    elif as_json:
        print_json(contents)
    else:
        print_info(contents)
    if contents.loss or (contents.losses and (contents.losses.total or contents.losses.ended)):
        raise typer.Exit(ExitCode.DONE_WITH_LOSS)


@app.command()
def recover(file: File, out: Out) -> None:
    """Copy all that is readable into a new, complete recording; exit code 3 if something was lost, 1 if all was."""
    from msgs.recording.mcap_copy import copy_recording

    require_new_file(out)
    with progress_bar(f"reading {file.name}"):
        copied = copy_recording(file, out)
    report_copy(out, *copied)


@app.command()
def convert(
    file: File,
    out: Annotated[Path, typer.Argument(metavar="OUT", help="New file (foxglove, sigmf) or folder (ros2, numpy).")],
    to: Annotated[Format | None, typer.Option("--to", help="Format; follows from OUT's suffix if left out.")] = None,
    as_json: AsJson = False,
) -> None:
    """Convert a recording for other tools (docs/guides/recordings.md); exit code 3 if something was missing or
    damaged.
    """
    require_new_file(out)
    conversion = bag_convert.convert(file, out, bag_convert.format_of(out, to), progress_bar)
    print_result(as_json, conversion, lambda: _print_conversion(conversion))
    if conversion.loss:
        raise typer.Exit(ExitCode.DONE_WITH_LOSS)


def _print_conversion(conversion: Conversion) -> None:
    print_line(
        f"{conversion.out}: {conversion.format.value}, "
        f"{counted(sum(conversion.converted.values()), 'message')} converted"
    )
    parts = (
        ("converted", conversion.converted),
        ("not converted", conversion.not_converted),
        ("left out", conversion.left_out),
    )
    rows = [(item, became, count) for became, counts in parts for item, count in counts.items()]
    print_table(("TOPIC", "WHAT BECAME OF IT", "MESSAGES"), rows)
    if conversion.loss:
        print_line(f"loss: {conversion.loss}")
