"""The page's token across restarts of its node: for one run of a graph, at one port, in a file private to its owner.

An open page reconnects to the restarted node only if that node knows the page's token. The file lies in the
graph's directory, which nobody else can enter. It is useless to another graph, and at another port: if the port
was taken by another program, that program may have learnt the token.
"""

from __future__ import annotations

import contextlib
import logging
import os
import re
import stat
from pathlib import Path

import msgspec

from msgs.files.whole_files import no_link
from nodes.process.supervisor import read_lock

_LOG = logging.getLogger(__name__)
_MAX_BYTES = 4096
_TOKEN = re.compile(r"[A-Za-z0-9_-]{32,128}")


class PageToken(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A token, and the run of the graph and the port for which it is valid."""

    #: The supervisor's process, its start in clock ticks since boot, and the folder of its run.
    graph: tuple[int, int, str]
    port: int
    token: str


class TokenFile:
    """File of a viewer's token; in a directory without a supervised graph it keeps none."""

    def __init__(self, path: Path) -> None:
        self._path = path
        owner = read_lock(path.parent)
        is_known = {"pid", "started", "run"} <= owner.keys()
        self._graph = (owner["pid"], owner["started"], owner["run"]) if is_known else None

    def load(self) -> PageToken | None:
        """Return the token that an earlier process of this node saved during this run of the graph."""
        if self._graph is None:
            return None
        try:
            saved = msgspec.json.decode(_read(self._path), type=PageToken)
        except FileNotFoundError:
            return None
        except (OSError, ValueError) as error:
            # neither the file's bytes nor msgspec's quotes: they may be a token
            _LOG.warning("%s: not used, a new token is drawn: %s", self._path, type(error).__name__)
            return None
        is_good = saved.graph == self._graph and _TOKEN.fullmatch(saved.token) and 0 < saved.port <= 65535
        return saved if is_good else None

    def save(self, port: int, token: str) -> None:
        """Save a token; if that fails the next process draws another, and the open page says so."""
        if self._graph is None:
            return
        page_token = PageToken(graph=self._graph, port=port, token=token)
        written = self._path.with_name(f"{self._path.name}.{os.getpid()}")
        try:
            with contextlib.suppress(FileNotFoundError):
                written.unlink()
            descriptor = os.open(written, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o600)
            with os.fdopen(descriptor, "wb") as file:
                file.write(msgspec.json.encode(page_token))
            written.replace(self._path)
        except OSError as error:
            _LOG.warning("%s: the page will not come back after a restart: %s", self._path, error.strerror)


def _read(path: Path) -> bytes:
    """Return the bytes of a regular file of ours that nobody else can read; raises `ValueError` for any other."""
    with open(path, "rb", opener=no_link) as file:
        status = os.fstat(file.fileno())
        if not stat.S_ISREG(status.st_mode) or status.st_uid != os.geteuid() or status.st_mode & 0o077:
            raise ValueError("must be a regular file of ours, mode 0600")
        return file.read(_MAX_BYTES + 1)
