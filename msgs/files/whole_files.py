"""Files that are there whole or not at all, room on their disk, and no way round through a symbolic link."""

from __future__ import annotations

import errno
import os
import secrets
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

#: What a disk, a quota or a limit answers where there is no room for more.
_NO_ROOM = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
_BYTES_PER_MB = 1_000_000


@contextmanager
def whole(path: Path, suffix: str = ".part") -> Iterator[Path]:
    """Where to write what becomes `path` when the context ends well; whatever else happens, what was there stays.

    `suffix` ends the name that it has until then, for writers that go by it. Raises `OSError` with the name of `path`
    where its disk refuses.
    """
    # a name that nobody knows before, and nobody else has: several may make the same file at once
    part = path.with_name(f".{path.name}.{secrets.token_hex(8)}{suffix}")
    try:
        with named(path, part):
            yield part
            os.replace(part, path)
    finally:
        part.unlink(missing_ok=True)


def write_whole(path: Path, content: bytes) -> None:
    """Write a small file whole or not at all."""
    with whole(path) as part:
        part.write_bytes(content)


@contextmanager
def named(path: Path, part: Path | None = None) -> Iterator[None]:
    """Have an `OSError` of a full disk, or about `part`, name the file that was to be written."""
    try:
        yield
    except OSError as error:
        is_nameless = error.filename is None and error.errno in _NO_ROOM
        if is_nameless or (part is not None and error.filename == str(part)):
            raise OSError(error.errno, error.strerror, str(path)) from None
        raise


def free_bytes(folder: Path) -> int:
    """Room on the file system of `folder` for an ordinary user."""
    found = os.statvfs(folder)
    return found.f_bavail * found.f_frsize


def require_room(path: Path, needed_bytes: int) -> None:
    """Raise `OSError` naming `path` where its disk has less room than it will take."""
    free = free_bytes(path.absolute().parent)
    if free < needed_bytes:
        reason = f"needs {-(-needed_bytes // _BYTES_PER_MB)} MB, {free // _BYTES_PER_MB} MB are free"
        raise OSError(errno.ENOSPC, reason, str(path))


def no_link(path: str | Path, flags: int) -> int:
    """Opener of files of one's own (mode 0600 where they are new); raises `ValueError` for a symbolic link."""
    try:
        # without O_NONBLOCK a pipe in the file's place would hold us up for ever
        return os.open(path, flags | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC, 0o600)
    except OSError as error:
        if error.errno == errno.ELOOP:
            raise ValueError(f"{path}: must not be a symbolic link") from None
        raise
