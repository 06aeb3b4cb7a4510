"""Shared parts of all verbs: exit codes, common options, tables for people, JSON for machines."""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from enum import IntEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import msgspec
import typer

if TYPE_CHECKING:
    from rich.console import Console, RenderableType
    from rich.table import Table


class ExitCode(IntEnum):
    """Exit codes of every verb."""

    DONE = 0
    FAILED = 1
    BAD_INPUT = 2
    DONE_WITH_LOSS = 3


AsJson = Annotated[bool, typer.Option("--json", help="Print JSON instead of a table.")]
Domain = Annotated[str, typer.Option("--domain", envvar="MIRRORWAVE_DOMAIN", help="Graph to talk to.")]
DEFAULT_DOMAIN = "default"

_CONTROL = {code: "\N{REPLACEMENT CHARACTER}" for code in (*range(32), *range(127, 160)) if chr(code) not in "\t\n"}
#: What pictures may be written as.
PICTURE_SUFFIXES = (".png", ".svg", ".pdf")
#: File errors that mean a wrong argument, not a failing machine.
_WRONG_PATH = (FileNotFoundError, FileExistsError, IsADirectoryError, NotADirectoryError, PermissionError)


def print_json(value: Any) -> None:
    """One JSON document on one line of stdout; numbers that JSON lacks become null."""
    text = json.dumps(_plain(value), allow_nan=False)
    with _printing():
        sys.stdout.write(text + "\n")
        sys.stdout.flush()


def printable(text: str) -> str:
    """`text` without control characters but tabs and line ends: what a file says must not steer a terminal."""
    return text.translate(_CONTROL)


def print_line(text: str) -> None:
    """One line on stdout."""
    with _printing():
        sys.stdout.write(printable(text) + "\n")
        sys.stdout.flush()


def print_table(columns: Sequence[str], rows: Iterable[Sequence[object]]) -> None:
    """A table on stdout; columns of numbers are aligned right. Lines are never cut where stdout is no terminal."""
    print_picture(console_table(columns, rows))


def print_picture(picture: RenderableType) -> None:
    """Print anything that rich can draw, on stdout."""
    with _printing():
        stdout_console().print(picture)


def stdout_console() -> Console:
    """Stdout for rich; where nobody's eyes set the width, nothing is cut."""
    from rich.console import Console

    return Console(width=None if sys.stdout.isatty() else 1000)


@contextmanager
def _printing() -> Iterator[None]:
    """Have an error of the file system name what it is about."""
    try:
        yield
    except BrokenPipeError:
        raise
    except OSError as error:
        raise OSError(error.errno, error.strerror, "standard output") from None


def console_table(columns: Sequence[str], rows: Iterable[Sequence[object]]) -> Table:
    """The same as a rich table."""
    from rich.table import Table
    from rich.text import Text

    cells = [[_cell(value) for value in row] for row in rows]
    table = Table(box=None, pad_edge=False, header_style="bold")
    for index, name in enumerate(columns):
        numeric = bool(cells) and all(_is_number(row[index]) for row in cells)
        table.add_column(Text(name), justify="right" if numeric else "left", no_wrap=True)
    for row in cells:
        table.add_row(*(Text(cell) for cell in row))
    return table


@contextmanager
def progress_bar(name: str, total: int) -> Iterator[Callable[[], None]]:
    """A bar with the time left where stderr is a terminal; gives what advances it."""
    from rich.console import Console
    from rich.progress import Progress

    with Progress(console=Console(stderr=True), transient=True, disable=not sys.stderr.isatty()) as progress:
        task = progress.add_task(name, total=total)
        yield lambda: progress.advance(task)


@contextmanager
def scan_counter() -> Iterator[Callable[[], None]]:
    """Scans so far and the time they took, where stderr is a terminal; gives what advances them."""
    from rich.console import Console
    from rich.progress import Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

    columns = (SpinnerColumn(), TextColumn("{task.completed:.0f} scans"), TimeElapsedColumn())
    # stdout is for results
    console = Console(stderr=True)
    with Progress(*columns, console=console, transient=True, disable=not sys.stderr.isatty()) as progress:
        task = progress.add_task("scans", total=None)
        yield lambda: progress.advance(task)


@contextmanager
def compile_line() -> Iterator[None]:
    """Say on stderr, once, that kernels are compiled, where the body is the first to need them."""
    from nodes.process.compiling import compile_notice

    with compile_notice(lambda text: typer.echo(text, err=True)):
        yield


def file_or_sample(file: Path | None, sample: bool, name: str) -> Path:
    """Return the file that a verb was given, or the shipped sample; `ValueError` where it got both or neither."""
    from msgs.files.shipped import SAMPLE

    if sample != (file is None):
        raise ValueError(f"give {name} or --sample{', not both' if sample else ''}")
    return SAMPLE if file is None else file


def error_line(error: BaseException) -> str:
    """An error as one line that names file, field, value and rule, as far as it knows them."""
    if isinstance(error, OSError) and error.filename is not None:
        return f"{error.filename}: {error.strerror or type(error).__name__}"
    if isinstance(error, ImportError):
        return f"a package is missing: {error}"
    return printable(" ".join(str(error).split())) or type(error).__name__


def exit_code_of(error: BaseException) -> ExitCode:
    """2 for wrong usage or bad input, 1 for everything else."""
    bad_input = (ValueError, msgspec.MsgspecError, *_WRONG_PATH)
    return ExitCode.BAD_INPUT if isinstance(error, bad_input) else ExitCode.FAILED


def require_new_file(path: Path) -> None:
    """Raise `FileExistsError` rather than write over what somebody recorded."""
    if path.exists():
        raise FileExistsError(17, "exists already; choose another name", str(path))
    if not path.absolute().parent.is_dir():
        raise NotADirectoryError(20, "its directory does not exist", str(path))


def require_picture(path: Path) -> None:
    """Raise `ValueError` before the work rather than after it, where no picture can be written to `path`."""
    if path.suffix.lower() not in PICTURE_SUFFIXES:
        raise ValueError(f"{path}: a picture's name must end in {', '.join(PICTURE_SUFFIXES)}, got {path.suffix!r}")
    if not path.absolute().parent.is_dir():
        raise NotADirectoryError(20, "its directory does not exist", str(path))


def _cell(value: object) -> str:
    if value is None:
        return "-"
    if isinstance(value, float):
        return f"{value:.3g}" if abs(value) < 1000.0 else f"{value:.0f}"
    return printable(str(value))


def _is_number(cell: str) -> bool:
    return cell == "-" or cell.replace(".", "", 1).replace("-", "").replace("e+", "").isdigit()


def _plain(value: Any) -> Any:
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, dict):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    if isinstance(value, msgspec.Struct):
        return _plain(msgspec.to_builtins(value))
    return value
