"""What the verbs of `mirrorwave bag` share: their arguments, spans of time, the wish to stop."""

from __future__ import annotations

import signal
from pathlib import Path
from typing import Annotated, Any

import typer

File = Annotated[Path, typer.Argument(metavar="FILE", help="Recording.")]
Out = Annotated[Path, typer.Argument(metavar="OUT", help="New recording.")]
Topics = Annotated[str | None, typer.Option("--topics", metavar="A,B", help="Only these topics, by comma.")]
StartS = Annotated[float, typer.Option("--start", metavar="S", min=0.0, help="Leave out the first S seconds.")]
EndS = Annotated[float | None, typer.Option("--end", metavar="S", min=0.0, help="Stop S seconds from the start.")]


def split_topics(topics: str | None) -> tuple[str, ...] | None:
    """Topics of a comma list, None where none was given."""
    return None if topics is None else tuple(name.strip() for name in topics.split(",") if name.strip())


def span_ns(summary: Any, start_s: float, end_s: float | None) -> tuple[int | None, int | None]:
    """Seconds from the start of a recording as its own times."""
    if end_s is not None and end_s <= start_s:
        raise ValueError(f"--end must be after --start {start_s:g}, got {end_s:g}")
    start_ns = summary.start_ns + int(1e9 * start_s)
    return start_ns, None if end_s is None else summary.start_ns + int(1e9 * end_s)


def stop_by_signal(stop: Any, duration_s: float | None) -> Any:
    """Have SIGINT, SIGTERM and, after `duration_s`, the alarm clock ask for the end."""
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGALRM):
        # at once: publishers go on, so what waits would never end
        signal.signal(number, lambda _number, _frame: stop.request(at_once=True))
    if duration_s is not None:
        signal.setitimer(signal.ITIMER_REAL, duration_s)
    return stop
