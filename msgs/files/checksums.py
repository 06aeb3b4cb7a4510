"""Checksums of files, and JSON that people read."""

from __future__ import annotations

import hashlib
from pathlib import Path

import msgspec


def file_sha256(path: Path) -> str:
    """Return the SHA-256 of a file, hexadecimal; read in pieces, as captures are large."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def json_lines(value: object) -> bytes:
    """Return indented JSON with a final newline."""
    return msgspec.json.format(msgspec.json.encode(value), indent=2) + b"\n"
