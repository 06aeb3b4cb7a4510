"""`mirrorwave can`: what the car's CAN bus, or a log of it, says of the vehicle's motion."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from mirrorwave.console import (
    AsJson,
    ExitCode,
    print_json,
    print_line,
    print_result,
    print_rows,
    print_table,
    progress_bar,
)
from mirrorwave.terminal import ends_with_reader
from msgs.values.wording import counted

if TYPE_CHECKING:
    from mirrorwave.diagnose.can_log import LogReport
    from mirrorwave.diagnose.can_signals import SignalReport
    from msgs.values.vehicle import VehicleState
    from nodes.can.bus import BusParams

app = typer.Typer(help="Look at the vehicle's CAN bus and at logs of it.", no_args_is_help=True)

DBC = Path("launch/can/mirrorwave.dbc")
MAPPING = Path("launch/can/mirrorwave.yaml")
Dbc = Annotated[Path, typer.Option("--dbc", help="The car's DBC.")]
Mapping = Annotated[Path, typer.Option("--mapping", help="From the DBC's signals to the vehicle state, YAML.")]
Channel = Annotated[
    str | None, typer.Option("--channel", help="Only frames of this channel; ASC and BLF count from 1.")
]
Signals = Annotated[
    bool, typer.Option("--signals", help="Every signal of the DBC instead of the vehicle state; needs no mapping.")
]
#: Longer lists are cut on the terminal; --json keeps them whole.
_SHOWN_EVENTS = 40
#: How often a live bus is read, and how many gaps between frames of a message its period is taken from.
_POLL_S, _KEPT_GAPS = 0.005, 1000


@app.command()
def decode(
    log: Annotated[Path, typer.Argument(metavar="LOG", help="Log: candump (.log), ASC, BLF, CSV or TRC.")],
    dbc: Dbc = DBC,
    mapping: Mapping = MAPPING,
    channel: Channel = None,
    every: Annotated[float, typer.Option("--every", metavar="S", min=0.0, help="Show a state each S seconds.")] = 1.0,
    signals: Signals = False,
    as_json: AsJson = False,
) -> None:
    """The vehicle state over a log, and what was wrong with its frames; exit code 3 if the log breaks off."""
    from mirrorwave.diagnose.can_log import LogReport
    from msgs.files.shipped import shipped_path
    from nodes.can.bus import load_decoder
    from nodes.can.log_file import on_one_clock, read_log

    if signals:
        _decode_signals(log, dbc, channel, every, as_json)
        return
    report = LogReport(load_decoder(shipped_path(dbc), shipped_path(mapping)), every)
    with progress_bar("frames") as advance:
        report.read(_each(on_one_clock(read_log(log, channel)), advance))
    if report.frames == 0:
        raise ValueError(report.loss or f"{log}: holds no frames")
    print_result(as_json, {"log": str(log), **report.as_dict()}, lambda: _print_report(report))
    if report.loss:
        raise typer.Exit(ExitCode.DONE_WITH_LOSS)
    if not report.valid_states:
        raise typer.Exit(ExitCode.FAILED)


def _each(frames: Iterable[Any], advance: Callable[[], None]) -> Iterator[Any]:
    for frame in frames:
        yield frame
        advance()


def _print_report(report: LogReport) -> None:
    columns = ("time_s", "speed_mps", "yaw_rate_rps", "steering_rad", "valid", "reason")
    print_rows(columns, report.samples)
    print_line("")
    if report.events:
        keys = ("event", "from_s", "to_s", "count", "message", "why")
        shown = report.events[:_SHOWN_EVENTS]
        print_rows(keys, shown)
        if len(report.events) > len(shown):
            print_line(f"... {counted(len(report.events), 'event')} in all")
        print_line("")
    facts = report.as_dict()
    verdicts = ", ".join(f"{count} {verdict}" for verdict, count in facts["frames_by_verdict"].items())
    print_line(f"{counted(report.frames, 'frame')} in {report.duration_s:.2f} s: {verdicts}")
    print_line(f"{report.valid_states} of {counted(report.states, 'state')} valid")
    print_line(report.yaw_rate_bias)
    if any("outside the DBC's" in event["why"] for event in report.events):
        print_line("where the DBC's range of a signal is wrong, dbc_range of the mapping overrules it")
    if report.loss:
        print_line(f"the log breaks off: {report.loss}")


def _decode_signals(log: Path, dbc: Path, channel: str | None, every_s: float, as_json: bool) -> None:
    """All that a DBC knows of a log; exit code 1 if it knows none of its frames."""
    from mirrorwave.diagnose.can_log import until_error
    from mirrorwave.diagnose.can_signals import SignalReport
    from msgs.files.shipped import shipped_path
    from nodes.can.bus import load_dbc
    from nodes.can.log_file import on_one_clock, read_log

    report = SignalReport(load_dbc(shipped_path(dbc)), every_s)
    with progress_bar("frames") as advance:
        report.read(until_error(_each(on_one_clock(read_log(log, channel)), advance), report))
    if report.frames == 0:
        raise ValueError(report.loss or f"{log}: holds no frames")
    if as_json:
        print_json({"log": str(log), **report.as_dict()})
    else:
        columns = ("message", "frames", "period_ms", "longest_gap_ms", "verdicts", "last values")
        rows = [_signals_row(row) for row in report.messages()]
        print_table([name.upper() for name in columns], rows, ("LONGEST_GAP_MS", "PERIOD_MS"))
        print_line("")
        print_line(f"{report.known} of {counted(report.frames, 'frame')} in {report.duration_s:.2f} s are of this DBC")
        if report.loss:
            print_line(f"the log breaks off: {report.loss}")
    if report.loss:
        raise typer.Exit(ExitCode.DONE_WITH_LOSS)
    if not report.known:
        raise typer.Exit(ExitCode.FAILED)


def _signals_row(row: dict[str, Any]) -> list[Any]:
    verdicts = ", ".join(f"{count} {verdict}" for verdict, count in row["frames_by_verdict"].items())
    values = " ".join(f"{name}={value:g}" for name, value in row["signals"].items())
    return [
        f"{row['message']} ({row['id']:#x})",
        row["frames"],
        row["period_ms"],
        row["longest_gap_ms"],
        verdicts,
        values,
    ]


@app.command()
def monitor(
    interface: Annotated[str, typer.Option("--interface", "-i", help="python-can's name of it.")] = "socketcan",
    channel: Annotated[str, typer.Option("--channel", "-c", help="Bus, as the interface names it.")] = "can0",
    option: Annotated[
        list[str] | None,
        typer.Option("--option", "-o", metavar="KEY=VALUE", help="For the interface, as bitrate=500000; repeatable."),
    ] = None,
    dbc: Dbc = DBC,
    mapping: Mapping = MAPPING,
    every: Annotated[float, typer.Option("--every", metavar="S", min=0.01, help="A line each S seconds.")] = 0.5,
    duration: Annotated[float | None, typer.Option("--duration", metavar="S", help="Stop after S seconds.")] = None,
    signals: Signals = False,
    as_json: AsJson = False,
) -> None:
    """The vehicle state of a live bus, line by line; exit code 1 if it was never valid."""
    from mirrorwave.diagnose.can_log import state_row
    from nodes.vehicle_can import Params, create

    params = Params(
        interface=interface, channel=channel, options=_options(option or []),
        dbc=str(dbc), mapping=str(mapping),
    )  # fmt: skip
    if signals:
        _monitor_signals(params, every, duration, as_json)
        return
    node = create(params)
    was_valid = False
    try:
        with ends_with_reader():
            for state in _live_states(node, every, duration):
                was_valid = was_valid or state.valid
                print_result(as_json, state_row(state), _state_line(state))
    finally:
        node.close()
    if not was_valid:
        raise typer.Exit(ExitCode.FAILED)


def _monitor_signals(params: BusParams, every_s: float, duration_s: float | None, as_json: bool) -> None:
    """All messages of a DBC on a live bus, each interval; exit code 1 if none came."""
    from mirrorwave.diagnose.can_signals import SignalReport
    from msgs.files.shipped import shipped_path
    from nodes.can.bus import CanLink, load_dbc
    from nodes.vehicle_can import LiveSource, Params

    assert isinstance(params, Params)
    report = SignalReport(load_dbc(shipped_path(params.dbc)), None, _KEPT_GAPS)
    source = LiveSource(CanLink(params))
    start_s = time.monotonic()
    try:
        with ends_with_reader():
            for _ in _ticks(every_s, duration_s, lambda: report.read(source.frames(time.monotonic_ns()))):
                row = {"time_s": time.monotonic() - start_s, "trouble": source.trouble, "frames": report.frames}
                if as_json:
                    print_json({**row, "known_frames": report.known, "messages": report.messages()})
                else:
                    _print_signals_now(row, report)
    finally:
        source.close()
    if not report.known:
        raise typer.Exit(ExitCode.FAILED)


def _ticks(every_s: float, duration_s: float | None, poll: Callable[[], None]) -> Iterator[None]:
    """Each `every_s`, `poll` being called all the while."""
    start_s = time.monotonic()
    due_s = every_s
    while duration_s is None or time.monotonic() - start_s < duration_s:
        poll()
        if time.monotonic() - start_s >= due_s:
            due_s += every_s
            yield
        time.sleep(_POLL_S)


def _print_signals_now(row: dict[str, Any], report: SignalReport) -> None:
    trouble = f"; {row['trouble']}" if row["trouble"] else ""
    print_line(
        f"--- {row['time_s']:.1f} s: {report.known} of {counted(row['frames'], 'frame')} are of this DBC{trouble}"
    )
    for message in report.messages():
        name, frames, period_ms, _, verdicts, values = _signals_row(message)
        every = "" if period_ms is None else f" every {period_ms:g} ms"
        print_line(f"{name}: {counted(frames, 'frame')}{every}, {verdicts}: {values}")


def _live_states(node: Any, every_s: float, duration_s: float | None) -> Iterator[VehicleState]:
    """The newest state, each `every_s`; Ctrl-C ends it."""
    start_s = time.monotonic()
    last: VehicleState | None = None
    lines = 0
    while duration_s is None or time.monotonic() - start_s < duration_s:
        for _, state in node.step([], time.monotonic_ns()):
            last = state
        if last is not None and time.monotonic() - start_s >= (lines + 1) * every_s:
            lines += 1
            yield last
        time.sleep(max(0.0, 1e-9 * (node.due_ns(time.monotonic_ns()) - time.monotonic_ns())))


def _state_line(state: VehicleState) -> str:
    motion = (
        f"speed {state.speed_mps:8.3f} m/s  yaw rate {state.yaw_rate_rps:8.4f} rad/s  "
        f"steering {state.steering_rad:7.3f} rad"
    )
    return f"{motion}  {'valid' if state.valid else 'NOT VALID: ' + state.reason}"


def _options(texts: list[str]) -> dict[str, Any]:
    """`key=value` with values as YAML has them: numbers are numbers."""
    from nodes.process.launch_file import parse_yaml

    options = {}
    for text in texts:
        key, equals, value = text.partition("=")
        if not (key and equals):
            raise ValueError(f"--option {text}: expected key=value")
        options[key] = parse_yaml(value, f"--option {text}")
    return options
