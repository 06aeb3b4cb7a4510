"""`mirrorwave bag filter` and `merge`: recordings made of recordings."""

from __future__ import annotations

from collections.abc import Collection
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Annotated

import typer

from mirrorwave.commands.captures.bag_options import EndS, File, Out, StartS, span_ns, split_topics
from mirrorwave.console import ExitCode, print_line, progress_bar, require_new_file
from msgs.values.wording import counted


def filter_topics(
    file: File,
    out: Out,
    topic: Annotated[
        list[str] | None, typer.Option(metavar="PATTERN", help="Topics to keep, e.g. 'perception/*'; may be repeated.")
    ] = None,
    not_topic: Annotated[
        list[str] | None, typer.Option(metavar="PATTERN", help="Topics to leave out; may be repeated.")
    ] = None,
    every: Annotated[
        int, typer.Option(metavar="N", min=1, help="Keep every Nth message of a publisher; latched topics whole.")
    ] = 1,
    start: StartS = 0.0,
    end: EndS = None,
    topics: Annotated[str | None, typer.Option(hidden=True)] = None,
) -> None:
    """Copy a span of time, the topics that patterns name, or every Nth message, into a new recording."""
    from msgs.recording.mcap import RecordingReader
    from msgs.recording.mcap_copy import copy_recording

    require_new_file(out)
    with RecordingReader(file) as reader:
        start_ns, end_ns = span_ns(*reader.span_ns, start, end)
        wanted = _selected(
            reader.types, [*(topic or ()), *(split_topics(topics) or ())] or ["*"], not_topic or [], file
        )
        total = sum(info.messages for info in reader.info().topics if info.topic in wanted)
        is_whole = len(wanted) == len(reader.types)
    with progress_bar(out.name, total) as advance:
        copied = copy_recording(
            file, out, topics=None if is_whole else wanted, start_ns=start_ns, end_ns=end_ns, every=every,
            on_message=advance,
        )  # fmt: skip
    report_copy(out, *copied)


def _selected(held: Collection[str], kept: list[str], left_out: list[str], file: Path) -> list[str]:
    """Return the topics that patterns select; `ValueError` for a pattern that names none, and where none is left."""
    for pattern in (*kept, *left_out):
        if not any(fnmatchcase(name, pattern) for name in held):
            raise ValueError(f"{file}: no topic matches {pattern!r}; it holds {', '.join(held) or 'none'}")
    matching = [name for name in held if any(fnmatchcase(name, pattern) for pattern in kept)]
    selected = [name for name in matching if not any(fnmatchcase(name, pattern) for pattern in left_out)]
    if not selected:
        raise ValueError(f"{file}: --topic and --not-topic leave no topic")
    return selected


def merge(
    files: Annotated[list[Path], typer.Argument(metavar="RECORDING", help="Recordings of one clock.")],
    out: Annotated[Path, typer.Option("--out", metavar="OUT", help="New recording.")],
) -> None:
    """Copy recordings into one, by time; messages that several hold come once."""
    from msgs.recording.mcap import info
    from msgs.recording.mcap_copy import merge_recordings

    if len(files) < 2:
        raise ValueError(f"merge takes two recordings or more, got {len(files)}")
    if len({path.resolve() for path in files}) < len(files):
        raise ValueError("merge takes each recording once")
    require_new_file(out)
    total = sum(topic.messages for path in files for topic in info(path).topics)
    with progress_bar(out.name, total) as advance:
        copied = merge_recordings(files, out, on_message=advance)
    if copied.repeated:
        print_line(f"{counted(copied.repeated, 'message')} in more than one of them")
    report_copy(out, copied.messages, copied.loss)


def report_copy(out: Path, count: int, loss: str | None) -> None:
    """Print what was written; exit code 3 if the source had lost some, 1 if all."""
    print_line(f"{out}: {counted(count, 'message')}" + (f"; the source had lost some: {loss}" if loss else ""))
    if loss:
        raise typer.Exit(ExitCode.DONE_WITH_LOSS if count else ExitCode.FAILED)
