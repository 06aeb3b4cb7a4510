"""Files that are written whole or not at all, free space on their disk, and openers that refuse symbolic links."""

from __future__ import annotations

import errno
import os
import secrets
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

#: Error numbers of a disk, a quota or a limit without free space.
_NO_ROOM = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
_BYTES_PER_MB = 1_000_000


@contextmanager
def whole(path: Path, suffix: str = ".part") -> Iterator[Path]:
    """Yield a path to write to, ending in `suffix`; without an error it becomes `path`. `OSError` names `path`."""
    # an unpredictable name used by no other process: several may make the same file at once
    part = path.with_name(f".{path.name}.{secrets.token_hex(8)}{suffix}")
    try:
        with named_errors(path, part):
            yield part
            os.replace(part, path)
    finally:
        part.unlink(missing_ok=True)


def write_whole(path: Path, content: bytes) -> None:
    """Write a small file whole or not at all."""
    with whole(path) as part:
        part.write_bytes(content)


@contextmanager
def named_errors(path: Path, part: Path | None = None) -> Iterator[None]:
    """Name the file that was to be written in an `OSError` of a full disk or about `part`."""
    try:
        yield
    except OSError as error:
        is_nameless = error.filename is None and error.errno in _NO_ROOM
        if is_nameless or (part is not None and error.filename == str(part)):
            raise OSError(error.errno, error.strerror, str(path)) from None
        raise


def free_bytes(folder: Path) -> int:
    """Return the free space in bytes on the file system of `folder` for an ordinary user."""
    stats = os.statvfs(folder)
    return stats.f_bavail * stats.f_frsize


def require_room(path: Path, needed_bytes: int) -> None:
    """Raise `OSError` naming `path` if its disk has less free space than it needs."""
    free = free_bytes(path.absolute().parent)
    if free < needed_bytes:
        reason = f"needs {-(-needed_bytes // _BYTES_PER_MB)} MB, {free // _BYTES_PER_MB} MB are free"
        raise OSError(errno.ENOSPC, reason, str(path))


def no_link(path: str | Path, flags: int) -> int:
    """Open a file of one's own (mode 0600 if it is new); raises `ValueError` for a symbolic link."""
    try:
        # without O_NONBLOCK a pipe in the file's place would block for ever
        return os.open(path, flags | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC, 0o600)
    except OSError as error:
        if error.errno == errno.ELOOP:
            raise ValueError(f"{path}: must not be a symbolic link") from None
        raise
