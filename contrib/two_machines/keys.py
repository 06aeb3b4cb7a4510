"""Keys of encrypted links: CURVE certificate files, read only where nobody else could have read or changed them.

The files are those of `zmq.auth`: NAME.key holds the public key and may be given away, NAME.key_secret holds both. A
folder of public keys lists the peers that may connect.
"""

from __future__ import annotations

import ipaddress
import os
import re
import stat
import struct
from pathlib import Path
from typing import Any

import msgspec
import zmq
from zmq.utils import z85

#: Larger files are no certificates.
MAX_BYTES = 4096
#: A CURVE key in Z85.
KEY_CHARACTERS = 40
PUBLIC_SUFFIX = ".key"
SECRET_SUFFIX = ".key_secret"

_NAME = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_.-]{0,63}")
_FIELD = re.compile(rb"""^[ \t]*(public|secret)-key[ \t]*=[ \t]*["']?([^\s"']*)["']?[ \t]*\r?$""", re.MULTILINE)
_TCP_ADDRESS = re.compile(r"tcp://(?:\[(?P<bracketed>[^\[\]]+)\]|(?P<plain>[^\[\]:;/]+)):(?:[0-9]{1,5}|\*)")
_OTHERS_WRITE = stat.S_IWGRP | stat.S_IWOTH


class KeyPair(msgspec.Struct, frozen=True):
    """A public key and the secret it belongs to, 40 characters of Z85 each; its text forms never show the secret."""

    public: bytes
    secret: bytes

    def __repr__(self) -> str:
        return f"KeyPair(public={self.public!r}, secret=...)"

    def __rich_repr__(self) -> list[tuple[str, Any]]:
        return [("public", self.public)]


def generate(name: str, folder: Path) -> tuple[Path, Path]:
    """Make a new pair in `folder`, created if missing (mode 0700); return the paths of the public and secret file.

    Raises `ValueError` for an invalid name or a folder that others may write to, `FileExistsError` rather than
    overwrite a key, `OSError` if nothing can be written.
    """
    require_name(name)
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True, mode=0o700)
    _require_not_writable_by_others(folder)
    public_path, secret_path = folder / f"{name}{PUBLIC_SUFFIX}", folder / f"{name}{SECRET_SUFFIX}"
    public, secret = zmq.curve_keypair()
    _write_new(
        secret_path, 0o600, f'curve\n    public-key = "{public.decode()}"\n    secret-key = "{secret.decode()}"\n'
    )
    try:
        _write_new(public_path, 0o644, f'curve\n    public-key = "{public.decode()}"\n')
    except BaseException:
        secret_path.unlink()
        raise
    return public_path, secret_path


def load_own(path: Path) -> KeyPair:
    """Return the pair of a NAME.key_secret file.

    Raises `ValueError` naming file and rule: for a link, a file that is not ours or that group or others may read,
    that may be replaced by others, that is too large or holds no pair; `OSError` if it cannot be read.
    """
    path = Path(path)
    status, data = _read(path)
    if status.st_uid != os.geteuid():
        raise ValueError(f"{path}: a secret key must belong to who uses it, this one is user {status.st_uid}'s")
    if status.st_mode & 0o077:
        mode = stat.S_IMODE(status.st_mode)
        raise ValueError(f"{path}: a secret key must be readable by its owner alone, mode is {mode:04o}; chmod 600")
    if not path.parent.stat().st_mode & stat.S_ISVTX:
        _require_not_writable_by_others(path.parent)
    fields = _fields(data, path)
    if "secret" not in fields:
        raise ValueError(f"{path}: holds no secret key; the file that does ends in {SECRET_SUFFIX}")
    pair = KeyPair(public=_public(fields, path), secret=fields["secret"])
    if zmq.curve_public(pair.secret) != pair.public:
        raise ValueError(f"{path}: the public key does not belong to the secret key")
    return pair


def load_public(path: Path) -> bytes:
    """Return the public key of a NAME.key file.

    Raises `ValueError` naming file and rule: for a link, a file that group or others may write, that is too large,
    that holds no key, or a secret one too; `OSError` if it cannot be read.
    """
    path = Path(path)
    status, data = _read(path)
    if status.st_mode & _OTHERS_WRITE:
        raise ValueError(f"{path}: group or others may change this key; chmod 644")
    if b"secret-key" in data:
        raise ValueError(f"{path}: holds a secret key where a public one belongs; make a new pair if it was given away")
    return _public(_fields(data, path), path)


def allowed_signature(folder: Path) -> frozenset[tuple[str, int, int]]:
    """Return what changes with the files of a folder: names, sizes, times of change; raises `OSError`."""
    with os.scandir(folder) as entries:
        facts = [(entry.name, entry.stat(follow_symlinks=False)) for entry in entries]
    return frozenset((name, status.st_size, status.st_mtime_ns) for name, status in facts)


def load_allowed(folder: Path, may_be_empty: bool = False) -> dict[bytes, str]:
    """Return the public keys of all NAME.key files in `folder`, with the peers' names.

    Raises `ValueError` naming folder or file and rule: for a folder that is missing, holds no key unless it
    `may_be_empty`, a key twice or a secret, or that group or others may write to; and as `load_public` does.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise ValueError(f"{folder}: the folder of allowed keys does not exist")
    _require_not_writable_by_others(folder)
    entries = sorted(folder.iterdir())
    for path in entries:
        if path.name.endswith(SECRET_SUFFIX):
            raise ValueError(f"{path}: a secret key lies among the allowed keys; move it out")
    allowed: dict[bytes, str] = {}
    for path in entries:
        if path.name.endswith(PUBLIC_SUFFIX):
            name = path.name.removesuffix(PUBLIC_SUFFIX)
            require_name(name)
            public = load_public(path)
            if public in allowed:
                raise ValueError(f"{path}: the same key as {allowed[public]}{PUBLIC_SUFFIX}; every peer has its own")
            allowed[public] = name
    if not (allowed or may_be_empty):
        raise ValueError(f"{folder}: holds no key ending in {PUBLIC_SUFFIX}: nobody could connect")
    return allowed


def is_loopback(address: str) -> bool:
    """Return whether `tcp://HOST:PORT` stays on this machine: 127.0.0.0/8, [::1] or localhost; all else does not."""
    match = _TCP_ADDRESS.fullmatch(address)
    if match is None:
        return False
    host = match["bracketed"] or match["plain"]
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def require_name(name: str) -> None:
    """Raise `ValueError` unless `name` can name a peer and its key files."""
    if not _NAME.fullmatch(name):
        raise ValueError(
            f"a key's name must be 1..64 letters, digits, '_', '-' or '.', no '-' or '.' first, got {name!r}"
        )


def _write_new(path: Path, mode: int, text: str) -> None:
    """Write a file that did not exist before and never had a wider mode."""
    descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, mode)
    with os.fdopen(descriptor, "w", encoding="ascii") as file:
        # the caller's umask may have narrowed it
        os.fchmod(descriptor, mode)
        file.write(text)


def _read(path: Path) -> tuple[os.stat_result, bytes]:
    """Return facts and bytes of one and the same regular file, whatever happens to its path meanwhile."""
    if path.is_symlink():
        raise ValueError(f"{path}: a key file must not be a symbolic link")
    # without O_NONBLOCK a pipe in the key's place would block for ever
    descriptor = os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC)
    with os.fdopen(descriptor, "rb") as file:
        status = os.fstat(descriptor)
        if not stat.S_ISREG(status.st_mode):
            raise ValueError(f"{path}: a key must be a regular file")
        data = file.read(MAX_BYTES + 1)
    if len(data) > MAX_BYTES:
        raise ValueError(f"{path}: a key file holds at most {MAX_BYTES} bytes")
    return status, data


def _fields(data: bytes, path: Path) -> dict[str, bytes]:
    """Return `public` and `secret` of a certificate, each a key in Z85."""
    fields: dict[str, bytes] = {}
    for kind, key in _FIELD.findall(data):
        name = kind.decode()
        if name in fields:
            raise ValueError(f"{path}: holds more than one {name} key")
        # the value is not repeated: it may be a secret
        if not _is_key(key):
            raise ValueError(
                f"{path}: the {name} key must be {KEY_CHARACTERS} characters of Z85, got {len(key)} characters"
            )
        fields[name] = key
    return fields


def _public(fields: dict[str, bytes], path: Path) -> bytes:
    if "public" not in fields:
        raise ValueError(f"{path}: holds no public key")
    return fields["public"]


def _is_key(text: bytes) -> bool:
    try:
        return len(text) == KEY_CHARACTERS and len(z85.decode(text)) == 32
    except (KeyError, ValueError, struct.error):
        return False


def _require_not_writable_by_others(folder: Path) -> None:
    status = folder.stat()
    if status.st_mode & _OTHERS_WRITE or status.st_uid not in (os.geteuid(), 0):
        mode = stat.S_IMODE(status.st_mode)
        raise ValueError(
            f"{folder}: a folder of keys must be ours, not writable by group or others, mode is {mode:04o}; chmod 700"
        )
