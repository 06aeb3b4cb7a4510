"""Shared parts of all verbs: exit codes, common options, tables for people, JSON for machines."""

from __future__ import annotations

import json
import math
import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext, suppress
from enum import IntEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import msgspec
import typer

from msgs.files.open_files import open_files_line
from msgs.values.wording import as_utf8, duration_text

if TYPE_CHECKING:
    from rich.console import Console, RenderableType
    from rich.progress import Progress as Bar


class ExitCode(IntEnum):
    """Exit codes of every verb."""

    DONE = 0
    FAILED = 1
    BAD_INPUT = 2
    DONE_WITH_LOSS = 3


AsJson = Annotated[bool, typer.Option("--json", help="Print JSON instead of a table.")]
Domain = Annotated[str, typer.Option("--domain", envvar="MIRRORWAVE_DOMAIN", help="Graph to talk to.")]
DEFAULT_DOMAIN = "default"


#: Tables: space between columns; a line of a text that wraps has at least so many cells, and a longer word is broken.
_GAP, _LINE, _LONG_WORD = 2, 20, 32
_UNLIMITED = 100_000
#: How often the progress of a long verb is shown, where stderr is no terminal and where it is one.
BEAT_S, BAR_S = 10.0, 0.2
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


def print_result(as_json: bool, value: Any, show: str | Callable[[], None]) -> None:
    """Print a result: as JSON, or as a line or what `show` prints of it."""
    if as_json:
        print_json(value)
    elif isinstance(show, str):
        print_line(show)
    else:
        show()


def printable(text: str) -> str:
    """`text` without control characters but tabs and line ends: what a file says must not steer a terminal."""
    return as_utf8(text).translate(_CONTROL)


def print_line(text: str) -> None:
    """One line on stdout."""
    with _printing():
        sys.stdout.write(printable(text) + "\n")
        sys.stdout.flush()


def print_table(columns: Sequence[str], rows: Iterable[Sequence[object]], drop: Sequence[str] = ()) -> None:
    """Print a table on stdout, laid out as `console_table` says."""
    print_picture(console_table(columns, rows, drop))


def print_rows(columns: Sequence[str], rows: Sequence[Mapping[str, object]], drop: Sequence[str] = ()) -> None:
    """Print these columns of mappings as a table, with their names as headings in capitals."""
    headings, least = ([name.upper() for name in names] for names in (columns, drop))
    print_table(headings, [[row[name] for name in columns] for row in rows], least)


def print_picture(picture: RenderableType) -> None:
    """Print anything that rich can draw, on stdout."""
    with _printing():
        stdout_console().print(picture)


def stdout_console() -> Console:
    """Stdout for rich; where no terminal sets the width, nothing is cut."""
    from rich.console import Console

    return Console(width=None if sys.stdout.isatty() else _UNLIMITED)


@contextmanager
def _printing() -> Iterator[None]:
    """Have an error of the file system name what it is about."""
    try:
        yield
    except BrokenPipeError:
        raise
    except OSError as error:
        raise OSError(error.errno, error.strerror, "standard output") from None


def console_table(
    columns: Sequence[str], rows: Iterable[Sequence[object]], drop: Sequence[str] = (), width: int | None = None
) -> RenderableType:
    """Return a table that fits a terminal of `width` cells, by default stdout's, without cutting a heading or a cell.

    Columns of numbers are aligned right. Where space is short, headings and long texts wrap at spaces; then the columns
    that `drop` names are left out, the first of them first, and a last line names them. Where the others are still too
    wide, each row is a block with one line a column.
    """
    from rich.console import Group
    from rich.table import Table
    from rich.text import Text

    width = stdout_console().width if width is None else width
    cells = [[_cell(value) for value in row] for row in rows]
    kept = list(range(len(columns)))
    left_out: list[int] = []
    least = [index for name in drop for index, column in enumerate(columns) if column == name]
    while (widths := _column_widths(columns, cells, kept, width)) is None and len(left_out) < len(least):
        left_out.append(least[len(left_out)])
        kept.remove(left_out[-1])
    # a few letters a line rather than no table
    widths = widths or _column_widths(columns, cells, kept, width, line=0)
    if widths is None:
        return Text("\n\n".join(_block(columns, row) for row in cells) or ", ".join(columns))
    # a wide one may have left room for others
    for index in reversed(left_out):
        if (more := _column_widths(columns, cells, sorted([*kept, index]), width)) is not None:
            kept, widths = sorted([*kept, index]), more
    names = ", ".join(columns[index] for index in sorted(set(left_out).difference(kept)))
    table = Table(box=None, pad_edge=False, header_style="bold")
    for index, column_width in zip(kept, widths, strict=True):
        justify: Literal["left", "right"] = "right" if _is_numeric(cells, index) else "left"
        table.add_column(Text(columns[index]), justify=justify, overflow="fold", width=column_width)
    for row in cells:
        table.add_row(*(Text(row[index]) for index in kept))
    note = f"left out at this width: {names}; a wider terminal or --json shows them"
    return Group(table, Text(note)) if names else table


def _column_widths(
    columns: Sequence[str], cells: list[list[str]], kept: list[int], width: int, line: int = _LINE
) -> list[int] | None:
    """Return widths of columns with the widest narrowed until all fit; None where they do not fit.

    A text that wraps has lines of `line` cells at least.
    """
    wanted, least = [], []
    for index in kept:
        texts = [row[index] for row in cells]
        widest = _width(texts)
        words = _width(word for text in texts for word in text.split())
        # a number is not broken, nor a short text; of a long one a few words stay on a line
        narrow = widest if _is_numeric(cells, index) else min(widest, max(min(words, _LONG_WORD), line))
        wanted.append(max(widest, _width([columns[index]])))
        least.append(max(narrow, _width(columns[index].split())))
    room = width - _GAP * (len(kept) - 1)
    if sum(least) > room:
        return None
    limits = range(max(wanted, default=0), -1, -1)
    narrowed = ([max(low, min(high, limit)) for low, high in zip(least, wanted, strict=True)] for limit in limits)
    widths = next(widths for widths in narrowed if sum(widths) <= room)
    for index, high in enumerate(wanted):
        widths[index] += min(high - widths[index], room - sum(widths))
    return widths


def _width(texts: Iterable[str]) -> int:
    """Terminal cells of the longest line."""
    from rich.cells import cell_len

    return max((cell_len(line) for text in texts for line in text.splitlines()), default=0)


def _block(columns: Sequence[str], row: list[str]) -> str:
    """One row, a line a column."""
    return "\n".join(f"{name}: {cell}" if name else cell for name, cell in zip(columns, row, strict=True))


def _is_numeric(cells: list[list[str]], index: int) -> bool:
    return any(row[index] != "-" for row in cells) and all(_is_number(row[index]) for row in cells)


class Progress:
    """Count of what a long verb has done, and of how much there is where that is known. Safe between threads."""

    def __init__(self, name: str, total: float | None, done: float, write: Callable[[str], None]) -> None:
        self.name, self.total, self.done = name, total, done
        self._write, self._start_s, self._kept = write, time.monotonic(), done

    def __call__(self, count: float = 1) -> None:
        """Add `count` to what is done."""
        self.done += count

    def update(self, done: float, total: float | None) -> None:
        """Set what is done, and of how much."""
        self.done, self.total = done, total

    def keep(self, count: float) -> None:
        """Add what an earlier run has done: its time says nothing of what is left."""
        self.done, self._kept = self.done + count, self._kept + count

    def print(self, text: str) -> None:
        """Write a line on stderr."""
        self._write(text)

    def line(self) -> str:
        """Return what is done, how long it took, and how long the rest takes at this rate, or what delays it."""
        elapsed_s, done = time.monotonic() - self._start_s, self.done - self._kept
        of = "" if self.total is None else f" of {self.total:.0f}"
        left, module = "", sys.modules.get("models.compiled")
        if module is not None and module.KernelCache.compiled and not done:
            left = f", {module.KernelCache.compiled} kernels compiled, which are kept"
        if self.total is not None and done > 0.0:
            left = f", {duration_text((self.total - self.done) * elapsed_s / done)} left"
        count = f"{self.done:.0f}{of}, " if self.done or of else ""
        return f"{self.name}: {count}{duration_text(elapsed_s)}{left}"


@contextmanager
def progress_bar(name: str, total: float | None = None, done: float = 0) -> Iterator[Progress]:
    """Show on stderr how much is done: a bar on a terminal, elsewhere a line every `BEAT_S`; gives what advances it."""
    ended = threading.Event()
    with _bar(name, total) if sys.stderr.isatty() else nullcontext() as bar:
        progress = Progress(name, total, done, _heartbeat if bar is None else bar.console.print)

        def show() -> None:
            while not ended.wait(BEAT_S if bar is None else BAR_S):
                if bar is None:
                    _heartbeat(progress.line())
                else:
                    bar.update(bar.task_ids[0], completed=progress.done, total=progress.total, line=progress.line())

        thread = threading.Thread(target=show, name="progress", daemon=True)
        thread.start()
        try:
            yield progress
        finally:
            ended.set()
            thread.join()


def _bar(name: str, total: float | None) -> Bar:
    from rich.console import Console
    from rich.progress import BarColumn, SpinnerColumn, TextColumn
    from rich.progress import Progress as Bar

    columns = (SpinnerColumn(), BarColumn(20), TextColumn("{task.fields[line]}", markup=False))
    # stdout is for results
    bar = Bar(*columns, console=Console(stderr=True), transient=True)
    bar.add_task("", total=total, line=name)
    return bar


def _heartbeat(line: str) -> None:
    with suppress(OSError):
        sys.stderr.write(f"{printable(line)}\n")
        sys.stderr.flush()


def file_or_sample(file: Path | None, sample: bool, name: str) -> Path:
    """Return the file that a verb was given, or the shipped sample; `ValueError` where it got both or neither."""
    from msgs.files.shipped import SAMPLE

    if sample != (file is None):
        raise ValueError(f"give {name} or --sample{', not both' if sample else ''}")
    return SAMPLE if file is None else file


def error_line(error: BaseException) -> str:
    """An error as one line that names file, field, value and rule, as far as it knows them."""
    if line := open_files_line(error):
        return line
    if isinstance(error, OSError) and error.filename is not None:
        return printable(f"{error.filename}: {error.strerror or type(error).__name__}")
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
        return f"{value:.3g}" if abs(value) < 999.5 else f"{value:.0f}"
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
