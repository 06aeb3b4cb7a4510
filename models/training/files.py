"""Files that are there whole or not at all, and their checksums."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import msgspec


@contextmanager
def whole(path: Path) -> Iterator[Path]:
    """Where to write what becomes `path` when the context ends well; a kill in between leaves the old file."""
    # of its own for each process: several may make the same file at once
    part = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        yield part
        os.replace(part, path)
    finally:
        part.unlink(missing_ok=True)


def write_whole(path: Path, content: bytes) -> None:
    """Write a small file whole or not at all."""
    with whole(path) as part:
        part.write_bytes(content)


def file_sha256(path: Path) -> str:
    """SHA-256 of a file, hexadecimal; read in pieces, as captures are large."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def json_lines(value: object) -> bytes:
    """JSON for people to read: indented, with a last newline."""
    return msgspec.json.format(msgspec.json.encode(value), indent=2) + b"\n"
