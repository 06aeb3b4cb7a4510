"""Shared options of `mirrorwave bag` and `launch --record`: arguments, spans of time, the request to stop."""

from __future__ import annotations

import shlex
import signal
import sys
from pathlib import Path
from typing import Annotated, Any

import typer

from mirrorwave.console import require_new_file
from mirrorwave.exit_signals import is_asked_again
from msgs.values.units import ns_from_s, s_from_ns

File = Annotated[Path, typer.Argument(metavar="RECORDING", help="Recording (MCAP).")]
Out = Annotated[Path, typer.Argument(metavar="OUT", help="New recording.")]
Topics = Annotated[str | None, typer.Option("--topics", metavar="A,B", help="Only these topics, by comma.")]
StartS = Annotated[float, typer.Option("--start", metavar="S", min=0.0, help="Leave out the first S seconds.")]
EndS = Annotated[float | None, typer.Option("--end", metavar="S", min=0.0, help="Stop S seconds from the start.")]

Raw = Annotated[bool, typer.Option("--raw", help="Record raw beams too (350 MB/s).")]
SplitSize = Annotated[
    float | None,
    typer.Option("--split-size", metavar="MB", help="A new file, OUT-00001 and so on, every MB (10^6 bytes)."),
]
SplitDuration = Annotated[
    float | None, typer.Option("--split-duration", metavar="S", help="A new file every S seconds.")
]
MaxParts = Annotated[
    int | None, typer.Option("--max-parts", metavar="N", help="Delete the oldest file of a split recording beyond N.")
]
SnapshotS = Annotated[
    float | None,
    typer.Option("--snapshot", metavar="S", help="Hold the last S seconds; write them at `mirrorwave bag snapshot`."),
]
MinFree = Annotated[
    float | None, typer.Option("--min-free", metavar="MB", help="End before the disk has less room (100 MB).")
]
_BYTES_PER_MB = 1_000_000
#: 30 years: longer times are a slip of the keys, and alarm clock and file take no much longer ones.
_LONGEST_S = 1e9


def recorder_params(
    split_size: float | None,
    split_duration: float | None,
    max_parts: int | None,
    snapshot: float | None,
    min_free: float | None,
) -> dict[str, Any]:
    """Parameters of the recorder from its options, those that were not given left out."""
    given = {
        "split_bytes": _bytes("--split-size", split_size),
        "split_s": split_duration,
        "max_parts": max_parts,
        "snapshot_s": snapshot,
        "min_free_bytes": _bytes("--min-free", min_free),
    }
    return {name: value for name, value in given.items() if value is not None}


def require_new_recording(out: Path, params: dict[str, Any]) -> None:
    """Raise `FileExistsError` where OUT, or one of the files OUT-00001, ... that `params` ask for, exists already."""
    from nodes.recording.files import numbered_files, numbered_path

    several = any(params.get(name) is not None for name in ("split_bytes", "split_s", "snapshot_s"))
    require_new_file(next(iter(numbered_files(out).values()), numbered_path(out, 1)) if several else out)


def command_line() -> str:
    """The command as it was given."""
    return shlex.join(["mirrorwave", *sys.argv[1:]])


def _bytes(option: str, megabytes: float | None) -> int | None:
    if megabytes is None:
        return None
    if not 0.0 <= megabytes < 1e12:
        raise ValueError(f"{option} must be a number of MB from 0, got {megabytes:g}")
    return round(_BYTES_PER_MB * megabytes)


def split_topics(topics: str | None) -> tuple[str, ...] | None:
    """Topics of a comma list, None where none was given; raises `ValueError` for an empty one."""
    if topics is None:
        return None
    names = tuple(name.strip() for name in topics.split(",") if name.strip())
    if not names:
        raise ValueError(f"--topics must name a topic, got {topics!r}")
    return names


def span_ns(
    first_ns: int, last_ns: int, start_s: float, end_s: float | None, duration_s: float | None = None
) -> tuple[int, int | None]:
    """Times of the span that `--start`, `--end` and `--duration` name, in seconds from `first_ns`, up to `last_ns`."""
    for option, value_s in (("--start", start_s), ("--end", end_s), ("--duration", duration_s)):
        require_seconds(option, value_s)
    if end_s is not None and duration_s is not None:
        raise ValueError(f"--end and --duration must not be given together, got {end_s:g} and {duration_s:g}")
    end_s = start_s + duration_s if duration_s is not None else end_s
    if start_s and first_ns + ns_from_s(start_s) > last_ns:
        raise ValueError(
            f"--start must be within the recording, {s_from_ns(last_ns - first_ns):.3g} s, got {start_s:g}"
        )
    # two times may be one nanosecond
    if end_s is not None and ns_from_s(end_s) <= ns_from_s(start_s):
        raise ValueError(f"--end must be after --start {start_s:g}, got {end_s:g}")
    return first_ns + ns_from_s(start_s), None if end_s is None else first_ns + ns_from_s(end_s)


def require_seconds(option: str, value_s: float | None) -> None:
    """Raise `ValueError` for a time that is no number, negative or endless."""
    if value_s is not None and not 0.0 <= value_s <= _LONGEST_S:
        raise ValueError(f"{option} must be 0..{_LONGEST_S:g} s, got {value_s:g}")


def stop_by_signal(stop: Any, duration_s: float | None) -> Any:
    """Have SIGINT, SIGTERM, SIGHUP unless it is ignored and, after `duration_s`, the alarm clock ask for the end."""
    from nodes.node import stopping_signals

    def end(number: int, frame: object) -> None:
        if number == signal.SIGALRM or not is_asked_again(number):
            # at once: publishers go on, so what waits would never end
            stop.request(at_once=True)

    for number in stopping_signals(signal.SIGINT, signal.SIGTERM, signal.SIGALRM):
        signal.signal(number, end)
    if duration_s is not None:
        signal.setitimer(signal.ITIMER_REAL, duration_s)
    return stop
