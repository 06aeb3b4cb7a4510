"""Recordings, results and run folders of the working directory that other users of the machine may read."""

from __future__ import annotations

import itertools
import os
import stat
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from msgs.files.shipped import CHECKOUT

#: Endings of files that show what the sensors saw, or hold a log.
_KINDS = (".mcap", ".sigmf-meta", ".sigmf-data", ".jsonl", ".npz")
_OPEN = stat.S_IRWXG | stat.S_IRWXO
_ENTER = stat.S_IXGRP | stat.S_IXOTH
#: Levels below the folder that are looked at, and entries in all.
_LEVELS, _MAX_ENTRIES = 4, 20_000


class OpenFiles(NamedTuple):
    """Files of one folder that others may read, and what closes them."""

    number: int
    example: Path
    mode: int
    mend: str


def open_files(folder: Path) -> list[OpenFiles]:
    """Return a finding for each open folder in `folder` and each kind of open file; a checkout's are no user's."""
    opened: dict[tuple[Path, str], list[Path]] = {}
    for path in itertools.islice(_open_below(folder, 0), _MAX_ENTRIES):
        inside = path.relative_to(folder).parts
        opened.setdefault((folder / inside[0], "") if len(inside) > 1 else (folder, path.suffix), []).append(path)
    return [
        OpenFiles(
            len(paths),
            paths[0],
            stat.S_IMODE(paths[0].lstat().st_mode),
            f"chmod go-rwx {top / f'*{suffix}'}" if suffix else f"chmod -R go-rwx {top}",
        )
        for (top, suffix), paths in opened.items()
    ]


def _open_below(folder: Path, level: int) -> Iterator[Path]:
    try:
        entries = sorted(os.scandir(folder), key=lambda entry: entry.name)
    except OSError:
        return
    for entry in entries:
        try:
            mode = entry.stat(follow_symlinks=False).st_mode
        except OSError:
            continue
        if stat.S_ISDIR(mode):
            is_shipped = folder.resolve() == CHECKOUT and entry.name not in ("runs", "data")
            if level < _LEVELS and mode & _ENTER and not entry.name.startswith(".") and not is_shipped:
                yield from _open_below(Path(entry.path), level + 1)
        elif stat.S_ISREG(mode) and mode & _OPEN and entry.name.endswith(_KINDS):
            yield Path(entry.path)
